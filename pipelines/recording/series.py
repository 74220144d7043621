"""Series: content of a topic as arrays, the same classes for reading and writing.

Stamps `t_ns` are header stamps, Unix time in integer ns, shape (N,); `stamped_by_log` counts those that had to be taken
from the log times. Quaternions are w, x, y, z. Covariances are those of the messages: zero means unknown, and a first
element of -1 that there is no such measurement. What is left out when a series is built by hand is filled in as ROS
does it: no orientation is the identity with covariance -1.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alidade.factors.array import Array, Stamps
from alidade.pipelines.recording import messages

_XYZW_TO_WXYZ = (3, 0, 1, 2)
# Covariance of what was not measured, as ROS has it.
ABSENT = np.diag([-1.0, 0.0, 0.0])
_FILLED_IN: Any = None


@dataclass(frozen=True)
class Column:
    """Mapping of a series' attribute to a message: field, shape of one value, order of its numbers."""

    path: str
    shape: tuple[int, ...]
    order: tuple[int, ...] | None = None


@dataclass(frozen=True, eq=False)
class Stamped:
    """Messages of type TYPE at stamps (N,), Unix ns."""

    TYPE: ClassVar[str]

    t_ns: Stamps
    stamped_by_log: int = dataclasses.field(default=0, kw_only=True)
    frame_id: str = dataclasses.field(default="", kw_only=True)

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True, eq=False)
class Series(Stamped):
    """Base of a sensor's readings: arrays with a row for each of N messages of a topic.

    Arrays that are left out are filled in. Raises ValueError at a wrong shape.
    """

    COLUMNS: ClassVar[dict[str, Column]]
    # Where other types of messages hold the columns; what they have not got is filled in.
    OTHERS: ClassVar[dict[str, dict[str, Column]]] = {}
    DEFAULTS: ClassVar[dict[str, ArrayLike]] = {}

    def __post_init__(self) -> None:
        stamps = np.asarray(self.t_ns)
        if stamps.ndim != 1 or stamps.dtype.kind not in "iu":
            raise ValueError(f"{type(self).__name__}.t_ns: shape (N,) of integer ns, not {stamps.dtype}{stamps.shape}")
        object.__setattr__(self, "t_ns", stamps.astype(np.int64, copy=False))
        for name, column in self.COLUMNS.items():
            value = getattr(self, name)
            value = np.asarray(self.DEFAULTS.get(name, 0.0) if value is None else value, dtype=float)
            object.__setattr__(self, name, np.broadcast_to(value, (len(stamps), *column.shape)))


@dataclass(frozen=True, eq=False)
class ImuSeries(Series):
    """Gyro (N, 3) rad/s, accelerometer (N, 3) m/s^2, attitude (N, 4), the covariances of a sample (N, 3, 3) each."""

    TYPE: ClassVar[str] = messages.IMU
    COLUMNS: ClassVar[dict[str, Column]] = {
        "gyro": Column("angular_velocity", (3,)),
        "accel": Column("linear_acceleration", (3,)),
        "wxyz": Column("orientation", (4,), _XYZW_TO_WXYZ),
        "gyro_cov": Column("angular_velocity_covariance", (3, 3)),
        "accel_cov": Column("linear_acceleration_covariance", (3, 3)),
        "wxyz_cov": Column("orientation_covariance", (3, 3)),
    }
    DEFAULTS: ClassVar[dict[str, ArrayLike]] = {"wxyz": [1.0, 0.0, 0.0, 0.0], "wxyz_cov": ABSENT}

    gyro: Array
    accel: Array = _FILLED_IN
    wxyz: Array = _FILLED_IN
    gyro_cov: Array = _FILLED_IN
    accel_cov: Array = _FILLED_IN
    wxyz_cov: Array = _FILLED_IN


@dataclass(frozen=True, eq=False)
class MagneticSeries(Series):
    """Magnetic field (N, 3) T and its covariance (N, 3, 3)."""

    TYPE: ClassVar[str] = messages.MAGNETIC_FIELD
    COLUMNS: ClassVar[dict[str, Column]] = {
        "field": Column("magnetic_field", (3,)),
        "field_cov": Column("magnetic_field_covariance", (3, 3)),
    }

    field: Array
    field_cov: Array = _FILLED_IN


@dataclass(frozen=True, eq=False)
class VectorSeries(Series):
    """Vectors (N, 3): of a TwistStamped the angular rate, of an AccelStamped the linear acceleration."""

    TYPE: ClassVar[str] = messages.VECTOR
    COLUMNS: ClassVar[dict[str, Column]] = {"vector": Column("vector", (3,))}
    OTHERS: ClassVar[dict[str, dict[str, Column]]] = {
        messages.TWIST: {"vector": Column("twist.angular", (3,))},
        messages.ACCEL: {"vector": Column("accel.linear", (3,))},
    }

    vector: Array


@dataclass(frozen=True, eq=False)
class QuaternionSeries(Series):
    """Attitudes as quaternions (N, 4), for writing; they are read as poses."""

    TYPE: ClassVar[str] = messages.QUATERNION
    COLUMNS: ClassVar[dict[str, Column]] = {"wxyz": Column("quaternion", (4,), _XYZW_TO_WXYZ)}

    wxyz: Array


@dataclass(frozen=True, eq=False)
class PoseSeries(Series):
    """Attitudes (N, 4), positions (N, 3) m, covariances (N, 6, 6) in the order x, y, z, rotation about x, y, z."""

    TYPE: ClassVar[str] = messages.POSE
    COLUMNS: ClassVar[dict[str, Column]] = {
        "wxyz": Column("pose.pose.orientation", (4,), _XYZW_TO_WXYZ),
        "position": Column("pose.pose.position", (3,)),
        "cov": Column("pose.covariance", (6, 6)),
    }
    OTHERS: ClassVar[dict[str, dict[str, Column]]] = {
        messages.ODOMETRY: COLUMNS,
        messages.QUATERNION: QuaternionSeries.COLUMNS,
        messages.PLAIN_POSE: {
            "wxyz": Column("pose.orientation", (4,), _XYZW_TO_WXYZ),
            "position": Column("pose.position", (3,)),
        },
        messages.TRANSFORM: {
            "wxyz": Column("transform.rotation", (4,), _XYZW_TO_WXYZ),
            "position": Column("transform.translation", (3,)),
        },
    }

    wxyz: Array
    position: Array = _FILLED_IN
    cov: Array = _FILLED_IN


@dataclass(frozen=True, eq=False)
class FixSeries(Series):
    """Latitude and longitude (N,) deg, height above the WGS 84 ellipsoid (N,) m, status (N,) (-1: no fix)."""

    TYPE: ClassVar[str] = messages.NAV_SAT_FIX
    COLUMNS: ClassVar[dict[str, Column]] = {
        "latitude_deg": Column("latitude", ()),
        "longitude_deg": Column("longitude", ()),
        "height": Column("altitude", ()),
        "status": Column("status.status", ()),
    }

    latitude_deg: Array
    longitude_deg: Array
    height: Array = _FILLED_IN
    status: Array = _FILLED_IN


@dataclass(frozen=True, eq=False)
class TemperatureSeries(Series):
    """Temperatures (N,), degrees Celsius."""

    TYPE: ClassVar[str] = messages.TEMPERATURE
    COLUMNS: ClassVar[dict[str, Column]] = {"celsius": Column("temperature", ())}

    celsius: Array


@dataclass(frozen=True, eq=False)
class JointSeries(Stamped):
    """Positions (N, len(names)) rad of the named joints; `without` counts messages that lack one of them."""

    TYPE: ClassVar[str] = messages.JOINT_STATE

    position: Array
    names: tuple[str, ...]
    without: int = 0


@dataclass(frozen=True, eq=False)
class DetectionSeries(Stamped):
    """AprilTags found in pictures: M detections in N pictures.

    t_ns (N,) stamps of the pictures, frame (M,) index of the picture, tag_id (M,), corners (M, 4, 2) px in the order of
    the AprilTag library, family (M,).
    """

    TYPE: ClassVar[str] = messages.TAG_DETECTIONS

    frame: NDArray[np.int64]
    tag_id: NDArray[np.int64]
    corners: Array
    family: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """Intrinsics: size in px, distortion model and coefficients d, matrices k (3, 3), r (3, 3), p (3, 4)."""

    TYPE: ClassVar[str] = messages.CAMERA_INFO

    t_ns: int
    width: int
    height: int
    distortion_model: str
    d: Array
    k: Array
    r: Array
    p: Array
    frame_id: str = ""

    @classmethod
    def of(cls, t_ns: int, size: tuple[int, int], model: str, d: Array, K: Array) -> CameraInfo:
        """Calibration of an unrectified camera of `size` (width, height), px."""
        return cls(t_ns, *size, model, d, K, np.eye(3), np.pad(K, ((0, 0), (0, 1))), frame_id="camera")


@dataclass(frozen=True, eq=False)
class ImageSeries(Stamped):
    """Compressed pictures: stamps (N,), the files in the same order (an iterable, taken one by one), their format."""

    TYPE: ClassVar[str] = messages.COMPRESSED_IMAGE

    data: Iterable[bytes]
    format: str = "jpeg"


# Of one camera, as simulators draw them.
Pictures = tuple[CameraInfo, ImageSeries]


Topic = Series | JointSeries | DetectionSeries | CameraInfo | ImageSeries
