"""Trial solutions: how well a recording fits after a change, and how well held-out measurements are predicted.

The only place of this room that uses the parts of a solver rather than a solver.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from alidade.pipelines import deadline
from alidade.pipelines.diagnostics.goodness_of_fit import Fit
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array, ChiSquare, Estimate, Factor, Problem, Quantity, Residuals
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.parallel import LostError
from alidade.pipelines.settings import Config

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

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrialFit:
    """How well a recording fits after a change: the solution, and the loss of the measurements it rejected.

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
        """None without chi-square."""
        if estimate.chi_square is None or not np.isfinite(estimate.chi_square.value):
            return None
        rejected = {f: int((~r.used).sum()) for f, r in estimate.residuals.items()}
        rows = sum(n * estimate.residuals[f].whitened.shape[1] for f, n in rejected.items())
        gate = problem.loss.gate if problem.loss else 0.0
        lost = gate**2 * sum(rejected.values())
        return cls(problem.quantities, estimate, estimate.chi_square, lost, estimate.chi_square.dof + rows)

    @property
    def cost(self) -> float:
        """Chi-square, the rejected measurements included."""
        return self.chi_square.value + self.lost

    @property
    def cost_with_priors(self) -> float:
        """The same with how far the solution is from its priors: what weighs corrections that fit alike."""
        found = zip(self.quantities, self.estimate.values.tolist(), strict=True)
        return self.cost + sum(((x - q.prior_mean) / q.prior_sigma) ** 2 for q, x in found if q.prior_sigma)

    @property
    def factor(self) -> float:
        """Factor on the noise used with which the recording would fit."""
        return float(np.sqrt(self.cost / max(self.dof, 1.0)))

    @property
    def fits(self) -> bool:
        """Whether chi-square lies within its interval with no more than a few outliers rejected."""
        few = self.chi_square.dof > (1.0 - _MAX_OUTLIERS) * self.dof
        return few and self.chi_square.value <= Fit.of(0.0, self.chi_square.dof).high


def solve_trial(build: Build, data: Any, config: Config, label: str = "") -> TrialFit | None:
    """The batch solution of changed data; None when there is none.

    A trial has data and noise that nobody recorded: what it raises ends the trial alone, and is logged. A worker
    process that is lost says nothing of the trial, and is raised.
    """
    return _tried(label, partial(_solution, build, data, config))


def score_trial(build: Build, data: Any, config: Config, label: str = "") -> float:
    """Median whitened residual of the measurements plus that of the processes, near the least-squares solution.

    Infinite when there is no solution; exceptions as of `solve_trial`.
    """
    score = _tried(label, lambda: _score(build(data, config)))
    return np.inf if score is None else score


def _tried(label: str, trial: Callable[[], Result | None]) -> Result | None:
    """The result of a trial; None without time left, or where it raises: logged, a program's defect as a warning."""
    from alidade.pipelines.solvers.marginals import IndeterminateError

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


def _solution(build: Build, data: Any, config: Config) -> TrialFit | None:
    from alidade.pipelines.solvers.batch import solve_batch

    problem = build(data, config)
    return TrialFit.of(problem, solve_batch(problem, _MAX_ITERATIONS))


def max_concurrent(times: Sequence[Array]) -> int:
    """Trials solved at the same time, by memory: each holds a graph of samples with these stamps."""
    return max(_MAX_SAMPLES // max((len(time) for time in times), default=1), 1)


def _score(problem: Problem) -> float:
    from alidade.pipelines.solvers.assembly import CHUNK, Assembly
    from alidade.pipelines.solvers.system import residuals_of
    from alidade.pipelines.solvers.weighing import optimize

    whole = Assembly.of(problem.steps(CHUNK))
    factors, shared = whole.factors, whole.shared(problem)
    values = optimize(factors, whole.initial, shared, None, _SCORE_ITERATIONS, _MAX_SCORE_DAMPING).values
    measured = np.concatenate(
        [np.abs(r.whitened).ravel() for r in residuals_of(factors, values).values()] or [np.zeros(1)]
    )
    processes = [f.factor for f in factors if f.measurement is None and f.family not in ("prior", "definition")]
    sizes = [np.sqrt(2.0 * f.error(values) / f.dim()) for f in processes]
    return float(np.median(measured) + (np.median(sizes) if sizes else 0.0))


def held_out_residuals(problem: Problem) -> dict[str, float]:
    """Family -> robust standard deviation of held-out measurements, over their noise.

    One chunk in five is held out. Expected is 1, and a little more by the uncertainty of the prediction.
    """
    from alidade.pipelines.solvers.assembly import CHUNK, Assembly
    from alidade.pipelines.solvers.system import residuals_of
    from alidade.pipelines.solvers.weighing import optimize

    steps = list(problem.steps(CHUNK))
    whole = Assembly.of(steps)
    out: list[Factor] = [
        f for step in steps[_HELD_OUT - 1 :: _HELD_OUT] for f in step.factors if f.measurement is not None
    ]
    left = {id(f) for f in out}
    kept = [f for f in whole.factors if id(f) not in left]
    if not any(f.measurement is not None for f in kept):
        return {}
    solution = optimize(kept, whole.initial, whole.shared(problem), problem.loss, held=problem.assumed)
    if not solution.converged:
        return {}
    found: dict[str, Residuals] = residuals_of(out, solution.values)
    return {family: robust_sigma(r.whitened) for family, r in found.items()}
