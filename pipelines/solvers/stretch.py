"""A stretch of a graph: about some values it says, as linear rows, what it knows of variables that others hold too.

The variables that it alone holds are eliminated for that, and follow by back substitution once the others are known.
What is made of it on the way stays where it was made, in whichever process that is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.factors.loss import TruncatedLoss
from alidade.factors.vectorized import Ensemble, VectorizedFactor
from alidade.pipelines.estimation.problem import Array, Factor
from alidade.pipelines.solvers.gtsam_engine import conditionals_of
from alidade.pipelines.solvers.linear_system import damped, elimination_ordering, graph_of, linear_graph_of
from alidade.pipelines.solvers.marginals import IndeterminateError, eliminated, explain, ordering_of
from alidade.pipelines.solvers.triangular import Triangular, rows_of

# Variable and which of its numbers -> information about it that a linear system has too much.
Excess = dict[tuple[int, int], Array]


class Keep(Enum):
    """What is kept of a stretch while its graph is looked at: linear rows and all, what back substitution needs, none.

    What is not kept is made anew whenever it is needed.
    """

    NOTHING = 0
    TREES = 1
    ALL = 2


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive factors of a graph.

    Attributes:
        factors: as they are.
        others: those of them that are not vectorised.
        inner: variables that no other stretch holds, in the order of their elimination; of a graph in one piece none.
        held: all others, in the order of their keys.
        outer: which of the factors hold none of the inner ones.
        ensemble: the vectorised ones among the factors, where all is kept.
    """

    factors: Sequence[Factor]
    others: gtsam.NonlinearFactorGraph
    inner: Sequence[int]
    held: Sequence[int]
    outer: Sequence[int]
    ensemble: Ensemble | None

    @classmethod
    def alone(cls, factors: Sequence[Factor], graph: gtsam.NonlinearFactorGraph) -> Stretch:
        """A graph in one piece, as gtsam has it too."""
        held = sorted(graph.keyVector())
        return cls(factors, _others(factors), (), held, range(len(factors)), Ensemble(vectorized(factors)))

    @classmethod
    def of(cls, factors: Sequence[Factor], joint: set[int], keep: Keep) -> Stretch:
        """One of several, `joint` the variables that are not its own."""
        graph = graph_of(factors)
        outer = [i for i, f in enumerate(factors) if joint.issuperset(f.factor.keys())]
        held = sorted(joint.intersection(graph.keyVector()))
        whole = elimination_ordering(graph, held)
        inner = [whole.at(i) for i in range(whole.size() - len(held))]
        ensemble = Ensemble(vectorized(factors)) if keep is Keep.ALL else None
        return cls(factors, _others(factors), inner, held, outer, ensemble)

    def made_of(self, factors: Sequence[Factor]) -> Stretch:
        """The same with other noise."""
        ensemble = None if self.ensemble is None else Ensemble(vectorized(factors))
        return replace(self, factors=factors, others=_others(factors), ensemble=ensemble)

    @cached_property
    def ordering(self) -> gtsam.Ordering:
        """Of the inner ones."""
        return ordering_of(self.inner)

    @cached_property
    def keys(self) -> list[int]:
        """All of its variables, in their order: that of vectors."""
        return sorted([*self.inner, *self.held])

    def at(self, values: gtsam.Values, loss: TruncatedLoss | None) -> AbstractContextManager[None]:
        """Within the block the factors answer for these values, under the loss."""
        return self._together.at(values, loss)

    @property
    def _together(self) -> Ensemble:
        """Its vectorised factors."""
        return self.ensemble or Ensemble(vectorized(self.factors))

    def error(self, values: gtsam.Values, loss: TruncatedLoss | None) -> float:
        """Half the sum of squares."""
        ensemble = self._together
        with ensemble.at(values, loss):
            return ensemble.error + float(self.others.error(values))

    def linearize(
        self, values: gtsam.Values, loss: TruncatedLoss | None, excess: Excess | None = None
    ) -> gtsam.GaussianFactorGraph:
        """The linear system about the values; with the mixed second derivatives where their `excess` is asked for."""
        ensemble = self._together
        with ensemble.at(values, loss, excess is not None):
            if excess is not None:
                for key, number, information in ensemble.excess():
                    excess[key, number] = excess.get((key, number), np.zeros(2)) + information
            return linear_graph_of(self.factors, values)


@dataclass(frozen=True, eq=False)
class Part:
    """A stretch, linearised.

    Attributes:
        stretch: as it is.
        graph: its linear system.
        tree: of its own variables, if they are eliminated already.
    """

    stretch: Stretch
    graph: gtsam.GaussianFactorGraph
    tree: gtsam.GaussianBayesTree | None = None

    @cached_property
    def triangular(self) -> Triangular:
        """The triangular factor of its own variables. Raises IndeterminateError, naming one that is not determined."""
        return Triangular.of(self.graph, self.stretch.ordering, self.tree)

    @cached_property
    def held(self) -> NDArray[np.intp]:
        """The rows in a vector of the variables that others hold too."""
        return rows_of(self.triangular.places, self.stretch.held)

    @cached_property
    def _rows(self) -> list[NDArray[np.intp]]:
        """The rows that the variables of each factor have in a vector."""
        return [rows_of(self.triangular.places, self.graph.at(i).keys()) for i in range(self.graph.size())]

    def blocks(self) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """The rows of each linearised factor (m, d), and where in a vector its d numbers are."""
        return ((self.graph.at(i).jacobian()[0], rows) for i, rows in enumerate(self._rows))

    def solved(self, held: Array, right: Array | None = None) -> Array:
        """(D, k) vectors of its variables that solve its own equations.

        Args:
            held: (d, k) of those that others hold too.
            right: (D, k) of the equations, zero without it.
        """
        given = np.zeros((self.triangular.size, held.shape[1])) if right is None else right.copy()
        given[self.held] = held
        return self.triangular.back(given)


class Dense(NamedTuple):
    """A linear factor as arrays, as alidade.factors.vectorized.jacobian_factor has them."""

    keys: list[int]
    widths: list[int]
    augmented: Array


@dataclass(frozen=True)
class Reduced:
    """What a stretch says of the variables that others hold too.

    Attributes:
        outer: its factors that hold no others.
        left: what the elimination of its own variables leaves.
        excess: of a system with mixed second derivatives, see Ensemble.at.
    """

    outer: list[Dense]
    left: list[Dense]
    excess: Excess


@dataclass(eq=False)
class StretchAt:
    """A stretch about some values, and what is kept of it there.

    Attributes:
        stretch: as it is.
        values: about which.
        loss: in force.
        keep: how much is kept.
    """

    stretch: Stretch
    values: gtsam.Values
    loss: TruncatedLoss | None
    keep: Keep
    _damping: float = field(default=0.0, init=False)
    _mixed: bool = field(default=False, init=False)
    _tree: gtsam.GaussianBayesTree | None = field(default=None, init=False)
    _part: Part | None = field(default=None, init=False)

    def error(self) -> float:
        """Half the sum of squares."""
        return self.stretch.error(self.values, self.loss)

    def reduced(self, damping: float, mixed: bool) -> Reduced:
        """Its own variables eliminated, with mixed second derivatives or without.

        `damping` holds these where they are by so many times their information, see `damped`.
        Raises IndeterminateError, naming a variable of its own that is not determined.
        """
        self._damping, self._mixed = damping, mixed
        excess: Excess = {}
        graph, outer = self._linearized(excess), set(self.stretch.outer)
        own, others = gtsam.GaussianFactorGraph(), gtsam.GaussianFactorGraph()
        for i in range(graph.size()):
            (others if i in outer else own).push_back(graph.at(i))
        tree, left = eliminated(own, self.stretch.ordering)
        if self.keep is not Keep.NOTHING:
            self._tree = tree
        if self.keep is Keep.ALL:
            self._part = Part(self.stretch, graph, tree)
        return Reduced(list(_dense(others)), list(_dense(left)), excess)

    def part(self) -> Part:
        """The stretch linearised about the values, as it was reduced."""
        return self._part or Part(self.stretch, self._linearized({}), self._tree)

    def follow(self, held: Sequence[Array]) -> tuple[gtsam.VectorValues, float]:
        """The moves of its own variables where others move so, and by how much they alone lower the error.

        Raises IndeterminateError, naming a variable of its own near one that is not determined.
        """
        delta, own, lowers = gtsam.VectorValues(), gtsam.VectorValues(), 0.0
        for key, move in zip(self.stretch.held, held, strict=True):
            delta.insert(key, move)
        tree = self._tree or eliminated(self._linearized({}), self.stretch.ordering)[0]
        # Those above come first.
        for conditional in reversed(conditionals_of(tree, self.stretch.ordering)):
            solved, d = conditional.solve(delta), conditional.d()
            lowers += 0.5 * float(d @ d)
            delta.insert(solved)
            own.insert(solved)
        if not np.isfinite(own.vector()).all():
            raise IndeterminateError(explain(f"near variable {self.stretch.inner[0]}"))
        return own, lowers

    def _linearized(self, excess: Excess) -> gtsam.GaussianFactorGraph:
        graph = self.stretch.linearize(self.values, self.loss, excess if self._mixed else None)
        return damped(graph, self._damping, self.stretch.inner) if self._damping > 0.0 else graph


def vectorized(factors: Sequence[Factor]) -> list[VectorizedFactor]:
    """The vectorised ones among factors."""
    return [v for f in factors if (v := f.vectorized) is not None]


def _others(factors: Sequence[Factor]) -> gtsam.NonlinearFactorGraph:
    return graph_of([f for f in factors if f.vectorized is None])


def _dense(graph: gtsam.GaussianFactorGraph) -> Iterable[Dense]:
    """Linear factors as arrays."""
    zero = graph.gradientAtZero()
    for i in range(graph.size()):
        factor = graph.at(i)
        keys = list(factor.keys())
        A, b = factor.jacobian()
        yield Dense(keys, [*(len(zero.at(key)) for key in keys), 1], np.column_stack([A, b]))
