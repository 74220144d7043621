"""A method of another distribution: installed, found by its entry point, and served by every command."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.command import Run

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "gyro_pair"
SHORT = """
duration_s: 8
gyro_a: {rate_hz: 100}
gyro_b: {rate_hz: 120, density: 2.0e-4}
"""
# One process runs all commands, since each of its own would import everything anew.
COMMANDS = """
import json, os, sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from alidade.pipelines.applications import cli

for line in sys.stdin:
    folder, words = json.loads(line)
    os.chdir(folder)
    sys.argv = ["alidade", *words]
    code, out, err = 0, StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code or 0
    print(json.dumps([code, out.getvalue(), err.getvalue()]), flush=True)
"""
Command = Callable[..., Run]


@pytest.fixture(scope="module")
def command(example_site: Path) -> Iterator[Command]:
    """Runs alidade with the example installed."""
    env = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(example_site)]), "PATH": "/usr/bin:/bin"}
    with subprocess.Popen(
        [sys.executable, "-c", COMMANDS], env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        to_it, from_it = process.stdin, process.stdout

        def run(folder: Path, *words: str, code: int = 0) -> Run:
            print(json.dumps([str(folder), words]), file=to_it, flush=True)
            done = Run(*json.loads(from_it.readline()))
            assert done.code == code, f"{words}\n{done.out}{done.err}"
            return done

        yield run
        to_it.close()


@pytest.fixture(scope="module")
def folder(command: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a short scenario and a recording of it."""
    folder = tmp_path_factory.mktemp("fifth")
    (folder / "short.yaml").write_text(SHORT)
    command(folder, "simulate", "gyro_pair", "--scenario", "short.yaml", "--out", "s.mcap", "--quiet")
    return folder


@pytest.fixture(scope="module")
def calibrated(command: Command, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a calibration by batch."""
    out = tmp_path_factory.mktemp("calibrated")
    command(folder, "calibrate", "s.mcap", "--out", str(out), "--quiet")
    return out


def result(folder: Path) -> dict[str, object]:
    found = json.loads((folder / "result.json").read_text())
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize("solver", ["batch", "incremental", "published"])
def test_calibrate(command: Command, folder: Path, calibrated: Path, solver: str, tmp_path: Path) -> None:
    out = calibrated if solver == "batch" else tmp_path
    if solver != "batch":
        command(folder, "calibrate", "s.mcap", "--solver", solver, "--out", str(out), "--quiet")
    assert result(out)["status"] == "calibrated"
    report = (out / "report.html").read_text()
    assert "Both gyros in one frame" in report
    assert "bias_difference_x" in report


def test_validate(command: Command, folder: Path, calibrated: Path, tmp_path: Path) -> None:
    calibration = str(calibrated / "calibration.yaml")
    done = command(folder, "validate", "s.mcap", "--calibration", calibration, "--out", str(tmp_path), "--quiet")
    assert "rate of gyro a against gyro b's" in done.out
    assert (tmp_path / "validation.html").exists()


def test_info_knows_it(command: Command, folder: Path) -> None:
    assert "gyro_pair: yes" in command(folder, "info", "s.mcap", "--quiet").out.splitlines()


def test_compare_with_halves(command: Command, folder: Path, tmp_path: Path) -> None:
    done = command(folder, "compare", "s.mcap", "--out", str(tmp_path), "--quiet")
    assert all(solver in done.out for solver in ("published", "batch", "incremental"))
    assert "time_offset" in (tmp_path / "compare.html").read_text()


def test_plan_finds_the_second_axis(command: Command, folder: Path, tmp_path: Path) -> None:
    one_axis, better = tmp_path / "one_axis.yaml", tmp_path / "better.yaml"
    one_axis.write_text(SHORT + "motion: {yaw: [{amplitude_deg: 60, frequency_hz: 0.3}]}")
    done = command(folder, "plan", "gyro_pair", "--scenario", str(one_axis), "--out", str(better), code=3)
    assert "The body: sway by 20 deg" in done.out
    command(folder, "plan", "gyro_pair", "--scenario", str(better), "--quiet")


def test_follow(command: Command, folder: Path, tmp_path: Path) -> None:
    done = command(folder, "follow", "s.mcap", "--out", str(tmp_path))
    assert "the accuracy wanted is reached" in done.out + done.err
    assert result(tmp_path)["status"] == "calibrated"


@pytest.mark.slow
def test_montecarlo_of_the_nominal_scenario(command: Command, folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs the extra alidade[fleet]")
    words = ("--runs", "2", "--jobs", "1", "--solvers", "published,batch", "--out", str(tmp_path), "--quiet")
    done = command(folder, "montecarlo", "gyro_pair", *words)
    assert "batch has a mean NEES of" in done.out
    with (tmp_path / "runs.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["status"] for row in rows] == ["calibrated"] * 4
    assert "gyro_pair_nominal" in (tmp_path / "montecarlo.html").read_text()


def test_what_it_cannot_do_is_one_line(command: Command, folder: Path) -> None:
    done = command(folder, "simulate", "gyro_pair", "--images", "--out", "x.mcap", "--quiet", code=2)
    assert done.err == "alidade: gyro_pair has no camera: leave out --images\n"


def test_config_has_its_noise(command: Command, folder: Path, tmp_path: Path) -> None:
    """`noise.gyro_b_density` is a key that the method brings."""
    (tmp_path / "config.yaml").write_text("noise: {gyro_b_density: 4.0e-3}")
    (tmp_path / "wrong.yaml").write_text("noise: {gyro_c_density: 4.0e-3}")
    calibrate = ("calibrate", "s.mcap", "--out", str(tmp_path / "r"), "--quiet", "--config")
    done = command(folder, *calibrate, str(tmp_path / "config.yaml"))
    assert "times the message's value" in done.out, "the level is not that of the residuals"
    asked = command(folder, *calibrate, str(tmp_path / "wrong.yaml"), code=2)
    assert "unknown key noise.gyro_c_density" in asked.err


def test_no_shared_file_knows_it() -> None:
    for package in ("factors", "pipelines", "datasets", "benchmarks"):
        for file in (ROOT / package).rglob("*.py"):
            assert "gyro_pair" not in file.read_text(encoding="utf-8"), file
