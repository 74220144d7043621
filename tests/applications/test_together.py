"""Several recordings of one device as one calibration."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import alidade
from alidade import Config
from alidade.factors.array import Array
from alidade.pipelines.applications import joint as together
from alidade.pipelines.applications.cli import app
from alidade.pipelines.applications.fleet.statistics import mean_nees
from alidade.pipelines.applications.joint import calibrate_together
from alidade.pipelines.applications.session import Session
from alidade.pipelines.applications.sharing import walks
from alidade.pipelines.config import load_config
from alidade.pipelines.display.figure import Plot
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Severity
from alidade.pipelines.estimation.problem import SqrtInformation
from alidade.pipelines.estimation.widening import marginalised
from alidade.pipelines.methods import method
from alidade.pipelines.recording.opening import group_recordings
from alidade.pipelines.reports.joint_report import forecasts, recording_blocks
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.solvers.freed import information_at
from alidade.pipelines.solvers.joint import join
from tests.support.broad_trials import TRIALS, converted
from tests.support.one_graph import one_graph, solved
from tests.support.short_problems import FOUR_POSITIONS

COARSE = {"gyro_rate_hz": 20.0, "encoder_rate_hz": 20.0, **FOUR_POSITIONS}
EXACT = "noise_known: 0\nsensors: ideal\n"


def sessions(name: str, seeds: Sequence[int], config: str, scenario: object = None) -> list[Session]:
    settings = load_config(config.encode())
    return [alidade.open(alidade.simulate(name, scenario, seed=seed), config=settings) for seed in seeds]  # type: ignore[arg-type]


def jointly(opened: Sequence[Session]) -> Calibration:
    return calibrate_together([partial(lambda session: session, each) for each in opened])


TURNING = {
    "helmet_mount_deg": [3.0, -4.0, 2.0],
    "camera_mount_deg": [-1.0, 2.0, 1.5],
    "priors": {},
    "platform": {
        "yaw": [{"amplitude_deg": 20, "frequency_hz": 0.25}],
        "pitch": [{"amplitude_deg": 8, "frequency_hz": 0.31}],
        "roll": [{"amplitude_deg": 12, "frequency_hz": 0.17}],
    },
}
# Wide enough that the recordings alone decide.
WIDE = EXACT + "priors: {theta_x: 10.0, theta_y: 10.0, theta_z: 10.0}\n"
CASES = {
    "indexer, ideal": ("indexer", EXACT, COARSE),
    "indexer": ("indexer", "noise_known: 0", None),
    "head with mounts, ideal": ("head", EXACT, {"duration_s": 12.0, **TURNING}),
    "head, its clock the device's": (
        "head",
        # One graph has no noise beside what factors are whitened by, and no errors by the attitude.
        "noise_known: 0\nnoise: {gyro_rate_noise: 0}\nsensors: {camera: {map: 0}}\n"
        "share: {time_offset: device, clock_skew: device, 'platform_bias_*': device}",
        {"duration_s": 20.0, "vision_rate_hz": 15.0, **TURNING},
    ),
}
SLOW = ("indexer", "head with mounts, ideal", "head, its clock the device's")


@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.slow] * (case in SLOW)) for case in CASES])
def test_it_is_one_big_graph(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """To 1e-6 sigmas at fixed noise levels, the device's numbers and those of the last recording, and their sigmas."""
    monkeypatch.setattr(together, "_STAYS", 1e-7)
    name, config, scenario = CASES[case]
    opened = sessions(name, [1, 2, 3], config, scenario)
    problems = [each.problem() for each in opened]
    shared = walks(opened[0].method, opened[0].config, [q.name for q in problems[0].quantities])
    values, sigmas = solved(one_graph(problems, shared))
    found = jointly(opened).parameters
    for p in found.values():
        one = p.name if p.name in shared else f"{p.name}@2"
        if p.sigma > 0.0:
            assert abs(p.value - values[one]) < 1e-6 * sigmas[one], p.name
            assert p.sigma == pytest.approx(p.inflation * sigmas[one], rel=1e-6), p.name
    assert found.keys() == {q.name for q in problems[0].quantities}


@pytest.mark.slow
def test_once_linearised_anew_it_is_as_good_as_that() -> None:
    opened = sessions("indexer", [1, 2, 3], "noise_known: 0")
    values, sigmas = solved(
        one_graph([each.problem() for each in opened], walks(opened[0].method, Config(), _names(opened[0])))
    )
    for p in jointly(opened).parameters.values():
        if p.name in values and not p.name.startswith("gyro_bias"):
            assert abs(p.value - values[p.name]) < 1e-3 * sigmas[p.name]


def _names(session: Session) -> list[str]:
    return [q.name for q in session.problem().quantities]


def test_one_recording_together_with_none_is_as_it_was() -> None:
    (one,) = sessions("head", [1], "")
    estimate = jointly([one]).estimate
    np.testing.assert_allclose(estimate.sigmas, one.calibrate("batch").estimate.sigmas, rtol=1e-6)
    assert estimate.converged
    assert "moved last by 0 sigmas" in estimate.message


def _saturating(shared_data: Path) -> Session:
    """A real gyro that saturates; 1 % of its pictures are outliers at the noise found, a hundredth of the default."""
    return alidade.open(shared_data / "repoimu" / "tstick_05.mcap", "head")


def test_linearised_again_about_its_own_solution_a_recording_says_the_same(shared_data: Path) -> None:
    """Of a real one with outliers, disturbed pictures and widened noise, a joint estimate needs no second look."""
    session = _saturating(shared_data)
    start, _ = session.method.faults.span(session.data)
    session = replace(session, data=session.method.faults.segment(session.data, start, start + 40.0), recording=None)
    calibration = session.calibrated_beside(lambda _: {})
    first = calibration.estimate.sqrt_info
    assert first is not None
    estimate = calibration.estimate
    assert first.added is not None  # errors of vision by the attitude
    again = marginalised(information_at(session.problem(), estimate, _names(session)), first.added)
    both = [each.R.T @ each.R + each.prior_R.T @ each.prior_R for each in (first, again)]
    one, other = (np.sqrt(np.diag(np.linalg.inv(each))) for each in both)
    np.testing.assert_allclose(other, one, rtol=1e-3)
    before, after = (
        np.linalg.solve(information, each.R.T @ each.d + each.prior_R.T @ each.prior_d)
        for information, each in zip(both, (first, again), strict=True)
    )
    assert (np.abs(after - before) < 0.05 * one).all()


@pytest.mark.slow
def test_halves_of_a_real_recording_are_jointly_what_it_is_as_a_whole(shared_data: Path) -> None:
    """Solved anew at the noise found, other pictures were rejected and the scale moved by 20 sigmas: no solution."""
    session = _saturating(shared_data)
    faults = session.method.faults
    start, stop = faults.span(session.data)
    middle = 0.5 * (start + stop)
    parts = (faults.segment(session.data, *part) for part in ((start, middle), (middle, stop + 1.0)))
    joint, whole = jointly([replace(session, data=part, recording=None) for part in parts]), session.calibrate("batch")
    assert joint.estimate.converged, joint.headline
    for axis in "xyz":
        mount, known = (each.parameters[f"helmet_mount_{axis}"] for each in (joint, whole))
        assert abs(mount.value - known.value) < known.sigma
        # The halves' widening is of fewer blocks of 5 s.
        assert mount.sigma == pytest.approx(known.sigma, rel=0.5)


@pytest.mark.slow
def test_five_recordings_make_sigmas_smaller_by_their_root() -> None:
    """With ideal sensors and wide priors, of what is shared; what belongs to a recording stays nearly as it is."""
    opened = sessions("indexer", range(5), WIDE)
    one, five = opened[0].calibrate().parameters, jointly(opened).parameters
    for axis in "xyz":
        assert five[f"theta_{axis}"].sigma * 5**0.5 == pytest.approx(one[f"theta_{axis}"].sigma, rel=2e-3)
        assert five[f"gyro_bias_{axis}"].sigma == pytest.approx(one[f"gyro_bias_{axis}"].sigma, rel=0.05)


@pytest.mark.slow
def test_one_after_the_other_it_is_the_same(tmp_path: Path) -> None:
    """Each recording with the result of those before it as prior."""
    opened = sessions("indexer", range(4), EXACT)
    opened[0].calibrate().write(tmp_path)
    for session in opened[1:]:
        last = session.beginning_from(tmp_path / "result.json").calibrate(report=False)
        last.write(tmp_path)
    both = jointly(opened).parameters
    for p in last.parameters.values():
        assert abs(p.value - both[p.name].value) < 1e-6 * p.sigma, p.name
        assert p.sigma == pytest.approx(both[p.name].sigma, rel=1e-6)


@pytest.mark.slow
def test_errors_are_as_large_as_their_covariance_says() -> None:
    """NEES of the device's parameters over histories of five recordings each lies in its interval."""
    squares, freedoms = [], []
    for history in range(25):
        seeds = range(100 + 5 * history, 105 + 5 * history)
        simulated = [alidade.simulate("head", {"duration_s": 8.0, **TURNING}, seed=seed) for seed in seeds]
        opened = [alidade.open(each, config=load_config(EXACT.encode())) for each in simulated]
        found = jointly(opened)
        kept = [i for i, name in enumerate(found.estimate.names) if "mount" in name and found.estimate.sigmas[i] > 0.0]
        truth = np.array([simulated[0].truth[found.estimate.names[i]] for i in kept], dtype=float)
        error = found.estimate.values[kept] - truth
        squares.append(float(error @ np.linalg.solve(found.covariance[np.ix_(kept, kept)], error)))
        freedoms.append(float(len(kept)))
    nees = mean_nees(np.array(squares), np.array(freedoms))
    assert nees.consistent, nees


def linear(rng: np.random.Generator, names: tuple[str, ...], truth: Array, device: int) -> SqrtInformation:
    """A recording that says something of its numbers, those of the device first; the estimate is anywhere."""
    n = len(names)
    R, at = rng.standard_normal((n, n)) + 2.0 * np.eye(n), rng.standard_normal(n)
    d = R @ (truth - at) + rng.standard_normal(n)
    prior = np.eye(n)[:device] / 3.0
    return SqrtInformation(names, at, R, d, prior, -prior @ at, np.ones(n))


def test_joining_is_least_squares_of_everything() -> None:
    """Two numbers of the device, one that walks, one of the recording: against all unknowns in one system."""
    rng, names, days = np.random.default_rng(3), ("a", "b", "walking", "own"), [0.0, 4.0, 13.0]
    rates = {"a": 0.0, "b": 0.0, "walking": 0.2}
    sqrt_info = [linear(rng, names, np.array([1.0, -1.0, 0.5, i]), 3) for i in range(3)]
    joined = join(sqrt_info, rates, days)
    # Unknowns: a, b, then walking and own of each recording.
    rows, rights = [], []
    for i, each in enumerate(sqrt_info):
        place = np.zeros((4, 8))
        place[[0, 1, 2, 3], [0, 1, 2 + 2 * i, 3 + 2 * i]] = 1.0
        rows.append(each.R @ place)
        rights.append(each.d + each.R @ each.at)
        if i == 0:
            rows.append(each.prior_R @ place)
            rights.append(np.zeros(3))
        else:
            step = np.zeros((1, 8))
            step[0, [2 + 2 * i, 2 * i]] = np.array([1.0, -1.0]) / (0.2 * (days[i] - days[i - 1]) ** 0.5)
            rows.append(step)
            rights.append(np.zeros(1))
    A, b = np.concatenate(rows), np.concatenate(rights)
    x, P = np.linalg.solve(A.T @ A, A.T @ b), np.linalg.inv(A.T @ A)
    for i in range(3):
        at = [0, 1, 2 + 2 * i, 3 + 2 * i]
        gaussian_prior = joined.all(i)
        assert gaussian_prior.names == names
        np.testing.assert_allclose(gaussian_prior.mean, x[at], atol=1e-10)
        np.testing.assert_allclose(gaussian_prior.covariance, P[np.ix_(at, at)], atol=1e-10)


def test_the_variance_is_told_by_source() -> None:
    """Of each source the share that the variance falls by when its rows alone have no noise, to first order."""
    rng = np.random.default_rng(3)
    tellings = [linear(rng, ("a", "b", "own"), np.array([1.0, 2.0, 3.0]), 2) for _ in range(3)]
    joined = join(tellings, {"a": 0.0, "b": 0.1}, [0.0, 10.0, 30.0])
    budget = joined.budget(2, ["x", "y", "z"])
    known = joined.all(2)
    assert set(budget) == set(known.names)
    assert all(sum(shares.values()) == pytest.approx(1.0) for shares in budget.values())
    assert set(budget["b"]) >= {"recording x", "recording y", "recording z", "walk between recordings"}
    # Drawn: what scatters when the noise of one recording alone is drawn anew.
    share = budget["own"]["recording z"]
    drawn = []
    for _ in range(1000):
        other = replace(tellings[2], d=tellings[2].d + rng.standard_normal(len(tellings[2].d)))
        again = join([*tellings[:2], other], {"a": 0.0, "b": 0.1}, [0.0, 10.0, 30.0]).all(2)
        drawn.append(again.mean[again.names.index("own")])
    assert np.var(drawn) / known.sigmas[known.names.index("own")] ** 2 == pytest.approx(share, rel=0.15)


@pytest.mark.slow
def test_many_recordings_are_solved_once_each_in_the_memory_of_one() -> None:
    """One in ten a second time at most, and hardly more memory; in a process of its own for both."""
    count, again, memory = 30, {}, {}
    for how in ("alone", "together"):
        done = subprocess.run([sys.executable, "-c", MANY, how, str(count)], capture_output=True, text=True, check=True)
        again[how], memory[how] = map(float, done.stdout.split()[-2:])
    assert again["together"] <= 0.1 * count
    assert memory["together"] < memory["alone"] + 60.0


MANY = """
import resource, sys
from unittest.mock import patch
import alidade
from alidade.pipelines.applications import joint as together

how, count = sys.argv[1], int(sys.argv[2])
made = [alidade.simulate("indexer", None, seed=seed) for seed in range(count)]
with patch.object(together, "_again", wraps=together._again) as again:
    alidade.calibrate(made) if how == "together" else [alidade.calibrate(each) for each in made]
print(again.call_count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
"""


def test_recordings_that_are_of_another_device_are_told() -> None:
    opened = sessions("indexer", [1, 2], EXACT, COARSE)
    moved = alidade.simulate("indexer", {**COARSE, "mounting_deg": [0.5, -0.3 - 1.02 / 3600.0, 0.4]}, seed=3)
    opened.append(alidade.open(moved, config=load_config(EXACT.encode())))
    found = jointly(opened)
    assert found.status == "inconsistent"
    (step,) = [finding.evidence for finding in found.findings if finding.kind == "device_change"]
    assert step["parameter"] == "theta_y"
    assert step["step"] < -4.0 * step["sigma"]
    assert "Change of the device between arrays and arrays: theta_y by -" in found.headline
    # What is reported is the device at the last recording, not a mean of both sides.
    last = opened[-1].calibrate("batch", report=False).parameters
    for axis in "xyz":
        p = found.parameters[f"theta_{axis}"]
        assert abs(p.value - last[p.name].value) < 3.0 * last[p.name].sigma
    assert found.parameters["theta_y"].sigma == pytest.approx(last["theta_y"].sigma, rel=0.05)
    assert {finding.kind for finding in found.findings if finding.severity > Severity.NOTE} == {"device_change"}


def test_a_step_of_what_is_not_required_is_a_note() -> None:
    """A gyro's scale that changed by 2 %: mounts and bias are estimated beside it."""
    rates = {"gyro_rate_hz": 100.0, "platform_gyro_rate_hz": 50.0, "vision_rate_hz": 10.0, "duration_s": 30.0}
    scenario = method("head").settings("head_mounts").model_dump() | rates
    first, second = (alidade.simulate("head", scenario, seed=seed) for seed in (1, 2))
    scaled = replace(second.data, head_gyro=second.data.head_gyro * [1.02, 1.0, 1.0])
    found = jointly([alidade.open(first), alidade.open(replace(second, data=scaled))])
    assert found.status == "calibrated"
    assert any("Change of the device between arrays and arrays: gyro_scale_x by 1." in note for note in found.notes)
    truth = first.truth
    mounts = [p for name, p in found.parameters.items() if "mount" in name and p.sigma > 0.0]
    assert mounts
    assert all(abs(p.value - float(str(truth[p.name]))) < 3.5 * p.sigma for p in mounts)


@pytest.mark.slow
def test_a_joint_estimate_is_tested_for_prior_conflicts() -> None:
    """Each of two recordings contradicts the gyro's data sheet: so does the joint estimate, and says so itself.

    By ten sigmas: thirty are less likely than a gyro with three hundred times the noise, and that is what is said then.
    """
    short = {"duration_s": 20.0, "gyro_rate_hz": 50.0, "vision_rate_hz": 10.0}
    opened = []
    for seed in (1, 2):
        data = alidade.simulate("head", short, seed=seed).data
        scaled = replace(data, head_gyro=data.head_gyro * [1.1, 1.0, 1.0])
        opened.append(alidade.open(scaled, method="head"))
    found = jointly(opened)
    assert found.status == "inconsistent"
    own = [finding for finding in found.findings if finding.kind == "prior_conflict"]
    assert own[0].evidence["parameter"] == "gyro_scale_x"
    assert own[0].severity == Severity.INCONSISTENT
    of_recordings = [finding.evidence for finding in found.findings if finding.kind == "recording"]
    assert len(of_recordings) == 2
    assert all(each["findings"][0].evidence["parameter"] == "gyro_scale_x" for each in of_recordings)
    assert {level.noise.name for level in found.estimate.levels} == {level.noise.name for level in found.problem.noises}


@pytest.mark.slow
def test_a_list_of_sources_is_calibrated_together() -> None:
    simulated = [alidade.simulate("indexer", COARSE, seed=seed) for seed in (1, 2)]
    found = alidade.calibrate(simulated, config=load_config(EXACT.encode()))
    assert len(found.recordings) == 2
    assert found.status == "calibrated"
    with pytest.raises(InputError, match="together by batch alone"):
        alidade.calibrate(simulated, "incremental")


@pytest.mark.slow
def test_what_walks_has_a_number_for_each_recording() -> None:
    """A month apart, with a step between the first and the others that the walk allows for."""
    walking = EXACT + "share: {'theta_*': 1.0e-6}\n"
    opened = []
    for month, arcsec in enumerate((0.0, 0.5, 0.5)):
        simulated = alidade.simulate(
            "indexer", {**COARSE, "mounting_deg": [0.5, -0.3 - arcsec / 3600.0, 0.4]}, seed=month
        )
        later = replace(simulated.data, epoch_ns=simulated.data.epoch_ns + month * 30 * 86_400 * 10**9)
        opened.append(alidade.open(later, method="indexer", config=load_config(walking.encode())))
    found = jointly(opened)
    assert found.status == "calibrated"
    by_date = [{p.name: p for p in part.parameters}["theta_y"] for part in found.recordings]
    truth = [np.deg2rad(-0.3 - arcsec / 3600.0) for arcsec in (0.0, 0.5, 0.5)]
    for each, true in zip(by_date, truth, strict=True):
        assert abs(each.value - true) < 4.0 * each.sigma
    assert found.parameters["theta_y"].value == by_date[-1].value
    assert not found.changes or "theta_y" not in {step.name for step in found.changes.steps}


@pytest.mark.slow
def test_how_far_it_walks_is_told_by_the_recordings() -> None:
    """Eight of an IMU whose mounting walks 2 arcsec in a month: no change that is found, but a rate and a forecast."""
    rng, mounting, opened = np.random.default_rng(8), np.array([0.5, -0.3, 0.4]), []
    rate = np.deg2rad(2.0 / 3600.0) / 30.0**0.5
    for seed in range(8):
        simulated = alidade.simulate("indexer", {**COARSE, "mounting_deg": mounting.tolist()}, seed=seed)
        config = load_config(simulated.config.encode(), load_config(b"sensors: ideal\nshare: {theta_*: walks}"))
        later = replace(simulated.data, epoch_ns=simulated.data.epoch_ns + seed * 30 * 86_400 * 10**9)
        opened.append(alidade.open(later, method="indexer", config=config))
        mounting = mounting + 2.0 / 3600.0 * rng.standard_normal(3)
    found = jointly(opened)
    assert found.status == "calibrated", found.headline
    assert found.changes is not None
    assert found.changes.rates["theta"].rate == pytest.approx(rate, rel=0.5)
    assert found.changes.rates["theta"].upper > rate
    own = [next(p for p in part.parameters if p.name == "theta_y") for part in found.recordings]
    assert len({p.value for p in own}) == 8
    (sqrt_info,) = [text for name, text in forecasts(found) if name == "theta_y"]
    assert "within what is required for" in sqrt_info
    (shown,) = [each for each in recording_blocks(found) if isinstance(each, Plot) and each.title.startswith("theta")]
    (band,) = [mark for mark in shown.figure.named("theta_y") if mark.kind == "band"]
    # From the first recording on, and on beyond the last, ever wider.
    assert len(band.x) > 8
    assert (np.diff(band.columns["high"][8:]) > 0.0).all()


@pytest.mark.slow
def test_real_trials_agree_or_are_named(shared_data: Path, tmp_path: Path) -> None:
    """Three trials of one helmet tracker's stand-in: the slow one saw another mount and scale, and is named for it."""
    for name in TRIALS:
        converted(shared_data / "broad" / f"{name}.mat", tmp_path / f"{name[:2]}.mcap")
    paths = [tmp_path / f"{name[:2]}.mcap" for name in TRIALS]
    both = alidade.calibrate(paths, config=load_config(b"share: {time_offset: device}"))
    assert both.status == "inconsistent"
    steps = [finding.evidence for finding in both.findings if finding.kind == "device_change"]
    assert any("helmet_mount" in e["parameter"] and e["recordings"] == ("01.mcap", "07.mcap") for e in steps)
    assert both.parameters["time_offset"].value == pytest.approx(4.2e-3, abs=0.1e-3)
    agreeing = alidade.calibrate(paths[1:], config=load_config(b"share: {time_offset: device}"))
    assert not [step for step in agreeing.changes.found if "mount" in step.name or step.name == "time_offset"]  # type: ignore[union-attr]


@pytest.mark.slow
def test_a_recording_that_does_not_fit_is_named() -> None:
    opened = sessions("indexer", [1, 2], EXACT)
    wrong = alidade.simulate("indexer", None, seed=3)
    louder = load_config((EXACT + "noise: {gyro_density: 1.0e-9, encoder: 1.0e-8}").encode())
    opened.append(alidade.open(wrong, config=louder))
    found = jointly(opened)
    assert found.status == "inconsistent"
    assert "by itself:" in found.headline


def test_the_command_takes_several_recordings(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.mcap" for name in ("march", "june")]
    scenario = tmp_path / "coarse.yaml"
    scenario.write_text(json.dumps({**COARSE, "sensors": "ideal"}))
    for seed, path in enumerate(paths, 1):
        how = ["--scenario", str(scenario), "--seed", str(seed), "--out", str(path)]
        CliRunner().invoke(app, ["simulate", "indexer", *how])
    out = tmp_path / "out"
    ended = CliRunner().invoke(app, ["calibrate", *map(str, paths), "--out", str(out)])
    assert ended.exit_code == 0, ended.output
    assert "2 recordings of one device: march.mcap, june.mcap" in ended.output
    result = json.loads((out / "result.json").read_text())
    assert [part["recording"] for part in result["recordings"]] == ["march.mcap", "june.mcap"]
    assert all(part["dof"] > 100.0 for part in result["recordings"])
    assert set(result["budget"]["theta_y"]) >= {"recording march.mcap", "recording june.mcap", "prior of theta_y"}
    assert sum(result["budget"]["theta_y"].values()) == pytest.approx(1.0)
    own = [{p["name"]: p["value"] for p in part["parameters"]} for part in result["recordings"]]
    assert own[0].keys() == {"gyro_bias_x", "gyro_bias_y", "gyro_bias_z"}
    assert own[0]["gyro_bias_x"] != own[1]["gyro_bias_x"]
    first = json.loads((out / "recordings" / "march" / "result.json").read_text())
    sigma = {p["name"]: p["sigma"] for p in first["parameters"]}
    joint = {p["name"]: p["sigma"] for p in result["parameters"]}
    assert joint["theta_y"] < 0.8 * sigma["theta_y"]
    page = (out / "report.html").read_text()
    assert "march.mcap" in page
    assert "What each recording has of its own" in page
    assert "recording june.mcap" in page
    twice = CliRunner().invoke(app, ["calibrate", str(paths[0]), str(paths[0]), "--out", str(tmp_path / "no")])
    assert isinstance(twice.exception, InputError)
    assert "named twice" in str(twice.exception)
    assert not (tmp_path / "no").exists()
    other = CliRunner().invoke(app, ["calibrate", *map(str, paths), "--solver", "incremental"])
    assert isinstance(other.exception, InputError)
    assert "together by batch alone" in str(other.exception)


def test_parts_of_one_bag_are_one_recording(tmp_path: Path) -> None:
    names = ["ride_0.mcap", "ride_1.mcap", "other.mcap"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    text = "rosbag2_bagfile_information: {relative_file_paths: [ride_0.mcap, ride_1.mcap]}"
    (tmp_path / "metadata.yaml").write_text(text)
    paths = [tmp_path / name for name in names]
    assert group_recordings(paths) == [paths[:2], paths[2]]
    assert group_recordings([Path(), Path("/")]) == [Path(), Path("/")]
    shutil.rmtree(tmp_path)
    assert group_recordings([tmp_path / "a*.mcap", tmp_path]) == [tmp_path / "a*.mcap", tmp_path]
