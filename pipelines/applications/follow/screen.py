"""Terminal output of `alidade follow`: a page that changes in place, or plain lines without a terminal."""

from __future__ import annotations

import time

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.text import Text

from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.display.table import Cell, Column, Row, Table
from alidade.pipelines.reports.terminal import rich_table

# Readers want four light modules around the code; the encoder leaves two.
_QUIET = 2
# Two modules above each other are one character, by whether the upper and the lower one are dark.
_HALVES = {(False, False): " ", (True, False): "▀", (False, True): "▄", (True, True): "█"}
# A line at most this often where there is no terminal, s.
_LINE = 5.0


class Screen:
    """Context manager that shows views on the terminal as they come."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._last, self._headline = -_LINE, ""

    def __enter__(self) -> Screen:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print one line above the changing view."""
        self._console.print(escape(text), soft_wrap=True)

    def show_address(self, address: str) -> None:
        """Print an address as a QR code, where there is a terminal to show it to a phone."""
        if self._console.is_terminal:
            self._console.print(qr(address))

    def show(self, view: View) -> None:
        """Show the current state."""
        if self._live is not None:
            self._live.update(_page(view), refresh=True)
            return
        now = time.monotonic()
        if now - self._last >= _LINE or view.headline != self._headline:
            self._last, self._headline = now, view.headline
            wanted = f"; next: {view.motion.advice}" if view.motion else ""
            self.say(f"{view.time:.1f} s: {view.headline}{wanted}")


def _page(view: View) -> Group:
    headline = Text(f"{view.time:.1f} s: {view.headline}", style="bold green" if view.done else "bold")
    motion = [Text(f"next: {view.motion.advice}", style="bold")] if view.motion else []
    return Group(headline, *motion, *map(rich_table, (_parameters(view), _collected(view))))


def _parameters(view: View) -> Table:
    rows: list[Row] = []
    for row in view.rows:
        verdict = row.get("verdict", "")
        numbers = (row.get("value", ""), row.get("sigma", ""), row["require"])
        rows.append((row["name"], row["unit"], *numbers, Cell(verdict, tone=verdict)))
    few = f", the least accurate of {len(view.estimated)}" if len(view.shown) < len(view.estimated) else ""
    columns = (f"parameter{few}", Column("unit", "text"), "value", "sigma", "required", Column("verdict", "text"))
    return Table("", "", columns, tuple(rows))


def _collected(view: View) -> Table:
    rows = tuple((c.what, c.have, c.wanted or Cell("enough", tone="good")) for c in view.checklist)
    return Table("", "", ("collected", Column("so far", "text"), Column("still wanted", "text")), rows)


def qr(address: str) -> Text:
    """Return an address as a QR code for a phone's camera, black on white whatever the terminal's own colours."""
    import cv2  # takes long, and most runs show no code

    dark = np.pad(cv2.QRCodeEncoder.create().encode(address) == 0, _QUIET)
    rows = dark if len(dark) % 2 == 0 else np.vstack([dark, np.zeros_like(dark[:1])])
    lines = [
        "".join(_HALVES[bool(a), bool(b)] for a, b in zip(upper, lower, strict=True))
        for upper, lower in zip(rows[::2], rows[1::2], strict=True)
    ]
    return Text("\n".join(lines), style="black on white", no_wrap=True)
