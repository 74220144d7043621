"""What the client of a bridge and the servers of `follow` share: Foxglove's protocol, and limits on connections.

    gate.admit(connection, address, close)    # may close another one
    gate.trust(connection)                    # it has shown that it may read
    gate.release(connection)

Of foxglove-websocket v1 here is the part that both sides use. Connections to a server are counted in all and per
address, those that have shown nothing yet and those that may read apart, and of too many the oldest goes: idle
connections, however many, keep nobody out who says at once what it wants, nor do streams that a lost network left.
"""

from __future__ import annotations

import ipaddress
import struct
import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from pydantic_core import from_json

from alidade.pipelines.errors import InputError

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
# Binary: opcode, subscription, time in ns, then the message.
MESSAGE_DATA = 1
MESSAGE_HEAD = struct.Struct("<BIQ")
# Channels and subscriptions are numbered with 32 bits.
LARGEST_ID = (1 << 32) - 1
# Connections of either kind in all and from one address: a dozen devices, and what a lost network left of some; far
# below the 1024 files that a process may have open.
MAX_CONNECTIONS, MAX_PER_ADDRESS = 64, 16
# A connection that has not shown in this time that it may read is closed, s.
HANDSHAKE_TIME_S = 5.0
# Wrong tokens of one address at once, and s for each further one; addresses that are remembered.
MAX_ATTEMPTS, ATTEMPT_PERIOD_S, MAX_ADDRESSES = 10, 10.0, 1024


class RefusedError(Exception):
    """Raised at a message from the other side that breaks the protocol, with the reason as text."""


def read_message(text: str) -> dict[str, Any]:
    """Parse a text message: a JSON object of numbers and Unicode text. Raises RefusedError."""
    try:
        content = from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise RefusedError("no JSON") from error
    if not isinstance(content, dict):
        raise RefusedError("no JSON object")
    return content


def read_id(value: Any) -> int:
    """Check and return the number of a channel or a subscription. Raises RefusedError."""
    if type(value) is not int or not 0 <= value <= LARGEST_ID:
        raise RefusedError("a number of a channel that is none")
    return value


def websockets() -> Any:
    """Import the library websockets. Raises InputError when it is not installed."""
    try:
        import websockets.sync.client
        import websockets.sync.server
    except ImportError as error:
        raise InputError(
            "ws:// and --serve need websockets, which is not installed: pip install 'alidade[live]'"
        ) from error
    return websockets


@dataclass
class _Admitted:
    address: str
    close: Callable[[], None]
    trusted: bool = False


class Gate:
    """Limit on the number of connections of a server; safe in any thread.

    Args:
        most: connections of either kind.
        per_address: of these, from one address.
    """

    def __init__(self, most: int = MAX_CONNECTIONS, per_address: int = MAX_PER_ADDRESS) -> None:
        self._most, self._per_address = most, per_address
        self._admitted: dict[Hashable, _Admitted] = {}  # the oldest first
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._admitted)

    def admit(self, connection: Hashable, address: str, close: Callable[[], None]) -> None:
        """Admit a connection that is not trusted yet; close the oldest such one if there are too many."""
        with self._lock:
            admitted = self._admitted[connection] = _Admitted(network_of(address), close)
            gone = self._surplus(admitted)
        if gone is not None:
            gone.close()

    def trust(self, connection: Hashable) -> None:
        """Mark a connection as trusted to read; close the oldest trusted one if there are too many."""
        with self._lock:
            admitted = self._admitted.pop(connection, None)
            if admitted is None:
                return
            admitted.trusted = True
            self._admitted[connection] = admitted
            gone = self._surplus(admitted)
        if gone is not None:
            gone.close()

    def close_untrusted(self, connection: Hashable) -> None:
        """Close a connection unless it has been trusted by now."""
        with self._lock:
            each = self._admitted.get(connection)
            gone = self._admitted.pop(connection) if each is not None and not each.trusted else None
        if gone is not None:
            gone.close()

    def release(self, connection: Hashable) -> None:
        """Count a connection as closed."""
        with self._lock:
            self._admitted.pop(connection, None)

    def _surplus(self, new: _Admitted) -> _Admitted | None:
        """Remove and return the oldest connection of the same trust if a new one is one too many; else None."""
        same = [key for key, each in self._admitted.items() if each.trusted == new.trusted]
        own = [key for key in same if self._admitted[key].address == new.address]
        if len(own) > self._per_address:
            return self._admitted.pop(own[0])
        return self._admitted.pop(same[0]) if len(same) > self._most else None


class Attempts:
    """Limit on wrong tokens by address: a few at once, then one at intervals."""

    def __init__(self) -> None:
        self._left: dict[str, tuple[float, float]] = {}  # attempts left, and when that was

    def allowed(self, address: str) -> bool:
        """Whether the address may try a token now."""
        return self._at(network_of(address)) >= 1.0

    def failed(self, address: str) -> None:
        """Count a wrong attempt of an address."""
        address = network_of(address)
        left = self._at(address) - 1.0
        self._left.pop(address, None)
        if len(self._left) >= MAX_ADDRESSES:
            del self._left[next(iter(self._left))]
        self._left[address] = left, time.monotonic()

    def _at(self, address: str) -> float:
        left, when = self._left.get(address, (float(MAX_ATTEMPTS), 0.0))
        return min(float(MAX_ATTEMPTS), left + (time.monotonic() - when) / ATTEMPT_PERIOD_S)


def network_of(address: str) -> str:
    """Return the address by which a client is counted: of IPv6 its network of 64 bits."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return str(found)
    return str(found.ipv4_mapped or ipaddress.IPv6Network((found, 64), strict=False).network_address)
