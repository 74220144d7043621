"""Noise levels of the largest marginal likelihood: gradient, widening, innovations."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.chi_square import quantile
from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.simulation import HeadNoise, HeadScenario, head_config, simulate_head
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.linear_chain import LinearChain
from alidade.pipelines.solvers.linearization import Linearization
from alidade.pipelines.solvers.marginal_likelihood import estimate_levels, widened
from alidade.pipelines.solvers.robust import solve_robust

SCENARIO = HeadScenario.model_validate(
    {"duration_s": 30.0, "vision_rate_hz": 20.0, "gyro_rate_hz": 100.0, "latitude_deg": None, "sensors": {}}
)


def made(data: HeadData) -> Problem:
    return methods.method("head").problem(data, load_config(head_config(SCENARIO).encode()))


@cache
def chain() -> tuple[LinearChain, tuple[Level, ...]]:
    """A recording about its solution, and its noises as stated."""
    compiled = Compiled.of(made(simulate_head(SCENARIO, 1).data), "chain")
    assert isinstance(compiled.engine, Linearization)
    solution = solve_robust(compiled.engine, compiled.initial, compiled.problem.loss)
    return LinearChain.of(compiled.engine, solution.values), compiled.problem.noises


def test_levels_found_are_where_the_likelihood_is_largest() -> None:
    linear, levels = chain()
    found = estimate_levels(linear, levels)
    free = [i for i, level in enumerate(levels) if level.noise.estimated]
    assert len(free) == 4

    def value(scales: np.ndarray) -> float:
        tried = list(found)
        for i, scale in zip(free, scales, strict=True):
            tried[i] = replace(tried[i], scale=float(scale))
        solved = linear.solved(linear.variances(tried))
        assert solved is not None
        known = np.array([found[i].known for i in free])
        return solved.value + float(((np.log(scales) / known) ** 2).sum())

    best = np.array([found[i].scale for i in free])
    for i in range(len(free)):
        for by in (0.5, 2.0):
            assert value(best * np.where(np.arange(len(free)) == i, by, 1.0)) > value(best) - 0.1


def test_a_level_is_never_below_its_bound() -> None:
    """The others are where the likelihood is largest with it there."""
    linear, levels = chain()
    bounded = tuple(
        replace(level, noise=replace(level.noise, least=3.0)) if level.noise.name == "gyro_density" else level
        for level in levels
    )
    found = {level.noise.name: level.scale for level in estimate_levels(linear, bounded)}
    assert found["gyro_density"] == pytest.approx(3.0)
    held = tuple(
        replace(level, scale=3.0, noise=replace(level.noise, known=0.0)) if level.noise.least else level
        for level in bounded
    )
    expected = {level.noise.name: level.scale for level in estimate_levels(linear, held)}
    assert found["vision_attitude"] == pytest.approx(expected["vision_attitude"], rel=0.01)


def test_level_of_vision_is_that_simulated() -> None:
    linear, levels = chain()
    (vision,) = (level for level in estimate_levels(linear, levels) if level.noise.name == "vision_attitude")
    assert vision.found is not None
    assert vision.sigma is not None
    assert abs(vision.found - 1.0) < 4.0 * vision.sigma
    assert vision.sigma < 0.03


def test_noises_of_the_same_rows_are_known_better_together() -> None:
    """White noise of the simulated gyro, none that grows with the rate: all of it is what was simulated."""
    linear, levels = chain()
    own, added = (
        level for level in estimate_levels(linear, levels) if level.noise.name in ("gyro_density", "gyro_rate_noise")
    )
    assert own.effective is not None
    assert added.effective is None
    size, sigma = own.effective
    assert abs(size - 1.0) < 4.0 * sigma
    assert size > own.scale
    assert own.found is not None
    assert own.sigma is not None
    assert sigma / size < own.sigma / own.found
    assert own.together.used == pytest.approx(size * own.noise.stated)


def test_innovations_are_white_and_of_unit_variance() -> None:
    linear, levels = chain()
    (found,) = linear.innovations(linear.variances(levels), [np.inf] * len(linear.rows)).values()
    e = found.whitened[..., 0]
    n = e.size
    assert abs((e**2).mean() - 1.0) < 4.0 * (2.0 / n) ** 0.5
    assert abs((e[1:] * e[:-1]).mean()) < 4.0 * n**-0.5


@pytest.mark.parametrize("share", [1e-8, 1e-12])
def test_measurements_may_be_far_better_than_what_is_predicted(share: float) -> None:
    """Attitudes rounded to 0.01 that rest: rounding once took positive covariances away, and the command stopped."""
    linear, levels = chain()
    variances = linear.variances(levels)
    better = [v * (share if len(rows.states) == 1 else 1.0) for v, rows in zip(variances, linear.rows, strict=True)]
    (found,) = linear.innovations(better, [np.inf] * len(linear.rows)).values()
    assert np.isfinite(found.whitened).all()
    np.testing.assert_allclose(np.square(found.whitened[..., 0]).sum(axis=1), found.squares)


def test_glitches_are_widened_and_nothing_is_left_out() -> None:
    data, _ = simulate_head(SCENARIO.model_copy(update={"duration_s": 15.0}), 1)
    wxyz = data.vision_wxyz.copy()
    glitches = [50, 130, 200]
    wxyz[glitches] = so3.multiply(wxyz[glitches], so3.exp(np.full(3, 0.03)))
    estimate = solve_batch(made(replace(data, vision_wxyz=wxyz)))
    right = solve_batch(made(data))
    assert estimate.rejected["vision"] == 0
    names = [i for i, name in enumerate(estimate.names) if name.startswith(("gyro_bias", "helmet_mount", "time"))]
    assert np.abs((estimate.values - right.values)[names] / right.sigmas[names]).max() < 1.0


def test_an_outlier_before_all_others_stays_one() -> None:
    """Judged by what is known before it, it was none, then all others were, and the level 6 times as large."""
    short = SCENARIO.model_copy(update={"duration_s": 3.0})
    data, _ = simulate_head(short, 2)
    wxyz = data.vision_wxyz.copy()
    wxyz[[0, 20, 40]] = so3.multiply(wxyz[[0, 20, 40]], so3.exp(np.full(3, 0.2)))
    estimate = solve_batch(made(replace(data, vision_wxyz=wxyz)))
    assert np.flatnonzero(~estimate.residuals["vision"].used).tolist() == [0, 20, 40]
    (vision,) = (level for level in estimate.levels if level.noise.name == "vision_attitude")
    assert 0.7 < vision.scale < 1.4


def test_few_rows_of_clean_noise_are_widened() -> None:
    linear, levels = chain()
    groups = {rows.group: np.ones(len(rows.time)) for rows in linear.rows}
    wide = widened(linear, levels, [groups.get(i, np.ones(0)) for i in range(max(groups) + 1)])
    measured = np.concatenate([wide[rows.group] for rows in linear.rows if rows.is_measurement])
    assert np.mean(measured > 1.0) < 0.01
    assert np.isfinite(measured).all()


@pytest.mark.parametrize(("density", "by_rate"), [pytest.param(2e-3, 0.0, marks=pytest.mark.slow), (5e-4, 5e-3)])
def test_white_noise_and_noise_that_grows_with_the_rate_are_told_apart(density: float, by_rate: float) -> None:
    """Whichever is at its default at first, where -2 log L is flat in its logarithm, is not the other one's noise."""
    data, _ = simulate_head(SCENARIO, 1)
    size = np.hypot(density, by_rate * np.linalg.norm(data.head_gyro, axis=1)) * SCENARIO.gyro_rate_hz**0.5
    noise = size[:, None] * np.random.default_rng(1).standard_normal(data.head_gyro.shape)
    noisy = replace(data, head_gyro=data.head_gyro + noise, gyro_density=None)
    estimate = solve_batch(methods.method("head").problem(noisy, load_config(None)))
    used = {level.noise.name: level.used for level in estimate.levels}
    rate = float(np.sqrt((data.head_gyro**2).sum(axis=1).mean()))
    found, true = np.array([used["gyro_density"], rate * used["gyro_rate_noise"]]), np.array([density, rate * by_rate])
    larger = int(np.argmax(true))
    assert found[larger] == pytest.approx(true[larger], rel=0.25)
    assert found[1 - larger] < 0.2 * found[larger]


def test_noise_of_vision_in_motion_is_not_the_gyros() -> None:
    """A device at rest for most of the time: one level of vision is that of the rest, and its mount was 3 deg off."""
    swings = [{"amplitude_deg": 20.0, "frequency_hz": f, "end_s": 6.0} for f in (0.33, 0.5, 0.67)]
    moved = {"yaw": swings[:1], "pitch": swings[1:2], "roll": swings[2:]}
    noise = {"vision_attitude": 3e-4, "vision_rate_noise": 4e-3, "gyro_density": 2e-4}
    scenario = HeadScenario.model_validate(SCENARIO.model_dump() | {"head": moved, "noise": noise})
    total, dof = 0.0, 0
    for seed in range(3):
        data, truth = simulate_head(scenario, seed)
        estimate = solve_batch(
            methods.method("head").problem(replace(data, vision_cov=None, gyro_density=None), load_config(None))
        )
        used = {level.noise.name: level.used for level in estimate.levels}
        assert used["vision_rate_noise"] == pytest.approx(4e-3, rel=0.2)
        assert used["vision_attitude"] == pytest.approx(3e-4, rel=0.1)
        assert used["gyro_rate_noise"] < 1e-3
        rows = [i for i, name in enumerate(estimate.names) if name.startswith(("helmet_mount", "gyro_bias", "time"))]
        error = estimate.values[rows] - [truth[estimate.names[i]] for i in rows]
        total += float(error @ np.linalg.solve(estimate.covariance[np.ix_(rows, rows)], error))
        dof += len(rows)
    assert quantile(0.005, dof) < total < quantile(0.995, dof)


def test_a_noise_in_motion_that_is_stated_contradicts_no_white_noise() -> None:
    """The total was compared with the white part's figure: "4 times the config's value", where both are right."""
    noise = {"vision_attitude": 2e-3, "vision_rate_noise": 1e-2}
    scenario = HeadScenario.model_validate(SCENARIO.model_dump() | {"duration_s": 15.0, "noise": noise})
    of = methods.method("head").problem(simulate_head(scenario, 2).data, load_config(head_config(scenario).encode()))
    levels = {level.noise.name: level for level in solve_batch(of).levels}
    assert levels["vision_rate_noise"].noise.source == "config"
    assert levels["vision_attitude"].together.scale == pytest.approx(1.0, rel=0.3)
    assert levels["gyro_density"].effective is not None


@cache
def levels_with(gap_s: float, pictures_too: bool) -> dict[str, float]:
    """Levels found of a recording without samples for a while, and without pictures then."""
    noise = HeadNoise(gyro_density=2e-4, vision_attitude=1e-3)
    data, _ = simulate_head(SCENARIO.model_copy(update={"duration_s": 20.0, "platform": None, "noise": noise}), 3)
    gyro, vision = (np.abs(t - 10.0) >= 0.5 * gap_s for t in (data.head_t, data.vision_t))
    vision |= not pictures_too
    left = replace(
        data,
        head_t=data.head_t[gyro],
        head_gyro=data.head_gyro[gyro],
        head_force=None,
        gyro_density=None,
        vision_t=data.vision_t[vision],
        vision_wxyz=data.vision_wxyz[vision],
        vision_cov=None,
    )
    estimate = solve_batch(methods.method("head").problem(left, load_config(None)))
    return {level.noise.name: level.used for level in estimate.levels}


@pytest.mark.parametrize("pictures_too", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_turns_in_a_gap_is_no_noise(pictures_too: bool) -> None:
    """A second without samples once left the gyro a tenth of its density, and pictures in it 6 % more noise."""
    whole, gap = levels_with(0.0, False), levels_with(1.0, pictures_too)
    assert gap["gyro_density"] == pytest.approx(whole["gyro_density"], rel=0.15)
    assert gap["vision_attitude"] == pytest.approx(whole["vision_attitude"], rel=0.02)
