"""Monte Carlo studies: same seeds, same numbers; files; bad input."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.pipelines.applications.fleet.montecarlo import SOLVERS, _first, run_study, simulate_and_solve
from alidade.pipelines.applications.session import Session
from alidade.pipelines.methods import method, names
from alidade.pipelines.reports.result_json import truth_errors
from benchmarks import consistency
from tests.support.browser import fits
from tests.support.fleet_command import alidade
from tests.support.solved import calibrate

pytest.importorskip("distributed", reason="needs the extra alidade[fleet]")

SHORT = """
duration_s: 3
gyro_rate_hz: 50
vision_rate_hz: 10
truth_rate_hz: 1
priors: {helmet_mount_x: 0, helmet_mount_y: 0, helmet_mount_z: 0, time_offset: 0}
sensors: ideal
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


@pytest.mark.slow
def test_same_seeds_same_numbers_whatever_the_workers(
    local_cluster: str, scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    common = ("montecarlo", "head", "--runs", 3, "--seed", 3, "--scenario", scenario)
    assert alidade(monkeypatch, *common, "--scheduler", local_cluster, "--out", tmp_path / "two") == 0
    assert alidade(monkeypatch, *common, "--jobs", 1, "--out", tmp_path / "one") == 0
    for name in ("runs.csv", "summary.csv"):
        assert (tmp_path / "two" / name).read_bytes() == (tmp_path / "one" / name).read_bytes()
    with (tmp_path / "one" / "runs.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["seed"], row["solver"]) for row in rows] == [(str(s), k) for s in range(3, 6) for k in SOLVERS]


def test_numbers_are_those_of_a_run_by_hand(scenario: Path) -> None:
    result = simulate_and_solve("head", method("head").settings(str(scenario)), 3, ["batch"], 1.0)["batch"]
    assert list(result["parameters"]) == ["gyro_bias_x", "gyro_bias_y", "gyro_bias_z"]
    normalised = np.array([p["error"] / p["sigma"] for p in result["parameters"].values()])
    assert result["dof"] == 3
    # Biases of the three axes are nearly uncorrelated.
    assert result["nees"] == pytest.approx(float(normalised @ normalised), rel=0.1)


# The same simulator with less of everything.
BRIEFEST: dict[str, dict[str, Any]] = {
    "los": {"duration_s": 4.0, "gyro_rate_hz": 100.0, "image_rate_hz": 20.0},
    "indexer": {"gyro_rate_hz": 40.0, "encoder_rate_hz": 20.0, "rate_deg_s": 40.0, "dwell_s": 2.0},
    "head": {"duration_s": 4.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 20.0},
    "cube": {"poses": 8},
    "tumble": {"attitudes": 12},
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in ("head", "tumble"))) for name in names()]
)
def test_arrays_give_what_the_same_recording_gives_from_a_file(name: str, tmp_path: Path) -> None:
    """All but noise densities are the same to the last bit; those go through a file as variances."""
    found = method(name)
    settings = found.scenario.model_validate(BRIEFEST[name])
    path = tmp_path / "session.mcap"
    found.write(path, found.simulate(settings, 5))
    (written,) = calibrate(path, ["batch"])
    result = simulate_and_solve(name, settings, 5, ["batch"], 1.0)["batch"]
    assert result["status"] == written.status
    errors = truth_errors(written)
    assert list(result["parameters"]) == [p.name for p in written.parameters.values() if p.name in errors and p.sigma]
    for parameter, said in result["parameters"].items():
        sigma = written.parameters[parameter].sigma
        assert said["sigma"] == pytest.approx(sigma, rel=1e-8)
        assert said["error"] == pytest.approx(errors[parameter].error, abs=1e-7 * sigma)
    assert result["chi_square"] == pytest.approx(written.estimate.chi_square.value, rel=1e-8)  # type: ignore[union-attr]


def test_numbers_do_not_depend_on_what_a_report_tells() -> None:
    found = method("los")
    session = Session.of(found, found.simulate(found.scenario.model_validate(BRIEFEST["los"]), 5))
    whole, bare = session.calibrate(), session.calibrate(report=False)
    np.testing.assert_array_equal(bare.estimate.values, whole.estimate.values)
    np.testing.assert_array_equal(bare.covariance, whole.covariance)
    assert bare.headline == whole.headline
    assert whole.budget is not None
    assert bare.budget is None


def test_another_scenario_is_another_study() -> None:
    """Even where only what the camera saw differs."""
    cube = method("cube")
    first, second = (
        _first(cube, cube.scenario.model_validate(BRIEFEST["cube"] | {"noise": {"corner_px": px}}), 0)
        for px in (0.2, 0.4)
    )
    assert first[1] != second[1]


def test_study_goes_on_and_sums_up(
    local_cluster: str,
    scenario: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    common = ("montecarlo", "head", "--scenario", scenario, "--solvers", "batch", "--scheduler", local_cluster)
    out = tmp_path / "out"
    assert alidade(monkeypatch, *common, "--runs", 2, "--out", out) == 0
    assert "2 of 2 runs, 0 from an earlier run" in capsys.readouterr().out
    assert alidade(monkeypatch, *common, "--runs", 3, "--out", out) == 0
    said = capsys.readouterr().out
    assert "3 of 3 runs, 2 from an earlier run" in said
    assert "batch has a mean NEES of" in said
    assert alidade(monkeypatch, *common, "--runs", 3, "--out", out, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["schema"], printed["wanted"], printed["interrupted"]) == ("alidade.montecarlo/1", 3, False)
    assert {run["seed"] for run in printed["runs"]} == set(range(3))
    page = (out / "montecarlo.html").read_text()
    fits(page, tmp_path)
    assert "default-src 'none'" in page
    for text in ("mean NEES", "gyro_bias_x", "batch: NEES", "batch: errors in sigmas"):
        assert text in page
    # Another scenario is another study.
    scenario.write_text(SHORT + "gyro_turn_on_bias_deg_s: 0.1\n")
    assert alidade(monkeypatch, *common, "--runs", 2, "--out", out) == 0
    assert "2 of 2 runs, 0 from an earlier run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["gyro"], "no method 'gyro'; there are los, "),
        (["head", "--scenario", "nothing"], "no scenario file nothing"),
        (["head", "--solvers", "magic"], "no solver 'magic'; the solvers are published, batch, incremental, or all"),
        (["head", "--runs", "0"], "at least one run"),
        (["head", "--out", "/dev/null/out"], "no folder to write results to"),
        (["head", "--jobs", "1", "--scheduler", "tcp://127.0.0.1:1"], "not together with --scheduler"),
        (["head", "--jobs", "0", "--out", "a/b/c"], "--jobs 0"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code = alidade(monkeypatch, "montecarlo", *arguments)
    error = capsys.readouterr().err
    assert code == 2
    assert len(error.splitlines()) == 1
    assert said in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [("montecarlo", "head"), ("fleet", "*.mcap")])
def test_a_missing_extra_is_told(
    words: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "alidade.pipelines.applications.fleet.find_spec", lambda name: None if name == "arro3" else True
    )
    assert alidade(monkeypatch, *words) == 2
    assert capsys.readouterr().err == "alidade: this command needs arro3: pip install 'alidade[fleet]'\n"


@pytest.mark.slow
def test_the_consistency_page_lists_every_solver(local_cluster: str, tmp_path: Path) -> None:
    study = run_study("tumble", None, range(2), SOLVERS, tmp_path / "out", local_cluster)
    page = consistency.page([(solver, study) for solver in SOLVERS], 2)
    rows = [line.split(" | ")[:3] for line in page.splitlines() if line.startswith("| tumble")]
    assert rows == [["| tumble", solver, "2"] for solver in SOLVERS]


# Shorter than the nominal recordings: `python -m benchmarks.consistency` has the whole study.
BRIEF = {
    "los": "{duration_s: 30.0, sensors: {}}",
    "head": "{duration_s: 30.0, vision_rate_hz: 15.0, sensors: {}}",
    "tumble": "{attitudes: 25, rest_s: 1.5, accelerometer: {rate_hz: 50.0}}",
}


@pytest.mark.slow
@pytest.mark.parametrize("method", names())
def test_batch_and_incremental_are_consistent(method: str, tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(BRIEF.get(method, "{sensors: {}}"))
    study = run_study(method, str(scenario), range(8), ("batch", "incremental"), tmp_path, jobs=2)
    for solver in study.solvers:
        assert not study.failures(solver)
        nees = study.nees(solver)
        assert nees.consistent, f"{solver}: mean NEES {nees.mean:.3f} outside {nees.low:.3f} to {nees.high:.3f}"
