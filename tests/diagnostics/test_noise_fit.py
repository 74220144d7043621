"""Allan deviation against allantools, and coefficients against noise of known ones."""

from __future__ import annotations

from collections.abc import Callable

import allantools
import numpy as np
import pytest
from numpy.typing import NDArray

from alidade.pipelines.diagnostics.allan import NOISES, allan_curve, allan_variance, confidence
from alidade.pipelines.diagnostics.noise_spectrum import Coefficient, axis_noise, find_lines, fit_noise
from tests.support import noises

Array = NDArray[np.float64]
Make = Callable[[np.random.Generator, int, float], Array]
N, B, K, Q = 1e-3, 6e-4, 2e-4, 3e-5


def by_name(found: tuple[Coefficient, ...]) -> dict[str, Coefficient]:
    return {c.name: c for c in found}


@pytest.mark.parametrize("n", [9, 64, 1001, 4096, 5003])
def test_allan_deviation_is_that_of_allantools(n: int) -> None:
    x = np.cumsum(np.random.default_rng(n).normal(size=n)) + 7.0
    curve = allan_curve([x], 0.02)
    tau, deviation, _, terms = allantools.oadev(x, rate=50.0, data_type="freq", taus=curve.tau)
    assert curve.tau == pytest.approx(tau)
    assert curve.deviation == pytest.approx(deviation, rel=1e-9)
    assert curve.terms == pytest.approx(terms)


def test_pieces_are_pooled() -> None:
    rng = np.random.default_rng(1)
    pieces = [rng.normal(size=n) for n in (400, 57, 1000)]
    curve = allan_curve(pieces, 1.0)
    for i, tau in enumerate(curve.tau):
        parts = [allan_curve([p], 1.0) for p in pieces]
        some = [(p.deviation[i], p.terms[i]) for p in parts if i < len(p.tau)]
        if len(some) == 3:
            expected = sum(d**2 * n for d, n in some) / sum(n for _, n in some)
            assert curve.deviation[i] ** 2 == pytest.approx(expected), tau


@pytest.mark.parametrize(("noise", "alpha"), [("N", 0), ("B", -1), ("K", -2)])
def test_degrees_of_freedom_are_those_of_greenhall(noise: str, alpha: int) -> None:
    curve = allan_curve([np.random.default_rng(0).normal(size=4097)], 0.01)
    dof, low, high = confidence(curve, np.eye(4)[NOISES.index(noise)])
    # At the shortest averaging times allantools takes time as continuous.
    for tau, found in list(zip(curve.tau, dof, strict=True))[3:]:
        m = round(tau / 0.01)
        assert found == pytest.approx(allantools.edf_greenhall(alpha, 2, m, 4098, overlapping=True), rel=0.1)
    assert np.all(low < curve.deviation)
    assert np.all(curve.deviation < high)


@pytest.mark.parametrize(
    ("name", "make"),
    [("N", noises.white), ("K", noises.walk), ("B", noises.synthetic_flicker), ("Q", noises.quantised)],
)
def test_allan_variance_of_each_noise_and_its_interval(name: str, make: Callable[..., Array]) -> None:
    """95 % intervals of the Allan deviation hold the true one in 88 and more of 100 runs at every averaging time."""
    squares = np.eye(4)[NOISES.index(name)]
    inside: list[NDArray[np.bool_]] = []
    for seed in range(100):
        # A sample is a mean over its interval.
        x = make(np.random.default_rng(seed), 8000, 0.0125, 1.0).reshape(-1, 8).mean(axis=1)
        curve = allan_curve([x], 0.1)
        if not inside:
            _, low, high = confidence(curve, squares)
            below, above = low / curve.deviation, high / curve.deviation
            truth = np.sqrt(allan_variance(curve.tau, squares))
        inside.append((below * curve.deviation < truth) & (truth < above * curve.deviation))
    covered = np.mean(inside, axis=0)
    assert covered.min() >= 0.88
    # The longest averages of a quantised integral get wider intervals than they need.
    assert 0.92 < covered.mean() < (1.0 if name == "Q" else 0.98)


MIXES: dict[str, tuple[int, dict[str, float]]] = {
    "white": (1501, {"N": N}),
    "walk": (6000, {"N": N, "K": 2e-3}),
    "flicker": (20_000, {"N": N, "B": 1e-3}),
    "quantised": (6000, {"N": N, "Q": Q, "K": 2e-3}),
}


@pytest.mark.parametrize("mix", [pytest.param(m, marks=[pytest.mark.slow] * (m != "white")) for m in MIXES])
def test_intervals_hold_the_coefficients(mix: str) -> None:
    """95 % intervals cover in 88 to 99 of 100 runs, and noises that are not there are hardly ever found."""
    n, truth = MIXES[mix]
    makers = {"N": noises.white, "B": noises.synthetic_flicker, "K": noises.walk, "Q": noises.quantised}
    inside = dict.fromkeys(NOISES, 0)
    false = 0
    pulls: dict[str, list[float]] = {name: [] for name in truth}
    for seed in range(100):
        rng = np.random.default_rng(seed)
        x = sum(makers[name](rng, n, 0.01, size) for name, size in truth.items())
        for name, c in by_name(fit_noise([np.asarray(x)], 0.01).coefficients).items():
            inside[name] += c.low <= truth.get(name, 0.0) <= c.high
            if name in truth:
                assert c.value is not None, (seed, name)
                assert c.sigma is not None
                pulls[name].append((c.value - truth[name]) / c.sigma)
            else:
                false += c.value is not None
    # Each of up to three others shows by chance in one of a thousand.
    assert false <= 2
    for name in truth:
        assert 88 <= inside[name] <= 99, name
        assert 0.8 < np.std(pulls[name]) < 1.2, name
        assert abs(np.mean(pulls[name])) < 0.4, name


def test_all_at_once() -> None:
    rng = np.random.default_rng(3)
    n, interval = 400_000, 0.01
    x = noises.white(rng, n, interval, N) + noises.flicker(rng, n, interval, B) + noises.walk(rng, n, interval, K)
    x += noises.quantised(rng, n, interval, Q)
    fit = fit_noise([x], interval)
    for name, size in {"N": N, "B": B, "K": K, "Q": Q}.items():
        c = by_name(fit.coefficients)[name]
        assert c.value is not None, name
        assert c.sigma is not None
        assert abs(c.value - size) < 3.0 * c.sigma, name
    assert fit.misfit == 1.0
    assert not fit.filtered


def test_a_short_record_says_how_long_it_would_have_to_be() -> None:
    """10 min do not tell a walk that the length they ask for does."""
    rate, density, interval = 4e-6, 1e-4, 0.1
    rng = np.random.default_rng(5)
    short = noises.white(rng, 6000, interval, density) + noises.walk(rng, 6000, interval, rate)
    c = by_name(fit_noise([short], interval).coefficients)["K"]
    assert c.value is None
    assert c.high > rate
    assert c.needed_s is not None
    told = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        n = round(c.needed_s / interval)
        # The length is that for half the bound.
        longer = noises.white(rng, n, interval, density) + noises.walk(rng, n, interval, 0.5 * c.high)
        told += by_name(fit_noise([longer], interval).coefficients)["K"].value is not None
    assert 8 <= told <= 20


def test_pieces_tell_what_one_record_does() -> None:
    rng = np.random.default_rng(2)
    pieces = [noises.white(rng, n, 0.01, N) + noises.walk(rng, n, 0.01, 5e-3) + rng.normal() for n in (500, 4001, 1200)]
    found = by_name(fit_noise(pieces, 0.01).coefficients)
    assert found["N"].low < N < found["N"].high
    assert found["K"].low < 5e-3 < found["K"].high


def test_a_filter_in_the_sensor_does_not_spoil_the_density() -> None:
    rng = np.random.default_rng(4)
    x = noises.white(rng, 60_000, 0.01, N)
    kernel = 0.6 ** np.arange(60)
    smooth = np.convolve(x, kernel / kernel.sum())[60:60_000]
    fit = fit_noise([smooth], 0.01)
    assert fit.filtered
    found = by_name(fit.coefficients)
    assert found["N"].value == pytest.approx(N, rel=0.06)
    assert found["B"].value is None
    assert found["K"].value is None


@pytest.mark.parametrize(("amplitude", "hz"), [(0.1, 12.3456), (3.0, 31.7), (1.0, 0.7)])
def test_a_sinusoid_is_named_and_leaves_the_density_alone(amplitude: float, hz: float) -> None:
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(60_000)
    noise = axis_noise([rng.normal(size=len(t)) + amplitude * np.sin(2.0 * np.pi * hz * t + 1.0)], 0.01)
    (line,) = noise.lines
    assert line.hz == pytest.approx(hz, abs=line.resolution_hz)
    assert line.amplitude == pytest.approx(amplitude, rel=0.1)
    found = by_name(noise.fit.coefficients)
    assert found["N"].low < 0.1 < found["N"].high
    assert found["B"].value is None
    assert found["K"].value is None


def test_a_sinusoid_is_taken_out_of_short_pieces_too() -> None:
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(12_000)
    x = rng.normal(size=len(t)) + 2.0 * np.sin(2.0 * np.pi * 12.3 * t)
    noise = axis_noise([x[:9000], x[9000:9030], np.zeros(40), x[9030:9500], x[9500:]], 0.01)
    assert noise.lines[0].hz == pytest.approx(12.3, abs=noise.lines[0].resolution_hz)
    assert by_name(noise.fit.coefficients)["N"].value == pytest.approx(0.1, rel=0.03)


def test_a_vibration_that_wanders_is_named() -> None:
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(60_000)
    phase = 2.0 * np.pi * 20.0 * t + np.cumsum(0.02 * rng.normal(size=len(t)))
    noise = axis_noise([rng.normal(size=len(t)) + 0.5 * np.sin(phase)], 0.01)
    assert noise.lines[0].hz == pytest.approx(20.0, abs=0.1)
    assert by_name(noise.fit.coefficients)["N"].value == pytest.approx(0.1, rel=0.02)


def test_no_sinusoids_in_plain_noise() -> None:
    for seed in range(40):
        rng = np.random.default_rng(seed)
        assert not find_lines([rng.normal(size=20_000)], 0.01)
        assert not find_lines([np.cumsum(rng.normal(size=20_000))], 0.01)


def test_readings_coarser_than_the_noise_are_named() -> None:
    x = np.random.default_rng(0).normal(size=5000)
    assert axis_noise([np.round(x / 4.0) * 4.0], 0.01).coarse == 4.0
    assert axis_noise([np.round(x / 0.1) * 0.1], 0.01).coarse is None
