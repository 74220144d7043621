"""Poses of a body of tags over a stream of pictures; attitudes of a helmet's tag board from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.pose import BodyPose, TagBody, estimate_pose
from alidade.pipelines.vision.tags import UNREADABLE, Detections, detections, edge_lengths

# A picture's own attitude settles the flips of the pictures up to this much later.
_FRESH_NS = 200_000_000
# The tags do not fit the body's layout when the reprojection error is above this many sigmas, this many px and this
# share of a tag's side (a layout made by hand is good to half a per cent; a tag in another's place is not).
_MISFIT_SIGMAS, _MISFIT_PX, _MISFIT_SHARE = 5.0, 0.5, 0.03

UNSEEN = "no tag of the body seen well"
AMBIGUOUS = "planar flip ambiguous"
MISFIT = "tags do not fit the layout"


@dataclass(frozen=True, eq=False)
class Sight:
    """View of a body in one picture: stamp, all tag ids, pose, and the reason if the pose is unusable."""

    t_ns: int
    ids: NDArray[np.int64]
    pose: BodyPose | None
    problem: str | None


@dataclass(frozen=True, eq=False)
class BoardAttitudes:
    """Attitudes of a tag board over time.

    Attributes:
        t_ns: (K,) stamps, Unix ns.
        cRh: (K, 4) attitude of the board's frame h in the camera's optical frame c.
        covariance: (K, 3, 3) rad^2, of delta in `cRh * Exp(delta)`, delta in h.
        dropped: reason -> number of pictures.
    """

    t_ns: NDArray[np.int64]
    cRh: Array
    covariance: Array
    dropped: dict[str, int]


def body_poses(
    images: Iterable[tuple[int, bytes]], camera: Camera, body: TagBody, sigma_px: float | None = None
) -> Iterator[Sight]:
    """Yield the pose of a body of tags in each picture; the last unambiguous attitude guides the next.

    Args:
        images: stamps (ns) and encoded pictures (PNG, JPEG, ...), in time order.
        camera: the camera; pictures of another size raise InputError.
        body: the tags and where they are on the body.
        sigma_px: as in `estimate_pose`.
    """
    last_t, last_cRb = 0, None
    for t_ns, found in detections(images, body.family, camera):
        if found is None:
            yield Sight(t_ns, np.zeros(0, dtype=np.int64), None, UNREADABLE)
            continue
        fresh = last_cRb is not None and 0 <= t_ns - last_t <= _FRESH_NS
        pose = estimate_pose(camera, body, found, sigma_px, expected=last_cRb if fresh else None)
        problem = _problem(pose, found, sigma_px)
        if pose is not None and problem is None and pose.decided:
            last_t, last_cRb = t_ns, pose.cRb
        yield Sight(t_ns, found.ids, pose, problem)


def _problem(pose: BodyPose | None, found: Detections, sigma_px: float | None) -> str | None:
    if pose is None:
        return UNSEEN
    corners = found.corners[np.isin(found.ids, pose.ids)]
    side = float(edge_lengths(corners).mean())
    if pose.rms_px > max(_MISFIT_SIGMAS * (sigma_px or 0.0), _MISFIT_PX, _MISFIT_SHARE * side):
        return MISFIT
    return AMBIGUOUS if pose.ambiguous else None


def board_attitudes(
    images: Iterable[tuple[int, bytes]], camera: Camera, board: TagBody, sigma_px: float | None = None
) -> BoardAttitudes:
    """Measure a helmet's tag board in pictures: attitudes in the camera's optical frame (arguments as in `body_poses`).

    Raises:
        InputError: no pictures, none that decodes, no tag of the board ever seen, or no attitude that can be used.
    """
    t_ns: list[int] = []
    attitudes: list[Array] = []
    covariances: list[Array] = []
    dropped: Counter[str] = Counter()
    seen: set[int] = set()
    for sight in body_poses(images, camera, board, sigma_px):
        seen.update(sight.ids.tolist())
        if sight.problem is not None or sight.pose is None:
            dropped[sight.problem or UNSEEN] += 1
            continue
        t_ns.append(sight.t_ns)
        attitudes.append(sight.pose.cRb)
        covariances.append(sight.pose.covariance[:3, :3])
    if not t_ns:
        raise InputError(_why_nothing(dropped, seen, board))
    return BoardAttitudes(np.array(t_ns, dtype=np.int64), np.array(attitudes), np.array(covariances), dict(dropped))


def _why_nothing(dropped: Counter[str], seen: set[int], board: TagBody) -> str:
    count = dropped.total()
    if not count:
        return "no pictures on the image topic: record it, or name it in the config"
    if dropped[UNREADABLE] == count:
        return f"none of the {count} pictures decodes: they must be PNG or JPEG"
    if not seen & set(board.ids.tolist()):
        return (
            f"no tag of the board in any of {count} pictures: tags seen {sorted(seen) or 'none'}, "
            f"the config names {board.ids.tolist()}"
        )
    reasons = ", ".join(f"{reason} ({n})" for reason, n in dropped.most_common())
    return f"no attitude of the tag board from {count} pictures: {reasons}; check the board's sizes and positions"
