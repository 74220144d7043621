"""Covariance of an adjusted layout whose errors are correlated from picture to picture.

A tag's corners err by what its print, its blur and the camera's model have wrong: nearly the same in the next picture,
and the more so in one in which nothing has moved. The layout errs by L r, L the influence of the whitened errors r, so
with autocovariance g of r its covariance is the sum over tags, views and lags of L' g(lag) L, as for noise coloured in
time (pipelines.solvers.coloured). g is that of the errors left, all tags together, up to the lag where it has died out;
tags that fit worse than the others have a variance of their own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.vision.layout.normal import normal_equations, shared_rows
from pipelines.vision.layout.robust import Fit
from pipelines.vision.layout.sights import Array, Index

# A correlation within this many of its sigmas of zero has died out; the first one is asked to be beyond more of them.
_DIED_OUT, _COLOURED = 2.0, 4.0
# Numbers seen again where nothing moved, from which on they tell what they have in common.
_FEWEST = 100
# A tag's variance beyond the common one by this many of its sigmas is its own.
_CLEARLY = 2.0
# Of a tag's sum of squares, what the adjustment leaves at least.
_LEAST_LEFT = 0.1
# Of the views, the longest lag.
_LONGEST = 0.25


@dataclass(frozen=True, eq=False)
class Covariance:
    """What is known of a layout.

    Attributes:
        tags: (6 (n - 1), 6 (n - 1)), of all tags but the fixed one, rad and m.
        cameras: (c, k) sigmas of the cameras' intrinsics; None where they are as given.
        inflation: (n,) by what each tag's sigmas exceed those of independent corners.
    """

    tags: Array
    cameras: Array | None
    inflation: Array


def covariance(fit: Fit, fixed: int, view: Index) -> Covariance:
    """Covariance of an adjusted bundle.

    Args:
        fit: the bundle.
        fixed: index of the tag that stays.
        view: (f,) pictures in a row in which nothing moved have the same number, ascending.
    """
    bundle, sights, rows = fit.bundle, fit.sights, fit.rows
    curved = fit.curvature[sights.picture]
    information = normal_equations(bundle, sights, rows, curved, fixed, fit.cameras).information
    white: Array = np.asarray(np.linalg.inv(information), dtype=float)
    found = _sandwich(fit, fixed, view, white)
    n, tags = len(bundle.body.ids), 6 * (len(bundle.body.ids) - 1)
    inflation = np.ones(n)
    for k, tag in enumerate(np.flatnonzero(np.arange(n) != fixed)):
        at = slice(6 * k, 6 * k + 6)
        inflation[tag] = np.sqrt(np.trace(np.linalg.solve(white[at, at], found[at, at])) / 6.0)
    cameras: Array | None = None
    if fit.cameras.free.any():
        cameras = np.zeros(fit.cameras.sigma.shape)
        cameras[fit.cameras.sigma > 0.0] = np.sqrt(np.diag(found)[tags:])
    return Covariance(found[:tags, :tags], cameras, inflation)


def _sandwich(fit: Fit, fixed: int, view: Index, white: Array) -> Array:
    """(q, q) covariance of all that pictures share, from the influence of every error."""
    bundle, sights, rows = fit.bundle, fit.sights, fit.rows
    normal = normal_equations(bundle, sights, rows, np.ones(len(sights)), fixed, fit.cameras)
    by_pose = (normal.inverse @ normal.across)[sights.picture]
    shared = shared_rows(bundle, sights, rows, fit.cameras)[..., normal.free]
    own = shared - rows.by_picture @ by_pose
    of, views = view[sights.picture], int(view.max()) + 1
    power, common = _spectrum(_correlations(fit, of, views), views), _common(fit, of)
    # Priors of cameras are information that no error brought.
    free = fit.cameras.sigma.ravel()[fit.cameras.free]
    prior = white[:, len(white) - len(free) :]
    parts, taken = [(prior * free**-2.0) @ prior.T], []
    for tag in range(len(bundle.body.ids)):
        mine = sights.tag == tag
        dense = np.zeros((views, 8, len(white)))
        np.add.at(dense, of[mine], own[mine])
        waves = np.fft.rfft(dense, 2 * views, axis=0)
        square = common * np.einsum("w,wia,wib->ab", power, waves.conj(), waves, optimize=True).real
        square += (1.0 - common) * np.einsum("mia,mib->ab", own[mine], own[mine], optimize=True)
        parts.append(white @ square @ white)
        taken.append(2.0 * float((white * square).sum()))
    left = np.einsum("mia,ab,mib->m", own, np.sum(parts, axis=0), own, optimize=True)
    variance = _variances(fit, np.array(taken) - np.bincount(sights.tag, left, len(taken)))
    return np.asarray(parts[0] + np.einsum("t,tab->ab", variance, np.array(parts[1:])))


def _correlations(fit: Fit, of: Index, views: int) -> Array:
    """Correlation of a corner's error with its own so many views later, from 1 on until it has died out."""
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


def _common(fit: Fit, of: Index) -> float:
    """The share of the variance that pictures in which nothing moved have in common; 1 where there are too few."""
    order = np.lexsort((fit.sights.picture, fit.sights.tag))
    tag, view, miss = fit.sights.tag[order], of[order], fit.rows.miss[order]
    next_ = (tag[1:] == tag[:-1]) & (view[1:] == view[:-1])
    if 8 * next_.sum() < _FEWEST:
        return 1.0
    a, b = miss[1:][next_], miss[:-1][next_]
    return float(np.clip(2.0 * (a * b).sum() / (a**2 + b**2).sum(), 0.0, 1.0))


def _spectrum(correlations: Array, views: int) -> Array:
    """Weights (views + 1,) of the waves of `rfft` over twice the views, none negative."""
    g = np.zeros(2 * views)
    g[0] = 1.0
    g[1 : len(correlations) + 1] = correlations
    g[len(g) - len(correlations) :] = correlations[::-1]
    power = np.maximum(np.fft.rfft(g).real, 0.0)
    # A wave and its conjugate are one here, but for the first and the last.
    power[1:-1] *= 2.0
    return np.asarray(power / (2 * views))


def _variances(fit: Fit, taken: Array) -> Array:
    """(n,) variance of each tag's errors over what their pictures' sigmas say; 1 where it is not clearly more.

    `taken` (n,) is what the adjustment of all that pictures share takes from a tag's sum of squares: of correlated
    errors more than of independent ones.
    """
    tags = len(fit.bundle.body.ids)
    shown = np.bincount(fit.sights.picture)[fit.sights.picture]
    free = np.bincount(fit.sights.tag, 8.0 - 6.0 / shown, tags)
    left = np.maximum(free - taken, _LEAST_LEFT * free)
    found = np.bincount(fit.sights.tag, fit.rows.squares, tags) / left
    return np.asarray(np.where(found > 1.0 + _CLEARLY * np.sqrt(2.0 / left), found, 1.0))
