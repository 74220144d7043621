"""A graph as the batch solver has it: factors to be evaluated and linearised, whole or stretch by stretch.

A long recording is divided into stretches of time. The variables that only one of them holds are eliminated there,
which leaves, as square root of information, what the stretch says of the others; these rows of all stretches are the
system that is solved. Where the others are known, a stretch's own variables follow by back substitution. That is the
whole system's elimination in another order, hence exact, and only one stretch is linearised at a time: what memory
holds of a state of many hours is its value and residuals. A stretch is linearised anew whenever it is needed, and of
many hours eliminated, too.

A short recording is one stretch of which nothing is eliminated in advance.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise, product
from typing import TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.loss import TruncatedLoss
from factors.vectorized import Ensemble, VectorizedFactor, residuals_at
from pipelines import progress
from pipelines.graph.problem import Array, Factor, Residuals
from pipelines.solvers.assembly import StepBoundary
from pipelines.solvers.history import MOMENTS
from pipelines.solvers.marginals import IndeterminateError, eliminated, joint_information, marginal, ordering_of
from pipelines.solvers.triangular import Triangular, conditionals_of, rows_of

Shown = TypeVar("Shown")
# Variable and which of its numbers -> information about it that a linear system has too much.
Excess = dict[tuple[int, int], Array]
Elimination = Callable[
    [gtsam.GaussianFactorGraph, gtsam.Ordering], tuple[gtsam.GaussianConditional, gtsam.GaussianFactor]
]

# What is held is held this tightly, in the units of each variable.
_HELD = 1e-12
# A graph of more variables is divided, and into stretches of about so many, or fewer where that gives the history too
# few moments.
_UNDIVIDED, _STRETCH = 150_000, 3_000
# Up to so many variables what back substitution needs of stretches is kept, 6 kB each; of more it is found anew.
_KEPT = 400_000
# Of the information that a system with mixed second derivatives has about a number no more than this share is too much.
_EXCESS = 0.98


def shown(stretches: Sequence[Shown]) -> Iterable[Shown]:
    """Stretches, or their numbers, shown as they are taken where there are several."""
    return stretches if len(stretches) == 1 else progress.track(stretches, "stretch by stretch", len(stretches))


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive factors of a graph.

    Attributes:
        factors: as they are.
        others: those of them that are not vectorised.
        inner: variables that no other stretch holds, in the order of their elimination; of a graph in one piece none.
        outer: which of the factors hold none of these.
        ensemble: the vectorised ones among the factors, kept where there is but one stretch.
    """

    factors: Sequence[Factor]
    others: gtsam.NonlinearFactorGraph
    inner: gtsam.Ordering
    outer: Sequence[int]
    ensemble: Ensemble | None

    @classmethod
    def alone(cls, factors: Sequence[Factor]) -> Stretch:
        """A graph in one piece."""
        return cls(factors, _others(factors), gtsam.Ordering(), range(len(factors)), Ensemble(_vectorized(factors)))

    @classmethod
    def of(cls, factors: Sequence[Factor], joint: set[int]) -> Stretch:
        """One of several, `joint` the variables that are not its own."""
        graph = graph_of(factors)
        outer = [i for i, f in enumerate(factors) if joint.issuperset(f.factor.keys())]
        held = joint.intersection(graph.keyVector())
        whole = elimination_ordering(graph, sorted(held))
        inner = ordering_of(whole.at(i) for i in range(whole.size() - len(held)))
        return cls(factors, _others(factors), inner, outer, None)

    def made_of(self, factors: Sequence[Factor]) -> Stretch:
        """The same with other noise."""
        ensemble = None if self.ensemble is None else Ensemble(_vectorized(factors))
        return replace(self, factors=factors, others=_others(factors), ensemble=ensemble)

    def at(self, values: gtsam.Values, loss: TruncatedLoss | None) -> AbstractContextManager[None]:
        """Within the block the factors answer for these values, under the loss."""
        return self._together.at(values, loss)

    @property
    def _together(self) -> Ensemble:
        """Its vectorised factors."""
        return self.ensemble or Ensemble(_vectorized(self.factors))

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
    """A stretch about some values.

    Attributes:
        factors: of it.
        graph: the same, linearised.
        inner: as the stretch has it.
        tree: of its own variables, if they are eliminated already.
    """

    factors: Sequence[Factor]
    graph: gtsam.GaussianFactorGraph
    inner: gtsam.Ordering
    tree: gtsam.GaussianBayesTree | None = None

    @cached_property
    def triangular(self) -> Triangular:
        """The triangular factor of its own variables. Raises IndeterminateError, naming one that is not determined."""
        return Triangular.of(self.graph, self.inner, self.tree)

    @cached_property
    def _rows(self) -> list[NDArray[np.intp]]:
        """The rows that the variables of each factor have in a vector."""
        return [rows_of(self.triangular.places, self.graph.at(i).keys()) for i in range(self.graph.size())]

    def blocks(self) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """The rows of each linearised factor (m, d), and where in a vector its d numbers are."""
        return ((self.graph.at(i).jacobian()[0], rows) for i, rows in enumerate(self._rows))


@dataclass(frozen=True, eq=False)
class Linear:
    """A graph about some values, linearised.

    Attributes:
        system: the graph.
        values: about which.
        damping: with which a stretch's own variables are held where they are.
        graph: what the stretches say of the variables that they share, all of it for a graph in one piece.
        families: of its factors, empty for those left of an elimination.
        boundaries: ends of stretches, counted in its factors; of a graph in one piece the ends of the steps.
        trees: of the variables that each stretch alone holds, where they are kept.
        excess: of a system with mixed second derivatives, see Ensemble.at; a step goes without it. None: it has none.
    """

    system: System
    values: gtsam.Values
    damping: float
    graph: gtsam.GaussianFactorGraph
    families: Sequence[str]
    boundaries: Sequence[StepBoundary]
    trees: Sequence[gtsam.GaussianBayesTree | None] = (None,)
    excess: Excess | None = None

    @cached_property
    def triangular(self) -> Triangular:
        """The triangular factor of `graph`. Raises IndeterminateError, naming a variable that is not determined."""
        return Triangular.of(self.graph, self.system.ordering)

    def part(self, i: int) -> Part:
        """A stretch; the only one of a graph in one piece is this system itself."""
        if len(self.system.stretches) == 1:
            return self._alone
        mixed: Excess | None = None if self.excess is None else {}
        found = self.system.part(self.system.stretches[i], self.values, self.damping, mixed)
        return replace(found, tree=self.trees[i])

    @cached_property
    def _alone(self) -> Part:
        (stretch,) = self.system.stretches
        return Part(stretch.factors, self.graph, stretch.inner)

    def parts(self) -> Iterator[Part]:
        """The stretches, one after the other."""
        return map(self.part, shown(range(len(self.system.stretches))))

    def shared(self, part: Part) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The rows that the variables of `graph` which a part holds have in its vectors, and in the part's."""
        ours, its = self.triangular.places, part.triangular.places
        keys = [key for key in its if key in ours]
        return rows_of(ours, keys), rows_of(its, keys)

    def solved(self, joint: Array, own: Callable[[Part], Array] | None = None) -> Iterator[tuple[Part, Array]]:
        """Every part with a vector of its variables that solves its own equations.

        Args:
            joint: (D, k) of the variables of `graph`.
            own: a part's right side, all of its rows; without it is zero.
        """
        for part in self.parts():
            ours, its = self.shared(part)
            right = np.zeros((part.triangular.size, joint.shape[1])) if own is None else own(part)
            right[its] = joint[ours]
            yield part, part.triangular.back(right)

    def drawn(self, keys: Collection[int], count: int, generator: np.random.Generator) -> list[gtsam.Values]:
        """Values drawn from their covariance about these, by what some variables add to it.

        Raises:
            IndeterminateError: a variable is not determined.
        """
        dims = self.values.dims()
        units = {key: np.zeros((dims[key], count)) for key in self.values.keys()}
        for k, (key, unit) in product(range(count), units.items()):
            if key in keys:
                unit[:, k] = generator.standard_normal(len(unit))

        def of(places: Mapping[int, slice]) -> Array:
            return np.concatenate([units[key] for key in places])

        return self._moved(of(self.triangular.places), lambda part: of(part.triangular.places))

    def followed(self, keys: Sequence[int], moves: Array) -> list[gtsam.Values]:
        """Values with the variables that all measurements share moved, the others where they are likeliest then.

        Args:
            keys: these variables.
            moves: (d, k) of their tangents, one after the other, a column each.

        Raises:
            IndeterminateError: a variable is not determined.
        """
        # These are eliminated last: their rows hold no other.
        own = rows_of(self.triangular.places, list(keys))
        right = np.zeros((self.triangular.size, moves.shape[1]))
        right[own] = self.triangular.root(list(keys)) @ moves
        return self._moved(right)

    def _moved(self, right: Array, own: Callable[[Part], Array] | None = None) -> list[gtsam.Values]:
        """Values (k,) moved by R^-1 times (D, k) of the variables of `graph`, and of a part's own as in `solved`."""
        joint = self.triangular.back(right)
        moves = [gtsam.VectorValues() for _ in range(joint.shape[1])]
        inserted: set[int] = set()
        for part, x in self.solved(joint, own):
            for key in part.triangular.places.keys() - inserted:
                for move, column in zip(moves, x[part.triangular.places[key]].T, strict=True):
                    move.insert(key, column)
            inserted.update(key for key in part.triangular.places if key in self.triangular.places)
        return [self.values.retract(move) for move in moves]

    def damped(self, damping: float) -> Linear:
        """With each unknown held where it is by so many times its own information."""
        if len(self.system.stretches) > 1:
            return self.system.linearized(self.values, damping)
        return replace(self, graph=damped(self.graph, damping))

    def holding(self, at: Mapping[int, Array]) -> Linear:
        """With some of the variables that stretches share held at moves (d,)."""
        graph = gtsam.GaussianFactorGraph()
        graph.push_back(self.graph)
        for key, move in at.items():
            noise = gtsam.noiseModel.Isotropic.Sigma(len(move), _HELD)
            graph.add(gtsam.JacobianFactor(key, np.eye(len(move)), move, noise))
        return replace(self, graph=graph, excess=None)

    @property
    def has_states(self) -> bool:
        """Whether there are variables that not all measurements share."""
        return len(self.system.shared) < self.system.ordering.size()

    def of_the_known(self) -> gtsam.VectorValues:
        """The move to the minimum, but for directions of the shared variables that little is known about.

        These are held by the geometric mean of the most and the least that is known of a direction; states follow.
        Raises RuntimeError if these are not determined.
        """
        shared = self.system.shared
        information, slope = marginal(self.graph, self.system.ordering, shared).hessian(ordering_of(shared))
        known, axes = np.linalg.eigh(information)
        known = np.maximum(known, np.finfo(float).eps * known[-1])
        move = axes @ (axes.T @ slope / (known + np.sqrt(known[0] * known[-1])))
        delta, dims, end = gtsam.VectorValues(), self.values.dims(), 0
        for key in shared:
            start, end = end, end + dims[key]
            delta.insert(key, move[start:end])
        return self.holding({key: delta.at(key) for key in shared}).step()[0] if self.has_states else delta

    def information(self, keys: Sequence[int]) -> Array:
        """(d, d) of the variables that all measurements share, in this order, all others marginalised out.

        Raises IndeterminateError if one of the others is not determined.
        """
        try:
            R = self.triangular.root(list(keys))
        except IndeterminateError:
            # Those asked for may be undetermined.
            return joint_information(self.graph, self.system.ordering, keys)
        return R.T @ R

    def solution(self) -> gtsam.VectorValues:
        """The move to the minimum. Raises IndeterminateError, naming a variable that is not determined."""
        solution = self.triangular.back(self.triangular.right)[:, 0]
        delta = gtsam.VectorValues()
        for key, place in self.triangular.places.items():
            delta.insert(key, solution[place])
        self._follow(delta)
        return delta

    def states_alone(self) -> gtsam.VectorValues:
        """The same with the variables that all measurements share held; raises RuntimeError if that is singular."""
        dims, still = self.values.dims(), gtsam.VectorValues()
        for key in self.system.shared:
            still.insert(key, np.zeros(dims[key]))
        delta, _ = self.holding({key: still.at(key) for key in self.system.shared}).step()
        # To the last digit, too.
        delta.update(still)
        return delta

    def step(self, on_floor: bool = False) -> tuple[gtsam.VectorValues, float]:
        """The same, by gtsam's own solution, and by how much it lowers the error. Raises RuntimeError if singular.

        `on_floor`: the states are where they are likeliest, so that all of the excess is known.
        """
        function: Elimination = gtsam.EliminateQR
        if self.excess:
            too_much = {place: each.sum() if on_floor else each[0] for place, each in self.excess.items()}
            function = without_excess(too_much, self.values.dims())
        delta = self.graph.optimize(self.system.ordering, function)
        gradient, keys = self.graph.gradientAtZero(), list(self.graph.keyVector())
        return delta, self._follow(delta) - 0.5 * float(gradient.vector(keys) @ delta.vector(keys))

    def _follow(self, delta: gtsam.VectorValues) -> float:
        """Add stretches' own variables to a solution that has all others; by how much they alone lower the error."""
        lowers = 0.0
        for i, stretch in enumerate(shown(self.system.stretches)):
            if not stretch.inner.size():
                continue
            tree = self.trees[i] or eliminated(self.part(i).graph, stretch.inner)[0]
            # Those above come first.
            for conditional in reversed(conditionals_of(tree, stretch.inner)):
                solved, d = conditional.solve(delta), conditional.d()
                lowers += 0.5 * float(d @ d)
                for key in conditional.keys():
                    if not delta.exists(key):
                        delta.insert(key, solved.at(key))
        return lowers


@dataclass(frozen=True, eq=False)
class System:
    """A graph, its stretches, and the order in which variables are eliminated.

    Attributes:
        stretches: its factors, in time order.
        boundaries: the stretches' ends; of a graph in one piece those of all steps.
        ordering: of the elimination of the variables that stretches share, those of all of them last.
        shared: the variables that all measurements share.
        loss: how those that may be outliers are weighed; None counts all in full.
    """

    stretches: Sequence[Stretch]
    boundaries: Sequence[StepBoundary]
    ordering: gtsam.Ordering
    shared: Sequence[int]
    loss: TruncatedLoss | None

    @classmethod
    def of(
        cls,
        factors: Sequence[Factor],
        shared: Sequence[int],
        loss: TruncatedLoss | None,
        boundaries: Sequence[StepBoundary] = (),
    ) -> System:
        """The system of some factors, divided at some of the boundaries if it is long."""
        ends = _divided(factors, boundaries)
        if len(ends) < 2:
            alone = Stretch.alone(factors)
            return cls([alone], boundaries, elimination_ordering(graph_of(factors), shared), shared, loss)
        pieces = _pieces(factors, ends)
        joint = _joint(pieces, boundaries, shared)
        stretches = [Stretch.of(piece, set(joint)) for piece in pieces]
        return cls(stretches, ends, ordering_of(joint), shared, loss)

    @property
    def factors(self) -> Sequence[Factor]:
        """All of them."""
        if len(self.stretches) == 1:
            return self.stretches[0].factors
        return [f for stretch in self.stretches for f in stretch.factors]

    @cached_property
    def measured(self) -> int:
        """Rows of all measurements."""
        models = [f.measurement.model for f in self.factors if f.measurement is not None]
        return sum(len(model.time) * model.rows for model in models)

    def made_of(self, factors: Sequence[Factor]) -> System:
        """The same system with other noise: of factors on the same variables, one for one."""
        begin, made = 0, []
        for stretch in self.stretches:
            made.append(stretch.made_of(factors[begin : begin + len(stretch.factors)]))
            begin += len(stretch.factors)
        return replace(self, stretches=made)

    def under(self, loss: TruncatedLoss | None) -> System:
        """The same system with another loss."""
        return replace(self, loss=loss)

    @contextmanager
    def at(self, values: gtsam.Values) -> Iterator[None]:
        """Within the block the factors answer for these values, under the system's loss; residuals alone if divided."""
        if len(self.stretches) == 1:
            with self.stretches[0].at(values, self.loss):
                yield
        else:
            with residuals_at([_vectorized(stretch.factors) for stretch in self.stretches], values, self.loss):
                yield

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squares."""
        return sum(stretch.error(values, self.loss) for stretch in shown(self.stretches))

    def part(self, stretch: Stretch, values: gtsam.Values, damping: float = 0.0, excess: Excess | None = None) -> Part:
        """One of several stretches about the values, damped as `Linear.damping` says."""
        graph = stretch.linearize(values, self.loss, excess)
        if damping > 0.0:
            graph = damped(graph, damping, _keys(stretch.inner))
        return Part(stretch.factors, graph, stretch.inner)

    def linearized(self, values: gtsam.Values, damping: float = 0.0, mixed: bool = False) -> Linear:
        """About the values, each unknown held there by so many times its information; `mixed` as Ensemble.at has it.

        Raises:
            IndeterminateError: one of several stretches does not determine a variable of its own; names it.
        """
        excess: Excess | None = {} if mixed else None
        if len(self.stretches) == 1:
            (alone,) = self.stretches
            graph, families = alone.linearize(values, self.loss, excess), [f.family for f in alone.factors]
            if damping > 0.0:
                graph = damped(graph, damping)
            return Linear(self, values, damping, graph, families, self.boundaries, excess=excess)
        graph, families, boundaries, trees = gtsam.GaussianFactorGraph(), [], [], []
        kept = sum(stretch.inner.size() for stretch in self.stretches) <= _KEPT
        for stretch, end in zip(shown(self.stretches), self.boundaries, strict=True):
            part, outer = self.part(stretch, values, damping, excess), set(stretch.outer)
            own = gtsam.GaussianFactorGraph()
            for i in range(part.graph.size()):
                if i in outer:
                    graph.push_back(part.graph.at(i))
                    families.append(stretch.factors[i].family)
                else:
                    own.push_back(part.graph.at(i))
            tree, left = eliminated(own, stretch.inner)
            trees.append(tree if kept else None)
            for i in range(left.size()):
                graph.push_back(left.at(i))
                families.append("")
            boundaries.append(end._replace(factors=graph.size()))
        if damping > 0.0:
            graph = damped(graph, damping)
        return Linear(self, values, damping, graph, families, boundaries, trees, excess)

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """What `linearized` says of the variables that stretches share, all of it for a graph in one piece."""
        return self.linearized(values).graph

    def without_rejected(self, values: gtsam.Values) -> System:
        """The same system with the measurements alone that count at the values, wherever it is asked from then on."""
        factors = self.factors
        with self.at(values):
            kept = [without_rejected(f, f, values) for f in factors]
        same = all(one is other for one, other in zip(kept, factors, strict=True))
        return (self if same else self.made_of(kept)).under(None)

    def residuals(self, values: gtsam.Values) -> dict[str, Residuals]:
        """Residuals of all measurements, by family."""
        with self.at(values):
            return residuals_of(self.factors, values)


def without_excess(excess: Mapping[tuple[int, int], float], dims: Mapping[int, int]) -> Elimination:
    """Elimination by QR of a system whose last clique then moves as if it knew so much less.

    With R x = d of that clique, U the roots of what is too much and V = R'^-1 U, (R'R - UU') x = R'd has the same R and
    (1 - VV')^-1 d for d. Where hardly any information would be left the excess stays, and the step is shorter than it
    might be.
    """

    def eliminate(
        factors: gtsam.GaussianFactorGraph, keys: gtsam.Ordering
    ) -> tuple[gtsam.GaussianConditional, gtsam.GaussianFactor]:
        conditional, left = gtsam.EliminateQR(factors, keys)
        own = list(conditional.keys())
        ends = dict(zip(own, accumulate(dims[key] for key in own), strict=True))
        rows = {ends[key] - dims[key] + number: c for (key, number), c in excess.items() if key in ends and c > 0.0}
        if not rows or conditional.S().shape[1]:
            return conditional, left
        R = conditional.R()
        units = np.zeros((len(R), len(rows)))
        units[list(rows), range(len(rows))] = np.sqrt(list(rows.values()))
        V = np.linalg.solve(R.T, units)
        if np.linalg.norm(V, 2) ** 2 > _EXCESS:
            return conditional, left
        d = np.linalg.solve(np.eye(len(R)) - V @ V.T, conditional.d())
        terms = [(key, R[:, ends[key] - dims[key] : ends[key]]) for key in own]
        return gtsam.GaussianConditional(terms, len(own), d, gtsam.noiseModel.Unit.Create(len(d))), left

    return eliminate


def _divided(factors: Sequence[Factor], boundaries: Sequence[StepBoundary]) -> list[StepBoundary]:
    """Ends of stretches, each with about as many new variables as the others; none for a short graph."""
    seen: set[int] = set()
    count, begin = [], 0
    for boundary in boundaries:
        for f in factors[begin : boundary.factors]:
            seen.update(f.factor.keys())
        begin = boundary.factors
        count.append(len(seen))
    if not count or len(seen) <= _UNDIVIDED:
        return []
    stretch = np.array(count) // min(_STRETCH, -(-len(seen) // MOMENTS))
    return [boundaries[i] for i in (*np.flatnonzero(np.diff(stretch)), len(boundaries) - 1)]


def _pieces(factors: Sequence[Factor], ends: Sequence[StepBoundary]) -> list[Sequence[Factor]]:
    """The factors of each stretch; what comes after the last end belongs to the last."""
    cuts = [0, *(end.factors for end in ends[:-1]), len(factors)]
    return [factors[begin:end] for begin, end in pairwise(cuts)]


def _joint(
    pieces: Sequence[Sequence[Factor]], boundaries: Sequence[StepBoundary], shared: Sequence[int]
) -> dict[int, None]:
    """Variables of several stretches and those that ever hold a parameter, in order of last use, the shared ones last.

    Eliminated in that order they leave a band: what is held until the end would join all stretches if it went first.
    """
    own = [np.unique([key for f in piece for key in f.factor.keys()]).tolist() for piece in pieces]
    joint = {key for boundary in boundaries for key in boundary.current_keys.values()}
    seen: set[int] = set()
    for keys in own:
        joint.update(seen.intersection(keys))
        seen.update(keys)
    joint.update(shared)
    # From the last one back, and that turned round.
    used = dict.fromkeys(key for keys in (shared, *own[::-1]) for key in keys[::-1] if key in joint)
    return dict.fromkeys([*used][::-1])


def _keys(ordering: gtsam.Ordering) -> list[int]:
    return [ordering.at(i) for i in range(ordering.size())]


def _vectorized(factors: Sequence[Factor]) -> list[VectorizedFactor]:
    return [v for f in factors if (v := f.vectorized) is not None]


def _others(factors: Sequence[Factor]) -> gtsam.NonlinearFactorGraph:
    return graph_of([f for f in factors if f.vectorized is None])


def without_rejected(factor: Factor, like: Factor, values: gtsam.Values) -> Factor:
    """A factor with no weight on the measurements that another one, of the same, rejects at the values."""
    if factor.measurement is None or like.measurement is None or (used := like.measurement.used(values)).all():
        return factor
    weights = np.ones(1) if factor.measurement.weights is None else factor.measurement.weights
    return Factor.of(factor.family, factor.measurement.weighed(weights * used[:, None]))


def graph_of(factors: Sequence[Factor]) -> gtsam.NonlinearFactorGraph:
    """The gtsam graph of the factors, in their order."""
    graph = gtsam.NonlinearFactorGraph()
    for f in factors:
        graph.add(f.factor)
    return graph


def linear_graph_of(factors: Sequence[Factor], values: gtsam.Values) -> gtsam.GaussianFactorGraph:
    """The linear system of the factors about the values, in their order."""
    graph = gtsam.GaussianFactorGraph()
    for f in factors:
        graph.push_back(f.linearized(values))
    return graph


def elimination_ordering(graph: gtsam.NonlinearFactorGraph, shared: Sequence[int]) -> gtsam.Ordering:
    """Nested dissection of the chain with the shared variables last, which suits chains with a few common variables."""
    # METIS wants variables that share a factor with another, or it brings the process down.
    joined = gtsam.NonlinearFactorGraph()
    alone = dict.fromkeys(shared)
    for i in range(graph.size()):
        keys = graph.at(i).keys()
        if len(keys) > 1:
            joined.push_back(graph.at(i))
        else:
            alone.update(dict.fromkeys(keys))
    last = set(shared)
    metis = gtsam.Ordering.MetisNonlinearFactorGraph(joined) if joined.size() else gtsam.Ordering()
    chain = [metis.at(i) for i in range(metis.size()) if metis.at(i) not in last]
    return ordering_of([*(alone.keys() - last - set(chain)), *chain, *shared])


def damped(
    linear: gtsam.GaussianFactorGraph, weight: float, keys: Collection[int] | None = None
) -> gtsam.GaussianFactorGraph:
    """The system with each unknown, or some, held where it is by `weight` times its own information."""
    gradient = linear.gradientAtZero()
    diagonal = {key: np.zeros(len(gradient.at(key))) for key in linear.keyVector()}
    for i in range(linear.size()):
        factor = linear.at(i)
        squares = (factor.jacobian()[0] ** 2).sum(axis=0)
        for key in factor.keys():
            size = len(diagonal[key])
            diagonal[key] += squares[:size]
            squares = squares[size:]
    out = gtsam.GaussianFactorGraph()
    out.push_back(linear)
    for key in diagonal if keys is None else keys:
        scale = np.sqrt(weight * np.maximum(diagonal[key], 1e-6))
        noise = gtsam.noiseModel.Unit.Create(len(scale))
        out.add(gtsam.JacobianFactor(key, np.diag(scale), np.zeros(len(scale)), noise))
    return out


def residuals_of(factors: Sequence[Factor], values: gtsam.Values) -> dict[str, Residuals]:
    """Residuals of all measurements, by family, in time order of the steps."""
    gathered: dict[str, list[Residuals]] = {}
    for f in factors:
        if f.measurement is not None:
            whitened = f.measurement.residuals(values)
            used = f.measurement.used(values)
            gathered.setdefault(f.family, []).append(Residuals(f.measurement.model.time, whitened, used))
    return {
        family: Residuals(
            np.concatenate([p.time for p in parts]),
            np.concatenate([p.whitened for p in parts]),
            np.concatenate([p.used for p in parts]),
        )
        for family, parts in gathered.items()
    }
