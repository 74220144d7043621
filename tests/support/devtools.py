"""A browser that stays open, driven over the DevTools protocol: for pages that change by themselves."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from tests.support.browser import CHROMIUM

_STEP = 0.05


class Tab:
    """A page in a browser without a screen; a context.

    Args:
        folder: for the browser's own files.
    """

    def __init__(self, folder: Path) -> None:
        self._stack, self._folder, self._count = ExitStack(), folder, 0
        self.complaints: list[str] = []

    def __enter__(self) -> Tab:
        command = [
            str(CHROMIUM),
            *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
            *("--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0"),
            *(f"--user-data-dir={self._folder / 'profile'}", "about:blank"),
        ]
        browser = self._stack.enter_context(
            subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        )
        self._stack.callback(browser.kill)
        assert browser.stderr is not None
        address = ""
        while not address:
            line = browser.stderr.readline()
            assert line, "the browser did not start"
            found = re.search(r"DevTools listening on (ws://\S+)", line)
            address = found[1] if found else ""
        self._socket = self._stack.enter_context(connect(address, max_size=1 << 26))
        (target,) = [t for t in self._call("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        attached = self._call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._call(f"{domain}.enable")
        # As a person's browser: for a headless one, which is to print, pages draw everything at once.
        self._call("Emulation.setUserAgentOverride", userAgent="Mozilla/5.0 Chrome")
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def size(self, width: int, height: int = 844) -> None:
        """As wide as a phone or a desktop."""
        self._call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )

    def screen(self) -> None:
        """As on a screen, in light colours."""
        self._call(
            "Emulation.setEmulatedMedia", media="screen", features=[{"name": "prefers-color-scheme", "value": "light"}]
        )

    def print(self) -> None:
        """As it is printed."""
        self._call("Emulation.setEmulatedMedia", media="print")

    def pdf(self, path: Path) -> None:
        """What is shown, on paper: as a browser prints it, without figures being told of another width before."""
        self._call("Emulation.setEmulatedMedia", media="", features=[])
        content = self._call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)
        path.write_bytes(base64.b64decode(content["data"]))

    def open(self, url: str) -> None:
        self._call("Page.navigate", url=url)

    def value(self, expression: str) -> Any:
        """Of a JavaScript expression on the page."""
        return self._call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait(self, expression: str, seconds: float = 10.0) -> None:
        """Until a JavaScript expression is true."""
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f"{expression}\n{self.value('document.body.innerText')}"
            time.sleep(_STEP)

    def overflow(self) -> list[str]:
        """What stands out to the right of the window."""
        found = self.value(
            "[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > innerWidth + 0.5"
            " && !e.closest('svg')).map(e => e.tagName + '#' + e.id + ' ' + e.textContent.slice(0, 40))"
            ".concat(document.documentElement.scrollWidth > innerWidth ? ['the page scrolls sideways'] : [])"
        )
        return [str(one) for one in found]

    def picture(self, path: Path) -> None:
        """A PNG of the whole page."""
        shot = self._call("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if hasattr(self, "_session"):
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))
        while True:
            told = json.loads(self._socket.recv(timeout=60.0))
            if told.get("id") == self._count:
                assert "error" not in told, told
                return dict(told["result"])
            if told.get("method") == "Runtime.exceptionThrown":
                self.complaints.append(json.dumps(told["params"]["exceptionDetails"]))
            if told.get("method") == "Log.entryAdded" and told["params"]["entry"]["level"] == "error":
                self.complaints.append(told["params"]["entry"]["text"])
