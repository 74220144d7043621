"""How much of each family of measurements was rejected: a few are outliers, many are a model that does not fit."""

from __future__ import annotations

from collections.abc import Mapping

from alidade.pipelines.estimation.problem import Residuals
from alidade.pipelines.estimation.robust import robust_sigma

# Shares of a family from which on the headline tells of the rejected, and from which on the model is wrong.
_TOLD, _TOO_MANY = 0.1, 0.25
# A family of fewer measurements has no share worth the name.
_FEWEST = 10


def rejected_shares(residuals: Mapping[str, Residuals]) -> dict[str, float]:
    """Family -> rejected share, of families of which more was rejected than outliers are, most first."""
    shares = {family: 1.0 - float(r.used.mean()) for family, r in residuals.items() if len(r.used) >= _FEWEST}
    return dict(sorted(((f, s) for f, s in shares.items() if s > _TOLD), key=lambda each: -each[1]))


def too_many_rejected(residuals: Mapping[str, Residuals]) -> bool:
    """Whether so much of a family was rejected that these can be no outliers."""
    return max(rejected_shares(residuals).values(), default=0.0) > _TOO_MANY


def rejection_sentence(residuals: Mapping[str, Residuals]) -> str:
    """What was rejected, by family; empty when that is no more than outliers are."""
    told = [
        f"{100.0 * share:.0f} % of the {family} measurements were rejected (all of them together would fit a noise "
        f"{robust_sigma(residuals[family].whitened):.2g} times the one stated)"
        for family, share in rejected_shares(residuals).items()
    ]
    return f"{'; '.join(told)}." if told else ""
