"""Properties of the los factors: the model itself, Jacobians, batches, compression."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors import so3
from factors.los import GimbalPath, LocalMotion, LosDirectionFactor, LosRateFactor, rate_matrix, roll_rate
from factors.model import Array
from factors.testing import assert_jacobians
from tests.numerics import assert_rows_are_independent

N = 12
TIMES = np.linspace(0.5, 5.0, N)
CORE = ("delta_px", "delta_gx", "delta_gy", "delta_z")
ALL = (
    *("delta_px", "delta_gx", "delta_gy", "delta_pz", "delta_gz"),
    *("camera_roll", "collimation", "axis_nonperpendicularity"),
)


def _paths() -> tuple[GimbalPath, LocalMotion]:
    t = np.arange(0.0, 6.0, 0.005)
    rate = 0.8 * np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None] + np.array([0.0, 1.0, 2.0]))
    angles = np.stack([0.4 * np.sin(1.3 * t), 0.5 + 0.2 * np.cos(0.9 * t)], axis=1)
    gimbal = GimbalPath(t, angles)
    return gimbal, LocalMotion.around(TIMES, t, rate, gimbal)


GIMBAL, MOTION = _paths()


def _passive(axis: int, angle: float) -> Array:
    return so3.matrix(so3.exp(-angle * np.eye(3)[axis]))


def _blocks(names: tuple[str, ...], size: float, off: float, dt: float | None) -> list[Array]:
    """Attitudes that see the target within `off` rad of the line of sight at mounting angles of `size` rad."""
    rng = np.random.default_rng(2)
    angles = np.broadcast_to(size * rng.normal(size=len(names)), (N, len(names)))
    level = LosDirectionFactor(TIMES, np.zeros((N, 3)), np.tile(np.eye(3), (N, 1, 1)), GIMBAL.at(TIMES), names)
    tRm = so3.multiply(so3.exp(off * rng.normal(size=(N, 3))), level.camera(angles))
    if dt is None:
        return [tRm, angles]
    return [tRm, angles, rng.normal(scale=0.02, size=(N, 3)), np.full((N, 1), dt)]


def _factor(rows: np.ndarray, names: tuple[str, ...], width: int, offset: bool) -> LosDirectionFactor:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(N, width, width)) + 3 * np.eye(width)
    measured = 0.05 * rng.normal(size=(N, width))
    motion = MOTION[rows] if offset else None
    return LosDirectionFactor(TIMES[rows], measured[rows], root[rows], GIMBAL.at(TIMES)[rows], names, motion)


@pytest.mark.parametrize("names", [CORE, ALL], ids=["core", "all"])
@pytest.mark.parametrize("width", [2, 3], ids=["without roll", "with roll"])
@pytest.mark.parametrize("size", [0.5, 1e-6], ids=["large angles", "near zero"])
@pytest.mark.parametrize("off", [0.3, 1e-7], ids=["off axis", "on axis"])
@pytest.mark.parametrize("dt", [None, 0.0, 0.0123, -0.03])
def test_direction_jacobians(names: tuple[str, ...], width: int, size: float, off: float, dt: float | None) -> None:
    blocks = _blocks(names, size, off, dt)
    steps = [1e-5, 1e-5, *([] if dt is None else [1e-4, 1e-6])]
    model = _factor(np.arange(N), names, width, dt is not None)
    assert_jacobians(model, blocks, steps)


@pytest.mark.parametrize("dt", [None, 0.01])
def test_direction_rows_are_independent(dt: float | None) -> None:
    blocks = _blocks(ALL, 0.3, 0.2, dt)
    assert_rows_are_independent(lambda rows: _factor(rows, ALL, 3, dt is not None), blocks)


def test_prediction_is_the_published_chain() -> None:
    """d_l = Rx(eps + px) Rz(eta + pz) d_b, the gyro turned by Ry(gy) Rx(gx) Rz(gz), written out."""
    blocks = _blocks(ALL, 0.1, 0.05, None)
    px, gx, gy, pz, gz, roll, collimation, skew = blocks[1][0]
    model = _factor(np.arange(N), ALL, 3, False)
    for k, (azimuth, elevation) in enumerate(model.gimbal):
        mRb = _passive(1, gy) @ _passive(0, gx) @ _passive(2, gz)
        gimbal = _passive(0, elevation + px) @ _passive(1, skew) @ _passive(2, azimuth + pz)
        cRm = _passive(1, roll) @ _passive(2, collimation) @ gimbal @ mRb.T
        x, y, z = cRm @ so3.matrix(blocks[0][k]).T @ np.array([0.0, 1.0, 0.0])
        expected = [-np.arctan2(z, y), np.arctan2(x, y)]
        np.testing.assert_allclose(model.predict(blocks[0], blocks[1])[k, :2], expected, atol=1e-14)


def test_only_the_difference_of_pz_and_gz_counts() -> None:
    blocks = _blocks(ALL, 0.1, 0.05, None)
    model = _factor(np.arange(N), ALL, 3, False)
    turned = blocks[1] + 0.2 * np.array([name in ("delta_pz", "delta_gz") for name in ALL])
    np.testing.assert_allclose(model(blocks[0], turned)[0], model(*blocks)[0], atol=1e-12)


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_roll_is_right_handed_and_the_turn_of_the_picture(off: float) -> None:
    """A small patch of the target, projected point by point: its best similarity turns by minus the camera's roll."""
    roll = 0.3
    model = LosDirectionFactor(np.zeros(1), np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 2)), ("camera_roll",))
    tRm = so3.exp(np.array([[off, 0.0, -off]]))
    predicted = model.predict(tRm, np.array([[roll]]))[0]
    cRt = _passive(1, roll) @ so3.matrix(tRm[0]).T
    patch = 1e-6 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    seen = (np.array([0.0, 1.0, 0.0]) + patch) @ cRt.T
    points = seen[:, [0, 2]] / seen[:, [1]]
    ahead = cRt[:, 1]
    shift = points - ahead[[0, 2]] / ahead[1]
    # Best rotation of (x, z) patch onto its picture; x towards z is left-handed about y.
    cosine = (patch[:, [0, 2]] * shift).sum()
    sine = (patch[:, 0] * shift[:, 1] - patch[:, 2] * shift[:, 0]).sum()
    assert predicted[2] == pytest.approx(np.arctan2(sine, cosine), abs=1e-8)
    assert predicted[2] == pytest.approx(roll, abs=1e-12 if off == 0.0 else 2e-3)


def _cubics(seed: int) -> tuple[Array, list[np.poly1d]]:
    rng = np.random.default_rng(seed)
    return np.sort(rng.uniform(0, 2, 80)), [np.poly1d(rng.normal(size=4)) for _ in range(2)]


def test_gimbal_path_is_exact_for_cubics() -> None:
    t, angles = _cubics(4)
    path = GimbalPath(t, np.stack([p(t) for p in angles], axis=1))
    at = np.concatenate([t, np.random.default_rng(8).uniform(t[0], t[-1], 50)])
    np.testing.assert_allclose(path.at(at), np.stack([p(at) for p in angles], axis=1), atol=1e-9)


def test_local_motion_is_exact_for_cubics() -> None:
    t, angles = _cubics(4)
    path = GimbalPath(t, np.stack([p(t) for p in angles], axis=1))
    rate = np.poly1d([0.3, -0.2, 0.1])
    at = np.random.default_rng(9).uniform(t[0], t[-1], 50)
    motion = LocalMotion.around(at, t, np.stack([rate(t)] * 3, axis=1), path)
    np.testing.assert_allclose(motion.rate, np.stack([rate(at)] * 3, axis=1), atol=1e-7)
    np.testing.assert_allclose(motion.acceleration, np.stack([rate.deriv()(at)] * 3, axis=1), atol=1e-6)
    np.testing.assert_allclose(motion.gimbal_rate, np.stack([p.deriv()(at) for p in angles], axis=1), atol=1e-6)
    second = np.stack([p.deriv(2)(at) for p in angles], axis=1)
    np.testing.assert_allclose(motion.gimbal_acceleration, second, atol=1e-4)


def _los_rate(X: Array, gimbal: Array, w_b: Array) -> tuple[Array, float]:
    """The publication's eq. (2), pz = dz and gz = 0: inertial rates of the LOS frame about x and z, and about y."""
    px, gx, gy, dz = X
    azimuth, elevation = gimbal
    w_m = _passive(1, gy) @ _passive(0, gx) @ w_b
    s, c = np.sin(azimuth), np.cos(azimuth)
    command_x = -c * w_m[0] - s * w_m[1]
    command_z = np.tan(elevation) * (c * w_m[1] - s * w_m[0]) - w_m[2]
    outer = _passive(2, azimuth + dz) @ w_b + np.array([0.0, 0.0, command_z])
    w_l = _passive(0, elevation + px) @ outer + np.array([command_x, 0.0, 0.0])
    return np.array([w_l[0], w_l[2]]), float(w_l[1])


def test_exact_rate_matrix_is_the_derivative_of_the_kinematics() -> None:
    rng = np.random.default_rng(5)
    gimbal, rate = rng.uniform(-1, 1, size=(N, 2)), rng.normal(size=(N, 3))
    exact, published = rate_matrix(gimbal, rate), rate_matrix(gimbal, rate, exact=False)
    for k in range(N):
        steps = 1e-6 * np.eye(4)
        numeric = [(_los_rate(d, gimbal[k], rate[k])[0] - _los_rate(-d, gimbal[k], rate[k])[0]) / 2e-6 for d in steps]
        np.testing.assert_allclose(exact[k], np.array(numeric).T, atol=1e-8)
        assert roll_rate(gimbal, rate)[k] == pytest.approx(_los_rate(np.zeros(4), gimbal[k], rate[k])[1], abs=1e-12)
    np.testing.assert_array_equal(exact[:, :, 1:], published[:, :, 1:])
    # What the publication leaves out of H2,1: Rx(eps + px) turns the azimuth rate too.
    s, c = np.sin(gimbal[:, 0]), np.cos(gimbal[:, 0])
    azimuth_rate = np.tan(gimbal[:, 1]) * (c * rate[:, 1] - s * rate[:, 0]) - rate[:, 2]
    np.testing.assert_allclose(exact[:, 1, 0] - published[:, 1, 0], -np.sin(gimbal[:, 1]) * azimuth_rate, atol=1e-12)


def _rate_factor(rows: np.ndarray) -> LosRateFactor:
    rng = np.random.default_rng(6)
    H = rate_matrix(rng.uniform(-1, 1, size=(N, 2)), rng.normal(size=(N, 3)))
    return LosRateFactor(TIMES[rows], rng.normal(size=(N, 2))[rows], H[rows], np.linspace(0.5, 2.0, N)[rows])


def test_rate_jacobians_and_rows() -> None:
    blocks = [np.broadcast_to(np.random.default_rng(7).normal(size=4), (N, 4))]
    assert_jacobians(_rate_factor(np.arange(N)), blocks)
    assert_rows_are_independent(_rate_factor, blocks)


def test_compressed_rate_factor_solves_least_squares() -> None:
    model = _rate_factor(np.arange(N))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(model.on(0, compress=True).factor)
    values = gtsam.Values()
    values.insert(0, np.array([0.1, -0.2, 0.3, 0.0]))
    solution = gtsam.GaussNewtonOptimizer(graph, values).optimize()
    A = (model.H / model.sigma[:, None, None]).reshape(-1, 4)
    b = (model.measured / model.sigma[:, None]).ravel()
    np.testing.assert_allclose(solution.atVector(0), np.linalg.lstsq(A, b)[0], atol=1e-12)
    np.testing.assert_allclose(gtsam.Marginals(graph, solution).marginalCovariance(0), np.linalg.inv(A.T @ A))
