"""Square-root elimination of a chain of small states with shared unknowns, all segments of the chain at once.

The linear system of a calibration is a block-bidiagonal arrowhead: states x_0 ... x_{N-1} (attitudes, d numbers each)
joined to their neighbours, measurements of single states, and s unknowns that every row may hold (mounts, biases,
scales). A bias that walks is a coarser chain above: node z_j (c numbers) is in force over a piece of the chain.

    rows about state k                [x_k | z_j | shared | right side]             (N, m, d + c + s + 1)
    rows that join k to k - 1         [x_k | x_k-1 | z_j | shared | right side]     (N, b, 2 d + c + s + 1)

The chain is cut into segments that are eliminated in lockstep from their last states backward, one numpy.linalg.qr for
one state of each. A segment leaves rows about its last state, that of the segment before and the border (z_j, shared):
a chain again. The last few dozen states go in time order, each node with the last state of its piece, so that what is
known after each of them is at hand. Of more pieces than that nodes join the states once a piece is one segment:
(attitude at the cut, bias).

Nothing is squared: R's diagonal gives the determinant, its last column the minimum. Golub, Plemmons, "Large-scale
geodetic least-squares adjustment by dissection and orthogonal decomposition", Lin. Alg. Appl. 34 (1980).

Limits: rank is tested state by state (`RANK_TOLERANCE`); two states that are undetermined only together end in a pivot
of the size of rounding. Shared unknowns without a prior may make `root` singular, and `solve` then raises
numpy.linalg.LinAlgError.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import IndeterminateError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Chains of at most so many states are eliminated in time order.
SEQUENTIAL_STATES = 96
# Of longer ones so many are looked at together: what it takes beside R does not grow with the recording.
PART_STATES = 1 << 14
# Rows of a block of a tall matrix, of which a cache holds some thousands of columns' worth.
_ROWS = 256
# A pivot below this share of its column's norm counts as zero: the state is not determined.
RANK_TOLERANCE = 1e-13


UNDETERMINED = (
    "a state (an attitude or a bias at one moment) is not determined by any measurement: record longer and with more "
    "motion, and check that every sensor measured throughout"
)


class IndeterminateStateError(IndeterminateError):
    """Neither measurements nor its neighbours determine a state."""


class Chain(ABC):
    """Linear least squares A x = b over a chain of states, in whitened rows [A | b], read in parts.

    Attributes:
        d: numbers of a state.
        shared: (r, s + 1) rows about the shared unknowns that come first: priors.
        piece: (N,) index j, not decreasing, of the node in force from k - 1 to k and at k; every node is in force at
            one state at least. None: no nodes.
        walk: (J, w, 2 c + 1) rows [z_j | z_j-1 | right side]; of the first node zero in its predecessor's columns.
    """

    d: int
    shared: Array
    piece: Index | None
    walk: Array | None

    @abstractmethod
    def __len__(self) -> int:
        """Number of states."""

    @abstractmethod
    def part(self, begin: int, end: int) -> ChainSystem:
        """Return the rows about states `begin` to `end` - 1, with those that join state `begin` to its predecessor.

        Rows about shared unknowns or nodes alone are all there.
        """

    @property
    def c(self) -> int:
        """Size of a node; 0 without nodes."""
        return 0 if self.walk is None else int(self.walk.shape[2]) // 2

    @property
    def border(self) -> int:
        """Number of columns beside those of the states: node, shared unknowns and right side, c + s + 1."""
        return self.c + int(self.shared.shape[1])

    def eliminate(self, damping: float = 0.0) -> ChainFactorization:
        """Factorize the system, with Marquardt `damping` where positive. Raises IndeterminateStateError."""
        return ChainFactorization.of(self.damped(damping) if damping > 0.0 else self)

    def root(self) -> Array:
        """`Factorization.root` alone: R of the states takes the memory of the rows. Raises IndeterminateStateError."""
        return _eliminated(self, with_rows=False)[2]

    def damped(self, damping: float) -> Chain:
        """Return the system with each unknown's own information, `damping` times, added at zero (Marquardt)."""
        d, c, root = self.d, self.c, np.sqrt(damping)
        states, shared = np.zeros((len(self), d)), np.square(self.shared[:, :-1]).sum(axis=0)
        for begin in range(0, len(self), PART_STATES):
            own = self.part(begin, min(begin + PART_STATES, len(self)))
            states[begin : begin + len(own)] += np.square(own.measured[..., :d]).sum(axis=1)
            states[begin : begin + len(own)] += np.square(own.between[..., :d]).sum(axis=1)
            before = np.square(own.between[..., d : 2 * d]).sum(axis=1)[begin == 0 :]
            states[max(begin - 1, 0) :][: len(before)] += before
            for rows in (own.measured, own.between, own.beside):
                shared = shared + np.square(rows[..., rows.shape[2] - len(shared) - 1 : -1]).sum(axis=(0, 1))
        prior = np.vstack([self.shared, np.pad(np.diag(root * np.sqrt(shared)), ((0, 0), (0, 1)))])
        walk = self.walk
        if walk is not None:
            nodes = np.square(walk[..., :c]).sum(axis=1)
            nodes[:-1] += np.square(walk[1:, :, c : 2 * c]).sum(axis=1)
            walk = np.concatenate([walk, np.zeros((len(nodes), c, 2 * c + 1))], axis=1)
            walk[:, np.arange(-c, 0), np.arange(c)] = root * np.sqrt(nodes)
        return _Damped(self, root * np.sqrt(states), d, prior, self.piece, walk)

    def segments(self) -> Index:
        """Last states of the segments, (B,); no segment spans two pieces."""
        n = len(self)
        together = min(n, PART_STATES)
        index, length = np.arange(n), max(2, int(together / max((2.0 * together) ** 0.5, SEQUENTIAL_STATES / 2.0)))
        if self.piece is None:
            return np.flatnonzero((n - 1 - index) % length == 0)
        last = np.flatnonzero(np.diff(self.piece, append=self.piece[-1] + 1) > 0)
        return np.flatnonzero((last[np.searchsorted(last, index)] - index) % length == 0)


@dataclass(frozen=True, eq=False)
class ChainSystem(Chain):
    """Rows of a whole chain in memory.

    Attributes:
        measured: (N, m, d + c + s + 1) rows about state k; rows that a state has no need of are zero.
        between: (N, b, 2 d + c + s + 1) rows that join state k to k - 1: zero across a break, and of the first state
            zero in the columns of its predecessor.
        beside: (N, q, c + s + 1) rows without a state that come after k - 1 and before k, or with it.
    """

    measured: Array
    between: Array
    beside: Array
    shared: Array
    d: int
    piece: Index | None = None
    walk: Array | None = None

    def __len__(self) -> int:
        return len(self.measured)

    def part(self, begin: int, end: int) -> ChainSystem:
        """Slice the rows about some consecutive states, as views."""
        piece, some = None if self.piece is None else self.piece[begin:end], slice(begin, end)
        measured, between, beside = self.measured[some], self.between[some], self.beside[some]
        return replace(self, measured=measured, between=between, beside=beside, piece=piece)

    @property
    def squares(self) -> float:
        """Sum of squares of the right side, the cost at a zero step."""
        parts = [self.measured, self.between, self.beside, self.shared, *([] if self.walk is None else [self.walk])]
        return sum(float(np.square(rows[..., -1]).sum()) for rows in parts)

    def with_nodes_as_states(self) -> ChainSystem:
        """Return the system in which each piece is one state (x_j, z_j), without nodes."""
        assert self.walk is not None
        d, c, (n, b, _), beside = self.d, self.c, self.between.shape, _triangle(self.beside)
        x, z, rest = np.arange(d), np.arange(d, d + c), np.arange(2 * (d + c), 2 * (d + c) + self.border - c)
        out = np.zeros((n, b + c + self.walk.shape[1], rest[-1] + 1))
        out[:, :b][..., np.r_[x, x + d + c, z, rest]] = self.between
        out[:, b : b + len(beside[0, :c])][..., np.r_[z, rest]] = beside[:, :c]
        out[:, b + c :][..., np.r_[z, z + d + c, rest[-1]]] = self.walk
        return ChainSystem(self.measured, out, beside[:, c:, c:], self.shared, d + c)


@dataclass(frozen=True, eq=False)
class _Damped(Chain):
    """A chain with Marquardt's damping rows; `diagonal` (N, d) is that of the states."""

    chain: Chain
    diagonal: Array
    d: int
    shared: Array
    piece: Index | None
    walk: Array | None

    def __len__(self) -> int:
        return len(self.chain)

    def part(self, begin: int, end: int) -> ChainSystem:
        """Return the rows about some consecutive states, the damping rows below the others."""
        own, d = self.chain.part(begin, end), self.d
        measured = np.concatenate([own.measured, np.zeros((len(own), d, own.measured.shape[2]))], axis=1)
        measured[:, np.arange(-d, 0), np.arange(d)] = self.diagonal[begin:end]
        return replace(own, measured=measured, shared=self.shared, walk=self.walk)


@dataclass(frozen=True, eq=False)
class _Level:
    """One level of the elimination: R of the inner states of all segments, the longest segment first.

    Attributes:
        ends, order: (B,) the segments' last states, and which of the segments in time order these are.
        active: (L + 1,) number of segments that are longer than k.
        rows: (N, d, 3 d + border) R of the inner states: columns x_k, x_k-1, last state of the segment, border.
        piece: (B,) of the segments; None: no nodes.
    """

    ends: Index
    order: Index
    active: Index
    rows: Array
    piece: Index | None

    @classmethod
    def eliminate(cls, chain: Chain, with_rows: bool) -> tuple[_Level, ChainSystem, Index]:
        """Eliminate each segment's inner states; return the level, the chain of last states, their indices.

        Without rows the level serves no back-substitution.
        """
        lasts, d = chain.segments(), chain.d
        shape, begin, left = (d, 3 * d + chain.border), 0, list[Array]()
        rows = np.zeros((len(chain) if with_rows else 0, *shape))
        # States of a coarse chain have more rows.
        more = chain.beside.shape[1] if isinstance(chain, ChainSystem) else 0
        for some in _together(lasts, max(1, PART_STATES // (1 + more))):
            end = int(lasts[some][-1]) + 1
            own = rows[begin:end] if with_rows else np.zeros((end - begin, *shape))
            found = _inner(chain.part(begin, end), lasts[some] - begin, own)
            left = left or [np.empty((len(lasts), *each.shape[1:])) for each in found]
            for whole, each in zip(left, found, strict=True):
                whole[some] = each
            begin = end
        measured, between, beside = left
        piece = None if chain.piece is None else chain.piece[lasts]
        coarse = ChainSystem(measured, between, beside, chain.shared, d, piece, chain.walk)
        return cls.of(lasts, rows, piece), coarse, lasts

    @classmethod
    def of(cls, lasts: Index, rows: Array, piece: Index | None) -> _Level:
        """Build a level from its segments' last states (B,), rows R of the inner states and pieces (B,)."""
        order, active = _longest_first(lasts)
        return cls(lasts[order], order, active, rows, None if piece is None else piece[order])

    def parts(self) -> Iterator[tuple[slice, slice, _Level]]:
        """Yield consecutive segments in parts: slice of the states, slice of the segments, level of the part."""
        in_time, begin = np.argsort(self.order), 0
        lasts = self.ends[in_time]
        for some in _together(lasts, PART_STATES):
            end = int(lasts[some][-1]) + 1
            piece = None if self.piece is None else self.piece[in_time][some]
            yield slice(begin, end), some, _Level.of(lasts[some] - begin, self.rows[begin:end], piece)
            begin = end

    def back(
        self, last: Array, border: Array, generator: np.random.Generator | None = None, before: Array | float = 0.0
    ) -> Array:
        """Back-substitute states (N, d, n) from the segments' last ones (B, d, n), border (B or 1, c + s + 1, n).

        `before` (d, n) is the state before the first, where there is one.
        """
        (N, d, _), last = self.rows.shape, last[self.order]
        x = np.zeros((N + 1, d, last.shape[2]))  # the last of them stands before the first
        x[self.ends], x[-1] = last, before
        for k in range(len(self.active) - 2, 0, -1):
            some, state = slice(self.active[k]), self.ends[: self.active[k]] - k
            R = self.rows[state]
            right = R[..., d : 2 * d] @ x[state - 1] + R[..., 2 * d : 3 * d] @ last[some]
            right += R[..., 3 * d :] @ (border if len(border) == 1 else border[some])
            x[state] = _solved(R[..., :d], right, generator)
        return x[:-1]

    def covariances(self, ends: Array) -> Array:
        """Covariances (N, 2 d + c, .) of (state, previous state, node), from those at segment ends (B, 2 d + c, .)."""
        d, c = self.rows.shape[1], ends.shape[1] - 2 * self.rows.shape[1]
        swap, out = np.r_[d : 2 * d, :d, 2 * d : 2 * d + c], np.zeros((len(self.rows), *ends.shape[1:]))
        before, node = slice(d), slice(2 * d, None)
        P = _block(ends[self.order], swap)  # of (state before, last state of the segment, node)
        for k in range(len(self.active) - 2, 0, -1):
            some, R = P[: self.active[k]], self.rows[self.ends[: self.active[k]] - k]
            T = -np.linalg.solve(R[..., :d], R[..., d : 3 * d + c])
            found = np.empty_like(some)
            cross = T @ some
            found[:, :d, :d] = cross @ np.swapaxes(T, 1, 2) + _inverse_gram(R[..., :d])
            found[:, :d, d : 2 * d], found[:, :d, 2 * d :] = cross[..., before], cross[..., node]
            found[:, d:, :d] = np.swapaxes(found[:, :d, d:], 1, 2)
            found[:, d : 2 * d, d : 2 * d], found[:, 2 * d :, 2 * d :] = some[:, before, before], some[:, node, node]
            found[:, d : 2 * d, 2 * d :], found[:, 2 * d :, d : 2 * d] = some[:, before, node], some[:, node, before]
            out[self.ends[: self.active[k]] - k] = found
            some[:, :d, :d], some[:, :d, d:] = found[:, :d, :d], cross[..., d:]
            some[:, d:, :d] = np.swapaxes(cross[..., d:], 1, 2)
        out[self.ends] = _block(P, swap)
        return out


class Factorization(ABC):
    """R of a chain's linear system: solution, covariances and draws by back-substitution.

    Attributes:
        c: numbers of the last node.
        root: (c + s + 1, c + s + 1) R of that, the shared unknowns and the right side.
    """

    c: int
    root: Array

    @property
    def minimum(self) -> float:
        """Sum of squares of all rows at the solution."""
        return float(self.root[-1, -1] ** 2)

    def solve(self) -> tuple[Array, Array, Array]:
        """Return the least-squares solution: states (N, d), nodes (J, c), shared unknowns (s,)."""
        last = np.asarray(np.linalg.solve(self.root[:-1, :-1], self.root[:-1, -1]), dtype=float)
        states, nodes = self.given(last[:, None])
        return states[..., 0], nodes[..., 0], last[self.c :]

    def given(self, last: Array) -> tuple[Array, Array]:
        """Return the optimal states and nodes for a given last node and shared unknowns (c + s, n)."""
        return self._back(last, 1.0)

    def propagate(self, last: Array) -> tuple[Array, Array]:
        """Return how the optimal states and nodes move with the last node and shared unknowns (c + s, n)."""
        return self._back(last, 0.0)

    def sample(self, count: int, generator: np.random.Generator) -> tuple[Array, Array, Array]:
        """Draw deviations from the posterior mean: states (N, d, n), nodes (J, c, n), shared unknowns (s, n)."""
        last = _solved(self.root[:-1, :-1], np.zeros((len(self.root) - 1, count)), generator)
        return *self._back(last, 0.0, generator), last[self.c :]

    @abstractmethod
    def _back(self, last: Array, right: float, generator: np.random.Generator | None = None) -> tuple[Array, Array]:
        """Back-substitute from last node and shared unknowns (c + s, n), with the right side `right` times."""


@dataclass(frozen=True, eq=False)
class ChainFactorization(Factorization):
    """R of a chain in numpy: eliminates everything but the last node and the shared unknowns."""

    d: int
    c: int
    root: Array
    _levels: list[_Level | None]  # None: from there on nodes are part of the states
    _ends: _TimeOrder

    @classmethod
    def of(cls, chain: Chain) -> ChainFactorization:
        """Eliminate a chain down to the last node and the shared unknowns. Raises IndeterminateStateError."""
        levels, ends, root = _eliminated(chain, with_rows=True)
        return cls(chain.d, chain.c, root, levels, ends)

    def nodes(self, last: Array) -> tuple[Array, Array]:
        """Return covariances and moves of the node pairs (z_j, z_j-1), for rows about nodes alone.

        Returns covariances (J, 2 c, 2 c) of (z_j, z_j-1) where the shared unknowns are known, zero for what is before
        the first, and how these move (J, 2 c, q) with the last node and the shared unknowns (c + s, q).
        """
        covariances, z = self._coarse(last)[1::2]
        return covariances, np.concatenate([z, np.concatenate([np.zeros_like(z[:1]), z[:-1]])], axis=1)

    def parts(self, last: Array, piece: Index | None) -> Iterator[tuple[slice, Array, Array]]:
        """Yield covariances and moves of (x_k, x_k-1, z_j) for some consecutive states at a time.

        Args:
            last: (c + s, q) moves of the last node and the shared unknowns.
            piece: (N,) node in force at each state.

        Yields which n states, the covariances (n, 2 d + c, 2 d + c) of (x_k, x_k-1, z_j) where the shared unknowns are
        known, zero for what is before the first, and how these move (n, 2 d + c, q) with the last node and the shared
        unknowns. What is known of all unknowns adds the squares of moves with `shared_roots`.
        """
        pairs, _, x, z = self._coarse(last)
        before, shared = np.zeros_like(x[:1]), np.pad(last[self.c :], ((0, 1), (0, 0)))
        finest = self._levels[0] if self._levels else None
        whole = [(slice(0, len(x)), slice(0, len(x)), None)] if finest is None else finest.parts()
        for states, some, level in whole:
            own, covariances = x[some], pairs[some]
            if level is not None:
                border = shared[None] if level.piece is None else _with_nodes(z[level.piece], shared)
                own, covariances = level.back(own, border, None, before[0]), level.covariances(covariances)
            node = np.zeros((len(own), 0, z.shape[2])) if piece is None else z[piece[states]]
            yield states, covariances, np.concatenate([own, np.concatenate([before, own[:-1]]), node], axis=1)
            before = own[-1:]

    def _coarse(self, last: Array) -> tuple[Array, Array, Array, Array]:
        """Covariances of state pairs and of nodes, moves of states and nodes, on the finest level's last states."""
        d, c = self.d, self.c
        levels = self._levels[int(bool(self._levels) and self._levels[0] is not None) :]
        pairs, nodes = self._ends.covariances(_inverse_gram(self.root[:c, :c]), c)
        for level in reversed(levels):
            if level is None:
                x, z, before = np.arange(d), np.arange(d, d + c), d + c
                nodes = _block(pairs, np.r_[z, z + before])
                pairs = _block(pairs, np.r_[x, x + before, z])
            else:
                pairs = level.covariances(pairs)
        return pairs, nodes, *self._states(levels, last, 0.0)

    @property
    def shared_roots(self) -> Array:
        """Factor F (c + s, s): F F' is what the shared unknowns add to the covariance of last node and shared."""
        return np.asarray(np.linalg.inv(self.root[:-1, :-1])[:, self.c :])

    def prefix_roots(self) -> tuple[Index, list[Array]]:
        """Keyframes (M,) and, of each, R of (node, shared, right side) given all rows until then."""
        ends, roots, known = self._ends, list[Array](), np.zeros((0, 1))
        for k, (head, pile) in enumerate(zip(ends.heads, ends.piles, strict=True)):
            known = _root([known, pile] if k and ends.piece[k] == ends.piece[k - 1] else [pile], pile.shape[1])
            roots.append(_root([head, known], head.shape[1])[self.d :, self.d :])
        return ends.keyframes, roots

    def _back(self, last: Array, right: float, generator: np.random.Generator | None = None) -> tuple[Array, Array]:
        return self._states(self._levels, last, right, generator)

    def _states(
        self, levels: list[_Level | None], last: Array, right: float, generator: np.random.Generator | None = None
    ) -> tuple[Array, Array]:
        """Back-substitute through some levels: states at the start of the finest of these, and nodes."""
        last = np.pad(last, ((0, 1), (0, 0)), constant_values=-right)
        x, nodes = self._ends.back(last, self.c, generator)
        shared = last[self.c :]
        for level in reversed(levels):
            if level is None:
                x, nodes = x[:, : self.d], x[:, self.d :]
            else:
                border = shared[None] if level.piece is None else _with_nodes(nodes[level.piece], shared)
                x = level.back(x, border, generator)
        return x, nodes


def _eliminated(chain: Chain, with_rows: bool) -> tuple[list[_Level | None], _TimeOrder, Array]:
    """Levels of a chain's elimination, with R of the states or not, the few states that remain, and the root."""
    own, levels, keyframes = chain.d, list[_Level | None](), np.arange(len(chain))
    while len(chain) > SEQUENTIAL_STATES or (own == 0 and chain.walk is not None):
        if chain.walk is not None and len(chain) == len(chain.walk):
            chain = chain.part(0, len(chain)).with_nodes_as_states()
            levels.append(None)
        else:
            level, chain, lasts = _Level.eliminate(chain, with_rows)
            levels.append(level)
            keyframes = keyframes[lasts]
    return levels, *_TimeOrder.eliminate(chain.part(0, len(chain)), keyframes, own)


def _with_nodes(nodes: Array, shared: Array) -> Array:
    """Stack the node in force (B, c, n) on the shared unknowns: each segment's border (B, c + s + 1, n)."""
    return np.concatenate([nodes, np.repeat(shared[None], len(nodes), axis=0)], axis=1)


@dataclass(frozen=True, eq=False)
class _TimeOrder:
    """Elimination in time order of the few dozen states that remain after all levels.

    Attributes:
        d, c: numbers of a state, and of a node where these are no part of the states.
        keyframes: (M,) of the states.
        rows: R of each state, columns: it, the next state, node, shared; with the last state of a piece goes its node:
            (state, node), (next state, next node), shared; of the last state: it, node, shared.
        piece: (M,) node in force at each.
        heads: rows [state | node | shared | right side] about each by itself and all before it.
        piles: rows [node | shared | right side] left by the state before; at the begin of a piece by all before.
    """

    d: int
    c: int
    keyframes: Index
    rows: list[Array]
    piece: Index
    heads: list[Array]
    piles: list[Array]

    @classmethod
    def eliminate(cls, chain: ChainSystem, keyframes: Index, own: int) -> tuple[_TimeOrder, Array]:
        """Eliminate a chain's states down to R of (last node, shared, right side); the first `own` numbers go last."""
        d, c, w, count = chain.d, chain.c, chain.border, len(chain.measured)
        piece = np.zeros(count, dtype=np.intp) if chain.piece is None else chain.piece
        rows, heads, piles, begin = list[Array](), list[Array](), list[Array](), 0
        left = _below([chain.shared, *([] if chain.walk is None else [_about_node(chain.walk[0], w)])], w)
        carried = np.delete(chain.between[0], np.s_[d : 2 * d], axis=1)
        for k, measured in enumerate(chain.measured):
            heads.append(np.concatenate([carried, measured]))
            piles.append(np.concatenate([left, chain.beside[k]]))
            if k == count - 1:
                break
            between = _swapped(chain.between[k + 1], d)
            if piece[k + 1] == piece[k]:
                (R,), (carried,), (left,) = _step(heads[-1][None], measured[None, :0], between[None], d, 0)
            else:
                assert chain.walk is not None
                known = _root(piles[begin:], w)
                R, carried, left = _last_of_piece(heads[-1], known, between, chain.walk[piece[k + 1]], d, c)
                begin = k + 1
            rows.append(R)
        R = _root([heads[-1], *piles[begin:]], d + w)
        rows.append(_determined(R[None, :own])[0])
        return cls(d, c, keyframes, rows, piece, heads, piles), R[own:, own:]

    def back(self, last: Array, tail: int, generator: np.random.Generator | None) -> tuple[Array, Array]:
        """Back-substitute states (M, d, n), nodes (J, c, n) from last node (`tail` numbers), shared unknowns."""
        d, c, n, count = self.d, self.c, last.shape[1], len(self.rows)
        x, nodes, shared = np.zeros((count, d, n)), np.zeros((int(self.piece[-1]) + 1, c, n)), last[tail:]
        own = len(self.rows[-1])
        x[-1, own:], nodes[-1] = last[: d - own], last[:c]
        x[-1, :own] = _solved(self.rows[-1][:, :own], self.rows[-1][:, own:] @ last, generator)
        for k in range(count - 2, -1, -1):
            R, j = self.rows[k], self.piece[k + 1]
            following = np.concatenate([x[k + 1], nodes[j], shared])
            found = _solved(R[:, : len(R)], R[:, len(R) :] @ following, generator)
            x[k] = found[:d]
            if len(R) > d:
                nodes[self.piece[k]] = found[d:]
        return x, nodes

    def covariances(self, last: Array, tail: int) -> tuple[Array, Array]:
        """Covariances (M, 2 d + c, .) of (state, state before, node) and (J, 2 c, .) of (node, node before).

        `last` (tail, tail) is the last node's, all where the shared unknowns are known.
        """
        d, c, e, count = self.d, self.c, self.d + self.c, len(self.rows)
        pairs, nodes = np.zeros((count, d + e, d + e)), np.zeros((int(self.piece[-1]) + 1, 2 * c, 2 * c))
        of_pair, of_node = np.r_[:d, e : e + d, d:e], np.r_[d:e, e + d : 2 * e]
        joint, P = np.zeros((2 * e, 2 * e)), _before(self.rows[-1], last, np.eye(tail))[0]
        for k in range(count - 1, -1, -1):
            joint[:e, :e], joint[e:] = P, 0.0
            if k:
                R = self.rows[k - 1]
                P, joint[e:, :e] = _before(R, P, np.eye(e)[len(R) :])
                joint[e:, e:] = P
            joint[:e, e:] = joint[e:, :e].T
            pairs[k] = _block(joint, of_pair)
            if k == 0 or self.piece[k - 1] < self.piece[k]:
                nodes[self.piece[k]] = _block(joint, of_node)
        return pairs, nodes


def _before(R: Array, following: Array, same: Array) -> tuple[Array, Array]:
    """Return the covariance of (x, parts of y) and its cross term to y, from rows R [x | y | .].

    `following` is the covariance of y, and `same` selects the parts.
    """
    own = len(R)
    T = np.vstack([-np.linalg.solve(R[:, :own], R[:, own : own + len(following)]), same])
    cross = T @ following
    out = cross @ T.T
    out[:own, :own] += _inverse_gram(R[:, :own])
    return out, cross


def _inverse_gram(R: Array) -> Array:
    """Inverse Gram matrices (R'R)^-1 of triangles (..., d, d)."""
    inverse = np.linalg.inv(R)
    return np.asarray(inverse @ np.swapaxes(inverse, -1, -2))


def _block(matrices: Array, some: Index) -> Array:
    """Principal submatrices of matrices (..., n, n): selected rows and the same columns."""
    return matrices[..., some[:, None], some]


def _last_of_piece(
    head: Array, known: Array, between: Array, walk: Array, d: int, c: int
) -> tuple[Array, Array, Array]:
    """Eliminate a state with its node: R, rows on the next state, rows on the next node and shared unknowns.

    Columns: head [x | z | rest], known [z | rest], between [x | x' | z' | rest], walk [z' | z | right side].
    """
    e, rest = d + c, np.arange(2 * (d + c), d + c + head.shape[1])
    x, z, x_next, z_next = np.arange(d), np.arange(d, e), np.arange(e, e + d), np.arange(e + d, 2 * e)
    parts = (
        (head, [x, z, rest]),
        (known, [z, rest]),
        (between, [x, x_next, z_next, rest]),
        (walk, [z_next, z, rest[-1:]]),
    )
    stack = np.zeros((max(sum(len(rows) for rows, _ in parts), 2 * e), rest[-1] + 1))
    begin = 0
    for rows, columns in parts:
        stack[begin : begin + len(rows), np.concatenate(columns)] = rows
        begin += len(rows)
    R = _triangle(stack)
    return _determined(R[None, :e])[0], R[e : e + d, e:], R[e + d :, e + d :]


def _about_node(walk: Array, columns: int) -> Array:
    """Place rows about the first node, [z | previous node | right side], in columns [node | shared | right side]."""
    c = walk.shape[1] // 2
    out = np.zeros((len(walk), columns))
    out[:, :c], out[:, -1] = walk[:, :c], walk[:, -1]
    return out


def _longest_first(lasts: Index) -> tuple[Index, Index]:
    """Order of the segments with last states (B,), the longest first, and how many are longer than k, (L + 1,)."""
    lengths = np.diff(lasts, prepend=-1)
    active = np.array([np.count_nonzero(lengths > k) for k in range(lengths.max() + 1)])
    return np.argsort(-lengths, kind="stable"), active


def _together(lasts: Index, states: int) -> list[slice]:
    """Group consecutive segments into parts of about so many states, or one longer segment."""
    cuts = np.flatnonzero(np.diff(lasts // states)) + 1
    return [slice(int(a), int(b)) for a, b in zip([0, *cuts], [*cuts, len(lasts)], strict=True)]


def _inner(chain: ChainSystem, lasts: Index, rows: Array) -> tuple[Array, Array, Array]:
    """Eliminate the inner states of some segments of a chain; the last state of each segment, (B,), remains.

    `rows` (N, d, 3 d + border) get R of the states that are eliminated.

    Returns the rows of the last states' chain: about each, joining it to the one before, and without a state.
    """
    d, w, b = chain.d, chain.border, chain.between.shape[1]
    order, active = _longest_first(lasts)
    ends = lasts[order]
    R, kept = _swapped(chain.between[ends], d), max(d, b)  # columns: state before, last state, border
    carried, piles = np.pad(R, ((0, 0), (0, kept - b), (0, 0))), [chain.beside[ends]]
    for k in range(1, len(active) - 1):
        state, ended = ends[: active[k]] - k, slice(active[k + 1], active[k])
        rows[state], R, rest = _step(R[: active[k]], chain.measured[state], chain.between[state], d, d)
        carried[ended, :d], carried[ended, d:] = R[ended], 0.0
        piles += [rest, chain.beside[state]]
    left, in_time = _reduced(piles, d + w), np.argsort(order)
    own = np.concatenate([left[:, :d, :d], np.zeros((len(ends), d, d)), left[:, :d, d:]], axis=2)
    between = np.concatenate([_swapped(carried, d), own], axis=1)[in_time]
    return chain.measured[lasts], between, left[in_time, d:, d:]


def _swapped(rows: Array, d: int) -> Array:
    """Swap the columns of the first two states in rows."""
    return np.concatenate([rows[..., d : 2 * d], rows[..., :d], rows[..., 2 * d :]], axis=-1)


def _step(carried: Array, measured: Array, between: Array, d: int, gap: int) -> tuple[Array, Array, Array]:
    """Eliminate one state in each of B segments: rows of R, rows (B, d, .) on the next state, rows about neither.

    `carried` (B, ., d + gap + border) are rows from before, `gap` columns of them of the segments' first states.
    """
    p, m, b = carried.shape[1], measured.shape[1], between.shape[1]
    stack = np.zeros((len(carried), max(p + m + b, 2 * d), between.shape[2] + gap))
    before, own, after = stack[:, :p], stack[:, p : p + m], stack[:, p + m : p + m + b]
    before[..., :d], before[..., 2 * d :] = carried[..., :d], carried[..., d:]
    own[..., :d], own[..., 2 * d + gap :] = measured[..., :d], measured[..., d:]
    after[..., : 2 * d], after[..., 2 * d + gap :] = between[..., : 2 * d], between[..., 2 * d :]
    R = _triangle(stack)
    return _determined(R[:, :d]), R[:, d : 2 * d, d:], R[:, 2 * d :, 2 * d :]


def _reduced(piles: list[Array], columns: int) -> Array:
    """Triangle R (B, columns, columns) of piles of rows, right-aligned; a pile may cover the first segments only."""
    ends = np.cumsum([0, *(each.shape[1] for each in piles)])
    whole = np.zeros((len(piles[0]), max(int(ends[-1]), columns), columns))
    for each, begin, end in zip(piles, ends, ends[1:], strict=False):
        whole[: len(each), begin:end, columns - each.shape[2] :] = each
    return _triangle(whole)


def _triangle(rows: Array) -> Array:
    """Triangle R (..., r, columns) of rows (..., m, columns), without the copies of numpy's mode "r".

    Many rows go by blocks that fit the cache, then what these leave (Demmel et al., "Communication-optimal parallel and
    sequential QR and LU factorizations", SIAM J. Sci. Comput. 2012).
    """
    columns, size = rows.shape[-1], max(_ROWS, 4 * rows.shape[-1])
    if rows.ndim == 2 and len(rows) > 2 * size:
        whole = len(rows) // size * size
        blocks = _triangle(rows[:whole].reshape(-1, size, columns))
        return _triangle(np.concatenate([blocks.reshape(-1, columns), rows[whole:]]))
    R: Array = np.swapaxes(np.linalg.qr(rows, mode="raw")[0], -1, -2)[..., : min(rows.shape[-2:]), :]
    return R * _upper(R.shape[-2], R.shape[-1])


def _root(rows: list[Array], columns: int) -> Array:
    """Triangle R of stacked rows, narrower blocks aligned to the right."""
    return _triangle(_below(rows, columns))


def _below(rows: list[Array], columns: int) -> Array:
    """Stack blocks of rows, narrower ones aligned to the right."""
    out, begin = np.zeros((sum(map(len, rows)), columns)), 0
    for each in rows:
        out[begin : begin + len(each), columns - each.shape[1] :] = each
        begin += len(each)
    return out


@cache
def _upper(rows: int, columns: int) -> Array:
    """Mask that is 1 on and above the diagonal, 0 below."""
    return np.triu(np.ones((rows, columns)))


def _solved(R: Array, right: Array, generator: np.random.Generator | None) -> Array:
    """Solve R x + right = noise for x; the noise is white with a generator, else zero."""
    noise = 0.0 if generator is None else generator.standard_normal(right.shape)
    return np.asarray(-np.linalg.solve(R, right + noise), dtype=float)


def _determined(R: Array) -> Array:
    """Return rows R (B, d, .) whose triangles (B, d, d) have full rank. Raises IndeterminateStateError."""
    triangle = R[..., : R.shape[1]]
    pivots = np.abs(np.diagonal(triangle, axis1=1, axis2=2))
    if not (pivots > RANK_TOLERANCE * np.linalg.norm(triangle, axis=1)).all():
        raise IndeterminateStateError(UNDETERMINED)
    return R
