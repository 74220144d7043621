"""`alidade follow`: the follower, its screen, its server and its page put together."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from rich.console import Console

from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.page import LivePage
from alidade.pipelines.applications.follow.screen import Screen
from alidade.pipelines.applications.follow.serve import LiveServer
from alidade.pipelines.applications.follow.sources import source_of
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.terminal import console


def follow(
    what: str,
    settings: Settings,
    port: int | None,
    record: Path | None = None,
    on_stderr: bool = False,
    page_at: tuple[str, int] | None = None,
) -> Calibration:
    """Follow a recording until it ends, shown in the terminal, with a port served on it, and on a page.

    The first Ctrl-C ends it with what is there, the second at once. Raises as `source_of` and `Follower.follow` do.

    Args:
        what: a path, ws://host:port, or - for standard input.
        settings: how.
        port: of the server.
        record: folder where streams are kept.
        on_stderr: show it there, for standard output is a program's.
        page_at: host and port of the page; None: there is none.
    """
    with ExitStack() as stack:
        server = None if port is None else stack.enter_context(LiveServer(port))
        stopped = stack.enter_context(_interrupted())
        screen = stack.enter_context(Screen(Console(stderr=True, highlight=False) if on_stderr else console))
        if server is not None:
            screen.say(f"estimates live at {server.url} (Foxglove: open connection)")

        page = None if page_at is None else stack.enter_context(LivePage(screen.say, *page_at, name=what))
        if page is not None:
            screen.say(f"page at {page.url}")
            if page.is_open:
                screen.show_address(page.url)

        def show(view: View) -> None:
            screen.show(view)
            for each in (server, page):
                if each is not None:
                    each.show(view)

        def say(sentence: str) -> None:
            screen.say(sentence)
            if page is not None:
                page.say(sentence)

        source = stack.enter_context(source_of(what, record, say))
        calibration = Follower(source, settings, show, say, stopped.is_set).follow()
        if page is not None:
            page.end(calibration)
        return calibration


@contextmanager
def _interrupted() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the next one is as ever."""
    event = threading.Event()

    def heard(_: int, __: FrameType | None) -> None:
        event.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, heard)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)
