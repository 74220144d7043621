"""Properties of the los factors: the model itself, Jacobians, batches, compression."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.gimbal import GimbalPath, LocalMotion, command
from alidade.factors.los import SIGHT_ERRORS, LosContext, LosDirectionFactor
from alidade.factors.testing import assert_jacobians
from tests.support.los_rates import LosRateFactor, rate_matrix, roll_rate
from tests.support.numerics import assert_rows_are_independent

N = 12
TIMES = np.linspace(0.5, 5.0, N)
CORE = ("delta_px", "delta_gx", "delta_gy", "delta_z")
ALL = (
    *("delta_px", "delta_gx", "delta_gy", "delta_pz", "delta_gz"),
    *("camera_roll", "collimation", "axis_nonperpendicularity"),
)


def _rates(t: Array) -> Array:
    return np.asarray(0.8 * np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None] + np.array([0.0, 1.0, 2.0])))


def _gimbal(t: Array) -> Array:
    return np.stack([0.4 * np.sin(1.3 * t), 0.5 + 0.2 * np.cos(0.9 * t)], axis=1)


STAMPS = np.arange(0.0, 6.0, 0.005)
FORCE = np.array([0.5, -1.0, 9.7])
STAMP_SHIFT = 0.003 * np.random.default_rng(5).normal(size=N)
GIMBAL = GimbalPath(STAMPS, _gimbal(STAMPS))
WARMTH = (2.0 * STAMPS)[:, None]
# What moves the gyro's readings, by how many numbers its errors are.
_FORCES = np.tile(FORCE, (len(STAMPS), 1))
DRIVERS = {0: None, 6: None, 9: WARMTH, 15: _FORCES, 18: np.column_stack([_FORCES, WARMTH])}
MOTIONS = {n: LocalMotion.around(TIMES, STAMPS, _rates(STAMPS), GIMBAL, each) for n, each in DRIVERS.items()}
MOTION = MOTIONS[15]


def _passive(axis: int, angle: float) -> Array:
    return so3.matrix(so3.exp(-angle * np.eye(3)[axis]))


def _blocks(
    names: tuple[str, ...], size: float, off: float, sight: float | None = None, gyro_errors: int = 0
) -> list[Array]:
    """Attitudes that see the target within `off` rad of the line of sight at mounting angles of `size` rad."""
    rng = np.random.default_rng(2)
    angles = np.broadcast_to(size * rng.normal(size=len(names)), (N, len(names)))
    level = LosDirectionFactor(TIMES, np.zeros((N, 3)), np.tile(np.eye(3), (N, 1, 1)), GIMBAL.at(TIMES), names)
    tRm = so3.multiply(so3.exp(off * rng.normal(size=(N, 3))), level.camera(angles))
    if sight is None:
        return [tRm, angles]
    shared = np.broadcast_to(sight * rng.normal(size=len(SIGHT_ERRORS)), (N, len(SIGHT_ERRORS)))
    errors = np.broadcast_to(0.01 * rng.normal(size=gyro_errors), (N, gyro_errors))
    return [tRm, angles, rng.normal(scale=0.02, size=(N, 3)), shared, *([errors] if gyro_errors else [])]


def _factor(
    rows: np.ndarray, names: tuple[str, ...], width: int, sight: bool = False, gyro_errors: int = 0
) -> LosDirectionFactor:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(N, width, width)) + 3 * np.eye(width)
    measured = 0.05 * rng.normal(size=(N, width))
    context = LosContext(MOTIONS[gyro_errors], TIMES, TIMES - 0.2, STAMP_SHIFT)[rows] if sight else None
    return LosDirectionFactor(
        TIMES[rows], measured[rows], root[rows], GIMBAL.at(TIMES)[rows], names, context, gyro_errors
    )


# Of two sets of names, widths, sizes and places each pair with each pair: half of all there are.
@pytest.mark.parametrize(
    ("names", "width", "size", "off"),
    [
        pytest.param(
            *((CORE, ALL)[i], (2, 3)[j], (0.5, 1e-6)[k], (0.3, 1e-7)[(i + j + k) % 2]),
            marks=[pytest.mark.slow] * (j != k),
        )
        for i, j, k in product(range(2), repeat=3)
    ],
)
@pytest.mark.parametrize(("sight", "gyro"), [(None, 0), (0.0, 15), (0.01, 0), (0.01, 6), (0.01, 9), (-0.02, 18)])
def test_direction_jacobians(
    names: tuple[str, ...], width: int, size: float, off: float, sight: float | None, gyro: int
) -> None:
    blocks = _blocks(names, size, off, sight, gyro)
    steps = [1e-5, 1e-5, *([] if sight is None else [1e-4, 1e-6, *([1e-4] if gyro else [])])]
    model = _factor(np.arange(N), names, width, sight is not None, gyro)
    assert_jacobians(model, blocks, steps)


@pytest.mark.parametrize("sight", [None, 0.01])
def test_direction_rows_are_independent(sight: float | None) -> None:
    gyro = 0 if sight is None else 15
    blocks = _blocks(ALL, 0.3, 0.2, sight, gyro)
    assert_rows_are_independent(lambda rows: _factor(rows, ALL, 3, sight is not None, gyro), blocks)


@pytest.mark.parametrize("name", SIGHT_ERRORS)
def test_an_error_does_what_its_definition_says(name: str) -> None:
    """Each alone, written out: the picture of a target seen through an axis, a clock or a lens with that error."""
    size = {"target_rate_x": 0.02, "target_rate_z": 0.02, "clock_skew": 2e-3}.get(name, 5e-3)
    tRm, angles, bias, _, errors = _blocks(CORE, 0.1, 0.05, 0.0, 15)
    sight = np.zeros((N, len(SIGHT_ERRORS)))
    sight[:, SIGHT_ERRORS.index(name)] = size
    model = _factor(np.arange(N), CORE, 3, True, 15)
    root_inverse = np.linalg.inv(model.sqrt_information)
    picture = model.measured - np.einsum("nij,nj->ni", root_inverse, model(tRm, angles, bias, sight, errors)[0])

    late = {"time_offset": size + 0.0 * TIMES, "clock_skew": -size * TIMES}.get(name, 0.0 * TIMES) - STAMP_SHIFT
    gimbal = _gimbal(TIMES + late - (size if name == "encoder_delay" else 0.0))
    read = _gimbal(TIMES + late)
    for i, joint in enumerate(("azimuth", "elevation")):
        for part, function in (("sin", np.sin), ("cos", np.cos)):
            if name == f"{joint} {part}":
                # What is read is angle + size f(angle): here the angle that is read as `read`.
                for _ in range(50):
                    gimbal[:, i] = read[:, i] - size * function(gimbal[:, i])
    x, y, z, xy, xz, yz = errors[0, :6]
    gain = np.eye(3) + [[x, xy, xz], [xy, y, yz], [xz, yz, z]]
    G = errors[0, 6:].reshape(3, 3)
    middle = _rates(TIMES + 0.5 * late)
    true = (middle - bias - G @ FORCE) @ np.linalg.inv(gain).T
    target = np.zeros((N, 3))
    for i, axis in enumerate("xz"):
        if name == f"target_rate_{axis}":
            target[:, 2 * i] = size * (TIMES - 0.2)
    seen = so3.compose(so3.exp(-target), tRm, so3.exp(true * late[:, None]))
    level = LosDirectionFactor(TIMES, model.measured, model.sqrt_information, gimbal, CORE)
    expected = level.predict(seen, angles)
    if name == "los_scale":
        expected[:, :2] *= 1.0 + size
    np.testing.assert_allclose(picture, expected, atol=3e-6)


def test_prediction_is_the_published_chain() -> None:
    """d_l = Rx(eps + px) Rz(eta + pz) d_b, the gyro turned by Ry(gy) Rx(gx) Rz(gz), written out."""
    blocks = _blocks(ALL, 0.1, 0.05)
    px, gx, gy, pz, gz, roll, collimation, skew = blocks[1][0]
    model = _factor(np.arange(N), ALL, 3)
    for k, (azimuth, elevation) in enumerate(model.gimbal):
        mRb = _passive(1, gy) @ _passive(0, gx) @ _passive(2, gz)
        gimbal = _passive(0, elevation + px) @ _passive(1, skew) @ _passive(2, azimuth + pz)
        cRm = _passive(1, roll) @ _passive(2, collimation) @ gimbal @ mRb.T
        x, y, z = cRm @ so3.matrix(blocks[0][k]).T @ np.array([0.0, 1.0, 0.0])
        expected = [-np.arctan2(z, y), np.arctan2(x, y)]
        np.testing.assert_allclose(model.predict(blocks[0], blocks[1])[k, :2], expected, atol=1e-14)


def test_only_the_difference_of_pz_and_gz_counts() -> None:
    blocks = _blocks(ALL, 0.1, 0.05)
    model = _factor(np.arange(N), ALL, 3)
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


def _driven(hz: float, delay: float, noise: float = 0.0) -> tuple[Array, GimbalPath, GimbalPath]:
    """Gyro samples at STAMPS, swings at `hz`; the gimbal that they drive; its encoders, read `delay` s late."""
    w, fine = 2.0 * np.pi * hz, np.arange(-0.1, 6.1, 0.001)
    samples = 0.3 * np.cos(w * STAMPS[:, None] + np.array([0.0, 1.0, 2.0]))
    samples += noise * np.random.default_rng(11).normal(size=samples.shape)
    rate = np.stack([CubicSpline(STAMPS, column)(fine) for column in samples.T], axis=1)
    angles = np.tile([0.3, 0.2], (len(fine), 1))
    for k, middle in enumerate(0.5 * (rate[1:] + rate[:-1])):
        half = angles[k] + 0.0005 * command(middle[None], angles[k : k + 1])[0]
        angles[k + 1] = angles[k] + 0.001 * command(middle[None], half[None])[0]
    gimbal = GimbalPath(fine, angles)
    return samples, gimbal, GimbalPath(STAMPS, gimbal.at(STAMPS + delay))


@pytest.mark.parametrize("hz", [0.2, 2.0, 5.0])
@pytest.mark.parametrize("delay", [0.0, 2e-3])
def test_motion_around_a_stamp_follows_swings_whatever_the_delay_of_the_encoders(hz: float, delay: float) -> None:
    samples, gimbal, encoders = _driven(hz, delay)
    late = np.where(np.arange(N) % 2 == 0, -0.015, 0.015)
    sight = np.zeros((N, len(SIGHT_ERRORS)))
    sight[:, 0], sight[:, -1] = late, delay
    motion = LocalMotion.around(TIMES, STAMPS, samples, encoders)
    model = LosDirectionFactor(
        TIMES,
        np.zeros((N, 2)),
        np.tile(np.eye(2), (N, 1, 1)),
        motion.read,
        CORE,
        LosContext(motion, TIMES, TIMES, np.zeros(N)),
    )
    tRm, angles, bias, _ = _blocks(CORE, 0.02, 0.01, 0.0)
    predicted = -model(tRm, angles, 0.0 * bias, sight)[0]
    w, phase = 2.0 * np.pi * hz, np.array([0.0, 1.0, 2.0])
    turned = 0.3 / w * (np.sin(w * (TIMES + late)[:, None] + phase) - np.sin(w * TIMES[:, None] + phase))
    exposed = LosDirectionFactor(TIMES, model.measured, model.sqrt_information, gimbal.at(TIMES + late), CORE)
    expected = exposed.predict(so3.multiply(tRm, so3.exp(turned)), angles)[:, :2]
    np.testing.assert_allclose(predicted, expected, atol=3e-3 * 0.3 * 0.015)


def test_a_gimbal_between_samples_moves_by_its_commands() -> None:
    """At 20 samples/s a cubic is off by a hundred times as much."""
    samples, gimbal, _ = _driven(2.0, 0.0)
    sparse = GimbalPath(STAMPS[::10], gimbal.at(STAMPS[::10]))
    motion = LocalMotion.around(TIMES, STAMPS, samples, sparse)
    off, off_by_cubic = (np.abs(each - gimbal.at(TIMES)).max() for each in (motion.read, sparse.at(TIMES)))
    assert off < 1e-5
    assert off < 0.01 * off_by_cubic


def test_motion_is_smoothed_no_less_than_it_allows() -> None:
    """Noise in the readings becomes the smaller rates, the longer they are fitted."""
    noise, spread = 2e-5 * np.random.default_rng(3).normal(size=(len(STAMPS), 2)), {}
    for hz in (0.2, 5.0):
        samples, _, encoders = _driven(hz, 2e-3)
        noisy = GimbalPath(STAMPS, encoders.angles + noise)
        without, with_noise = (
            LocalMotion.around(STAMPS[100:-100], STAMPS, samples, each) for each in (encoders, noisy)
        )
        spread[hz] = np.std(with_noise.rest[:, 0] - without.rest[:, 0])
    assert 3.0 * spread[0.2] < spread[5.0]


def test_noise_that_a_gimbal_follows_is_no_motion_of_the_line_of_sight() -> None:
    (samples, gimbal, encoders), (clean, _, _) = _driven(0.2, 1e-3, noise=0.01), _driven(0.2, 1e-3)
    motion = LocalMotion.around(TIMES, STAMPS, samples, encoders)
    zero = np.zeros((N, 1))
    rate, (_, moving, _) = motion.turning(zero), motion.moved(encoders.at(TIMES), zero, zero + 1e-3)
    assert np.std(rate - LocalMotion.around(TIMES, STAMPS, clean, encoders).turning(zero)) > 5e-4
    assert np.abs(moving - command(rate, gimbal.at(TIMES))).max() < 1e-4


def test_drivers_around_a_stamp_are_those_of_its_time() -> None:
    assert MOTION.drivers is not None
    np.testing.assert_allclose(MOTION.drivers, np.tile(FORCE, (N, 1)))


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


@pytest.mark.parametrize("following", [0.0, 0.6, 1.0])
def test_share_of_its_commands_that_a_gimbal_follows(following: float) -> None:
    """With noise in all, a slew to another target halfway, and encoders that begin before the gyro and end after it."""
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 30.0, 0.01)
    gyro = 0.1 * np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None]) + 3e-4 * rng.standard_normal((len(t), 3))
    angles = np.full((len(t), 2), 0.3)
    for i in range(1, len(t)):
        angles[i] = angles[i - 1] + 0.01 * following * command(
            0.5 * (gyro[i - 1 : i] + gyro[i : i + 1]), angles[i - 1 : i]
        )
    slewed = angles + 0.3 * np.clip(t - 15.0, 0.0, 1.0)[:, None] + 5e-6 * rng.standard_normal(angles.shape)
    motion = LocalMotion.around(TIMES + 5.0, t[300:-300], gyro[300:-300], GimbalPath(t, slewed))
    assert motion.following == pytest.approx(following, abs=0.02)
