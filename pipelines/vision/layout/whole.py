"""The adjustment from first to last: tags placed, right side out, pictures that do not tell their flip left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.layout.additional import nothing
from alidade.pipelines.vision.layout.bundle import adjusted, loss
from alidade.pipelines.vision.layout.flips import Flips, flips, lone_scale, pairs, sides
from alidade.pipelines.vision.layout.pictures import Gathered
from alidade.pipelines.vision.layout.placing import FAR, grown, joint, mirrored, together, vote, with_pictures
from alidade.pipelines.vision.layout.robust import Fit, fitted
from alidade.pipelines.vision.layout.sights import Array, Bundle, Index, Sights
from alidade.pipelines.vision.pose import TagBody

# Twice the logarithm of the odds, a thousand to one, from which a flip is told.
_TOLD = 2.0 * float(np.log(1e3))
# Poses closer than this, rad, are one, or on the way to it.
_SAME = 0.05
# Tags are placed from at most so many views, and those that show a pair of tags seen in no more than so many.
_MOST, _RARE = 250, 10
# Views that are asked whether a tag's flip is told.
_HEARD = 40


def adjusted_whole(views: Gathered, body: TagBody | None) -> Fit:
    """The most likely bundle of all tags; `body` is where they are, None if that is not known yet.

    Raises:
        InputError: the pictures do not tell the layout from its mirror image.
    """
    sights = views.sights
    found = flips(views.start, sights)
    sights = replace(sights, sigma=sights.sigma * lone_scale(views.start, sights, found))
    if body is None:
        few = _telling(sights, views.view)
        body = _in_frame(grown(views.start, sights[few], found[few]), views.start.body)
    body = _right_side_out(replace(views.start, body=body), sights, found)
    start = replace(views.start, body=body)
    told = sides(start, sights, found, FAR)
    decided = told.cost[:, 1] - told.cost[:, 0] > _TOLD
    whole = np.flatnonzero(together(sights) & decided[sights.picture])
    if not len(whole):
        raise InputError(
            "no picture tells the poses of the tags in it from their planar flips; take pictures from nearer, or that "
            "show more tags on different faces"
        )
    return replace(fitted(with_pictures(start, told), sights[whole], 0, nothing(start)), whole=whole)


def _telling(sights: Sights, view: Index) -> Index:
    """Sights of the pictures from which tags are placed: one of each view, and not too many."""
    first = np.unique(view, return_index=True)[1]
    if len(first) > _MOST:
        # Of the ways in which tags are tied together, the rare ones stay.
        ties = joint(sights, int(sights.tag.max()) + 1)
        a, b = pairs(sights.picture)
        rare = np.unique(sights.picture[a[ties[sights.tag[a], sights.tag[b]] <= _RARE]])
        even = first[np.linspace(0, len(first) - 1, _MOST).round().astype(np.intp)]
        first = np.union1d(even, np.intersect1d(rare, first))
    return np.flatnonzero(np.isin(sights.picture, first))


def _in_frame(body: TagBody, given: TagBody) -> TagBody:
    """The body turned and moved so that its first tag is where it is given."""
    turn = so3.multiply(given.bRt[0], so3.inverse(body.bRt[0]))
    position = given.position[0] + so3.rotate(turn, body.position - body.position[0])
    return replace(body, bRt=so3.multiply(turn, body.bRt), position=position)


def _right_side_out(start: Bundle, sights: Sights, found: Flips) -> TagBody:
    """The body or its mirror image, whichever the pictures fit.

    Raises:
        InputError: both fit.
    """
    bodies, costs = [], []
    seen = sights[together(sights)]
    for body in (start.body, mirrored(start.body, 0)):
        there = replace(start, body=body)
        there = with_pictures(there, sides(there, sights, found, FAR))
        after, rows = adjusted(there, seen, 0, nothing(start), FAR)
        bodies.append(after.body)
        costs.append(float(loss(rows.squares, FAR).sum()))
    best = int(np.argmin(costs))
    apart = _angles(bodies[0].bRt, bodies[1].bRt).max()
    if apart > _SAME and abs(costs[1] - costs[0]) < _TOLD:
        raise InputError(
            "the pictures fit the tags and their mirror image alike, an edge seen from outside and one seen from "
            "inside; take pictures from nearer, where perspective shows"
        )
    return bodies[best]


def flip_told(fit: Fit, view: Index, tag: int) -> bool:
    """Whether the pictures tell the pose of a tag, by its index, from every other that they may fit; see `vote`.

    Pictures in which nothing moved count once.
    """
    mine = np.flatnonzero(fit.sights.tag == tag)
    mine = mine[np.unique(view[fit.sights.picture[mine]], return_index=True)[1]]
    mine = mine[np.linspace(0, len(mine) - 1, min(len(mine), _HEARD)).round().astype(np.intp)]
    pictures = fit.sights.picture[mine]
    others = fit.sights[np.isin(fit.sights.picture, pictures) & (fit.sights.tag != tag)]
    told = sides(fit.bundle, others, flips(fit.bundle, others), FAR)
    seen = fit.sights[mine]
    bRt, _, cost = vote(fit.bundle, seen, flips(fit.bundle, seen), told)
    now = _angles(bRt, fit.bundle.body.bRt[tag]) < _SAME
    return bool(now.any() and (now.all() or cost[~now].min() - cost[now].min() > _TOLD))


def _angles(p: Array, q: Array) -> Array:
    return np.asarray(np.linalg.norm(so3.log(so3.multiply(so3.inverse(p), q)), axis=-1))
