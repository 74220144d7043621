"""First guesses for the head method's graph: gyro bias, both mounts and the pictures' clock."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.attitude import SKEW_COLUMN
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.estimation.camera_clock import Clock, Miss, first_span, guess_clock, turns_near
from alidade.pipelines.estimation.priors import prior_sigmas
from alidade.pipelines.estimation.problem import Parameter
from alidade.pipelines.recording.checks import nanoseconds
from alidade.pipelines.recording.pairing import BELONGS, pair

# Rates for the first guess are taken over this time, s: long against vision noise, short against turns.
_GUESS_SPAN = 0.3
_FEWEST_FRAMES = 10
# Pairs of pictures from which the camera's mount, and from which the clock is estimated.
_CAMERA_PAIRS, _CLOCK_PAIRS = 3000, 1000
# Sigmas of the median misfit, each 1 / sqrt(n) of it, by which a camera's mount has to fit better than none.
_CHANCE = 3.0
# What is estimated with the clock: a correction of the mount, rad, the gyro bias, rad/s; offset, s, and skew, s/s.
_MOUNT, _BIAS, _CLOCK = slice(0, 3), slice(3, 6), slice(6, 8)


def guess(gyro: GyroPath, vision_t: Array, iRh: Array, sigma: float) -> tuple[Array, Array]:
    """Initial gyro bias (3,) and mount vRh (4,) from mean rates over short windows: w_v = vRh w_h + bias.

    Rates seen by vision beyond what the gyro's length allows are outliers. The mount is the rotation between the
    rates when the motion is about more than one axis, else the identity.

    Args:
        gyro: the helmet's, integrated without any bias taken off.
        vision_t: (n,) when the pictures were taken, s.
        iRh: (n, 4) what they show, the platform's own attitude before it.
        sigma: of one, rad.
    """
    i, j = _pairs(vision_t, len(vision_t))
    if not len(i):
        return np.zeros(3), so3.identity()
    start, stop = vision_t[i], vision_t[j]
    span = (stop - start)[:, None]
    rate = so3.log(gyro.increments(start, stop).wxyz) / span
    seen = so3.local(iRh[i], iRh[j]) / span
    mismatch = np.abs(np.linalg.norm(rate, axis=1) - np.linalg.norm(seen, axis=1))
    good = mismatch < 0.05 + 5.0 * sigma / span[:, 0]
    if good.sum() < _FEWEST_FRAMES:
        return np.zeros(3), so3.identity()
    rate, seen = rate[good], seen[good]
    a, b = rate - rate.mean(axis=0), seen - seen.mean(axis=0)
    s = np.linalg.svd(a.T @ b, compute_uv=False)
    noise = 2.0 * (sigma / _GUESS_SPAN) ** 2 * len(rate)
    two_axes = s[1] > 3.0 * noise / np.sqrt(len(rate)) and s[1] > 0.01 * s[0]
    vRh = so3.align(a, b) if two_axes else so3.identity()
    return np.median(rate - so3.rotate(vRh, seen), axis=0), vRh


def guess_camera(gyro: GyroPath, platform: GyroPath, vision_t: Array, cRh: Array, sigma: float) -> Array:
    """Estimate a first camera mount cRb (4,), however large, from mean rates of gyros and vision over short windows.

    With u the rate of h relative to c, in c, p the platform's rate and C the mount, the rate w of the helmet's gyro
    with its bias b has |w - b| = |u + C p|: |w|^2 - |u|^2 - |p|^2 = 2 u'C p + 2 b'w + constant, linear in C and b, with
    the platform gyro's bias neglected. C is nearest to the identity where the motion leaves it open. The mount is the
    identity unless the rates agree better with C by `_CHANCE` sigmas of the median misfit.

    Args:
        gyro, platform: integrated without any bias taken off.
        vision_t: (n,) when the pictures were taken, s.
        cRh: (n, 4) what they show.
        sigma: of one, rad.
    """
    i, j = _pairs(vision_t, _CAMERA_PAIRS)
    if len(i) < _FEWEST_FRAMES:
        return so3.identity()
    start, stop = vision_t[i], vision_t[j]
    span = (stop - start)[:, None]
    w, p = (so3.log(each.increments(start, stop).wxyz) / span for each in (gyro, platform))
    u = so3.rotate(cRh[i], so3.local(cRh[i], cRh[j]) / span)
    products = 2.0 * np.einsum("ni,nj->nij", u, p).reshape(-1, 9)
    squares = (w**2).sum(axis=1) - ((u + p) ** 2).sum(axis=1)
    x = np.linalg.lstsq(np.column_stack([products, 2.0 * w, np.ones(len(w))]), squares)[0]

    def misfit(cRb: Array) -> float:
        iRh = so3.compose(platform.attitude(vision_t), so3.inverse(cRb), cRh)
        bias, vRh = guess(gyro, vision_t, iRh, sigma)
        return float(np.median(np.linalg.norm(w - bias - so3.rotate(vRh, so3.local(iRh[i], iRh[j]) / span), axis=1)))

    mount = so3.align(np.eye(3) + x[:9].reshape(3, 3).T, np.eye(3))
    better = misfit(mount) < (1.0 - _CHANCE / np.sqrt(len(w))) * misfit(so3.identity())
    return mount if better else so3.identity()


def guess_picture_clock(
    gyro: GyroPath,
    platform: GyroPath | None,
    elapsed: Array,
    begun: float,
    measured: Array,
    parameters: tuple[Parameter, Parameter, Parameter],
    sigma: float,
) -> Clock:
    """Estimate the camera's clock, gyro bias and mount that fit the helmet's gyro to the pictures; return the clock.

    It is near the delay at which the norms of both rates are correlated most: a fit from zero ends within a swing.

    Args:
        gyro, platform: of helmet and platform, integrated without any bias taken off; None: the platform is at rest.
        elapsed: (n,) stamps of the pictures since the recording's first, s.
        begun: that one, s.
        measured: (n, 4) bRh.
        parameters: the helmet's mount, bias, and the pictures' errors, with their priors.
        sigma: of one picture, rad.
    """
    numbers = zip(parameters, (3, 3, SKEW_COLUMN + 1), strict=True)
    prior = 1.0 / np.concatenate([prior_sigmas(parameter)[:size] for parameter, size in numbers])

    def carried(at: Array, seen: Array) -> Array:
        return seen if platform is None else so3.multiply(platform.attitude(at), seen)

    def missing(until: float) -> Callable[[Array], Miss] | None:
        count = int(np.searchsorted(elapsed, until, side="right"))
        pairs = _pairs(elapsed[:count], _CLOCK_PAIRS)
        return None if len(pairs[0]) < _FEWEST_FRAMES else partial(near, *pairs)

    def near(i: Index, j: Index, x: Array) -> Miss:
        def taken(x: Array) -> tuple[Array, Array]:
            clock = Clock(begun, *x[_CLOCK])
            return clock.taken(elapsed[i]), clock.taken(elapsed[j])

        before, after = taken(x)
        turn = so3.multiply(so3.inverse(carried(before, measured[i])), carried(after, measured[j]))
        turns_at = turns_near(gyro, before, after)

        def miss(x: Array) -> Array:
            turns = turns_at(*taken(x))
            predicted = so3.multiply(turns.wxyz, so3.exp(turns.bias_jacobian @ x[_BIAS]))
            vRh = so3.multiply(mount, so3.exp(x[None, _MOUNT]))
            return so3.local(so3.compose(vRh, turn, so3.inverse(vRh)), predicted)

        return miss

    first = elapsed <= first_span(1.0 / prior[-1])
    at, seen = begun + elapsed[first], measured[first]
    others = () if platform is None else ((nanoseconds(platform.t, 0), platform.read),)
    found = pair(nanoseconds(gyro.t, 0), gyro.read, nanoseconds(at, 0), seen, others)
    offset = found.offset_s if found is not None and found.correlation > BELONGS else 0.0
    bias, mount = guess(gyro, at + offset, carried(at + offset, seen), sigma)
    x = np.concatenate([np.zeros(3), bias, [offset, 0.0]])
    return guess_clock(begun, float(elapsed[-1]), x, prior, sigma, missing)[0]


def _pairs(time: Array, most: int) -> tuple[Index, Index]:
    """Indices of picture pairs about `_GUESS_SPAN` s apart, at most about `most` pairs."""
    stride = max(1, round(_GUESS_SPAN / max(float(np.median(np.diff(time))), 1e-3))) if len(time) > 1 else 1
    i = np.flatnonzero(time[stride:] - time[:-stride] < 2.0 * _GUESS_SPAN)
    i = i[:: -(-len(i) // most) or 1]
    return i, i + stride
