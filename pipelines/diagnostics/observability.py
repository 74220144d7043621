"""Whether a calibration can be trusted: what the recording determined, and whether its residuals fit the noise stated.

    assessment = assess(problem.quantities, estimate.covariance, estimate.chi_square, problem.advice)
    assessment.status, assessment.headline

The rules are those of the contract, section Verdicts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from alidade.factors.chi_square import quantile
from alidade.pipelines.diagnostics.assumptions import costs
from alidade.pipelines.estimation.advice import Motion
from alidade.pipelines.estimation.problem import Array, ChiSquare, History, Quantity, Residuals

Verdict = Literal["fixed", "observable", "prior", "weak", "unobservable"]
Status = Literal["calibrated", "weak", "inconsistent", "unobservable"]
Advice = Callable[[Mapping[str, float]], Motion]

# A sigma of this fraction of its prior says that the recording added next to nothing.
_UNCHANGED = 0.9
# Tails outside the 99.9 % interval of chi-square.
_TAIL = 5e-4
# Weights of a direction below this are left out.
_SMALL_WEIGHT = 0.1
# Directions whose sigmas lie this close together may be mixed at will.
_ALIKE = 0.9
# Sigma, in prior scales, of what is not a number.
_UNKNOWN = 1e4

# Lags of the autocorrelation, and from how many innovations on it says something.
_LAGS, _FEWEST_INNOVATIONS = 5, 20
# Parts of a recording whose information is compared, and from how many moments on.
_TENTHS, _FEWEST_MOMENTS = 10, 20

_DEFAULT_ADVICE = Motion("vary the motion while recording, record longer, or give these parameters a tighter prior")


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the recording leaves weak or unobservable.

    Attributes:
        verdict: "weak" or "unobservable".
        sigma_ratio: its sigma over that of its prior.
        weights: parameter -> component of the unit vector, in units of the priors' sigmas; strongest first, small ones
            dropped.
        motion: what to do about it.
    """

    verdict: Verdict
    sigma_ratio: float
    weights: Mapping[str, float]
    motion: Motion

    @property
    def advice(self) -> str:
        """What to do about it, in words."""
        return self.motion.advice

    @property
    def label(self) -> str:
        """The parameters that trade against each other."""
        first, *others = self.weights
        return f"{first} against {', '.join(others)}" if others else first


@dataclass(frozen=True)
class Fit:
    """A sum of squared whitened residuals, its degrees of freedom and its 99.9 % interval.

    With less than one degree of freedom the sum has no interval worth the name: low and high are NaN.
    """

    value: float
    dof: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, dof: float) -> Fit:
        """With its interval."""
        if dof < 1.0:
            return cls(value, dof, np.nan, np.nan)
        return cls(value, dof, quantile(_TAIL, dof), quantile(1.0 - _TAIL, dof))

    @property
    def noise_factor(self) -> float:
        """By what the noise stated would have to be multiplied to make the value the expected one."""
        return float(np.sqrt(self.value / max(self.dof, 1.0)))

    @property
    def excess(self) -> float:
        """Value above expectation, in standard deviations."""
        return float((self.value - self.dof) / np.sqrt(2.0 * max(self.dof, 1.0)))


@dataclass(frozen=True)
class Consistency:
    """Chi-square of the whole and of each family of measurements."""

    total: Fit
    families: Mapping[str, Fit]

    @property
    def too_large(self) -> bool:
        """Residuals larger than the noise explains, or no number at all."""
        fit = self.total
        return not np.isfinite(fit.value) or fit.value > fit.high

    @property
    def too_small(self) -> bool:
        """Residuals smaller than the noise explains."""
        return self.total.value < self.total.low

    @property
    def message(self) -> str | None:
        """A sentence when the residuals do not fit the noise."""
        total = self.total
        if not np.isfinite(total.value):
            return "chi-square is not a number: the solver did not end at a usable estimate"
        sums = f"chi-square {total.value:.5g} for {total.dof:.5g} degrees of freedom"
        if self.too_large:
            return (
                f"{sums} is above its upper bound {total.high:.5g}: the noise stated is too small, most of all for "
                f"{self._worst(1.0)}, or the model lacks something (time offset, sign of an axis, scale)"
            )
        if self.too_small:
            return (
                f"{sums} is below its lower bound {total.low:.5g}: the noise stated is too large, most of all for "
                f"{self._worst(-1.0)}"
            )
        return None

    def _worst(self, sign: float) -> str:
        families = self.families or {"the whole": self.total}
        family, fit = max(families.items(), key=lambda item: sign * item[1].excess)
        return f"{family} (it would have to be {fit.noise_factor:.2g} times as large)"


@dataclass(frozen=True)
class Innovations:
    """Whether the innovations of a family are white and as large as they should be.

    Attributes:
        autocorrelation: at the lags 1, 2, ... measurements; 0 expected.
        bound: 99.9 % of white innovations have an autocorrelation within plus and minus this.
        nis: mean of the squared norms; `rows` expected.
        low, high: 99.9 % interval of that mean.
        rows: numbers in a measurement.
    """

    autocorrelation: tuple[float, ...]
    bound: float
    nis: float
    low: float
    high: float
    rows: int

    @classmethod
    def of(cls, residuals: Residuals) -> Innovations | None:
        """Of those used; None when there are too few to say anything."""
        used = residuals.whitened[residuals.used]
        n, rows = used.shape
        if n < _FEWEST_INNOVATIONS:
            return None
        square = float((used**2).sum())
        lags = tuple(float((used[lag:] * used[:-lag]).sum()) / square for lag in range(1, _LAGS + 1))
        fit = Fit.of(square, float(n * rows))
        bound = NormalDist().inv_cdf(1.0 - _TAIL) / float(np.sqrt(n * rows))
        return cls(lags, bound, square / n, fit.low / n, fit.high / n, rows)

    @property
    def white(self) -> bool:
        """Whether all autocorrelations lie within the bound."""
        return max(map(abs, self.autocorrelation)) <= self.bound


@dataclass(frozen=True)
class Learning:
    """How a parameter became known while recording.

    Attributes:
        met_s: from when on its sigma was as required, s; None: never.
        stretch: (start, end), s, of the tenth of the recording that brought most information.
        share: that tenth's part of all information.
    """

    met_s: float | None
    stretch: tuple[float, float]
    share: float


def learning(history: History, names: Sequence[str], quantities: Sequence[Quantity]) -> dict[str, Learning]:
    """For each parameter that is estimated, from the history of a filter.

    Information is the inverse of the variance; what a walking parameter loses counts as none gained.

    Args:
        history: sigmas as they were at each time.
        names: of the history's columns.
        quantities: those to tell about.
    """
    required = {q.name: q.require for q in quantities if q.prior_sigma != 0.0 and q.judged}
    found = {}
    for i, name in enumerate(names):
        sigma = history.sigmas[:, i]
        if name not in required or len(sigma) < _FEWEST_MOMENTS or not (sigma > 0.0).all():
            continue
        late = np.flatnonzero(sigma > required[name])
        after = 0 if len(late) == 0 else int(late[-1]) + 1
        edges = np.linspace(history.time[0], history.time[-1], _TENTHS + 1)
        gained = np.maximum(np.diff(np.interp(edges, history.time, sigma**-2.0)), 0.0)
        gained[0] += sigma[0] ** -2.0
        best = int(np.argmax(gained))
        found[name] = Learning(
            met_s=float(history.time[after]) if after < len(sigma) else None,
            stretch=(float(edges[best]), float(edges[best + 1])),
            share=float(gained[best] / gained.sum()),
        )
    return found


@dataclass(frozen=True)
class Cause:
    """Why residuals may not fit, tried by solving again.

    Attributes:
        label: what is wrong.
        evidence: what changing it does.
    """

    label: str
    evidence: str


@dataclass(frozen=True)
class Assessment:
    """The verdict on an estimate.

    Attributes:
        status: the first that applies of unobservable, inconsistent, weak, calibrated.
        verdicts: parameter -> verdict, in the order of the quantities; of those only that an accuracy is wanted of.
        directions: weak and unobservable ones, worst first.
        covariance: (n, n), the one judged: symmetric and finite whatever was given.
        consistency: None when the solver has no chi-square.
        headline: the verdict in one sentence.
        causes: of residuals that do not fit, the likeliest first; see alidade.pipelines.diagnostics.hypothesis_tests.
    """

    status: Status
    verdicts: Mapping[str, Verdict]
    directions: tuple[Direction, ...]
    covariance: Array
    consistency: Consistency | None
    headline: str
    causes: tuple[Cause, ...] = ()

    def explained(self, causes: Sequence[Cause]) -> Assessment:
        """The same with causes, the likeliest as the headline; what needs them is inconsistent."""
        if not causes:
            return self
        likeliest = causes[0]
        headline = f"{likeliest.label[:1].upper()}{likeliest.label[1:]}: {likeliest.evidence}."
        if self.consistency is not None:
            total = self.consistency.total
            headline += f" As it is the whole has chi-square {total.value:.5g} for {total.dof:.5g}."
        status: Status = "unobservable" if self.status == "unobservable" else "inconsistent"
        return replace(self, status=status, causes=tuple(causes), headline=headline)

    def misfit(self, reason: str) -> Assessment:
        """The same, inconsistent, for a reason other than chi-square (a sentence; empty: chi-square was it)."""
        if not reason or self.status == "unobservable":
            return self.remarked(reason)
        headline = self.headline if self.status == "inconsistent" else "The recording does not fit the model:"
        return replace(self, status="inconsistent", headline=f"{headline} {reason}")

    def remarked(self, *remarks: str) -> Assessment:
        """The same with more sentences at the end of the headline, those that are not empty."""
        return replace(self, headline=" ".join([self.headline, *filter(None, remarks)]))

    def unsolved(self, message: str) -> Assessment:
        """The same for an estimate that is no solution: its numbers are not to be used, however small their sigmas."""
        headline = f"The solver did not converge ({message}): the numbers are no solution, do not use them."
        return replace(self, status="inconsistent", headline=headline)

    @property
    def sigmas(self) -> Array:
        """(n,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the status does not say: for now, residuals smaller than the noise stated."""
        message = self.consistency.message if self.consistency and self.consistency.too_small else None
        return (message,) if message else ()


def assess(
    quantities: Sequence[Quantity],
    covariance: Array,
    chi_square: ChiSquare | None,
    advice: Advice | None,
    decides: bool = True,
) -> Assessment:
    """The verdict on an estimate with this joint covariance (n, n) of the quantities; never fails on a singular one.

    A direction moves a parameter by its share of that parameter's sigma. A direction is beyond what is required when
    its share of some parameter's sigma is larger than this parameter's `require`, or when it is the largest share of a
    sigma that is; no direction is blamed for parameters that are all as good as wanted. It is then unobservable if its
    sigma is 0.9 of its prior's or more, else weak.

    Args:
        quantities: what is reported; those with prior 0 are fixed and take no part, those of which no accuracy is
            wanted have no verdict.
        covariance: of the reported numbers, rows and columns as the quantities.
        chi_square: of the residuals, if the solver has one.
        advice: what the method asks for to determine a direction, given its weights by parameter name.
        decides: whether chi-square beyond its bound makes it inconsistent; not where noise levels are estimated.
    """
    covariance = _finite(quantities, covariance)
    sigmas = np.sqrt(np.diag(covariance))
    verdicts = {q.name: _verdict(q, float(s)) for q, s in zip(quantities, sigmas, strict=True) if q.judged}
    directions = _directions(quantities, covariance, advice)
    consistency = _consistency(chi_square)
    unusable = consistency is not None and not np.isfinite(consistency.total.value)
    deciding = consistency if decides or unusable else None
    status = _status([*verdicts.values(), *(d.verdict for d in directions)], deciding)
    headline = _headline(status, verdicts, directions, consistency)
    if status == "weak":
        headline = " ".join(filter(None, [headline, costs(quantities, covariance)]))
    return Assessment(status, verdicts, directions, covariance, consistency, headline)


def _finite(quantities: Sequence[Quantity], covariance: Array) -> Array:
    """The covariance with fixed quantities at zero and what is no variance made very wide and uncorrelated."""
    covariance = np.asarray(covariance, dtype=float).reshape(len(quantities), len(quantities))
    covariance = 0.5 * (covariance + covariance.T)
    fixed = np.array([q.prior_sigma == 0.0 for q in quantities], dtype=bool)
    variance = np.diag(covariance)
    bad = ~(np.isfinite(variance) & (variance >= 0.0))
    wide = np.array([(_UNKNOWN * q.prior_scale) ** 2 for q in quantities])
    out = np.where(np.isfinite(covariance) & ~np.logical_or.outer(bad, bad), covariance, 0.0)
    out[np.diag_indices_from(out)] = np.where(bad, wide, variance)
    return np.where(np.logical_or.outer(fixed, fixed), 0.0, out)


def _verdict(quantity: Quantity, sigma: float) -> Verdict:
    if quantity.prior_sigma == 0.0:
        return "fixed"
    unchanged = sigma >= _UNCHANGED * quantity.scale
    if sigma <= quantity.require:
        return "prior" if unchanged else "observable"
    return "unobservable" if unchanged else "weak"


def _directions(quantities: Sequence[Quantity], covariance: Array, advice: Advice | None) -> tuple[Direction, ...]:
    """Weak and unobservable eigen-directions of the prior-scaled covariance, worst first."""
    estimated = [i for i, q in enumerate(quantities) if q.prior_sigma != 0.0 and q.judged]
    if not estimated:
        return ()
    names = [quantities[i].name for i in estimated]
    scale = np.array([quantities[i].scale for i in estimated])
    require = np.array([quantities[i].require for i in estimated])
    scaled = covariance[np.ix_(estimated, estimated)] / np.outer(scale, scale)
    eigenvalues, vectors = np.linalg.eigh(scaled)
    ratios = np.sqrt(np.maximum(eigenvalues, 0.0))
    shares = np.abs(vectors) * np.outer(scale, ratios)
    beyond = shares > require[:, None]
    for i in np.flatnonzero(np.sqrt(np.diag(scaled)) * scale > require):
        beyond[i, np.argmax(shares[i])] = True
    bad = np.flatnonzero(beyond.any(axis=0))[::-1]
    found = []
    for group in _alike(ratios[bad]):
        basis = vectors[:, bad[group]]
        verdict: Verdict = "unobservable" if ratios[bad[group]][0] >= _UNCHANGED else "weak"
        for vector in _plainest(basis).T:
            weights = _weights(names, vector)
            ratio = float(np.sqrt(max(vector @ scaled @ vector, 0.0)))
            found.append(Direction(verdict, ratio, weights, advice(weights) if advice else _DEFAULT_ADVICE))
    return tuple(found)


def _alike(ratios: Array) -> list[NDArray[np.intp]]:
    """Indices of falling ratios in runs of nearly equal ones, whose eigenvectors are arbitrary, of one verdict each."""
    falls = ratios[1:] < _ALIKE * ratios[:-1]
    changes = (ratios[1:] >= _UNCHANGED) != (ratios[:-1] >= _UNCHANGED)
    return [run for run in np.split(np.arange(len(ratios)), np.flatnonzero(falls | changes) + 1) if len(run)]


def _plainest(basis: Array) -> Array:
    """Orthonormal basis (n, k) of the same space with as few large components as can be.

    Quartimax rotation (Neuhaus, Wrigley 1954): maximises the sum of the fourth powers of the components.
    """
    rotation = np.eye(basis.shape[1])
    for _ in range(100):
        turned = basis @ rotation
        u, _, vt = np.linalg.svd(basis.T @ turned**3)
        rotation = u @ vt
    return basis @ rotation


def _weights(names: Sequence[str], vector: Array) -> dict[str, float]:
    """The components worth naming, strongest first and that one positive."""
    order = np.argsort(-np.abs(vector), kind="stable")
    sign = 1.0 if vector[order[0]] >= 0.0 else -1.0
    return {names[i]: sign * float(vector[i]) for i in order if abs(vector[i]) >= _SMALL_WEIGHT}


def _consistency(chi_square: ChiSquare | None) -> Consistency | None:
    if chi_square is None:
        return None
    families = {family: Fit.of(value, dof) for family, (value, dof) in chi_square.families.items()}
    return Consistency(Fit.of(chi_square.value, chi_square.dof), families)


def _status(verdicts: Sequence[Verdict], consistency: Consistency | None) -> Status:
    if "unobservable" in verdicts:
        return "unobservable"
    if consistency is not None and consistency.too_large:
        return "inconsistent"
    return "weak" if "weak" in verdicts else "calibrated"


def _headline(
    status: Status,
    verdicts: Mapping[str, Verdict],
    directions: Sequence[Direction],
    consistency: Consistency | None,
) -> str:
    if status == "calibrated":
        estimated = sum(verdict != "fixed" for verdict in verdicts.values())
        by_prior = [name for name, verdict in verdicts.items() if verdict == "prior"]
        but = f", {', '.join(by_prior)} by prior alone" if by_prior else ""
        return f"All {estimated} parameters are as accurate as required{but}."
    if status == "inconsistent" and consistency is not None:
        return f"The residuals do not fit: {consistency.message}."
    said = "The recording does not determine" if status == "unobservable" else "Less accurate than required:"
    return f"{said} {'; '.join(f'{labels} ({advice})' for labels, advice in by_advice(directions, status))}."


def by_advice(directions: Sequence[Direction], verdict: str) -> list[tuple[str, str]]:
    """(labels, advice) of the directions with a verdict, those that want the same together."""
    labels: dict[str, list[str]] = {}
    for direction in directions:
        if direction.verdict == verdict:
            labels.setdefault(direction.advice, []).append(direction.label)
    return [("; ".join(dict.fromkeys(group)), advice) for advice, group in labels.items()]
