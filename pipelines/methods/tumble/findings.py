"""What a tumbled recording shows beside its parameters: iron in plain words, and the directions that were covered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.pipelines.display.sphere_map import described, share_near, widest_gap
from alidade.pipelines.estimation.problem import Array, Estimate, Findings
from alidade.pipelines.methods.triads import gain_names, parts_row, parts_with_sigmas, triad_names, triad_of
from alidade.pipelines.methods.tumble.model import Sensor, prepare
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.settings import Config

NAMES = {"accel": "accelerometer", "mag": "magnetometer"}
# Unit of a strength -> the one that people read, and what to multiply by.
_UNITS = {"T": ("µT", 1e6), "m/s^2": ("mg", 1e3 / 9.80665), "1": ("% of the field's strength", 100.0)}
# Gaps up to this, rad, are none.
_GAP = np.deg2rad(45.0)


def findings(data: TumbleData, config: Config, estimate: Estimate) -> Findings:
    """Rows of `triads`, `offsets`, `stretches` and `coverage` for the sensors that the estimate knows.

    triads: as of the cube, where K has no unit. offsets: b with its sigma, its length, what that is of the strength.
    stretches: relative error of a field's length along one direction of the body against the mean, for the directions
        of
    the largest and the least reading. coverage: part of all directions of the body that the vector came within 30 deg
    of, the widest gap, rad, and where it is. Each with a sentence.
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
    """(n, 3) unit vectors in the body of what a sensor measured, calibrated."""
    K, b = triad_of(sensor.name, values)
    vectors = sensor.raw @ K.T + b
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _parts(sensor: Sensor, estimate: Estimate, values: Mapping[str, float]) -> dict[str, object] | None:
    """K taken apart, of a sensor whose scale is against a nominal one."""
    if not sensor.is_si or sensor.unit == "1":
        return None
    names = triad_names(sensor.name, sensor.symmetric)[:-3]
    rows = [estimate.names.index(name) for name in names]
    spread = np.array([[1.0 if own == name else 0.0 for own in names] for name in _nine(sensor)])
    covariance = spread @ estimate.covariance[np.ix_(rows, rows)] @ spread.T
    found = parts_with_sigmas(triad_of(sensor.name, values)[0], covariance)
    return None if found is None else parts_row(sensor.name, *found)


def _nine(sensor: Sensor) -> list[str]:
    """The parameter in each of the nine places of K."""
    known = triad_names(sensor.name, sensor.symmetric)
    return [name for row in gain_names(sensor.name, known) for name in row]


def _offset(sensor: Sensor, estimate: Estimate, values: Mapping[str, float]) -> dict[str, object]:
    b = triad_of(sensor.name, values)[1]
    rows = [estimate.names.index(f"{sensor.name}_b{i}") for i in "123"]
    sigma = np.sqrt(np.diag(estimate.covariance)[rows])
    size = float(np.linalg.norm(b))
    spread = float(np.sqrt(b @ estimate.covariance[np.ix_(rows, rows)] @ b)) / max(size, np.finfo(float).tiny)
    unit, factor = _UNITS[sensor.unit]
    amount = f"{factor * size:.3g} ± {factor * spread:.1g} {unit} towards {described(-b)}"
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
    """From the singular values of K^-1, relative to their geometric mean, and their directions in the body."""
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
