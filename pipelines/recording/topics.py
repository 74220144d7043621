"""Topics by their keys in the config, those made of others; what a method needs of a recording, and what is there.

topics:
  head_imu: /helmet/imu                                            # a name
  vision_attitude: {topic: /tracker/pose, invert: true}            # the tracker gives the inverse
  vision_attitude: {topic: /tf, frames: [camera, helmet]}          # one pair of frames of a TFMessage
  imu: {gyro: /gyro, accel: /accelerometer}                        # two topics, of any type that holds them
  imu: {topic: /imu, frame: imu_left}                              # of several devices on one topic the one
  imu: {topic: /imu, axes: [y, -x, z]}                             # other axes: x is the recorded y, y the -x
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_serializer, model_validator

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.recording import messages, series

if TYPE_CHECKING:
    from alidade.pipelines.recording.recording import Recording, TopicInfo
    from alidade.pipelines.settings import Config


@dataclass(frozen=True)
class Topic:
    """A topic of the contract: its key in the config, its default name and the message types it may have."""

    key: str
    name: str
    types: tuple[str, ...]


@dataclass(frozen=True)
class Setting:
    """A key of the config that replaces a topic: how to ask for it, and whether a config has it."""

    phrase: str
    given: Callable[[Config], bool]


# One thing a method cannot do without: all topics and settings of at least one group.
Need = Sequence[Sequence[Topic | Setting]]

# Topics that several methods read.
IMU = Topic("imu", "/imu", messages.IMUS)
MAG = Topic("mag", "/mag", (messages.MAGNETIC_FIELD,))
FIX = Topic("fix", "/fix", (messages.NAV_SAT_FIX,))
TEMPERATURE = Topic("temperature", "/temperature", (messages.TEMPERATURE,))
IMAGE = Topic("image", "/camera/image/compressed", messages.PICTURES)
CAMERA_INFO = Topic("camera_info", "/camera/camera_info", (messages.CAMERA_INFO,))


def wanted(recording: Recording, config: Config, topic: Topic) -> bool:
    """Whether an optional topic is there with messages in it, or the config asks for it by name."""
    found = recording.topics.get(config.topic(topic))
    return bool(found and found.count) or topic.key in config.topics


Axis = Literal["x", "y", "z", "+x", "+y", "+z", "-x", "-y", "-z"]


def _each_once(axes: tuple[Axis, Axis, Axis]) -> tuple[Axis, Axis, Axis]:
    if len({axis[-1] for axis in axes}) < 3:
        raise ValueError("each of x, y and z is needed once, with its sign")
    return axes


# What is x, y and z, in other axes.
Axes = Annotated[tuple[Axis, Axis, Axis], Field(strict=False), AfterValidator(_each_once)]


def along(axes: Axes | None, vectors: Array) -> Array:
    """Return vectors (N, 3) along other axes, each given as a signed axis of the recorded ones."""
    if axes is None:
        return vectors
    signs = [-1.0 if axis.startswith("-") else 1.0 for axis in axes]
    return np.asarray(vectors[:, ["xyz".index(axis[-1]) for axis in axes]] * signs)


class TopicSource(BaseModel):
    """Source of a topic: a recorded one, one of its pairs of frames, its inverse, or two topics.

    Attributes:
        topic: recorded name.
        frames: parent and child, of a tf2_msgs/msg/TFMessage.
        invert: whether the recorded attitude is the inverse of the one meant.
        frame: header.frame_id of the messages that are meant.
        axes: what is x, y and z, in the recorded axes, of an IMU or magnetometer.
        gyro, accel: topics whose rates and accelerations make an IMU; without `accel` there are rates alone.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    topic: str | None = None
    frames: Annotated[tuple[str, str], Field(strict=False)] | None = None
    invert: bool = False
    frame: str | None = None
    axes: Axes | None = None
    gyro: str | None = None
    accel: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        return {"topic": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _one_way(self) -> TopicSource:
        if (self.topic is None) == (self.gyro is None):
            raise ValueError("either a topic or a gyro is needed")
        if self.gyro is None and self.accel is not None:
            raise ValueError("accel goes with a gyro")
        if self.gyro is not None and (self.frames or self.invert or self.frame):
            raise ValueError("frame, frames and invert go with a topic")
        if self.axes and (self.frames or self.invert):
            raise ValueError("axes go with an IMU or a magnetometer, not with frames or invert")
        if self.frame and self.frames:
            raise ValueError("frame is of a header, frames of a transform: give one of them")
        return self

    @model_serializer
    def _plain(self) -> str | dict[str, Any]:
        given = {name: value for name, value in self.__dict__.items() if value not in (None, False)}
        return given["topic"] if given.keys() == {"topic"} else given

    @property
    def is_made(self) -> bool:
        """Whether the source is derived, that is, more than the name of a recorded topic."""
        return self.topic is None or self.frames is not None or self.invert or bool(self.frame or self.axes)

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the recorded topics that the source is made of."""
        return tuple(part for part in (self.topic, self.gyro, self.accel) if part is not None)

    @property
    def name(self) -> str:
        """Name of the recorded topic, or description of a derived one."""
        axes = f" along {', '.join(self.axes)}" if self.axes else ""
        if self.topic is None:
            return (f"{self.gyro} with {self.accel}" if self.accel else f"{self.gyro} as gyro") + axes
        frames = f" ({' to '.join(self.frames)})" if self.frames else f" of {self.frame}" if self.frame else ""
        return f"{self.topic}{frames}{' inverted' if self.invert else ''}{axes}"


def inverted(poses: series.PoseSeries) -> series.PoseSeries:
    """Return poses with the inverse of every attitude.

    The covariance of the rotation is that of delta in R*Exp(delta) before and after: of R' = R^T it is R*cov*R^T.
    Positions' covariances are left out, zero.
    """
    rotation = so3.matrix(poses.wxyz)
    cov = np.zeros_like(poses.cov)
    cov[:, 3:, 3:] = rotation @ poses.cov[:, 3:, 3:] @ rotation.swapaxes(1, 2)
    position = -np.einsum("nji,nj->ni", rotation, poses.position)
    wxyz = poses.wxyz * [1.0, -1.0, -1.0, -1.0]
    return series.PoseSeries(poses.t_ns, wxyz, position, cov, stamped_by_log=poses.stamped_by_log)


def joined(gyro: series.VectorSeries, accel: series.VectorSeries | None) -> series.ImuSeries:
    """Join rates with accelerations, interpolated linearly at the stamps of the rates; NaN outside of the samples."""
    if accel is None or len(accel) == 0:
        values: Array = np.full(3, np.nan)
    elif np.array_equal(gyro.t_ns, accel.t_ns):
        values = accel.vector
    else:
        order = np.argsort(accel.t_ns, kind="stable")
        start = min(int(gyro.t_ns[0]), int(accel.t_ns[order[0]]))
        at, t = (gyro.t_ns - start) * 1e-9, (accel.t_ns[order] - start) * 1e-9
        columns = [np.interp(at, t, column, np.nan, np.nan) for column in accel.vector[order].T]
        values = np.stack(columns, axis=1)
    by_log = gyro.stamped_by_log + (0 if accel is None else accel.stamped_by_log)
    return series.ImuSeries(gyro.t_ns, gyro.vector, values, stamped_by_log=by_log, frame_id=gyro.frame_id)


@dataclass(frozen=True)
class TopicFacts:
    """Rates and gaps of one topic. Times are s from the session's start; None where there are too few messages.

    rate_hz is one over the median interval between stamps; the largest gap is the longest interval and where it begins.
    """

    name: str
    type: str
    count: int
    start_s: float | None
    duration_s: float | None
    rate_hz: float | None
    largest_gap_s: float | None
    largest_gap_at_s: float | None
    duplicates: int
    out_of_order: int


@dataclass(frozen=True)
class SessionFacts:
    """Facts about a recording: start, Unix ns, length, s, topics, and method -> what the recording lacks for it.

    lost: topic -> messages that are known to be lost; notes: sentences about what of the file cannot be used;
    proposed: method -> keys of the config that the recording suggests, each with the reason.
    """

    epoch_ns: int
    duration_s: float
    attachments: tuple[str, ...]
    topics: tuple[TopicFacts, ...]
    missing: dict[str, tuple[str, ...]]
    lost: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    proposed: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods for which the recording lacks nothing."""
        return tuple(method for method, lacking in self.missing.items() if not lacking)


def facts_of(recording: Recording, config: Config, needs: Mapping[str, Sequence[Need]]) -> SessionFacts:
    """Return facts about all topics of a recording, and for each method its needs that the recording does not meet."""
    epoch, times = recording.epoch_ns, recording.times
    topics = tuple(_facts(recording.topics[name], epoch, *times[name]) for name in recording.topics)
    missing = {method: lacking(wanted, recording, config) for method, wanted in needs.items()}
    return SessionFacts(
        epoch,
        recording.duration_s,
        recording.container.attachments,
        topics,
        missing,
        recording.container.missing,
        recording.notes,
    )


def lacking(needs: Sequence[Need], recording: Recording, config: Config) -> tuple[str, ...]:
    """Needs of a method that a recording with this config does not meet, one phrase each."""
    phrases = []
    for groups in needs:
        texts = [" and ".join(filter(None, (_lack(one, recording, config) for one in group))) for group in groups]
        if all(texts):
            phrases.append(", or ".join(texts))
    return tuple(phrases)


def _facts(topic: TopicInfo, epoch_ns: int, t_ns: NDArray[np.int64], log_ns: NDArray[np.int64]) -> TopicFacts:
    stamps = t_ns[np.argsort(log_ns, kind="stable")] - epoch_ns
    backward = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps))) if len(stamps) else 0
    stamps = np.sort(stamps)
    steps = np.diff(stamps)
    start = float(stamps[0]) / 1e9 if len(stamps) else None
    duration = rate = gap = gap_at = None
    if len(steps) and stamps[-1] > stamps[0]:
        duration = float(stamps[-1] - stamps[0]) / 1e9
        rate = 1e9 / float(np.median(steps[steps > 0]))
        widest = int(np.argmax(steps))
        gap, gap_at = float(steps[widest]) / 1e9, float(stamps[widest]) / 1e9
    duplicates = int(np.count_nonzero(steps == 0))
    return TopicFacts(topic.name, topic.type, len(stamps), start, duration, rate, gap, gap_at, duplicates, backward)


def _lack(need: Topic | Setting, recording: Recording, config: Config) -> str:
    """Phrase for a missing topic or config key; empty if it is there."""
    if isinstance(need, Setting):
        return "" if need.given(config) else need.phrase
    name = config.topic(need)
    found = recording.topics.get(name)
    types = " or ".join(need.types)
    if found is None:
        return f"{name} ({need.types[0]})"
    if found.type not in need.types:
        return f"{name} as {types}, not {found.type}"
    if not found.is_readable:
        return f"{name} in an encoding that is read, not {found.encoding}"
    return "" if found.count else f"messages on {name}"
