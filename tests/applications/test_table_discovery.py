"""What tables hold, concluded from headers and numbers, as phones, loggers and export tools write them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from alidade import export
from alidade.factors import so3
from alidade.pipelines.applications.session import Session
from alidade.pipelines.applications.table_discovery import propose_columns, with_columns
from alidade.pipelines.config import load_config
from alidade.pipelines.methods import method
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Config
from tests.support.command import Command

RNG = np.random.default_rng(5)
N = 400
DIRECTIONS = RNG.normal(size=(N, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1)[:, None]
RATES = 0.5 * RNG.normal(size=(N, 3))
ATTITUDES = RNG.normal(size=(N, 4))
ATTITUDES /= np.linalg.norm(ATTITUDES, axis=1)[:, None]


def write(path: Path, header: str, *columns: object) -> Path:
    numbers = np.column_stack([np.asarray(column, dtype=float) for column in columns])
    lines = [",".join(f"{x:.17g}" for x in row) for row in numbers.tolist()]
    path.write_text("\n".join([*([header] if header else []), *lines]), encoding="utf-8")
    return path


SECONDS = 0.01 * np.arange(N)
CASES = {
    "phyphox": (
        '"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)","Acceleration z (m/s^2)"',
        (SECONDS, 9.81 * DIRECTIONS),
        {"/imu": {"time": "Time (s)", "accel": [f"Acceleration {a} (m/s^2)" for a in "xyz"]}},
    ),
    "Sensor Logger": (
        "time,seconds_elapsed,z,y,x",
        (1.79e18 + 1e7 * np.arange(N), SECONDS, DIRECTIONS),
        {},
    ),
    "blackbox": (
        "loopIteration, time (us), magADC[0], magADC[1], magADC[2], gyroADC[0], gyroADC[1], gyroADC[2], "
        "gyroUnfilt[0], gyroUnfilt[1], gyroUnfilt[2], accSmooth[0], accSmooth[1], accSmooth[2]",
        (np.arange(N), 1e4 * np.arange(N), 500 * DIRECTIONS, *2 * [20.0 * RATES + 50.0], 2048 * DIRECTIONS),
        {
            "/imu": {
                "time": "time (us)",
                "unit": "us",
                "gyro": [f"gyroADC[{i}]" for i in range(3)],
                "accel": [f"accSmooth[{i}]" for i in range(3)],
                "units": {"gyro": "deg/s"},
            },
            "/mag": {"time": "time (us)", "unit": "us", "field": [f"magADC[{i}]" for i in range(3)]},
        },
    ),
    "SD logger": (
        "millis,ax,ay,az,gx,gy,gz,mx,my,mz",
        (10 * np.arange(N), DIRECTIONS, np.rad2deg(2.0 * RATES), 45.0 * DIRECTIONS),
        {
            "/imu": {
                "time": "millis",
                "unit": "ms",
                "gyro": ["gx", "gy", "gz"],
                "accel": ["ax", "ay", "az"],
                "units": {"gyro": "deg/s", "accel": "g"},
            },
            "/mag": {"time": "millis", "unit": "ms", "field": ["mx", "my", "mz"], "units": {"field": "uT"}},
        },
    ),
    "units in names": (
        "t_ns,acc_x_mg,acc_y_mg,acc_z_mg,gyro_x_dps,gyro_y_dps,gyro_z_dps",
        (1e7 * np.arange(N), 1000 * DIRECTIONS, RATES),
        {
            "/imu": {
                "time": "t_ns",
                "unit": "ns",
                "gyro": [f"gyro_{a}_dps" for a in "xyz"],
                "accel": [f"acc_{a}_mg" for a in "xyz"],
                "units": {"gyro": "deg/s", "accel": "mg"},
            }
        },
    ),
    "no header": (
        "",
        (SECONDS, 9.81 * DIRECTIONS),
        {"/imu": {"time": "column 1", "accel": ["column 2", "column 3", "column 4"]}},
    ),
    "no time": (
        "mx,my,mz",
        (48.0 * DIRECTIONS,),
        {"/mag": {"rate": 100.0, "field": ["mx", "my", "mz"], "units": {"field": "uT"}}},
    ),
    "accelerations with gravity by the name that ROS has for them": (
        "time,linear_acceleration.x,linear_acceleration.y,linear_acceleration.z",
        (SECONDS, 9.8 * DIRECTIONS),
        {"/imu": {"time": "time", "accel": [f"linear_acceleration.{axis}" for axis in "xyz"]}},
    ),
    "forces in units of gravity": (
        "time,gFx,gFy,gFz",
        (SECONDS, DIRECTIONS),
        {"/imu": {"time": "time", "accel": ["gFx", "gFy", "gFz"], "units": {"accel": "g"}}},
    ),
    "rows that begin with a number that the header does not name": (
        "timestamp,ang_vel_x,ang_vel_y,ang_vel_z",
        (np.arange(N), 1.5e9 + SECONDS, RATES),
        {"/imu": {"time": "timestamp", "gyro": [f"ang_vel_{axis}" for axis in "xyz"]}},
    ),
    "units below such a header": (
        "time,gx,gy,gz\ns,deg/s,deg/s,deg/s",
        (np.delete(np.arange(N), 7), np.delete(SECONDS, 7), np.delete(RATES, 7, axis=0)),
        {"/imu": {"time": "time", "gyro": ["gx", "gy", "gz"], "units": {"gyro": "deg/s"}}},
    ),
    "a frame's number and a last column without a name": (
        "frame,time,wx,wy,wz",
        (np.arange(N), SECONDS, RATES, np.ones(N)),
        {"/imu": {"time": "time", "gyro": ["wx", "wy", "wz"]}},
    ),
    "a rate that is another one's": (
        "# baud rate: 115200\ntime,wx,wy,wz",
        (SECONDS, RATES),
        {"/imu": {"time": "time", "gyro": ["wx", "wy", "wz"]}},
    ),
    "a pose as rostopic writes it": (
        "%time,field.header.seq,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
        + ",".join(f"field.pose.orientation.{axis}" for axis in "xyzw"),
        (1.5e18 + 1e7 * np.arange(N), np.arange(N), 0.5 * DIRECTIONS, ATTITUDES),
        {"/attitude": {"time": "time", "unit": "ns", "wxyz": [f"field.pose.orientation.{axis}" for axis in "wxyz"]}},
    ),
    "an IMU without an attitude as rostopic writes it, fast": (
        ",".join(
            [
                "%time,field.header.seq,field.header.stamp",
                *(f"field.orientation.{axis}" for axis in "xyzw"),
                *(f"field.orientation_covariance{i}" for i in range(9)),
                *(f"field.angular_velocity.{axis}" for axis in "xyz"),
                *(f"field.angular_velocity_covariance{i}" for i in range(9)),
                *(f"field.linear_acceleration.{axis}" for axis in "xyz"),
            ]
        ),
        (
            1.5e18 + 1e7 * np.arange(N) + 1e6 * RATES[:, 0],
            np.arange(N),
            1.5e18 + 1e7 * np.arange(N),
            np.tile([0.0, 0.0, 0.0, 1.0, -1.0, *8 * [0.0]], (N, 1)),
            RATES,
            np.ones((N, 9)),
            15.0 * DIRECTIONS,
        ),
        {
            "/imu": {
                "time": "field.header.stamp",
                "unit": "ns",
                "gyro": [f"field.angular_velocity.{axis}" for axis in "xyz"],
                "accel": [f"field.linear_acceleration.{axis}" for axis in "xyz"],
            }
        },
    ),
    "a pose as bagpy writes it": (
        "Time,header.seq,header.stamp.secs,header.stamp.nsecs,"
        + ",".join(f"pose.orientation.{axis}" for axis in "xyzw"),
        (
            1.5e9 + SECONDS + 1e-3 * RATES[:, 0],
            np.arange(N),
            1.5e9 + SECONDS // 1.0,
            np.rint(1e9 * (SECONDS % 1.0)),
            ATTITUDES,
        ),
        {
            "/attitude": {
                "time": ["header.stamp.secs", "header.stamp.nsecs"],
                "wxyz": [f"pose.orientation.{axis}" for axis in "wxyz"],
            }
        },
    ),
    "two devices side by side, a time each": (
        "imu_time,gx,gy,gz,frame,mocap_time,mocap_ms,qw,qx,qy,qz",
        (SECONDS, RATES, np.arange(N), 1.03 * SECONDS + 0.5, 1030.0 * SECONDS + 500.0, ATTITUDES),
        {
            "/imu": {"time": "imu_time", "gyro": ["gx", "gy", "gz"]},
            "/attitude": {"time": "mocap_time", "wxyz": ["qw", "qx", "qy", "qz"]},
        },
    ),
    "one clock in two forms": (
        "t,gx,gy,gz,unix_time,uptime_ms,qw,qx,qy,qz",
        (SECONDS, RATES, 1.79e9 + SECONDS, 1e3 * SECONDS + 250.0, ATTITUDES),
        {
            "/imu": {"time": "t", "gyro": ["gx", "gy", "gz"]},
            "/attitude": {"time": "t", "wxyz": ["qw", "qx", "qy", "qz"]},
        },
    ),
    "messages of two topics as PlotJuggler exports them, by the alphabet": (
        ",".join(
            [
                "__time",
                *(f"/imu/angular_velocity/{axis}" for axis in "xyz"),
                "/imu/header/stamp/nanosec,/imu/header/stamp/sec",
                *(f"/imu/linear_acceleration/{axis}" for axis in "xyz"),
                "/mag/header/stamp",
                *(f"/mag/magnetic_field/{axis}" for axis in "xyz"),
            ]
        ),
        (
            0.05 + SECONDS,
            RATES,
            np.rint(1e9 * (SECONDS % 1.0)),
            SECONDS // 1.0,
            15.0 * DIRECTIONS,
            SECONDS + 0.002,
            5e-5 * DIRECTIONS,
        ),
        {
            "/imu": {
                "time": ["/imu/header/stamp/sec", "/imu/header/stamp/nanosec"],
                "gyro": [f"/imu/angular_velocity/{axis}" for axis in "xyz"],
                "accel": [f"/imu/linear_acceleration/{axis}" for axis in "xyz"],
            },
            "/mag": {"time": "/mag/header/stamp", "field": [f"/mag/magnetic_field/{axis}" for axis in "xyz"]},
        },
    ),
    "the whole time in seconds and in nanoseconds": (
        "time_sec,time_nsec,gx,gy,gz",
        (SECONDS, np.rint(1e9 * SECONDS), RATES),
        {"/imu": {"time": "time_sec", "gyro": ["gx", "gy", "gz"]}},
    ),
    "a logger whose attitude is off": (
        "t,gx,gy,gz,qw,qx,qy,qz",
        (SECONDS, RATES, np.full((N, 4), np.nan)),
        {"/imu": {"time": "t", "gyro": ["gx", "gy", "gz"]}},
    ),
    "user acceleration in g": (
        "t,userAccelerationX (G),userAccelerationY (G),userAccelerationZ (G)",
        (SECONDS, 0.065 * RNG.normal(size=(N, 3))),
        {},
    ),
    "free acceleration, fast": ("t,FreeAcc_X,FreeAcc_Y,FreeAcc_Z", (SECONDS, 14.0 * DIRECTIONS), {}),
    "a gyro and an accelerometer with a time each": (
        "t_gyro,gx,gy,gz,t_acc,ax,ay,az",
        (SECONDS, RATES, 1.03 * SECONDS + 0.5, 9.81 * DIRECTIONS),
        {
            "/imu/gyro": {"time": "t_gyro", "gyro": ["gx", "gy", "gz"]},
            "/imu/accel": {"time": "t_acc", "accel": ["ax", "ay", "az"]},
        },
    ),
    "a rigid body as Motive exports it": (
        "Format Version,1.23,Take Name,Take,Capture Frame Rate,100.000000,Rotation Type,Quaternion\n\n"
        f",Type{8 * ',Rigid Body'}\n,Name{8 * ',Head'}\n,ID{8 * ',1'}\n"
        f",{4 * ',Rotation'}{3 * ',Position'},Mean Marker Error\nFrame,Time (Seconds),X,Y,Z,W,X,Y,Z,",
        (np.arange(N), SECONDS, ATTITUDES, DIRECTIONS, np.full(N, 3e-4)),
        {"/attitude": {"time": "Time (Seconds)", "wxyz": ["W", "column 3", "column 4", "column 5"]}},
    ),
    "a quaternion by numbers, a clock of 0.1 ms beside the rate": (
        "// Update Rate: 100.0Hz\nSampleTimeFine,Gyr_X,Gyr_Y,Gyr_Z,Quat_q0,Quat_q1,Quat_q2,Quat_q3",
        (100 * np.arange(N), RATES, ATTITUDES),
        {
            "/imu": {"rate": 100.0, "gyro": ["Gyr_X", "Gyr_Y", "Gyr_Z"]},
            "/attitude": {"rate": 100.0, "wxyz": [f"Quat_q{i}" for i in range(4)]},
        },
    ),
    "a line of units, one of them a vendor's own": (
        "D_Timestamp,D_Accel_X,D_Accel_Y,D_Accel_Z,D_Mag_X,D_Mag_Y,D_Mag_Z\n"
        "ms,m/(s^2),m/(s^2),m/(s^2),local_flux,local_flux,local_flux",
        (1.6e12 + 10 * np.arange(N), 9.81 * DIRECTIONS, DIRECTIONS),
        {
            "/imu": {"time": "D_Timestamp", "unit": "ms", "accel": [f"D_Accel_{axis}" for axis in "XYZ"]},
            "/mag": {
                "time": "D_Timestamp",
                "unit": "ms",
                "field": [f"D_Mag_{axis}" for axis in "XYZ"],
                "units": {"field": "G"},
            },
        },
    ),
    "a quaternion in brackets": (
        "timestamp,q[0],q[1],q[2],q[3],delta_q_reset[0],delta_q_reset[1],delta_q_reset[2],delta_q_reset[3]",
        (1e4 * np.arange(N), ATTITUDES, np.tile([1.0, 0.0, 0.0, 0.0], (N, 1))),
        {"/attitude": {"time": "timestamp", "unit": "us", "wxyz": [f"q[{i}]" for i in range(4)]}},
    ),
    "a segment as Vicon exports it": (
        "Segments\n200\n,,Head:Head,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,rad,rad,rad,mm,mm,mm",
        (np.arange(N), np.zeros(N), 0.5 * DIRECTIONS, 900.0 * DIRECTIONS),
        {"/attitude": {"rate": 200.0, "rotation_vector": ["RX", "RY", "RZ"]}},
    ),
    "a tracker's errors": (
        "t_ns,az_error (mrad),el_error (mrad)",
        (1e7 * np.arange(N), 3.0 * RATES[:, :2]),
        {
            "/los/error": {
                "time": "t_ns",
                "unit": "ns",
                "vector": ["el_error (mrad)", None, "az_error (mrad)"],
                "units": {"vector": "mrad"},
            }
        },
    ),
    "a head tracker's angles": (
        "t (ms),Yaw,Pitch,Roll,Yaw rate,Pitch rate,Roll rate",
        (10 * np.arange(N), 40.0 * RATES, RATES),
        {
            "/attitude": {
                "time": "t (ms)",
                "unit": "ms",
                "yaw_pitch_roll": ["Yaw", "Pitch", "Roll"],
                "units": {"yaw_pitch_roll": "deg"},
            }
        },
    ),
    "a pose": (
        "timestamp,qw,qx,qy,qz",
        (1.79e9 + SECONDS, ATTITUDES),
        {"/attitude": {"time": "timestamp", "wxyz": ["qw", "qx", "qy", "qz"]}},
    ),
    "linear acceleration": (
        "Time (s),Linear Acceleration x (m/s^2),Linear Acceleration y (m/s^2),Linear Acceleration z (m/s^2)",
        (SECONDS, 0.1 * DIRECTIONS),
        {},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_columns_are_concluded(name: str, tmp_path: Path) -> None:
    header, columns, expected = CASES[name]
    found = propose_columns(open_recording(write(tmp_path / "x.csv", header, *columns)))
    assert found is not None
    plain = {topic: json.loads(table.model_dump_json(exclude_defaults=True)) for topic, table in found.columns.items()}
    assert plain == expected
    assert found.reasons or found.doubts
    assert not expected or load_config(found.yaml.encode()).columns == found.columns, "as pasted"


def test_a_file_is_named_after_its_sensor(tmp_path: Path) -> None:
    header = "time,seconds_elapsed,z,y,x"
    path = write(tmp_path / "Gyroscope.csv", header, 1.79e18 + 1e7 * np.arange(N), SECONDS, RATES)
    found = propose_columns(open_recording(path))
    assert found is not None
    assert found.columns["/imu"].gyro == ("x", "y", "z")
    assert (found.columns["/imu"].time, found.columns["/imu"].unit) == ("time", "ns")


def test_three_columns_without_a_header_are_what_the_file_is_named_after(tmp_path: Path) -> None:
    counts = 3500.0 * DIRECTIONS + [10_000.0, -8_000.0, 8_500.0]
    found = propose_columns(open_recording(write(tmp_path / "mag3_raw.csv", "", counts)))
    assert found is not None
    assert found.columns["/mag"].field == ("column 1", "column 2", "column 3")
    assert "no header: the sensor is that of the file's name" in " ".join(found.doubts)
    unnamed = propose_columns(open_recording(write(tmp_path / "run7.csv", "", counts)))
    assert unnamed is not None
    assert not unnamed.columns


def test_units_in_a_header_say_what_columns_are(tmp_path: Path) -> None:
    """Names in a language that nobody listed, and a time without a word for it."""
    header = "Zeit [ms];Beschl_x [g];Beschl_y [g];Beschl_z [g];Bfeld_x [uT];Bfeld_y [uT];Bfeld_z [uT]"
    columns = (1e3 * SECONDS, DIRECTIONS, 45.0 * DIRECTIONS)
    found = propose_columns(open_recording(write(tmp_path / "lab.csv", header.replace(";", ","), *columns)))
    assert found is not None
    assert (found.columns["/imu"].time, found.columns["/imu"].unit) == ("Zeit [ms]", "ms")
    assert found.columns["/imu"].accel == ("Beschl_x [g]", "Beschl_y [g]", "Beschl_z [g]")
    assert found.columns["/mag"].field == ("Bfeld_x [uT]", "Bfeld_y [uT]", "Bfeld_z [uT]")
    header = "epoch_ms,rate_p(deg/s),rate_q(deg/s),rate_r(deg/s)"
    found = propose_columns(open_recording(write(tmp_path / "imu.csv", header, 1.6e12 + 1e3 * SECONDS, 50.0 * RATES)))
    assert found is not None
    assert found.columns["/imu"].gyro == ("rate_p(deg/s)", "rate_q(deg/s)", "rate_r(deg/s)")
    assert found.columns["/imu"].time == "epoch_ms"


def test_rows_of_two_devices_by_turns_have_the_time_of_their_own(tmp_path: Path) -> None:
    lines = ["imu_time,gx,gy,gz,mocap_time,qw,qx,qy,qz"]
    for t, rates, wxyz in zip(SECONDS, RATES, ATTITUDES, strict=True):
        lines += [f"{t},{','.join(map(str, rates))},,,,,", f",,,,{t + 0.003},{','.join(map(str, wxyz))}"]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    found = propose_columns(open_recording(tmp_path / "a.csv"))
    assert found is not None
    assert {topic: table.time for topic, table in found.columns.items()} == {
        "/imu": "imu_time",
        "/attitude": "mocap_time",
    }


def test_an_attitude_that_never_moves_is_not_used_and_that_is_written(tmp_path: Path) -> None:
    still = np.tile([0.0, 0.0, 0.0, 1.0], (N, 1))
    found = propose_columns(open_recording(write(tmp_path / "a.csv", "t,gx,gy,gz,qx,qy,qz,qw", SECONDS, RATES, still)))
    assert found is not None
    assert list(found.columns) == ["/imu"]
    assert "qw, qx, qy, qz are constant: not used" in found.doubts


def test_fast_motion_in_g_is_not_gravity_taken_off(tmp_path: Path) -> None:
    """Of 1.5 g typically, and between 0.5 and 3: in m/s^2 these numbers would be motion alone."""
    moving = np.random.default_rng(0).uniform(0.3, 3.0, (len(SECONDS), 1)) * DIRECTIONS
    found = propose_columns(open_recording(write(tmp_path / "a.csv", "t [s],ax [g],ay [g],az [g]", SECONDS, moving)))
    assert found is not None
    assert found.columns["/imu"].accel == ("ax [g]", "ay [g]", "az [g]")


def test_a_table_without_columns_is_told_what_is_lacking(tmp_path: Path, alidade: Command) -> None:
    path = write(tmp_path / "lab.csv", "t,mx,my,mz", SECONDS, 45.0 * DIRECTIONS)
    (tmp_path / "twice.yaml").write_text("columns: {/mag: {time: t, field: [mx, my, my]}}")
    (tmp_path / "absent.yaml").write_text(
        "columns: {/helm: {time: t, gyro: [mx, my, mz]}}\ntopics: {head_imu: /helmet/imu}"
    )
    for config, message in (
        ("twice.yaml", "field: a column is named twice, mx, my, my"),
        ("absent.yaml", "topics.head_imu: no topic /helmet/imu"),
    ):
        run = alidade("calibrate", str(path), "--config", str(tmp_path / config), "--out", str(tmp_path / "out"))
        assert run.code == 2
        assert message in run.err
    assert "a table needs `columns:` in the config, or --auto-columns" in open_recording(path).there()


def test_an_accelerometers_file_beside_a_compass_is_the_imu(tmp_path: Path) -> None:
    """It had a topic of its own that no method reads, though `info` said that tumble is served."""
    write(tmp_path / "acc.csv", "ax (g),ay (g),az (g)", DIRECTIONS)
    write(tmp_path / "mag.csv", "mx (uT),my (uT),mz (uT)", 45.0 * DIRECTIONS)
    recording, config = with_columns(open_recording(tmp_path), Config())
    assert config.topics["imu"].parts == ("/imu/accel",)
    data = method("tumble").read(recording, config)
    assert data.accel is not None
    assert data.mag is not None


def test_a_time_with_too_few_digits_is_told(tmp_path: Path) -> None:
    found = propose_columns(
        open_recording(write(tmp_path / "x.csv", "t,mx,my,mz", np.full(N, 1.75e9), 48.0 * DIRECTIONS))
    )
    assert found is not None
    assert found.columns["/mag"].rate == 100.0
    assert "t is no time: it does not increase from row to row" in found.doubts


def test_a_phones_files_of_one_sensor_each_are_one_imu(tmp_path: Path, alidade: Command) -> None:
    write(tmp_path / "Accelerometer.csv", "Time (s),acc x (g),acc y (g),acc z (g)", SECONDS, DIRECTIONS)
    write(tmp_path / "Gyroscope.csv", "Time (s),gyr x (rad/s),gyr y (rad/s),gyr z (rad/s)", SECONDS, RATES)
    found = propose_columns(open_recording(tmp_path))
    assert found is not None
    assert found.columns.keys() == {"/imu/accel", "/imu/gyro"}
    assert found.topics["imu"].parts == ("/imu/gyro", "/imu/accel")
    # Topics once proposed were not those that calibrate uses: the same two as a reference.
    shown = alidade("info", str(tmp_path)).out
    assert "imu: {gyro: /imu/gyro, accel: /imu/accel}" in shown
    assert "reference_imu" not in shown
    # Of the shell's own pattern each is a recording, and one without a gyro is not a dead one.
    apart = [str(path) for path in sorted(tmp_path.glob("*.csv"))]
    run = alidade("calibrate", *apart, "--auto-columns", "--method", "cube", "--out", str(tmp_path / "out"))
    assert run.code == 2
    assert "topic /imu has no gyro, which is needed here" in run.err
    assert "name those of one by their folder, or by a pattern in quotes" in run.err


def rows_of_sensors(path: Path, names: Mapping[str, object], header: str = "sensor,time,x,y,z") -> Path:
    """Write a table with a row for each reading of each sensor, by turns."""
    lines = [header]
    for i, t in enumerate(SECONDS):
        lines += [f"{name},{t:.3f},{','.join(map(str, np.asarray(xyz)[i]))}" for name, xyz in names.items()]
    path.write_text("\n".join(lines))
    return path


def test_rows_named_after_their_sensor_are_a_topic_each(tmp_path: Path, alidade: Command) -> None:
    sensors = {"GYROSCOPE": RATES, "accelerometer": 9.81 * DIRECTIONS, "magnetometer": 45.0 * DIRECTIONS}
    path = rows_of_sensors(tmp_path / "imu_log.csv", {**sensors, "battery": 3.7 + 0.0 * RATES})
    found = propose_columns(open_recording(path))
    assert found is not None
    assert {topic: table.where for topic, table in found.columns.items()} == {
        "/imu/gyro": {"sensor": "GYROSCOPE"},
        "/imu/accel": {"sensor": "accelerometer"},
        "/mag": {"sensor": "magnetometer"},
    }
    assert found.columns["/mag"].units == {"field": "uT"}
    assert found.topics["imu"].parts == ("/imu/gyro", "/imu/accel")
    run = alidade("calibrate", str(path), "--auto-columns", "--method", "tumble", "--out", str(tmp_path / "out"))
    assert run.code in (0, 3)
    assert "Magnetometer" in run.out


def test_of_rows_named_after_a_sensor_twice_the_uncalibrated_ones_are_left_out(tmp_path: Path) -> None:
    sensors = {"Uncalibrated accel": 9.9 * DIRECTIONS, "accel": 9.81 * DIRECTIONS, "linear_acceleration": RATES}
    path = rows_of_sensors(tmp_path / "a.csv", sensors, "type,t,value_x,value_y,value_z")
    found = propose_columns(open_recording(path))
    assert found is not None
    assert [table.where for table in found.columns.values()] == [{"type": "accel"}]
    assert found.topics["imu"].topic == "/imu/accel"
    assert "Uncalibrated accel is not used: /imu/accel is of another sensor" in found.doubts
    assert any("gravity" in doubt for doubt in found.doubts)


def test_a_rotation_vector_is_no_magnetometer_and_units_may_stand_with_the_sensor(tmp_path: Path) -> None:
    sensors = {
        "android.sensor.geomagnetic_rotation_vector": 0.1 * DIRECTIONS,
        "android.sensor.magnetic_field": 45.0 * DIRECTIONS,
        "Gyroscope (deg/s)": RATES,
    }
    found = propose_columns(open_recording(rows_of_sensors(tmp_path / "phone.csv", sensors)))
    assert found is not None
    assert found.columns["/mag"].where == {"sensor": "android.sensor.magnetic_field"}
    assert found.columns["/imu/gyro"].units == {"gyro": "deg/s"}


def test_sensors_that_are_written_one_after_the_other_are_all_found(tmp_path: Path) -> None:
    """Longer, each, than what is looked at of a table."""
    lines, repeats = ["sensor,time,x,y,z"], 21_000
    for name, size in (("accelerometer", 9.81), ("magnetometer", 45.0)):
        lines += [f"{name},{0.01 * i},{x * size},{y * size},{z * size}" for i, (x, y, z) in _many(repeats)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    found = propose_columns(open_recording(tmp_path / "log.csv"))
    assert found is not None
    assert found.columns.keys() == {"/imu/accel", "/mag"}


def _many(count: int) -> Iterator[tuple[int, list[float]]]:
    return enumerate(np.resize(DIRECTIONS, (count, 3)).tolist())


def test_one_sensor_by_name_beside_an_empty_w_is_found(tmp_path: Path) -> None:
    lines = [f"magnetometer,{t},{x},{y},{z}," for t, (x, y, z) in zip(SECONDS, 45.0 * DIRECTIONS, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["sensor,time,x,y,z,w", *lines]))
    found = propose_columns(open_recording(tmp_path / "log.csv"))
    assert found is not None
    assert found.columns["/mag"].where == {"sensor": "magnetometer"}


@pytest.mark.parametrize(
    ("file", "words", "topic"),
    [("mag", ("accuracy high", "accuracy low"), "/mag"), ("accel", ("magnet near", "magnet far"), "/imu")],
)
def test_a_word_in_each_row_that_is_no_sensor_changes_nothing(
    file: str, words: tuple[str, str], topic: str, tmp_path: Path
) -> None:
    size = 45.0 if file == "mag" else 9.81
    rows = zip(SECONDS, size * DIRECTIONS, strict=True)
    lines = [f"{t},{words[i % 2]},{x},{y},{z}" for i, (t, (x, y, z)) in enumerate(rows)]
    (tmp_path / f"{file}.csv").write_text("\n".join(["time,state,x,y,z", *lines]))
    found = propose_columns(open_recording(tmp_path / f"{file}.csv"))
    assert found is not None
    assert {name: table.where for name, table in found.columns.items()} == {topic: {}}


def test_a_column_that_mentions_sensors_does_not_say_what_named_columns_are(tmp_path: Path) -> None:
    lines = ["t,state,mx,my,mz"]
    lines += [
        f"{t},{'mag warm' if t < 1 else 'mag ready'},{','.join(map(str, xyz))}"
        for t, xyz in zip(SECONDS, 45.0 * DIRECTIONS, strict=True)
    ]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    found = propose_columns(open_recording(tmp_path / "a.csv"))
    assert found is not None
    assert not found.columns["/mag"].where


def test_the_parts_of_an_imu_are_no_gyros_beside_it(tmp_path: Path, alidade: Command) -> None:
    t = 0.01 * np.arange(2000)
    turned = np.stack([0.8 * np.sin(1.9 * t), 0.5 * np.sin(2.7 * t + 1.0), 0.3 * np.sin(3.7 * t)], axis=1)
    wxyz = so3.exp(turned)
    rates = so3.log(so3.multiply(so3.inverse(wxyz[:-1]), wxyz[1:])) / 0.01
    folder = tmp_path / "phone"
    folder.mkdir()
    write(folder / "Gyroscope.csv", "seconds_elapsed,x,y,z", t[1:], rates)
    write(folder / "Accelerometer.csv", "seconds_elapsed,x,y,z", t, so3.rotate(so3.inverse(wxyz), [0.0, 0.0, 9.81]))
    write(folder / "Orientation.csv", "seconds_elapsed,qw,qx,qy,qz", t, wxyz)
    out = alidade("info", str(folder)).out
    assert "head_imu: {gyro: /imu/gyro, accel: /imu/accel}" in out
    assert "an attitude made of it is no reference" in " ".join(out.split())
    assert "vision_attitude: /attitude" in out
    # Topics that are found in tables take both options.
    assert "use `calibrate --auto-columns --auto-topics` or paste" in " ".join(out.split())
    refused = alidade("calibrate", str(folder), "--auto-columns", "--out", str(tmp_path / "out"))
    assert (refused.code, "--method head --auto-topics" in refused.err) == (2, True)


def test_one_command_calibrates_a_phones_table(tmp_path: Path, alidade: Command) -> None:
    field = 45.0 * DIRECTIONS @ np.diag([1.05, 0.97, 1.0]) + [12.0, -30.0, 7.0] + 0.1 * RNG.normal(size=(N, 3))
    header = ",".join(["Time (s)", *(f"Magnetic Field {axis} (µT)" for axis in "xyz")])
    path = write(tmp_path / "phone.csv", header, SECONDS, field)
    shown = alidade("info", str(path))
    assert '/mag: {time: "Time (s)", field:' in shown.out
    done = alidade("calibrate", str(path), "--auto-columns", "--json", "--out", str(tmp_path / "out"))
    result = json.loads(done.out)
    assert result["status"] == "calibrated"
    assert "columns as `alidade info` proposes them" in result["notes"]
    assert "note: columns" not in shown.out


def test_a_decoded_blackbox_log_is_calibrated_and_its_offset_exported(tmp_path: Path) -> None:
    """Columns as blackbox_decode writes them: words among numbers, a compass that repeats its readings, counts."""
    n, dt = 500, 0.01
    t = dt * np.arange(n)
    rates = np.stack([2.0 * np.sin(1.1 * t), 2.3 * np.cos(0.7 * t), 1.5 + np.sin(0.31 * t)], axis=1)
    attitudes = [np.array([1.0, 0.0, 0.0, 0.0])]
    for rate in 0.5 * (rates[1:] + rates[:-1]):
        attitudes.append(so3.multiply(attitudes[-1], so3.exp(rate * dt)))
    R = so3.matrix(np.array(attitudes))
    offset = np.array([120.0, -333.0, 41.0])
    field = (offset + 500.0 * R.transpose(0, 2, 1) @ [0.4, 0.0, -0.9165])[np.arange(n) // 4 * 4]
    columns = {"gyroADC": np.rad2deg(rates), "accSmooth": 2048.0 * R[:, 2], "magADC": field}
    names = [f"{name}[{i}]" for name in columns for i in range(3)]
    rows = np.rint(np.column_stack(list(columns.values())) + 0.5 * RNG.normal(size=(n, 9))).astype(int)
    lines = [
        f"{8 * i}, {27_000_000 + 10_000 * i}, {', '.join(f'{x:3d}' for x in row)}, 16.1, ANGLE_MODE|MAG, IDLE"
        for i, row in enumerate(rows.tolist())
    ]
    header = ", ".join(["loopIteration", "time (us)", *names, "vbatLatest (V)", "flightModeFlags (flags)", "failsafe"])
    (tmp_path / "LOG00001.01.csv").write_text("\n".join([header, *lines]))
    recording = open_recording(tmp_path / "LOG00001.01.csv")
    result = Session.read(recording, "tumble", None, auto_columns=True).calibrate(report=False)
    assert result.status in ("calibrated", "weak"), result.headline
    command = export(result, "betaflight").splitlines()[-1]
    found = [int(x) for x in command.removeprefix("set mag_calibration = ").split(",")]
    np.testing.assert_allclose(found, offset, atol=2.0)


def test_several_tables_of_one_device_have_their_columns_proposed(tmp_path: Path, alidade: Command) -> None:
    """`--auto-columns` was once lost where several recordings are calibrated together."""
    header = ",".join(["Time (s)", *(f"Magnetic Field {axis} (µT)" for axis in "xyz")])
    paths = []
    for name in ("march", "june"):
        field = 45.0 * DIRECTIONS @ np.diag([1.05, 0.97, 1.0]) + [12.0, -30.0, 7.0] + 0.1 * RNG.normal(size=(N, 3))
        paths.append(write(tmp_path / f"{name}.csv", header, SECONDS, field))
    done = alidade("calibrate", *map(str, paths), "--auto-columns", "--json", "--out", str(tmp_path / "out"))
    assert done.code == 0, done.err
    assert [part["recording"] for part in json.loads(done.out)["recordings"]] == ["march.csv", "june.csv"]


def test_compare_and_validate_use_the_proposed_columns(tmp_path: Path, alidade: Command) -> None:
    """Their error proposes `--auto-columns`."""
    header = ",".join(["Time (s)", *(f"Magnetic Field {axis} (µT)" for axis in "xyz")])
    for name in ("march", "june"):
        field = 45.0 * DIRECTIONS @ np.diag([1.05, 0.97, 1.0]) + [12.0, -30.0, 7.0] + 0.1 * RNG.normal(size=(N, 3))
        write(tmp_path / f"{name}.csv", header, SECONDS, field)
    march, june = str(tmp_path / "march.csv"), str(tmp_path / "june.csv")
    assert alidade("calibrate", march, "--auto-columns", "--out", str(tmp_path / "out")).code == 0
    found = str(tmp_path / "out" / "result.json")
    refused = alidade("validate", june, "--calibration", found)
    assert refused.code == 2
    assert "--auto-columns" in refused.err
    validated = alidade("validate", june, "--calibration", found, "--auto-columns", "--out", str(tmp_path / "page"))
    assert validated.code == 0, validated.err
    compared = alidade("compare", june, "--auto-columns")
    assert compared.code == 0, compared.err
