"""The two-stage calibration of two gyros: time offset first, rotation second.

The norm of the rate is the same in every frame, so the peak of the norms' cross-correlation is the time offset; with it
the rotation that brings one gyro's rates nearest to the other's is the singular value solution of Kabsch (Acta Cryst.
A32, 1976), and the difference of the mean rates that of the biases. Kalibr starts its joint estimation so (Furgale,
Rehder, Siegwart, "Unified temporal and spatial calibration for multi-sensor systems", IROS 2013; Rehder et al.,
"Extending kalibr", ICRA 2016).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.settings import Config
from gyro_pair.recording import GyroPairData, densities

Array = NDArray[np.float64]

# The time offset is looked for up to here, s.
FARTHEST = 0.5
# Rates of change are taken over this time, s: long against noise, short against turns.
_SPAN = 0.1


@dataclass(frozen=True)
class Alignment:
    """What the two stages find.

    Attributes:
        time_offset: s, from b's stamps to the same moments on a's clock.
        aRb: (4,) rotation.
        difference: (3,) bias of b less that of a, in b, rad/s.
    """

    time_offset: float
    aRb: Array
    difference: Array


def align(data: GyroPairData) -> Alignment:
    """Time offset, rotation and bias difference; what the motion does not tell is arbitrary."""
    offset = _peak(data)
    a, b = _pairs(data, offset)
    aRb = so3.align(a - a.mean(axis=0), b - b.mean(axis=0))
    return Alignment(offset, aRb, (b - so3.rotate(so3.inverse(aRb), a)).mean(axis=0))


def published_estimate(data: GyroPairData, config: Config, problem: Problem) -> Estimate:
    """The two stages as a solver of the problem.

    The publications give no accuracy; the covariance is the Cramer-Rao bound of each stage by itself, rates white.
    """
    start = time.perf_counter()
    found = align(data)
    phi = so3.log(found.aRb)
    return Estimate(
        solver="published",
        names=tuple(q.name for q in problem.quantities),
        values=np.concatenate([phi, [found.time_offset], found.difference]),
        covariance=_covariance(data, found, sum(density**2 for density in densities(data, config))),
        converged=abs(found.time_offset) < FARTHEST,
        message="cross-correlation, then singular values",
        seconds={"solve": time.perf_counter() - start},
    )


def _peak(data: GyroPairData) -> float:
    """The shift of b's stamps, s, at which the norms of both gyros' rates correlate most, between grid points too."""
    step = min(float(np.median(np.diff(t))) for t in (data.a_t, data.b_t))
    grid = np.arange(max(data.a_t[0], data.b_t[0]), min(data.a_t[-1], data.b_t[-1]), step)
    a, b = (
        np.interp(grid, t, np.linalg.norm(rate, axis=1))
        for t, rate in ((data.a_t, data.a_gyro), (data.b_t, data.b_gyro))
    )
    reach = min(int(FARTHEST / step), len(grid) // 4)
    # All of the same part of b: as much of both as the shift leaves would draw the peak towards no shift.
    b = b[reach : len(grid) - reach]
    correlation = np.correlate(a, b - b.mean(), "valid") / np.sqrt(_scatter(a, len(b)))
    best = int(np.argmax(correlation))
    if not 0 < best < 2 * reach:
        return float(np.sign(best - reach)) * FARTHEST
    left, top, right = correlation[best - 1 : best + 2]
    return float(step * (best - reach + 0.5 * (left - right) / (left - 2.0 * top + right)))


def _scatter(values: Array, length: int) -> Array:
    """Sum of squares about the mean of each stretch of so many neighbouring values, never zero."""
    first, second = (np.cumsum(np.append(0.0, power)) for power in (values, values**2))
    first, second = (each[length:] - each[:-length] for each in (first, second))
    return np.maximum(second - first**2 / length, np.finfo(float).tiny)


def _pairs(data: GyroPairData, offset: float) -> tuple[Array, Array]:
    """Rates (n, 3) of both gyros at the moments of b's samples, each in its own frame."""
    at = data.b_t + offset
    inside = (at >= data.a_t[0]) & (at <= data.a_t[-1])
    a = np.stack([np.interp(at[inside], data.a_t, axis) for axis in data.a_gyro.T], axis=1)
    return a, data.b_gyro[inside]


def _covariance(data: GyroPairData, found: Alignment, density_squared: float) -> Array:
    """(7, 7) of rotation vector, time offset and bias difference; what is not told has the variance of a wide prior."""
    step = float(np.median(np.diff(data.b_t)))
    variance = density_squared / step
    a, b = _pairs(data, found.time_offset)
    rate = b - b.mean(axis=0)
    tangent = np.linalg.inv(np.eye(3) / np.pi**2 + ((rate**2).sum() * np.eye(3) - rate.T @ rate) / variance)
    jacobian = so3.right_jacobian_inverse(so3.log(found.aRb))
    lag = max(1, round(_SPAN / step))
    slope = np.diff(np.linalg.norm(a, axis=1)[::lag]) / (lag * step)
    covariance = np.zeros((7, 7))
    covariance[:3, :3] = jacobian @ tangent @ jacobian.T
    covariance[3, 3] = 1.0 / (1.0 / FARTHEST**2 + lag * (slope**2).sum() / variance)
    covariance[4:, 4:] = variance / len(b) * np.eye(3)
    return covariance
