"""The influence of every measurement on every parameter, and what follows from it.

That is the uncertainty budget by source, the measurements that move parameters most, and by how much the parameters
move when the graph is a little different.

At the minimum a small change r of the whitened residuals moves the reported numbers by L r, with

    L = J N^-1 A^T,    N = A^T A

A the linearised, whitened system, J the Jacobian of the reported numbers. Residuals of unit variance give the
covariance L L^T = J N^-1 J^T: the squares of a row of L are the parts that each residual has in a parameter's variance.
One solution of N x = J_j^T for each parameter is kept, two back-substitutions with the triangular factor of A, of the
variables that stretches share; rows of L come stretch by stretch and one factor after the other as A x, so that no
matrix of all rows is ever there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import gtsam
import numpy as np

from alidade.pipelines.estimation.problem import Array, Factor, Problem, Pull
from alidade.pipelines.solvers.marginals import HELD
from alidade.pipelines.solvers.stretch import Part
from alidade.pipelines.solvers.system import Linear

Answer = TypeVar("Answer")

# Family of the priors, which are told one by one.
_PRIOR = "prior"


@dataclass(frozen=True, eq=False)
class Influence:
    """What every whitened residual of a graph does to the reported numbers.

    Attributes:
        names: (n,) of the numbers, fixed ones left out.
        linear: the graph about its solution.
        solutions: (D, n) rows of N^-1 J^T, of the variables that stretches share; those of the others follow.
        covariance: (n, n) of the numbers, errors that the graph does not model left out.
    """

    names: tuple[str, ...]
    linear: Linear
    solutions: Array
    covariance: Array

    def part(self, of: slice) -> Influence:
        """The same of some of the numbers."""
        return Influence(self.names[of], self.linear, self.solutions[:, of], self.covariance[of, of])

    def ask(self, question: Callable[..., Answer], *args: Any) -> list[Answer]:
        """What a question gives of the rows of every part of the graph, in time order.

        Args:
            question: a function at the top of a module, since it may be asked in another process; takes the rows: each
                factor, it linearised, and the derivative (n, m) of the numbers by its m whitened residuals.
            args: what it takes besides.
        """
        return self.linear.ask(_with_rows, [(held, question, *args) for held in self.linear.handed(self.solutions)])

    def moves(self, changed: Linear) -> Array:
        """(n,) by how much the numbers are elsewhere at the minimum of a graph that is a little different.

        To first order that is J N^-1 times the difference of the gradients A^T r, and the rows of the two graphs need
        not be the same, as compressed ones are not.

        Args:
            changed: that graph, linearised where this one is.
        """
        given = list(zip(self.linear.handed(self.solutions), changed.ask(_gradient), strict=True))
        return np.asarray(np.sum(self.linear.ask(_moves, given), axis=0))


# What is asked of a part's rows.
FactorRows = Iterator[tuple[Factor, gtsam.GaussianFactor, Array]]


def _with_rows(part: Part, held: Array, question: Callable[[FactorRows], Answer], *args: Any) -> Answer:
    solutions = part.solved(held)
    blocks = zip(part.stretch.factors, part.blocks(), strict=True)
    rows = ((factor, part.graph.at(i), (A @ solutions[rows]).T) for i, (factor, (A, rows)) in enumerate(blocks))
    return question(rows, *args)


def _gradient(part: Part) -> Array:
    """(D,) of a part's error."""
    return np.asarray(part.graph.gradientAtZero().vector(part.stretch.keys))


def _moves(part: Part, held: Array, changed: Array) -> Array:
    """(n,) what a part with a changed gradient (D,) has in the moves of the numbers."""
    return np.asarray(-part.solved(held).T @ (changed - _gradient(part)))


def influence(problem: Problem, linear: Linear, current_keys: Mapping[int, int]) -> Influence:
    """The influence of a graph's residuals at an estimate.

    Args:
        problem: names the reported numbers.
        linear: the graph about the estimate.
        current_keys: parameter key -> variable that holds its value, for parameters that move along.

    Raises:
        IndeterminateError: a variable is not determined.
    """
    triangular = linear.triangular
    names: list[str] = []
    rights: list[Array] = []
    for p in problem.parameters:
        key = current_keys.get(p.key, p.key)
        for quantity, gradient in zip(p.quantities, p.coordinates(linear.values, key)[1], strict=True):
            if quantity.prior_sigma != 0.0:
                right = np.zeros(triangular.size)
                right[triangular.places[key]] = gradient
                names.append(quantity.name)
                rights.append(right)
    J = np.array(rights).reshape(len(names), -1)
    solutions = triangular.back(triangular.forward(J.T))
    covariance = J @ solutions
    return Influence(tuple(names), linear, solutions, 0.5 * (covariance + covariance.T))


def uncertainty_budget(problem: Problem, found: Influence, added: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Number -> source -> its share of the number's variance, the largest first; shares sum to one.

    Sources are the families of the noise, every prior of the problem by itself ("prior of NAME"), and what the graph
    does not model ("not modelled").

    Args:
        problem: the graph's.
        found: the influence of its residuals.
        added: family -> variance (n,) that the colour of its noise adds.
    """
    by_key = {p.key: [q.name for q in p.quantities] for p in problem.parameters}
    variances: dict[str, Array] = {}
    for part in found.ask(_variances, by_key):
        for source, variance in part.items():
            variances[source] = variances.get(source, np.zeros(len(found.names))) + variance
    for family, more in added.items():
        variances[family] = variances[family] + more
    extra = {q.name: q.extra_sigma**2 for q in problem.quantities}
    variances["not modelled"] = np.array([extra[name] for name in found.names])
    total = np.sum(list(variances.values()), axis=0)
    return {
        name: dict(
            sorted(
                ((source, float(v[j] / total[j])) for source, v in variances.items() if v[j] > 0.0),
                key=lambda share: -share[1],
            )
        )
        for j, name in enumerate(found.names)
    }


def _variances(rows: FactorRows, by_key: Mapping[int, Sequence[str]]) -> dict[str, Array]:
    """Source -> what the rows add to the variance of the numbers (n,); by variable the names of its numbers."""
    variances: dict[str, Array] = {}
    for factor, linear, row in rows:
        if factor.family == HELD:  # no source of anything
            continue
        keys = linear.keys()
        names = by_key.get(keys[0], ()) if factor.family == _PRIOR and len(keys) == 1 else ()
        squares = row**2
        if squares.shape[1] == len(names):
            parts = [(f"prior of {name}", squares[:, k]) for k, name in enumerate(names)]
        else:
            parts = [(factor.family, squares.sum(axis=1))]
        for source, part in parts:
            variances[source] = variances.get(source, np.zeros(len(part))) + part
    return variances


def strongest(found: Influence, sigmas: Mapping[str, float], most: int) -> tuple[Pull, ...]:
    """The measurements that move a number most, in its sigmas, each with that number.

    A measurement with whitened residuals r takes the numbers elsewhere by its columns of L times r; at the minimum all
    of these and the priors' are in balance. Measurements of a compressed factor count as one; rejected ones have no
    influence.

    Args:
        found: the influence of the residuals.
        sigmas: of the numbers that are looked at.
        most: so many at most.
    """
    names = [name for name in found.names if name in sigmas]
    columns = [found.names.index(name) for name in names]
    scale = np.array([1.0 / sigmas[name] for name in names])
    if not names:
        return ()
    pulls = [pull for part in found.ask(_pulls, columns, scale, most) for pull in part]
    pulls.sort(key=lambda pull: -abs(pull[3]))
    return tuple(Pull(family, time, names[number], move) for family, time, number, move in pulls[:most])


def _pulls(rows: FactorRows, columns: Sequence[int], scale: Array, most: int) -> list[tuple[str, float, int, float]]:
    """Family, time, which number and by how many sigmas: the measurements among the rows that move one of some most."""
    families: list[str] = []
    times: list[float] = []
    largest: list[tuple[Array, Array]] = []
    for factor, linear, row in rows:
        vectorized = factor.vectorized
        if vectorized is None:
            continue
        time = vectorized.model.time[-1:] if vectorized.compress else vectorized.model.time
        _, r = linear.jacobian()
        moves = (row[columns] * scale[:, None] * r).reshape(len(columns), len(time), -1).sum(axis=2)
        which = np.abs(moves).argmax(axis=0)
        largest.append((which, moves[which, np.arange(len(time))]))
        families += [factor.family] * len(time)
        times += time.tolist()
    if not times:
        return []
    numbers, moved = (np.concatenate(each) for each in zip(*largest, strict=True))
    first = np.argsort(-np.abs(moved), kind="stable")[:most]
    return [(families[i], times[i], int(numbers[i]), float(moved[i])) for i in first.tolist()]
