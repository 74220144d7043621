"""First guess of a triad: the likeliest ellipsoid near its readings, with the prior where they determine nothing.

Readings of a rotation about one axis, as on a car or a ship at the quay, lie on a ring and determine part of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array
from alidade.factors.ellipsoid import StrengthFactor, entries
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods.tumble.published import FEWEST, Ellipsoid, ellipsoid

# Prior sigma of entries of K over their size, against a sensor on the body's axes; of b over the strength: an
# accelerometer in SI is near zero, hard iron and offsets of counts have no limit.
GAIN, ACCEL_OFFSET, OFFSET = 0.3, 0.2, 10.0
# Of a guess: sigma of entries of K over their size, noise of a reading over the radius; readings that are looked at.
_LIKELY, _NOISE, _READINGS = 0.2, 2e-2, 1000
# Samples this many sigmas from the ellipsoid are left out of an algebraic fit.
_FAR, _ROUNDS = 5.0, 5
# Readings farther from their median than this many times the median distance are outliers, or most are of one attitude:
# of readings spread evenly over a sphere, a cap or a ring the farthest is less than twice as far as half of them.
_DISTANT = 4.0
# Noise of a sample over the radius of the ellipsoid. Through a cloud of Gaussian noise that is the mean length in it,
# about which lengths scatter by (3 pi / 8 - 1)^.5 = .42 of it; half of that, which no sensor has, is no ellipsoid.
CLOUD = 0.21
_UNIT = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


def first_guess(raw: Array, strength: float | None, offset: float) -> tuple[Array, Array]:
    """Estimate S and centre of the most likely ellipsoid |S (raw - centre)| = 1.

    It is fitted to all readings and, where some are distant, without these; the fit that most readings are near counts.

    Args:
        raw: (n, 3) readings.
        strength: in their unit, of a sensor whose K is about 1; None: unknown, the radius of the nearest sphere.
        offset: prior sigma of b over the strength.
    """
    away = np.linalg.norm(raw - np.median(raw, axis=0), axis=1)
    near = away <= _DISTANT * np.median(away)
    whole = _fitted(raw, strength, offset)
    if near.all() or near.sum() < FEWEST:
        return whole
    trimmed = _fitted(raw[near], strength, offset)
    radius = float(np.linalg.det(trimmed[0])) ** (-1.0 / 3.0)
    if robust_sigma(_distances(raw[near], *trimmed)) > CLOUD * radius:
        return whole
    # Cauchy's loss: what outliers cost hardly grows with their distance.
    costs = [np.log1p((_distances(raw, *each) / (_NOISE * radius)) ** 2).sum() for each in (whole, trimmed)]
    return whole if costs[0] < costs[1] else trimmed


def _distances(raw: Array, S: Array, centre: Array) -> Array:
    """Distances (n,) of readings (n, 3) from an ellipsoid, to first order."""
    vectors = (raw - centre) @ S.T
    lengths = np.maximum(np.linalg.norm(vectors, axis=1), np.finfo(float).tiny)
    return np.asarray((lengths - 1.0) * lengths / np.linalg.norm(vectors @ S, axis=1))


def _fitted(raw: Array, strength: float | None, offset: float) -> tuple[Array, Array]:
    """Fit S and centre with their prior; the starts are the algebraic ellipsoid and spheres.

    Readings on a ring determine only some of the nine numbers; the others are the prior's.
    """
    from scipy.optimize import least_squares

    centre, radius = _sphere(raw)
    unit = strength or radius
    x = raw[:: max(1, len(raw) // _READINGS)] / unit
    ones = np.ones(len(x))
    factor = StrengthFactor(ones, x, _NOISE * ones, 0.0 * ones, symmetric=True)
    mean, sigma = np.append(_UNIT, np.zeros(3)), np.repeat([_LIKELY, offset], [6, 3])

    def residuals(numbers: Array) -> Array:
        return np.append(factor(np.tile(numbers, (len(x), 1)), ones[:, None])[0][:, 0], (numbers - mean) / sigma)

    def jacobian(numbers: Array) -> Array:
        by_numbers = factor(np.tile(numbers, (len(x), 1)), ones[:, None])[1]()[0][:, 0]
        return np.vstack([by_numbers, np.diag(1.0 / sigma)])

    starts = [np.append(_UNIT, -each / unit) for each in _centres(raw, centre, radius, strength)]
    if (found := _inliers_ellipsoid(raw)) is not None:
        S = unit * found.S
        starts.append(np.append(S[np.triu_indices(3)], -S @ found.centre / unit))
    fits = [least_squares(residuals, start, jacobian, loss="soft_l1", max_nfev=50) for start in starts]
    likeliest = entries(True) @ min(fits, key=lambda fit: float(fit.cost)).x
    S = likeliest[:9].reshape(3, 3)
    # Lengths stay where S is replaced by the positive root of its square.
    sizes, vt = np.linalg.svd(S)[1:]
    return vt.T @ np.diag(sizes) @ vt / unit, -unit * np.linalg.solve(S, likeliest[9:])


def _centres(raw: Array, centre: Array, radius: float, strength: float | None) -> list[Array]:
    """Candidate centres of a sphere: the fitted one, two of known radius through the readings' ring, and zero."""
    if strength is None:
        return [centre]
    spread = raw - raw.mean(axis=0)
    normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    away = np.sqrt(max(strength**2 - radius**2, 0.0)) * normal
    return [centre, centre - away, centre + away, np.zeros(3)]


def _inliers_ellipsoid(raw: Array) -> Ellipsoid | None:
    """Fit an algebraic ellipsoid robustly, by repeated rejection of distant readings."""
    kept, last = np.ones(len(raw), dtype=bool), None
    for _ in range(_ROUNDS):
        found = ellipsoid(raw[kept])
        if found is None:
            return last
        last = found
        misses = np.abs(np.linalg.norm((raw - found.centre) @ found.S.T, axis=1) - 1.0)
        near = misses < _FAR * max(robust_sigma(misses), 1e-9)
        if (near == kept).all() or near.sum() < FEWEST:
            break
        kept = near
    return last


def _sphere(raw: Array) -> tuple[Array, float]:
    """Centre and radius of the sphere fitted to readings (n, 3); the minimum-norm solution if not unique."""
    origin, unit = raw.mean(axis=0), max(float(raw.std()), np.finfo(float).tiny)
    scaled = (raw - origin) / unit
    design = np.column_stack([2.0 * scaled, np.ones(len(raw))])
    solution = np.linalg.lstsq(design, (scaled**2).sum(axis=1), rcond=1e-3)[0]
    radius = unit * float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 1e-6)))
    return origin + unit * solution[:3], radius


# Readings leave the ring's plane by less than this share of their scatter along it: 6 deg.
_FLAT = 0.1
# Parts of a recording that are left out one after the other: errors of a fit are alike over seconds.
_PARTS = 10


@dataclass(frozen=True, eq=False)
class Ring:
    """Ellipse through the readings of a rotation about one axis.

    Attributes:
        axis: (3,) unit vector along it, in the sensor's axes.
        centre: (3,) of the ellipse, in the unit of the readings: across the axis it is the hard iron.
        sigma: of that across the axis, jackknife over parts of the recording.
        ratio: longest over shortest axis of the ellipse.
    """

    axis: Array
    centre: Array
    sigma: float
    ratio: float


def ring(raw: Array) -> Ring | None:
    """Fit an ellipse to readings (n, 3) of a triad turned about one axis, in time order; None where none fits."""
    middle = raw.mean(axis=0)
    sizes, axes = np.linalg.svd(raw - middle, full_matrices=False)[1:]
    if sizes[2] > _FLAT * sizes[1]:
        return None
    flat = (raw - middle) @ axes[:2].T
    every = np.arange(len(flat))
    fits = [_ellipse(np.delete(flat, part, axis=0)) for part in (every[:0], *np.array_split(every, _PARTS))]
    known = np.array([fit for fit in fits if fit is not None])
    if len(known) < len(fits):
        return None
    centre = middle + known[0, :2] @ axes[:2]
    sigma = float(np.sqrt((_PARTS - 1) * known[1:, :2].var(axis=0).mean()))
    return Ring(axes[2], centre, sigma, float(known[0, 2]))


def _ellipse(flat: Array) -> Array | None:
    """Centre (2) and ratio of the axes of the ellipse through points (n, 2), by linear least squares."""
    unit = max(float(flat.std()), np.finfo(float).tiny)
    x, y = flat.T / unit
    design = np.stack([x * x, 2.0 * x * y, y * y, 2.0 * x, 2.0 * y], axis=1)
    (xx, xy, yy, u, v), _, rank, _ = np.linalg.lstsq(design, np.ones(len(x)))
    Q = np.array([[xx, xy], [xy, yy]])
    sizes = np.linalg.eigvalsh(Q)
    if rank < len(design.T) or sizes[0] <= 0.0:
        return None
    return np.append(-unit * np.linalg.solve(Q, [u, v]), np.sqrt(sizes[1] / sizes[0]))
