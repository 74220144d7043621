"""Overlapping Allan deviation with confidence intervals.

IEEE Std 952-1997, annex C, names the noises of an inertial sensor by their Allan variance (tau: averaging time):

    quantisation of the integral  Q    3 Q^2 / tau^2
    white noise                   N    N^2 / tau
    bias instability              B    (2 ln 2 / pi) B^2
    rate random walk              K    K^2 tau / 3

The estimator and its equivalent degrees of freedom follow Riley, Howe, "Handbook of frequency stability analysis", NIST
SP 1065, 2008, 5.2.4, and Greenhall, Riley, "Uncertainty of stability variances based on finite differences", PTTI 2003:
the covariance of the second differences that are averaged follows from the generalised autocovariance s_x of the
integrated signal. Here s_x is that of all four noises together, so that no dominant one has to be chosen at each tau.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array
from alidade.factors.chi_square import interval

NOISES = ("Q", "N", "B", "K")

# An averaging time is at most this part of the longest piece: beyond it the estimate says nothing.
_LONGEST = 0.25
# Lags the covariance is summed at, per averaging time; and how many averaging times away it has died out.
_LAGS, _REACH = 32, 12
_CONFIDENCE = 0.95
# So many differences fit the cache, and are small enough that their memory is used again.
_BLOCK = 1 << 13


@dataclass(frozen=True, eq=False)
class AllanCurve:
    """Allan deviation (n,) at averaging times tau (n,), s.

    terms: how many differences each is the mean of; pieces: the samples of each piece of the record.
    """

    tau: Array
    deviation: Array
    terms: Array
    interval_s: float
    pieces: tuple[int, ...]


def allan_curve(pieces: Sequence[Array], interval_s: float) -> AllanCurve:
    """Compute the overlapping Allan deviation at averaging times in octaves.

    Args:
        pieces: samples of a rate, each piece evenly spaced by interval_s; the differences of all are averaged.
        interval_s: s.
    """
    longest = max(len(piece) for piece in pieces)
    factors = 2 ** np.arange(max(1, int(np.log2(max(2.0, _LONGEST * longest))) + 1))
    squares, terms = np.zeros(len(factors)), np.zeros(len(factors))
    for piece in pieces:
        # A sum from which the mean is taken keeps its digits.
        integral = np.concatenate([[0.0], np.cumsum(piece - piece.mean())])
        for i, m in enumerate(factors[2 * factors <= len(piece)].tolist()):
            squares[i] += _second_differences_squared(integral, m)
            terms[i] += len(integral) - 2 * m
    usable = terms > 0
    factors, squares, terms = factors[usable], squares[usable], terms[usable]
    deviation = np.sqrt(squares / (2.0 * terms)) / factors
    return AllanCurve(
        interval_s * factors.astype(float), deviation, terms, interval_s, tuple(len(piece) for piece in pieces)
    )


def allan_variance(tau: Array, squares: Array) -> Array:
    """Allan variance (n,) of the model with Q^2, N^2, B^2, K^2 in `squares` (4,), at tau (n,), s."""
    flat = np.full(len(tau), 2.0 * np.log(2.0) / np.pi)
    return np.asarray(np.stack([3.0 / tau**2, 1.0 / tau, flat, tau / 3.0], axis=1) @ squares)


def confidence(curve: AllanCurve, squares: Array) -> tuple[Array, Array, Array]:
    """Equivalent degrees of freedom and 95 % interval (low, high) of each Allan deviation, (n,) each.

    Args:
        curve: the estimate.
        squares: Q^2, N^2, B^2, K^2 of the noise, which the degrees of freedom depend on.
    """
    dof = np.array([_degrees_of_freedom(curve, tau, squares) for tau in curve.tau])
    bounds = np.sqrt([interval(_CONFIDENCE, each) for each in dof])
    return dof, curve.deviation * bounds[:, 0], curve.deviation * bounds[:, 1]


def _second_differences_squared(integral: Array, m: int) -> float:
    """Sum of the squared second differences of an integrated signal over m samples."""
    count, total = len(integral) - 2 * m, 0.0
    for start in range(0, count, _BLOCK):
        stop = min(start + _BLOCK, count)
        second = integral[start + 2 * m : stop + 2 * m] + integral[start:stop]
        second -= 2.0 * integral[start + m : stop + m]
        total += float(second @ second)
    return total


def _degrees_of_freedom(curve: AllanCurve, tau: float, squares: Array) -> float:
    """Equivalent degrees of freedom of an Allan variance: twice the squared mean over the variance."""
    m = round(tau / curve.interval_s)
    # Longer averages are taken at a coarser grid of lags, on which the covariance is as smooth. That of quantisation is
    # not, and gets too few degrees of freedom there: where it matters, tau is short.
    step = max(1, m // _LAGS)
    total = weighted = 0.0
    for samples in curve.pieces:
        terms = samples + 1 - 2 * m
        if terms <= 0:
            continue
        lags = np.arange(0, min(terms, _REACH * m + 1), step)
        covariance = _second_difference_covariance(curve.interval_s * lags.astype(float), tau, squares)
        weights = (terms - lags) * np.where(lags > 0, 2.0, 1.0)
        weighted += float(weights @ (covariance / covariance[0]) ** 2) * step
        total += terms
    return max(1.0, total**2 / weighted)


def _second_difference_covariance(lag: Array, tau: float, squares: Array) -> Array:
    """Covariance (n,) of second differences (span tau, s) of the integral, at lags (n,), s."""
    out = np.zeros(len(lag))
    for shift, factor in ((-2, 1.0), (-1, -4.0), (0, 6.0), (1, -4.0), (2, 1.0)):
        out += factor * _integral_covariance(np.abs(lag + shift * tau), tau, squares)
    return out


def _integral_covariance(t: Array, tau: float, squares: Array) -> Array:
    """Generalised autocovariance (n,) of the integrated noise at times t (n,) >= 0, s."""
    q, n, b, k = squares
    # A time of zero but for rounding.
    same = t < 1e-6 * tau
    log = np.log(np.where(same, tau, t) / tau)
    return np.asarray(q * same - n * t / 2.0 + b * t**2 * log / (2.0 * np.pi) + k * t**3 / 12.0)
