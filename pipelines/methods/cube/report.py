"""Results of the cube method: formulas, tables, figures, uses, validation.

Frames: b cube's body, B reference, C camera, n level. Methods page, section 4.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import earth_rate, gravity
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.diagnostics.use import Truth, Use
from alidade.pipelines.display.figure import BEFORE, COLORS, GRID, Figure, Plot, thin
from alidade.pipelines.display.sphere_map import described, sphere_map, widest_gap
from alidade.pipelines.display.table import Table
from alidade.pipelines.display.units import rounded
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import SENSOR_NAMES
from alidade.pipelines.estimation.problem import Estimate, Findings
from alidade.pipelines.methods import Report, temperature
from alidade.pipelines.methods.cube.model import noises
from alidade.pipelines.methods.cube.parameters import CUBE, SENSITIVITY, SQUARE, TEMPERATURE, TILT
from alidade.pipelines.methods.cube.recording import (
    CubeConfig,
    CubeData,
    RawConversion,
    local_field,
    nominal,
    recorded,
    stated_density,
)
from alidade.pipelines.methods.cube.static_poses import StaticPoses, static_poses
from alidade.pipelines.methods.formula import Formula, apply, matrix_text, temperature_text, vector_text
from alidade.pipelines.methods.place import FIELD
from alidade.pipelines.methods.temperature import FIRST
from alidade.pipelines.methods.triads import (
    CORRECTIONS,
    RESULTS,
    TRIADS,
    along,
    parts_row,
    parts_with_sigmas,
    raw_of,
    triad_formula,
    triad_names,
    triad_uses,
)
from alidade.pipelines.recording.topics import IMU, MAG
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config


def formulas(parameters: Collection[str], config: Config) -> list[Formula]:
    """Sensors, mounts and tags that are among the parameters; raw numbers are as recorded.

    The accelerometer's nonlinearity, the gyro's g-sensitivity and the slopes over temperature are in nominal units.
    """
    raw = config.section(CubeConfig).raw
    found: list[Formula] = []
    if "accel_k11" in parameters:
        found += _accelerometer(parameters, raw.accel)
    if "gyro_k11" in parameters:
        found.append(_gyro(parameters, raw.gyro))
    if "mag_k11" in parameters:
        found.append(triad_formula("mag", parameters, "mag", ("mag",)))
    if "camera_mount_x" in parameters:
        found.append(
            Formula(
                "camera to reference, camera_rotation as the config gives it",
                "BRC",
                "camera_rotation * Exp(camera_mount)",
                ("camera_rotation",),
            )
        )
    tags = sorted(int(name[4:-2]) for name in parameters if name.startswith("tag_") and name.endswith("_x"))
    found += [
        Formula(
            f"tag {tag} to cube, rotation_{tag} as the config gives it",
            f"bodyRtag_{tag}",
            f"rotation_{tag} * Exp(tag_{tag})",
            (f"rotation_{tag}",),
        )
        for tag in tags
    ]
    if "reference_heading" in parameters:
        found.append(
            Formula(
                "reference to level, from its own attitude nRB_said in East-North-Up",
                "nRB",
                f"Exp({vector_text((*TILT.names, 'reference_heading'), parameters)}) * nRB_said",
                ("nRB_said",),
            )
        )
    if "camera_mount_x" in parameters and "reference_heading" in parameters:
        found.append(
            Formula(
                "attitude of the cube from a tag seen at CRT that stands on it at bodyRtag",
                "nRb",
                "nRB * BRC * CRT * inverse(bodyRtag)",
                ("camera_rotation", "nRB_said", "CRT", "bodyRtag"),
            )
        )
    return found


def stated(config: Config) -> dict[str, Array]:
    """Stated camera mount and tag rotations, by their names in the formulas."""
    cube = config.section(CubeConfig)
    tags = {f"rotation_{tag}": np.array(each.rotation) for tag, each in cube.tags.items()}
    return tags if cube.camera_rotation is None else {**tags, "camera_rotation": np.array(cube.camera_rotation)}


def _accelerometer(parameters: Collection[str], conversion: RawConversion | None) -> list[Formula]:
    """Formulas of the specific force, corrected for those nonlinearities and drifts that are parameters."""
    drift = _drift("accel", parameters)
    inputs = ("accel", *(["temperature"] if drift else []))
    if not any(name in parameters for each in (SQUARE, CUBE) for name in each.names):
        return [triad_formula("accel", parameters, _reduced("accel", [drift], conversion), inputs)]
    square, cube = (vector_text(each.names, parameters) for each in (SQUARE, CUBE))
    reading = "accel" if conversion is None else f"(accel - {conversion.offset!r}) * {conversion.scale!r}"
    settled = f"(accel_u - {drift})" if drift else "accel_u"
    back = settled if conversion is None else f"({settled} / {conversion.scale!r} + {conversion.offset!r})"

    def linear(at: str) -> str:
        return f"{reading} - {square} * {at}**2 - {cube} * {at}**3"

    description = "accelerometer without its curvature, m/s^2, axis by axis"
    first = reading if conversion is None else f"({reading})"
    return [
        Formula(f"{description}, nearly", "accel_near", linear(first), ("accel",)),
        Formula(description, "accel_u", linear("accel_near"), ("accel",)),
        triad_formula("accel", parameters, back, inputs),
    ]


def _gyro(parameters: Collection[str], conversion: RawConversion | None) -> Formula:
    """Formula of the rate, corrected for g-sensitivity and drift where these are parameters."""
    feels = any(name in parameters for name in SENSITIVITY.names)
    felt = f"{matrix_text([SENSITIVITY.names[i : i + 3] for i in (0, 3, 6)], parameters)} * f_b" if feels else ""
    drift = _drift("gyro", parameters)
    inputs = "gyro", *(["accel"] if feels else []), *(["temperature"] if drift else [])
    return triad_formula("gyro", parameters, _reduced("gyro", [felt, drift], conversion), inputs)


def _drift(sensor: str, parameters: Collection[str]) -> str:
    """Expression of a sensor's bias drift with temperature, nominal units; empty without slope parameters."""
    names = TEMPERATURE[sensor].names
    return temperature_text(names, parameters) if any(name in parameters for name in names) else ""


def _reduced(reading: str, errors: Sequence[str], conversion: RawConversion | None) -> str:
    """Expression of a reading minus errors in nominal units."""
    scale = "" if conversion is None else f" / {conversion.scale!r}"
    each = [f" - {error}{scale}" for error in errors if error]
    return f"({reading}{''.join(each)})" if each else reading


# White noise is estimated from means over this much time, s: shorter ones are what the device's own filter leaves.
_BLOCK = 0.25
_UNITS = {"accel": "m/s^2/sqrt(Hz)", "gyro": "rad/s/sqrt(Hz)", "mag": "T/sqrt(Hz)"}


def findings(data: CubeData, config: Config, estimate: Estimate) -> Findings:
    """Rows of `triads`, `noise`, `static_poses` and `disturbed_poses`, SI, for the triads that the estimate knows.

    triads: scale of each axis against the nominal one; nonorthogonality, rad, of x and y, x and z, y and z, positive
    where they are closer than a right angle; mounting, rad, the rotation vector that turns the body's axes into the
    sensor's; each with its sigmas. None for a K that is no sensor's: singular, or left-handed.
    noise: white noise density of each axis with K applied, measured over the static poses, beside the one that the
    solution took; walk of the bias per sqrt(s), stated or an upper bound.
    static_poses: beginning and end, s, the direction of up in the body, and the kinds of measurement that were used.
    disturbed_poses: those whose magnetometer was left out: number, beginning and end, s, and by what vector, T in n,
    and how much the field was off there.
    """
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    values |= temperature.constants(temperature.reference(data.temperature))
    poses = static_poses(data, config)
    known = [name for name in TRIADS if f"{name}_k11" in values]
    return {
        "triads": [row for name in known if (row := _triad(name, config, estimate)) is not None],
        "noise": [_noise(name, data, config, poses, values) for name in known],
        "static_poses": _poses(poses, config, estimate, values),
        "disturbed_poses": _disturbed(data, poses, config, estimate, values),
    }


def _triad(name: str, config: Config, estimate: Estimate) -> dict[str, object] | None:
    rows = [estimate.names.index(entry) for entry in triad_names(name)[:9]]
    conversion = getattr(config.section(CubeConfig).raw, name)
    unit = 1.0 if conversion is None else conversion.scale
    K, covariance = estimate.values[rows].reshape(3, 3) / unit, estimate.covariance[np.ix_(rows, rows)] / unit**2
    parts = parts_with_sigmas(K, covariance)
    return None if parts is None else parts_row(name, *parts)


def _disturbed(
    data: CubeData, poses: StaticPoses, config: Config, estimate: Estimate, values: Mapping[str, float]
) -> list[dict[str, object]]:
    """Findings rows of poses with a rejected magnetometer, near iron or a current."""
    residuals, attitudes = estimate.residuals.get("magnetometer"), estimate.attitudes
    if residuals is None or attitudes is None or poses.mag is None or "mag_k11" not in values:
        return []
    middle = poses.span.mean(axis=1)
    field, rows = _field(data, config, values), []
    for time in residuals.time[~residuals.used]:
        k = int(np.argmin(np.abs(middle - time)))
        nRb = attitudes.wxyz[int(np.argmin(np.abs(attitudes.time - time)))]
        off = so3.rotate(nRb, calibrated("mag", poses.mag[k : k + 1], config, values)[0]) - field
        rows.append(
            {
                "pose": k + 1,
                "start_s": float(poses.span[k, 0]),
                "end_s": float(poses.span[k, 1]),
                "off": off.tolist(),
                "size": float(np.linalg.norm(off)),
            }
        )
    return rows


def _noise(
    name: str, data: CubeData, config: Config, poses: StaticPoses, values: Mapping[str, float]
) -> dict[str, object]:
    t, samples = {
        "accel": (data.imu_t, data.accel),
        "gyro": (data.imu_t, data.gyro),
        "mag": (data.mag_t, data.mag),
    }[name]
    assert t is not None
    assert samples is not None
    vectors = calibrated(name, nominal(samples, getattr(config.section(CubeConfig).raw, name)), config, values)
    rate = 1.0 / float(np.median(np.diff(t)))
    density = white_noise(t, vectors, poses.span, rate)
    row: dict[str, object] = {
        "sensor": name,
        "topic": config.topic(MAG if name == "mag" else IMU),
        "rate_hz": float(f"{rate:.6g}"),
        "unit": _UNITS[name],
        "density": density.tolist(),
        "stated": stated_density(f"{name}_density", data, config).stated,
    }
    taken = noises(data, config)["gyro_bias_walk"].used if name == "gyro" else 0.0
    # One that adds up to more over the recording than the mean of one rest is good to would have shown.
    length = float(poses.span[-1, 1] - poses.span[0, 0])
    bound = float(np.mean(density) / np.sqrt(np.median(poses.duration) * length))
    return row | ({"walk": taken, "walk_source": "stated"} if taken else {"walk": bound, "walk_source": "upper bound"})


def white_noise(t: Array, vectors: Array, spans: Array, rate: float) -> Array:
    """Density (3,), unit/sqrt(Hz), of the white noise of vectors (n, 3) at t (n,) s within the spans (P, 2) s.

    From the overlapping Allan variance over a quarter of a second (IEEE 1139): half the mean square of the differences
    of means that follow each other, times that time. Zero where no span is as long as two of them.
    """
    size = max(1, round(_BLOCK * rate))
    squares = []
    for first, last in np.searchsorted(t, spans):
        sums = np.cumsum(vectors[first:last] - vectors[first], axis=0)
        squares.append((sums[2 * size :] - 2.0 * sums[size:-size] + sums[: -2 * size]) ** 2)
    gathered = np.concatenate(squares)
    return np.asarray(np.sqrt(0.5 * gathered.mean(axis=0) / (size * rate))) if len(gathered) else np.zeros(3)


def _poses(
    poses: StaticPoses, config: Config, estimate: Estimate, values: Mapping[str, float]
) -> list[dict[str, object]]:
    up = (
        calibrated("accel", poses.accel, config, values, celsius=poses.celsius)
        if "accel_k11" in values
        else poses.accel
    )
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    used = {family: r.time[r.used] for family, r in estimate.residuals.items()}
    return [
        {
            "start_s": float(start),
            "end_s": float(end),
            "up": np.round(direction, 4).tolist(),
            "used": [family for family, time in used.items() if ((start <= time) & (time <= end)).any()],
        }
        for (start, end), direction in zip(poses.span, up, strict=True)
    ]


# Unit that people read an error in, and what to multiply its SI number by.
_ERRORS = {"accel": ("mg", 1e3 / 9.80665), "gyro": ("deg", np.rad2deg(1.0)), "mag": ("nT", 1e9)}


def cube_plots(data: CubeData, calibration: Calibration) -> list[Plot | Table]:
    """Figures and tables of the method for which the recording has data."""
    config = calibration.config
    estimate = calibration.estimate
    values = calibration.problem.numbers(estimate)
    poses = static_poses(data, config)
    tables = _noise_table(calibration), _static_poses(calibration), _disturbed_table(calibration)
    found: list[Plot | Table | None] = [table for table in tables if table.rows]
    found += [_before_and_after(*rows) for rows in _errors(data, config, poses, calibration, values)]
    for name, strength in _strengths(data, values).items():
        found.append(_sphere(name, strength, data, config, poses, values))
    return [each for each in [*found, coverage(calibration)] if each is not None]


def _errors(
    data: CubeData, config: Config, poses: StaticPoses, calibration: Calibration, values: Mapping[str, float]
) -> list[tuple[str, Array, Array, Array]]:
    """Errors (n, 3), SI, before and after calibration by sensor, at times (n,), s, against the estimated attitudes."""
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
        between = np.stack([poses.span[k[:-1], 1], poses.span[k[1:], 0]], axis=1)
        earth = so3.exp(np.diff(between) * earth_rate(data.latitude))
        expected = so3.compose(bRn[:-1], earth, attitudes.wxyz[1:])
        found.insert(1, ("gyro", between[:, 1], *_turn_errors(data, config, values, between, expected)))
    return found


def _field(data: CubeData, config: Config, values: Mapping[str, float]) -> Array:
    names = FIELD.names
    return np.array([values[name] for name in names]) if names[0] in values else local_field(data, config)


def _turn_errors(
    data: CubeData, config: Config, values: Mapping[str, float], span: Array, expected: Array
) -> tuple[Array, Array]:
    """Errors (n, 3), rad, of the gyro's rotations between consecutive rests, before and after calibration.

    Args:
        data, config, values: as of `calibrated_rates`.
        span: (n, 2) s, end of the rest before and beginning of the one after.
        expected: (n, 4) rotations.
    """
    rates = nominal(data.gyro, config.section(CubeConfig).raw.gyro), calibrated_rates(data, config, values)
    turned = (GyroPath(data.imu_t, rate).increments(*span.T).wxyz for rate in rates)
    before, after = (so3.local(expected, each) for each in turned)
    return before, after


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
        f"{SENSOR_NAMES[name].capitalize()} before and after",
        f"{what}{against}: {rounded(rms[0], 3)} {unit} RMS as recorded, {rounded(rms[1], 3)} {unit} calibrated.",
        out,
    )


def _strengths(data: CubeData, values: Mapping[str, float]) -> dict[str, float]:
    """Strength of the vector that each sensor measures at rest, SI."""
    found = {}
    if data.latitude is not None and "accel_k11" in values:
        found["accel"] = float(gravity(data.latitude, data.height))
    if "mag_k11" in values and "field_e" in values:
        found["mag"] = float(np.linalg.norm([values[f"field_{axis}"] for axis in "enu"]))
    return found


def _sphere(
    name: str, strength: float, data: CubeData, config: Config, poses: StaticPoses, values: Mapping[str, float]
) -> Plot | None:
    """Plot vectors at rest along two axes, on their sphere, with their distance from it."""
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
        view.line(np.cos(angle), np.sin(angle), color=GRID)
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
    lengths.levels(0.0, GRID, "solid")
    rms = [float(np.sqrt((miss**2).mean())) for miss in misses]
    return Plot(
        f"Sphere of the {SENSOR_NAMES[name]}",
        f"Means of the static poses over the strength they should have, seen along z and along y, and below how far "
        f"their lengths are off: {rounded(rms[0])} % RMS as recorded, {rounded(rms[1])} % calibrated.",
        views[0],
        (views[1], lengths),
    )


def _add_both(out: Figure, x: list[Array], y: list[Array]) -> None:
    """Add uncalibrated points as rings and calibrated ones as dots to a figure."""
    out.points(x[0], y[0], "uncalibrated", BEFORE, 8, shape="ring")
    out.points(x[1], y[1], "calibrated", COLORS[0], 5)


def validate(data: CubeData, config: Config, values: Mapping[str, float]) -> list[Validation]:
    """Errors without and with a calibration, at the static poses and over the turns between them.

    Without calibration the sensors are nominal: as recorded, or converted as the config's `raw` says.

    Raises InputError when there is no static pose, or the place on the earth is unknown.
    """
    if data.latitude is None:
        raise InputError("the place on the earth is unknown: record /reference/fix, or give latitude_deg in the config")
    poses = static_poses(data, config)
    time = poses.span.mean(axis=1)
    strength = {"accel": float(gravity(data.latitude, data.height))}
    means = {"accel": poses.accel}
    if poses.mag is not None and data.longitude is not None:
        strength["mag"], means["mag"] = float(np.linalg.norm(local_field(data, config))), poses.mag
    found = []
    for name, unit, what in (("accel", "m/s^2", "specific force"), ("mag", "T", "magnetic field")):
        if name in means and f"{name}_k11" in values:
            good = np.isfinite(means[name]).all(axis=1)
            errors = [
                np.linalg.norm(vectors[good], axis=1)[:, None] - strength[name]
                for vectors in (means[name], calibrated(name, means[name], config, values, celsius=poses.celsius))
            ]
            found.append(Validation(f"{what} at rest, its strength", unit, time[good], *errors))
    if "gyro_k11" in values and sum(tags is not None for tags in poses.tags) > 1:
        found.append(_turn_validation(data, config, poses, values))
    return found


def _turn_validation(data: CubeData, config: Config, poses: StaticPoses, values: Mapping[str, float]) -> Validation:
    """Compare gyro rotations with those between consecutive poses seen by the camera.

    The camera is taken to stand still; the earth's own turning, 0.1 mrad in two seconds, is not taken off.
    """
    pairs = [
        (poses.span[k, 1], poses.span[k + 1, 0], so3.multiply(so3.inverse(before.pose.cRb), after.pose.cRb))
        for k, (before, after) in enumerate(itertools.pairwise(poses.tags))
        if before is not None and after is not None
    ]
    between, seen = np.array([pair[:2] for pair in pairs]).reshape(-1, 2), np.array([pair[2] for pair in pairs])
    errors = _turn_errors(data, config, values, between, seen.reshape(-1, 4))
    return Validation("turns by the gyro, against the camera", "rad", between[:, 1], *errors)


def calibrated(
    name: str,
    vectors: Array,
    config: Config,
    values: Mapping[str, float],
    celsius: Array | None = None,
    accel: Array | None = None,
) -> Array:
    """Calibrated readings (n, 3) of a sensor along the cube's axes, SI.

    Args:
        vectors: its readings, in nominal units as `accel`.
        values: parameters by name; those that are not among them are 0.
        celsius: (n,) temperatures, degrees Celsius; None: slopes over temperature are not applied.
        accel: (n, 3) readings of the accelerometer; None: a gyro's g-sensitivity is not applied.
    """
    nominals = {name: vectors} if accel is None else {name: vectors, "accel": accel}
    inputs = {each: recorded(given, getattr(config.section(CubeConfig).raw, each)) for each, given in nominals.items()}
    unknown: set[str] = set() if "accel" in inputs else set(SENSITIVITY.names)
    if celsius is None or FIRST not in values:
        unknown |= {each for slope in TEMPERATURE.values() for each in slope.names}
    else:
        inputs["temperature"] = celsius
    known = {each: value for each, value in values.items() if each not in unknown}
    usable = [formula for formula in formulas(known, config) if formula.inputs and inputs.keys() >= {*formula.inputs}]
    used = {each for formula in usable for each in formula.inputs}
    return apply(usable, known, {each: inputs[each] for each in used})[RESULTS[name]]


def calibrated_rates(data: CubeData, config: Config, values: Mapping[str, float]) -> Array:
    """Calibrated rates of all gyro samples, (N, 3) rad/s in b."""
    raw = config.section(CubeConfig).raw
    celsius = None if data.temperature is None else data.temperature.above(0.0, data.imu_t)
    accel = nominal(data.accel, raw.accel) if "accel_k11" in values else None
    return calibrated("gyro", nominal(data.gyro, raw.gyro), config, values, celsius, accel)


def coverage(calibration: Calibration) -> Plot | None:
    """Plot the directions of up in the body on an equal-area map of the sphere, with the gaps between."""
    up = np.array([row["up"] for row in rows_of(calibration, "static_poses")])
    if not len(up):
        return None
    gap, where = widest_gap(up)
    names = [f"pose {k + 1}: {described(direction)}" for k, direction in enumerate(up)]
    return Plot(
        "Attitudes covered",
        f"Which direction of the body was up in each of the {len(up)} static poses, on an equal-area map of all "
        f"directions. The middle of the widest gap is {np.rad2deg(gap):.0f} deg from every pose, "
        f"at {described(where)}.",
        sphere_map(up, names, "pose"),
    )


_NOISE = {"accel": ("µg/√Hz", 1e6 / 9.80665), "gyro": ("deg/√h", np.rad2deg(60.0)), "mag": ("nT/√Hz", 1e9)}


def rows_of(calibration: Calibration, name: str) -> Sequence[Mapping[str, Any]]:
    """Rows of a table of findings; none if there is no such table."""
    return calibration.tables.get(name, ())


def _noise_table(calibration: Calibration) -> Table:
    rows = []
    for row in rows_of(calibration, "noise"):
        unit, factor = _NOISE[row["sensor"]]
        axes = (f"{factor * density:.3g}" for density in row["density"])
        rows.append(
            (SENSOR_NAMES[row["sensor"]], *axes, f"{factor * row['stated']:.3g}", unit, f"{row['rate_hz']:.5g}")
        )
    return Table(
        "White noise at rest",
        "With K applied, from the Allan deviation over a quarter of a second in the static poses; stated is what "
        "the solution took it to be.",
        ("sensor", "x", "y", "z", "stated", "unit", "rate, Hz"),
        tuple(rows),
    )


def _disturbed_table(calibration: Calibration) -> Table:
    rows = [
        (str(row["pose"]), f"{row['start_s']:.2f}", f"{row['end_s']:.2f}", f"{1e6 * row['size']:.2g}")
        for row in rows_of(calibration, "disturbed_poses")
    ]
    return Table(
        "Poses with another field",
        "Their magnetometer was left out: the field there is off by more than noise, as near iron or a current.",
        ("pose", "from, s", "to, s", "off by, µT"),
        tuple(rows),
    )


def _static_poses(calibration: Calibration) -> Table:
    found = rows_of(calibration, "static_poses")
    whole = list(dict.fromkeys(family for row in found for family in row["used"]))
    rows = [
        (
            str(k + 1),
            f"{row['start_s']:.2f}",
            f"{row['end_s']:.2f}",
            described(row["up"]),
            ", ".join(family for family in whole if family not in row["used"]),
        )
        for k, row in enumerate(found)
    ]
    return Table(
        "Static poses",
        f"When gyro and accelerometer were quiet, and which side was up. Used of each: {', '.join(whole)}, but for "
        "what is named as not used.",
        ("pose", "from, s", "to, s", "up", "not used"),
        tuple(rows),
    )


def uses(true: Truth, config: Config, _noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a cube calibration: heading, rate and specific force."""
    raw = config.section(CubeConfig).raw

    def readings(true: Truth, ideal: Mapping[str, Array]) -> dict[str, Array]:
        found = {}
        if "mag" in ideal:
            found["mag"] = raw_of(true, "mag", ideal["mag"])
        if "accel" in ideal and "accel_k11" in true:
            u = nominal(raw_of(true, "accel", ideal["accel"]), raw.accel)
            square, cube = (true.vector(*each.names)[..., None, :] for each in (SQUARE, CUBE))
            found["accel"] = recorded(u * (1.0 + u * (square + u * cube)), raw.accel)
        if "gyro" in ideal:
            sensitivity = true.matrix([[f"gyro_g_{i}{j}" for j in "xyz"] for i in "xyz"])
            u = nominal(raw_of(true, "gyro", ideal["gyro"]), raw.gyro) + along(sensitivity, ideal["accel"])
            found["gyro"] = recorded(u, raw.gyro)
        return found

    return triad_uses(true, readings)


CARDS = {
    "Mounts and field": (
        ("Camera to reference, correction", "deg", ("camera_mount_x", "camera_mount_y", "camera_mount_z")),
        ("Reference heading", "deg", ("reference_heading",)),
        ("Field", "µT", ("field_e", "field_n", "field_u")),
    ),
}
REPORT = Report(
    uses=uses,
    cards=CARDS,
    formulas=formulas,
    corrections=tuple(replace(each, frame="cube") for each in CORRECTIONS),
    findings=findings,
    fixed_rotations=stated,
    figures=cube_plots,
    validate=validate,
)
