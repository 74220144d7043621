"""The published calibration of a gyro-stabilised line of sight: recursive least squares on LOS error rates.

CN102288133B: the LOS error is differenced over each interval between pictures, and X = [px, gx, gy, dz] follows from
[dw_x; dw_z] = H X by recursive least squares with forgetting factor 1. The publication takes the gyro as free of bias
and leaves out that the camera rolls about its line of sight. H as published lacks -sin(eps) eta' in H2,1; `exact` adds
it. Methods page, section 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array, interpolated
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import ChiSquare, Estimate, History, Problem, Residuals
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.methods.noise import typical
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

NAMES = ("delta_px", "delta_gx", "delta_gy", "delta_z")


@dataclass(frozen=True, eq=False)
class LosLeastSquares:
    """Estimates of the published least squares after each interval between pictures.

    Attributes:
        t: (n,) ends of the intervals, s from the session's start.
        values: (n, 4) px, gx, gy, dz, rad.
        covariance: (n, 4, 4) if the rates' noise were white with the sigma given, rad^2.
        residuals: (n, 2) rates minus H X with the X before this interval, rad/s.
        sigmas: (n,) of those by noise and by the X before, rad/s per component (root mean square).
    """

    t: Array
    values: Array
    covariance: Array
    residuals: Array
    sigmas: Array


def recursive_least_squares(
    data: LosData, los_sigma: float = 2e-5, initial_sigma: float = 0.1, exact: bool = False
) -> LosLeastSquares:
    """Run the published recursive least squares over a session.

    Args:
        los_sigma: noise of one LOS error, rad; it scales the covariance alone.
        initial_sigma: of each angle before any measurement, rad.
        exact: H2,1 with the term that the publication leaves out.

    Raises:
        InputError: fewer than two pictures lie within the gyro's and the gimbal's records.
    """
    t, measured, H = rates(data, exact)
    variance = 2.0 * (los_sigma / np.diff(t)) ** 2
    x, P = np.zeros(4), initial_sigma**2 * np.eye(4)
    values, covariances, residuals, sigmas = [], [], [], []
    for y, h, r in zip(measured, H, variance, strict=True):
        innovation = y - h @ x
        S = h @ P @ h.T + r * np.eye(2)
        gain = P @ h.T @ np.linalg.inv(S)
        sigmas.append(np.sqrt(0.5 * np.trace(S)))
        x = x + gain @ innovation
        P = P - gain @ h @ P
        P = 0.5 * (P + P.T)
        values.append(x)
        covariances.append(P)
        residuals.append(innovation)
    return LosLeastSquares(t[1:], np.array(values), np.array(covariances), np.array(residuals), np.array(sigmas))


def published_estimate(data: LosData, config: Config, problem: Problem) -> Estimate:
    """Run the published filter as a solver of the problem, for four mounting angles without a gyro bias."""
    sigma = first_given(config.noise.los_error, typical(data.error_cov, 0, 1), DEFAULT_NOISE.los_error)
    result = recursive_least_squares(data, sigma)
    keep = [i for i, name in enumerate(NAMES) if name in {q.name for q in problem.quantities}]
    covariance = result.covariance[:, keep][:, :, keep]
    whitened = result.residuals / result.sigmas[:, None]
    square, dof = float((whitened**2).sum()), float(whitened.size)
    return Estimate(
        solver="published",
        names=tuple(NAMES[i] for i in keep),
        values=result.values[-1, keep],
        covariance=covariance[-1],
        converged=True,
        message="all LOS error rates used",
        residuals={"los rate": Residuals(result.t, whitened, np.ones(len(whitened), dtype=bool))},
        chi_square=ChiSquare(square, dof, {"los rate": (square, dof)}),
        history=History(result.t, result.values[:, keep], np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))),
    )


def rates(data: LosData, exact: bool = False) -> tuple[Array, Array, Array]:
    """Stamps of the pictures (n + 1,), s, LOS error rates between them (n, 2), rad/s, and mean H (n, 2, 4)."""
    start = max(data.gyro_t[0], data.gimbal_t[0])
    stop = min(data.gyro_t[-1], data.gimbal_t[-1])
    inside = (data.image_t >= start) & (data.image_t <= stop)
    if inside.sum() < 2:
        raise InputError(
            f"only {int(inside.sum())} of {len(inside)} LOS errors lie within the records of gyro and gimbal; at least "
            "2 are needed: check the topics and their clocks"
        )
    t, error = data.image_t[inside], data.error[inside, :2]
    middle = data.gyro_t
    azimuth, elevation = interpolated(middle, data.gimbal_t, data.gimbal).T
    H = sensitivity(azimuth, elevation, data.gyro, exact)
    steps = 0.5 * np.diff(middle)[:, None, None] * (H[1:] + H[:-1])
    integral = np.concatenate([np.zeros((1, 8)), np.cumsum(steps.reshape(-1, 8), axis=0)])
    at_pictures = interpolated(t, middle, integral)
    duration = np.diff(t)[:, None]
    return t, np.diff(error, axis=0) / duration, (np.diff(at_pictures, axis=0) / duration).reshape(-1, 2, 4)


def sensitivity(azimuth: Array, elevation: Array, rate: Array, exact: bool = False) -> Array:
    """Jacobian H (n, 2, 4) of LOS rates by mounting angles, at gimbal angles (n,), rad, and rates (n, 3)."""
    s, c, se, ce = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    wx, wy, wz = rate.T
    zero = np.zeros_like(s)
    first = (s * wx - c * wy) / ce if exact else ce * s * wx - ce * c * wy - se * wz
    rows = [
        [zero, -s * wz, c * wz, c * wy - s * wx],
        [first, se * c * wz + ce * wy, -ce * wx + se * s * wz, se * c * wx + se * s * wy],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
