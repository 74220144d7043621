"""What a calibration is to the reports, and result.json.

calibration = Calibration(problem, estimate, diagnose(...), session_facts(...), ...)
result_json(calibration)            # the contract's text of result.json
"""

from __future__ import annotations

import datetime
import math
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from alidade.pipelines.diagnostics.change_test import Stability
from alidade.pipelines.diagnostics.device_changes import Changes
from alidade.pipelines.diagnostics.goodness_of_fit import Fit, InnovationTest, SolverDifference
from alidade.pipelines.diagnostics.observability import TimeToAccuracy, Verdict, time_to_accuracy, verdicts
from alidade.pipelines.display.figure import Figure
from alidade.pipelines.estimation.assumptions import pull
from alidade.pipelines.estimation.finding import Finding, Severity, Status, status
from alidade.pipelines.estimation.noise import Level, Source
from alidade.pipelines.estimation.problem import Array, Estimate, Findings, History, Problem, Quantity, Residuals
from alidade.pipelines.recording.faults import CLIPPED
from alidade.pipelines.recording.info import SessionFacts
from alidade.pipelines.reports import sentences
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.methods import Method
    from alidade.pipelines.methods.formula import Formula

_PACKAGES = ("alidade", "gtsam", "numpy", "opencv-contrib-python-headless", "pycolmap")


@dataclass(frozen=True)
class Plot:
    """A figure of the report.

    Attributes:
        title: in a few words.
        caption: what is seen, units included.
        figure: it.
        beside: figures that belong to it, beside it or below.
    """

    title: str
    caption: str
    figure: Figure
    beside: tuple[Figure, ...] = ()


@dataclass(frozen=True)
class Table:
    """A table of the report: title, caption, heads of the columns, and rows of as many texts."""

    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, repr=False)
class Calibration:
    """Everything the reports tell about one calibration.

    Attributes:
        method: that was calibrated.
        problem: the method's.
        estimate: by any solver; its names are a part of the problem's.
        findings: on that estimate, the most severe first.
        recording: name of the file.
        sha256: of the file.
        facts: about the recording; its epoch is the zero of all times.
        config: in force.
        truth: parameter -> value, when known; other keys are ignored.
        software: package -> version.
        seconds: phase -> wall time, beside those of the estimate.
        plots: makes the method's own figures and tables.
        beside: the published solver's estimate of the same recording, which the report shows too; None: there is none.
        stability: whether what was calibrated stayed as it was; None where that cannot be said.
        solver_difference: an incremental estimate less batch's; None where they were not compared.
        tables: what the method found beside its parameters.
        recordings: of a joint calibration, what each of them has of its own.
        changes: of a joint calibration, whether the device changed from one to another.
    """

    method: Method
    problem: Problem
    estimate: Estimate
    findings: tuple[Finding, ...]
    recording: str
    sha256: str
    facts: SessionFacts
    config: Config = field(default_factory=Config)
    truth: Mapping[str, object] | None = None
    software: Mapping[str, str] = field(default_factory=lambda: software_versions())
    seconds: Mapping[str, float] = field(default_factory=dict)
    plots: Callable[[Calibration], Sequence[Plot | Table]] | None = None
    beside: Estimate | None = None
    stability: Stability | None = None
    solver_difference: SolverDifference | None = None
    tables: Findings = field(default_factory=dict)
    recordings: Sequence[PartResult] = ()
    changes: Changes | None = None

    @property
    def parameters(self) -> dict[str, ParameterResult]:
        """Name -> parameter, as result.json lists them."""
        given = self.verdicts
        rows = zip(
            quantities_of(self.problem, self.estimate),
            self.estimate.values,
            self.estimate.sigmas,
            self.estimate.inflations,
            strict=True,
        )
        return {
            q.name: ParameterResult(
                name=q.name,
                value=float(value),
                sigma=float(sigma),
                unit=q.unit,
                prior_sigma=q.prior_sigma,
                prior_mean=q.prior_mean,
                require=q.require if q.judged else None,
                observability=given.get(q.name),
                group=q.group,
                pull=None if q.group is None else pull(q, float(value), float(sigma), float(inflation)),
                inflation=float(inflation),
            )
            for q, value, sigma, inflation in rows
        }

    @property
    def noises(self) -> list[NoiseResult]:
        """Every noise that was in force: as stated, as found, as used."""
        colours = self.estimate.colours
        return [
            NoiseResult(
                name=level.noise.name,
                unit=level.noise.unit,
                source=level.noise.source,
                stated=level.noise.stated,
                estimated=None if level.found is None else level.found * level.noise.stated,
                sigma=None if level.sigma is None else level.sigma * level.noise.stated,
                used=level.used,
                inflation=max((colours.get(family, 1.0) ** 0.5 for family in level.noise.families), default=1.0),
            )
            for level in self.estimate.levels or [Level(level.noise) for level in self.problem.noises]
        ]

    @property
    def budget(self) -> dict[str, Mapping[str, float]] | None:
        """Parameter -> source -> share of the variance, without nuisance parameters; None if the solver has none."""
        if self.estimate.budget is None:
            return None
        return {name: self.estimate.budget[name] for name in self._calibrated if name in self.estimate.budget}

    @property
    def sensitivity(self) -> dict[str, SensitivityResult] | None:
        """Fixed input -> effect of its error on the parameters; None if the solver has none."""
        moved = self.estimate.moved
        if moved is None:
            return None
        found = {}
        for exact in self.method.hypotheses().exact:
            if exact.name in moved:
                moves = moved[exact.name]
                by_unit = {name: moves[name] / exact.step for name in self._calibrated if name in moves}
                found[exact.name] = SensitivityResult(unit=exact.unit, step=exact.step, parameters=by_unit)
        return found

    @property
    def measurements(self) -> list[MeasurementResult] | None:
        """The most influential measurements; None if the solver has none."""
        if self.estimate.strongest is None:
            return None
        return [
            MeasurementResult(family=p.family, time_s=p.time, parameter=p.parameter, pull=p.sigmas)
            for p in self.estimate.strongest
        ]

    @property
    def _calibrated(self) -> list[str]:
        """The parameters without assumptions."""
        return [q.name for q in quantities_of(self.problem, self.estimate) if q.group is None]

    @property
    def start(self) -> str:
        """Of the recording, ISO 8601."""
        return datetime.datetime.fromtimestamp(self.facts.epoch_ns // 1_000_000_000, datetime.UTC).isoformat()

    @property
    def status(self) -> Status:
        """calibrated, weak, unobservable or inconsistent."""
        return status(self.findings)

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Parameter -> verdict, of those with a required accuracy."""
        return verdicts(quantities_of(self.problem, self.estimate), self.estimate.covariance, self.findings)

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Name -> quantity, those of several recordings too."""
        return {q.name: q for q in self.problem.quantities}

    @property
    def headline(self) -> str:
        """The status with its reasons."""
        return sentences.headline(self.findings, self.quantities, self.verdicts)

    @property
    def directions(self) -> tuple[Finding, ...]:
        """Findings on weak and unobservable directions, worst first."""
        return tuple(finding for finding in self.findings if finding.kind == "direction")

    @property
    def causes(self) -> tuple[tuple[str, str], ...]:
        """Label and evidence of what may explain the other findings, the most likely first."""
        found = (sentences.cause(finding, self.quantities) for finding in self.findings)
        return tuple(cause for cause in found if cause is not None)

    @property
    def fit(self) -> Fit | None:
        """Chi-square of all residuals with its interval; None when the solver has none."""
        chi_square = self.estimate.chi_square
        return None if chi_square is None else Fit.of(chi_square.value, chi_square.dof)

    @property
    def family_fits(self) -> dict[str, Fit]:
        """Family -> chi-square with its interval."""
        chi_square = self.estimate.chi_square
        return {} if chi_square is None else {family: Fit.of(*sums) for family, sums in chi_square.families.items()}

    @property
    def covariance(self) -> Array:
        """(n, n) joint covariance of the parameters, in their order, SI."""
        return self.estimate.covariance

    @property
    def history(self) -> History | None:
        """Values and sigmas from what was recorded until each moment."""
        return self.estimate.history

    @property
    def residuals(self) -> Mapping[str, Residuals]:
        """Family of measurements -> residuals at the estimate."""
        return self.estimate.residuals

    def write(self, folder: str | Path) -> tuple[Path, ...]:
        """Write result.json, calibration.yaml, report.html and what else there is; returns their paths.

        Raises:
            InputError: the folder cannot be written to.
        """
        from alidade.pipelines.reports.write import write_results

        return write_results(Path(folder), self)

    def apply(self, **measured: Any) -> dict[str, Array]:
        """The formulas of calibration.yaml, computed: everything that follows from what is measured.

            calibration.apply(gyro=w)["w_iv"]

        What the solver does not know counts as zero, and so do assumptions that it does not determine: what would be
        measured for these alone is not looked at.

        Args:
            measured: by the names in the formulas: numbers, vectors (..., 3), quaternions w, x, y, z (..., 4); SI.

        Raises:
            InputError: something is given that no formula measures.
        """
        from alidade.pipelines.methods.formula import apply

        values = {name: parameter.value for name, parameter in self.parameters.items() if name in self.applied}
        unknown = dict.fromkeys((q.name for q in self.problem.quantities), 0.0)
        needed, possible = (
            {name for formula in formulas for name in formula.measured}
            for formulas in (self.formulas, self.method.formulas(list(unknown), self.config))
        )
        given = {name: value for name, value in measured.items() if name in needed or name not in possible}
        return apply(self.formulas, {**self.problem.constants, **unknown, **values}, given)

    def __repr__(self) -> str:
        """One line."""
        return f"<Calibration {self.method.name}, {self.estimate.solver}, of {self.recording}: {self.status}>"

    def __str__(self) -> str:
        """The table and the verdict, as the command prints them."""
        from alidade.pipelines.reports.terminal import as_text

        return as_text([self])

    def _repr_html_(self) -> str:
        """The table for notebooks."""
        from alidade.pipelines.reports.html import notebook_html

        return notebook_html(self)

    @property
    def config_text(self) -> str:
        """The config in force, YAML; what is as by default is left out."""
        from ruamel.yaml import YAML

        yaml: Any = YAML(typ="safe", pure=True)
        yaml.default_flow_style = None
        yaml.sort_base_mapping_type_on_output = False
        yaml.width = 80
        text = StringIO()
        yaml.dump(self.config.model_dump(mode="json", exclude_defaults=True), text)
        return text.getvalue()

    @property
    def formulas(self) -> Sequence[Formula]:
        """How it is applied, assumptions that the recording does not determine left out."""
        return self.method.formulas(self.applied, self.config)

    @property
    def applied(self) -> list[str]:
        """The parameters, of the assumptions those that the recording determines."""
        sigmas = {name: parameter.sigma for name, parameter in self.parameters.items()}
        return [
            q.name
            for q in self.problem.quantities
            if q.group is None or (q.name in sigmas and q.determined(sigmas[q.name]))
        ]

    @property
    def counts(self) -> dict[str, int]:
        """Messages in the recording by topic, and measurements used by family."""
        topics = {topic.name: topic.count for topic in self.facts.topics}
        families = {family: int(r.used.sum()) for family, r in self.estimate.residuals.items()}
        return {**topics, **families}

    @property
    def dropped(self) -> dict[str, int]:
        """Reason -> number of measurements left out, outliers included."""
        outliers = {f"{family}: outliers": n for family, n in self.estimate.rejected.items() if n}
        lost = {f"{topic}: lost with damaged bytes of the file": n for topic, n in self.facts.lost.items()}
        return {**lost, **self.problem.dropped, **outliers}

    @property
    def timing(self) -> dict[str, float]:
        """Phase -> s of wall time."""
        return {**self.seconds, **self.estimate.seconds}

    @property
    def innovations(self) -> dict[str, InnovationTest]:
        """Family -> whiteness and size of its innovations; of an incremental run that ended as it went."""
        if not self.estimate.has_innovations:
            return {}
        found = {family: InnovationTest.of(r) for family, r in self.estimate.residuals.items()}
        return {family: innovations for family, innovations in found.items() if innovations is not None}

    @property
    def learning(self) -> dict[str, TimeToAccuracy]:
        """Parameter -> time to its accuracy; none of the published solver, whose sigmas may be far off."""
        history = self.estimate.history
        if self.estimate.solver == "published" or history is None:
            return {}
        return time_to_accuracy(history, self.estimate.names, self.problem.quantities)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader has to know beside the headline."""
        clipped = tuple(f"{what}: {n} samples left out" for what, n in self.dropped.items() if what.endswith(CLIPPED))
        return (*self.facts.notes, *sentences.notes(self.findings, self.quantities), *clipped)


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)


class ParameterResult(_Record):
    """One parameter; SI."""

    name: str
    value: float  # of the estimate
    sigma: float  # one standard deviation, all else marginalised out
    unit: str  # SI
    prior_sigma: float | None  # null: free
    prior_mean: float = 0.0  # left out where it is 0
    require: float | None  # sigma wanted; null: none
    observability: Verdict | None  # verdict; null of an assumption that nothing is required of
    group: Literal["assumption"] | None = None  # assumption, or left out
    pull: float | None = None  # z-score of a nuisance parameter: distance from its prior over the expected spread
    inflation: float = 1.0  # of sigma, by noise that is correlated in time

    @model_serializer(mode="wrap")
    def _without_group(self, handler: SerializerFunctionWrapHandler) -> dict[str, object]:
        """What is calibrated belongs to no group and has no pull; a prior about 0 has no mean."""
        content: dict[str, object] = handler(self)
        left_out = {*(() if self.group else ("group", "pull")), *(() if self.prior_mean else ("prior_mean",))}
        return {k: v for k, v in content.items() if k not in left_out}


class NoiseResult(_Record):
    """A noise in its unit: stated by whom, estimated from the recording with sigma (null: not asked), and used.

    `inflation` is by what the sigma of a mean of its measurements is larger than if they were independent.
    """

    name: str
    unit: str
    source: Source  # who stated it: config, message or default
    stated: float  # where the search began
    estimated: float | None  # what the recording alone says; null: it was not asked
    sigma: float | None  # of estimated
    used: float  # used in the solution and all sigmas
    inflation: float  # by what a mean of such measurements is less certain than of independent ones


class CovarianceResult(_Record):
    """Joint covariance of the parameters, in the order given."""

    order: list[str]  # names of parameters
    matrix: list[list[float]]  # row by row, SI


class DirectionResult(_Record):
    """A direction that is weak or unobservable."""

    sigma_ratio: float  # its sigma after over before the recording
    weights: dict[str, float]  # parameter: its part in the direction
    advice: str  # the motion that would determine it


class FitResult(_Record):
    """Chi-square of a family with its 99.9 % interval; null where there is none."""

    value: float | None  # chi-square
    dof: float | None  # degrees of freedom
    low: float | None  # of the interval
    high: float | None  # of the interval


class ChiSquareResult(FitResult):
    """Chi-square of the whole."""

    families: dict[str, FitResult]  # the same of each family of measurements


class CauseResult(_Record):
    """A hypothesis or a prior conflict that may explain what does not fit, as text; `findings` has the numbers."""

    label: str  # what it is
    evidence: str  # what shows it


class InnovationsResult(_Record):
    """Whether the innovations of a family are white, and the mean of their squares (NIS) with its 99.9 % interval."""

    autocorrelation: list[float]  # by lag, from 1
    bound: float  # of the autocorrelation of white noise
    nis: float  # mean of the squared norms; as large as rows if sigmas are true
    low: float  # of nis
    high: float  # of nis
    rows: int  # numbers in a measurement


class LearningResult(_Record):
    """From when on a parameter was as accurate as required, s, and the tenth of the recording that said most of it."""

    met_s: float | None  # s from the start; null: never
    stretch: tuple[float, float]  # beginning and end, s
    share: float  # of the information


class StabilityResult(_Record):
    """Largest change during the recording, with its p-value."""

    statistic: float  # its size as a standard normal number
    level: float  # p-value
    time_s: float  # when, from the start
    change: dict[str, float]  # parameter: the step, SI


class SessionResult(_Record):
    """What went in; it starts at `start`, ISO 8601."""

    sha256: str  # of the file
    start: str  # ISO 8601
    duration_s: float  # s
    counts: dict[str, int]  # messages by topic, measurements used by family
    dropped: dict[str, int]  # reason: how many were left out


class TruthResult(_Record):
    """A parameter's true value and the error of the estimate; in sigmas unless it is fixed."""

    value: float  # the truth
    error: float  # estimate less truth
    error_sigmas: float | None  # null: fixed


class SensitivityResult(_Record):
    """Effect of a fixed input: parameter -> change, SI, per unit of the input.

    `step` is what the input is usually off by, one sigma; unit "1" is a share of the input itself.
    """

    unit: str  # of the input; 1: a share of itself
    step: float  # what it is usually off by
    parameters: dict[str, float]  # parameter: change per unit, SI


class MeasurementResult(_Record):
    """A measurement and the parameter that it shifts most, by `pull` sigmas."""

    family: str  # of measurements
    time_s: float  # s from the start
    parameter: str  # that it shifts most
    pull: float  # shift in sigmas


class SelfCheckResult(_Record):
    """An incremental estimate beside batch's, in sigmas."""

    parameter: str  # the one that differs most
    difference: float  # incremental less batch, in sigmas
    sigma_ratio: float  # the smallest of incremental over batch


class SecondResult(_Record):
    """Another solution that is nearly as likely; SI."""

    chi_square: float  # by how much it is higher, priors included
    parameters: dict[str, float]


class PartParameter(_Record):
    """A number of one recording; SI."""

    name: str
    value: float
    sigma: float
    unit: str


class PartResult(_Record):
    """One recording of a joint calibration.

    `parameters` are its own numbers, and the device's that walk, from all recordings; `alone` is what it says of the
    device by itself, `status` and `headline` are its own. `dof` are the degrees of freedom of its noise estimate;
    null where that was stated.
    """

    recording: str  # name of the file
    sha256: str
    start: str  # ISO 8601
    duration_s: float
    status: Status
    headline: str
    dof: float | None  # of the noise estimate
    parameters: list[PartParameter]  # its own, and the device's that walk
    alone: list[PartParameter]  # what it says of the device by itself


class ChangeResult(_Record):
    """A step of a number, SI, between two recordings; it is `found` where it is more than chance."""

    parameter: str
    before: str  # recording
    after: str  # recording
    step: float  # SI
    sigma: float
    found: bool  # more than chance


class RateResult(_Record):
    """How far numbers of a kind walk in the root of a day, SI; `upper` is the 95 % bound, null: there is none."""

    rate: float  # SI in the root of a day
    upper: float | None  # 95 % bound; null: there is none


class ChangesResult(_Record):
    """Changes of the device between recordings, tested at this level for the whole history."""

    level: float  # significance level of the whole history
    steps: list[ChangeResult]  # from recording to recording
    rates: dict[str, RateResult]  # kind of parameter: how far it walks


class Result(_Record):
    """result.json; null where the solver has no such figure."""

    schema_name: Annotated[Literal["alidade.result/1"], Field(alias="schema")] = "alidade.result/1"
    method: str  # of calibration
    solver: str  # batch, incremental or published
    status: Status  # the verdict on the whole
    parameters: list[ParameterResult]
    covariance: CovarianceResult
    null_directions: list[DirectionResult]
    chi_square: ChiSquareResult
    noise: list[NoiseResult]
    session: SessionResult
    software: dict[str, str]  # package: version
    timing_s: dict[str, float]  # phase: s of wall time
    headline: str  # the verdict in one sentence
    notes: list[str]  # what a reader has to know beside it
    causes: list[CauseResult]
    innovations: dict[str, InnovationsResult]  # by family; of the incremental solver
    learning: dict[str, LearningResult]  # by parameter
    stability: StabilityResult | None
    self_check: SelfCheckResult | None
    budget: dict[str, dict[str, float]] | None  # parameter: source: its share of the variance
    sensitivity: dict[str, SensitivityResult] | None  # effect of a fixed input
    measurements: list[MeasurementResult] | None  # the twenty that matter most
    findings: list[dict[str, object]]  # kind, severity and evidence, the most severe first
    tables: dict[str, list[dict[str, object]]]  # the method's own
    second_best: SecondResult | None = None  # where there is another solution that is nearly as likely
    constants: dict[str, float] | None = None  # that formulas need beside the parameters
    recordings: list[PartResult] | None = None  # of a joint calibration
    changes: ChangesResult | None = None  # of a joint calibration
    truth: dict[str, TruthResult] | None = None  # where the recording brings it


def result(calibration: Calibration) -> Result:
    """result.json as a model. Raises pydantic's ValidationError if a number is not finite."""
    c = calibration
    return Result(
        method=c.problem.method,
        solver=c.estimate.solver,
        status=c.status,
        parameters=list(c.parameters.values()),
        covariance=CovarianceResult(order=list(c.estimate.names), matrix=c.covariance.tolist()),
        null_directions=[DirectionResult(**direction.evidence) for direction in c.directions],
        chi_square=_chi_square(c),
        noise=c.noises,
        session=SessionResult(
            sha256=c.sha256, start=c.start, duration_s=c.facts.duration_s, counts=c.counts, dropped=c.dropped
        ),
        software=dict(c.software),
        timing_s=c.timing,
        headline=c.headline,
        notes=list(c.notes),
        causes=[CauseResult(label=label, evidence=evidence) for label, evidence in c.causes],
        innovations={family: InnovationsResult(**asdict(found)) for family, found in c.innovations.items()},
        learning={name: LearningResult(**asdict(found)) for name, found in c.learning.items()},
        stability=_stability(c.stability),
        self_check=_self_check(c.solver_difference),
        budget=None if c.budget is None else {name: dict(shares) for name, shares in c.budget.items()},
        sensitivity=c.sensitivity,
        measurements=c.measurements,
        findings=[finding_json(finding) for finding in c.findings],
        tables={name: [dict(row) for row in rows] for name, rows in c.tables.items()},
        second_best=_second(c.estimate),
        constants=dict(c.problem.constants) or None,
        recordings=list(c.recordings) or None,
        changes=_changes(c),
        truth=truth_errors(c) if c.truth is not None else None,
    )


def finding_json(finding: Finding) -> dict[str, object]:
    """A finding as result.json has it: kind, severity (note, weak, inconsistent, unobservable) and its evidence."""
    return {
        "kind": finding.kind,
        "severity": Severity(finding.severity).name.lower(),
        **{key: _json(value) for key, value in finding.evidence.items()},
    }


def _json(value: Any) -> object:
    """Findings within evidence as objects, pairs as lists; null in place of what is no finite number."""
    if isinstance(value, Finding):
        return finding_json(value)
    if isinstance(value, Mapping):
        return {key: _json(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _self_check(found: SolverDifference | None) -> SelfCheckResult | None:
    if found is None:
        return None
    return SelfCheckResult(parameter=found.parameter, difference=found.z, sigma_ratio=found.sigma_ratio)


def _second(estimate: Estimate) -> SecondResult | None:
    if estimate.second is None:
        return None
    values = dict(zip(estimate.names, estimate.second.values.tolist(), strict=True))
    return SecondResult(chi_square=estimate.second.chi_square, parameters=values)


def result_json(calibration: Calibration) -> str:
    """The text of result.json; keys that only some calibrations have are left out of the others."""
    model = result(calibration)
    seldom = ("truth", "second_best", "constants", "recordings", "changes")
    left_out = {name for name in seldom if getattr(model, name) is None}
    return model.model_dump_json(by_alias=True, indent=1, exclude=left_out) + "\n"


def truth_errors(calibration: Calibration) -> dict[str, TruthResult]:
    """Parameter -> truth and error, for those whose truth is known."""
    known = calibration.truth or {}
    found = {}
    for p in calibration.parameters.values():
        truth = known.get(p.name)
        if isinstance(truth, int | float) and math.isfinite(truth):
            error = p.value - truth
            found[p.name] = TruthResult(
                value=truth, error=error, error_sigmas=error / p.sigma if p.sigma > 0.0 else None
            )
    return found


def quantities_of(problem: Problem, estimate: Estimate) -> tuple[Quantity, ...]:
    """The quantities of an estimate, in its order; a published solver may know fewer than the problem has."""
    known = {q.name: q for q in problem.quantities}
    return tuple(known[name] for name in estimate.names)


def software_versions() -> dict[str, str]:
    """Versions of what computed the result."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _stability(found: Stability | None) -> StabilityResult | None:
    if found is None:
        return None
    change = found.departures if found.changed else {}
    return StabilityResult(statistic=found.statistic, level=found.level, time_s=found.time_s, change=change)


def _changes(c: Calibration) -> ChangesResult | None:
    """Every step as it is with nothing else changed; those found as they are with all found."""
    if c.changes is None:
        return None
    found = {(step.name, step.after): step for step in c.changes.found}
    steps = []
    for step in c.changes.steps:
        told = found.get((step.name, step.after), step)
        names = [c.recordings[i].recording for i in (step.after, step.after + 1)]
        steps.append(
            ChangeResult(
                parameter=step.name,
                before=names[0],
                after=names[1],
                step=told.size,
                sigma=told.sigma,
                found=(step.name, step.after) in found,
            )
        )
    rates = {
        name: RateResult(rate=rate.rate, upper=rate.upper if math.isfinite(rate.upper) else None)
        for name, rate in c.changes.rates.items()
    }
    return ChangesResult(level=c.changes.level, steps=steps, rates=rates)


def _chi_square(c: Calibration) -> ChiSquareResult:
    if c.fit is None:
        return ChiSquareResult(value=None, dof=None, low=None, high=None, families={})
    families = {family: FitResult(**_numbers(fit)) for family, fit in c.family_fits.items()}
    return ChiSquareResult(**_numbers(c.fit), families=families)


def _numbers(fit: Fit) -> dict[str, float | None]:
    numbers = {"value": fit.value, "dof": fit.dof, "low": fit.low, "high": fit.high}
    return {name: number if math.isfinite(number) else None for name, number in numbers.items()}
