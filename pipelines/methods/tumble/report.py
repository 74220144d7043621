"""Results of the tumble method: formulas, iron in plain words, directions covered, figures, uses, validation.

Frame b: the axes in which the first of these is symmetric that there is: the gyro's errors, the K of the accelerometer,
the magnetometer's.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from alidade.factors.array import Array
from alidade.factors.ellipsoid import entries
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.diagnostics.use import Truth, Use
from alidade.pipelines.display.figure import BEFORE, COLORS, Figure, Plot, thin
from alidade.pipelines.display.sphere_map import described, share_near, sphere_map, widest_gap
from alidade.pipelines.display.table import Column, Table
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import SENSOR_NAMES
from alidade.pipelines.estimation.problem import Estimate, Findings
from alidade.pipelines.methods import Report
from alidade.pipelines.methods.formula import Formula, gyro_rate, temperature_text, vector_text
from alidade.pipelines.methods.temperature import ACCEL_SLOPE, FIRST
from alidade.pipelines.methods.triads import (
    CORRECTIONS,
    RESULTS,
    G,
    gyro_reading,
    parts_row,
    parts_with_sigmas,
    raw_of,
    triad_formula,
    triad_names,
    triad_of,
    triad_uses,
)
from alidade.pipelines.methods.tumble.model import Sensor, prepare
from alidade.pipelines.methods.tumble.parameters import STRENGTHS
from alidade.pipelines.methods.tumble.recording import ACCEL_CURVATURE, LINE, TumbleData, beside
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config


def formulas(parameters: Collection[str], _config: Config | None = None) -> list[Formula]:
    """Formulas of the sensors present, from raw numbers as recorded to the unit of the strength."""
    found = []
    if "accel_k11" in parameters:
        formula = triad_formula("accel", parameters, "accel", ("accel",), "body's")
        if any(name in parameters for each in ACCEL_CURVATURE for name in each.names):
            found.append(replace(formula, description=f"{formula.description}, its curvature in it", name="f_read"))
            square, cube = (vector_text(each.names, parameters) for each in ACCEL_CURVATURE)
            expression = f"f_read - {square} * f_read**2 - {cube} * (f_read**3 - {LINE:.4f} * f_read)"
            formula = replace(formula, expression=expression, inputs=("accel",))
        if any(name in parameters for name in ACCEL_SLOPE.names):
            drift = temperature_text(ACCEL_SLOPE.names, parameters)
            inputs = *formula.inputs, "temperature"
            formula = replace(formula, expression=f"{formula.expression} - {drift}", inputs=inputs)
        found.append(formula)
    if "mag_k11" in parameters:
        unit = "the unit of field_strength"
        found.append(triad_formula("mag", parameters, "mag", ("mag",), "body's", unit))
    if "gyro_bias_x" in parameters:
        force = RESULTS["accel"]
        rate, inputs = gyro_rate(parameters, force)
        of_force = [name for each in found if each.name == force and "accel" in inputs for name in each.inputs]
        found.append(
            Formula("rate, rad/s along the body's axes", "w_b", rate, tuple(dict.fromkeys([*inputs, *of_force])))
        )
    return found


# Unit of a strength -> the one that people read, and what to multiply by.
_UNITS = {"T": ("µT", 1e6), "m/s^2": ("mg", 1e3 / 9.80665), "1": ("% of the field's strength", 100.0)}
# Gaps up to this, rad, are none.
_GAP = np.deg2rad(45.0)


def findings(data: TumbleData, config: Config, estimate: Estimate) -> Findings:
    """Rows of `triads`, `offsets`, `stretches` and `coverage` for the sensors that the estimate knows.

    triads: as of the cube, where K has no unit. offsets: b with its sigma, its length, what that is of the strength.
    stretches: relative error of a field's length along one direction of the body against the mean, for the directions
    of the largest and the least reading. coverage: part of all directions of the body that the vector came within 30
    deg of, the widest gap, rad, and where it is. Each with a sentence.
    """
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    sensors = [each for each in prepare(data, config).sensors if f"{each.name}_k11" in values]
    parts = [_parts(sensor, estimate, values) for sensor in sensors]
    return {
        "triads": [row for row in parts if row is not None],
        "offsets": [_offset(sensor, estimate, values) for sensor in sensors],
        "stretches": [_stretch(sensor, values) for sensor in sensors],
        "coverage": [_coverage(sensor, values) for sensor in sensors],
    }


def directions(sensor: Sensor, values: Mapping[str, float]) -> Array:
    """Unit vectors (n, 3) of a sensor's calibrated readings in the body frame."""
    K, b = triad_of(sensor.name, values)
    vectors = sensor.raw @ K.T + b
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _parts(sensor: Sensor, estimate: Estimate, values: Mapping[str, float]) -> dict[str, object] | None:
    """Scales, nonorthogonalities and mounting of K, for a sensor with a nominal scale; else None."""
    if not sensor.is_si or sensor.unit == "1":
        return None
    rows = [estimate.names.index(name) for name in triad_names(sensor.name, sensor.symmetric)[:-3]]
    spread = entries(sensor.symmetric)[:9, :-3]
    covariance = spread @ estimate.covariance[np.ix_(rows, rows)] @ spread.T
    found = parts_with_sigmas(triad_of(sensor.name, values)[0], covariance)
    return None if found is None else parts_row(sensor.name, *found)


def _offset(sensor: Sensor, estimate: Estimate, values: Mapping[str, float]) -> dict[str, object]:
    b = triad_of(sensor.name, values)[1]
    rows = [estimate.names.index(f"{sensor.name}_b{i}") for i in "123"]
    sigma = np.sqrt(np.diag(estimate.covariance)[rows])
    size = float(np.linalg.norm(b))
    spread = float(np.sqrt(b @ estimate.covariance[np.ix_(rows, rows)] @ b)) / max(size, np.finfo(float).tiny)
    unit, factor = _UNITS[sensor.unit]
    amount = f"{factor * size:.3g} ± {factor * spread:.1g} {unit}{f' towards {described(-b)}' if size else ''}"
    if sensor.name == "accel":
        says = f"offset: at no acceleration it reads {amount}"
    elif sensor.is_si:
        share = "" if sensor.unit == "1" else f" ({100.0 * size / sensor.strength:.0f} % of the earth's)"
        says = f"hard iron: whatever moves with the device adds {amount}{share}, however it is turned"
    else:
        says = f"hard iron and the offset of the counts: {amount}, however it is turned"
    return {
        "sensor": sensor.name,
        "b": b.tolist(),
        "sigma": sigma.tolist(),
        "size": size,
        "share": size / sensor.strength,
        "says": says,
    }


def _stretch(sensor: Sensor, values: Mapping[str, float]) -> dict[str, object]:
    """Findings row of a sensor's soft iron or scale: relative singular values of K^-1 with body directions."""
    K = triad_of(sensor.name, values)[0]
    _, sizes, axes = np.linalg.svd(np.linalg.inv(K))
    relative = sizes / np.cbrt(sizes.prod()) - 1.0
    most, least = (f"{100.0 * relative[i]:+.2f} % along {described(axes[i])}" for i in (0, 2))
    name = "soft iron and scale" if sensor.name == "mag" else "scale and skew"
    what = "a field" if sensor.name == "mag" else "a force"
    return {
        "sensor": sensor.name,
        "most": float(relative[0]),
        "along": axes[0].tolist(),
        "least": float(relative[2]),
        "least_along": axes[2].tolist(),
        "says": f"{name}: {what} reads {most} and {least}, against the mean of all directions",
    }


def _coverage(sensor: Sensor, values: Mapping[str, float]) -> dict[str, object]:
    reached = directions(sensor, values)
    share, (gap, where) = share_near(reached), widest_gap(reached)
    what = "the field" if sensor.name == "mag" else "up"
    missing = f"; it never came within {np.rad2deg(gap):.0f} deg of {described(where)}: turn it there too"
    return {
        "sensor": sensor.name,
        "share": share,
        "gap": gap,
        "at": where.tolist(),
        "says": f"{what} came within 30 deg of {100.0 * share:.0f} % of all directions of the device"
        + (missing if gap > _GAP else ""),
    }


def figures(data: TumbleData, calibration: Calibration) -> list[Plot | Table]:
    """Figures of the calibrated readings."""
    estimate = calibration.estimate
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    found: list[Plot | Table] = [_words(calibration)]
    for sensor in prepare(data, calibration.config).sensors:
        if f"{sensor.name}_k11" in values:
            found += [_lengths(sensor, values), _sphere(sensor, values), _covered(sensor, values)]
    return found


def _words(calibration: Calibration) -> Table:
    kinds = ("offsets", "stretches", "coverage")
    rows = [(SENSOR_NAMES[str(row["sensor"])], str(row["says"])) for kind in kinds for row in calibration.tables[kind]]
    columns = ("sensor", Column("what was found", "prose"))
    return Table("In plain words", "Directions are those of the device's axes.", columns, tuple(rows))


def _lengths(sensor: Sensor, values: Mapping[str, float]) -> Plot:
    K, b = triad_of(sensor.name, values)
    raw = np.linalg.norm(sensor.raw, axis=1)
    lengths = [raw / raw.mean(), np.linalg.norm(sensor.raw @ K.T + b, axis=1) / sensor.strength]
    misses = [100.0 * (length - 1.0) for length in lengths]
    out = Figure("length, % off")
    some = thin(2 * len(raw))
    for words, miss, color in zip(("uncalibrated", "calibrated"), misses, (BEFORE, COLORS[0]), strict=True):
        out.points(sensor.time[some], miss[some], words, color, 4)
    rms = [float(np.sqrt((miss**2).mean())) for miss in misses]
    return Plot(
        f"Length of what the {SENSOR_NAMES[sensor.name]} reads",
        f"It should be the same in every attitude: {rms[0]:.2g} % RMS off its mean as recorded, {rms[1]:.2g} % off "
        "calibrated.",
        out,
    )


def _sphere(sensor: Sensor, values: Mapping[str, float]) -> Plot:
    """Plot the readings in two views: as recorded about their own centre, and calibrated."""
    K, b = triad_of(sensor.name, values)
    clouds = (sensor.raw / sensor.radius, (sensor.raw @ K.T + b) / sensor.strength)
    some = thin(3 * len(sensor.raw))
    views = []
    for i, j in ((0, 1), (0, 2)):
        out = Figure("xyz"[j], "xyz"[i], 420, 0.5, square=True)
        for name, cloud, color in zip(("as recorded", "calibrated"), clouds, (BEFORE, COLORS[0]), strict=True):
            out.points(cloud[some, i], cloud[some, j], name, color, 3)
        views.append(out)
    return Plot(
        f"Readings of the {SENSOR_NAMES[sensor.name]}",
        "Seen along z and along y, in units of what is measured: an ellipsoid about the offset as recorded, the unit "
        "sphere about zero calibrated.",
        views[0],
        (views[1],),
    )


def _covered(sensor: Sensor, values: Mapping[str, float]) -> Plot:
    reached: Array = directions(sensor, values)
    reached = reached[thin(3 * len(reached))]
    names = [described(direction) for direction in reached]
    what = "the field" if sensor.name == "mag" else "up"
    return Plot(
        f"Directions covered by the {SENSOR_NAMES[sensor.name]}",
        f"Where {what} was, in the device's axes, on an equal-area map of all directions.",
        sphere_map(reached, names, "reading"),
    )


_STRENGTH_OF = {"accel": "specific force at rest, its strength", "mag": "magnetic field, its strength"}


def validate(data: TumbleData, config: Config, values: Mapping[str, float]) -> list[Validation]:
    """Vector lengths minus the calibration strength; before compensation scaled to that strength on average.

    Raises InputError when the calibration has none of the recording's sensors.
    """
    found = []
    for sensor in prepare(data, config).sensors:
        if f"{sensor.name}_k11" not in values:
            continue
        K, b = triad_of(sensor.name, values)
        strength = values.get(STRENGTHS[sensor.name], sensor.strength)
        raw = np.linalg.norm(sensor.raw, axis=1)
        drift = np.zeros((1, 3))
        for i, cause in enumerate(sensor.driven):
            driver = sensor.drivers[:, 3 * i : 3 * i + 3] if sensor.drivers is not None else drift
            if cause is ACCEL_SLOPE:
                if data.temperature is None or FIRST not in values:
                    continue
                driver = driver + (data.temperature.first - values[FIRST])
            drift = drift + driver * [values.get(name, 0.0) for name in cause.names]
        after = np.linalg.norm(sensor.raw @ K.T + b - drift, axis=1) - strength
        before = raw * strength / np.mean(raw) - strength
        found.append(Validation(_STRENGTH_OF[sensor.name], sensor.unit, sensor.time, before[:, None], after[:, None]))
    if not found:
        raise InputError("the calibration is of none of the sensors in the recording")
    return found


def uses(true: Truth, _config: Config, _noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a tumble calibration: heading, rate and specific force."""
    return triad_uses(true, _readings)


def _readings(true: Truth, nominal: Mapping[str, Array]) -> dict[str, Array]:
    found = {}
    if "mag" in nominal:
        found["mag"] = raw_of(true, "mag", nominal["mag"])
    if "accel" in nominal and "accel_k11" in true:
        f = nominal["accel"]
        terms = zip((true.vector(*each.names)[..., None, :] for each in ACCEL_CURVATURE), beside(f), strict=True)
        found["accel"] = raw_of(true, "accel", f + sum(size * term for size, term in terms))
    if "gyro" in nominal:
        found["gyro"] = gyro_reading(true, nominal["gyro"], nominal.get("accel", np.array([0.0, 0.0, G])))
    return found


CARDS = {
    "Gyro": (
        ("Bias", "deg/s", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
        ("Scale error", "%", ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")),
    ),
    "Field": (
        ("Strength", "", ("field_strength",)),
        ("Dip", "deg", ("field_dip",)),
        ("Delay of the magnetometer", "ms", ("mag_delay",)),
    ),
}
REPORT = Report(
    uses=uses,
    cards=CARDS,
    formulas=formulas,
    corrections=CORRECTIONS,
    findings=findings,
    figures=figures,
    validate=validate,
)
