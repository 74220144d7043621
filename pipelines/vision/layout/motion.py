"""How a body moves in each picture, from its poses in the pictures before and after."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alidade.factors import so3
from alidade.pipelines.vision.layout.sights import Array, Bundle, Index

# Pictures farther apart than this, s, tell nothing of the motion in each other.
_APART = 0.25
# A polynomial is laid through so many pictures before and after, and through all within this time, s.
_BESIDE, _NEAR = 2, 0.12
_DEGREE = 4


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
