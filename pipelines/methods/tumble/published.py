"""The usual calibration of a tumbled triad: an ellipsoid through its readings by linear least squares.

Every book on magnetometers has it, for example Merayo, Brauer, Primdahl, Petersen, Nielsen, "Scalar calibration of
vector magnetometers", Measurement Science and Technology 2000: the coefficients of the quadric x'Qx + 2u'x = 1 by least
squares of that equation, the centre -Q^-1 u and the root of Q made to a unit length. Errors of the equation are not
those of the measurements, which biases it where noise is not small; there is no weighing of outliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods.triads import numeric_jacobian
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.settings import Config

if TYPE_CHECKING:
    from alidade.pipelines.methods.tumble.model import Sensor

# Nine coefficients and a residual.
FEWEST = 10
_STEP = 1e-5


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid |S (raw - centre)| = 1, S (3, 3) symmetric, with covariance (9, 9) of its quadric coefficients.

    Attributes:
        S, centre: as above, in the unit of raw.
        coefficients: (9,) of the quadric of (raw - origin) / unit.
        covariance: of these, by the equation's residuals.
        origin: (3,).
        unit: of the scaled raw.
    """

    S: Array
    centre: Array
    coefficients: Array
    covariance: Array
    origin: Array
    unit: float


def ellipsoid(raw: Array) -> Ellipsoid | None:
    """Fit an ellipsoid to readings (n, 3) by least squares; None where the best quadric is no ellipsoid."""
    origin, unit = raw.mean(axis=0), max(float(raw.std()), np.finfo(float).tiny)
    x, y, z = ((raw - origin) / unit).T
    design = np.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z, 2 * x, 2 * y, 2 * z], axis=1)
    coefficients, _, rank, _ = np.linalg.lstsq(design, np.ones(len(raw)))
    found = None if rank < design.shape[1] else _shape(coefficients, origin, unit)
    if found is None:
        return None
    residuals = design @ coefficients - 1.0
    covariance = np.linalg.inv(design.T @ design) * float(residuals @ residuals) / max(len(raw) - 9, 1)
    return Ellipsoid(*found, coefficients, covariance, origin, unit)


def published_estimate(data: TumbleData, config: Config, problem: Problem) -> Estimate:
    """Estimate K and b of each sensor alone by an ellipsoid fit; a magnetometer is rotated as in the first guess.

    Raises InputError where the best quadric is no ellipsoid.
    """
    from scipy.linalg import block_diag

    from alidade.pipelines.methods.tumble.model import prepare

    names: list[str] = []
    values: list[Array] = []
    blocks: list[Array] = []
    for sensor in prepare(data, config).sensors:
        found = ellipsoid(sensor.raw)
        if found is None:
            raise InputError(f"no ellipsoid fits the readings of {sensor.name}: turn it through more attitudes")
        names += sensor.names
        values.append(_numbers(sensor, found, found.coefficients))
        steps = _STEP * np.sqrt(np.diag(found.covariance))
        J = numeric_jacobian(partial(_numbers, sensor, found), found.coefficients, steps)
        blocks.append(J @ found.covariance @ J.T)
    whole, covariance = np.concatenate(values), block_diag(*blocks)
    known = [i for i, name in enumerate(names) if name in {q.name for q in problem.quantities}]
    return Estimate(
        solver="published",
        names=tuple(names[i] for i in known),
        values=whole[known],
        covariance=covariance[np.ix_(known, known)],
        converged=True,
        message="an ellipsoid by linear least squares",
    )


def _numbers(sensor: Sensor, found: Ellipsoid, coefficients: Array) -> Array:
    """Reported K and b of a sensor, for quadric coefficients near the best."""
    shape = _shape(coefficients, found.origin, found.unit)
    assert shape is not None
    S, centre = shape
    K = sensor.strength * sensor.turned @ S
    gains = K[np.triu_indices(3)] if sensor.symmetric else K.ravel()
    return np.concatenate([gains, -K @ centre])


def _shape(coefficients: Array, origin: Array, unit: float) -> tuple[Array, Array] | None:
    """Matrix S and centre of a quadric; None if the quadric is no ellipsoid."""
    xx, xy, xz, yy, yz, zz = coefficients[:6]
    Q, u = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), coefficients[6:]
    if np.linalg.cond(Q) > 1e8:
        return None
    centre = -np.linalg.solve(Q, u)
    squares, axes = np.linalg.eigh(Q / (1.0 + centre @ Q @ centre))
    if squares[0] <= 0.0:
        return None
    return (axes * np.sqrt(squares)) @ axes.T / unit, origin + unit * centre
