"""The state of a recording being followed, live over Foxglove's WebSocket.

One topic per parameter, `/estimate/<parameter>`, with the fields of estimates.mcap (value, sigma, lower, upper) so that
one layout shows both, and what is required; `/status` says the rest in words. JSON messages with a schema.
"""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any

from pipelines.errors import InputError
from pipelines.follow.guidance import View

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView, Client

# Others on the network have no business with a calibration bench.
HOST = "127.0.0.1"
PORT = 8765  # Foxglove's own

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_ESTIMATE = {
    "title": "alidade.Estimate",
    "type": "object",
    "properties": {**dict.fromkeys(("value", "sigma", "lower", "upper", "require"), _NUMBER), "verdict": _TEXT},
}
_STATUS = {
    "title": "alidade.Status",
    "type": "object",
    "properties": {
        "time_s": _NUMBER,
        "status": _TEXT,
        "headline": _TEXT,
        "missing": {"type": "array", "items": _TEXT},
        "collected": {"type": "array", "items": {"type": "object", "properties": {"what": _TEXT, "have": _TEXT}}},
    },
}


class LiveServer:
    """A server on the loopback interface; a context.

    Raises InputError when foxglove-sdk is not installed or the port is taken.
    """

    def __init__(self, port: int = PORT) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise InputError(
                "--serve needs foxglove-sdk, which is not installed: pip install 'alidade[serve]'"
            ) from error
        self._context = foxglove.Context()
        self._channels: dict[str, Channel] = {}
        self._last: dict[str, tuple[dict[str, Any], int]] = {}
        try:
            self._server = foxglove.start_server(
                name="alidade", host=HOST, port=port, context=self._context, server_listener=self
            )
        except (RuntimeError, OSError) as error:
            raise InputError(f"--port {port}: no server can be started there ({error}); give another") from error

    @property
    def url(self) -> str:
        """What to open in Foxglove."""
        return f"ws://{HOST}:{self._server.port}"

    def __enter__(self) -> LiveServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.stop()

    def show(self, view: View) -> None:
        """Send a view to whoever is connected; its log time is that of the recording."""
        at = view.epoch_ns + round(view.time * 1e9)
        if view.values is not None and view.sigmas is not None and view.assessment is not None:
            for q, value, sigma in zip(view.quantities, view.values.tolist(), view.sigmas.tolist(), strict=True):
                message = {
                    "value": value,
                    "sigma": sigma,
                    "lower": value - sigma,
                    "upper": value + sigma,
                }
                if q.judged:
                    message |= {"require": q.require, "verdict": view.assessment.verdicts[q.name]}
                self._log(f"/estimate/{q.name}", _ESTIMATE, {"unit": q.unit}, message, at)
        status = {
            "time_s": view.time,
            "status": "" if view.assessment is None else view.assessment.status,
            "headline": view.headline,
            "missing": list(view.missing),
            "collected": [{"what": c.what, "have": c.have, "wanted": c.wanted} for c in view.checklist],
        }
        self._log("/status", _STATUS, {}, status, at)

    def _log(
        self, topic: str, schema: dict[str, Any], metadata: dict[str, str], message: dict[str, Any], at: int
    ) -> None:
        from foxglove import Channel

        if topic not in self._channels:
            self._channels[topic] = Channel(
                topic, schema=schema, message_encoding="json", context=self._context, metadata=metadata
            )
        self._last[topic] = message, at
        self._channels[topic].log(message, log_time=at)

    # -- what foxglove-sdk asks of a listener

    def on_subscribe(self, _: Client, channel: ChannelView) -> None:
        """Whoever comes late sees the last message at once."""
        if channel.topic in self._last:
            message, at = self._last[channel.topic]
            self._channels[channel.topic].log(message, log_time=at)

    def on_unsubscribe(self, _: Client, __: ChannelView) -> None:
        """Nothing to do."""
