"""The most likely layout of a body of tags and its covariance.

A hand-held body is sharp in some pictures and blurred in others. Each picture has a variance of its own, distributed
about a common one, which makes the errors of a picture one draw of a multivariate t distribution (K. Lange, R. Little,
J. Taylor, "Robust statistical modeling using the t distribution", JASA 1989); its weights are found by iteration. How
the body moves in each picture, for shutters that roll, follows from its poses in the pictures before and after.

A tag's corners err by what its print, its blur and the camera's model have wrong: nearly the same in the next picture,
and the more so in one in which nothing has moved. The layout errs by L r, L the influence of the whitened errors r, so
with autocovariance g of r its covariance is the sum over tags, views and lags of L' g(lag) L, as for noise coloured in
time (alidade.pipelines.solvers.error_budget). g is that of the errors left, all tags together, up to the lag where it
has died out; tags that fit worse than the others have a variance of their own. What stays the same in all pictures of a
tag is not in it.

A printed tag on a cube is not flat, nor is it quite square: in all its pictures its corners err alike, which neither
their noise nor its correlation from picture to picture accounts for. What they are off by that no pose takes up has one
sigma for all tags, as a share of their size, the most likely one. It is not adjusted but counted in the sigmas of the
layout: adjusted, it takes up errors of another kind too, and halves of real recordings then agree less well.

Priors of additional parameters are weighed against such errors, not against independent ones: with the information A
of independent errors, of which the gradient has covariance S, and that of the priors P, the best linear estimate has
the information A S^-1 A + P. The adjustment, whose information is A + P, takes pictures for better than they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.pipelines.vision.layout.bundle import (
    Additional,
    Bundle,
    Rows,
    Sights,
    adjusted,
    free_columns,
    linearized,
    pose_steps,
    shared_rows,
)
from alidade.pipelines.vision.pose import SQUARE

# Degrees of freedom of the t distribution.
_NU = 4.0
_ROUNDS, _SIGMA_SETTLED = 12, 1e-3
# A tag in a picture whose corners miss by this many times the picture's sigma is a false detection.
_FAR = 4.0
_MEDIAN_OF_SEVEN = 6.35
# Pictures farther apart than this, s, have no information about each other's motion.
_APART = 0.25
# A polynomial is laid through so many pictures before and after, and through all within this time, s.
_BESIDE, _NEAR = 2, 0.12
_DEGREE = 4
# A correlation within this many of its sigmas of zero has died out; the first one is asked to be beyond more of them.
_DIED_OUT, _COLOURED = 2.0, 4.0
# Numbers seen again where nothing moved, from which on their common error is estimated.
_FEWEST = 100
# A tag's variance beyond the common one by this many of its sigmas is its own.
_CLEARLY = 2.0
# Of a tag's sum of squares, what the adjustment leaves at least.
_LEAST_LEFT = 0.1
# Of the views, the longest lag.
_LONGEST = 0.25
# Of the variance of independent errors, what correlated ones have at least, so that it has an inverse.
_LEAST_VARIANCE = 1e-6
# What paper is like, of a corner each way, and how well that is known, in the logarithm.
_PAPER, _ROUGHLY = 2e-3, 2.0
_LEVELS = np.geomspace(1e-5, 3e-2, 400)
# Information below this share of the largest is rounding.
_ROUNDING = 1e-9


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
        """Ratio (f,) of a picture's true to its weighted information: below 1, as weights depend on errors."""
        squares = np.bincount(self.sights.picture, self.rows.squares, len(self.weight))
        free = np.maximum(freedom(self.sights, len(self.weight)), 1.0)
        return np.asarray(np.maximum(1.0 - 2.0 * squares / ((_NU + free) * free), 0.1))

    def rms_px(self, keep: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Weighted root mean square reprojection error of some sights, px per axis."""
        weight, squares = self.weight[self.sights.picture], self.sights.sigma**2 * self.rows.squares / 8.0
        return float(np.sqrt((weight * squares)[keep].sum() / weight[keep].sum()))


def fitted(bundle: Bundle, sights: Sights, whole: Index, additional: Additional) -> Fit:
    """Adjust the bundle by maximum likelihood and reject false detections; the first tag stays.

    Args:
        bundle: a start.
        sights: with sigmas that are right among each other.
        whole: which of them are looked at.
        additional: what is adjusted beside poses.
    """
    sights, used = sights[whole], np.ones(len(whole), dtype=bool)
    # Where the start is it is not yet drawn to what is false.
    squares, sigma = linearized(bundle, sights).squares, None
    for _ in range(_ROUNDS):
        false = _false(sights[used], squares, sigma)
        if sigma is not None and not false.any():
            break
        used[np.flatnonzero(used)[false]] = False
        used[np.flatnonzero(used)[~sights[used].together]] = False
        fit = _reweighted(bundle, sights[used], whole, additional)
        bundle, sigma = fit.bundle, fit.sigma
        squares = fit.rows.squares * (sigma**2 / fit.weight[fit.sights.picture])
    return fit


def _false(sights: Sights, squares: Array, sigma: float | None) -> NDArray[np.bool_]:
    """Mask (m,) of false detections: sights with far larger errors than the others in the same picture."""
    if sigma is None:
        # The median of a chi-square of seven degrees of freedom; a picture's pose takes one or so of a tag's eight.
        sigma = float(np.sqrt(np.median(squares) / _MEDIAN_OF_SEVEN))
    count = np.bincount(sights.picture)[sights.picture]
    others = np.bincount(sights.picture, squares)[sights.picture] - squares
    # Of the picture without this tag, with what is known of pictures beforehand.
    variance = (_NU * sigma**2 + others) / (_NU + np.maximum(8.0 * (count - 1) - 6.0, 0.0))
    return np.asarray(squares > 8.0 * _FAR**2 * variance)


def _reweighted(bundle: Bundle, sights: Sights, whole: Index, additional: Additional) -> Fit:
    f, tags = len(bundle.cRb), len(bundle.body.ids)
    free = freedom(sights, f)
    shared = 6.0 * (tags - 1) + additional.free.sum()
    # The share of the tags in what a picture determines is theirs, not the noise's.
    free *= 1.0 - shared / max(free.sum(), shared + 1.0)
    sigma, weight = 1.0, np.ones(f)
    for _ in range(_ROUNDS):
        scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
        if additional.sigmas[:, -1].any():
            bundle = with_motion(bundle, np.unique(sights.picture))
        bundle, rows = adjusted(bundle, scaled, 0, additional)
        squares = np.bincount(sights.picture, rows.squares, f) * sigma**2 / weight
        before, (sigma, weight) = sigma, _scale(squares, free)
        if abs(sigma / before - 1.0) < _SIGMA_SETTLED:
            break
    scaled = replace(sights, sigma=sights.sigma * sigma / np.sqrt(weight[sights.picture]))
    bundle, rows = adjusted(bundle, scaled, 0, additional)
    sigma_px = sigma * float(np.median(sights.sigma))
    return Fit(bundle, scaled, rows, weight, sigma, sigma_px, whole, additional)


def freedom(sights: Sights, pictures: int) -> Array:
    """Degrees of freedom (f,) of each picture: eight per tag minus six for the pose, at least 0."""
    return np.asarray(np.maximum(8.0 * np.bincount(sights.picture, minlength=pictures) - 6.0, 0.0))


def _scale(squares: Array, freedom: Array) -> tuple[float, Array]:
    """Common sigma and picture weights (f,) by Student's t, from sums of squares and degrees of freedom."""
    variance = float(squares.sum() / freedom.sum())
    for _ in range(200):
        weight = (_NU + freedom) / (_NU + squares / variance)
        before, variance = variance, float((weight * squares).sum() / freedom.sum())
        if abs(variance / before - 1.0) < 1e-6:
            break
    return float(np.sqrt(variance)), np.asarray((_NU + freedom) / (_NU + squares / variance))


def with_motion(bundle: Bundle, pictures: Index) -> Bundle:
    """Estimate the motion during given pictures (in ascending time) from their neighbours; others get zero."""
    motion = np.zeros_like(bundle.motion)
    for run in _runs(bundle, pictures):
        time = bundle.time[run]
        place = np.arange(len(run))
        first = np.minimum(place - _BESIDE, np.searchsorted(time, time - _NEAR)).clip(0)
        last = np.maximum(place + _BESIDE, np.searchsorted(time, time + _NEAR) - 1).clip(max=len(run) - 1)
        for k, a, b in zip(place, first, last, strict=True):
            about = run[a : b + 1]
            turned = so3.local(bundle.cRb[run[k]], bundle.cRb[about])
            away = np.concatenate([turned, bundle.position[about]], axis=1)
            motion[run[k]] = _slope(time[a : b + 1] - time[k], away)
    return replace(bundle, motion=motion)


def _runs(bundle: Bundle, pictures: Index) -> list[Index]:
    """Runs of consecutive pictures of one camera with short gaps in time."""
    gap, camera = np.diff(bundle.time[pictures]), bundle.camera[pictures]
    # Where a time is unknown, NaN, no comparison holds.
    close = (gap > 0.0) & (gap < _APART) & (camera[1:] == camera[:-1])
    return [run for run in np.split(pictures, np.flatnonzero(~close) + 1) if len(run) > 1]


def _slope(t: Array, values: Array) -> Array:
    """Derivative (6,) at t = 0 of the polynomials, of degree four at most, that fit values (n, 6)."""
    scale = np.abs(t).max()
    powers = (t / scale)[:, None] ** np.arange(min(_DEGREE + 1, len(t)))
    return np.asarray(np.linalg.lstsq(powers, values)[0][1] / scale)


def _deformations() -> Array:
    """Unit deformations (6, 4, 3) of a tag: size, height over width, shear, keystone along x and y, twist.

    With the six numbers of a pose these are all that four corners may be off by.
    """
    x, y = SQUARE[:, 0], SQUARE[:, 1]
    out = np.zeros((6, 4, 3))
    out[0, :, 0], out[0, :, 1] = x, y
    out[1, :, 0], out[1, :, 1] = -x, y
    out[2, :, 0], out[2, :, 1] = y, x
    out[3, :, 0] = out[4, :, 1] = out[5, :, 2] = x * y
    return np.asarray(out / np.linalg.norm(out, axis=(1, 2), keepdims=True))


DEFORMATIONS = _deformations()


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of a layout and of its additional parameters.

    Attributes:
        whole: (q, q) of all tags after the first, rad and m, and of all additional parameters that are adjusted.
        inflation: (n,) by what each tag's sigmas exceed those of independent corners.
        bend: sigma of a tag's corners against a flat square, as a share of its size.
        step: (q,) from the adjustment to the best linear estimate.
    """

    whole: Array
    inflation: Array
    bend: float
    step: Array


def covariance(fit: Fit, view: Index) -> Covariance:
    """Compute the covariance of an adjusted bundle.

    Args:
        fit: the bundle.
        view: (f,) pictures in a row in which nothing moved have the same number, ascending.
    """
    bundle, sights, rows, additional = fit.bundle, fit.sights, fit.rows, fit.additional
    n, of_tags, free = len(bundle.body.ids), bend_rows(bundle, sights, rows), free_columns(bundle, 0, additional)
    J = shared_rows(bundle, sights, rows, additional)[..., free]
    deformed = np.zeros((len(sights), 8, n, len(DEFORMATIONS)))
    deformed[np.arange(len(sights)), :, sights.tag] = of_tags
    columns = np.concatenate([J, deformed.reshape(len(sights), 8, -1)], axis=2)
    poses, _ = pose_steps(bundle, sights, rows, columns, np.ones(len(sights)))
    own, by_deformation = np.split(columns - rows.by_picture @ poses[sights.picture], [J.shape[2]], axis=2)
    # Weights that a picture's tags have in common leave open what its pose takes up.
    information = np.tensordot(fit.curvature[sights.picture, None, None] * J, own, ((0, 1), (0, 1)))
    priors = np.arange(J.shape[2] - additional.free.sum(), J.shape[2])
    information[priors, priors] += additional.precision
    diagonal = np.arange(len(information))
    # A tag of which nothing is left is where it was, as in the adjustment.
    information[diagonal, diagonal] += information[diagonal, diagonal] == 0.0
    white: Array = np.asarray(np.linalg.inv(information), dtype=float)
    bend, spread = bending(rows.miss, by_deformation, own, white)
    found, step = _with_priors(fit, information, _sandwich(fit, own, view, white) + spread)
    inflation = np.ones(n)
    for tag in range(1, n):
        at = slice(6 * tag - 6, 6 * tag)
        inflation[tag] = np.sqrt(np.trace(np.linalg.solve(white[at, at], found[at, at])) / 6.0)
    return Covariance(found, inflation, bend, step)


def _with_priors(fit: Fit, information: Array, found: Array) -> tuple[Array, Array]:
    """Covariance (q, q) and step (q,) of the optimal estimate given the additional parameters' priors.

    Args:
        fit: adjusted with independent errors.
        information: (q, q) of that, A + P.
        found: (q, q) covariance of its errors but for what the priors bring, (A + P)^-1 S (A + P)^-1.
    """
    additional = fit.additional
    q, precision = len(information), additional.precision
    prior, right = np.zeros((2, q))
    prior[q - len(precision) :] = precision
    right[q - len(precision) :] = precision * additional.off(fit.bundle)
    # In units of A + P, which is positive definite even where pictures alone have no information.
    L = np.linalg.cholesky(information)
    back = np.linalg.inv(L)
    P = back * prior @ back.T
    A, S = np.eye(q) - P, L.T @ found @ L + _LEAST_VARIANCE * np.eye(q)
    weighed = A @ np.linalg.inv(S)
    covariance = np.linalg.inv(weighed @ A + P)
    step = -covariance @ ((np.eye(q) - weighed) @ (back @ right))
    return np.asarray(back.T @ covariance @ back), np.asarray(back.T @ step)


def _sandwich(fit: Fit, own: Array, view: Index, white: Array) -> Array:
    """Sandwich covariance (q, q) of the shared unknowns, from the influence of every corner error."""
    bundle, sights = fit.bundle, fit.sights
    of, views = view[sights.picture], int(view.max()) + 1
    power, common = _spectrum(_correlations(fit, of, views), views), _common_share(fit, of)
    precision = fit.additional.precision
    of_priors = white[:, len(white) - len(precision) :]
    parts, taken = [], []
    for tag in range(len(bundle.body.ids)):
        mine = sights.tag == tag
        dense = np.zeros((views, 8, len(white)))
        np.add.at(dense, of[mine], own[mine])
        waves = np.fft.rfft(dense, 2 * views, axis=0)
        square = common * np.einsum("w,wia,wib->ab", power, waves.conj(), waves, optimize=True).real
        square += (1.0 - common) * np.einsum("mia,mib->ab", own[mine], own[mine], optimize=True)
        parts.append(white @ square @ white)
        taken.append(2.0 * float((white * square).sum()))
    spread = np.sum(parts, axis=0) + (of_priors * precision) @ of_priors.T
    left = np.einsum("mia,ab,mib->m", own, spread, own, optimize=True)
    variance = _variances(fit, np.array(taken) - np.bincount(sights.tag, left, len(taken)))
    return np.asarray(np.einsum("t,tab->ab", variance, np.array(parts)))


def _correlations(fit: Fit, of: Index, views: int) -> Array:
    """Autocorrelation of corner errors over views, at lags 1, 2, ... until it vanishes."""
    tags = len(fit.bundle.body.ids)
    mean, count = np.zeros((tags, views, 8)), np.zeros((tags, views))
    np.add.at(mean, (fit.sights.tag, of), fit.rows.miss)
    np.add.at(count, (fit.sights.tag, of), 1.0)
    mean /= np.maximum(count, 1.0)[..., None]
    there = count > 0.0
    square = float((mean**2).sum() / (8.0 * there.sum()))
    found: list[float] = []
    for lag in range(1, int(_LONGEST * views) + 1):
        pairs = 8.0 * float((there[:, lag:] & there[:, :-lag]).sum())
        if not pairs:
            break
        correlation = float((mean[:, lag:] * mean[:, :-lag]).sum()) / (pairs * square)
        if correlation < (_DIED_OUT if found else _COLOURED) * pairs**-0.5:
            break
        found.append(correlation)
    return np.array(found)


def _common_share(fit: Fit, of: Index) -> float:
    """Share of the error variance common to pictures without motion between them; 1 if there are too few."""
    order = np.lexsort((fit.sights.picture, fit.sights.tag))
    tag, view, miss = fit.sights.tag[order], of[order], fit.rows.miss[order]
    next_ = (tag[1:] == tag[:-1]) & (view[1:] == view[:-1])
    if 8 * next_.sum() < _FEWEST:
        return 1.0
    a, b = miss[1:][next_], miss[:-1][next_]
    return float(np.clip(2.0 * (a * b).sum() / (a**2 + b**2).sum(), 0.0, 1.0))


def _spectrum(correlations: Array, views: int) -> Array:
    """Non-negative spectral weights (views + 1,) of the autocorrelation, for `rfft` over twice the views."""
    g = np.zeros(2 * views)
    g[0] = 1.0
    g[1 : len(correlations) + 1] = correlations
    g[len(g) - len(correlations) :] = correlations[::-1]
    power = np.maximum(np.fft.rfft(g).real, 0.0)
    # A wave and its conjugate are one here, but for the first and the last.
    power[1:-1] *= 2.0
    return np.asarray(power / (2 * views))


def _variances(fit: Fit, taken: Array) -> Array:
    """Variance (n,) of each tag's errors relative to the pictures' sigmas; 1 where not significantly larger.

    `taken` (n,) is what the adjustment of all that pictures share takes from a tag's sum of squares: of correlated
    errors more than of independent ones.
    """
    tags = len(fit.bundle.body.ids)
    shown = np.bincount(fit.sights.picture)[fit.sights.picture]
    free = np.bincount(fit.sights.tag, 8.0 - 6.0 / shown, tags)
    left = np.maximum(free - taken, _LEAST_LEFT * free)
    found = np.bincount(fit.sights.tag, fit.rows.squares, tags) / left
    return np.asarray(np.where(found > 1.0 + _CLEARLY * np.sqrt(2.0 / left), found, 1.0))


def bend_rows(bundle: Bundle, sights: Sights, rows: Rows) -> Array:
    """Jacobian (m, 8, 6) of the errors by each tag's deformations along `DEFORMATIONS`, in tag sizes."""
    m = len(sights)
    by_corner = rows.by_tag[..., 3:].reshape(m, 4, 2, 3) @ so3.matrix(bundle.body.bRt[sights.tag])[:, None]
    by_deformation = np.einsum("mkij,bkj,m->mkib", by_corner, DEFORMATIONS, bundle.body.size[sights.tag])
    return by_deformation.reshape(m, 8, len(DEFORMATIONS))


def bending(miss: Array, by_deformation: Array, own: Array, white: Array) -> tuple[float, Array]:
    """Most likely sigma of a printed corner along x and y, in tag sizes, and the resulting covariance (q, q).

    Errors are linear in the deformations x, and x in their gradient g = J x, J the information on x with all else
    eliminated: along the axes of J a component of g has the variance l + l^2 level^2, l its information.

    Args:
        miss: (m, 8) errors of the adjusted bundle.
        by_deformation: (m, 8, 6 n) with the pictures' poses eliminated.
        own: (m, 8, q) likewise, by all that is adjusted and that pictures share.
        white: (q, q) covariance of these, were errors independent.
    """
    across = np.tensordot(own, by_deformation, ((0, 1), (0, 1)))
    moved = white @ across
    J = np.tensordot(by_deformation, by_deformation, ((0, 1), (0, 1))) - across.T @ moved
    information, axes = np.linalg.eigh(J)
    gradient = axes.T @ np.tensordot(by_deformation, miss, ((0, 1), (0, 1)))
    known = information > _ROUNDING * information.max()
    variance = information[known] + (information[known] * _LEVELS[:, None]) ** 2
    unlikely = (np.log(variance) + gradient[known] ** 2 / variance).sum(axis=1)
    level = float(_LEVELS[(unlikely + (np.log(_LEVELS / _PAPER) / _ROUGHLY) ** 2).argmin()])
    return level, level**2 * np.asarray(moved @ moved.T)
