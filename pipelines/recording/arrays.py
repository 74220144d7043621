"""Arrays as a container: what logs and tables hold becomes messages and goes through the same checks as they do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from alidade.pipelines.recording import series
from alidade.pipelines.recording.container import Channel, Container, Rows, Schema, rows_of
from alidade.pipelines.recording.data_loss import DataLoss
from alidade.pipelines.recording.mcap_records import MESSAGE_HEAD
from alidade.pipelines.recording.message_source import message_source
from alidade.pipelines.recording.messages import definition_text

# Messages at a time; those of any size may be pictures.
_ALIKE, _VARIED = 1 << 14, 4


class ArrayContainer(Container):
    """Topics, name -> series, as messages.

    Args:
        path: of the file or folder they were read from.
        topics: what it holds. Pictures are taken from their iterable anew with each reading.
        remarks: sentences about what is lost or was assumed.
    """

    def __init__(self, path: Path, topics: Mapping[str, series.Topic], remarks: Sequence[str] = ()) -> None:
        self.path, self.data, self.profile = path, path, "ros2"
        self.losses: list[DataLoss] = []
        self._topics, self.remarks = dict(enumerate(topics.values(), start=1)), tuple(remarks)
        self.channels, self.schemas, self.counts = {}, {}, {}
        for number, (name, topic) in enumerate(topics.items(), start=1):
            kind = message_source(number, topic).definition.name
            self.schemas[number] = Schema(number, kind, "ros2msg", definition_text(kind).encode())
            self.channels[number] = Channel(number, name, "cdr", number)
            self.counts[number] = 1 if isinstance(topic, series.CameraInfo) else len(topic)

    def rows(self, channels: set[int]) -> Iterator[Rows]:
        """The messages of these channels, one channel after the other."""
        head = MESSAGE_HEAD.itemsize
        for number in sorted(channels):
            source = message_source(number, self._topics[number])
            step = _VARIED if source.varies else _ALIKE
            for start in range(0, self.counts[number], step):
                log_ns = source.log_ns[start : start + step]
                records = source.take(len(log_ns))
                if source.varies:
                    yield rows_of(number, [record[head:] for record in records], log_ns)
                else:
                    begin = records.shape[1] * np.arange(len(log_ns)) + head
                    yield Rows(number, records.ravel(), begin, np.full(len(log_ns), source.size), log_ns)

    def notes(self, start_ns: int | None, duration_s: float = 0.0) -> tuple[str, ...]:  # noqa: ARG002
        """Nothing is known to be lost."""
        return ()
