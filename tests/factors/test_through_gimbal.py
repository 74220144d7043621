"""Noise through a gimbal's angles: what errors let through, taken off the residuals again; analytic Jacobians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.gimbal import command
from alidade.factors.gyro import GyroIncrementFactor
from alidade.factors.los import SIGHT_ERRORS, LosDirectionFactor
from alidade.factors.model import Block, Model, Residuals
from alidade.factors.preintegration import GyroPath
from alidade.factors.testing import assert_jacobians
from alidade.factors.through_gimbal import GimbalErrors, GimbalMap, ThroughGimbalFactor
from alidade.pipelines.estimation.error_map import ErrorMap

N = 15
TIME = np.linspace(0.0, 1.0, N)
NAMES = ("delta_px", "delta_gx", "delta_gy", "delta_z", "camera_roll", "collimation", "axis_nonperpendicularity")
ENCODERS, SCALE = slice(5, 9), SIGHT_ERRORS.index("los_scale")
GIMBAL = np.random.default_rng(1).uniform(-0.8, 0.8, (N, 2))
MOUNT = tuple((1e-2 * np.random.default_rng(2).standard_normal(len(NAMES))).tolist())


@dataclass(frozen=True)
class _Fixed(Model):
    """Residuals (n, m) that depend on nothing but a number that they are multiplied with."""

    time: Array
    residuals: Array
    sqrt_information: Array
    blocks: tuple[Block, ...] = (1,)
    stacked: ClassVar = ("time", "residuals", "sqrt_information")

    @property
    def rows(self) -> int:
        return self.residuals.shape[1]

    def __call__(self, factor: Array) -> Residuals:
        return factor * self.residuals, lambda: (self.residuals[..., None],)


def _fixed(residuals: Array, sqrt_information: Array | None = None) -> _Fixed:
    root = np.tile(np.eye(residuals.shape[1]), (N, 1, 1)) if sqrt_information is None else sqrt_information
    return _Fixed(TIME, residuals, root)


def _pictures(gimbal: Array, angles: Array, encoder: Array, tRm: Array) -> Array:
    """phx, phz and roll (n, 3) for angles (d,) at gimbal angles that encoders with s, c (4,) read."""
    s, c = encoder[::2], encoder[1::2]
    true = gimbal - s * np.sin(gimbal) - c * np.cos(gimbal)
    return _level(true).predict(tRm, np.tile(angles, (N, 1)))


def _level(gimbal: Array) -> LosDirectionFactor:
    return LosDirectionFactor(TIME, np.zeros((N, 3)), np.tile(np.eye(3), (N, 1, 1)), gimbal, NAMES)


def _camera(gimbal: Array, angles: Array, encoder: Array) -> Array:
    s, c = encoder[::2], encoder[1::2]
    true = gimbal - s * np.sin(gimbal) - c * np.cos(gimbal)
    return _level(true).camera(np.tile(angles, (N, 1)))


def _errors(size: float, only: str | None = None) -> tuple[Array, Array, float, list[Array]]:
    """Angles, s and c, the scale of LOS errors, and the blocks (N, d) that contain them; or one angle alone."""
    rng = np.random.default_rng(3)
    angles, encoder, scale = size * rng.standard_normal(len(NAMES)), size * rng.standard_normal(4), size
    if only is not None:
        angles, encoder, scale = np.where(np.array(NAMES) == only, size, 0.0), np.zeros(4), 0.0
    sight = np.zeros(len(SIGHT_ERRORS))
    sight[ENCODERS], sight[SCALE] = encoder, scale
    return angles, encoder, scale, [np.tile(each, (N, 1)) for each in (angles + np.array(MOUNT), sight)]


ERRORS = {"all": (1e-3, None), "collimation": (0.04, "collimation"), "camera_roll": (0.04, "camera_roll")}


@pytest.mark.parametrize("following", [1.0, 0.4])
@pytest.mark.parametrize("which", ERRORS)
def test_noise_of_increments_is_that_of_the_gyro_whatever_the_gimbal_is(which: str, following: float) -> None:
    """The gimbal, driven by n, moves the camera by a step; attitudes of the gyro follow from angles and pictures.

    The camera's own turns change it by less than second order, 2e-3: what is left would pass for information.
    """
    angles, encoder, scale, blocks = _errors(*ERRORS[which])
    step, n = 1e-3, np.random.default_rng(4).standard_normal((N, 3))

    def turned(gimbal: Array) -> Array:
        true = so3.inverse(_camera(gimbal, np.zeros(len(NAMES)), np.zeros(4)))
        azimuth, elevation = (gimbal - GIMBAL).T
        larger = scale * np.stack([elevation, 0.0 * azimuth, np.cos(GIMBAL[:, 1]) * azimuth], axis=1)
        return so3.compose(true, so3.exp(-larger), _camera(gimbal, angles, encoder))

    half = 0.5 * step * following * command(n, GIMBAL)
    through = so3.log(so3.multiply(so3.inverse(turned(GIMBAL - half)), turned(GIMBAL + half))) / step
    read = n - through
    ours = ThroughGimbalFactor(_fixed(read), GIMBAL, GimbalErrors(NAMES, MOUNT), following=following)
    assert np.abs(read - n).max() > 2e-3
    np.testing.assert_allclose(ours(np.ones((N, 1)), *blocks)[0], n, atol=3e-5 if which == "all" else 5e-4)


@pytest.mark.parametrize(("rows", "stated"), [(2, 1.0), (3, 1.0), (2, 0.4), (3, 2.0)])
@pytest.mark.parametrize("which", ERRORS)
def test_noise_of_pictures_is_the_same_whatever_the_gimbal_is(which: str, rows: int, stated: float) -> None:
    """Covariance of encoder noise in pictures, by differences at the errors, whitened at its true level: 1."""
    angles, encoder, scale, blocks = _errors(*ERRORS[which])
    sigma, own = 5e-6, 4e-6

    def covariance(angles: Array, encoder: Array, scale: float) -> Array:
        tRm = _camera(GIMBAL, angles, encoder)
        out = np.tile(own**2 * np.eye(rows), (N, 1, 1))
        for step in 1e-4 * np.eye(2):
            ahead, behind = (_pictures(GIMBAL + s * step, angles, encoder, tRm)[:, :rows] for s in (1, -1))
            by_angle = (ahead - behind) / 2e-4
            by_angle[:, :2] *= 1.0 + scale
            out += sigma**2 * by_angle[:, :, None] * by_angle[:, None, :]
        return out

    root = np.linalg.cholesky(np.linalg.inv(covariance(np.zeros(len(NAMES)), np.zeros(4), 0.0))).swapaxes(1, 2) / stated
    spread = root @ np.linalg.cholesky(covariance(angles, encoder, scale))
    columns = []
    for column in np.moveaxis(spread, 2, 0):
        errors = GimbalErrors(NAMES, MOUNT)
        ours = ThroughGimbalFactor(_fixed(column, root), GIMBAL, errors, np.full(N, sigma))
        columns.append(stated * ours.at_noise(np.full((N, rows), stated))(np.ones((N, 1)), *blocks)[0])
    whitened = np.stack(columns, axis=2)
    assert np.abs(stated**2 * spread @ spread.swapaxes(1, 2) - np.eye(rows)).max() > 5e-4
    atol = 2e-5 if which == "all" else 1e-3  # with the first order alone 2e-3
    np.testing.assert_allclose(whitened @ whitened.swapaxes(1, 2), np.tile(np.eye(rows), (N, 1, 1)), atol=atol)


def test_map_lets_through_what_errors_of_the_gimbal_do() -> None:
    """A larger phx is a larger elevation, a larger phz a collimation; less the sine of an angle the encoder's error."""
    n, c = np.random.default_rng(4).standard_normal((N, 3)), 1e-2
    one, constant = np.ones((N, 1)), GimbalMap(np.ones((N, 1)), np.zeros((N, 1, 2)))
    mounted = ThroughGimbalFactor(_fixed(n), GIMBAL, GimbalErrors(NAMES, MOUNT))
    for axis, name in enumerate(("delta_px", "collimation")):
        angles, numbers = _zeros()[0], np.zeros((N, 2))
        angles[:, NAMES.index(name)] += c
        numbers[:, axis] = c
        mapped = ThroughGimbalFactor(_fixed(n), GIMBAL, constant)(one, numbers)[0]
        np.testing.assert_allclose(mapped, mounted(one, angles, _zeros()[1])[0], rtol=0, atol=1e-12)
    sine = GimbalMap(-np.sin(GIMBAL[:, 1:]), np.stack([np.zeros((N, 1)), -np.cos(GIMBAL[:, 1:])], axis=2))
    encoders = _zeros()[1]
    encoders[:, SIGHT_ERRORS.index("elevation sin")] = c
    mapped = ThroughGimbalFactor(_fixed(n), GIMBAL, sine)(one, np.tile([c, 0.0], (N, 1)))[0]
    assert np.abs(mapped - n).max() > 1e-3
    np.testing.assert_allclose(mapped, mounted(one, _zeros()[0], encoders)[0], rtol=0, atol=1e-12)


def test_slopes_of_a_map_are_those_of_its_functions() -> None:
    """Of a map that is the sines of both angles, by differences between measurements close to each other."""
    gimbal = np.random.default_rng(8).uniform(-0.8, 0.8, (40, 2)).repeat(3, axis=0)
    gimbal[1::3, 0] += 1e-6
    gimbal[2::3, 1] += 1e-6
    slopes = np.cos(gimbal)[..., None] * np.eye(2)
    places = {"azimuth": gimbal[:, 0], "elevation": gimbal[:, 1]}
    found = ErrorMap.of("map", "xz", 1e-4, ("los",), np.arange(120.0), np.sin(gimbal), places, slopes=slopes)
    assert found is not None
    assert found.slopes is not None
    f = found.functions
    numeric = np.stack([f[1::3] - f[::3], f[2::3] - f[::3]], axis=2) / 1e-6
    np.testing.assert_allclose(found.slopes[::3], numeric, atol=1e-4)


def _zeros() -> list[Array]:
    return [np.tile(MOUNT, (N, 1)), np.zeros((N, len(SIGHT_ERRORS)))]


def test_jacobians_of_increments_agree_with_differences() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 4.0, 0.005)
    path = GyroPath(t, np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None]), np.zeros(3))
    stop = np.linspace(0.5, 3.5, N)
    turns = path.increments(stop - 0.1, stop, scale=True)
    model = GyroIncrementFactor(stop, turns, path, np.full(N, 1e-2), errors=6)
    start = so3.exp(rng.standard_normal((N, 3)))
    end = so3.compose(start, turns.wxyz, so3.exp(0.02 * rng.standard_normal((N, 3))))
    blocks = [start, end, 0.01 * rng.standard_normal((N, 3)), 0.01 * rng.standard_normal((N, 6)), *_errors(0.05)[3]]
    assert_jacobians(ThroughGimbalFactor(model, GIMBAL, GimbalErrors(NAMES, MOUNT)), blocks)


@pytest.mark.parametrize("rows", [2, 3])
def test_jacobians_of_pictures_agree_with_differences(rows: int) -> None:
    rng = np.random.default_rng(6)
    root = rng.standard_normal((N, rows, rows)) + 3.0 * np.eye(rows)
    model = _fixed(rng.standard_normal((N, rows)), root)
    factor = ThroughGimbalFactor(model, GIMBAL, GimbalErrors(NAMES, MOUNT), np.full(N, 0.3))
    for each in (factor, factor.at_noise(rng.uniform(0.5, 1.5, (N, rows)))):
        assert_jacobians(each, [np.full((N, 1), 0.7), *_errors(0.1)[3]])
    functions = GimbalMap(rng.standard_normal((N, 3)), rng.standard_normal((N, 3, 2)))
    factor = ThroughGimbalFactor(model, GIMBAL, functions, np.full(N, 0.3))
    assert_jacobians(factor, [np.full((N, 1), 0.7), 0.1 * rng.standard_normal((N, 6))])


def test_errors_may_be_blocks_of_the_wrapped_model() -> None:
    rng = np.random.default_rng(7)
    names = NAMES[:4]
    angles = np.tile(MOUNT[:4], (N, 1)) + 0.05
    tRm = so3.multiply(so3.exp(0.02 * rng.standard_normal((N, 3))), _level(GIMBAL).camera(_zeros()[0]))
    root = np.tile(3.0 * np.eye(2), (N, 1, 1))
    plain = LosDirectionFactor(TIME, np.zeros((N, 2)), root, GIMBAL, names)

    @dataclass(frozen=True)
    class WithSight(Model):
        """The same with a block that it does not use."""

        model: LosDirectionFactor
        stacked: ClassVar = ("model",)

        @property
        def time(self) -> Array:
            return self.model.time

        @property
        def rows(self) -> int:
            return 2

        @property
        def blocks(self) -> tuple[Block, ...]:
            return (*self.model.blocks, len(SIGHT_ERRORS))

        @property
        def sqrt_information(self) -> Array:
            return self.model.sqrt_information

        def __call__(self, tRm: Array, angles: Array, sight: Array) -> Residuals:
            residuals, jacobians = self.model(tRm, angles)
            return residuals, lambda: (*jacobians(), np.zeros((N, 2, sight.shape[1])))

    factor = ThroughGimbalFactor(
        WithSight(plain), GIMBAL, GimbalErrors(names, MOUNT[:4]), np.full(N, 0.1), error_blocks=(1, 2)
    )
    sight = np.tile(0.05 * rng.standard_normal(len(SIGHT_ERRORS)), (N, 1))
    assert factor.blocks == WithSight(plain).blocks
    assert_jacobians(factor, [tRm, angles, sight])
