"""Messages of any type as tables: a row for each message, a column for each of its numbers and words.

    columns:
      /imu: {file: /fmu/out/sensor_combined, time: timestamp, unit: us, gyro: ['gyro_rad[0]', 'gyro_rad[1]', ...]}

So what a laboratory's own messages mean is described as the columns of a text file are. The last column is that of the
times at which the messages were recorded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.container import Container, MultiPartContainer
from alidade.pipelines.recording.decoding import LOG_TIME, MessageFormat
from alidade.pipelines.recording.messages import SENSORS, MessageError
from alidade.pipelines.recording.table_values import unit_in
from alidade.pipelines.recording.tables import TableHead


class MessageTable:
    """Table of the messages of one topic.

    Args:
        container: where the messages are.
        name: of the topic.
        formats: of its channels.
    """

    def __init__(self, container: Container, name: str, formats: Mapping[int, MessageFormat]) -> None:
        self.name, self._container, self._formats = name, container, formats

    @property
    def is_known(self) -> bool:
        """Whether the messages are of a type that is read as it is."""
        return any(each.type in SENSORS for each in self._formats.values())

    @cached_property
    def form(self) -> TableHead:
        """Names of the columns, those of the first message. Raises InputError."""
        path = self._container.path / self.name.strip("/")
        for number, block in self._container.first_blocks(self._formats).items():
            try:
                names = tuple(next(self._formats[number].cells(block)))
            except MessageError as error:
                raise InputError(f"{self._container.path}: topic {self.name}: {error}") from error
            return TableHead(path, names, tuple("ns" if n == LOG_TIME else unit_in(n) for n in names), ())
        return TableHead(path, (), (), ())

    def read(self, names: Sequence[str], most: int | None = None) -> tuple[dict[str, NDArray[np.str_]], list[str]]:
        """Return the named columns as texts, empty where a message lacks the field; and no sentences.

        Args:
            names: of the columns.
            most: number of messages after which no more are looked at; None for all.

        Raises:
            InputError: a column is missing, or a message cannot be read.
        """
        wanted = [self.form.names[self.form.index(name)] for name in names]
        parts: list[list[NDArray[np.str_]]] = []
        count = 0
        for block in self._container.blocks(set(self._formats)):
            try:
                parts.append(self._formats[block.channel].texts(block, wanted))
            except MessageError as error:
                raise InputError(f"{self._container.path}: topic {self.name}: {error}") from error
            count += len(block.start)
            if most is not None and count >= most:
                break
        texts = [np.concatenate(column) for column in zip(*parts, strict=True)] or [np.empty(0, np.str_)] * len(names)
        return dict(zip(names, texts, strict=True)), []


class WithTables(MultiPartContainer):
    """A recording with topics that are made of its own messages.

    Args:
        recorded: the recording.
        made: topics of its messages.
    """

    def __init__(self, recorded: Container, made: Container) -> None:
        super().__init__(recorded.path, [recorded, made])
        self._recorded = recorded
        self.assumptions, self.incomplete = recorded.assumptions, recorded.incomplete

    def sha256(self) -> str:
        """SHA-256 of the recording, hexadecimal."""
        return self._recorded.sha256()


def message_tables(container: Container) -> dict[str, MessageTable]:
    """Return the topics of a recording as tables, by name."""
    formats: dict[str, dict[int, MessageFormat]] = {}
    for number, channel in container.channels.items():
        found = MessageFormat(channel, container.schemas.get(channel.schema_id))
        if found.is_parsed and container.counts.get(number):
            formats.setdefault(channel.topic, {})[number] = found
    return {name: MessageTable(container, name, own) for name, own in formats.items()}
