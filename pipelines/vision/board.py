"""Attitudes of a helmet's tag board from a stream of pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
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


def _problem(pose: BodyPose, found: Detections, sigma_px: float | None) -> str:
    """Return why a pose is not used; empty if it is."""
    corners = found.corners[np.isin(found.ids, pose.ids)]
    side = float(edge_lengths(corners).mean())
    if pose.rms_px > max(_MISFIT_SIGMAS * (sigma_px or 0.0), _MISFIT_PX, _MISFIT_SHARE * side):
        return MISFIT
    return AMBIGUOUS if pose.ambiguous else ""


def board_attitudes(
    images: Iterable[tuple[int, bytes]], camera: Camera, board: TagBody, sigma_px: float | None = None
) -> BoardAttitudes:
    """Measure a helmet's tag board in pictures: attitudes in the camera's optical frame.

    The last unambiguous attitude guides the next.

    Args:
        images: stamps (ns) and encoded pictures (PNG, JPEG, ...), in time order.
        camera: the camera; pictures of another size raise InputError.
        board: the tags and where they are on the board.
        sigma_px: as in `estimate_pose`.

    Raises:
        InputError: no pictures, none that decodes, no tag of the board ever seen, or no attitude that can be used.
    """
    rows: list[tuple[int, Array, Array]] = []
    dropped: Counter[str] = Counter()
    seen: set[int] = set()
    last_t, last_cRh = 0, None
    for t_ns, found in detections(images, board.family, camera):
        if found is None:
            dropped[UNREADABLE] += 1
            continue
        seen.update(found.ids.tolist())
        fresh = last_cRh is not None and 0 <= t_ns - last_t <= _FRESH_NS
        pose = estimate_pose(camera, board, found, sigma_px, expected=last_cRh if fresh else None)
        problem = UNSEEN if pose is None else _problem(pose, found, sigma_px)
        if pose is None or problem:
            dropped[problem] += 1
            continue
        rows.append((t_ns, pose.cRb, pose.covariance[:3, :3]))
        if pose.decided:
            last_t, last_cRh = t_ns, pose.cRb
    if not rows:
        raise InputError(_why_nothing(dropped, seen, board))
    stamps, attitudes, covariances = zip(*rows, strict=True)
    return BoardAttitudes(np.array(stamps, dtype=np.int64), np.array(attitudes), np.array(covariances), dict(dropped))


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
