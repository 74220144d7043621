"""The earth's rate, gravity and field against published values."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from alidade.factors.earth import EARTH_RATE, earth_rate, gravity, magnetic_field


def test_earth_rate_points_north_at_the_equator_and_up_at_the_pole() -> None:
    np.testing.assert_allclose(earth_rate(0.0), [0.0, EARTH_RATE, 0.0])
    np.testing.assert_allclose(earth_rate(np.pi / 2), [0.0, 0.0, EARTH_RATE], atol=1e-20)
    np.testing.assert_allclose(np.linalg.norm(earth_rate(np.linspace(-1.5, 1.5, 7)), axis=-1), EARTH_RATE)


def test_gravity_at_equator_and_pole() -> None:
    assert gravity(0.0) == pytest.approx(9.7803253359, abs=1e-10)
    # TR8350.2, table 3.4.
    assert gravity(np.pi / 2) == pytest.approx(9.8321849378, abs=1e-9)


def test_gravity_falls_with_height_as_the_field_of_the_ellipsoid() -> None:
    """Against the closed form at the equator: GM/r^2 with the J2 and J4 terms, less the centrifugal acceleration."""
    gm, a, j2, j4 = 3.986004418e14, 6378137.0, 1.082629821e-3, -2.37091e-6
    for height in (0.0, 1000.0, 10000.0):
        r = a + height
        attraction = gm / r**2 * (1 + 1.5 * j2 * (a / r) ** 2 - 1.875 * j4 * (a / r) ** 4)
        assert gravity(0.0, height) == pytest.approx(attraction - EARTH_RATE**2 * r, abs=3e-6)


def test_magnetic_field_gives_all_official_values(shared_data: Path) -> None:
    with (shared_data / "wmm" / "wmm2025_test_values.csv").open() as table:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(table)]
    assert len(rows) == 100
    for row in rows:
        field = magnetic_field(
            np.deg2rad(row["lat_deg"]), np.deg2rad(row["lon_deg"]), row["altitude_km"] * 1e3, row["decimal_year"]
        )
        expected = np.array([row["Y_nT"], row["X_nT"], -row["Z_nT"]]) * 1e-9
        np.testing.assert_allclose(field, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("year", "north", "east", "down"),
    [(2015.0, 6636.6, -451.9, 54408.9), (2020.0, 6570.4, -146.3, 54606.0)],
    ids=["2015 version 2", "2020"],
)
def test_magnetic_field_of_earlier_years_is_that_of_their_edition(
    year: float, north: float, east: float, down: float
) -> None:
    """Test values of the technical reports of WMM 2015 version 2 and WMM 2020, at 80 deg north on the meridian, nT."""
    found = 1e9 * magnetic_field(np.deg2rad(80.0), 0.0, 0.0, year)
    np.testing.assert_allclose(found, [east, north, -down], atol=0.06)


@pytest.mark.parametrize(("year", "height"), [(2009.99, 0.0), (2030.01, 0.0), (2026.0, 9e5), (2026.0, -2e3)])
def test_magnetic_field_refuses_dates_and_heights_outside_the_model(year: float, height: float) -> None:
    with pytest.raises(ValueError, match="World Magnetic Model holds"):
        magnetic_field(0.7, 0.1, height, year)


@pytest.mark.parametrize(("latitude", "longitude"), [(0.0, 0.5), (0.7, 0.0), (0.0, 0.0)])
def test_magnetic_field_at_zero_degrees_is_continuous(latitude: float, longitude: float) -> None:
    at = magnetic_field(latitude, longitude, 0.0, 2026.0)
    near = magnetic_field(latitude + 1e-6, longitude + 1e-6, 0.0, 2026.0)
    np.testing.assert_allclose(at, near, atol=1e-9)
