"""First guess of mounting and gyro bias, and the groups in which the gyro is not that of the axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from alidade.factors import so3
from alidade.factors.indexer import mounting_angles
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array, Parameter
from alidade.pipelines.methods.indexer.groups import Group
from alidade.pipelines.methods.indexer.parameters import SCALE, THETA

# A gyro that departs from the encoders by more than this share of the rate is not the gyro of this axis.
_DISAGREEMENT = 0.01


def agreeing(
    groups: tuple[Group, ...], parameters: Sequence[Parameter], density: float, encoder: float
) -> tuple[tuple[Group, ...], int]:
    """The groups whose gyro follows the encoders, and how many do not.

    Fits gyro = A w + b over all groups, so that neither mounting nor bias counts as disagreement.

    Raises:
        InputError: the gyro turns against the encoder of an axis though the mounting's priors exclude that it is upside
            down, or at a rate that differs by more than 1 % and by more than the priors of the gyro's scale allow.
    """
    w = np.array([g.mean_platform for g in groups])
    gyro = np.array([g.mean_gyro for g in groups])
    moving = np.array([g.position is not None for g in groups])
    speed = np.linalg.norm(w, axis=1)
    weight = np.array([g.duration for g in groups])
    for _ in range(10):
        A, b = _fit(w, gyro, weight)
        misfit = np.linalg.norm(gyro - w @ A.T - b, axis=1)
        # Least absolute misfit: one damaged turn does not bend the fit.
        weight = np.array([g.duration for g in groups]) / np.maximum(misfit, 1e-4 * speed.max())
    quantities = [q for p in parameters for q in p.quantities]
    scales = [q.prior_sigma or 0.0 for q in quantities if q.name in SCALE.names]
    allowed = _DISAGREEMENT + 3.0 * max(scales, default=0.0)
    angles = [np.inf if q.prior_sigma is None else q.prior_sigma for q in quantities if q.name in THETA]
    upright = 3.0 * max(angles, default=0.0) < 0.5 * np.pi
    for axis, name in (("outer", "outer_x"), ("inner", "inner_z")):
        mine = [i for i, g in enumerate(groups) if g.run.axis == axis]
        if not mine:
            continue
        unit = w[mine] / speed[mine, None]
        along = float(np.median(((unit @ A.T) * unit).sum(axis=1)))
        gain = float(np.median(np.linalg.norm(unit @ A.T, axis=1)))
        if along < 0.0 and upright:
            raise InputError(
                f"indexer: gyro and encoder of the axis {name} disagree in sign; check the directions of both"
            )
        if abs(gain - 1.0) > allowed:
            raise InputError(
                f"indexer: about the axis {name} the gyro turns at {100.0 * gain:.4g} % of the encoder's rate, more "
                "than 1 % off; check units and gear, or say so of the gyro (sensors: {gyro: {scale: 0.05}})"
            )
    duration = np.array([g.duration for g in groups])
    noise = np.sqrt(density**2 / duration + 2.0 * (encoder / duration) ** 2)
    good = ~moving | (misfit <= _DISAGREEMENT * np.maximum(speed, 0.1 * speed.max()) + 5.0 * noise)
    return tuple(g for g, ok in zip(groups, good, strict=True) if ok), int((~good).sum())


def _fit(w: Array, gyro: Array, weight: Array) -> tuple[Array, Array]:
    """A (3, 3) near the identity and b (3,) near zero with gyro = A w + b in weighted least squares."""
    rows = np.column_stack([w, np.ones(len(w))])
    # What no rotation excites stays with the prior: a mounting of some degrees, a bias below 1e-3 rad/s.
    hold = 1e-6 * weight.sum() * np.array([*[np.mean((w**2).sum(axis=1))] * 3, 1.0])
    normal = (rows * weight[:, None]).T @ rows + np.diag(hold)
    right = (rows * weight[:, None]).T @ gyro
    right[:3] += np.diag(hold[:3])
    solution = np.linalg.solve(normal, right)
    return np.asarray(solution[:3].T), np.asarray(solution[3])


def guess(groups: tuple[Group, ...]) -> tuple[Array, Array]:
    """First guess of theta (3,) and the bias (3,): the rotation that best takes the platform's rates to the gyro's."""
    w = np.array([g.mean_platform for g in groups])
    gyro = np.array([g.mean_gyro for g in groups])
    weight = np.array([g.duration for g in groups])
    b = _fit(w, gyro, weight)[1]
    # A trace of the identity decides what one axis alone leaves open.
    trace = 1e-6 * np.linalg.norm(((gyro - b) * weight[:, None]).T @ w)
    tRm = so3.align(np.vstack([w, np.eye(3)]), np.vstack([gyro - b, np.eye(3)]), np.append(weight, np.full(3, trace)))
    return mounting_angles(tRm), b
