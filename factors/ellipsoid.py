"""Factors of triads rotated in a constant field: its constant length, and the constant angle between two fields.

Frames: b the body. A triad has nominal = K raw + b. The length of a vector that is constant in level coordinates does
not depend on the attitude: raw lies on an ellipsoid. The attitude is eliminated; the residual of a noisy raw is its
distance from the ellipsoid.

Variables are (K by rows, b), 12 numbers, or of a K that is symmetric 9: k11 k12 k13 k22 k23 k33, b. To first order
residuals are as white as the samples; the bias of second order, noise along a curved surface, is `excess`
(of fitted curves: Kanatani, "Statistical optimization for geometric computation", 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from alidade.factors.array import Array
from alidade.factors.model import Block, Model, Residuals

# Of a symmetric K: which of the nine entries by rows each of the six numbers is.
_UPPER = np.zeros((9, 6))
_UPPER[[0, 1, 3, 2, 6, 4, 5, 7, 8], [0, 1, 1, 2, 2, 3, 4, 4, 5]] = 1.0
_SYMMETRIC = np.block([[_UPPER, np.zeros((9, 3))], [np.zeros((3, 6)), np.eye(3)]])


# Lower limit of lengths and strengths, which keeps their logarithms finite.
_LEAST = 1e-12


def entries(symmetric: bool) -> Array:
    """Matrix (12, 9) or (12, 12) from a triad variable's numbers to K by rows and b."""
    return _SYMMETRIC if symmetric else np.eye(12)


def nominal_of(raw: Array, numbers: Array) -> Array:
    """Calibrated vectors K raw + b, (n, 3), from raw (n, 3) and the rows of K and b (12,) or (n, 12)."""
    K, b = numbers[..., :9].reshape(*numbers.shape[:-1], 3, 3), numbers[..., 9:]
    return np.asarray(np.einsum("...ij,...j->...i", K, raw) + b)


def excess(raw: Array, sigma: Array, numbers: Array) -> Array:
    """Mean distance (n,) of noisy readings (n, 3) from the ellipsoid of K and b (12,), for noise sigma (n,).

    With f = |K raw + b| of gradient g and second derivatives H it is sigma^2 (tr H / (2 |g|) - g'Hg / |g|^3).
    """
    K, vectors = numbers[:9].reshape(3, 3), nominal_of(raw, numbers)
    length = np.linalg.norm(vectors, axis=1)
    g = vectors / length[:, None] @ K
    slope = np.linalg.norm(g, axis=1)
    curvature = (((g @ K.T) ** 2).sum(axis=1) - slope**4) / length
    return sagitta(raw, (sigma**2)[:, None, None] * np.eye(3), numbers) - sigma**2 * curvature / slope**3


def sagitta(raw: Array, scatter: Array, numbers: Array) -> Array:
    """Depth (n,) inside the ellipsoid of means (n, 3) of points on it with covariances (n, 3, 3).

    In the symbols of `excess` it is tr (H scatter) / (2 |g|).
    """
    K, vectors = numbers[:9].reshape(3, 3), nominal_of(raw, numbers)
    length = np.linalg.norm(vectors, axis=1)
    direction = vectors / length[:, None]
    turned = K @ scatter @ K.T
    along = np.einsum("ni,nij,nj->n", direction, turned, direction)
    curvature = (np.trace(turned, axis1=1, axis2=2) - along) / length
    return np.asarray(0.5 * curvature / np.linalg.norm(direction @ K, axis=1))


@dataclass(frozen=True)
class StrengthFactor(Model):
    """Length s of a vector measured in any attitude: |K raw + b - drift| = s.

    Blocks: triad (9 or 12), s (1) and, of a sensor whose offset has drivers, what these do (m), see `drifted`.

    The residual is how far raw is from the ellipsoid (Sampson's distance, |v| - s over its slope |K' v / |v||), and not
    how far |v| is from s: that would be less for a K that is too small, down to K = 0 and |b| = s.

    Attributes:
        time: (n,) s.
        raw: (n, 3).
        sigma: (n,) of raw, per axis.
        excess: (n,) by what the distance is more than 0 on average, see `excess`.
        symmetric: whether K is.
        drivers: (n, m) of the offset, see `drifted`; None: there are none.
    """

    time: Array
    raw: Array
    sigma: Array
    excess: Array
    symmetric: bool
    drivers: Array | None = None
    shapes: ClassVar = {"raw": (3,), "sigma": ()}
    rows: int = 1
    stacked: ClassVar = ("time", "raw", "sigma", "excess", "drivers")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: triad, strength and the drivers' effects."""
        return (9 if self.symmetric else 12, 1, *([] if self.drivers is None else [self.drivers.shape[1]]))

    def __call__(self, triads: Array, strength: Array, *drift: Array) -> Residuals:
        """Residual ((|v| - s) / |K' v / |v|| - excess) / sigma, (n, 1), v = K raw + b - drift."""
        triads = drifted(triads, self.drivers, drift)
        K, length, direction = _polar(self.raw, triads, self.symmetric)
        gradient = np.einsum("nij,ni->nj", K, direction)
        slope = np.maximum(np.linalg.norm(gradient, axis=1), _LEAST)
        distance = (length - strength[:, 0]) / slope
        weight = 1.0 / self.sigma

        def jacobians() -> tuple[Array, ...]:
            # The slope changes with K, and as the direction does.
            unit = gradient / slope[:, None]
            ahead = np.einsum("nij,nj->ni", K, unit)
            across = (ahead - (ahead * direction).sum(axis=1)[:, None] * direction) / length[:, None]
            of_length = _by_triad(direction - distance[:, None] * across, self.raw, self.symmetric)
            by_K = np.einsum("ni,nj->nij", distance[:, None] * direction, unit).reshape(-1, 9)
            of_slope = (by_K @ entries(self.symmetric)[:9])[:, None]
            scale = (weight / slope)[:, None]
            by_numbers = (of_length - of_slope) * scale[..., None]
            return by_numbers, -scale[..., None], *by_slope(by_numbers, self.drivers)

        return ((distance - self.excess) * weight)[:, None], jacobians

    def without_noise(self, triads: Array, strength: Array, *drift: Any) -> StrengthFactor:
        """Return the factor of the nearest readings on the ellipsoid, to first order in their distance from it.

        Where noise is, the slope is another one: the Jacobian at a reading and its residual are correlated.
        """
        K, length, direction = _polar(self.raw, drifted(triads, self.drivers, drift), self.symmetric)
        gradient = np.einsum("nij,ni->nj", K, direction)
        steps = (length - strength[:, 0]) / np.maximum((gradient**2).sum(axis=1), _LEAST)
        return replace(self, raw=self.raw - steps[:, None] * gradient)


@dataclass(frozen=True)
class DipFactor(Model):
    """Angle between two constant vectors, up and the field, measured together in any attitude: u . f = -sin dip.

    u and f have the directions of K raw + b of the accelerometer and of the magnetometer. Blocks: both triads (9 or 12
    each), dip (1; rad, the field's inclination, positive down) and what the accelerometer's drivers do (m), as of the
    length.

    Attributes:
        time: (n,) s.
        accel, mag: (n, 3) raw.
        sigma: (n,) of the product.
        symmetric: whether the K of accelerometer and magnetometer are.
        drivers: (n, m), of the accelerometer, as of the length.
    """

    time: Array
    accel: Array
    mag: Array
    sigma: Array
    symmetric: tuple[bool, bool]
    drivers: Array | None = None
    shapes: ClassVar = {"accel": (3,), "mag": (3,), "sigma": ()}
    rows: int = 1
    stacked: ClassVar = ("time", "accel", "mag", "sigma", "drivers")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: accelerometer, magnetometer, dip and the drivers' effects."""
        triads = (9 if symmetric else 12 for symmetric in self.symmetric)
        return (*triads, 1, *([] if self.drivers is None else [self.drivers.shape[1]]))

    def __call__(self, accel: Array, mag: Array, dip: Array, *drift: Array) -> Residuals:
        """Residual (u . f + sin dip) / sigma, (n, 1)."""
        accel = drifted(accel, self.drivers, drift)
        _, up_length, up = _polar(self.accel, accel, self.symmetric[0])
        _, field_length, field = _polar(self.mag, mag, self.symmetric[1])
        cosine = (up * field).sum(axis=1)
        weight = 1.0 / self.sigma[:, None]

        def jacobians() -> tuple[Array, ...]:
            across_up = (field - cosine[:, None] * up) / up_length[:, None] * weight
            across_field = (up - cosine[:, None] * field) / field_length[:, None] * weight
            by_up = _by_triad(across_up, self.accel, self.symmetric[0])
            return (
                by_up,
                _by_triad(across_field, self.mag, self.symmetric[1]),
                (np.cos(dip) * weight)[..., None],
                *by_slope(by_up, self.drivers),
            )

        return (cosine[:, None] + np.sin(dip)) * weight, jacobians


def drifted(triads: Array, drivers: Array | None, slopes: Sequence[Array]) -> Array:
    """Subtract the drivers' drift from b of triads (n, 9 or 12); unchanged without drivers.

    Drivers (n, m) are three to each cause, along the axes of b: a temperature three times, or squares of what is felt.
    What they do, the last of `slopes` (n, m), is in the unit of b for each of theirs.
    """
    if drivers is None:
        return triads
    drift = (drivers * slopes[-1]).reshape(len(drivers), -1, 3).sum(axis=1)
    return np.concatenate([triads[:, :-3], triads[:, -3:] - drift], axis=1)


def by_slope(by_triad: Array, drivers: Array | None) -> tuple[Array, ...]:
    """Jacobian by the drivers' effects, from that by the drifted triads (n, d, 9 or 12); empty without drivers."""
    if drivers is None:
        return ()
    return (-np.tile(by_triad[..., -3:], drivers.shape[1] // 3) * drivers[:, None],)


def _polar(raw: Array, triads: Array, symmetric: bool) -> tuple[Array, Array, Array]:
    """Matrix K (n, 3, 3) of triads, length (n,) and direction (n, 3) of the calibrated readings K raw + b."""
    numbers = triads @ entries(symmetric).T
    vectors = nominal_of(raw, numbers)
    length = np.maximum(np.linalg.norm(vectors, axis=1), _LEAST)
    return numbers[:, :9].reshape(-1, 3, 3), length, vectors / length[:, None]


def _by_triad(along: Array, raw: Array, symmetric: bool) -> Array:
    """Jacobian (n, 1, d) of the component of K raw + b along vectors (n, 3), by the triad variable."""
    by_rows = np.concatenate([np.einsum("ni,nj->nij", along, raw).reshape(-1, 9), along], axis=1)
    return (by_rows @ entries(symmetric))[:, None]
