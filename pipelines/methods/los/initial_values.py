"""First guesses for the los method's graph: mounting angles, gyro bias, the pictures' clock and attitudes.

They come from pictures a second apart. Linearising at zero angles and zero bias is good enough for a minute; over ten
what they do together would start too far off, and a clock that runs fast or slow would be further off than motion
around the stamps determines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, Mask
from alidade.factors.gimbal import GimbalPath
from alidade.factors.los import LosDirectionFactor
from alidade.factors.preintegration import GyroPath, Increments
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.camera_clock import Clock, Miss, guess_clock, turns_near
from alidade.pipelines.estimation.priors import prior_sigmas
from alidade.pipelines.estimation.problem import Parameter
from alidade.pipelines.estimation.robust import fitted
from alidade.pipelines.methods.los.recording import LosData

# Pictures so far apart, s, are compared, long against their noise, and no more than so many pairs of them.
_SPAN, _MOST_PAIRS = 1.0, 2000
_PASSES = 5
# What is assumed is held at zero by this part of its prior: a gyro's skew, which is not looked for, would pass for ten
# times the roll that a camera may have, and turn the axes of the target's frame with it.
_HELD = 1e-3
# A clock is guessed from fewer pairs.
_CLOCK_PAIRS = 500


def los_direction(measured: Array) -> Array:
    """Unit vectors (n, 3) in c towards the target, from LOS errors phx, phz (n, 2 or more), rad."""
    ahead = np.stack([np.tan(measured[:, 1]), np.ones(len(measured)), -np.tan(measured[:, 0])], axis=1)
    return np.asarray(ahead / np.linalg.norm(ahead, axis=1, keepdims=True))


def los_error(direction: Array) -> Array:
    """LOS errors phx, phz (n, 2), rad, from directions (n, 3) in c."""
    x, y, z = direction.T
    return np.stack([-np.arctan2(z, y), np.arctan2(x, y)], axis=1)


def camera(gimbal: Array, angles: Array, names: tuple[str, ...]) -> Array:
    """Camera attitude cRm (n, 4) at gimbal angles (n, 2) and mounting angles (d,), rad."""
    n = len(gimbal)
    model = LosDirectionFactor(np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2, 2)), gimbal, names)
    return model.camera(np.tile(angles, (n, 1)))


def seen(cRm: Array, measured: Array) -> Array:
    """Attitude tRm (n, 4) from cRm and measured phx, phz, roll (n, 3), rad; a NaN roll counts as zero."""
    y = np.array([0.0, 1.0, 0.0])
    swing = so3.shortest(y, los_direction(measured))
    cRt = so3.multiply(swing, so3.exp(-np.nan_to_num(measured[:, 2])[:, None] * y))
    return so3.multiply(so3.inverse(cRt), cRm)


def initial_attitudes(chains: Sequence[Index], time: Array, cRm: Array, measured: Array, gyro: GyroPath) -> Array:
    """Initial attitudes tRm (n, 4): gyro propagation from a target's first picture, aligned with each picture."""
    out = np.empty((len(time), 4))
    toward = so3.rotate(so3.inverse(cRm), los_direction(measured))
    for chain in chains:
        carried = _carried(time[chain], cRm[chain], measured[chain], gyro)
        expected = so3.rotate(so3.inverse(carried), [0.0, 1.0, 0.0])
        out[chain] = so3.multiply(carried, so3.shortest(toward[chain], expected))
    return out


def _carried(time: Array, cRm: Array, measured: Array, gyro: GyroPath) -> Array:
    """Attitude tRm (n, 4) at one target's pictures, propagated by the gyro from the first picture."""
    turned = gyro.attitude(time)
    return so3.compose(seen(cRm[:1], measured[:1]), so3.inverse(turned[:1]), turned)


def carried_errors(time: Array, cRm: Array, measured: Array, gyro: GyroPath, target_rate: Array) -> Array:
    """LOS errors phx, phz (n, 2), rad, of one target's pictures, predicted by the gyro from the first.

    The target's frame turns at `target_rate` (3,), rad/s.
    """
    tRm = _carried(time, cRm, measured, gyro)
    target = so3.rotate(so3.exp((time - time[0])[:, None] * target_rate), [0.0, 1.0, 0.0])
    return los_error(so3.rotate(so3.multiply(cRm, so3.inverse(tRm)), target))


def guess(
    chains: Sequence[Index],
    time: Array,
    gimbal: Array,
    measured: Array,
    gyro: GyroPath,
    parameters: tuple[Parameter, ...],
    sigma: float,
) -> tuple[Array, Array]:
    """Estimate mounting angles and gyro bias (3,) robustly from LOS errors predicted over one second.

    Args:
        chains: pictures of one target each, as rows of what follows.
        time: (n,) of the pictures, s.
        gimbal: (n, 2) azimuth and elevation there, rad.
        measured: (n, 3) phx, phz, roll.
        gyro: integrated without any bias taken off.
        parameters: mounting angles and bias, with their priors.
        sigma: of one LOS error, rad.
    """
    angles, bias = parameters
    names = tuple(q.name for q in angles.quantities)
    prior = 1.0 / np.concatenate([_sigmas(angles), prior_sigmas(bias)])
    x = np.zeros(len(prior))
    i, j = _pairs(chains, time, _MOST_PAIRS)
    if not len(i):
        return x[: len(names)], x[len(names) :]
    turns, read = gyro.increments(time[i], time[j]), (gimbal[i], gimbal[j])

    def miss(x: Array) -> Array:
        return _miss(x, names, turns, read, measured[i], measured[j])

    x, _ = fitted(lambda _: miss, x, prior, sigma, _PASSES)
    return x[: len(names)], x[len(names) :]


def guess_picture_clock(
    chains: Sequence[Index],
    time: Array,
    begun: float,
    gimbal: GimbalPath,
    measured: Array,
    gyro: GyroPath,
    parameters: tuple[Parameter, ...],
    guessed: tuple[Array, Array],
    sigma: float,
) -> tuple[Clock, tuple[Array, Array, float]]:
    """Estimate the camera's clock with mounting angles, gyro bias and encoder delay from predicted LOS errors.

    Encoders that read late spoil the errors more than late pictures do, which the gimbal stabilises.

    Args:
        chains, time, measured, gyro, sigma: as `guess` has them.
        begun: the recording's first stamp, s.
        gimbal: at all times.
        parameters: mounting angles and bias, and alidade.factors.los.SIGHT_ERRORS, with their priors.
        guessed: mounting angles and bias to begin with.
    """
    angles, bias, sight = parameters
    names = tuple(q.name for q in angles.quantities)
    offset, skew, *_, delay = prior_sigmas(sight)
    prior = 1.0 / np.concatenate([_sigmas(angles), prior_sigmas(bias), [delay, offset, skew]])

    def missing(until: float) -> Callable[[Array], Miss] | None:
        i, j = _pairs([chain[time[chain] - begun <= until] for chain in chains], time, _CLOCK_PAIRS)
        if not len(i):
            return None
        elapsed, pictures = (time[i] - begun, time[j] - begun), (measured[i], measured[j])
        return lambda x: _miss_by_clock(x, names, elapsed, pictures, begun, gimbal, gyro)

    x, last = np.concatenate([*guessed, np.zeros(3)]), float(time[-1]) - begun
    overlap = max(1.0, min(len(time), _CLOCK_PAIRS) * _SPAN / last)
    clock, x = guess_clock(begun, last, x, prior, sigma, missing, overlap)
    return clock, (x[: len(names)], x[len(names) : -3], float(x[-3]))


def _sigmas(angles: Parameter) -> Array:
    """Prior sigmas (d,) of the mounting angles and nuisance parameters, rad."""
    return np.where([q.assumed for q in angles.quantities], _HELD, 1.0) * prior_sigmas(angles)


def _miss_by_clock(
    x: Array,
    names: tuple[str, ...],
    elapsed: tuple[Array, Array],
    measured: tuple[Array, Array],
    begun: float,
    gimbal: GimbalPath,
    gyro: GyroPath,
) -> Miss:
    """Prediction errors as `_miss`, near x, with encoder delay and clock as last three numbers of x.

    The gyro's rotations are computed once.
    """

    def taken(x: Array) -> tuple[Array, Array]:
        clock = Clock(begun, *x[-2:])
        return clock.taken(elapsed[0]), clock.taken(elapsed[1])

    turns_at = turns_near(gyro, *taken(x))

    def miss(x: Array) -> Array:
        before, after = taken(x)
        read = gimbal.at(before - x[-3]), gimbal.at(after - x[-3])
        return _miss(x[:-3], names, turns_at(before, after), read, *measured)

    return miss


def _miss(
    x: Array, names: tuple[str, ...], turns: Increments, gimbal: tuple[Array, Array], before: Array, after: Array
) -> Array:
    """Errors (n, 2), rad, of LOS errors predicted over gyro rotations from earlier LOS errors.

    Args:
        x: mounting angles of these names and bias.
        turns: of the gyro, n of them.
        gimbal: angles (n, 2) before and after, rad.
        before, after: phx, phz, roll (n, 3), rad.
    """
    mount, bias = x[: len(names)], x[len(names) :]
    turn = so3.multiply(turns.wxyz, so3.exp(turns.bias_jacobian @ bias))
    tRm = so3.multiply(seen(camera(gimbal[0], mount, names), before), turn)
    cRm = camera(gimbal[1], mount, names)
    return los_error(so3.rotate(so3.multiply(cRm, so3.inverse(tRm)), [0.0, 1.0, 0.0])) - after[:, :2]


def _pairs(chains: Sequence[Index], time: Array, most: int) -> tuple[Index, Index]:
    """Indices of picture pairs of one target, one second apart, at most about `most` pairs."""
    first, second = [], []
    for chain in chains:
        later = np.searchsorted(time[chain], time[chain] + _SPAN)
        inside = later < len(chain)
        first.append(chain[inside])
        second.append(chain[later[inside]])
    i, j = np.concatenate(first), np.concatenate(second)
    stride = -(-len(i) // most) or 1
    return i[::stride], j[::stride]


# After a gap longer than this, s, the camera may hold on to another target.
_LOST = 0.5
# A gap in gyro or gimbal longer than so many sample intervals is no sampling jitter.
_GAP = 5.0
_FEWEST_PICTURES = 10
# Times are differences of stamps, which are whole ns: they differ beyond this, s.
_ROUNDING = 1e-9
# Pictures that a target's first one has to agree with.
_FOLLOWERS = 5


def select_pictures(data: LosData, sigma: Array, margin: float) -> tuple[Index, Mask, dict[str, int]]:
    """Select the usable pictures; return indices, mask of each target's first one, and exclusion counts.

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


def _in_gap(t: Array, at: Array) -> Mask:
    """Mask of times that lie in a gap between two samples."""
    step = np.diff(t)
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(step) - 1)
    return np.asarray(step[i] > _GAP * np.median(step))


def _first_of_target(data: LosData, rows: Index) -> Mask:
    """Mask of pictures that start a chain, after a gap with a possible change of target or a gyro gap."""
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
    """Number of LOS errors at the start of a chain that disagree with the median of their followers."""
    for i in range(len(error) - _FOLLOWERS):
        after = error[i + 1 : i + 1 + _FOLLOWERS]
        drift = np.median(np.abs(np.diff(after, axis=0)), axis=0)
        if np.all(np.abs(error[i] - np.median(after, axis=0)) < 6.0 * sigma[i] + _FOLLOWERS * drift):
            return i
    return 0
