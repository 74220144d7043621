"""Which pictures of a los recording serve, and where a target is found anew."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.los.recording import LosData

# After a gap longer than this, s, the camera may hold on to another target.
_LOST = 0.5
# A gap in gyro or gimbal longer than so many sample intervals is no sampling jitter.
_GAP = 5.0
_FEWEST_PICTURES = 10
# Times are differences of stamps, which are whole ns: they are told apart beyond this, s.
_ROUNDING = 1e-9
# Pictures that a target's first one has to agree with.
_FOLLOWERS = 5


def select_pictures(
    data: LosData, sigma: Array, margin: float
) -> tuple[NDArray[np.intp], NDArray[np.bool_], dict[str, int]]:
    """The pictures used, which of them are the first of their target, and what was left out.

    `margin`, s, is left out on either side of a gap in which the gimbal may have turned to another target.
    """
    t = data.image_t
    outside = (t < max(data.gyro_t[0], data.gimbal_t[0])) | (t > min(data.gyro_t[-1], data.gimbal_t[-1]))
    blind = ~outside & (_in_gap(data.gimbal_t, t) | _in_gap(data.gyro_t, t))
    rows = np.flatnonzero(~outside & ~blind)
    chains = np.split(rows, np.flatnonzero(_first_of_target(data, rows))[1:])
    close, early, lone = (np.zeros(len(t), dtype=bool) for _ in range(3))
    starts = np.zeros(len(t), dtype=bool)
    for i, chain in enumerate(chains):
        after = t[chain] - t[chain[0]] if i > 0 else np.inf
        before = t[chain[-1]] - t[chain] if i < len(chains) - 1 else np.inf
        close[chain] = np.minimum(after, before) < margin - _ROUNDING
        left = chain[~close[chain]]
        wrong = _wrong_before_followers(data.error[left, :2], sigma[left])
        early[left[:wrong]] = True
        if len(left) - wrong < 2:
            lone[left[wrong:]] = True
        else:
            starts[left[wrong]] = True
    keep = rows[~(close | early | lone)[rows]]
    if len(keep) < _FEWEST_PICTURES:
        raise InputError(
            f"only {len(keep)} of {len(t)} LOS errors can be used, at least {_FEWEST_PICTURES} are needed: "
            f"{int(outside.sum())} lie outside the records of gyro and gimbal, {int(blind.sum())} in their gaps, "
            f"{int(lone.sum())} stand alone; check the topics and their clocks"
        )
    reasons = {
        "LOS error outside the records of gyro and gimbal": outside,
        "LOS error in a gap of gyro or gimbal": blind,
        "LOS error beside a gap, where the time offset cannot be followed": close,
        "LOS error disagrees with those after it where a target is found": early,
        "LOS error alone between gaps": lone,
    }
    return keep, starts[keep], {reason: int(mask.sum()) for reason, mask in reasons.items() if mask.any()}


def _in_gap(t: Array, at: Array) -> NDArray[np.bool_]:
    """Whether times lie between two samples that are too far apart."""
    step = np.diff(t)
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(step) - 1)
    return np.asarray(step[i] > _GAP * np.median(step))


def _first_of_target(data: LosData, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Where a chain starts: after a gap in which the target may have changed, and after a gap of the gyro."""
    starts = np.ones(len(rows), dtype=bool)
    if len(rows) < 2:
        return starts
    step = np.diff(data.image_t[rows])
    gyro_step = np.diff(data.gyro_t)
    gaps = data.gyro_t[:-1][gyro_step > _GAP * np.median(gyro_step)]
    gaps_before = np.searchsorted(gaps, data.image_t[rows])
    starts[1:] = (step > max(_LOST, _GAP * float(np.median(step)))) | (np.diff(gaps_before) > 0)
    return starts


def _wrong_before_followers(error: Array, sigma: Array) -> int:
    """How many LOS errors at the start of a chain disagree with the median of those that follow."""
    for i in range(len(error) - _FOLLOWERS):
        after = error[i + 1 : i + 1 + _FOLLOWERS]
        drift = np.median(np.abs(np.diff(after, axis=0)), axis=0)
        if np.all(np.abs(error[i] - np.median(after, axis=0)) < 6.0 * sigma[i] + _FOLLOWERS * drift):
            return i
    return 0
