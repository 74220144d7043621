"""Trial solutions: how well a recording fits after a change, and how well held-out measurements are predicted.

The only place of this room that uses the parts of a solver rather than a solver.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.pipelines import deadline
from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.errors import InputError
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


def solve_trial(build: Build, data: Any, config: Config, label: str = "") -> TrialFit | None:
    """Solve changed data in batch; None if there is no solution.

    A trial has data and noise that nobody recorded: what it raises ends the trial alone, and is logged. A worker
    process that is lost says nothing of the trial, and is raised.
    """
    from alidade.pipelines.solvers.batch import solve_batch

    def solution() -> TrialFit | None:
        problem = build(data, config)
        return TrialFit.of(problem, solve_batch(problem, _MAX_ITERATIONS))

    return _tried(label, solution)


def score_trial(build: Build, data: Any, config: Config, label: str = "") -> tuple[float, float]:
    """Median whitened residual of measurements plus that of processes, after a few steps; and the prior cost.

    Infinite when there is no solution; exceptions as of `solve_trial`.
    """
    score = _tried(label, lambda: _score(build(data, config)))
    return (np.inf, np.inf) if score is None else score


def _tried(label: str, trial: Callable[[], Result | None]) -> Result | None:
    """Run a trial; None past the deadline or after an exception, which is logged (a defect as a warning)."""
    from alidade.pipelines.solvers.chain import IndeterminateError

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
    return max(_MAX_SAMPLES // max((len(time) for time in times), default=1), 1)


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
    drawn = compiled.layout.tangents(draws(solution.factorization, DRAWS, np.random.default_rng(1)))
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
