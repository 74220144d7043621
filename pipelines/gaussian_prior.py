"""Gaussian priors of parameters from outside the data sheets, such as an earlier calibration."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.factors.array import Array

# Of correlated numbers, the least variance of a combination that counts as known, in their own.
_LEAST = 1e-14
# Eigenvalues of a correlation matrix below this share of the largest are rounding.
_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Gaussian prior of parameters by name, which replaces their default priors.

    Attributes:
        names: of the numbers.
        mean: (n,) SI.
        covariance: (n, n); a number whose row is zero is exactly its mean.
        source: where it is from, for people; empty: the config.
        recordings: SHA-256 of each recording behind it, if it is an earlier calibration.
    """

    names: tuple[str, ...]
    mean: Array
    covariance: Array
    source: str = ""
    recordings: tuple[str, ...] = ()

    def of(self, names: Collection[str]) -> GaussianPrior:
        """Return the marginal distribution of those of the named parameters that the prior has."""
        kept = [i for i, name in enumerate(self.names) if name in names]
        rows = np.array(kept, dtype=np.intp)
        known = tuple(self.names[i] for i in kept)
        return GaussianPrior(known, self.mean[rows], self.covariance[np.ix_(rows, rows)], self.source, self.recordings)

    def given(self, known: Mapping[str, float]) -> GaussianPrior:
        """Return the conditional distribution of the other parameters, given exact values of some."""
        rest = self.of([name for name in self.names if name not in known])
        one, other = (np.array([(n in known) is among for n in self.names], dtype=bool) for among in (False, True))
        scale = np.where(self.sigmas > 0.0, self.sigmas, 1.0)
        C = self.covariance / np.outer(scale, scale)
        gain = C[np.ix_(one, other)] @ np.linalg.pinv(C[np.ix_(other, other)], rtol=_RANK, hermitian=True)
        off = (np.array([known[name] for name in self.names if name in known]) - self.mean[other]) / scale[other]
        lost = np.outer(scale[one], scale[one]) * (gain @ C[np.ix_(other, one)])
        return replace(rest, mean=rest.mean + scale[one] * (gain @ off), covariance=rest.covariance - lost)

    @property
    def means(self) -> dict[str, float]:
        """Mean of each parameter, by name."""
        return dict(zip(self.names, self.mean.tolist(), strict=True))

    @property
    def sigmas(self) -> Array:
        """Standard deviations (n,)."""
        return np.sqrt(np.diag(self.covariance))


def independent(
    names: Sequence[str], mean: Sequence[float], sigmas: Sequence[float], source: str = ""
) -> GaussianPrior:
    """Return a Gaussian prior without correlations."""
    return GaussianPrior(
        tuple(names), np.array(mean, dtype=float), np.diag(np.square(np.array(sigmas, dtype=float))), source
    )


def root_of_information(correlation: Array, sigmas: Array) -> Array:
    """Return a square root R (n, n) of the information R'R of numbers with these correlations and sigmas (n,)."""
    eigenvalues, vectors = np.linalg.eigh(correlation)
    return np.asarray((vectors / np.sqrt(np.maximum(eigenvalues, _LEAST))).T / sigmas)
