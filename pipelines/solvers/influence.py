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

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from pipelines.graph.problem import Array, Factor, Problem, Pull
from pipelines.solvers.marginals import HELD
from pipelines.solvers.system import Linear

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

    def rows(self) -> Iterator[tuple[Factor, gtsam.GaussianFactor, Array]]:
        """Each factor, it linearised, and the derivative (n, m) of the numbers by its m whitened residuals."""
        for part, solutions in self.linear.solved(self.solutions):
            for i, (factor, (A, rows)) in enumerate(zip(part.factors, part.blocks(), strict=True)):
                yield factor, part.graph.at(i), (A @ solutions[rows]).T

    def moves(self, changed: Linear) -> Array:
        """(n,) by how much the numbers are elsewhere at the minimum of a graph that is a little different.

        To first order that is J N^-1 times the difference of the gradients A^T r, and the rows of the two graphs need
        not be the same, as compressed ones are not.

        Args:
            changed: that graph, linearised where this one is.
        """
        moved = np.zeros(len(self.names))
        for (part, solutions), other in zip(self.linear.solved(self.solutions), changed.parts(), strict=True):
            keys = list(part.triangular.places)
            before, after = part.graph.gradientAtZero(), other.graph.gradientAtZero()
            moved -= solutions.T @ (after.vector(keys) - before.vector(keys))
        return moved


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
    by_key = {p.key: p for p in problem.parameters}
    variances: dict[str, Array] = {}
    for factor, linear, rows in found.rows():
        if factor.family == HELD:  # no source of anything
            continue
        keys = linear.keys()
        parameter = by_key.get(keys[0]) if factor.family == _PRIOR and len(keys) == 1 else None
        squares = rows**2
        if parameter is not None and squares.shape[1] == len(parameter.quantities):
            parts = [(f"prior of {q.name}", squares[:, k]) for k, q in enumerate(parameter.quantities)]
        else:
            parts = [(factor.family, squares.sum(axis=1))]
        for source, part in parts:
            variances[source] = variances.get(source, np.zeros(len(found.names))) + part
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
    families: list[str] = []
    times: list[float] = []
    largest: list[tuple[Array, Array]] = []
    for factor, linear, rows in found.rows():
        vectorized = factor.vectorized
        if vectorized is None:
            continue
        time = vectorized.model.time[-1:] if vectorized.compress else vectorized.model.time
        _, r = linear.jacobian()
        moves = (rows[columns] * scale[:, None] * r).reshape(len(names), len(time), -1).sum(axis=2)
        which = np.abs(moves).argmax(axis=0)
        largest.append((which, moves[which, np.arange(len(time))]))
        families += [factor.family] * len(time)
        times += time.tolist()
    if not times:
        return ()
    numbers, moved = (np.concatenate(each) for each in zip(*largest, strict=True))
    first = np.argsort(-np.abs(moved), kind="stable")[:most]
    return tuple(Pull(families[i], times[i], names[numbers[i]], float(moved[i])) for i in first.tolist())
