"""Sigmas that survive coloured noise: the variance of an estimate whose residuals are correlated in time.

The estimate errs by L r, L its influence and r the whitened noise. With autocovariance g(k) of r at lag k the variance
of a number is not sum L_i^2 but

    sum over k of g(k) sum over i of L_i+k L_i

(Newey, West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix",
Econometrica 1987, with influence functions in place of regressors). g is that of the residuals, up to the lag where it
has died out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from alidade.pipelines.estimation.problem import Array, Factor, Problem, Residuals
from alidade.pipelines.solvers.influence import FactorRows, Influence

# Families of fewer measurements are too short to tell their colour.
_FEWEST = 100
# A correlation within this many of its sigmas of zero has died out; the first one is asked to be beyond more of them.
_DIED_OUT, _COLOURED = 2.0, 4.0
# Of a recording's length, the longest lag.
_LONGEST = 0.25
# Of a variance in units of a prior's: less is rounding.
_SMALLEST = 1e-18
# Numbers whose rows of L are held at a time.
_AT_A_TIME = 8


def correlations(whitened: Array) -> Array:
    """Autocorrelation (K,) of residuals (n, m) at the lags 1 ... K, until it has died out; empty where it is white."""
    n, m = whitened.shape
    if n < _FEWEST:
        return np.empty(0)
    size = 1 << (2 * n - 1).bit_length()
    power = (np.abs(np.fft.rfft(whitened, size, axis=0)) ** 2).sum(axis=1)
    sums = np.fft.irfft(power, size)[: int(_LONGEST * n)]
    if not sums[0] > 0.0:
        return np.empty(0)
    correlation = sums[1:] / sums[0]
    sigma = float((n * m) ** -0.5)
    if len(correlation) == 0 or correlation[0] < _COLOURED * sigma:
        return np.empty(0)
    small = np.flatnonzero(correlation < _DIED_OUT * sigma)
    return np.asarray(correlation[: small[0] if len(small) else None])


def coloured(factors: Sequence[Factor], values: gtsam.Values) -> dict[str, Array]:
    """Family -> autocorrelation of its residuals, of those that are not white; rejected measurements count as zero.

    Compressed factors do not tell what each measurement did to the estimate: their families are left out.
    """
    found = {}
    compressed = {f.family for f in factors if f.measurement is not None and f.measurement.compress}
    for family in dict.fromkeys(f.family for f in factors if f.measurement is not None):
        if family in compressed:
            continue
        rows = [_residuals(f, values) for f in factors if f.family == family]
        if len({row.shape[1] for row in rows}) == 1 and len(lags := correlations(np.concatenate(rows))):
            found[family] = lags
    return found


def _residuals(factor: Factor, values: gtsam.Values) -> Array:
    assert factor.measurement is not None
    return np.where(factor.measurement.used(values)[:, None], factor.measurement.residuals(values), 0.0)


def inflated_by_innovations(
    problem: Problem, covariance: Array, innovations: Mapping[str, Residuals]
) -> tuple[Array, dict[str, float]]:
    """(n, n) a filter's covariance as its innovations are correlated, and how many of a family count as one.

    A filter does not tell what each measurement did: the family that is correlated most counts for all information
    that does not come from priors.

    Args:
        problem: the graph's.
        covariance: (n, n) of the reported numbers for white noise.
        innovations: whitened, by family.
    """
    lengths = {}
    for family, found in innovations.items():
        lags = correlations(np.where(found.used[:, None], found.whitened, 0.0))
        if len(lags):
            lengths[family] = 1.0 + 2.0 * float(lags.sum())
    if not lengths:
        return covariance, lengths
    free = np.flatnonzero(np.diag(covariance) > 0.0)
    scale, extra = np.array([(problem.quantities[i].scale, problem.quantities[i].extra_sigma) for i in free]).T
    block = np.ix_(free, free)
    variance, vectors = np.linalg.eigh((covariance[block] - np.diag(extra**2)) / np.outer(scale, scale))
    prior = np.diag([0.0 if problem.quantities[i].prior_sigma is None else 1.0 for i in free])
    told = (vectors / np.maximum(variance, _SMALLEST)) @ vectors.T - prior
    information, vectors = np.linalg.eigh(prior + told / max(lengths.values()))
    grown = covariance.copy()
    grown[block] = (vectors / information) @ vectors.T * np.outer(scale, scale) + np.diag(extra**2)
    return grown, lengths


def added_variance(found: Influence, colours: Mapping[str, Array]) -> dict[str, Array]:
    """Family -> (n,) what the colour of its noise adds to the variance of each number, none less than zero.

    Args:
        found: the influence of the residuals.
        colours: see `coloured`.
    """
    added = {family: np.zeros(len(found.names)) for family in colours}
    lengths = dict.fromkeys(colours, 0)
    for f in found.linear.system.factors:
        if f.family in colours and f.measurement is not None:
            lengths[f.family] += len(f.measurement.model.time)
    for start in range(0, len(found.names) if colours else 0, _AT_A_TIME):
        part = found.part(slice(start, start + _AT_A_TIME))
        rows = part.ask(_of_families, list(colours))
        for family, correlation in colours.items():
            L = np.concatenate([each[family] for each in rows if family in each])
            L = L.reshape(lengths[family], -1, len(part.names))
            more = 2.0 * correlation @ _products(L, len(correlation))
            added[family][start : start + len(part.names)] = np.maximum(more, 0.0)
    return added


def _of_families(rows: FactorRows, families: Sequence[str]) -> dict[str, Array]:
    """Family -> influence (m, p) of all its rows, where there are any."""
    found: dict[str, list[Array]] = {}
    for factor, _, row in rows:
        if factor.family in families:
            found.setdefault(factor.family, []).append(row.T)
    return {family: np.concatenate(of) for family, of in found.items()}


def _products(L: Array, lags: int) -> Array:
    """Sums (lags, p) over measurements of L (n, m, p) times itself, 1 ... lags measurements later."""
    size = 1 << (2 * len(L) - 1).bit_length()
    power = (np.abs(np.fft.rfft(L, size, axis=0)) ** 2).sum(axis=1)
    return np.asarray(np.fft.irfft(power, size, axis=0)[1 : lags + 1])


def inflations(problem: Problem, covariance: Array, names: Sequence[str], added: Mapping[str, Array]) -> Array:
    """(n,) by what the sigmas of all reported numbers grow.

    Args:
        problem: the graph's.
        covariance: (n, n) of the reported numbers for white noise.
        names: of the numbers that the added variances are of.
        added: see `added_variance`.
    """
    more = dict(zip(names, np.sum(list(added.values()), axis=0), strict=True)) if added else {}
    variance = np.diag(covariance)
    grown = variance + np.array([more.get(q.name, 0.0) for q in problem.quantities])
    return growth(variance, grown)


def growth(variance: Array, grown: Array) -> Array:
    """(n,) by what sigmas grow with their variances; 1 of what is exactly known."""
    return np.sqrt(np.divide(grown, variance, out=np.ones_like(variance), where=variance > 0.0))
