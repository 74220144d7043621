"""The bridge from vectorised models to gtsam: many measurements in one CustomFactor.

The bridge gathers the blocks from gtsam's Values, calls the model, weighs outliers down and lays the Jacobians out as
gtsam wants them. One Python call for 20 measurements costs little more than for one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from itertools import chain
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import so3
from factors.loss import TruncatedLoss
from factors.model import POSE3, ROT3, Array, Block, Keys, Model, Residuals, check, dimension, width

# Models of these types, rows and blocks were seen to give what they declare.
_CHECKED: set[Hashable] = set()


class _Evaluation:
    """A model's residuals at some values, and its Jacobians once asked for."""

    def __init__(self, residuals: Array, linearize: Callable[[], tuple[Array, ...]]) -> None:
        self.residuals = residuals
        self._linearize: Callable[[], tuple[Array, ...]] | None = linearize
        self._jacobians: tuple[Array, ...] = ()

    def jacobians(self) -> tuple[Array, ...]:
        if self._linearize is not None:
            self._jacobians, self._linearize = self._linearize(), None
        return self._jacobians

    def part(self, start: int, stop: int) -> _Evaluation:
        """That of some consecutive measurements."""
        return _Evaluation(
            self.residuals[start:stop], lambda: tuple(jacobian[start:stop] for jacobian in self.jacobians())
        )

    def weighed(self, weights: Array | None) -> _Evaluation:
        """With rows multiplied by weights (n, m); None: as it is."""
        if weights is None:
            return self
        return _Evaluation(
            weights * self.residuals, lambda: tuple(weights[..., None] * jacobian for jacobian in self.jacobians())
        )


def _same(a: Any, b: Any) -> bool:
    """Whether two values of a variable are equal to the last bit."""
    return a.tobytes() == b.tobytes() if isinstance(a, np.ndarray) else bool(a.equals(b, 0.0))


@dataclass
class VectorizedFactor:
    """A model tied to variables: what a gtsam graph takes (`.factor`) and what reports ask for (`.residuals`).

    Built by `Model.on`, which says what the fields are. A compressed factor has as many rows as unknowns and one more
    that keeps its error exact. `weights` (n, m) multiply the whitened residuals, see `weighed`.

    Raises:
        ValueError: keys, noise or what the model declares do not fit.
    """

    model: Model
    tied: Sequence[Keys]
    loss: TruncatedLoss | None = None
    compress: bool = False
    noise: gtsam.noiseModel.Base | None = None
    weights: Array | None = None
    columns: list[int | list[int]] = field(init=False)
    keys: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.columns = [int(c) if isinstance(c, int | np.integer) else [int(key) for key in c] for c in self.tied]
        self.tied = self.columns
        self.blocks = self.model.blocks
        self._require_fit()
        if self.noise is not None:
            self.model, self.noise = _Whitened.by(self.model, self.noise), None
        # Key -> position among the factor's keys, in order of first appearance.
        slots: dict[int, int] = {}
        for column in self.columns:
            for key in [column] if isinstance(column, int) else column:
                slots.setdefault(key, len(slots))
        self.keys = list(slots)
        self._slots = [
            slots[column] if isinstance(column, int) else [slots[key] for key in column] for column in self.columns
        ]
        unknowns = sum(map(dimension, self.blocks))
        self._dim = unknowns + 1 if self.compress else len(self.model.time) * self.model.rows
        self._last: tuple[list[Any], _Evaluation] | None = None
        self._given: tuple[_Evaluation, TruncatedLoss | None] | None = None
        self._mixed = False

    def _require_fit(self) -> None:
        """Raise ValueError unless model, blocks and keys belong together."""
        name, n = type(self.model).__name__, len(self.model.time)
        kind = (type(self.model), self.model.rows, self.blocks)
        if kind not in _CHECKED:
            check(self.model)
            _CHECKED.add(kind)
        if len(self.columns) != len(self.blocks):
            raise ValueError(f"{name} has {len(self.blocks)} blocks {list(self.blocks)}, given are {len(self.columns)}")
        held: dict[int, Block] = {}
        for i, (column, block) in enumerate(zip(self.columns, self.blocks, strict=True)):
            if not isinstance(column, int) and len(column) != n:
                raise ValueError(f"{name} of {n} measurements got {len(column)} keys for block {i}: one key, or {n}")
            for key in [column] if isinstance(column, int) else column:
                if held.setdefault(key, block) != block:
                    raise ValueError(f"{name} takes {_name(key)} both as {held[key]!r} and as {block!r}")
        if self.compress and (any(not isinstance(c, int) for c in self.columns) or len(held) < len(self.blocks)):
            raise ValueError("only a factor on different variables shared by all its measurements can be compressed")

    @property
    def factor(self) -> gtsam.CustomFactor:
        """A gtsam factor that asks this one, and keeps it.

        It is not kept here: the two would keep each other for good, since Python's garbage collector cannot see what
        gtsam holds.
        """
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(self._dim), self.keys, self._evaluate)

    def residuals(self, values: gtsam.Values) -> Array:
        """Whitened residuals (n, m) at the values, outliers included."""
        return self._at(values).residuals

    def rows(self, values: gtsam.Values) -> tuple[Array, Array]:
        """Residuals (n * m,) and their Jacobian (n * m, d) on the factor's keys, neither weighed nor compressed."""
        evaluation = self._at(values)
        jacobians: list[Array] = [np.empty(0)] * len(self.keys)
        self._lay_out(evaluation.jacobians(), jacobians)
        return evaluation.residuals.ravel(), np.concatenate(jacobians, axis=1)

    def used(self, values: gtsam.Values) -> NDArray[np.bool_]:
        """Which of the n measurements the loss lets count; all of them without one."""
        return _counting(_squares(self.residuals(values)), self._loss_in_force) > 0.5

    def under(self, loss: TruncatedLoss | None) -> VectorizedFactor:
        """The same factor with another loss, if it has one at all."""
        if self.loss is None or self.loss == loss:
            return self
        other = copy(self)
        other.loss = loss
        return other

    def weighed(self, weights: Array) -> VectorizedFactor:
        """The same factor with its whitened residuals multiplied by other weights (m,) or (n, m): noise of 1 / weights.

        They take the place of those it has.
        """
        other = copy(self)
        other.weights = np.broadcast_to(weights, (len(self.model.time), self.model.rows))
        other._last = None
        return other

    def only(self, kept: NDArray[np.bool_]) -> VectorizedFactor:
        """The factor on some of its n measurements. Only for a model that names what is `stacked`, uncompressed."""
        rows = np.flatnonzero(kept)
        tied = [column if isinstance(column, int) else [column[i] for i in rows] for column in self.columns]
        weights = None if self.weights is None else self.weights[rows]
        return VectorizedFactor(_take(self.model, rows), tied, self.loss, noise=self.noise, weights=weights)

    @property
    def divisible(self) -> bool:
        """Whether `only` serves."""
        return hasattr(self.model, "stacked") and self.model.divisible and not self.compress

    @property
    def _loss_in_force(self) -> TruncatedLoss | None:
        return self.loss if self._given is None else self._given[1]

    def _at(self, values: gtsam.Values) -> _Evaluation:
        """The model at the values.

        The last evaluation is kept: a solver asks for the error, then for the Jacobians at the same values, and a
        smoother asks again and again while its linearisation point stays.
        """
        if self._given is not None:
            return self._given[0]
        variables = [
            variable
            for column, block in zip(self.columns, self.blocks, strict=True)
            for variable in _read(values, [column] if isinstance(column, int) else column, block)
        ]
        if self._last is None or not all(map(_same, variables, self._last[0])):
            self._last = variables, _Evaluation(*self.model(*self._arrays(variables))).weighed(self.weights)
        return self._last[1]

    def _arrays(self, variables: list[Any]) -> Iterator[Array]:
        """For each column its variables' values, (n, width)."""
        n = len(self.model.time)
        start = 0
        for column, block in zip(self.columns, self.blocks, strict=True):
            stop = start + (1 if isinstance(column, int) else len(column))
            array = _array(variables[start:stop], block)
            yield np.broadcast_to(array, (n, array.shape[1]))
            start = stop

    def _evaluate(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        evaluation = self._at(values)
        residuals, loss = evaluation.residuals, self._loss_in_force
        if jacobians is None:
            if loss is None and not self.compress:
                return residuals.ravel()
            error = np.zeros(self._dim)
            error[0] = np.sqrt(_square(residuals) if loss is None else loss.cost(_squares(residuals)).sum())
            return error
        blocks = evaluation.jacobians()
        if loss is not None:
            root = np.sqrt(loss.weight(_squares(residuals)))[:, None]
            residuals = root * residuals
            blocks = tuple(root[..., None] * b for b in blocks)
        if self.compress:
            return self._compressed(residuals, blocks, jacobians)
        if self._mixed and self.model.turning is not None:
            blocks = _turned(blocks, residuals, *self.model.turning)
        self._lay_out(blocks, jacobians)
        return residuals.ravel()

    @cached_property
    def _places(self) -> tuple[list[slice], list[_Place]]:
        """As `_places` says."""
        slots = tuple(each if isinstance(each, int) else tuple(each) for each in self._slots)
        return _places(len(self.model.time), self.model.rows, slots, tuple(map(dimension, self.blocks)))

    def _lay_out(self, blocks: Sequence[Array], jacobians: list[Array]) -> None:
        n, m = blocks[0].shape[:2]
        columns, targets = self._places
        whole = np.zeros((n * m, columns[-1].stop))
        for target, block in zip(targets, blocks, strict=True):
            if isinstance(target, tuple):
                place = np.ndarray(block.shape, whole.dtype, whole, *target)
                place += block
            else:
                whole.reshape(-1)[target] += block
        for slot, column in enumerate(columns):
            jacobians[slot] = whole[:, column]

    def _compressed(self, residuals: Array, blocks: Sequence[Array], jacobians: list[Array]) -> Array:
        rows = [b.reshape(-1, b.shape[2]) for b in blocks]
        A = np.concatenate(rows, axis=1) if len(rows) > 1 else rows[0]
        R, d, rest = square_root(A.T @ A, A.T @ residuals.ravel(), _square(residuals))
        start = 0
        for slot, block in zip(self._slots, blocks, strict=True):
            assert isinstance(slot, int)
            stop = start + block.shape[2]
            jacobians[slot] = np.vstack([R[:, start:stop], np.zeros((1, stop - start))])
            start = stop
        return np.append(d, rest)


def _turned(blocks: Sequence[Array], residuals: Array, block: int, number: int) -> tuple[Array, ...]:
    """Jacobians by blocks, that by a number which turns the first two rows with the residuals turned likewise."""
    by = blocks[block].copy()
    by[:, :2, number] += _at_right_angles(residuals)
    return *blocks[:block], by, *blocks[block + 1 :]


def _at_right_angles(residuals: Array) -> Array:
    """The first two rows (n, 2) of residuals (n, m), turned back in their plane."""
    return np.stack([residuals[:, 1], -residuals[:, 0]], axis=1)


# Where a block (n, m, d) is added to the whole Jacobian: offset and strides, bytes, where its keys follow each other
# evenly, or the elements.
_Place = tuple[int, tuple[int, int, int]] | NDArray[np.intp]


@lru_cache(maxsize=1000)
def _places(
    n: int, m: int, slots: tuple[int | tuple[int, ...], ...], dimensions: tuple[int, ...]
) -> tuple[list[slice], list[_Place]]:
    """The columns of each key in the whole Jacobian (n, m, width), and where each block is added.

    Most factors of a graph have the same.

    Args:
        n, m: measurements, and the rows of each.
        slots: of each block the position of its key, or of each measurement's, among the factor's keys.
        dimensions: of each block.
    """
    widths: dict[int, int] = {}
    for own, size in zip(slots, dimensions, strict=True):
        widths |= dict.fromkeys([own] if isinstance(own, int) else own, size)
    ends = np.cumsum([widths[slot] for slot in range(len(widths))])
    columns = [slice(int(end) - widths[slot], int(end)) for slot, end in enumerate(ends)]
    width = int(ends[-1])
    rows = (np.arange(n * m) * width).reshape(n, m, 1)
    targets: list[_Place] = []
    for own, size in zip(slots, dimensions, strict=True):
        first = ends[[own] * n if isinstance(own, int) else list(own)] - size
        apart = int(first[min(1, n - 1)] - first[0])
        if (np.diff(first) == apart).all():
            one = np.dtype(float).itemsize
            targets.append((int(first[0]) * one, ((m * width + apart) * one, width * one, one)))
        else:
            targets.append(rows + first[:, None, None] + np.arange(size))
    return columns, targets


class Ensemble:
    """Vectorised factors evaluated together, models of one kind in one call.

    A graph has its measurements in many factors, for the sake of sparsity; numpy would rather have them in one array.
    """

    def __init__(self, factors: Sequence[VectorizedFactor]) -> None:
        groups: dict[Hashable, list[VectorizedFactor]] = {}
        for factor in factors:
            groups.setdefault(_kind(factor), []).append(factor)
        # Variables of one kind and where each is in the array of all their values: read once, whoever takes them.
        self._places: dict[Block, dict[int, int]] = {}
        self._groups = [_Group(group, self._places) for group in groups.values()]
        self._values: gtsam.Values | None = None

    @contextmanager
    def at(self, values: gtsam.Values, loss: TruncatedLoss | None = None, mixed: bool = False) -> Iterator[None]:
        """Evaluated at the values, which nobody may change; within the block the factors answer for no others.

        Args:
            values: of all variables.
            loss: within the block it stands in place of the factors' own, where they have one; None weighs all in full.
            mixed: where a number turns rows, its Jacobian's products with others have the second derivatives by both,
                which are as large as the residuals; its product with itself then has an `excess`. The gradient is as it
                is: what is added is at right angles to the residuals.
        """
        if values is not self._values:
            read = {block: _array(_read(values, list(keys), block), block) for block, keys in self._places.items()}
            for group in self._groups:
                group.evaluate(read)
            self._values = values
        try:
            for group in self._groups:
                group.give(loss, mixed)
            yield
        finally:
            for group in self._groups:
                group.take()

    def excess(self) -> Iterator[tuple[int, int, Array]]:
        """What `mixed` has too much, factor by factor; to be asked within the block of `at`.

        A variable, which of its numbers, and (2,) information about that: the first is of the residuals alone; the
        second, what they have in common with the Jacobian, is right where all else is at its minimum, and may be
        anything elsewhere.
        """
        return chain.from_iterable(group.excess() for group in self._groups)


@contextmanager
def residuals_at(
    parts: Sequence[Sequence[VectorizedFactor]], values: gtsam.Values, loss: TruncatedLoss | None
) -> Iterator[None]:
    """As `Ensemble.at` for many factors, part by part: within the block they answer with residuals alone.

    The models' Jacobians, and what these are made of, are let go after each part.
    """
    try:
        for factors in parts:
            with Ensemble(factors).at(values, loss):
                given = [factor._given for factor in factors]
            for factor, each in zip(factors, given, strict=True):
                assert each is not None
                factor._given = _Evaluation(each[0].residuals, _no_jacobians), each[1]
        yield
    finally:
        for factors in parts:
            for factor in factors:
                factor._given = None


def _no_jacobians() -> tuple[Array, ...]:
    raise RuntimeError("evaluated for residuals alone")


class _Group:
    """Factors whose models are evaluated as one."""

    def __init__(self, factors: Sequence[VectorizedFactor], places: dict[Block, dict[int, int]]) -> None:
        self._factors = factors
        self._model = _stack([f.model for f in factors])
        ends = np.cumsum([len(f.model.time) for f in factors]).tolist()
        self._spans = list(zip([0, *ends[:-1]], ends, strict=True))
        self._columns = [self._column(i, places.setdefault(block, {})) for i, block in enumerate(factors[0].blocks)]
        self._whole: _Evaluation | None = None
        self._parts: list[_Evaluation] = []

    def _column(self, i: int, places: dict[int, int]) -> NDArray[np.intp]:
        """The place of the variable that each measurement takes in a column; only one if they share it."""
        first = self._factors[0].columns[i]
        if isinstance(first, int) and all(factor.columns[i] == first for factor in self._factors):
            return np.array([places.setdefault(first, len(places))])
        rows: list[Any] = []
        for factor in self._factors:
            column = factor.columns[i]
            if isinstance(column, int):
                rows.append(np.broadcast_to(places.setdefault(column, len(places)), len(factor.model.time)))
            else:
                rows.append([places.setdefault(key, len(places)) for key in column])
        whole = np.concatenate(rows)
        return whole[:1] if (whole == whole[:1]).all() else whole

    def evaluate(self, read: Mapping[Block, Array]) -> None:
        n = self._spans[-1][1]
        blocks = []
        for rows, block in zip(self._columns, self._factors[0].blocks, strict=True):
            array = read[block][rows]
            blocks.append(np.broadcast_to(array, (n, array.shape[1])))
        whole = self._whole = _Evaluation(*self._model(*blocks))
        self._parts = [whole.part(start, stop) for start, stop in self._spans]

    def give(self, loss: TruncatedLoss | None, mixed: bool) -> None:
        for factor, part in zip(self._factors, self._parts, strict=True):
            factor._given = part.weighed(factor.weights), None if factor.loss is None else loss
            factor._mixed = mixed

    def excess(self) -> Iterator[tuple[int, int, Array]]:
        """As Ensemble.excess has it."""
        turning, first = self._model.turning, self._factors[0]
        if turning is None or first.compress:
            return
        assert self._whole is not None, "evaluated before"
        block, number = turning
        weights = self._weights
        residuals = weights * self._whole.residuals
        added = _at_right_angles(residuals)
        by = weights[:, :2] * self._whole.jacobians()[block][:, :2, number]
        counting = _counting(_squares(residuals), first._loss_in_force)
        information = counting[:, None] * np.stack([_squares(added), (by * added).sum(axis=1)], axis=1)
        sums = np.add.reduceat(information, [start for start, _ in self._spans])
        for factor, each in zip(self._factors, sums, strict=True):
            key = factor.columns[block]
            assert isinstance(key, int), "a number that turns rows is shared"
            yield key, number, each

    @property
    def _weights(self) -> Array:
        """Of all rows, (n or 1, m)."""
        if all(factor.weights is None for factor in self._factors):
            return np.ones((1, self._model.rows))
        of = [(len(f.model.time), f.model.rows, f.weights) for f in self._factors]
        return np.concatenate([np.ones((n, m)) if weights is None else weights for n, m, weights in of])

    def take(self) -> None:
        for factor in self._factors:
            factor._given, factor._mixed = None, False


@dataclass(frozen=True)
class _Whitened(Model):
    """A model whose residuals are whitened here.

    Attributes:
        model: whose residuals are not.
        R: (m, m) square root of the information of one measurement.
    """

    model: Model
    R: Array

    @classmethod
    def by(cls, model: Model, noise: gtsam.noiseModel.Base) -> _Whitened:
        """Whitened by a Gaussian noise model of one measurement."""
        gaussian, name = gtsam.noiseModel.Gaussian, type(model).__name__
        if not isinstance(noise, gaussian) or isinstance(noise, gtsam.noiseModel.Constrained):
            raise ValueError(f"{name}: the noise model must be Gaussian and no constraint; for outliers give a `loss`")
        if noise.dim() != model.rows:
            raise ValueError(f"{name}: one measurement has {model.rows} rows, the noise model {noise.dim()}")
        return cls(model, noise.R())

    @property
    def time(self) -> Array:
        return self.model.time

    @property
    def rows(self) -> int:
        return self.model.rows

    @property
    def blocks(self) -> tuple[Block, ...]:
        return self.model.blocks

    def __call__(self, *blocks: Array) -> Residuals:
        residuals, linearize = self.model(*blocks)
        return residuals @ self.R.T, lambda: tuple(self.R @ jacobian for jacobian in linearize())


def _kind(factor: VectorizedFactor) -> Hashable:
    """Equal for factors whose models can be evaluated as one."""
    stacked = getattr(factor.model, "stacked", None)
    if stacked is None:
        return id(factor)
    model: Any = factor.model
    shared = tuple(_hashable(getattr(model, f.name)) for f in fields(model) if f.name not in stacked)
    absent = tuple(getattr(model, name) is None for name in stacked)
    return type(model), shared, absent, model.rows, model.blocks, factor.loss is None, factor.compress


def _hashable(value: Any) -> Hashable:
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


def _stack(parts: Sequence[Any]) -> Any:
    """One array, list or dataclass of several, their `stacked` fields one after the other."""
    first = parts[0]
    if first is None or len(parts) == 1:
        return first
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    if isinstance(first, list):
        return list(chain.from_iterable(parts))
    return replace(first, **{name: _stack([getattr(part, name) for part in parts]) for name in first.stacked})


def _take(whole: Any, rows: NDArray[np.intp]) -> Any:
    """An array, list or dataclass of some measurements."""
    if whole is None or isinstance(whole, np.ndarray):
        return whole if whole is None else whole[rows]
    if isinstance(whole, list):
        return [whole[row] for row in rows]
    return replace(whole, **{name: _take(getattr(whole, name), rows) for name in whole.stacked})


def _square(residuals: Array) -> float:
    """Sum of all squares."""
    flat = residuals.ravel()
    return float(flat @ flat)


def _counting(squares: Array, loss: TruncatedLoss | None) -> Array:
    """By how much a loss lets measurements count whose sums of squares are (n,)."""
    return np.ones(len(squares)) if loss is None else loss.weight(squares)


def _squares(residuals: Array) -> Array:
    """Sum of squares of each measurement (n,)."""
    return np.einsum("nm,nm->n", residuals, residuals)


def _read(values: gtsam.Values, keys: Sequence[int], block: Block) -> list[Any]:
    """Values of variables of one kind."""
    if block is ROT3:
        return [values.atRot3(key) for key in keys]
    if block is POSE3:
        return [values.atPose3(key) for key in keys]
    vectors = [values.atVector(key) for key in keys]
    for key, vector in zip(keys, vectors, strict=True):
        if len(vector) != block:
            raise ValueError(f"{_name(key)} is a vector of {len(vector)} numbers, its factor takes {block}")
    return vectors


def _array(variables: Sequence[Any], block: Block) -> Array:
    """Values of variables, (n, width)."""
    if not isinstance(block, int):
        out = np.empty((len(variables), width(block)))
        rotations = list(variables) if block is ROT3 else [pose.rotation() for pose in variables]
        out[:, :4] = so3.from_gtsam(rotations)
        if block is POSE3:
            out[:, 4:] = [pose.translation() for pose in variables]
        return out
    return np.array(variables)


def _name(key: int) -> str:
    """A variable as people write it."""
    symbol = gtsam.Symbol(key)
    return str(symbol.string()) if symbol.chr() else str(key)


def square_root(information: Array, projection: Array, square: float) -> tuple[Array, Array, float]:
    """Rows (R, d) and a rest with |A x + e|^2 = |R x + d|^2 + rest^2, given A'A, A'e and e'e.

    Works for singular A'A too: directions without information get empty rows.
    """
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    known = eigenvalues > len(scale) * np.finfo(float).eps
    root = np.sqrt(np.where(known, eigenvalues, 0.0))
    R = root[:, None] * vectors.T * scale
    d = np.where(known, vectors.T @ (projection / scale), 0.0) / np.where(known, root, 1.0)
    return R, d, max(square - float(d @ d), 0.0) ** 0.5
