"""Levenberg-Marquardt: full Gauss-Newton steps, damped only after one that raises the cost.

With A, b the whitened rows at the values, a step minimises |A dx - b|^2 + damping |D dx|^2, D'D the diagonal of A'A.
The ratio of the decrease of the cost to the one that the linear system predicts says how far the damping goes up or
down: Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004, section 3.2. Under a robust loss
the rows have its weights at the values (iteratively reweighted least squares), and the prediction is that of these.

The error of a linear system's prediction is about what is left for the next step: a small step that does as predicted
ends at the minimum.

Limits: a minimum is a local one. A cost is a sum of squares, in units of squared sigmas, with the losses in force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self

import numpy as np

from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.solvers.chain import Array, IndeterminateStateError, Index
from alidade.pipelines.solvers.layout import Layout, Tangent, Values
from alidade.pipelines.solvers.linearization import Group


class Factorization(Protocol):
    """R of a linear system, all but the last node and the shared unknowns eliminated; see ChainFactorization."""

    @property
    def c(self) -> int:
        """Numbers of the last node."""

    @property
    def root(self) -> Array:
        """R of the last node, the shared unknowns and the right side."""

    @property
    def minimum(self) -> float:
        """Sum of squares at the solution."""

    @property
    def log_determinant(self) -> float:
        """Of the information A'A."""

    def solve(self) -> tuple[Array, Array, Array]:
        """States, nodes, shared unknowns of the least squares."""

    def given(self, last: Array) -> tuple[Array, Array]:
        """States and nodes for given last node and shared unknowns (c + s, n)."""

    def propagate(self, last: Array) -> tuple[Array, Array]:
        """Moves of states and nodes that go with moves (c + s, n)."""

    def sample(self, count: int, generator: np.random.Generator) -> tuple[Array, Array, Array]:
        """Draws from the posterior, as deviations from its mean."""

    def prefix_roots(self) -> tuple[Index, list[Array]]:
        """Keyframes, and R of (their node, shared unknowns, right side) by all until then."""


class System(Protocol):
    """Whitened rows A dx = b about some values."""

    @property
    def squares(self) -> float:
        """|b|^2."""

    def eliminate(self, damping: float = 0.0) -> Factorization:
        """R of the rows. Raises IndeterminateStateError."""


class Engine(Protocol):
    """A problem's factors, ready to be linearised: `Linearization`, or `GtsamEngine`."""

    @property
    def layout(self) -> Layout:
        """Of the variables."""

    @property
    def groups(self) -> Sequence[Group]:
        """The measurements by kind."""

    def at(self, values: Values) -> tuple[System, float]:
        """The system about the values, and the cost there."""

    def cost(self, values: Values) -> float:
        """Twice the sum of the losses."""

    def residuals(self, values: Values) -> list[Array]:
        """Weighted whitened residuals of each group."""

    def products(self, group: Group, values: Values, tangent: Tangent) -> tuple[Array, Array]:
        """A x (n, m, k) of a group's whitened rows with k tangent vectors, and its right side (n, m)."""

    @property
    def piece(self) -> Index:
        """(N,) node in force at each keyframe."""

    @property
    def time(self) -> Array:
        """(N,) s of the keyframes."""

    def under(self, loss: TruncatedLoss | None) -> Self:
        """The engine with another loss for the measurements that have one."""

    def with_groups(self, groups: Sequence[Group]) -> Self:
        """The engine with other measurements at the same variables."""


# Decrease of the cost over the one predicted above which a step is lengthened: along it the cost is no parabola, and
# falls on, as it does about a saddle, where the ratio is 2.
_DOUBLE = 1.5


@dataclass(frozen=True)
class LevenbergConfig:
    """Termination and damping.

    Attributes:
        max_iterations: linear systems solved.
        cost_tolerance: stop when the predicted decrease is below it (squared sigmas): no number is off its minimum by
            more than the root of it, in its own sigmas, and by far less once the step is taken.
        prediction_tolerance: error of the predicted decrease of an undamped step below which that step is the last.
        curved_tolerance: predicted decrease of an undamped step below which it may raise the cost at a minimum: what
            the data hardly determine is curved by more than the linear system knows. .01 is .1 sigma.
        determined_tolerance: predicted decrease of the first damped step below which all is at its minimum that has
            more information than the damping: the full step raises the cost along what has less, which is curved, and
            where that is to be priors tell (`weak_directions`). .001 is .03 sigma.
        initial_damping: of the first damped step, relative to the diagonal of A'A.
        min_damping: below it steps are full ones again; along a curved valley damping between lets them be longest.
        max_damping: above it no step is left.
    """

    max_iterations: int = 60
    cost_tolerance: float = 2e-5
    prediction_tolerance: float = 2e-6
    curved_tolerance: float = 1e-2
    determined_tolerance: float = 1e-3
    initial_damping: float = 1e-6
    min_damping: float = 1e-9
    max_damping: float = 1e8


@dataclass(frozen=True, eq=False)
class Solution:
    """Values at a minimum of an engine's cost, with the system there.

    Attributes:
        engine: with the loss and the weights in force.
        values: where it ended.
        system, cost: about these.
        converged: whether it is a minimum; `message` says how or why not.
        iterations: linear systems solved on the way.
    """

    engine: Engine
    values: Values
    system: System
    cost: float
    converged: bool
    message: str
    iterations: int

    @cached_property
    def factorization(self) -> Factorization:
        """Of the system. Raises IndeterminateStateError."""
        return self.system.eliminate()


def minimize(
    engine: Engine, values: Values, config: LevenbergConfig, known: tuple[System, float] | None = None
) -> Solution:
    """Minimise an engine's cost from some values; `known`: the system about these, and the cost."""
    system, cost = known or engine.at(values)
    damping, growth, undamped = 0.0, 2.0, np.inf

    def solution(converged: bool, message: str, iterations: int) -> Solution:
        return Solution(engine, values, system, cost, converged, message, iterations)

    if not np.isfinite(cost):
        return solution(False, "the residuals at the start are not finite", 0)
    for iteration in range(1, config.max_iterations + 1):
        step, predicted = _step(system, damping)
        if step is not None:
            candidate = engine.layout.retract(values, step)
            new_system, new_cost = engine.at(candidate)
            decrease = cost - new_cost
            undamped = predicted if damping == 0.0 else undamped
            near = min(predicted, abs(decrease)) < _enough(config, cost)
            near &= damping == 0.0 or undamped < config.curved_tolerance
            near |= damping == config.initial_damping and predicted < config.determined_tolerance
            if decrease > _DOUBLE * predicted > _DOUBLE * _enough(config, cost):
                candidate, new_system, new_cost = _lengthened(engine, values, step, new_cost)
            if decrease > 0.0 or (near and decrease > -_enough(config, cost)):
                values, system, cost = candidate, new_system, new_cost
                as_predicted = (
                    damping == 0.0 and predicted < 1.0 and abs(decrease - predicted) < config.prediction_tolerance
                )
                if near or as_predicted:
                    return solution(True, f"converged after {iteration} iterations", iteration)
                ratio = decrease / predicted if predicted > 0.0 else 1.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
                damped = damping > config.min_damping and predicted > config.determined_tolerance
                damping, growth = (damping if damped else 0.0), 2.0
                continue
            if near:
                return solution(True, f"converged after {iteration} iterations", iteration)
        damping, growth = max(damping * growth, config.initial_damping), 2.0 * growth
        if damping > config.max_damping:
            return solution(False, f"no step lowers chi-square of {cost:.6g}", iteration)
    return solution(False, f"not converged after {config.max_iterations} iterations", config.max_iterations)


def _lengthened(engine: Engine, values: Values, step: Tangent, cost: float) -> tuple[Values, System, float]:
    """Where a step leads that is doubled as long as the cost, `cost` after it as it is, falls."""
    length = 1.0

    def ahead(length: float) -> Values:
        return engine.layout.retract(
            values, Tangent(*(length * part for part in (step.states, step.nodes, step.shared)))
        )

    while (further := engine.cost(ahead(2.0 * length))) < cost:
        length, cost = 2.0 * length, further
    return ahead(length), *engine.at(ahead(length))


def _enough(config: LevenbergConfig, cost: float) -> float:
    """A decrease that is none: the tolerance, and rounding of the cost."""
    return config.cost_tolerance + 1e-13 * cost


def _step(system: System, damping: float) -> tuple[Tangent | None, float]:
    """A step, None where the damped system is singular, and the decrease that it predicts."""
    try:
        factorization = system.eliminate(damping)
        step = Tangent(*factorization.solve())
    except (IndeterminateStateError, np.linalg.LinAlgError):
        return None, 0.0
    return step, system.squares - factorization.minimum
