"""Messages as numbers: the topics of a container, their stamps, their messages decoded.

Time is header.stamp; log time stands in where the stamp is zero. Everything wrong with a topic is an InputError that
names the recording, the topic and the time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.channel_format import READABLE, ChannelFormat, converted
from alidade.pipelines.recording.clocks import check_clock
from alidade.pipelines.recording.container import Container, MessageBlock
from alidade.pipelines.recording.decoding import Decoder, Times, header_stamps, is_unstamped, logged_at, with_log_times
from alidade.pipelines.recording.messages import Definition, MessageError
from alidade.pipelines.recording.stamps import stamp_notes
from alidade.pipelines.recording.topic_columns import NUMBERS, TopicColumns

# Topics whose first stamp may start a session. Positions and intrinsics may be stamped long before it.
TIMED = {
    *(messages.IMU, messages.MAGNETIC_FIELD, messages.JOINT_STATE, messages.VECTOR, messages.QUATERNION, messages.POSE),
    *(messages.COMPRESSED_IMAGE, messages.IMAGE, messages.TAG_DETECTIONS),
    *(messages.PLAIN_POSE, messages.TRANSFORM, messages.ODOMETRY, messages.TWIST, messages.ACCEL),
}
# Message and schema encoding as ROS 2 records.
ENCODING = "cdr/ros2msg"
# Topics an error lists.
_MOST_NAMED = 30


@dataclass(frozen=True)
class Topic:
    """One topic of a recording: its ROS 2 type, messages, encoding, and whether messages so encoded can be read."""

    name: str
    type: str
    count: int
    encoding: str
    is_readable: bool


class MessageReader:
    """The messages of a container, decoded.

    Args:
        container: where they are.
        name: of the recording, for what is said about it.
        epoch_ns: start of the session, if it is known.

    Attributes:
        topics: by name, sorted.
        unstamped: of topics read by now, how many messages without a stamp were left out.
    """

    def __init__(self, container: Container, name: str, epoch_ns: int | None = None) -> None:
        if epoch_ns is not None:
            self.epoch_ns = epoch_ns
        self._container, self._name = container, name
        self._formats = {
            number: ChannelFormat(channel, container.schemas.get(channel.schema_id))
            for number, channel in container.channels.items()
        }
        self.topics = self._list_topics()
        self.unstamped: dict[str, int] = {}
        self._at_hand: dict[tuple[str, tuple[str, ...]], TopicColumns] = {}
        self._times: dict[str, Times] = {}
        # Of topics read by now, what their stamps tell: how late messages were logged at least, ns, and sentences.
        self._told: dict[str, tuple[int | None, tuple[str, ...]]] = {}

    @cached_property
    def epoch_ns(self) -> int:
        """Start of the session, Unix ns: the earliest first stamp of a sensor topic, else the first log time."""
        timed = {name for name, topic in self.topics.items() if topic.type in TIMED and topic.is_readable}
        channels, counts = self._container.channels, self._container.counts
        wanted = {number for number, channel in channels.items() if channel.topic in timed and counts.get(number)}
        first = (
            int(with_log_times(self._formats[number].stamps(block), block.log_ns)[0][0])
            for number, block in self._container.first_blocks(wanted).items()
        )
        return min(first, default=self._container.first_log_ns)

    @cached_property
    def span(self) -> tuple[int, int]:
        """First and last log time, ns."""
        logged = [log_ns for _, log_ns in self.times.values() if len(log_ns)]
        return min((int(t.min()) for t in logged), default=0), max((int(t.max()) for t in logged), default=0)

    @property
    def delay_ns(self) -> int:
        """How much later than their stamps messages were logged, at least, in the topics read by now; ns."""
        return min((delay for delay, _ in self._tell().values() if delay is not None), default=0)

    @property
    def stamp_notes(self) -> tuple[str, ...]:
        """Sentences about how the stamps came about in the topics read by now."""
        told = self._tell()
        left_out = (
            f"topic {name}: {n} messages without a stamp, among others that have one, are left out"
            for name, n in self.unstamped.items()
        )
        return (*left_out, *(note for name in self.topics if name in told for note in told[name][1]))

    def _tell(self) -> Mapping[str, tuple[int | None, tuple[str, ...]]]:
        for name in self._times.keys() - self._told.keys():
            t_ns, log_ns = self._times[name]
            timed = name in self.topics and self.topics[name].type in TIMED
            delay = int((log_ns - t_ns).min()) if len(t_ns) else None
            self._told[name] = delay, stamp_notes(name, t_ns, log_ns) if timed else ()
        return self._told

    def forget_times(self) -> None:
        """Keep what the stamps read by now tell, and not the stamps: `times` reads them anew."""
        self._tell()
        self._times.clear()

    @property
    def times(self) -> Mapping[str, Times]:
        """Topic -> stamps (log times where there is no header to be read) and log times."""
        found: dict[str, list[Times]] = {name: [] for name in self.topics if name not in self._times}
        for name, rows in self._blocks(found):
            found[name].append((self._formats[rows.channel].stamps(rows), rows.log_ns))
        self._times |= {name: with_log_times(*_joined(parts)) for name, parts in found.items()}
        return self._times

    def require(self, topic: str, *types: str) -> None:
        """Raise InputError unless the topic is there, has messages, and one of the types."""
        found = self.topics.get(topic)
        if found is None:
            raise InputError(
                f"{self._name}: no topic {topic} ({' or '.join(types)}); {self.there()}; "
                "`topics:` in the config can rename"
            )
        if types and found.type not in types:
            kind = found.type if found.encoding == ENCODING else f"{found.type} ({found.encoding})"
            needed = f"needed is {' or '.join(types)} ({ENCODING}){converted(found.encoding)}"
            raise InputError(f"{self._name}: topic {topic} holds {kind}, {needed}")
        if not found.is_readable:
            raise InputError(
                f"{self._name}: topic {topic} has the encoding {found.encoding}, needed is {ENCODING} (ROS 2, as "
                f"`ros2 bag record -s mcap` writes it), or one of {', '.join(READABLE[1:])}{converted(found.encoding)}"
            )
        if not found.count:
            raise InputError(f"{self._name}: topic {topic} has no messages")

    def there(self) -> str:
        """A phrase that lists the topics of the recording, and what is lost of it."""
        named = [
            f"{name} ({t.type.split('/')[-1]}{f', {t.encoding}' if t.encoding != ENCODING else ''})"
            for name, t in self.topics.items()
        ]
        more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
        ros1 = " (a ROS 1 recording)" if any(t.encoding.startswith("ros1/") for t in self.topics.values()) else ""
        return "; ".join(
            [f"topics there{ros1}: {', '.join(named[:_MOST_NAMED]) or 'none'}{more}", *self._container.notes(None)]
        )

    def read_together(self, topics: Mapping[str, Sequence[str]]) -> None:
        """Decode topics in one pass, to have them at hand when `columns` is asked for them; see Recording."""
        wanted = {}
        for name in topics.keys() & self.topics.keys():
            topic = self.topics[name]
            if topic.type in NUMBERS and topic.is_readable and topic.count:
                wanted[name] = TopicColumns(topic.type, topic.count, topics[name])
        failed = self._fill(wanted)
        self._at_hand |= {(name, tuple(topics[name])): c for name, c in wanted.items() if name not in failed}

    def columns(self, topic: str, joints: tuple[str, ...] = ()) -> TopicColumns:
        """What is at hand of a topic, or is read now. The topic has been required."""
        columns = self._at_hand.pop((topic, joints), None)
        if columns is None:
            columns = TopicColumns(self.topics[topic].type, self.topics[topic].count, joints)
            for error in self._fill({topic: columns}).values():
                raise error
        self._check_read(topic, columns.table.taken)
        if without := columns.table.drop_unstamped():
            self.unstamped[topic] = without
        return columns

    def decoded(self, topic: str, *types: str) -> Iterator[tuple[int, bool, Any, Definition]]:
        """(stamp, whether it is the log time, message, its definition) one by one, in file order."""
        self.require(topic, *types)
        times = []
        for _, recorded in self._blocks([topic]):
            try:
                definition = self._formats[recorded.channel].definition
                rows = self._formats[recorded.channel].rows(recorded)
            except MessageError as error:
                raise self._unreadable(topic, error) from error
            stamps = header_stamps(definition.has_header, rows, definition.wire)
            absent = is_unstamped(stamps, rows.log_ns)
            times.append((np.where(absent, rows.log_ns, stamps), rows.log_ns))
            for i, (t_ns, log_ns) in enumerate(zip(times[-1][0].tolist(), rows.log_ns.tolist(), strict=True)):
                try:
                    with logged_at(log_ns):
                        message = definition.decode(rows.message(i))
                except MessageError as error:
                    raise self._unreadable(topic, error) from error
                yield t_ns, bool(absent[i]), message, definition
        self._times[topic] = _joined(times)
        self._check_read(topic, len(self._times[topic][0]))
        if self.topics[topic].type in TIMED:
            check_clock(topic, *self._times[topic], self.epoch_ns)

    @contextmanager
    def fields(self, topic: str) -> Iterator[None]:
        """Turns what comes of fields that are missing, or are something else, into an InputError."""
        try:
            yield
        except (KeyError, AttributeError, TypeError, ValueError) as error:
            raise InputError(f"{self._name}: topic {topic}: the messages have no usable field ({error})") from error

    def _list_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for number, channel in self._container.channels.items():
            found = self._formats[number]
            before = topics.get(channel.topic)
            if before and (before.type, before.encoding) != (found.type, found.encoding):
                raise InputError(
                    f"{self._name}: topic {channel.topic} has messages of two types, {before.type} and {found.type}"
                )
            count = self._container.counts.get(number, 0) + (before.count if before else 0)
            topics[channel.topic] = Topic(channel.topic, found.type, count, found.encoding, found.is_readable)
        return dict(sorted(topics.items()))

    def _blocks(self, topics: Iterable[str]) -> Iterator[tuple[str, MessageBlock]]:
        """Topic and messages, block by block in the file's order."""
        wanted = set(topics)
        channels = {number for number, channel in self._container.channels.items() if channel.topic in wanted}
        for rows in self._container.blocks(channels) if channels else ():
            yield self._container.channels[rows.channel].topic, rows

    def _unreadable(self, topic: str, error: MessageError) -> InputError:
        when = f", logged at {(error.log_ns - self.epoch_ns) * 1e-9:.3f} s" if error.log_ns is not None else ""
        return InputError(f"{self._name}: topic {topic}: {error}{when}")

    def _check_read(self, topic: str, number: int) -> None:
        """Raise InputError if no message of the topic is left."""
        if not number:
            lost = "; ".join(self._container.notes(None))
            raise InputError(f"{self._name}: topic {topic}: none of its messages can be read: {lost}")

    def _fill(self, wanted: Mapping[str, TopicColumns]) -> dict[str, InputError]:
        """Read topics in one pass; returns those that cannot be read, with the reason."""
        decoders: dict[int, Decoder] = {}
        failed: dict[str, InputError] = {}
        for topic, rows in self._blocks(wanted):
            if topic in failed:
                continue
            found = self._formats[rows.channel]
            try:
                if rows.channel not in decoders:
                    decoders[rows.channel] = Decoder(found.definition, wanted[topic].fields)
                with self.fields(topic):
                    decoders[rows.channel].append(found.rows(rows), wanted[topic].table)
            except MessageError as error:
                failed[topic] = self._unreadable(topic, error)
            except InputError as error:
                failed[topic] = error
            if len(failed) == len(wanted):
                break
        self._times |= {topic: c.table.times(filled=False) for topic, c in wanted.items() if topic not in failed}
        return failed


def _joined(parts: Sequence[Times]) -> Times:
    none = np.empty(0, np.int64)
    return np.concatenate([none, *(t_ns for t_ns, _ in parts)]), np.concatenate([none, *(log for _, log in parts)])
