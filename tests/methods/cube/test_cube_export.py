"""Exported calibrations, applied to raw data as each program does; sheets of tags."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

import alidade
from alidade.factors import so3
from alidade.pipelines.applications.cli import app
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods.cube.printing import print_cube, tag_size
from alidade.pipelines.methods.cube.recording import CubeConfig
from alidade.pipelines.reports.calibration import SavedCalibration
from alidade.pipelines.reports.export_formats import MOUNT_FORMATS, TRIAD_FORMATS, export

RNG = np.random.default_rng(1)
BIAS = {"accel": 0.3, "gyro": 0.02, "mag": 2e-5}
NOMINAL = {"accel": 9.8, "gyro": 1.0, "mag": 5e-5}


def _calibration(
    K: dict[str, np.ndarray],
    b: dict[str, np.ndarray],
    method: str = "cube",
    noise: list[dict[str, object]] | None = None,
    unit: str = "1",
) -> SavedCalibration:
    numbers = {f"{n}_k{i + 1}{j + 1}": K[n][i, j] for n in K for i in range(3) for j in range(3)}
    numbers |= {f"{n}_b{i + 1}": b[n][i] for n in K for i in range(3)}
    return SavedCalibration.model_validate(
        {
            "schema": "alidade.calibration/1",
            "method": method,
            "solver": "batch",
            "status": "calibrated",
            "recording": {"file": "s.mcap", "sha256": "", "start": ""},
            "parameters": {
                name: {"value": float(v), "sigma": 1e-4, "unit": unit, "verdict": "observable"}
                for name, v in numbers.items()
            },
            "findings": {"noise": noise or []},
        }
    )


def _fits(K: dict[str, np.ndarray]) -> tuple[SavedCalibration, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """A calibration with these gains, raw data and the nominal values behind them."""
    b = {name: BIAS[name] * RNG.normal(size=3) for name in K}
    nominal = {name: NOMINAL[name] * RNG.normal(size=(20, 3)) for name in K}
    raw = {name: (nominal[name] - b[name]) @ np.linalg.inv(K[name]).T for name in K}
    return _calibration(K, b), raw, nominal


def _diagonal() -> dict[str, np.ndarray]:
    """What PX4 and ArduPilot can hold without loss."""
    S = RNG.normal(size=(3, 3)) * 0.03
    return {
        "accel": np.diag(1.0 + 0.03 * RNG.normal(size=3)),
        "gyro": np.eye(3),
        "mag": np.eye(3) + S + S.T,
    }


def _three(values: dict[str, float], name: str) -> np.ndarray:
    return np.array([values[name.format(axis)] for axis in "XYZ"])


def _symmetric(diagonal: np.ndarray, off: np.ndarray) -> np.ndarray:
    return np.array([[diagonal[0], off[0], off[1]], [off[0], diagonal[1], off[2]], [off[1], off[2], diagonal[2]]])


def test_px4() -> None:
    saved, raw, nominal = _fits(_diagonal())
    rows = [line.split("\t") for line in export(saved, "px4").splitlines() if not line.startswith("#")]
    values = {row[2]: float(row[3]) for row in rows}
    assert all(row[4] == "9" for row in rows)
    accel = _three(values, "CAL_ACC0_{}SCALE") * (raw["accel"] - _three(values, "CAL_ACC0_{}OFF"))
    gyro = raw["gyro"] - _three(values, "CAL_GYRO0_{}OFF")
    S = _symmetric(_three(values, "CAL_MAG0_{}SCALE"), _three(values, "CAL_MAG0_{}ODIAG"))
    gauss = (1e4 * raw["mag"] - _three(values, "CAL_MAG0_{}OFF")) @ S.T
    np.testing.assert_allclose(accel, nominal["accel"], atol=1e-6)
    np.testing.assert_allclose(gyro, nominal["gyro"], atol=1e-8)
    np.testing.assert_allclose(gauss, 1e4 * nominal["mag"], atol=1e-7)


def test_ardupilot() -> None:
    saved, raw, nominal = _fits(_diagonal())
    lines = [line.split(",") for line in export(saved, "ardupilot").splitlines() if not line.startswith("#")]
    values = {name: float(value) for name, value in lines}
    accel = _three(values, "INS_ACCSCAL_{}") * (raw["accel"] - _three(values, "INS_ACCOFFS_{}"))
    S = _symmetric(_three(values, "COMPASS_DIA_{}"), _three(values, "COMPASS_ODI_{}"))
    milligauss = values["COMPASS_SCALE"] * (1e7 * raw["mag"] + _three(values, "COMPASS_OFS_{}")) @ S.T
    np.testing.assert_allclose(accel, nominal["accel"], atol=1e-6)
    np.testing.assert_allclose(raw["gyro"] - _three(values, "INS_GYROFFS_{}"), nominal["gyro"], atol=1e-8)
    np.testing.assert_allclose(milligauss, 1e7 * nominal["mag"], atol=1e-4)


def test_ros2_holds_everything() -> None:
    full = {name: np.eye(3) + 0.05 * RNG.normal(size=(3, 3)) for name in ("accel", "gyro", "mag")}
    saved, raw, nominal = _fits(full)
    parameters = YAML(typ="safe", pure=True).load(export(saved, "ros2"))["/**"]["ros__parameters"]
    for name, entry in parameters.items():
        found = raw[name] @ np.reshape(entry["gain"], (3, 3)).T + entry["bias"]
        np.testing.assert_allclose(found, nominal[name], rtol=1e-9, atol=1e-12)


def test_kalibr_loads_and_holds_the_noise_measured() -> None:
    noise: list[dict[str, object]] = [
        {
            "sensor": name,
            "topic": "/imu",
            "rate_hz": 200.0,
            "density": [0.8 * density, density, 1.2 * density],
            "walk": walk,
            "walk_source": source,
        }
        for name, density, walk, source in (("accel", 2e-3, 3e-5, "upper bound"), ("gyro", 1e-4, 2e-6, "stated"))
    ]
    eye, zero = {"accel": np.eye(3), "gyro": np.eye(3)}, {"accel": np.zeros(3), "gyro": np.zeros(3)}
    text = export(_calibration(eye, zero, noise=noise), "kalibr")
    yaml = YAML(typ="safe", pure=True)
    yaml.version = (1, 1)  # as Kalibr's own loader: a number without a point would be a word
    values = yaml.load("%YAML 1.1\n---\n" + text)
    rms = np.sqrt(np.mean(np.square([0.8, 1.0, 1.2])))
    assert values == {
        "accelerometer_noise_density": pytest.approx(2e-3 * rms, rel=1e-4),
        "accelerometer_random_walk": 3e-5,
        "gyroscope_noise_density": pytest.approx(1e-4 * rms, rel=1e-4),
        "gyroscope_random_walk": 2e-6,
        "rostopic": "/imu",
        "update_rate": 200,
    }
    assert all(isinstance(v, int | float) for name, v in values.items() if name != "rostopic")
    assert "accelerometer_random_walk: 3.0000e-05 # m/s^2/s/sqrt(Hz), upper bound" in text
    with pytest.raises(InputError, match="does not hold the noise of accelerometer and gyro"):
        export(_calibration(eye, zero), "kalibr")


def test_openvins_holds_all_of_accelerometer_and_gyro() -> None:
    full = {name: np.eye(3) + 0.05 * RNG.normal(size=(3, 3)) for name in ("accel", "gyro")}
    saved, raw, nominal = _fits(full)
    row: dict[str, object] = {"topic": "/imu", "rate_hz": 200.0, "density": [1e-3] * 3, "walk": 1e-5, "walk_source": ""}
    saved.findings["noise"] = [{"sensor": name, **row} for name in full]
    text = export(saved, "openvins")
    assert text.startswith("%YAML:1.0\n")
    imu = YAML(typ="safe", pure=True).load(text.split("\n", 1)[1])["imu0"]
    assert imu["model"] == "kalibr"
    assert imu["gyroscope_noise_density"] == 1e-3
    for name, T, R in (("accel", "Ta", "R_IMUtoACC"), ("gyro", "Tw", "R_IMUtoGYRO")):
        D = np.linalg.inv(imu[T])
        # OpenVINS takes nothing above the diagonal.
        np.testing.assert_allclose(np.triu(D, 1), 0.0, atol=1e-11)
        b = -np.linalg.solve(full[name], nominal[name][0] - full[name] @ raw[name][0])
        applied = (raw[name] - b) @ (np.transpose(imu[R]) @ np.tril(D)).T
        np.testing.assert_allclose(applied, nominal[name], rtol=1e-9, atol=1e-10)
    np.testing.assert_array_equal(imu["Tg"], np.zeros((3, 3)))


def test_realsense_corrects_as_librealsense_and_its_script_do() -> None:
    """rs-imu-calibration fits rows [raw, -1] X; librealsense reads X as a float3x3 by columns and a bias."""
    full = {name: np.eye(3) + 0.05 * RNG.normal(size=(3, 3)) for name in ("accel", "gyro", "mag")}
    saved, raw, nominal = _fits(full)
    (imu,) = json.loads(export(saved, "realsense"))["imus"]
    for name, word in (("accel", "accelerometer"), ("gyro", "gyroscope")):
        X = np.reshape([*imu[word]["scale_and_alignment"], *imu[word]["bias"]], (4, 3))
        script = np.column_stack([raw[name], np.full(len(raw[name]), -1.0)]) @ X
        x, y, z = X[:3]  # float3x3: three columns, one after the other
        library = [x * r[0] + y * r[1] + z * r[2] - X[3] for r in raw[name]]
        np.testing.assert_allclose(script, nominal[name], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(library, nominal[name], rtol=1e-9, atol=1e-12)


def test_oak_holds_affine_maps_and_noise() -> None:
    full = {name: np.eye(3) + 0.05 * RNG.normal(size=(3, 3)) for name in ("accel", "gyro")}
    saved, raw, nominal = _fits(full)
    saved.findings["noise"] = [{"sensor": "gyro", "rate_hz": 200.0, "density": [1e-4, 2e-4, 3e-4], "walk": 2e-6}]
    found = json.loads(export(saved, "oak"))["imuCalibrationParams"]
    for name, word in (("accel", "accelerometer"), ("gyro", "gyroscope")):
        applied = np.column_stack([raw[name], np.ones(len(raw[name]))]) @ np.transpose(found[word])
        np.testing.assert_allclose(applied, nominal[name], rtol=1e-9, atol=1e-12)
    assert found["noise"]["gyroscope"]["y"] == {"noiseDensity": 2e-4, "randomWalk": 2e-6, "biasStability": 0.0}
    assert found["noise"]["accelerometer"]["z"] == {"noiseDensity": 0.0, "randomWalk": 0.0, "biasStability": 0.0}


@pytest.mark.parametrize("form", ["realsense", "oak"])
def test_cameras_take_an_imu_whatever_the_unit_of_a_magnetometer(form: str) -> None:
    saved, _, _ = _fits({"accel": np.eye(3), "mag": np.eye(3)})
    in_counts = saved.parameters["mag_k11"].model_copy(update={"unit": "T/count"})
    saved = saved.model_copy(update={"parameters": {**saved.parameters, "mag_k11": in_counts}})
    assert '"gyroscope"' in export(saved, form)
    with pytest.raises(InputError, match="holds neither its accelerometer nor its gyro"):
        export(_fits({"mag": np.eye(3)})[0], form)


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_counts_are_no_autopilots_units(form: str) -> None:
    counts = _calibration({"accel": 2e-3 * np.eye(3)}, {"accel": np.zeros(3)}, unit="m/s^2/count")
    with pytest.raises(InputError, match="accel was recorded in counts, and this format corrects SI"):
        export(counts, form)


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_what_is_lost_is_said(form: str) -> None:
    K = {name: np.eye(3) for name in ("accel", "gyro", "mag")}
    K["accel"] = K["accel"] + np.array([[0, 0.02, 0], [0, 0, 0], [0, 0, 0]])
    K["mag"] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    text = export(_fits(K)[0], form)
    assert "accelerometer: terms of K up to 0.02 have no place" in text
    assert "its mounting, 90.00 deg in all" in text


def test_ros2_has_the_covariance_of_a_sample() -> None:
    noise: list[dict[str, object]] = [{"sensor": "accel", "rate_hz": 100.0, "density": [1e-3, 2e-3, 3e-3]}]
    saved = _calibration(
        {"accel": np.eye(3), "gyro": np.eye(3)}, {n: np.zeros(3) for n in ("accel", "gyro")}, noise=noise
    )
    parameters = YAML(typ="safe", pure=True).load(export(saved, "ros2"))["/**"]["ros__parameters"]
    np.testing.assert_allclose(np.reshape(parameters["accel"]["covariance"], (3, 3)), np.diag([1e-4, 4e-4, 9e-4]))
    assert "covariance" not in parameters["gyro"]


def test_a_magnetometer_without_a_known_strength_keeps_its_scale() -> None:
    S = np.eye(3) + 0.1 * np.diag([1.0, -1.0, 0.5])
    S /= np.cbrt(np.linalg.det(S))
    offset = np.array([1e-5, -2e-5, 3e-5])
    saved = _calibration({"mag": 2.1e4 * S}, {"mag": -2.1e4 * S @ offset}, method="tumble", unit="1/T")
    text = export(saved, "ardupilot")
    values = {name: float(value) for name, value in (x.split(",") for x in text.splitlines() if x[0] != "#")}
    np.testing.assert_allclose(_three(values, "COMPASS_OFS_{}"), -1e7 * offset, rtol=1e-6)
    np.testing.assert_allclose(_three(values, "COMPASS_DIA_{}"), np.diag(S), rtol=1e-6)
    assert "its scale is as recorded" in text


def _in_counts(K: np.ndarray, offset: np.ndarray, unit: str) -> tuple[SavedCalibration, np.ndarray]:
    """A magnetometer of about 300 counts in the earth's field, and its readings of all directions."""
    u = RNG.normal(size=(50, 3))
    raw = u / np.linalg.norm(u, axis=1)[:, None] @ np.linalg.inv(K).T + offset
    return _calibration({"mag": K}, {"mag": -K @ offset}, method="tumble", unit=unit), raw


def test_betaflight_subtracts_counts() -> None:
    """magADC -= magZero, whole numbers, after the alignment: what is left is the soft iron."""
    offset = np.array([120.0, -333.0, 41.0])
    saved, raw = _in_counts(np.eye(3) / 300.0, offset + 0.3, "1/count")
    text = export(saved, "betaflight")
    assert "log with mag_calibration 0,0,0" in text
    command = text.splitlines()[-1]
    found = re.fullmatch(r"set mag_calibration = (-?\d+),(-?\d+),(-?\d+)", command)
    assert found
    corrected = raw - np.array([int(x) for x in found.groups()])
    # Whole counts: half a count along each axis.
    np.testing.assert_allclose(np.linalg.norm(corrected, axis=1), 300.0, atol=0.5 * 3**0.5)
    bent = _in_counts(np.diag([1.1, 1.0, 1.0 / 1.1]) / 300.0, offset, "1/count")[0]
    assert "terms of K up to 0.1 have no place" in export(bent, "betaflight")


@pytest.mark.parametrize(("unit", "strength", "length"), [("1/count", 1.0, 1024.0), ("T/count", 5e-5, 300.0)])
def test_inav_scales_counts(unit: str, strength: float, length: float) -> None:
    """(raw - magzero) 1024 / maggain: the field is 1024 where its strength is the unit, else about as recorded."""
    offset, gain = np.array([120.0, -333.0, 41.0]), np.array([1.08, 1.0, 1.0 / 1.08])
    saved, raw = _in_counts(np.diag(gain) / 300.0, offset, unit)
    saved = _calibration({"mag": strength * np.diag(gain) / 300.0}, {"mag": -strength * gain * offset / 300.0},
                         method="tumble", unit=unit)  # fmt: skip
    rows = dict(re.findall(r"set (mag\w+) = (-?\d+)", export(saved, "inav")))
    zero, scale = (np.array([int(rows[f"{name}_{axis}"]) for axis in "xyz"]) for name in ("magzero", "maggain"))
    corrected = (raw - zero) * 1024.0 / scale
    np.testing.assert_allclose(np.linalg.norm(corrected, axis=1), length, rtol=2e-3)
    assert np.ptp(np.linalg.norm(raw - zero, axis=1)) > 0.1 * 300.0


@pytest.mark.parametrize("form", ["betaflight", "inav"])
def test_flight_controllers_of_counts_refuse_tesla_and_what_does_not_fit(form: str) -> None:
    with pytest.raises(InputError, match="corrects a magnetometer in counts"):
        export(_fits({"mag": np.eye(3)})[0], form)
    with pytest.raises(InputError, match="has an offset of 40000 counts"):
        export(_in_counts(np.eye(3), np.array([4e4, 0.0, 0.0]), "1/count")[0], form)


def test_a_compass_on_other_axes_has_its_gains_along_its_own() -> None:
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([1.1, 1.0, 1.0]) / 300.0
    text = export(_in_counts(turned, np.zeros(3), "1/count")[0], "inav")
    assert "its mounting, 90.00 deg in all" in text
    assert "set maggain_x = 273\nset maggain_y = 300\nset maggain_z = 300\n" in text


def test_wrong_format_and_method() -> None:
    saved, _, _ = _fits(_diagonal())
    with pytest.raises(
        InputError, match="a calibration of cube has no format yaml; it has px4, ardupilot, betaflight, inav, ros2"
    ):
        export(saved, "yaml")
    with pytest.raises(InputError, match="this calibration of head holds nothing"):
        export(_calibration({}, {}, "head"), "px4")


def test_command_python_and_page_name_every_format() -> None:
    page = (Path(__file__).parents[3] / "docs" / "howto" / "export.md").read_text(encoding="utf-8")
    shown = CliRunner().invoke(app, ["export", "-h"], env={"COLUMNS": "200"}).output
    for form in (*TRIAD_FORMATS, *MOUNT_FORMATS):
        assert form in shown
        assert form in str(alidade.export.__doc__)
        assert f"\n| `{form}`" in page


def test_without_magnetometer_nothing_is_said_about_one() -> None:
    saved, _, _ = _fits({"accel": np.eye(3), "gyro": np.eye(3)})
    assert "MAG" not in export(saved, "px4")
    assert "COMPASS" not in export(saved, "ardupilot")


def test_printed_faces_are_true_to_scale(tmp_path: Path) -> None:
    print_cube(tmp_path / "cube.pdf", 0.12)
    data = (tmp_path / "cube.pdf").read_bytes()
    assert data.startswith(b"%PDF-1.4")
    assert data.count(b"/Type /Page ") == 6
    for i, at in enumerate(
        int(line[:10]) for line in data[data.rindex(b"xref\n0") :].splitlines()[3:] if line.endswith(b"n ")
    ):
        assert data[at:].startswith(f"{i + 1} 0 obj".encode())
    # Black cells of the first page, in m.
    page = data.split(b"stream\n")[1].split(b"\nf\n")[0].decode()
    cells = np.array([[float(x) for x in line.split()[:4]] for line in page.splitlines()]) * 0.0254 / 72.0
    low, high = cells[:, :2].min(axis=0), (cells[:, :2] + cells[:, 2:]).max(axis=0)
    np.testing.assert_allclose(high - low, tag_size(0.12), atol=1e-6)
    np.testing.assert_allclose(0.5 * (low + high), [0.105, 0.1485], atol=1e-6)


def test_the_config_of_a_printed_cube_is_of_one_glued_as_the_sheets_say(tmp_path: Path) -> None:
    print_cube(tmp_path / "cube.pdf", 0.1, 3)
    config = load_config((tmp_path / "cube.yaml").read_bytes())
    tags = config.section(CubeConfig).tags
    axes = {sign + name: float(f"{sign}1") * axis for name, axis in zip("xyz", np.eye(3), strict=True) for sign in "+-"}
    said = re.findall(rb"on side (\S\S), this way up towards side (\S\S)\)", (tmp_path / "cube.pdf").read_bytes())
    assert list(tags) == [3, 4, 5, 6, 7, 8]
    assert len({side for side, _ in said}) == 6
    for tag, (side, up) in zip(tags.values(), said, strict=True):
        assert tag.size == pytest.approx(tag_size(0.1))
        np.testing.assert_allclose(tag.position, 0.05 * axes[side.decode()], atol=1e-9)
        np.testing.assert_allclose(so3.matrix(tag.rotation)[:, 1], axes[up.decode()], atol=1e-8)
        np.testing.assert_allclose(so3.matrix(tag.rotation)[:, 2], axes[side.decode()], atol=1e-8)


@pytest.mark.parametrize(("edge", "first"), [(0.5, 16), (-1.0, 16), (0.1, 585)])
def test_faces_that_cannot_be_printed(tmp_path: Path, edge: float, first: int) -> None:
    with pytest.raises(InputError):
        print_cube(tmp_path / "cube.pdf", edge, first)
    assert not list(tmp_path.iterdir())
