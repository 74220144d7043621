"""The live page, in a real browser: what to do now, what there is by now, and when it is enough."""

from __future__ import annotations

import io
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from http.cookiejar import CookieJar
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rich.console import Console

from alidade.pipelines.applications.follow.follow import Screen
from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.page import LivePage
from alidade.pipelines.applications.follow.sources import Source
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.diagnostics.observability import weak_directions
from alidade.pipelines.display.drawing import covered, swaying
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Finding, Motion, Severity
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods import simulate
from tests.support.browser import DESKTOP, PHONE, needs_browser
from tests.support.devtools import Tab
from tests.support.live import messages, paced, write

LINES = "[...document.querySelectorAll('#parameters .how')].map(e => e.textContent)"
WORDS = "document.getElementById('words').textContent"
LOST = "document.body.className === 'lost'"


def _sway(_: Mapping[str, float]) -> Motion:
    return Motion("sway it more")


def _view(time_s: float, sigma: float) -> View:
    """Of two parameters, the second of which is known well enough, and a sway that is wanted at the beginning."""
    quantities = (Quantity("delta_px", "rad", 0.1, 0.1, 1e-3), Quantity("delta_gx", "rad", 0.1, 0.1, 1e-3))
    covariance = np.diag([sigma**2, 1e-8])
    findings = weak_directions(quantities, covariance, _sway, np.zeros(2))
    wanted = "sway the carrier about its x"
    collected = (
        ChecklistItem("sway about x", "1.0 deg", wanted, 0.5, Motion(wanted, swaying("x", "carrier"))),
        ChecklistItem("sides up", "3 of 6", chart=covered(np.eye(3), "sides up")),
    )
    return View(time_s, 0, quantities, np.array([0.02, 0.01]), covariance, collected, None, findings, _sway)


@needs_browser
def test_it_says_what_to_do_until_enough_is_there_and_comes_back_by_itself(tmp_path: Path) -> None:
    with Tab(tmp_path) as tab:
        with LivePage(print, port=0, name="s.mcap") as page:
            port = int(urlsplit(page.url).port or 0)
            tab.size(PHONE)
            tab.open(page.url)
            tab.wait(f"{WORDS} === 'Waiting for the recording'")
            page.show(_view(1.0, 2e-2))
            page.show(_view(2.0, 1e-2))
            tab.wait("document.getElementById('time').textContent === '0:02'")
            assert tab.value(WORDS) == "Sway the carrier about its x"
            assert tab.value("document.querySelectorAll('#picture svg').length") == 1
            for width in (PHONE, DESKTOP):
                tab.size(width)
                assert tab.overflow() == []
            assert tab.value("document.getElementById('reached').textContent").startswith("1 of 2 parameters")
            said = tab.value("document.getElementById('parameters').textContent")
            assert "delta_px weak± 0.57 deg, required 0.057" in said
            line = tab.value("document.querySelector('#parameters polyline').getAttribute('points')")
            assert len(line.split()) == 2, "the sigma as it was, and as it is"
        tab.wait(LOST)
        with LivePage(print, port=port, name="s.mcap") as page:
            page.show(_view(3.0, 1e-4))
            tab.wait(f"!({LOST}) && {WORDS} === 'You may stop'")
            evidence = {"since_s": 31.0, "time_s": 31.0, "steps": {"delta_px": (8e-3, 1e-3)}}
            page.show(replace(_view(4.0, 1e-4), change=Finding("change", Severity.INCONSISTENT, evidence)))
            tab.wait(f"{WORDS} === 'Look what moved, and begin anew'")
            assert "00:00:31 UTC" in tab.value("document.getElementById('alarms').textContent")
        # Only that the server was away is complained of.
        assert all("ERR_" in complaint for complaint in tab.complaints)


def _asked(url: str, cookies: CookieJar | None = None, host: str | None = None) -> tuple[int, str]:
    """Status and text of an answer."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(cookies))
    request = urllib.request.Request(url, headers={} if host is None else {"Host": host})
    try:
        with opener.open(request, timeout=10.0) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_the_address_on_the_network_serves_once() -> None:
    said: list[str] = []
    with LivePage(said.append, "0.0.0.0", 0) as page:
        first = page.url.replace(str(urlsplit(page.url).hostname), "127.0.0.1")
        origin = first.partition("?")[0]
        phone = CookieJar()
        assert _asked(origin)[0] == 403
        assert _asked(f"{origin}events")[0] == 403
        assert _asked(first, phone)[0] == 200
        assert _asked(origin, phone)[0] == 200, "the cookie is kept"
        assert _asked(first)[0] == 403, "used before"
        assert page.url in said[-1]
        assert page.url.partition("?")[2] != first.partition("?")[2]


def test_a_phone_reads_the_address_from_the_terminal() -> None:
    console = Console(force_terminal=True, width=100, record=True, file=io.StringIO())
    address = "http://192.168.100.200:8766/?token=ed9855c552"
    Screen(console).show_address(address)
    rows = [list(line.ljust(37)) for line in console.export_text().splitlines()]
    cells = np.array(rows)
    dark = np.stack([np.isin(cells, ["▀", "█"]), np.isin(cells, ["▄", "█"])], axis=1).reshape(-1, cells.shape[1])
    picture = cv2.resize(np.where(dark, 0, 255).astype(np.uint8), None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == address


class Link:
    """A network between a browser and a server: what goes through it can be held up without anybody being told."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._held: list[threading.Event] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def hold(self) -> None:
        """Whatever is connected by now gets nothing any more."""
        for event in self._held:
            event.set()

    def _accept(self) -> None:
        while True:
            near = self._listening.accept()[0]
            far = socket.create_connection(("127.0.0.1", self._to))
            held = threading.Event()
            self._held.append(held)
            for a, b in ((near, far), (far, near)):
                threading.Thread(target=self._pass, args=(a, b, held), daemon=True).start()

    def _pass(self, a: socket.socket, b: socket.socket, held: threading.Event) -> None:
        with suppress(OSError):
            while data := a.recv(1 << 16):
                if held.is_set():
                    return
                b.sendall(data)
            b.shutdown(socket.SHUT_WR)


@needs_browser
@pytest.mark.slow
def test_a_connection_on_which_nothing_comes_is_made_anew(tmp_path: Path) -> None:
    with LivePage(print, port=0) as page, Tab(tmp_path) as tab:
        link = Link(int(urlsplit(page.url).port or 0))
        page.show(_view(1.0, 1e-2))
        tab.open(f"http://127.0.0.1:{link.port}/")
        tab.wait(f"{WORDS} === 'Sway the carrier about its x'")
        time.sleep(10.0)
        assert not tab.value(LOST), "the server says that it is there"
        link.hold()
        page.show(_view(2.0, 1e-4))
        began = time.monotonic()
        tab.wait(f"{WORDS} === 'You may stop'", 15.0)
        assert 5.0 < time.monotonic() - began < 12.0


def test_on_this_machine_other_names_are_refused() -> None:
    """A page from elsewhere whose name was made to lead here."""
    with LivePage(print, port=0) as page:
        assert _asked(page.url)[0] == 200
        assert _asked(page.url, host="elsewhere.example")[0] == 403
        with pytest.raises(InputError, match=r"--page: no server can be started at 127\.0\.0\.1 port \d+"):
            LivePage(print, port=int(urlsplit(page.url).port or 0))


def test_nothing_on_the_page_comes_from_elsewhere() -> None:
    with LivePage(print, port=0) as page:
        text = _asked(page.url)[1]
    assert "//" not in text.replace("// ", "")


def test_without_starlette_the_page_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "starlette.applications", None)
    with pytest.raises(InputError, match=r"--page needs starlette and uvicorn.*alidade\[serve\]"):
        LivePage(print)


# Short ones that reach what is wanted, and how many times as fast as they were recorded they are played.
RECORDINGS = {
    "los": ("{duration_s: 40, gyro_rate_hz: 100, gimbal_rate_hz: 100, image_rate_hz: 20}", 5.0),
    "indexer": ("{gyro_rate_hz: 50, encoder_rate_hz: 50}", 25.0),
    "head": ("head_mounts", 5.0),
    "cube": ("{poses: 18}", 6.0),
    "tumble": ("{}", 5.0),
}


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_followed_on_a_phone_and_on_a_desktop(name: str, tmp_path: Path) -> None:
    scenario, speed = RECORDINGS[name]
    if scenario.startswith("{"):
        (tmp_path / "scenario.yaml").write_text(scenario)
        scenario = str(tmp_path / "scenario.yaml")
    simulate(name, scenario, 1, tmp_path / "whole.mcap")
    with (tmp_path / "whole.mcap").open("rb") as stream:
        for attachment in make_reader(stream).iter_attachments():
            (tmp_path / attachment.name).write_bytes(attachment.data)
    whole = messages(tmp_path / "whole.mcap")

    def record() -> None:
        with (tmp_path / "s.mcap").open("wb") as out:
            write(paced(whole, speed), out, 4_000)

    seen: list[dict[str, Any]] = []

    def look(page: LivePage) -> None:
        with Tab(tmp_path) as tab:
            tab.open(page.url)
            while threading.main_thread().is_alive():
                for width in (PHONE, DESKTOP):
                    tab.size(width)
                    seen.append(
                        {
                            "words": tab.value(WORDS),
                            "drawn": tab.value("document.querySelectorAll('#picture svg').length"),
                            "lines": tab.value(
                                "[...document.querySelectorAll('#parameters .how')].map(e => e.textContent)"
                            ),
                            "overflow": tab.overflow(),
                            "complaints": list(tab.complaints),
                        }
                    )
                if str(seen[-1]["words"]).startswith("The recording "):
                    return
                time.sleep(0.2)

    with LivePage(print, port=0, name=f"{name}.mcap") as page:
        threads = [threading.Thread(target=record, daemon=True), threading.Thread(target=look, args=(page,))]
        for thread in threads:
            thread.start()
        settings = Settings(config=tmp_path / "alidade.yaml", patience=60.0)
        calibration = Follower(Source(tmp_path / "s.mcap"), settings, page.show, page.say, lambda: False).follow()
        page.end(calibration)
        threads[1].join(30.0)

    assert calibration.status == "calibrated"
    words = [one["words"] for one in seen]
    assert words[-1] == "The recording has ended: calibrated"
    assert "You may stop" in words
    asked = [one for one in seen if one["words"] not in (words[-1], "You may stop", "Waiting for the recording")]
    assert any(one["drawn"] for one in asked), "it was to say what to do, with a picture"
    assert all(one["overflow"] == [] and one["complaints"] == [] for one in seen)
    sigmas = [_sigmas(one["lines"]) for one in seen]
    first, last = next(one for one in sigmas if one), sigmas[-1]
    assert np.median(last) < 0.7 * np.median(first), "sigmas were to fall"


def _sigmas(lines: list[str]) -> list[float]:
    """What stands before the units."""
    return [float(line.split()[1].rstrip(",")) for line in lines if line.startswith("± ")]
