"""What `alidade follow` shows: a page that changes in place, or plain lines where there is no terminal."""

from __future__ import annotations

import time
from types import TracebackType

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.display.units import human_unit, rounded, to_digits_of
from alidade.pipelines.reports.terminal import COLOURS

# Readers want four light modules around the code; the encoder leaves two.
_QUIET = 2
# Two modules above each other are one character, by whether the upper and the lower one are dark.
_HALVES = {(False, False): " ", (True, False): "▀", (False, True): "▄", (True, True): "█"}
# A line at most this often where there is no terminal, s.
_LINE = 5.0


class Screen:
    """A context in which views are shown as they come."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._last, self._headline = -_LINE, ""

    def __enter__(self) -> Screen:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """One line that stays."""
        self._console.print(escape(text), soft_wrap=True)

    def show_address(self, address: str) -> None:
        """A QR code, where there is a terminal to show it to a phone."""
        if self._console.is_terminal:
            self._console.print(qr(address))

    def show(self, view: View) -> None:
        """The state by now."""
        if self._live is not None:
            self._live.update(_page(view), refresh=True)
            return
        now = time.monotonic()
        if now - self._last >= _LINE or view.headline != self._headline:
            self._last, self._headline = now, view.headline
            wanted = f"; next: {view.missing[0]}" if view.missing and not view.done else ""
            self.say(f"{view.time:.1f} s: {view.headline}{wanted}")


def _page(view: View) -> Group:
    headline = Text(f"{view.time:.1f} s: {view.headline}", style="bold green" if view.done else "bold")
    parts: list[RenderableType] = [headline, _parameters(view), _collected(view)]
    if not view.done:
        parts += [Text(f"- {sentence}") for sentence in view.missing]
    return Group(*parts)


def _parameters(view: View) -> Table:
    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    table.add_column("parameter", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for column in ("value", "sigma", "required"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    for i in view.shown:
        q = view.quantities[i]
        unit, factor = human_unit(q)
        required = rounded(factor * q.require)
        if view.values is None or view.sigmas is None:
            table.add_row(q.name, unit, "", "", required, "")
            continue
        sigma, verdict = float(view.sigmas[i]), view.verdicts[q.name]
        value = to_digits_of(factor * float(view.values[i]), factor * sigma)
        table.add_row(q.name, unit, value, rounded(factor * sigma), required, f"[{COLOURS[verdict]}]{verdict}[/]")
    if len(view.shown) < len(view.estimated):
        table.caption = f"the least accurate of {len(view.estimated)} parameters"
    return table


def _collected(view: View) -> Table:
    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    table.add_column("collected", no_wrap=True)
    table.add_column("so far")
    table.add_column("still wanted")
    for c in view.checklist:
        table.add_row(c.what, c.have, c.wanted or "[green]enough[/]")
    return table


def qr(address: str) -> Text:
    """An address as a QR code for a phone's camera, dark on light whatever the terminal's own colours are."""
    import cv2  # takes long, and most runs show no code

    dark = np.pad(cv2.QRCodeEncoder.create().encode(address) == 0, _QUIET)
    rows = dark if len(dark) % 2 == 0 else np.vstack([dark, np.zeros_like(dark[:1])])
    lines = [
        "".join(_HALVES[bool(a), bool(b)] for a, b in zip(upper, lower, strict=True))
        for upper, lower in zip(rows[::2], rows[1::2], strict=True)
    ]
    return Text("\n".join(lines), style="black on white", no_wrap=True)
