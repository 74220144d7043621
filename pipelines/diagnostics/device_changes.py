"""Changes of a device between recordings: steps, random walk, and whether an earlier calibration still holds.

A step of one of the device's numbers between two dates is another unknown of the joint system: added to the number in
all recordings after it. Its estimate from the joint residuals and its sigma are those of least squares with that
unknown (a score test, exact for a linear system). The largest of all is compared with its distribution without a change
over the whole history: drawn, since steps at neighbouring dates are nearly the same question. A step that is more than
that is taken into the system, and the next one looked for.

A walk makes the steps at all dates random, with variances rate^2 times the days between. In units in which the noise of
the recordings is white they are then independent, and the rate is that of the largest likelihood of what they leave
(restricted maximum likelihood: what the device's numbers themselves explain is projected out).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.pipelines.estimation.parameters import kind
from alidade.pipelines.estimation.problem import Quantity, SqrtInformation
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.solvers.joint import Joined, join
from alidade.pipelines.solvers.posterior import sqrt_information_of

# Probability of a false alarm: by a number, by all at once.
LEVEL, _JOINTLY = 0.05, 0.2
# Histories drawn; beyond so many tests, or where fewer of them would be beyond the limit, chance is bounded instead.
_DRAWN, _MOST_TESTS, _FEW = 4000, 1500, 40
_AT_ONCE = 200
# A step of a number is asked for where its sigma is less than this of the prior's.
_DETERMINED = 1.0
_MOST_STEPS = 20
# A 95 % bound is where minus twice the log likelihood is larger by this: chi-square with one degree of freedom.
_BOUND = 3.84
# Grid of standard deviations, in scales.
_MIN_SIGMA, _MAX_SIGMA, _GRID = 1e-3, 1e6, 400
# Eigenvalues below this share of the largest are rounding.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class Change:
    """Step of a parameter between a recording and the next one, SI.

    Attributes:
        name: of the number.
        after: index of the last recording before it.
        size: of the step.
        sigma: of that.
    """

    name: str
    after: int
    size: float
    sigma: float

    @property
    def z(self) -> float:
        """Size of the step over its sigma."""
        return self.size / self.sigma


@dataclass(frozen=True)
class Together:
    """Joint test of all numbers for a step after one recording: chi-square, degrees of freedom, significance."""

    after: int
    chi_square: float
    dof: int
    significant: bool


@dataclass(frozen=True)
class Rate:
    """Random-walk rate of a kind of numbers, SI per square root of a day, and the 95 % upper limit `upper`."""

    rate: float
    upper: float


@dataclass(frozen=True)
class Changes:
    """Changes of a device found over the history of its recordings.

    Attributes:
        level: p-value of any step.
        limit: from so many sigmas on the first step of a number is more than chance.
        found: the steps that are more than chance, of what was asked for, in the order in which they were found.
        others: significant steps of the numbers that were not asked for, estimated together with those found.
        steps: every step that was asked for, with the significant steps in the system.
        together: steps of all that was asked for at once, without any step in the system.
        rates: kind of numbers -> how they walk.
    """

    level: float
    limit: float = math.inf
    found: tuple[Change, ...] = ()
    others: tuple[Change, ...] = ()
    steps: tuple[Change, ...] = ()
    together: tuple[Together, ...] = ()
    rates: Mapping[str, Rate] = field(default_factory=dict)

    @property
    def jointly(self) -> tuple[Together, ...]:
        """Significant tests of a step of all numbers of the device at once, where no single number's step is."""
        return () if self.found or self.others else tuple(each for each in self.together if each.significant)

    @property
    def any(self) -> bool:
        """Whether any change of what was asked for is significant."""
        return bool(self.found or self.jointly)


def changes(
    joined: Joined,
    days: Sequence[float],
    inflations: Mapping[str, float],
    asked: Collection[str] | None = None,
    level: float = LEVEL,
) -> Changes:
    """Test a device's numbers for steps between recordings.

    Args:
        joined: the recordings, in the order of their dates.
        days: of these.
        inflations: by what sigmas of the numbers are larger because noise is coloured; 1 where not given.
        asked: the numbers whose changes matter; None: all. Steps are looked for in the others as well.
        level: how often chance alone may make any step in such a history.
    """
    if len(joined.parts) < 2:
        return Changes(level)
    A, b = (np.concatenate(each) for each in zip(*joined.rows, strict=True))
    steady = [(name, k) for k, (name, recording) in enumerate(joined.unknowns) if recording is None]
    questions = [(name, k, after) for after in range(len(joined.parts) - 1) for name, k in steady]
    columns = _columns(joined, questions)
    left, residual = _projected(A * joined.scales, columns, b)
    determined = np.linalg.norm(left, axis=0) * joined.scales[[k for _, k, _ in questions]] > 1.0 / _DETERMINED
    questions = [question for question, yes in zip(questions, determined, strict=True) if yes]
    asked = {name for name, _ in steady} if asked is None else asked
    wanted = np.array([name in asked for name, _, _ in questions], dtype=bool)
    if not wanted.any():
        return Changes(level)
    columns, left = columns[:, determined], left[:, determined]
    grown = np.array([inflations.get(name, 1.0) for name, _, _ in questions])
    limit = _limit(left, level)
    found, steps = _significant_steps(A * joined.scales, b, columns, questions, grown, limit)
    questions = [question for question in questions if question[0] in asked]
    left, grown = left[:, wanted], grown[wanted]
    return Changes(
        level,
        limit,
        tuple(step for step in found if step.name in asked),
        tuple(step for step in found if step.name not in asked),
        tuple(step for step in steps if step.name in asked),
        tuple(_together(left, residual, questions, grown, level)),
        _rates(left, residual, questions, days, grown),
    )


def _columns(joined: Joined, questions: Sequence[tuple[str, int, int]]) -> Array:
    """Columns (rows, questions) of the joint system for a unit step of a number in all recordings after one."""
    ends = np.cumsum([len(d) for _, d in joined.rows])
    whole = np.concatenate([R for R, _ in joined.rows])
    after, last = ends[: len(joined.parts)], ends[len(joined.parts) - 1]
    out = np.zeros((len(whole), len(questions)))
    for q, (_, k, recording) in enumerate(questions):
        out[after[recording] : last, q] = whole[after[recording] : last, k]
    return out


def _projected(A: Array, columns: Array, b: Array) -> tuple[Array, Array]:
    """Project columns and right side b on the complement of A's range."""
    basis = np.linalg.qr(A).Q
    return columns - basis @ (basis.T @ columns), b - basis @ (basis.T @ b)


def _steps(questions: Sequence[tuple[str, int, int]], left: Array, residual: Array, grown: Array) -> list[Change]:
    information = np.einsum("ij,ij->j", left, left)
    sizes, sigmas = left.T @ residual / information, grown / np.sqrt(information)
    return [
        Change(name, after, float(size), float(sigma))
        for (name, _, after), size, sigma in zip(questions, sizes, sigmas, strict=True)
    ]


def _significant_steps(
    A: Array, b: Array, columns: Array, questions: Sequence[tuple[str, int, int]], grown: Array, limit: float
) -> tuple[list[Change], list[Change]]:
    """Find the significant steps of a device between recordings, one by one; return these, and all steps by date.

    Each is estimated with the others found in the system. Of all steps those are left out that no longer differ from
    what was found.
    """
    taken: list[int] = []
    while True:
        left, residual = _projected(np.hstack([A, columns[:, taken]]), columns, b)
        open_ = np.flatnonzero((left**2).sum(axis=0) > _ROUNDING * (columns**2).sum(axis=0)).tolist()
        some = _steps([questions[i] for i in open_], left[:, open_], residual, grown[open_])
        best = int(np.argmax([abs(step.z) for step in some])) if some else -1
        if not some or len(taken) == _MOST_STEPS or abs(some[best].z) < limit:
            break
        taken.append(open_[best])
    each = dict(zip(open_, some, strict=True))
    for i in taken:
        others = [j for j in taken if j != i]
        left, residual = _projected(np.hstack([A, columns[:, others]]), columns[:, [i]], b)
        each[i] = _steps([questions[i]], left, residual, grown[[i]])[0]
    return [each[i] for i in taken], [each[i] for i in sorted(each)]


def _limit(left: Array, level: float) -> float:
    """Threshold, in sigmas, on the largest of all steps, for a false-alarm probability `level`."""
    singly, tests = level * (1.0 - _JOINTLY), left.shape[1]
    if tests > _MOST_TESTS or singly * _DRAWN < _FEW:
        return float(quantile(1.0 - singly / tests, 1.0)) ** 0.5
    unit = left / np.linalg.norm(left, axis=0)
    triangle = np.linalg.qr(unit, mode="r")
    rng = np.random.default_rng(0)
    largest = [
        np.abs(rng.standard_normal((_AT_ONCE, len(triangle))) @ triangle).max(axis=1) for _ in range(_DRAWN // _AT_ONCE)
    ]
    return float(np.quantile(np.concatenate(largest), 1.0 - singly))


def _together(
    left: Array, residual: Array, questions: Sequence[tuple[str, int, int]], grown: Array, level: float
) -> list[Together]:
    dates = sorted({after for _, _, after in questions})
    found = []
    for date in dates:
        own = [i for i, (_, _, after) in enumerate(questions) if after == date]
        some = left[:, own]
        u, s, _ = np.linalg.svd(some / np.linalg.norm(some, axis=0), full_matrices=False)
        kept = s > _ROUNDING**0.5 * s[0]
        square, dof = float(((u[:, kept].T @ residual) ** 2).sum() / grown[own].mean() ** 2), int(kept.sum())
        bound = quantile(1.0 - level * _JOINTLY / len(dates), float(dof))
        found.append(Together(date, square, dof, square > bound))
    return found


def _rates(
    left: Array,
    residual: Array,
    questions: Sequence[tuple[str, int, int]],
    days: Sequence[float],
    grown: Array,
) -> dict[str, Rate]:
    """Estimate the random-walk rate of each kind of numbers."""
    found = {}
    for which in dict.fromkeys(kind(name) for name, _, _ in questions):
        own = [i for i, (name, _, _) in enumerate(questions) if kind(name) == which]
        roots = np.array([max(days[questions[i][2] + 1] - days[questions[i][2]], 0.0) ** 0.5 for i in own])
        if (roots > 0.0).any():
            u, s, _ = np.linalg.svd(left[:, own] * roots, full_matrices=False)
            kept = s > _ROUNDING**0.5 * s.max()
            noise = grown[own].mean() ** 2
            found[which] = _rate((u[:, kept].T @ residual) ** 2 / noise, s[kept] ** 2 / noise)
    return found


def _rate(squares: Array, information: Array) -> Rate:
    """Maximum-likelihood rate, from squares of independent numbers with variances 1 + rate^2 information."""

    def doubled(rate: float) -> float:
        variance = 1.0 + rate**2 * information
        return float((np.log(variance) + squares / variance).sum())

    return Rate(*maximum_likelihood_sigma(doubled, float(information.max()) ** -0.5))


def maximum_likelihood_sigma(minus_two_log_likelihood: Callable[[float], float], scale: float) -> tuple[float, float]:
    """Maximum-likelihood standard deviation and its 95 % upper bound, which may be infinite.

    Args:
        minus_two_log_likelihood: of a standard deviation >= 0; it has one minimum.
        scale: > 0, a standard deviation that is neither far too large nor far too small.
    """
    from scipy.optimize import brentq, minimize_scalar

    grid = scale * np.geomspace(_MIN_SIGMA, _MAX_SIGMA, _GRID)
    costs = np.array([minus_two_log_likelihood(each) for each in grid])
    best, sigma, cost = int(costs.argmin()), 0.0, minus_two_log_likelihood(0.0)
    if cost > costs[best]:
        around = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, len(grid) - 1)])
        found = minimize_scalar(
            minus_two_log_likelihood, bounds=around, method="bounded", options={"xatol": 1e-9 * scale}
        )
        sigma, cost = float(found.x), float(found.fun)
    beyond = np.flatnonzero((costs > cost + _BOUND) & (grid > sigma))
    if not len(beyond):
        return sigma, float("inf")
    below = max(sigma, float(grid[beyond[0] - 1]) if beyond[0] else 0.0)
    return sigma, float(brentq(lambda s: minus_two_log_likelihood(s) - cost - _BOUND, below, float(grid[beyond[0]])))


Verdict = Literal["holds", "changed", "unknown", "same"]


@dataclass(frozen=True)
class CalibrationCheck:
    """Result of a test whether an earlier calibration holds on a new recording.

    Attributes:
        changes: of the parameters between the two.
        quantities: the parameters, by name.
        required: names of the calibration's parameters that have a required accuracy.
    """

    changes: Changes
    quantities: Mapping[str, Quantity]
    required: Sequence[str]

    @property
    def verdict(self) -> Verdict:
        """Verdict: "unknown" where the recording determines no comparable parameter, else "changed" or "holds"."""
        if not self.changes.steps:
            return "unknown"
        return "changed" if self.changes.any else "holds"

    @property
    def steps(self) -> Sequence[Change]:
        """Change of every required parameter that is tested, with all significant changes estimated jointly."""
        return self.changes.steps

    @property
    def untested(self) -> list[str]:
        """Names of the calibration's required parameters for which a recording does not determine whether they changed.

        Also those that it does not determine apart from parameters that did change.
        """
        tested = {step.name for step in self.steps}
        return [name for name in self.required if name not in tested]

    @property
    def matters(self) -> bool:
        """Whether a change exceeds the parameter's required accuracy: a significant one, or any if all are together."""
        found = self.changes.found or self.steps
        return any(abs(step.size) > self.quantities[step.name].require for step in found)


def check_calibration(
    known: GaussianPrior, sqrt_info: SqrtInformation, quantities: Sequence[Quantity], inflations: Mapping[str, float]
) -> CalibrationCheck:
    """Test an earlier calibration against a recording, as two recordings of one device.

    The priors count once. The recording's own numbers, its bias and its time offset, are its own.

    Args:
        known: of the device, from the earlier calibration; no number is exactly known.
        sqrt_info: information of the recording.
        quantities: of the recording's graph.
        inflations: by what the recording's sigmas are larger because noise is coloured.
    """
    by_name = {q.name: q for q in quantities}
    known = known.of(sqrt_info.names)
    # The numbers whose priors are set apart.
    of_device = np.array(sqrt_info.names)[(sqrt_info.prior_R != 0.0).any(axis=0)].tolist()
    rates = dict.fromkeys([*known.names, *of_device], 0.0)
    before = sqrt_information_of(known, [by_name[name].prior_scale for name in known.names])
    joined = join([before, sqrt_info], rates, [0.0, 1.0])
    required = [name for name in known.names if by_name[name].required]
    return CalibrationCheck(changes(joined, [0.0, 1.0], inflations, required), by_name, required)
