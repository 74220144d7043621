"""At rest what is known is a curve: the joint covariance has to cover it, not its tangent alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from alidade.factors.array import Array
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.settings import Sensors
from alidade.pipelines.solvers import weak_directions
from alidade.pipelines.solvers.batch import solve, solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.posterior import Reported
from benchmarks.initialisation import CASES, LOS, beginning, drawn_los, followed, made, nees
from tests.support.builders import IDEAL


def recording(
    seed: int, rest_s: float, duration_s: float, sensors: Sensors = IDEAL, **changes: float
) -> tuple[Problem, Array]:
    """A carrier that is at rest first; mounting angles and errors of the sensors are drawn from their priors."""
    carrier = beginning(LOS.carrier, dict.fromkeys(("yaw", "pitch", "roll"), rest_s))
    return made("los", drawn_los(seed, duration_s=duration_s, carrier=carrier, sensors=sensors, **changes), seed)


def solved(problem: Problem, monkeypatch: pytest.MonkeyPatch | None = None) -> Estimate:
    """By batch; with a patch, as the linear system has it alone."""
    if monkeypatch is None:
        return solve_batch(problem)
    with monkeypatch.context() as patch:
        patch.setattr(weak_directions, "curvature", lambda found, _: np.zeros((len(found.sigmas), len(found.sigmas))))
        return solve_batch(problem)


def along_the_tangent(problem: Problem) -> tuple[Array, Array]:
    """The minimum, and the covariance there as the linear system has it."""
    compiled = Compiled.of(problem)
    found = solve(compiled).solution
    reported = Reported.of(compiled, found.values)
    return reported.numbers, reported.covariance(reported.root(found.factorization.root).covariance())


def test_the_joint_covariance_at_rest_covers_the_valley() -> None:
    """Summed over six recordings; the tangent alone is refuted. Four numbers have errors, the sensors are ideal."""
    bent, flat, numbers = 0.0, 0.0, 0
    for seed in range(6):
        problem, truth = recording(seed, 10.0, 6.0, image_rate_hz=5.0, gyro_rate_hz=50.0)
        curved = solved(problem)
        bent += nees(curved.values, curved.covariance, truth)[0]
        size, dof = nees(*along_the_tangent(problem), truth)
        flat, numbers = flat + size, numbers + dof
    assert chi2.ppf(0.001, 4 * 6) < bent < chi2.ppf(0.999, 4 * 6), (bent, numbers)
    assert flat > chi2.ppf(0.999, 4 * 6), (flat, numbers)


def test_what_is_determined_needs_no_second_order(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = recording(1, 0.0, 15.0)
    np.testing.assert_array_equal(solved(problem).covariance, solved(problem, monkeypatch).covariance)


@pytest.mark.slow
def test_joint_errors_fit_at_rest_and_when_motion_begins() -> None:
    moments = np.array([2.0, 5.0, 8.0, 12.0, 15.0, 20.0])
    found = [followed(*recording(seed, 10.0, 21.0, Sensors()), moments) for seed in range(4)]
    sums = np.sum([each.nees for each in found], axis=0)
    assert (sums < chi2.ppf(0.999, 4 * found[0].numbers)).all(), sums / 4.0


def test_other_draws_tell_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen at random would differ by a half."""
    problem, _ = recording(0, 10.0, 6.0)
    linear, covariance = solved(problem, monkeypatch).covariance, []
    for seed in range(4):
        default = np.random.default_rng
        monkeypatch.setattr(np.random, "default_rng", lambda _, default=default, seed=seed: default(seed))
        covariance.append(solve_batch(problem).covariance)
        monkeypatch.undo()
    scale = np.sqrt(np.diag(linear))
    axes = np.linalg.eigh(linear / np.outer(scale, scale))[1] / scale[:, None]
    best = [axes[:, 0] @ each @ axes[:, 0] for each in covariance]
    assert min(best) > 100.0 * (axes[:, 0] @ linear @ axes[:, 0])
    assert max(best) < 1.2 * min(best)


def test_numbers_that_measurements_are_not_linear_in_are_covered() -> None:
    """Turns about one axis: gains about the others stay unknown, and with them b = -K c, however well c is known.

    Along the tangent of K and b alone it is 5,400.
    """
    settings, _ = CASES["cube"]["one axis"](1000)
    problem, truth = made("cube", settings, 1000)
    estimate = solve_batch(problem)
    size, dof = nees(estimate.values, estimate.covariance, truth)
    assert size < chi2.ppf(0.999, dof), (size, dof)


@pytest.mark.parametrize("numbers", [(3002,), pytest.param((3001, 3002, 3003), marks=pytest.mark.slow)])
def test_a_mount_that_nobody_knows_is_covered_before_the_second_axis_turns(numbers: tuple[int, ...]) -> None:
    """Here and there known to a few hundredths of what mounts may be, which bend what is known a thousand times better.

    Along the tangent alone it is 560. The mounts are of 90, 120 and 180 deg, against which no sign can be checked.
    """
    sums = np.zeros(2)
    for number in numbers:
        settings, shares = CASES["indexer"]["mount"](number)
        problem, truth = made("indexer", settings, number)
        last = [step.time for step in problem.steps(1)][-1]
        found = followed(problem, truth, last * shares[:5])
        sums += max(found.nees), found.numbers
    assert sums[0] < chi2.ppf(0.999, sums[1]), sums
