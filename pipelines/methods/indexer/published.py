"""The published calibration of a two-axis indexer: half differences of whole turns, and the thin-shell search.

CN115265591B: in each of four positions the platform turns uniformly forward and back. Half the difference of the two
mean gyro rates is free of bias and of the earth's rate, and turned into the platform's frame t its components across
the axis vanish: Yt and Zt in positions 1 and 2 (outer axis), Xt and Yt in positions 3 and 4 (inner axis). The cost is
the sum of squares of those eight. Angles and passive matrices as published, C_t^m = Rx(theta_x) Ry(theta_y)
Rz(theta_z). Methods page, section 2; the formulas of the eight equations were lost and are given there as they must
have been.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.windows import AxisMotion, Run, axis_motion
from alidade.pipelines.methods.triads import numeric_jacobian
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

NAMES = ("theta_x", "theta_y", "theta_z")

# The other axis stands at 0 or at half a turn within this, rad.
_ANGLE_TOLERANCE = np.deg2rad(5.0)
# A cost that changes by less than this over the start interval, relatively, does not depend on the angle.
_FLAT = 1e-9


@dataclass(frozen=True)
class HalfDifference:
    """Half difference of the forward and backward mean rates at one position.

    Attributes:
        position: 1 and 2 outer axis, 3 and 4 inner axis, with the other at 0 and at half a turn.
        axis: the one that turns.
        rate: (3,) half the forward mean less the backward mean, in m, rad/s.
        duration: s, of all the whole turns together.
    """

    position: int
    axis: Literal["outer", "inner"]
    rate: Array
    duration: float


@dataclass(frozen=True)
class ThinShell:
    """Result of the thin-shell search.

    Attributes:
        theta: (3,) rad.
        fourth_cases: how often the search met s_min < s_mean > s_max, which the publication does not name: the half
            with the lower end was kept.
        flat: for each angle, whether the cost did not depend on it: it then stays at the middle of its interval.
        at_edge: for each angle, whether it ended at an edge of its start interval: it may lie outside.
    """

    theta: Array
    fourth_cases: int
    flat: tuple[bool, ...]
    at_edge: tuple[bool, ...]


def published_estimate(data: IndexerData, config: Config, problem: Problem) -> Estimate:
    """Run the thin-shell search once, as a solver of the problem that estimates the angles theta.

    The publication gives no accuracy; the covariance is what gyro noise alone does to the eight components.
    """
    measured = half_differences(data)
    found = search(measured)
    density = first_given(config.noise.gyro_density, data.gyro_density, DEFAULT_NOISE.gyro_density)
    known = {q.name for q in problem.quantities}
    notes = [f"{name} has no influence on the cost" for name, flat in zip(NAMES, found.flat, strict=True) if flat]
    notes += [f"{name} at the edge of +-2 deg" for name, edge in zip(NAMES, found.at_edge, strict=True) if edge]
    if found.fourth_cases:
        notes.append(f"fourth case met {found.fourth_cases} times")
    return Estimate(
        solver="published",
        names=tuple(name for name in NAMES if name in known),
        values=found.theta,
        covariance=_covariance(found.theta, measured, density),
        converged=not any(found.flat) and not any(found.at_edge),
        message="; ".join(notes) or "one sweep",
    )


def _covariance(theta: Array, measured: Sequence[HalfDifference], density: float) -> Array:
    """Covariance (3, 3), rad^2, of theta by white gyro noise in the eight components; 1 rad if unobserved."""
    J = numeric_jacobian(lambda angles: np.concatenate(_across(angles, measured)), theta, np.full(3, 1e-6))
    # Half the difference of two means over half of the time each.
    weights = np.repeat([half.duration for half in measured], 2) / density**2
    return np.asarray(np.linalg.inv(np.eye(3) + (J.T * weights) @ J))


def half_differences(data: IndexerData) -> tuple[HalfDifference, ...]:
    """Half differences of the recording's positions, in order, averaged over repeated visits.

    Raises:
        InputError: no position has whole turns forward and back.
    """
    motion = axis_motion(data)
    means: dict[int, dict[int, list[Array]]] = {p: {1: [], -1: []} for p in (1, 2, 3, 4)}
    duration = dict.fromkeys(means, 0.0)
    for run in motion.runs:
        position = _position(run)
        if position is not None and run.whole_turns:
            mean, length = _mean_over_whole_turns(data, motion, run)
            means[position][run.direction].append(mean)
            duration[position] += length
    found = tuple(
        HalfDifference(
            position,
            "outer" if position <= 2 else "inner",
            np.asarray(0.5 * (np.mean(both[1], axis=0) - np.mean(both[-1], axis=0))),
            duration[position],
        )
        for position, both in means.items()
        if both[1] and both[-1]
    )
    if not found:
        raise InputError(
            "indexer: the published search needs whole turns forward and back about an axis while the other stands at "
            "0 or 180 degrees; the graph solvers do without"
        )
    return found


def cost(theta: ArrayLike, measured: Sequence[HalfDifference]) -> float:
    """Sum of squared half differences across the rotation axis in t, (rad/s)^2, at theta (3,), rad."""
    return sum(float(row @ row) for row in _across(theta, measured))


def _across(theta: ArrayLike, measured: Sequence[HalfDifference]) -> list[Array]:
    """Components (2,) of each half difference across the rotation axis in t, rad/s."""
    tRm = so3.from_angles(theta)
    in_t = [so3.rotate(tRm, half.rate) for half in measured]
    return [rate[1:] if half.axis == "outer" else rate[:2] for rate, half in zip(in_t, measured, strict=True)]


def search(measured: Sequence[HalfDifference], half_width: float = np.deg2rad(2.0), iterations: int = 28) -> ThinShell:
    """Search theta_x, theta_y and theta_z in turn by the thin-shell method, the other angles unchanged.

    Args:
        measured: half differences; the base is level and points north, as the schedule of the publication asks.
        half_width: of the start interval about zero, rad.
        iterations: limit for each angle.
    """
    theta, fourth_cases, flat = np.zeros(3), 0, []
    for axis in range(3):
        theta[axis], fourth, is_flat = _shell(theta, axis, measured, half_width, iterations)
        fourth_cases += fourth
        flat.append(is_flat)
    at_edge = tuple(bool(half_width - abs(angle) < 1e-6 * half_width) for angle in theta)
    return ThinShell(theta, fourth_cases, tuple(flat), at_edge)


def _shell(
    theta: Array, axis: int, measured: Sequence[HalfDifference], half_width: float, iterations: int
) -> tuple[float, int, bool]:
    """Search one angle; return it, the number of fourth cases, and whether the cost is flat."""

    def at(angle: float) -> float:
        trial = theta.copy()
        trial[axis] = angle
        return cost(trial, measured)

    low, high, fourth = -half_width, half_width, 0
    for iteration in range(iterations):
        middle = 0.5 * (low + high)
        s_low, s_middle, s_high = at(low), at(middle), at(high)
        if iteration == 0 and max(s_low, s_high) - min(s_low, s_middle, s_high) <= _FLAT * s_middle:
            return middle, fourth, True
        if s_low > s_middle < s_high:
            low, high = 0.5 * (middle + low), 0.5 * (middle + high)
        elif s_low <= s_middle <= s_high:
            high = middle
        elif s_low >= s_middle >= s_high:
            low = middle
        else:
            fourth += 1
            low, high = (low, middle) if s_low <= s_high else (middle, high)
    return 0.5 * (low + high), fourth, False


def _position(run: Run) -> int | None:
    """Number (1 to 4) of the published position that a run has; None for other positions."""
    if run.axis not in ("outer", "inner"):
        return None
    off_zero = abs((run.other + np.pi) % (2.0 * np.pi) - np.pi)
    first = 1 if run.axis == "outer" else 3
    if off_zero < _ANGLE_TOLERANCE:
        return first
    return first + 1 if np.pi - off_zero < _ANGLE_TOLERANCE else None


def _mean_over_whole_turns(data: IndexerData, motion: AxisMotion, run: Run) -> tuple[Array, float]:
    """Mean gyro rate (3,) over a run's whole turns, by the encoder, and their duration, s.

    The turns start behind the ramp, since the publication averages uniform turning; a run without turns to spare is
    taken from its start.
    """
    first, last = np.searchsorted(motion.t, [run.start, run.stop])
    t = motion.t[first : last + 1]
    angle = motion.angles[first : last + 1, 0 if run.axis == "outer" else 1]
    path = np.maximum.accumulate(np.abs(angle - angle[0]))
    spare = max(path[-1] - 2.0 * np.pi * run.whole_turns, 0.0)
    begin, end = np.interp([0.5 * spare, path[-1] - 0.5 * spare], path + 1e-12 * np.arange(len(path)), t)
    # A sample is the mean over the interval about its stamp; those at the ends count with the part inside.
    edges = np.concatenate([[-np.inf], 0.5 * (data.gyro_t[1:] + data.gyro_t[:-1]), [np.inf]])
    inside = np.clip(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0.0, None)
    return np.asarray(inside @ data.gyro / inside.sum()), float(inside.sum())
