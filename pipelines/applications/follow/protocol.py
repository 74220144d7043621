"""What of Foxglove's WebSocket protocol is spoken here, as a client and as a server (foxglove-websocket v1)."""

from __future__ import annotations

import struct
from typing import Any

from alidade.pipelines.errors import InputError

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
# Binary: opcode, subscription, time in ns, then the message.
MESSAGE_DATA = 1
MESSAGE_HEAD = struct.Struct("<BIQ")


def websockets() -> Any:
    """The library. Raises InputError when it is not installed."""
    try:
        import websockets.sync.client
        import websockets.sync.server
    except ImportError as error:
        raise InputError(
            "ws:// and --serve need websockets, which is not installed: pip install 'alidade[live]'"
        ) from error
    return websockets
