"""A start for bundle adjustment: tags placed one by one by a vote of all pictures that show them with placed ones.

No single picture has to tell a tag's pose from its planar flip. Each proposes what it may be, both flips of the tag
on both poses that the placed tags leave open; a wrong flip differs from picture to picture, so that the pose most
pictures can explain is the right one. What remains is that all may be inside out: seen from afar, a body and its
mirror image have the same pictures. That is told at the end, by adjusting both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.pipelines.vision.layout.additional import nothing
from alidade.pipelines.vision.layout.bundle import adjusted, loss
from alidade.pipelines.vision.layout.flips import Flips, Sides, pairs, sides
from alidade.pipelines.vision.layout.sights import Array, Bundle, Index, Sights, linearized
from alidade.pipelines.vision.pose import TagBody, part

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


def grown(bundle: Bundle, sights: Sights, found: Flips) -> TagBody:
    """The body with all its tags placed, in the frame of the one that is seen most with others.

    Args:
        bundle: cameras, sizes; no pose in it is looked at.
        sights: of tags that pictures tie together.
        found: of the same sights.
    """
    n = len(bundle.body.ids)
    body = replace(bundle.body, bRt=so3.identity(n), position=np.zeros((n, 3)))
    shared = joint(sights, n)
    seed = int((shared.sum(axis=1) - np.diag(shared)).argmax())
    bundle, placed = replace(bundle, body=body), np.arange(n) == seed
    told = _sides(bundle, sights, found, placed)
    while (tag := _next(sights, placed)) is not None:
        bundle = _placed(bundle, sights, found, told, tag)
        placed[tag] = True
        bundle = _settled(bundle, sights, _sides(bundle, sights, found, placed), placed, seed)
        told = _sides(bundle, sights, found, placed)
    return bundle.body


def mirrored(body: TagBody, about: int) -> TagBody:
    """The body inside out: what a camera far away cannot tell from it. Tag number `about` stays."""
    aRb = so3.inverse(body.bRt[about])
    turned = so3.multiply(aRb, body.bRt) * [1.0, -1.0, -1.0, 1.0]
    place = so3.rotate(aRb, body.position - body.position[about]) * [1.0, 1.0, -1.0]
    back = body.bRt[about]
    return replace(body, bRt=so3.multiply(back, turned), position=body.position[about] + so3.rotate(back, place))


def with_pictures(bundle: Bundle, told: Sides) -> Bundle:
    """The bundle with the better pose of each picture."""
    return replace(bundle, cRb=told.cRb[:, 0], position=told.position[:, 0])


def together(sights: Sights) -> NDArray[np.bool_]:
    """(m,) sights in pictures that show two tags or more."""
    return np.asarray(np.bincount(sights.picture)[sights.picture] > 1)


def joint(sights: Sights, tags: int) -> Array:
    """(n, n) number of pictures that show two tags together."""
    a, b = pairs(sights.picture)
    out = np.zeros((tags, tags))
    np.add.at(out, (sights.tag[a], sights.tag[b]), 1.0)
    return out


def _next(sights: Sights, placed: NDArray[np.bool_]) -> int | None:
    """The tag that is to be placed next: in most pictures together with placed ones."""
    shown = np.bincount(sights.picture[placed[sights.tag]], minlength=sights.picture.max() + 1)
    rows = ~placed[sights.tag] & (shown[sights.picture] > 0)
    return int(np.bincount(sights.tag[rows]).argmax()) if rows.any() else None


def _sides(bundle: Bundle, sights: Sights, found: Flips, placed: NDArray[np.bool_]) -> Sides:
    keep = np.flatnonzero(placed[sights.tag])
    return sides(bundle, sights[keep], found[keep], FAR)


def _settled(bundle: Bundle, sights: Sights, told: Sides, placed: NDArray[np.bool_], seed: int) -> Bundle:
    """A few steps of adjustment of what is placed."""
    seen = sights[placed[sights.tag]]
    seen = seen[together(seen)]
    number = np.cumsum(placed) - 1
    start = with_pictures(replace(bundle, body=part(bundle.body, placed)), told)
    seen = replace(seen, tag=number[seen.tag])
    after, _ = adjusted(start, seen, int(number[seed]), nothing(start), FAR, _ON_THE_WAY)
    bRt, position = bundle.body.bRt.copy(), bundle.body.position.copy()
    bRt[placed], position[placed] = after.body.bRt, after.body.position
    return replace(bundle, body=replace(bundle.body, bRt=bRt, position=position))


def _placed(bundle: Bundle, sights: Sights, found: Flips, told: Sides, tag: int) -> Bundle:
    """The bundle with one more tag where most pictures agree that it is."""
    rows = np.flatnonzero((sights.tag == tag) & np.isfinite(told.cost[sights.picture, 0]))
    bRt, position, _ = vote(bundle, sights[_some(rows, _PICTURES)], found[_some(rows, _PICTURES)], told)
    turned, places = bundle.body.bRt.copy(), bundle.body.position.copy()
    turned[tag], places[tag] = bRt[0], position[0]
    return replace(bundle, body=replace(bundle.body, bRt=turned, position=places))


def _some(rows: Index, most: int) -> Index:
    """At most so many of them, at even distances."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.intp)]


def vote(bundle: Bundle, sights: Sights, found: Flips, told: Sides) -> tuple[Array, Array, Array]:
    """Proposals for the pose of one tag, refined: bRt (h, 4), position (h, 3) and cost (h,), by ascending cost.

    The error of a picture's own pose is part of a corner's: its covariance is that of both.

    Args:
        bundle: cameras and body.
        sights: of this tag, in pictures whose poses are told by others.
        found: of the same sights.
        told: of all pictures.
    """
    cRb, position = told.cRb[sights.picture], told.position[sights.picture]
    there = np.isfinite(told.cost[sights.picture])
    bRc = so3.inverse(cRb)[:, :, None]
    proposals = so3.multiply(bRc, found.cRt[:, None]).reshape(-1, 4)
    places = so3.rotate(bRc, found.place[:, None] - position[:, :, None]).reshape(-1, 3)
    keep = _some(np.flatnonzero(np.repeat(there.ravel(), 2)), _PROPOSALS)
    bRt, place = proposals[keep], places[keep]
    known = told.information[sights.picture] + 1e-12 * np.eye(6)
    odds = np.where(there, told.cost[sights.picture] - told.cost[sights.picture, :1], np.inf)
    cost, going = np.zeros(len(keep)), np.arange(len(keep))
    for round_ in range(_ROUNDS + 1):
        far = FAR * 4.0 ** max(0, 4 - round_)
        squares, gradient, information = _against(bundle, sights, cRb, position, known, bRt[going], place[going])
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


def _against(
    bundle: Bundle, sights: Sights, cRb: Array, position: Array, known: Array, bRt: Array, place: Array
) -> tuple[Array, Array, Array]:
    """Of each proposal (h) in each sight (s) and side (2): squares, gradient (6,), information (6, 6) for the tag.

    Errors of the picture's pose, of which so much is `known` (s, 2, 6, 6) by others, are marginalised.
    """
    h, s = len(bRt), len(sights)
    shape = (h, s, 2)
    proposal, sight, side = (a.ravel() for a in np.indices(shape))
    body = TagBody(np.arange(h), np.full(h, bundle.body.size[sights.tag[0]]), bRt, place, bundle.body.family)
    camera = bundle.camera[sights.picture][sight]
    seen = Sights(np.arange(len(sight)), proposal, sights.corners[sight], sights.sigma[sight])
    rows = linearized(Bundle.of(bundle.cameras, camera, body, cRb[sight, side], position[sight, side]), seen)
    A, B, miss = rows.by_picture, rows.by_tag, rows.miss[..., None]
    At, Bt = np.swapaxes(A, 1, 2), np.swapaxes(B, 1, 2)
    by_pose, crossing = At @ miss, At @ B
    moved = np.linalg.solve(known[sight, side] + At @ A, np.concatenate([by_pose, crossing], axis=2))
    squares = rows.squares - (by_pose * moved[..., :1]).sum(axis=(1, 2))
    taken = np.swapaxes(crossing, 1, 2) @ moved
    gradient = (Bt @ miss - taken[..., :1])[..., 0]
    return squares.reshape(shape), gradient.reshape(*shape, 6), (Bt @ B - taken[..., 1:]).reshape(*shape, 6, 6)
