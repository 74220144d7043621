"""Place of a recording on the earth, and the magnetic field there."""

from __future__ import annotations

import datetime

import numpy as np

from alidade.factors.array import Array
from alidade.factors.earth import magnetic_field
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.parameters import ParameterSpec, stated
from alidade.pipelines.recording import series
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.topics import Topic, wanted
from alidade.pipelines.settings import Config, first_given

# The earth's field, each component about its model: outdoors. A parked car adds 1e-6 to 5e-6, a building 5e-6.
FIELD = ParameterSpec(
    "field",
    "T",
    5e-7,
    "Local magnetic field, {axis} component.",
    "field.model_error",
    axes="enu",
    require=1e-6,
    per_recording=True,
)
STRENGTH_ADVICE = Motion(
    "measure that strength with a proton or calibrated magnetometer and state it, in T, as "
    "field: {strength: {value: 4.9e-5, sigma: 1.0e-7}}; where headings are all that is wanted, require the shape "
    "alone: require: {mag_shape: 5.0e-3}",
    why="no motion separates the magnetometer's scale from the strength of the field",
)


def known_strength(config: Config, model: Array | None) -> tuple[float, float] | None:
    """Field strength and its sigma, T: measured, else that of the field model (3,); None without both."""
    measured = config.field.strength
    if measured is not None:
        return measured.value, measured.sigma
    return None if model is None else (float(np.linalg.norm(model)), stated(config, FIELD))


def known_field(config: Config, model: Array) -> tuple[Array, float, float]:
    """Prior mean (3,) of the field, sigma of its strength and sigma of each transverse component, T.

    Its direction is the model's; a strength that was measured replaces the model's.
    """
    strength = known_strength(config, model)
    assert strength is not None
    return strength[0] * model / np.linalg.norm(model), strength[1], stated(config, FIELD)


def read_place(recording: Recording, config: Config, fix: Topic) -> tuple[float | None, float | None, float]:
    """Latitude and longitude, rad (None if unknown), and height, m, from the config, else the median fix.

    Raises InputError when there are fixes and none of them can be used.
    """
    given = [config.latitude_deg, config.longitude_deg, config.altitude_m]
    if wanted(recording, config, fix) and None in given:
        found: list[float | None] = [*median_fix(recording, config.topic(fix))]
    else:
        found = [None, None, 0.0]
    latitude, longitude, height = (b if a is None else a for a, b in zip(given, found, strict=True))
    angles = [None if angle is None else float(np.deg2rad(angle)) for angle in (latitude, longitude)]
    return angles[0], angles[1], first_given(height, 0.0)


def place_topics(
    fix: Topic, epoch_ns: int, latitude: float | None, longitude: float | None, height: float, frame_id: str = "gnss"
) -> dict[str, series.Topic]:
    """Topic with one fix to write, for a place in rad and m; empty if the place is unknown."""
    if latitude is None or longitude is None:
        return {}
    at = [np.array([each]) for each in (np.rad2deg(latitude), np.rad2deg(longitude), height)]
    return {fix.name: series.FixSeries(np.array([epoch_ns]), *at, frame_id=frame_id)}


def median_fix(recording: Recording, topic: str) -> tuple[float, float, float]:
    """Median latitude and longitude, deg, and height, m, of a topic's fixes. Raises InputError where none is usable."""
    fixes = recording.fixes(topic)
    good = (fixes.status >= 0) & np.isfinite(fixes.latitude_deg + fixes.longitude_deg + fixes.height)
    if not good.any():
        raise InputError(f"topic {topic}: none of {len(fixes)} messages has a position fix")
    latitude, longitude, height = (
        float(np.median(values[good])) for values in (fixes.latitude_deg, fixes.longitude_deg, fixes.height)
    )
    if abs(latitude) > 90.0 or abs(longitude) > 360.0:
        raise InputError(f"topic {topic}: latitude {latitude:g}, longitude {longitude:g}; NavSatFix is in degrees")
    return latitude, longitude, height


def field_at(
    latitude: float, longitude: float, height: float, epoch_ns: int, date: datetime.date | None = None
) -> Array:
    """Field (3,) of the World Magnetic Model, T in East-North-Up, on a date, else on the date of a stamp.

    Args:
        latitude, longitude: rad.
        height: m.
        epoch_ns: Unix ns.
        date: as the config gives it.

    Raises:
        InputError: the model does not hold then.
    """
    day = date or datetime.datetime.fromtimestamp(epoch_ns * 1e-9, datetime.UTC).date()
    first, last = datetime.date(day.year, 1, 1), datetime.date(day.year + 1, 1, 1)
    year = day.year + (day - first) / (last - first)
    try:
        return magnetic_field(latitude, longitude, height, year)
    except ValueError as error:
        raise InputError(f"{error}; the config has `date` and `altitude_m` for it") from error
