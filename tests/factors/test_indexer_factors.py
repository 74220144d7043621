"""Properties of the indexer's factor: the mean over a window against brute force, Jacobians, batches."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import earth_rate
from alidade.factors.indexer import (
    AxisPath,
    IndexerAverageFactor,
    Option,
    PlatformRates,
    base_from_platform,
    gyro_edges,
    gyro_means,
)
from alidade.factors.testing import assert_jacobians
from tests.support.numerics import assert_rows_are_independent

RNG = np.random.default_rng(3)
N = 9
BASE_RATE = so3.rotate(so3.exp([0.3, -0.2, 0.9]), earth_rate(0.7))
OPTIONS: tuple[Option, ...] = ("errors", "temperature", "encoder", "epsilon", "tilt")
TEMPERATURE = np.linspace(0.0, 8.0, N)


def _angles(t: Array) -> tuple[Array, Array]:
    """Both axes moving at once, with ripple."""
    return 0.4 * t + 0.2 * np.sin(0.9 * t), 1.0 - 0.3 * t + 0.3 * np.cos(0.5 * t)


def _brute_force(start: float, stop: float, epsilon: float) -> Array:
    """Mean inertial rate of t over the window from rotation increments of the platform against inertial space."""
    t = np.linspace(start, stop, 20001)
    iRbase = so3.exp(t[:, None] * BASE_RATE)
    iRt = so3.multiply(iRbase, base_from_platform(*_angles(t), epsilon))
    return so3.log(so3.multiply(so3.inverse(iRt[:-1]), iRt[1:])).sum(axis=0) / (stop - start)


def _rates(n: int = N, spread: float = 0.3) -> PlatformRates:
    edges = np.linspace(1.0, 20.0, n + 1)
    parts = RNG.normal(scale=spread, size=(3, n, 3))
    by_encoder = RNG.normal(size=(n, 3, 3, 5))
    return PlatformRates(edges, parts[0], parts[1], parts[2], by_encoder, np.zeros((3 * n, 3 * n + 2)))


def _model(gyro: Array, rates: PlatformRates) -> IndexerAverageFactor:
    return IndexerAverageFactor(gyro, rates, RNG.normal(size=(3 * N, 3 * N)), OPTIONS, temperature=TEMPERATURE)


@pytest.mark.parametrize("epsilon", [0.0, 2e-3, -0.4])
def test_mean_rate_equals_brute_force_for_any_motion_and_epsilon(epsilon: float) -> None:
    t = np.linspace(0.0, 30.0, 30001)
    edges = np.array([0.0, 3.21, 11.7704, 29.9999])
    outer, inner = _angles(t)
    rates = AxisPath(t, outer, inner, BASE_RATE).rates(edges)
    mean = rates.fixed + np.cos(epsilon) * rates.cosine + np.sin(epsilon) * rates.sine
    expected = [_brute_force(a, b, epsilon) for a, b in pairwise(edges)]
    np.testing.assert_allclose(mean, expected, atol=3e-9)


@pytest.mark.parametrize("rate_hz", [0.5, 7.0, 1000.0])
def test_whole_turns_are_exact_at_any_encoder_rate(rate_hz: float) -> None:
    """About one axis only the ends count, and the earth's rate across the axis averages out."""
    speed, turns = np.deg2rad(10.0), 3
    t = np.arange(0.0, 120.0, 1.0 / rate_hz)
    rates = AxisPath(t, speed * t, np.full_like(t, 0.2), BASE_RATE).rates([1.3, 1.3 + turns * 36.0])
    expected = (speed + BASE_RATE[0]) * np.array([[np.cos(0.2), -np.sin(0.2), 0.0]])
    np.testing.assert_allclose((rates.fixed + rates.cosine), expected, atol=2e-11 + 4e-9 * (rate_hz < 1.0))


def test_covariance_of_the_mean_matches_monte_carlo() -> None:
    t = np.arange(0.0, 12.0, 0.05)
    sigma = 1e-4
    outer, inner = 0.5 * t, np.full_like(t, 0.6)
    edges = np.array([1.013, 6.2, 10.72])
    means = []
    for _ in range(1500):
        noisy = [a + sigma * RNG.standard_normal(len(t)) for a in (outer, inner)]
        rates = AxisPath(t, noisy[0], noisy[1], np.zeros(3)).rates(edges)
        means.append((rates.fixed + rates.cosine).ravel())
    noise = AxisPath(t, outer, inner, np.zeros(3)).rates(edges).noise
    expected = noise @ noise.T * sigma**2
    found = np.cov(np.array(means).T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.12)


def test_windows_outside_the_stamps_are_refused() -> None:
    path = AxisPath([0.0, 1.0], [0.0, 1.0], [0.0, 0.0], BASE_RATE)
    for edges in [(-0.1, 0.5), (0.5, 1.1), (0.5, 0.5)]:
        with pytest.raises(ValueError, match="within"):
            path.rates(edges)


def test_angles_make_the_mounting_of_the_publication_and_come_back() -> None:
    theta = RNG.uniform(-1.2, 1.2, size=(50, 3))
    passive = [so3.matrix(so3.inverse(so3.exp(theta[:, i : i + 1] * e))) for i, e in enumerate(np.eye(3))]
    np.testing.assert_allclose(
        so3.matrix(so3.inverse(so3.from_angles(theta))), passive[0] @ passive[1] @ passive[2], atol=1e-12
    )
    np.testing.assert_allclose(so3.angles(so3.from_angles(theta)), theta, atol=1e-12)


def test_gyro_mean_is_the_integral_between_sample_edges() -> None:
    t = np.array([0.0, 1.0, 2.0, 4.0, 5.0])
    np.testing.assert_allclose(gyro_edges(t), [-0.5, 0.5, 1.5, 3.0, 4.5, 5.5])
    rate = np.arange(15.0).reshape(5, 3)
    mean = gyro_means(gyro_edges(t), rate, np.array([1, 4, 5]))
    np.testing.assert_allclose(mean, [(rate[1] + 1.5 * rate[2] + 1.5 * rate[3]) / 4.0, rate[4]])


def _blocks(size: float) -> list[Array]:
    shapes = [(3, 1.0), (3, 0.05), (6, 0.05), (3, 0.01), (5, 0.1), (1, 0.3), (3, 0.5)]
    return [np.tile(RNG.normal(scale=size * spread, size=width), (N, 1)) for width, spread in shapes]


@pytest.mark.parametrize("size", [1.0, 1e-9], ids=["random", "near zero"])
def test_jacobians(size: float) -> None:
    assert_jacobians(_model(RNG.normal(size=(N, 3)), _rates()), _blocks(size))


@pytest.mark.parametrize("options", [(), ("errors",), ("temperature",), ("tilt", "encoder", "epsilon")])
def test_jacobians_with_some_options(options: tuple[Option, ...]) -> None:
    model = replace(_model(RNG.normal(size=(N, 3)), _rates()), options=options)
    blocks = dict(zip(("theta", "bias", *OPTIONS), _blocks(0.3), strict=True))
    assert_jacobians(model, [blocks[name] for name in ("theta", "bias", *options)])


def test_theta_may_count_another_unit() -> None:
    model = replace(_model(RNG.normal(size=(N, 3)), _rates()), theta_unit=1e-3)
    blocks = _blocks(0.3)
    in_units = [blocks[0] / 1e-3, *blocks[1:]]
    np.testing.assert_allclose(model(*in_units)[0], replace(model, theta_unit=1.0)(*blocks)[0], atol=1e-12)
    assert_jacobians(model, in_units, [1e-2, *[1e-5] * 6])


def test_jacobians_near_the_singular_angle() -> None:
    model = _model(RNG.normal(size=(N, 3)), _rates())
    blocks = _blocks(0.1)
    blocks[0] = np.tile([0.3, np.pi / 2 - 1e-4, -0.2], (N, 1))
    assert_jacobians(model, blocks)


def test_windows_without_encoder_noise_are_independent() -> None:
    gyro, rates, blocks = RNG.normal(size=(N, 3)), _rates(), _blocks(1.0)

    def model(rows: np.ndarray) -> IndexerAverageFactor:
        edges = np.append(rates.edges[rows], rates.edges[rows[-1] + 1])
        some = PlatformRates(
            edges,
            rates.fixed[rows],
            rates.cosine[rows],
            rates.sine[rows],
            rates.by_encoder[rows],
            np.zeros((3 * len(rows), 3 * len(rows) + 2)),
        )
        return IndexerAverageFactor.of(gyro[rows], some, 1e-3, 0.0, OPTIONS, temperature=TEMPERATURE[rows])

    assert_rows_are_independent(model, blocks)


def test_encoder_noise_at_a_common_edge_cancels_in_the_sum() -> None:
    """The mean over two adjoining windows is as noisy as that over one window as long as both.

    But for the inner encoder's mean over the windows, which hold a whole number of samples each.
    """
    t = np.arange(0.0, 12.0, 0.05)
    path = AxisPath(t, 0.5 * t, np.full_like(t, 0.3), np.zeros(3))
    split = IndexerAverageFactor.of(np.zeros((2, 3)), path.rates([1.0, 4.02, 9.0]), 1e-4, 3e-4)
    whole = IndexerAverageFactor.of(np.zeros((1, 3)), path.rates([1.0, 9.0]), 1e-4, 3e-4)
    covariances = [np.linalg.inv(f.sqrt_information.T @ f.sqrt_information) for f in (split, whole)]
    mean = np.hstack([np.eye(3) * 3.02 / 8.0, np.eye(3) * 4.98 / 8.0])
    np.testing.assert_allclose(mean @ covariances[0] @ mean.T, covariances[1], atol=1e-5 * covariances[1].max())


def test_residual_vanishes_at_the_truth() -> None:
    theta, bias, errors, slope, encoder, epsilon, tilt = _blocks(0.3)
    rates = _rates()
    fixed, cosine, sine = np.moveaxis(rates.parts(encoder), 1, 0)
    w = so3.rotate(so3.exp(tilt), fixed + np.cos(epsilon) * cosine + np.sin(epsilon) * sine)
    xx, yy, zz, xy, xz, yz = errors[0]
    gain = np.eye(3) + np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    gyro = so3.rotate(so3.inverse(so3.from_angles(theta)), w) @ gain + bias + TEMPERATURE[:, None] * slope
    model = IndexerAverageFactor.of(gyro, rates, 1.0, 0.0, OPTIONS, temperature=TEMPERATURE)
    np.testing.assert_allclose(model(theta, bias, errors, slope, encoder, epsilon, tilt)[0], 0.0, atol=1e-13)
    assert np.abs(model(theta + 1e-3, bias, errors, slope, encoder, epsilon, tilt)[0]).max() > 1e-5


@pytest.mark.parametrize("size", [1e-6, 1e-3])
def test_mean_rates_with_encoder_errors_are_those_of_the_true_angles(size: float) -> None:
    """To first order in the errors, for any motion."""
    t = np.linspace(0.0, 30.0, 3001)
    edges = np.array([0.503, 3.21, 11.7704, 29.0])
    errors = size * np.array([1.0, -0.7, 0.8, 0.5, 1.3])

    def read(at: Array) -> list[Array]:
        true = _angles(at + errors[4])
        sines = zip(true, errors[:4].reshape(2, 2), strict=True)
        return [angle + s * np.sin(angle) + c * np.cos(angle) for angle, (s, c) in sines]

    (outer, inner), (outer_read, inner_read) = _angles(t), read(t)
    expected = AxisPath(t, outer, inner, BASE_RATE).rates(edges).parts(np.zeros(5))
    found = AxisPath(t, outer_read, inner_read, BASE_RATE).rates(edges)
    assert np.abs(found.parts(np.zeros(5)) - expected).max() > 0.05 * size
    np.testing.assert_allclose(found.parts(errors), expected, atol=2.0 * size**2 + 1e-4 * size)
