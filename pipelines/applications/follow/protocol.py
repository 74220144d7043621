"""The part of Foxglove's protocol, foxglove-websocket v1, that the client of a bridge and the server of `serve` use."""

from __future__ import annotations

import struct
from typing import Any

from pydantic_core import from_json

from alidade.pipelines.errors import InputError

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
# Binary: opcode, subscription, time in ns, then the message.
MESSAGE_DATA = 1
MESSAGE_HEAD = struct.Struct("<BIQ")
# Channels and subscriptions are numbered with 32 bits.
LARGEST_ID = (1 << 32) - 1


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
