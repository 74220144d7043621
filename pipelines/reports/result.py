"""A calibration: estimate, findings and provenance of one or several recordings, for all reports.

calibration = Calibration(problem, estimate, diagnose(...), session_facts(...), ...)
"""

from __future__ import annotations

import datetime
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.change_test import Stability
from alidade.pipelines.diagnostics.device_changes import Changes
from alidade.pipelines.diagnostics.diagnose import LIMITS
from alidade.pipelines.diagnostics.goodness_of_fit import Fit, InnovationTest, SolverDifference
from alidade.pipelines.diagnostics.observability import (
    DerivedNumber,
    TimeToAccuracy,
    Verdict,
    derived,
    has_no_solution,
    time_to_accuracy,
    verdicts,
)
from alidade.pipelines.diagnostics.use import Posterior, Truth, UseBands, use_bands
from alidade.pipelines.display.figure import Plot
from alidade.pipelines.display.table import Table
from alidade.pipelines.estimation.finding import Finding, Status, status
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameters import prior_z_scores
from alidade.pipelines.estimation.problem import Estimate, Findings, History, Problem, Quantity, Residuals
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.methods.formula import Formula
from alidade.pipelines.recording.faults import CLIPPED
from alidade.pipelines.recording.topics import SessionFacts
from alidade.pipelines.reports import sentences
from alidade.pipelines.reports.result_json import NoiseResult, ParameterResult, PartResult, SensitivityResult
from alidade.pipelines.reports.values import Application, SensorValues
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.methods import Method
    from alidade.pipelines.reports.calibration import SavedRotation
    from alidade.pipelines.reports.html import Page

_PACKAGES = ("alidade", "gtsam", "numpy", "opencv-contrib-python-headless", "pycolmap")
# An error in use below this, in the unit shown, is rounding: nothing that was estimated has to do with that use.
_ROUNDING = 1e-9


@dataclass(frozen=True, repr=False)
class Calibration(SensorValues):
    """A calibration with its findings and provenance.

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
    def sources(self) -> list[str]:
        """SHA-256 of each recording behind the values, those behind a prior included; empty if there is but one."""
        prior = self.config.gaussian_prior
        own = [part.sha256 for part in self.recordings] or [self.sha256]
        every = [*own, *(prior.recordings if prior else ())]
        return every if len(every) > 1 else []

    @cached_property
    def parameters(self) -> dict[str, ParameterResult]:
        """Parameters by name, as result.json lists them."""
        rows = zip(
            self._estimated,
            self.estimate.values,
            self.estimate.sigmas,
            self.estimate.inflations,
            prior_z_scores(self.estimate, self._estimated),
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
                observability=self.verdicts.get(q.name),
                group=q.group,
                pull=None if q.group is None else z,
                inflation=float(inflation),
            )
            for q, value, sigma, inflation, z in rows
        }

    @property
    def values(self) -> dict[str, float]:
        """Value of each parameter, SI."""
        return dict(zip(self.estimate.names, self.estimate.values.tolist(), strict=True))

    @property
    def rotations(self) -> dict[str, SavedRotation]:
        """Parameters that are rotation vectors, without _x, _y, _z -> name in formulas and quaternion w, x, y, z."""
        from alidade.pipelines.reports.calibration import rotations_of

        return rotations_of(self)

    def _joint(self) -> tuple[Sequence[str], Array]:
        return self.estimate.names, self.covariance

    def application(self) -> Application:
        """Formulas, values and recording's config with which the calibration is applied."""
        unknown = dict.fromkeys((q.name for q in self.problem.quantities), 0.0)
        whole = self.method.report.formulas(list(unknown), self.config)
        return Application(self.formulas, whole, self.applied_values, {**self.problem.constants, **unknown})

    @cached_property
    def uses(self) -> tuple[UseBands, ...]:
        """Uses of the calibration, with the error before and after it and the 95 % band; none without a solution."""
        solved = self.estimate.converged and np.isfinite(self.covariance).all()
        if has_no_solution(self.findings) or not solved:
            return ()
        posterior, noise = posterior_of(self), {noise.name: noise.used for noise in self.noises}
        known = {**self.problem.constants, **self.values}
        true = Truth([*known], np.array([*known.values()]))
        found = []
        for use in self.method.report.uses(true, self.config, noise):
            with suppress(KeyError):  # its formulas need what this graph has not got
                found.append(use_bands(use, posterior))
        return tuple(each for each in found if max(each.before, each.after) > _ROUNDING)

    def plot(self, name: str | None = None) -> Page:
        """The figures of the report, which a notebook shows: all, those of a use, or the plot with a title.

            calibration.plot("heading")

        Raises:
            InputError: there is no such use or plot.
        """
        from alidade.pipelines.reports.calibration_report import plotted

        return plotted(self, name)

    def to_dict(self) -> dict[str, Any]:
        """The content of result.json."""
        from alidade.pipelines.reports.result_json import result_json

        content: dict[str, Any] = json.loads(result_json(self))
        return content

    @property
    def noises(self) -> list[NoiseResult]:
        """Every noise that was in force: as stated, as found, as used.

        One with others beside it counts with these: all together, root mean square over the recording.
        """
        colours = self.estimate.colours
        stated = [Level(level.noise) for level in self.problem.noises]
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
                correlation_time=level.noise.correlation_time,
            )
            for level in (each.together for each in self.estimate.levels or stated)
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
        for exact in self.method.faults.exact:
            if exact.name in moved:
                moves = moved[exact.name]
                by_unit = {name: moves[name] / exact.step for name in self._calibrated if name in moves}
                found[exact.name] = SensitivityResult(unit=exact.unit, step=exact.step, parameters=by_unit)
        return found

    @property
    def _calibrated(self) -> list[str]:
        """Names of the calibrated parameters, nuisance parameters left out."""
        return [q.name for q in self._estimated if q.group is None]

    @property
    def start(self) -> str:
        """Date of the recording's start, ISO 8601."""
        return datetime.datetime.fromtimestamp(self.facts.epoch_ns // 1_000_000_000, datetime.UTC).isoformat()

    @property
    def status(self) -> Status:
        """Status: calibrated, weak, unobservable or inconsistent."""
        return status(self.findings)

    @cached_property
    def verdicts(self) -> dict[str, Verdict]:
        """Verdicts by parameter, of those with a required accuracy."""
        return verdicts(self._estimated, self.covariance, self.findings, self.estimate.values)

    @property
    def derived(self) -> list[DerivedNumber]:
        """Scale and shape of a sensor whose scale hangs on the strength of what it measures."""
        return derived(self._estimated, self.covariance, self.estimate.values, self.findings)

    @cached_property
    def quantities(self) -> dict[str, Quantity]:
        """Quantities by name, those of several recordings too."""
        return {q.name: q for q in self.problem.quantities}

    @property
    def _estimated(self) -> tuple[Quantity, ...]:
        """Quantities of the estimate, in its order; a published solver may have fewer than the problem."""
        return tuple(self.quantities[name] for name in self.estimate.names)

    @property
    def headline(self) -> str:
        """Sentence with the status and its reasons."""
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
        """Chi-square with its interval, by family of measurements."""
        chi_square = self.estimate.chi_square
        return {} if chi_square is None else {family: Fit.of(*sums) for family, sums in chi_square.families.items()}

    @property
    def covariance(self) -> Array:
        """Joint covariance (n, n) of the parameters, in their order, SI."""
        return self.estimate.covariance

    @property
    def history(self) -> History | None:
        """Values and sigmas from what was recorded until each moment."""
        return self.estimate.history

    @property
    def residuals(self) -> Mapping[str, Residuals]:
        """Residuals at the estimate, by family of measurements."""
        return self.estimate.residuals

    def write(self, folder: str | Path) -> tuple[Path, ...]:
        """Write result.json, calibration.yaml, report.html and what else there is; returns their paths.

        Raises:
            InputError: the folder cannot be written to.
        """
        from alidade.pipelines.reports.write import write_results

        return write_results(Path(folder), self)

    def __repr__(self) -> str:
        return f"<Calibration {self.method.name}, {self.estimate.solver}, of {self.recording}: {self.status}>"

    def __str__(self) -> str:
        """Verdict, uses and results, as the command prints them."""
        from alidade.pipelines.reports.calibration_report import short_report
        from alidade.pipelines.reports.terminal import as_text

        return as_text(short_report(self))

    def _repr_html_(self) -> str:
        """Verdict, uses and results for notebooks, as the report has them."""
        from alidade.pipelines.reports.calibration_report import short_report
        from alidade.pipelines.reports.html import Page, render_html

        return Page(render_html(short_report(self)))._repr_html_()

    @property
    def config_text(self) -> str:
        """The config in force, YAML; what is as by default is left out."""
        return dump_yaml(self.config.model_dump(mode="json", exclude_defaults=True), is_sorted=False)

    @property
    def formulas(self) -> Sequence[Formula]:
        """Formulas that apply the calibration, without assumptions that the recording does not determine."""
        return self.method.report.formulas(self.applied, self.config)

    @property
    def applied(self) -> list[str]:
        """The parameters, without nuisance parameters of which the recording says no more than their prior mean, 0."""
        names = []
        for q in self.problem.quantities:
            p = self.parameters.get(q.name)
            # By its prior, the recording or a prior conflict.
            known = p and (q.prior_mean != 0.0 or q.determined(p.sigma) or abs(p.pull or 0.0) > LIMITS.prior_z)
            if q.group is None or known:
                names.append(q.name)
        return names

    @cached_property
    def applied_values(self) -> dict[str, float]:
        """Values that the formulas use: estimates, given that what they leave out is at its prior mean.

        A nuisance parameter that the recording does not determine is left out, but what was estimated jointly with it
        is not: without a g-sensitivity the best bias is the one that has its effect in it.
        """
        applied, best = set(self.applied), self.values
        left_out = dict.fromkeys((name for name in best if name not in applied), 0.0)
        if np.isfinite(self.covariance).all():
            best = GaussianPrior(tuple(best), self.estimate.values, self.covariance).given(left_out).means
        return {name: value for name, value in best.items() if name in applied}

    @property
    def counts(self) -> dict[str, int]:
        """Messages in the recording by topic, and measurements used by family."""
        topics = {topic.name: topic.count for topic in self.facts.topics}
        families = {family: int(r.used.sum()) for family, r in self.estimate.residuals.items()}
        return {**topics, **families}

    @property
    def dropped(self) -> dict[str, int]:
        """Number of measurements left out, outliers included, by reason."""
        outliers = {f"{family}: outliers": n for family, n in self.estimate.rejected.items() if n}
        lost = {f"{topic}: lost with damaged bytes of the file": n for topic, n in self.facts.lost.items()}
        return {**lost, **self.problem.dropped, **outliers}

    @property
    def timing(self) -> dict[str, float]:
        """Wall time, s, by phase."""
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
        """Sentences that a reader needs beside the headline."""
        clipped = tuple(f"{what}: {n} samples left out" for what, n in self.dropped.items() if what.endswith(CLIPPED))
        return (*self.facts.notes, *sentences.notes(self.findings, self.quantities), *clipped)


def software_versions() -> dict[str, str]:
    """Versions of the software that computed the result."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def posterior_of(c: Calibration) -> Posterior:
    """Return the posterior of the parameters that the formulas apply."""
    quantities, known = [c.quantities[name] for name in c.estimate.names], c.application()
    gains = {q.name: q for q in quantities if len(q.name) > 4 and q.name[-4:-2] == "_k"}
    plain = all(q.unit in ("", "1") for q in gains.values())
    nominal = {
        q.name: (float(q.name[-1] == q.name[-2]) if q.name in gains else 0.0) if plain else q.prior_mean
        for q in quantities
        if q.group is None and q.name in known.values
    }
    truth = None
    if c.truth is not None:
        stated = {name: value for name, value in c.truth.items() if isinstance(value, int | float)}
        truth = np.array([stated.get(name, value) for name, value in c.values.items()], dtype=float)
    require = [q.require if q.judged and np.isfinite(q.require) else 0.0 for q in quantities]
    return Posterior(
        names=c.estimate.names,
        x=c.estimate.values,
        P=c.covariance,
        require=np.array(require),
        applied=known,
        nominal=replace(known, values=nominal),
        whole=replace(known, formulas=known.whole, values=c.values),
        truth=truth,
    )
