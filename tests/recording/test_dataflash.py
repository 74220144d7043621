"""ArduPilot logs: the arrays that they carry, and a calibration from one."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.tumble.recording import tumble_topics
from alidade.pipelines.methods.tumble.simulation import (
    TumbledAccelerometer,
    TumbledGyro,
    TumbledMagnetometer,
    TumbleScenario,
)
from alidade.pipelines.recording import series
from alidade.pipelines.recording.recording import open_recording
from tests.support import forms
from tests.support.command import Command
from tests.support.recorded import T0

TURNING = TumbleScenario(attitudes=25, accelerometer=TumbledAccelerometer(rate_hz=50.0), gyro=TumbledGyro(rate_hz=50.0))


# Kinds of messages as ArduPilot writes them: letters of the format, columns.
IMU = "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
MAG = "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"
GPS = "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"
ATT = "Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"


def of_kind(kind: tuple[str, str], n: int, **columns: Any) -> tuple[str, dict[str, Any]]:
    """Messages with these columns, the others 0."""
    zeros = np.zeros(n, int)
    return kind[0], {
        name: columns.get(name, zeros.astype(float) if code in "fd" else zeros)
        for code, name in zip(kind[0], kind[1].split(","), strict=True)
    }


def xyz(name: str, values: Any) -> dict[str, Any]:
    return {name + axis: values[:, i] for i, axis in enumerate("XYZ")}


def test_ardupilot_logs(tmp_path: Path) -> None:
    n, rng = 100, np.random.default_rng(1)
    us = 5_000_000_000 + 4000 * np.arange(n)  # the compass's clock of 32 bits has gone round
    gyro, accel = rng.normal(size=(2, 2 * n, 3)).astype(np.float32)
    field = rng.integers(-600, 600, (n, 3))
    which, twice = np.arange(2 * n) % 2, np.repeat(us, 2)
    measured = us - 700 - 4000 * (np.arange(n) % 2)  # each reading is logged twice
    week, ms = divmod((T0 // 1000 - 315_964_800_000_000 + 18_000_000) // 1000 + 5_000_000, 604_800_000)
    start = np.zeros(1, int)
    kinds = {
        "UNIT": ("QbZ", {"TimeUS": start, "Id": start + ord("E"), "Label": np.array([b"rad/s"])}),
        "MULT": ("Qbd", {"TimeUS": start, "Id": start + ord("0"), "Mult": start + 1.0}),
        "FMTU": (
            "QBNN",
            {
                "TimeUS": start,
                "FmtType": start + 4,
                "UnitIds": np.array([b"s#EEEooo--O--zz"]),
                "MultIds": np.array([b"F-000000-----00"]),
            },
        ),
        "IMU": of_kind(IMU, 2 * n, TimeUS=twice, I=which, T=30.5 + which, **xyz("Gyr", gyro), **xyz("Acc", accel)),
        "MAG": of_kind(MAG, n, TimeUS=us, S=measured % 2**32, **xyz("Mag", field)),
        "GYR": ("QBQfff", {"TimeUS": us, "I": 0 * us, "SampleUS": us - 500, **xyz("Gyr", gyro[:n])}),
        "ACC2": ("QQfff", {"TimeUS": us, "SampleUS": us - 500, **xyz("Acc", accel[:n])}),
        "ATT": of_kind(ATT, 3, TimeUS=us[:3], Roll=np.array([0, 0, 90.0]), Yaw=np.array([0, 90.0, 0])),
        "GPS": of_kind(
            GPS,
            3,
            TimeUS=us[:3],
            Status=np.array([1, 3, 3]),
            GWk=np.array([0, week, week]),
            GMS=ms + np.array([0, 4, 8]),
            Lat=np.full(3, 471_234_567),
            Lng=np.full(3, 85_000_000),
            Alt=np.full(3, 40_012),
        ),
    }
    recording = open_recording(forms.dataflash(tmp_path / "00000001.BIN", kinds))
    assert recording.notes == ("readings are as the autopilot corrected them: a calibration comes on top of its own",)
    t_ns = (T0 // 1_000_000 * 1000 + us) * 1000
    for i, name in enumerate(("/IMU", "/IMU/1")):
        imu = recording.imu(name)
        np.testing.assert_array_equal(imu.t_ns, t_ns)
        np.testing.assert_array_equal(imu.gyro, gyro[i::2].astype(float))
        np.testing.assert_array_equal(imu.accel, accel[i::2].astype(float))
        np.testing.assert_array_equal(recording.temperature(f"{name}/temperature").celsius, 30.5 + i)
    magnetic = recording.magnetic("/MAG")
    np.testing.assert_array_equal(magnetic.t_ns, t_ns[::2] - 700_000)
    np.testing.assert_array_equal(magnetic.field, 1e-7 * field[::2])
    np.testing.assert_array_equal(recording.vector("/GYR").t_ns, t_ns - 500_000)
    np.testing.assert_array_equal(recording.vector("/ACC/1").vector, accel[:n].astype(float))
    fixes = recording.fixes("/GPS")
    found = fixes.latitude_deg[0], fixes.longitude_deg[0], fixes.height[0]
    assert found == (47.1234567, 8.5, 400.12)
    np.testing.assert_array_equal(fixes.status, [-1, 0, 0])
    # Level to the north; level to the east; to the north, the right side down. What is forward and what is right:
    wRv = so3.matrix(recording.poses("/ATT").wxyz)
    np.testing.assert_allclose(wRv[:, :, 0], [[0, 1, 0], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(wRv[:, :, 1], [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)


def test_an_ardupilot_log_that_cannot_be_used_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    us = 4000 * np.arange(10)
    kinds = {"IMU": of_kind(IMU, 10, TimeUS=us), "GPS": of_kind(GPS, 0)}
    path = forms.dataflash(tmp_path / "1.bin", kinds)
    assert "no fix says what time it was" in open_recording(path).notes[-1]
    whole = path.read_bytes()
    for data, is_damaged in (
        (whole + bytes(100), False),  # the rest of a page
        (whole + bytes(1000), True),
        (whole[:300] + whole[310:], True),
        (whole[:-10], False),
    ):
        path.write_bytes(data)
        assert ("the log is damaged" in str(open_recording(path).notes)) is is_damaged
    forms.dataflash(path, {"IMU": ("Qf", {"TimeUS": us, "GyrX": us / 1.0})})
    with pytest.raises(InputError, match=r"1.bin: an ArduPilot log without the columns of its messages .'GyrY'.$"):
        open_recording(path)
    path.write_bytes(path.read_bytes().replace(b"Qf\0", b"Qd\0"))
    with pytest.raises(InputError, match=r"1.bin: an ArduPilot log that cannot be read .the columns of IMU"):
        open_recording(path)
    monkeypatch.setitem(sys.modules, "pymavlink.DFReader", None)
    with pytest.raises(InputError, match=r"1.bin: an ArduPilot log; to read it: pip install 'alidade\[ardupilot\]'$"):
        open_recording(path)


@pytest.mark.slow
def test_a_tumble_from_an_ardupilot_log(alidade: Command, tmp_path: Path) -> None:
    """Two IMUs and a compass: what the same recording gives as MCAP, but for the rounding to milligauss."""
    compass = TumbledMagnetometer(rate_hz=20.0, density=1e-7)
    simulated = method("tumble").simulate(TURNING.model_copy(update={"magnetometer": compass}), 1)
    method("tumble").write(tmp_path / "s.mcap", simulated)
    topics = tumble_topics(simulated.data)
    imu, mag, place = (topics[name] for name in ("/imu", "/mag", "/fix"))
    assert isinstance(imu, series.ImuSeries)
    assert isinstance(mag, series.MagneticSeries)
    assert isinstance(place, series.FixSeries)

    def us(t_ns: Any) -> Any:
        return (t_ns - imu.t_ns[0]) // 1000 + 60_000_000

    week, ms = divmod((int(imu.t_ns[0]) // 1000 - 315_964_782_000_000) // 1000, 604_800_000)
    once, which = np.ones(1, int), np.arange(2 * len(imu)) % 2
    axes = xyz("Gyr", np.repeat(imu.gyro, 2, axis=0) + which[:, None]) | xyz("Acc", np.repeat(imu.accel, 2, axis=0))
    degrees = {"Lat": place.latitude_deg, "Lng": place.longitude_deg}
    where = {name: np.rint(1e7 * values).astype(int) for name, values in degrees.items()}
    field = xyz("Mag", np.rint(1e7 * mag.field).astype(int))
    kinds = {
        "IMU": of_kind(IMU, len(which), TimeUS=np.repeat(us(imu.t_ns), 2), I=which, **axes),
        "MAG": of_kind(MAG, len(mag), TimeUS=us(mag.t_ns), S=us(mag.t_ns), **field),
        "GPS": of_kind(GPS, 1, TimeUS=us(imu.t_ns[:1]), Status=3 * once, GWk=week * once, GMS=ms * once, **where),
    }
    path, config = forms.dataflash(tmp_path / "1.bin", kinds), tmp_path / "c.yaml"
    config.write_text(simulated.config + "topics: {imu: /IMU, mag: /MAG, fix: /GPS}\n")
    printed = alidade("info", path, "--config", config).out
    assert "tumble: yes" in printed
    assert "/IMU/1" in printed
    right, found = (
        {one["name"]: one for one in json.loads(run.out)["parameters"]}
        for run in (
            alidade("calibrate", tmp_path / "s.mcap", "--out", tmp_path / "right", "--json"),
            alidade("calibrate", path, "--config", config, "--out", tmp_path / "out", "--json"),
        )
    )
    assert right.keys() == found.keys()
    assert {"mag_k11", "mag_b1", "accel_b1", "gyro_bias_x"} <= found.keys()
    # Four sigmas of the rounding, beside the noise of a reading.
    rounding = 4.0 * (1e-7 / np.sqrt(12.0)) / (compass.density * np.sqrt(compass.rate_hz))
    for name, one in found.items():
        assert abs(one["value"] - right[name]["value"]) <= rounding * one["sigma"], name
