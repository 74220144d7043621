"""Trials and cross-validation: a recording solved after a change, in segments, and without held-out measurements.

The only place of this room that uses the parts of a solver rather than a solver.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.pipelines import deadline, parallel
from alidade.pipelines.diagnostics.fault_models import FaultModel
from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.errors import IndeterminateError, InputError
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import CHUNK, ChiSquare, Estimate, Problem, Quantity
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.parallel import LostError
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.solvers.linearization import Group

Result = TypeVar("Result")
# Builds the graph of a method's data.
Build = Callable[[Any, Config], Problem]

# A recording with more than this share rejected does not fit.
_MAX_OUTLIERS = 0.1
# Iterations after which a right model has long converged; a wrong one may wander for many times as long.
_MAX_ITERATIONS = 15
# Samples of trials that are solved at the same time.
_MAX_SAMPLES = 10_000_000
# Iterations of a score, and the largest damping: a right model needs no more, a wrong one is not pursued.
_SCORE_ITERATIONS, _MAX_SCORE_DAMPING = 5, 1e-4
# One chunk in so many is held out.
_HELD_OUT = 5
# What a prediction is uncertain by, in sigmas of the measurement, beyond which there is none.
_UNPREDICTED = 1e3

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrialFit:
    """Fit of a recording after a change: the solution, and the loss of the rejected measurements.

    Attributes:
        quantities: of the problem.
        estimate: the solution.
        chi_square: of the measurements used.
        lost: of the rejected measurements, each at the gate.
        dof: degrees of freedom, the rejected rows among them.
    """

    quantities: tuple[Quantity, ...]
    estimate: Estimate
    chi_square: ChiSquare
    lost: float
    dof: float

    @classmethod
    def of(cls, problem: Problem, estimate: Estimate) -> TrialFit | None:
        """Build the fit of an estimate; None if the estimate has no chi-square."""
        if estimate.chi_square is None or not np.isfinite(estimate.chi_square.value):
            return None
        rejected = {f: int((~r.used).sum()) for f, r in estimate.residuals.items()}
        rows = sum(n * estimate.residuals[f].whitened.shape[1] for f, n in rejected.items())
        gate = problem.loss.gate if problem.loss else 0.0
        lost = gate**2 * sum(rejected.values())
        return cls(problem.quantities, estimate, estimate.chi_square, lost, float(estimate.chi_square.dof + rows))

    @property
    def cost(self) -> float:
        """Chi-square, including the rejected measurements and the priors of nuisance parameters.

        A gyro whose scale is -1 fits where an axis has the wrong sign.
        """
        return self.chi_square.value + self.lost + sum(self._assumed)

    @property
    def cost_with_priors(self) -> float:
        """Cost including the distance of the solution from its priors, to rank corrections that fit alike."""
        return self.chi_square.value + self.lost + sum(_from_priors(self.quantities, self.estimate.values))

    @property
    def _assumed(self) -> list[float]:
        rows = [i for i, q in enumerate(self.quantities) if q.assumed]
        return _from_priors([self.quantities[i] for i in rows], self.estimate.values[rows])

    @property
    def factor(self) -> float:
        """Noise factor with which the recording would fit."""
        return float(np.sqrt(self.cost / max(self.dof, 1.0)))

    @property
    def fits(self) -> bool:
        """Whether chi-square and nuisance parameters lie within their intervals, with few outliers rejected."""
        few, priors = self.chi_square.dof > (1.0 - _MAX_OUTLIERS) * self.dof, self._assumed
        within = not priors or sum(priors) <= Fit.of(0.0, float(len(priors))).high
        return few and within and self.chi_square.value <= Fit.of(0.0, self.chi_square.dof).high


def _from_priors(quantities: Sequence[Quantity], values: Array) -> list[float]:
    """Squared distances of values (n,) from their priors, in the priors' sigmas."""
    found = zip(quantities, values.tolist(), strict=True)
    return [((x - q.prior_mean) / q.prior_sigma) ** 2 for q, x in found if q.prior_sigma]


def solve_trial(build: Build, data: Any, config: Config, label: str = "", error_map: bool = False) -> TrialFit | None:
    """Solve changed data in batch; None if there is no solution.

    With `error_map` also for errors of measurements that depend on where they are made, as a recording is.
    A trial has data and noise that nobody recorded: what it raises ends the trial alone, and is logged. A worker
    process that is lost says nothing of the trial, and is raised.
    """
    from alidade.pipelines.solvers.batch import solve_batch

    def solution() -> TrialFit | None:
        problem = build(data, config)
        return TrialFit.of(problem, solve_batch(problem, _MAX_ITERATIONS, error_map=error_map))

    return _tried(label, solution)


def score_trial(build: Build, data: Any, config: Config, label: str = "") -> tuple[float, float]:
    """Median whitened residual of measurements plus that of processes, after a few steps; and the prior cost.

    Infinite when there is no solution; exceptions as of `solve_trial`.
    """
    score = _tried(label, lambda: _score(build(data, config)))
    return (np.inf, np.inf) if score is None else score


def _tried(label: str, trial: Callable[[], Result | None]) -> Result | None:
    """Run a trial; None past the deadline or after an exception, which is logged (a defect as a warning)."""
    if deadline.passed():
        return None
    try:
        return trial()
    except LostError:
        raise
    except (InputError, IndeterminateError) as error:
        _log.info("trial (%s): %s", label or "as recorded", error)
    except Exception as error:
        _log.warning("trial (%s) failed: %s: %s", label or "as recorded", type(error).__name__, error)
        _log.debug("trial (%s)", label or "as recorded", exc_info=True)
    return None


def max_concurrent(times: Sequence[Array]) -> int:
    """Number of trials to solve at once, limited by memory, for graphs with these stamps."""
    return max(_MAX_SAMPLES // max((len(time) for time in times if len(time)), default=1), 1)


def _score(problem: Problem) -> tuple[float, float]:
    from alidade.pipelines.solvers.engines import Compiled
    from alidade.pipelines.solvers.levenberg import LevenbergConfig, minimize
    from alidade.pipelines.solvers.linearization import NOT_MEASURED
    from alidade.pipelines.solvers.posterior import Reported

    compiled = Compiled.of(problem)
    engine, config = compiled.engine.under(None), LevenbergConfig(_SCORE_ITERATIONS, max_damping=_MAX_SCORE_DAMPING)
    values = minimize(engine, compiled.initial, config).values
    whitened = list(zip(engine.groups, engine.residuals(values), strict=True))
    measured = [np.abs(r).ravel() for group, r in whitened if group.is_measurement]
    processes = [r for group, r in whitened if not group.is_measurement and group.family not in NOT_MEASURED]
    sizes = [np.sqrt((r**2).mean(axis=1)) for r in processes]
    numbers = Reported.of(compiled, values).numbers
    score = sum(float(np.median(np.concatenate(each))) for each in (measured, sizes) if each)
    return score, sum(_from_priors(problem.quantities, numbers))


def held_out_residuals(problem: Problem) -> dict[str, float]:
    """Robust standard deviation of held-out measurements over that of noise and prediction, by family.

    One chunk in five is held out, a pose of a cube with all that was seen in it. Expected is 1.
    """
    from alidade.pipelines.solvers.engines import Compiled
    from alidade.pipelines.solvers.posterior import DRAWS, draws
    from alidade.pipelines.solvers.robust import solve_robust

    steps = list(problem.steps(CHUNK))
    out = np.repeat(np.arange(len(steps)) % _HELD_OUT == _HELD_OUT - 1, [len(step.factors) for step in steps])
    compiled = Compiled.of(problem, steps=steps)
    measurements = [g for g in compiled.engine.groups if g.is_measurement]
    if all(out[g.factors].all() for g in measurements):
        return {}
    kept = compiled.engine.with_groups([_without(g, out[g.factors]) for g in compiled.engine.groups])
    solution = solve_robust(kept, compiled.initial, problem.loss)
    if not solution.converged:
        return {}
    found: dict[str, list[Array]] = {}
    drawn = draws(solution.factorization, DRAWS, np.random.default_rng(1))
    for group in measurements:
        predicted, right = compiled.engine.products(replace(group, loss=None), solution.values, drawn)
        held = out[group.factors]
        found.setdefault(group.family, []).append(_normalised(right[held], predicted[held]))
    return {family: robust_sigma(np.concatenate(each)) for family, each in found.items()}


def _normalised(residuals: Array, predicted: Array) -> Array:
    """Residuals (n, m) whitened by noise and prediction (draws (n, m, k)), along the covariance's axes.

    Without those that the prediction leaves open, as the place of a cube that nothing else measures.
    """
    covariance = np.eye(residuals.shape[1]) + predicted @ predicted.swapaxes(1, 2) / predicted.shape[2]
    variances, axes = np.linalg.eigh(covariance)
    z = np.einsum("nmj,nm->nj", axes, residuals) / np.sqrt(variances)
    return np.asarray(z[variances < _UNPREDICTED**2])


def _without(group: Group, out: Mask) -> Group:
    """Remove the held-out measurements from a group; processes and priors stay."""
    if not group.is_measurement:
        return group
    return replace(group, weights=group.all_weights * ~out[:, None])


@dataclass(frozen=True)
class SplitHalf:
    """A parameter's estimates from the two segments of a recording: values and sigmas, SI."""

    first: float
    first_sigma: float
    second: float
    second_sigma: float

    @property
    def step(self) -> float:
        """Difference of the two estimates, second minus first."""
        return self.second - self.first

    @property
    def step_sigma(self) -> float:
        """Standard deviation of the difference between the halves."""
        return float(np.hypot(self.first_sigma, self.second_sigma))

    @property
    def z(self) -> float:
        """Difference between the halves over its sigma."""
        return self.step / self.step_sigma


# A quantity with its value and sigma.
_Number = tuple[Quantity, float, float]


def split_halves(
    build: Build, faults: FaultModel, data: Any, config: Config
) -> tuple[dict[str, SplitHalf], tuple[str, ...]]:
    """Solve both halves of a recording, see `solve_segments`; also return unsolved ones ("first", "second")."""
    parts = _solved_parts(build, faults, data, config, 0.5 * sum(faults.span(data)))
    return _in_both(*parts), tuple(name for name, part in zip(("first", "second"), parts, strict=True) if not part)


def solve_segments(
    build: Build, faults: FaultModel, data: Any, config: Config, middle: float, levels: Sequence[Level] = ()
) -> dict[str, SplitHalf]:
    """Solve the segments before and after a time, s; return the parameters that both determine.

    Parameters that a prior determines in either part are left out: they would agree whatever was recorded. A bias that
    walks differs between the parts by its walk too. Both parts have the noise levels of the whole recording in
    `levels`; those of other noises are estimated anew.
    """
    build = partial(_at_levels, build, {level.noise.name: level for level in levels})
    return _in_both(*_solved_parts(build, faults, data, config, middle))


def _solved_parts(
    build: Build, faults: FaultModel, data: Any, config: Config, middle: float
) -> list[dict[str, _Number]]:
    start, stop = faults.span(data)
    parts = [partial(_solved, build, faults, data, config, *part) for part in ((start, middle), (middle, stop + 1.0))]
    return parallel.done(parts, "either side", max_concurrent(faults.times(data)))


def _in_both(first: Mapping[str, _Number], second: Mapping[str, _Number]) -> dict[str, SplitHalf]:
    both = {name: (first[name], second[name]) for name in first if name in second}
    return {
        name: SplitHalf(value, sigma, other, other_sigma)
        for name, ((quantity, value, sigma), (_, other, other_sigma)) in both.items()
        if quantity.determined(max(sigma, other_sigma))
    }


def _at_levels(build: Build, levels: Mapping[str, Level], data: Any, config: Config) -> Problem:
    """Build the problem with the noise levels of a previous solution fixed."""
    problem = build(data, config).at_levels(tuple(levels.values()))
    known = (levels.get(level.noise.name, level) for level in problem.noises)
    noises = tuple(
        replace(level, noise=replace(level.noise, known=0.0), least=None) if level.noise.name in levels else level
        for level in known
    )
    return replace(problem, noises=noises)


def _solved(
    build: Build, faults: FaultModel, data: Any, config: Config, start: float, stop: float
) -> dict[str, _Number]:
    """Solve the segment [start, stop), s, of a recording by itself; empty if there is no solution."""
    found = solve_trial(
        build, faults.segment(data, start, stop), config, f"{start:.0f} to {stop:.0f} s", error_map=True
    )
    if found is None or not found.estimate.converged:
        return {}
    numbers = zip(found.quantities, found.estimate.values.tolist(), found.estimate.sigmas.tolist(), strict=True)
    return {number[0].name: number for number in numbers}


@dataclass(frozen=True, eq=False)
class Validation:
    """Errors of one kind before and after compensation; a method may have several kinds.

    Attributes:
        name: what is compared with what.
        unit: SI, that of the errors.
        time: (n,) s from the session's start.
        before: (n, m) errors, one column an axis, with nothing compensated.
        after: (n, m) the same with the calibration applied.
        note: what a reader has to know beside it, a sentence without its full stop; may be empty.
        micro: angles are read in µrad, as in the trade of pointing, not in degrees.
    """

    name: str
    unit: str
    time: Array
    before: Array
    after: Array
    note: str = ""
    micro: bool = False


def rms(errors: Array) -> float:
    """Root mean square of the lengths of errors (n, m)."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def peak(errors: Array) -> float:
    """Largest length of errors (n, m)."""
    return float(np.linalg.norm(errors, axis=1).max())
