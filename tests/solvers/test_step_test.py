"""A mount that slips: every keyframe a candidate, motion alone beside the jump, the best ones solved again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import alidade
from alidade.factors import so3
from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.change_test import step_finding, step_stability
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.problem import Estimate, Problem, Quantity, StepEstimate
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.linear_chain import LinearChain
from alidade.pipelines.solvers.linearization import Linearization
from alidade.pipelines.solvers.marginal_likelihood import sandwich, scores
from alidade.pipelines.solvers.robust import solve_robust
from alidade.pipelines.solvers.step_test import STEP_PRIOR, sandwich_ratios, scan, split

DURATION_S = 30.0
SCENARIO = HeadScenario.model_validate(
    {"duration_s": DURATION_S, "vision_rate_hz": 20.0, "gyro_rate_hz": 100.0, "latitude_deg": None, "sensors": {}}
)


def problem(data: HeadData) -> Problem:
    return methods.method("head").problem(data, load_config(head_config(SCENARIO).encode()))


@cache
def recorded(seed: int) -> HeadData:
    return simulate_head(SCENARIO, seed).data


def slipped(data: HeadData, deg: float, time: float, axis: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> HeadData:
    """The markers slip on the helmet."""
    wxyz, late = data.vision_wxyz.copy(), data.vision_t > time
    wxyz[late] = so3.multiply(wxyz[late], so3.exp(np.deg2rad(deg) * np.array(axis)))
    return replace(data, vision_wxyz=wxyz)


def glitching(data: HeadData) -> HeadData:
    """The reference is off by 2 deg from 14 to 15 s."""
    return slipped(slipped(data, 2.0, 14.0), -2.0, 15.0)


def sparse(data: HeadData, kept: np.ndarray) -> HeadData:
    """Some of the pictures."""
    cov = None if data.vision_cov is None else data.vision_cov[kept]
    return replace(data, vision_t=data.vision_t[kept], vision_wxyz=data.vision_wxyz[kept], vision_cov=cov)


def found(data: HeadData) -> tuple[Estimate, Finding | None]:
    """The estimate of a recording, and the finding on a step in it."""
    of = problem(data)
    estimate = solve_batch(of, steps=True)
    assert estimate.steps is not None
    return estimate, step_finding(estimate.steps, DURATION_S, of.quantities)


@pytest.mark.parametrize("lasting", [False, True], ids=["white noise", "an error that lasts"])
def test_the_scan_is_exact(lasting: bool) -> None:
    """Falls of chi-square by two filters are those of the chain with the step in it."""
    of = problem(slipped(recorded(1), 0.5, 12.0))
    if lasting:
        assert of.correlated_error is not None
        assert of.refined_graph is not None
        found = of.refined_graph((*of.noises, replace(of.correlated_error.level.over(0.3), scale=0.5)))
        assert found is not None
        of = found
    compiled = Compiled.of(of, "chain")
    engine = compiled.engine
    assert isinstance(engine, Linearization)
    values = solve_robust(engine, compiled.initial, compiled.problem.loss).values
    chain, key = LinearChain.of(engine, values), compiled.problem.step_candidates[0]
    columns = np.flatnonzero(engine.layout.root_columns(key)[:, engine.layout.sizes[3] :].any(axis=0))
    variances = chain.variances(compiled.problem.noises)
    tested = scan(chain, variances, columns)
    before = chain.solved(variances)
    assert tested is not None
    assert before is not None
    for i in (0, len(tested.keyframe) // 3, len(tested.keyframe) - 1):
        with_step = LinearChain.of(*split(engine, values, key, float(tested.time[i]), np.zeros(3))[:2])
        joined = with_step.solved(variances)
        alone = with_step.solved(
            [
                np.where(rows.states[-1][0] == tested.keyframe[i], np.inf, v) if rows.family == "gyro" else v
                for rows, v in zip(with_step.rows, variances, strict=True)
            ]
        )
        assert joined is not None
        assert alone is not None
        moved = joined.shared[-3:] - joined.shared[columns]
        D = np.zeros((3, len(joined.shared)))
        D[:, -3:], D[:, columns] = np.eye(3), -np.eye(3)
        np.testing.assert_allclose(tested.step[i], moved, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(np.linalg.inv(tested.information[i]), joined.covariance(D), rtol=1e-4)
        # With its step at zero the chain is the one before, but for the determinants.
        C = joined.covariance(D)
        assert tested.fall[i] == pytest.approx(moved @ np.linalg.solve(C, moved), rel=1e-3, abs=1e-6)
        by_motion, C = alone.shared[-3:] - alone.shared[columns], alone.covariance(D)
        assert tested.by_motion[i] == pytest.approx(by_motion @ np.linalg.solve(C, by_motion), rel=1e-3, abs=1e-6)
        apart = by_motion - moved
        assert tested.apart[i] == pytest.approx(apart @ np.linalg.solve(C, apart), rel=1e-3, abs=1e-6)
    assert STEP_PRIOR == 0.35


def test_with_the_step_held_fixed_the_mount_is_as_sure_as_without_one() -> None:
    """However near the end: its ratio of sandwich to nominal sigma is that of the chain in which nothing steps."""
    compiled = Compiled.of(problem(recorded(1)), "chain")
    engine = compiled.engine
    assert isinstance(engine, Linearization)
    values = solve_robust(engine, compiled.initial, compiled.problem.loss).values
    chain, key = LinearChain.of(engine, values), compiled.problem.step_candidates[0]
    variances = chain.variances(compiled.problem.noises)
    mount = engine.layout.root_columns(key)[:, engine.layout.sizes[3] :]
    nominal, robust = sandwich(*scores(chain, variances)[:2])
    inverse = np.linalg.inv(np.linalg.cholesky(mount @ nominal @ mount.T))
    ratios = np.linalg.eigvalsh(inverse @ mount @ robust @ mount.T @ inverse.T) ** 0.5
    of_steps = []
    for time in (15.0, DURATION_S - 1.5):
        with_step = LinearChain.of(*split(engine, values, key, time, np.zeros(3))[:2])
        p = with_step.prior.shape[1] - 1
        first = np.pad(mount, ((0, 0), (0, 3)))
        D = np.eye(p)[-3:] - first
        of_step, of_mount = sandwich_ratios(with_step, variances, D, first, np.zeros(p))
        assert of_mount == pytest.approx(max(1.0, ratios[-1]), rel=1e-4)
        of_steps.append(of_step)
    assert abs(of_steps[0] - of_steps[1]) > 0.01


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_a_recording_in_which_nothing_changes_has_no_finding(seed: int) -> None:
    estimate, finding = found(recorded(seed))
    assert finding is None
    assert estimate.steps is not None
    assert step_stability(estimate.steps[0], DURATION_S).level > 0.05


@pytest.mark.parametrize(("deg", "time"), [(1.0, 9.0), pytest.param(20.0, 24.0, marks=pytest.mark.slow)])
def test_a_slip_is_found_that_levels_would_hide(deg: float, time: float) -> None:
    """Without the step the gyro's noise rises, and the recording would be calibrated."""
    estimate, finding = found(slipped(recorded(2), deg, time))
    assert estimate.steps is not None
    assert finding is not None
    assert (finding.kind, finding.severity) == ("change", Severity.INCONSISTENT)
    assert abs(finding.evidence["time_s"] - time) < 0.3
    step = estimate.steps[0]
    assert abs(step.size - np.deg2rad(deg)) < 4.0 * step.sigma
    assert step.ratio < 1.5


def test_a_glitch_of_the_reference_is_no_change() -> None:
    """2 deg for 1 s jumps, and comes back."""
    estimate, finding = found(glitching(recorded(1)))
    assert finding is None
    assert estimate.steps is not None
    assert not any(step.jumped for step in estimate.steps if abs(step.time_s - 14.0) < 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("deg", "least"), [(1.0, Severity.WEAK), (1.5, Severity.INCONSISTENT)])
def test_a_glitch_hides_no_smaller_slip(deg: float, least: Severity) -> None:
    """Both have a jump; the glitch has the larger one, and passes for noise, so that motion tells less of the slip."""
    finding = found(slipped(glitching(recorded(1)), deg, 20.0))[1]
    assert finding is not None
    assert finding.severity >= least
    assert abs(finding.evidence["time_s"] - 20.0) < 0.3


def test_a_world_that_is_found_anew_is_no_change() -> None:
    """The reference's own frame turns by 2 deg: the attitude jumps, and no mount slips."""
    data = recorded(3)
    wxyz, late = data.vision_wxyz.copy(), data.vision_t > 15.0
    wxyz[late] = so3.multiply(so3.exp(np.deg2rad([0.0, 2.0, 0.0])), wxyz[late])
    finding = found(replace(data, vision_wxyz=wxyz))[1]
    assert finding is None or finding.kind == "jump"


def test_a_slip_before_the_first_motion_of_a_mount_beyond_its_prior_jumps() -> None:
    """Before, the mount by motion alone is its prior, 7 sigmas from the true one: no step of 2 deg agreed with that."""
    data, mount, begin = recorded(2), so3.exp(np.array([np.deg2rad(150.0), 0.0, 0.0])), 10.0
    rng, wxyz, gyro = np.random.default_rng(0), data.vision_wxyz.copy(), data.head_gyro.copy()
    moving, early = int(np.searchsorted(data.head_t, begin)), data.vision_t < begin
    gyro[:moving] = gyro[:moving].mean(axis=0) + 5e-4 * rng.standard_normal((moving, 3))
    noise = so3.exp(8.7e-3 * rng.standard_normal((int(early.sum()), 3)))
    wxyz[early] = so3.multiply(np.broadcast_to(wxyz[np.argmin(early)], noise.shape), noise)
    turned = so3.rotate(np.broadcast_to(mount, (len(gyro), 4)), gyro)
    finding = found(slipped(replace(data, head_gyro=turned, vision_wxyz=wxyz), 4.0, begin - 0.2))[1]
    assert finding is not None
    assert (finding.kind, finding.severity) == ("jump", Severity.WEAK)


def test_a_slip_in_an_outage_is_dated_by_the_pictures_around_it() -> None:
    """Two pictures a second, none for 3 s in the middle."""
    data = slipped(recorded(2), 3.0, 10.4)
    kept = np.flatnonzero((data.vision_t < 9.0) | (data.vision_t > 12.0))[::10]
    finding = found(sparse(data, kept))[1]
    assert finding is not None
    assert finding.evidence["since_s"] < 9.0
    assert 12.0 < finding.evidence["time_s"] < 12.6


def step(jumped: bool = True, **of: float) -> StepEstimate:
    """A step of 1 deg that both tests show, with some numbers else."""
    numbers = {"size": 0.0175, "sigma": 1e-3, "fall": 300.0, "by_motion": 300.0, "apart": 1.0}
    numbers |= {"ratio": 1.0, "ratio_by_motion": 1.0} | of
    return StepEstimate(10.0, 9.9, {"helmet_mount_x": (numbers["size"], numbers["sigma"])}, **numbers, jumped=jumped)


def judged(*steps: StepEstimate) -> tuple[str, Severity] | None:
    finding = step_finding(steps, 60.0, [Quantity("helmet_mount_x", "rad", 0.35, 0.35, 1e-2)])
    return None if finding is None else (finding.kind, finding.severity)


def test_a_step_that_fits_worse_has_a_p_value() -> None:
    assert step_stability(step(fall=-0.5), 60.0).level == 1.0


def test_what_is_a_change_and_what_is_a_jump() -> None:
    assert judged(step()) == ("change", Severity.INCONSISTENT)
    assert judged(step(size=0.005)) == ("change", Severity.NOTE)
    assert judged(step(sigma=7e-3)) is None
    assert judged(step(fall=20.0, by_motion=20.0)) is None
    assert judged(step(ratio=4.0)) is None
    assert judged(step(by_motion=20.0)) == ("jump", Severity.WEAK)
    assert judged(step(by_motion=20.0, size=0.01)) == ("jump", Severity.NOTE)
    assert judged(step(by_motion=20.0, jumped=False)) is None
    assert judged(step(by_motion=20.0, size=0.005)) is None
    assert judged(step(by_motion=60.0, apart=30.0)) == ("jump", Severity.NOTE)
    assert judged(step(by_motion=60.0, apart=30.0, jumped=False)) is None
    assert judged(step(size=0.005), step(by_motion=20.0)) == ("jump", Severity.WEAK)
    assert judged(step(by_motion=60.0, apart=30.0, ratio=1.7, ratio_by_motion=1.7)) == ("jump", Severity.WEAK)


@pytest.mark.slow
def test_hardly_any_simulated_recording_is_called_changed() -> None:
    """At one in a thousand each, two of 40 are one in a thousand by chance."""
    called, largest = 0, []
    for seed in range(40):
        session = alidade.open(alidade.simulate("head", {"duration_s": 60.0, "gyro_rate_hz": 100.0}, seed))
        estimate = solve_batch(session.problem(), steps=True)
        assert estimate.steps is not None
        called += step_finding(estimate.steps, 60.0, session.problem().quantities) is not None
        largest.append(estimate.steps[0].statistic)
    assert called <= 1
    assert np.median(largest) < 12.0
