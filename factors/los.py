"""Factors of the los method: where a fixed target stands in the camera of a gyro-stabilised two-axis gimbal.

Frames: m gyro (IMU) on the carrier; b carrier; c camera on the gimbal, x right, y along the line of sight (LOS), z up;
t target, y towards it, z up its texture, as it stood when it was found. So t serves as the inertial frame: where the
target stands is part of the attitudes tRm, and a new target is a new chain of attitudes.

With the passive matrices Rx(a) = Exp(a ex)^T of CN102288133B, azimuth eta and elevation eps,

    cRm = Ry(camera_roll) Rz(collimation) Rx(eps + px) Ry(axis_nonperpendicularity) Rz(eta + dz) Rx(-gx) Ry(-gy),

dz = pz - gz. The LOS error (phx, phz) says that the target lies along (tan phz, 1, -tan phx) in c. Source: methods
page, section 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.gimbal import LocalMotion
from alidade.factors.gyro import rate_error
from alidade.factors.model import ROT3, Block, Model, Residuals, Stacked

# What else than the mounting spoils LOS errors, in the order of their block: s and rad/s, s and c of encoders rad.
SIGHT_ERRORS = (
    *("time_offset", "clock_skew", "los_scale", "target_rate_x", "target_rate_z"),
    *("azimuth sin", "azimuth cos", "elevation sin", "elevation cos", "encoder_delay"),
)

# The turns of cRm, right to left, and their axes.
_TURNS = {
    "gy": 1,
    "gx": 0,
    "azimuth": 2,
    "axis_nonperpendicularity": 1,
    "elevation": 0,
    "collimation": 2,
    "camera_roll": 1,
}
# Which turn an angle adds to, and its sign.
_PLACES = {
    "delta_px": ("elevation", 1.0),
    "delta_gx": ("gx", -1.0),
    "delta_gy": ("gy", -1.0),
    "delta_z": ("azimuth", 1.0),
    "delta_pz": ("azimuth", 1.0),
    "delta_gz": ("azimuth", -1.0),
    "camera_roll": ("camera_roll", 1.0),
    "collimation": ("collimation", 1.0),
    "axis_nonperpendicularity": ("axis_nonperpendicularity", 1.0),
}


@dataclass(frozen=True)
class LosContext(Stacked):
    """Motion and times of n pictures, required for derivatives by sensor errors.

    Attributes:
        motion: of gyro and gimbal near the stamps.
        elapsed: (n,) since the recording's first stamp, s.
        tracked: (n,) time since the picture's target was found, s.
        stamp_shift: (n,) correction that the stamps already contain, s.
    """

    motion: LocalMotion
    elapsed: Array
    tracked: Array
    stamp_shift: Array
    stacked: ClassVar = ("motion", "elapsed", "tracked", "stamp_shift")

    def late(self, sight: Array) -> Array:
        """Delay (n,), s, from the shifted stamps to the exposures, by SIGHT_ERRORS (n, 10)."""
        return np.asarray(sight[:, 0] - sight[:, 1] * self.elapsed - self.stamp_shift)


@dataclass(frozen=True)
class LosDirectionFactor(Model):
    """LOS errors of one target, exact for arbitrarily large mounting angles.

    Predicted: phz = atan2(dx, dy), phx = -atan2(dz, dy) with d = cRm tRm^T ey and, as a third row, the camera's roll
    about its line of sight, the twist about y that takes the target's texture to its picture: the rotation part of the
    picture's local similarity. Blocks: tRm at the stamps (rotations), the mounting angles `names` (rad), and with
    `context` the gyro bias (3, rad/s), SIGHT_ERRORS and, unless the gyro is perfect, its errors (6 to 19), see
    alidade.factors.gyro. With those errors

    - a picture was exposed at stamp + time_offset - clock_skew * elapsed, and an encoder read its axis encoder_delay
      later than its stamp; gyro and gimbal propagate attitude and angles there from the shifted stamp;
    - an encoder reads angle + s sin(angle) + c cos(angle);
    - phx and phz are measured larger by los_scale times themselves;
    - the target's frame turns at (target_rate_x, 0, target_rate_z), about its own axes, from where it was found.

    Attributes:
        time: (n,) stamps of the pictures, shifted by `context.stamp_shift`, s.
        measured: (n, 2) phx, phz, or (n, 3) with the roll, rad.
        sqrt_information: (n, 2, 2) or (n, 3, 3), 1/rad.
        gimbal: (n, 2) azimuth and elevation as read at the stamps, rad.
        names: the mounting angles that are variables; all others are zero.
        context: motion near the pictures; None: errors of the sensors are no variables.
        errors: numbers of the gyro's errors, 0 for a perfect gyro.
    """

    time: Array
    measured: Array
    sqrt_information: Array
    gimbal: Array
    names: tuple[str, ...] = ("delta_px", "delta_gx", "delta_gy", "delta_z")
    context: LosContext | None = None
    errors: int = 0
    shapes: ClassVar = {"gimbal": (2,)}
    stacked: ClassVar = ("time", "measured", "sqrt_information", "gimbal", "context")

    @property
    def rows(self) -> int:
        """Number of rows of a residual: 2, or 3 with the roll."""
        return self.measured.shape[1]

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: tRm, mounting angles; with a context also bias, SIGHT_ERRORS and gyro errors."""
        if self.context is None:
            return ROT3, len(self.names)
        return ROT3, len(self.names), 3, len(SIGHT_ERRORS), *([self.errors] if self.errors else [])

    def __call__(
        self,
        tRm: Array,
        angles: Array,
        bias: Array | None = None,
        sight: Array | None = None,
        errors: Array | None = None,
    ) -> Residuals:
        """Residual sqrt_information * (measured - predicted), (n, 2) or (n, 3)."""
        if self.context is None or bias is None or sight is None:
            residual, _, derivatives = self._residuals(tRm, angles, self.gimbal, 0.0)
            return residual, lambda: derivatives()[:2]
        motion, elapsed, tracked = self.context.motion, self.context.elapsed, self.context.tracked
        late = self.context.late(sight)
        turn, by_late, by_gyro = _carried(motion, late, bias, errors)
        gimbal, by_time, by_delay, by_encoder = self._gimbal(motion, sight[:, 5:9], late[:, None], sight[:, 9:])
        rotation = np.stack([sight[:, 3], np.zeros_like(late), sight[:, 4]], axis=1) * tracked[:, None]
        carried = so3.multiply(tRm, turn)
        seen = so3.multiply(so3.exp(-rotation), carried)
        residual, predicted, derivatives = self._residuals(seen, angles, gimbal, sight[:, 2:3])

        def jacobians() -> tuple[Array, ...]:
            by_attitude, by_angles, by_gimbal = derivatives()
            by_bias, *by_errors = by_gyro()
            by_exposure = by_attitude @ by_late + by_gimbal @ by_time[..., None]
            moving = -so3.matrix(so3.inverse(carried)) @ so3.right_jacobian(-rotation) * tracked[:, None, None]
            by_sight = [
                by_exposure,
                by_exposure * -elapsed[:, None, None],
                -self.sqrt_information[:, :, :2] @ predicted[:, :2, None],
                by_attitude @ moving[:, :, ::2],
                (by_gimbal[..., None] * by_encoder[:, None]).reshape(*by_gimbal.shape[:2], 4),
                by_gimbal @ by_delay[..., None],
            ]
            return (
                by_attitude @ so3.matrix(so3.inverse(turn)),
                by_angles,
                by_attitude @ by_bias,
                np.concatenate(by_sight, axis=2),
                *(by_attitude @ each for each in by_errors),
            )

        return residual, jacobians

    def _gimbal(self, move: LocalMotion, encoder: Array, late: Array, delay: Array) -> tuple[Array, ...]:
        """True angles (n, 2) `late` (n, 1) s after the stamps; derivatives by late, delay (n, 2), s, c (n, 2, 2).

        The errors (n, 4) are s and c of each encoder; angle + s sin(angle) + c cos(angle) = reading is solved by a step
        of fixed-point iteration and one of Newton's, which leaves s^4.
        """
        read, by_late, by_delay = move.moved(self.gimbal, late, delay)
        s, c = encoder[:, ::2], encoder[:, 1::2]
        angle = read - s * np.sin(read) - c * np.cos(read)
        sine, cosine = np.sin(angle), np.cos(angle)
        angle = angle - (angle + s * sine + c * cosine - read) / (1.0 + s * cosine - c * sine)
        sine, cosine = np.sin(angle), np.cos(angle)
        gain = 1.0 / (1.0 + s * cosine - c * sine)
        return angle, gain * by_late, gain * by_delay, -np.stack([gain * sine, gain * cosine], axis=2)

    def camera(self, angles: Array) -> Array:
        """Camera attitudes cRm (n, 4) at the stamps, for mounting angles (n, d), rad."""
        turned = self._camera(so3.identity(len(angles)), angles, self.gimbal)
        return so3.from_matrix(turned[:, :3].transpose(2, 0, 1))

    def predict(self, tRm: Array, angles: Array) -> Array:
        """LOS errors and roll phx, phz, roll (n, 3), rad, at attitudes tRm (n, 4) and mounting angles (n, d)."""
        return _picture(self._camera(tRm, angles, self.gimbal)[:, :3])

    @cached_property
    def _angle_signs(self) -> tuple[list[str], Array]:
        """Names of the elementary rotations in use, and each mounting angle's sign in these (turns, angles)."""
        touched = {_PLACES[name][0] for name in self.names} | {"azimuth", "elevation"}
        turns = [turn for turn in _TURNS if turn in touched]
        places = np.zeros((len(turns), len(self.names)))
        for i, name in enumerate(self.names):
            turn, sign = _PLACES[name]
            places[turns.index(turn), i] = sign
        return turns, places

    def _camera(self, tRm: Array, angles: Array, gimbal: Array) -> Array:
        """Camera matrix cRt with the elementary rotations' axes in c beside, (3, 3 + turns, n)."""
        turns, places = self._angle_signs
        angle = places @ angles.T
        angle[turns.index("azimuth")] += gimbal[:, 0]
        angle[turns.index("elevation")] += gimbal[:, 1]
        out = np.zeros((3, 3 + len(turns), len(tRm)))
        out[:, :3] = so3.matrix(tRm).transpose(2, 1, 0)
        cosine, sine = np.cos(angle), np.sin(angle)
        for i, turn in enumerate(turns):
            axis = _TURNS[turn]
            j, k = (axis + 1) % 3, (axis + 2) % 3
            upper, lower = out[j, : 3 + i], out[k, : 3 + i]
            rows = cosine[i] * upper + sine[i] * lower, cosine[i] * lower - sine[i] * upper
            out[j, : 3 + i], out[k, : 3 + i] = rows
            out[axis, 3 + i] = 1.0
        return out

    def _residuals(
        self, tRm: Array, angles: Array, gimbal: Array, scale: Array | float
    ) -> tuple[Array, Array, Callable[[], tuple[Array, Array, Array]]]:
        """Residuals with measured phx, phz scaled by `scale` (n, 1); phx, phz, roll; derivatives on demand.

        The derivatives are by tRm, angles and gimbal angles.
        """
        camera = self._camera(tRm, angles, gimbal)
        picture, scales = _picture(camera[:, :3]), np.ones((len(tRm), 3))
        scales[:, :2] += scale
        error = self.measured - (scales * picture)[:, : self.rows]
        if self.rows == 3:
            error[:, 2] = (error[:, 2] + np.pi) % (2.0 * np.pi) - np.pi

        def derivatives() -> tuple[Array, Array, Array]:
            turns, places = self._angle_signs
            # A passive turn by da moves the picture by Exp(-da axis), a right perturbation of tRm by Exp(-cRm delta).
            cRt = camera[:, :3].transpose(2, 0, 1)
            by_camera = scales[..., None] * _picture_jacobian(camera[:, :3])
            weighted = self.sqrt_information @ by_camera[:, : self.rows]
            by_turn = weighted @ camera[:, 3:].transpose(2, 0, 1)
            columns = [turns.index("azimuth"), turns.index("elevation")]
            return weighted @ cRt @ so3.matrix(tRm), by_turn @ places, by_turn[:, :, columns]

        return np.einsum("nij,nj->ni", self.sqrt_information, error), picture, derivatives


def _carried(
    motion: LocalMotion, late: Array, bias: Array, errors: Array | None
) -> tuple[Array, Array, Callable[[], list[Array]]]:
    """Gyro rotations (n, 4) from the stamps to `late` (n,) s after these, with derivatives on the right.

    Returns:
        The turns, and their derivatives by `late` (n, 3, 1) and by bias and errors.
    """
    late = late[:, None]
    turned, drivers = motion.turned(np.zeros_like(late), late), motion.drivers
    excess, by_excess = rate_error(late * bias, errors, turned, None if drivers is None else late * drivers)
    # Magnus' second term, of a rate that changes its direction.
    swerve = late**2 / 12.0 * so3.cross(motion.rate[:, 0], motion.rate[:, 1])
    arc = turned - excess + late * swerve
    rate = motion.turning(late)
    rate = rate - rate_error(bias, errors, rate, drivers)[0] + 3.0 * swerve
    to_end = so3.right_jacobian(arc)

    def by_gyro() -> list[Array]:
        by_bias, *by_errors = by_excess()
        return [-to_end @ (late[..., None] * by_bias), *(-to_end @ each for each in by_errors)]

    return so3.exp(arc), to_end @ rate[..., None], by_gyro


def _picture(cRt: Array) -> Array:
    """LOS errors and roll phx, phz, roll, (n, 3), rad, of the target for camera attitudes cRt (3, 3, n)."""
    x, y, z = cRt[:, 1]
    roll = np.arctan2(cRt[2, 0] - cRt[0, 2], cRt[0, 0] + cRt[2, 2])
    return np.stack([-np.arctan2(z, y), np.arctan2(x, y), roll], axis=1)


def _picture_jacobian(cRt: Array) -> Array:
    """Derivative (n, 3, 3) of phx, phz, roll by the left perturbation xi in Exp(xi) cRt."""
    x, y, z = cRt[:, 1]
    out = np.empty((cRt.shape[2], 3, 3))
    yz, xy = y * y + z * z, x * x + y * y
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = -1.0, x * y / yz, x * z / yz
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = x * z / xy, y * z / xy, -1.0
    sine, cosine = cRt[2, 0] - cRt[0, 2], cRt[0, 0] + cRt[2, 2]
    square = sine * sine + cosine * cosine
    a, b = cRt[1, 0], cRt[1, 2]
    out[:, 2, 0] = (cosine * a - sine * b) / square
    out[:, 2, 1] = -1.0
    out[:, 2, 2] = (cosine * b + sine * a) / square
    return out
