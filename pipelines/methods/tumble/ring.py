"""What readings on a ring determine: a magnetometer turned about one axis, as on a car or a ship at the quay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array

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
    """Fit the ring of readings (n, 3) in time order; None if they are not planar or no ellipse fits."""
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
