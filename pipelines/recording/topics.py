"""Topics by the keys they have in the config, what a method needs of a recording, and topics made of recorded ones.

topics:
  head_imu: /helmet/imu                                            # a name
  vision_attitude: {topic: /tracker/pose, invert: true}            # the tracker gives the inverse
  vision_attitude: {topic: /tf, frames: [camera, helmet]}          # one pair of frames of a TFMessage
  imu: {gyro: /gyro, accel: /accelerometer}                        # two topics, of any type that holds them
  imu: {topic: /imu, frame: imu_left}                              # of several devices on one topic the one
  imu: {topic: /imu, axes: [y, -x, z]}                             # other axes: x is the recorded y, y the -x
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_serializer, model_validator

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.recording import messages, series

if TYPE_CHECKING:
    from alidade.pipelines.recording.recording import Recording
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
