"""Several recordings of one device as one calibration.

Each recording is solved by itself, and what it says of the device, linear about the joint estimate of those before it
and itself, is joined with what the others say. Then those that were farthest from the final estimate are linearised
again there, with the noise levels and inliers of their own solutions, until the joint estimate stays. What is kept of a
recording meanwhile is small; its data wait in a temporary file.
"""

from __future__ import annotations

import datetime
import hashlib
import pickle
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines import progress
from alidade.pipelines.applications.session import Session
from alidade.pipelines.applications.sharing import DAY_S, finding_of_recording, stated_walks, walks
from alidade.pipelines.diagnostics.device_changes import Changes, Rate, changes
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.diagnostics.observability import finite_covariance
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Finding, Severity, by_severity, remark
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameters import kind
from alidade.pipelines.estimation.problem import (
    ChiSquare,
    Estimate,
    Parameter,
    Problem,
    Quantity,
    Residuals,
    SqrtInformation,
)
from alidade.pipelines.estimation.widening import marginalised
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.methods import Method
from alidade.pipelines.recording.container import require_distinct, total
from alidade.pipelines.recording.topics import SessionFacts
from alidade.pipelines.reports.joint_report import recording_blocks
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import PartParameter, PartResult
from alidade.pipelines.solvers.freed import information_at
from alidade.pipelines.solvers.joint import LEAST_DAYS, Joined, grown, join

# The joint estimate stays when other linearisations move it by less than this, in sigmas (what is left is about the
# square), and those that were not tried are foreseen to; so many times they are tried.
_STAYS, _MOST_PASSES = 1e-2, 6
# Where chi-square between the recordings is so many times its freedoms the device is not one: no need to be exact.
_FAR_APART = 10.0
# A number that stepped walks from recording to recording by so many times the step.
_FREELY = 10.0
# So many recordings are named in a sentence.
_MOST_NAMED = 3
_NO_SOLUTION = "linearised at the joint estimate the recordings lead elsewhere again and again"
_OVERLAP = (
    "recordings overlap in time and count as several all the same; parts of one are named by a folder or a pattern in "
    "quotes"
)
# Of parameters that the last recording's graph does not have.
_NO_VARIABLE = 0


@dataclass(frozen=True, eq=False)
class Alone:
    """Calibration of one recording by itself, kept for the joint calibration.

    Attributes:
        calibration: what result.json says of it by itself, without the data behind it.
        day: its date, days since 1970.
        sqrt_info: information about its numbers.
        data: the file in which its data wait.
    """

    calibration: Calibration
    day: float
    sqrt_info: SqrtInformation
    data: Path

    @classmethod
    def of(cls, session: Session, calibration: Calibration, data: Path) -> Alone:
        """Keep a session's batch calibration in memory and its data in a file."""
        estimate = calibration.estimate
        assert estimate.sqrt_info is not None
        with data.open("wb") as stream:
            pickle.dump(session.data, stream)
        small = Estimate(
            solver=estimate.solver,
            names=estimate.names,
            values=estimate.values,
            covariance=estimate.covariance,
            converged=estimate.converged,
            message=estimate.message,
            chi_square=estimate.chi_square,
            rejected=estimate.rejected,
            residuals={
                family: Residuals(np.empty(0), np.empty((0, 0)), each.used)
                for family, each in estimate.residuals.items()
            },
            levels=estimate.levels,
            inflation=estimate.inflation,
            error_map=estimate.error_map,
        )
        problem = Problem(calibration.problem.method, calibration.problem.parameters, steps=lambda _: iter(()))
        return cls(
            calibration=replace(calibration, estimate=small, problem=problem, plots=None, beside=None),
            day=_day(session),
            sqrt_info=estimate.sqrt_info,
            data=data,
        )

    @property
    def name(self) -> str:
        """Name of the recording's file."""
        return self.calibration.recording

    def loaded(self) -> Any:
        """The recording's data, read back from their file."""
        with self.data.open("rb") as stream:
            return pickle.load(stream)  # written above, into a folder of our own


def calibrate_together(
    sessions: Sequence[Callable[[], Session]], written: Callable[[Calibration], None] = lambda _: None
) -> Calibration:
    """Calibrate several recordings of a device jointly, by batch.

    Args:
        sessions: open the recordings, one after the other.
        written: is given the calibration of each recording by itself.

    Raises:
        InputError: a recording cannot be used, or they are of different methods.
        IndeterminateError: states other than the parameters are not determined.
    """
    with TemporaryDirectory(prefix="alidade-") as folder:
        alone: list[Alone] = []
        for i, read in enumerate(sessions):
            session = read()
            if alone:
                session = replace(session, near=alone[0].calibration.values)
            calibration = session.calibrated_beside(partial(_with_those_before, session, alone))
            alone.append(Alone.of(session, calibration, Path(folder) / str(i)))
            written(calibration)
            del session, calibration
        method = _one_device(alone)
        alone.sort(key=lambda each: each.day)
        rates = _rates(method, alone)
        known = _walks(alone, rates)
        rates = {name: known[kind(name)].rate if kind(name) in known else rate for name, rate in rates.items()}
        joined, step = _joined(method, alone, rates)
        changed = _changes(alone, joined)
        if changed.found:
            joined, step = _joined(method, alone, {**rates, **_rates_of_stepped(changed, alone)})
        newest = alone[-1]
        problem = method.graph(newest.loaded(), newest.calibration.config)
        changed = replace(changed, rates={**changed.rates, **known})
        return _calibration(problem, method, alone, joined, step, changed)


def _one_device(alone: Sequence[Alone]) -> Method:
    """Return the method of all recordings. Raises InputError if they are of several methods or one is named twice."""
    if not alone:
        raise InputError("no recordings are named")
    first = alone[0].calibration
    for each in alone:
        found = each.calibration
        if found.method is not first.method:
            raise InputError(
                f"{each.name}: is calibrated by {found.method.name}, {first.recording} by {first.method.name}"
            )
    require_distinct((each.name, each.calibration.sha256) for each in alone)
    return first.method


def _rates(method: Method, alone: Sequence[Alone]) -> dict[str, float]:
    """Return the random-walk rates of the device's parameters, SI per root day. Raises InputError as `walks` does."""
    names = list(dict.fromkeys(name for each in alone for name in each.calibration.quantities))
    return walks(method, alone[0].calibration.config, names)


def _with_those_before(session: Session, alone: Sequence[Alone], sqrt_info: SqrtInformation) -> dict[str, float]:
    """Return a recording's parameter values given those before it; empty if these are of another device."""
    if not alone or alone[0].calibration.method is not session.method:
        return {}
    rates = _rates(session.method, alone)
    before = [(each.day, each.sqrt_info) for each in alone]
    order = sorted([*before, (_day(session), sqrt_info)], key=lambda each: each[0])
    joined = join([each for _, each in order], rates, [day for day, _ in order])
    if _far_apart(joined):
        return {}
    place = next(i for i, (_, each) in enumerate(order) if each is sqrt_info)
    return joined.all(place).of(sqrt_info.names).means


def _day(session: Session) -> float:
    """The date of a recording, days since 1970."""
    date = session.config.date
    if date is None:
        return session.epoch_ns * 1e-9 / DAY_S
    return datetime.datetime(date.year, date.month, date.day, 12, tzinfo=datetime.UTC).timestamp() / DAY_S


def _far_apart(joined: Joined) -> bool:
    value, dof = joined.disagreement
    return value > _FAR_APART * max(dof, 1)


def _walks(alone: Sequence[Alone], rates: Mapping[str, float]) -> dict[str, Rate]:
    """Return kind of parameters -> random-walk rate, SI per root day, where stated or to be estimated."""
    config = alone[0].calibration.config
    asked = {kind(name) for name in stated_walks(config, list(rates))}
    days = [each.day for each in alone]
    estimated = _changes(alone, join([each.sqrt_info for each in alone], rates, days)).rates if asked else {}
    stated = {kind(name): Rate(rate, rate) for name, rate in rates.items() if rate}
    return {**stated, **{which: rate for which, rate in estimated.items() if which in asked}}


def _changes(alone: Sequence[Alone], joined: Joined) -> Changes:
    inflations = {name: _inflation(name, alone) for name, _ in joined.unknowns}
    return changes(joined, [each.day for each in alone], inflations)


def _rates_of_stepped(changed: Changes, alone: Sequence[Alone]) -> dict[str, float]:
    """Return random-walk rates, SI per root day, that let each number that stepped differ freely between recordings.

    About what did not change: a mean of both sides would be made up for by all other numbers.
    """
    days = min(max(after.day - before.day, LEAST_DAYS) for before, after in pairwise(alone))
    return {step.name: _FREELY * abs(step.size) / days**0.5 for step in changed.found}


def _joined(method: Method, alone: Sequence[Alone], rates: Mapping[str, float]) -> tuple[Joined, float]:
    """Return the joint estimate, and by how many sigmas its last iteration moved it."""
    sqrt_info, days = [each.sqrt_info for each in alone], [each.day for each in alone]
    joined, step = join(sqrt_info, rates, days), np.inf
    if len(alone) == 1 or _far_apart(joined):
        return joined, 0.0
    for _ in range(_MOST_PASSES):
        before = joined
        # What is wrong with a linearisation grows with the square of how far it is from there.
        squares = [joined.distance(i, each) ** 2 for i, each in enumerate(sqrt_info)]
        order = sorted(range(len(alone)), key=lambda i: -squares[i])
        for done, i in enumerate(progress.track(order, "joining", len(order)), 1):
            sqrt_info[i] = _again(method, alone[i], joined.all(i), rates, sqrt_info[i].added)
            joined = join(sqrt_info, rates, days)
            step = before.sigmas_to(joined)
            near, far = (sum(squares[k] for k in some) for some in (order[:done], order[done:]))
            if step * far < _STAYS * near:
                break
        if step < _STAYS:
            break
    return joined, step


def _again(
    method: Method, alone: Alone, known: GaussianPrior, rates: Mapping[str, float], added: Array | None
) -> SqrtInformation:
    """Return the information of one recording, linear about the joint estimate of its numbers.

    Its noise levels and inliers stay those of its own solution: found anew at these levels, other inliers may fit too.
    """
    estimate, found = alone.calibration.estimate, known.means
    values = np.array([found.get(name, value) for name, value in zip(estimate.names, estimate.values, strict=True)])
    moves = estimate.error_map if estimate.error_map is not None and estimate.error_map.map.moves else None
    problem = method.graph(alone.loaded(), alone.calibration.config).near(found)
    without = replace(estimate, values=values if moves is None else values - moves.shift)
    again = information_at(problem, without, rates)
    again = again if moves is None else moves.moved(again)
    return again if added is None else marginalised(again, added)


def _calibration(
    problem: Problem,
    method: Method,
    alone: Sequence[Alone],
    joined: Joined,
    step: float,
    changed: Changes,
) -> Calibration:
    """Return the joint estimate as a calibration of the device at the last recording, with that one's parameters."""
    last = len(alone) - 1
    posterior = joined.all(last)
    found = posterior.means
    names = tuple(dict.fromkeys([*(q.name for q in problem.quantities), *found]))
    problem = replace(problem, parameters=_with_others(problem, alone, found), premises=())
    quantities = {q.name: q for q in problem.quantities}
    rows = np.array([names.index(name) for name in posterior.names], dtype=np.intp)
    values = np.array([found.get(name, quantities[name].prior_mean) for name in names])
    of_device = {name for name, _ in joined.unknowns}
    inflation = np.array([_inflation(name, alone if name in of_device else alone[last:]) for name in names])
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(rows, rows)] = posterior.covariance
    extra = np.diag([quantities[name].extra_sigma ** 2 if name in found else 0.0 for name in names])
    covariance = covariance * np.outer(inflation, inflation) + extra
    converged = step < _STAYS
    ordered = [quantities[name] for name in names]
    shares = joined.budget(last, [each.name for each in alone])
    estimate = Estimate(
        solver="batch",
        names=names,
        values=values,
        covariance=finite_covariance(ordered, covariance),
        converged=converged,
        message=f"{len(alone)} recordings; the joint estimate moved last by {step:.1g} sigmas",
        chi_square=_sum([each.calibration.estimate.chi_square for each in alone]),
        rejected=total([each.calibration.estimate.rejected for each in alone]),
        levels=_combined_levels([each.calibration.estimate.levels for each in alone]),
        inflation=inflation,
        budget={name: _with_extra(shares[name], names.index(name), covariance, extra) for name in shares},
    )
    parts = [_part(each, joined, i) for i, each in enumerate(alone)]
    return Calibration(
        method=method,
        problem=problem,
        estimate=estimate,
        findings=_findings(estimate, ordered, problem, alone, joined, changed),
        recording=_named([each.name for each in alone]),
        sha256=hashlib.sha256(b"".join(bytes.fromhex(each.calibration.sha256) for each in alone)).hexdigest(),
        facts=_facts([each.calibration.facts for each in alone]),
        config=alone[last].calibration.config,
        recordings=parts,
        changes=changed,
        plots=recording_blocks,
    )


def _with_extra(shares: Mapping[str, float], k: int, covariance: Array, extra: Array) -> dict[str, float]:
    """Return a parameter's variance shares by source, with the share of errors that its graph does not model."""
    beyond = float(extra[k, k] / covariance[k, k])
    modelled = {source: share * (1.0 - beyond) for source, share in shares.items()}
    return {**modelled, "not modelled": beyond} if beyond else modelled


def _with_others(problem: Problem, alone: Sequence[Alone], found: Mapping[str, float]) -> tuple[Parameter, ...]:
    """Return the parameters of the last recording, and those of the device that only the others determine.

    What is fixed in the last recording and known from others is as the others have it.
    """
    known: dict[str, Quantity] = {}
    for each in alone:
        own = each.calibration.quantities
        known |= {name: q for name, q in own.items() if q.prior_sigma != 0.0 and name in found}
    last = tuple(replace(p, quantities=tuple(known.get(q.name, q) for q in p.quantities)) for p in problem.parameters)
    there = {q.name for p in last for q in p.quantities}
    missing = tuple(q for name, q in known.items() if name not in there)
    return (*last, *((Parameter(_NO_VARIABLE, missing),) if missing else ()))


def _inflation(name: str, alone: Sequence[Alone]) -> float:
    """Return the ratio of inflated to nominal sigma of a parameter in the joint estimate."""
    found = [p for each in alone if (p := each.calibration.parameters.get(name)) is not None]
    return grown([p.sigma for p in found], [p.inflation for p in found])


def _findings(
    estimate: Estimate,
    quantities: Sequence[Quantity],
    problem: Problem,
    alone: Sequence[Alone],
    joined: Joined,
    changed: Changes,
) -> tuple[Finding, ...]:
    """The findings on the joint estimate, on recordings by themselves, and on changes of the device between them."""
    if not estimate.converged:
        return diagnose(replace(estimate, message=_NO_SOLUTION), quantities)
    own = (finding_of_recording(each.calibration) for each in alone)
    steps = list(_device_changes(changed, alone, {q.name for q in quantities if q.required}))
    found = [*steps, *diagnose(estimate, quantities, problem.advice), *(each for each in own if each is not None)]
    value, dof = joined.disagreement
    is_severe = any(step.severity > Severity.NOTE for step in steps)
    if not is_severe and dof >= 1 and value > Fit.of(value, float(dof)).high:
        found.append(_disagreement([each.name for each in alone], (), value, dof))
    found.append(remark(f"{len(alone)} recordings of one device"))
    return by_severity(found)


def _device_changes(changed: Changes, alone: Sequence[Alone], required: Collection[str]) -> Iterator[Finding]:
    """Yield findings on steps of the device between recordings, most significant first; else of all parameters.

    A step of a number without a required accuracy is a NOTE: the others are estimated beside it.
    """
    places = [(each.name, each.calibration.start) for each in alone]
    for step in sorted(changed.found, key=lambda step: -abs(step.z)):
        names, dates = zip(*places[step.after : step.after + 2], strict=True)
        numbers = {"parameter": step.name, "step": step.size, "sigma": step.sigma}
        severity = Severity.INCONSISTENT if step.name in required else Severity.NOTE
        yield Finding("device_change", severity, {**numbers, "recordings": names, "dates": dates})
    for each in changed.jointly:
        names, dates = zip(*places[each.after : each.after + 2], strict=True)
        yield _disagreement(names, dates, each.chi_square, each.dof)


def _disagreement(names: Sequence[str], dates: Sequence[str], chi_square: float, dof: int) -> Finding:
    evidence = {"recordings": names, "dates": dates, "chi_square": chi_square, "dof": dof}
    return Finding("recordings_disagree", Severity.INCONSISTENT, evidence)


def _combined_levels(each: Sequence[Sequence[Level]]) -> tuple[Level, ...]:
    """Combine the noise levels of all recordings, by name."""
    by_name: dict[str, list[Level]] = {}
    for level in chain.from_iterable(each):
        by_name.setdefault(level.noise.name, []).append(level)
    return tuple(map(_combined, by_name.values()))


def _combined(levels: Sequence[Level]) -> Level:
    """Combine levels of one noise: estimates weighted by information, used levels by their mean."""
    newest, known = levels[-1], [(x.found, x.sigma) for x in levels if x.found is not None and x.sigma]
    scale = float(np.mean([level.used for level in levels])) / newest.noise.stated if newest.noise.stated else 1.0
    if not known:
        return replace(newest, scale=scale, found=None, sigma=None)
    found, sigma = np.array(known, dtype=float).T
    information = float((sigma**-2.0).sum())
    return replace(newest, scale=scale, found=float((found / sigma**2).sum()) / information, sigma=information**-0.5)


def _sum(found: Sequence[ChiSquare | None]) -> ChiSquare:
    each = [c for c in found if c is not None]
    families: dict[str, tuple[float, float]] = {}
    for chi_square in each:
        for family, (value, dof) in chi_square.families.items():
            before = families.get(family, (0.0, 0.0))
            families[family] = before[0] + value, before[1] + dof
    return ChiSquare(sum(c.value for c in each), sum(c.dof for c in each), families)


def _named(names: Sequence[str]) -> str:
    """Return the names of recordings as a short phrase."""
    return ", ".join(names) if len(names) <= _MOST_NAMED else f"{names[0]} to {names[-1]}, {len(names)} recordings"


def _facts(facts: Sequence[SessionFacts]) -> SessionFacts:
    """Combine the facts of all recordings; the start is that of the last, whose date the result has."""
    last = facts[-1]
    lost = total([each.lost for each in facts])
    notes = tuple(dict.fromkeys(note for each in facts for note in each.notes))
    if any(0 < b.epoch_ns - a.epoch_ns < 1e9 * a.duration_s for a, b in pairwise(facts)):
        notes = (*notes, _OVERLAP)
    return SessionFacts(last.epoch_ns, sum(each.duration_s for each in facts), (), (), last.missing, lost, notes)


def _part(alone: Alone, joined: Joined, i: int) -> PartResult:
    """Return a recording's entry: its own parameters in the joint estimate, and what it finds by itself."""
    by_itself, part = alone.calibration, joined.parts[i]
    posterior = joined.all(i).of([*part.own, *joined.walking])

    def number(name: str, value: float, sigma: float) -> PartParameter:
        quantity = by_itself.quantities[name]
        whole = float(np.hypot(sigma * by_itself.parameters[name].inflation, quantity.extra_sigma))
        return PartParameter(name=name, value=value, sigma=whole, unit=quantity.unit)

    found = [by_itself.parameters[name] for name in part.names]
    chi_square = by_itself.estimate.chi_square
    start = datetime.datetime.fromtimestamp(alone.day * DAY_S, datetime.UTC)
    is_noise_estimated = any(level.noise.estimated for level in by_itself.estimate.levels)
    return PartResult(
        recording=alone.name,
        sha256=by_itself.sha256,
        start=start.isoformat(timespec="seconds"),
        duration_s=by_itself.facts.duration_s,
        status=by_itself.status,
        headline=by_itself.headline,
        dof=chi_square.dof if chi_square and is_noise_estimated else None,
        parameters=[number(*each) for each in zip(posterior.names, posterior.mean, posterior.sigmas, strict=True)],
        alone=[PartParameter(name=p.name, value=p.value, sigma=p.sigma, unit=p.unit) for p in found],
    )
