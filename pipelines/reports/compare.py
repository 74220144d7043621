"""compare.html: the solvers side by side, and whether the recording agrees with itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import NormalDist

import numpy as np

from alidade.pipelines.diagnostics.cross_validation import SplitHalf
from alidade.pipelines.display.figure import COLORS, Dash, Figure
from alidade.pipelines.display.units import human_unit, signed, to_digits_of
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods.meanings import meaning
from alidade.pipelines.reports.answer import Answer
from alidade.pipelines.reports.result import Calibration, Plot, truth_errors
from alidade.pipelines.reports.templating import page
from alidade.pipelines.reports.whole import write_page

FILE = "compare.html"
# How often chance alone may take any parameter of the halves apart.
_CHANCE = 1e-3
# Lines of the solvers, the exact ones over the published.
_STYLES: dict[str, tuple[str, Dash]] = {
    "published": (COLORS[1], "dotted"),
    "batch": (COLORS[2], "dashed"),
    "incremental": (COLORS[0], "solid"),
}


def compare_html(
    calibrations: Sequence[Calibration], halves: Mapping[str, SplitHalf], predicted: Mapping[str, float]
) -> str:
    """The page as one HTML text.

    Args:
        calibrations: of one recording, by different solvers.
        halves: of the recording, see alidade.pipelines.diagnostics.cross_validation.
        predicted: family -> size of the errors of held-out measurements, sigmas.
    """
    quantities = [q for q in calibrations[0].problem.quantities if q.prior_sigma != 0.0]
    known = calibrations[0].truth is not None
    plots = [*_differences(calibrations, quantities), *_convergence(calibrations, quantities)]
    return page(
        "alidade.pipelines.reports",
        "compare.html",
        plots,
        calibrations=calibrations,
        recording=calibrations[0].recording,
        method=calibrations[0].method.title,
        meanings={q.name: meaning(calibrations[0].method, q.name) for q in quantities},
        answer=_answer(halves, predicted),
        truth_known=known,
        several=len(calibrations) > 1 and _batch(calibrations) is not None,
        columns=["parameter", "unit", *(head for c in calibrations for head in _heads(c, calibrations, known))],
        rows=[
            [
                q.name,
                human_unit(q)[0],
                *(cell for c in calibrations for cell in _cells(c, calibrations, q, known)),
            ]
            for q in quantities
        ],
        halves=[_half(q, halves[q.name]) for q in quantities if q.name in halves],
        predicted=predicted,
    )


def write_compare(
    out_dir: Path, calibrations: Sequence[Calibration], halves: Mapping[str, SplitHalf], predicted: Mapping[str, float]
) -> Path:
    """Write compare.html; returns its path. Raises InputError when it cannot be written."""
    return write_page(out_dir, FILE, compare_html(calibrations, halves, predicted))


def _found(calibration: Calibration, name: str) -> tuple[float, float] | None:
    """Value and sigma of a parameter, SI; None when the solver does not know it."""
    found = calibration.parameters.get(name)
    return None if found is None else (found.value, found.sigma)


def _batch(calibrations: Sequence[Calibration]) -> Calibration | None:
    return next((c for c in calibrations if c.estimate.solver == "batch"), None)


def _from_batch(calibration: Calibration, calibrations: Sequence[Calibration], name: str) -> float | None:
    """How far a solver is from batch, in batch's sigmas."""
    batch = _batch(calibrations)
    if batch is None or batch is calibration:
        return None
    mine, reference = _found(calibration, name), _found(batch, name)
    if mine is None or reference is None or reference[1] == 0.0:
        return None
    return (mine[0] - reference[0]) / reference[1]


def _heads(calibration: Calibration, calibrations: Sequence[Calibration], known: bool) -> list[str]:
    """Of a solver's columns."""
    solver, batch = calibration.estimate.solver, _batch(calibrations)
    apart = [f"{solver} from batch, σ"] if batch is not None and batch is not calibration else []
    return [solver, *apart, *([f"error of {solver}, σ"] if known else [])]


def _cells(calibration: Calibration, calibrations: Sequence[Calibration], quantity: Quantity, known: bool) -> list[str]:
    """What a solver says of a parameter; a dash and nothing where it does not know it."""
    found = _found(calibration, quantity.name)
    columns = len(_heads(calibration, calibrations, known))
    if found is None:
        return ["-", *[""] * (columns - 1)]
    _, factor = human_unit(quantity)
    far = _from_batch(calibration, calibrations, quantity.name)
    error = truth_errors(calibration).get(quantity.name)
    apart = ["" if far is None else signed(far)] if columns - known == 2 else []
    off = ["" if error is None or error.error_sigmas is None else signed(error.error_sigmas)] if known else []
    return [_with_sigma(factor * found[0], factor * found[1]), *apart, *off]


def _answer(halves: Mapping[str, SplitHalf], predicted: Mapping[str, float]) -> Answer:
    """Whether the recording agrees with itself."""
    question = "Does the recording agree with itself?"
    held_out = ", ".join(f"{size:.2f} ({family})" for family, size in predicted.items())
    said = f" Measurements held out are predicted to {held_out} of their sigmas." if held_out else ""
    if not halves:
        sentence = "Neither half determines a parameter by itself, so they cannot be held against each other."
        return Answer(question, "cannot say", "fixed", sentence + said, (), ("Record about twice as long.",))
    limit = NormalDist().inv_cdf(1.0 - 0.5 * _CHANCE / len(halves))
    far = {name: half.z for name, half in halves.items() if abs(half.z) > limit}
    if not far:
        most = max(abs(half.z) for half in halves.values())
        sentence = (
            f"Its two halves, each solved by itself, agree in all {len(halves)} parameters that both determine: they "
            f"differ by {most:.1f} sigmas at most, and chance makes {limit:.1f} in one recording of a thousand."
        )
        return Answer(question, "yes", "good", sentence + said, (), ("Go by the batch solver's result, and apply it.",))
    named = ", ".join(f"{name} ({signed(z)})" for name, z in sorted(far.items(), key=lambda item: -abs(item[1])))
    sentence = f"Its two halves differ by more than the {limit:.1f} sigmas that chance explains: {named}."
    steps = (
        "Ask what happened in between: a knock, a cable, warming up; a gyro's bias walks, and may differ for that.",
        "If something moved, calibrate the two parts each by itself; if nothing did, look at the residuals in the "
        "report of `alidade calibrate`, which tries causes.",
    )
    return Answer(question, "no", "bad", sentence + said, (), steps)


def _with_sigma(value: float, sigma: float) -> str:
    return f"{to_digits_of(value, sigma)} \u00b1 {to_digits_of(sigma, sigma)}"


def _half(quantity: Quantity, halves: SplitHalf) -> tuple[str, str, str, str, str]:
    unit, factor = human_unit(quantity)
    first = _with_sigma(factor * halves.first, factor * halves.first_sigma)
    second = _with_sigma(factor * halves.second, factor * halves.second_sigma)
    return quantity.name, unit, first, second, signed(halves.z)


def _differences(calibrations: Sequence[Calibration], quantities: Sequence[Quantity]) -> list[Plot]:
    """Errors, or differences from batch, in sigmas."""
    known = any(truth_errors(c) for c in calibrations)
    y_title = "error, sigmas of each solver" if known else "difference from batch, sigmas of batch"
    out = Figure(y_title, "", 380, x_labels=tuple(q.name for q in quantities))
    for k, c in enumerate(calibrations):
        errors = truth_errors(c)
        numbers = [
            (errors[q.name].error_sigmas if q.name in errors else None)
            if known
            else _from_batch(c, calibrations, q.name)
            for q in quantities
        ]
        if any(number is not None for number in numbers):
            heights = np.array([np.nan if number is None else number for number in numbers])
            out.bars(heights, c.estimate.solver, _STYLES[c.estimate.solver][0], (k, len(calibrations)))
    out.levels((-3.0, 3.0))
    what = (
        "Error of each solver in units of the sigma it states" if known else "Each solver less batch, sigmas of batch"
    )
    return [Plot("Differences", f"{what}; dotted are three.", out)]


def _convergence(calibrations: Sequence[Calibration], quantities: Sequence[Quantity]) -> list[Plot]:
    """A figure a parameter: its estimate over time by every solver that has a history."""
    plots = []
    for q in quantities:
        unit, factor = human_unit(q)
        out = Figure(unit, height=260)
        reach: list[float] = []
        for c in calibrations:
            history, names = c.estimate.history, c.estimate.names
            color, dash = _STYLES[c.estimate.solver]
            if q.name not in names:
                continue
            i = names.index(q.name)
            if history is None:
                value, sigma = (factor * float(x[i]) for x in (c.estimate.values, c.estimate.sigmas))
                out.levels(value, color, dash, c.estimate.solver)
                reach += [value - 4.0 * sigma, value + 4.0 * sigma]
                continue
            values, sigmas = factor * history.values[:, i], factor * history.sigmas[:, i]
            if c.estimate.solver == "incremental":
                out.band(history.time, values - sigmas, values + sigmas, color, c.estimate.solver)
            out.line(history.time, values, c.estimate.solver, color, dash)
            settled = history.time >= history.time[0] + 0.2 * np.ptp(history.time)
            reach += [float(values[settled].min()), float(values[settled].max())]
        truth = (calibrations[0].truth or {}).get(q.name)
        if isinstance(truth, int | float):
            out.levels(factor * truth, COLORS[6], "solid", "truth")
            reach.append(factor * truth)
        if reach and out.marks:
            edge = 0.05 * (max(reach) - min(reach))
            out.y_range = (min(reach) - edge, max(reach) + edge)
            caption = meaning(calibrations[0].method, q.name)
            plots.append(Plot(f"{q.name} over time", f"{caption} The band is one sigma of incremental.".strip(), out))
    return plots
