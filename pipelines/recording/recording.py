"""Recordings as arrays.

    recording = open_recording(Path("session.mcap"))
    imu = recording.imu("/imu")         # imu.t_ns, imu.gyro, ...

The path of a sample, one module a step:

    mcap_file.py, ros1_bag.py, ...  file         -> MessageBlock: raw messages of one channel, checksums verified
    decoding.py                     MessageBlock -> ColumnTable: numbers of all messages of one layout at once
    recording.py                    ColumnTable  -> Series: units, frames and covariances as the messages state them
    streams.py                      Series       -> times in s, sorted and finite, faulty samples removed
    the method's recording.py                    -> arrays of the method

The time of a sample is its header stamp; where that is zero the log time stands in, and the series counts those.
Messages come in the order of their log times. Every method raises InputError, naming what is there, when the topic is
missing or empty, has another type, cannot be decoded, or its clock was set in between (checks.py). A damaged chunk is
left out, see `Recording.notes`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines import progress
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.checks import check_clock, jitter_ns, stamp_notes
from alidade.pipelines.recording.container import Container, MessageBlock
from alidade.pipelines.recording.decoding import (
    ENCODING,
    NUMERIC_TYPES,
    READABLE,
    ColumnTable,
    DecodedMessage,
    Times,
    formats_of,
    one_clock,
    with_log_times,
)
from alidade.pipelines.recording.images import pictures
from alidade.pipelines.recording.messages import MessageError
from alidade.pipelines.recording.opening import Where, open_container
from alidade.pipelines.recording.plausibility import to_signed, wrapped_bits
from alidade.pipelines.recording.table_topics import TableTopic, described, tables_of
from alidade.pipelines.recording.topics import TopicSource, along, inverted, joined

# Topics whose first stamp may start a session. Positions, intrinsics and static frames may be stamped long before it.
SENSOR_STAMPED_TYPES = {*messages.SENSORS} - {
    *(messages.NAV_SAT_FIX, messages.CAMERA_INFO, messages.TF, messages.TEMPERATURE)
}
# Topics, and pairs of frames, that an error message names.
MAX_NAMED = 30
_NO_COLUMNS = "a table needs `columns:` in the config, or --auto-columns"
# Sigma of the delay with which messages are logged, s: assumed where log times replace stamps.
UNKNOWN_LOG_DELAY_S = 0.01
# Quantities that may be counts of a sensor.
_COUNTED: Mapping[type, tuple[str, ...]] = {
    series.ImuSeries: ("gyro", "accel"),
    series.MagneticSeries: ("field",),
    series.VectorSeries: ("vector",),
}

AnySeries = TypeVar("AnySeries", bound=series.Series)


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a recording: its ROS 2 type, number of messages, encoding, and whether that encoding is read."""

    name: str
    type: str
    count: int
    encoding: str
    is_readable: bool


def open_recording(where: Where, strict: bool = False) -> Recording:
    """The recording in a file, a folder of parts, files named by a pattern or a list; see docs/reference/messages.md.

    One that is still being written, or is damaged, is read as far as it is sound. Raises InputError when something is
    missing, empty or no recording, when nothing in it can be read, and with `strict` when anything is lost: truncated,
    damaged, without summary.
    """
    return Recording(open_container(where, strict))


class Recording:
    """Recording as arrays, topic by topic; keeps positions in the file and stamps, not the messages.

    What reading a topic shows (notes, delays, sigma of stamps) belongs to this object: `with_config` returns another
    one, which knows of the topics read through it alone.

    Args:
        container: where its messages are.
        epoch_ns: start of the session, Unix ns, where the container lacks its first messages.

    Attributes:
        path: of the file or folder, as it was named.
        container: the raw messages, and what of them is lost.
        recorded: topics in the file, by name, sorted.
        stamp_sigma_s: sigma of the stamps read by now, s: 0 except where log times replace them.
    """

    def __init__(self, container: Container, epoch_ns: int | None = None) -> None:
        self.path = container.path
        self.container = self._undescribed = container
        self._given_epoch_ns = epoch_ns
        if epoch_ns is not None:
            self.epoch_ns = epoch_ns
        self._formats = formats_of(container)
        self.recorded = self._list_topics()
        self._sources: dict[str, TopicSource] = {}
        self._assumptions: tuple[str, ...] = ()
        self.stamp_sigma_s = 0.0
        self._decoded_tables: dict[tuple[str, tuple[str, ...]], ColumnTable] = {}
        self._transforms: dict[str, dict[tuple[str, str], tuple[series.PoseSeries, int]]] = {}
        self._times: dict[str, Times] = {}
        self._unstamped: dict[str, int] = {}  # topic -> messages without a stamp that were left out
        self._by_log: set[str] = set()  # topics whose messages have their log times in place of stamps
        # Topic -> least delay of the log times after the stamps, ns (None without messages), and sentences about these.
        self._stamp_facts: dict[str, tuple[int | None, tuple[str, ...]]] = {}

    def with_config(self, sources: Iterable[TopicSource], columns: Mapping[str, TableTopic] | None = None) -> Recording:
        """Return the recording with other derived topics and, if `columns` has any, with its tables described anew.

        Raises InputError when a table or a column is not there, or holds no numbers.
        """
        container = described(self._undescribed, columns) if columns else self.container
        known = self.__dict__.get("epoch_ns") if container is self.container else self._given_epoch_ns
        other = Recording(container, known)
        other._undescribed, other._assumptions = self._undescribed, self._assumptions
        other._sources = {source.name: source for source in sources if source.is_made}
        return other

    @property
    def topics(self) -> Mapping[str, TopicInfo]:
        """Topics by name: the recorded ones, and the derived ones whose parts are there."""
        derived = {name: info for name, source in self._sources.items() if (info := self._derived_info(name, source))}
        return {**self.recorded, **derived}

    def remark(self, sentence: str) -> None:
        """Add a sentence about an assumption to the recording's notes, unless it is there already."""
        if sentence not in self._assumptions:
            self._assumptions = (*self._assumptions, sentence)

    def sha256(self) -> str:
        """SHA-256 of the file, hexadecimal."""
        return self.container.sha256()

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """Content of an attachment, None if there is none; see `Container.attachment`."""
        return self.container.attachment(name, needed)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about lost data, assumptions, and the origin of the stamps in the topics read so far."""
        container = self.container
        lost = container.notes(self.epoch_ns, self.duration_s) if container.losses or container.missing else ()
        return (*container.incomplete, *container.assumptions, *self._assumptions, *self._stamp_notes, *lost)

    @cached_property
    def epoch_ns(self) -> int:
        """Start of the session, Unix ns: the earliest first stamp of a sensor topic, else the first log time."""
        sensors = [n for n, each in self._formats.items() if each.type in SENSOR_STAMPED_TYPES and each.is_readable]
        first = (
            int(with_log_times(self._formats[number].stamps(block), block.log_ns)[0][0])
            for number, block in self.container.first_blocks(sensors).items()
        )
        return min(first, default=self.container.first_log_ns)

    @cached_property
    def duration_s(self) -> float:
        """Time from the first message to the last, by their log times, s."""
        logged = [log_ns for _, log_ns in self.times.values() if len(log_ns)]
        first, last = min((int(t.min()) for t in logged), default=0), max((int(t.max()) for t in logged), default=0)
        return (last - first) * 1e-9

    @property
    def delay_ns(self) -> int:
        """Least delay of the log times after the stamps, ns, in the topics read by now."""
        return min((delay for delay, _ in self._all_stamp_facts().values() if delay is not None), default=0)

    @property
    def times(self) -> Mapping[str, Times]:
        """Topic -> stamps and log times, Unix ns; log times replace stamps where messages have no readable header."""
        found: dict[str, list[Times]] = {name: [] for name in self.recorded if name not in self._times}
        for name, block in self._blocks(found):
            found[name].append((self._formats[block.channel].stamps(block), block.log_ns))
        self._times |= {name: with_log_times(*_concatenate(parts)) for name, parts in found.items()}
        bases = {name: source.parts[0] for name, source in self._sources.items()}
        return {**self._times, **{name: self._times[base] for name, base in bases.items() if base in self._times}}

    def forget_times(self) -> None:
        """Free the memory of all stamps read so far; `times` reads them anew."""
        self._all_stamp_facts()
        self._times.clear()

    def stamps(self, block: MessageBlock) -> NDArray[np.int64]:
        """Return the stamps (N,) of a block's messages, Unix ns; log times where the topic is read by log time."""
        stamps = self._formats[block.channel].stamps(block)
        return block.log_ns if self.container.channels[block.channel].topic in self._by_log else stamps

    def there(self) -> str:
        """Return a phrase that lists the recorded topics and the lost data."""
        named = [
            f"{name} ({t.type.split('/')[-1]}{f', {t.encoding}' if t.encoding != ENCODING else ''})"
            for name, t in self.recorded.items()
        ]
        more = f" and {len(named) - MAX_NAMED} more" if len(named) > MAX_NAMED else ""
        tables = [] if named or not tables_of(self.container) else [_NO_COLUMNS]
        ros1 = " (a ROS 1 recording)" if any(t.encoding.startswith("ros1/") for t in self.recorded.values()) else ""
        return "; ".join(
            [
                f"topics there{ros1}: {', '.join(named[:MAX_NAMED]) or 'none'}{more}",
                *tables,
                *self.container.notes(None),
            ]
        )

    # -- topics of numbers

    def read_together(self, topics: Mapping[str, Sequence[str]]) -> None:
        """Decode several topics in one pass over the file; the readers below then use the result.

        A topic that has no numbers, or cannot be read, is left to the method, which says why. Of a
        sensor_msgs/JointState `topics` has the joints that are needed.
        """
        wanted = dict(topics)
        for name in wanted.keys() & self._sources.keys():
            wanted |= dict.fromkeys(self._sources[name].parts, ())
        tables = {}
        for name in wanted.keys() & self.recorded.keys():
            info = self.recorded[name]
            if info.type in NUMERIC_TYPES and info.is_readable and info.count:
                tables[name] = ColumnTable(info.type, info.count, wanted[name])
        failed = self._fill(tables)
        self._decoded_tables |= {(n, tuple(wanted[n])): table for n, table in tables.items() if n not in failed}

    def imu(self, topic: str, frame: str | None = None) -> series.ImuSeries:
        """Read a sensor_msgs/Imu topic, or a Vector3Stamped or TwistStamped one as rates alone: accelerations NaN."""
        if topic in self._sources:
            return self._derived_imu(topic, self._sources[topic])
        if self._require(topic, *messages.RATES).type in messages.IMUS:
            return self._series(series.ImuSeries, topic, frame)
        return joined(self._series(series.VectorSeries, topic, frame), None)

    def magnetic(self, topic: str) -> series.MagneticSeries:
        """Read a sensor_msgs/MagneticField topic."""
        source = self._sources.get(topic)
        if source is None:
            return self._series(series.MagneticSeries, topic)
        if source.topic is None:
            raise InputError(f"{self.path}: topic {topic} is made of rates; it holds no magnetic field")
        found = self._series(series.MagneticSeries, source.topic, source.frame)
        return dataclasses.replace(found, field=along(source.axes, found.field))

    def vector(self, topic: str) -> series.VectorSeries:
        """Read a topic of vectors: Vector3Stamped, the rates of TwistStamped, or the accelerations of AccelStamped."""
        return self._series(series.VectorSeries, topic)

    def poses(self, topic: str, frame: str | None = None) -> series.PoseSeries:
        """Read a topic of poses, or of attitudes alone, of any type in messages.ATTITUDES."""
        if topic in self._sources:
            return self.poses_of(self._sources[topic])
        if self._require(topic, *messages.ATTITUDES).type == messages.IMU:
            return self._orientations(topic, frame)
        return self._series(series.PoseSeries, topic, frame)

    def poses_of(self, source: TopicSource) -> series.PoseSeries:
        """Read the poses of a topic source, whether or not it was given to `with_config`."""
        if source.topic is None:
            raise InputError(f"{self.path}: topic {source.name} is made of rates; it holds no attitude")
        frames = source.frames
        poses = self._between(source.topic, frames) if frames else self.poses(source.topic, source.frame)
        return inverted(poses) if source.invert else poses

    def fixes(self, topic: str) -> series.FixSeries:
        """Read a sensor_msgs/NavSatFix topic."""
        return self._series(series.FixSeries, topic)

    def temperature(self, topic: str) -> series.TemperatureSeries:
        """Read a sensor_msgs/Temperature topic."""
        return self._series(series.TemperatureSeries, topic)

    def joints(self, topic: str, names: Sequence[str]) -> series.JointSeries:
        """Read positions, rad, of the named joints on a sensor_msgs/JointState topic, in any order of the messages."""
        self._require(topic, messages.JOINT_STATE)
        table = self._table(topic, tuple(names))
        if not table.filled.any():
            raise InputError(
                f"{self.path}: topic {topic} has no message with positions of the joints {', '.join(names)}; "
                f"its joints: {', '.join(table.joint_names) or 'none'}"
            )
        t_ns, from_log, numbers = self._sorted(topic, table)
        without = table.count - int(np.count_nonzero(table.filled))
        return series.JointSeries(t_ns, numbers["position"], tuple(names), without, stamped_by_log=from_log)

    # -- messages one by one

    def camera_info(self, topic: str) -> series.CameraInfo:
        """Read the first message of a sensor_msgs/CameraInfo topic."""
        with self._problems(topic):
            message = next(self._decoded(topic, messages.CAMERA_INFO))
            found = message.content
            k, r, p, d = (np.array(values, dtype=float) for values in (found.k, found.r, found.p, found.d))
            size = int(found.width), int(found.height)
            matrices = k.reshape(3, 3), r.reshape(3, 3), p.reshape(3, 4)
            return series.CameraInfo(message.t_ns, *size, found.distortion_model, d, *matrices, found.header.frame_id)

    def images(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield the pictures on a CompressedImage or Image topic as (stamp in ns, file), one by one.

        Raw ones, and those of a video, are files in the Netpbm form.
        """
        info = self._require(topic, *messages.PICTURES)
        found = progress.track(self._decoded(topic, *messages.PICTURES), "pictures", info.count)
        with self._problems(topic):
            yield from pictures(found, info.type == messages.IMAGE)

    def detections(self, topic: str) -> series.DetectionSeries:
        """Read an apriltag_msgs/AprilTagDetectionArray topic, with corners as points or as plain numbers."""
        stamps: list[tuple[int, bool]] = []
        rows: list[tuple[int, int, Array, str]] = []
        with self._problems(topic):
            decoded = self._decoded(topic, messages.TAG_DETECTIONS)
            for i, message in enumerate(message for message in decoded if not message.left_out):
                stamps.append((message.t_ns, message.from_log_time))
                numbers = message.definition.numbers
                for found in message.content.detections:
                    # (x, y) or (x, y, z) of each
                    xy = numbers(found.corners).reshape(4, -1)[:, :2]
                    rows.append((i, int(numbers(found.id)[0]), xy, found.family))
            frame, tag_id, corners, family = ([row[k] for row in rows] for k in range(4))
            return series.DetectionSeries(
                np.array([t_ns for t_ns, _ in stamps], dtype=np.int64),
                np.array(frame, dtype=np.int64),
                np.array(tag_id, dtype=np.int64),
                np.array(corners, dtype=float).reshape(-1, 4, 2),
                np.array(family, dtype=np.str_),
                stamped_by_log=sum(from_log for _, from_log in stamps),
            )

    def transforms(self, topic: str) -> Mapping[tuple[str, str], series.PoseSeries]:
        """Read the transforms on a tf2_msgs/TFMessage topic by (parent frame, child frame)."""
        if topic not in self._transforms:
            rows: dict[tuple[str, str], list[tuple[int, int, Array]]] = {}
            with self._problems(topic):
                for message in self._decoded(topic, messages.TF):
                    for one in message.content.transforms:
                        t_ns = one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec
                        row = t_ns, message.t_ns, message.definition.numbers(one.transform)
                        pair = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
                        rows.setdefault(pair, []).append(row)
                self._transforms[topic] = {pair: _poses(found) for pair, found in rows.items()}
        return {pair: poses for pair, (poses, _) in self._transforms[topic].items()}

    # -- derived topics

    def _derived_info(self, name: str, source: TopicSource) -> TopicInfo | None:
        """Return the facts of a derived topic; None if one of its parts is not recorded."""
        parts = [self.recorded[part] for part in source.parts if part in self.recorded]
        if len(parts) < len(source.parts):
            return None
        is_pose = source.topic is not None and (bool(source.frames) or source.invert)
        kind = messages.POSE if is_pose else messages.IMU if source.topic is None else parts[0].type
        return TopicInfo(name, kind, parts[0].count, parts[0].encoding, all(part.is_readable for part in parts))

    def _derived_imu(self, name: str, source: TopicSource) -> series.ImuSeries:
        if source.frames or source.invert:
            raise InputError(f"{self.path}: topic {name} is made of attitudes; it holds no rates")
        if source.topic is not None:
            imu = self.imu(source.topic, source.frame)
        else:
            accel = None if source.accel is None else self._part(source.accel, "accel")
            imu = joined(self._part(source.gyro or "", "gyro"), accel)
        return dataclasses.replace(imu, gyro=along(source.axes, imu.gyro), accel=along(source.axes, imu.accel))

    def _part(self, topic: str, which: str) -> series.VectorSeries:
        """Read the vectors of a topic, or one attribute of an IMU topic: `gyro` or `accel`."""
        info = self._require(topic, *messages.RATES, messages.ACCEL)
        if info.type not in messages.IMUS:
            return self._series(series.VectorSeries, topic)
        imu = self._series(series.ImuSeries, topic)
        return series.VectorSeries(
            imu.t_ns, getattr(imu, which), stamped_by_log=imu.stamped_by_log, frame_id=imu.frame_id
        )

    def _between(self, topic: str, frames: tuple[str, str]) -> series.PoseSeries:
        """Read the transforms between one pair of frames, (parent, child), on a TFMessage topic."""
        pairs, pair = self.transforms(topic), (frames[0].lstrip("/"), frames[1].lstrip("/"))
        found = pairs.get(pair)
        if found is None:
            there = ", ".join(f"{parent} to {child}" for parent, child in sorted(pairs)[:MAX_NAMED])
            raise InputError(
                f"{self.path}: topic {topic} has no transform from {frames[0]} to {frames[1]}; there: {there or 'none'}"
            )
        if without := self._transforms[topic][pair][1]:
            self._unstamped[topic] = without
        self._note_unstamped(topic, found.t_ns, found.stamped_by_log)
        return found

    def _orientations(self, topic: str, frame: str | None) -> series.PoseSeries:
        """Read the orientations of an Imu topic as poses. Raises InputError where the topic has none."""
        imu = self.imu(topic, frame)
        if (imu.wxyz_cov[:, 0, 0] < 0.0).all():
            raise InputError(
                f"{self.path}: topic {topic}: orientation_covariance starts with -1, so there is no attitude in it"
            )
        cov = np.zeros((len(imu), 6, 6))
        cov[:, 3:, 3:] = imu.wxyz_cov
        return series.PoseSeries(imu.t_ns, imu.wxyz, cov=cov, stamped_by_log=imu.stamped_by_log)

    # -- from messages to series

    def _list_topics(self) -> dict[str, TopicInfo]:
        topics: dict[str, TopicInfo] = {}
        for number, channel in self.container.channels.items():
            found = self._formats[number]
            before = topics.get(channel.topic)
            if before and (before.type, before.encoding) != (found.type, found.encoding):
                raise InputError(
                    f"{self.path}: topic {channel.topic} has messages of two types, {before.type} and {found.type}"
                )
            count = self.container.counts.get(number, 0) + (before.count if before else 0)
            topics[channel.topic] = TopicInfo(channel.topic, found.type, count, found.encoding, found.is_readable)
        return dict(sorted(topics.items()))

    def _require(self, topic: str, *types: str) -> TopicInfo:
        """Return the recorded topic; raise InputError unless it has decodable messages of one of the types."""
        found = self.recorded.get(topic)
        if found is None:
            problem = f"no topic {topic} ({' or '.join(types)}); {self.there()}; `topics:` in the config can rename"
        elif found.type not in types:
            kind = found.type if found.encoding == ENCODING else f"{found.type} ({found.encoding})"
            needed = f"needed is {' or '.join(types)} ({ENCODING}){self._advice(topic)}"
            problem = f"topic {topic} holds {kind}, {needed}"
        elif not found.is_readable:
            problem = (
                f"topic {topic} has the encoding {found.encoding}, needed is {ENCODING} (ROS 2, as `ros2 bag record "
                f"-s mcap` writes it), or one of {', '.join(READABLE[1:])}{self._advice(topic)}"
            )
        elif not found.count:
            problem = f"topic {topic} has no messages"
        else:
            return found
        raise InputError(f"{self.path}: {problem}")

    def _advice(self, topic: str) -> str:
        channels = self.container.channels.items()
        return next(self._formats[number].advice for number, channel in channels if channel.topic == topic)

    def _blocks(self, topics: Iterable[str]) -> Iterator[tuple[str, MessageBlock]]:
        """Yield the blocks of messages of some topics as (topic, messages), in file order."""
        names = set(topics)
        wanted = {n: channel.topic for n, channel in self.container.channels.items() if channel.topic in names}
        for block in self.container.blocks(set(wanted)) if wanted else ():
            yield wanted[block.channel], block

    def _table(self, topic: str, joints: tuple[str, ...] = ()) -> ColumnTable:
        """Return the decoded messages of a topic that `_require` has accepted."""
        table = self._decoded_tables.pop((topic, joints), None)
        if table is None:
            table = ColumnTable(self.recorded[topic].type, self.recorded[topic].count, joints)
            for error in self._fill({topic: table}).values():
                raise error
        self._check_any(topic, table.count)
        return table

    def _fill(self, tables: Mapping[str, ColumnTable]) -> dict[str, InputError]:
        """Decode topics into their tables in one pass; return the reason for each topic that cannot be read."""
        failed: dict[str, InputError] = {}
        for topic, block in self._blocks(tables):
            if topic not in failed:
                try:
                    with self._problems(topic):
                        self._formats[block.channel].append(block, tables[topic])
                except InputError as error:
                    failed[topic] = error
            if len(failed) == len(tables):
                break
        self._times |= {topic: table.times(filled=False) for topic, table in tables.items() if topic not in failed}
        return failed

    def _decoded(self, topic: str, *types: str) -> Iterator[DecodedMessage]:
        """Yield the decoded messages of a topic one by one, in file order; pictures and tags by one clock."""
        info = self._require(topic, *types)
        absent = self._unstamped_of(topic) if info.type in (*messages.PICTURES, messages.TAG_DETECTIONS) else None
        times = []
        for _, block in self._blocks([topic]):
            kept = []
            with self._problems(topic):
                decoded = self._formats[block.channel].decode(block)
                for message, log_ns in zip(decoded, block.log_ns.tolist(), strict=True):
                    if absent == 0 and message.from_log_time:
                        yield message._replace(left_out=True)
                        continue
                    one = message._replace(t_ns=log_ns, from_log_time=True) if absent else message
                    kept.append((one.t_ns, log_ns))
                    yield one
            t_ns, log = np.array(kept, dtype=np.int64).reshape(-1, 2).T
            times.append((t_ns, log))
        self._times[topic] = _concatenate(times)
        self._note_unstamped(topic, self._times[topic][0], absent or 0)
        self._check_any(topic, len(self._times[topic][0]))
        if info.type in SENSOR_STAMPED_TYPES:
            check_clock(topic, *self._times[topic], self.epoch_ns)

    def _unstamped_of(self, topic: str) -> int:
        """Number of a topic's messages without a stamp where all get their log times, else 0; few are left out."""
        blocks = (block for _, block in self._blocks([topic]))
        both = _concatenate([(self._formats[block.channel].stamps(block), block.log_ns) for block in blocks])
        kept, absent = one_clock(*both)
        if without := int(np.count_nonzero(~kept)):
            self._unstamped[topic] = without
        return absent

    def _check_any(self, topic: str, number: int) -> None:
        """Raise InputError if no message of the topic is left."""
        if not number:
            lost = "; ".join(self.container.notes(None))
            raise InputError(f"{self.path}: topic {topic}: none of its messages can be read: {lost}")

    @contextmanager
    def _problems(self, topic: str) -> Iterator[None]:
        """Context manager that raises InputError for messages of a topic that cannot be decoded or lack a field."""
        try:
            yield
        except MessageError as error:
            when = f", logged at {(error.log_ns - self.epoch_ns) * 1e-9:.3f} s" if error.log_ns is not None else ""
            raise InputError(f"{self.path}: topic {topic}: {error}{when}") from error
        except (KeyError, AttributeError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: topic {topic}: the messages have no usable field ({error})") from error

    def _series(self, kind: type[AnySeries], topic: str, frame: str | None = None) -> AnySeries:
        self._require(topic, kind.TYPE, *kind.OTHERS)
        table = self._table(topic)
        self._choose_frame(topic, table, frame)
        t_ns, from_log, columns = self._sorted(topic, table)
        for name in _COUNTED.get(kind, ()):
            if bits := wrapped_bits(columns[name]):
                columns[name] = to_signed(columns[name], bits)
                self.remark(
                    f"topic {topic}: {name} jumps by {1 << bits}: counts of a signed {bits} bit sensor that were "
                    "written as unsigned, read as signed"
                )
        return kind(t_ns, stamped_by_log=from_log, frame_id=next(iter(table.frames()), ""), **columns)

    def _sorted(self, topic: str, table: ColumnTable) -> tuple[NDArray[np.int64], int, dict[str, Array]]:
        """Return stamps, how many of them are log times, and columns, by log time; InputError if the clock was set."""
        if without := table.drop_unstamped():
            self._unstamped[topic] = without
        if self.recorded[topic].type in SENSOR_STAMPED_TYPES:
            check_clock(topic, *table.times(), self.epoch_ns)
        t_ns, absent, columns = table.sorted()
        self._note_unstamped(topic, t_ns, absent)
        return t_ns, len(t_ns) if absent else 0, columns

    def _choose_frame(self, topic: str, table: ColumnTable, frame: str | None) -> None:
        """Keep the messages of one frame. Raises InputError if it has none, or if none of several is named.

        Frames that follow one another in time are one device that was renamed.
        """
        frames = table.frames()
        there = ", ".join(f"{name or 'without a name'} ({int(rows.sum())} messages)" for name, rows in frames.items())
        if frame is not None:
            if frame.lstrip("/") not in frames:
                raise InputError(f"{self.path}: topic {topic} has no messages of the frame {frame}; there: {there}")
            table.filled &= frames[frame.lstrip("/")]
            return
        spans = [np.flatnonzero(rows)[[0, -1]] for rows in frames.values() if rows.sum() > 1]
        spans.sort(key=lambda span: int(span[0]))
        if any(after[0] < before[1] for before, after in itertools.pairwise(spans)):
            raise InputError(
                f"{self.path}: topic {topic} has messages of several devices, by their frames: {there}; choose one: "
                f"`{{topic: {topic}, frame: {next(iter(frames))}}}` in place of its name under `topics:`"
            )

    # -- what stamps show

    @property
    def _stamp_notes(self) -> tuple[str, ...]:
        """Sentences about the origin of the stamps in the topics read so far."""
        facts = self._all_stamp_facts()
        left_out = (
            f"topic {name}: {n} messages without a stamp, among others that have one, are left out"
            for name, n in self._unstamped.items()
        )
        return (*left_out, *(note for name in self.recorded if name in facts for note in facts[name][1]))

    def _all_stamp_facts(self) -> Mapping[str, tuple[int | None, tuple[str, ...]]]:
        for name in self._times.keys() - self._stamp_facts.keys():
            t_ns, log_ns = self._times[name]
            is_sensor = name in self.recorded and self.recorded[name].type in SENSOR_STAMPED_TYPES
            delay = int((log_ns - t_ns).min()) if len(t_ns) else None
            self._stamp_facts[name] = delay, stamp_notes(name, t_ns, log_ns) if is_sensor else ()
        return self._stamp_facts

    def _note_unstamped(self, topic: str, t_ns: NDArray[np.int64], absent: int) -> None:
        """Note that stamps of a topic are missing, so that all are log times, and the log times' jitter."""
        if not absent:
            return
        self._by_log.add(topic)
        jitter = jitter_ns(np.diff(t_ns))
        self.stamp_sigma_s = max(self.stamp_sigma_s, float(np.hypot(UNKNOWN_LOG_DELAY_S, jitter * 1e-9)))
        self.remark(
            f"topic {topic}: {absent} of {len(t_ns)} messages have no stamp; all get their log times, which are "
            f"late by an unknown delay (assumed {1e3 * UNKNOWN_LOG_DELAY_S:.0f} ms, one sigma) and jitter "
            f"by {jitter * 1e-6:.2g} ms (sigma)"
        )


def _concatenate(parts: Sequence[Times]) -> Times:
    none = np.empty(0, np.int64)
    return np.concatenate([none, *(t_ns for t_ns, _ in parts)]), np.concatenate([none, *(log for _, log in parts)])


def _poses(rows: list[tuple[int, int, Array]]) -> tuple[series.PoseSeries, int]:
    """Make poses of rows of stamp (0: none), log time, and x, y, z, qx, qy, qz, qw; count those left out."""
    stamps, log_ns = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2).T
    kept, absent = one_clock(stamps, log_ns)
    numbers = np.array([row[2] for row in rows]).reshape(-1, 7)[kept]
    t_ns, from_log = (log_ns, len(rows)) if absent else (stamps[kept], 0)
    poses = series.PoseSeries(t_ns, numbers[:, [6, 3, 4, 5]], numbers[:, :3], stamped_by_log=from_log)
    return poses, int(np.count_nonzero(~kept))
