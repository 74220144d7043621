"""Bundle adjustment of pictures of which some are better than others, without false detections.

A hand-held body is sharp in some pictures and blurred in others. Each picture has a variance of its own, distributed
about a common one, which makes the errors of a picture one draw of a multivariate t distribution (K. Lange, R. Little,
J. Taylor, "Robust statistical modeling using the t distribution", JASA 1989); its weights are found by iteration. How
the body moves in each picture, for shutters that roll, follows from its poses in the pictures before and after.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.vision.layout.bundle import Additional, adjusted
from alidade.pipelines.vision.layout.sights import Bundle, Index, Rows, Sights, linearized

# Degrees of freedom of the t distribution.
_NU = 4.0
_ROUNDS, _SETTLED = 12, 1e-3
# A tag in a picture whose corners miss by this many times the picture's sigma is a false detection.
_FAR = 4.0
_MEDIAN_OF_SEVEN = 6.35
# Pictures farther apart than this, s, have no information about each other's motion.
_APART = 0.25
# A polynomial is laid through so many pictures before and after, and through all within this time, s.
_BESIDE, _NEAR = 2, 0.12
_DEGREE = 4


@dataclass(frozen=True, eq=False)
class Fit:
    """Adjusted bundle with its residuals.

    Attributes:
        bundle: with all poses.
        sights: those used; sigma is that of the picture.
        rows: their errors, in these sigmas.
        weight: (f,) of the pictures, about 1; the inverse of their variance over the common one.
        sigma: of a corner in a common picture, in the sigmas given.
        sigma_px: of a corner in a common picture, per axis.
        whole: indices of the sights that were looked at, used or not, in a table of the caller's.
        additional: what was adjusted beside poses.
    """

    bundle: Bundle
    sights: Sights
    rows: Rows
    weight: Array
    sigma: float
    sigma_px: float
    whole: Index
    additional: Additional

    @property
    def curvature(self) -> Array:
        """Share (f,) of a picture's information that its weight leaves: less, since the weight follows the errors."""
        squares = np.bincount(self.sights.picture, self.rows.squares, len(self.weight))
        free = np.maximum(freedom(self.sights, len(self.weight)), 1.0)
        return np.asarray(np.maximum(1.0 - 2.0 * squares / ((_NU + free) * free), 0.1))

    @property
    def errors_px(self) -> Array:
        """Errors (m, 4, 2) of the sights used, px."""
        return self.rows.miss.reshape(-1, 4, 2) * self.sights.sigma[:, None, None]

    def rms_px(self, keep: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Root mean square error, px per axis, of some sights, with the weights of their pictures."""
        weight = self.weight[self.sights.picture][keep]
        return float(np.sqrt((weight * (self.errors_px**2).mean(axis=(1, 2))[keep]).sum() / weight.sum()))


def fitted(bundle: Bundle, sights: Sights, fixed: int, additional: Additional) -> Fit:
    """The most likely bundle; false detections are left out.

    Args:
        bundle: a start.
        sights: with sigmas that are right among each other.
        fixed: index of the tag that stays.
        additional: what is adjusted beside poses.
    """
    used = np.ones(len(sights), dtype=bool)
    # Where the start is it is not yet drawn to what is false.
    squares, sigma = linearized(bundle, sights).squares, None
    for _ in range(_ROUNDS):
        false = _false(sights[used], squares, sigma)
        if sigma is not None and not false.any():
            break
        used[np.flatnonzero(used)[false]] = False
        used[np.flatnonzero(used)[~sights[used].together]] = False
        fit = _reweighted(bundle, sights[used], fixed, additional)
        bundle, sigma = fit.bundle, fit.sigma
        squares = fit.rows.squares * (sigma**2 / fit.weight[fit.sights.picture])
    return replace(fit, whole=np.arange(len(sights)))


def _false(sights: Sights, squares: Array, sigma: float | None) -> NDArray[np.bool_]:
    """(m,) sights that miss by far more than the others of their picture."""
    if sigma is None:
        # The median of a chi-square of seven degrees of freedom; a picture's pose takes one or so of a tag's eight.
        sigma = float(np.sqrt(np.median(squares) / _MEDIAN_OF_SEVEN))
    count = np.bincount(sights.picture)[sights.picture]
    others = np.bincount(sights.picture, squares)[sights.picture] - squares
    # Of the picture without this tag, with what is known of pictures beforehand.
    variance = (_NU * sigma**2 + others) / (_NU + np.maximum(8.0 * (count - 1) - 6.0, 0.0))
    return np.asarray(squares > 8.0 * _FAR**2 * variance)


def _reweighted(bundle: Bundle, sights: Sights, fixed: int, additional: Additional) -> Fit:
    f, tags = len(bundle.cRb), len(bundle.body.ids)
    free = freedom(sights, f)
    shared = 6.0 * (tags - 1) + additional.free.sum()
    # The share of the tags in what a picture determines is theirs, not the noise's.
    free *= 1.0 - shared / max(free.sum(), shared + 1.0)
    sigma, weight = 1.0, np.ones(f)
    for _ in range(_ROUNDS):
        scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
        if additional.line_time.any():
            bundle = with_motion(bundle, np.unique(sights.picture))
        bundle, rows = adjusted(bundle, scaled, fixed, additional)
        squares = np.bincount(sights.picture, rows.squares, f) * sigma**2 / weight
        before, (sigma, weight) = sigma, _scale(squares, free)
        if abs(sigma / before - 1.0) < _SETTLED:
            break
    scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
    bundle, rows = adjusted(bundle, scaled, fixed, additional)
    sigma_px = sigma * float(np.median(sights.sigma))
    return Fit(bundle, scaled, rows, weight, sigma, sigma_px, np.arange(len(sights)), additional)


def freedom(sights: Sights, pictures: int) -> Array:
    """Degrees of freedom (f,) of a picture beyond the six of its pose."""
    return np.asarray(np.maximum(8.0 * np.bincount(sights.picture, minlength=pictures) - 6.0, 0.0))


def _scale(squares: Array, freedom: Array) -> tuple[float, Array]:
    """Common sigma and the weights (f,) of pictures with these sums of squares."""
    variance = float(squares.sum() / freedom.sum())
    for _ in range(200):
        weight = (_NU + freedom) / (_NU + squares / variance)
        before, variance = variance, float((weight * squares).sum() / freedom.sum())
        if abs(variance / before - 1.0) < 1e-6:
            break
    return float(np.sqrt(variance)), np.asarray((_NU + freedom) / (_NU + squares / variance))


def with_motion(bundle: Bundle, pictures: Index) -> Bundle:
    """The bundle with the motion that some of its pictures, by ascending time, show; in others nothing moves."""
    motion = np.zeros_like(bundle.motion)
    for run in _runs(bundle, pictures):
        time = bundle.time[run]
        place = np.arange(len(run))
        first = np.minimum(place - _BESIDE, np.searchsorted(time, time - _NEAR)).clip(0)
        last = np.maximum(place + _BESIDE, np.searchsorted(time, time + _NEAR) - 1).clip(max=len(run) - 1)
        for k, a, b in zip(place, first, last, strict=True):
            about = run[a : b + 1]
            turned = so3.log(so3.multiply(so3.inverse(bundle.cRb[run[k]]), bundle.cRb[about]))
            away = np.concatenate([turned, bundle.position[about]], axis=1)
            motion[run[k]] = _slope(time[a : b + 1] - time[k], away)
    return replace(bundle, motion=motion)


def _runs(bundle: Bundle, pictures: Index) -> list[Index]:
    """Pictures of one camera that follow each other closely."""
    gap, camera = np.diff(bundle.time[pictures]), bundle.camera[pictures]
    # Where a time is unknown, NaN, no comparison holds.
    close = (gap > 0.0) & (gap < _APART) & (camera[1:] == camera[:-1])
    return [run for run in np.split(pictures, np.flatnonzero(~close) + 1) if len(run) > 1]


def _slope(t: Array, values: Array) -> Array:
    """(6,) at t = 0 of polynomials of degree four, or as many as there are values (n, 6) for."""
    scale = np.abs(t).max()
    powers = (t / scale)[:, None] ** np.arange(min(_DEGREE + 1, len(t)))
    return np.asarray(np.linalg.lstsq(powers, values)[0][1] / scale)
