"""Recordings as arrays.

    recording = open_recording(Path("session.mcap"))
    imu = recording.imu("/imu")         # imu.t_ns, imu.gyro, ...

Time is header.stamp; log time stands in only where the stamp is zero, and the series counts those. Messages come in
the order of their log times. Every method raises InputError, naming what is there, when the topic is missing or empty,
holds another type, cannot be decoded, or its clock was set in between (pipelines.recording.clocks). A chunk that is
damaged is left out, see `Recording.notes`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines import progress
from pipelines.errors import InputError
from pipelines.recording import messages, series
from pipelines.recording.clocks import check_clock
from pipelines.recording.container import McapFile, Rows
from pipelines.recording.decoding import Decoder, Times, header_stamps, logged_at
from pipelines.recording.losses import Loss
from pipelines.recording.messages import Definition, MessageError
from pipelines.recording.taking import NUMBERS, Taking

AnySeries = TypeVar("AnySeries", bound=series.Series)

# Topics whose first stamp may start a session. Positions and intrinsics may be stamped long before it.
_TIMED = {
    *(messages.IMU, messages.MAGNETIC_FIELD, messages.JOINT_STATE, messages.VECTOR, messages.QUATERNION, messages.POSE),
    *(messages.COMPRESSED_IMAGE, messages.TAG_DETECTIONS),
}

# Message and schema encoding as ROS 2 records.
ENCODING = "cdr/ros2msg"
# Topics an error lists.
_MOST_NAMED = 30


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    type: str
    count: int
    encoding: str


def open_recording(path: Path | str, strict: bool = False) -> Recording:
    """The recording in an MCAP file, also in one that is still being written, as far as it is sound.

    Raises InputError when the file is missing, empty or no MCAP, when nothing in it can be read, and with `strict` when
    anything is lost: truncated, damaged, without summary.
    """
    return Recording(Path(path), strict)


class Recording:
    """An MCAP recording of ROS 2 messages. Holds positions in the file and stamps, not the messages."""

    def __init__(self, path: Path, strict: bool = False) -> None:
        self.path = path
        self._file = McapFile(path, strict)
        self.topics = self._list_topics()
        self._at_hand: dict[tuple[str, tuple[str, ...]], Taking] = {}
        self._times: dict[str, Times] = {}

    def sha256(self) -> str:
        """SHA-256 of the file, hexadecimal."""
        with self.path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    @property
    def profile(self) -> str:
        """The profile the recorder gave, `ros2` for ROS 2."""
        return self._file.profile

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return self._file.attachments

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """The attachment of that name, None if there is none.

        One that is damaged raises InputError; if it is not needed, it is noted as lost.
        """
        return self._file.attachment(name, needed)

    @property
    def losses(self) -> tuple[Loss, ...]:
        """What of the file cannot be used; complete when all topics that matter have been read."""
        return tuple(self._file.losses)

    @property
    def missing(self) -> dict[str, int]:
        """Topic -> messages known to be lost."""
        return self._file.missing

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about what is lost."""
        return self._file.notes(self.epoch_ns, self.duration_s) if self._file.losses or self._file.missing else ()

    @cached_property
    def epoch_ns(self) -> int:
        """Start of the session, Unix ns: the earliest first stamp of a sensor topic, else the first log time."""
        timed = {name for name, topic in self.topics.items() if topic.type in _TIMED and topic.encoding == ENCODING}
        wanted = {
            n for n, channel in self._file.channels.items() if channel.topic in timed and self._file.counts.get(n)
        }
        first: dict[int, int] = {}
        for rows in self._file.rows(wanted):
            if rows.channel not in first:
                first[rows.channel] = int(self._stamps(rows)[0])
            if len(first) == len(wanted):
                break
        return min(first.values()) if first else self._span[0]

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last, by their log times, s."""
        return (self._span[1] - self._span[0]) * 1e-9

    def read_together(self, topics: Mapping[str, Sequence[str]]) -> None:
        """Decode topics in one pass over the file, to have them at hand when the methods below ask for them.

        A topic that has no numbers, or cannot be read, is left to the method, which says why.

        Args:
            topics: names, each with the joints wanted if it is a sensor_msgs/msg/JointState.
        """
        takings = {}
        for name in topics.keys() & self.topics.keys():
            topic = self.topics[name]
            if topic.type in NUMBERS and topic.encoding == ENCODING and topic.count:
                takings[name] = Taking(topic.type, topic.count, topics[name])
        failed = self._fill(takings)
        self._at_hand |= {(name, tuple(topics[name])): t for name, t in takings.items() if name not in failed}

    def imu(self, topic: str) -> series.ImuSeries:
        """A sensor_msgs/msg/Imu topic."""
        return self._series(series.ImuSeries, topic)

    def magnetic(self, topic: str) -> series.MagneticSeries:
        """A sensor_msgs/msg/MagneticField topic."""
        return self._series(series.MagneticSeries, topic)

    def vector(self, topic: str) -> series.VectorSeries:
        """A geometry_msgs/msg/Vector3Stamped topic."""
        return self._series(series.VectorSeries, topic)

    def quaternion(self, topic: str) -> series.QuaternionSeries:
        """A geometry_msgs/msg/QuaternionStamped topic."""
        return self._series(series.QuaternionSeries, topic)

    def poses(self, topic: str) -> series.PoseSeries:
        """A geometry_msgs/msg/PoseWithCovarianceStamped topic, or attitudes alone from a QuaternionStamped one."""
        self._require(topic, messages.POSE, messages.QUATERNION)
        if self.topics[topic].type == messages.POSE:
            return self._series(series.PoseSeries, topic)
        attitude = self.quaternion(topic)
        return series.PoseSeries(attitude.t_ns, attitude.wxyz, stamped_by_log=attitude.stamped_by_log)

    def fixes(self, topic: str) -> series.FixSeries:
        """A sensor_msgs/msg/NavSatFix topic."""
        return self._series(series.FixSeries, topic)

    def joints(self, topic: str, names: Sequence[str]) -> series.JointSeries:
        """Positions of the named joints on a sensor_msgs/msg/JointState topic, whatever order the messages have."""
        self._require(topic, messages.JOINT_STATE)
        taking = self._taking(topic, tuple(names))
        table = taking.table
        if not table.filled.any():
            raise InputError(
                f"{self.path}: topic {topic} has no message with positions of the joints {', '.join(names)}; "
                f"its joints: {', '.join(taking.joints) or 'none'}"
            )
        check_clock(topic, *table.times(), self.epoch_ns)
        t_ns, by_log, columns = table.sorted()
        without = table.taken - int(np.count_nonzero(table.filled))
        return series.JointSeries(t_ns, columns["position"], tuple(names), by_log, without)

    def camera_info(self, topic: str) -> series.CameraInfo:
        """The first message of a sensor_msgs/msg/CameraInfo topic."""
        for t_ns, _, message, _ in self._decoded(topic, messages.CAMERA_INFO):
            with self._fields(topic):
                k, r, p = (np.array(values, dtype=float) for values in (message.k, message.r, message.p))
                d = np.array(message.d, dtype=float)
                return series.CameraInfo(
                    t_ns,
                    int(message.width),
                    int(message.height),
                    message.distortion_model,
                    d,
                    k.reshape(3, 3),
                    r.reshape(3, 3),
                    p.reshape(3, 4),
                    message.header.frame_id,
                )
        raise AssertionError("an empty topic has been refused")

    def images(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """(stamp in ns, file) of the pictures on a sensor_msgs/msg/CompressedImage topic, one at a time."""
        self._require(topic, messages.COMPRESSED_IMAGE)
        decoded = self._decoded(topic, messages.COMPRESSED_IMAGE)
        for t_ns, _, message, _ in progress.track(decoded, "pictures", self.topics[topic].count):
            with self._fields(topic):
                picture = message.data.tobytes()
            yield t_ns, picture

    def detections(self, topic: str) -> series.DetectionSeries:
        """An apriltag_msgs/msg/AprilTagDetectionArray topic, with corners as points or as plain numbers."""
        stamps: list[int] = []
        by_log = 0
        frame, tag_id, corners, hamming, margin, family = [], [], [], [], [], []
        for i, (t_ns, from_log, message, definition) in enumerate(self._decoded(topic, messages.TAG_DETECTIONS)):
            stamps.append(t_ns)
            by_log += from_log
            with self._fields(topic):
                for found in message.detections:
                    frame.append(i)
                    tag_id.append(int(definition.numbers(found.id)[0]))
                    # (x, y) or (x, y, z) of each
                    corners.append(definition.numbers(found.corners).reshape(4, -1)[:, :2])
                    hamming.append(int(found.hamming))
                    margin.append(float(found.decision_margin))
                    family.append(found.family)
        return series.DetectionSeries(
            np.array(stamps, dtype=np.int64),
            np.array(frame, dtype=np.int64),
            np.array(tag_id, dtype=np.int64),
            np.array(corners, dtype=float).reshape(-1, 4, 2),
            np.array(hamming, dtype=np.int64),
            np.array(margin, dtype=float),
            np.array(family, dtype=np.str_),
            by_log,
        )

    @property
    def times(self) -> Mapping[str, Times]:
        """Topic -> stamps (log times where there is no header to be read) and log times."""
        found: dict[str, list[Times]] = {name: [] for name in self.topics if name not in self._times}
        for name, rows in self._blocks(found):
            found[name].append((self._stamps(rows), rows.log_ns))
        self._times |= {name: _joined(parts) for name, parts in found.items()}
        return self._times

    # -- behind the methods above

    @cached_property
    def _span(self) -> tuple[int, int]:
        """First and last log time, ns."""
        logged = [log_ns for _, log_ns in self.times.values() if len(log_ns)]
        return min((int(t.min()) for t in logged), default=0), max((int(t.max()) for t in logged), default=0)

    def _list_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for number, channel in self._file.channels.items():
            schema = self._file.schemas.get(channel.schema_id)
            kind = schema.name if schema else ""
            encoding = f"{channel.message_encoding}/{schema.encoding if schema else ''}"
            before = topics.get(channel.topic)
            if before and (before.type, before.encoding) != (kind, encoding):
                raise InputError(
                    f"{self.path}: topic {channel.topic} has messages of two types, {before.type} and {kind}"
                )
            count = self._file.counts.get(number, 0) + (before.count if before else 0)
            topics[channel.topic] = Topic(channel.topic, kind, count, encoding)
        return dict(sorted(topics.items()))

    def _require(self, topic: str, *types: str) -> None:
        """Raise InputError unless the topic is there, has messages, and one of the types."""
        found = self.topics.get(topic)
        if found is None:
            raise InputError(
                f"{self.path}: no topic {topic} ({' or '.join(types)}); {self.there()}; "
                "`topics:` in the config can rename"
            )
        if types and found.type not in types:
            kind = found.type if found.encoding == ENCODING else f"{found.type} ({found.encoding})"
            raise InputError(f"{self.path}: topic {topic} holds {kind}, needed is {' or '.join(types)} ({ENCODING})")
        if found.encoding != ENCODING:
            raise InputError(
                f"{self.path}: topic {topic} has the encoding {found.encoding}, needed is {ENCODING} (ROS 2, as "
                "`ros2 bag record -s mcap` writes it)"
            )
        if not found.count:
            raise InputError(f"{self.path}: topic {topic} has no messages")

    @contextmanager
    def _fields(self, topic: str) -> Iterator[None]:
        """Turns what comes of fields that are missing, or are something else, into an InputError."""
        try:
            yield
        except (KeyError, AttributeError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: topic {topic}: the messages have no usable field ({error})") from error

    def there(self) -> str:
        """A phrase that lists the topics of the recording, and what is lost of it."""
        named = [
            f"{name} ({t.type.split('/')[-1]}{f', {t.encoding}' if t.encoding != ENCODING else ''})"
            for name, t in self.topics.items()
        ]
        more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
        ros1 = " (a ROS 1 recording)" if self.profile == "ros1" else ""
        return "; ".join(
            [f"topics there{ros1}: {', '.join(named[:_MOST_NAMED]) or 'none'}{more}", *self._file.notes(None)]
        )

    def _blocks(self, topics: Iterable[str]) -> Iterator[tuple[str, Rows]]:
        """Topic and messages, block by block in the file's order."""
        wanted = set(topics)
        channels = {number for number, channel in self._file.channels.items() if channel.topic in wanted}
        for rows in self._file.rows(channels) if channels else ():
            yield self._file.channels[rows.channel].topic, rows

    def _definition(self, topic: str, rows: Rows) -> Definition:
        schema = self._file.schemas[self._file.channels[rows.channel].schema_id]
        try:
            found = messages.definition(schema.name, schema.data.decode(errors="replace"))
            found.check()
        except MessageError as error:
            raise self._unreadable(topic, error) from error
        return found

    def _stamps(self, rows: Rows) -> NDArray[np.int64]:
        """Header stamps, ns; log times where there are none."""
        channel = self._file.channels[rows.channel]
        if self.topics[channel.topic].encoding != ENCODING:
            return rows.log_ns
        text = self._file.schemas[channel.schema_id].data.decode(errors="replace")
        stamps = header_stamps(messages.has_header(text), rows)
        return np.where(stamps == 0, rows.log_ns, stamps)

    def _unreadable(self, topic: str, error: MessageError) -> InputError:
        when = f", logged at {(error.log_ns - self.epoch_ns) * 1e-9:.3f} s" if error.log_ns is not None else ""
        return InputError(f"{self.path}: topic {topic}: {error}{when}")

    def _decoded(self, topic: str, *types: str) -> Iterator[tuple[int, bool, Any, Definition]]:
        """(stamp, whether it is the log time, message, its definition) one by one, in file order."""
        self._require(topic, *types)
        times = []
        for _, rows in self._blocks([topic]):
            definition = self._definition(topic, rows)
            stamps = header_stamps(definition.has_header, rows)
            times.append((self._stamps(rows), rows.log_ns))
            for i, (t_ns, log_ns) in enumerate(zip(stamps.tolist(), rows.log_ns.tolist(), strict=True)):
                try:
                    with logged_at(log_ns):
                        message = definition.decode(rows.message(i))
                except MessageError as error:
                    raise self._unreadable(topic, error) from error
                yield t_ns or log_ns, not t_ns, message, definition
        self._times[topic] = _joined(times)
        self._check_read(topic, len(self._times[topic][0]))
        if self.topics[topic].type in _TIMED:
            check_clock(topic, *self._times[topic], self.epoch_ns)

    def _check_read(self, topic: str, number: int) -> None:
        """Raise InputError if no message of the topic is left."""
        if not number:
            lost = "; ".join(self._file.notes(None))
            raise InputError(f"{self.path}: topic {topic}: none of its messages can be read: {lost}")

    def _series(self, kind: type[AnySeries], topic: str) -> AnySeries:
        self._require(topic, kind.TYPE)
        table = self._taking(topic).table
        if kind.TYPE in _TIMED:
            check_clock(topic, *table.times(), self.epoch_ns)
        t_ns, by_log, columns = table.sorted()
        return kind(t_ns, stamped_by_log=by_log, **columns)

    def _taking(self, topic: str, joints: tuple[str, ...] = ()) -> Taking:
        """What is at hand of a topic, or is read now."""
        taking = self._at_hand.pop((topic, joints), None)
        if taking is None:
            taking = Taking(self.topics[topic].type, self.topics[topic].count, joints)
            for error in self._fill({topic: taking}).values():
                raise error
        self._check_read(topic, taking.table.taken)
        return taking

    def _fill(self, takings: Mapping[str, Taking]) -> dict[str, InputError]:
        """Read topics in one pass; returns those that cannot be read, with the reason."""
        decoders: dict[int, Decoder] = {}
        failed: dict[str, InputError] = {}
        for topic, rows in self._blocks(takings):
            if topic in failed:
                continue
            try:
                if rows.channel not in decoders:
                    decoders[rows.channel] = Decoder(self._definition(topic, rows), takings[topic].fields)
                with self._fields(topic):
                    decoders[rows.channel].append(rows, takings[topic].table)
            except MessageError as error:
                failed[topic] = self._unreadable(topic, error)
            except InputError as error:
                failed[topic] = error
            if len(failed) == len(takings):
                break
        self._times |= {topic: t.table.times(filled=False) for topic, t in takings.items() if topic not in failed}
        return failed


def _joined(parts: Sequence[Times]) -> Times:
    none = np.empty(0, np.int64)
    return np.concatenate([none, *(t_ns for t_ns, _ in parts)]), np.concatenate([none, *(log for _, log in parts)])
