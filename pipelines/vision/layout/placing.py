"""A start for bundle adjustment: tags placed one by one by a vote of all pictures that show them with placed ones.

No single picture has to determine a tag's pose against its planar flip. Each proposes what it may be, both flips of the
tag on both poses that the placed tags leave open; a wrong flip differs from picture to picture, so that the pose most
pictures can explain is the right one. What remains is that all may be inside out: seen from afar, a body and its mirror
image have the same pictures. That is decided at the end, by adjusting both; pictures that do not decide between their
two poses are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.layout.bundle import (
    Additional,
    Bundle,
    Gathered,
    Sights,
    adjusted,
    linearized,
    loss,
    refined_pictures,
)
from alidade.pipelines.vision.layout.fit import Fit, fitted
from alidade.pipelines.vision.pose import TagBody, angles, planar_solutions

# Sum of squares of a tag in a picture, eight numbers in sigmas, beyond which it counts less and less.
FAR = 8.0 * 4.0**2
# A vote hears so many pictures, and so many proposals.
_PICTURES, _PROPOSALS = 40, 32
_ROUNDS = 8
# A proposal whose step would lower its cost by less than this stays where it is.
_STAYS = 0.01
_LEAST_DAMPING = 1e-9
# Adjustments on the way.
_ON_THE_WAY = 4
# Poses closer than this, rad, are one.
_ONE_POSE = 1e-3
# Twice the logarithm of the odds, a thousand to one, from which a flip is resolved.
_DECIDED = 2.0 * float(np.log(1e3))
# Poses closer than this, rad, are one, or on the way to it.
_SAME = 0.05
# Tags are placed from at most so many views, and those that show a pair of tags seen in no more than so many.
_MOST, _RARE = 250, 10
# Views that decide about a tag's flip.
_HEARD = 40


@dataclass(frozen=True, eq=False)
class Sides:
    """The two candidate poses of each picture, the better first.

    Attributes:
        cRb, position: (f, 2, 4), (f, 2, 3).
        cost: (f, 2); infinite where there is none.
        information: (f, 2, 6, 6).
    """

    cRb: Array
    position: Array
    cost: Array
    information: Array


def adjusted_whole(views: Gathered, body: TagBody | None) -> Fit:
    """Adjust the bundle of all tags; `body` gives initial tag poses, or None if unknown.

    Raises:
        InputError: the pictures do not distinguish the layout from its mirror image.
    """
    sights = with_flips(views.start, views.sights)
    sights = replace(sights, sigma=sights.sigma * lone_scale(views.start, sights))
    if body is None:
        body = _in_frame(grown(views.start, sights[_decisive(sights, views.view)]), views.start.body)
    body = _right_side_out(replace(views.start, body=body), sights)
    start = replace(views.start, body=body)
    poses = sides(start, sights)
    decided = poses.cost[:, 1] - poses.cost[:, 0] > _DECIDED
    whole = np.flatnonzero(sights.together & decided[sights.picture])
    if not len(whole):
        raise InputError(
            "no picture distinguishes its tags' poses from their planar flips; take pictures from nearer, or that "
            "show more tags on different faces"
        )
    return fitted(with_pictures(start, poses), sights, whole, Additional.of(start))


def _decisive(sights: Sights, view: Index) -> Index:
    """Select sights for placing tags: one picture per view, limited in number."""
    first = np.unique(view, return_index=True)[1]
    if len(first) > _MOST:
        # Of the ways in which tags are tied together, the rare ones stay.
        ties = joint(sights, int(sights.tag.max()) + 1)
        a, b = pairs(sights.picture)
        rare = np.unique(sights.picture[a[ties[sights.tag[a], sights.tag[b]] <= _RARE]])
        first = np.union1d(_thinned(first, _MOST), np.intersect1d(rare, first))
    return np.flatnonzero(np.isin(sights.picture, first))


def _in_frame(body: TagBody, given: TagBody) -> TagBody:
    """Transform the body so that its first tag has the given pose."""
    turn = so3.multiply(given.bRt[0], so3.inverse(body.bRt[0]))
    position = given.position[0] + so3.rotate(turn, body.position - body.position[0])
    return replace(body, bRt=so3.multiply(turn, body.bRt), position=position)


def _right_side_out(start: Bundle, sights: Sights) -> TagBody:
    """Select the body or its mirror image, by the fit of the pictures.

    Raises:
        InputError: both fit.
    """
    bodies, costs = [], []
    seen = sights[sights.together]
    for body in (start.body, mirrored(start.body, 0)):
        there = replace(start, body=body)
        there = with_pictures(there, sides(there, sights))
        after, rows = adjusted(there, seen, 0, Additional.of(start), FAR)
        bodies.append(after.body)
        costs.append(float(loss(rows.squares, FAR).sum()))
    best = int(np.argmin(costs))
    apart = angles(bodies[0].bRt, bodies[1].bRt).max()
    if apart > _SAME and abs(costs[1] - costs[0]) < _DECIDED:
        raise InputError(
            "the pictures fit the tags and their mirror image alike, an edge seen from outside and one seen from "
            "inside; take pictures from nearer, where perspective shows"
        )
    return bodies[best]


def flip_resolved(fit: Fit, view: Index, tag: int) -> bool:
    """Whether the pictures distinguish a tag's pose (by tag index) from every alternative that `vote` finds.

    Pictures in which nothing moved count once.
    """
    mine = np.flatnonzero(fit.sights.tag == tag)
    mine = mine[np.unique(view[fit.sights.picture[mine]], return_index=True)[1]]
    seen = fit.sights[_thinned(mine, _HEARD)]
    others = fit.sights[np.isin(fit.sights.picture, seen.picture) & (fit.sights.tag != tag)]
    bRt, _, cost = vote(fit.bundle, seen, sides(fit.bundle, others))
    now = angles(bRt, fit.bundle.body.bRt[tag]) < _SAME
    return bool(now.any() and (now.all() or cost[~now].min() - cost[now].min() > _DECIDED))


def grown(bundle: Bundle, sights: Sights) -> TagBody:
    """Place all tags one by one, in the frame of the tag most often seen together with others.

    Args:
        bundle: cameras, sizes; no pose in it is looked at.
        sights: of tags that pictures tie together.
    """
    n = len(bundle.body.ids)
    body = replace(bundle.body, bRt=so3.identity(n), position=np.zeros((n, 3)))
    shared = joint(sights, n)
    seed = int((shared.sum(axis=1) - np.diag(shared)).argmax())
    bundle, placed = replace(bundle, body=body), np.arange(n) == seed
    poses = sides(bundle, sights[placed[sights.tag]])
    while (tag := _next(sights, placed)) is not None:
        bundle = _placed(bundle, sights, poses, tag)
        placed[tag] = True
        seen = sights[placed[sights.tag]]
        start = with_pictures(bundle, sides(bundle, seen))
        # A few steps; tags that are not placed yet stay where they are.
        bundle, _ = adjusted(start, seen[seen.together], seed, Additional.of(start), FAR, _ON_THE_WAY)
        poses = sides(bundle, seen)
    return bundle.body


def mirrored(body: TagBody, about: int) -> TagBody:
    """Mirror image of the body, equivalent for a distant camera; tag number `about` stays."""
    aRb = so3.inverse(body.bRt[about])
    turned = so3.multiply(aRb, body.bRt) * [1.0, -1.0, -1.0, 1.0]
    place = so3.rotate(aRb, body.position - body.position[about]) * [1.0, 1.0, -1.0]
    back = body.bRt[about]
    return replace(body, bRt=so3.multiply(back, turned), position=body.position[about] + so3.rotate(back, place))


def with_pictures(bundle: Bundle, poses: Sides) -> Bundle:
    """Set each picture's pose to the better of its two candidates."""
    return replace(bundle, cRb=poses.cRb[:, 0], position=poses.position[:, 0])


def joint(sights: Sights, tags: int) -> Array:
    """Count (n, n) of pictures that show each pair of tags together."""
    a, b = pairs(sights.picture)
    out = np.zeros((tags, tags))
    np.add.at(out, (sights.tag[a], sights.tag[b]), 1.0)
    return out


def _next(sights: Sights, placed: NDArray[np.bool_]) -> int | None:
    """Index of the tag to be placed next, most often seen with placed ones; None if there is none."""
    shown = np.bincount(sights.picture[placed[sights.tag]], minlength=sights.picture.max() + 1)
    rows = ~placed[sights.tag] & (shown[sights.picture] > 0)
    return int(np.bincount(sights.tag[rows]).argmax()) if rows.any() else None


def _placed(bundle: Bundle, sights: Sights, poses: Sides, tag: int) -> Bundle:
    """Place one more tag at the pose that most pictures agree on."""
    rows = np.flatnonzero((sights.tag == tag) & np.isfinite(poses.cost[sights.picture, 0]))
    bRt, position, _ = vote(bundle, sights[_thinned(rows, _PICTURES)], poses)
    turned, places = bundle.body.bRt.copy(), bundle.body.position.copy()
    turned[tag], places[tag] = bRt[0], position[0]
    return replace(bundle, body=replace(bundle.body, bRt=turned, position=places))


def _thinned(rows: Index, most: int) -> Index:
    """Thin row indices evenly to at most `most`."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.intp)]


def vote(bundle: Bundle, sights: Sights, poses: Sides) -> tuple[Array, Array, Array]:
    """Refined proposals for one tag's pose: bRt (h, 4), position (h, 3), m, and cost (h,), by ascending cost.

    The error of a picture's own pose is part of a corner's: its covariance is that of both.

    Args:
        bundle: cameras and body.
        sights: of this tag, in pictures whose poses others determine.
        poses: of all pictures.
    """
    cRb, position = poses.cRb[sights.picture], poses.position[sights.picture]
    there = np.isfinite(poses.cost[sights.picture])
    bRc = so3.inverse(cRb)[:, :, None]
    proposals = so3.multiply(bRc, sights.cRt[:, None]).reshape(-1, 4)
    places = so3.rotate(bRc, sights.place[:, None] - position[:, :, None]).reshape(-1, 3)
    keep = _thinned(np.flatnonzero(np.repeat(there.ravel(), 2)), _PROPOSALS)
    bRt, place = proposals[keep], places[keep]
    known = poses.information[sights.picture] + 1e-12 * np.eye(6)
    odds = np.where(there, poses.cost[sights.picture] - poses.cost[sights.picture, :1], np.inf)
    cost, going = np.zeros(len(keep)), np.arange(len(keep))
    for round_ in range(_ROUNDS + 1):
        far = FAR * 4.0 ** max(0, 4 - round_)
        squares, gradient, information = _proposal_costs(bundle, sights, cRb, position, known, bRt[going], place[going])
        squares = np.where(there, squares + odds, np.inf)
        side = squares.argmin(axis=2)[..., None]
        squares = np.take_along_axis(squares, side, 2)[..., 0]
        cost[going] = loss(squares, far).sum(axis=1)
        if round_ == _ROUNDS:
            break
        weight = (far / (far + squares)) ** 2
        g = np.take_along_axis(gradient, side[..., None], 2)[:, :, 0]
        H = np.take_along_axis(information, side[..., None, None], 2)[:, :, 0]
        H = np.einsum("hs,hsij->hij", weight, H)
        H += _LEAST_DAMPING * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        g = np.einsum("hs,hsi->hi", weight, g)
        step = -np.linalg.solve(H, g[..., None])[..., 0]
        step *= np.minimum(1.0, 0.3 / np.maximum(np.linalg.norm(step[:, :3], axis=1), 1e-12))[:, None]
        if far == FAR:
            more = -(step * g).sum(axis=1) > _STAYS
            going, step = going[more], step[more]
            if not len(going):
                break
        bRt[going] = so3.multiply(bRt[going], so3.exp(step[:, :3]))
        place[going] += step[:, 3:]
    order = np.argsort(cost)
    return bRt[order], place[order], cost[order]


def _proposal_costs(
    bundle: Bundle, sights: Sights, cRb: Array, position: Array, known: Array, bRt: Array, place: Array
) -> tuple[Array, Array, Array]:
    """Squares, gradient (6,), information (6, 6) of a tag's pose, by proposal (h), sight (s), picture side (2).

    Errors of the picture's pose, of which so much is `known` (s, 2, 6, 6) by others, are marginalised.
    """
    h, s = len(bRt), len(sights)
    shape = (h, s, 2)
    proposal, sight, side = (a.ravel() for a in np.indices(shape))
    body = TagBody(np.arange(h), np.full(h, bundle.body.size[sights.tag[0]]), bRt, place, bundle.body.family)
    camera = bundle.camera[sights.picture][sight]
    seen = replace(sights[sight], picture=np.arange(len(sight)), tag=proposal)
    rows = linearized(Bundle.of(bundle.cameras, camera, body, cRb[sight, side], position[sight, side]), seen)
    A, B, miss = rows.by_picture, rows.by_tag, rows.miss[..., None]
    At, Bt = np.swapaxes(A, 1, 2), np.swapaxes(B, 1, 2)
    by_pose, crossing = At @ miss, At @ B
    moved = np.linalg.solve(known[sight, side] + At @ A, np.concatenate([by_pose, crossing], axis=2))
    squares = rows.squares - (by_pose * moved[..., :1]).sum(axis=(1, 2))
    taken = np.swapaxes(crossing, 1, 2) @ moved
    gradient = (Bt @ miss - taken[..., :1])[..., 0]
    return squares.reshape(shape), gradient.reshape(*shape, 6), (Bt @ B - taken[..., 1:]).reshape(*shape, 6, 6)


def with_flips(bundle: Bundle, sights: Sights) -> Sights:
    """Add both planar pose solutions of each single tag to the sights."""
    m = len(sights)
    cRt, place = np.zeros((m, 2, 4)), np.zeros((m, 2, 3))
    size = bundle.body.size[sights.tag]
    for k, camera in enumerate(bundle.cameras):
        mine = np.flatnonzero(bundle.camera[sights.picture] == k)
        cRt[mine], place[mine] = planar_solutions(camera, size[mine], sights.corners[mine])
    return replace(sights, cRt=cRt, place=place)


def lone_scale(bundle: Bundle, sights: Sights) -> float:
    """Ratio of actual to stated corner errors, from fits of single tags (eight numbers for a pose of six)."""
    n, camera = len(bundle.body.ids), bundle.camera[sights.picture]
    body = replace(bundle.body, bRt=so3.identity(n), position=np.zeros((n, 3)))
    alone = replace(sights, picture=np.arange(len(sights)))
    starts = (Bundle.of(bundle.cameras, camera, body, sights.cRt[:, k], sights.place[:, k]) for k in range(2))
    costs = [refined_pictures(start, alone)[1] for start in starts]
    # The median of a chi-square of two degrees of freedom is 2 ln 2.
    return float(np.sqrt(np.median(np.minimum(*costs)) / (2.0 * np.log(2.0))))


def sides(bundle: Bundle, sights: Sights) -> Sides:
    """Find both candidate poses of each picture, for the tag poses of the bundle's body.

    Every pose of every tag in a picture is a start; the best is refined, and the best of those on the other side of
    the flip.

    Args:
        bundle: cameras and body; its pictures' poses are not looked at.
        sights: of the tags that are placed.
    """
    f = len(bundle.cRb)
    bRt, place = bundle.body.bRt[sights.tag][:, None], bundle.body.position[sights.tag][:, None]
    cRb = so3.multiply(sights.cRt, so3.inverse(bRt))
    position = sights.place - so3.rotate(cRb, place)
    costs = _start_costs(bundle, sights, cRb, position)
    picture = np.repeat(sights.picture, 2)
    cRb, position = cRb.reshape(-1, 4), position.reshape(-1, 3)
    first = _refined(bundle, sights, _best(picture, costs.ravel(), f), cRb, position)
    away = angles(first.cRb[picture], cRb).reshape(-1, 2)
    other = np.where(away < away[:, ::-1], np.inf, costs)
    second = _refined(bundle, sights, _best(picture, other.ravel(), f), cRb, position)
    second.cost[angles(first.cRb, second.cRb) < _ONE_POSE] = np.inf
    order = np.argsort(np.stack([first.cost, second.cost], axis=1), axis=1)
    both = (np.stack(pair, axis=1) for pair in zip(vars(first).values(), vars(second).values(), strict=True))
    return Sides(*(pair[np.arange(f)[:, None], order] for pair in both))


def _start_costs(bundle: Bundle, sights: Sights, cRb: Array, position: Array) -> Array:
    """Cost (m, 2) of a picture's sights at each start pose, from either solution of each sight."""
    a, b = pairs(sights.picture)
    costs = []
    for k in range(2):
        start = Bundle.of(bundle.cameras, bundle.camera[sights.picture], bundle.body, cRb[:, k], position[:, k])
        # Each start is a picture of its own, which sees what the picture sees.
        squares = linearized(start, replace(sights[b], picture=a)).squares
        costs.append(np.bincount(a, loss(squares, 100.0 * FAR), len(sights)))
    return np.stack(costs, axis=1)


def pairs(picture: Index) -> tuple[Index, Index]:
    """Ordered index pairs of sights in the same picture, self pairs included; pictures ascend."""
    counts = np.bincount(picture)[picture]
    first = np.searchsorted(picture, picture)
    a = np.repeat(np.arange(len(picture)), counts)
    within = np.arange(len(a)) - np.repeat(np.cumsum(counts) - counts, counts)
    return a, np.repeat(first, counts) + within


def _best(picture: Index, costs: Array, f: int) -> Index:
    """Index (f,) of the cheapest start in each picture; -1 where there is none."""
    out, dearest_first = np.full(f, -1), np.argsort(-costs, kind="stable")
    order = dearest_first[np.isfinite(costs[dearest_first])]
    out[picture[order]] = order  # the last of a picture stays
    return out


def _refined(bundle: Bundle, sights: Sights, start: Index, cRb: Array, position: Array) -> Sides:
    """Refine one pose of each picture from the start with index (f,); -1 for no start."""
    got = start >= 0
    there = replace(
        bundle,
        cRb=np.where(got[:, None], cRb[start], so3.identity()),
        position=np.where(got[:, None], position[start], [0.0, 0.0, 1.0]),
    )
    there, cost, information = refined_pictures(there, sights[got[sights.picture]], FAR)
    return Sides(there.cRb, there.position, np.where(got, cost, np.inf), information)
