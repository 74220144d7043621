"""Both poses that a picture may have: the planar flip of tags, told by all of them together or kept open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from alidade.factors import so3
from alidade.pipelines.vision.layout.bundle import loss, refined_pictures
from alidade.pipelines.vision.layout.sights import Array, Bundle, Index, Sights, linearized
from alidade.pipelines.vision.pose import planar_solutions

# Poses closer than this, rad, are one.
_SAME = 1e-3


@dataclass(frozen=True, eq=False)
class Flips:
    """Both poses of each tag in each picture: cRt (m, 2, 4), place in c (m, 2, 3) m."""

    cRt: Array
    place: Array

    def __getitem__(self, keep: Index) -> Flips:
        return Flips(self.cRt[keep], self.place[keep])


@dataclass(frozen=True, eq=False)
class Sides:
    """The two poses that each picture may have, the better first.

    Attributes:
        cRb, position: (f, 2, 4), (f, 2, 3).
        cost: (f, 2); infinite where there is none.
        information: (f, 2, 6, 6).
    """

    cRb: Array
    position: Array
    cost: Array
    information: Array


def flips(bundle: Bundle, sights: Sights) -> Flips:
    """Both poses of each tag by itself, as they minimise its reprojection error."""
    m = len(sights)
    cRt, place = np.zeros((m, 2, 4)), np.zeros((m, 2, 3))
    size = bundle.body.size[sights.tag]
    for k, camera in enumerate(bundle.cameras):
        mine = np.flatnonzero(bundle.camera[sights.picture] == k)
        cRt[mine], place[mine] = planar_solutions(camera, size[mine], sights.corners[mine])
    return Flips(cRt, place)


def lone_scale(bundle: Bundle, sights: Sights, found: Flips) -> float:
    """By how much corners are worse than stated: from each tag by itself, eight numbers for the six of its pose."""
    m = len(sights)
    body = replace(bundle.body, bRt=so3.identity(len(bundle.body.ids)), position=np.zeros((len(bundle.body.ids), 3)))
    alone = Sights(np.arange(m), sights.tag, sights.corners, sights.sigma)
    costs = []
    for k in range(2):
        start = Bundle.of(bundle.cameras, bundle.camera[sights.picture], body, found.cRt[:, k], found.place[:, k])
        costs.append(refined_pictures(start, alone)[1])
    # The median of a chi-square of two degrees of freedom is 2 ln 2.
    return float(np.sqrt(np.median(np.minimum(*costs)) / (2.0 * np.log(2.0))))


def sides(bundle: Bundle, sights: Sights, found: Flips, far: float) -> Sides:
    """The two poses of each picture with the tags where the bundle's body has them.

    Every pose of every tag in a picture is a start; the best is refined, and the best of those on the other side of
    the flip.

    Args:
        bundle: cameras and body; its pictures' poses are not looked at.
        sights: of the tags that are placed.
        found: of the same sights.
        far: see `adjusted`.
    """
    f = len(bundle.cRb)
    bRt, place = bundle.body.bRt[sights.tag][:, None], bundle.body.position[sights.tag][:, None]
    cRb = so3.multiply(found.cRt, so3.inverse(bRt))
    position = found.place - so3.rotate(cRb, place)
    costs = _start_costs(bundle, sights, cRb, position, far)
    picture = np.repeat(sights.picture, 2)
    cRb, position = cRb.reshape(-1, 4), position.reshape(-1, 3)
    first = _refined(bundle, sights, _best(picture, costs.ravel(), f), cRb, position, far)
    away = np.linalg.norm(so3.log(so3.multiply(so3.inverse(first[0].cRb[picture]), cRb)), axis=1).reshape(-1, 2)
    other = np.where(away < away[:, ::-1], np.inf, costs)
    second = _refined(bundle, sights, _best(picture, other.ravel(), f), cRb, position, far)
    turn = np.linalg.norm(so3.log(so3.multiply(so3.inverse(first[0].cRb), second[0].cRb)), axis=1)
    second[1][turn < _SAME] = np.inf
    order = np.argsort(np.stack([first[1], second[1]], axis=1), axis=1)
    rows = np.arange(f)[:, None]

    def sorted_(a: Array, b: Array) -> Array:
        return np.asarray(np.stack([a, b], axis=1)[rows, order])

    return Sides(
        sorted_(first[0].cRb, second[0].cRb),
        sorted_(first[0].position, second[0].position),
        sorted_(first[1], second[1]),
        sorted_(first[2], second[2]),
    )


def _start_costs(bundle: Bundle, sights: Sights, cRb: Array, position: Array, far: float) -> Array:
    """(m, 2) cost of all sights in a picture, were the picture's pose that of each start."""
    a, b = pairs(sights.picture)
    costs = []
    for k in range(2):
        start = Bundle.of(bundle.cameras, bundle.camera[sights.picture], bundle.body, cRb[:, k], position[:, k])
        # Each start is a picture of its own, which sees what the picture sees.
        seen = Sights(a, sights.tag[b], sights.corners[b], sights.sigma[b])
        costs.append(np.bincount(a, loss(linearized(start, seen).squares, 100.0 * far), len(sights)))
    return np.stack(costs, axis=1)


def pairs(picture: Index) -> tuple[Index, Index]:
    """All ordered pairs of sights in one picture, each with itself too; pictures ascend."""
    counts = np.bincount(picture)[picture]
    first = np.searchsorted(picture, picture)
    a = np.repeat(np.arange(len(picture)), counts)
    within = np.arange(len(a)) - np.repeat(np.cumsum(counts) - counts, counts)
    return a, np.repeat(first, counts) + within


def _best(picture: Index, costs: Array, f: int) -> Index:
    """(f,) the start of least cost in each picture, -1 where there is none."""
    order = np.lexsort((costs, picture))
    order = order[np.isfinite(costs[order])]
    out = np.full(f, -1)
    which, first = np.unique(picture[order], return_index=True)
    out[which] = order[first]
    return out


def _refined(
    bundle: Bundle, sights: Sights, start: Index, cRb: Array, position: Array, far: float
) -> tuple[Bundle, Array, Array]:
    got = start >= 0
    there = replace(
        bundle,
        cRb=np.where(got[:, None], cRb[start], so3.identity()),
        position=np.where(got[:, None], position[start], [0.0, 0.0, 1.0]),
    )
    there, cost, information = refined_pictures(there, sights[got[sights.picture]], far)
    return there, np.where(got, cost, np.inf), information
