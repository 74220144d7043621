"""A calibration ends in its time with a result, says what it did not do, and Ctrl-C is answered."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines import deadline, parallel
from alidade.pipelines.applications.noise import noise
from alidade.pipelines.applications.session import Session
from alidade.pipelines.methods import simulate
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.layout import Values
from alidade.pipelines.solvers.levenberg import Point
from alidade.pipelines.solvers.linearization import Linearization
from tests.support.command import LONGER, Command


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A clock that the test moves, and the usual limit as it is outside of tests."""
    now = [100.0]
    monkeypatch.setattr(deadline, "LEAST_S", deadline.LEAST_S / LONGER)
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_a_deadline_passes_names_what_it_stopped_and_ends_with_its_block(clock: list[float]) -> None:
    assert not deadline.passed("anything")
    with deadline.within(5.0):
        assert not deadline.passed("early")
        clock[0] += 5.0
        assert deadline.passed("late")
        assert deadline.passed()
        assert deadline.stopped() == "The time limit of 5 s stopped late; --time-limit gives more time."
    assert not deadline.passed("anything")
    assert deadline.stopped() == ""


@pytest.mark.parametrize(
    ("duration", "online", "limit"), [(30.0, False, 60.0), (36_000.0, False, 3600.0), (124.0, True, 124.0)]
)
def test_the_usual_time_follows_the_recording(duration: float, online: bool, limit: float, clock: list[float]) -> None:
    with deadline.usual(duration, online):
        clock[0] += limit - 0.1
        assert not deadline.passed()
        clock[0] += 0.2
        assert deadline.passed()


def test_the_usual_time_is_given_once_more_to_the_search_for_causes(clock: list[float]) -> None:
    with deadline.usual(30.0):
        clock[0] += 60.1
        with deadline.renewed():
            assert not deadline.passed()
            clock[0] += 60.1
            assert deadline.passed("the search")
        assert deadline.stopped() == "The time limit of 60 s stopped the search; --time-limit gives more time."
    with deadline.within(5.0):
        clock[0] += 5.1
        with deadline.renewed():
            assert deadline.passed()


def test_what_the_command_says_goes_before_the_usual(clock: list[float]) -> None:
    with deadline.within(1000.0), deadline.usual(1.0), deadline.within(None):
        clock[0] += 999.0
        assert not deadline.passed()


def test_a_busy_machine_ends_no_solution_and_a_stated_limit_is_by_the_clock(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    used = [3.0]
    monkeypatch.setattr(time, "thread_time", lambda: used[0])
    with deadline.usual(30.0):
        with deadline.of_processor():
            clock[0] += 1000.0
            used[0] += 59.0
            assert not deadline.passed()
            used[0] += 1.0
            assert deadline.passed("the solution")
        assert deadline.passed()
        assert "60 s stopped the solution" in deadline.stopped()
    with deadline.within(60.0), deadline.of_processor():
        clock[0] += 60.0
        assert deadline.passed()


def test_items_end_with_the_time_and_it_is_said_where(clock: list[float]) -> None:
    with deadline.within(2.5):
        taken = []
        for item in deadline.until_passed(range(10), "the run at {}".format):
            taken.append(item)
            clock[0] += 1.0
        assert taken == [0, 1, 2]
        assert "stopped the run at 3;" in deadline.stopped()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("los")
    (folder / "scenario.yaml").write_text("{duration_s: 30, gyro_rate_hz: 100, gimbal_rate_hz: 100, image_rate_hz: 10}")
    simulate("los", str(folder / "scenario.yaml"), 0, folder / "s.mcap", False)
    return folder / "s.mcap"


def _in_degrees(session: Session) -> Session:
    return replace(session, data=replace(session.data, gyro=np.rad2deg(session.data.gyro)))


def _outliers(session: Session) -> Session:
    rng, error = np.random.default_rng(0), session.data.error.copy()
    error[rng.random(len(error)) < 0.3] += 0.1
    return replace(session, data=replace(session.data, error=error))


@pytest.mark.parametrize(("wrong", "solver"), [(_outliers, "batch"), (_in_degrees, "incremental")])
def test_where_nothing_fits_there_is_a_result_in_time(
    wrong: Callable[[Session], Session], solver: str, recording: Path
) -> None:
    session = wrong(Session.read(open_recording(recording), "los", None))
    start = time.process_time()
    with parallel.processes(1), deadline.within(0.5):
        calibration = session.calibrate(solver)
    assert time.process_time() - start < 10.0
    assert np.isfinite(calibration.estimate.values).all()
    assert calibration.estimate.converged or calibration.status == "inconsistent"
    told = (calibration.headline, *calibration.notes)
    assert calibration.status == "calibrated" or any("time limit of 0.5 s" in text for text in told)


def test_minimisations_end_with_the_time(recording: Path, clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    """No linear system is made after it, where a posterior of what is no minimum once took minutes."""
    problem, made, of = _outliers(Session.read(open_recording(recording), "los", None)).problem(), [0], Point.of

    def counted(engine: Linearization, values: Values) -> Point:
        made[0] += 1
        clock[0] += 1.0
        return of(engine, values)

    monkeypatch.setattr(Point, "of", counted)
    with deadline.within(3.0):
        estimate = solve_batch(problem)
    assert estimate.message == "not converged: stopped by the time limit of 3 s"
    assert not estimate.converged
    assert np.isfinite(estimate.values).all()
    assert sum(estimate.rejected.values()) > 0, "outliers are not used, though time is over"
    assert made[0] == 3


def test_a_result_is_written_when_the_time_is_over(alidade: Command, recording: Path, tmp_path: Path) -> None:
    run = alidade("calibrate", recording, "--time-limit", "0.1", "--out", tmp_path / "out", "--jobs", "1")
    assert run.code in (0, 3, 4), run.err
    assert json.loads((tmp_path / "out" / "result.json").read_text())["parameters"]
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.usefixtures("few_solutions")
def test_compare_and_validate_say_what_the_time_limit_stopped(
    alidade: Command, recording: Path, tmp_path: Path
) -> None:
    compared = alidade("compare", recording, "--time-limit", "0.1", "--out", tmp_path / "compared", "--jobs", "1")
    assert compared.code == 0, compared.err
    page = (tmp_path / "compared" / "compare.html").read_text()
    assert "The time limit of 0.1 s stopped" in page
    assert alidade("calibrate", recording, "--out", tmp_path / "out", "--jobs", "1").code in (0, 3)
    (tmp_path / "scenario.yaml").write_text("{duration_s: 10, gyro_rate_hz: 100, gimbal_rate_hz: 100}")
    simulate("los", str(tmp_path / "scenario.yaml"), 1, tmp_path / "t.mcap", False)
    held = tmp_path / "out" / "calibration.yaml"
    limited = ("--calibration", held, "--time-limit", "0.1", "--out", tmp_path / "held", "--json", "--jobs", "1")
    start = time.monotonic()
    validated = alidade("validate", tmp_path / "t.mcap", *limited)
    assert validated.code in (0, 3, 4), validated.err
    assert time.monotonic() - start < 10.0


def test_noise_takes_the_topics_for_which_there_is_time(tmp_path: Path, clock: list[float]) -> None:
    n = 2000
    stamps, rng = np.arange(n) * 10_000_000, np.random.default_rng(0)
    imu = series.ImuSeries(stamps, 1e-4 * rng.normal(size=(n, 3)), [0.0, 0.0, 9.8] + 1e-3 * rng.normal(size=(n, 3)))
    topics = {"/first/imu": imu, "/second/imu": imu}
    write_session(tmp_path / "s.mcap", topics)
    study = noise(tmp_path / "s.mcap")
    assert {sensor.topic for sensor in study.sensors} == set(topics)
    with deadline.within(1.0):
        clock[0] += 2.0
        study = noise(tmp_path / "s.mcap")
    assert {sensor.topic for sensor in study.sensors} == {"/first/imu"}
    assert any("stopped the noise of /second/imu" in note for note in study.notes)


@pytest.mark.parametrize("after", [3.5, *(pytest.param(after, marks=pytest.mark.slow) for after in (0.5, 2.0, 5.0))])
def test_ctrl_c_is_answered_within_a_second(after: float, recording: Path, tmp_path: Path) -> None:
    """Reading, solving, trying causes, in several processes."""
    (tmp_path / "c.yaml").write_text("noise: {los_error: 1.0e-7}\nnoise_known: 0\n")
    command = [sys.executable, "-m", "alidade", "calibrate", str(recording), "--config", str(tmp_path / "c.yaml")]
    process = subprocess.Popen(
        [*command, "--jobs", "2", "--out", str(tmp_path / "out")], stderr=subprocess.PIPE, text=True
    )
    time.sleep(after)
    if process.poll() is not None:
        pytest.skip("it is done by then")
    process.send_signal(signal.SIGINT)
    start = time.monotonic()
    _, said = process.communicate(timeout=30)
    # The machine that runs the tests has other work: twice the second that it takes alone.
    assert time.monotonic() - start < 2.0
    if process.returncode == -signal.SIGINT:
        pytest.skip("the interpreter itself was still starting")
    assert process.returncode == 130
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()
