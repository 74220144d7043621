"""Whitening of gyro and encoder noise that errors of a gimbal couple into attitudes and pictures.

The angles from which a camera's attitude is computed contain noise: the gimbal turns with what the gyro that drives it
reads, that gyro's noise n included, and encoders have noise of their own. With a perfect gimbal neither matters: the
camera turns with the gimbal, and encoder noise is part of the stated noise v of pictures. Let an error of size e turn
the camera by e f about an axis a, f a function of the gimbal angles. A step dg of the angles then turns the attitudes
that follow from angles and pictures by a further

    e Y dg,    Y dg = a (grad f) dg + f sum_k (a_k x a) dg_k,

a_k the axes of those of the gimbal's turns that stand between gyro and a. So errors e_i change the noise of the gyro's
increments to (1 + K) n, K n = sum e_i Y_i dg, with the steps dg by which n drives the gimbal; and that of pictures to
(1 + K) v, K v = sum e_i Y_i dg, with the steps E(dg | v) that are the encoders' part of v: the smaller a part, the
larger v is than stated.

Errors that are unknowns would be chosen to make that noise smaller, and be biased by a number of sigmas that grows with
the square root of the recording's length. Multiplied with the inverse of 1 + K, residuals have the same noise whatever
the errors are. K is of first order in them, so they are counted from a first guess, where K is 0. Of the camera's own
turns, whose priors are the widest, it is of second order (of pictures but for e^2 times the encoders' share of v): what
is left of that order counts as information once the rows are more than the inverse of a prior's variance, 10,000 for a
roll of .6 deg. Without it the camera of an hour at 10 pictures/s rolled by 58 prior sigmas.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from alidade.factors.array import Array
from alidade.factors.los import SIGHT_ERRORS
from alidade.factors.model import Block, Model, Residuals, Stacked, WrappedModel, dimension

# The turns of gimbal and camera, from the gyro on.
_AZIMUTH, _ELEVATION, _NONPERPENDICULARITY, _COLLIMATION, _ROLL = range(5)
# Beside them: a LOS error larger by a scale, as if the camera turned by so much more with every step.
_LOS_SCALE = 5
# The camera's axes in the order of the pictures' rows, phx, phz and roll, which are larger by its turns about them.
_X, _Z, _Y = range(3)
# Turn of the camera, rad, up to which the second order is counted: ten prior sigmas of a roll. Beyond, where nothing
# fits, it only lengthens the way to the minimum: 65 iterations in place of 40, or more than 100.
_LARGEST_TURN = 0.1
# Which turn a mounting angle adds to; those that stand before the gimbal change nothing.
_TURNS = {
    "delta_px": _ELEVATION,
    "axis_nonperpendicularity": _NONPERPENDICULARITY,
    "collimation": _COLLIMATION,
    "camera_roll": _ROLL,
}
_SCALE, _ENCODERS = SIGHT_ERRORS.index("los_scale"), SIGHT_ERRORS.index("azimuth sin")
# An error: number of its block and column there, first guess, turn, f (n or 1,), its derivatives by the angles
# (n or 1, 2).
Error = tuple[int, int, float, int, Array, Array]


@dataclass(frozen=True)
class GimbalErrors(Stacked):
    """Error model of a gimbal's mounting and encoders.

    Attributes:
        names: mounting angles that are variables.
        mount: their first guess, rad.
    """

    names: tuple[str, ...]
    mount: tuple[float, ...]
    stacked: ClassVar = ()

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Sizes of the variable blocks: mounting angles, rad, and SIGHT_ERRORS."""
        return len(self.names), len(SIGHT_ERRORS)

    def each(self, gimbal: Array) -> Iterator[Error]:
        """Yield the errors at gimbal angles (n, 2), rad; an encoder reads s sine + c cosine too much."""
        for column, name in enumerate(self.names):
            if name in _TURNS:
                yield 0, column, self.mount[column], _TURNS[name], np.ones(1), np.zeros((1, 2))
        yield 1, _SCALE, 0.0, _LOS_SCALE, np.ones(1), np.zeros((1, 2))
        sine, cosine = np.sin(gimbal), np.cos(gimbal)
        for turn in (_AZIMUTH, _ELEVATION):
            only, column = np.eye(2)[turn], _ENCODERS + 2 * turn
            yield 1, column, 0.0, turn, -sine[:, turn], -cosine * only
            yield 1, column + 1, 0.0, turn, -cosine[:, turn], sine * only


@dataclass(frozen=True)
class GimbalMap(Stacked):
    """LOS error map over the gimbal angles: errors of phx and phz that are linear in given functions of these.

    Attributes:
        functions: (n, k) of each measurement.
        slopes: (n, k, 2) their derivatives by azimuth and elevation.
    """

    functions: Array
    slopes: Array
    stacked: ClassVar = ("functions", "slopes")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Size of the variable block: coefficients c, of phx and phz function by function."""
        return (2 * self.functions.shape[1],)

    def each(self, _: Array) -> Iterator[Error]:
        """Yield the map's errors, which increase the measured phx and phz as a camera rotation would."""
        for j in range(self.functions.shape[1]):
            for axis, turn in enumerate((_ELEVATION, _COLLIMATION)):
                yield 0, 2 * j + axis, 0.0, turn, self.functions[:, j], self.slopes[:, j]


@dataclass(frozen=True)
class ThroughGimbalFactor(WrappedModel):
    """Gyro increments, or gimbal pictures, whitened so that gimbal errors do not change their noise.

    Blocks: those of the model and, unless these are among them, those of the errors.

    Attributes:
        model: of n measurements: increments of the gyro that drives the gimbal, in its axes; or, with `encoder`,
            pictures: phx, phz and perhaps the roll, with `sqrt_information`.
        gimbal: (n, 2) azimuth and elevation, rad.
        errors: of the gimbal.
        encoder: (n,) sigma of the encoders' noise within the pictures', rad.
        weights: (n, m) inverse of the pictures' noise in units of the whitening noise; None: 1.
        following: the share of the gyro's commands that the gimbal follows.
        error_blocks: which of the model's blocks hold the errors; empty: they are appended after the model's.
    """

    gimbal: Array
    errors: GimbalErrors | GimbalMap
    encoder: Array | None = None
    following: float = 1.0
    error_blocks: tuple[int, ...] = ()
    weights: Array | None = None
    shapes: ClassVar = {"gimbal": (2,), "encoder": ()}
    stacked: ClassVar = ("model", "gimbal", "errors", "encoder", "weights")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the wrapped model and of the errors."""
        return (*self.model.blocks, *(() if self.error_blocks else self.errors.blocks))

    def at_noise(self, weights: Array) -> Model:
        """Return the model with the encoders' share of noise 1 / weights (n, m) times the one used for whitening."""
        return replace(self, model=self.model.at_noise(weights), weights=weights)

    def __call__(self, *blocks: Array) -> Residuals:
        """Residual (1 + K)^-1 r, (n, m), with r the residual of the wrapped model."""
        count = len(self.model.blocks)
        error_blocks = self.error_blocks or tuple(range(count, len(blocks)))
        residuals, jacobians = self.model(*blocks[:count])
        errors = list(self.errors.each(self.gimbal))
        e = np.stack([blocks[error_blocks[block]][:, column] - guess for block, column, guess, *_ in errors])
        to_steps, to_residuals = self._units()
        Y = self._by_steps([error[3:] for error in errors])
        change = np.einsum("en,ekjn->kjn", e, Y)
        for i, second in self._second_derivatives([error[3] for error in errors]):
            held = np.clip(e[i], -_LARGEST_TURN, _LARGEST_TURN)
            change += 0.5 * held**2 * second
            Y[i] += np.where(held == e[i], held, 0.0) * second
        K = to_residuals @ change.transpose(2, 0, 1) @ to_steps
        whitening = np.linalg.inv(np.eye(self.rows) + K)
        residuals = np.einsum("nij,nj->ni", whitening, residuals)

        def all_jacobians() -> tuple[Array, ...]:
            steps = np.einsum("njm,nm->jn", to_steps, residuals)
            by_errors = whitening @ to_residuals @ (Y * steps).sum(axis=2).transpose(2, 1, 0)
            own = whitening @ np.concatenate(jacobians(), axis=2)
            added = np.zeros((*residuals.shape, sum(block.shape[1] for block in blocks[count:])))
            ends = np.cumsum([dimension(block) for block in self.blocks])[:-1]
            out = np.split(np.concatenate([own, added], axis=2), ends, axis=2)
            for i, (block, column, *_) in enumerate(errors):
                out[error_blocks[block]][:, :, column] -= by_errors[:, :, i]
            return tuple(out)

        return residuals, all_jacobians

    def _units(self) -> tuple[Array, Array]:
        """Derivatives of gimbal steps by whitened residuals (n, 2, m), and of these by camera rotation (n, m, 3)."""
        (sa, se), (ca, ce) = np.sin(self.gimbal).T, np.cos(self.gimbal).T
        zero = np.zeros_like(sa)
        if self.encoder is None:
            camera = np.array([[ca, sa * se, -sa * ce], [sa, -ca * se, ca * ce], [zero, ce, se]]).transpose(2, 0, 1)
            # What alidade.factors.gimbal.command does.
            steps = np.stack([camera[:, :, _Z] / ce[:, None], camera[:, :, _X]], axis=1)
            return -self.following * steps, camera
        by_angles = np.array([[zero, ce, se], [zero + 1.0, zero, zero]]).transpose(2, 1, 0)
        to_residuals = self.sqrt_information @ np.eye(3)[: self.rows]
        information = np.ones_like(to_residuals[:, :, 0]) if self.weights is None else self.weights**2
        to_steps = (information[..., None] * (to_residuals @ by_angles)).swapaxes(1, 2)
        return (self.encoder**2)[:, None, None] * to_steps, to_residuals

    def _second_derivatives(self, turns: list[int]) -> Iterator[tuple[int, Array]]:
        """Yield the numbers of the errors that turn the camera itself, and the derivative of each Y by its error.

        Of all `turns`; the derivative is (3, 2, n), a x (a x a_k) of pictures, with the axes of the module's text;
        attitudes turn back. What a collimation and a roll do together is left out: it rotates noise, and lets none pass
        for information.
        """
        sign = -1.0 if self.encoder is None else 1.0
        elevation = self.gimbal[:, 1]
        across = {_COLLIMATION: (_Y, np.sin(elevation)), _ROLL: (_Z, np.cos(elevation))}
        for i, turn in enumerate(turns):
            if turn in across:
                axis, by_azimuth = across[turn]
                second = np.zeros((3, 2, len(elevation)))
                second[_X, 1], second[axis, 0] = -sign, -sign * by_azimuth
                yield i, second

    def _by_steps(self, errors: list[tuple[int, Array, Array]]) -> Array:
        """Matrices Y (errors, 3, 2, n), camera frame, of errors with rotation axis, function, angle derivatives."""
        se, ce = np.sin(self.gimbal[:, 1]), np.cos(self.gimbal[:, 1])
        out = np.zeros((len(errors), 3, 2, len(se)))
        for Y, (turn, value, slopes) in zip(out, errors, strict=True):
            if turn == _AZIMUTH:
                Y[_Z], Y[_Y] = ce * slopes.T, se * slopes.T
            elif turn == _ELEVATION:
                Y[_X] = slopes.T
                Y[_Z, 0], Y[_Y, 0] = -se * value, ce * value
            elif turn == _NONPERPENDICULARITY:
                Y[_Z], Y[_Y] = -se * slopes.T, ce * slopes.T
                Y[_X, 0] = -value
            elif turn == _COLLIMATION:
                Y[_Z] = slopes.T
                Y[_X, 0], Y[_Y, 1] = se * value, -value
            elif turn == _LOS_SCALE:
                Y[_X, 1], Y[_Z, 0] = value, ce * value
            else:
                Y[_Y] = slopes.T
                Y[_X, 0], Y[_Z, 1] = -ce * value, value
        return out
