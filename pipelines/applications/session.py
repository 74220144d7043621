"""From a recording to calibrations: open, choose the method, solve, judge.

session = open_session(Path("session.mcap"))
session.calibrate("batch").status
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from alidade.pipelines import deadline, methods, progress
from alidade.pipelines.applications.discovery import empty, idle, nearest_suggestion, suggestions, with_suggested
from alidade.pipelines.applications.sharing import device_prior, walks
from alidade.pipelines.applications.table_discovery import propose_columns, with_columns
from alidade.pipelines.config import Settings, configured, load_config
from alidade.pipelines.diagnostics.change_test import (
    Stability,
    change_finding,
    offset_finding,
    stability,
    step_finding,
    step_stability,
    with_change,
)
from alidade.pipelines.diagnostics.cross_validation import SplitHalf, held_out_residuals, solve_segments, split_halves
from alidade.pipelines.diagnostics.diagnose import diagnose, is_suspect, prior_conflicts, rejects_an_end
from alidade.pipelines.diagnostics.goodness_of_fit import SolverDifference, solver_difference
from alidade.pipelines.diagnostics.hypothesis_tests import find_hypotheses, misstatements
from alidade.pipelines.diagnostics.observability import finite_covariance
from alidade.pipelines.diagnostics.split_test import RESOLUTION, change_by_parts
from alidade.pipelines.diagnostics.stated_priors import contradictions, freed_config, with_conflicts
from alidade.pipelines.errors import InputError, NotARecordingError
from alidade.pipelines.estimation.finding import Finding, Severity, by_severity, remark
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import (
    AttitudeRate,
    Attitudes,
    EngineName,
    Estimate,
    History,
    Problem,
    Quantity,
    SqrtInformation,
    Step,
)
from alidade.pipelines.methods import Method
from alidade.pipelines.recording.checks import COPIED, OVERTAKEN
from alidade.pipelines.recording.decoding import ENCODING
from alidade.pipelines.recording.opening import Where
from alidade.pipelines.recording.plausibility import HELD
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.recording.table_topics import tables_of
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, SessionFacts, facts_of, lacking, wanted
from alidade.pipelines.reports.calibration import load_known
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import TRUTH, Config
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.window import check_window

SOLVERS = ("batch", "incremental", "published")
# Steps that a run takes whatever time it has: of fewer there may be no solution at all.
_LEAST_STEPS = 20
# What ends for want of time, in this order.
_HYPOTHESES, _SEGMENTS, _COMPARISON, _SENSITIVITY, _HALVES, _HELD_OUT = (
    "the test of hypotheses",
    "the solution of both sides of a change",
    "the comparison with batch",
    "the sensitivity to fixed inputs",
    "the split-half test",
    "the prediction of held-out measurements",
)
# What an online run ends with.
_CONCLUDED = "at the end all measurements were solved together"
# Difference between incremental and batch that is worth a note, in sigmas.
_NOTABLE_DIFFERENCE = 1.0


@dataclass(frozen=True, eq=False, repr=False)
class Session:
    """Data as their method takes them, the config in force, and the recording that both come from.

    Attributes:
        method, data, config: as above.
        recording: that the data were read from; None: they are arrays in memory.
        known: parameter -> true value, of simulated arrays.
        engine: that eliminates batch's linear systems.
        near: numbers that rotations are reported near of, as another recording of the device has them.
        attitude_rate: of the trajectory that is reported.
        read_s: wall time of reading, s; None: nothing was read.
    """

    method: Method
    data: Any
    config: Config
    recording: Recording | None = None
    known: Mapping[str, float] | None = None
    engine: EngineName = "auto"
    near: Mapping[str, float] = field(default_factory=dict)
    attitude_rate: AttitudeRate = "vision"
    read_s: float | None = None

    @classmethod
    def read(
        cls,
        recording: Recording,
        method_name: str | None,
        config_file: Settings,
        auto_topics: bool = False,
        prior: Path | None = None,
        auto_columns: bool = False,
    ) -> Session:
        """Read and check a recording.

        Args:
            recording: opened.
            method_name: None: the config's, or the only one that the recording can serve.
            config_file: overrides the recording's own config key by key; a YAML file or a Config.
            auto_topics: use the topics that `alidade info` proposes where those of the method are absent.
            prior: an earlier calibration of the device, result.json or calibration.yaml.
            auto_columns: use the columns of tables that `alidade info` proposes where the config describes none.

        Raises:
            InputError: recording, config or prior cannot be used.
        """
        recording, config = configured(recording, config_file)
        if auto_columns:
            recording, config = with_columns(recording, config)
        if auto_topics:
            recording, config = with_suggested(recording, config, method_name)
        chosen = methods.method(resolve_method(method_name, recording, config))
        for sentence in of_other_methods(chosen, config):
            recording.remark(sentence)
        try:
            data = chosen.read(recording, config)
        except InputError as error:
            missing = missing_for(chosen.name, recording, config.model_copy(update={"method": chosen.name}))
            if not missing:
                raise
            nearest = nearest_suggestion(suggestions(recording, config, [chosen.name]))
            said = str(error)
            if said.startswith("topic "):  # a fault of a topic matters less than others that are not there
                said = f"{recording.path}: method {chosen.name} lacks {'; '.join(missing)}"
            raise InputError(f"{said}{f'; nearest is {nearest}' if nearest else ''}") from error
        unused = *idle(recording, config, chosen.name), *empty(recording, config, chosen.name)
        for sentence in (*_counted(data), *unused):
            recording.remark(sentence)
        session = cls(chosen, data, config, recording)
        return session if prior is None else session.beginning_from(prior)

    def beginning_from(self, prior: Path) -> Session:
        """Return the session with an earlier calibration of the device, result.json or calibration.yaml, as prior.

        Raises:
            InputError: it cannot be used, is another method's, or was made of this recording.
        """
        gaussian_prior = device_prior(load_known(prior), self.method, self.config, self.sha256(), self.epoch_ns)
        return replace(self, config=self.config.with_prior(gaussian_prior))

    def again(self, recording: Recording) -> Session:
        """Return a session of another recording, or part of one, with the same method and config. Raises InputError."""
        recording = recording.with_config(self.config.topics.values(), self.config.columns)
        return replace(self, data=self.method.read(recording, self.config), recording=recording)

    @classmethod
    def of(cls, method: Method | None, simulated: Simulated, config_file: Settings = None) -> Session:
        """Return a session of simulated data that were never written to a file; by default with their own method."""
        config = load_config(simulated.config.encode(), config_file)
        chosen = method or methods.method(config.method or "")
        return cls(chosen, simulated.data, config, known=simulated.truth)

    def __repr__(self) -> str:
        return f"<Session {self.method.name} of {self.name}>"

    @property
    def name(self) -> str:
        """Name of the recording, for people."""
        return "arrays" if self.recording is None else self.recording.path.name

    @property
    def epoch_ns(self) -> int:
        """Origin of all times, Unix ns: the recording's first stamp."""
        return int(self.data.epoch_ns)

    def sha256(self) -> str:
        """SHA-256 of the recording, or of all arrays and numbers in memory, hexadecimal."""
        if self.recording is not None:
            return self.recording.sha256()
        return sha256_of(self.data)

    def truth(self) -> Mapping[str, object] | None:
        """Parameter -> true value, where known. Raises InputError for an attachment that is no JSON object."""
        attachment = None if self.recording is None else self.recording.attachment(TRUTH, needed=False)
        if self.recording is None or attachment is None:
            return self.known
        try:
            return dict(json.loads(attachment, parse_int=float))
        except (ValueError, TypeError, RecursionError) as error:
            raise InputError(
                f"{self.recording.path}: the attachment {TRUTH} is no JSON object of parameters and their values"
            ) from error

    def problem(self) -> Problem:
        """Return the factor graph. Raises InputError for too few data, or config keys that the method does not use."""
        return self._problem

    @cached_property
    def _problem(self) -> Problem:
        _check_sheets(self.method, self.config)
        try:
            with progress.doing("preparing the graph"):
                return self.method.graph(self.data, self.config).near(self.near)
        except InputError as error:
            unknown = str(error).startswith("unknown key") and self.config.origin
            raise InputError(f"{self.config.origin}: {error}") if unknown else error from None

    @cached_property
    def facts(self) -> SessionFacts:
        """Facts about the recording: topics, rates, gaps, losses; of arrays the length. The stamps are freed then."""
        if self.recording is None:
            start, stop = self.method.faults.span(self.data)
            return SessionFacts(self.epoch_ns, stop - start, (), (), {self.method.name: ()}, notes=_counted(self.data))
        facts = session_facts(self.recording, self.config)
        self.recording.forget_times()
        return facts

    def calibrate(
        self, solver: str = "batch", window: float | None = 1.0, check: bool = True, report: bool = True
    ) -> Calibration:
        """The calibration by one of SOLVERS; `window` in s is the incremental one's, None keeps the whole history.

        With `check` an incremental run ends with the solution of all measurements together, as the command's does:
        that is what a change is looked for in. Without `report` there are values, sigmas and verdicts,
        the same to the last digit, and nothing of what else a report explains: where the variances come from, which
        measurements move a number most, the effect of fixed inputs on it, the method's own findings.

        Raises:
            InputError: no such solver, no such window, or the data cannot be used.
            IndeterminateError: states other than the parameters are not determined.
        """
        (calibration,) = self.calibrations([solver], window, check=check, report=report)
        return calibration

    def calibrations(
        self, solvers: Sequence[str], window: float | None = 1.0, check: bool = False, report: bool = True
    ) -> list[Calibration]:
        """Return a calibration of the recording by each solver; see `calibrate`."""
        if isinstance(solvers, str):
            raise InputError(f"solvers: a list of names is needed, not the text {solvers!r}")
        for solver in solvers:
            if solver not in SOLVERS:
                raise InputError(f"no solver {solver!r}; there are {', '.join(SOLVERS)}")
        check_window(window)
        solved = (self._solve(solver, window, report=report) for solver in solvers)
        with self.usual_time("incremental" in solvers):
            return self.judged(solved, {} if self.read_s is None else {"read": self.read_s}, check, report)

    def calibrated_beside(self, others: Callable[[SqrtInformation], Mapping[str, float]]) -> Calibration:
        """Calibrate by batch, with the information linearised where other recordings have the parameters.

        `others` maps the recording's information, linear about its solution, to the parameters given the others too.
        """
        with self.usual_time():
            (calibration,) = self.judged([self._solve("batch", None, others)], {})
        return calibration

    def usual_time(self, online: bool = False) -> AbstractContextManager[None]:
        """Context manager with the default time limit of a calibration, where no command has set one."""
        start, stop = self.method.faults.span(self.data)
        return deadline.usual(stop - start, online)

    def judged(
        self, solved: Iterable[Estimate], seconds: Mapping[str, float], check: bool = False, report: bool = True
    ) -> list[Calibration]:
        """Return a calibration for each estimate of the session's parameters: findings added, ready for reports.

        `seconds` is what reading took; `check` and `report` are as `calibrate` has them. Raises InputError when
        attitudes are wanted at the gyro's rate, and the method has none.
        """
        if self.attitude_rate == "gyro" and self.problem().at_gyro_rate is None:
            raise InputError(f"attitude rate gyro: {self.method.name} has no attitudes between those it estimates")
        # The facts before anything is solved, so that the stamps need not be kept meanwhile.
        sha256, truth, facts = self.sha256(), self.truth(), self.facts
        found, published, problem = [], None, self.problem()
        for estimate in solved:
            quantities = tuple(q for q in problem.quantities if q.name in estimate.names)
            estimate = replace(estimate, covariance=finite_covariance(quantities, estimate.covariance))
            difference = None
            if check and estimate.solver == "incremental" and not deadline.passed(_COMPARISON):
                estimate, difference = self._with_conclusion(estimate, quantities, report)
            if estimate.solver == "published":
                published = estimate
            elif report and estimate.solver == "incremental" and published is None:
                with suppress(InputError):  # that solver needs more data
                    published = self._solve("published", None)
            stable, change = self.change(estimate, quantities)
            conflicts = prior_conflicts(estimate, quantities)
            if estimate.converged and estimate.solver != "published":
                estimate = with_conflicts(estimate, quantities, conflicts)
            if change is not None and change.kind == "change" and change.severity < Severity.INCONSISTENT:
                estimate = with_change(estimate, change)
            tables = self.method.report.findings(self.data, self.config, estimate) if report else {}
            estimate, carried = self._at_gyro_rate(estimate)
            with deadline.renewed():
                found_at, judged = self._findings(estimate, quantities, change, conflicts)
            stable, findings = found_at or stable, [*judged]
            findings += [*_remarks(problem, estimate, difference), *carried]
            findings += map(remark, filter(None, [deadline.stopped()]))
            if not estimate.converged and estimate.solver != "published":  # curvature where no minimum is
                priors = np.array([0.0 if q.prior_sigma == 0.0 else q.scale for q in quantities])
                estimate = replace(estimate, covariance=problem.prior_covariance(estimate.names, priors))
            found.append(
                Calibration(
                    method=self.method,
                    problem=problem,
                    estimate=estimate,
                    findings=by_severity(findings),
                    recording=self.name,
                    sha256=sha256,
                    facts=facts,
                    config=self.config,
                    truth=truth,
                    seconds=seconds,
                    plots=partial(self.method.report.figures, self.data),
                    beside=published if estimate.solver == "incremental" else None,
                    stability=stable,
                    solver_difference=difference,
                    tables=tables,
                )
            )
        return found

    def _at_gyro_rate(self, estimate: Estimate) -> tuple[Estimate, list[Finding]]:
        """Return the estimate with attitudes at the wanted rate, and a note on the gaps between those by vision."""
        problem = self.problem()
        if self.attitude_rate == "vision" or estimate.attitudes is None or problem.at_gyro_rate is None:
            return estimate, []
        dense = problem.at_gyro_rate(estimate.attitudes, problem.numbers(estimate))
        return replace(estimate, attitudes=dense), [_carried(estimate.attitudes, dense)]

    def cross_validate(self) -> tuple[dict[str, SplitHalf], dict[str, float], str, tuple[str, ...]]:
        """Return the split-half test, held-out residuals by family, what the time limit stopped, unsolved halves."""
        with self.usual_time():
            halves, unsolved, predicted = dict[str, SplitHalf](), tuple[str, ...](), dict[str, float]()
            if not deadline.passed(_HALVES):
                halves, unsolved = split_halves(self.method.graph, self.method.faults, self.data, self.config)
                deadline.passed(_HALVES)
            if not deadline.passed(_HELD_OUT):
                predicted = held_out_residuals(self.problem())
            return halves, predicted, deadline.stopped(), unsolved

    def _findings(
        self,
        estimate: Estimate,
        quantities: Sequence[Quantity],
        change: Finding | None,
        conflicts: Sequence[Finding],
    ) -> tuple[Stability | None, tuple[Finding, ...]]:
        """Return the findings on an estimate; if it is suspect, causes are looked for.

        The first is the test of a change that explains the misfit; None where nothing did.
        """
        contradicted, problem = self._contradictions(estimate, quantities), self.problem()
        advice = problem.advice
        findings = diagnose(estimate, quantities, advice, change, (), contradicted, conflicts)
        if estimate.solver == "published" or deadline.passed(_HYPOTHESES):
            return None, findings
        model, build = self.method.faults, self.method.graph
        hypotheses = misstatements(build, model, self.data, self.config)
        suspect = is_suspect(estimate, findings, quantities)
        # A test of steps at every keyframe separates slips from outliers and from other faults.
        by_parts = not hypotheses and not (problem.step_candidates and estimate.converged)
        if not (hypotheses or suspect or (by_parts and (rejects_an_end(estimate) or change is not None))):
            return None, findings
        severe = any(each.severity > Severity.NOTE for each in contradicted)
        freed = self._freed[0] if severe and self._freed is not None else None
        split = self._changed_between(quantities, freed, estimate.converged) if by_parts else None
        if suspect and not hypotheses and (split is None or not split[1].evidence["steps"]):
            with progress.doing("testing hypotheses"):
                hypotheses = find_hypotheses(build, model, self.data, self.config, estimate, freed)
            deadline.passed(_HYPOTHESES)
        if not hypotheses and split is not None:
            stable, found = split
            if not suspect and not found.evidence["steps"]:
                weak = replace(found, severity=Severity.WEAK)
                return stable, diagnose(estimate, quantities, advice, weak, (), contradicted, conflicts)
            # What of a device contradicts its data sheet is what a mixture of two devices has.
            return stable, diagnose(estimate, quantities, advice, None, (found,), (), ())
        # A fault that explains more than freeing what is fixed is what these contradictions come from.
        contradicted = () if hypotheses else contradicted
        return None, diagnose(estimate, quantities, advice, change, hypotheses, contradicted, conflicts)

    def _changed_between(
        self, quantities: Sequence[Quantity], freed: Config | None, converged: bool
    ) -> tuple[Stability, Finding] | None:
        """Test whether a change during the recording explains its misfit; return the test and a finding with the steps.

        There are no steps where the parts do not determine what changed; a step that is immaterial is no change.
        Where neither part nor the whole determines anything, as without motion, parts fit whatever was recorded.
        """
        with progress.doing("looking for a change"):
            model, build = self.method.faults, self.method.graph
            stable = change_by_parts(build, model, self.data, self.config, freed)
            if stable is None:
                return None
            parts = self._either_side(stable.time_s)
        if not (parts or converged):
            return None
        found = change_finding(stable, parts, quantities)
        if found is not None and found.severity < Severity.INCONSISTENT:
            return None
        start, stop = model.span(self.data)
        between = RESOLUTION * (stop - start)
        steps = {} if found is None else found.evidence["steps"]
        evidence = {"since_s": stable.time_s - between, "time_s": stable.time_s + between, "steps": steps}
        return replace(stable, differences=steps), Finding("change", Severity.INCONSISTENT, evidence)

    def _contradictions(self, estimate: Estimate, quantities: Sequence[Quantity]) -> tuple[Finding, ...]:
        """Return findings on inputs that the config fixes and the recording contradicts."""
        if estimate.solver == "published" or not estimate.converged or self._freed is None:
            return ()
        from alidade.pipelines.solvers.freed import freed_information

        ratio = estimate.widest(quantities)
        freed, found = self._freed[1], estimate.error_map
        if found is not None:
            freed, quantities = found.map.added_to(freed), (*quantities, *found.map.parameter.quantities)
        sqrt_info = freed_information(freed, estimate)
        return () if sqrt_info is None else contradictions(sqrt_info, freed.quantities, quantities, ratio)

    @cached_property
    def _freed(self) -> tuple[Config, Problem] | None:
        """Config with all its fixed parameters free, and the graph of it; None where the config fixes nothing."""
        config = freed_config(self.config, self.problem().quantities)
        try:
            return None if config is None else (config, self.method.graph(self.data, config).near(self.near))
        except InputError:  # the method has to have it fixed
            return None

    def change(self, estimate: Estimate, quantities: Sequence[Quantity]) -> tuple[Stability | None, Finding | None]:
        """Test for a change; return the test's result, and if there is one a finding with the steps at it."""
        if estimate.solver == "published" or not estimate.converged:
            return None, None
        ratios = [] if estimate.sandwich is None else estimate.sandwich[[q.judged for q in quantities]].tolist()
        ratio = max(ratios, default=1.0)
        if estimate.steps is not None:
            span = float(np.ptp(np.concatenate([r.time for r in estimate.residuals.values()])))
            offset = None if estimate.offset_step is None else offset_finding(estimate.offset_step, quantities)
            each = [f for f in (step_finding(estimate.steps, span, quantities), offset) if f is not None]
            found = max(each, key=lambda finding: (finding.severity, finding.kind == "change"), default=None)
            if found is not None and found is offset:
                return stability(estimate, quantities), found
            return (step_stability(estimate.steps[0], span) if estimate.steps else None), found
        stable = stability(estimate, quantities)
        if stable is None or not stable.changed:
            return stable, None
        parts = self._either_side(stable.time_s, estimate.levels) if self.method.faults.cut else {}
        return stable, change_finding(stable, parts, quantities, ratio)

    def _either_side(self, time_s: float, levels: Sequence[Level] = ()) -> Mapping[str, SplitHalf]:
        """Return the parameters that both sides of a change determine, see `solve_segments`; none past the deadline."""
        if deadline.passed(_SEGMENTS):
            return {}
        with progress.doing("solving both sides of a change"):
            return solve_segments(self.method.graph, self.method.faults, self.data, self.config, time_s, levels)

    def _with_conclusion(
        self, estimate: Estimate, quantities: Sequence[Quantity], report: bool
    ) -> tuple[Estimate, SolverDifference | None]:
        """Return batch's estimate at the end of an incremental run, and the run's difference from that estimate.

        Where batch does not converge, the run's own estimate, and None.
        """
        batch = self._solve("batch", None, report=report)
        if not batch.converged:
            return estimate, None
        batch = replace(batch, covariance=finite_covariance(quantities, batch.covariance))
        return _concluded(estimate, batch), solver_difference(estimate, batch, quantities)

    def _solve(
        self,
        solver: str,
        window: float | None,
        others: Callable[[SqrtInformation], Mapping[str, float]] | None = None,
        report: bool = True,
    ) -> Estimate:
        problem = self.problem()
        if solver == "published":
            start = time.perf_counter()
            estimate = self.method.published(self.data, self.config, problem)
            return replace(estimate, seconds={"solve": time.perf_counter() - start})
        if all(q.prior_sigma == 0.0 for q in problem.quantities):
            raise InputError("priors: every parameter is fixed (0), so that there is nothing to calibrate; free one")
        if solver == "incremental":
            from alidade.pipelines.solvers.incremental import solve_incremental

            shown = replace(problem, steps=partial(_steps_with_progress, problem, self.facts.duration_s))
            with deadline.of_processor():
                return solve_incremental(shown, window)
        from alidade.pipelines.solvers.batch import solve_batch

        device = walks(self.method, self.config, [q.name for q in problem.quantities])
        with progress.doing("solving"), deadline.of_processor():
            changed = self._changed() if report else ()
            return solve_batch(
                problem,
                budget=report,
                changed=changed,
                device=device,
                elsewhere=others,
                engine=self.engine,
                error_map=True,
                steps=True,
                history=True,
            )

    def _changed(self) -> Iterator[tuple[str, Problem]]:
        """Yield the name of each fixed input of the graph, and the graph with that input off by its step."""
        for exact in self.method.faults.exact:
            if deadline.passed(_SENSITIVITY):
                return
            changed = exact.changed(self.data, self.config, exact.step)
            if changed is None:
                continue
            try:
                problem = self.method.graph(*changed)
            except InputError:  # on the edge of what can be used, a step farther than the recording itself
                continue
            yield exact.name, problem


def open_session(
    path: Where, method: str | None = None, config: Settings = None, strict: bool = False, **more: Any
) -> Session:
    """Open a recording for calibration: a file, a folder of parts, a pattern of names, or a list of parts.

    With `strict` one of which anything is lost is refused; `more` are further arguments of `Session.read`. Raises
    InputError.
    """
    start = time.perf_counter()
    with progress.doing("reading"):
        session = Session.read(open_recording(path, strict), method, config, **more)
    return replace(session, read_s=time.perf_counter() - start)


def session_facts(recording: Recording, config: Config) -> SessionFacts:
    """Facts about all topics of a recording, and what it lacks for each method."""
    return facts_of(recording, config, {name: methods.method(name).requirements for name in methods.names()})


def checked_facts(recording: Recording, config: Config) -> SessionFacts:
    """Facts about a recording, and why `calibrate` would refuse it for a method that lacks nothing.

    Pictures are not looked at.
    """
    facts = session_facts(recording, config)
    by_name = {name: config.model_copy(update={"method": name}) for name, lacks in facts.missing.items() if lacks}
    asked = {name for name, own in by_name.items() if not missing_for(name, recording, own)}
    to_ask = {name: (f"`--method {name}`: topics alone do not select it",) for name in asked}
    facts = replace(facts, missing={**facts.missing, **to_ask})
    refused = {name: said for name in facts.methods if (said := _refused(methods.method(name), recording, config))}
    facts = replace(facts, missing={**facts.missing, **{name: (said,) for name, said in refused.items()}})
    proposed = {name: tuple(methods.method(name).proposed(recording, config)) for name in facts.methods}
    return replace(facts, proposed={name: keys for name, keys in proposed.items() if keys})


def _refused(method: Method, recording: Recording, config: Config) -> str:
    """Why a method cannot read the recording, as a phrase; empty where it can."""
    from alidade.pipelines.vision.camera import camera_of

    by_key = {topic.key: topic for topic in method.topics}
    image, camera = by_key.get(IMAGE.key), by_key.get(CAMERA_INFO.key)
    needless = [key for key in ("los_error", "vision_attitude", "tag_detections") if key in by_key]
    seen = image is not None and wanted(recording, config, image)
    measured = [key for key in needless if wanted(recording, config, by_key[key])]
    try:
        if camera is not None and (seen or "tag_detections" in measured):
            camera_of(recording, config)
        if not seen or (measured and "tag_detections" not in measured):
            method.read(recording, config)
    except InputError as error:
        return f"usable data: {error}"
    return ""


def missing_for(name: str, recording: Recording, config: Config) -> tuple[str, ...]:
    """Return phrases for what a recording with this config lacks for a method; none if the method can read it."""
    return lacking(methods.method(name).requirements, recording, config)


def of_other_methods(chosen: Method, config: Config) -> Iterator[str]:
    """Sentences about sections of the config that only other methods read.

    Raises InputError for a prior or requirement of a parameter that only others have.
    """
    others = [methods.method(name) for name in methods.names() if name != chosen.name]
    for where, names in (("priors", config.priors), ("require", config.require)):
        for name in names:
            owners = [each.name for each in others if each.spec(name) is not None]
            if owners and chosen.spec(name) is None:
                whose = f"a parameter of {' and '.join(owners)}, not of {chosen.name}"
                written = "" if config.method in (None, chosen.name) else f"the config is for method {config.method}: "
                raise InputError(f"{config.origin or 'config'}: {written}{where}.{name}: {whose}")
    own = chosen.config_section and chosen.config_section.key
    for key in sorted({each.config_section.key for each in others if each.config_section} - {own}):
        if key in config.model_fields_set:
            yield f"`{key}:` in the config is of another method: {chosen.name} does not use it"


def resolve_method(option: str | None, recording: Recording, config: Config) -> str:
    """The method to use: the option, else the config's, else the only one the recording has the topics for.

    Raises InputError when the option is no method, and when none or several methods could be meant.
    """
    if option is not None:
        return methods.method(option).name
    if config.method:
        return config.method
    able = methods.prefer_specific([name for name in methods.names() if not missing_for(name, recording, config)])
    if len(able) == 1:
        return able[0]
    if able:
        raise InputError(f"{recording.path}: the topics serve {' and '.join(able)}; choose with --method")
    absent = {
        f"topics.{key}: no topic {part}"
        for key, source in config.topics.items()
        for part in source.parts
        if part not in recording.topics
    }
    if absent:
        raise InputError(f"{recording.path}: {'; '.join(sorted(absent))}; {recording.there()}")
    found = suggestions(recording, config)
    nearest = nearest_suggestion(found)
    by_name = [
        name for name in methods.names() if not missing_for(name, recording, config.model_copy(update={"method": name}))
    ]
    if by_name:
        options = [f"--method {name}" for name in by_name]
        options += [f"--method {each.method} --auto-topics" for each in found if not each.missing]
        raise InputError(f"{recording.path}: these topics alone do not select a method; use {' or '.join(options)}")
    columns = propose_columns(recording)
    if columns is not None and columns.columns:
        kind = NotARecordingError if tables_of(recording.container) else InputError
        raise kind(
            f"{recording.path}: tables, and messages of unknown types, need `columns:` in the config; `alidade info` "
            "proposes them to paste, `--auto-columns` uses the proposal"
        )
    raise InputError(
        f"{recording.path}: no usable topics for any method; {recording.there()}; needed are ROS 2 messages "
        f"({ENCODING}): `alidade info` lists them for each method, `topics:` in the config can rename"
        + (f"; nearest is {nearest}" if nearest else "")
    )


def sha256_of(data: Any) -> str:
    """SHA-256 of a dataclass' arrays and numbers, field by field, hexadecimal."""
    digest = hashlib.sha256()
    _feed(digest, data)
    return digest.hexdigest()


def _feed(digest: hashlib._Hash, data: Any) -> None:
    """Hash the arrays and numbers of a dataclass, and of dataclasses in it, with the names of their fields."""
    for one in fields(data):
        value = getattr(data, one.name)
        digest.update(one.name.encode())
        if is_dataclass(value):
            _feed(digest, value)
        elif isinstance(value, np.ndarray):
            digest.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, int | float | str):
            digest.update(repr(value).encode())


def _counted(data: Any) -> tuple[str, ...]:
    """Sentences on samples of a recording that were copied, overtaken, held or kept without a stamp, with counts."""
    noted = (COPIED, OVERTAKEN, HELD, "not used (reading kept)")
    return tuple(f"{reason}: {n}" for reason, n in getattr(data, "dropped", {}).items() if reason.endswith(noted))


def _check_sheets(method: Method, config: Config) -> None:
    """Raise InputError for config keys that the method does not use and would ignore in silence."""
    if "vision" in config.model_fields_set and "vision_attitude" not in {topic.key for topic in method.topics}:
        raise InputError(f"vision: method {method.name} has no use for it; it reads no attitudes by vision")
    if "field" in config.model_fields_set and "field" not in method.data_sheets:
        raise InputError(f"field: method {method.name} has no use for it; it reads no magnetometer")
    for name in sorted(config.sensors.model_fields_set):
        sheet, figures = getattr(config.sensors, name), method.data_sheets.get(name, [])
        useless = [each for each in sorted(sheet.model_fields_set - {*figures}) if getattr(sheet, each) != 0.0]
        if not useless:
            continue
        where = f"sensors.{name}.{useless[0]}" if figures else f"sensors.{name}"
        used = [f"sensors.{name}.{each}" for each in figures] or [f"sensors.{each}" for each in method.data_sheets]
        useful = ", ".join(used) or "no data sheet"
        raise InputError(f"{where}: method {method.name} has no use for it; it uses {useful}")


def _remarks(problem: Problem, estimate: Estimate, difference: SolverDifference | None) -> Iterator[Finding]:
    """Notes on a calibration: how its incremental run ended, and the premises of its method."""
    if difference is not None and abs(difference.z) >= _NOTABLE_DIFFERENCE:
        yield Finding("solver_difference", Severity.NOTE, asdict(difference))
    if estimate.concluded:
        yield remark(f"{_CONCLUDED}; estimates over time are the run's")
    if estimate.solver != "published":
        yield from map(remark, problem.premises)


def _steps_with_progress(problem: Problem, duration: float, chunk: int) -> Iterator[Step]:
    """Yield the problem's steps; if one by one, with progress by recording time, until the deadline."""
    if chunk > 1:
        return problem.steps(chunk)
    name = "the run at {:.1f} s of {:.1f} s".format
    steps = deadline.until_passed(problem.steps(chunk), lambda step: name(step.time, duration), _LEAST_STEPS)
    return progress.track(steps, "step by step", duration, lambda step: step.time)


def _concluded(online: Estimate, batch: Estimate) -> Estimate:
    """Return batch's estimate at the end of an online run, with that run's estimates over time before it."""
    history = online.history
    if history is not None and len(history.time):
        history = History(
            history.time,
            np.vstack([history.values[:-1], batch.values]),
            np.vstack([history.sigmas[:-1], batch.sigmas]),
        )
    seconds = {**online.seconds, "conclusion": sum(batch.seconds.values())}
    return replace(batch, solver=online.solver, message=_CONCLUDED, history=history, concluded=True, seconds=seconds)


def _carried(seen: Attitudes, dense: Attitudes) -> Finding:
    """Return a note that the gyro carries the attitudes across the gaps between those by vision."""
    time = np.sort(seen.time)
    gaps = np.diff(time)
    where = f", over {gaps.max():.2g} s at most, at {time[gaps.argmax()]:.6g} s" if len(gaps) else ""
    return remark(
        f"attitude.tum has {len(dense.time)} attitudes at the gyro's samples: the gyro carries them from those by "
        f"vision before and after{where}, and the difference between both is distributed evenly over that time"
    )
