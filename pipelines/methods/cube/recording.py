"""Topics, config section and arrays of the cube method, from and to a recording."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Annotated, ClassVar, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from alidade.factors.array import Array
from alidade.pipelines.estimation.noise import Noise
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.noise import stated
from alidade.pipelines.methods.place import field_at, known_field, place_topics, read_place
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.checks import check_overlap, nanoseconds
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Covariances, Fields, Forces, Numbers, Quaternions, Rates
from alidade.pipelines.recording.streams import StreamReader, Temperature, imu_series, white_covariance
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, IMU, MAG, TEMPERATURE, Need, Setting, Topic, wanted
from alidade.pipelines.settings import Board, Config, Date, MethodSection, Quaternion, Section, Sigma
from alidade.pipelines.vision.camera import Camera

REFERENCE_FIX = Topic("reference_fix", "/reference/fix", (messages.NAV_SAT_FIX,))
REFERENCE_IMU = Topic("reference_imu", "/reference/imu", (messages.IMU,))
# Of a covariance in decimal digits, the negative share that is rounding.
_ROUNDING = 1e-5

TAG_DETECTIONS = Topic("tag_detections", "/tag_detections", (messages.TAG_DETECTIONS,))


class RawConversion(Section):
    """Nominal conversion of one sensor's counts: (raw - offset) * scale."""

    scale: Sigma  # SI per count
    offset: float = 0.0  # counts


class Raw(Section):
    """Nominal conversions of the sensors that record counts."""

    accel: RawConversion | None = None
    gyro: RawConversion | None = None
    mag: RawConversion | None = None


class LayoutCovariance(Section):
    """Covariance of the tags' rotations (rad) and positions (m) from cube-layout, six numbers a tag."""

    tags: list[int]  # ids in order
    camera: bool = False  # whether its focal length (a share) and centre (px) follow after the tags
    rows: list[str]  # the lower triangle, each row its numbers with blanks between them

    @model_validator(mode="after")
    def _whole(self) -> Self:
        needed = 6 * len(self.tags) + 3 * self.camera
        if len(self.rows) != needed:
            what = f"{len(self.tags)} tags{' and a camera' if self.camera else ''}"
            raise ValueError(f"{what} need {needed} rows, there are {len(self.rows)}")
        if np.linalg.eigvalsh(self.matrix).min(initial=0.0) < -_ROUNDING * np.diag(self.matrix).max(initial=0.0):
            raise ValueError("rows are no covariance: a combination of the numbers has a negative variance")
        return self

    @property
    def matrix(self) -> Array:
        """Covariance matrix (6 n, 6 n); of a layout with camera (6 n + 3, 6 n + 3)."""
        out = np.zeros((len(self.rows), len(self.rows)))
        for i, row in enumerate(self.rows):
            try:
                numbers = [float(number) for number in row.split()]
            except ValueError as error:
                raise ValueError(f"row {i + 1} holds something that is no number: {row[:40]!r}") from error
            if len(numbers) != i + 1:
                raise ValueError(f"row {i + 1} of a lower triangle has {i + 1} numbers, not {len(numbers)}")
            out[i, : i + 1] = out[: i + 1, i] = numbers
        return out


class RefinedCamera(Section):
    """Camera intrinsics estimated by cube-layout, which replace those of its CameraInfo."""

    focal: Annotated[tuple[Sigma, Sigma], Field(strict=False)]  # px
    centre: Annotated[tuple[float, float], Field(strict=False)]  # px
    distortion: list[float]  # coefficients of CameraInfo's model


class CubeConfig(Board, MethodSection):
    """Section `cube` of a config: tags and their uncertainty, camera on the reference, counts, date."""

    key: ClassVar[str] = "cube"

    camera_rotation: Quaternion | None = None  # BRC, camera on the reference: w, x, y, z
    raw: Raw = Raw()  # of sensors that record counts
    date: Date | None = None  # of the field model, as at the top level
    covariance: LayoutCovariance | None = None  # as cube-layout writes it
    camera: RefinedCamera | None = None  # as cube-layout --refine-camera writes it


def field_date(config: Config) -> datetime.date | None:
    """Date for the field model, at the top or under `cube`."""
    return config.date or config.section(CubeConfig).date


TOPICS = (IMU, MAG, REFERENCE_FIX, REFERENCE_IMU, TAG_DETECTIONS, IMAGE, CAMERA_INFO, TEMPERATURE)
_TAGS = Setting("cube.tags in the config", lambda config: bool(config.section(CubeConfig).tags))
_METHOD = Setting("`method: cube` in the config", lambda config: config.method == "cube")
REQUIREMENTS: tuple[Need, ...] = (
    ((IMU,),),
    # Pictures alone could be of anything. Without camera the turns between poses and gravity serve; the config has to
    # say that this is meant.
    ((TAG_DETECTIONS, CAMERA_INFO), (IMAGE, CAMERA_INFO, REFERENCE_IMU), (IMAGE, CAMERA_INFO, _TAGS), (_METHOD,)),
)


# Of gyro, accelerometer and magnetometer, in this order.
DENSITIES = ("gyro_density", "accel_density", "mag_density")

_Result = TypeVar("_Result")


@dataclass(frozen=True, eq=False)
class Sightings:
    """Tags detected in the camera's pictures.

    Attributes:
        t: (F,) s, stamps of the pictures.
        frame: (M,) index of the picture of each tag seen.
        ids: (M,) tag ids.
        corners: (M, 4, 2) px, in the AprilTag library's order; integer coordinates are pixel centres.
        covariance: (M, 4, 2, 2) px^2, or None when nobody measured it.
    """

    t: Array
    frame: NDArray[np.int64]
    ids: NDArray[np.int64]
    corners: Array
    covariance: Array | None


@dataclass(frozen=True, eq=False)
class CubeData:
    """Measurements of a cube session. Times are s from epoch_ns (Unix ns), strictly increasing.

    imu_t (N,), gyro (N, 3), accel (N, 3): the device's, as recorded, rad/s and m/s^2 or counts. mag_t (L,), mag (L, 3):
    T or counts; None when it has none. reference_t (R,), reference_wxyz (R, 4): attitude nRB of the reference in
    East-North-Up, unit; None without one. reference_cov (R, 3, 3) rad^2, about the axes of n; None if unknown.
    latitude, longitude, rad, height, m above the ellipsoid: of the reference; None if unknown. camera, sightings: None
    without a camera. gyro_density, accel_density, mag_density: from the covariances of the messages, in the unit
    recorded per sqrt(Hz), None if they have none. dropped: reason -> messages. temperature: of gyro and
    accelerometer, None where nobody measures it.
    """

    epoch_ns: int
    imu_t: Numbers
    gyro: Rates
    accel: Forces
    mag_t: Numbers | None = None
    mag: Fields | None = None
    reference_t: Numbers | None = None
    reference_wxyz: Quaternions | None = None
    reference_cov: Covariances | None = None
    latitude: float | None = None
    longitude: float | None = None
    height: float = 0.0
    camera: Camera | None = None
    sightings: Sightings | None = None
    gyro_density: float | None = None
    accel_density: float | None = None
    mag_density: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    temperature: Temperature | None = None

    @cached_property
    def computed(self) -> dict[tuple[str, str], object]:
        """Cache of functions made by `computed_once`: (function, config) -> result."""
        return {}


def computed_once(compute: Callable[[CubeData, Config], _Result]) -> Callable[[CubeData, Config], _Result]:
    """Decorate a function of data and config so that the data cache its result for each config."""

    @wraps(compute)
    def call(data: CubeData, config: Config) -> _Result:
        key = compute.__name__, config.model_dump_json()
        if key not in data.computed:
            data.computed[key] = compute(data, config)
        return cast(_Result, data.computed[key])

    return call


def nominal(values: Array, conversion: RawConversion | None) -> Array:
    """Convert readings to SI by the config's `raw`; readings without a conversion are SI already."""
    return values if conversion is None else (values - conversion.offset) * conversion.scale


def recorded(values: Array, conversion: RawConversion | None) -> Array:
    """Convert nominal units back to readings as recorded, the inverse of `nominal`."""
    return values if conversion is None else values / conversion.scale + conversion.offset


def local_field(data: CubeData, config: Config) -> Array:
    """Magnetic field (3,), T in n, at the reference, by the world magnetic model.

    The date is the config's or that of the stamps, the strength `field.strength` where it is given. Raises InputError
    when the model does not hold there and then. `data` has latitude and longitude.
    """
    assert data.latitude is not None
    assert data.longitude is not None
    model = field_at(data.latitude, data.longitude, data.height, data.epoch_ns, field_date(config))
    return known_field(config, model)[0]


def stated_density(name: str, data: CubeData, config: Config, *families: str) -> Noise:
    """Stated noise density `name` for some families, nominal SI: from config, messages or default."""
    sensor = name.removesuffix("_density")
    density: float | None = getattr(data, name)
    conversion: RawConversion | None = getattr(config.section(CubeConfig).raw, sensor)
    message = density if density is None or conversion is None else density * conversion.scale
    return stated(name, config, message, families)


# rad^2; no reference is as good.
_LEAST_VARIANCE = 1e-11

_NUMBERS = (IMU, MAG, REFERENCE_IMU, REFERENCE_FIX)


def read_cube(recording: Recording, config: Config) -> CubeData:
    """Read and check a cube session; without tag detections, detect tags in pictures of the static poses.

    What the recording holds decides what there is: magnetometer, reference and camera may each be missing.

    Raises InputError when a topic is unusable (alidade.pipelines.recording.checks) or in an implausible unit, when the
    topics have no time in common, and with pictures when there is no static pose or no tag in any.
    """
    from alidade.pipelines.methods.cube.tags import read_camera, read_sightings
    from alidade.pipelines.methods.cube.units import Readings, check_units

    reader = StreamReader(recording, dict.fromkeys(map(config.topic, _NUMBERS), ()))
    name = config.topic(IMU)
    imu = reader.samples(name, recording.imu(name), "gyro", "accel", least=3)
    raw = config.section(CubeConfig).raw
    sensors = [
        Readings(name, imu.t, imu.series.accel, raw.accel),
        Readings(name, imu.t, imu.series.gyro, raw.gyro),
    ]
    gyro_density, accel_density = reader.density(name, "gyro", imu), reader.density(name, "accel", imu)
    spans = {name: imu.t}

    mag = mag_density = None
    name = config.topic(MAG)
    if wanted(recording, config, MAG):
        mag = reader.magnetic_field(name)
        mag_density = reader.density(name, "mag", mag)
        sensors.append(Readings(name, mag.t, mag.series.field, raw.mag))
        spans[name] = mag.t
    check_units(*sensors)

    reference_t = reference_wxyz = reference_cov = None
    if wanted(recording, config, REFERENCE_IMU):
        reference_t, reference_wxyz, reference_cov = _reference(reader, config.topic(REFERENCE_IMU))
        spans[config.topic(REFERENCE_IMU)] = reference_t
    check_overlap(spans)

    latitude, longitude, height = read_place(recording, config, REFERENCE_FIX)
    has_camera = any(wanted(recording, config, topic) for topic in (IMAGE, TAG_DETECTIONS))
    data = CubeData(
        epoch_ns=reader.epoch_ns,
        imu_t=imu.t,
        gyro=imu.series.gyro,
        accel=imu.series.accel,
        mag_t=mag and mag.t,
        mag=mag and mag.series.field,
        reference_t=reference_t,
        reference_wxyz=reference_wxyz,
        reference_cov=reference_cov,
        latitude=latitude,
        longitude=longitude,
        height=height,
        camera=read_camera(recording, config) if has_camera else None,
        gyro_density=gyro_density,
        accel_density=accel_density,
        mag_density=mag_density,
        dropped=reader.dropped,
        temperature=temperature.read(reader, config, (temperature.GYRO_SLOPE, temperature.ACCEL_SLOPE), imu.t),
    )
    if data.camera is None:
        return data
    whole = replace(data, sightings=read_sightings(recording, data, config, reader.dropped))
    whole.computed.update(data.computed)  # the static intervals do not depend on what the camera saw
    return whole


def _reference(reader: StreamReader, topic: str) -> tuple[Array, Array, Array | None]:
    t, wxyz, cov = reader.attitude(topic, _LEAST_VARIANCE, least=1)
    known = (np.linalg.eigvalsh(0.5 * (cov + cov.swapaxes(1, 2)))[:, 0] > 0.0).all()
    return t, wxyz, cov if known else None


def cube_topics(data: CubeData, pictures: Iterable[bytes] | None = None) -> dict[str, series.Topic]:
    """Topics of a recording under their default names.

    Pictures, JPEG files, one for each frame of the sightings in their order, take the place of the detections.
    """
    epoch = data.epoch_ns
    imu = imu_series(epoch, data.imu_t, data.gyro, data.accel, data.gyro_density, data.accel_density)
    topics: dict[str, series.Topic] = {IMU.name: imu}
    if data.mag_t is not None and data.mag is not None:
        t_ns, cov = nanoseconds(data.mag_t, epoch), white_covariance(data.mag_t, data.mag_density)
        topics[MAG.name] = series.MagneticSeries(t_ns, data.mag, field_cov=cov, frame_id="imu")
    if data.reference_t is not None and data.reference_wxyz is not None:
        topics[REFERENCE_IMU.name] = series.ImuSeries(
            nanoseconds(data.reference_t, epoch),
            np.zeros((len(data.reference_t), 3)),
            wxyz=data.reference_wxyz,
            wxyz_cov=np.zeros((3, 3)) if data.reference_cov is None else data.reference_cov,
            frame_id="reference",
        )
    topics |= place_topics(REFERENCE_FIX, epoch, data.latitude, data.longitude, data.height, "reference")
    if data.camera is not None and data.sightings is not None:
        c = data.camera
        topics[CAMERA_INFO.name] = series.CameraInfo.of(
            epoch, (c.width, c.height), c.distortion_model, c.coefficients, c.K
        )
        topics |= _pictures_or_tags(data.sightings, epoch, pictures)
    return topics | temperature.topics(data.temperature, epoch)


def _pictures_or_tags(seen: Sightings, epoch_ns: int, pictures: Iterable[bytes] | None) -> dict[str, series.Topic]:
    t_ns = nanoseconds(seen.t, epoch_ns)
    if pictures is not None:
        return {IMAGE.name: series.ImageSeries(t_ns, pictures, format="jpeg", frame_id="camera")}
    family = np.full(len(seen.ids), "tag36h11")
    found = series.DetectionSeries(t_ns, seen.frame, seen.ids, seen.corners, family, frame_id="camera")
    return {TAG_DETECTIONS.name: found}
