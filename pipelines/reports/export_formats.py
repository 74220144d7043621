"""A calibration for the programs that apply it: static transforms, ROS 2 parameters, sensors of three axes.

Each is in the conventions of its program. Numbers of sensors are for the axes as recorded. Where a format has no place
for a part of K, a comment says how much is lost.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import dump_yaml, yaml_float
from alidade.pipelines.methods.triads import TRIADS, triad_of
from alidade.pipelines.reports.calibration import SavedCalibration, SavedTransform, as_saved
from alidade.pipelines.reports.result import Calibration

_SAID = "covariance of small rotations about the parent's axes, rad^2, by rows"
_PLACE = "only the rotation is calibrated: put the translation in"


def export(calibration: str | Path | Calibration | SavedCalibration, form: str) -> str:
    """The text of a calibration: px4, ardupilot, betaflight, inav, ros2, kalibr, openvins, realsense, oak; tf, urdf.

    Gain and offset of sensors of three axes, or mounting rotations as static transforms.

    Raises:
        InputError: the calibration cannot be used, or has no such format.
    """
    saved = as_saved(calibration)
    has_triad = any(f"{name}_k11" in saved.parameters for name in TRIADS)
    formats = {**(TRIAD_FORMATS if has_triad else {}), **(MOUNT_FORMATS if saved.transforms else {})}
    if not formats:
        raise InputError(f"this calibration of {saved.method} holds nothing that another program could be given")
    if form not in formats:
        raise InputError(f"a calibration of {saved.method} has no format {form}; it has {', '.join(formats)}")
    return formats[form](saved)


def _tf(saved: SavedCalibration) -> str:
    """Return a command of tf2_ros, static_transform_publisher, for each transform."""
    lines = [f"# {_PLACE}."]
    for name, each in saved.transforms.items():
        quaternion = " ".join(f"--q{axis} {value!r}" for axis, value in zip("wxyz", each.wxyz, strict=True))
        lines += [
            f"# {name}: {each.child} to {each.parent}; {_SAID}: {_row(each)}",
            f"ros2 run tf2_ros static_transform_publisher --x 0 --y 0 --z 0 {quaternion} "
            f"--frame-id {each.parent} --child-frame-id {each.child}",
        ]
    return "\n".join([*lines, ""])


def _urdf(saved: SavedCalibration) -> str:
    """Return a fixed URDF joint for each transform; rpy turns about fixed x, then y, then z."""
    lines = [f"<!-- {_PLACE}. -->"]
    for name, each in saved.transforms.items():
        angles = " ".join(f"{angle:.12g}" for angle in roll_pitch_yaw(each))
        lines += [
            f"<!-- {name}: {each.child} to {each.parent}; {_SAID}: {_row(each)} -->",
            f'<joint name="{each.parent}_to_{each.child}" type="fixed">',
            f'  <parent link="{each.parent}"/>',
            f'  <child link="{each.child}"/>',
            f'  <origin xyz="0 0 0" rpy="{angles}"/>',
            "</joint>",
        ]
    return "\n".join([*lines, ""])


def roll_pitch_yaw(transform: SavedTransform) -> tuple[float, float, float]:
    """Angles, rad, with R = Rz(yaw) Ry(pitch) Rx(roll), active; yaw is 0 where pitch is a right angle."""
    R = so3.matrix(np.array(transform.wxyz))
    level = float(np.hypot(R[0, 0], R[1, 0]))
    pitch = float(np.arctan2(-R[2, 0], level))
    if level < 1e-9:
        return float(np.arctan2(-R[1, 2], R[1, 1])), pitch, 0.0
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))


def _row(transform: SavedTransform) -> str:
    return " ".join(f"{x:.4g}" for x in transform.covariance)


MOUNT_FORMATS: Mapping[str, Callable[[SavedCalibration], str]] = {"tf": _tf, "urdf": _urdf}


def ros_parameters(saved: SavedCalibration, names: Collection[str]) -> str:
    """Return a ROS 2 parameter file of the values in formulas, SI, x, y, z as one list, and of the transforms."""
    content: dict[str, Any] = {"method": saved.method, "sha256": saved.recording.sha256}
    for name in names:
        stem, _, axis = name.rpartition("_")
        triple = [f"{stem}_{each}" for each in "xyz"]
        if axis in "xyz" and all(each in saved.parameters for each in triple):
            content.setdefault(stem, [saved.parameters[each].in_formulas if each in names else 0.0 for each in triple])
        else:
            content[name] = saved.parameters[name].in_formulas
    lines = ["/**:", "  ros__parameters:", "    alidade:"]
    lines += [f"      {name}: {_text(value)}" for name, value in content.items()]
    for name, each in saved.transforms.items():
        w, x, y, z = each.wxyz
        lines += [f"      {name}:", f"        frame_id: {each.parent}", f"        child_frame_id: {each.child}"]
        lines.append(f"        rotation_xyzw: {_text([x, y, z, w])}")
    return "\n".join([*lines, ""])


def _text(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    return yaml_float(value) if isinstance(value, float) else str(value)


_GAUSS, _MILLIGAUSS = 1e4, 1e7  # in a tesla
_AXES = "XYZ"


def _triads(saved: SavedCalibration, names: Collection[str] = TRIADS) -> dict[str, tuple[Array, Array]]:
    """Return K (3, 3) and b (3,) of the calibrated sensors among `names`: nominal = K raw + b."""
    return {name: triad_of(name, saved.values) for name in names if f"{name}_k11" in saved.parameters}


def _in_si(
    saved: SavedCalibration, names: Collection[str] = TRIADS
) -> tuple[dict[str, tuple[Array, Array]], list[str]]:
    """Return K and b of the calibrated sensors, which have to be recorded in SI, and notes about them.

    A magnetometer in T, calibrated in a field of unknown strength, keeps its scale on average: its K has the
    determinant 1. Raises InputError when a sensor is recorded in counts.
    """
    triads, notes = _triads(saved, names), []
    for name, (K, b) in triads.items():
        unit = saved.parameters[f"{name}_k11"].unit
        if unit == "1/T":
            scale = np.cbrt(abs(float(np.linalg.det(K))))
            triads[name] = K / scale, b / scale
            notes.append("magnetometer: calibrated without the field's strength, its scale is as recorded")
        elif unit != "1":
            recorded = "counts" if unit.endswith("/count") else f"a unit of its own ({unit})"
            raise InputError(
                f"{name} was recorded in {recorded}, and this format corrects SI units: calibrate readings that are "
                "converted, as the program has them, or export ros2"
            )
    return triads, notes


def zero_offset(K: Array, b: Array) -> Array:
    """Return the offset, the reading at nominal zero: nominal = K (raw - offset)."""
    return np.asarray(-np.linalg.solve(K, b))


def symmetric_part(K: Array) -> tuple[Array, float]:
    """Return S of the polar decomposition K = R S, S symmetric and R a rotation, and the angle of R, rad."""
    u, s, vt = np.linalg.svd(K)
    angle = float(np.arccos(np.clip(0.5 * (np.trace(u @ vt) - 1.0), -1.0, 1.0)))
    return (vt.T * s) @ vt, angle


@dataclass(frozen=True)
class _Autopilot:
    """Parameter names of an autopilot, {} for X, Y, Z: scale (raw - offset), raw - offset, symmetric (raw - offset).

    Attributes:
        accel, gyro, mag: of the accelerometer (offset, scale), the gyro (offset) and the magnetometer (offset, the
            matrix on its diagonal and off it: xy, xz, yz).
        mag_offset: the unit of the magnetometer's offset in a tesla, negative where it is added.
    """

    accel: tuple[str, str]
    gyro: str
    mag: tuple[str, str, str]
    mag_offset: float

    def parameters(self, saved: SavedCalibration) -> tuple[list[tuple[str, float]], list[str]]:
        """Return parameter names and values, and comments on what is lost. Raises InputError for sensors in counts."""
        rows: list[tuple[str, float]] = []
        triads, notes = _in_si(saved)
        if "accel" in triads:
            K, b = triads["accel"]
            rows += _xyz(self.accel[0], zero_offset(K, b)) + _xyz(self.accel[1], np.diag(K))
            notes.append(_lost("accelerometer", K - np.diag(np.diag(K))))
        if "gyro" in triads:
            K, b = triads["gyro"]
            rows += _xyz(self.gyro, zero_offset(K, b))
            notes.append(_lost("gyro", K - np.eye(3)))
        if "mag" in triads:
            K, b = triads["mag"]
            S, angle = symmetric_part(K)
            values = self.mag_offset * zero_offset(K, b), np.diag(S), S[[0, 0, 1], [1, 2, 2]]
            rows += [row for name, three in zip(self.mag, values, strict=True) for row in _xyz(name, three)]
            notes.append(_turned(angle))
        return rows, [f"# {note}" for note in notes]


_PX4 = _Autopilot(
    accel=("CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE"),
    gyro="CAL_GYRO0_{}OFF",
    mag=("CAL_MAG0_{}OFF", "CAL_MAG0_{}SCALE", "CAL_MAG0_{}ODIAG"),
    mag_offset=_GAUSS,
)
_ARDUPILOT = _Autopilot(
    accel=("INS_ACCOFFS_{}", "INS_ACCSCAL_{}"),
    gyro="INS_GYROFFS_{}",
    mag=("COMPASS_OFS_{}", "COMPASS_DIA_{}", "COMPASS_ODI_{}"),
    mag_offset=-_MILLIGAUSS,
)


def _px4(saved: SavedCalibration) -> str:
    """Return QGroundControl's parameter file: vehicle, component, name, value, type (9: float)."""
    rows, notes = _PX4.parameters(saved)
    lines = [f"1\t1\t{name}\t{value:.9g}\t9" for name, value in rows]
    return "\n".join(["# Calibrated by alidade; give CAL_*0_ID the ids of the sensors.", *notes, *lines, ""])


def _ardupilot(saved: SavedCalibration) -> str:
    """Return ArduPilot's parameter file, a line NAME,value for each parameter."""
    rows, notes = _ARDUPILOT.parameters(saved)
    if "mag_k11" in saved.parameters:
        rows.append(("COMPASS_SCALE", 1.0))
    return "\n".join([*notes, *(f"{name},{value:.9g}" for name, value in rows), ""])


def _betaflight(saved: SavedCalibration) -> str:
    """Return Betaflight's command: offset in counts, subtracted after mag_align (sensors/compass.c)."""
    S, offset, notes = _compass_in_counts(saved, "mag_calibration 0,0,0")
    lost = _lost("magnetometer", S / np.cbrt(np.linalg.det(S)) - np.eye(3))
    return "\n".join([f"# {lost}", *notes, f"set mag_calibration = {','.join(map(str, offset))}", ""])


def _inav(saved: SavedCalibration) -> str:
    """Return INAV's commands: (raw - magzero) 1024 / maggain per axis, then alignment (sensors/compass.c)."""
    S, offset, notes = _compass_in_counts(saved, "magzero 0, maggain 1024")
    diagonal = np.diag(S)
    size = float(np.cbrt(diagonal.prod()))
    # A field of the earth's strength becomes 1024, where K has its unit; else the mean gain is 1.
    gain = np.round((1.0 if _unit(saved) == "1/count" else 1024.0 * size) / diagonal).astype(int)
    lost = _lost("magnetometer", (S - np.diag(diagonal)) / size)
    rows = (("magzero", offset), ("maggain", gain))
    commands = [f"set {name}_{axis} = {n}" for name, three in rows for axis, n in zip("xyz", three, strict=True)]
    return "\n".join([f"# {lost}", *notes, *commands, ""])


def _compass_in_counts(saved: SavedCalibration, neutral: str) -> tuple[Array, NDArray[np.int64], list[str]]:
    """Return the symmetric part of the magnetometer's K, its offset in whole counts, and comments.

    Betaflight and INAV log a compass with its calibration applied, which is none with the settings `neutral`.

    Raises InputError when it was not recorded in counts, or the offset is beyond 16 bits.
    """
    if "mag_k11" not in saved.parameters or not _unit(saved).endswith("/count"):
        raise InputError("this format corrects a magnetometer in counts: calibrate what the flight controller logs")
    K, b = triad_of("mag", saved.values)
    offset = np.round(zero_offset(K, b)).astype(np.int64)
    if np.abs(offset).max() > np.iinfo(np.int16).max:
        raise InputError(f"mag has an offset of {np.abs(offset).max()} counts, and this format has 16 bits")
    S, angle = symmetric_part(K)
    return S, offset, [f"# {_turned(angle)}", f"# logs have the calibration of their time applied: log with {neutral}"]


def _unit(saved: SavedCalibration) -> str:
    return saved.parameters["mag_k11"].unit


def _ros2(saved: SavedCalibration) -> str:
    """Return a ROS 2 node's parameters: rows of K, and b, of each sensor, in the units of sensor_msgs.

    Where noise was measured, the covariance that its messages may state: of one sample, calibrated, by rows.
    """
    noise = _noise_rows(saved)
    parameters: dict[str, dict[str, list[float]]] = {}
    for name, (K, b) in _triads(saved).items():
        parameters[name] = {"gain": [float(x) for x in K.ravel()], "bias": [float(x) for x in b]}
        if name in noise and min(noise[name]["density"]) > 0.0:
            variance = noise[name]["rate_hz"] * np.square(noise[name]["density"])
            parameters[name]["covariance"] = [float(x) for x in np.diag(variance).ravel()]
    return (
        "# calibrated = gain raw + bias, gain a 3x3 matrix by rows; covariance, by rows, of one calibrated sample\n"
        + dump_yaml({"/**": {"ros__parameters": parameters}})
    )


def _noise_rows(saved: SavedCalibration) -> dict[str, Any]:
    """Rows of a calibration's table of measured noise, by the sensor's name, `accel` or `gyro`."""
    return {str(row.get("sensor")): row for row in saved.findings.get("noise", [])}


def _kalibr_noise(saved: SavedCalibration) -> str:
    """Kalibr's imu.yaml: noise of the calibrated sensors, one number for three axes.

    Raises InputError when the calibration does not hold the noise.
    """
    noise = _noise_rows(saved)
    if not all(min(noise.get(name, {}).get("density", [0.0])) > 0.0 for name in ("accel", "gyro")):
        raise InputError(
            "the calibration does not hold the noise of accelerometer and gyro: let the device rest longer"
        )
    lines = [
        "# Noise with K and b applied. Densities are measured at rest, root mean squares of the axes. Walks are not",
        "# measured: stated is what the calibration took; an upper bound adds up over the recording to the error of",
        "# the mean of one rest, and a larger one would have shown. Allan deviations over hours are more accurate.",
    ]
    for name, word, unit in (("accel", "accelerometer", "m/s^2"), ("gyro", "gyroscope", "rad/s")):
        row = noise[name]
        density = float(np.sqrt(np.mean(np.square(row["density"]))))
        # With a point in it, else YAML 1.1 takes it for a word.
        lines.append(f"{word}_noise_density: {density:.4e} # {unit}/sqrt(Hz), measured")
        lines.append(f"{word}_random_walk: {row['walk']:.4e} # {unit}/s/sqrt(Hz), {row['walk_source']}")
    gyro = noise["gyro"]
    return "\n".join([*lines, f"rostopic: {gyro['topic']}", f"update_rate: {gyro['rate_hz']:.6g}", ""])


def _openvins(saved: SavedCalibration) -> str:
    """OpenVINS's kalibr_imu_chain.yaml: noise, and K of accelerometer and gyro whole.

    It applies R_IMUtoACC' Ta^-1 (raw - bias) and R_IMUtoGYRO' Tw^-1 (raw - bias - Tg a), the inverses lower triangular;
    biases it finds by itself.

    Raises InputError when the calibration holds no noise, a sensor was recorded in counts, or its axes are left-handed.
    """
    noise, triads = _kalibr_noise(saved).splitlines(), _imu(saved)
    lines = ["%YAML:1.0", "", "imu0:", *_matrix("T_i_b", np.eye(4)), *(f"  {line}" for line in noise)]
    lines += ["  time_offset: 0.0", '  model: "kalibr"']
    for name, T, rotation, what in (
        ("gyro", "Tw", "R_IMUtoGYRO", "rad/s"),
        ("accel", "Ta", "R_IMUtoACC", "m/s^2"),
    ):
        K, b = triads[name]
        R, D = lower_triangular_part(K)
        if np.linalg.det(R) < 0.0:
            raise InputError(f"the axes of {name} are left-handed, and OpenVINS has no place for that")
        offset = ", ".join(f"{x:.6g}" for x in zero_offset(K, b))
        lines += [
            f"  # {name}: its bias was {offset} {what}; OpenVINS finds it anew",
            *_matrix(T, np.asarray(np.linalg.inv(D), dtype=float)),
        ]
        lines += _matrix(rotation, R.T)
    names = [f"gyro_g_{row}{column}" for row in "xyz" for column in "xyz"]
    held = [saved.parameters[name].value if name in saved.parameters else 0.0 for name in names]
    return "\n".join([*lines, *_matrix("Tg", np.reshape(held, (3, 3))), ""])


def _realsense(saved: SavedCalibration) -> str:
    """calibration.json as librealsense's rs-imu-calibration writes it: S raw - bias, SI, S by columns."""
    imu = {
        word: {"scale_and_alignment": K.T.ravel().tolist(), "bias": (-b).tolist()}
        for word, (K, b) in zip(_IMU.values(), _imu(saved).values(), strict=True)
    }
    return json.dumps({"device_type": "D435i", "imus": [imu]}, indent=4, sort_keys=True) + "\n"


def _oak(saved: SavedCalibration) -> str:
    """Part of the EEPROM of DepthAI's CalibrationHandler: affine maps (3, 4) of raw readings, and noise, SI.

    Noise that was not measured is 0, as in a camera that holds none.
    """
    noise = _noise_rows(saved)
    content: dict[str, Any] = {"noise": {"name": ""}}
    for (name, word), (K, b) in zip(_IMU.items(), _imu(saved).values(), strict=True):
        content[word] = np.column_stack([K, b]).tolist()
        row = {"density": [0.0] * 3, "walk": 0.0} | noise.get(name, {})
        content["noise"][word] = {
            axis: {"noiseDensity": density, "randomWalk": row["walk"], "biasStability": 0.0}
            for axis, density in zip("xyz", row["density"], strict=True)
        }
    return json.dumps({"imuCalibrationParams": content}, indent=1) + "\n"


_IMU = {"accel": "accelerometer", "gyro": "gyroscope"}


def _imu(saved: SavedCalibration) -> dict[str, tuple[Array, Array]]:
    """Return gains K (3, 3) and biases b (3,), SI, of accelerometer and gyro; 1 and 0 of one that is not calibrated.

    Raises InputError when neither is, or one was recorded in counts.
    """
    triads, _ = _in_si(saved, _IMU)
    if not triads:
        raise InputError(
            "this format corrects an IMU, and the calibration holds neither its accelerometer nor its gyro"
        )
    return {name: triads.get(name, (np.eye(3), np.zeros(3))) for name in _IMU}


def lower_triangular_part(K: Array) -> tuple[Array, Array]:
    """Return R, orthogonal, and D, lower triangular and positive on its diagonal, with K = R D."""
    q, r = np.linalg.qr(K[::-1, ::-1])
    signs = np.sign(np.diag(r))
    return (q * signs)[::-1, ::-1], (signs[:, None] * r)[::-1, ::-1]


def _matrix(name: str, rows: Array) -> list[str]:
    return [f"  {name}:", *(f"    - [{', '.join(f'{x:.12g}' for x in row)}]" for row in rows)]


TRIAD_FORMATS: Mapping[str, Callable[[SavedCalibration], str]] = {
    "px4": _px4,
    "ardupilot": _ardupilot,
    "betaflight": _betaflight,
    "inav": _inav,
    "ros2": _ros2,
    "kalibr": _kalibr_noise,
    "openvins": _openvins,
    "realsense": _realsense,
    "oak": _oak,
}


def _xyz(name: str, values: Array) -> list[tuple[str, float]]:
    return [(name.format(axis), float(value)) for axis, value in zip(_AXES, values, strict=True)]


def _lost(sensor: str, rest: Array) -> str:
    return f"{sensor}: terms of K up to {np.abs(rest).max():.2g} have no place in this format"


def _turned(angle: float) -> str:
    return f"magnetometer: its mounting, {np.rad2deg(angle):.2f} deg in all, has no place in this format"
