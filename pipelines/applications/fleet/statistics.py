"""Statistics of many calibrations: consistency of the sigmas, outlying units, changed units.

Values x_i come with their own sigmas s_i. A fleet has a spread t of its own beside them, so that x_i scatters about the
centre with variance t^2 + s_i^2; centre and t are estimated from medians, which up to half of the units cannot spoil.
Of what does not stand out, t is taken apart into what units differ by and what recordings of one unit differ by.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from alidade.factors.array import Array, Index
from alidade.factors.chi_square import quantile, student
from alidade.pipelines.diagnostics.device_changes import maximum_likelihood_sigma

# Chance that anything at all is flagged among good units, over all tests of a page.
FALSE_ALARM = 0.01
# A spread is estimated from at least so many values.
ENOUGH = 5
# Median of chi-square with one degree of freedom.
_MEDIAN = NormalDist().inv_cdf(0.75) ** 2
# Efficiency of the median as an estimate of spread: the share of the values that the usual estimate would need.
_EFFICIENCY = 0.37


@dataclass(frozen=True)
class Nees:
    """Mean normalised estimation error squared of `runs` runs, and its 99 % interval if the covariances are true."""

    mean: float
    low: float
    high: float
    runs: int
    dof: float

    @property
    def needed(self) -> int:
        """Number of runs whose interval shows sigmas that are a fifth too small (errors squared 1.44 times as large).

        The mean of n runs has the relative standard deviation sqrt(2 / (n dof)); 2.576 of these are to be at most 0.44.
        """
        return math.ceil(2.0 * (2.576 / 0.44) ** 2 / self.dof)

    @property
    def consistent(self) -> bool:
        """Whether the mean NEES lies in its interval."""
        return self.low <= self.mean <= self.high


def mean_nees(nees: Array, dof: Array) -> Nees:
    """Return the mean of e' P^-1 e over runs (n,) of `dof` (n,) parameters; n times it is chi-square (Bar-Shalom)."""
    n, total = len(nees), float(dof.sum())
    return Nees(float(nees.mean()), quantile(0.005, total) / n, quantile(0.995, total) / n, n, total / n)


@dataclass(frozen=True)
class Accuracy:
    """Errors of one parameter over many runs, beside the sigmas predicted.

    Attributes:
        bias: mean error; `bias_sigma` is its standard error.
        rms: root mean square error.
        sigma: root mean square of the sigmas predicted.
        coverage: share of errors within 1, 2 and 3 sigmas; 0.683, 0.954 and 0.997 if the sigmas are true.
    """

    bias: float
    bias_sigma: float
    rms: float
    sigma: float
    coverage: tuple[float, float, float]


def accuracy(errors: Array, sigmas: Array) -> Accuracy:
    """Accuracy (mean, RMS, coverage) of errors (n,) with sigmas (n,)."""
    scatter = float(errors.std(ddof=1)) if len(errors) > 1 else math.nan
    return Accuracy(
        float(errors.mean()),
        scatter / math.sqrt(len(errors)),
        float(np.sqrt((errors**2).mean())),
        float(np.sqrt((sigmas**2).mean())),
        coverage(errors / sigmas),
    )


def coverage(normalised: Array) -> tuple[float, float, float]:
    """Return the shares of errors, in sigmas, within 1, 2 and 3."""
    size = np.abs(normalised)
    return float((size < 1.0).mean()), float((size < 2.0).mean()), float((size < 3.0).mean())


@dataclass(frozen=True)
class Spread:
    """Distribution of a parameter in the fleet: `centre`, and the standard deviation `tau` beyond the sigmas."""

    centre: float
    tau: float

    def z(self, values: Array, sigmas: Array) -> Array:
        """Return distances of values from the centre in standard deviations, of spread and own sigma together."""
        return np.asarray((values - self.centre) / np.hypot(self.tau, sigmas))


def spread(values: Array, sigmas: Array, centre: float | None = None) -> Spread:
    """Return a robust centre and spread of values (n,) with sigmas (n,); a given centre is kept."""
    tau = 0.0
    where = centre if centre is not None else float(np.median(values))
    for _ in range(20):
        if centre is None:
            weights = 1.0 / np.hypot(tau, sigmas)
            where = float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf"))
        previous, tau = tau, _excess((values - where) ** 2, sigmas**2)
        if math.isclose(tau, previous, rel_tol=1e-6):
            break
    return Spread(where, tau)


def limit(tests: int, values: int | None = None) -> float:
    """Return the |z| that no test of so many exceeds by chance, except on one page in a hundred.

    Args:
        tests: made on the whole page.
        values: the spread was estimated from so many (Student's t then); None: it is known.
    """
    z = NormalDist().inv_cdf(1.0 - 0.5 * FALSE_ALARM / max(tests, 1))
    if values is None:
        return z
    return student(z, _EFFICIENCY * (values - 1))


@dataclass(frozen=True)
class Trend:
    """Straight line through values over time: slope per unit of time, and the sigma of the slope."""

    slope: float
    sigma: float

    @property
    def z(self) -> float:
        """The trend's slope over its sigma."""
        return self.slope / self.sigma


def trend(time: Array, values: Array, sigmas: Array) -> Trend | None:
    """Fit a line by least squares with sigmas (n,) that include the spread; None without three values and two times."""
    weights = 1.0 / sigmas**2
    centred = time - np.average(time, weights=weights)
    information = float((weights * centred**2).sum())
    if len(time) < 3 or not np.ptp(time) > 0.0:
        return None
    return Trend(float((weights * centred * values).sum()) / information, information**-0.5)


@dataclass(frozen=True)
class Component:
    """Variance component: the standard deviation of values beyond their sigmas.

    Attributes:
        value: of the largest likelihood; 0 where the sigmas suffice.
        sigma: of that; NaN at 0, where `upper` says what is known.
        upper: it is not larger than that (95 %).
    """

    value: float
    sigma: float
    upper: float


def components(values: Array, sigmas: Array, units: Index) -> tuple[Component | None, Component | None]:
    """Variance components from unit to unit and from recording to recording: x = centre + unit + recording + noise.

    The second is estimated from differences to the mean of the unit, the first from these means, each by its
    restricted likelihood (Searle, Casella, McCulloch, Variance Components, 1992, 3.7 and 6.6).

    Args:
        values, sigmas: (n,).
        units: (n,) which unit each shows.

    Returns:
        The first from five units on, the second where a unit has several recordings.
    """
    groups = np.unique(units, return_inverse=True)[1]
    several = np.bincount(groups) > 1 if len(groups) else np.empty(0, dtype=bool)
    some = several[groups]
    recording = _component(values[some], sigmas[some], groups[some]) if several.any() else None
    if len(several) < ENOUGH:
        return None, recording
    weights = 1.0 / (sigmas**2 + (recording.value if recording else 0.0) ** 2)
    total = np.bincount(groups, weights)
    means = np.bincount(groups, weights * values) / total
    return _component(means, np.asarray(total**-0.5), np.zeros(len(means), dtype=np.intp)), recording


def _component(values: Array, sigmas: Array, groups: Index) -> Component:
    """Return the scatter, beyond their sigmas, of values (n,) about the means of their groups (n,) of two or more."""
    groups = np.unique(groups, return_inverse=True)[1]

    def sums(weights: Array) -> Array:
        return np.asarray(np.bincount(groups, weights), dtype=float)

    def doubled(tau: float) -> float:
        w = 1.0 / (sigmas**2 + tau**2)
        total = sums(w)
        mean = sums(w * values) / total
        return float(np.log(total).sum() - np.log(w).sum() + (w * (values - mean[groups]) ** 2).sum())

    tau, upper = maximum_likelihood_sigma(doubled, float(np.median(sigmas)))
    w = 1.0 / (sigmas**2 + tau**2)
    one, two, three = sums(w), sums(w**2), sums(w**3)
    information = 0.5 * float((two - 2.0 * three / one + (two / one) ** 2).sum())  # of tau squared
    return Component(tau, 0.5 / tau * information**-0.5 if tau > 0.0 else math.nan, upper)


def varies(z: Array) -> bool:
    """Whether most changes z (n,) exceed two sigmas: recordings then differ by nature, as turn-on biases do."""
    return len(z) >= ENOUGH and float((np.abs(z) > 2.0).mean()) > 0.5


def _excess(squares: Array, variances: Array) -> float:
    """Return tau with median(squares / (tau^2 + variances)) = median of chi-square; 0 if the variances suffice."""
    from scipy.optimize import brentq

    def over(excess: float) -> float:
        return float(np.median(squares / (excess + variances))) - _MEDIAN

    if over(0.0) <= 0.0:
        return 0.0
    return math.sqrt(brentq(over, 0.0, float(squares.max()) / _MEDIAN, xtol=np.finfo(float).tiny))
