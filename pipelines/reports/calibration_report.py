"""report.html: a calibration as a report, one function per section."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress

from alidade.factors import so3
from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.diagnostics.observability import has_no_solution
from alidade.pipelines.diagnostics.use import UseBands
from alidade.pipelines.display.drawing import rotation_text, sketch_with
from alidade.pipelines.display.figure import Dash, Figure, Plot
from alidade.pipelines.display.table import Cell, Column, Columns, Row, Table
from alidade.pipelines.display.units import human_unit, noise_unit, rounded, signed, to_digits_of
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.methods.triads import TRIADS
from alidade.pipelines.noises import NOISES
from alidade.pipelines.reports import sentences
from alidade.pipelines.reports.calibration import SavedCalibration, saved
from alidade.pipelines.reports.export_formats import ros_parameters
from alidade.pipelines.reports.html import Page, render_html
from alidade.pipelines.reports.plots import common_plots
from alidade.pipelines.reports.report import (
    Badge,
    Block,
    Bullets,
    Card,
    Code,
    Curves,
    Details,
    Heading,
    Plots,
    Report,
    Section,
    Summary,
    Svg,
    Tables,
    Text,
    Tile,
    Tiles,
    Tone,
)
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import TruthResult, truth_errors
from alidade.pipelines.reports.results_table import (
    LEGEND,
    MAX_SIGMA_OVER_PRIOR,
    ResultCard,
    ResultGroup,
    ResultRow,
    group_of,
    matrix_texts,
    result_cards,
    result_table,
)
from alidade.pipelines.reports.sentences import limits
from alidade.pipelines.reports.snippets import c_code, python_code

# Effects of fixed inputs that are named: the smallest, in sigmas of the parameter, and how many.
_MIN_EFFECT_SIGMAS, _MAX_EFFECTS = 0.1, 6
_TONES: dict[str, Tone] = {"calibrated": "good", "weak": "warn", "unobservable": "bad", "inconsistent": "bad"}
_CALL = "found = calibration.apply({})  # by name: everything that the formulas give"
# Badges: inflation of sigmas, share of a family that is rejected, noise used over stated and its inverse.
_NOTABLE_INFLATION, _NOTABLE_REJECTION, _NOTABLE_NOISE = 1.1, 0.1, 2.0
# Ratio from which on two bounds are said to differ.
_GAIN = 1.2
# Parameters whose error budget is shown: those nearest to their requirement.
_MAX_BUDGET = 8
# Height of the curves of a use, and the dashes of its lines.
_CURVE_PX = 236
_DASHES: tuple[Dash, ...] = ("solid", "dashed", "dotdash", "dotted")
_LANGUAGES = {"Python": python_code, "C": c_code}


def report_html(calibration: Calibration) -> str:
    """Return the report of a calibration as one HTML text."""
    return render_html(calibration_report(calibration))


def short_report(calibration: Calibration) -> Report:
    """Short report for terminal and notebook: verdict, uses and results."""
    return _report(calibration, ())


def calibration_report(calibration: Calibration) -> Report:
    """The report of a calibration: verdict, results, use; how to apply it; diagnostics; collapsed details."""
    c, file = calibration, saved(calibration)
    return _report(
        c,
        (
            Section("Uncertainty in use", tuple(_use_card(found) for found in c.uses), printed="never"),
            Section("Frames", _frames(c, file), printed="never"),
            Section("Apply", _application(c, file), printed="never", narrow_collapsed=True),
            Section("Diagnostics", _diagnostics(c), printed="on request", narrow_collapsed=True),
            Section("Details", _details(c), printed="on request"),
        ),
    )


def _report(c: Calibration, more: Sequence[Section]) -> Report:
    about = [
        c.recording,
        f"{c.start[:19].replace('T', ' ')} UTC",
        f"{c.facts.duration_s:.1f} s",
        f"{c.estimate.solver} solver",
        f"alidade {c.software.get('alidade', '')}",
    ]
    cards = result_cards(c)
    return Report(
        title=f"{c.problem.method}: {c.status} ({c.recording})",
        heading=f"{c.method.title} calibration",
        about=" · ".join(about),
        summary=summary_of(c, cards),
        sections=(
            Section("", (Tiles(tuple(map(_tile, c.uses))),) if c.uses else ()),
            Section("Results", _results(c, cards)),
            *more,
        ),
    )


def plotted(calibration: Calibration, name: str | None) -> Page:
    """Return the figures of a report, all or the named one, as a page. Raises InputError for an unknown name."""
    uses = {found.use.name: found for found in calibration.uses}
    plots = {plot.title: plot for plot in _plots(calibration)}
    if name is not None and name not in uses and name not in plots:
        raise InputError(f"no plot {name!r}; there are {', '.join([*uses, *plots])}")
    blocks: list[Block] = [_use_card(found) for key, found in uses.items() if name in (None, key)]
    shown = tuple(plot for title, plot in plots.items() if name in (None, title))
    blocks += [Plots(shown)] if shown else []
    about = f"{calibration.recording} · {calibration.status}"
    page = Report(
        f"{calibration.method.title}: figures", calibration.method.title, about, (Section("", tuple(blocks)),)
    )
    return Page(render_html(page))


def _plots(c: Calibration) -> list[Plot]:
    own = list(c.plots(c)) if c.plots else []
    return [*(each for each in own if isinstance(each, Plot)), *common_plots(c)]


def summary_of(c: Calibration, cards: Sequence[ResultCard]) -> Summary:
    """Return the summary of a calibration: the verdict and what to do, a sentence each, and badges."""
    rows = [(card, group, row) for card in cards for group, row in card.rows if row.require and row.sigma > 0.0]
    missed = [name for name, verdict in c.verdicts.items() if verdict in ("weak", "unobservable")]
    if missed and all(row.ratio <= 1.0 for _, _, row in rows):  # what is derived of parameters may miss nothing
        groups = [group_of(c, c.method.describe(name).removesuffix("."), "", [name]) for name in missed]
        rows = [(ResultCard("", (group,)), group, group.rows[0]) for group in groups]
    worst = max(rows, key=lambda found: found[2].ratio, default=None)
    text, action = sentences.short_verdict(
        c.findings, c.quantities, c.verdicts, _nearest(*worst, bool(missed)) if worst else ""
    )
    steps = (action,) if action else ()
    return Summary("", c.status, _TONES[c.status], text, c.notes, steps, tuple(_badges(c)))


def _nearest(card: ResultCard, group: ResultGroup, row: ResultRow, missed: bool) -> str:
    """Return a phrase on the result that is closest to its requirement, or farthest beyond."""
    what = f"{group.title[:1].lower()}{group.title[1:]}"
    label = f" {row.label}" if len(group.rows) > 1 else ""
    name = f"{what}{label}, {card.title.lower()}" if len(row.names) > 1 else f"{row.names[0]} ({what})"
    if not missed:
        return f"; the closest is {name}, at {100.0 * row.ratio:.2g} % of the requirement"
    for digits in range(2, 7):  # as many as distinguish the two
        sigma, require = rounded(row.sigma, digits), rounded(row.require or 0.0, digits)
        if sigma != require:
            break
    return f", worst {name}: ± {sigma} {group.unit} where {require} is required"


def _badges(c: Calibration) -> Iterator[Badge]:
    """Yield badges: inflation, rejections, noise, priors, change, misfit, error if simulated."""
    if has_no_solution(c.findings):
        return
    inflation = max((p.inflation for p in c.parameters.values()), default=1.0)
    if inflation > _NOTABLE_INFLATION:
        yield Badge(f"sigmas × {inflation:.1f} for correlated noise", "warn", "included in all sigmas")
    slow = sentences.slow_error(c.findings)
    if slow > sentences.SLOW_ERROR_WARNING:
        yield Badge(f"sigmas × {slow:.1f} for slow errors", "warn", "included in all sigmas")
    for family, residuals in c.residuals.items():
        share = 1.0 - float(residuals.used.mean()) if len(residuals.used) else 0.0
        if share > _NOTABLE_REJECTION:
            yield Badge(f"{100.0 * share:.0f} % of {family} rejected", "warn", "measurements that fit no solution")
    for n in c.noises:
        if n.correlation_time is not None:
            size = sentences.correlated_size(n.name, n.unit, n.used, n.correlation_time)
            yield Badge(f"{n.name} {size}", "warn", "errors correlated in time, included in all sigmas")
        elif n.stated and not 1.0 / _NOTABLE_NOISE < n.used / n.stated < _NOTABLE_NOISE:
            by = "the default" if n.source == "default" else "stated"
            yield Badge(f"{n.name} {rounded(n.used / n.stated)} × {by}", "warn", f"noise, by {n.source}")
    alone = [name for name, each in c.verdicts.items() if each == "prior"]
    if alone:
        more = f" + {len(alone) - 1}" if len(alone) > 1 else ""
        yield Badge(f"prior alone: {alone[0]}{more}", "warn", "within the requirement by the prior alone")
    if c.fit is not None:
        fits = c.fit.low <= c.fit.value <= c.fit.high
        text = "fit as expected" if fits else f"misfit: residuals {c.fit.noise_factor:.2g} × the noise"
        yield Badge(text, "good" if fits else "warn", "99.9 % interval of chi-square")
    if c.stability is not None:
        yield _stability_badge(c.stability.changed, c.findings)
    errors = [abs(e.error_sigmas) for e in truth_errors(c).values() if e.error_sigmas is not None]
    if errors:
        yield Badge(f"simulated: largest error {max(errors):.1f} σ of {len(errors)}", "fixed")


def _stability_badge(changed: bool, findings: Sequence[Finding]) -> Badge:
    if changed:
        return Badge("changed during the recording", "bad", "parameters differ before and after")
    moved = next((finding.kind for finding in findings if finding.kind in sentences.MOVES), "")
    if moved:
        return Badge("vision jumped" if moved == "jump" else "small change", "warn", "see the findings")
    return Badge("stable", "good", "no significant change during the recording")


def _tile(found: UseBands) -> Tile:
    use = found.use
    gain = found.before / found.after if found.after > 0.0 else math.inf
    times = f", {rounded(gain)} times less" if gain > _GAIN else ", not improved"
    figure = ("± " if use.signed else "") + rounded(found.after)
    note = f"{rounded(found.before, 3)} {use.unit} before{times}"
    return Tile(use.label, figure, f"{use.unit}, 95 %", note, "" if gain > _GAIN else "warn")


def _results(c: Calibration, cards: Sequence[ResultCard]) -> tuple[Block, ...]:
    """Return the result cards; cards of nuisance parameters alone are collapsed if all of these are determined."""
    known = "; ▾ simulated truth" if truth_errors(c) else ""
    beside = [card for card in cards if card is not cards[0] and _is_beside(c, card)]
    shown = tuple(result_table(card) for card in cards if card not in beside)
    blocks: list[Block] = [Tables(shown, style="cards"), Text(f"{LEGEND}{known}.")]
    if beside:
        names = ", ".join(f"{g.title[:1].lower()}{g.title[1:]}" for card in beside for g in card.groups)
        blocks.append(Details(f"Beside these: {names}", (Tables(tuple(map(result_table, beside)), "cards"),), "fold"))
    return tuple(blocks)


def _is_beside(c: Calibration, card: ResultCard) -> bool:
    """Whether a card has nuisance parameters only, all of them determined."""
    names = [name for _, row in card.rows for name in row.names]
    return all(c.quantities[name].assumed for name in names) and not any(
        row.verdict in ("weak", "unobservable") for _, row in card.rows
    )


def _use_card(found: UseBands) -> Card:
    """Return a card with the error before and after calibration over the operating points, and the formula."""
    use = found.use
    sign = "± " if use.signed else ""
    before, after = rounded(found.before, 3), rounded(found.after)
    parts = [f"Before: 95 % within {sign}{before} {use.unit}. After: within {sign}{after} {use.unit}."]
    if found.required:
        parts.append(f"Parameters just at their requirements would allow {rounded(found.required)} {use.unit}.")
    alone = found.figure(lambda band: band.uncorrelated) / max(found.figure(lambda band: band.bound), 1e-300)
    if not 1.0 / _GAIN < alone < _GAIN:
        parts.append(f"From the sigmas alone, without correlations, the band would be {rounded(alone)} times as wide.")
    whole = found.figure(lambda band: band.whole)
    if whole > 0.0 and found.figure(lambda band: band.bound) / whole > _GAIN:
        parts.append(f"Applying all estimates, undetermined ones too, would leave {sign}{rounded(whole)} {use.unit}.")
    if found.drawn:
        parts.append("The error is not linear: bounds are quantiles of 4,000 draws.")
    plain, applied = (Figure(use.y_title, use.x_title, _CURVE_PX) for _ in range(2))
    for line, dash in zip(use.lines, _DASHES, strict=False):
        band, f = found.bands[line.name], use.factor
        plain.band(use.x, f * band.before_bounds[0], f * band.before_bounds[1], line.color, line.name)
        plain.line(use.x, f * band.before, line.name, line.color, dash)
        low, high = (band.after - band.bound, band.after + band.bound) if use.signed else (0.0 * band.bound, band.bound)
        applied.band(use.x, f * low, f * high, line.color, line.name)
        applied.line(use.x, f * high, line.name, line.color, dash)
        if use.signed:
            applied.line(use.x, f * low, line.name, line.color, dash)
        if band.actual is not None:
            applied.line(use.x, f * band.actual, "actual", line.color, "dotted", width=2.0)
    legend = [(line.name, line.color, dash) for line, dash in zip(use.lines, _DASHES, strict=False)]
    legend += [("actual error (simulated truth)", "ink", "dotted")] if applied.named("actual") else []
    spread = "shown is m ± 1.96 √S" if use.signed else "shown is the length of e with the 95 % quantile of |N(m, S)|"
    formula = (
        Code(use.formula),
        Text(f"Band: S = J P Jᵀ + N, P the joint covariance of all parameters, J = ∂e/∂(true parameters); {spread}."),
    )
    captions = ("Before calibration", "After calibration: 95 % band" if use.signed else "After calibration: 95 % bound")
    curves = Curves(tuple(zip(captions, (plain, applied), strict=True)), tuple(legend))
    condition = Text(f"{sentences.capital(use.condition)}.")
    return Card(
        (
            Text(" ".join(parts), style=""),
            curves,
            condition,
            *_coefficients(found),
            Details("Formula", formula, "screen"),
        ),
        use.title,
        f"use-{use.name}",
    )


def _coefficients(found: UseBands) -> tuple[Block, ...]:
    """Return a table of the coefficients of each curve with their sigmas, before and after calibration."""
    use = found.use
    if use.coefficients is None:
        return ()
    rows = [
        (name, line, *(rounded(use.factor * number, 3) if math.isfinite(number) else "none" for number in numbers))
        for line, band in found.bands.items()
        if band.coefficients is not None
        for name, numbers in zip(use.coefficients.names, band.coefficients, strict=True)
    ]
    columns: Columns = ("coefficient", Column("", "text"), f"before, {use.unit}", "σ", f"after, {use.unit}", "σ")
    table = Table("", use.coefficients.formula, columns, tuple(rows), "", "small", None)
    return (Details("Coefficients of the deviation", (table,), "screen"),)


def _diagnostics(c: Calibration) -> tuple[Block, ...]:
    """Return the diagnostics: fit, noise, stability, error budget, and the method's own tables."""
    own = tuple(each for each in (c.plots(c) if c.plots else ()) if isinstance(each, Table))
    fit, *more = _goodness_of_fit(c) or (None,)
    beside = tuple(table for table in (fit, _noise(c)) if isinstance(table, Table))
    return (
        *((Tables(beside, "pair"),) if beside else ()),
        *more,
        *_titled("Stability during the recording", _stability(c)),
        *_titled("Error budget", _error_budget(c)),
        *((Tables(own),) if own else ()),
    )


def _titled(title: str, blocks: tuple[Block, ...]) -> tuple[Block, ...]:
    return (Heading(title), *blocks) if blocks else ()


def _details(c: Calibration) -> tuple[Block, ...]:
    """Return further details, which the page collapses."""
    matrices = tuple(Code(text, copied=True) for text in matrix_texts(c))
    plots = tuple(_plots(c))
    parts: list[tuple[str, tuple[Block, ...]]] = [
        ("All findings", (Text(c.headline, style=""),)),
        ("Unobservable and weak directions", direction_blocks(c.findings)),
        ("Parameters", _parameters(c)),
        ("Nuisance parameters", _parameters(c, nuisance=True)),
        ("K matrices and offsets b", matrices),
        ("Sensitivity to fixed inputs", _fixed_inputs(c)),
        ("Most influential measurements", _influential_measurements(c)),
        ("Time to required accuracy", _time_to_accuracy(c)),
        ("Plots", (Plots(plots),) if plots else ()),
        ("Recording", _recording(c)),
        ("Provenance", _provenance(c)),
    ]
    unprinted = ("K matrices and offsets b",)  # the numbers are among the parameters
    return tuple(
        Details(title, blocks, "fold screen" if title in unprinted else "fold", title.lower().replace(" ", "-"))
        for title, blocks in parts
        if blocks
    )


def direction_blocks(findings: Sequence[Finding]) -> tuple[Block, ...]:
    """Return a table of weak directions, those with the same advice in one row, and the weights of each."""
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
    """Return the method's sketch with the estimated mounts drawn in."""
    if c.method.frames is None:
        return ()
    svg = c.method.frames.read_text(encoding="utf-8")
    shown = {name: so3.log(each.wxyz) for name, each in file.transforms.items() if f'data-turn="{name}"' in svg}
    drawing = Svg(sketch_with(svg, shown))
    if not shown:
        return (Card((drawing,), style="sketch"),)
    lines = (
        f"{name}, {file.transforms[name].child} to {file.transforms[name].parent}: {rotation_text(turn)}"
        for name, turn in shown.items()
    )
    return (Card((drawing, Bullets(tuple(lines)), Text("Dashed: the axes as estimated.")), style="sketch"),)


def _parameters(c: Calibration, nuisance: bool = False) -> tuple[Block, ...]:
    """Return a table of the calibrated or of the nuisance parameters; their errors too where the truth is known."""
    own: Columns = ("z-score",) if nuisance else ("required", Column("verdict", "text"))
    error = () if c.truth is None else (Column("error", wide=True),)
    errors = truth_errors(c)
    rows: list[Row] = []
    for p in c.parameters.values():
        q = c.quantities[p.name]
        unit, factor = human_unit(q)
        if (p.group is not None) != nuisance:
            continue
        is_known = p.sigma < MAX_SIGMA_OVER_PRIOR * q.scale
        value, sigma = (
            to_digits_of(factor * x, factor * p.sigma) if is_known else "unknown" for x in (p.value, p.sigma)
        )
        prior = "free" if p.prior_sigma is None else rounded(factor * p.prior_sigma, 3)
        row: Row = (Cell(p.name, c.method.describe(p.name)), value, sigma, unit, prior)
        if nuisance:
            row += ("" if p.pull is None else signed(p.pull),)
        else:
            verdict = p.observability or ""
            row += ("" if p.require is None else rounded(factor * p.require, 3), Cell(verdict, tone=verdict))
        if error:
            row += (_error(errors.get(q.name) if is_known else None, factor, p.sigma),)
        rows.append(row)
    columns: Columns = ("parameter", "value", "sigma", Column("unit", "text"), "prior", *own, *error)
    caption = "Sigma, prior and required are standard deviations in the unit of the row."
    if nuisance:
        caption = (
            "Sensor errors, estimated with data-sheet priors (`sensors` in the config). z-score: (estimate - prior "
            "mean) over its expected spread; none where the recording has no information."
        )
    elif error:
        caption += " Error is the estimate minus the truth that came with the recording; nothing else uses that truth."
    id = "assumptions" if nuisance else "parameters"
    return (Table("", caption, columns, tuple(rows), id, "dense", None),) if rows else ()


def _error(found: TruthResult | None, factor: float, sigma: float) -> str:
    """Write the error of a simulated parameter, SI times `factor`, and its size in sigmas; empty without one."""
    if found is None:
        return ""
    in_sigmas = "" if found.error_sigmas is None else f" ({signed(found.error_sigmas)} σ)"
    return to_digits_of(factor * found.error, factor * sigma) + in_sigmas


def _application(c: Calibration, file: SavedCalibration) -> tuple[Block, ...]:
    """Return the formulas, and code with the numbers in it; nothing for a result that is not to be applied."""
    needed = " ".join(formula.expression for formula in c.formulas)
    constants = [f"{name} = {value:.6g}" for name, value in c.problem.constants.items() if name in needed]
    formulas = tuple(f"`{line}`" for line in (*(formula.text for formula in c.formulas), *constants))
    inputs = dict.fromkeys(name for formula in c.formulas for name in formula.inputs)
    sensors = [name for name in TRIADS if f"{name}_k11" in c.values]
    used = [f'K, bias = calibration.matrix("{name}"), calibration.bias("{name}")' for name in sensors[-1:]]
    session = [
        "import alidade",
        "",
        'calibration = alidade.load("calibration.yaml")',
        *(used or [_CALL.format(", ".join(f"{name}={name}" for name in inputs))]),
    ]
    if not formulas or c.status not in ("calibrated", "weak"):
        return ()
    numbers = {**c.problem.constants, **c.applied_values}
    code: list[tuple[str, str]] = []
    # A plug-in may write formulas that only a person can read.
    with suppress(ValueError, KeyError, SyntaxError):
        code = [(name, generate(c.formulas, numbers)) for name, generate in _LANGUAGES.items()]
    code.append(("ROS 2 parameters", ros_parameters(file, list(c.applied_values))))
    said = Text(
        "SI units. calibration.yaml has the numbers, and rotations as quaternions; the same with these numbers in it:"
    )
    snippets = (Details(language, (Code(text, copied=True),), "screen") for language, text in code)
    formulas_block = Details("Formulas", (Bullets(formulas),))
    return (Card((Code("\n".join(session), copied=True), formulas_block, said, *snippets), id="application"),)


def _noise(c: Calibration) -> Table | None:
    """Return a table of all noises except those that are zero."""
    inflated = any(n.inflation > 1.0 for n in c.noises)
    columns: Columns = (
        "noise",
        Column("unit", "text"),
        "stated",
        "estimated",
        "used",
        *(["inflation"] if inflated else []),
    )
    specs = NOISES | {spec.name: spec for spec in c.method.noise}
    rows: list[Row] = []
    for n in c.noises:
        if not (n.stated or n.used):
            continue
        unit, factor = noise_unit(n.name, n.unit)
        estimated = "" if n.estimated is None else to_digits_of(factor * n.estimated, factor * (n.sigma or 0.0))
        sigma = "" if n.sigma is None else f" ± {rounded(factor * n.sigma)}"
        what = specs[n.name].description if n.name in specs else n.name
        if n.correlation_time is None:
            name = Cell(n.name, hint=f"{what} Stated by {n.source}; {n.used:.3g} {n.unit} used.")
            stated = rounded(factor * n.stated, 3)
        else:
            name, stated = Cell(f"{n.name}, {rounded(n.correlation_time)} s", hint=what), ""
        inflation = (f"{n.inflation:.2f}" if n.inflation > 1.0 else "",) if inflated else ()
        numbers = (stated, estimated + sigma, rounded(factor * n.used, 3))
        rows.append((name, unit, *numbers, *inflation))
    caption = "Estimated from residuals or samples; used: weighted mean of both, weights from `noise_known`."
    if inflated:
        caption += " Inflation: factor of sigma due to time correlation, already included."
    return Table("Noise", caption, columns, tuple(rows), "noise", "small", None) if rows else None


def _error_budget(c: Calibration) -> tuple[Block, ...]:
    ratios = {p.name: p.sigma / p.require for p in c.parameters.values() if p.require}
    found = sorted(limits(c.budget or {}, c.problem.quantities), key=lambda each: -ratios.get(each.name, 0.0))
    found = found[:_MAX_BUDGET]
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
    caption = (
        "Contribution of each noise and each prior to the variance of the parameters nearest to their requirement; the "
        "shares sum to one."
    )
    table = Table(
        "", caption, ("parameter", Column("shares of its variance", "prose")), rows, "budget", "lines columns"
    )
    # Of what misses its requirement; where nothing does, of the one nearest to it.
    required = [limit for limit in found if limit.name in ratios]
    short = [limit for limit in required if ratios[limit.name] > 1.0] or required[:1]
    advice = tuple(f"{limit.sentence}." for limit in short)
    return (table, Card((Bullets(advice),))) if advice else (table,)


def _fixed_inputs(c: Calibration) -> tuple[Block, ...]:
    """Return a table of the effects of a typical error of each fixed input, the largest first."""
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
    rows = tuple((m.family, f"{m.time:.2f}", m.parameter, signed(m.sigmas, 2)) for m in c.estimate.strongest or ())
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
    columns: Columns = ("family", "chi-square", Column("dof", label="degrees of freedom"), interval, "noise factor")
    caption = "Noise factor: by what the noise used would have to be multiplied to fit the residuals."
    blocks: list[Block] = [Table("Goodness of fit", caption, columns, rows, style="small", most_rows=None)]
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
    """Return a card with the result of the change test; nothing if there was no test."""
    if c.stability is None:
        return ()
    changes = [sentences.sentence(f, c.quantities) for f in c.findings if f.kind in ("change", "jump")]
    name = next(iter(c.stability.departures), "")
    unchanged = (
        f"No significant change: the largest is at {c.stability.time_s:.0f} s, mostly of {name} "
        f"(p = {min(c.stability.level, 1.0):.2g})."
    )
    return (Card((Text(changes[0] if changes else unchanged, style=""),), id="stability"),)


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
    notes = tuple(Text(f"{sentences.capital(note)}.") for note in c.facts.notes)
    lost = tuple(f"{reason}: {count}" for reason, count in c.dropped.items())
    left_out = (Card((Bullets(lost),), "Left out"),) if lost else ()
    return (Table("", "", columns, rows, style="", most_rows=None), *notes, *left_out)


def _provenance(c: Calibration) -> tuple[Block, ...]:
    timing = ", ".join(f"{phase} {seconds:.2f}" for phase, seconds in c.timing.items())
    lines = (
        f"SHA-256 of the recording: `{c.sha256}`",
        f"Solver: {c.estimate.solver}, {c.estimate.message}.{f' Time, s: {timing}.' if timing else ''}",
        ", ".join(f"{package} {version}" for package, version in c.software.items()),
    )
    config = (Details("Config", (Code(c.config_text),), id="config"),) if c.config_text else ()
    return (Card((*map(Text, lines), *config)),)
