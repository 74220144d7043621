"""A problem's measurements evaluated as arrays: values in, the chain's whitened rows out, gtsam not involved.

    linearization = Linearization.of(factors, layout)       # models of one kind stacked: `groups`
    system, cost = linearization.at(values)                 # its linear system under the loss and weights in force
    cost = linearization.cost(values)                       # without Jacobians
    linearization.under(loss)                               # another loss (None: every measurement in full)
    rows, cost = group.rows(values, width)                  # (n, m, width) of one kind, on the columns of its target

An evaluation is one call a kind. Rows are written under the robust loss and the noise weights:

    residuals r (n, m), Jacobian J;  w = weights, v = sqrt(loss weight of |w r|^2)  ->  rows [v w J | -v w r]

so that half the negative gradient of the cost, the sum of twice the losses, is A'b. Rows about nodes of a walking bias
alone hold no column of b_0, which cancels in them.

Limits: all rows of a keyframe stand below one another, padded to the most that any keyframe has. A native gtsam factor
is linearised one at a time, by gtsam; one with a robust or constrained noise model is refused.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.factors.bridge import BoundModel
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import TOGETHER, Block, Model, Residuals, dimension, select_rows, stack_models, stacking_key
from alidade.pipelines.estimation.problem import Factor
from alidade.pipelines.solvers.chain import PART_STATES, Chain, ChainSystem, Index
from alidade.pipelines.solvers.gtsam_engine import GtsamSystem
from alidade.pipelines.solvers.layout import Layout, NotAChainError, Tangent, Values, insert_value

if TYPE_CHECKING:
    import gtsam

# Rows of a chain of at most so many bytes are kept; those of a longer one are made anew, part by part, wherever asked.
KEPT_BYTES = 1 << 28
# Families whose residuals have no information about measurement noise.
NOT_MEASURED = ("prior", "definition")
# The shared variables of a row about nodes alone cancel to this share of its largest coefficient.
CANCELLED = 1e-9


@dataclass(frozen=True, eq=False)
class NativeModel(Model):
    """Measurement model of one native gtsam factor, which gtsam linearises.

    Attributes:
        factor: of which `blocks` are the variables.
        time: (1,) s.
        rows, blocks: as every model has.
    """

    factor: gtsam.NonlinearFactor
    time: Array
    rows: int
    blocks: tuple[Block, ...]

    def __call__(self, *blocks: Array) -> Residuals:
        """Whitened residuals (1, m) and their Jacobians, (1, m, d) each."""
        import gtsam

        values = gtsam.Values()
        for key, block, value in zip(self.factor.keys(), self.blocks, blocks, strict=True):
            insert_value(values, key, block, value[0])
        linear: Any = self.factor.linearize(values)
        A, b = linear.jacobian()
        ends = np.cumsum([dimension(block) for block in self.blocks])[:-1]
        return -b[None], lambda: tuple(each[None] for each in np.split(A, ends, axis=1))


@dataclass(frozen=True, eq=False)
class Group:
    """Measurements of one kind, evaluated together, with their positions in a linear system.

    Attributes:
        family: of them all.
        model: of n measurements of m rows.
        loss: None: every measurement counts in full.
        weights: (n, m) by which whitened residuals are multiplied beside the loss; None: 1.
        factors: (n,) position of the factor of each in the problem's factors.
        is_measurement: whether they may be outliers, and not processes or priors.
        beside: (n,) what a unit of the noise beside their own adds to whitened residuals, or None.
        fixed: (n,) part of the variance by which they are whitened that no level scales, or None.
        gather: for each block its kind and the rows (n or 1,) of its variables in that kind's array.
        at: for each block the positions (n or 1,) of its variables in the layout.
        target: "state": rows about one keyframe; "pair": rows that join it to the one before; "walk": rows about nodes
            alone; "shared": rows about shared unknowns; "": there is no chain.
        place: (n,) keyframe, of "walk" the node.
        row: (n,) first row of each among those of its place.
        columns: for each block those (n or 1, dim) that its Jacobian is added to: of a bias node the shared ones of the
            first node and those of its deviation from that.
        deviates: for each block (n or 1,) whether it is a later node than the first.
        excluded: (n,) measurements that do not count whatever their residuals; None: none.
    """

    family: str
    model: Model
    loss: TruncatedLoss | None
    weights: Array | None
    factors: Index
    is_measurement: bool
    beside: Array | None
    fixed: Array | None
    gather: list[tuple[Block, Index]]
    at: list[Index]
    target: str
    place: Index
    row: Index
    columns: list[list[Index]]
    deviates: list[Mask]
    excluded: Mask | None = None

    def evaluate(self, values: Values) -> Residuals:
        """Whitened residuals (n, m), unweighted, and their Jacobians on demand."""
        return self.model(*self.gathered(values))

    def residuals(self, values: Values) -> Array:
        """Whitened residuals (n, m), unweighted, evaluated part by part."""
        each = [part.evaluate(values)[0] for part in self.divided()]
        return each[0] if len(each) == 1 else np.concatenate(each)

    def without_noise(self, values: Values) -> Group:
        """Return the group at measurements whose residuals are zero, where its Jacobians have noise of these."""
        return replace(self, model=self.model.without_noise(*self.gathered(values)))

    def gathered(self, values: Values) -> list[Array]:
        """Values of the variables that the group's model is evaluated at, (n, width) for each block."""
        arrays = [values.arrays[block][rows] for block, rows in self.gather]
        return [np.broadcast_to(each, (len(self.model.time), each.shape[1])) for each in arrays]

    @property
    def all_weights(self) -> Array:
        """Noise weights (n, m) of the rows, without the loss, as a copy."""
        shape = len(self.model.time), self.model.rows
        return np.ones(shape) if self.weights is None else self.weights.copy()

    def counting(self, used: Mask) -> Group:
        """Return the group with given inliers at full weight, the rest excluded, and no robust loss."""
        return replace(self, loss=None, excluded=None if used.all() else ~used)

    def weighted(self, residuals: Array) -> Array:
        """Multiply residuals by the noise weights."""
        return residuals if self.weights is None else self.weights * residuals

    def cost(self, residuals: Array) -> float:
        """Twice the sum of the robust losses of unweighted whitened residuals."""
        squares = np.einsum("nm,nm->n", *(2 * [self.weighted(residuals)]))
        return float(self._included(squares if self.loss is None else self.loss.cost(squares)).sum())

    def used(self, residuals: Array) -> Array:
        """Robust weights (n,) of the measurements, from their unweighted whitened residuals (n, m)."""
        if self.loss is None:
            return self._included(np.ones(len(residuals)))
        return self._included(self.loss.weight(np.einsum("nm,nm->n", *(2 * [self.weighted(residuals)]))))

    def inliers(self, values: Values) -> Mask:
        """Mask (n,) of the measurements that the loss does not reject at some values and that are not excluded."""
        if self.loss is None:
            return np.ones(len(self.model.time), dtype=bool) if self.excluded is None else ~self.excluded
        return np.asarray(self.used(self.residuals(values)) > 0.5)

    def _included(self, each: Array) -> Array:
        """Set numbers (n,) of excluded measurements to zero."""
        return each if self.excluded is None else np.where(self.excluded, 0.0, each)

    def whitened(self, values: Values) -> tuple[Array, tuple[Array, ...], float]:
        """Right side (n, m), Jacobian (n, m, dim) by each block, under loss and noise weights; and the cost."""
        residuals, linearize = self.evaluate(values)
        factor = np.broadcast_to(np.sqrt(self.used(residuals))[:, None], residuals.shape)
        if self.weights is not None:
            factor = factor * self.weights
        plain = self.weights is None and self.loss is None and self.excluded is None
        jacobians = tuple(J if plain else factor[..., None] * J for J in linearize())
        return -factor * residuals, jacobians, self.cost(residuals)

    @property
    def is_divisible(self) -> bool:
        """Whether the model can evaluate some of the group's measurements without the others."""
        return len(self.place) == 1 or hasattr(self.model, "stacked")

    def within(self, begin: int, end: int) -> Group | None:
        """Select the measurements whose place is in `begin` ... `end` - 1; None if there is none."""
        some = np.flatnonzero((self.place >= begin) & (self.place < end))
        return None if not len(some) else self if len(some) == len(self.place) else self.of(some)

    def divided(self) -> Iterator[Group]:
        """Yield the group in parts whose rows fit a processor's cache."""
        n = len(self.place)
        if n <= TOGETHER or not self.is_divisible:
            yield self
            return
        for number, part in enumerate(self.model.in_parts):
            yield self.of(slice(number * TOGETHER, (number + 1) * TOGETHER), part)

    def of(self, some: Index | slice, model: Model | None = None) -> Group:
        """Select some of the group's measurements, whose model may be known."""

        def own(each: Any) -> Any:
            return each if each is None or len(each) == 1 else each[some]

        return replace(
            self,
            model=model or select_rows(self.model, some),
            weights=None if self.weights is None else self.weights[some],
            factors=self.factors[some],
            beside=None if self.beside is None else self.beside[some],
            fixed=None if self.fixed is None else self.fixed[some],
            gather=[(block, own(rows)) for block, rows in self.gather],
            at=[own(each) for each in self.at],
            place=self.place[some],
            row=self.row[some],
            columns=[[own(each) for each in columns] for columns in self.columns],
            deviates=[own(each) for each in self.deviates],
            excluded=None if self.excluded is None else self.excluded[some],
        )

    def rows(self, values: Values, width: int) -> tuple[Array, float]:
        """Whitened rows [Jacobian | right side] (n, m, width), and the group's cost."""
        right, jacobians, cost = self.whitened(values)
        out = np.zeros((*right.shape, width))
        out[..., -1] = right
        for places, jacobian, deviates in zip(self.columns, jacobians, self.deviates, strict=True):
            _add(out, places[0], jacobian)
            for columns in places[1:]:
                _add(out, columns, jacobian if deviates.all() else deviates[:, None, None] * jacobian)
        return out, cost


def _add(out: Array, columns: Index, jacobian: Array) -> None:
    """Add Jacobians (n, m, d) to columns (n or 1, d) of rows (n, m, width)."""
    if len(columns) == 1:
        begin = int(columns[0, 0])
        out[..., begin : begin + columns.shape[1]] += jacobian
        return
    out[np.arange(len(out))[:, None, None], np.arange(out.shape[1])[:, None], columns[:, None]] += jacobian


@dataclass(frozen=True, eq=False)
class Linearization:
    """Compiled factors of a problem, which evaluates and linearises them together.

    Attributes:
        layout: of its variables.
        groups: of its factors.
        piece: (N,) node in force from the keyframe before to each and at it.
        sizes: rows m of a keyframe and b between two.
        is_chain: whether its linear systems are a chain; else gtsam eliminates them.
    """

    layout: Layout
    groups: Sequence[Group]
    piece: Index
    sizes: tuple[int, int]
    is_chain: bool = True

    @classmethod
    def of(cls, factors: Sequence[Factor], layout: Layout, chain: bool = True) -> Linearization:
        """Compile factors. Raises NotAChainError if they do not fit the chain; `chain=False` accepts any graph."""
        kinds: dict[Hashable, list[tuple[int, Factor, BoundModel]]] = {}
        for i, factor in enumerate(factors):
            v = factor.bound or _native(factor, layout)
            key = stacking_key(v.model), layout.roles(v.columns), factor.family, factor.measurement is None
            kinds.setdefault((*key, v.loss is None, factor.beside is None, factor.fixed is None), []).append(
                (i, factor, v)
            )
        drafts = [_Draft.of(kind, layout, chain) for kind in kinds.values()]
        piece = _pieces(drafts, layout) if chain else np.zeros(layout.sizes[0], dtype=np.intp)
        used = np.zeros((2, layout.sizes[0]), dtype=np.intp)
        # What joins keyframes first: rows about single ones may stand where there is no such row.
        groups = [draft.placed(layout, piece, used, chain) for draft in sorted(drafts, key=lambda d: d.count.max() < 2)]
        absent = int((~layout.kept[0]).sum(axis=1).max(initial=0))
        return cls(layout, groups, piece, (int(used[0].max()) + absent, int(used[1].max())), chain)

    def at(self, values: Values) -> tuple[System, float]:
        """Linearise about the values; return the system and the cost, twice the sum of the losses."""
        if self.is_chain:
            return self._chain_at(values)
        each = [(group.at, *group.whitened(values)) for group in self.groups]
        return GtsamSystem.of(self.layout, (rows[:3] for rows in each)), sum(rows[3] for rows in each)

    def _chain_at(self, values: Values) -> tuple[ChainSystem | LinearizedChain, float]:
        (N, d, J, c, s), (m, b) = self.layout.sizes, self.sizes
        shared, cost, squares = [np.zeros((0, s + 1))], 0.0, 0.0
        walk: list[list[Array]] = [[] for _ in range(J)]
        for group in self.groups:
            if group.target in ("state", "pair"):
                continue
            rows, square = group.rows(values, {"walk": 2 * c + s + 1, "shared": s + 1}[group.target])
            cost, squares = cost + square, squares + float(np.square(rows[..., -1]).sum())
            if group.target == "shared":
                shared.append(rows.reshape(-1, s + 1))
                continue
            _require_cancelled(rows, c, group.family)
            for node, each in zip(group.place.tolist(), np.delete(rows, np.s_[2 * c : -1], axis=2), strict=True):
                walk[node].append(each)
        piece, about = (self.piece, self._walk(walk)) if c else (None, None)
        chain = LinearizedChain(self, values, d, np.concatenate(shared), piece, about, squares)
        keeps = 8 * N * (m * (d + c + s + 1) + b * (2 * d + c + s + 1)) <= KEPT_BYTES
        if keeps or not all(group.is_divisible for group in self.groups):
            system, more = chain.rows(0, N)
            return system, cost + more
        for begin in range(0, N, PART_STATES):
            for part in self.within(begin, begin + PART_STATES):
                residuals = part.residuals(values)
                cost += part.cost(residuals)
                squares += float(part.used(residuals) @ np.square(part.weighted(residuals)).sum(axis=1))
        return replace(chain, squares=squares), cost

    def within(self, begin: int, end: int) -> Iterator[Group]:
        """Yield the measurements at keyframes `begin` ... `end` - 1 by group."""
        for group in self.groups:
            if group.target in ("state", "pair") and (part := group.within(begin, end)) is not None:
                yield part

    def divided(self) -> Iterator[Group]:
        """Yield all groups in parts whose rows fit a processor's cache."""
        for group in self.groups:
            yield from group.divided()

    def cost(self, values: Values) -> float:
        """Twice the sum of the robust losses at some values."""
        return self.cost_of(self.unweighted(values))

    def cost_of(self, unweighted: Sequence[Array]) -> float:
        """Twice the sum of the robust losses, from the unweighted whitened residuals (n, m) of each group."""
        return sum(group.cost(own) for group, own in zip(self.groups, unweighted, strict=True))

    def unweighted(self, values: Values) -> list[Array]:
        """Whitened residuals (n, m) of each group, outliers included, without noise and robust weights."""
        return [group.residuals(values) for group in self.groups]

    def residuals(self, values: Values) -> list[Array]:
        """Weighted whitened residuals (n, m) of each group, outliers included."""
        return [group.weighted(own) for group, own in zip(self.groups, self.unweighted(values), strict=True)]

    @property
    def measured(self) -> dict[str, list[Group]]:
        """Groups of measurements of each family."""
        found: dict[str, list[Group]] = {}
        for group in self.groups:
            if group.is_measurement:
                found.setdefault(group.family, []).append(group)
        return found

    def with_groups(self, groups: Sequence[Group]) -> Linearization:
        """Replace the groups by others at the same variables."""
        return replace(self, groups=groups)

    def inliers(self, values: Values) -> list[Mask]:
        """Mask (n,) of each group's measurements that count at some values."""
        return [group.inliers(values) for group in self.groups]

    def counting(self, used: Sequence[Mask]) -> Linearization:
        """Give the measurements of the masks (n,) full weight and exclude all others, without robust losses."""
        return self.with_groups([group.counting(own) for group, own in zip(self.groups, used, strict=True)])

    def products(self, group: Group, values: Values, step: Tangent) -> tuple[Array, Array]:
        """Products (n, m, k) of a group of factors' whitened Jacobians with k tangents, and their right side (n, m)."""
        right, jacobians, _ = group.whitened(values)
        out = np.zeros((*right.shape, step.shared.shape[1]))
        for at, J in zip(group.at, jacobians, strict=True):
            out += J @ self.layout.moves(at, step)
        return out, right

    @property
    def time(self) -> Array:
        """Times of the keyframes (N,), s: of the factor from the previous keyframe, or of the last measurement."""
        out = np.full(self.layout.sizes[0], -np.inf)
        for target in ("state", "pair", ""):
            known = np.full(len(out), -np.inf)
            for group in self.groups:
                if group.target == target and group.family not in NOT_MEASURED and (group.place >= 0).all():
                    np.maximum.at(known, group.place, group.model.time)
            out = np.where(known > -np.inf, known, out)
        known = out[out > -np.inf]
        return np.maximum.accumulate(np.where(out > -np.inf, out, known[0] if len(known) else 0.0))

    def under(self, loss: TruncatedLoss | None) -> Linearization:
        """Replace the robust loss of all groups that have one."""
        return replace(self, groups=[g if g.loss is None else replace(g, loss=loss) for g in self.groups])

    def _walk(self, rows: list[list[Array]]) -> Array:
        """Stack rows (J, w, 2 c + 1) about nodes, with unit rows for entries without a variable."""
        c, absent = self.layout.sizes[3], ~self.layout.kept[1]
        units = [np.eye(2 * c + 1)[np.flatnonzero(each)] for each in absent]
        whole = [np.concatenate([unit, *each]) for unit, each in zip(units, rows, strict=True)]
        out = np.zeros((len(whole), max(map(len, whole)), 2 * c + 1))
        for each, own in zip(out, whole, strict=True):
            each[: len(own)] = own
        return out


@dataclass(frozen=True, eq=False)
class LinearizedChain(Chain):
    """A chain linearised part by part on demand, for problems whose rows exceed the memory.

    Attributes:
        linearization, values: of the factors, and about which.
        squares: sum of squares of the right side.
    """

    linearization: Linearization
    values: Values
    d: int
    shared: Array
    piece: Index | None
    walk: Array | None
    squares: float

    def __len__(self) -> int:
        return self.linearization.layout.sizes[0]

    def part(self, begin: int, end: int) -> ChainSystem:
        """Linearise the rows about keyframes `begin` ... `end` - 1."""
        return self.rows(begin, end)[0]

    def rows(self, begin: int, end: int) -> tuple[ChainSystem, float]:
        """Linearise the rows about some keyframes; return them and twice the sum of the losses."""
        n, d, w, (m, b), cost = end - begin, self.d, self.border, self.linearization.sizes, 0.0
        measured, between = np.zeros((n, m, d + w)), np.zeros((n, b, 2 * d + w))
        for group in self.linearization.within(begin, end):
            out = measured if group.target == "state" else between
            for some in group.divided():
                rows, square = some.rows(self.values, out.shape[2])
                out[(some.place - begin)[:, None], some.row[:, None] + np.arange(rows.shape[1])] = rows
                cost += square
        # Unit rows for the numbers of states that no variable has.
        absent = ~self.linearization.layout.kept[0][begin:end]
        keyframe, number = np.nonzero(absent)
        measured[keyframe, -1 - (np.cumsum(absent, axis=1) - 1)[keyframe, number], number] = 1.0
        piece = None if self.piece is None else self.piece[begin:end]
        return ChainSystem(measured, between, np.zeros((n, 0, w)), self.shared, d, piece, self.walk), cost


# Whitened rows A dx = b about some values, as numpy eliminates them where they are a chain, else gtsam.
System = ChainSystem | LinearizedChain | GtsamSystem


def _require_cancelled(rows: Array, c: int, family: str) -> None:
    """Raise NotAChainError unless rows [z_j | z_j-1 | shared | right side] are about the nodes alone."""
    shared, largest = np.abs(rows[..., 2 * c : -1]).max(initial=0.0), np.abs(rows[..., :-1]).max(initial=0.0)
    if shared > CANCELLED * largest:
        raise NotAChainError(f"{family}: rows join bias nodes and shared variables, and no keyframe")


def _native(factor: Factor, layout: Layout) -> BoundModel:
    """Wrap a native gtsam factor as a model. Raises NotAChainError for a robust or constrained noise model."""
    import gtsam

    native = factor.native
    assert native is not None
    noise = getattr(native, "noiseModel", lambda: None)()
    if isinstance(noise, gtsam.noiseModel.Robust | gtsam.noiseModel.Constrained):
        raise NotAChainError(f"{factor.family}: a native factor with a robust or a constrained noise model")
    keys = list(native.keys())
    blocks = tuple(layout.blocks[i] for i in layout.block[layout.at(keys)].tolist())
    return NativeModel(native, np.zeros(1), native.dim(), blocks).on(*keys)


@dataclass(eq=False)
class _Draft:
    """A group without rows and columns assigned yet.

    Attributes:
        group: without target, rows and columns.
        last, count: (n,) the last keyframe of each measurement, -1: none, and how many it joins, at most two.
        node: (n,) the node that each takes, -1: none; `pair`: whether it joins that to the one before.
        whole: for each block whether it is the first node as the bias as a whole, wherever the measurement is.
    """

    group: Group
    last: Index
    count: Index
    node: Index
    pair: bool
    whole: list[bool]

    @classmethod
    def of(cls, kind: Sequence[tuple[int, Factor, BoundModel]], layout: Layout, chain: bool) -> _Draft:
        _, first, v = kind[0]
        model, lengths = stack_models([each.model for *_, each in kind]), [len(each.model.time) for *_, each in kind]
        n = sum(lengths)
        at = [_positions([each.columns[i] for *_, each in kind], lengths, layout) for i in range(len(v.columns))]
        weights = None
        if any(each.weights is not None for *_, each in kind):
            shapes = [(length, model.rows) for length in lengths]
            known = [np.ones(s) if e.weights is None else e.weights for (*_, e), s in zip(kind, shapes, strict=True)]
            weights = np.concatenate(known)
        frames = [np.broadcast_to(layout.keyframe[each], n) for each in at if (layout.keyframe[each] >= 0).any()]
        # At keyframes the first node, given by one key for all measurements, is the bias as a whole.
        whole = [
            bool(frames) and isinstance(column, int) and bool((layout.node[each] == 0).all())
            for column, each in zip(v.columns, at, strict=True)
        ]
        nodes = [
            np.broadcast_to(layout.node[each], n)
            for each, alone in zip(at, whole, strict=True)
            if not alone and (layout.node[each] >= 0).any()
        ]
        last = np.max(frames, axis=0) if frames else np.full(n, -1)
        span = last - np.min(frames, axis=0) if frames else np.zeros(n, dtype=np.intp)
        node = np.max(nodes, axis=0) if nodes else np.full(n, -1)
        reach = node - np.min(nodes, axis=0) if nodes else np.zeros(n, dtype=np.intp)
        if chain and (span.max(initial=0) > 1 or (frames and np.min(frames) < 0)):
            raise NotAChainError(f"{first.family}: a factor joins keyframes that are not neighbours")
        if chain and reach.max(initial=0) > (0 if frames else 1):
            raise NotAChainError(f"{first.family}: a factor joins bias nodes that are not neighbours")
        group = Group(
            family=first.family,
            model=model,
            loss=v.loss,
            weights=weights,
            factors=np.repeat([i for i, *_ in kind], lengths),
            is_measurement=first.measurement is not None,
            beside=_joined([f.beside for _, f, _ in kind], lengths),
            fixed=_joined([f.fixed for _, f, _ in kind], lengths),
            gather=[(layout.blocks[layout.block[each[0]]], layout.row[each]) for each in at],
            at=at,
            target="",
            place=last,
            row=np.zeros(n, dtype=np.intp),
            columns=[],
            deviates=[layout.node[each] > 0 for each in at],
        )
        return cls(group, last, span + 1, node, bool(reach.any()), whole)

    def placed(self, layout: Layout, piece: Index, used: Index, chain: bool) -> Group:
        """Assign target, rows and columns to the group, its rows below those already placed."""
        c, group, rows = layout.sizes[3], self.group, self.group.model.rows
        n = len(self.last)
        target, place, row = "shared", np.full(n, -1), group.row
        if not chain:
            target, place = "shared" if self.last.max() < 0 and self.node.max() <= 0 else "", self.last
        elif self.last.max(initial=-1) >= 0:
            target, place = ("pair" if (self.count > 1).any() else "state"), self.last
        elif c and self._is_walk(layout):
            target, place = "walk", self.node
        elif c and self.node.max(initial=-1) >= (0 if group.is_measurement else 1):
            if self.pair:
                raise NotAChainError(f"{group.family}: a factor joins two bias nodes and shared variables")
            target, place = "state", np.searchsorted(piece, np.maximum(self.node, 0), side="right") - 1
        if target == "state" and (used[1][place] + rows <= used[1].max()).all() and len(set(place)) == n:
            target = "pair"
        if target in ("state", "pair"):
            row = _below(place, rows, used[int(target == "pair")])
        columns = [self._columns(i, layout, target, piece) for i in range(len(group.at))] if target else []
        return replace(group, target=target, place=place, row=row, columns=columns)

    def _is_walk(self, layout: Layout) -> bool:
        """Whether every measurement involves nodes alone and joins each to the one before."""
        return self.pair and all((layout.node[each] >= 0).all() for each in self.group.at)

    def _columns(self, i: int, layout: Layout, target: str, piece: Index) -> list[Index]:
        """Columns of a block within the rows of its target; see `Group.columns`."""
        d, c = layout.sizes[1], layout.sizes[3]
        at = self.group.at[i]
        span = np.arange(dimension(layout.blocks[layout.block[at[0]]]))
        begin = {"shared": 0, "walk": 2 * c, "state": d + c, "pair": 2 * d + c}[target]
        if layout.keyframe[at[0]] >= 0:
            before = (layout.keyframe[at] < self.last).astype(np.intp)
            return [_single(layout.offset[at] + d * before)[:, None] + span]
        out = [_single(begin + layout.shared[at])[:, None] + span]
        if c and not self.whole[i] and target != "shared" and (layout.node[at] >= 0).any():
            if target == "walk":
                first = layout.part[at] + c * (layout.node[at] < self.node)
            else:
                first = begin - c + layout.part[at]
                if (piece[self.last] != self.node)[self.last >= 0].any():
                    raise NotAChainError(
                        f"{self.group.family}: a factor takes another bias node than its keyframe's others"
                    )
            out.append(_single(first)[:, None] + span)
        return out


def _single(columns: Index) -> Index:
    """Reduce columns to (1, .) where all rows are equal."""
    return columns[:1] if (columns == columns[:1]).all() else columns


def _positions(columns: Sequence[int | list[int]], lengths: Sequence[int], layout: Layout) -> Index:
    """Positions (n or 1,) in the layout of a block's variables."""
    if isinstance(columns[0], int):
        at = layout.at([int(column) for column in columns if isinstance(column, int)])
        return at[:1] if (at == at[0]).all() else np.repeat(at, lengths)
    return _single(layout.at(np.concatenate([np.asarray(column, dtype=np.intp) for column in columns])))


def _joined(parts: Sequence[Array | None], lengths: Sequence[int]) -> Array | None:
    """Concatenate per-measurement numbers (n,) of all factors; None where no factor has any."""
    each = [np.broadcast_to(p, length) for p, length in zip(parts, lengths, strict=True) if p is not None]
    return np.concatenate(each) if each else None


def _below(place: Index, rows: int, used: Index) -> Index:
    """Assign each measurement (n,) its first row at its place; `used` (N,), the rows filled there, grows."""
    order = np.argsort(place, kind="stable")
    begins = np.flatnonzero(np.diff(place[order], prepend=-1))
    counts = np.diff(begins, append=len(order))
    out = np.empty(len(place), dtype=np.intp)
    out[order] = np.arange(len(order)) - np.repeat(begins, counts)
    out = used[place] + rows * out
    used[place[order][begins]] += rows * counts
    return out


def _pieces(drafts: Sequence[_Draft], layout: Layout) -> Index:
    """Index (N,) of the node in force at each keyframe; every node is in force at one at least."""
    N, d, J, c, _ = layout.sizes
    if not c:
        return np.zeros(N, dtype=np.intp)
    if not d:
        return np.arange(N)
    known = np.full(N, -1)
    known[0] = 0
    for draft in drafts:
        some = (draft.last >= 0) & (draft.node >= 0)
        known[draft.last[some]] = draft.node[some]
    out, unknown = known.copy(), np.flatnonzero(known < 0)
    for run in np.split(unknown, np.flatnonzero(np.diff(unknown) > 1) + 1) if len(unknown) else ():
        after = known[run[-1] + 1] if run[-1] + 1 < N else J
        out[run] = np.maximum(out[run[0] - 1], after - len(run) + np.arange(len(run)))
    if (np.diff(out) < 0).any() or (np.diff(out) > 1).any() or out[-1] != J - 1:
        raise NotAChainError("the nodes of a bias that walks do not follow one another over the keyframes")
    return out
