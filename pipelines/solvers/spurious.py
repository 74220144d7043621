"""Information that a linearised graph has only because it is linearised at noisy states.

About the only axis of a motion a mount cannot be told: turned about it, all measurements stay the same. But the states
at which the graph is linearised are off by their noise, their axis of motion wavers, and by the wavering the mount
seems to be known a little. Each state adds to that, so that minutes of motion would pass for a calibration.

How much of the information is of this kind other linearisations tell, at states as far from the estimated ones as these
are from the true ones, drawn from their covariance: it is quadratic in what the states are off by, so that the noise of
a draw adds what the noise of the estimate has added already (a bootstrap of the bias, Efron, Tibshirani, "An
Introduction to the Bootstrap", 1993, chapter 10).

What noise seems to tell has a sigma and a value: the noise of a gyro that drives a gimbal at rest moves the mounting
angles by as much as their priors let it, some of them always to the same side. So combinations of which most of the
information is noise are to be held where the priors have them, and all that is told of them counts as noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alidade.pipelines.estimation.problem import Array, Problem
from alidade.pipelines.solvers.marginals import IndeterminateError, joint_information, prior_units
from alidade.pipelines.solvers.system import Linear

# Directions in which sigma is beyond this share of the prior are looked at; in others noise adds next to nothing.
_WEAK = 0.3
# ... and so are only those of which the recording says at least this much, in units of the prior's information.
_TOLD = 0.01
_DRAWS = 3
# Of more than this share of noise it is all that is told.
_MOSTLY = 0.5
# More than this is a prior, in units of the default one's information.
_SOME = 0.1


@dataclass(frozen=True)
class Spurious:
    """Information about the reported numbers that is the states' noise; of those that are free, in prior scales.

    Attributes:
        information: (m, m).
        directions: (k, m) unit rows, combinations of the numbers of which nothing else is told.
    """

    information: Array
    directions: Array


def information_of_noise(
    problem: Problem,
    about: Linear,
    covariance: Array,
    current_keys: Mapping[int, int],
) -> Spurious | None:
    """What of the information about the reported numbers is the states' noise; None: nothing.

    Args:
        problem: the graph's.
        about: it linearised at its solution.
        covariance: (n, n) of the reported numbers as the linearised graph has it.
        current_keys: parameter key -> variable that holds its value.
    """
    keys = [current_keys.get(p.key, p.key) for p in problem.parameters]
    doubtful = _doubtful(problem, keys, covariance)
    if not doubtful:
        return None
    values = about.values
    # Far from the solution, measurements would be rejected that count there.
    system = about.system.without_rejected(values)
    try:
        moved = about.drawn(set(values.keys()) - set(doubtful), _DRAWS, np.random.default_rng(0))
        elsewhere = [joint_information(system.linearize(there), system.ordering, keys) for there in moved]
        own = about.information(keys)
    except (RuntimeError, IndeterminateError):
        return None
    noise = np.mean(elsewhere, axis=0) - own
    free, scale, unit = prior_units(problem.parameters, values, keys)
    own, noise = unit.T @ own @ unit, unit.T @ noise @ unit
    priors = [problem.quantities[i].prior_sigma for i in free]
    prior = np.diag([(s / sigma) ** 2 if sigma else 0.0 for s, sigma in zip(scale, priors, strict=True)])
    eigenvalues, vectors = np.linalg.eigh(own)
    weak = vectors[:, eigenvalues < _WEAK**-2.0]
    told, noise, loose = (weak.T @ each @ weak for each in (own - prior, noise, prior))
    held = _held(told, noise, loose)
    others = np.eye(len(held.T)) - held.T @ held
    information = told - others @ (told - _part(told, noise)) @ others
    return Spurious(weak @ information @ weak.T, held @ weak.T)


def _doubtful(problem: Problem, keys: Sequence[int], covariance: Array) -> list[int]:
    """Variables of what is calibrated of which the recording tells a direction, but little of it."""
    found, start = [], 0
    for parameter, key in zip(problem.parameters, keys, strict=True):
        of = [start + i for i, q in enumerate(parameter.quantities) if q.prior_sigma != 0.0 and not q.assumed]
        start += len(parameter.quantities)
        scale = np.array([problem.quantities[i].scale for i in of])
        widest = np.linalg.eigvalsh(covariance[np.ix_(of, of)] / np.outer(scale, scale))
        if ((widest > _WEAK**2) & (widest < 1.0 / (1.0 + _TOLD))).any():
            found.append(key)
    return found


def _held(told: Array, noise: Array, prior: Array) -> Array:
    """Directions (k, m) of which more than half of what is told (m, m) is noise.

    `prior` is the priors' information (m, m).
    """
    information, axes = np.linalg.eigh(told)
    seeming, known = ((axes * (each @ axes)).sum(axis=0) for each in (noise, prior))
    mostly = (information > _TOLD) & (seeming > _MOSTLY * information)
    # Without a prior there is nowhere to be held.
    return np.asarray(axes[:, mostly & (known > _SOME)].T)


def _part(told: Array, noise: Array) -> Array:
    """What of the information (m, m) that a recording tells is noise: none at least, all of it at most."""
    eigenvalues, vectors = np.linalg.eigh(0.5 * (told + told.T))
    root = vectors * np.sqrt(np.maximum(eigenvalues, 1e-12))
    inverse = np.linalg.inv(root)
    shares, directions = np.linalg.eigh(inverse @ (0.5 * (noise + noise.T)) @ inverse.T)
    part = root @ directions
    return np.asarray((part * np.clip(shares, 0.0, 1.0)) @ part.T)
