"""Tables as loggers, phones and spreadsheets write them: the same numbers come out, or one line says what is wrong."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.recording.table_values import nanoseconds

N = 60
T = [f"{1000 + 0.02 * i:.3f}" for i in range(N)]
FIELD = np.round(np.random.default_rng(1).normal(0.0, 30.0, (N, 3)), 3)
CONFIG = "columns: {/mag: {time: t, field: [mx, my, mz], units: {field: uT}}}"
HEADER = "t,mx,my,mz"


def rows(separator: str = ",", decimal: str = ".", time: Callable[[int], str] = lambda i: T[i]) -> list[str]:
    lines = [separator.join([time(i), *(f"{x:.3f}" for x in FIELD[i])]) for i in range(N)]
    return lines if decimal == "." else [line.replace(".", decimal) for line in lines]


def described(path: Path, config: str = CONFIG) -> Recording:
    recording = open_recording(path)
    settings = load_config(config.encode())
    recording = recording.with_config(settings.topics.values(), settings.columns)
    return recording


def magnetic(path: Path, config: str = CONFIG) -> series.MagneticSeries:
    return described(path, config).magnetic("/mag")


def iso(i: int) -> str:
    start = datetime.datetime(2026, 3, 1, 23, 59, 59, tzinfo=datetime.UTC)
    return (start + datetime.timedelta(milliseconds=20 * i)).isoformat(timespec="milliseconds")


def wrapped(i: int) -> str:
    return str((2**32 - 500_000 + 20_000 * i) % 2**32)


DIALECTS: dict[str, tuple[bytes, str]] = {
    "a word ahead of the numbers": (
        "\n".join(["Fs,50.00", "name," + HEADER, *(f"rest {i % 3},{line}" for i, line in enumerate(rows()))]).encode(),
        "x.csv",
    ),
    "comma": ("\n".join([HEADER, *rows()]).encode(), "x.csv"),
    "byte order mark": ("\n".join([HEADER, *rows()]).encode("utf-8-sig"), "x.csv"),
    "UTF-16": ("\n".join([HEADER, *rows()]).encode("utf-16"), "x.csv"),
    "carriage returns": ("\r".join([HEADER, *rows()]).encode(), "x.csv"),
    "semicolons": ("\n".join([HEADER.replace(",", ";"), *rows(";")]).encode(), "x.csv"),
    "decimal commas": ("\n".join([HEADER.replace(",", ";"), *rows(";", ",")]).encode(), "x.csv"),
    "tabs": ("\n".join([HEADER.replace(",", "\t"), *rows("\t")]).encode(), "x.tsv"),
    "blanks": ("\n".join(["t  mx my   mz", *rows("   ")]).encode(), "x.txt"),
    "blanks and decimal commas": ("\n".join([HEADER.replace(",", " "), *rows(" ", ",")]).encode(), "x.dat"),
    "quotes": ("\n".join(['"t","mx","my","mz"', *rows()]).encode(), "x.csv"),
    "preamble": ("\n".join(["sep=,", "Device:,Pixel 4", "Rate:,50Hz", "", HEADER, *rows()]).encode(), "x.csv"),
    "comments": ("\n".join(["# exported, by an app", "# unit: uT, s", HEADER, *rows()]).encode(), "x.csv"),
    "slashes": ("\n".join(["// General:", "//  version: 1", "t\tmx\tmy\tmz", *rows("\t")]).encode(), "x.txt"),
    "a line of units": ("\n".join([HEADER, "s,uT,uT,uT", *rows()]).encode(), "x.csv"),
    "a delimiter at the end": ("\n".join([HEADER + ",", *(f"{row}," for row in rows())]).encode(), "x.csv"),
    "a delimiter at the end of rows": ("\n".join([HEADER, *(f"{row}," for row in rows())]).encode(), "x.csv"),
    "blank lines": ("\n\n".join([HEADER, *rows()]).encode(), "x.csv"),
    "header once more": ("\n".join([HEADER, *rows()[:30], HEADER, *rows()[30:]]).encode(), "x.csv"),
    "exponents": ("\n".join([HEADER, *rows(time=lambda i: f"{float(T[i]):.9E}")]).encode(), "x.csv"),
    "dates": ("\n".join([HEADER, *rows(time=iso)]).encode(), "x.csv"),
    "clock times over midnight": ("\n".join([HEADER, *rows(time=lambda i: iso(i)[11:23])]).encode(), "x.csv"),
    "another ending": ("\n".join([HEADER, *rows()]).encode(), "LOG.000"),
    "upper case": ("\n".join([HEADER, *rows()]).encode(), "DATA.CSV"),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_a_dialect_gives_the_same_numbers(name: str, tmp_path: Path) -> None:
    content, file = DIALECTS[name]
    (tmp_path / file).write_bytes(content)
    found = magnetic(tmp_path / file)
    np.testing.assert_array_equal(found.field, FIELD * 1e-6)
    np.testing.assert_array_equal(np.diff(found.t_ns), np.full(N - 1, 20_000_000))


def test_a_folder_of_a_phones_tables_is_one_recording(tmp_path: Path) -> None:
    (tmp_path / "Magnetometer.csv").write_text("\n".join([HEADER, *rows()]))
    (tmp_path / "README.txt").write_text("no table\n")
    np.testing.assert_array_equal(magnetic(tmp_path).field, FIELD * 1e-6)


@pytest.mark.parametrize(
    ("config", "header", "time"),
    [
        ("time: t, unit: us", HEADER, wrapped),
        ("time: t", "t (us),mx,my,mz", wrapped),
        ("time: t, unit: ms", HEADER, lambda i: str(20 * i)),
        ("time: t", "t [ms],mx,my,mz", lambda i: str(20 * i)),
        ("time: t", HEADER, lambda i: f"{0.02 * i:.2f}"),
        ("rate: 50", HEADER, lambda _: ""),
    ],
    ids=["counter that runs over", "unit in the header", "ms", "ms in the header", "from zero on", "rate"],
)
def test_times_in_a_unit(config: str, header: str, time: Callable[[int], str], tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("\n".join([header, *rows(time=time)]))
    named = config.replace("time: t", f'time: "{header.split(",", maxsplit=1)[0]}"')
    found = magnetic(tmp_path / "x.csv", f"columns: {{/mag: {{{named}, field: [mx, my, mz]}}}}")
    np.testing.assert_array_equal(np.diff(found.t_ns), np.full(N - 1, 20_000_000))
    assert found.stamped_by_log == 0, "a time of 0 is a time"


def test_what_stands_for_no_number_is_none_and_a_last_row_that_is_cut_is_left_out(tmp_path: Path) -> None:
    lines = rows()
    lines[10], lines[11], lines[12] = f"{T[10]},NA,NA,NA", f"{T[11]},null,null,null", f"{T[12]},,,"
    (tmp_path / "x.csv").write_text("\n".join([HEADER, *lines])[:-9])
    recording = described(tmp_path / "x.csv")
    np.testing.assert_array_equal(recording.magnetic("/mag").field, np.delete(FIELD, [10, 11, 12, 59], axis=0) * 1e-6)
    assert "x.csv: rows cut short, the first in line 61: 1 left out" in recording.notes


@pytest.mark.parametrize(
    ("lines", "config", "message"),
    [
        ([HEADER, *rows()[:5], "1,2", "1,2", "1,2", *rows()[5:]], CONFIG, "line 7 has 2 columns instead of 4"),
        ([HEADER, *rows()[:5], "1000.1,2,bad,3", *rows()[5:]], CONFIG, "row 6, column my: 'bad' is no number"),
        (
            [f"{HEADER},mx", *(f"{row},0" for row in rows())],
            CONFIG,
            "2 columns are called mx; name one of them as `col",
        ),
        ([HEADER, *rows(time=lambda i: str(20 * i))], CONFIG, "is the unit ms"),
        ([HEADER, *rows(time=lambda i: str(1_790_000_000_000_000_000 + 20_000_000 * i))], CONFIG, "is the unit ns"),
        ([HEADER, *rows(time=lambda i: str(1_790_000_000_000 + 20 * i))], CONFIG, "is the unit ms"),
        (
            [HEADER, *rows()],
            "columns: {/mag: {time: t, unit: us, field: [mx, my, mz]}}",
            "is the unit s|is the unit ms",
        ),
        ([HEADER, *rows()], "columns: {/mag: {field: [mx, my, mz]}}", "either time, .*or rate, in Hz, is needed"),
        (
            [HEADER, *rows()],
            "columns: {/mag: {time: [t, mx], unit: us, field: [mx, my, mz]}}",
            "unit goes with one column of time",
        ),
        (
            [HEADER, *rows()],
            "columns: {/mag: {time: [t, mx], field: [mx, my, mz]}}",
            "are no whole seconds and nanosec",
        ),
        (
            [HEADER, *rows()],
            "columns: {/mag: {time: [t, t], field: [mx, my, mz]}}",
            "must be a column, or two: of whole",
        ),
        ([HEADER, *rows()], "columns: {/mag: {time: [t], field: [mx, my, mz]}}", "must be a column, or two: of whole"),
        ([HEADER, *rows()], "columns: {/mag: {time: 5, field: [mx, my, mz]}}", "must be a column, or two: .*, not 5"),
        (["1 January", "no numbers here"], CONFIG, "no line of numbers in it"),
        ([HEADER, *rows(",", ",")], CONFIG, "commas separate columns and mark decimals, 4 names over 8 cells"),
    ],
)
def test_what_cannot_be_read_is_one_line(lines: list[str], config: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=message):
        magnetic(tmp_path / "x.csv", config)


def test_units_in_a_header_are_those_of_a_config_that_says_none(tmp_path: Path) -> None:
    header = "Time (s),Gyro x (°/s),Gyro y (°/s),Gyro z (°/s),ax (G),ay (G),az (G)"
    numbers = np.hstack([FIELD, FIELD])
    lines = [",".join([t, *map(str, row)]) for t, row in zip(T, numbers.tolist(), strict=True)]
    (tmp_path / "x.csv").write_bytes("\n".join([header, *lines]).encode("latin-1"))
    names = "gyro: [Gyro x (°/s), Gyro y (°/s), Gyro z (°/s)], accel: [ax (G), ay (G), az (G)]"
    recording = described(tmp_path / "x.csv", f"columns: {{/imu: {{time: Time (s), {names}}}}}")
    imu = recording.imu("/imu")
    np.testing.assert_allclose(imu.gyro, np.deg2rad(FIELD), rtol=1e-15)
    np.testing.assert_allclose(imu.accel, 9.80665 * FIELD, rtol=1e-15)
    assert any("gyro is in deg/s by its header" in note for note in recording.notes)


def test_seconds_and_nanoseconds_in_two_columns_are_one_time(tmp_path: Path) -> None:
    seconds, ns = np.divmod(1_790_000_000_995_000_000 + 20_000_000 * np.arange(N), 1_000_000_000)
    lines = [",".join(map(str, [seconds[i], ns[i], *FIELD[i].tolist()])) for i in range(N)]
    (tmp_path / "x.csv").write_text("\n".join(["header.stamp.sec,header.stamp.nanosec,mx,my,mz", *lines]))
    config = "columns: {/mag: {time: [header.stamp.sec, header.stamp.nanosec], field: [mx, my, mz]}}"
    found = described(tmp_path / "x.csv", config).magnetic("/mag")
    np.testing.assert_array_equal(found.t_ns, 1_000_000_000 * seconds + ns)


@pytest.mark.parametrize("key", ["yaw_pitch_roll", "rotation_vector"])
def test_attitudes_as_angles_or_as_rotation_vectors(key: str, tmp_path: Path) -> None:
    numbers = FIELD * [1.0, 0.5, 1.0]
    lines = [",".join([T[i], *(f"{x:.17g}" for x in numbers[i])]) for i in range(N)]
    (tmp_path / "x.csv").write_text("\n".join(["t,a,b,c", *lines]), encoding="utf-8")
    config = f"columns: {{/pose: {{time: t, {key}: [a, b, c], units: {{{key}: deg}}}}}}"
    wxyz = described(tmp_path / "x.csv", config).poses("/pose").wxyz
    radians = np.deg2rad(numbers)
    angles = Rotation.from_euler("ZYX", radians) if key == "yaw_pitch_roll" else Rotation.from_rotvec(radians)
    np.testing.assert_allclose(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), angles.as_matrix(), atol=1e-12)


def test_an_error_about_an_axis_that_is_not_measured_is_none(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("\n".join([HEADER, *rows()]), encoding="utf-8")
    config = "columns: {/los/error: {time: t, vector: [mx, null, mz], units: {vector: mrad}}}"
    found = described(tmp_path / "x.csv", config).vector("/los/error").vector
    np.testing.assert_allclose(found[:, [0, 2]], 1e-3 * FIELD[:, [0, 2]], rtol=1e-12)
    assert np.isnan(found[:, 1]).all()


def test_rows_of_one_device_of_two_and_axes_of_another_frame(tmp_path: Path) -> None:
    lines = [f"{row},{i % 2}" for i, row in enumerate(rows())]
    (tmp_path / "x.csv").write_text("\n".join([f"{HEADER},I", *lines]))
    base = "time: t, field: [mx, my, mz], axes: [y, -x, z]"
    found = magnetic(tmp_path / "x.csv", f"columns: {{/mag: {{{base}, where: {{I: 1}}}}}}")
    np.testing.assert_array_equal(found.field, FIELD[1::2][:, [1, 0, 2]] * [1.0, -1.0, 1.0])
    with pytest.raises(InputError, match="where: no row has I 3; its values: 0, 1"):
        magnetic(tmp_path / "x.csv", f"columns: {{/mag: {{{base}, where: {{I: 3}}}}}}")
    with pytest.raises(InputError, match="axes: each of x, y and z is needed once"):
        magnetic(tmp_path / "x.csv", "columns: {/mag: {time: t, field: [mx, my, mz], axes: [x, x, z]}}")


def test_an_accelerometer_alone_is_an_imu_without_a_gyro(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("\n".join([HEADER, *rows()]))
    imu = described(tmp_path / "x.csv", "columns: {/imu: {time: t, accel: [mx, my, mz]}}").imu("/imu")
    np.testing.assert_array_equal(imu.accel, FIELD)
    assert (imu.gyro_cov[:, 0, 0] == -1.0).all()


def test_last_rows_of_memory_that_was_never_written_are_left_out(tmp_path: Path) -> None:
    erased = ["4294967.295,65535,65535,65535"] * 20
    (tmp_path / "x.csv").write_text("\n".join([HEADER, *rows(), *erased]))
    recording = described(tmp_path / "x.csv")
    assert len(recording.magnetic("/mag")) == N
    assert any("the last 20 rows are all the same" in note for note in recording.notes)


@pytest.mark.parametrize("bits", [12, 16])
def test_signed_counts_written_as_unsigned_are_signed(bits: int, tmp_path: Path) -> None:
    t = np.arange(400)
    counts = np.rint(0.4 * 2**bits * np.stack([np.sin(0.05 * t + k) for k in range(3)], axis=1)).astype(int)
    lines = [f"{0.01 * i:.2f},{','.join(map(str, row))}" for i, row in zip(t, (counts % 2**bits).tolist(), strict=True)]
    (tmp_path / "x.csv").write_text("\n".join([HEADER, *lines]))
    recording = described(tmp_path / "x.csv", "columns: {/mag: {time: t, field: [mx, my, mz]}}")
    np.testing.assert_array_equal(recording.magnetic("/mag").field, counts)
    assert any(f"counts of a signed {bits} bit sensor" in note for note in recording.notes)
    # Counts about the middle of an unsigned range are what they are.
    lines = [
        f"{0.01 * i:.2f},{','.join(map(str, row))}"
        for i, row in zip(t, (counts + 2 ** (bits - 1)).tolist(), strict=True)
    ]
    (tmp_path / "y.csv").write_text("\n".join([HEADER, *lines]))
    again = magnetic(tmp_path / "y.csv", "columns: {/mag: {time: t, field: [mx, my, mz]}}")
    np.testing.assert_array_equal(again.field, counts + 2 ** (bits - 1))


def test_a_time_that_is_not_a_number_is_refused() -> None:
    with pytest.raises(InputError, match="a time that is no number in s: 'nan'"):
        nanoseconds(Path("s.tum"), np.array(["0.1", "nan", "0.3"]), "s")
