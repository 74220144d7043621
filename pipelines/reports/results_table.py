"""Results in engineering units: a table a sensor or mount, each number with sigma, requirement and verdict.

K of a sensor of three axes is shown as scale error, non-orthogonality and misalignment, and its offset as what it reads
at zero. Sigmas, requirements and priors of these are those of the entries, through the same Jacobian.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.observability import DerivedNumber, Verdict, doubted, verdict
from alidade.pipelines.display.table import Cell, Column, Interval, Row, Table
from alidade.pipelines.display.units import human_unit, rounded, to_digits_of
from alidade.pipelines.estimation.parameters import SENSOR_NAMES
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods.triads import TRIADS, numeric_jacobian, parts_of, sensor_model
from alidade.pipelines.reports.plots import variables
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import truth_errors

_G, _DEG = 9.80665, math.degrees(1.0)
_BIAS_UNITS = {"accel": ("mg", 1e3 / _G), "gyro": ("deg/s", _DEG), "mag": ("µT", 1e6)}
# Unit of the scale of a sensor in counts, as data sheets have it, and what counts per SI unit are multiplied by.
_COUNT_UNITS = {"accel": ("counts/g", _G), "gyro": ("counts/(deg/s)", 1.0 / _DEG), "mag": ("counts/µT", 1e-6)}
# Units that a method's cards may name, and what SI numbers are multiplied by; others are shown in their usual unit.
_CARD_UNITS = {"deg": _DEG, "deg/s": _DEG, "deg/h": 3600.0 * _DEG, "ms": 1e3, "µT": 1e6}
# Scale errors below this are shown in ppm.
_PPM = 1e-3
# A value whose sigma exceeds so many sigmas of its prior is not shown.
MAX_SIGMA_OVER_PRIOR = 10.0
# Share of a sigma that is a step for derivatives.
_STEP = 0.01
# A derived number whose sigma is below this share of its requirement is fixed: rounding.
_NOTHING = 1e-9
MARKS: dict[str, tuple[str, str]] = {
    "observable": ("✓", "within the requirement"),
    "prior": ("◐", "within the requirement by its prior alone"),
    "weak": ("!", "sigma above the requirement"),
    "unobservable": ("✕", "not determined by the recording"),
    "fixed": ("=", "fixed"),
    "": ("·", "nuisance parameter, no requirement"),
}
LEGEND = (
    "✓ within the requirement · ◐ by its prior alone · ! weak · ✕ not observable · = fixed · σ: one standard deviation "
    "· required: largest σ allowed · bar: value ± 2σ (dark) in ± 2 required (light)"
)


@dataclass(frozen=True)
class ResultRow:
    """Result in the unit of its group; `names`: parameters in it; `known`: sigma below ten prior sigmas."""

    label: str
    value: float
    sigma: float
    require: float | None
    verdict: Verdict | None
    error: float | None
    names: tuple[str, ...]
    hint: str = ""
    known: bool = True

    def times(self, factor: float) -> ResultRow:
        """Return the row in another unit: its numbers multiplied by a factor."""
        require, error = (None if number is None else factor * number for number in (self.require, self.error))
        return replace(self, value=factor * self.value, sigma=factor * self.sigma, require=require, error=error)

    @property
    def ratio(self) -> float:
        """Ratio of the sigma to the required one; 0 if none is required."""
        return self.sigma / self.require if self.require else 0.0


@dataclass(frozen=True)
class ResultGroup:
    """Numbers of one kind and unit; `note` where there are none."""

    title: str
    unit: str
    rows: tuple[ResultRow, ...]
    note: str = ""


@dataclass(frozen=True)
class ResultCard:
    """Results of one sensor or mount, in groups."""

    title: str
    groups: tuple[ResultGroup, ...]

    @property
    def rows(self) -> list[tuple[ResultGroup, ResultRow]]:
        """All rows of the card, each with its group."""
        return [(group, row) for group in self.groups for row in group.rows]


def result_cards(c: Calibration) -> list[ResultCard]:
    """Return cards of the sensors, of the method, and of what is left; nuisance parameters only where declared."""
    triads = [name for name in TRIADS if f"{name}_k11" in c.values]
    cards = [_triad_card(c, name) for name in triads]
    shown = {name for card in cards for _, row in card.rows for name in row.names}
    for title, groups in c.method.report.cards.items():
        found = []
        for group, unit, names in groups:
            there = [name for name in names if name in c.values and name not in shown]
            if there:
                found.append(group_of(c, group, unit, there))
                shown |= set(there)
        if found:
            cards.append(ResultCard(title, tuple(found)))
    others = []
    for title, _, members in variables(c):
        left = [q.name for q in members if q.group is None and q.name not in shown]
        if left:
            others.append(group_of(c, title, "", left))
    return [*cards, *([ResultCard("Others", tuple(others))] if others else [])]


def result_table(card: ResultCard) -> Table:
    """Return a card as a table."""
    columns = (
        Column(card.title),
        *("value", "σ", "required"),
        Column("", "drawing"),
        Column("", "text"),
    )
    return Table(card.title, "", columns, tuple(_rows(card)), style="results", most_rows=None)


def matrix_texts(c: Calibration) -> list[str]:
    """Return K and b of each sensor of three axes as text."""
    found = []
    for name in TRIADS:
        if f"{name}_k11" in c.values:
            K, bias = sensor_model(name, c.values)
            rows = "\n".join("    [" + ", ".join(f"{x: .9g}" for x in row) + "]," for row in K)
            b = ", ".join(f"{x: .9g}" for x in -K @ bias)
            zero = ", ".join(f"{x: .9g}" for x in bias)
            found.append(
                f"{name}: nominal = K raw + b = K (raw - bias), SI\nK = [\n{rows}\n]\nb = [{b}]\nbias = [{zero}]"
            )
    return found


def _rows(card: ResultCard) -> Iterator[Row]:
    for group in card.groups:
        yield (Cell(f"{group.title}{f', {group.unit}' if group.unit else ''}", small=group.note),)
        for row in group.rows:
            mark, words = MARKS[row.verdict or ""]
            yield (
                Cell(row.label, hint=row.hint),
                to_digits_of(row.value, row.sigma) if row.known else "unknown",
                "" if not row.known else rounded(row.sigma) if row.sigma > 0.0 else "fixed",
                "" if not row.require else rounded(row.require),
                Cell("", interval=Interval(row.sigma, row.require, row.error), tone=row.verdict or ""),
                Cell(mark, tone=row.verdict or "", hint=f"{row.verdict or 'nuisance'}: {words}"),
            )


def group_of(c: Calibration, title: str, unit: str, names: Sequence[str]) -> ResultGroup:
    """Return parameters of one kind as a group, in the given unit or else in their usual one."""
    known = (unit, _CARD_UNITS[unit]) if unit in _CARD_UNITS else None
    human, factor = known or human_unit(c.quantities[names[0]])
    errors = truth_errors(c)
    rows = []
    for name in names:
        p = c.parameters[name]
        error = errors[name].error if name in errors else None
        row = ResultRow(
            name.rpartition("_")[2],
            *(p.value, p.sigma, p.require, p.observability, error, (name,)),
            hint=f"{name}: {c.method.describe(name)}",
            known=p.sigma < MAX_SIGMA_OVER_PRIOR * c.quantities[name].scale,
        )
        rows.append(row.times(factor))
    return ResultGroup(title, human, tuple(rows))


def _triad_card(c: Calibration, sensor: str) -> ResultCard:
    names = [name for name in c.estimate.names if name.startswith((f"{sensor}_k", f"{sensor}_b")) and name[-1] in "123"]
    symmetric = f"{sensor}_k21" not in names
    unit = c.quantities[f"{sensor}_k11"].unit
    plain, in_counts, of_field = unit in ("", "1"), unit.endswith("/count"), unit.startswith("1/")
    common = {each.name: each for each in c.derived}.get(f"{sensor}_scale")
    relative = common is not None or of_field
    absolute = in_counts and not relative

    def parts(values: Array) -> Array:
        K, bias = sensor_model(sensor, dict(zip(names, values.tolist(), strict=True)))
        found = parts_of(K)
        mean = found[:3].mean()
        scale = found[:3] if absolute else found[:3] / (mean if relative else 1.0) - 1.0
        return np.concatenate([scale, found[3:], bias, [mean]])

    try:
        rows = _derived(c, names, parts)
    except ValueError:  # K is no sensor's
        return ResultCard(SENSOR_NAMES[sensor].capitalize(), (group_of(c, "K and b", "", names),))
    title = "Scale error about mean" if relative else "Scale" if absolute else "Scale error"
    scale_unit, factor = _COUNT_UNITS[sensor] if absolute else ("%", 100.0)
    if plain and max(abs(row.value) + row.sigma for row in rows[:3]) < _PPM:
        scale_unit, factor = "ppm", 1e6
    bias_unit, bias_factor = ("counts", 1.0) if in_counts else _BIAS_UNITS[sensor]
    groups = [
        ResultGroup(title, scale_unit, tuple(row.times(factor) for row in rows[:3])),
        ResultGroup("Non-orthogonality", "deg", tuple(row.times(_DEG) for row in rows[3:6])),
        ResultGroup("Misalignment", "deg", tuple(row.times(_DEG) for row in rows[6:9])),
        ResultGroup("Bias", bias_unit, tuple(row.times(bias_factor) for row in rows[9:12])),
    ]
    if symmetric:
        groups[2] = ResultGroup("Misalignment", "", (), "0 by definition: it defines the body's axes")
    if of_field:
        groups.insert(0, ResultGroup("Mean scale", f"{bias_unit}/field", (rows[12].times(bias_factor),)))
    elif common is not None:
        groups.insert(0, _overall(rows[12], common, in_counts))
    return ResultCard(SENSOR_NAMES[sensor].capitalize(), tuple(groups))


def _overall(row: ResultRow, common: DerivedNumber, in_counts: bool) -> ResultGroup:
    """Return the mean scale, whose error all axes share, as a group; counts per µT for a magnetometer in counts."""
    require = None if common.require is None else common.require * row.value
    by_strength = common.verdict != "observable" or row.sigma <= (require or np.inf)
    row = replace(row, require=require, verdict=common.verdict if by_strength else row.verdict)
    if in_counts:
        unit, factor = _COUNT_UNITS["mag"]
        return ResultGroup("Mean scale", unit, (row.times(factor),))
    return ResultGroup("Mean scale error", "%", (replace(row, value=row.value - 1.0).times(100.0),))


_LABELS = (*"xyz", "xy", "xz", "yz", *"xyz", *"xyz", "xyz")


def _derived(c: Calibration, names: Sequence[str], function: Callable[[Array], Array]) -> list[ResultRow]:
    """Return rows of functions of parameters, SI, with propagated sigmas. Raises ValueError where not defined."""
    quantities = [c.quantities[name] for name in names]
    x, P = np.array([c.values[name] for name in names]), c.covariance_of(names)
    step = np.where(np.diag(P) > 0.0, _STEP * np.sqrt(np.diag(P)), 0.0)
    value, J = function(x), numeric_jacobian(function, x, step)
    wanted = np.array([q.require if q.required else 0.0 for q in quantities])
    prior = np.array([q.scale for q in quantities])
    require, scale = (np.sqrt((J**2) @ v**2) for v in (wanted, prior))
    sigma = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", J, P, J), 0.0))
    truth = {name: found.value for name, found in truth_errors(c).items()}
    error = value - function(np.array([truth[n] for n in names])) if truth.keys() >= set(names) else None
    rows = []
    for i, label in enumerate(_LABELS):
        fixed = sigma[i] <= _NOTHING * require[i]
        found = verdict(
            Quantity(label, "", 0.0 if fixed else scale[i], scale[i] or 1.0, require[i] or math.inf), sigma[i]
        )
        rows.append(
            ResultRow(
                label,
                float(value[i]),
                0.0 if fixed else float(sigma[i]),
                float(require[i]) or None,
                doubted(found, c.findings),
                None if error is None else float(error[i]),
                tuple(names),
                hint="of K and b: " + ", ".join(n for n, d in zip(names, J[i], strict=True) if d)[:80],
                known=bool(sigma[i] < MAX_SIGMA_OVER_PRIOR * scale[i]) or fixed,
            )
        )
    return rows
