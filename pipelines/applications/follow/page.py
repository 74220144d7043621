"""Page for the person who holds the device: the motion to make now, the progress, and when to stop.

    with LivePage(say) as page:      # http://127.0.0.1:8766
        page.show(view)

One document without anything from elsewhere, and server-sent events that each have the whole state, so that whoever
comes late, or comes back, has it at once. On the loopback interface whoever asks is answered if they ask for this
machine by name, so that other pages in the browser cannot read along. On any other address only who has come by the
one-time token is; what it was traded for is kept in a cookie. Connections are bounded in number, and in time until they
have shown that they may read; wrong tokens are counted by address.
"""

from __future__ import annotations

import asyncio
import base64
import ipaddress
import math
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from pydantic_core import to_json

from alidade.pipelines.applications.follow.guidance import WAITING, View
from alidade.pipelines.applications.follow.network import HANDSHAKE_TIME_S, MAX_CONNECTIONS, Attempts, Gate
from alidade.pipelines.errors import InputError, printable
from alidade.pipelines.reports.result import Calibration

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

HOST, PORT = "127.0.0.1", 8766

# A client is sent what is new this often, and of nothing new that often, s: the page takes longer silence for a dead
# connection.
_GLANCE, _ALIVE = 0.2, 2.0
# Browsers that have lost the server come back after this, ms.
_RETRY = 1000
# Points of a sparkline; of twice as many every other one is kept.
_POINTS = 60
# Sentences kept, and for how long, s.
_NOTES, _FRESH = 3, 30.0
# Letters of a sentence.
_MAX_NOTE = 2000
# Machines beyond every network (RFC 5737, RFC 3849): what would be sent there goes out by the address that others see.
# Nothing is sent.
_ELSEWHERE = {socket.AF_INET: ("192.0.2.1", 9), socket.AF_INET6: ("2001:db8::1", 9)}
_PAGE = Path(__file__).parent / "templates" / "live.html"
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    # A browser that has lost the network would try the idle connections that it kept first, one every few seconds.
    "Connection": "close",
}


class LivePage:
    """Context manager that serves the live page.

    Raises InputError when starlette or uvicorn is not installed, or there is no such address or no port free there.

    Args:
        say: called with where the next device finds the page once a token has been used.
        host: address of this machine to be reached by; the loopback one is for this machine alone, any other
            `is_open` to others, by a token.
        port: 0: any that is free.
        name: of the recording.
    """

    def __init__(self, say: Callable[[str], None], host: str = HOST, port: int = PORT, name: str = "") -> None:
        try:
            import starlette.applications
            import starlette.routing
            import uvicorn
        except ImportError as error:
            raise InputError(
                "--page needs starlette and uvicorn, which are not installed: pip install 'alidade[serve]'"
            ) from error
        self._say, self._host = say, host
        self._socket, self._families = _listening(host, port)
        self._port = self._socket.getsockname()[1]
        self.is_open = not ipaddress.ip_address(self._socket.getsockname()[0]).is_loopback
        self._token, self._key = _token(), secrets.token_urlsafe(32)
        self._gate, self._attempts = Gate(), Attempts()
        self._histories: dict[str, list[tuple[float, float]]] = {}
        self._state: dict[str, Any] = {"name": printable(name), "notes": [], "over": None}
        self._noted: list[tuple[float, str]] = []  # when, and what
        self._lock = threading.Lock()  # sources speak from threads of their own
        self._event = (0, "")  # number and text of the last one
        self._over = False
        app = starlette.applications.Starlette(
            routes=[
                starlette.routing.Route("/", self._document),
                starlette.routing.Route("/events", self._events),
            ]
        )
        self._server = uvicorn.Server(
            uvicorn.Config(
                app,
                http=_bounded(self._gate),
                log_config=None,
                log_level="critical",
                lifespan="off",
                ws="none",
                # So many are taken in at once, and counted before the next: all that wait would exhaust the open files.
                backlog=MAX_CONNECTIONS,
                timeout_graceful_shutdown=1,
            )
        )
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="page", daemon=True
        )

    @property
    def url(self) -> str:
        """Address of the page, for a browser."""
        host = self._host
        if self.is_open and ipaddress.ip_address(self._socket.getsockname()[0]).is_unspecified:
            host = _outward(self._families)
        address = f"http://{f'[{host}]' if ':' in host else host}:{self._port}/"
        return f"{address}?token={self._token}" if self.is_open else address

    def __enter__(self) -> LivePage:
        self._thread.start()
        self._publish()
        return self

    def __exit__(self, _: object, error: object, __: object) -> None:
        if isinstance(error, Exception):
            self._end("failed", str(error))
        self._over = self._server.should_exit = True
        self._thread.join(3.0)
        self._socket.close()

    def show(self, view: View) -> None:
        """Show the current state on the page."""
        self._remember(view)
        if view.covariance is not None:
            self._noted = [note for note in self._noted if not note[1].startswith(WAITING)]
        motion = view.motion
        self._publish(
            **view.summary,
            notes=self._notes(),
            done=view.done,
            alarms=list(view.alarms),
            now=None if motion is None else {"words": motion.words, "why": motion.why, "picture": motion.picture},
            coverage=[{"what": c.what, "share": c.share, "chart": c.chart} for c in view.checklist],
            parameters=self._parameters(view),
            estimated=len(view.estimated),
            reached=len(set(view.estimated) - set(view.short)),
        )

    def say(self, sentence: str) -> None:
        """Show a sentence on the page for a while."""
        self._noted = [*self._noted, (time.monotonic(), printable(sentence, _MAX_NOTE))][-_NOTES:]
        self._publish(notes=self._notes())

    def end(self, calibration: Calibration) -> None:
        """Show the result on the page."""
        self._end(calibration.status, calibration.headline)

    # -- the state

    def _end(self, status: str, headline: str) -> None:
        self._publish(over={"status": status, "headline": headline})

    def _publish(self, **changed: Any) -> None:
        """Send the state, with what changed in it, to all clients."""
        with self._lock:
            self._state |= changed
            self._event = (self._event[0] + 1, to_json(self._state, inf_nan_mode="null").decode())

    def _notes(self) -> list[str]:
        return [sentence for at, sentence in self._noted if time.monotonic() - at < _FRESH]

    def _remember(self, view: View) -> None:
        """Add to the histories log10 of each sigma over its required value, at the view's time."""
        if view.sigmas is None:
            return
        for q, sigma in zip(view.quantities, view.sigmas.tolist(), strict=True):
            ratio = sigma / q.require
            if not (math.isfinite(ratio) and ratio > 0.0):
                continue
            history = self._histories.setdefault(q.name, [])
            if history and view.time < history[-1][0]:  # begun anew
                history.clear()
            history.append((round(view.time, 1), round(math.log10(ratio), 2)))
            if len(history) > 2 * _POINTS:
                del history[1:-1:2]

    def _parameters(self, view: View) -> list[dict[str, Any]]:
        """Return the rows of a view in the page's units, with the history of each parameter."""
        return [
            {**row, "unit": row["unit"].replace("^2", "²").strip("1"), "history": self._histories.get(row["name"], [])}
            for row in view.rows
        ]

    # -- answers

    def _is_authorised(self, request: Request) -> bool:
        """Whether a request may be answered; if so, mark its connection as trusted."""
        known = self._asks_for_this_machine(request) and (
            not self.is_open or _equal(request.cookies.get(self._cookie, ""), self._key)
        )
        if known:
            self._gate.trust(request.state.connection)
        return known

    def _asks_for_this_machine(self, request: Request) -> bool:
        """Whether the Host header is this machine's, not a name that was made to lead here.

        A name that somebody else's DNS has made to lead here is no address, and none of this machine's.
        """
        try:
            host = urlsplit(f"//{request.headers.get('host', '')}").hostname or ""
        except ValueError:
            return False
        if host in {"localhost", self._host.lower(), self._socket.getsockname()[0]}:
            return True
        own = socket.gethostname().lower()
        return self.is_open and (_is_address(host) or host.removesuffix(".local") == own.removesuffix(".local"))

    @property
    def _cookie(self) -> str:
        """Name of the page's cookie, with the port: all ports of a machine share their cookies."""
        return f"alidade-{self._port}"

    async def _document(self, request: Request) -> Response:
        from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse

        if self._is_authorised(request):
            return HTMLResponse(_PAGE.read_text(encoding="utf-8"), headers=_HEADERS)
        token, client = request.query_params.get("token"), request.client.host if request.client else "?"
        if not self.is_open or token is None or not self._asks_for_this_machine(request):
            return PlainTextResponse(_REFUSED, 403, _HEADERS)
        if not self._attempts.allowed(client):
            return PlainTextResponse(_TOO_MANY, 429, _HEADERS)
        if not _equal(token, self._token):
            self._attempts.failed(client)
            return PlainTextResponse(_REFUSED, 403, _HEADERS)
        self._token = _token()
        self._say(f"page opened from {client}; next device: {self.url}")
        answer = RedirectResponse("/", 303)
        answer.set_cookie(self._cookie, self._key, httponly=True, samesite="lax")
        return answer

    async def _events(self, request: Request) -> Response:
        from starlette.responses import PlainTextResponse, StreamingResponse

        if not self._is_authorised(request):
            return PlainTextResponse(_REFUSED, 403, _HEADERS)
        return StreamingResponse(self._stream(), media_type="text/event-stream", headers=_HEADERS)

    async def _stream(self) -> AsyncIterator[str]:
        """The last event, and each that is the last one when it is looked again, until all is over."""
        yield f"retry: {_RETRY}\n\n"
        sent, last = 0, time.monotonic()
        while True:
            is_last = self._over
            number, text = self._event
            if number != sent:
                sent, last = number, time.monotonic()
                yield f"data: {text}\n\n"
            elif time.monotonic() - last > _ALIVE:
                last = time.monotonic()
                yield "event: alive\ndata: 1\n\n"
            if is_last:
                return
            await asyncio.sleep(_GLANCE)


_REFUSED = (
    "This address was used before, or is none of this page. The terminal in which alidade runs shows the next one.\n"
)
_TOO_MANY = "Too many wrong addresses from this device: wait a minute.\n"


def _listening(host: str, port: int) -> tuple[socket.socket, Sequence[socket.AddressFamily]]:
    """Return a listening socket and the address families that reach it; `::` serves IPv4 as well where possible."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        both = family == socket.AF_INET6 and host == "::" and socket.has_dualstack_ipv6()
        listening = socket.create_server((host, port), family=family, dualstack_ipv6=both)
        return listening, (socket.AF_INET, socket.AF_INET6) if both else (family,)
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(f"--page: no server can be started at {host} port {port} ({error}); give another") from error


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _equal(given: str, secret: str) -> bool:
    """Compare a text with a secret in a time that does not depend on where they differ."""
    return secrets.compare_digest(given.encode(errors="replace"), secret.encode())


def _token() -> str:
    """Return a token of 128 random bits, in letters and digits that people can type on a phone, for one use."""
    return base64.b32encode(secrets.token_bytes(16)).decode().rstrip("=").lower()


def _bounded(gate: Gate) -> type[Any]:
    """Return Uvicorn's protocol class with each connection subject to the gate."""
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class BoundedProtocol(H11Protocol):
        """Connection over HTTP that the gate admits and may close."""

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            # Ports are used again: the connection itself is its name, and each of its requests has it.
            self.app_state = {**self.app_state, "connection": self}
            gate.admit(self, self.client[0] if self.client else "?", transport.abort)
            self.loop.call_later(HANDSHAKE_TIME_S, gate.close_untrusted, self)

        def connection_lost(self, exc: Exception | None) -> None:
            gate.release(self)
            super().connection_lost(exc)

    return BoundedProtocol


def _outward(families: Sequence[socket.AddressFamily]) -> str:
    """Return an address of this machine that others on its network reach; the host name without a network."""
    for family in families:
        with socket.socket(family, socket.SOCK_DGRAM) as probe, suppress(OSError):
            probe.connect(_ELSEWHERE[family])
            return str(probe.getsockname()[0])
    return socket.gethostname()
