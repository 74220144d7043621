"""Damaged and unfinished recordings: what is read of them is what was recorded, and what is lost is told."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode

from pipelines import cli
from pipelines.errors import InputError
from pipelines.sessions import writing
from pipelines.sessions.config import Config
from pipelines.sessions.info import session_facts
from pipelines.sessions.los import write_los
from pipelines.sessions.reading import open_recording
from pipelines.simulation.los import LosScenario, los_config, simulate_los
from pipelines.simulation.motion import EulerMotion, Swing
from tests.damage import CONFIG, FORMS, Whole, boundaries, check_sound, flips, read, spoilt, topics, write_small

OWN = "alidade's own"


@dataclass
class Small:
    """A small recording: its bytes, what is in it, and a place for damaged copies."""

    data: bytes
    whole: Whole
    copy: Path

    def outcomes(self, copies: Iterable[bytes]) -> Counter[str]:
        """How many damaged copies were read whole, in part, or refused; all of them soundly."""
        found: Counter[str] = Counter()
        for data in copies:
            self.copy.write_bytes(data)
            found[check_sound(self.copy, self.whole)] += 1
        return found


@pytest.fixture(scope="module", params=[*FORMS, OWN])
def small(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Small:
    return make(request.param, tmp_path_factory.mktemp("damaged"))


def make(form: str, folder: Path) -> Small:
    path = folder / "s.mcap"
    if form == OWN:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(writing, "_CHUNK", 4000)
            writing.write_session(path, topics(), {"alidade.yaml": CONFIG})
    else:
        path = write_small(path, form)
    whole = read(open_recording(path))
    assert check_sound(path, whole) == "whole"
    assert not open_recording(path).notes
    return Small(path.read_bytes(), whole, folder / "copy.mcap")


def has_chunks(data: bytes) -> bool:
    return any(data[at] == Opcode.CHUNK for at in boundaries(data)[:-1])


def cuts(data: bytes) -> list[bytes]:
    """Cut at every record boundary and one byte beside it."""
    return [data[: at + off] for at in boundaries(data) for off in (-1, 0, 1)]


def test_cut_at_record_boundaries(small: Small) -> None:
    every = cuts(small.data)
    found = small.outcomes(every[:: len(every) // 40])
    assert found["part"] > 20
    assert found["refused"] < 8  # before the first chunk ends


def test_flipped_bytes(small: Small) -> None:
    found = small.outcomes(flips(small.data, 60, 1))
    assert found["whole"] > 0
    # All messages outside chunks have but one checksum.
    assert found["part"] > 30 or not has_chunks(small.data)


@pytest.mark.slow
def test_every_cut_and_many_flips(small: Small) -> None:
    rng = np.random.default_rng(2)
    random_cuts = [small.data[:at] for at in rng.integers(8, len(small.data), 200)]
    for name, copies in {
        "cut at a record": cuts(small.data),
        "cut anywhere": random_cuts,
        "one byte": flips(small.data, 500, 3),
        "stretches and several bytes": spoilt(small.data, 500, 4),
    }.items():
        print(name, dict(small.outcomes(copies)))


# -- from the file to the verdict

LOS = LosScenario(
    duration_s=20.0,
    carrier=EulerMotion(
        yaw=[Swing(amplitude_deg=20, frequency_hz=0.15)],
        pitch=[Swing(amplitude_deg=8, frequency_hz=0.31)],
        roll=[Swing(amplitude_deg=12, frequency_hz=0.21)],
    ),
    image_rate_hz=20.0,
    gyro_rate_hz=200.0,
    gimbal_rate_hz=100.0,
)


@dataclass
class Run:
    code: int
    out: str
    err: str


Command = Callable[..., Run]


@pytest.fixture
def alidade(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Runs the command in this process."""

    def run(*arguments: str | Path) -> Run:
        monkeypatch.setattr(sys, "argv", ["alidade", *map(str, arguments)])
        capsys.readouterr()
        code: int | str | None = 0
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code
        captured = capsys.readouterr()
        return Run(int(code or 0), captured.out, captured.err)

    return run


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A los recording in chunks of a second or so."""
    path = tmp_path_factory.mktemp("los") / "s.mcap"
    data, truth = simulate_los(LOS, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "_CHUNK", 120_000)
        write_los(path, data, truth, los_config(LOS))
    return path.read_bytes()


def judged(alidade: Command, data: bytes, folder: Path) -> str:
    """The status that a damaged recording gets, `refused` if none; fails if it gets a wrong answer."""
    path, out = folder / "x.mcap", folder / "out"
    path.write_bytes(data)
    run = alidade("calibrate", path, "--method", "los", "--out", out)
    if run.code == 2:
        assert run.err.startswith("alidade: ")
        assert run.err.count("\n") == 1
        assert not out.exists()
        return "refused"
    assert run.code in (0, 3, 4)
    assert run.err == ""
    assert {"result.json", "calibration.yaml", "report.html"} <= {file.name for file in out.iterdir()}
    result = json.loads((out / "result.json").read_text())
    if result["status"] == "calibrated":
        errors = [abs(known["error_sigmas"] or 0.0) for known in result.get("truth", {}).values()]
        assert max(errors, default=0.0) < 4.0
        assert all("error_sigmas" in known for known in result.get("truth", {}).values())
    for file in out.iterdir():
        file.unlink()
    out.rmdir()
    return str(result["status"])


def test_a_damaged_recording_is_calibrated_rightly_or_not_at_all(
    alidade: Command, session: bytes, tmp_path: Path
) -> None:
    every = cuts(session)
    found = Counter(judged(alidade, data, tmp_path) for data in [*every[4 :: len(every) // 3], *flips(session, 5, 1)])
    assert found["calibrated"] > 3


@pytest.mark.slow
def test_many_damaged_recordings_are_calibrated_rightly_or_not_at_all(
    alidade: Command, session: bytes, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    cases = [
        *cuts(session),
        *(session[:at] for at in rng.integers(8, len(session), 200)),
        *flips(session, 500, 3),
        *spoilt(session, 200, 4),
    ]
    print(len(cases), dict(Counter(judged(alidade, data, tmp_path) for data in cases)))


def test_what_is_lost_is_in_the_result_the_report_and_the_terminal(
    alidade: Command, session: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "x.mcap"
    at = [place for place in boundaries(session)[:-1] if session[place] == Opcode.CHUNK][4] + 100
    path.write_bytes(session[:at] + bytes([session[at] ^ 1]) + session[at + 1 :])
    told = r"the recording is damaged: 1 chunk, "
    for command in (["info", path], ["calibrate", path, "--out", tmp_path / "out"], ["compare", path]):
        run = alidade(*command)
        assert run.code == 0
        assert told in run.out
        assert "messages lost: " in run.out
    run = alidade("validate", path, "--calibration", tmp_path / "out" / "calibration.yaml", "--out", tmp_path / "v")
    assert told in run.out
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert any(told in note for note in result["notes"])
    lost = result["session"]["dropped"]["/imu: lost with damaged bytes of the file"]
    assert lost + result["session"]["counts"]["/imu"] == 20 * 200
    assert (tmp_path / "out" / "report.html").read_text().count("is damaged: 1 chunk") == 2
    for command in (
        ["info", path],
        ["calibrate", path, "--out", tmp_path / "no"],
        ["compare", path],
        ["validate", path, "--calibration", tmp_path / "out" / "calibration.yaml", "--out", tmp_path / "no"],
    ):
        run = alidade(*command, "--strict")
        assert run.code == 2
        assert told in run.err
    assert not (tmp_path / "no").exists()


def test_a_damaged_config_is_refused_unless_another_is_given(alidade: Command, session: bytes, tmp_path: Path) -> None:
    at = session.find(b"method: los")
    (tmp_path / "x.mcap").write_bytes(session[:at] + b"n" + session[at + 1 :])
    run = alidade("calibrate", tmp_path / "x.mcap", "--out", tmp_path / "out")
    assert run.code == 2
    assert "the attachment alidade.yaml is damaged (checksum); a config can be given with --config" in run.err
    (tmp_path / "c.yaml").write_text("method: los\n")
    run = alidade("calibrate", tmp_path / "x.mcap", "--config", tmp_path / "c.yaml", "--out", tmp_path / "out")
    assert run.code in (0, 3)
    assert "note: the attachment alidade.yaml is damaged and not used" in run.out


def test_a_damaged_truth_is_not_used(alidade: Command, session: bytes, tmp_path: Path) -> None:
    at = session.find(b"delta_px", session.find(b"truth.json"))
    (tmp_path / "x.mcap").write_bytes(session[:at] + b"D" + session[at + 1 :])
    run = alidade("calibrate", tmp_path / "x.mcap", "--out", tmp_path / "out")
    assert run.code == 0
    assert "note: the attachment truth.json is damaged and not used" in run.out
    assert "truth" not in json.loads((tmp_path / "out" / "result.json").read_text())


def test_a_missing_summary_loses_nothing(session: bytes, tmp_path: Path) -> None:
    end = next(at for at in boundaries(session)[:-1] if session[at] == Opcode.DATA_END)
    (tmp_path / "s.mcap").write_bytes(session)
    (tmp_path / "x.mcap").write_bytes(session[:end])
    whole, cut = (open_recording(tmp_path / name) for name in ("s.mcap", "x.mcap"))
    np.testing.assert_array_equal(cut.imu("/imu").gyro, whole.imu("/imu").gyro)
    assert cut.notes == ("the recording is truncated: it ends without its closing records",)
    assert not cut.missing
    with pytest.raises(InputError, match="--strict"):
        open_recording(tmp_path / "x.mcap", strict=True)


def test_a_damaged_length_loses_one_chunk(session: bytes, tmp_path: Path) -> None:
    """The walk goes on at the next chunk, though it does not know where the damaged record ends."""
    at = [place for place in boundaries(session)[:-1] if session[place] == Opcode.CHUNK][4]
    (tmp_path / "x.mcap").write_bytes(session[: at + 4] + b"\xff" + session[at + 5 :])
    recording = open_recording(tmp_path / "x.mcap")
    facts = session_facts(recording, Config())
    assert [loss.chunks for loss in recording.losses] == [1]
    assert set(facts.lost) == {"/imu", "/gimbal/joint_states", "/los/error"}
    assert facts.lost["/imu"] < 400
    imu = next(topic for topic in facts.topics if topic.name == "/imu")
    assert imu.largest_gap_s == pytest.approx(facts.lost["/imu"] / 200.0, abs=0.006)
    assert recording.losses[0].span is not None
    assert "between" in recording.notes[0]
