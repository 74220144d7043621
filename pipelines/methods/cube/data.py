"""What a cube session measured, as arrays, and what follows from them and the config alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, wraps
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.noise import Noise
from alidade.pipelines.methods.cube.topics import CubeConfig, RawConversion, field_date
from alidade.pipelines.methods.noise import stated
from alidade.pipelines.methods.place import field_at
from alidade.pipelines.recording.shapes import Covariances, Numbers, Quaternions, Vectors
from alidade.pipelines.recording.streams import Temperature
from alidade.pipelines.settings import Config
from alidade.pipelines.vision.camera import Camera

Array = NDArray[np.float64]

# Of gyro, accelerometer and magnetometer, in this order.
DENSITIES = ("gyro_density", "accel_density", "mag_density")

_Result = TypeVar("_Result")


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
    recorded per sqrt(Hz), None if they have none. dropped: reason -> messages. temperature: of gyro and
    accelerometer, None where nobody measures it.
    """

    epoch_ns: int
    imu_t: Numbers
    gyro: Vectors
    accel: Vectors
    mag_t: Numbers | None = None
    mag: Vectors | None = None
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
        """What functions made by `computed_once` have found in these data: (function, config) -> result."""
        return {}


def computed_once(compute: Callable[[CubeData, Config], _Result]) -> Callable[[CubeData, Config], _Result]:
    """A function of data and config that finds its result once for each config; the data keep it."""

    @wraps(compute)
    def call(data: CubeData, config: Config) -> _Result:
        key = compute.__name__, config.model_dump_json()
        if key not in data.computed:
            data.computed[key] = compute(data, config)
        return cast(_Result, data.computed[key])

    return call


def nominal(values: Array, conversion: RawConversion | None) -> Array:
    """Counts converted as the config's `raw` says, in SI; what is recorded in SI as it is."""
    return values if conversion is None else (values - conversion.offset) * conversion.scale


def recorded(values: Array, conversion: RawConversion | None) -> Array:
    """The inverse of `nominal`."""
    return values if conversion is None else values / conversion.scale + conversion.offset


def local_field(data: CubeData, config: Config) -> Array:
    """The World Magnetic Model where the reference is, (3,) T in n, on the config's date or that of the stamps.

    Raises InputError when the model does not hold there and then. `data` has latitude and longitude.
    """
    assert data.latitude is not None
    assert data.longitude is not None
    return field_at(data.latitude, data.longitude, data.height, data.epoch_ns, field_date(config))


def stated_density(name: str, data: CubeData, config: Config, *families: str) -> Noise:
    """One of DENSITIES as the config, the messages or nobody states it, in nominal SI, of some families."""
    sensor = name.removesuffix("_density")
    density: float | None = getattr(data, name)
    conversion: RawConversion | None = getattr(config.section(CubeConfig).raw, sensor)
    message = density if density is None or conversion is None else density * conversion.scale
    return stated(name, config, message, families)


def noise_densities(data: CubeData, config: Config) -> tuple[float, ...]:
    """Of gyro, accelerometer and magnetometer as stated, nominal SI per sqrt(Hz)."""
    return tuple(stated_density(name, data, config).stated for name in DENSITIES)
