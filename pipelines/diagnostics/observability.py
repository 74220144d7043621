"""Observability: verdicts per parameter, weak eigen-directions, time to the required accuracy.

The rules are those of the contract, section Verdicts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from alidade.factors.array import Array, Index
from alidade.pipelines.estimation.finding import Finding, Motion, Severity
from alidade.pipelines.estimation.problem import CommonFactor, History, Quantity

Verdict = Literal["fixed", "observable", "prior", "weak", "unobservable"]
_RANKS: tuple[Verdict, ...] = get_args(Verdict)
# Weights of a direction by parameter name -> motion that would determine it.
Advise = Callable[[Mapping[str, float]], Motion]

# A posterior sigma of this fraction of its prior's says that the recording added next to nothing.
UNCHANGED = 0.9
# Weights of a direction below this are left out.
_MIN_WEIGHT = 0.1
# Eigenvectors whose sigmas have a ratio above this are arbitrary mixtures of each other.
_DEGENERATE = 0.9
# Sigma, in prior scales, in place of one that is not a number.
_UNKNOWN = 1e4
# Parts of a recording whose information is compared, and the fewest moments that have a history.
_TENTHS, _MIN_MOMENTS = 10, 20

_DEFAULT_ADVICE = Motion("vary the motion while recording, record longer, or give these parameters a tighter prior")


@dataclass(frozen=True, eq=False)
class Scaling:
    """Factor common to a sensor's numbers and the strength of the measured field, linearised.

    A magnetometer's K and b, and the field, fit as well when all are multiplied by one factor, which only the prior of
    the field's strength determines. K and b in units of that strength, their shape, are what a recording determines.

    Attributes:
        factor: as the quantities have it.
        sigma: of the strength, relative.
        moves: (n,) what one sigma of the strength moves each number by.
        shape: (n, n) covariance of the numbers given the strength: with `moves` squared it is that of the numbers.
    """

    factor: CommonFactor
    sigma: float
    moves: Array
    shape: Array


def scalings(quantities: Sequence[Quantity], covariance: Array, values: Array) -> list[Scaling]:
    """Common factors of quantities, from their covariance (n, n) and values (n,), SI."""
    found = []
    for factor in dict.fromkeys(q.factor for q in quantities if q.factor is not None):
        of = np.array([q.factor == factor and q.assumed for q in quantities])
        strength = np.where(of, values, 0.0)
        gain = strength / max(float(strength @ strength), np.finfo(float).tiny)
        sigma = float(np.sqrt(max(float(gain @ covariance @ gain), 0.0)))
        moves = covariance @ gain / sigma if sigma > 0.0 else np.zeros(len(values))
        found.append(Scaling(factor, sigma, moves, covariance - np.outer(moves, moves)))
    return found


def verdict(quantity: Quantity, sigma: float) -> Verdict:
    """Return the contract's verdict on a parameter with a given posterior sigma, SI."""
    if quantity.prior_sigma == 0.0:
        return "fixed"
    unchanged = sigma >= UNCHANGED * quantity.scale
    if sigma <= quantity.require:
        return "prior" if unchanged else "observable"
    return "unobservable" if unchanged else "weak"


def verdicts(
    quantities: Sequence[Quantity], covariance: Array, findings: Sequence[Finding], values: Array
) -> dict[str, Verdict]:
    """Verdict of each parameter with a required accuracy, or of the sensor's shape where that is required instead.

    Of a solution that rejected more than a quarter of a family, as its findings have it, nothing is `observable`: what
    is left are the measurements that agree with it.

    Args:
        quantities: n of them.
        covariance: (n, n) in their order.
        findings: on the solution.
        values: (n,) in their order.
    """
    sigmas = np.sqrt(np.diag(covariance)).tolist()
    found = {q.name: verdict(q, sigma) for q, sigma in zip(quantities, sigmas, strict=True) if q.judged}
    for scaling in scalings(quantities, covariance, values):
        shape = _shape(scaling, quantities)
        if shape.verdict and any(q.relative and q.factor == scaling.factor for q in quantities):
            found[shape.name] = shape.verdict
    return {name: doubted(each, findings) for name, each in found.items()}


def doubted(found: Verdict, findings: Sequence[Finding]) -> Verdict:
    """Downgrade a verdict by the findings: no solution, or a solution that rejects many measurements.

    Where there is no solution nothing is determined.
    """
    if found != "fixed" and has_no_solution(findings):
        return "unobservable"
    return "weak" if found == "observable" and rejects_many(findings) else found


def has_no_solution(findings: Sequence[Finding]) -> bool:
    """Whether the findings include an unconverged solver, whose values are unusable."""
    return any(each.kind == "not_converged" and each.severity > Severity.NOTE for each in findings)


class DerivedNumber(NamedTuple):
    """Derived number: SENSOR_scale, the relative sigma of the strength, or SENSOR_shape, K and b given the strength.

    Attributes:
        name: as above.
        sigma: relative; of a shape the largest, each in units of what is required of its number.
        require: of sigma; None: nothing is required.
        verdict: as of a parameter; None: nothing is required.
    """

    name: str
    sigma: float
    require: float | None
    verdict: Verdict | None


def derived(
    quantities: Sequence[Quantity], covariance: Array, values: Array, findings: Sequence[Finding]
) -> list[DerivedNumber]:
    """Compute scale and shape of sensors with a scale inseparable from the measured strength.

    Args:
        quantities: n of them.
        covariance: (n, n), finite, in their order.
        values: (n,), SI.
        findings: on the solution.
    """
    both = (each(one, quantities) for one in scalings(quantities, covariance, values) for each in (_scale, _shape))
    return [number._replace(verdict=number.verdict and doubted(number.verdict, findings)) for number in both]


def _scale(scaling: Scaling, quantities: Sequence[Quantity]) -> DerivedNumber:
    """Compute SENSOR_scale, with the strength accuracy at which no judged number misses its own requirement."""
    moved = zip(quantities, _moved(scaling, quantities).tolist(), strict=True)
    rows = [(q, m) for q, m in moved if m > 0.0 and q.factor == scaling.factor]
    require = min((scaling.sigma * q.require / m for q, m in rows), default=None)
    worst = None if require is None else _worst(verdict(q, m) for q, m in rows if m > q.require)
    return DerivedNumber(scaling.factor.scale, scaling.sigma, require, worst)


def _shape(scaling: Scaling, quantities: Sequence[Quantity]) -> DerivedNumber:
    sigmas = np.sqrt(np.maximum(np.diag(scaling.shape), 0.0)).tolist()
    own = [(q, s) for q, s in zip(quantities, sigmas, strict=True) if q.factor == scaling.factor and not q.assumed]
    require = scaling.factor.require
    sigma = require * max((s / q.require for q, s in own), default=0.0)
    return DerivedNumber(scaling.factor.shape, sigma, require, _worst(verdict(q, s) for q, s in own))


def _moved(scaling: Scaling, quantities: Sequence[Quantity]) -> Array:
    """Shift (n,) of each judged number per sigma of a field's strength; 0 for the others."""
    return np.where([q.judged and q.prior_sigma != 0.0 for q in quantities], np.abs(scaling.moves), 0.0)


def _worst(found: Iterable[Verdict]) -> Verdict:
    return max(found, key=_RANKS.index, default="observable")


def rejects_many(findings: Sequence[Finding]) -> bool:
    """Whether any recording's findings reject more of a family than outliers explain."""
    return any(
        rejects_many(each.evidence["findings"])
        if each.kind == "recording"
        else each.kind == "rejection" and each.severity == Severity.INCONSISTENT
        for each in findings
    )


def finite_covariance(quantities: Sequence[Quantity], covariance: Array) -> Array:
    """Make a covariance (n, n) symmetric and finite: fixed quantities 0, invalid variances very wide, uncorrelated."""
    covariance = np.asarray(covariance, dtype=float).reshape(len(quantities), len(quantities))
    covariance = 0.5 * (covariance + covariance.T)
    fixed = np.array([q.prior_sigma == 0.0 for q in quantities], dtype=bool)
    variance = np.diag(covariance)
    bad = ~(np.isfinite(variance) & (variance >= 0.0))
    wide = np.array([(_UNKNOWN * q.prior_scale) ** 2 for q in quantities])
    out = np.where(np.isfinite(covariance) & ~np.logical_or.outer(bad, bad), covariance, 0.0)
    out[np.diag_indices_from(out)] = np.where(bad, wide, variance)
    return np.where(np.logical_or.outer(fixed, fixed), 0.0, out)


def weak_directions(
    quantities: Sequence[Quantity], covariance: Array, advise: Advise | None, values: Array
) -> tuple[Finding, ...]:
    """Weak and unobservable eigen-directions of the prior-scaled covariance (n, n), worst first.

    A direction moves a parameter by its share of that parameter's sigma. It is beyond the requirement when its share of
    some parameter's sigma is larger than this parameter's `require`, or when it is the largest share of a sigma that
    is; no direction is blamed for parameters that are all as accurate as required. It is then unobservable if its sigma
    is 0.9 of its prior's or more, else weak. Fixed quantities, and those without a required accuracy, take no part.

    The strength of what a sensor measures is a direction of its own, SENSOR_scale, and the others are given it.
    """
    estimated = [i for i, q in enumerate(quantities) if q.prior_sigma != 0.0 and q.required]
    if not estimated:
        return ()
    covariance = finite_covariance(quantities, covariance)
    own = np.diag(covariance)
    factors = scalings(quantities, covariance, values)
    for factor in factors:
        covariance = covariance - np.outer(factor.moves, factor.moves)
    variances = np.where([q.relative for q in quantities], np.diag(covariance), own)
    sigmas = np.sqrt(np.maximum(variances, 0.0))[estimated]
    moved = np.array([_moved(factor, quantities)[estimated] for factor in factors]).reshape(len(factors), len(sigmas))
    names = [quantities[i].name for i in estimated]
    scale = np.array([quantities[i].scale for i in estimated])
    require = np.array([quantities[i].require for i in estimated])
    scaled = covariance[np.ix_(estimated, estimated)] / np.outer(scale, scale)
    eigenvalues, vectors = np.linalg.eigh(scaled)
    ratios = np.sqrt(np.maximum(eigenvalues, 0.0))
    shares = np.column_stack([np.abs(vectors) * np.outer(scale, ratios), *moved])
    beyond = shares > require[:, None]
    for i in np.flatnonzero(sigmas > require):
        beyond[i, np.argmax(shares[i])] = True
    count = len(ratios)
    bad = np.flatnonzero(beyond[:, :count].any(axis=0))[::-1]
    found = []
    for group in _degenerate(ratios[bad]):
        severity = Severity.UNOBSERVABLE if ratios[bad[group]][0] >= UNCHANGED else Severity.WEAK
        for vector in _simplest_basis(vectors[:, bad[group]]).T:
            ratio = float(np.sqrt(max(vector @ scaled @ vector, 0.0)))
            found.append(_direction(severity, _weights(names, vector), ratio, advise))
    for j in np.flatnonzero(beyond[:, count:].any(axis=0)):
        number = _scale(factors[j], quantities)
        severity = Severity.UNOBSERVABLE if number.verdict == "unobservable" else Severity.WEAK
        found.append(_direction(severity, {number.name: 1.0}, float((moved[j] / scale).max()), advise))
    return tuple(found)


def _direction(severity: Severity, weights: Mapping[str, float], ratio: float, advise: Advise | None) -> Finding:
    advice = (advise(weights) if advise else _DEFAULT_ADVICE).advice
    return Finding("direction", severity, {"weights": weights, "sigma_ratio": ratio, "advice": advice})


def _degenerate(ratios: Array) -> list[Index]:
    """Runs of nearly equal decreasing ratios with one verdict, as indices: their eigenvectors are arbitrary."""
    falls = ratios[1:] < _DEGENERATE * ratios[:-1]
    changes = (ratios[1:] >= UNCHANGED) != (ratios[:-1] >= UNCHANGED)
    return [run for run in np.split(np.arange(len(ratios)), np.flatnonzero(falls | changes) + 1) if len(run)]


def _simplest_basis(basis: Array) -> Array:
    """Rotate an orthonormal basis (n, k) of a space to as few large components as possible.

    Quartimax rotation (Neuhaus, Wrigley 1954): maximises the sum of the fourth powers of the components.
    """
    rotation = np.eye(basis.shape[1])
    for _ in range(100):
        rotated = basis @ rotation
        u, _, vt = np.linalg.svd(basis.T @ rotated**3)
        rotation = u @ vt
    return basis @ rotation


def _weights(names: Sequence[str], vector: Array) -> dict[str, float]:
    """Components of a direction worth naming, the strongest first and positive."""
    order = np.argsort(-np.abs(vector), kind="stable")
    sign = 1.0 if vector[order[0]] >= 0.0 else -1.0
    return {names[i]: sign * float(vector[i]) for i in order if abs(vector[i]) >= _MIN_WEIGHT}


@dataclass(frozen=True)
class TimeToAccuracy:
    """Time when a parameter reached its required accuracy, and time of largest information gain.

    Attributes:
        met_s: time from which on its sigma was as required, s; None: never.
        stretch: (start, end) of the tenth of the recording that brought most information.
        share: that tenth's part of all information.
    """

    met_s: float | None
    stretch: tuple[float, float]
    share: float


def time_to_accuracy(
    history: History, names: Sequence[str], quantities: Sequence[Quantity]
) -> dict[str, TimeToAccuracy]:
    """Time to the required accuracy of each estimated parameter, from the history of a filter.

    Information is the inverse of the variance less that of the prior; what a walking parameter loses counts as none
    gained.

    Args:
        history: sigmas as they were at each time.
        names: of the history's columns.
        quantities: of which the result is wanted.
    """
    estimated = {q.name: q for q in quantities if q.prior_sigma != 0.0 and q.judged}
    found = {}
    for i, name in enumerate(names):
        sigma = history.sigmas[:, i]
        if name not in estimated or len(sigma) < _MIN_MOMENTS or not (sigma > 0.0).all():
            continue
        q = estimated[name]
        late = np.flatnonzero(sigma > q.require)
        after = 0 if len(late) == 0 else int(late[-1]) + 1
        edges = np.linspace(history.time[0], history.time[-1], _TENTHS + 1)
        gained = np.maximum(np.diff(np.interp(edges, history.time, sigma**-2.0)), 0.0)
        prior = q.prior_sigma**-2.0 if q.prior_sigma else 0.0
        gained[0] += max(float(sigma[0]) ** -2.0 - prior, 0.0)
        best = int(np.argmax(gained))
        found[name] = TimeToAccuracy(
            met_s=float(history.time[after]) if after < len(sigma) else None,
            stretch=(float(edges[best]), float(edges[best + 1])),
            share=float(gained[best] / total) if (total := float(gained.sum())) else 0.0,
        )
    return found
