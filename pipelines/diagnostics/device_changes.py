"""Whether a device changed between recordings, by how much, and how it walks.

A step of one of the device's numbers between two dates is another unknown of the joint system: added to the number in
all recordings after it. Its estimate from the joint residuals and its sigma are those of least squares with that
unknown (a score test, exact for a linear system). The largest of all is held against what chance alone does over the
whole history: drawn, since steps at neighbouring dates are nearly the same question. A step that is more than that is
taken into the system, and the next one looked for.

A walk makes the steps at all dates random, with variances rate^2 times the days between. In units in which the noise of
the recordings is white they are then independent, and the rate is that of the largest likelihood of what they leave
(restricted maximum likelihood: what the device's numbers themselves explain is projected out).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from alidade.factors.chi_square import quantile
from alidade.pipelines.diagnostics.likelihood import likeliest
from alidade.pipelines.estimation.assumptions import kind
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.solvers.joint import Joined

# How often a history in which nothing changed is taken for one in which something did: by a number, by all at once.
LEVEL, _JOINTLY = 0.05, 0.2
# Histories drawn; beyond so many tests, or where fewer of them would be beyond the limit, chance is bounded instead.
_DRAWN, _MOST_TESTS, _FEW = 4000, 1500, 40
_AT_ONCE = 200
# A step of a number is asked for where its sigma is less than this of the prior's.
_TOLD = 1.0
_MOST_STEPS = 20
# Eigenvalues below this share of the largest are rounding.
_ROUNDING = 1e-10


@dataclass(frozen=True)
class Change:
    """A step of a number between a recording and the next one, SI.

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
        """In its sigmas."""
        return self.size / self.sigma


@dataclass(frozen=True)
class Together:
    """A step of all numbers at once: chi-square and degrees of freedom, and how often chance does as much."""

    after: int
    chi_square: float
    dof: int
    significant: bool


@dataclass(frozen=True)
class Rate:
    """How far numbers of a kind walk in the root of a day, SI; not farther than `upper` (95 %)."""

    rate: float
    upper: float


@dataclass(frozen=True)
class Changes:
    """What a history of recordings says of a device.

    Attributes:
        level: how often chance alone makes any step.
        limit: from so many sigmas on the first step of a number is more than chance.
        found: the steps that are more than chance, in the order in which they were found.
        steps: every number's step after every recording, with nothing else changed.
        together: steps of all numbers at once.
        rates: kind of numbers -> how they walk.
    """

    level: float
    limit: float = math.inf
    found: tuple[Change, ...] = ()
    steps: tuple[Change, ...] = ()
    together: tuple[Together, ...] = ()
    rates: Mapping[str, Rate] = field(default_factory=dict)

    @property
    def any(self) -> bool:
        """Whether anything changed."""
        return bool(self.found) or any(each.significant for each in self.together)


def changes(
    joined: Joined,
    days: Sequence[float],
    inflations: Mapping[str, float],
    asked: Collection[str] | None = None,
    level: float = LEVEL,
) -> Changes:
    """Of the device's numbers that are taken for the same in all recordings.

    Args:
        joined: the recordings, in the order of their dates.
        days: of these.
        inflations: by what sigmas of the numbers are larger because noise is coloured; 1 where not given.
        asked: the numbers whose steps are looked for; None: all.
        level: how often chance alone may make any step in such a history.
    """
    if len(joined.parts) < 2:
        return Changes(level)
    A, b = (np.concatenate(each) for each in zip(*joined.rows, strict=True))
    steady = [(name, k) for k, (name, recording) in enumerate(joined.unknowns) if recording is None]
    steady = [(name, k) for name, k in steady if asked is None or name in asked]
    questions = [(name, k, after) for after in range(len(joined.parts) - 1) for name, k in steady]
    columns = _columns(joined, questions)
    left, residual = _without(A * joined.scales, columns, b)
    told = np.linalg.norm(left, axis=0) * joined.scales[[k for _, k, _ in questions]] > 1.0 / _TOLD
    questions = [question for question, yes in zip(questions, told, strict=True) if yes]
    if not questions:
        return Changes(level)
    columns, left = columns[:, told], left[:, told]
    grown = np.array([inflations.get(name, 1.0) for name, _, _ in questions])
    steps, limit = _steps(questions, left, residual, grown), _limit(left, level)
    return Changes(
        level,
        limit,
        tuple(_found(A * joined.scales, b, columns, questions, grown, limit)),
        tuple(steps),
        tuple(_together(left, residual, questions, grown, level)),
        _rates(left, residual, questions, days, grown),
    )


def _columns(joined: Joined, questions: Sequence[tuple[str, int, int]]) -> Array:
    """(rows, questions) of a unit step of a number in all recordings after one."""
    ends = np.cumsum([len(d) for _, d in joined.rows])
    whole = np.concatenate([R for R, _ in joined.rows])
    after, last = ends[: len(joined.parts)], ends[len(joined.parts) - 1]
    out = np.zeros((len(whole), len(questions)))
    for q, (_, k, recording) in enumerate(questions):
        out[after[recording] : last, q] = whole[after[recording] : last, k]
    return out


def _without(A: Array, columns: Array, b: Array) -> tuple[Array, Array]:
    """Columns and right sides less what the unknowns explain."""
    basis = np.linalg.qr(A).Q
    return columns - basis @ (basis.T @ columns), b - basis @ (basis.T @ b)


def _steps(questions: Sequence[tuple[str, int, int]], left: Array, residual: Array, grown: Array) -> list[Change]:
    information = np.einsum("ij,ij->j", left, left)
    sizes, sigmas = left.T @ residual / information, grown / np.sqrt(information)
    return [
        Change(name, after, float(size), float(sigma))
        for (name, _, after), size, sigma in zip(questions, sizes, sigmas, strict=True)
    ]


def _found(
    A: Array, b: Array, columns: Array, questions: Sequence[tuple[str, int, int]], grown: Array, limit: float
) -> list[Change]:
    """One step after the other, each with those before it in the system."""
    taken: list[int] = []
    while len(taken) < _MOST_STEPS:
        left, residual = _without(np.hstack([A, columns[:, taken]]), columns, b)
        open_ = np.flatnonzero((left**2).sum(axis=0) > _ROUNDING * (columns**2).sum(axis=0)).tolist()
        if not open_:
            break
        some = _steps([questions[i] for i in open_], left[:, open_], residual, grown[open_])
        best = int(np.argmax([abs(step.z) for step in some]))
        if abs(some[best].z) < limit:
            break
        taken.append(open_[best])
    # Sizes and sigmas with all of them in the system.
    found = []
    for i in taken:
        others = [j for j in taken if j != i]
        left, residual = _without(np.hstack([A, columns[:, others]]), columns[:, [i]], b)
        found += _steps([questions[i]], left, residual, grown[[i]])
    return found


def _limit(left: Array, level: float) -> float:
    """Size in sigmas that the largest of all steps has by chance in one history in so many."""
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
    """Kind -> how its numbers walk."""
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
    """From squares of independent numbers with variances 1 + rate^2 information."""

    def doubled(rate: float) -> float:
        variance = 1.0 + rate**2 * information
        return float((np.log(variance) + squares / variance).sum())

    return Rate(*likeliest(doubled, float(information.max()) ** -0.5))
