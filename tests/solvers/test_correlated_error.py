"""Vision's error that is correlated in time: found where there is one, and what else depends on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.change_test import step_finding
from alidade.pipelines.diagnostics.cross_validation import solve_segments
from alidade.pipelines.estimation.noise import CORRELATED_ERROR, Level
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.solvers.batch import solve, solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.linear_chain import ENOUGH_KEYFRAMES, LinearChain
from alidade.pipelines.solvers.marginal_likelihood import estimate_levels
from alidade.pipelines.solvers.robust import solve_robust
from tests.support.gauss_markov import gauss_markov

RATE_HZ, DURATION_S = 20.0, 30.0
SCENARIO = HeadScenario.model_validate(
    {"duration_s": DURATION_S, "vision_rate_hz": RATE_HZ, "gyro_rate_hz": 100.0, "latitude_deg": None, "sensors": {}}
)


def lasting(size: float, time: float, n: int, seed: int) -> Array:
    """A Gauss-Markov process (n, 3) at the rate of the pictures."""
    phi = np.exp(-1.0 / (RATE_HZ * time))
    white = np.random.default_rng([seed, 3]).standard_normal((n + 400, 3))
    return size * gauss_markov(white, phi, 400)


def recorded(seed: int, size: float = 0.0, time: float = 0.3, scenario: HeadScenario = SCENARIO) -> HeadData:
    """A recording whose vision errs by a process of so many rad and s beside its white noise."""
    data = simulate_head(scenario, seed).data
    error = lasting(size, time, len(data.vision_t), seed)
    return replace(data, vision_wxyz=so3.multiply(data.vision_wxyz, so3.exp(error)))


def made(data: HeadData) -> Problem:
    return methods.method("head").problem(data, load_config(head_config(SCENARIO).encode()))


def with_error(problem: Problem, time: float, scale: float) -> tuple[Problem, tuple[Level, ...]]:
    """The graph with the error as states, and its levels."""
    assert problem.correlated_error is not None
    assert problem.refined_graph is not None
    levels = *problem.noises, replace(problem.correlated_error.level.over(time), scale=scale)
    graph = problem.refined_graph(levels)
    assert graph is not None
    return graph, levels


def lasts(estimate: Estimate) -> Level | None:
    return next((level for level in estimate.levels if level.noise.families == (CORRELATED_ERROR,)), None)


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_has_no_error_that_lasts(seed: int) -> None:
    assert lasts(solve_batch(made(recorded(seed)))) is None


@pytest.mark.parametrize(("size", "time"), [(8e-3, 0.1), (8e-3, 0.3), (8e-3, 1.5), (2.5e-2, 1.5)])
def test_size_and_time_of_an_error_are_found(size: float, time: float) -> None:
    """In place of a gyro noise that is many times the gyro's."""
    estimate = solve_batch(made(recorded(1, size, time)))
    found = lasts(estimate)
    assert found is not None
    assert found.found is not None
    assert found.sigma is not None
    assert abs(found.used - size) < 4.0 * found.sigma * found.noise.stated
    assert found.noise.correlation_time == pytest.approx(time, rel=0.5)
    (gyro,) = (level.together for level in estimate.levels if level.noise.name == "gyro_density")
    assert gyro.scale < 3.0


def test_an_error_is_found_however_little_white_noise_is_stated() -> None:
    """A thirtieth of vision's."""
    config = load_config(head_config(SCENARIO).encode())
    config = config.model_copy(update={"noise": config.noise.model_copy(update={"vision_attitude": 3e-4})})
    data = replace(recorded(2, 8e-3, 0.3), vision_cov=None)
    found = lasts(solve_batch(methods.method("head").problem(data, config)))
    assert found is not None
    assert found.used == pytest.approx(8e-3, rel=0.3)


def test_an_error_that_does_not_matter_stays_noise() -> None:
    """Smaller than half of what is required of the mount."""
    problem = made(recorded(1, 8e-3, 0.3))
    assert problem.correlated_error is not None
    assert problem.correlated_error.least == pytest.approx(5e-3)
    assert lasts(solve_batch(replace(problem, correlated_error=replace(problem.correlated_error, least=0.02)))) is None


def test_errors_are_no_measurements_that_move_the_result() -> None:
    estimate = solve_batch(made(recorded(1, 8e-3, 0.3)), budget=True)
    assert lasts(estimate) is not None
    assert estimate.budget is not None
    assert estimate.budget["helmet_mount_x"][CORRELATED_ERROR] > 0.3
    assert estimate.strongest
    assert CORRELATED_ERROR not in {each.family for each in estimate.strongest}


def test_either_side_of_a_recording_has_the_error_of_the_whole() -> None:
    method, data = methods.method("head"), recorded(1, 8e-3, 0.3)
    config = load_config(head_config(SCENARIO).encode())
    estimate = solve_batch(method.problem(data, config))
    sides = solve_segments(method.graph, method.faults, data, config, 15.0, estimate.levels)
    assert sides
    for name, side in sides.items():
        if "mount" in name:
            assert abs(side.step) < 3.5 * side.step_sigma, name
            assert side.first_sigma > 1.1 * estimate.sigmas[estimate.names.index(name)], name


@pytest.mark.slow
@pytest.mark.parametrize("time", [0.1, 0.5, 1.5])
def test_sigmas_contain_an_error_that_lasts(time: float) -> None:
    """Mean NEES of 16 recordings of all that is estimated, two-sided."""
    squares = []
    for seed in range(16):
        simulated = simulate_head(SCENARIO, seed)
        error = lasting(8e-3, time, len(simulated.data.vision_t), seed)
        data = replace(simulated.data, vision_wxyz=so3.multiply(simulated.data.vision_wxyz, so3.exp(error)))
        estimate = solve_batch(made(data))
        assert lasts(estimate) is not None, seed
        free = estimate.sigmas > 0.0
        off = (estimate.values - [simulated.truth[name] for name in estimate.names])[free]
        squares.append(off @ np.linalg.solve(estimate.covariance[np.ix_(free, free)], off) / free.sum())
    assert 0.75 < np.mean(squares) < 1.35


def test_likelihood_with_the_error_is_that_of_its_dense_covariance() -> None:
    """States of the process, integrated out, leave vision's white noise plus the process's covariance."""
    scenario = SCENARIO.model_copy(update={"duration_s": 4.0})
    compiled = Compiled.of(made(recorded(2, 5e-3, 0.3, scenario)), "chain")
    levels, error = compiled.problem.noises, compiled.problem.correlated_error
    assert error is not None
    chain = LinearChain.of(compiled.engine, solve_robust(compiled.engine, compiled.initial, None).values)
    layout = compiled.layout
    columns = np.flatnonzero(layout.root_columns(error.key)[:, layout.sizes[3] :].any(axis=0))
    (n, d), p = chain.size, chain.prior.shape[1] - 1
    for time, scale in ((0.1, 0.3), (0.8, 1.5)):
        level = replace(error.level.over(time), scale=scale)
        wider = chain.with_error(columns, level.noise.stated, time)
        solved = wider.solved(wider.variances((*levels, level)))
        assert solved is not None
        # Dense: all rows of the chain without the process, those of vision with its covariance.
        A, r, C = [np.pad(chain.prior[:, :p], ((0, 0), (n * d, 0)))], [chain.prior[:, p]], [np.eye(len(chain.prior))]
        for rows in chain.rows:
            m, k = rows.residuals.shape[1], len(rows.time)
            J = np.zeros((k, m, n * d + p))
            J[..., n * d :] = rows.shared
            for i, by in rows.states:
                for a in range(k):
                    J[a, :, d * i[a] : d * (i[a] + 1)] += by[a]
            noise = np.diag(np.repeat(rows.variance(levels), m))
            if rows.is_measurement:
                B, at = rows.shared[..., columns], chain.times[rows.states[0][0]]
                kept = np.exp(-np.abs(at[:, None] - at) / time) * level.used**2
                noise += np.einsum("ami,ab,bni->ambn", B, kept, B).reshape(k * m, k * m)
            A, r, C = [*A, J.reshape(k * m, -1)], [*r, rows.residuals.ravel()], [*C, noise]
        information, value, right = np.zeros((n * d + p, n * d + p)), 0.0, np.zeros(n * d + p)
        for by, left, noise in zip(A, r, C, strict=True):
            weighed = np.linalg.solve(noise, np.column_stack([by, left]))
            information, right = information + by.T @ weighed[:, :-1], right + by.T @ weighed[:, -1]
            value += left @ weighed[:, -1] + np.linalg.slogdet(noise)[1]
        value += np.linalg.slogdet(information)[1] - right @ np.linalg.solve(information, right)
        assert solved.value + wider.log_det_of_process == pytest.approx(value, rel=1e-9)


def test_the_chain_and_gtsam_agree_on_a_graph_with_the_error() -> None:
    scenario = SCENARIO.model_copy(update={"duration_s": 6.0})
    graph, levels = with_error(made(recorded(3, 5e-3, 0.3, scenario)), 0.3, 0.6)
    chain, gtsam = (solve(Compiled.of(graph, engine), levels=levels) for engine in ("chain", "gtsam"))
    sigmas = np.sqrt(np.diag(chain.posterior.covariance))
    off = chain.posterior.reported.numbers - gtsam.posterior.reported.numbers
    assert (np.abs(off) < 1e-3 * np.maximum(sigmas, 1e-15)).all()
    np.testing.assert_allclose(np.sqrt(np.diag(gtsam.posterior.covariance)), sigmas, rtol=1e-5)


def test_levels_are_linear_about_any_error() -> None:
    """At a solution whose errors are not zero the levels are those that they are about none."""
    graph, levels = with_error(made(recorded(4, 8e-3, 0.3)), 0.3, 1.0)
    compiled = Compiled.of(graph, "chain")
    solved = solve(compiled, levels=levels)
    about = LinearChain.of(compiled.engine, solved.values)
    assert about.process is not None
    assert np.abs(about.process.values).max() > 5e-3
    (found,) = (each for each in estimate_levels(about, levels) if each.noise.families == (CORRELATED_ERROR,))
    assert found.used == pytest.approx(8e-3, rel=0.25)


def test_a_part_of_a_chain_has_transitions_over_what_is_left_out() -> None:
    longer = SCENARIO.model_copy(update={"duration_s": 60.0})
    graph, levels = with_error(made(recorded(5, 8e-3, 0.3, longer)), 0.3, 1.0)
    compiled = Compiled.of(graph, "chain")
    chain = LinearChain.of(compiled.engine, compiled.initial)
    part, factors = chain.liveliest(chain.factors(None), 400)
    assert part.size[0] == 400 < chain.size[0] <= ENOUGH_KEYFRAMES
    assert [len(each) for each in factors] == [len(rows.time) for rows in part.rows]
    (rows,) = (each for each in part.rows if each.family == CORRELATED_ERROR and len(each.states) == 2)
    (_, before), (_, after) = rows.states
    phi = -before[:, 0, 3] / after[:, 0, 3]
    np.testing.assert_allclose(phi, np.maximum(np.exp(-np.diff(part.times) / 0.3), 1e-2), rtol=1e-9)
    assert np.diff(part.times).max() > 1.0
    assert part.solved([v * f for v, f in zip(part.variances(levels), factors, strict=True)]) is not None


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))])
def test_an_error_that_lasts_is_no_slip_and_hides_none(seed: int) -> None:
    data = recorded(seed, 8e-3, 0.5)
    for slip in (0.0, 3.0):
        turned = so3.exp(np.where(data.vision_t > 12.0, np.deg2rad(slip), 0.0)[:, None] * [0.6, 0.8, 0.0])
        problem = made(replace(data, vision_wxyz=so3.multiply(data.vision_wxyz, turned)))
        estimate = solve_batch(problem, steps=True)
        assert estimate.steps is not None
        finding = step_finding(estimate.steps, DURATION_S, problem.quantities)
        assert (finding is not None and finding.kind == "change") == (slip > 0.0), (slip, finding)
