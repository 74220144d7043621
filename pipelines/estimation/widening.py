"""Estimates with an error in their covariance that their solution does not have, and under wider priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.estimation.problem import Estimate, Quantity, SqrtInformation


def widened(
    estimate: Estimate, source: str, columns: Array, since: float = -np.inf, apart: Array | None = None
) -> Estimate:
    """Add a source of error to an estimate: its covariance becomes P + S S'.

    Whoever reads the estimate reads that covariance: its history from a time on, the budget, and the square-root
    information from which a joint calibration is made.

    Args:
        estimate: of n numbers.
        source: in the budget.
        columns: S (n, m).
        since: s, from which on the error is there.
        apart: S (n, m) without the device's priors, which the square-root information has not; None: `columns`.
    """
    sigmas = np.linalg.norm(columns, axis=1)
    covariance = estimate.covariance + columns @ columns.T
    history, budget = estimate.history, estimate.budget
    if history is not None:
        after = (history.time >= since)[:, None]
        history = replace(history, sigmas=np.where(after, np.hypot(history.sigmas, sigmas), history.sigmas))
    if budget is not None:
        share = dict(zip(estimate.names, sigmas**2 / np.maximum(np.diag(covariance), 1e-300), strict=True))
        budget = {name: _with_share(shares, source, float(share[name])) for name, shares in budget.items()}
    sqrt_info = estimate.sqrt_info
    if sqrt_info is not None:
        rows = [estimate.names.index(name) for name in sqrt_info.names]
        apart = columns if apart is None else apart
        sqrt_info = marginalised(sqrt_info, (apart / estimate.inflations[:, None])[rows])
    return replace(estimate, covariance=covariance, history=history, budget=budget, sqrt_info=sqrt_info)


def by_wider_priors(
    quantities: Sequence[Quantity], times: Array, values: Array, P: Array
) -> tuple[Array, Array] | None:
    """Shift (k, n) and S (k, n, m) of k posteriors under wider priors, P + S S'; None where none is wider.

    Widening priors changes the information by numbers on the diagonal (Woodbury 1950), of all of them at once.
    Variances above the priors', as terms of second order may make them, count as the priors'.

    Args:
        quantities: n of them.
        times: (n,) that priors are wider; up to 1 leaves one.
        values, P: (k, n), (k, n, n) the posteriors.
    """
    wide = np.flatnonzero(times > 1.0)
    if not len(wide):
        return None
    priors = np.array([(q.prior_mean, q.prior_sigma or 0.0) for q in quantities])[wide]
    taken = np.sqrt(1.0 - times[wide] ** -2) / priors[:, 1]
    columns = P[:, :, wide] * taken
    left, axes = np.linalg.eigh(np.eye(len(wide)) - columns[:, wide] * taken[:, None])
    axes = axes / np.sqrt(np.maximum(left, (times[wide] ** -2).min()))[:, None]
    gains = columns @ axes
    off = ((values[:, wide] - priors[:, 0]) * taken)[:, None] @ axes
    return (gains @ np.swapaxes(off, 1, 2))[..., 0], gains


def _with_share(shares: Mapping[str, float], source: str, share: float) -> dict[str, float]:
    """Add one source to the shares of a variance and sort, the largest first."""
    if share == 0.0:
        return dict(shares)
    whole = {**{name: (1.0 - share) * each for name, each in shares.items()}, source: share}
    return dict(sorted(whole.items(), key=lambda item: -item[1]))


def marginalised(sqrt_info: SqrtInformation, columns: Array) -> SqrtInformation:
    """Widen a square-root information R (x - at) = d on n numbers x by m independent errors.

    The errors S a, a (m,) unit normal, S `columns` (n, m), are marginalised out of R (x - S a - at) = d.

    Column by column: rows whitened by (I + r r')^-1/2, r = R s.
    """
    R, d = sqrt_info.R, sqrt_info.d
    for step in columns.T:
        r = R @ step
        square = float(r @ r)
        if square > 0.0:
            k = (1.0 - 1.0 / np.sqrt(1.0 + square)) / square
            R, d = R - k * np.outer(r, r @ R), d - k * r * float(r @ d)
    before = [] if sqrt_info.added is None else [sqrt_info.added]
    return replace(sqrt_info, R=R, d=d, added=np.column_stack([*before, columns]))
