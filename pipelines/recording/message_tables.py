"""Messages of any type as tables: a row for each message, a column for each of its numbers and words.

    columns:
      /imu: {file: /fmu/out/sensor_combined, time: timestamp, unit: us, gyro: ['gyro_rad[0]', 'gyro_rad[1]', ...]}

So what a laboratory's own messages mean is described as the columns of a text file are. The last column, log_time, is
that of the times at which the messages were recorded, unless they have a field of that name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Stamps
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.container import Container, MessageBlock, MultiPartContainer
from alidade.pipelines.recording.decoding import FIRST_MESSAGES, LOG_TIME, MessageFormat, formats_of
from alidade.pipelines.recording.messages import SENSORS, MessageError
from alidade.pipelines.recording.table_values import unit_in
from alidade.pipelines.recording.tables import MOST_COLUMNS, Columns, TableHead

# Bytes of a message beyond which its numbers are those of a picture or a scan; a pose with covariances has 400.
_LARGEST = 1 << 14
# ns since 1970, of 1973.
_UNIX_NS = 10**17


class MessageTable:
    """Table of the messages of the topic `name` of a container, with the formats of its channels by id."""

    def __init__(self, container: Container, name: str, formats: Mapping[int, MessageFormat]) -> None:
        self.name, self._container, self._formats = name, container, formats

    @property
    def is_proposed(self) -> bool:
        """Whether `info` may propose columns for the topic: its message type is unknown and no message is a picture."""
        is_small = self._first is not None and int(self._first.size.max(initial=0)) <= _LARGEST
        return is_small and not any(each.type in SENSORS for each in self._formats.values())

    @cached_property
    def form(self) -> TableHead:
        """Names of the columns, those of the first messages. Raises InputError."""
        path = self._container.path / self.name.strip("/")
        first: dict[str, object] = {}
        if self._first is not None:
            try:
                for cells in islice(self._formats[self._first.channel].cells(self._first), FIRST_MESSAGES):
                    first = {**cells, **first}
            except MessageError as error:
                raise InputError(f"{self._container.path}: topic {self.name}: {error}") from error
        if len(first) > MOST_COLUMNS:
            raise InputError(f"{self._container.path}: topic {self.name}: its messages have {len(first)} fields")
        names = tuple(sorted(first, key=lambda name: name == LOG_TIME))
        return TableHead(path, names, tuple("ns" if _is_unix_ns(first[n]) else unit_in(n) for n in names), ())

    @cached_property
    def _first(self) -> MessageBlock | None:
        """First block of messages; None without any."""
        return next(self._container.blocks(set(self._formats)), None)

    def read(self, names: Sequence[str], most: int | None = None) -> tuple[Columns, list[str], Stamps]:
        """Return the named columns as texts (N,), empty where a message lacks the field, and log times (N,), Unix ns.

        Between them the list of sentences about rows left out, as tables of files have it: there are none. After `most`
        messages no more are looked at. Raises InputError when a column is missing, or a message cannot be read.
        """
        wanted = [self.form.names[self.form.index(name)] for name in names]
        parts: list[list[NDArray[np.str_]]] = []
        logged = [np.empty(0, np.int64)]
        for block in self._container.blocks(set(self._formats)):
            try:
                parts.append(self._formats[block.channel].texts(block, wanted))
            except MessageError as error:
                raise InputError(f"{self._container.path}: topic {self.name}: {error}") from error
            logged.append(block.log_ns)
            if most is not None and sum(map(len, logged)) >= most:
                break
        texts = [np.concatenate(column) for column in zip(*parts, strict=True)] or [np.empty(0, np.str_)] * len(names)
        return dict(zip(names, texts, strict=True)), [], np.concatenate(logged)


def _is_unix_ns(value: object) -> bool:
    """Whether an integer is so large that it can only be a time in ns since 1970."""
    return isinstance(value, int) and value > _UNIX_NS


class WithTables(MultiPartContainer):
    """Recording that has, beside its own topics, those that the config describes as tables of its messages."""

    def __init__(self, recorded: Container, made: Container) -> None:
        parts = recorded.parts if isinstance(recorded, MultiPartContainer) else [recorded]
        super().__init__(recorded.path, [*parts, made])
        self._recorded = recorded
        self.assumptions, self.incomplete = recorded.assumptions, recorded.incomplete

    def sha256(self) -> str:
        """SHA-256 of the recording, hexadecimal."""
        return self._recorded.sha256()


def message_tables(container: Container) -> dict[str, MessageTable]:
    """Return the topics of a recording as tables, by name."""
    formats: dict[str, dict[int, MessageFormat]] = {}
    for number, found in formats_of(container).items():
        if found.is_parsed and container.counts.get(number):
            formats.setdefault(container.channels[number].topic, {})[number] = found
    return {name: MessageTable(container, name, own) for name, own in formats.items()}
