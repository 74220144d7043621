"""The published helmet-attitude filter: Euler angles and gyro bias in a Kalman filter corrected by vision.

"Comprehensive measurement of head motion based on MIMU", Electronics Optics & Control 2018(4); its formulas were lost,
so this is the standard form that it names. It knows neither mounts nor a time offset: v is taken as h and b as c. Euler
angles as published: vRb = Rx(roll) Ry(pitch) Rz(yaw) with the passive matrices Rx(a) = Exp(a ex).T and so on.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, interpolated
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Attitudes, ChiSquare, Estimate, History, Problem, Residuals
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

# The Euler rates divide by cos(pitch). Nearer than this to pitch +-90 deg (rad) they divide by the cosine held here.
_NEAREST_TO_VERTICAL = np.deg2rad(5.0)
# Sigma of the bias before any measurement, rad/s.
_BIAS_SIGMA = 0.05
# Bias estimates of which the mean is reported, on an axis where they scatter by more than this, rad/s.
_SMOOTHED, _SMOOTHING_SIGMA = 25, 2e-3


@dataclass(frozen=True)
class HeadFilterResult:
    """State of the published filter at each vision frame, after its update.

    Attributes:
        t: (K,) stamps of the vision frames used, s from the session's start.
        wxyz: (K, 4) attitude bRv.
        bias: (K, 3) gyro bias, rad/s.
        bias_sigma: (K, 3) its standard deviation, rad/s.
        innovation: (K, 3) vision minus prediction in yaw, pitch, roll, rad; zero at the first frame.
        innovation_covariance: (K, 3, 3) what the filter expected of it, rad^2.
    """

    t: Array
    wxyz: Array
    bias: Array
    bias_sigma: Array
    innovation: Array
    innovation_covariance: Array


def euler_kalman_filter(
    data: HeadData,
    gyro_density: float,
    bias_walk: float,
    vision_sigma: float,
) -> HeadFilterResult:
    """Run the published filter over a session, from the first vision frame to the last within the gyro's record.

    Within 5 degrees of pitch +-90 the Euler rates are evaluated with |cos(pitch)| held at its value there. The filter
    then stays finite, but its covariance knows nothing of what the held cosine leaves out: the attitude is off by
    degrees afterwards and comes back slowly, over tens of seconds if the head went over the vertical.

    Args:
        data: the session; with no platform gyro the platform is at rest.
        gyro_density: white noise of the helmet gyro, rad/s/sqrt(Hz).
        bias_walk: random walk of its bias, rad/s/sqrt(s).
        vision_sigma: noise of the vision angles, rad per angle.

    Raises:
        InputError: no vision frame lies within the gyro's time span.
    """
    inside = (data.vision_t >= data.head_t[0]) & (data.vision_t <= data.head_t[-1])
    if not inside.any():
        raise InputError("vision and helmet gyro do not overlap in time: the published filter has nothing to do")
    t, measured = data.vision_t[inside], so3.angles(data.vision_wxyz[inside])[:, ::-1]  # yaw, pitch, roll
    x = np.concatenate([measured[0], np.zeros(3)])
    P = np.diag(np.repeat([vision_sigma**2, _BIAS_SIGMA**2], 3))
    R = vision_sigma**2 * np.eye(3)
    states, sigmas, innovations, expected = [x], [np.sqrt(np.diag(P))], [np.zeros(3)], [R]
    for k, steps in enumerate(_steps(data, t), start=1):
        for dt, w_iv, w_ib in steps:
            x, P = _predict(x, P, dt, w_iv, w_ib, gyro_density, bias_walk)
        innovation = _nearest_angles(measured[k], x[:3])
        S = P[:3, :3] + R
        gain = P[:, :3] @ np.linalg.inv(S)
        x = x + gain @ innovation
        P = P - gain @ P[:3]
        P = 0.5 * (P + P.T)
        states.append(x)
        sigmas.append(np.sqrt(np.diag(P)))
        innovations.append(innovation)
        expected.append(S)
    history = np.array(states)
    return HeadFilterResult(
        t=t,
        wxyz=so3.from_angles(history[:, 2::-1]),
        bias=_smooth(history[:, 3:], _SMOOTHED, _SMOOTHING_SIGMA),
        bias_sigma=np.array(sigmas)[:, 3:],
        innovation=np.array(innovations),
        innovation_covariance=np.array(expected),
    )


def published_estimate(data: HeadData, config: Config, problem: Problem) -> Estimate:
    """Run the published filter as a solver of the problem, for the gyro bias at the end of the recording."""
    noise = config.noise
    sigma = noise.vision_attitude
    if sigma is None and data.vision_cov is not None:
        sigma = float(np.sqrt(np.median(np.trace(data.vision_cov, axis1=1, axis2=2)) / 3.0))
    result = euler_kalman_filter(
        data,
        first_given(noise.gyro_density, data.gyro_density, DEFAULT_NOISE.gyro_density),
        first_given(noise.gyro_bias_walk, DEFAULT_NOISE.gyro_bias_walk),
        first_given(sigma, DEFAULT_NOISE.vision_attitude),
    )
    names = tuple(q.name for q in problem.quantities if q.name.startswith("gyro_bias"))
    # The first frame starts the filter; from the second on the innovations say whether it is consistent.
    whitened = np.linalg.solve(np.linalg.cholesky(result.innovation_covariance), result.innovation[..., None])[1:, :, 0]
    square, dof = float((whitened**2).sum()), float(whitened.size)
    return Estimate(
        solver="published",
        names=names,
        values=result.bias[-1],
        covariance=np.diag(result.bias_sigma[-1] ** 2),
        converged=True,
        message="all vision frames used",
        residuals={"vision": Residuals(result.t[1:], whitened, np.ones(len(whitened), dtype=bool))},
        chi_square=ChiSquare(square, dof, {"vision": (square, dof)}),
        history=History(result.t, result.bias, result.bias_sigma),
        attitudes=Attitudes(result.t, result.wxyz),
    )


def _smooth(bias: Array, window: int, threshold: float) -> Array:
    """Replace rows by the mean of the last `window` rows, (K, 3), where their standard deviation exceeds a threshold.

    It is reported alone: fed back into the filter, the mean is the delay that sets an integral loop swinging (attitude
    error up to six times as large).
    """
    padded = np.concatenate([np.repeat(bias[:1], window - 1, axis=0), bias])
    recent = np.lib.stride_tricks.sliding_window_view(padded, window, axis=0)
    return np.asarray(np.where(recent.std(axis=-1) > threshold, recent.mean(axis=-1), bias))


def euler_rates(angles: Array, w_iv: Array, w_ib: Array) -> tuple[Array, Array, Array]:
    """Rates of yaw, pitch, roll, (3,) rad/s, with their derivatives (3, 3) by the angles and by w_iv.

    Inverts w_bv = [roll', 0, 0] + Rx [0, pitch', 0] + Rx Ry [0, 0, yaw'] with w_bv = w_iv - vRb w_ib, all in frame v.
    """
    (sy, sp, sr), (cy, cp, cr) = np.sin(angles), np.cos(angles)
    held = np.copysign(max(abs(cp), np.sin(_NEAREST_TO_VERTICAL)), cp)
    to_rates = np.array([[0.0, sr / held, cr / held], [0.0, cr, -sr], [1.0, sr * sp / held, cr * sp / held]])
    # The axes, in v, about which yaw, pitch and roll turn; turning about axis a changes vRb w_ib by -a x vRb w_ib.
    axes = np.array([[-sp, sr * cp, cr * cp], [0.0, cr, -sr], [1.0, 0.0, 0.0]])
    vRb = np.array(
        [
            [cy * cp, sy * cp, -sp],
            [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr],
            [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr],
        ]
    )
    w_ib_in_v = vRb @ w_ib
    p, q, r = w_iv - w_ib_in_v
    up, across = q * sr + r * cr, q * cr - r * sr
    rates = np.array([up / held, across, p + up * sp / held])
    by_angles = np.array(
        [
            [0.0, up * sp / held**2, across / held],
            [0.0, 0.0, -up],
            [0.0, up / held**2, across * sp / held],
        ]
    )
    return rates, by_angles + to_rates @ so3.cross(axes, w_ib_in_v).T, to_rates


def _predict(
    x: Array, P: Array, dt: float, w_iv: Array, w_ib: Array, gyro_density: float, bias_walk: float
) -> tuple[Array, Array]:
    """Predict state and covariance by one first-order step."""
    rates, by_angles, by_rate = euler_rates(x[:3], w_iv - x[3:], w_ib)
    F = np.eye(6)
    F[:3, :3] += dt * by_angles
    F[:3, 3:] = -dt * by_rate
    Q = dt * bias_walk**2 * np.eye(6)
    Q[:3, :3] = dt * gyro_density**2 * by_rate @ by_rate.T
    return np.concatenate([x[:3] + dt * rates, x[3:]]), F @ P @ F.T + Q


def _nearest_angles(measured: Array, predicted: Array) -> Array:
    """Measured minus predicted Euler angles, for the nearer of the two equivalent triples."""
    yaw, pitch, roll = measured
    twins = np.array([measured, [yaw + np.pi, np.pi - pitch, roll + np.pi]])
    difference = (twins - predicted + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(difference[np.argmin((difference**2).sum(axis=1))])


def _steps(data: HeadData, vision_t: Array) -> list[list[tuple[float, Array, Array]]]:
    """Integration steps (dt, w_iv, w_ib) of each interval between vision frames, from gyro stamp to gyro stamp.

    A sample is the mean rate about its stamp, so each step takes the rate at its middle (trapezoid).
    """
    stamps = np.union1d(vision_t, data.head_t[(data.head_t > vision_t[0]) & (data.head_t < vision_t[-1])])
    middle, dt = 0.5 * (stamps[1:] + stamps[:-1]), np.diff(stamps)
    w_iv = interpolated(middle, data.head_t, data.head_gyro)
    if data.platform_t is None or data.platform_gyro is None:
        w_ib = np.zeros_like(w_iv)
    else:
        w_ib = interpolated(middle, data.platform_t, data.platform_gyro)
    ends = np.searchsorted(stamps, vision_t)
    steps = list(zip(dt.tolist(), w_iv, w_ib, strict=True))
    return [steps[a:b] for a, b in pairwise(ends)]
