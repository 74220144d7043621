"""The command line as people type it: what it prints, its exit codes, one clear line for bad input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from io import BytesIO, TextIOWrapper
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.applications import cli
from alidade.pipelines.applications.session import Session
from alidade.pipelines.diagnostics.cross_validation import SplitHalf
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.simulation.scenario import load_scenario
from tests.support.builders import IDEAL
from tests.support.command import Command, Run


@pytest.fixture(scope="module")
def scenario() -> HeadScenario:
    short = {"duration_s": 8.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 10.0}
    return load_scenario(HeadScenario, "head_mounts").model_copy(update=short)


@pytest.fixture(scope="module")
def data(scenario: HeadScenario) -> HeadData:
    return simulate_head(scenario, 1).data


@pytest.fixture(scope="module")
def session(scenario: HeadScenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _written(tmp_path_factory.mktemp("session") / "s.mcap", scenario)


@pytest.fixture(scope="module")
def brief(scenario: HeadScenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For what takes long: a few seconds of few pictures and of sensors without errors."""
    short = scenario.model_copy(
        update={"duration_s": 4.0, "vision_rate_hz": 5.0, "gyro_rate_hz": 100.0, "sensors": IDEAL}
    )
    return _written(tmp_path_factory.mktemp("brief") / "s.mcap", short)


def _written(path: Path, scenario: HeadScenario) -> Path:
    simulated, truth = simulate_head(scenario, 1)
    method("head").write_data(path, simulated, truth, head_config(scenario))
    return path


def test_calibrate_writes_everything(alidade: Command, session: Path, tmp_path: Path) -> None:
    run = alidade("calibrate", session, "--out", tmp_path / "out")
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert run.code == {"calibrated": 0, "weak": 3}[result["status"]]
    assert result["schema"] == "alidade.result/1"
    assert (result["method"], result["solver"]) == ("head", "batch")
    names = [p["name"] for p in result["parameters"]]
    assert names[:4] == ["gyro_bias_x", "gyro_bias_y", "gyro_bias_z", "helmet_mount_x"]
    assert result["covariance"]["order"] == names
    assert np.array(result["covariance"]["matrix"]).shape == (len(names), len(names))
    assert [p.get("group") for p in result["parameters"]] == [None] * 10 + ["assumption"] * (len(names) - 10)
    for name in ("calibration.yaml", "report.html", "attitude.tum"):
        assert (tmp_path / "out" / name).stat().st_size > 100
    assert "Markers to helmet IMU x, deg" in run.out
    assert "helmet_mount_x" not in run.out
    assert run.err == ""


@pytest.mark.usefixtures("few_solutions")
@pytest.mark.parametrize("solver", ["incremental", "published"])
def test_other_solvers_write_estimates_over_time(alidade: Command, brief: Path, tmp_path: Path, solver: str) -> None:
    run = alidade("calibrate", brief, "--solver", solver, "--out", tmp_path / "out")
    assert run.code in (0, 3, 4)
    assert (tmp_path / "out" / "estimates.mcap").read_bytes().startswith(b"\x89MCAP0\r\n")
    assert json.loads((tmp_path / "out" / "result.json").read_text())["solver"] == solver


@pytest.mark.usefixtures("few_solutions")
def test_compare_shows_truth_and_three_solvers_and_splits_the_recording_that_it_read(
    alidade: Command, brief: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Halves were once read anew, without --auto-topics, --strict and --prior."""
    opened: list[Session] = []

    def cross_validate(self: Session) -> tuple[dict[str, SplitHalf], dict[str, float], str, tuple[str, ...]]:
        opened.append(self)
        return real(self)

    real = Session.cross_validate
    monkeypatch.setattr(Session, "cross_validate", cross_validate)
    renamed = tmp_path / "renamed.mcap"
    renamed.write_bytes(brief.read_bytes().replace(b"/head/imu", b"/helm/imu"))
    run = alidade("compare", renamed, "--method", "head", "--auto-topics", "--out", tmp_path / "out")
    assert run.code == 0, run.err
    for word in ("truth", "published", "batch", "incremental", "time_offset"):
        assert word in run.out
    assert (tmp_path / "out" / "compare.html").is_file()
    assert len(opened) == 1
    assert "head_imu" in opened[0].config.topics


def test_info_shows_topics_and_methods(alidade: Command, session: Path) -> None:
    run = alidade("info", session)
    assert run.code == 0
    for word in ("/head/imu", "/vision/attitude", "head: yes", "los: missing"):
        assert word in run.out


def test_simulate_is_repeatable(alidade: Command, tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text("duration_s: 3\n")
    for name in ("a", "b"):
        run = alidade("simulate", "head", "--scenario", tmp_path / "short.yaml", "--seed", 4, "--out", tmp_path / name)
        assert run.code == 0
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_weak_motion_exits_with_3_and_names_the_direction(alidade: Command, tmp_path: Path) -> None:
    """Platform at rest and the camera mount asked for: only its product with the attitude can be known."""
    still = load_scenario(HeadScenario, "head_nominal").model_copy(
        update={"duration_s": 10.0, "platform": None, "priors": {}, "camera_mount_deg": (1.0, 2.0, 0.0)}
    )
    simulated, truth = simulate_head(still, 2)
    config = head_config(still).replace(
        "priors: {}", "priors: {camera_mount_x: 0.1, camera_mount_y: 0.1, camera_mount_z: 0.1}"
    )
    method("head").write_data(tmp_path / "s.mcap", simulated, truth, config)
    run = alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out", "--all")
    assert run.code == 3
    assert "What to do: " in run.out
    assert "turn the platform" in run.out
    assert "camera_mount" in run.out.partition("Unobservable and weak directions")[2]
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["status"] == "unobservable"
    assert any("camera_mount" in name for d in result["null_directions"] for name in d["weights"])


def test_wrong_noise_exits_with_4(alidade: Command, brief: Path, tmp_path: Path) -> None:
    (tmp_path / "noise.yaml").write_text("noise: {vision_attitude: 0.001}\n")
    run = alidade("calibrate", brief, "--config", tmp_path / "noise.yaml", "--out", tmp_path / "out")
    assert run.code == 4
    assert "noise" in run.out


# Each damage to the data, and words that the one line has to have.
DAMAGE: dict[str, tuple[Callable[[HeadData], HeadData], tuple[str, ...]]] = {
    "gyro in deg/s": (lambda d: replace(d, head_gyro=np.rad2deg(d.head_gyro) * 3), ("/head/imu", "deg/s")),
    "all NaN": (lambda d: replace(d, head_gyro=d.head_gyro * np.nan), ("/head/imu", "NaN")),
    "zero quaternions": (lambda d: replace(d, vision_wxyz=0.0 * d.vision_wxyz), ("/vision/attitude", "zero")),
    "not unit": (lambda d: replace(d, vision_wxyz=d.vision_wxyz * 1.01), ("/vision/attitude", "norm")),
    "backward stamps": (lambda d: replace(d, head_t=_shuffled(d.head_t)), ("/head/imu", "stamp")),
    "duplicate stamps": (
        lambda d: replace(d, head_t=np.repeat(d.head_t[::4], 4)[: len(d.head_t)], gyro_density=None),
        ("/head/imu", "stamp"),
    ),
    "no overlap": (lambda d: replace(d, vision_t=d.vision_t + 1000.0), ("/vision/attitude", "/head/imu")),
}


def _shuffled(t: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).permutation(t)


def _refused(run: Run, out: Path, words: tuple[str, ...]) -> None:
    assert run.code == 2, run.out + run.err
    assert run.err.startswith("alidade: ")
    assert run.err.count("\n") == 1
    assert "Traceback" not in run.err
    for word in words:
        assert word in run.err
    assert not out.exists()


@pytest.mark.parametrize("damage", DAMAGE)
def test_bad_data_is_one_line(alidade: Command, data: HeadData, tmp_path: Path, damage: str) -> None:
    change, words = DAMAGE[damage]
    method("head").write_data(tmp_path / "s.mcap", change(data))
    _refused(alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "out"), tmp_path / "out", words)


_HEAD = [f"{name}_{axis}" for name in ("gyro_bias", "helmet_mount", "camera_mount") for axis in "xyz"]
ALL_FIXED = f"sensors: ideal\npriors: {{{', '.join(f'{name}: 0' for name in [*_HEAD, 'time_offset'])}}}"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("noise: {gyro_densty: 1e-4}", ("noise.gyro_densty", "gyro_density")),
        ("noise: [", ("YAML",)),
        ("priors: {helmet_mont_x: 0.1}", ("helmet_mont_x", "helmet_mount_x")),
        (ALL_FIXED, ("priors", "every parameter is fixed")),
        ("topics: {vision_attitude: /nowhere}", ("/nowhere",)),
        ("noise: {gyro_density: -1}", ("noise.gyro_density",)),
        ("noise: {mag_density: 1.0e300}", ("noise.mag_density", "less than")),
        ("method: los", ("/imu", "topics:")),
    ],
)
def test_bad_config_is_one_line(
    alidade: Command, session: Path, tmp_path: Path, content: str, words: tuple[str, ...]
) -> None:
    (tmp_path / "c.yaml").write_text(content)
    run = alidade("calibrate", session, "--config", tmp_path / "c.yaml", "--out", tmp_path / "out")
    _refused(run, tmp_path / "out", words)


def test_bad_files_are_one_line(alidade: Command, session: Path, tmp_path: Path) -> None:
    whole = session.read_bytes()
    files = {
        "absent.mcap": (None, "absent.mcap"),
        "empty.mcap": (b"", "empty"),
        "text.mcap": (b"not a recording at all, just text\n" * 20, "MCAP"),
        "cut.mcap": (whole[:60], "truncated"),
    }
    for name, (content, word) in files.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        run = alidade("calibrate", tmp_path / name, "--out", tmp_path / "out")
        _refused(run, tmp_path / "out", (name, word))


def test_bad_options_are_refused(alidade: Command, session: Path, tmp_path: Path) -> None:
    _refused(
        alidade("calibrate", session, "--window", "-3", "--out", tmp_path / "out"), tmp_path / "out", ("--window",)
    )
    _refused(
        alidade("simulate", "head", "--scenario", "hed", "--out", tmp_path / "x"), tmp_path / "x", ("head_mounts",)
    )
    _refused(alidade("simulate", "hedd", "--out", tmp_path / "x"), tmp_path / "x", ("head",))


def test_where_nothing_can_be_written_is_told_before_the_work(
    alidade: Command, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("mine")
    out = tmp_path / "file" / "out"

    def worked(*_: object, **__: object) -> None:
        raise AssertionError("before it was told")

    with monkeypatch.context() as patched:
        # The session's last: modules imported here take it as it is.
        for name in (
            "alidade.pipelines.applications.follow.follow.follow",
            "alidade.pipelines.applications.validate.validate",
            "alidade.pipelines.applications.session.open_session",
            "alidade.pipelines.applications.noise.noise",
            "alidade.pipelines.applications.planning.plan",
            "alidade.pipelines.applications.apply.apply",
            "alidade.pipelines.methods.simulate",
        ):
            patched.setattr(name, worked)
        for command in ("calibrate", "compare", "follow", "noise"):
            _refused(alidade(command, session, "--out", out), out, ("no folder to write results to", "file"))
        validate = ("validate", session, "--calibration", tmp_path / "file", "--out", out)
        _refused(alidade(*validate), out, ("no folder to write results to", "file"))
        for folders in (("demo",), ("certificate", tmp_path), ("fleet", session), ("montecarlo", "head")):
            run = alidade(*folders, "--out", tmp_path / "file")
            _refused(run, out, ("no folder to write results to", "file is no folder"))
        _refused(alidade("follow", session, "--checkpoint", out / "run.npz"), out, ("no folder to write",))
        for words in (
            ("plan", "head", "--out"),
            ("plan", "head", "--page"),
            ("apply", session, session, "--out"),
            ("simulate", "head", "--out"),
        ):
            _refused(alidade(*words, out), out, ("out: cannot be written", "file is no folder"))
            _refused(alidade(*words, tmp_path), out, ("is a folder; name a file in it",))
    for path in (out, tmp_path / "none" / "s.mcap", tmp_path):
        run = alidade("simulate", "tumble", "--out", path)
        assert (run.code, run.err.count("\n")) == (2, 1)
    assert (tmp_path / "file").read_text() == "mine"
    assert alidade("simulate", "tumble", "--seed", "-1", "--out", tmp_path / "s.mcap").code == 2
    named = alidade("simulate", "tumble", "--out", tmp_path / "s.csv")
    assert (named.code, "an MCAP file is written: name it s.mcap" in named.err) == (2, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


@pytest.mark.parametrize("where", ["reading", "importing", "writing"])
def test_ctrl_c_is_silent_and_leaves_nothing(
    alidade: Command, brief: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        if where == "importing":
            raise ImportError("initialization failed") from KeyboardInterrupt()  # as gtsam's module does
        raise KeyboardInterrupt

    target = (
        "alidade.pipelines.reports.write.report_html"
        if where == "writing"
        else "alidade.pipelines.applications.session.open_recording"
    )
    monkeypatch.setattr(target, interrupted)
    run = alidade("calibrate", brief, "--out", tmp_path / "out")
    assert (run.code, run.out, run.err) == (130, "", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["--version", "-V"])
def test_version(alidade: Command, option: str) -> None:
    assert alidade(option).out == f"{version('alidade')}\n"


def test_short_help(alidade: Command) -> None:
    """Of the command, of its own commands and of those that methods bring."""
    for words in ((), ("plan",), ("cube-print",)):
        run = alidade(*words, "-h")
        assert run.code == 0
        assert run.out.startswith("Usage: ")


def test_every_shipped_scenario_is_listed_and_says_what_it_shows(alidade: Command) -> None:
    listed = json.loads(alidade("scenarios", "--json").out)["scenarios"]
    folder = Path(__file__).parents[2] / "datasets" / "scenarios"
    assert {s["name"] for s in listed} == {path.stem for path in folder.glob("*.yaml")}
    assert all(len(s["summary"]) > 20 for s in listed), listed
    for_people = " ".join(alidade("scenarios").out.split())
    assert all(s["name"] in for_people for s in listed)


def test_scenarios_of_one_method_and_the_file_of_one(alidade: Command, tmp_path: Path) -> None:
    assert "los_nominal" not in (of_head := alidade("scenarios", "head").out)
    assert "head_outages" in of_head
    (tmp_path / "mine.yaml").write_text(alidade("scenarios", "head_mounts").out)
    assert load_scenario(HeadScenario, tmp_path / "mine.yaml") == load_scenario(HeadScenario, "head_mounts")
    unknown = alidade("scenarios", "head_mount")
    assert unknown.code == 2
    nearest = "the nearest are head_mounts, head_outages, head_turntable"
    assert unknown.err == f"alidade: no scenario or method head_mount; {nearest}\n"


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("alidade simu", ["simulate"]),
        ("alidade cube-", ["cube-layout", "cube-print"]),
        ("alidade plan t", ["tumble"]),
        ("alidade simulate head --scenario head_m", ["head_mounts"]),
    ],
)
def test_the_shell_completes(alidade: Command, monkeypatch: pytest.MonkeyPatch, typed: str, offered: list[str]) -> None:
    monkeypatch.setenv("_ALIDADE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(typed.count(" ")))
    assert alidade().out.split() == offered


@pytest.mark.parametrize("typed", ["--help", "calibrate --help", "cube-layout --help"])
def test_help_imports_nothing_heavy(typed: str) -> None:
    code = f"""
import atexit, sys
heavy = ("numpy", "pydantic", "gtsam", "cv2", "bokeh", "rich")
atexit.register(lambda: print([name for name in heavy if name in sys.modules], file=sys.stderr))
sys.argv = ["alidade", *{typed.split()}]
from alidade.pipelines.applications.cli import main
main()
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert run.returncode == 0
    assert run.stdout.startswith("Usage: alidade")
    assert run.stderr.strip() == "[]"


def test_output_fits_any_encoding_and_a_full_disk_is_one_line(brief: Path, tmp_path: Path) -> None:
    """A name outside ASCII once ended in a traceback; a full disk behind > was called /tmp."""
    (tmp_path / "é.mcap").write_bytes(brief.read_bytes())
    command = [sys.executable, "-m", "alidade", "info", str(tmp_path / "é.mcap")]
    env, root = {**os.environ, "PYTHONIOENCODING": "ascii"}, Path(__file__).parents[2]
    run = subprocess.run(command, capture_output=True, text=True, cwd=root, env=env)
    assert (run.returncode, run.stderr, run.stdout.partition(",")[0]) == (0, "", "?.mcap")
    with Path("/dev/full").open("w") as full:
        run = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=root)
    assert (run.returncode, run.stderr.count("\n")) == (2, 1)
    assert run.stderr.startswith("alidade: standard output, or temporary files in ")


def test_json_on_a_terminal_without_unicode_loses_nothing(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Units such as rad/s/√Hz once had a question mark."""
    with TextIOWrapper(BytesIO(), "ascii") as stdout:
        monkeypatch.setattr("sys.stdout", stdout)
        monkeypatch.setattr("sys.argv", ["alidade", "calibrate", str(session), "--json", "--out", str(tmp_path)])
        with pytest.raises(SystemExit):
            cli.main()
        stdout.seek(0)
        printed = json.load(stdout)
    text = (tmp_path / "result.json").read_text()
    assert "√" in text
    assert printed == json.loads(text)


def test_errors_name_what_is_missing_where_and_what_there_is(alidade: Command, session: Path, tmp_path: Path) -> None:
    """A recording without a gimbal once had a dead sensor, and a key of `require` no file."""
    from alidade.pipelines.methods import method

    (tmp_path / "c.yaml").write_text("require: {helmet_mount_q: 1.0e-3}")
    run = alidade("calibrate", session, "--config", tmp_path / "c.yaml", "--out", tmp_path / "out")
    assert run.code == 2
    assert "c.yaml: unknown key require.helmet_mount_q; the nearest known key is helmet_mount_" in run.err
    run = alidade("simulate", "tumble", "--scenario", "los_nominal", "--out", tmp_path / "x.mcap")
    assert run.code == 2
    assert "scenario los_nominal is of method los; tumble has tumble_car, tumble_imu, " in run.err
    method("tumble").write(tmp_path / "t.mcap", method("tumble").simulate(method("tumble").settings("tumble_imu"), 1))
    run = alidade("calibrate", tmp_path / "t.mcap", "--method", "los", "--out", tmp_path / "out")
    assert run.code == 2
    assert "t.mcap: method los lacks /gimbal/joint_states (sensor_msgs/msg/JointState)" in run.err
    assert "dead" not in run.err
    for words, said in (
        ((), "with --replay"),
        ((session, "--replay", session), f"stands in place of SOURCE; leave out {session}"),
        ((session, "--speed", "2"), "--speed 2: is that of --replay"),
    ):
        run = alidade("follow", *words, "--out", tmp_path / "out")
        assert (run.code, run.err.count("\n")) == (2, 1)
        assert said in run.err
