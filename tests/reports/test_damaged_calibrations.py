"""Damaged recordings from the file to the verdict: calibrated rightly or not at all, and what is lost is told."""

from __future__ import annotations

import json
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode

from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.recording import mcap_writer
from alidade.pipelines.reports.result_json import truth_errors
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from tests.support.builders import IDEAL
from tests.support.command import Command
from tests.support.damage import boundaries, cuts, flips, rewrite, spoilt
from tests.support.solved import calibrate

LOS = LosScenario(
    duration_s=5.0,
    carrier=EulerMotion(
        yaw=[Swing(amplitude_deg=20, frequency_hz=0.3)],
        pitch=[Swing(amplitude_deg=8, frequency_hz=0.62)],
        roll=[Swing(amplitude_deg=12, frequency_hz=0.42)],
    ),
    image_rate_hz=10.0,
    gyro_rate_hz=100.0,
    gimbal_rate_hz=100.0,
    sensors=IDEAL,
)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A los recording in chunks of a second or so."""
    path = tmp_path_factory.mktemp("los") / "s.mcap"
    data, truth = simulate_los(LOS, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_writer, "CHUNK_BYTES", 70_000)
        method("los").write_data(path, data, truth, los_config(LOS))
    return path.read_bytes()


def solved(data: bytes, path: Path) -> str:
    """The status that a damaged recording gets, `refused` if none; fails if it gets a wrong answer."""
    path.write_bytes(data)
    try:
        (calibration,) = calibrate(path, ["batch"], "los")
    except InputError:
        return "refused"
    status = calibration.status
    errors = [abs(known.error_sigmas or 0.0) for known in truth_errors(calibration).values()]
    assert status != "calibrated" or max(errors, default=0.0) < 4.0
    return status


def test_a_damaged_recording_is_calibrated_rightly_or_not_at_all(session: bytes, tmp_path: Path) -> None:
    copies = [*cuts(session)[4 :: len(cuts(session)) // 3], *flips(session, 4, 1)]
    assert Counter(solved(data, tmp_path / "x.mcap") for data in copies)["calibrated"] > 3


@pytest.mark.slow
def test_many_damaged_recordings_are_calibrated_rightly_or_not_at_all(session: bytes, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    for name, copies in {
        "cut at a record": cuts(session)[::3],
        "cut anywhere": [session[:at] for at in rng.integers(8, len(session), 70)],
        "one byte": flips(session, 170, 3),
        "stretches and several bytes": spoilt(session, 70, 4),
    }.items():
        print(name, dict(Counter(solved(data, tmp_path / "x.mcap") for data in copies)), flush=True)


@pytest.mark.usefixtures("few_solutions")
def test_what_is_lost_is_in_the_result_the_report_and_the_terminal(
    alidade: Command, session: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "x.mcap"
    at = [place for place in boundaries(session)[:-1] if session[place] == Opcode.CHUNK][2] + 100
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
    assert lost + result["session"]["counts"]["/imu"] == 5 * 100
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


# -- strings of the recording in pages

EVIL = '"><script>alert(1)</script><img src=x onerror=alert(2)>'


@pytest.mark.usefixtures("few_solutions")
def test_pages_show_the_strings_of_a_recording_and_obey_none(alidade: Command, session: bytes, tmp_path: Path) -> None:
    """Topics, file name and config of a stranger: text on the page, no element of it."""
    (tmp_path / "s.mcap").write_bytes(session)
    imu, error = f"/imu{EVIL}", f"/los/error'{EVIL}<!--"
    path = tmp_path / "x<b onclick=alert(3)>&'.mcap"
    rewrite(tmp_path / "s.mcap", path, {"/imu": imu, "/los/error": error}, chunk_size=70_000)
    (tmp_path / "c.yaml").write_text(json.dumps({"topics": {"imu": imu, "los_error": error}}))
    # Damaged, so that the names are in the notes too.
    data = path.read_bytes()
    at = next(place for place in boundaries(data)[:-1] if data[place] == Opcode.CHUNK) + 5000
    path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    config = ["--config", tmp_path / "c.yaml"]
    assert alidade("calibrate", path, *config, "--out", tmp_path / "out").code in (0, 3)
    assert alidade("compare", path, *config, "--out", tmp_path / "compare").code == 0
    saved = tmp_path / "out" / "calibration.yaml"
    assert alidade("validate", path, *config, "--calibration", saved, "--out", tmp_path / "validation").code == 0
    pages = {page.name: Page(page.read_text()) for page in tmp_path.rglob("*.html")}
    assert set(pages) == {"report.html", "compare.html", "validation.html"}
    for page in pages.values():
        assert not page.loaded
        assert not page.handlers
    assert EVIL in pages["report.html"].text
    assert "alert(1)" not in "".join(page.code for page in pages.values())


class Page(HTMLParser):
    """What a page shows, runs and loads, and the attributes that would run something."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text, self.code = "", ""
        self.loaded: list[str] = []
        self.handlers: list[str] = []
        self._in_script = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._in_script = tag == "script"
        links = [value or "" for name, value in attrs if name in ("src", "href")]
        self.loaded += [link for link in links if not link.startswith("#")]
        self.handlers += [name for name, _ in attrs if name.startswith("on")]

    def handle_endtag(self, tag: str) -> None:
        self._in_script = self._in_script and tag != "script"

    def handle_data(self, data: str) -> None:
        if self._in_script:
            self.code += data
        else:
            self.text += data


@pytest.mark.slow
@pytest.mark.parametrize("name", ["indexer_nominal", "cube_nominal", "head_mounts", "los_nominal"])
def test_independent_recordings_damaged_are_calibrated_rightly_or_not_at_all(
    name: str, shared_data: Path, tmp_path: Path
) -> None:
    whole = (shared_data / "contract" / f"{name}.mcap").read_bytes()
    truth = json.loads((shared_data / "contract" / f"{name}.truth.json").read_text())
    rng = np.random.default_rng(4)
    copies = [whole[: int(share * len(whole))] for share in (0.35, 0.6, 0.85)]
    for number in (1, 1, 1, 3, 6):
        flipped = bytearray(whole)
        for at in rng.integers(2000, len(whole), number):
            flipped[at] ^= 0x5A
        copies.append(bytes(flipped))
    for copy in copies:
        (tmp_path / "x.mcap").write_bytes(copy)
        try:
            (calibration,) = calibrate(tmp_path / "x.mcap", ["batch"])
        except InputError:
            continue
        known = [p for p in calibration.parameters.values() if isinstance(truth.get(p.name), float) and p.sigma > 0.0]
        assert known
        errors = [abs(p.value - truth[p.name]) / p.sigma for p in known]
        assert calibration.status != "calibrated" or max(errors) < 4.0
