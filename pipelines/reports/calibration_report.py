"""report.html: a calibration as a report, one function per section."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from contextlib import suppress

from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.display.figure import Plot
from alidade.pipelines.display.table import Cell, Column, Columns, Row, Table
from alidade.pipelines.display.units import human_unit, noise_unit, rounded, signed, to_digits_of
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods.meanings import NOISES, meaning
from alidade.pipelines.reports import sentences
from alidade.pipelines.reports.budget import Limit, limits
from alidade.pipelines.reports.calibration import SavedCalibration, saved
from alidade.pipelines.reports.export_formats import ros_parameters
from alidade.pipelines.reports.html import render_fragment, render_html
from alidade.pipelines.reports.plots import common_plots
from alidade.pipelines.reports.report import (
    Block,
    Bullets,
    Card,
    Code,
    Details,
    Plots,
    Report,
    Section,
    Summary,
    Svg,
    Tables,
    Text,
    Tone,
)
from alidade.pipelines.reports.result import Calibration, quantities_of
from alidade.pipelines.reports.result_json import ParameterResult, truth_errors
from alidade.pipelines.reports.sketch import enlarged, rotation_text, sketch_with
from alidade.pipelines.reports.snippets import c_code, python_code

# A value whose sigma exceeds so many sigmas of its prior is not shown.
_MAX_SIGMA_OVER_PRIOR = 10.0
# Effects of fixed inputs that are named: the smallest, in sigmas of the parameter, and how many.
_MIN_EFFECT_SIGMAS, _MAX_EFFECTS = 0.1, 6
_TONES: dict[str, Tone] = {"calibrated": "good", "weak": "warn", "unobservable": "bad", "inconsistent": "bad"}
_LANGUAGES = {"Python": python_code, "C": c_code}


def report_html(calibration: Calibration) -> str:
    """The report as one HTML text."""
    return render_html(calibration_report(calibration))


def notebook_html(calibration: Calibration) -> str:
    """The verdict and the parameters as a fragment of HTML, for notebooks."""
    verdict = f"{calibration.status}. {calibration.headline}"
    return render_fragment(Text(verdict), _parameter_table(calibration))


def calibration_report(calibration: Calibration) -> Report:
    """The report of a calibration."""
    c, file = calibration, saved(calibration)
    own = list(c.plots(c)) if c.plots else []
    plots = (*(each for each in own if isinstance(each, Plot)), *common_plots(c))
    tables = tuple(each for each in own if isinstance(each, Table))
    start = datetime.datetime.fromtimestamp(c.facts.epoch_ns // 1_000_000_000, datetime.UTC)
    about = [
        c.recording,
        f"{start:%Y-%m-%d %H:%M:%S} UTC",
        f"{c.facts.duration_s:.1f} s",
        f"{c.estimate.solver} solver",
    ]
    steps = sentences.next_steps(c.findings)
    question = "Is it as accurate as required, and does it fit the recording?"
    return Report(
        title=f"{c.problem.method}: {c.status} ({c.recording})",
        heading=f"{c.method.title} calibration",
        about=" · ".join(about),
        summary=Summary(question, c.status, _TONES[c.status], c.headline, c.notes, steps),
        sections=(
            Section("Frames", _frames(c, file)),
            Section("Parameters", (_parameter_table(c),)),
            Section("Apply", _application(c, file)),
            Section("Nuisance parameters", _nuisance_parameters(c)),
            Section("Noise", _noise(c)),
            Section("Unobservable and weak directions", direction_blocks(c.findings)),
            Section("Findings", (Tables(tables),) if tables else ()),
            Section("Error budget", _error_budget(c)),
            Section("Sensitivity to fixed inputs", _fixed_inputs(c)),
            Section("Most influential measurements", _influential_measurements(c)),
            Section("Time to required accuracy", _time_to_accuracy(c)),
            Section("Goodness of fit", _goodness_of_fit(c)),
            Section("Stability during the recording", _stability(c)),
            Section("Plots", (Plots(plots),) if plots else ()),
            Section("Recording", _recording(c)),
            Section("Provenance", _provenance(c)),
        ),
    )


def direction_blocks(findings: Sequence[Finding]) -> tuple[Block, ...]:
    """Weak directions: those with the same advice in one row, and the weights of each."""
    directions = [finding.evidence for finding in findings if finding.kind == "direction"]
    if not directions:
        return ()
    rows = tuple(
        (labels, Cell(severity.name.lower(), tone=severity.name.lower()), f"{sentences.capital(what)}.")
        for severity in (Severity.UNOBSERVABLE, Severity.WEAK)
        for labels, what in sentences.by_advice(findings, severity)
    )
    weights = (
        ", ".join(f"{weight:+.2f} {name}" for name, weight in direction["weights"].items()) for direction in directions
    )
    lines = tuple(
        f"sigma {direction['sigma_ratio']:.3g} times the prior's along {along} (in units of the priors)"
        for direction, along in zip(directions, weights, strict=True)
    )
    columns = (Column("parameters", "prose"), Column("verdict", "text"), Column("what determines them", "prose"))
    return (
        Table("", "", columns, rows, "directions"),
        Card((Details("Directions", (Bullets(lines),)),)),
    )


def _frames(c: Calibration, file: SavedCalibration) -> tuple[Block, ...]:
    """The method's sketch with the estimated mounts drawn in."""
    if c.method.sketch is None:
        return ()
    svg = c.method.sketch.read_text(encoding="utf-8")
    shown = {name: each for name, each in file.transforms.items() if f'data-turn="{name}"' in svg}
    drawing = Svg(sketch_with(svg, shown))
    if not shown:
        return (Card((drawing,), style="sketch"),)
    lines = tuple(
        f"{name}, {each.child} to {each.parent}: {rotation_text(each)}"
        f"{'; drawn ten times as large' if enlarged(each) else ''}"
        for name, each in shown.items()
    )
    return (Card((drawing, Bullets(lines), Text("Dashed: the axes as estimated.")), style="sketch"),)


def _parameter_table(c: Calibration) -> Table:
    columns: Columns = (
        *("parameter", "value", "sigma", Column("unit", "text"), "prior", "required", Column("verdict", "text")),
        *_error_column(c),
    )
    rows: list[Row] = []
    for q, p in _rows(c):
        require = "" if p.require is None else rounded(human_unit(q)[1] * p.require, 3)
        verdict = p.observability or ""
        rows.append((*_estimate_cells(c, q), require, Cell(verdict, tone=verdict), *_error_cells(c, q)))
    caption = "Sigma, prior and required are standard deviations in the unit of the row."
    if c.truth is not None:
        caption += " Error is the estimate minus the truth that came with the recording; nothing else uses that truth."
    return Table("", caption, columns, tuple(rows), "parameters", "dense", None)


def _nuisance_parameters(c: Calibration) -> tuple[Block, ...]:
    columns: Columns = ("parameter", "value", "sigma", Column("unit", "text"), "prior", "z-score", *_error_column(c))
    rows = tuple(
        (*_estimate_cells(c, q), "" if p.pull is None else signed(p.pull), *_error_cells(c, q))
        for q, p in _rows(c, nuisance=True)
    )
    caption = (
        "Sensor errors, estimated with data-sheet priors (`sensors` in the config). z-score: (estimate - prior mean) "
        "over its expected spread; none where the recording has no information."
    )
    return (Table("", caption, columns, rows, "assumptions", "dense", None),) if rows else ()


def _rows(c: Calibration, nuisance: bool = False) -> list[tuple[Quantity, ParameterResult]]:
    """The calibrated or the nuisance parameters of the estimate."""
    pairs = zip(quantities_of(c.problem, c.estimate), c.parameters.values(), strict=True)
    return [(q, p) for q, p in pairs if (p.group is not None) == nuisance]


def _estimate_cells(c: Calibration, q: Quantity) -> tuple[Cell | str, ...]:
    """Name, value, sigma, unit and prior."""
    p, (unit, factor) = c.parameters[q.name], human_unit(q)
    numbers = (p.value, p.sigma) if _is_known(q, p) else ()
    value, sigma = (to_digits_of(factor * x, factor * p.sigma) for x in numbers) if numbers else ("unknown", "unknown")
    prior = "free" if p.prior_sigma is None else rounded(factor * p.prior_sigma, 3)
    return Cell(p.name, meaning(c.method, p.name)), value, sigma, unit, prior


def _is_known(q: Quantity, p: ParameterResult) -> bool:
    return p.sigma < _MAX_SIGMA_OVER_PRIOR * q.scale


def _error_column(c: Calibration) -> tuple[Column, ...]:
    return () if c.truth is None else (Column("error", wide=True),)


def _error_cells(c: Calibration, q: Quantity) -> tuple[str, ...]:
    """The error where the truth is known; no cell without a truth."""
    if c.truth is None:
        return ()
    p, error, factor = c.parameters[q.name], truth_errors(c).get(q.name), human_unit(q)[1]
    if error is None or not _is_known(q, p):
        return ("",)
    in_sigmas = "" if error.error_sigmas is None else f" ({signed(error.error_sigmas)} σ)"
    return (to_digits_of(factor * error.error, factor * p.sigma) + in_sigmas,)


def _application(c: Calibration, file: SavedCalibration) -> tuple[Block, ...]:
    """The formulas, and code with the numbers in it; none of a result that is not to be applied."""
    needed = " ".join(formula.expression for formula in c.formulas)
    constants = [f"{name} = {value:.6g}" for name, value in c.problem.constants.items() if name in needed]
    formulas = tuple(f"`{line}`" for line in (*(formula.text for formula in c.formulas), *constants))
    if not formulas or c.status not in ("calibrated", "weak"):
        return ()
    values = {name: c.parameters[name].value for name in c.applied if name in c.parameters}
    numbers = {**c.problem.constants, **values}
    code: list[tuple[str, str]] = []
    # A plug-in may write formulas that only a person can read.
    with suppress(ValueError, KeyError, SyntaxError):
        code = [(name, generate(c.formulas, numbers)) for name, generate in _LANGUAGES.items()]
    code.append(("ROS 2 parameters", ros_parameters(file, list(values))))
    said = Text(
        "SI units. calibration.yaml has the numbers, and rotations as quaternions; the same with these numbers in it:"
    )
    snippets = (Details(language, (Code(text, copied=True),), "screen") for language, text in code)
    return (Card((Bullets(formulas), said, *snippets), id="apply"),)


def _noise(c: Calibration) -> tuple[Block, ...]:
    columns: Columns = (
        "noise",
        Column("unit", "text"),
        Column("source", "text", label="stated by"),
        *("stated", "estimated", "sigma", "used"),
        Column("used, SI", "text", wide=True),
        "inflation",
    )
    rows: list[Row] = []
    for n in c.noises:
        unit, factor = noise_unit(n.name, n.unit)
        estimated, sigma = (
            "" if number is None else rounded(factor * number, digits)
            for number, digits in ((n.estimated, 3), (n.sigma, 1))
        )
        in_si = "" if factor == 1.0 else f"{n.used:.3g} {n.unit}"
        inflation = f"{n.inflation:.2f}" if n.inflation > 1.0 else ""
        numbers = (rounded(factor * n.stated, 3), estimated, sigma, rounded(factor * n.used, 3))
        rows.append((Cell(n.name, NOISES.get(n.name, "")), unit, n.source, *numbers, in_si, inflation))
    caption = (
        "Estimated: from residuals or samples. Used: weighted mean of stated and estimated, weights from "
        "`noise_known`. Inflation: factor of sigma due to time correlation, already included."
    )
    return (Table("", caption, columns, tuple(rows), "noise", "dense", None),) if rows else ()


def _error_budget(c: Calibration) -> tuple[Block, ...]:
    found = limits(c.budget or {}, c.problem.quantities)
    if not found:
        return ()
    rows = tuple(
        (
            limit.name,
            Cell(
                ", ".join(f"{100.0 * share:.0f} % {source}" for source, share in limit.parts),
                shares=tuple(share for _, share in limit.parts),
            ),
        )
        for limit in found
    )
    caption = "Contribution of each noise and each prior to the variance; the shares sum to one."
    table = Table(
        "", caption, ("parameter", Column("shares of its variance", "prose")), rows, "budget", "lines columns"
    )
    advice = tuple(f"{limit.sentence}." for limit in _least_accurate(c, found))
    return (table, Card((Bullets(advice),))) if advice else (table,)


def _least_accurate(c: Calibration, found: Sequence[Limit]) -> list[Limit]:
    """Those of parameters less accurate than required; where all meet it, of the one nearest to it."""
    ratios = {p.name: p.sigma / p.require for p in c.parameters.values() if p.require}
    known = [limit for limit in found if limit.name in ratios]
    short = [limit for limit in known if ratios[limit.name] > 1.0]
    return short or sorted(known, key=lambda limit: -ratios[limit.name])[:1]


def _fixed_inputs(c: Calibration) -> tuple[Block, ...]:
    """The effect of a typical error of each fixed input, the largest first."""
    quantities = {q.name: q for q in c.problem.quantities if not q.assumed}
    rows: list[Row] = []
    for name, sensitivity in (c.sensitivity or {}).items():
        step, unit = sensitivity.step, sensitivity.unit
        sigmas = {p: c.parameters[p].sigma for p in quantities if p in sensitivity.parameters}
        shifts = {p: step * sensitivity.parameters[p] for p in sigmas}
        noticed = [p for p in shifts if abs(shifts[p]) > _MIN_EFFECT_SIGMAS * sigmas[p]]
        noticed.sort(key=lambda p: -abs(shifts[p]) / sigmas[p])
        effects = [_effect(quantities[p], shifts[p], sigmas[p]) for p in noticed[:_MAX_EFFECTS]]
        if len(noticed) > len(effects):
            effects.append(f"{len(noticed) - len(effects)} more by less")
        typical = f"{100.0 * step:g} %" if unit == "1" else f"{step:g} {unit}"
        rows.append((name, typical, ", ".join(effects) or "nothing noticeably"))
    caption = (
        "Effect of a typical error of inputs that are not estimated, in sigmas of the parameters; the sigmas do not "
        "include it."
    )
    columns: Columns = ("input", "off by", Column("moves", "prose"))
    return (Table("", caption, columns, tuple(rows), "exact", most_rows=None),) if rows else ()


def _effect(quantity: Quantity, shift: float, sigma: float) -> str:
    unit, factor = human_unit(quantity)
    size = f"{to_digits_of(factor * shift, factor * sigma)} {unit}".strip()
    return f"{quantity.name} {signed(shift / sigma)} σ ({size})"


def _influential_measurements(c: Calibration) -> tuple[Block, ...]:
    columns: Columns = ("family", "time, s", Column("moves most", "text", wide=True), "in its sigmas")
    rows = tuple((m.family, f"{m.time_s:.2f}", m.parameter, signed(m.pull, 2)) for m in c.measurements or ())
    caption = "Shift of the parameter if the measurement is left out, in sigmas. Undetected outliers rank first."
    return (Table("", caption, columns, rows, "measurements", "short-rows", 0),) if rows else ()


def _time_to_accuracy(c: Calibration) -> tuple[Block, ...]:
    columns: Columns = (
        "parameter",
        *(Column(head, wide=True) for head in ("as required from, s", "most information, s")),
        "its share",
    )
    rows = tuple(
        (
            name,
            "never" if found.met_s is None else f"{found.met_s:.1f}",
            f"{found.stretch[0]:.1f} … {found.stretch[1]:.1f}",
            f"{100.0 * found.share:.0f} %",
        )
        for name, found in c.learning.items()
    )
    return (Table("", "", columns, rows, "learning", "columns"),) if rows else ()


def _goodness_of_fit(c: Calibration) -> tuple[Block, ...]:
    if c.fit is None:
        return ()
    interval = Column("99.9 % interval", wide=True)
    rows = tuple(_fit_row(family, fit) for family, fit in {**c.family_fits, "whole": c.fit}.items())
    columns: Columns = ("family", "chi-square", "degrees of freedom", interval, "noise factor")
    caption = "Noise factor: by what the noise used would have to be multiplied to fit the residuals."
    blocks: list[Block] = [Table("", caption, columns, rows, style="", most_rows=None)]
    if c.innovations:
        heads = ("mean NIS", interval, Column("autocorrelation at lag 1", wide=True), "largest of 5 lags", "bound")
        caption = (
            "Innovations (measurement minus prediction) are white if the model is right. An autocorrelation beyond "
            "the bound is an unmodelled effect, most often a time offset."
        )
        rows = tuple(
            (
                family,
                f"{i.nis:.3f}",
                f"{i.low:.3f} … {i.high:.3f}",
                f"{i.autocorrelation[0]:+.3f}",
                f"{max(map(abs, i.autocorrelation)):.3f}",
                f"{i.bound:.3f}",
            )
            for family, i in c.innovations.items()
        )
        blocks.append(Table("", caption, ("innovations of", *heads), rows, "innovations", "", None))
    if c.causes:
        lines = tuple(f"{label}: {evidence}." for label, evidence in c.causes)
        how = "Faults of the data are tested by solving again with them corrected, on the segment that fits worst."
        blocks.append(Card((Bullets(lines), Text(how)), "Tested hypotheses", "causes"))
    return tuple(blocks)


def _fit_row(family: str, fit: Fit) -> tuple[str, ...]:
    sums = (family, f"{fit.value:.1f}", f"{fit.dof:.1f}")
    return (*sums, f"{fit.low:.1f} … {fit.high:.1f}", f"{fit.noise_factor:.2f}") if fit.dof >= 1 else (*sums, "", "")


def _stability(c: Calibration) -> tuple[Block, ...]:
    """The result of the change test, where it was made."""
    if c.stability is None:
        return ()
    changes = [sentences.sentence(f, c.quantities) for f in c.findings if f.kind in ("change", "jump")]
    name = next(iter(c.stability.departures), "")
    unchanged = (
        f"No significant change: the largest is at {c.stability.time_s:.0f} s, mostly of {name} "
        f"(p = {min(c.stability.level, 1.0):.2g})."
    )
    return (Card((Text(changes[0] if changes else unchanged, soft=False),), id="stability"),)


def _recording(c: Calibration) -> tuple[Block, ...]:
    columns: Columns = ("topic", "messages", "rate, Hz", "largest gap, s", "at, s", "duplicates", "out of order")
    rows = tuple(
        (
            t.name,
            str(t.count),
            *(
                "" if number is None else f"{number:.{digits}f}"
                for number, digits in ((t.rate_hz, 1), (t.largest_gap_s, 3), (t.largest_gap_at_s, 1))
            ),
            str(t.duplicates),
            str(t.out_of_order),
        )
        for t in c.facts.topics
    )
    notes = tuple(Text(f"{note[:1].upper()}{note[1:]}.") for note in c.facts.notes)
    lost = tuple(f"{reason}: {count}" for reason, count in c.dropped.items())
    left_out = (Card((Bullets(lost),), "Left out"),) if lost else ()
    return (Table("", "", columns, rows, style="", most_rows=None), *notes, *left_out)


def _provenance(c: Calibration) -> tuple[Block, ...]:
    timing = ", ".join(f"{phase} {seconds:.2f}" for phase, seconds in c.timing.items())
    lines = (
        f"SHA-256 of the recording: `{c.sha256}`",
        f"Solver: {c.estimate.solver}, {c.estimate.message}. Time, s: {timing}.",
        ", ".join(f"{package} {version}" for package, version in c.software.items()),
    )
    config = (Details("Config", (Code(c.config_text),), id="config"),) if c.config_text else ()
    return (Card((*map(Text, lines), *config)),)
