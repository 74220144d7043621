"""Error budget: contribution of data-sheet figures to the sigmas of weak parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.problem import Array, Quantity

# A figure with at least this share of a variance is worth stating better; the largest ones are reported.
_MIN_SHARE, _MAX_REPORTED = 0.2, 3


def dominant_priors(quantities: Sequence[Quantity], covariance: Array) -> Iterator[Finding]:
    """Data-sheet figures that make most of the variance of weak parameters, the largest share first.

    The share of a figure is the part of a variance that conditioning on its nuisance parameters removes:
    P_wn P_nn^-1 P_nw over P_ww.

    Args:
        quantities: of the covariance, in its order.
        covariance: (n, n).
    """
    variances = np.diag(covariance)
    weak = [i for i, q in enumerate(quantities) if q.judged and variances[i] > q.require**2]
    figures: dict[str, list[int]] = {}
    for i, q in enumerate(quantities):
        if q.sheet and variances[i] > 0.0:
            figures.setdefault(q.sheet, []).append(i)
    shares = {}
    for figure, rows in figures.items():
        across = covariance[np.ix_(weak, rows)]
        removed = across @ np.linalg.pinv(covariance[np.ix_(rows, rows)], hermitian=True) @ across.T
        shares[figure] = float(max(np.diag(removed) / variances[weak], default=0.0))
    dominant = [figure for figure in sorted(shares, key=lambda figure: -shares[figure]) if shares[figure] > _MIN_SHARE]
    for figure in dominant[:_MAX_REPORTED]:
        evidence = {"figure": figure, "stated": quantities[figures[figure][0]].scale, "share": shares[figure]}
        yield Finding("dominant_prior", Severity.WEAK, evidence)
