"""Levenberg-Marquardt: full Gauss-Newton steps, corrected where they raise the cost, damped where that does not help.

With A, b the whitened rows at the values, a step minimises |A dx - b|^2 + damping |D dx|^2, D'D the diagonal of A'A.
The ratio of the decrease of the cost to the one that the linear system predicts says how far the damping goes up or
down: Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004, section 3.2. Under a robust loss
the rows have its weights at the values (iteratively reweighted least squares), and the prediction is that of these.

What a recording determines a million times better than the rest follows the rest along curved valleys. A full step
along a valley's tangent leaves its floor, and raises the cost by orders of magnitude; damped steps small enough to stay
on it take hundreds. So the step is corrected first: from where it leads, damped steps bring what is determined back to
the floor and leave the rest where it is. The cost there counts. A gimbal that was at rest for 30 s, whose bias follows
its mount: 26 linear systems, where 200 damped steps alone had a third of the way before them.

Where the residuals are curved as well, the linear system makes every step along the floor too short, or too long, by
the same part; after one such step the length of the next follows from what the two predict (Aitken). An hour of a
swaying gimbal, 180,000 pictures: 9 linear systems in place of 14 once its outliers are known.

Limits: a minimum is a local one. A cost is a sum of squares, in units of squared sigmas, with the losses in force.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines import deadline
from alidade.pipelines.solvers.chain import Factorization, IndeterminateStateError
from alidade.pipelines.solvers.layout import Tangent, Values
from alidade.pipelines.solvers.linearization import Linearization, System

# Decrease of the cost over the one predicted above which a step was too short (about a saddle the ratio is 2), and
# below which it was too long, if it was shorter than a sigma: farther from the minimum that says nothing of the next.
_TOO_SHORT, _TOO_LONG, _NEAR = 1.5, 0.5, 1.0
# Largest length, in full steps, of a step after one that the linear system makes too short.
_LONGEST = 8.0
# Error of the predicted decrease of an undamped step, shorter than a sigma, below which that step is the last.
_AS_PREDICTED = 2e-6
# Predicted decrease of an undamped step, corrected, below which it may raise the cost at a minimum: what the data
# hardly determine is curved by more than the linear system knows. .01 is .1 sigma.
_CURVED = 1e-2
# Predicted decrease of the first damped step below which all is at its minimum that has more information than the
# damping, where the full step raises the cost even corrected: priors say where the rest is to be (`weak_directions`).
# .001 is .03 sigma. A rough minimisation, whose tolerance is larger, ends at that, also while the cost still falls.
_DETERMINED = 1e-3
# Damping of corrections, of the first damped step and of steps that need not go all the way, relative to the diagonal
# of A'A; that of a correction over that of the step; and the damping below which steps are full ones again.
INITIAL_DAMPING, _FIRMER, _MIN_DAMPING = 1e-6, 100.0, 1e-12


@dataclass(frozen=True)
class LevenbergConfig:
    """Options of the Levenberg-Marquardt minimisation.

    Attributes:
        max_iterations: linear systems solved.
        cost_tolerance: stop when the predicted decrease is below it (squared sigmas): no number is off its minimum by
            more than the root of it, in its own sigmas, and by far less once the step is taken. Sigmas are as large as
            the residuals where these are larger than stated.
        max_damping: above it no step is left.
        corrections: of a step that raises the cost, at most. A rough minimisation makes none: it has few iterations,
            and while outliers count its steps are not along any valley.
    """

    max_iterations: int = 100
    cost_tolerance: float = 2e-5
    max_damping: float = 1e8
    corrections: int = 6


DEFAULT = LevenbergConfig()


@dataclass(frozen=True, eq=False)
class Point:
    """Values, the linear system about these, and the cost.

    Attributes:
        engine: with the loss and the weights in force.
        values: of all variables.
        system, cost: about these.
    """

    engine: Linearization
    values: Values
    system: System
    cost: float

    @classmethod
    def of(cls, engine: Linearization, values: Values) -> Point:
        """Linearise an engine about some values."""
        return cls(engine, values, *engine.at(values))

    @cached_property
    def factorization(self) -> Factorization:
        """Square-root factorization R of the whitened rows. Raises IndeterminateStateError."""
        return self.system.eliminate()

    def forget_factorization(self) -> None:
        """Free the memory of R, the largest array of a long recording; `factorization` makes it anew."""
        vars(self).pop("factorization", None)


@dataclass(frozen=True, eq=False)
class Solution(Point):
    """Result of a minimisation: values, linear system, cost, and whether it converged.

    Attributes:
        converged: whether it is a minimum; `message` says how or why not.
        iterations: linear systems solved on the way.
    """

    converged: bool
    message: str
    iterations: int

    def at_inliers(self) -> Solution:
        """Return the solution with the rejected measurements left out. Raises IndeterminateStateError."""
        engine = self.engine.counting(self.engine.inliers(self.values))
        out = replace(self, engine=engine, cost=engine.cost(self.values))
        vars(out).update(factorization=self.factorization)
        self.forget_factorization()
        return out


def minimize(
    engine: Linearization, values: Values, config: LevenbergConfig = DEFAULT, known: tuple[System, float] | None = None
) -> Solution:
    """Minimise an engine's cost from some values; `known` gives the linear system and cost there."""
    here = Point(engine, values, *known) if known else Point.of(engine, values)
    damping, growth, iteration, before = 0.0, 2.0, 0, 0.0

    def solution(converged: bool, message: str) -> Solution:
        return Solution(engine, here.values, here.system, here.cost, converged, message, iteration)

    if not np.isfinite(here.cost):
        return solution(False, "the residuals at the start are not finite")
    rows = sum(len(group.model.time) * group.model.rows for group in engine.groups if group.is_measurement)
    while iteration < config.max_iterations:
        if deadline.passed():
            return solution(False, f"not converged: {deadline.sentence()}")
        iteration, enough = iteration + 1, _enough(config, here, rows)
        step, predicted = _step(here.system, damping)
        if step is not None:
            length = _length(predicted, before) if damping == 0.0 else 1.0
            # Where there is nothing to be gained the cost rises by rounding.
            most = config.corrections if predicted >= enough else 0
            there, corrections = _reached(engine, here, step.times(length), damping, most)
            iteration += corrections
            decrease = here.cost - there.cost
            before = _misjudged(decrease, max(predicted, enough)) if damping == 0.0 and length == 1.0 else 0.0
            if length > 1.0 and decrease < enough:
                continue  # too far, which proves no minimum: the next step is the single one from here
            # A part of a full step, or more than one, is predicted to gain less.
            off = abs(decrease - length * (2.0 - length) * predicted)
            is_minimum = _is_minimum(enough, damping, predicted, decrease, off)
            is_minimum &= decrease >= 0.0 or not deadline.passed()  # which leaves a step uncorrected
            if decrease > 0.0 or (is_minimum and decrease > -enough):
                here = there
            if is_minimum:
                return solution(True, f"converged after {iteration} iterations")
            if decrease > 0.0:
                ratio = decrease / predicted if predicted > 0.0 else 1.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
                growth = 2.0
                if damping < _MIN_DAMPING or predicted < _DETERMINED:
                    damping = 0.0
                continue
        damping, growth = (damping * growth if damping > 0.0 else INITIAL_DAMPING), 2.0 * growth
        if damping > config.max_damping:
            return solution(False, f"no step lowers chi-square of {here.cost:.6g}")
    return solution(False, f"not converged after {iteration} iterations")


def states_first(engine: Linearization, values: Values) -> Values:
    """Move all states, and the bias, to where they are best at the other parameters given, if the cost falls.

    States aligned with single measurements repeat their noise. A parameter that multiplies a state would explain that
    noise: of ten minutes of a gimbal the scale of LOS errors took a step of 12 prior sigmas.
    """
    with suppress(IndeterminateStateError, np.linalg.LinAlgError):
        system, cost = engine.at(values)
        factorization = system.eliminate()
        root, c = factorization.root, factorization.c
        last = np.zeros((len(root) - 1, 1))
        last[:c, 0] = np.linalg.solve(root[:c, :c], root[:c, -1])
        there = engine.layout.retract(values, followed(factorization, last))
        return there if engine.cost(there) < cost else values
    return values


def followed(factorization: Factorization, last: Array) -> Tangent:
    """Complete moves (c + s, 1) of last node and shared unknowns by the optimal moves of all states and nodes."""
    states, nodes = factorization.given(last)
    return Tangent(states[..., 0], nodes[..., 0], last[factorization.c :, 0])


def _length(predicted: float, before: float) -> float:
    """Length, in full steps, of a step from its predicted decrease and that of the step before.

    Steps that shrink by a factor lead to the minimum as a geometric series does, whose sign alternates where steps are
    too long: Aitken's extrapolation. `before` is negative after a step that was too long, 0 after one that was right.
    """
    ratio = (max(predicted, 0.0) / abs(before)) ** 0.5 if before else 0.0
    return 1.0 / (1.0 - min(ratio, 1.0 - 1.0 / _LONGEST)) if before > 0.0 else 1.0 / (1.0 + min(ratio, 1.0))


def _misjudged(decrease: float, predicted: float) -> float:
    """Predicted decrease of a step whose actual one is larger, its negative if smaller, and 0 if they agree."""
    if decrease > _TOO_SHORT * predicted:
        return predicted
    return -predicted if decrease < _TOO_LONG * predicted and predicted < _NEAR else 0.0


def _is_minimum(enough: float, damping: float, predicted: float, decrease: float, off: float) -> bool:
    """Whether the end of a step is a minimum, from its damping, and how far off the decrease is from the predicted."""
    if damping > 0.0:
        determined = damping <= INITIAL_DAMPING and predicted < max(_DETERMINED, enough)
        return determined and (decrease <= 0.0 or damping == INITIAL_DAMPING or enough > _DETERMINED)
    as_predicted = predicted < _NEAR and off < _AS_PREDICTED
    return predicted < enough or (predicted < _CURVED and decrease < enough) or as_predicted


def _reached(engine: Linearization, here: Point, step: Tangent, damping: float, most: int) -> tuple[Point, int]:
    """Return the end of a step, corrected at most `most` times where the cost rises, and the number of corrections."""
    there = Point.of(engine, engine.layout.retract(here.values, step))
    if there.cost < here.cost or most == 0 or deadline.passed():
        return there, 0
    firm, counted = max(INITIAL_DAMPING, _FIRMER * damping), engine.counting(engine.inliers(here.values))
    back = Point.of(counted, there.values)
    for count in range(1, most + 1):
        correction, _ = _step(back.system, firm)
        if correction is None or deadline.passed():
            return there, count
        further = Point.of(counted, engine.layout.retract(back.values, correction))
        if not further.cost < back.cost:
            return there, count
        back = further
        if engine.cost(back.values) < here.cost:
            return Point.of(engine, back.values), count
    return there, most


def _enough(config: LevenbergConfig, point: Point, rows: int) -> float:
    """Decrease of the cost that counts as none: tolerance times the mean square residual, plus rounding."""
    return config.cost_tolerance * max(1.0, point.system.squares / max(rows, 1)) + 1e-13 * point.cost


def _step(system: System, damping: float) -> tuple[Tangent | None, float]:
    """Solve a damped system; return the step (None if singular) and the predicted decrease of the cost."""
    try:
        factorization = system.eliminate(damping)
        step = Tangent(*factorization.solve())
    except (IndeterminateStateError, np.linalg.LinAlgError):
        return None, 0.0
    return step, system.squares - factorization.minimum
