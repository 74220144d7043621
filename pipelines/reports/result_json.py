"""result.json: one model that writes and reads it.

result_json(calibration)             # the text
read_result(Path("out/result.json")) # the keys that later commands use
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AliasChoices,
    AliasPath,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    ValidationError,
    model_serializer,
)
from pydantic_core import to_jsonable_python

from alidade.pipelines.diagnostics.observability import Verdict
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Finding, Status
from alidade.pipelines.estimation.noise import Source
from alidade.pipelines.files import MAX_RESULT_BYTES, read_bytes

if TYPE_CHECKING:
    from alidade.pipelines.diagnostics.device_changes import Changes
    from alidade.pipelines.reports.result import Calibration


# A number, null where it is not finite.
_Finite = Annotated[
    float | None, BeforeValidator(lambda x: None if isinstance(x, float) and not math.isfinite(x) else x)
]


class _Record(BaseModel):
    model_config = ConfigDict(
        extra="ignore", frozen=True, allow_inf_nan=False, populate_by_name=True, from_attributes=True
    )


class ParameterResult(_Record):
    """Calibrated parameter with its uncertainty; SI."""

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

    def __repr__(self) -> str:
        verdict = self.observability or self.group or "no requirement"
        return f"<{self.name} {self.value:.6g} ± {self.sigma:.2g} {self.unit}, {verdict}>".replace(" ,", ",")

    @model_serializer(mode="wrap")
    def _without_group(self, handler: SerializerFunctionWrapHandler) -> dict[str, object]:
        """Serialise without keys that do not apply: z-score without a group, prior_mean where it is 0."""
        content: dict[str, object] = handler(self)
        left_out = {*(() if self.group else ("group", "pull")), *(() if self.prior_mean else ("prior_mean",))}
        return {k: v for k, v in content.items() if k not in left_out}


class NoiseResult(_Record):
    """A noise in its unit: stated by whom, estimated from the recording with sigma (null: not asked), and used."""

    name: str
    unit: str
    source: Source  # who stated it: config, message or default
    stated: float  # where the search began
    estimated: float | None  # what the recording alone says; null: it was not asked
    sigma: float | None  # of estimated
    used: float  # used in the solution and all sigmas
    inflation: float  # by what a mean of such measurements is less certain than of independent ones
    correlation_time: float | None = None  # s, of a Gauss-Markov error; null: white noise, or a walk


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

    value: _Finite  # chi-square
    dof: _Finite  # degrees of freedom
    low: _Finite  # of the interval
    high: _Finite  # of the interval


class ChiSquareResult(FitResult):
    """Chi-square of all residuals together."""

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
    """Recording that a result is of: start, length, counts of messages and of what was left out."""

    sha256: str  # of the file
    start: str  # ISO 8601
    duration_s: float = Field(validation_alias=AliasChoices("duration_s", AliasPath("facts", "duration_s")))  # s
    counts: dict[str, int]  # messages by topic, measurements used by family
    dropped: dict[str, int]  # reason: how many were left out


class TruthResult(_Record):
    """A parameter's true value and the error of the estimate; in sigmas unless it is fixed."""

    value: float  # the truth
    error: float  # estimate less truth
    error_sigmas: float | None  # null: fixed


class SensitivityResult(_Record):
    """Effect of a fixed input: parameter -> change, SI, per unit of the input."""

    unit: str  # of the input; 1: a share of itself
    step: float  # what it is usually off by, one sigma
    parameters: dict[str, float]  # parameter: change per unit, SI


class MeasurementResult(_Record):
    """An influential measurement and the parameter that it shifts most, in sigmas."""

    family: str  # of measurements
    time_s: float = Field(validation_alias=AliasChoices("time_s", "time"))  # s from the start
    parameter: str  # that it shifts most
    pull: float = Field(validation_alias=AliasChoices("pull", "sigmas"))  # shift in sigmas


class SelfCheckResult(_Record):
    """Difference of an incremental estimate from batch's, in sigmas."""

    parameter: str  # the one that differs most
    difference: float = Field(validation_alias=AliasChoices("difference", "z"))  # incremental less batch, in sigmas
    sigma_ratio: float  # the smallest of incremental over batch


class SecondResult(_Record):
    """Another solution that is nearly as likely; SI."""

    chi_square: float  # by how much it is higher, priors included
    parameters: dict[str, float]


class PartParameter(_Record):
    """Parameter of one recording in a joint calibration; SI."""

    name: str
    value: float
    sigma: float
    unit: str


class PartResult(_Record):
    """One recording of a joint calibration; its status and headline are its own."""

    recording: str  # name of the file
    sha256: str
    start: str  # ISO 8601
    duration_s: float
    status: Status
    headline: str
    dof: float | None  # degrees of freedom of its noise estimate; null: that was stated
    parameters: list[PartParameter]  # its own, and the device's that walk, from all recordings
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
    """Walk of numbers of a kind in the root of a day, SI; `upper` is the 95 % bound, null: there is none."""

    rate: float  # SI in the root of a day
    upper: _Finite  # 95 % bound; null: there is none


class ChangesResult(_Record):
    """Changes of the device between recordings, tested at this level for the whole history."""

    level: float  # significance level of the whole history
    steps: list[ChangeResult]  # from recording to recording
    rates: dict[str, RateResult]  # kind of parameter: how far it walks


class UseResult(_Record):
    """A use of the calibration with the 95 % bound of its error."""

    name: str = Field(validation_alias=AliasChoices("name", AliasPath("use", "name")))  # such as heading
    unit: str = Field(validation_alias=AliasChoices("unit", AliasPath("use", "unit")))  # of the numbers
    before: float  # 95 % bound without calibration
    after95: float = Field(validation_alias=AliasChoices("after95", "after"))  # 95 % bound with it
    required: float | None  # at the requirements
    at: str = Field(validation_alias=AliasChoices("at", AliasPath("use", "label")))  # operating point, in words
    coefficients: dict[str, dict[str, dict[str, _Finite]]] | None = None  # curve: A to E of a compass deviation


class Result(_Record):
    """Content of result.json; null where the solver has no such figure."""

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
    tables: dict[str, list[dict[str, object]]]  # the method's own; derived: mag_scale, mag_shape
    uses: list[UseResult] = []  # error in use, before and after
    applied: list[str] = []  # parameters that the formulas apply
    second_best: SecondResult | None = None  # where there is another solution that is nearly as likely
    constants: dict[str, float] | None = None  # that formulas need beside the parameters
    sources: list[str] | None = None  # SHA-256 of each recording behind the values, where there are several
    recordings: list[PartResult] | None = None  # of a joint calibration
    changes: ChangesResult | None = None  # of a joint calibration
    truth: dict[str, TruthResult] | None = None  # where the recording brings it


# Keys that `read_result` does not read, as they may differ in results of other versions.
_UNREAD: dict[str, object] = {
    **{key: [] for key in ("null_directions", "notes", "causes", "findings")},
    **{key: {} for key in ("timing_s", "innovations", "learning", "tables")},
    **dict.fromkeys(("stability", "self_check", "sensitivity", "measurements", "second_best", "changes", "truth")),
}


def read_result(path: Path, text: str | bytes | None = None) -> Result:
    """Read result.json without the keys in _UNREAD; `text` is the file's content if that has been read before.

    Raises:
        InputError: the file cannot be read or is no result.json.
    """
    data = read_bytes(path, MAX_RESULT_BYTES) if text is None else text
    try:
        content = TypeAdapter(dict[str, Any]).validate_json(data)
        return Result.model_validate({"schema": None, **content, **_UNREAD})
    except ValidationError as error:
        raise invalid(path, "a result.json", error) from error


def invalid(path: Path, what: str, error: ValidationError) -> InputError:
    """Return an InputError with the first error that pydantic found in a file."""
    first: Any = error.errors()[0]
    said = "it has no keys and values" if first["type"] in ("model_type", "dict_type") else first["msg"]
    return InputError(f"{path}: not {what}: {': '.join(filter(None, ['.'.join(map(str, first['loc'])), said]))}")


# Keys that a calibration has by the same name.
_ITS_OWN = ("status", "software", "headline", "notes", "innovations", "learning", "budget", "sensitivity", "applied")


def result(calibration: Calibration) -> Result:
    """Return the content of result.json as a model. Raises pydantic's ValidationError for a non-finite number."""
    c, second = calibration, calibration.estimate.second
    return Result.model_validate(
        {
            **{key: getattr(c, key) for key in _ITS_OWN},
            "schema": "alidade.result/1",
            "method": c.problem.method,
            "solver": c.estimate.solver,
            "parameters": list(c.parameters.values()),
            "covariance": {"order": c.estimate.names, "matrix": c.covariance.tolist()},
            "null_directions": [direction.evidence for direction in c.directions],
            "chi_square": {
                **(vars(c.fit) if c.fit else dict.fromkeys(FitResult.model_fields)),
                "families": c.family_fits,
            },
            "noise": c.noises,
            "session": c,
            "timing_s": c.timing,
            "causes": [{"label": label, "evidence": evidence} for label, evidence in c.causes],
            "stability": c.stability
            and {**vars(c.stability), "change": c.stability.departures if c.stability.changed else {}},
            "self_check": c.solver_difference,
            "measurements": c.estimate.strongest,
            "findings": [finding_json(finding) for finding in c.findings],
            "tables": {**c.tables, **({"derived": [each._asdict() for each in c.derived]} if c.derived else {})},
            "second_best": second
            and {
                "chi_square": second.chi_square,
                "parameters": dict(zip(c.estimate.names, second.values.tolist(), strict=True)),
            },
            "constants": c.problem.constants or None,
            "sources": c.sources or None,
            "recordings": c.recordings or None,
            "changes": c.changes
            and {"level": c.changes.level, "steps": _steps(c.changes, c.recordings), "rates": c.changes.rates},
            "uses": c.uses,
            "truth": None if c.truth is None else truth_errors(c),
        }
    )


def finding_json(finding: Finding) -> dict[str, object]:
    """Return a finding as in result.json: kind, severity (note, weak, inconsistent, unobservable) and evidence."""
    evidence = {k: [*map(finding_json, v)] if k == "findings" else v for k, v in finding.evidence.items()}
    content = {"kind": finding.kind, "severity": finding.severity.name.lower(), **evidence}
    found: dict[str, object] = to_jsonable_python(content, inf_nan_mode="null")
    return found


def result_json(calibration: Calibration) -> str:
    """Return the text of result.json without the keys that apply to some calibrations only, where they are empty."""
    model = result(calibration)
    seldom = ("truth", "second_best", "constants", "sources", "recordings", "changes")
    left_out = {name for name in seldom if getattr(model, name) is None}
    return model.model_dump_json(by_alias=True, indent=1, exclude=left_out) + "\n"


def results_json(calibrations: Sequence[Calibration]) -> str:
    """Return the text of a list of several calibrations' result.json."""
    return f"[{', '.join(result_json(calibration).rstrip() for calibration in calibrations)}]"


def truth_errors(calibration: Calibration) -> dict[str, TruthResult]:
    """Return parameter -> truth and error, for parameters whose truth is known."""
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


def _steps(changes: Changes, parts: Sequence[PartResult]) -> list[ChangeResult]:
    """Return all tested steps of the device's parameters; those found are estimated with all found, others alone."""
    return [
        ChangeResult(
            parameter=step.name,
            before=parts[step.after].recording,
            after=parts[step.after + 1].recording,
            step=step.size,
            sigma=step.sigma,
            found=step in changes.found,
        )
        for step in changes.steps
    ]
