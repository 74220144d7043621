"""Pages in a real browser, at the widths of a desktop and of a phone, and on paper.

Chromium is told what to do over its DevTools protocol; one runs for all tests.
"""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium to draw the page; none is installed")

DESKTOP, PHONE = 1280, 390
# A4 between margins of 12 mm, in CSS px.
PAPER = 703
_PATIENCE_S = 60.0

# Elements that stand out of the page to the right, those in a box that scrolls on a screen aside.
_OVERFLOWING = """(() => {
  const width = document.documentElement.clientWidth, paper = matchMedia("print").matches, found = [];
  for (const element of document.querySelectorAll("body *")) {
    const box = element.getBoundingClientRect();
    if (box.right <= width + 1 || box.width == 0 || element.closest("svg")) continue;
    if (!paper && element.parentElement.closest(".scroll, pre")) continue;
    const where = `${element.tagName} ${element.className} ${element.textContent.slice(0, 40)}`;
    found.push(`${where}: ${Math.round(box.right)} of ${width}`);
  }
  return found;
})()"""
_UNDRAWN = "document.querySelectorAll('.plot:not([data-drawn])').length"


@dataclass(frozen=True)
class Look:
    """What a page looks like.

    Attributes:
        figures: that were drawn.
        overflowing: elements that stand out, in words.
        complaints: of the browser: errors, and requests that the page's own policy stops.
        shown_s: until the page and the figures near its top were drawn, s.
    """

    figures: int
    overflowing: list[str]
    complaints: list[str]
    shown_s: float


class Tab:
    """One page of the browser."""

    def __init__(self, socket: Any, session: str, ids: Iterator[int]) -> None:
        self._socket, self._session, self._ids = socket, session, ids
        self.complaints: list[str] = []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> Any:
        """The answer to a command."""
        number = next(self._ids)
        content = {"id": number, "method": method, "params": params, "sessionId": self._session}
        self._socket.send(json.dumps(content))
        while True:
            message = json.loads(self._socket.recv(timeout=_PATIENCE_S))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._heard(message)

    def tell(self, expression: str) -> Any:
        """The value of an expression of the page."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait(self, expression: str) -> None:
        """Until an expression of the page is true."""
        deadline = time.monotonic() + _PATIENCE_S
        while not self.tell(expression):
            assert time.monotonic() < deadline, f"never true: {expression}; {self.complaints}"
            time.sleep(0.02)

    def open(self, path: Path, width: int, dark: bool = False) -> float:
        """Shows a file; returns how long it took until it and the figures in sight were drawn, s."""
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", media="", features=features)
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 600
        )
        began = time.monotonic()
        self.call("Page.navigate", url=path.as_uri())
        self.wait("document.readyState == 'complete'")
        near = "[...document.querySelectorAll('.plot')].filter(p => p.getBoundingClientRect().top < innerHeight)"
        self.wait(f"{near}.every(p => p.dataset.drawn)")
        return time.monotonic() - began

    def paper(self, path: Path) -> None:
        """Prints what is shown."""
        content = self.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
        path.write_bytes(base64.b64decode(content["data"]))

    def picture(self, path: Path) -> None:
        """Takes a picture of the whole page."""
        content = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(content["data"]))

    def _heard(self, message: Any) -> None:
        params = message.get("params", {})
        match message.get("method"):
            case "Runtime.consoleAPICalled":
                self.complaints.append(str([each.get("value") for each in params["args"]]))
            case "Runtime.exceptionThrown":
                self.complaints.append(str(params["exceptionDetails"]))
            case "Log.entryAdded":
                self.complaints.append(params["entry"]["text"])


@contextmanager
def browser() -> Iterator[Tab]:
    """A browser with an empty page."""
    from websockets.sync.client import connect

    profile = Path(tempfile.mkdtemp(prefix="alidade-browser-"))
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync", "--disable-quic")
    quiet = ("--disable-background-networking", "--disable-component-update", "--hide-scrollbars")
    command = [str(CHROMIUM), *flags, *quiet, "--remote-debugging-port=0", f"--user-data-dir={profile}", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port, path = _address(profile / "DevToolsActivePort")
        with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as socket:
            yield _new_tab(socket, itertools.count(1))
    finally:
        process.terminate()
        process.wait(10)
        shutil.rmtree(profile, ignore_errors=True)


def _address(file: Path) -> tuple[str, str]:
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        if file.exists() and len(lines := file.read_text().split()) == 2:
            return lines[0], lines[1]
        time.sleep(0.02)
    raise AssertionError("the browser did not start")


def _new_tab(socket: Any, ids: Iterator[int]) -> Tab:
    def call(method: str, **params: Any) -> Any:
        number = next(ids)
        socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while (message := json.loads(socket.recv(timeout=_PATIENCE_S))).get("id") != number:
            pass
        return message["result"]

    target = call("Target.createTarget", url="about:blank")["targetId"]
    return Tab(socket, call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"], ids)


@cache
def _running() -> Tab:
    """The browser of this run of the tests."""
    import atexit

    context = browser()
    tab = context.__enter__()
    atexit.register(context.__exit__, None, None, None)
    return tab


def look(text: str, folder: Path, width: int) -> Look:
    """What a page looks like at a width in px."""
    tab, path = _running(), folder / "page.html"
    path.write_text(text, encoding="utf-8")
    tab.complaints.clear()
    shown = tab.open(path, width)
    tab.wait(f"{_UNDRAWN} == 0")
    return _seen(tab, shown)


def on_paper() -> Look:
    """What the page that was looked at last is like when it is printed."""
    tab = _running()
    tab.call("Emulation.setEmulatedMedia", media="print")
    tab.call("Emulation.setDeviceMetricsOverride", width=PAPER, height=960, deviceScaleFactor=1, mobile=False)
    return _seen(tab, 0.0)


def _seen(tab: Tab, shown: float) -> Look:
    figures = tab.tell("document.querySelectorAll('.plot[data-drawn]').length")
    return Look(figures, tab.tell(_OVERFLOWING), list(tab.complaints), shown)


def drawn(text: str, folder: Path) -> int:
    """Number of figures a browser draws of a page; nothing may stand out to the right, complain or use the network."""
    seen = [look(text, folder, DESKTOP), on_paper(), look(text, folder, PHONE)]
    for each, where in zip(seen, (f"at {DESKTOP} px", "on paper", f"at {PHONE} px"), strict=True):
        assert not each.complaints, f"{where}: {each.complaints}"
        assert not each.overflowing, f"{where}: too wide: {each.overflowing[:5]}"
    (count,) = {each.figures for each in seen}
    return count
