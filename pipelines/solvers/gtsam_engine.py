"""Elimination by gtsam: for graphs that are no chain, and as the reference of the chain solver.

Models are evaluated as for the chain; every measurement becomes a gtsam.JacobianFactor about its own variables. All but
the last bias node and the shared unknowns are eliminated by QR in an order of gtsam's choice (COLAMD), and what is left
is R of these. Systems and factorizations are used as those of the chain are.

Limits: a factor and a conditional at a time pass through Python, some 20 us each, and what was known at moments on the
way is not asked for. By QR nothing depends on the least pivot that gtsam's Cholesky accepts, which differs between
processors (gtsam issue 2782).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.factors.bridge import jacobian_factor
from alidade.pipelines.solvers.chain import UNDETERMINED, Factorization, IndeterminateStateError, Index
from alidade.pipelines.solvers.layout import Layout


def _factors(
    layout: Layout, at: Sequence[Index], right: Array, jacobians: Sequence[Array]
) -> list[gtsam.GaussianFactor]:
    """Convert a group's rows to Gaussian factors: one if all have the same variables, else one per measurement."""
    n, m = right.shape
    if all(len(each) == 1 for each in at):
        columns = [np.broadcast_to(J, (n, *J.shape[1:])).reshape(n * m, -1) for J in jacobians]
        return [_factor([int(layout.key[each[0]]) for each in at], columns, right.ravel())]
    keys = [np.broadcast_to(layout.key[each], n) for each in at]
    blocks = [np.broadcast_to(J, (n, *J.shape[1:])) for J in jacobians]
    return [_factor([int(k[i]) for k in keys], [J[i] for J in blocks], right[i]) for i in range(n)]


def _factor(keys: Sequence[int], blocks: Sequence[Array], right: Array) -> gtsam.JacobianFactor:
    """Build a Gaussian factor from rows [A | b]; blocks of a repeated variable add up."""
    summed: dict[int, Array] = {}
    for key, block in zip(keys, blocks, strict=True):
        summed[key] = summed[key] + block if key in summed else block
    widths = [*(block.shape[1] for block in summed.values()), 1]
    return jacobian_factor(list(summed), widths, np.column_stack([*summed.values(), right]))


@dataclass(frozen=True, eq=False)
class GtsamSystem:
    """Linear system about some values, whitened rows A dx = b, as a Gaussian factor graph of gtsam.

    Attributes:
        layout: of the variables.
        graph: of the rows.
        squares: sum of squares of the right side.
    """

    layout: Layout
    graph: gtsam.GaussianFactorGraph
    squares: float

    @classmethod
    def of(cls, layout: Layout, groups: Iterable[tuple[Sequence[Index], Array, Sequence[Array]]]) -> GtsamSystem:
        """Build the system from groups of rows.

        Args:
            layout: of the variables.
            groups: of each, for each block the positions (n or 1,) of its variables, right side (n, m) and Jacobians.
        """
        graph, squares = gtsam.GaussianFactorGraph(), 0.0
        for at, right, jacobians in groups:
            squares += float(np.square(right).sum())
            for factor in _factors(layout, at, right, jacobians):
                graph.push_back(factor)
        return cls(layout, graph, squares)

    def root(self) -> Array:
        """`Factorization.root` alone. Raises IndeterminateStateError."""
        return self.eliminate().root

    def eliminate(self, damping: float = 0.0) -> GtsamFactorization:
        """Eliminate the rows, with each unknown's information times `damping` added. Raises IndeterminateStateError."""
        graph, layout = self._damped(damping) if damping > 0.0 else self.graph, self.layout
        *_, J, c, s = layout.sizes
        last = (layout.keyframe < 0) & ((layout.node <= 0) | (layout.node == J - 1))
        rest = set(layout.key[~last].tolist())
        colamd, ordering = gtsam.Ordering.ColamdGaussianFactorGraph(graph), gtsam.Ordering()
        for key in (colamd.at(i) for i in range(colamd.size())):
            if key in rest:
                ordering.push_back(key)
        try:
            tree, left = graph.eliminatePartialMultifrontal(ordering, gtsam.EliminateQR)
        except RuntimeError as error:
            raise undetermined(error) from None
        columns = {int(key): layout.root_columns(int(key)) for key in layout.key[last]}
        rows = [np.zeros((0, c + s + 1))]
        for i in range(left.size()):
            linear: Any = left.at(i)
            A, b = linear.jacobian()
            parts = np.vstack([columns[key] for key in linear.keys()])
            rows.append(np.column_stack([A @ parts, b]))
        if c:
            absent = np.flatnonzero(~layout.kept[1][-1])
            rows.append(np.eye(c + s + 1)[absent])
        whole = np.concatenate(rows)
        if len(whole) < c + s + 1:
            whole = np.pad(whole, ((0, c + s + 1 - len(whole)), (0, 0)))
        root = np.triu(np.linalg.qr(whole, mode="r"))
        conditionals = [_Conditional.of(each, layout) for each in conditionals_of(tree, ordering)]
        found = GtsamFactorization(layout, c, root, conditionals)
        root[-1, -1] = np.sqrt(self._minimum(graph, found))  # gtsam drops what no variable can change
        return found

    def _minimum(self, graph: gtsam.GaussianFactorGraph, found: GtsamFactorization) -> float:
        """Sum of squares at the solution, or what elimination leaves of it if R is singular."""
        try:
            last = np.asarray(np.linalg.solve(found.root[:-1, :-1], found.root[:-1, -1:]), dtype=float)
            moves = found.moves(last, 1.0, None)
        except np.linalg.LinAlgError:
            return max(self.squares - found.explained, 0.0)
        solution = gtsam.VectorValues()
        for at, move in moves.items():
            solution.insert(int(self.layout.key[at]), move[:, 0])
        return 2.0 * float(graph.error(solution))

    def _damped(self, damping: float) -> gtsam.GaussianFactorGraph:
        graph, layout = gtsam.GaussianFactorGraph(), self.layout
        graph.push_back(self.graph)
        squares = {key: np.zeros(layout.size(at)) for at, key in enumerate(layout.key.tolist())}
        for i in range(self.graph.size()):
            linear: Any = self.graph.at(i)
            own, begin = np.square(linear.jacobian()[0]).sum(axis=0), 0
            for key in linear.keys():
                size = len(squares[key])
                squares[key] += own[begin : begin + size]
                begin += size
        for key, own in squares.items():
            graph.push_back(_factor([key], [np.diag(np.sqrt(damping * own))], np.zeros(len(own))))
        return graph


def undetermined(error: RuntimeError) -> IndeterminateStateError:
    """Convert gtsam's indeterminate-system text to an error that names the state nearby."""
    found = re.search(r"Symbol: (\w+)", str(error))
    return IndeterminateStateError(UNDETERMINED.replace("a state", f"state {found[1]}") if found else UNDETERMINED)


def conditionals_of(tree: gtsam.GaussianBayesTree, ordering: gtsam.Ordering) -> list[gtsam.GaussianConditional]:
    """Conditionals of all variables of an ordering, each once, in the order of elimination."""
    # From the last one back: what is above a clique has been seen when the last of its own comes.
    found, seen = [], set[int]()
    for i in reversed(range(ordering.size())):
        key = ordering.at(i)
        if key not in seen:
            conditional = tree[key].conditional()
            seen.update(conditional.keys())
            found.append(conditional)
    return found[::-1]


@dataclass(frozen=True, eq=False)
class _Conditional:
    """Conditional R x + S others = d of a clique's variables, by their positions in the layout."""

    own: list[int]
    others: list[int]
    R: Array
    S: Array
    d: Array

    @classmethod
    def of(cls, conditional: gtsam.GaussianConditional, layout: Layout) -> _Conditional:
        at = layout.at(list(conditional.keys())).tolist()
        R = np.array(conditional.R(), ndmin=2)  # copies: the memory is the conditional's
        if not (np.abs(np.diag(R)) > 0.0).all():
            raise IndeterminateStateError(UNDETERMINED)
        S = np.array(conditional.S()).reshape(len(R), -1)
        count = int(np.searchsorted(np.cumsum([layout.size(i) for i in at]), len(R))) + 1
        return cls(at[:count], at[count:], R, S, np.array(conditional.d(), ndmin=1))


@dataclass(frozen=True, eq=False)
class GtsamFactorization(Factorization):
    """R of a linear system that gtsam eliminates."""

    layout: Layout
    c: int
    root: Array
    _conditionals: list[_Conditional]

    @property
    def explained(self) -> float:
        """Decrease of the sum of squares from a zero step to the solution."""
        return sum(float(np.square(d).sum()) for d in (self.root[:-1, -1], *(each.d for each in self._conditionals)))

    def moves(self, last: Array, right: float, generator: np.random.Generator | None) -> dict[int, Array]:
        """Moves (dim, n) of each variable, by position, that follow from the last node and the shared unknowns."""
        layout, found, J = self.layout, dict[int, Array](), self.layout.sizes[2]
        for at in np.flatnonzero((layout.keyframe < 0) & ((layout.node <= 0) | (layout.node == J - 1))).tolist():
            found[at] = layout.root_columns(int(layout.key[at])) @ last
        for each in reversed(self._conditionals):
            rest = right * each.d[:, None]
            if generator is not None:
                rest = rest - generator.standard_normal((len(each.d), last.shape[1]))
            if each.others:
                rest = rest - each.S @ np.vstack([found[at] for at in each.others])
            ends = np.cumsum([layout.size(at) for at in each.own])[:-1]
            found |= zip(each.own, np.split(np.linalg.solve(each.R, rest), ends), strict=True)
        return found

    def _back(self, last: Array, right: float, generator: np.random.Generator | None = None) -> tuple[Array, Array]:
        layout, n = self.layout, last.shape[1]
        N, d, J, c, _ = layout.sizes
        states, nodes, found = np.zeros((N, d, n)), np.zeros((J, c, n)), self.moves(last, right, generator)
        first = int(np.flatnonzero(layout.node == 0)[0]) if c else -1
        for at, x in found.items():
            size = layout.size(at)
            if layout.keyframe[at] >= 0:
                states[layout.keyframe[at], layout.offset[at] : layout.offset[at] + size] = x
            elif layout.node[at] > 0:
                nodes[layout.node[at], layout.part[at] : layout.part[at] + size] = x - found[first]
        return states, nodes
