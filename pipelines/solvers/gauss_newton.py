"""Least squares by Gauss-Newton steps, for graphs with curved valleys and for models that do not fit.

The outer loop is our own, since gtsam's optimizers copy all values into Python at every call of a Python factor, which
makes them quadratic in the number of variables. Linearising, ordering and elimination stay gtsam's. Elimination
is by QR: tight processes beside loose priors cost Cholesky its digits, and QR costs only half as much again.

A full step may be wrong in three ways. Along a curved valley, such as that of two mounts whose product alone is known,
it leaves the floor and raises the error by what is of second order; damping would only make it crawl, and there the
states, and shared variables as far as they are known, are brought back to the floor instead. A large step too leaves
states off the floor, and by so much the next one would be misled about shared variables that little tells, such as a
camera's roll: these swing, and the states after them, for steps on end; there states go to the floor alone in its
place. And where measurements do not fit, residuals bend the error as much as Jacobians do: steps are too short or too
long by the same share again and again. What one gained instead of what it foresaw tells how far the parabola through
both has its floor (Nocedal, Wright, "Numerical Optimization", 2006, sections 3.5 and 10.3).

Where measurements do fit, their noise bends the error along a number that turns pictures, such as a camera's roll: by
the mixed second derivatives states follow it, and of thousands of pictures together these are as large as all that is
known of it. Steps have them (`Ensemble.at`), and are Newton's in that; what is said of a solution has not, since noise
tells nothing of the number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from alidade.pipelines import deadline
from alidade.pipelines.solvers.marginals import IndeterminateError
from alidade.pipelines.solvers.system import Linear, System

MOST_ITERATIONS = 60
# Damping in units of an unknown's own information, beyond which no step is left to be made.
MOST_DAMPING = 1e8
# An error (unit: half a squared sigma) less than this above the minimum has nothing more than 0.005 sigma off, sigmas
# being as large as the residuals say. What a linearisation foresaw wrongly of its step is about what is left for the
# next one.
_ERROR_TOLERANCE = 1e-5
# A step that was to lower the error by less than this, half a sigma, and does by less than a third of it has only
# to do with what is of second order: noise, which is all that a sensor at rest tells of a mount or a delay.
_LITTLE = 0.15
# A step off by more than this from what it foresaw leaves states off the floor; the next one is misled by them if it
# gains less than it foresaw by more than a share of that, and in all. One off by less than the last leaves them there.
_OFF, _MISLED, _ON = 0.1, 0.01, 1e-3
# Parts of a step along a valley that are tried, and whether what is known of shared variables returns to the floor in
# each of the steps that the states then have for it.
_SHARES, _RETURNS = (1.0, 0.3, 0.1, 0.03), (False, False, True, True)
# A step that gains more or less than it foresaw by such a share of it is too short or too long, at most so many times.
_WRONG_LENGTH, _LONGEST = 0.2, 10.0


@dataclass(frozen=True)
class Solution:
    """Values at a minimum of a system, how it was reached, and whether states are on the floor; None: nobody knows."""

    system: System
    values: gtsam.Values
    converged: bool
    message: str
    iterations: int
    on_floor: bool | None = None


@dataclass(frozen=True)
class _Move:
    """Values to go to, and their error.

    Attributes:
        foreseen: by how much the linear system foresaw that they lower the error.
        on_floor: whether the states are there.
        halfway: whether the shared variables are yet to follow.
        last: whether the minimum is there.
    """

    values: gtsam.Values
    error: float
    foreseen: float
    on_floor: bool = False
    halfway: bool = False
    last: bool = False


def minimize(
    system: System,
    values: gtsam.Values,
    tolerance: float = _ERROR_TOLERANCE,
    most: int = MOST_ITERATIONS,
    most_damping: float = MOST_DAMPING,
    on_floor: bool | None = None,
) -> Solution:
    """Values with the least error, by steps that are damped (Levenberg-Marquardt) only where full ones fail.

    Args:
        system: with the loss in force.
        values: where to begin.
        tolerance: of the error above its minimum; where residuals are larger than their noise it may be more.
        most: iterations, after which it counts as not converged.
        most_damping: in units of an unknown's own information, beyond which no step is left.
        on_floor: whether the states are at the start; None: nobody knows.
    """
    error, damping = system.error(values), 0.0
    if not np.isfinite(error):
        return Solution(system, values, False, "the residuals at the start are not finite", 0)
    near = _near(system, error, tolerance)
    for iteration in range(1, most + 1):
        move, damping = _move(system, values, error, near, damping, most_damping, on_floor)
        if move is None:
            return Solution(system, values, False, f"no step lowers the error of {error:.6g}", iteration)
        before, values, error = error, move.values, move.error
        fall, off = before - error, abs(before - error - move.foreseen)
        small = move.foreseen < _LITTLE and fall < 0.3 * move.foreseen
        near = _near(system, error, tolerance)
        enough = small or min(fall, off) < near + 1e-13 * before + 1e-10 * error
        if not move.last:
            told = damping == 0.0 and not _ON <= off <= _OFF
            on_floor = move.on_floor or (off < _ON if told else None)
        if move.last or (damping == 0.0 and not move.halfway and enough):
            return Solution(system, values, True, f"converged after {iteration} iterations", iteration, on_floor)
        damping = damping / 10.0 if damping > 1e-6 else 0.0
        if deadline.passed():
            return Solution(system, values, False, f"not converged: {deadline.sentence()}", iteration)
    return Solution(system, values, False, f"not converged after {most} iterations", most)


def _move(
    system: System,
    values: gtsam.Values,
    error: float,
    near: float,
    damping: float,
    most_damping: float,
    on_floor: bool | None,
) -> tuple[_Move | None, float]:
    """The next move, None if there is none, and the damping that it took."""
    linear = _linearized(system, values)
    while damping <= most_damping:
        delta, foreseen = _step(system, values, linear, damping, on_floor is True)
        move = None
        if delta is not None and damping > 0.0:
            move = _lower(error, _there(system, values, delta, foreseen))
        elif delta is not None and foreseen < near:
            move = _there(system, values, delta, foreseen)
            return (replace(move, last=True) if move.error < error else _stay(values, error)), damping
        elif delta is not None:
            move = _full(system, values, error, linear, delta, foreseen, on_floor)
            if move is None and foreseen < _LITTLE:
                return _stay(values, error), damping
        if move is not None:
            return move, damping
        damping = max(10.0 * damping, 1e-6)
    return None, damping


def _stay(values: gtsam.Values, error: float) -> _Move:
    """No further move, since the minimum is as near as need be."""
    return _Move(values, error, 0.0, last=True)


def _near(system: System, error: float, tolerance: float) -> float:
    """So much above the minimum is near enough, if the error there is about what it is."""
    return max(tolerance, _ERROR_TOLERANCE * 2.0 * error / max(system.measured, 1))


def _full(
    system: System,
    values: gtsam.Values,
    error: float,
    linear: Linear | None,
    delta: gtsam.VectorValues,
    foreseen: float,
    on_floor: bool | None,
) -> _Move | None:
    """Where an undamped step leads, or what is better there; None: nowhere that is lower."""
    move = _there(system, values, delta, foreseen)
    fall = error - move.error
    if on_floor is False and foreseen - fall > max(_MISLED, _MISLED * foreseen):
        alone = _states_alone(system, values, linear)
        if alone.error < min(error, move.error):
            return alone
    if fall < 0.0:
        return _lower(error, _along_valley(system, values, error, delta, move))
    # A surrogate of the loss weighs anew with every step: of a few on the way nothing is to be learned.
    relaxed = system.loss is not None and np.isfinite(system.loss.mu)
    if not relaxed and abs(fall - foreseen) > _WRONG_LENGTH * foreseen:
        bend = 2.0 * foreseen - fall
        share = foreseen / bend if foreseen < _LONGEST * bend else _LONGEST
        other = _there(system, values, delta.scale(share), foreseen)
        if share > 1.0 and other.error >= move.error:
            other = _Move(*_returned(system, other.values, known=False), foreseen, on_floor=True)
        if other.error < move.error:
            return other
    return move


def _there(system: System, values: gtsam.Values, delta: gtsam.VectorValues, foreseen: float) -> _Move:
    """Where a step leads."""
    candidate = values.retract(delta)
    return _Move(candidate, system.error(candidate), foreseen)


def _lower(error: float, move: _Move) -> _Move | None:
    """A move that does not raise the error, but for rounding."""
    return move if move.error <= error + _ERROR_TOLERANCE else None


def _states_alone(system: System, values: gtsam.Values, linear: Linear | None) -> _Move:
    """The states moved with the shared variables held; its error infinite if they are not determined."""
    try:
        candidate = None if linear is None else values.retract(linear.states_alone())
    except (RuntimeError, IndeterminateError):
        candidate = None
    error = np.inf if candidate is None else system.error(candidate)
    return _Move(values if candidate is None else candidate, error, 0.0, on_floor=True, halfway=True)


def _along_valley(system: System, values: gtsam.Values, error: float, delta: gtsam.VectorValues, full: _Move) -> _Move:
    """A place with a lower error on a step's way, `full` its end; its error infinite if there is none.

    The states are solved for anew with the shared variables held where the step takes them. Where these alone are off
    the floor, as a bias is once the mount has turned by which it is known, only what little is known about them stays
    where it is, as from the first in a graph without states. They go less far until that lowers the error.
    """
    for share in _SHARES:
        candidate = full.values if share == 1.0 else values.retract(delta.scale(share))
        for known in _RETURNS:
            candidate, new_error = _returned(system, candidate, known)
            if new_error < error:
                return _Move(candidate, new_error, full.foreseen, on_floor=True)
    return _Move(values, np.inf, full.foreseen)


def _returned(system: System, values: gtsam.Values, known: bool) -> tuple[gtsam.Values, float]:
    """Values nearer to the floor, and their error: the states alone moved, or all that is known."""
    linear = _linearized(system, values)
    if linear is not None and (known or not linear.has_states):
        try:
            candidate = values.retract(linear.of_the_known())
        except (RuntimeError, IndeterminateError):
            return values, np.inf
        return candidate, system.error(candidate)
    move = _states_alone(system, values, linear)
    return move.values, move.error


def _linearized(system: System, values: gtsam.Values) -> Linear | None:
    """A system about some values; None: a stretch does not determine what it alone holds."""
    try:
        return system.linearized(values, mixed=True)
    except IndeterminateError:
        return None


def _step(
    system: System, values: gtsam.Values, linear: Linear | None, damping: float, on_floor: bool
) -> tuple[gtsam.VectorValues | None, float]:
    """One (damped) step, None if the system is singular, and by how much it should lower the error."""
    try:
        if damping > 0.0:
            linear = system.linearized(values, damping, mixed=True) if linear is None else linear.damped(damping)
        return (None, 0.0) if linear is None else linear.step(on_floor)
    except (RuntimeError, IndeterminateError):
        return None, 0.0
