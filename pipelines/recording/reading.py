"""Recordings as arrays.

    recording = open_recording(Path("session.mcap"))
    imu = recording.imu("/imu")         # imu.t_ns, imu.gyro, ...

Time is header.stamp; log time stands in only where the stamp is zero, and the series counts those. Messages come in
the order of their log times. Every method raises InputError, naming what is there, when the topic is missing or empty,
holds another type, cannot be decoded, or its clock was set in between (alidade.pipelines.recording.clocks). A chunk
that is damaged is left out, see `Recording.notes`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines import progress
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import messages, series, video
from alidade.pipelines.recording.clocks import check_clock
from alidade.pipelines.recording.container import Container, DataLoss
from alidade.pipelines.recording.decoding import Table, Times
from alidade.pipelines.recording.message_reader import TIMED, MessageReader, Topic
from alidade.pipelines.recording.netpbm import netpbm
from alidade.pipelines.recording.opening import Where, open_container
from alidade.pipelines.recording.plausibility import to_signed, wrapped_bits
from alidade.pipelines.recording.sources import TopicSource, along, inverted, joined
from alidade.pipelines.recording.stamps import jitter_ns
from alidade.pipelines.recording.table_topics import TableTopic, described, tables_of
from alidade.pipelines.recording.tables import CsvFile

# Pairs of frames an error lists.
_MOST_PAIRS = 30

# How late messages usually are when they are logged, s.
_LATE = 0.01

# Quantities that may be counts.
_COUNTED: Mapping[type, tuple[str, ...]] = {
    series.ImuSeries: ("gyro", "accel"),
    series.MagneticSeries: ("field",),
    series.VectorSeries: ("vector",),
}

AnySeries = TypeVar("AnySeries", bound=series.Series)


def open_recording(where: Where, strict: bool = False) -> Recording:
    """The recording in a file, a folder of parts, files named by a pattern or a list; see docs/reference/messages.md.

    One that is still being written, or is damaged, is read as far as it is sound. Raises InputError when something is
    missing, empty or no recording, when nothing in it can be read, and with `strict` when anything is lost: truncated,
    damaged, without summary.
    """
    return Recording(open_container(where, strict))


class Recording:
    """A recording, whatever its form. Holds positions in the file and stamps, not the messages.

    Args:
        container: where its messages are.
        epoch_ns: start of the session, Unix ns, where the container has not got its first messages.

    Attributes:
        stamp_sigma_s: how well the stamps read by now are known, s: 0, but where log times stand in for them.
    """

    def __init__(self, container: Container, epoch_ns: int | None = None) -> None:
        self.path = container.path
        self._container = container
        self._epoch_ns = epoch_ns
        self._reader = MessageReader(container, str(container.path), epoch_ns)
        self._made: dict[str, TopicSource] = {}
        self._transforms: dict[str, dict[tuple[str, str], series.PoseSeries]] = {}
        self.stamp_sigma_s = 0.0

    @property
    def topics(self) -> Mapping[str, Topic]:
        """By name: those recorded, and those that `use` makes of them."""
        recorded = self._reader.topics
        made = {name: found for name, source in self._made.items() if (found := self._made_topic(name, source))}
        return {**recorded, **made}

    def remark(self, sentence: str) -> None:
        """Note something that was assumed about the recording, once."""
        if sentence not in self._container.assumptions:
            self._container.assumptions = (*self._container.assumptions, sentence)

    def use(self, sources: Iterable[TopicSource], columns: Mapping[str, TableTopic]) -> None:
        """Take what the config says of topics that are made of others, and of the columns of tables.

        Raises InputError when a table or a column is not there, or holds no numbers.
        """
        if columns:
            self._container = described(self._container, columns)
            self._reader = MessageReader(self._container, str(self.path), self._epoch_ns)
        self._made = {source.name: source for source in sources if source.is_made}

    def tables(self) -> dict[str, CsvFile]:
        """The tables that no config describes yet, by the names of their files."""
        return tables_of(self._container)

    def sha256(self) -> str:
        """SHA-256 of the file, hexadecimal."""
        return self._container.sha256()

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return self._container.attachments

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """The attachment of that name, None if there is none.

        One that is damaged raises InputError; if it is not needed, it is noted as lost.
        """
        return self._container.attachment(name, needed)

    @property
    def losses(self) -> tuple[DataLoss, ...]:
        """What of the file cannot be used; complete when all topics that matter have been read."""
        return tuple(self._container.losses)

    @property
    def missing(self) -> dict[str, int]:
        """Topic -> messages known to be lost."""
        return self._container.missing

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about what is lost, what was assumed, and how stamps came about in the topics read by now."""
        container = self._container
        lost = container.notes(self.epoch_ns, self.duration_s) if container.losses or container.missing else ()
        return (*container.incomplete, *container.assumptions, *self._reader.stamp_notes, *lost)

    @property
    def epoch_ns(self) -> int:
        """Start of the session, Unix ns: the earliest first stamp of a sensor topic, else the first log time."""
        return self._reader.epoch_ns

    @property
    def delay_ns(self) -> int:
        """How much later than their stamps messages were logged, at least, in the topics read by now; ns."""
        return self._reader.delay_ns

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last, by their log times, s."""
        first, last = self._reader.span
        return (last - first) * 1e-9

    @property
    def times(self) -> Mapping[str, Times]:
        """Topic -> stamps (log times where there is no header to be read) and log times."""
        made = {name: source.parts[0] for name, source in self._made.items()}
        times = self._reader.times
        return {**times, **{name: times[base] for name, base in made.items() if base in times}}

    def forget_times(self) -> None:
        """Let go of the stamps read by now, which would stay as long as the recording; `times` reads them anew."""
        self._reader.forget_times()

    def there(self) -> str:
        """A phrase that lists the topics of the recording, and what is lost of it."""
        return self._reader.there()

    def read_together(self, topics: Mapping[str, Sequence[str]]) -> None:
        """Decode topics in one pass over the file, to have them at hand when the methods below ask for them.

        A topic that has no numbers, or cannot be read, is left to the method, which says why.

        Args:
            topics: names, each with the joints wanted if it is a sensor_msgs/msg/JointState.
        """
        wanted = dict(topics)
        for name in wanted.keys() & self._made.keys():
            wanted |= dict.fromkeys(self._made[name].parts, ())
        self._reader.read_together(wanted)

    def imu(self, topic: str, frame: str | None = None) -> series.ImuSeries:
        """A sensor_msgs/msg/Imu topic, or rates alone from a Vector3Stamped or TwistStamped one: accelerations NaN."""
        if topic in self._made:
            return self._made_imu(topic, self._made[topic])
        self._reader.require(topic, *messages.RATES)
        if self.topics[topic].type == messages.IMU:
            return self._series(series.ImuSeries, topic, frame)
        rate = self._series(series.VectorSeries, topic, frame)
        return series.ImuSeries(rate.t_ns, rate.vector, np.full(3, np.nan), stamped_by_log=rate.stamped_by_log)

    def magnetic(self, topic: str) -> series.MagneticSeries:
        """A sensor_msgs/msg/MagneticField topic."""
        source = self._made.get(topic)
        if source is None:
            return self._series(series.MagneticSeries, topic)
        if source.topic is None:
            raise InputError(f"{self.path}: topic {topic} is made of rates; it holds no magnetic field")
        found = self._series(series.MagneticSeries, source.topic, source.frame)
        return dataclasses.replace(found, field=along(source.axes, found.field))

    def vector(self, topic: str) -> series.VectorSeries:
        """A geometry_msgs/msg/Vector3Stamped topic, a TwistStamped's rates or an AccelStamped's accelerations."""
        return self._series(series.VectorSeries, topic)

    def quaternion(self, topic: str) -> series.QuaternionSeries:
        """A geometry_msgs/msg/QuaternionStamped topic."""
        return self._series(series.QuaternionSeries, topic)

    def poses(self, topic: str, frame: str | None = None) -> series.PoseSeries:
        """A topic of poses, or of attitudes alone, in any of the types of messages.ATTITUDES."""
        if topic in self._made:
            return self._made_poses(topic, self._made[topic])
        self._reader.require(topic, *messages.ATTITUDES)
        kind = self.topics[topic].type
        if kind == messages.IMU:
            return self._attitudes(topic, frame)
        if kind != messages.QUATERNION:
            return self._series(series.PoseSeries, topic, frame)
        attitude = self._series(series.QuaternionSeries, topic, frame)
        return series.PoseSeries(attitude.t_ns, attitude.wxyz, stamped_by_log=attitude.stamped_by_log)

    def poses_of(self, source: TopicSource) -> series.PoseSeries:
        """As `poses`, of a source that `use` need not know."""
        return self._made_poses(source.name, source)

    def transforms(self, topic: str) -> Mapping[tuple[str, str], series.PoseSeries]:
        """Frames, parent and child -> the transforms between them, on a tf2_msgs/msg/TFMessage topic."""
        if topic not in self._transforms:
            rows: dict[tuple[str, str], list[tuple[int, bool, Any]]] = {}
            for log_ns, _, message, definition in self._reader.decoded(topic, messages.TF):
                with self._reader.fields(topic):
                    for one in message.transforms:
                        t_ns = one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec
                        row = t_ns or log_ns, not t_ns, definition.numbers(one.transform)
                        pair = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
                        rows.setdefault(pair, []).append(row)
            self._transforms[topic] = {pair: _series_of_transforms(found) for pair, found in rows.items()}
        return self._transforms[topic]

    def fixes(self, topic: str) -> series.FixSeries:
        """A sensor_msgs/msg/NavSatFix topic."""
        return self._series(series.FixSeries, topic)

    def temperature(self, topic: str) -> series.TemperatureSeries:
        """A sensor_msgs/msg/Temperature topic."""
        return self._series(series.TemperatureSeries, topic)

    def joints(self, topic: str, names: Sequence[str]) -> series.JointSeries:
        """Positions of the named joints on a sensor_msgs/msg/JointState topic, whatever order the messages have."""
        self._reader.require(topic, messages.JOINT_STATE)
        columns = self._reader.columns(topic, tuple(names))
        table = columns.table
        if not table.filled.any():
            raise InputError(
                f"{self.path}: topic {topic} has no message with positions of the joints {', '.join(names)}; "
                f"its joints: {', '.join(columns.joints) or 'none'}"
            )
        check_clock(topic, *table.times(), self.epoch_ns)
        t_ns, by_log, numbers = table.sorted()
        self._tell_unstamped(topic, t_ns, by_log)
        without = table.taken - int(np.count_nonzero(table.filled))
        return series.JointSeries(t_ns, numbers["position"], tuple(names), by_log, without)

    def camera_info(self, topic: str) -> series.CameraInfo:
        """The first message of a sensor_msgs/msg/CameraInfo topic."""
        for t_ns, _, message, _ in self._reader.decoded(topic, messages.CAMERA_INFO):
            with self._reader.fields(topic):
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
        """(stamp in ns, file) of the pictures on a CompressedImage or Image topic, one by one.

        Raw ones, and those of a H.264 video, are files in the Netpbm form.
        """
        self._reader.require(topic, *messages.PICTURES)
        files = progress.track(self._files(topic), "pictures", self.topics[topic].count)
        for t_ns, form, data in files:
            if form in video.OTHERS:
                raise InputError(f"{self.path}: topic {topic}: a video in {form}; H.264 is read, or single pictures")
            if form in video.H264:
                packets = itertools.chain([(t_ns, data)], ((t_ns, data) for t_ns, _, data in files))
                yield from self._video(topic, packets)
                return
            yield t_ns, data

    def _files(self, topic: str) -> Iterator[tuple[int, str, bytes]]:
        """(stamp in ns, form, file or message of a video) of the messages of a topic of pictures."""
        is_raw = self.topics[topic].type == messages.IMAGE
        for t_ns, _, message, _ in self._reader.decoded(topic, *messages.PICTURES):
            with self._reader.fields(topic):
                file = ("netpbm", netpbm(message)) if is_raw else (message.format.lower(), message.data.tobytes())
            yield t_ns, *file

    def _video(self, topic: str, packets: Iterable[tuple[int, bytes]]) -> Iterator[tuple[int, bytes]]:
        """The pictures of a video."""
        try:
            yield from video.decoded(packets)
        except ValueError as error:
            raise InputError(f"{self.path}: topic {topic}: {error}") from error

    def detections(self, topic: str) -> series.DetectionSeries:
        """An apriltag_msgs/msg/AprilTagDetectionArray topic, with corners as points or as plain numbers."""
        stamps: list[int] = []
        by_log = 0
        frame, tag_id, corners, hamming, margin, family = [], [], [], [], [], []
        for i, (t_ns, from_log, message, definition) in enumerate(self._reader.decoded(topic, messages.TAG_DETECTIONS)):
            stamps.append(t_ns)
            by_log += from_log
            with self._reader.fields(topic):
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

    def _made_topic(self, name: str, source: TopicSource) -> Topic | None:
        """What a made topic is; None if something that it is made of is not there."""
        parts = [self._reader.topics.get(part) for part in source.parts]
        found = [part for part in parts if part is not None]
        if len(found) < len(parts):
            return None
        is_pose = source.topic is not None and (bool(source.frames) or source.invert)
        kind = messages.POSE if is_pose else messages.IMU if source.topic is None else found[0].type
        is_readable = all(part.is_readable for part in found)
        return Topic(name, kind, found[0].count, found[0].encoding, is_readable)

    def _made_poses(self, name: str, source: TopicSource) -> series.PoseSeries:
        if source.topic is None:
            raise InputError(f"{self.path}: topic {name} is made of rates; it holds no attitude")
        whole = (source.topic, source.frame)
        poses = self._between(source.topic, source.frames) if source.frames else self.poses(*whole)
        return inverted(poses) if source.invert else poses

    def _made_imu(self, name: str, source: TopicSource) -> series.ImuSeries:
        if source.frames or source.invert:
            raise InputError(f"{self.path}: topic {name} is made of attitudes; it holds no rates")
        if source.topic is not None:
            imu = self.imu(source.topic, source.frame)
        else:
            accel = None if source.accel is None else self._part(source.accel, "accel")
            imu = joined(self._part(source.gyro or "", "gyro"), accel)
        return dataclasses.replace(imu, gyro=along(source.axes, imu.gyro), accel=along(source.axes, imu.accel))

    def _part(self, topic: str, which: str) -> series.VectorSeries:
        """The rates or accelerations on a topic that holds either."""
        self._reader.require(topic, messages.IMU, messages.VECTOR, messages.TWIST, messages.ACCEL)
        if self.topics[topic].type != messages.IMU:
            return self._series(series.VectorSeries, topic)
        imu = self._series(series.ImuSeries, topic)
        return series.VectorSeries(imu.t_ns, getattr(imu, which), stamped_by_log=imu.stamped_by_log)

    def _between(self, topic: str, frames: tuple[str, str]) -> series.PoseSeries:
        """The transforms of a pair of frames, parent and child, in the messages of a TFMessage topic."""
        pairs = self.transforms(topic)
        found = pairs.get((frames[0].lstrip("/"), frames[1].lstrip("/")))
        if found is None:
            there = ", ".join(f"{parent} to {child}" for parent, child in sorted(pairs)[:_MOST_PAIRS])
            raise InputError(
                f"{self.path}: topic {topic} has no transform from {frames[0]} to {frames[1]}; there: {there or 'none'}"
            )
        self._tell_unstamped(topic, found.t_ns, found.stamped_by_log)
        return found

    def _attitudes(self, topic: str, frame: str | None) -> series.PoseSeries:
        """The orientations of an Imu topic. Raises InputError where it has none."""
        imu = self.imu(topic, frame)
        if (imu.wxyz_cov[:, 0, 0] < 0.0).all():
            raise InputError(
                f"{self.path}: topic {topic}: orientation_covariance starts with -1, so there is no attitude in it"
            )
        cov = np.zeros((len(imu), 6, 6))
        cov[:, 3:, 3:] = imu.wxyz_cov
        return series.PoseSeries(imu.t_ns, imu.wxyz, cov=cov, stamped_by_log=imu.stamped_by_log)

    def _series(self, kind: type[AnySeries], topic: str, frame: str | None = None) -> AnySeries:
        self._reader.require(topic, kind.TYPE, *kind.OTHERS)
        table = self._reader.columns(topic).table
        self._choose(topic, table, frame)
        if self.topics[topic].type in TIMED:
            check_clock(topic, *table.times(), self.epoch_ns)
        t_ns, by_log, columns = table.sorted()
        self._tell_unstamped(topic, t_ns, by_log)
        for name in _COUNTED.get(kind, ()):
            if bits := wrapped_bits(columns[name]):
                columns[name] = to_signed(columns[name], bits)
                self.remark(
                    f"topic {topic}: {name} jumps by {1 << bits}: counts of a signed {bits} bit sensor that were "
                    "written as unsigned, read as signed"
                )
        return kind(t_ns, stamped_by_log=by_log, **columns)

    def _choose(self, topic: str, table: Table, frame: str | None) -> None:
        """Keep the messages of a frame. Raises InputError where there are none, and where none is asked for of several.

        Frames that follow one another in time are one device that was renamed.
        """
        frames = table.frames()
        there = ", ".join(f"{name or 'without a name'} ({int(rows.sum())} messages)" for name, rows in frames.items())
        if frame is not None:
            if frame.lstrip("/") not in frames:
                raise InputError(f"{self.path}: topic {topic} has no messages of the frame {frame}; there: {there}")
            table.keep(frames[frame.lstrip("/")])
            return
        spans = [np.flatnonzero(rows)[[0, -1]] for rows in frames.values() if rows.sum() > 1]
        spans.sort(key=lambda span: int(span[0]))
        if any(after[0] < before[1] for before, after in itertools.pairwise(spans)):
            raise InputError(
                f"{self.path}: topic {topic} has messages of several devices, by their frames: {there}; choose one: "
                f"`{{topic: {topic}, frame: {next(iter(frames))}}}` in place of its name under `topics:`"
            )

    def _tell_unstamped(self, topic: str, t_ns: NDArray[np.int64], by_log: int) -> None:
        """Remark that log times stand in for stamps, and by how much they jitter."""
        if not by_log:
            return
        jitter = jitter_ns(np.diff(t_ns))
        self.stamp_sigma_s = max(self.stamp_sigma_s, float(np.hypot(_LATE, jitter * 1e-9)))
        sentence = (
            f"topic {topic}: {by_log} of {len(t_ns)} messages have no stamp; the log times stand in, which are "
            f"late by a delay that nobody knows (taken for {1e3 * _LATE:.0f} ms, one sigma) and jitter by "
            f"{jitter * 1e-6:.2g} ms (sigma)"
        )
        self.remark(sentence)


def _series_of_transforms(rows: Sequence[tuple[int, bool, Any]]) -> series.PoseSeries:
    """Transforms as (stamp, whether it is a log time, translation and quaternion x, y, z, w)."""
    numbers = np.array([row[2] for row in rows]).reshape(len(rows), 7)
    t_ns = np.array([row[0] for row in rows], dtype=np.int64)
    by_log = sum(row[1] for row in rows)
    return series.PoseSeries(t_ns, numbers[:, [6, 3, 4, 5]], numbers[:, :3], stamped_by_log=by_log)
