"""A recording of the cube method as arrays, and back."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from factors.earth import magnetic_field
from pipelines.errors import InputError
from pipelines.methods.cube.static_intervals import find_rests
from pipelines.methods.cube.topics import (
    MAG,
    REFERENCE_FIX,
    REFERENCE_IMU,
    TAG_DETECTIONS,
    CubeConfig,
    RawConversion,
    field_date,
)
from pipelines.recording import series
from pipelines.recording.checks import (
    check_gyro,
    check_overlap,
    clean,
    count,
    gyro_density,
    nanoseconds,
    unit_quaternions,
)
from pipelines.recording.reading import Recording
from pipelines.recording.topics import CAMERA_INFO, IMAGE, IMU, wanted
from pipelines.recording.writing import attached, write_session
from pipelines.settings import DEFAULT_NOISE, Config, first_given
from pipelines.vision.recorded import camera_of

if TYPE_CHECKING:
    from pipelines.vision.camera import Camera

Array = NDArray[np.float64]

_NUMBERS = (IMU, MAG, REFERENCE_IMU, REFERENCE_FIX)

# Norms at rest that no accelerometer in m/s^2 and no magnetometer in T shows, and what they are likely to be.
_ACCEL_RANGE, _MAG_RANGE = (3.0, 30.0), (1e-6, 1e-3)
_ACCEL_UNITS = {"g": (0.5, 2.0), "mg": (500.0, 2000.0), "raw counts": (2000.0, np.inf)}
_MAG_UNITS = {"gauss": (0.05, 5.0), "uT": (5.0, 1000.0), "mG or raw counts": (1000.0, 2e4), "nT": (2e4, np.inf)}
_FAMILIES = ("", "36h11", "tag36h11")
# More pictures than this share with one id twice are two tags with one id, not a false detection.
_TWICE = 0.1


@dataclass(frozen=True, eq=False)
class Sightings:
    """Tags in the camera's pictures.

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
    """What a cube session measured. Times are s from epoch_ns (Unix ns), strictly increasing.

    imu_t (N,), gyro (N, 3), accel (N, 3): the device's, as recorded, rad/s and m/s^2 or counts. mag_t (L,), mag (L, 3):
    T or counts; None when it has none. reference_t (R,), reference_wxyz (R, 4): attitude nRB of the reference in
    East-North-Up, unit; None without one. reference_cov (R, 3, 3) rad^2, about the axes of n; None if unknown.
    latitude, longitude, rad, height, m above the ellipsoid: of the reference; None if unknown. camera, sightings: None
    without a camera. gyro_density, accel_density, mag_density: from the covariances of the messages, in the unit
    recorded per sqrt(Hz), None if they say nothing. dropped: reason -> messages.
    """

    epoch_ns: int
    imu_t: Array
    gyro: Array
    accel: Array
    mag_t: Array | None = None
    mag: Array | None = None
    reference_t: Array | None = None
    reference_wxyz: Array | None = None
    reference_cov: Array | None = None
    latitude: float | None = None
    longitude: float | None = None
    height: float = 0.0
    camera: Camera | None = None
    sightings: Sightings | None = None
    gyro_density: float | None = None
    accel_density: float | None = None
    mag_density: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)


def nominal(values: Array, conversion: RawConversion | None) -> Array:
    """Counts converted as the config's `raw` says, in SI; what is recorded in SI as it is."""
    return values if conversion is None else (values - conversion.offset) * conversion.scale


def recorded(values: Array, conversion: RawConversion | None) -> Array:
    """The inverse of `nominal`."""
    return values if conversion is None else values / conversion.scale + conversion.offset


def rests(data: CubeData, config: Config) -> Array:
    """Beginnings and ends, (P, 2) s, of the device's static poses. Raises InputError when there is none."""
    return _rests(data.imu_t, data.gyro, data.accel, data.gyro_density, data.accel_density, config)


def local_field(data: CubeData, config: Config) -> Array:
    """The World Magnetic Model where the reference is, (3,) T in n, on the config's date or that of the stamps.

    Raises InputError when the model does not hold there and then. `data` has latitude and longitude.
    """
    assert data.latitude is not None
    assert data.longitude is not None
    date = field_date(config) or datetime.datetime.fromtimestamp(data.epoch_ns * 1e-9, datetime.UTC).date()
    first, last = datetime.date(date.year, 1, 1), datetime.date(date.year + 1, 1, 1)
    year = date.year + (date - first) / (last - first)
    try:
        return magnetic_field(data.latitude, data.longitude, data.height, year)
    except ValueError as error:
        raise InputError(f"{error}; give the date of the recording in the config as `date`") from error


def noise_densities(data: CubeData, config: Config) -> tuple[float, float, float]:
    """Of gyro, accelerometer and magnetometer, nominal SI per sqrt(Hz): config, else messages, else default."""
    return _densities(data.gyro_density, data.accel_density, data.mag_density, config)


def _densities(
    gyro: float | None, accel: float | None, mag: float | None, config: Config
) -> tuple[float, float, float]:
    raw, noise, default = config.section(CubeConfig).raw, config.noise, DEFAULT_NOISE

    def message(density: float | None, conversion: RawConversion | None) -> float | None:
        return density if density is None or conversion is None else density * conversion.scale

    return (
        first_given(noise.gyro_density, message(gyro, raw.gyro), default.gyro_density),
        first_given(noise.accel_density, message(accel, raw.accel), default.accel_density),
        first_given(noise.mag_density, message(mag, raw.mag), default.mag_density),
    )


def _rests(
    t: Array, gyro: Array, accel: Array, gyro_density: float | None, accel_density: float | None, config: Config
) -> Array:
    densities = _densities(gyro_density, accel_density, None, config)
    root_rate = float(np.median(np.diff(t))) ** -0.5
    raw = config.section(CubeConfig).raw
    return find_rests(
        t, nominal(gyro, raw.gyro), nominal(accel, raw.accel), densities[0] * root_rate, densities[1] * root_rate
    )


def read_cube(recording: Recording, config: Config) -> CubeData:
    """Read and check a cube session; without tag detections they are taken from the pictures of the static poses.

    What the recording holds decides what there is: magnetometer, reference and camera may each be missing.

    Raises InputError when a topic is unusable (pipelines.recording.checks) or in an implausible unit, when the topics
    have no time in common, and with pictures when there is no static pose or no tag in any.
    """
    dropped: dict[str, int] = {}
    epoch = recording.epoch_ns
    recording.read_together(dict.fromkeys(map(config.topic, _NUMBERS), ()))
    name = config.topic(IMU)
    imu = recording.imu(name)
    count(dropped, f"{name}: stamped by log time (kept)", imu.stamped_by_log)
    imu_t, keep = clean(name, imu.t_ns, epoch, np.hstack([imu.gyro, imu.accel]), dropped, least=3)
    gyro, accel = imu.gyro[keep], imu.accel[keep]
    check_gyro(name, imu_t, nominal(gyro, config.section(CubeConfig).raw.gyro))
    _check_norm(
        f"{name}: acceleration",
        nominal(accel, config.section(CubeConfig).raw.accel),
        _ACCEL_RANGE,
        "m/s^2",
        _ACCEL_UNITS,
    )
    densities = gyro_density(imu_t, imu.gyro_cov), gyro_density(imu_t, imu.accel_cov)
    spans = {name: imu_t}

    mag_t = mag = mag_density = None
    name = config.topic(MAG)
    if wanted(recording, config, MAG):
        field_ = recording.magnetic(name)
        mag_t, keep = clean(name, field_.t_ns, epoch, field_.field, dropped)
        mag, mag_density = field_.field[keep], gyro_density(mag_t, field_.field_cov)
        _check_norm(f"{name}: field", nominal(mag, config.section(CubeConfig).raw.mag), _MAG_RANGE, "T", _MAG_UNITS)
        spans[name] = mag_t

    reference_t = reference_wxyz = reference_cov = None
    if wanted(recording, config, REFERENCE_IMU):
        reference_t, reference_wxyz, reference_cov = _reference(recording, config, epoch, dropped)
        spans[config.topic(REFERENCE_IMU)] = reference_t
    check_overlap(spans)

    camera = sightings = None
    if _has_camera(recording, config):
        camera = read_camera(recording, config)
        if IMAGE.key not in config.topics and wanted(recording, config, TAG_DETECTIONS):
            sightings = _detections(recording, config, epoch, dropped)
        else:
            found = _rests(imu_t, gyro, accel, *densities, config)
            sightings = _pictures(recording, config, epoch, camera, found, dropped)
    latitude, longitude, height = _position(recording, config)
    return CubeData(
        epoch,
        imu_t,
        gyro,
        accel,
        mag_t,
        mag,
        reference_t,
        reference_wxyz,
        reference_cov,
        latitude,
        longitude,
        height,
        camera,
        sightings,
        *densities,
        mag_density,
        dropped,
    )


def write_cube(
    path: Path | str,
    data: CubeData,
    truth: Mapping[str, float] | None = None,
    config_yaml: str | None = None,
    pictures: Iterable[bytes] | None = None,
) -> None:
    """Write a cube session under the default topic names, with its truth and config as attachments.

    Stamps are rounded to ns. With pictures (JPEG files, one for each frame of the sightings, in their order) these are
    written instead of the detections. read_cube gives the same data back if the first sample is the one at t = 0.
    """
    epoch = data.epoch_ns

    def covariance(t: Array, density: float | None) -> Array:
        return (0.0 if density is None else density**2 / float(np.median(np.diff(t)))) * np.eye(3)

    topics: dict[str, series.Topic] = {
        IMU.name: series.ImuSeries(
            nanoseconds(data.imu_t, epoch),
            data.gyro,
            data.accel,
            gyro_cov=covariance(data.imu_t, data.gyro_density),
            accel_cov=covariance(data.imu_t, data.accel_density),
            frame_id="imu",
        )
    }
    if data.mag_t is not None and data.mag is not None:
        cov = covariance(data.mag_t, data.mag_density)
        topics[MAG.name] = series.MagneticSeries(
            nanoseconds(data.mag_t, epoch), data.mag, field_cov=cov, frame_id="imu"
        )
    if data.reference_t is not None and data.reference_wxyz is not None:
        n = len(data.reference_t)
        topics[REFERENCE_IMU.name] = series.ImuSeries(
            nanoseconds(data.reference_t, epoch),
            np.zeros((n, 3)),
            wxyz=data.reference_wxyz,
            wxyz_cov=np.zeros((3, 3)) if data.reference_cov is None else data.reference_cov,
            frame_id="reference",
        )
    start = np.array([epoch])
    if data.latitude is not None and data.longitude is not None:
        latitude, longitude = np.rad2deg([data.latitude, data.longitude])
        topics[REFERENCE_FIX.name] = series.FixSeries(
            start, np.array([latitude]), np.array([longitude]), np.array([data.height]), frame_id="reference"
        )
    if data.camera is not None and data.sightings is not None:
        topics[CAMERA_INFO.name] = _info_message(data.camera, epoch)
        topics |= _pictures_or_tags(data.sightings, epoch, pictures)
    write_session(path, topics, attached(truth, config_yaml))


def _info_message(camera: Camera, epoch_ns: int) -> series.CameraInfo:
    return series.CameraInfo(
        epoch_ns,
        camera.width,
        camera.height,
        camera.distortion_model,
        camera.coefficients,
        camera.K,
        np.eye(3),
        np.hstack([camera.K, np.zeros((3, 1))]),
        frame_id="camera",
    )


def _pictures_or_tags(seen: Sightings, epoch_ns: int, pictures: Iterable[bytes] | None) -> dict[str, series.Topic]:
    t_ns = nanoseconds(seen.t, epoch_ns)
    if pictures is not None:
        return {IMAGE.name: series.ImageSeries(t_ns, pictures, format="jpeg", frame_id="camera")}
    m = len(seen.ids)
    zero = np.zeros(m, dtype=np.int64)
    found = series.DetectionSeries(
        t_ns, seen.frame, seen.ids, seen.corners, zero, np.zeros(m), np.full(m, "tag36h11"), frame_id="camera"
    )
    return {TAG_DETECTIONS.name: found}


def _has_camera(recording: Recording, config: Config) -> bool:
    return any(wanted(recording, config, topic) for topic in (IMAGE, TAG_DETECTIONS))


def _check_norm(
    what: str, values: Array, plausible: tuple[float, float], unit: str, units: Mapping[str, tuple[float, float]]
) -> None:
    """Raise InputError if the median norm is no such quantity in that unit; says in which unit it would be one."""
    norm = float(np.median(np.linalg.norm(values, axis=1)))
    if plausible[0] <= norm <= plausible[1]:
        return
    likely = next((name for name, (low, high) in units.items() if low <= norm < high), None)
    hint = f"; is it in {likely}?" if likely else ";"
    raise InputError(
        f"topic {what} has a norm of {norm:.4g} (median), implausible in {unit}{hint} It has to be in {unit}, or "
        "its conversion in the config under cube.raw"
    )


def _reference(
    recording: Recording, config: Config, epoch_ns: int, dropped: dict[str, int]
) -> tuple[Array, Array, Array | None]:
    topic = config.topic(REFERENCE_IMU)
    imu = recording.imu(topic)
    count(dropped, f"{topic}: stamped by log time (kept)", imu.stamped_by_log)
    if (imu.wxyz_cov[:, 0, 0] < 0.0).all():
        raise InputError(
            f"topic {topic}: orientation_covariance starts with -1, so there is no attitude in it; the "
            "reference has to put out its attitude in East-North-Up"
        )
    t, keep = clean(topic, imu.t_ns, epoch_ns, imu.wxyz, dropped, least=1)
    wxyz, cov = unit_quaternions(topic, t, imu.wxyz[keep]), imu.wxyz_cov[keep]
    known = (np.linalg.eigvalsh(0.5 * (cov + cov.swapaxes(1, 2)))[:, 0] > 0.0).all()
    return t, wxyz, cov if known else None


def _position(recording: Recording, config: Config) -> tuple[float | None, float | None, float]:
    """Latitude and longitude, rad, height, m: the median of the fixes; the config's latitude wins."""
    given = None if config.latitude_deg is None else float(np.deg2rad(config.latitude_deg))
    topic = config.topic(REFERENCE_FIX)
    if not wanted(recording, config, REFERENCE_FIX):
        return given, None, 0.0
    fixes = recording.fixes(topic)
    good = (fixes.status >= 0) & np.isfinite(fixes.latitude_deg + fixes.longitude_deg + fixes.height)
    if not good.any():
        raise InputError(f"topic {topic}: none of {len(fixes)} messages has a position fix")
    latitude, longitude, height = (
        float(np.median(values[good])) for values in (fixes.latitude_deg, fixes.longitude_deg, fixes.height)
    )
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise InputError(f"topic {topic}: latitude {latitude:g}, longitude {longitude:g}; NavSatFix is in degrees")
    return first_given(given, float(np.deg2rad(latitude))), float(np.deg2rad(longitude)), height


def read_camera(recording: Recording, config: Config) -> Camera:
    """The camera that looks at the cube. Raises InputError when it, or the cube's tags, are not described."""
    if not config.section(CubeConfig).tags:
        raise InputError(
            "the tags on the cube are not given: name them in the config as cube.tags {id: {size, rotation, position}}"
        )
    return camera_of(recording, config)


def _detections(recording: Recording, config: Config, epoch_ns: int, dropped: dict[str, int]) -> Sightings:
    topic = config.topic(TAG_DETECTIONS)
    found = recording.detections(topic)
    count(dropped, f"{topic}: stamped by log time (kept)", found.stamped_by_log)
    t, keep = clean(topic, found.t_ns, epoch_ns, np.zeros((len(found), 1)), dropped, least=1)
    place = np.full(len(found), -1)
    place[keep] = np.arange(len(keep))
    good = (place[found.frame] >= 0) & np.isfinite(found.corners).all(axis=(1, 2))
    good &= np.isin(found.family, _FAMILIES)
    return _sightings(
        topic, config, t, place[found.frame[good]], found.tag_id[good], found.corners[good], None, dropped
    )


def _pictures(
    recording: Recording, config: Config, epoch_ns: int, camera: Camera, rests: Array, dropped: dict[str, int]
) -> Sightings:
    """Tags found in the pictures taken at rest; the others are not looked at."""
    from pipelines.vision.parallel import UNREADABLE, detections

    topic = config.topic(IMAGE)
    stamps: list[int] = []
    frame: list[int] = []
    parts = []
    at_rest = (
        (t_ns, encoded)
        for t_ns, encoded in recording.images(topic)
        if ((rests[:, 0] <= (t_ns - epoch_ns) / 1e9) & ((t_ns - epoch_ns) / 1e9 <= rests[:, 1])).any()
    )
    for t_ns, seen in detections(at_rest, config.section(CubeConfig).tag_family, camera):
        if seen is None:
            count(dropped, f"{topic}: {UNREADABLE}", 1)
            continue
        sharp = np.isfinite(seen.covariance).all(axis=(1, 2, 3))
        count(dropped, f"{topic}: tag with an edge that cannot be measured", int((~sharp).sum()))
        frame += [len(stamps)] * int(sharp.sum())
        stamps.append(t_ns)
        parts.append((seen.ids[sharp], seen.corners[sharp], seen.covariance[sharp]))
    if not frame:
        raise InputError(
            f"topic {topic}: no tag is seen sharply in any of the {len(stamps)} pictures of the static poses; are they "
            "blurred, or the tags of another family?"
        )
    t, keep = clean(topic, np.array(stamps, dtype=np.int64), epoch_ns, np.zeros((len(stamps), 1)), dropped, least=1)
    place = np.full(len(stamps), -1)
    place[keep] = np.arange(len(keep))
    frames = place[np.array(frame, dtype=np.int64)]
    ids, corners, covariance = (np.concatenate(column) for column in zip(*parts, strict=True))
    good = frames >= 0
    return _sightings(topic, config, t, frames[good], ids[good], corners[good], covariance[good], dropped)


def _sightings(
    topic: str,
    config: Config,
    t: Array,
    frame: NDArray[np.int64],
    ids: NDArray[np.int64],
    corners: Array,
    covariance: Array | None,
    dropped: dict[str, int],
) -> Sightings:
    """The cube's tags among those seen, each at most once in a picture."""
    known = np.isin(ids, list(config.section(CubeConfig).tags))
    if not known.any():
        raise InputError(
            f"topic {topic}: no tag of the cube in any of {len(t)} pictures: seen {np.unique(ids).tolist() or 'none'}, "
            f"the config names {sorted(config.section(CubeConfig).tags)}"
        )
    count(dropped, f"{topic}: tag that is not on the cube", int((~known).sum()))
    _, inverse, counts = np.unique(np.stack([frame, ids]), axis=1, return_inverse=True, return_counts=True)
    once = counts[inverse.ravel()] == 1
    for tag in np.unique(ids[known & ~once]):
        pictures = len(np.unique(frame[(ids == tag) & ~once]))
        if pictures > _TWICE * len(np.unique(frame[ids == tag])):
            raise InputError(
                f"topic {topic}: tag {tag} is seen twice in {pictures} pictures; every tag in sight needs its own id"
            )
    count(dropped, f"{topic}: tag seen twice in a picture", int((known & ~once).sum()))
    good = known & once
    return Sightings(t, frame[good], ids[good], corners[good], None if covariance is None else covariance[good])
