"""Validation of a calibration on a recording: errors without and with the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from alidade.pipelines import deadline, methods
from alidade.pipelines.applications.session import Session, open_session, resolve_method
from alidade.pipelines.applications.sharing import device_prior, finding_of_recording, walks
from alidade.pipelines.config import Settings, configured
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.diagnostics.device_changes import CalibrationCheck, Change, Verdict, check_calibration
from alidade.pipelines.display.units import format_estimate, human_unit, rounded
from alidade.pipelines.errors import IndeterminateError, InputError
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.reports.calibration import SavedCalibration, load_known, saved, with_covariance
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.sentences import sentence


@dataclass(frozen=True, eq=False, repr=False)
class Validated:
    """Result of a calibration's test on a recording.

    Attributes:
        calibration: the one validated.
        recording: name of the file.
        validations: what the method says.
        same_recording: the calibration was made of this recording, alone or with others.
        lost: sentences about what of the recording cannot be used.
        held: whether the calibration holds; None where the recording cannot say.
        device: what the method says of the calibration's device, bias and the like of this recording re-estimated.
        best: the same of the recording's own calibration: errors that are to be expected of one that holds.
        own: the recording's own calibration; None where nothing is determined, and where everything is fixed.
    """

    calibration: SavedCalibration
    recording: str
    validations: Sequence[Validation]
    same_recording: bool
    lost: tuple[str, ...] = ()
    held: CalibrationCheck | None = None
    device: Sequence[Validation] = ()
    best: Sequence[Validation] = ()
    own: Calibration | None = None

    def __repr__(self) -> str:
        return f"<Validated {self.calibration.method} on {self.recording}: {self.verdict}>"

    @property
    def within(self) -> Finding | None:
        """Finding on a material change of the device during the recording; None without one."""
        found = (each for each in (self.own.findings if self.own else ()) if each.kind == "change")
        return next((each for each in found if each.severity == Severity.INCONSISTENT and each.evidence["steps"]), None)

    @property
    def applied(self) -> Sequence[Validation]:
        """Errors with the calibration; turn-on bias and the like are re-estimated from this recording if possible."""
        return self.device or self.validations

    @property
    def verdict(self) -> Verdict:
        """Verdict on the calibration: holds, changed, unknown, or same for the recording that it was made of."""
        if self.same_recording:
            return "same"
        if self.held is None:
            return "unknown"
        return self.held.verdict if self.within is None else "changed"

    @property
    def serves(self) -> bool:
        """Whether the parameters changed, but by less than the required accuracy."""
        return self.verdict == "changed" and self.within is None and self.held is not None and not self.held.matters

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        if self.same_recording:
            return "The calibration was made of this recording, and always agrees with it."
        if self.held is None or self.verdict == "unknown":
            return "The recording does not determine whether the calibration holds."
        if self.within is not None:
            return f"The calibration does not hold: {sentence(self.within, self.held.quantities)}"
        if self.verdict == "holds":
            tested = f"{len(self.held.steps)} of {len(self.held.required)} parameters"
            return f"The calibration holds: {tested} unchanged, to {self._resolution}."
        found = self._changes(self.held.changes.found)
        what = "; ".join(found) or "all parameters together, none by more than chance for itself"
        small = " That is less than what is required of them." if self.serves and found else ""
        return f"The calibration does not hold: {what}.{small}"

    def _changes(self, steps: Sequence[Change]) -> list[str]:
        """Phrases with the number that changed and by how much."""
        known = self.held.quantities if self.held else {}
        return [f"{step.name} changed by {format_estimate(known[step.name], step.size, step.sigma)}" for step in steps]

    @property
    def _resolution(self) -> str:
        """Phrase with the largest change, by unit, that would not be significant."""
        assert self.held is not None
        largest: dict[str, float] = {}
        for step in self.held.steps:
            unit, factor = human_unit(self.held.quantities[step.name])
            largest[unit] = max(largest.get(unit, 0.0), factor * self.held.changes.limit * step.sigma)
        return ", ".join(f"{rounded(size)} {unit}".strip() for unit, size in largest.items())

    @property
    def notes(self) -> list[str]:
        """Sentences that a reader needs beside the numbers."""
        out = [*self.lost, *(f"{v.name}: {v.note}" for v in self.validations if v.note and not self.device)]
        if self.calibration.status != "calibrated":
            out.append(f"the calibration's own verdict is {self.calibration.status}")
        if self.held is not None:
            out += [f"{what}: no accuracy is required of it" for what in self._changes(self.held.changes.others)]
            if self.held.steps and self.held.untested:
                apart = ", apart from what did" * bool(self.held.changes.found or self.held.changes.others)
                out.append(f"the recording does not determine whether {', '.join(self.held.untested)} changed{apart}")
        shown = None if self.held is None else self.within  # by the sentence
        if self.own is not None and (own := finding_of_recording(self.own, shown)) is not None:
            out.append(sentence(own, self.own.quantities))
        return out


def validate(
    recording: str | Path,
    calibration: str | Path | Calibration,
    *,
    method: str | None = None,
    config: Settings = None,
    strict: bool = False,
    auto_topics: bool = False,
    auto_columns: bool = False,
) -> Validated:
    """Test a calibration on another recording: `.verdict`, `.sentence`, `.held.steps`.

    Args:
        recording: the other one.
        calibration: a result.json, a calibration.yaml, or what `calibrate` returns.
        method: of both, that of the calibration.
        config: overrides the recording's own config key by key.
        strict: refuse a recording of which anything is lost.
        auto_topics: use the topics that `alidade info` proposes where those of the method are absent.
        auto_columns: use the columns of tables that `alidade info` proposes where the config describes none.

    Raises:
        InputError: recording, config or calibration cannot be used, or the calibration is another method's.
    """
    path = Path(recording)
    known = saved(calibration) if isinstance(calibration, Calibration) else load_known(Path(calibration))
    known.of_method(known.method if method is None else methods.method(method).name)
    try:
        session = open_session(path, known.method, config, strict, auto_topics=auto_topics, auto_columns=auto_columns)
    except InputError:
        if method is None:
            known.of_method(_method_of(path, config) or known.method)
        raise
    if not isinstance(calibration, Calibration):
        known = with_covariance(known, Path(calibration))
    chosen, data, settings, opened = session.method, session.data, session.config, session.recording
    assert opened is not None
    values = known.values
    validations = chosen.report.validate(data, settings, values)
    if known.includes(opened.sha256()):
        return Validated(known, path.name, validations, True, opened.notes)
    with session.usual_time():
        found = _check(session, known)
        lost = (*opened.notes, *filter(None, [deadline.stopped()]))
    held, own = found
    if own is None or held is None:
        return Validated(known, path.name, validations, False, lost, own=own)
    numbers = own.problem.numbers(own.estimate)
    of_device = walks(chosen, settings, [name for name in numbers if name in known.parameters])
    fixed = {name: values[name] for name in of_device if name in values}
    others = GaussianPrior(own.estimate.names, own.estimate.values, own.estimate.covariance).given(fixed)
    device = chosen.report.validate(data, settings, numbers | others.means | fixed)
    best = chosen.report.validate(data, settings, numbers)
    return Validated(known, path.name, validations, False, lost, held, device, best, own)


def _method_of(path: Path, config: Settings) -> str:
    """Return the method that a recording selects by itself; empty where it selects none."""
    try:
        return resolve_method(None, *configured(open_recording(path), config))
    except InputError:
        return ""


def _check(session: Session, known: SavedCalibration) -> tuple[CalibrationCheck | None, Calibration | None]:
    """Test an earlier calibration on a recording by the recording's own calibration, which is returned too.

    No test where that has not converged; and no calibration where nothing is determined, or everything is fixed.
    """
    session = replace(session, near=known.values)
    if known.solver == "published" or all(q.prior_sigma == 0.0 for q in session.problem().quantities):
        return None, None
    gaussian_prior = device_prior(known, session.method, session.config, session.sha256(), session.epoch_ns)
    try:
        own = session.calibrate(report=False)
    except IndeterminateError:
        return None, None
    estimate = own.estimate
    if not estimate.converged or estimate.sqrt_info is None:
        deadline.passed("the solution of this recording")
        return None, own
    inflations = dict(zip(estimate.names, estimate.inflations.tolist(), strict=True))
    return check_calibration(gaussian_prior, estimate.sqrt_info, own.problem.quantities, inflations), own
