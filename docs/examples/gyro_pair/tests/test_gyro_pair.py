"""Two gyros on one body: the factor's Jacobians, whether sigmas are true, flips, and what one axis leaves unknown."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from alidade.factors import so3
from alidade.factors.preintegration import GyroPath
from alidade.factors.testing import assert_jacobians
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.diagnostics.hypothesis_tests import find_hypotheses
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import status
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.formula import apply
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import IncrementalSolver, solve_incremental
from gyro_pair import METHOD, ConjugateRotation, GyroPairData, GyroPairScenario, align, problem, windows

Array = NDArray[np.float64]
RNG = np.random.default_rng(1)
# Rates low enough for many runs; both gyros as noisy, so that both matter.
QUICK = {
    "duration_s": 20,
    "gyro_a": {"rate_hz": 100, "density": 2e-4},
    "gyro_b": {"rate_hz": 125, "phase": 0.4, "density": 2e-4},
}


ONE_AXIS = {"yaw": [{"amplitude_deg": 60, "frequency_hz": 0.3}]}


def simulated(seed: int = 0, **changes: Any) -> Simulated:
    settings = METHOD.settings().model_dump() | QUICK | changes
    return METHOD.simulate(GyroPairScenario.model_validate(settings), seed)


def errors(session: Simulated, estimate: Estimate) -> Array:
    return estimate.values - np.array([session.truth[name] for name in estimate.names])


def nees(session: Simulated, estimate: Estimate) -> float:
    error = errors(session, estimate)
    return float(error @ np.linalg.solve(estimate.covariance, error))


@pytest.mark.parametrize("angle", [1.5, 1e-6], ids=["random", "near zero"])
def test_jacobians(angle: float) -> None:
    n = 12
    t = np.arange(0.0, 6.0, 0.005)
    rates = [1.5 * np.sin(np.array([1.1, 0.7, 1.9]) * t[:, None] + RNG.uniform(0, 6, 3)) for _ in "ab"]
    a, b = GyroPath(t, rates[0]), GyroPath(t + 0.002, rates[1], RNG.normal(scale=0.01, size=3))
    start = np.linspace(0.6, 4.5, n)
    model = ConjugateRotation(start + 0.5, start, b.increments(start, start + 0.5), RNG.uniform(0.5, 2.0, n), a, b)
    blocks = [
        np.broadcast_to(so3.exp(angle * RNG.normal(size=3)), (n, 4)),
        np.full((n, 1), 0.0123),
        np.broadcast_to(b.bias_hat + 0.02 * RNG.normal(size=3), (n, 3)),
    ]
    # The interpolated rate has corners at the stamps: a small step in time keeps clear of them.
    assert_jacobians(model, blocks, [1e-5, 1e-6, 1e-5])


def test_exact_without_noise() -> None:
    """Biases of both gyros and a fast motion leave no error, but for that of integrating samples."""
    still = {"density": 1e-9, "bias_deg_s": 2.0}
    session = simulated(gyro_a={"rate_hz": 200, **still}, gyro_b={"rate_hz": 200, "phase": 0.4, **still})
    error = np.abs(errors(session, solve_batch(problem(session.data, Config()))))
    assert error[:3].max() < 1e-6
    assert error[3] < 1e-7
    assert error[4:].max() < 1e-6


@cache
def runs(solve: Callable[[Problem], Estimate], count: int) -> list[tuple[float, Estimate]]:
    found = []
    for seed in range(count):
        session = simulated(seed)
        estimate = solve(problem(session.data, Config()))
        found.append((nees(session, estimate), estimate))
    return found


@pytest.mark.parametrize(
    ("solve", "count"), [(solve_batch, 15), pytest.param(solve_incremental, 4, marks=pytest.mark.slow)]
)
def test_errors_are_as_large_as_the_sigmas_say(solve: Callable[[Problem], Estimate], count: int) -> None:
    """Mean NEES and summed chi-square within their 99 % intervals."""
    found = runs(solve, count)
    low, high = chi2.ppf([0.005, 0.995], 7 * count) / count
    assert low < np.mean([n for n, _ in found]) < high
    fits = [e.chi_square for _, e in found if e.chi_square is not None]
    assert len(fits) == count
    low, high = chi2.ppf([0.005, 0.995], sum(fit.dof for fit in fits))
    assert low < sum(fit.value for fit in fits) < high


def test_incremental_ends_where_batch_does() -> None:
    (_, batch), (_, incremental) = runs(solve_batch, 15)[0], runs(solve_incremental, 1)[0]
    assert np.abs((incremental.values - batch.values) / batch.sigmas).max() < 0.05


def test_the_smoother_forgets_though_all_variables_stay() -> None:
    """What it knows becomes one Gaussian: an update costs the same however long the recording is."""
    slow = {"rate_hz": 50}
    graph = problem(simulated(duration_s=64, gyro_a=slow, gyro_b=slow).data, Config())
    run = IncrementalSolver(graph, window=1.0)
    for step in graph.steps(1):
        run.add_step(step)
    batch = solve_batch(graph)
    assert np.abs((run.values() - batch.values) / batch.sigmas).max() < 0.05


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 179.0])
@pytest.mark.parametrize("offset", [-0.31, 0.2])
def test_any_rotation_and_offset_is_found_from_nothing(angle_deg: float, offset: float) -> None:
    rotation = angle_deg * np.array([0.48, -0.6, 0.64])
    session = simulated(rotation_deg=rotation.tolist(), time_offset_s=offset)
    found = align(session.data)
    assert abs(found["time_offset"][0] - offset) < 2e-3
    assert np.linalg.norm(so3.local(so3.exp(np.deg2rad(rotation)), found["rotation"])) < 2e-3
    assert nees(session, solve_batch(problem(session.data, Config()))) < chi2.ppf(0.9999, 7)


def test_one_axis_leaves_the_rotation_about_it() -> None:
    session = simulated(motion=ONE_AXIS)
    graph = problem(session.data, Config())
    estimate = solve_batch(graph)
    findings = diagnose(estimate, graph.quantities, graph.advice)
    assert status(findings) == "weak"
    # The others are known along an arc about it alone, which the numbers leave by more than is required.
    direction, *along = (finding.evidence for finding in findings if finding.kind == "direction")
    assert all(each["sigma_ratio"] < 0.05 * direction["sigma_ratio"] for each in along)
    # About the axis of the motion, which is z of a: in b, where the rotation is perturbed, it is bRa z.
    tangent = np.linalg.solve(
        so3.right_jacobian_inverse(estimate.values[:3]),
        [direction["weights"].get(f"rotation_{axis}", 0.0) for axis in "xyz"],
    )
    axis = so3.rotate(so3.inverse(so3.exp(estimate.values[:3])), [0.0, 0.0, 1.0])
    assert abs(tangent @ axis) / np.linalg.norm(tangent) > 0.98
    assert "two axes" in direction["advice"]


@pytest.mark.slow
def test_a_wrong_sign_is_named() -> None:
    session = simulated()
    wrong = GyroPairData(**{**vars(session.data), "b_gyro": session.data.b_gyro * [1.0, 1.0, -1.0]})
    found = find_hypotheses(METHOD.graph, METHOD.faults, wrong, Config())
    # A mirrored triad is any one axis mirrored and turned.
    labels = [label for each in found for label in (each.evidence["label"], *each.evidence["equivalents"])]
    assert any("sign of the gyro" in label and "wrong" in label for label in labels)


def test_windows_have_no_sample_in_common_and_stay() -> None:
    data = simulated().data
    start, stop = windows(data)
    assert (start[1:] == stop[:-1]).all()
    assert np.abs(data.b_t[:, None] - stop).min() > 0.4 * np.median(np.diff(data.b_t))
    shorter = GyroPairData(**{**vars(data), "a_t": data.a_t[:-300], "a_gyro": data.a_gyro[:-300]})
    assert (windows(shorter)[0] == start[: len(windows(shorter)[0])]).all()


def test_formulas_undo_what_was_simulated() -> None:
    still = {"density": 1e-9, "bias_deg_s": 0.5}
    session = simulated(gyro_a={"rate_hz": 100, **still}, gyro_b={"rate_hz": 100, **still}, time_offset_s=0.0)
    data = session.data
    found = apply(METHOD.report.formulas((), Config()), session.truth, {"gyro_b": data.b_gyro, "stamp": data.b_t})
    np.testing.assert_allclose(found["gyro_a"], data.a_gyro, atol=1e-6)
    np.testing.assert_allclose(found["time"], data.a_t)


def test_too_short_a_recording_is_told() -> None:
    with pytest.raises(InputError, match="record longer, or check the clocks"):
        problem(simulated(duration_s=1.5).data, Config())


def test_unknown_prior_is_told() -> None:
    with pytest.raises(InputError, match=r"priors.rotation_w"):
        problem(simulated().data, Config(priors={"rotation_w": 0.1}))
