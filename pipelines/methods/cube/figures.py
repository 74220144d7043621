"""Figures of the cube method: errors before and after, vectors on their spheres; with its tables and the map."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.factors import so3
from alidade.factors.earth import earth_rate, gravity
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.display.figure import BEFORE, COLORS, FAINT, Figure, Plot, thin
from alidade.pipelines.display.table import Table
from alidade.pipelines.display.units import rounded
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.cube.compensation import calibrated, calibrated_rates
from alidade.pipelines.methods.cube.coverage import coverage
from alidade.pipelines.methods.cube.data import CubeData, local_field, nominal
from alidade.pipelines.methods.cube.poses import StaticPoses, static_poses, turn
from alidade.pipelines.methods.cube.tables import NAMES, cube_tables
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config

# Unit that people read an error in, and what to multiply its SI number by.
_ERRORS = {"accel": ("mg", 1e3 / 9.80665), "gyro": ("deg", np.rad2deg(1.0)), "mag": ("nT", 1e9)}


def cube_plots(data: CubeData, calibration: Calibration) -> list[Plot | Table]:
    """The method's own figures and tables; those that the recording has no data for are left out."""
    config = calibration.config
    estimate = calibration.estimate
    values = calibration.problem.numbers(estimate)
    poses = static_poses(data, config)
    found: list[Plot | Table | None] = [*cube_tables(calibration)]
    found += [_before_and_after(*rows) for rows in _errors(data, config, poses, calibration, values)]
    for name, strength in _strengths(data, values).items():
        found.append(_sphere(name, strength, data, config, poses, values))
    return [each for each in [*found, coverage(calibration)] if each is not None]


def _errors(
    data: CubeData, config: Config, poses: StaticPoses, calibration: Calibration, values: Mapping[str, float]
) -> list[tuple[str, Array, Array, Array]]:
    """Sensor, times (n,), and errors (n, 3), SI, before and after calibration, against the estimate's attitudes."""
    attitudes = calibration.estimate.attitudes
    if attitudes is None or not len(attitudes.time) or data.latitude is None:
        return []
    middle = poses.span.mean(axis=1)
    k = np.abs(middle[:, None] - attitudes.time).argmin(axis=0)
    bRn = so3.inverse(attitudes.wxyz)
    found = []
    vectors = {"accel": np.array([0.0, 0.0, float(gravity(data.latitude, data.height))])}
    if "mag_k11" in values:
        vectors["mag"] = _field(data, config, values)
    for name, vector in vectors.items():
        means = {"accel": poses.accel, "mag": poses.mag}[name]
        if f"{name}_k11" in values and means is not None:
            good = np.isfinite(means[k]).all(axis=1)
            expected, raw = so3.rotate(bRn[good], vector), means[k][good]
            celsius = None if poses.celsius is None else poses.celsius[k][good]
            compensated = calibrated(name, raw, config, values, celsius=celsius)
            found.append((name, middle[k][good], raw - expected, compensated - expected))
    if "gyro_k11" in values and len(k) > 1:
        found.insert(1, ("gyro", *_turns(data, config, poses.span[k], attitudes.wxyz, values)))
    return found


def _field(data: CubeData, config: Config, values: Mapping[str, float]) -> Array:
    names = ("field_e", "field_n", "field_u")
    return np.array([values[n] for n in names]) if names[0] in values else local_field(data, config)


def _turns(
    data: CubeData, config: Config, span: Array, nRb: Array, values: Mapping[str, float]
) -> tuple[Array, Array, Array]:
    """Ends of the turns, and errors (n, 3), rad, of the gyro's rotation over each, before and after calibration."""
    assert data.latitude is not None
    rates = nominal(data.gyro, config.section(CubeConfig).raw.gyro), calibrated_rates(data, config, values)
    time: list[float] = []
    before: list[Array] = []
    after: list[Array] = []
    for i in range(1, len(span)):
        samples = turn(data, span[i - 1, 1], span[i, 0])
        t = data.imu_t[samples]
        earth = so3.exp(earth_rate(data.latitude) * (t[-1] - t[0]))
        expected = so3.compose(so3.inverse(nRb[i - 1]), earth, nRb[i])
        for errors, rate in zip((before, after), rates, strict=True):
            turned = GyroPath(t, rate[samples]).attitude(t[-1:])[0]
            errors.append(so3.log(so3.multiply(so3.inverse(expected), turned)))
        time.append(span[i, 0])
    return np.array(time), np.array(before), np.array(after)


def _before_and_after(name: str, time: Array, before: Array, after: Array) -> Plot:
    unit, factor = _ERRORS[name]
    lengths = [factor * np.linalg.norm(errors, axis=1) for errors in (before, after)]
    out = Figure(f"error, {unit}", y_scale="log")
    for words, length, color in zip(("uncalibrated", "calibrated"), lengths, (BEFORE, COLORS[0]), strict=True):
        out.points(time, np.maximum(length, 1e-12), words, color, 7)
    rms = [float(np.sqrt((length**2).mean())) for length in lengths]
    what = "Rotation over each turn, against the attitudes found" if name == "gyro" else "Mean of each static pose"
    against = "" if name == "gyro" else " against what it should say at the attitude found"
    return Plot(
        f"{NAMES[name].capitalize()} before and after",
        f"{what}{against}: {rounded(rms[0], 3)} {unit} RMS as recorded, {rounded(rms[1], 3)} {unit} calibrated.",
        out,
    )


def _strengths(data: CubeData, values: Mapping[str, float]) -> dict[str, float]:
    """Sensor -> the strength that its vectors have at rest, SI."""
    found = {}
    if data.latitude is not None and "accel_k11" in values:
        found["accel"] = float(gravity(data.latitude, data.height))
    if "mag_k11" in values and "field_e" in values:
        found["mag"] = float(np.linalg.norm([values[f"field_{axis}"] for axis in "enu"]))
    return found


def _sphere(
    name: str, strength: float, data: CubeData, config: Config, poses: StaticPoses, values: Mapping[str, float]
) -> Plot | None:
    """Vectors at rest on their sphere, seen along two axes, and how far from it they are."""
    means = poses.accel if name == "accel" else poses.mag
    assert means is not None
    good = np.isfinite(means).all(axis=1)
    celsius = None if poses.celsius is None else poses.celsius[good]
    compensated = calibrated(name, means[good], config, values, celsius=celsius)
    vectors = [v / strength for v in (means[good], compensated)]
    angle = np.linspace(0.0, 2.0 * np.pi, 91)
    views = []
    for i, j in ((0, 1), (0, 2)):
        view = Figure("xyz"[j], "xyz"[i], 400, 0.5, square=True)
        view.line(np.cos(angle), np.sin(angle), color=FAINT)
        if name == "mag" and data.mag is not None:
            moving = calibrated(name, nominal(data.mag, config.section(CubeConfig).raw.mag), config, values) / strength
            some = moving[thin(3 * len(moving))]
            view.points(some[:, i], some[:, j], "calibrated, all samples", "series5", 3)
        _add_both(view, [v[:, i] for v in vectors], [v[:, j] for v in vectors])
        views.append(view)
    time = poses.span[good].mean(axis=1)
    misses = [100.0 * (np.linalg.norm(v, axis=1) - 1.0) for v in vectors]
    lengths = Figure("length, % off", height=240)
    _add_both(lengths, [time, time], misses)
    lengths.levels(0.0, FAINT, "solid")
    rms = [float(np.sqrt((miss**2).mean())) for miss in misses]
    return Plot(
        f"Sphere of the {NAMES[name]}",
        f"Means of the static poses over the strength they should have, seen along z and along y, and below how far "
        f"their lengths are off: {rounded(rms[0])} % RMS as recorded, {rounded(rms[1])} % calibrated.",
        views[0],
        (views[1], lengths),
    )


def _add_both(out: Figure, x: list[Array], y: list[Array]) -> None:
    """Uncalibrated as rings, calibrated as dots."""
    out.points(x[0], y[0], "uncalibrated", BEFORE, 8, shape="ring")
    out.points(x[1], y[1], "calibrated", COLORS[0], 5)
