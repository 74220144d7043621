"""The columns that the messages of a topic of numbers become."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.decoding import Order, Table

_COLUMNS: Mapping[str, Mapping[str, series.Column]] = {
    name: columns
    for kind in (
        series.ImuSeries,
        series.MagneticSeries,
        series.VectorSeries,
        series.QuaternionSeries,
        series.PoseSeries,
        series.FixSeries,
        series.TemperatureSeries,
    )
    for name, columns in ({kind.TYPE: kind.COLUMNS} | kind.OTHERS).items()
}
# Message types that become columns.
NUMBERS = {*_COLUMNS, messages.JOINT_STATE}


class TopicColumns:
    """The columns of a topic: those of a series, or the positions of the joints `names`.

    Attributes:
        table: to be filled.
        fields: of a message, for a Decoder.
        joints: names met in the messages.
    """

    def __init__(self, kind: str, count: int, names: Sequence[str]) -> None:
        self.joints: dict[str, None] = {}
        if kind == messages.JOINT_STATE:
            self.table = Table(count, {"position": (len(names),)})
            self.fields: dict[str, tuple[str, Order | None]] = {"position": ("position", partial(self._order, names))}
        else:
            columns = _COLUMNS[kind]
            self.table = Table(count, {name: column.shape for name, column in columns.items()})
            self.fields = {name: (column.path, _always(column.order)) for name, column in columns.items()}

    def _order(self, names: Sequence[str], message: Any) -> list[int] | None:
        self.joints.update(dict.fromkeys(map(str, message.name)))
        if not set(names) <= set(message.name) or len(message.position) != len(message.name):
            return None
        return [message.name.index(name) for name in names]


def _always(order: tuple[int, ...] | None) -> Order | None:
    return (lambda _: order) if order else None
