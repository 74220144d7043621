"""Priors with means: by hand, of an earlier calibration, and yesterday's result with today's recording."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

import alidade
from alidade import Config
from alidade.factors.array import Array
from alidade.factors.model import Model, Residuals
from alidade.pipelines.applications.cli import app
from alidade.pipelines.applications.sharing import walks
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.prior_replacement import with_priors
from alidade.pipelines.estimation.priors import prior_of
from alidade.pipelines.estimation.problem import Factor, Parameter, Problem, Quantity, Step
from alidade.pipelines.gaussian_prior import GaussianPrior, independent
from alidade.pipelines.methods import method
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental
from tests.support.one_graph import one_graph
from tests.support.short_problems import COARSE, head_problem

KNOWN = "noise_known: 0\n"
# Sigma by hand, and of what the recording says: about equal, so that both count.
MOUNT, SIGMA = np.array([0.06, -0.08, 0.03]), 1e-3


def as_stated(problem: Problem) -> Problem:
    """With the noise as stated: levels from the recording follow the priors a little, and all sigmas them."""
    noises = tuple(replace(level, noise=replace(level.noise, known=0.0)) for level in problem.noises)
    return replace(problem, noises=noises)


def believed(problem: Problem, sigma: float = SIGMA) -> Problem:
    names = [f"helmet_mount_{axis}" for axis in "xyz"]
    return with_priors(problem, [independent(names, MOUNT.tolist(), [sigma] * 3)])


def test_a_prior_from_elsewhere_is_no_data_sheets() -> None:
    """After --prior notes said that a number contradicts its data sheet."""
    known = with_priors(head_problem(), [independent(["gyro_scale_x"], [0.05], [1e-3])])
    found = {q.name: q for q in known.quantities}
    assert (found["gyro_scale_x"].sheet, found["gyro_scale_y"].sheet) == ("", "gyro.scale")


def test_a_prior_with_a_mean_is_a_measurement_of_it() -> None:
    """The posterior is that without the default prior, with another measurement: to first order the closed form."""
    problem = as_stated(head_problem())
    wide = with_priors(problem, [independent([f"helmet_mount_{a}" for a in "xyz"], [0.0] * 3, [1e2] * 3)])
    alone, both = solve_batch(wide), solve_batch(believed(problem))
    rows = [alone.names.index(f"helmet_mount_{axis}") for axis in "xyz"]
    # Where it agrees, nothing moves but the sigmas.
    agreeing = solve_batch(
        with_priors(problem, [independent([alone.names[i] for i in rows], alone.values[rows].tolist(), [SIGMA] * 3)])
    )
    expected = np.linalg.inv(np.linalg.inv(alone.covariance[np.ix_(rows, rows)]) + np.eye(3) / SIGMA**2)
    np.testing.assert_allclose(agreeing.values, alone.values, atol=1e-3 * alone.sigmas.min())
    np.testing.assert_allclose(agreeing.covariance[np.ix_(rows, rows)], expected, rtol=2e-3, atol=1e-12)
    assert (np.abs(both.values[rows] - MOUNT) < np.abs(alone.values[rows] - MOUNT)).all()


def test_a_sigma_of_zero_fixes_a_parameter_where_it_is_said_to_be() -> None:
    estimate = solve_batch(believed(as_stated(head_problem()), 0.0))
    rows = [estimate.names.index(f"helmet_mount_{axis}") for axis in "xyz"]
    np.testing.assert_allclose(estimate.values[rows], MOUNT, atol=1e-7)
    assert (estimate.sigmas[rows] == 0.0).all()


_SINGULAR = np.outer([1e-3, 2e-3, 1e-3], [1e-3, 2e-3, 1e-3])
NONSENSE: dict[str, tuple[GaussianPrior, str]] = {
    "a value of 1e300": (independent(["helmet_mount_x"], [1e300], [1e-3]), "far from anything"),
    "a value in microradians of a million": (independent(["helmet_mount_x"], [1e10], [1e-3]), "far from anything"),
    "a sigma of 1e150": (independent(["helmet_mount_x"], [0.0], [1e150]), "far from anything"),
    "a sigma of 1e-150": (independent(["helmet_mount_x"], [0.0], [1e-150]), "0 fixes it"),
    "a singular covariance": (
        GaussianPrior(("helmet_mount_x", "helmet_mount_y", "helmet_mount_z"), np.zeros(3), _SINGULAR, "x.json"),
        "x.json: the covariance is singular",
    ),
}


@pytest.mark.parametrize("case", NONSENSE)
def test_a_prior_of_which_no_solution_can_be_made_is_one_line(case: str) -> None:
    gaussian_prior, said = NONSENSE[case]
    with pytest.raises(InputError, match=said):
        with_priors(head_problem(), [gaussian_prior])


@pytest.mark.usefixtures("few_solutions")
def test_incremental_takes_the_same_prior() -> None:
    simulated = alidade.simulate("indexer", COARSE, seed=1)
    problem, truth = alidade.open(simulated).problem(), simulated.truth["theta_y"]
    problem = with_priors(problem, [independent(["theta_y"], [truth + 3e-6], [1e-7])])
    problem = as_stated(problem)
    batch, incremental = (solve(problem) for solve in (solve_batch, solve_incremental))
    row = batch.names.index("theta_y")
    assert abs(batch.values[row] - truth) > 2e-6  # the prior counts
    assert abs(incremental.values[row] - batch.values[row]) < 0.1 * batch.sigmas[row]
    assert incremental.sigmas[row] == pytest.approx(batch.sigmas[row], rel=0.05)


def test_the_rest_of_a_prior_of_several_numbers_stays() -> None:
    """time_offset shares its variable with clock skew and vision's scale, whose priors are as they were."""
    problem = as_stated(head_problem())
    before, after = (
        solve_batch(problem),
        solve_batch(with_priors(problem, [independent(["time_offset"], [0.004], [1e-6])])),
    )
    at = {name: i for i, name in enumerate(after.names)}
    assert after.values[at["time_offset"]] == pytest.approx(0.004, abs=3e-6)
    for name in ("vision_scale", "clock_skew"):
        assert after.sigmas[at[name]] <= before.sigmas[at[name]] * (1.0 + 1e-9)
        assert after.sigmas[at[name]] > 0.3 * before.sigmas[at[name]]


def test_what_is_fixed_today_stays_fixed_and_tells_of_the_others() -> None:
    """Believed together with another number: that one follows, as the belief conditioned on what is fixed."""
    names = ("helmet_mount_x", "camera_mount_x")
    tight = GaussianPrior(names, np.array([0.06, 0.02]), 1e-8 * np.array([[1.0, 0.99], [0.99, 1.0]]), "yesterday's")
    fixed = Config.model_validate({"priors": {"camera_mount_x": 0.0}})
    simulated = alidade.simulate("head", {"duration_s": 5.0, "vision_rate_hz": 10.0, "gyro_rate_hz": 100.0}, seed=1)
    session = alidade.open(simulated, config=fixed)
    estimate = solve_batch(with_priors(session.problem(), [tight]))
    value = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    assert value["camera_mount_x"] == pytest.approx(0.0, abs=1e-9)


@dataclass(frozen=True)
class Sum(Model):
    """Measurements of the sum of two numbers."""

    time: Array
    z: Array
    rows: int = 1
    blocks = (1, 1)

    def __call__(self, a: Array, b: Array) -> Residuals:
        return (a + b - self.z[:, None]) / 0.1, lambda: (np.full((len(a), 1, 1), 10.0),) * 2


FIRST, SECOND = (int(gtsam.symbol("p", i)) for i in range(2))


def _begins_twice() -> Problem:
    """A parameter that begins at 0 s and one that begins at 3 s; sums of both are measured from then on."""
    parameters = [
        Parameter(key, (Quantity(name, "", 1.0, 1.0, 0.1),)) for key, name in ((FIRST, "first"), (SECOND, "second"))
    ]

    def steps(_: int) -> Iterator[Step]:
        for k in range(6):
            values = gtsam.Values()
            factors = []
            for p in parameters:
                if k == 3 * (p.key == SECOND):
                    values.insert(p.key, np.zeros(1))
                    factors.append(prior_of(p))
            if k >= 3:
                seen = Sum(np.array([float(k)]), np.array([0.7]))
                factors.append(Factor.of("seen", seen.on(FIRST, SECOND)))
            yield Step(float(k), values, factors)

    return Problem(
        "two", tuple(parameters), steps, steps_after=lambda time: (step for step in steps(1) if step.time > time)
    )


def test_a_joint_prior_of_parameters_that_begin_in_different_steps() -> None:
    mean, covariance = np.array([0.3, -0.2]), np.array([[0.04, 0.03], [0.03, 0.09]])
    problem = with_priors(_begins_twice(), [GaussianPrior(("first", "second"), mean, covariance)])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for step in problem.steps(1):
        values.insert(step.initial)
        for f in step.factors:
            graph.add(f.factor)
    solved = values.retract(graph.linearize(values).optimize())
    information = np.linalg.inv(covariance) + 300.0 * np.ones((2, 2))
    expected = np.linalg.solve(information, np.linalg.solve(covariance, mean) + 300.0 * 0.7 * np.ones(2))
    np.testing.assert_allclose([solved.atVector(key)[0] for key in (FIRST, SECOND)], expected, atol=1e-9)
    joint = gtsam.Marginals(graph, solved).jointMarginalInformation([FIRST, SECOND]).fullMatrix()
    np.testing.assert_allclose(joint, information, atol=1e-6)


def test_a_joint_prior_in_the_later_steps_of_a_recording_that_grows() -> None:
    """Its second half is the conditional of what begins, given what began before."""
    gaussian_prior = GaussianPrior(("first", "second"), np.zeros(2), np.array([[0.04, 0.03], [0.03, 0.09]]))
    problem = with_priors(_begins_twice(), [gaussian_prior])
    assert problem.steps_after is not None
    whole, late = list(problem.steps(1))[3], next(problem.steps_after(2.0))
    values = gtsam.Values(late.initial)
    values.insert(FIRST, np.array([0.1]))
    for step in (whole, late):
        (prior,) = (f.factor for f in step.factors if f.family == "prior")
        variance = 0.09 - 0.03**2 / 0.04
        assert 2.0 * prior.error(values) == pytest.approx((0.75 * 0.1) ** 2 / variance)


CASES: dict[str, tuple[dict[str, Any] | None, str, float]] = {
    "indexer": (COARSE, "sensors: ideal", 1e-6),
    "head": (None, "sensors: ideal", 1e-6),
    "indexer assumptions": (COARSE, "", 1e-3),
}


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (case != "indexer assumptions")) for case in CASES]
)
def test_yesterdays_result_with_todays_recording_is_both_together(case: str, tmp_path: Path) -> None:
    """Against both in one graph, whose only difference is where the first recording is linearised."""
    name = case.split()[0]
    scenario, more, tolerance = CASES[case]
    config = load_config((KNOWN + more).encode())
    first, second = (alidade.open(alidade.simulate(name, scenario, seed=seed), config=config) for seed in (1, 2))
    shared = walks(first.method, first.config, [q.name for q in first.problem().quantities])
    both = solve_batch(one_graph([first.problem(), second.problem()], shared))
    first.calibrate().write(tmp_path)
    recursive = second.beginning_from(tmp_path / "result.json").calibrate(report=False).estimate
    for i, known in enumerate(recursive.names):
        of = both.names.index(known if known in shared else f"{known}@1")
        if recursive.sigmas[i] > 0.0:
            assert abs(recursive.values[i] - both.values[of]) < tolerance * both.sigmas[of], known
            assert recursive.sigmas[i] == pytest.approx(both.sigmas[of], rel=max(tolerance, 1e-6)), known


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> tuple[Calibration, Path]:
    folder = tmp_path_factory.mktemp("earlier")
    found = alidade.calibrate(alidade.simulate("indexer", COARSE, seed=1))
    found.write(folder)
    return found, folder


@pytest.fixture(scope="module")
def today(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("today")
    recording, scenario = folder / "today.mcap", folder / "coarse.yaml"
    scenario.write_text(json.dumps(COARSE))
    arguments = ["--scenario", str(scenario), "--seed", "2", "--out", str(recording)]
    CliRunner().invoke(app, ["simulate", "indexer", *arguments])
    return recording


@pytest.mark.parametrize("file", ["result.json", "calibration.yaml"])
def test_the_command_begins_from_an_earlier_calibration(
    earlier: tuple[Calibration, Path], today: Path, file: str, tmp_path: Path
) -> None:
    arguments = ["calibrate", str(today), "--prior", str(earlier[1] / file), "--json", "--out", str(tmp_path / "o")]
    ended = CliRunner().invoke(app, arguments)
    assert ended.exit_code == 0, ended.output
    result = json.loads(ended.stdout)
    found = {p["name"]: p for p in result["parameters"]}
    before = earlier[0].parameters
    assert found["theta_y"]["prior_mean"] == pytest.approx(before["theta_y"].value, rel=1e-11)
    assert found["theta_y"]["prior_sigma"] == pytest.approx(before["theta_y"].sigma, rel=1e-6)
    assert found["theta_y"]["sigma"] < 0.9 * before["theta_y"].sigma
    assert found["gyro_bias_x"]["prior_sigma"] == 1e-3  # the recording's own
    assert any(f"is that of {file}, of 2026-" in note for note in result["notes"])


def test_what_walks_is_known_less_well_after_a_while(earlier: tuple[Calibration, Path]) -> None:
    simulated = alidade.simulate("indexer", COARSE, seed=2)
    rate = 1e-5
    config = load_config(simulated.config.encode(), load_config(f"share: {{theta_*: {rate}}}".encode()))
    session = alidade.open(simulated, config=config)
    # A hundred days later.
    later = replace(session.data, epoch_ns=session.data.epoch_ns + 8_640_000 * 10**9)
    session = alidade.open(later, method="indexer", config=config, prior=earlier[1] / "result.json")
    prior = next(q.prior_sigma for q in session.problem().quantities if q.name == "theta_y")
    assert prior == pytest.approx(np.hypot(earlier[0].parameters["theta_y"].sigma, 10.0 * rate), rel=1e-6)


def test_how_far_it_walks_is_not_told_by_one_recording(earlier: tuple[Calibration, Path]) -> None:
    config = load_config(b"share: {theta_*: walks}")
    with pytest.raises(InputError, match="how far theta_x walks, only several recordings together determine it"):
        alidade.open(alidade.simulate("indexer", COARSE, seed=2), config=config, prior=earlier[1] / "result.json")


def test_what_the_config_says_of_a_prior_goes_before_an_earlier_calibration(earlier: tuple[Calibration, Path]) -> None:
    config = load_config(b"priors: {theta_y: 0.1, theta_z: {mean: 0.001, sigma: 0.01}}")
    session = alidade.open(alidade.simulate("indexer", COARSE, seed=2), config=config, prior=earlier[1] / "result.json")
    priors = {q.name: (q.prior_mean, q.prior_sigma) for q in session.problem().quantities}
    assert priors["theta_y"] == (0.0, 0.1)
    assert priors["theta_z"] == (0.001, 0.01)
    assert priors["theta_x"][1] == pytest.approx(earlier[0].parameters["theta_x"].sigma)


def test_unusable_priors_are_told_in_one_line(earlier: tuple[Calibration, Path], tmp_path: Path) -> None:
    again = alidade.simulate("indexer", COARSE, seed=1)
    with pytest.raises(InputError, match="was made of this very recording"):
        alidade.open(again, prior=earlier[1] / "result.json")
    with pytest.raises(InputError, match="is a calibration of indexer, not of head"):
        alidade.open(alidade.simulate("head", {"duration_s": 5.0}), prior=earlier[1] / "calibration.yaml")
    with pytest.raises(InputError, match="cannot be opened"):
        alidade.open(again, prior=tmp_path / "none.json")
    broken = json.loads((earlier[1] / "result.json").read_text())
    broken["covariance"]["matrix"][0][0] *= -1.0
    (tmp_path / "broken.json").write_text(json.dumps(broken))
    with pytest.raises(InputError, match="its covariance is none"):
        alidade.open(again, prior=tmp_path / "broken.json")
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(InputError, match=r"not a result\.json: schema"):
        alidade.open(again, prior=tmp_path / "other.json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("priors: {theta_x: {mean: 0.1}}", r"priors\.theta_x\.sigma: is missing"),
        (
            "priors: {theta_x: {meen: 0.1, sigma: 1}}",
            r"unknown key priors\.theta_x\.meen; the nearest known key is mean",
        ),
        ("share: {theta_x: often}", r"share\.theta_x: must be device, recording, walks, or how far it walks"),
        ("share: {theta_x: -1}", r"share\.theta_x: must be device"),
    ],
)
def test_priors_and_shares_that_mean_nothing(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_config(text.encode())


def test_a_mean_for_what_the_graph_leaves_out_is_refused() -> None:
    config = load_config(b"priors: {axis_nonperpendicularity: {mean: 1.0e-4, sigma: 0}}")
    with pytest.raises(InputError, match=r"priors\.axis_nonperpendicularity: where it is fixed"):
        alidade.open(alidade.simulate("indexer", COARSE, seed=1), config=config).problem()


def test_methods_say_what_belongs_to_a_recording() -> None:
    own = {
        "los": {"gyro_bias_x", "time_offset", "target_rate_x"},
        "indexer": {"gyro_bias_z"},
        "head": {"gyro_bias_y", "time_offset", "platform_bias_x"},
        "cube": {"gyro_b1", "field_n"},
    }
    for name, recordings in own.items():
        names = [*recordings, "theta_x", "camera_mount_y", "gyro_k11", "delta_px"]
        assert set(names) - walks(method(name), Config(), names).keys() == recordings, name
    names = ["gyro_bias_x", "gyro_bias_y"]
    assert walks(method("head"), load_config(b"share: {'gyro_bias_*': device, gyro_bias_y: 0.1}"), names) == {
        "gyro_bias_x": 0.0,
        "gyro_bias_y": 0.1,
    }
    with pytest.raises(InputError, match=r"unknown key share\.gyro_bia; the nearest known key is gyro_bias"):
        walks(method("head"), load_config(b"share: {gyro_bia: device}"), names)


@pytest.mark.slow
def test_compare_and_follow_begin_from_an_earlier_calibration(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text("{duration_s: 3.0, sensors: ideal, vision_rate_hz: 10, gyro_rate_hz: 100}")
    for seed, name in enumerate(("before", "today")):
        scenario = ["--scenario", str(tmp_path / "short.yaml"), "--out", str(tmp_path / f"{name}.mcap")]
        CliRunner().invoke(app, ["simulate", "head", "--seed", str(seed), *scenario])
    CliRunner().invoke(app, ["calibrate", str(tmp_path / "before.mcap"), "--out", str(tmp_path / "before")])
    prior = tmp_path / "before" / "result.json"
    earlier = {p["name"]: p for p in json.loads(prior.read_text())["parameters"]}["helmet_mount_x"]

    def found(*arguments: object) -> list[dict[str, float]]:
        ended = CliRunner().invoke(app, [*map(str, arguments), "--prior", str(prior), "--json"])
        said = json.loads(ended.stdout)
        return [
            next(p for p in each["parameters"] if p["name"] == "helmet_mount_x")
            for each in (said if isinstance(said, list) else [said])
            if each["solver"] != "published"
        ]

    today = tmp_path / "today.mcap"
    followed = found("follow", today, "--no-check", "--out", tmp_path / "out")
    for p in [*found("compare", today), *followed]:
        assert p["prior_mean"] == pytest.approx(earlier["value"], rel=1e-11)
        assert p["sigma"] < 0.9 * earlier["sigma"]
    ended = CliRunner().invoke(app, ["follow", str(today), "--prior", str(tmp_path / "none.json")])
    assert "none.json: cannot be opened" in str(ended.exception)
