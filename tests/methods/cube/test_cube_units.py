"""Sensors of a cube in counts: which, and conversions that can be pasted into the config."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.cube.recording import CubeData, RawConversion
from alidade.pipelines.methods.cube.simulation import CubeScenario, simulate_cube
from alidade.pipelines.methods.cube.units import Readings, check_units
from datasets import imu_tk_xsens


@pytest.fixture(scope="module")
def data() -> CubeData:
    return simulate_cube(CubeScenario(poses=10, static_s=1.0), 3).data


def _check(
    data: CubeData, accel: float, gyro: float, mag: float, conversions: Mapping[str, RawConversion] | None = None
) -> None:
    raw = conversions or {}
    assert data.mag is not None
    assert data.mag_t is not None
    check_units(
        Readings("/imu", data.imu_t, accel * data.accel, raw.get("accel")),
        Readings("/imu", data.imu_t, gyro * data.gyro, raw.get("gyro")),
        Readings("/mag", data.mag_t, mag * data.mag, raw.get("mag")),
    )


def _refused(data: CubeData, accel: float, gyro: float, mag: float) -> tuple[str, dict[str, Any]]:
    """What is said, and the section in it."""
    with pytest.raises(InputError) as caught:
        _check(data, accel, gyro, mag)
    found = re.search(r"(cube: \{raw: .*\}\}\})", str(caught.value))
    assert found
    return str(caught.value), YAML(typ="safe", pure=True).load(found.group(1))["cube"]["raw"]


@pytest.mark.parametrize("counts_a_g", [16384.0, 2048.0, 256.0])
@pytest.mark.parametrize("counts_a_deg", [131.0, 32.8, 16.4])
def test_all_in_counts_are_named_at_once_with_the_full_scales(
    data: CubeData, counts_a_g: float, counts_a_deg: float
) -> None:
    said, raw = _refused(data, counts_a_g / 9.80665, np.rad2deg(counts_a_deg), 1.0 / 1.5e-7)
    assert all(words in said for words in ("/imu: acceleration", "/imu: rate", "/mag: field"))
    assert raw["accel"] == {"scale": pytest.approx(9.80665 / counts_a_g, rel=1e-5)}
    assert raw["gyro"] == {"scale": pytest.approx(np.deg2rad(1.0 / counts_a_deg), rel=1e-5)}
    assert raw["mag"] == {"scale": pytest.approx(1.5e-7, rel=1e-5)}


def test_what_is_pasted_is_taken(data: CubeData) -> None:
    factors = (2048.0 / 9.80665, np.rad2deg(16.4), 1e6)
    _, raw = _refused(data, *factors)
    _check(data, *factors, {name: RawConversion(**one) for name, one in raw.items()})


def test_only_the_one_that_is_wrong(data: CubeData) -> None:
    said, raw = _refused(data, 1.0, float(np.rad2deg(1.0)), 1.0)
    assert list(raw) == ["gyro"]
    assert raw["gyro"]["scale"] == pytest.approx(np.deg2rad(1.0), rel=1e-5)
    assert "acceleration" not in said


def test_real_counts_with_an_offset(shared_data: Path) -> None:
    """An Xsens MTi against its factory sheet: 414 counts a m/s^2 about 32920, 4767 counts a rad/s."""
    session = imu_tk_xsens.to_session(shared_data / "imu_tk_xsens")
    with pytest.raises(InputError) as caught:
        check_units(
            Readings("/imu", session.imu_t, session.accel, None), Readings("/imu", session.imu_t, session.gyro, None)
        )
    (section,) = re.findall(r"(cube: \{raw: .*\}\}\})", str(caught.value))
    raw = YAML(typ="safe", pure=True).load(section)["cube"]["raw"]
    assert raw["accel"]["scale"] == pytest.approx(1.0 / 414.3, rel=0.02)
    assert raw["accel"]["offset"] == pytest.approx(32920.0, abs=600.0)
    assert raw["gyro"]["scale"] == pytest.approx(1.0 / 4767.0, rel=0.02)
    assert raw["gyro"]["offset"] == pytest.approx(32600.0, abs=300.0)
