"""Findings and error budgets in words: headline, notes, next steps. The only place with words about a result.

    headline(findings, quantities, verdicts)

Present tense, standard terms, numbers with units: those of `display/units.py`, to the digits of their sigma.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from alidade.pipelines.diagnostics.change_test import CHANGE
from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.diagnostics.stated_priors import CONFLICT
from alidade.pipelines.display.units import format_estimate, human_unit, noise_unit, rounded, to_digits_of
from alidade.pipelines.estimation.error_map import SOURCE
from alidade.pipelines.estimation.finding import Finding, Severity, status
from alidade.pipelines.estimation.parameters import kind as kind_of
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.solvers.joint import RECORDING, WALK

Quantities = Mapping[str, Quantity]

# Share of the required parameters from which on a calibration as a whole is not determined.
_MOST = 0.5
# Findings of a kind, and parameters or recordings of a finding, that are named.
_MAX_NAMED = 3
# Ratio of sandwich to nominal sigma from which on it is a warning.
SLOW_ERROR_WARNING = 2.0
_DIRECTIONS = {Severity.UNOBSERVABLE: "Not observable", Severity.WEAK: "Less accurate than required"}
_APPLY = (
    "Apply calibration.yaml; later, `alidade validate RECORDING --calibration calibration.yaml` says "
    "whether it still holds."
)
# Kinds of findings on accuracy, which a count of what misses it sums up, and on what did not stay as it was.
_ON_ACCURACY = ("direction", "dominant_prior", "recording")
MOVES = ("change", "jump", "device_change")
_MOVED = "What to do: see what moved at that time; if it may have been the mount, record again."
_WALK = "Calibrate the recordings after the last change together, or let the parameter walk: `share` in the config."
_OF_GYRO = "unit, signs and order of the gyro's axes, and that it belongs to the rest"
_OF_VISION = "that gyro and vision are of one device and time, and the meaning of the quaternions"
_CHECK = {
    "corner_px": "camera_info (lens, size and rectification of the pictures) and the layout of the tags",
    "gyro_density": _OF_GYRO,
    "gyro_rate_noise": _OF_GYRO,
    "vision_attitude": _OF_VISION,
    "vision_rate_noise": _OF_VISION,
    "vision_correlated": _OF_VISION,
}
_PRIOR = "prior of "
# Smaller shares are summed, and so are those after so many.
_LEAST_SHARE, _MOST_PARTS = 0.02, 4
REST = "everything else"
# By the unit of the parameter.
_FAR = {
    "rad": "check the orientation and the axis order of the sensor (`axes:` of its topic turns it, `[x, -y, -z]` by "
    "180 deg about x), or widen the prior",
    "s": "check that both sensors are stamped by one clock, or widen the prior",
}


def headline(findings: Sequence[Finding], quantities: Quantities, verdicts: Mapping[str, str]) -> str:
    """Return the status with all its reasons: the findings that cause it, the most severe first.

    Args:
        findings: of a result, the most severe first.
        quantities: by name.
        verdicts: parameter -> verdict, of those with a required accuracy.
    """
    worst = max((finding.severity for finding in findings), default=Severity.NOTE)
    if worst > Severity.NOTE:
        # Weak directions of a recording that does not fit are no reason for anything.
        return " ".join(
            _sentences([f for f in findings if f.severity >= min(worst, Severity.INCONSISTENT)], quantities)
        )
    estimated = sum(verdict != "fixed" for verdict in verdicts.values())
    by_prior = [name for name, verdict in verdicts.items() if verdict == "prior"]
    but = f", {', '.join(by_prior)} by prior alone" if by_prior else ""
    return f"{estimated} of {estimated} parameters meet the required accuracy{but}.{_warning(findings)}"


def _warning(findings: Sequence[Finding]) -> str:
    """Return a warning, to follow a sentence, if slow errors dominate the sigmas; else empty."""
    worst = slow_error(findings)
    return f" Warning: sigmas × {worst:.2g} for slow errors of a sensor." if worst > SLOW_ERROR_WARNING else ""


def slow_error(findings: Sequence[Finding]) -> float:
    """Return the largest ratio of sandwich to nominal sigma of a required parameter; 1 without such a finding."""
    return max((float(f.evidence["ratio"]) for f in findings if f.kind == "slow_error"), default=1.0)


def short_verdict(
    findings: Sequence[Finding], quantities: Quantities, verdicts: Mapping[str, str], worst: str
) -> tuple[str, str]:
    """One sentence about the result, and one about what to do.

    Args:
        findings: of a result, the most severe first.
        quantities: by name.
        verdicts: parameter -> verdict, of those with a required accuracy.
        worst: phrase on the number nearest to its requirement, or farthest beyond, with the comma or semicolon before
            it; empty: there is none.
    """
    advice = [what for _, what in by_advice(findings)]
    more = f"; {len(advice) - 1} more under Details" if len(advice) > 1 else ""
    action = f"What to do: {advice[0]}{more}." if advice else ""
    required = [name for name, verdict in verdicts.items() if verdict != "fixed"]
    missed = [name for name in required if verdicts[name] in ("weak", "unobservable")]
    state = status(findings)
    if state == "inconsistent" or any(finding.kind == "not_converged" for finding in findings):
        first = next(f for f in findings if f.severity > Severity.NOTE)
        if first.kind in ("device_change", "recordings_disagree"):
            return sentence(first, quantities), _WALK
        what = [" ".join(found) for f in findings if f is not first and (found := cause(f, quantities))][:1]
        probable = f" {what[0]}." if what and first.kind not in _CAUSES else ""
        sheets = _sheets([f for f in findings if f.severity > Severity.NOTE], quantities)
        action = f"Do not use the values before the cause is found.{probable} {sheets}"
        return sentence(first, quantities), action.rstrip()
    if state == "calibrated":
        text = f"All {len(required)} required parameters are within their required accuracy{worst}.{_warning(findings)}"
        return text, _APPLY
    directions = sum(f.kind == "direction" and f.severity == Severity.UNOBSERVABLE for f in findings)
    if state == "weak" or not directions:
        accuracy = [f"{len(missed)} of {len(required)} parameters miss their required accuracy{worst}."] * bool(missed)
        beside = [f for f in findings if f.severity > Severity.NOTE and not (missed and f.kind in _ON_ACCURACY)][:1]
        moved = [_MOVED for f in beside if f.kind in MOVES]
        return " ".join([*(sentence(f, quantities) for f in beside), *accuracy]), " ".join(
            [*filter(None, [action]), *moved]
        )
    if len(missed) > _MOST * len(required):
        return (
            f"The recording does not determine this calibration: {len(missed)} of {len(required)} parameters miss "
            f"their required accuracy, {directions} combinations are not observable.",
            action,
        )
    return f"The recording does not determine {directions} combinations of parameters; the others may be used.", action


def notes(findings: Sequence[Finding], quantities: Quantities) -> tuple[str, ...]:
    """Sentences that a reader needs beside the headline, without full stops."""
    found = _sentences([finding for finding in findings if finding.severity == Severity.NOTE], quantities)
    return tuple(text.removesuffix(".") for text in found)


def sentence(finding: Finding, quantities: Quantities) -> str:
    """Return one finding in words."""
    return _WORDS[finding.kind](finding.evidence, finding.severity, quantities)


def cause(finding: Finding, quantities: Quantities) -> tuple[str, str] | None:
    """Return label and evidence of a finding that may explain others; None for any other finding."""
    if finding.kind not in _CAUSES or finding.severity == Severity.NOTE:
        return None
    return _CAUSES[finding.kind](finding.evidence, finding.severity, quantities)


def label(weights: Mapping[str, float]) -> str:
    """Return the parameters of a direction, which trade against each other, as a phrase."""
    first, *others = weights
    return f"{first} against {', '.join(others)}" if others else first


def by_advice(findings: Sequence[Finding], *severities: Severity) -> list[tuple[str, str]]:
    """Return (labels, advice) of directions of these severities (none: all), one pair for each advice."""
    labels: dict[str, list[str]] = {}
    for finding in findings:
        if finding.kind == "direction" and (not severities or finding.severity in severities):
            labels.setdefault(finding.evidence["advice"], []).append(label(finding.evidence["weights"]))
    return [("; ".join(dict.fromkeys(group)), advice) for advice, group in labels.items()]


def capital(text: str) -> str:
    """Return a text with a capital letter, unless it begins with the name of a parameter or topic."""
    first = text.split(" ", 1)[0]
    return text if "_" in first or "/" in first else text[:1].upper() + text[1:]


def _sentences(findings: Sequence[Finding], quantities: Quantities) -> Iterator[str]:
    """Yield sentences on findings in their order: directions grouped by advice, of other kinds the first ones."""
    for (kind, severity), group in groupby(findings, key=lambda finding: (finding.kind, finding.severity)):
        each = list(group)
        if kind == "direction":
            for labels, advice in by_advice(each):
                ratios = [f.evidence["sigma_ratio"] for f in each if f.evidence["advice"] == advice]
                yield _weak(severity, labels, max(ratios), advice)
            continue
        yield from (sentence(finding, quantities) for finding in each[: None if kind == "remark" else _MAX_NAMED])
        if kind != "remark" and len(each) > _MAX_NAMED:
            yield f"{len(each) - _MAX_NAMED} more of this kind in result.json."
        if sheets := _sheets(each, quantities):
            yield sheets


def _sheets(findings: Sequence[Finding], quantities: Quantities) -> str:
    """Return the config's keys that would allow for conflicts with data sheets or priors; empty without conflicts.

    None allows for a reversed axis, whose scale is -2, for a dead one, -1, or for a negative filter of vision.
    """
    stated: dict[str, dict[str, float]] = {}  # sensor, or none for `priors` -> figure or parameter -> size
    faults = []
    for e in (finding.evidence for finding in findings if finding.kind == "prior_conflict"):
        q = quantities[e["parameter"]]
        if e["value"] < -1.5 and "_scale_" in q.name:
            faults.append(f"{q.name} is that of a reversed axis: correct its sign.")
        elif e["value"] < -0.5 and "_scale_" in q.name:
            faults.append(f"{q.name} is that of a dead or wrong axis, with less than half of its input: check it.")
        elif e["value"] < q.prior_mean and q.valid_below is not None:
            faults.append(
                "A negative vision_filter suggests a gyro that is low-passed more than vision, which no setting "
                "describes: raise its bandwidth."
            )
        elif q.group == "assumption":
            sensor, _, figure = q.sheet.partition(".")
            known = stated.setdefault(sensor, {})
            # The prior draws the value to its mean; one that is wider by the z-score is contradicted no more.
            size = max(abs(e["value"] - q.prior_mean), abs(e["z"]) * q.scale)
            known[figure or q.name] = max(known.get(figure or q.name, 0.0), size)
    written = {
        sensor: f"{{{', '.join(f'{name}: {size:.1g}' for name, size in known.items())}}}"
        for sensor, known in stated.items()
    }
    priors = [f"`priors: {written.pop('')}`"] if "" in written else []
    sensors = [f"`sensors: {{{', '.join(map(': '.join, written.items()))}}}`"] if written else []
    state = [f"If the device is so, state it: {' and '.join([*sensors, *priors])}."] if stated else []
    return " ".join([*faults, *state])


def _weak(severity: Severity, labels: str, sigma_ratio: float, advice: str) -> str:
    return f"{_DIRECTIONS[severity]}: {labels} (sigma {sigma_ratio:.2g} of the prior). {capital(advice)}."


def _hypothesis(e: Mapping[str, Any], severity: Severity, quantities: Quantities) -> str:
    what, evidence = _corrected(e, severity, quantities)
    equivalents = f" Equivalent: {'; '.join(e['equivalents'])}." if e["equivalents"] else ""
    return f"Consistent with: {what} ({evidence}).{equivalents}"


def _corrected(e: Mapping[str, Any], _: Severity, __: Quantities) -> tuple[str, str]:
    before, (after, dof) = e["chi_square_before"], (rounded(e[key], 4) for key in ("chi_square_after", "dof"))
    was = (
        "no usable solution as recorded, corrected chi-square"
        if before is None
        else f"chi-square {rounded(before, 4)} ->"
    )
    return e["label"], f"{was} {after}, dof {dof}"


def _conflict(e: Mapping[str, Any], _: Severity, quantities: Quantities) -> tuple[str, str]:
    q = quantities[e["parameter"]]
    unit, factor = human_unit(q)
    sigma = q.prior_at(e["value"]) or q.scale
    prior = f"prior {factor * q.prior_mean:.3g} ± {rounded(factor * sigma)} {unit}".rstrip()
    numbers = f"{format_estimate(q, e['value'], e['sigma'])}, {prior} (z = {e['z']:.1f})"
    if not (q.assumed or q.tight):
        return (
            f"{q.name} is far from its prior",
            f"{numbers}; {_FAR.get(q.unit, 'if the device really has this value, widen the prior')}",
        )
    inseparable = f" (or {', '.join(e['inseparable'])}, inseparable from it)" if e["inseparable"] else ""
    what = f"{q.name} contradicts its {'data sheet' if q.sheet else 'prior'}{inseparable}"
    return what, numbers + _shift(e["effect"], q.name, quantities, "its departure")


def _shift(effect: Mapping[str, float], name: str, quantities: Quantities, what: str) -> str:
    """Return a phrase on the largest effect of a parameter on another, in requirements; empty without effects."""
    shifts = {other: effect[other] / quantities[other].require for other in effect if other != name}
    moved = max(shifts, key=lambda other: abs(shifts[other]), default="")
    if not moved:
        return ""
    unit, factor = human_unit(quantities[moved])
    shift = f"{rounded(factor * abs(effect[moved]))} {unit}".rstrip()
    return f"; {what} shifts {moved} by {shift}, {abs(shifts[moved]):.2g} of its requirement"


def _fixed(e: Mapping[str, Any], _: Severity, quantities: Quantities) -> tuple[str, str]:
    q = quantities.get(e["parameter"]) or Quantity(e["parameter"], e["unit"], 0.0, 1.0, math.inf)
    unit, factor = human_unit(q)
    stated = f"{to_digits_of(factor * e['stated'], factor * e['sigma'])} {unit}".strip()
    inseparable = f" (or {', '.join(e['inseparable'][:_MAX_NAMED])})" if e["inseparable"] else ""
    what = f"{q.name} is fixed at {stated} by the config, and the recording contradicts it{inseparable}"
    numbers = f"{format_estimate(q, e['value'], e['sigma'])} if free (z = {e['z']:.1f})"
    return what, numbers + _shift(e["effect"], q.name, quantities, "freeing it")


def _change(e: Mapping[str, Any], severity: Severity, quantities: Quantities) -> str:
    steps = [
        f"{name} by {format_estimate(quantities[name], *step)}" for name, step in list(e["steps"].items())[:_MAX_NAMED]
    ]
    if severity == Severity.NOTE:
        return f"Change {_when(e)}{': ' if steps else ''}{', '.join(steps)}. Immaterial; included in the sigmas."
    return f"Change {_when(e)}: {', '.join(steps) or 'the parts before and after it fit by themselves, not together'}."


def _jump(e: Mapping[str, Any], severity: Severity, _: Quantities) -> str:
    size, sigma = (to_digits_of(math.degrees(e[name]), math.degrees(e["sigma"])) for name in ("size", "sigma"))
    undecided = "; the motion does not show whether the mount or the reference"
    return f"Vision jumped by {size} ± {sigma} deg {_when(e)}{undecided if severity > Severity.NOTE else ''}."


def _when(e: Mapping[str, Any]) -> str:
    """Return the time of a change as a phrase, s: an interval where measurements are more than a second apart."""
    since, until = e["since_s"], e["time_s"]
    return f"between {since:.0f} and {until:.0f} s" if until - since > 1.0 else f"at {until:.0f} s"


def _device_change(e: Mapping[str, Any], _: Severity, quantities: Quantities) -> str:
    step = format_estimate(quantities[e["parameter"]], e["step"], e["sigma"])
    return f"Change of the device {between(e['recordings'], e['dates'])}: {e['parameter']} by {step}."


def _noise(e: Mapping[str, Any], severity: Severity, _: Quantities) -> str:
    unit, factor = noise_unit(e["noise"], e["unit"])
    if severity > Severity.NOTE:
        estimated = f"estimated {e['estimated_factor'] or e['factor']:.2g} times the {e['source']}'s value"
        what = _CHECK.get(e["noise"], "the model or the unit")
        return f"Noise {e['noise']}: {estimated}; not white noise: check {what}."
    used = f"{rounded(factor * e['used'], 3)} {unit}".strip()
    return f"Noise {e['noise']}: {used} used, {e['factor']:.2g} times the {e['source']}'s value."


def correlated_size(noise: str, unit: str, used: float, correlation_time: float) -> str:
    """Describe a correlated error by its size, SI, in the unit that people use, and its correlation time, s."""
    shown, factor = noise_unit(noise, unit)
    return f"{rounded(factor * used)} {shown}, correlation time {rounded(correlation_time)} s"


def _correlated_error(e: Mapping[str, Any], _: Severity, __: Quantities) -> str:
    return f"{e['noise']}: errors are correlated in time, {correlated_size(**e)}. Sigmas include them."


def _error_map(e: Mapping[str, Any], _: Severity, quantities: Quantities) -> str:
    of = "the gimbal angles" if e["name"] == "los_map" else "the attitude"
    unit, factor = noise_unit(e["name"], e["unit"])
    size = f"{rounded(factor * e['rms'])} {unit} rms, data sheet {rounded(factor * e['prior'])}"
    test = f"chi-square {rounded(e['chi_square'], 3)}, dof {e['dof']}"
    shift = _shift(e["effect"], "", quantities, "correcting them")
    return f"{e['name']}: errors depend on {of}, {size} ({test}){shift}. Sigmas include their uncertainty."


def _slow_error(e: Mapping[str, Any], _: Severity, __: Quantities) -> str:
    warning = "Warning: errors of a sensor" if e["ratio"] > SLOW_ERROR_WARNING else "Errors of a sensor"
    return (
        f"{warning} vary slowly, for example with the pose, unlike noise: from blocks of 5 s the sigma of "
        f"{e['parameter']} is {e['ratio']:.2g} times the nominal one. Sigmas include it."
    )


def _misfit(e: Mapping[str, Any], severity: Severity, _: Quantities) -> str:
    fit = Fit.of(e["chi_square"], e["dof"])
    if fit.value != fit.value:
        return "Chi-square is not a number: the solver has no usable estimate."
    of = f" of {e['family']}" if e["family"] else ""
    large = fit.value > fit.dof
    bound = rounded(fit.high if large else fit.low, 4)
    sums = f"chi-square {rounded(fit.value, 4)}, 99.9 % bound {bound} (dof {rounded(fit.dof, 4)})"
    largest = f"; {'largest' if large else 'smallest'} for {e['largest']}, {e['noise_factor']:.2g} times its noise"
    relation = "exceed" if severity > Severity.NOTE or large else "are smaller than"
    return f"Residuals{of} {relation} the noise used: {sums}{largest}."


def _dominant_prior(e: Mapping[str, Any], severity: Severity, _: Quantities) -> str:
    share, figure = f"{100.0 * e['share']:.0f} %", e["figure"]
    what = figure.replace(".", " ").replace("_", " ")
    if severity == Severity.NOTE:
        return (
            f"Up to {share} of a required parameter's variance comes from {what}, which the recording does not "
            f"determine: check sensors.{figure} (now {e['stated']:.2g})."
        )
    return (
        f"{share} of that variance comes from {what}: state sensors.{figure} (now {e['stated']:.2g}) if it is better."
    )


def _ambiguous_solution(e: Mapping[str, Any], _: Severity, quantities: Quantities) -> str:
    named = []
    for name, (there, here) in list(e["values"].items())[:_MAX_NAMED]:
        unit, factor = human_unit(quantities[name])
        named.append(f"{name} {factor * there:.3g} instead of {factor * here:.3g} {unit}".rstrip())
    higher = f"chi-square with priors is higher by {e['chi_square']:.1f}"
    return f"A second solution is nearly as likely ({higher}): {', '.join(named)}; whole in second_best of result.json."


def _recordings_disagree(e: Mapping[str, Any], _: Severity, __: Quantities) -> str:
    sums = f"chi-square {e['chi_square']:.4g} (dof {e['dof']})"
    if e["dates"]:
        return f"All parameters together changed {between(e['recordings'], e['dates'])}: {sums}, none significantly."
    return f"The recordings disagree about the device: {sums}."


_WORDS: Mapping[str, Callable[[Mapping[str, Any], Severity, Quantities], str]] = {
    "not_converged": lambda e, *_: f"No solution: {e['message']}. Do not use the values.",
    "direction": lambda e, severity, _: _weak(severity, label(e["weights"]), e["sigma_ratio"], e["advice"]),
    "hypothesis": _hypothesis,
    "prior_conflict": lambda *finding: f"{': '.join(_conflict(*finding))}.",
    "contradiction": lambda *finding: f"{': '.join(_fixed(*finding))}.",
    "change": _change,
    "jump": _jump,
    "device_change": _device_change,
    "rejection": lambda e, *_: (
        f"{100.0 * e['share']:.0f} % of {e['family']} measurements rejected; all would fit {e['noise_factor']:.2g} "
        "times the noise."
    ),
    "disturbance": lambda e, severity, _: (
        f"{e['family']} disturbed {e['since_s']:.1f} to {e['time_s']:.1f} s: {e['rejected']} measurements are left out "
        f"there{', and nothing shows that the calibration holds afterwards' * (severity == Severity.WEAK)}."
    ),
    "noise": _noise,
    "correlation": lambda e, *_: (
        f"Residuals of {e['family']} are correlated over {100.0 * e['share']:.0f} % of the recording."
    ),
    "slow_error": _slow_error,
    "correlated_error": _correlated_error,
    "error_map": _error_map,
    "misfit": _misfit,
    "dominant_prior": _dominant_prior,
    "ambiguous_solution": _ambiguous_solution,
    "solver_difference": lambda e, *_: (
        f"The run's own last estimate differed by up to {abs(e['z']):.1f} sigma ({e['parameter']})."
    ),
    "recording": lambda e, _, quantities: (
        f"{e['recording']} by itself: {' '.join(_sentences(e['findings'], quantities))}"
    ),
    "recordings_disagree": _recordings_disagree,
    "remark": lambda e, *_: str(e["text"]),
}


_CAUSES = {"hypothesis": _corrected, "prior_conflict": _conflict, "contradiction": _fixed}


def between(recordings: Sequence[str], dates: Sequence[str]) -> str:
    """Return two dates (ISO 8601) in words, or the names of two recordings of one day."""
    first, second = (datetime.datetime.fromisoformat(date).date() for date in dates)
    if first == second:
        return f"between {recordings[0]} and {recordings[1]}"
    return f"between {' and '.join(f'{date.day} {date:%B %Y}' for date in (first, second))}"


# -- error budgets


@dataclass(frozen=True)
class Limit:
    """Error source that limits a parameter.

    Attributes:
        name: of the parameter.
        parts: source in words and its share of the variance, the largest first, the rest of them last.
        advice: what would make the largest smaller.
    """

    name: str
    parts: tuple[tuple[str, float], ...]
    advice: str

    @property
    def sentence(self) -> str:
        """Sentence about the largest error source and what to do about it."""
        source, share = self.parts[0]
        return f"{100.0 * share:.0f} % of the variance of {self.name}: {source}; {self.advice}"


def limits(budget: Mapping[str, Mapping[str, float]], quantities: Sequence[Quantity]) -> list[Limit]:
    """Largest error sources of each parameter of a budget, given the quantities of its problem."""
    assumed = {q.name for q in quantities if q.assumed}
    return [_limit(name, shares, assumed) for name, shares in budget.items()]


def _limit(name: str, shares: Mapping[str, float], assumed: set[str]) -> Limit:
    parts: dict[str, float] = {}
    advice: dict[str, str] = {}
    for source, share in shares.items():
        words, what = _described(name, source, assumed)
        parts[words] = parts.get(words, 0.0) + share
        advice.setdefault(words, what)
    order = sorted(parts.items(), key=lambda part: -part[1])
    kept = [part for i, part in enumerate(order) if i == 0 or (i < _MOST_PARTS and part[1] >= _LEAST_SHARE)]
    rest = sum(share for _, share in order[len(kept) :])
    last = [(REST, rest)] if rest > 0.0 else []
    return Limit(name, (*kept, *last), advice[kept[0][0]])


def _described(name: str, source: str, assumed: set[str]) -> tuple[str, str]:
    """Return an error source in words, and what would reduce it."""
    if source.startswith(RECORDING):
        return source, "record longer, or more often"
    if source == WALK:
        return source, "calibrate more often"
    if source == CONFLICT:
        return source, "state the figures of your sensors"
    if source in (CHANGE, SOURCE):
        return source, "find what changed" if source == CHANGE else "calibrate the camera, or move the other ways too"
    if not source.startswith(_PRIOR):
        return f"{source} noise", "record longer, or measure it better"
    of = source.removeprefix(_PRIOR)
    kinds = ", ".join(dict.fromkeys(map(kind_of, of.split(", "))))
    if assumed.issuperset(of.split(", ")):
        return f"prior of {kinds}", "state its data sheet if yours is better, or move so that it shows"
    if of == name:
        return "its own prior", "the recording adds little to what was known"
    return f"prior of {kinds}", "know it better, or move so that it shows"
