"""The earth as sensors feel it: its rotation, its gravity, its magnetic field.

Frame n is local level, East-North-Up. Latitudes and longitudes are geodetic (WGS 84), rad; heights are above the
ellipsoid, m.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from alidade.factors.array import Array

# Of the earth against inertial space, rad/s.
EARTH_RATE = 7.292115e-5

# WGS 84 ellipsoid and its normal gravity: NIMA TR8350.2, tables 3.1, 3.3 and 3.4.
_SEMI_MAJOR = 6378137.0  # m
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_SQUARED = 6.69437999014e-3
_GRAVITY_EQUATOR = 9.7803253359  # m/s^2
_SOMIGLIANA = 1.93185265241e-3
# Editions of the World Magnetic Model that pygeomag brings, and how long each holds.
_EDITIONS, _EDITION_YEARS = (2010, 2015, 2020, 2025), 5
_CENTRIFUGAL_RATIO = 3.449786506841e-3  # omega^2 a^2 b / GM


def earth_rate(latitude: ArrayLike) -> Array:
    """Angular rate of the earth (..., 3), rad/s, in n, at latitudes (...), rad."""
    latitude = np.asarray(latitude, dtype=float)
    return EARTH_RATE * np.stack([np.zeros_like(latitude), np.cos(latitude), np.sin(latitude)], axis=-1)


def gravity(latitude: ArrayLike, height: ArrayLike = 0.0) -> Array:
    """WGS 84 normal gravity, m/s^2: Somigliana's formula with the height term (TR8350.2, eqs. 4-1 and 4-3)."""
    sine_squared = np.sin(np.asarray(latitude, dtype=float)) ** 2
    h = np.asarray(height, dtype=float) / _SEMI_MAJOR
    surface = (
        _GRAVITY_EQUATOR * (1.0 + _SOMIGLIANA * sine_squared) / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * sine_squared)
    )
    slope = 1.0 + _FLATTENING + _CENTRIFUGAL_RATIO - 2.0 * _FLATTENING * sine_squared
    return np.asarray(surface * (1.0 - 2.0 * slope * h + 3.0 * h**2))


def magnetic_field(latitude: float, longitude: float, height: float, year: float) -> Array:
    """Magnetic field (3,), T, in n by the World Magnetic Model edition of the year (2010 to 2029).

    Args:
        latitude, longitude: rad.
        height: m.
        year: decimal year.

    Raises:
        ValueError: the model does not hold at that date or height.
    """
    if not _EDITIONS[0] <= year <= _EDITIONS[-1] + _EDITION_YEARS:
        raise ValueError(
            f"the World Magnetic Model holds from {_EDITIONS[0]} to {_EDITIONS[-1] + _EDITION_YEARS}, not in {year:.2f}"
        )
    if not -1e3 <= height <= 850e3:
        raise ValueError(f"the World Magnetic Model holds from -1 to 850 km, not at {height * 1e-3:.1f} km")
    model = _world_magnetic_model(max(edition for edition in _EDITIONS if edition <= year))
    # It counts north, east, down, in nT; degrees and km go in.
    found = model.calculate(np.rad2deg(latitude), np.rad2deg(longitude), height * 1e-3, year)
    return 1e-9 * np.array([found.y, found.x, -found.z])


@lru_cache(maxsize=len(_EDITIONS))
def _world_magnetic_model(edition: int) -> Any:
    from pygeomag import GeoMag

    # The second version of 2015 mends the first, NOAA/NCEI, February 2019.
    return GeoMag(coefficients_file=f"wmm/WMM_{edition}{'v2' if edition == 2015 else ''}.COF")
