"""The noise of a recording as people and programs read it: a table, the `noise:` section, noise.json, noise.html."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from alidade.pipelines.diagnostics.allan import allan_variance
from alidade.pipelines.diagnostics.noise_spectrum import Coefficient
from alidade.pipelines.display.figure import AXES, Figure, Plot
from alidade.pipelines.display.table import Cell, Column, Columns, Row, Table
from alidade.pipelines.display.units import significant
from alidade.pipelines.files import plain_json
from alidade.pipelines.reports.report import Bullets, Code, Plots, Report, Section, Summary
from alidade.pipelines.reports.result import software_versions

if TYPE_CHECKING:
    from alidade.pipelines.applications.noise import NoiseStudy, SensorNoise

_TITLES = {"gyro": "gyro", "accel": "accelerometer", "mag": "magnetometer"}
_COEFFICIENTS = {"N": "white noise", "B": "bias instability", "K": "random walk", "Q": "quantisation"}
# Topics of the platform that the device moves on.
_PLATFORM = "/platform/"
_KEYS = {"gyro": "gyro_density", "accel": "accel_density", "mag": "mag_density"}

_DEG_H = math.degrees(3600.0)
_UG = 1e6 / 9.80665
# Kind and coefficient -> SI unit, the unit people use, and what to multiply SI by.
_UNITS: dict[str, dict[str, tuple[str, str, float]]] = {
    "gyro": {
        "N": ("rad/s/sqrt(Hz)", "deg/√h", math.degrees(60.0)),
        "B": ("rad/s", "deg/h", _DEG_H),
        "K": ("rad/s/sqrt(s)", "deg/h/√h", 60.0 * _DEG_H),
        "Q": ("rad", "arcsec", _DEG_H),
    },
    "accel": {
        "N": ("m/s^2/sqrt(Hz)", "µg/√Hz", _UG),
        "B": ("m/s^2", "µg", _UG),
        "K": ("m/s^2/sqrt(s)", "µg/√h", 60.0 * _UG),
        "Q": ("m/s", "mm/s", 1e3),
    },
    "mag": {
        "N": ("T/sqrt(Hz)", "nT/√Hz", 1e9),
        "B": ("T", "nT", 1e9),
        "K": ("T/sqrt(s)", "nT/√h", 60e9),
        "Q": ("T s", "nT s", 1e9),
    },
}


def title(sensor: SensorNoise) -> str:
    """Return the topic and the kind of a sensor as a title."""
    return f"{sensor.topic} {_TITLES[sensor.kind]}"


def _at_rest(sensor: SensorNoise) -> str:
    """Return the rate and the time at rest of a sensor as a line."""
    count = len(sensor.rests)
    longest = float(np.ptp(sensor.rests, axis=1).max())
    rests = (
        f"at rest from {sensor.rests[0, 0]:.1f} to {sensor.rests[0, 1]:.1f} s"
        if count == 1
        else f"{count} static intervals, {length(sensor.length_s)} in all, the longest {length(longest)}"
    )
    return f"{sensor.rate_hz:.4g} Hz, {rests}"


def remarks(sensor: SensorNoise) -> list[str]:
    """Sentences that a reader needs beside the coefficients."""
    out = []
    for name, words in _COEFFICIENTS.items():
        silent = [c for axis in sensor.axes if (c := _of(sensor, axis, name)).value is None]
        if silent and name != "Q":
            out.append(f"{words}: {length(sensor.length_s)} at rest do not determine {_needed(silent)}")
    for axis, noise in sensor.axes.items():
        out += [
            f"{axis}: a sinusoid at {line.hz:.5g} Hz, amplitude {line.amplitude:.2g} {sensor.unit}, is not in the "
            "coefficients"
            for line in noise.lines
        ]
        if noise.fit.filtered:
            out.append(
                f"{axis}: white up to {noise.fit.band_hz[1]:.3g} Hz only, as behind a filter of the sensor; the "
                "coefficients are those below"
            )
        if noise.fit.misfit != 1.0:
            out.append(
                f"{axis}: near {noise.fit.misfit_hz:.2g} Hz there is {noise.fit.misfit:.2g} times the power that these "
                "noises have: vibration, temperature or interference; the coefficients are rough"
            )
        if noise.coarse is not None:
            out.append(
                f"{axis}: the readings come in steps of {noise.coarse:.2g} {sensor.unit}, larger than the noise, "
                "which they hide"
            )
    if sensor.filled:
        out.append(f"{sensor.filled} lost samples were filled in between their neighbours")
    return out


def section(study: NoiseStudy) -> tuple[dict[str, float], str]:
    """Return the config's noise keys with their values, and the `noise:` section to paste, with comments.

    A value is the root mean square over the axes. The first topic of a kind gives the keys, that of the platform its
    own; what has no key, or is not determined, stands as a comment.
    """
    values: dict[str, float] = {}
    lines = ["noise:"]
    for sensor in study.sensors:
        platform = sensor.topic.startswith(_PLATFORM)
        density = f"platform_{_KEYS[sensor.kind]}" if platform else _KEYS[sensor.kind]
        mine = density not in values and not (platform and sensor.kind != "gyro")
        lines.append(_line(sensor, "N", density, values if mine else None))
        if sensor.kind == "gyro" and not platform:
            lines.append(_line(sensor, "K", "gyro_bias_walk", values if mine else None))
    return values, "\n".join(lines) + "\n"


def noise_json(study: NoiseStudy) -> str:
    """Return the text of noise.json: all results, SI; null where a number is not determined or has no bound."""
    values, text = section(study)
    content = {
        "recording": study.recording,
        "duration_s": study.duration_s,
        "noise": values,
        "section": text,
        "sensors": [_sensor_json(sensor) for sensor in study.sensors],
        "notes": study.notes,
        "software": software_versions(),
    }
    return plain_json("noise", content) + "\n"


def noise_report(study: NoiseStudy) -> Report:
    """The report of a noise analysis."""
    config = Section("For the config", (Code(section(study)[1], copied=True),))
    sensors = (
        Section(
            title(sensor),
            (_sensor_table(sensor), Bullets((_at_rest(sensor), *remarks(sensor))), Plots((_plot(sensor),))),
        )
        for sensor in study.sensors
    )
    return Report(
        title=f"Noise ({study.recording})",
        heading="Noise of the sensors",
        about=study.recording,
        summary=_summary(study),
        sections=(config, *sensors),
    )


def _sensor_table(sensor: SensorNoise) -> Table:
    """Return a table of the coefficients of each axis, SI in small print; quantisation only where it shows."""
    rows: list[Row] = []
    for name, words in _COEFFICIENTS.items():
        found = [_of(sensor, axis, name) for axis in sensor.axes]
        if name == "Q" and all(c.value is None for c in found):
            continue
        si_unit, unit, factor = _UNITS[sensor.kind][name]
        cells = (Cell(_cell(c, factor), _scientific(c)) for c in found)
        rows.append((f"{words} {name}", Cell(unit, si_unit), *cells))
    columns: Columns = ("noise", Column("unit", "text", wide=True), *(Column(axis, wide=True) for axis in sensor.axes))
    caption = (
        "± one sigma; < not determined, below this with 95 % confidence. In small print the same in SI, as the config "
        "has it."
    )
    return Table("", caption, columns, tuple(rows), style="", most_rows=None)


def _summary(study: NoiseStudy) -> Summary:
    """Return a summary of which coefficients the time at rest determines."""
    silent = sum(
        _of(sensor, axis, name).value is None for sensor in study.sensors for axis in sensor.axes for name in "NBK"
    )
    asked = 3 * sum(len(sensor.axes) for sensor in study.sensors)
    question, notes = "What is the noise of the sensors?", tuple(note.removesuffix(".") for note in study.notes)
    steps = ("Paste the section `noise` into the config of your recordings.",)
    if not silent:
        text = "White noise, bias instability and random walk of every axis are determined."
        return Summary(question, "known", "good", text, notes, steps)
    text = (
        f"{asked - silent} of {asked} coefficients (white noise, bias instability and random walk of each axis) are "
        "determined; for the others there are upper bounds."
    )
    longer = "Leave the sensors at rest for longer where the remarks ask for it, if you need the others."
    return Summary(question, "known in part", "warn", text, notes, (*steps, longer))


def length(seconds: float) -> str:
    """Return a time, given in s, as text with two digits in s, min, h or days."""
    for unit, size, most in (("s", 1.0, 120.0), ("min", 60.0, 120.0), ("h", 3600.0, 48.0)):
        if seconds < size * most:
            return f"{seconds / size:.2g} {unit}" if seconds / size < 9.95 else f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400.0:.0f} days"


def _of(sensor: SensorNoise, axis: str, name: str) -> Coefficient:
    return next(c for c in sensor.axes[axis].fit.coefficients if c.name == name)


def _cell(c: Coefficient, factor: float) -> str:
    if c.value is None or c.sigma is None:
        return f"< {significant(factor * c.high, 2)}"
    return f"{significant(factor * c.value, 3)} ±{significant(100.0 * c.sigma / c.value, 2)}%"


def _scientific(c: Coefficient) -> str:
    return f"< {c.high:.1e}" if c.value is None else f"{c.value:.3e}"


def _needed(silent: Sequence[Coefficient]) -> str:
    """Return the end of a sentence on undetermined coefficients: their bound, and the time that determines them."""
    times = [c.needed_s for c in silent if c.needed_s is not None]
    bound = "it is below the numbers given (95 %)"
    if not times:
        return f"it; {bound}"
    low, high = length(min(times)), length(max(times))
    return f"it; {bound}; {low if low == high else f'{low} to {high}'} in one piece would determine half of them"


def _line(sensor: SensorNoise, name: str, key: str, values: dict[str, float] | None) -> str:
    """Return a line of the `noise:` section and enter its value in `values`; a comment if `values` is None."""
    found = {axis: _of(sensor, axis, name) for axis in sensor.axes}
    known = [c.value for c in found.values() if c.value is not None]
    each = ", ".join(f"{axis} {_scientific(c)}" for axis, c in found.items())
    comment = f"{_UNITS[sensor.kind][name][0]}, {sensor.topic}: {each}"
    if not known:
        return f"  # {key}: {comment}"
    value = float(f"{math.sqrt(sum(x * x for x in known) / len(known)):.3g}")
    mantissa, exponent = f"{value:.2e}".split("e")
    text = f"{key}: {mantissa}e{int(exponent)}"
    if values is None:
        return f"  # {text}  # {comment}"
    values[key] = value
    return f"  {text}  # {comment}"


def _sensor_json(sensor: SensorNoise) -> dict[str, Any]:
    return {
        "topic": sensor.topic,
        "sensor": sensor.kind,
        "unit": sensor.unit,
        "rate_hz": sensor.rate_hz,
        "rests": [{"start_s": start, "end_s": end} for start, end in sensor.rests.tolist()],
        "length_s": sensor.length_s,
        "samples": sensor.samples,
        "filled": sensor.filled,
        "remarks": remarks(sensor),
        "axes": [
            {
                "axis": axis,
                "coefficients": [
                    {**asdict(c), "meaning": _COEFFICIENTS[c.name], "unit": _UNITS[sensor.kind][c.name][0]}
                    for c in noise.fit.coefficients
                ],
                "band_hz": noise.fit.band_hz,
                "misfit": noise.fit.misfit,
                "lines": [
                    {"hz": x.hz, "amplitude": x.amplitude, "resolution_hz": x.resolution_hz} for x in noise.lines
                ],
                "allan": [
                    dict(zip(("tau_s", "deviation", "low", "high", "dof"), row, strict=True))
                    for row in np.stack(
                        [noise.curve.tau, noise.curve.deviation, noise.low, noise.high, noise.dof], axis=1
                    ).tolist()
                ],
            }
            for axis, noise in sensor.axes.items()
        ],
    }


def _plot(sensor: SensorNoise) -> Plot:
    """Plot the Allan deviation of each axis with its interval, and the fitted model, dotted."""
    _, unit, factor = _UNITS[sensor.kind]["B"]
    out = Figure(f"Allan deviation, {unit}", "averaging time, s", 420, x_scale="log", y_scale="log")
    for (axis, noise), color in zip(sensor.axes.items(), cycle(AXES)):
        tau = noise.curve.tau
        # On a logarithmic axis a bound at infinity has no place.
        high = np.where(np.isfinite(noise.high), noise.high, 10.0 * noise.curve.deviation)
        out.band(tau, factor * noise.low, factor * high, color, axis)
        out.line(tau, factor * noise.curve.deviation, axis, color)
        out.points(tau, factor * noise.curve.deviation, axis, color)
        out.line(tau, factor * np.sqrt(allan_variance(tau, noise.fit.squares)), axis, color, "dotted", shown=False)
    caption = "Overlapping Allan deviation with its 95 % interval; dotted: as the coefficients have it."
    return Plot(f"Allan deviation of {title(sensor)}", caption, out)
