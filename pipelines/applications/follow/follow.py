"""`alidade follow`: the follower, its screen, its server and its page put together."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

from rich.console import Console

from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.page import LivePage
from alidade.pipelines.applications.follow.screen import Screen
from alidade.pipelines.applications.follow.serve import LiveServer
from alidade.pipelines.applications.follow.sources import Replay, source_of
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.terminal import console

_STOPPING = "stopping: what is there is solved now; Ctrl-C again ends at once, without a result"


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
        settings: how.
        port: of the server.
        record: folder where streams are kept.
        on_stderr: show it there, for standard output is a program's.
        page_at: host and port of the page; None: there is none.
        origins: pages of other sites that may read what the server serves.
        speed: replay a finished recording at so many times its own; None: follow one that is being made.
    """
    with ExitStack() as stack:
        server = None if port is None else stack.enter_context(LiveServer(port, origins))
        screen = stack.enter_context(Screen(Console(stderr=True, highlight=False) if on_stderr else console))
        stopped = stack.enter_context(_interrupted(lambda: screen.say(_STOPPING)))
        if server is not None:
            screen.say(f"estimates live at {server.url} (Foxglove: open connection)")

        page = None if page_at is None else stack.enter_context(LivePage(screen.say, *page_at, name=what))
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
