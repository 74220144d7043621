"""Covariance of an adjusted layout whose errors are correlated from picture to picture.

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
the information A S^-1 A + P. The adjustment, whose information is A + P, takes pictures for better than they are;
`correction` is the step from there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.vision.layout.bundle import Fit, free_columns, pose_steps, shared_rows
from alidade.pipelines.vision.layout.sights import Bundle, Index, Rows, Sights
from alidade.pipelines.vision.pose import SQUARE

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
        sigma: (c, n + 1) of the additional parameters, 0 of those that stay as they are.
        inflation: (n,) by what each tag's sigmas exceed those of independent corners.
        bend: sigma of a tag's corners against a flat square, as a share of its size.
        correction: (6 n + k,) what priors of these move yet, tags first; None where there are none.
    """

    whole: Array
    sigma: Array
    inflation: Array
    bend: float
    correction: Array | None


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
    white: Array = np.asarray(np.linalg.inv(information), dtype=float)
    bend, spread = bending(rows.miss, by_deformation, own, white)
    found = _sandwich(fit, own, view, white) + spread
    correction = None
    if additional.free.any():
        found, step = _with_priors(fit, information, found)
        correction = np.zeros(len(free))
        correction[free] = step
    inflation = np.ones(n)
    for tag in range(1, n):
        at = slice(6 * tag - 6, 6 * tag)
        inflation[tag] = np.sqrt(np.trace(np.linalg.solve(white[at, at], found[at, at])) / 6.0)
    sigma = np.zeros(additional.sigmas.size)
    sigma[additional.free] = np.sqrt(np.diag(found)[6 * n - 6 :])
    return Covariance(found, sigma.reshape(additional.sigmas.shape), inflation, bend, correction)


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
