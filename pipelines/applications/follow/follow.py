"""`alidade follow`: the follower with its server, its page, and its screen, which a terminal changes in place."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.text import Text

from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.page import LivePage
from alidade.pipelines.applications.follow.serve import LiveServer
from alidade.pipelines.applications.follow.sources import Replay, source_of
from alidade.pipelines.display.table import Cell, Column, Row, Table
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.terminal import console, rich_table

_STOPPING = "stopping: what is there is solved now; Ctrl-C again ends at once, without a result"
# Readers want four light modules around the code; the encoder leaves two.
_QUIET = 2
# Two modules above each other are one character, by whether the upper and the lower one are dark.
_HALVES = {(False, False): " ", (True, False): "▀", (False, True): "▄", (True, True): "█"}
# A line at most this often where there is no terminal, s.
_LINE = 5.0


def follow(
    what: str,
    settings: Settings,
    port: int | None,
    record: Path | None = None,
    on_stderr: bool = False,
    page_at: tuple[str, int] | None = None,
    origins: Sequence[str] = (),
    speed: float | None = None,
) -> Calibration:
    """Follow a recording until it ends, in the terminal, on a port for Foxglove and on a page.

    The first Ctrl-C ends it with what is there, the second at once. A server or page that fails is given up, and costs
    nothing else. Raises as `source_of` and `Follower.follow` do.

    Args:
        what: a path, ws://host:port, or - for standard input.
        settings: of the follower.
        port, page_at: of the server; host and port of the page. None: there is none.
        record: folder where streams are kept.
        on_stderr: show it there, for standard output is a program's.
        origins: pages of other sites that may read what the server serves.
        speed: replay a finished recording at so many times its own; None: follow one that is being made.
    """
    with ExitStack() as stack:
        server = None if port is None else stack.enter_context(LiveServer(port, origins))
        screen = stack.enter_context(Screen(Console(stderr=True, highlight=False) if on_stderr else console))
        stopped = stack.enter_context(_interrupted(lambda: screen.say(_STOPPING)))
        if server is not None:
            screen.say(f"estimates live at {server.url} (Foxglove: open connection)")

        name = "standard input" if what == "-" else what
        page = None if page_at is None else stack.enter_context(LivePage(screen.say, *page_at, name=name))
        if page is not None:
            screen.say(f"page at {page.url}")
            if page.is_open:
                screen.show_address(page.url)

        watching: list[LiveServer | LivePage] = [each for each in (server, page) if each is not None]

        def show(view: View) -> None:
            screen.show(view)
            for each in list(watching):
                try:
                    each.show(view)
                except Exception as error:  # whoever looks on must not end the run
                    watching.remove(each)
                    screen.say(f"{each.url} shows nothing new any more ({type(error).__name__}: {error})")

        def say(sentence: str) -> None:
            screen.say(sentence)
            if page in watching and page is not None:
                page.say(sentence)

        made = source_of(what, record, say) if speed is None else Replay(Path(what), speed, record, say)
        source = stack.enter_context(made)
        calibration = Follower(source, settings, show, say, stopped.is_set).follow()
        if page in watching and page is not None:
            page.end(calibration)
        return calibration


@contextmanager
def _interrupted(answer: Callable[[], None]) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets, which also calls `answer`; the second one interrupts as usual."""
    event = threading.Event()

    def heard(_: int, __: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        event.set()
        threading.Thread(target=answer, daemon=True).start()  # the screen may be drawn right now

    before = signal.signal(signal.SIGINT, heard)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)


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
