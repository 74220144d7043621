"""Gyro integration against fine stepping, closed forms and gtsam's own preintegration."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from alidade.factors import preintegration, so3
from alidade.factors.preintegration import GyroPath


def _stream(n: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps so uneven that the rates count as points, which the references below can follow exactly."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.004, 0.006, size=n) * np.where(np.arange(n) % 2, 1.0, 2.0))
    rate = np.stack([np.sin(1.3 * t), 0.8 * np.cos(2.1 * t), 0.5 + 0.4 * np.sin(0.7 * t)], axis=1)
    return t, rate


def _fine(t: np.ndarray, rate: np.ndarray, start: float, stop: float, bias: np.ndarray) -> np.ndarray:
    """The rotation by 20,000 constant-rate steps on the linearly interpolated rate, for uneven stamps."""
    edges = np.linspace(start, stop, 20_001)
    middle = 0.5 * (edges[1:] + edges[:-1])
    w = np.stack([np.interp(middle, t, rate[:, k]) for k in range(3)], axis=1) - bias
    q = so3.identity()
    for turn in so3.exp(w * np.diff(edges)[:, None]):
        q = so3.multiply(q, turn)
    return q


@pytest.mark.parametrize(("start", "stop"), [(0.1, 0.9), (0.5, 0.503), (0.31, 2.9)])
def test_equals_fine_stepping(start: float, stop: float) -> None:
    t, rate = _stream()
    bias = np.array([0.01, -0.02, 0.005])
    step = GyroPath(t, rate, bias).increments([start], [stop])
    difference = so3.log(so3.multiply(so3.inverse(step.wxyz[0]), _fine(t, rate, start, stop, bias)))
    assert np.abs(difference).max() < 5e-9  # the stepping itself: its steps straddle the stamps


def test_interval_means_are_integrated_to_sixth_order() -> None:
    """Samples as the contract defines them, of a swinging rate; trapezoids on them alone would be 1e-5 rad off."""
    h = 0.005
    t = np.arange(0.0, 4.0, h)
    frequency, amplitude = np.array([3.0, 5.0, 7.0]), np.array([0.0, 0.0, 1.5])

    def angle(at: np.ndarray) -> np.ndarray:
        return amplitude * np.sin(np.outer(at, frequency)) / frequency

    mean = (angle(t + h / 2) - angle(t - h / 2)) / h
    start, stop = t[100:200], t[300:400]
    turned = so3.log(GyroPath(t, mean).increments(start, stop).wxyz)
    assert np.abs(turned - (angle(stop) - angle(start))).max() < 2e-11


@pytest.mark.parametrize("density", [1e-5, 1e-2])
def test_interpolation_variance_of_a_slow_gyro(density: float) -> None:
    """At 5 Hz of a hand that swings at up to 1 Hz, beside noise as stated and a pause."""
    rng, h = np.random.default_rng(3), 0.2
    t = np.delete(np.arange(0.0, 120.0, h), range(300, 305))
    frequency, amplitude, phase = rng.uniform(0.5, 6.0, 8), rng.uniform(0.2, 0.4, 8), rng.uniform(0.0, 6.0, 8)

    def angle(at: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(np.outer(at, frequency) + phase) @ (amplitude / frequency))

    rate = np.outer((angle(t + h / 2) - angle(t - h / 2)) / h, [0.0, 0.0, 1.0])
    noise = density * 0.2**-0.5 * rng.standard_normal(rate.shape)
    at = t[:-1] + 0.3 * h
    turns = GyroPath(t, rate + noise, density=density).increments(at[:-1], at[1:])
    without = GyroPath(t, rate + noise).increments(at[:-1], at[1:])
    assert np.count_nonzero(without.unseen) == 2
    error = (so3.log(turns.wxyz)[:, 2] - np.diff(angle(at)))[:298]
    # One axis turns, and the variance is that of each; sigmas are up to 1.5 times too wide where motion is smooth.
    expected = np.mean(3.0 * turns.unseen[:298] + density**2 * turns.duration[:298])
    assert 0.4 < np.mean(error**2) / expected < 1.5


def test_noise_alone_is_no_interpolation_error() -> None:
    rng, t, density = np.random.default_rng(0), np.arange(0.0, 100.0, 0.01), 1e-3
    path = GyroPath(t, density * 10.0 * rng.standard_normal((len(t), 3)), density=density)
    assert path.increments([0.0], [99.9]).unseen[0] < 0.01 * density**2 * 99.9


def test_constant_rate_is_exact_and_windows_compose() -> None:
    rate = np.array([0.3, -1.0, 2.0])
    path = GyroPath(np.linspace(0, 10, 1001), np.tile(rate, (1001, 1)))
    np.testing.assert_allclose(so3.log(path.increments([1.234], [2.0]).wxyz[0]), rate * 0.766, atol=1e-12)
    a, b, whole = (path.increments([x], [y]).wxyz[0] for x, y in [(0.5, 3.3), (3.3, 9.1), (0.5, 9.1)])
    np.testing.assert_allclose(so3.matrix(so3.multiply(a, b)), so3.matrix(whole), atol=1e-12)
    back = path.increments([3.3], [0.5]).wxyz[0]
    np.testing.assert_allclose(so3.matrix(so3.multiply(a, back)), np.eye(3), atol=1e-12)


def test_bias_jacobian_and_rate_against_differences() -> None:
    t, rate = _stream()
    start, stop = np.array([0.2, 1.0, 1.5, 2.0]), np.array([0.9, 1.002, 2.9, 1.95])
    path = GyroPath(t, rate)
    step = path.increments(start, stop)
    h = 1e-5
    for axis, d in enumerate(h * np.eye(3)):
        turned = [GyroPath(t, rate, s * d).increments(start, stop).wxyz for s in (1, -1)]
        numeric = so3.log(so3.multiply(so3.inverse(turned[1]), turned[0])) / (2 * h)
        np.testing.assert_allclose(step.bias_jacobian[..., axis], numeric, atol=2e-4 * np.abs(numeric).max())
    later, sooner = path.increments(start, stop + h).wxyz, path.increments(start, stop - h).wxyz
    np.testing.assert_allclose(step.rate, so3.log(so3.multiply(so3.inverse(sooner), later)) / (2 * h), atol=2e-4)


def test_agrees_with_gtsam_preintegration() -> None:
    t, rate = _stream()
    bias = np.array([0.01, -0.02, 0.005])
    native = gtsam.PreintegratedAhrsMeasurements(gtsam.PreintegratedRotationParams(), bias)
    middle = 0.5 * (rate[1:] + rate[:-1])
    for w, dt in zip(middle[:100], np.diff(t)[:100], strict=True):
        native.integrateMeasurement(w, dt)
    step = GyroPath(t, rate, bias).increments(t[:1], t[100:101])
    difference = so3.log(so3.multiply(so3.inverse(step.wxyz), so3.from_gtsam([native.deltaRij()])))
    assert np.abs(difference).max() < 1e-5  # gtsam leaves out the coning term


def test_long_streams_stay_unit_and_consistent() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(200_000) * 1e-3
    rate = rng.normal(scale=2.0, size=(200_000, 3))
    path = GyroPath(t, rate)
    edges = np.sort(rng.uniform(0, t[-1], size=500))
    pieces = path.increments(edges[:-1], edges[1:]).wxyz
    np.testing.assert_allclose(np.linalg.norm(pieces, axis=1), 1.0, atol=1e-14)
    product = so3.identity()
    for q in pieces:
        product = so3.multiply(product, q)
    whole = path.increments(edges[:1], edges[-1:]).wxyz[0]
    np.testing.assert_allclose(so3.log(so3.multiply(so3.inverse(whole), product)), 0.0, atol=1e-12)


def test_a_long_stream_is_integrated_block_by_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few of many blocks are kept, and windows reach over several of them, forwards and backwards."""
    t, rate = _stream(n=2_000)
    t[700:] += 0.3
    force = 9.8 + np.stack([np.cos(k * t) for k in (1.0, 2.0, 3.0)], axis=1)
    start = np.concatenate([np.linspace(t[0], t[-1], 101), [t[-1], 1.0]])
    stop = np.append(start[1:], 9.0)

    def found() -> tuple[np.ndarray, ...]:
        path = GyroPath(t, rate, [0.1, 0.2, -0.1], force)
        turns = path.increments(start, stop, scale=True)
        return *(getattr(turns, name) for name in turns.stacked), *(f(stop) for f in (path.attitude, path.rate))

    whole = found()
    monkeypatch.setattr(preintegration, "_BLOCK", 64)
    monkeypatch.setattr(preintegration, "_KEPT", 3)
    monkeypatch.setattr(preintegration, "_TOGETHER", 10)
    for one, other in zip(whole, found(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13 * max(np.abs(one).max(), 1.0))
    path = GyroPath(t, rate)
    path.attitude(stop)
    assert len(path._kept) == 3


def test_a_pass_over_a_long_stream_integrates_no_block_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows looked up together span two blocks, and are gone through several times."""
    monkeypatch.setattr(preintegration, "_BLOCK", 64)
    monkeypatch.setattr(preintegration, "_KEPT", 9)
    monkeypatch.setattr(preintegration, "_TOGETHER", 10)
    t, rate = _stream(n=2_000)
    path, made = GyroPath(t, rate), list[int]()
    block = preintegration._Block

    def counted(*parts: np.ndarray) -> object:
        made.append(len(parts))
        return block(*parts)

    monkeypatch.setattr(preintegration, "_Block", counted)
    ends = np.linspace(t[0], t[-1], 200)
    path.increments(ends[:-1], ends[1:], scale=True)
    assert 0 < len(made) < 2_000 / 64


def test_names_wrong_shapes() -> None:
    with pytest.raises(ValueError, match=r"stamps \(N,\) and rates \(N, 3\)"):
        GyroPath(np.arange(3.0), np.zeros((4, 3)))
