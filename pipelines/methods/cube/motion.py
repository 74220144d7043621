"""Motion of a simulated cube, by hand through its static poses, in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.pipelines.methods.cube.scenario import CubeScenario

Array = NDArray[np.float64]

# From 0 to 1, and from 0 to 1 and back, over [0, 1], at rest with two derivatives at both ends.
_STEP = Polynomial([0, 0, 0, 10, -15, 6])
_BUMP = 64.0 * Polynomial([0, 0, 0, 1]) * Polynomial([1, -1]) ** 3


@dataclass(frozen=True, eq=False)
class Motion:
    """The cube's way: attitudes nRb (P, 4) and places (P, 3), m in C, of the poses, and the hand's detours between.

    start (P,), stop (P,): of the static poses, s. wobble (P - 1, 3) rad in b, detour (P - 1, 3) m.
    """

    start: Array
    stop: Array
    nRb: Array
    place: Array
    wobble: Array
    detour: Array

    def _phase(self, t: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """The pose that a moment comes after, how far the turn from it has gone (0 to 1), and the turn's duration."""
        k = np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, len(self.start) - 1)
        following = np.minimum(k + 1, len(self.start) - 1)
        duration = np.where(following > k, self.start[following] - self.stop[k], 1.0)
        return k, np.where(following > k, np.clip((t - self.stop[k]) / duration, 0.0, 1.0), 0.0), duration

    def attitude(self, t: Array) -> Array:
        """Attitudes nRb (N, 4) at the times."""
        k, u, _ = self._phase(t)
        if len(self.start) == 1:
            return np.broadcast_to(self.nRb[0], (len(t), 4))
        turn = np.append(so3.log(so3.multiply(so3.inverse(self.nRb[:-1]), self.nRb[1:])), np.zeros((1, 3)), axis=0)
        wobble = np.append(self.wobble, np.zeros((1, 3)), axis=0)
        return so3.compose(self.nRb[k], so3.exp(turn[k] * _STEP(u)[:, None]), so3.exp(wobble[k] * _BUMP(u)[:, None]))

    def position(self, t: Array, derivative: int = 0) -> Array:
        """Place (N, 3) of the cube in C, m, or a derivative of it by time."""
        k, u, duration = self._phase(t)
        step, bump = (f.deriv(derivative) if derivative else f for f in (_STEP, _BUMP))
        after = np.append(self.place[1:], self.place[-1:], axis=0)
        detour = np.append(self.detour, np.zeros((1, 3)), axis=0)
        moved = (after[k] - self.place[k]) * step(u)[:, None] + detour[k] * bump(u)[:, None]
        return moved / duration[:, None] ** derivative + (0.0 if derivative else self.place[k])


def drawn_attitudes(scenario: CubeScenario, rng: np.random.Generator) -> Array:
    """Attitudes nRb (P, 4) of the poses: the random ones, then those given."""
    n = scenario.poses
    given = np.array([each.nRb for each in scenario.attitudes]).reshape(-1, 4)
    if not (n and scenario.turn_axes):
        return np.vstack([so3.normalize(rng.standard_normal((n, 4))), given])
    axes = np.array([scenario.turn_axes[k % len(scenario.turn_axes)] for k in range(n - 1)]).reshape(-1, 3)
    angle = rng.uniform(0.8, 2.4, n - 1) * rng.choice([-1.0, 1.0], n - 1)
    found = [so3.normalize(rng.standard_normal(4))]
    for axis, a in zip(axes, angle, strict=True):
        found.append(so3.multiply(found[-1], so3.exp(a * axis / np.linalg.norm(axis))))
    return np.vstack([np.array(found), given])


def drawn_motion(s: CubeScenario, rng: np.random.Generator) -> Motion:
    """Motion through the scenario's poses."""
    nRb = drawn_attitudes(s, rng)
    n = len(nRb)
    place = np.array([0.0, 0.0, s.distance]) + [0.04, 0.03, 0.05] * rng.uniform(-1, 1, (n, 3))
    angles = np.linalg.norm(so3.log(so3.multiply(so3.inverse(nRb[:-1]), nRb[1:])), axis=1)
    turning = np.maximum(angles, 0.5) / s.turn_rad_s
    start = np.concatenate([[0.0], np.cumsum(s.static_s + turning)])
    wobble = (0.0 if s.turn_axes else 0.15) * rng.standard_normal((n - 1, 3))
    return Motion(start, start + s.static_s, nRb, place, wobble, 0.05 * rng.standard_normal((n - 1, 3)))
