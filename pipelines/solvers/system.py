"""A graph as the batch solver has it: factors to be evaluated and linearised, whole or stretch by stretch.

A long recording is divided into stretches of time. The variables that only one of them holds are eliminated there,
which leaves, as square root of information, what the stretch says of the others; these rows of all stretches are the
system that is solved. Where the others are known, a stretch's own variables follow by back substitution. That is the
whole system's elimination in another order, hence exact. Stretches are looked at in several processes, where there may
be more than one (`alidade.pipelines.parallel`); what these find is the same to the last digit.

Of a recording of many hours memory does not hold all that is made of its stretches: what of them is not kept, see Keep,
is made anew whenever it is needed, one stretch at a time, and what is held of a state is its value and residuals. A
short recording is one stretch of which nothing is eliminated in advance.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise, product
from typing import Any, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.factors.loss import TruncatedLoss
from alidade.factors.vectorized import jacobian_factor, residuals_at
from alidade.pipelines.estimation.problem import Array, Factor, Residuals
from alidade.pipelines.parallel import Crew, room
from alidade.pipelines.solvers.assembly import StepBoundary
from alidade.pipelines.solvers.history import moments_of
from alidade.pipelines.solvers.linear_system import damped, elimination_ordering, graph_of
from alidade.pipelines.solvers.marginals import IndeterminateError, joint_information, marginal, ordering_of
from alidade.pipelines.solvers.stretch import Excess, Keep, Part, Stretch, StretchAt, vectorized
from alidade.pipelines.solvers.triangular import Triangular, rows_of

Answer = TypeVar("Answer")
Elimination = Callable[
    [gtsam.GaussianFactorGraph, gtsam.Ordering], tuple[gtsam.GaussianConditional, gtsam.GaussianFactor]
]

# What is held is held this tightly, in the units of each variable.
_HELD = 1e-12
# A graph of more variables is divided, and into stretches of so many at most.
_UNDIVIDED, _STRETCH = 15_000, 3_000
# Up to so many variables all of the stretches is kept, 20 kB each, then what back substitution needs of them, 6 kB
# each; of more it is found anew.
_KEPT, _KEPT_TREES = 150_000, 400_000
# A process is worth while for so many variables. It copies the memory of what it looks at, so many bytes of each
# (ten hours of los): where nothing is kept for want of memory, there has to be room for that.
_WORTH_WHILE, _COPIED = 5_000, 2_000
# Of the information that a system with mixed second derivatives has about a number no more than this share is too much.
_EXCESS = 0.98
_WHAT = "stretch by stretch"


@dataclass(frozen=True, eq=False)
class Linear:
    """A graph about some values, linearised.

    Attributes:
        system: the graph.
        values: about which.
        graph: what the stretches say of the variables that they share, all of it for a graph in one piece.
        families: of its factors, empty for those left of an elimination.
        boundaries: ends of stretches, counted in its factors; of a graph in one piece the ends of the steps.
        crew: who has the stretches; None for a graph in one piece.
        excess: of a system with mixed second derivatives, see Ensemble.at; a step goes without it. None: it has none.
    """

    system: System
    values: gtsam.Values
    graph: gtsam.GaussianFactorGraph
    families: Sequence[str]
    boundaries: Sequence[StepBoundary]
    crew: Crew[StretchAt] | None = None
    excess: Excess | None = None

    @cached_property
    def triangular(self) -> Triangular:
        """The triangular factor of `graph`. Raises IndeterminateError, naming a variable that is not determined."""
        return Triangular.of(self.graph, self.system.ordering)

    @cached_property
    def _alone(self) -> Part:
        (stretch,) = self.system.stretches
        return Part(stretch, self.graph)

    @cached_property
    def _dims(self) -> dict[int, int]:
        """Of all variables."""
        dims: dict[int, int] = self.values.dims()
        return dims

    def ask(self, question: Callable[..., Answer], given: Sequence[tuple[Any, ...]] = ()) -> list[Answer]:
        """What a question gives of every part, in time order.

        Args:
            question: a function at the top of a module, since it may be asked in another process; takes a part.
            given: for each part what it takes besides.
        """
        given = given or [()] * len(self.system.stretches)
        if self.crew is None:
            return [question(self._alone, *args) for args in given]
        return self.crew.ask(_asked, [(question, *args) for args in given], _WHAT)

    def handed(self, joint: Array) -> list[Array]:
        """Of (D, k) of the variables of `graph` what each part holds (d, k), see Part.held."""
        return [joint[rows] for rows in self._rows_held]

    def gathered(self, parts: Sequence[Array]) -> Array:
        """(D, k) of the variables of `graph`, the sum of what the parts have for what they hold (d, k)."""
        joint = np.zeros((self.triangular.size, parts[0].shape[1]))
        for rows, part in zip(self._rows_held, parts, strict=True):
            joint[rows] += part
        return joint

    @cached_property
    def _rows_held(self) -> list[NDArray[np.intp]]:
        """The rows that the variables of `graph` which each part holds have in a vector."""
        return [rows_of(self.triangular.places, stretch.held) for stretch in self.system.stretches]

    def drawn(self, keys: Collection[int], count: int, generator: np.random.Generator) -> list[gtsam.Values]:
        """Values drawn from their covariance about these, by what some variables add to it.

        Raises:
            IndeterminateError: a variable is not determined.
        """
        units = {key: np.zeros((self._dims[key], count)) for key in self.values.keys()}
        for k, (key, unit) in product(range(count), units.items()):
            if key in keys:
                unit[:, k] = generator.standard_normal(len(unit))
        own = [np.concatenate([units[key] for key in stretch.keys]) for stretch in self.system.stretches]
        return self._moved(np.concatenate([units[key] for key in self.triangular.places]), own)

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

    def _moved(self, right: Array, own: Sequence[Array] | None = None) -> list[gtsam.Values]:
        """Values (k,) moved by R^-1 times (D, k) of the variables of `graph`, and of each part's own, or zero."""
        joint = self.triangular.back(right)
        moves = self._vectors(self.triangular.places, joint)
        rights: Sequence[Array | None] = own or [None] * len(self.system.stretches)
        found = self.ask(_solved, list(zip(self.handed(joint), rights, strict=True)))
        for stretch, x in zip(self.system.stretches, found, strict=True):
            for move, more in zip(moves, self._vectors(stretch.inner, x), strict=True):
                move.insert(more)
        return [self.values.retract(move) for move in moves]

    def _vectors(self, keys: Iterable[int], columns: Array) -> list[gtsam.VectorValues]:
        """Vectors (d, k) of some variables, one after the other, as gtsam has them."""
        found = [gtsam.VectorValues() for _ in range(columns.shape[1])]
        end = 0
        for key in keys:
            start, end = end, end + self._dims[key]
            for vector, column in zip(found, columns.T, strict=True):
                vector.insert(key, column[start:end])
        return found

    def damped(self, damping: float) -> Linear:
        """With each unknown held where it is by so many times its own information."""
        if len(self.system.stretches) > 1:
            return self.system.linearized(self.values, damping, self.excess is not None)
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
        (delta,) = self._vectors(shared, move[:, None])
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
        (delta,) = self._vectors(self.triangular.places, self.triangular.back(self.triangular.right))
        self._follow(delta)
        return delta

    def states_alone(self) -> gtsam.VectorValues:
        """The same with the variables that all measurements share held; raises RuntimeError if that is singular."""
        still = gtsam.VectorValues()
        for key in self.system.shared:
            still.insert(key, np.zeros(self._dims[key]))
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
            function = without_excess(too_much, self._dims)
        delta = self.graph.optimize(self.system.ordering, function)
        gradient, keys = self.graph.gradientAtZero(), list(self.graph.keyVector())
        return delta, self._follow(delta) - 0.5 * float(gradient.vector(keys) @ delta.vector(keys))

    def _follow(self, delta: gtsam.VectorValues) -> float:
        """Add stretches' own variables to a solution that has all others; by how much they alone lower the error."""
        if self.crew is None:
            return 0.0
        stretches = self.system.stretches
        found = self.crew.ask(StretchAt.follow, [([delta.at(key) for key in each.held],) for each in stretches], _WHAT)
        for moves, _ in found:
            delta.insert(moves)
        return sum(lowers for _, lowers in found)


@dataclass(eq=False)
class System:
    """A graph, its stretches, and the order in which variables are eliminated.

    Attributes:
        stretches: its factors, in time order.
        boundaries: ends of all steps, where they are known.
        ordering: of the elimination of the variables that stretches share, those of all of them last.
        shared: the variables that all measurements share.
        loss: how those that may be outliers are weighed; None counts all in full.
        ends: of several stretches.
        keep: how much is kept of several stretches.
    """

    stretches: Sequence[Stretch]
    boundaries: Sequence[StepBoundary]
    ordering: gtsam.Ordering
    shared: Sequence[int]
    loss: TruncatedLoss | None
    ends: Sequence[StepBoundary] = ()
    keep: Keep = Keep.ALL
    # Who evaluated several stretches last, and has not linearised them; let go of with what comes after this system.
    _evaluated: tuple[gtsam.Values, Crew[StretchAt]] | None = field(default=None, init=False, repr=False)

    @classmethod
    def of(
        cls,
        factors: Sequence[Factor],
        shared: Sequence[int],
        loss: TruncatedLoss | None,
        boundaries: Sequence[StepBoundary] = (),
    ) -> System:
        """The system of some factors, divided at some of the boundaries if it is long."""
        ends, size = _divided(factors, boundaries)
        if len(ends) < 2:
            graph = graph_of(factors)
            alone = Stretch.alone(factors, graph)
            return cls([alone], boundaries, elimination_ordering(graph, shared), shared, loss)
        keep = Keep.ALL if size <= _KEPT else Keep.TREES if size <= _KEPT_TREES else Keep.NOTHING
        pieces = _pieces(factors, ends)
        joint = _joint(pieces, boundaries, shared)
        stretches = [Stretch.of(piece, set(joint), keep) for piece in pieces]
        return cls(stretches, boundaries, ordering_of(joint), shared, loss, ends, keep)

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
        self._evaluated = None
        begin, made = 0, []
        for stretch in self.stretches:
            made.append(stretch.made_of(factors[begin : begin + len(stretch.factors)]))
            begin += len(stretch.factors)
        return replace(self, stretches=made)

    def under(self, loss: TruncatedLoss | None) -> System:
        """The same system with another loss."""
        self._evaluated = None
        return replace(self, loss=loss)

    @contextmanager
    def at(self, values: gtsam.Values) -> Iterator[None]:
        """Within the block the factors answer for these values, under the system's loss; of a long graph residuals."""
        if self.keep is Keep.ALL:
            with ExitStack() as stretches:
                for stretch in self.stretches:
                    stretches.enter_context(stretch.at(values, self.loss))
                yield
        else:
            with residuals_at([vectorized(stretch.factors) for stretch in self.stretches], values, self.loss):
                yield

    def _about(self, values: gtsam.Values) -> Crew[StretchAt]:
        """Several stretches about the values."""
        self._evaluated = None
        there = [StretchAt(stretch, values, self.loss, self.keep) for stretch in self.stretches]
        return Crew(there, self._processes())

    def _processes(self) -> int:
        """How many may share the stretches."""
        own = sum(len(stretch.inner) for stretch in self.stretches)
        if self.keep is Keep.NOTHING and room() < _COPIED * own:
            return 1
        return own // _WORTH_WHILE

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squares."""
        if len(self.stretches) == 1:
            return self.stretches[0].error(values, self.loss)
        crew = self._about(values)
        self._evaluated = values, crew
        return sum(crew.ask(StretchAt.error, [()] * len(self.stretches), _WHAT))

    def linearized(self, values: gtsam.Values, damping: float = 0.0, mixed: bool = False) -> Linear:
        """About the values, each unknown held there by so many times its information; `mixed` as Ensemble.at has it.

        Raises:
            IndeterminateError: one of several stretches does not determine a variable of its own; names it.
        """
        if len(self.stretches) > 1:
            return self._reduced(values, damping, mixed)
        (alone,) = self.stretches
        excess: Excess | None = {} if mixed else None
        graph, families = alone.linearize(values, self.loss, excess), [f.family for f in alone.factors]
        if damping > 0.0:
            graph = damped(graph, damping)
        return Linear(self, values, graph, families, self.boundaries, excess=excess)

    def _reduced(self, values: gtsam.Values, damping: float, mixed: bool) -> Linear:
        """What several stretches say of what they share."""
        where, known = self._evaluated or (None, None)
        crew = known if known is not None and where is values else self._about(values)
        self._evaluated = None
        graph, families, boundaries = gtsam.GaussianFactorGraph(), [], []
        excess: Excess = {}
        told = crew.ask(StretchAt.reduced, [(damping, mixed)] * len(self.stretches), _WHAT)
        for stretch, reduced, end in zip(self.stretches, told, self.ends, strict=True):
            for rows in (*reduced.outer, *reduced.left):
                graph.push_back(jacobian_factor(*rows))
            families += [*(stretch.factors[i].family for i in stretch.outer), *[""] * len(reduced.left)]
            boundaries.append(end._replace(factors=graph.size()))
            for place, information in reduced.excess.items():
                excess[place] = excess.get(place, np.zeros(2)) + information
        if damping > 0.0:
            graph = damped(graph, damping)
        return Linear(self, values, graph, families, boundaries, crew, excess if mixed else None)

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


def _divided(factors: Sequence[Factor], boundaries: Sequence[StepBoundary]) -> tuple[list[StepBoundary], int]:
    """Ends of stretches, none for a short graph, and how many variables there are.

    They end at the moments of the history and, where there are many variables between two, in between.
    """
    seen: set[int] = set()
    count, begin = [], 0
    for boundary in boundaries:
        for f in factors[begin : boundary.factors]:
            seen.update(f.factor.keys())
        begin = boundary.factors
        count.append(len(seen))
    if not count or len(seen) <= _UNDIVIDED:
        return [], len(seen)
    ends: set[int] = set()
    before = 0
    for moment in moments_of(boundaries, boundaries[0].time):
        pieces = -(-(count[moment] - before) // _STRETCH)
        wanted = np.linspace(before, count[moment], pieces + 1)[1:-1]
        ends.update(np.searchsorted(count, wanted).tolist(), [moment])
        before = count[moment]
    return [boundaries[i] for i in sorted(ends)], len(seen)


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


def _asked(stretch: StretchAt, question: Callable[..., Answer], *args: Any) -> Answer:
    """Asks a stretch as it was linearised."""
    return question(stretch.part(), *args)


def _solved(part: Part, held: Array, right: Array | None) -> Array:
    """(d, k) of a part's own variables, one after the other, see Part.solved."""
    x = part.solved(held, right)
    return x[rows_of(part.triangular.places, part.stretch.inner)]


def without_rejected(factor: Factor, like: Factor, values: gtsam.Values) -> Factor:
    """A factor with no weight on the measurements that another one, of the same, rejects at the values."""
    if factor.measurement is None or like.measurement is None or (used := like.measurement.used(values)).all():
        return factor
    weights = np.ones(1) if factor.measurement.weights is None else factor.measurement.weights
    return Factor.of(factor.family, factor.measurement.weighed(weights * used[:, None]))


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
