"""How well a recording fits: a batch solution with what it rejected, and a quick score from a few iterations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from alidade.pipelines.diagnostics.observability import Fit
from alidade.pipelines.estimation.problem import Array, ChiSquare, Estimate, Problem, Quantity
from alidade.pipelines.parallel import LostError
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.methods import Method

# A recording with more than this share rejected does not fit.
_OUTLIERS = 0.1
# Iterations after which a model that is right has long converged; one that is wrong may wander for many times as long.
_ENOUGH = 15
# Samples of trials that are made at the same time.
_AT_ONCE = 10_000_000
# Iterations of a quick score.
_FEW = 5
# A model that is right needs no more damping than this; one that needs more is not looked at any longer.
_MOST_DAMPING = 1e-4


@dataclass(frozen=True)
class Outcome:
    """How well a recording fits after a change: the solution, and the loss of what it rejected.

    Attributes:
        quantities: that were solved for.
        estimate: the solution.
        chi_square: of what was used.
        lost: what the rejected measurements cost, at the gate each.
        rows: degrees of freedom, the rejected rows among them.
    """

    quantities: tuple[Quantity, ...]
    estimate: Estimate
    chi_square: ChiSquare
    lost: float
    rows: float

    @classmethod
    def of(cls, problem: Problem, estimate: Estimate) -> Outcome | None:
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
        """Chi-square, the rejected included."""
        return self.chi_square.value + self.lost

    @property
    def factor(self) -> float:
        """By what the noise stated would have to be multiplied for the recording to fit."""
        return float(np.sqrt(self.cost / max(self.rows, 1.0)))

    @property
    def fits(self) -> bool:
        """Whether chi-square lies within its interval without more than a few outliers rejected."""
        few = self.chi_square.dof > (1.0 - _OUTLIERS) * self.rows
        return few and self.chi_square.value <= Fit.of(0.0, self.chi_square.dof).high


def outcome(method: Method, data: Any, config: Config) -> Outcome | None:
    """The batch solution; None when there is none.

    A trial is made with data and noise that nobody recorded: whatever it raises ends the trial, and nothing else,
    but for a process that is lost, which says nothing of the trial.
    """
    from alidade.pipelines.solvers.batch import solve_batch

    try:
        problem = method.graph(data, config)
        return Outcome.of(problem, solve_batch(problem, _ENOUGH))
    except LostError:
        raise
    except Exception:
        return None


def quick_score(method: Method, data: Any, config: Config) -> float:
    """Typical residual of the measurements plus that of the processes near the least-squares solution, sigmas.

    Infinite when there is no solution, whatever a trial raises.
    """
    try:
        return _score(method.graph(data, config))
    except LostError:
        raise
    except Exception:
        return np.inf


def at_once(method: Method, data: Any) -> int:
    """How many trials are made at the same time, if there are so many processes: memory holds a graph of each."""
    return max(_AT_ONCE // max((len(time) for time in times_of(method, data)), default=1), 1)


def times_of(method: Method, data: Any) -> list[Array]:
    """Of all streams that there are."""
    return [time for name in method.hypotheses().streams if (time := getattr(data, name)) is not None]


def _score(problem: Problem) -> float:
    from alidade.pipelines.solvers.engines import Compiled
    from alidade.pipelines.solvers.levenberg import LevenbergConfig, minimize
    from alidade.pipelines.solvers.linearization import NOT_MEASURED

    compiled = Compiled.of(problem)
    engine = compiled.engine.under(None)
    values = minimize(engine, compiled.initial, LevenbergConfig(_FEW, max_damping=_MOST_DAMPING)).values
    whitened = list(zip(engine.groups, engine.residuals(values), strict=True))
    measured = np.concatenate([np.abs(r).ravel() for group, r in whitened if group.is_measurement])
    processes = [r for group, r in whitened if not group.is_measurement and group.family not in NOT_MEASURED]
    sizes = np.concatenate([np.sqrt((r**2).mean(axis=1)) for r in processes]) if processes else np.zeros(1)
    return float(np.median(measured) + np.median(sizes))
