"""The triangular factor of a linear system, or of some of its variables, and solutions with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.solvers.gtsam_engine import conditionals_of
from alidade.pipelines.solvers.marginals import IndeterminateError, eliminated, explain


@dataclass(frozen=True)
class _Clique:
    """R x + S a = d, x the variables eliminated together, a those above them, by their places in a whole vector."""

    own: NDArray[np.intp]
    above: NDArray[np.intp]
    R: Array
    S: Array
    d: Array


@dataclass(frozen=True)
class Triangular:
    """R of a linear system A = Q R, clique by clique; variables that were not eliminated stay at the end of it.

    Vectors have one column a solution, (D, k), with all variables of the system in the order of their keys.

    Attributes:
        places: variable -> its rows in a vector.
        cliques: in the order of their elimination.
        tree: the same as gtsam has it, which holds their memory.
    """

    places: Mapping[int, slice]
    cliques: list[_Clique]
    tree: gtsam.GaussianBayesTree

    @classmethod
    def of(
        cls, linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, tree: gtsam.GaussianBayesTree | None = None
    ) -> Triangular:
        """Eliminate all or some variables of a system, in order, unless a tree has them already.

        Raises:
            IndeterminateError: a variable is not determined; names it.
        """
        if tree is None:
            tree = eliminated(linear, ordering)[0] if ordering.size() else gtsam.GaussianBayesTree()
        places = places_of(linear)
        return cls(places, [_clique(each, places) for each in conditionals_of(tree, ordering)], tree)

    @cached_property
    def size(self) -> int:
        """Rows of a vector."""
        return max((place.stop for place in self.places.values()), default=0)

    @property
    def right(self) -> Array:
        """(D, 1) the right side, zero where nothing was eliminated."""
        out = np.zeros((self.size, 1))
        for clique in self.cliques:
            out[clique.own, 0] = clique.d
        return out

    def root(self, last: list[int]) -> Array:
        """(d, d) R of the variables that were eliminated last, in this order: what it says of them alone."""
        rows = rows_of(self.places, last)
        column = dict(zip(rows.tolist(), range(len(rows)), strict=True))
        R = np.zeros((len(rows), len(rows)))
        for clique in self.cliques:
            # Those eliminated last come last among a clique's own.
            if clique.own[-1] in column:
                own = [i for i, row in enumerate(clique.own.tolist()) if row in column]
                at = [column[row] for row in clique.own[own].tolist()]
                R[np.ix_(at, at)] = clique.R[np.ix_(own, own)]
                R[np.ix_(at, [column[row] for row in clique.above.tolist()])] = clique.S[own]
        return R

    def forward(self, right: Array) -> Array:
        """(D, k) y with R'y = right where variables were eliminated, elsewhere what that leaves of the right side."""
        y = right.copy()
        for clique in self.cliques:
            if y[clique.own].any():
                y[clique.own] = own = _solved_transposed(clique.R, y[clique.own])
                y[clique.above] -= clique.S.T @ own
        return y

    def back(self, given: Array) -> Array:
        """(D, k) x with R x = given where variables were eliminated; elsewhere it is as given."""
        x = given.copy()
        for clique in reversed(self.cliques):
            right = x[clique.own] - clique.S @ x[clique.above]
            x[clique.own] = np.linalg.solve(clique.R, right)
        return x


def places_of(linear: gtsam.GaussianFactorGraph) -> dict[int, slice]:
    """The rows of each variable of a system in a vector of all of them, in the order of their keys."""
    gradient, keys = linear.gradientAtZero(), sorted(linear.keyVector())
    ends = list(accumulate(len(gradient.at(key)) for key in keys))
    return {key: slice(start, stop) for key, start, stop in zip(keys, [0, *ends], ends, strict=False)}


def rows_of(places: Mapping[int, slice], keys: Sequence[int]) -> NDArray[np.intp]:
    """Rows of some variables, one after the other."""
    return np.array([row for key in keys for row in range(places[key].start, places[key].stop)], dtype=np.intp)


def _solved_transposed(R: Array, right: Array) -> Array:
    """(n, k) y with R'y = right; from the last row on R' is upper triangular too, where nothing is pivoted."""
    return np.asarray(np.linalg.solve(R.T[::-1, ::-1], right[::-1])[::-1])


def _clique(conditional: gtsam.GaussianConditional, places: Mapping[int, slice]) -> _Clique:
    # The first two are memory of the conditional, which goes with its tree.
    R, S, d = conditional.R(), conditional.S(), conditional.d()
    keys = list(conditional.keys())
    if not (np.abs(np.diag(R)) > 0.0).all():
        raise IndeterminateError(explain(f"near variable {keys[0]}"))
    rows = rows_of(places, keys)
    return _Clique(rows[: len(R)], rows[len(R) :], R, S, d)
