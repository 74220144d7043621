"""Positions of a problem's variables: in arrays of values, and among the unknowns of a chain.

    layout, values = Layout.of(problem.layout, initial)      # from a problem's ChainLayout and gtsam values
    moved = layout.retract(values, Tangent(*factorization.solve()))
    J = layout.root_columns(key)                             # tangent of a reported variable by (last node, shared)

A bias that walks is b_j = b_0 + delta_j and its running mean m_j = b_0 + mu_j: both have the shared columns of b_0 and
those of node z_j = (delta_j, mu_j), z_0 = 0. Variables of a state that a keyframe does not have are absent there.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.model import POSE3, ROT3, Block, dimension, retract, width
from alidade.pipelines.estimation.problem import ChainLayout
from alidade.pipelines.solvers.chain import Index

if TYPE_CHECKING:
    import gtsam


class NotAChainError(Exception):
    """A problem's factors do not form a chain; the message names the factor and the reason."""


@dataclass(frozen=True, eq=False)
class Values:
    """Values of all variables, in one array for each kind.

    Attributes:
        arrays: kind of variable -> (count, width), rows as `Layout` has them.
    """

    arrays: Mapping[Block, Array]


@dataclass(frozen=True, eq=False)
class Tangent:
    """Tangent of all unknowns, or n of these: states (N, d), nodes (J, c), shared (s,), each with [, n]."""

    states: Array
    nodes: Array
    shared: Array

    def times(self, length: float) -> Tangent:
        """Multiply the tangent by `length`."""
        return Tangent(length * self.states, length * self.nodes, length * self.shared)


@dataclass(frozen=True, eq=False)
class Layout:
    """Positions of a problem's variables in arrays of values and among the unknowns of a chain.

    Attributes:
        key: (V,) the variables, increasing.
        block: (V,) what each is: index into `blocks`.
        blocks: kinds of variables.
        row: (V,) row of each in the array of its kind.
        keyframe: (V,) of a state; -1: no state.
        offset: (V,) first of its numbers in the state.
        shared: (V,) first of its columns among the shared unknowns; -1: none.
        node: (V,) of a node; -1: none. The first node has 0, though nothing of it deviates from itself.
        part: (V,) first of its numbers in the node.
        sizes: N keyframes, d numbers of a state, J nodes, c numbers of a node, s shared unknowns.
        kept: (N, d), (J, c) which numbers of states and nodes are variables.
    """

    key: Index
    block: Index
    blocks: tuple[Block, ...]
    row: Index
    keyframe: Index
    offset: Index
    shared: Index
    node: Index
    part: Index
    sizes: tuple[int, int, int, int, int]
    kept: tuple[NDArray[np.bool_], NDArray[np.bool_]]

    @classmethod
    def of(
        cls, layout: ChainLayout | None, initial: gtsam.Values, shared: Collection[int] = ()
    ) -> tuple[Layout, Values]:
        """Lay out the variables of some gtsam values; return the layout with these values in arrays.

        Args:
            layout: how they are a chain; None: they are none, and every variable is a state by itself.
            initial: the values.
            shared: variables that are shared where there is no chain: those that are reported.
        """
        key = np.array(initial.keys(), dtype=np.uint64).astype(np.intp)
        letter, index, n = key >> 56, key & ((1 << 56) - 1), len(key)
        kind, row, size = np.zeros((3, n), dtype=np.intp)
        parts: dict[Block, list[Array]] = {}
        for some in _alike(initial, key, letter):
            block, values = _read(initial, key[some])
            own = parts.setdefault(block, [])
            kind[some], size[some] = list(parts).index(block), dimension(block)
            row[some] = sum(map(len, own)) + np.arange(len(values))
            own.append(values)
        keyframe, offset, d = _states(layout, key, letter, index, size, shared)
        node, part, first, (count, c) = _nodes(layout, letter, index, size)
        own_columns = (keyframe < 0) & ((node < 0) | (np.arange(n) == first))
        begin = np.where(own_columns, np.cumsum(np.where(own_columns, size, 0)) - size, -1)
        if first >= 0:
            begin[node >= 0] = begin[first]
        frames = int(keyframe.max(initial=-1)) + 1 or max(count, 1)
        kept = _kept((frames, d), keyframe, offset, size), _kept((count if c else 0, c), node, part, size)
        if c:
            kept[1][0] = False
        else:
            node[:] = -1
        sizes = frames, d, count if c else 0, c, int(size[own_columns].sum())
        out = cls(key, kind, tuple(parts), row, keyframe, offset, begin, node, part, sizes, kept)
        return out, Values({block: np.concatenate(each) for block, each in parts.items()})

    def at(self, keys: Sequence[int] | Index) -> Index:
        """Positions of the variables with some keys. Raises NotAChainError for a key without a value."""
        wanted = np.asarray(keys, dtype=np.intp)
        found = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        if (self.key[found] != wanted).any():
            raise NotAChainError("a factor is about a variable without a first value")
        return found

    def size(self, at: int) -> int:
        """Tangent dimension of the variable at a position."""
        return dimension(self.blocks[self.block[at]])

    def roles(self, columns: Sequence[int | list[int]]) -> tuple[tuple[bool, bool, bool], ...]:
        """Whether each block of a factor is one variable for all measurements, a state, a node: three flags each."""
        at = self.at([column if isinstance(column, int) else column[0] for column in columns])
        of = zip(columns, self.keyframe[at] >= 0, self.node[at] >= 0, strict=True)
        return tuple((isinstance(column, int), bool(state), bool(node)) for column, state, node in of)

    def moves(self, some: Index, step: Tangent) -> Array:
        """Moves (len(some), dim, ...) of variables of one kind along a tangent, a node's own added to those of b_0."""
        span, keyframe, node = np.arange(dimension(self.blocks[self.block[some[0]]])), self.keyframe, self.node
        out = np.zeros((len(some), len(span), *step.shared.shape[1:]))
        for own, of, rows, columns in (
            (keyframe[some] >= 0, step.states, keyframe, self.offset),
            (keyframe[some] < 0, step.shared[None], np.zeros_like(node), self.shared),
            (node[some] > 0, step.nodes, node, self.part),
        ):
            at = some[own]
            out[own] += of[rows[at][:, None], columns[at][:, None] + span]
        return out

    def retract(self, values: Values, step: Tangent) -> Values:
        """Retract values along a step."""
        moved = {}
        for i, block in enumerate(self.blocks):
            some = np.flatnonzero(self.block == i)
            delta = np.empty((len(some), dimension(block)))
            delta[self.row[some]] = self.moves(some, step)
            moved[block] = retract(values.arrays[block], block, delta)
        return Values(moved)

    def of_key(self, values: Values, key: int) -> Array:
        """Value (width,) of the variable with a given key."""
        (at,) = self.at([key])
        return values.arrays[self.blocks[self.block[at]]][self.row[at]]

    def to_gtsam(self, values: Values, keys: Iterable[int] | None = None) -> gtsam.Values:
        """Convert the values of some variables, or of all, to gtsam."""
        import gtsam

        out = gtsam.Values()
        some = np.arange(len(self.key)) if keys is None else self.at(sorted(set(keys)))
        for at in some.tolist():
            block = self.blocks[self.block[at]]
            insert_value(out, int(self.key[at]), block, values.arrays[block][self.row[at]])
        return out

    def from_gtsam(self, values: gtsam.Values) -> Values:
        """Read the values of all variables from gtsam."""
        arrays = {}
        for i, block in enumerate(self.blocks):
            some = np.flatnonzero(self.block == i)
            found = np.empty((len(some), width(block)))
            found[self.row[some]] = _read(values, self.key[some])[1]
            arrays[block] = found
        return Values(arrays)

    def with_shared(self, values: Values, block: Block, value: Array) -> tuple[Layout, Values, int]:
        """Append a shared variable; return the layout, the values with it, and its position."""
        known = values.arrays.get(block, np.empty((0, width(block))))
        blocks = self.blocks if block in self.blocks else (*self.blocks, block)
        numbers = {
            "key": self.key.max() + 1,
            "block": blocks.index(block),
            "row": len(known),
            "shared": self.sizes[4],
            "keyframe": -1,
            "offset": 0,
            "node": -1,
            "part": 0,
        }
        grown: dict[str, Any] = {name: np.append(getattr(self, name), number) for name, number in numbers.items()}
        sizes = (*self.sizes[:4], self.sizes[4] + dimension(block))
        arrays = {**values.arrays, block: np.vstack([known, value])}
        return replace(self, **grown, blocks=blocks, sizes=sizes), Values(arrays), len(self.key)

    def root_columns(self, key: int) -> Array:
        """Jacobian (d, c + s) of a variable's tangent by the last node and the shared unknowns.

        Raises NotAChainError for a state, or a node that is not the last.
        """
        (at,) = self.at([key])
        *_, J, c, s = self.sizes
        if self.keyframe[at] >= 0 or self.node[at] not in (-1, 0, J - 1):
            raise NotAChainError("a reported variable must be shared by all rows, or belong to the last node")
        size = dimension(self.blocks[self.block[at]])
        out = np.zeros((size, c + s))
        out[:, c + self.shared[at] : c + self.shared[at] + size] = np.eye(size)
        if self.node[at] > 0:
            out[:, self.part[at] : self.part[at] + size] += np.eye(size)
        return out


def _alike(values: gtsam.Values, key: Index, letter: Index) -> list[Index]:
    """Group variables by the letter of their key; single where letter or dimensions are not common."""
    dims = values.dims()
    dim = np.array([dims[k] for k in key.tolist()])
    groups: list[Index] = []
    for c in np.unique(letter):
        some = np.flatnonzero(letter == c)
        groups += [some] if c and (dim[some] == dim[some[0]]).all() else [some[i : i + 1] for i in range(len(some))]
    return groups


def _read(values: gtsam.Values, keys: Index) -> tuple[Block, Array]:
    """Block and values (n, width) of variables of one kind. Raises NotAChainError for other kinds."""
    first = int(keys[0])
    for block, read in ((None, values.atVector), (ROT3, values.atRot3), (POSE3, values.atPose3)):
        try:
            read(first)
        except RuntimeError:
            continue
        found: list[Any] = [read(k) for k in keys.tolist()]
        if block is None:
            return len(found[0]), np.array(found)
        if block is ROT3:
            return ROT3, so3.from_gtsam(found)
        rotations = so3.from_gtsam([pose.rotation() for pose in found])
        return POSE3, np.concatenate([rotations, [pose.translation() for pose in found]], axis=1)
    raise NotAChainError("variables are vectors, Rot3 or Pose3")


def insert_value(values: gtsam.Values, key: int, block: Block, value: Array) -> None:
    """Insert a variable's value (width,) into gtsam's values."""
    import gtsam

    if block is ROT3:
        values.insert(key, so3.to_gtsam(value))
    elif block is POSE3:
        values.insert(key, gtsam.Pose3(so3.to_gtsam(value[:4]), value[4:]))
    else:
        values.insert(key, value)


def _states(
    layout: ChainLayout | None, key: Index, letter: Index, index: Index, size: Index, shared: Collection[int]
) -> tuple[Index, Index, int]:
    """Keyframe (-1: none) of each variable, its offset in the state, and the size of a state."""
    keyframe, offset = np.full(len(key), -1), np.zeros(len(key), dtype=np.intp)
    if layout is None:
        some = ~np.isin(key, list(shared))
        keyframe[some] = np.arange(np.count_nonzero(some))
        return keyframe, offset, int(size[some].max(initial=0))
    some = np.isin(letter, [ord(c) for c in layout.states])
    keyframe[some] = np.unique(index[some], return_inverse=True)[1]
    d = 0
    for name in layout.states:
        of = letter == ord(name)
        offset[of] = d
        d += int(size[of].max(initial=0))
    return keyframe, offset, d


def _nodes(
    layout: ChainLayout | None, letter: Index, index: Index, size: Index
) -> tuple[Index, Index, int, tuple[int, int]]:
    """Node (-1: none) of each variable, its offset there; position of the first node; node count and size."""
    node, part = np.full(len(letter), -1), np.zeros(len(letter), dtype=np.intp)
    names = "" if layout is None else layout.nodes
    some = np.isin(letter, [ord(c) for c in names])
    if not some.any():
        return node, part, -1, (0, 0)
    biases = np.flatnonzero(letter == ord(names[0]))
    if not len(biases):
        raise NotAChainError("the nodes of a bias that walks are not there")
    first, width = int(biases[0]), int(size[biases[0]])
    node[some] = index[some] - index[first]
    for i, name in enumerate(names):
        part[letter == ord(name)] = i * width
    count = int(node.max()) + 1
    return node, part, first, (count, len(names) * width if count > 1 else 0)


def _kept(shape: tuple[int, int], place: Index, offset: Index, size: Index) -> NDArray[np.bool_]:
    """Mask of the entries of all states, or nodes, that belong to a variable."""
    out = np.zeros(shape, dtype=bool)
    if out.size:
        for begin, width in {*zip(offset[place >= 0].tolist(), size[place >= 0].tolist(), strict=True)}:
            some = (place >= 0) & (offset == begin) & (size == width)
            out[place[some], begin : begin + width] = True
    return out
