"""The bridge from vectorised models to gtsam: many measurements in one CustomFactor.

A *model* predicts n measurements of m rows each from blocks of variables, all at once in numpy. The bridge gathers the
blocks from gtsam's Values, calls the model, weighs outliers down and lays the Jacobians out as gtsam wants them. One
Python call for 20 measurements costs little more than for one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# What a block's variable is: a gtsam.Rot3, or a vector of so many numbers.
Kind = Literal["rotation"] | int


class Model(Protocol):
    """n measurements of m rows each, predicted from blocks of variables.

    A dataclass whose `stacked` names the fields that hold something for each measurement may be evaluated together with
    others that agree in all other fields.
    """

    @property
    def time(self) -> Array:
        """When each measurement was made, (n,), s."""

    @property
    def rows(self) -> int:
        """m, the rows of one measurement."""

    def __call__(self, *blocks: Any, **_: Any) -> tuple[Array, Callable[[], tuple[Array, ...]]]:
        """Whitened residuals and, on demand, their Jacobians.

        A block is (n, 4), rotations as quaternions w, x, y, z, or (n, d), vectors. The residuals are (n, m); each
        Jacobian is (n, m, d), d the dimension of the block's tangent (3 for a rotation, perturbed on the right).
        """


@dataclass
class TruncatedLoss:
    """Truncated least squares on each measurement's whitened norm, with its graduated relaxation.

    Beyond `gate` a measurement costs gate**2 / 2, whatever its size: it has no pull. `mu` = inf is that loss; a small
    mu is a convex surrogate, and raising mu from outside leads from one to the other; mu = 0 stands for plain least
    squares. Yang, Antonante, Tzoumas,
    Carlone, "Graduated non-convexity for robust spatial perception", RA-L 2020, eqs. 13 and 14.
    """

    gate: float
    mu: float = np.inf

    def weight(self, square: Array) -> Array:
        """Weights in [0, 1] of measurements with squared norms `square`."""
        inside, outside = self._limits()
        if self.mu == 0.0:
            return np.ones_like(square)
        if np.isinf(self.mu):
            return (square < inside).astype(float)
        between = self.gate * np.sqrt(self.mu * (self.mu + 1.0) / np.maximum(square, 1e-300)) - self.mu
        return np.where(square <= inside, 1.0, np.where(square >= outside, 0.0, between))

    def cost(self, square: Array) -> Array:
        """Twice the loss of each measurement; equal to `square` well inside the gate."""
        inside, outside = self._limits()
        beyond = np.full_like(square, self.gate**2)
        if self.mu == 0.0:
            return square
        if np.isinf(self.mu):
            return np.minimum(square, beyond)
        norm = np.sqrt(square)
        between = 2.0 * self.gate * norm * np.sqrt(self.mu * (self.mu + 1.0)) - self.mu * (self.gate**2 + square)
        return np.where(square <= inside, square, np.where(square >= outside, beyond, between))

    def _limits(self) -> tuple[float, float]:
        if self.mu == 0.0:
            return np.inf, np.inf
        if np.isinf(self.mu):
            return self.gate**2, self.gate**2
        return self.gate**2 * self.mu / (self.mu + 1.0), self.gate**2 * (self.mu + 1.0) / self.mu


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


def _same(a: Any, b: Any) -> bool:
    """Whether two values of a variable, Rot3 or vector, are equal to the last bit."""
    return bool(a.equals(b, 0.0)) if isinstance(a, gtsam.Rot3) else a.tobytes() == b.tobytes()


@dataclass
class VectorizedFactor:
    """A model tied to variables: what a gtsam graph takes (`.factor`) and what reports ask for (`.residuals`).

    Args:
        model: the prediction.
        columns: for each block of the model, the variable's key: one key shared by all measurements, or one key a
            measurement.
        kinds: for each block, what its variable is: "rotation", or the length of a vector.
        loss: how outlying measurements are weighed; None counts all in full.
        compress: hand gtsam the square root of the normal equations instead of the rows (all columns shared). The
            factor then has as many rows as unknowns and one more that keeps its error exact.
    """

    model: Model
    columns: Sequence[int | Sequence[int]]
    kinds: Sequence[Kind]
    loss: TruncatedLoss | None = None
    compress: bool = False
    keys: list[int] = field(init=False)

    def __post_init__(self) -> None:
        if self.compress and any(not isinstance(c, int) for c in self.columns):
            raise ValueError("only a factor on variables shared by all its measurements can be compressed")
        # Key -> position among the factor's keys, in order of first appearance.
        slots: dict[int, int] = {}
        for column in self.columns:
            for key in [column] if isinstance(column, int) else column:
                slots.setdefault(key, len(slots))
        self.keys = list(slots)
        self._slots = [
            slots[column] if isinstance(column, int) else [slots[key] for key in column] for column in self.columns
        ]
        unknowns = sum(3 if kind == "rotation" else kind for kind in self.kinds)
        self._dim = unknowns + 1 if self.compress else len(self.model.time) * self.model.rows
        self._reads = [
            (key, kind == "rotation")
            for column, kind in zip(self.columns, self.kinds, strict=True)
            for key in ([column] if isinstance(column, int) else column)
        ]
        self._last: tuple[list[Any], _Evaluation] | None = None
        self._given: _Evaluation | None = None

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
        """Which of the n measurements the loss lets count; all of them while it stands for plain least squares."""
        square = (self.residuals(values) ** 2).sum(axis=1)
        return np.ones(len(square), dtype=bool) if self.loss is None else self.loss.weight(square) > 0.5

    def _at(self, values: gtsam.Values) -> _Evaluation:
        """The model at the values.

        The last evaluation is kept: a solver asks for the error, then for the Jacobians at the same values, and a
        smoother asks again and again while its linearisation point stays.
        """
        if self._given is not None:
            return self._given
        variables = [_read(values, key, rotation) for key, rotation in self._reads]
        if self._last is None or not all(map(_same, variables, self._last[0])):
            self._last = variables, _Evaluation(*self.model(*self._blocks(variables)))
        return self._last[1]

    def _blocks(self, variables: list[Any]) -> Iterator[Array]:
        """For each column its variables' values, (n, 4) or (n, d)."""
        n = len(self.model.time)
        start = 0
        for column, kind in zip(self.columns, self.kinds, strict=True):
            stop = start + (1 if isinstance(column, int) else len(column))
            block = _array(variables[start:stop], kind)
            yield np.broadcast_to(block, (n, block.shape[1]))
            start = stop

    def _evaluate(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        evaluation = self._at(values)
        residuals = evaluation.residuals
        if jacobians is None:
            if self.loss is None and not self.compress:
                return residuals.ravel()
            error = np.zeros(self._dim)
            error[0] = np.sqrt(_square(residuals) if self.loss is None else self.loss.cost(_squares(residuals)).sum())
            return error
        blocks = evaluation.jacobians()
        if self.loss is not None:
            root = np.sqrt(self.loss.weight(_squares(residuals)))[:, None]
            residuals = root * residuals
            blocks = tuple(root[..., None] * b for b in blocks)
        if self.compress:
            return self._compressed(residuals, blocks, jacobians)
        self._lay_out(blocks, jacobians)
        return residuals.ravel()

    @cached_property
    def _places(self) -> tuple[list[slice], list[Any]]:
        """The columns of each key in the whole Jacobian (n, m, width), and the elements each block is added to."""
        widths = [0] * len(self.keys)
        for slots, kind in zip(self._slots, self.kinds, strict=True):
            for slot in [slots] if isinstance(slots, int) else slots:
                widths[slot] = 3 if kind == "rotation" else kind
        ends = np.cumsum(widths)
        columns = [slice(int(end) - width, int(end)) for end, width in zip(ends, widths, strict=True)]
        n, m = len(self.model.time), self.model.rows
        rows = (np.arange(n * m) * int(ends[-1])).reshape(n, m, 1)
        targets: list[Any] = []
        for slots in self._slots:
            if isinstance(slots, int):
                targets.append(columns[slots])
            else:
                first, width = (ends - widths)[slots], widths[slots[0]]
                targets.append(rows + first[:, None, None] + np.arange(width))
        return columns, targets

    def _lay_out(self, blocks: Sequence[Array], jacobians: list[Array]) -> None:
        n, m = blocks[0].shape[:2]
        columns, targets = self._places
        whole = np.zeros((n * m, columns[-1].stop))
        flat = whole.reshape(-1)
        for target, block in zip(targets, blocks, strict=True):
            if isinstance(target, slice):
                whole[:, target] += block.reshape(n * m, -1)
            else:
                flat[target] += block
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


class Ensemble:
    """Vectorised factors evaluated together, models of one kind in one call.

    A graph has its measurements in many factors, for the sake of sparsity; numpy would rather have them in one array.
    """

    def __init__(self, factors: Sequence[VectorizedFactor]) -> None:
        groups: dict[Hashable, list[VectorizedFactor]] = {}
        for factor in factors:
            groups.setdefault(_kind(factor), []).append(factor)
        self._groups = [_Group(group) for group in groups.values()]
        self._values: gtsam.Values | None = None

    @contextmanager
    def at(self, values: gtsam.Values) -> Iterator[None]:
        """Evaluated at the values, which nobody may change; within the block the factors answer for no others."""
        if values is not self._values:
            for group in self._groups:
                group.evaluate(values)
            self._values = values
        try:
            for group in self._groups:
                group.give()
            yield
        finally:
            for group in self._groups:
                group.take()


class _Group:
    """Factors whose models are evaluated as one."""

    def __init__(self, factors: Sequence[VectorizedFactor]) -> None:
        self._factors = factors
        self._model = _stack([f.model for f in factors])
        ends = np.cumsum([len(f.model.time) for f in factors]).tolist()
        self._spans = list(zip([0, *ends[:-1]], ends, strict=True))
        self._columns = [self._column(i) for i in range(len(factors[0].columns))]
        self._parts: list[_Evaluation] = []

    def _column(self, i: int) -> tuple[list[int], NDArray[np.intp] | None]:
        """The variables of a column and which of them each measurement takes; None: there is only one."""
        keys: dict[int, int] = {}
        index: list[Any] = []
        for factor in self._factors:
            column = factor.columns[i]
            if isinstance(column, int):
                index.append(np.broadcast_to(keys.setdefault(column, len(keys)), len(factor.model.time)))
            else:
                index.append([keys.setdefault(key, len(keys)) for key in column])
        return list(keys), np.concatenate(index) if len(keys) > 1 else None

    def evaluate(self, values: gtsam.Values) -> None:
        n = self._spans[-1][1]
        blocks = []
        for (keys, index), kind in zip(self._columns, self._factors[0].kinds, strict=True):
            block = _array([_read(values, key, kind == "rotation") for key in keys], kind)
            blocks.append(np.broadcast_to(block, (n, block.shape[1])) if index is None else block[index])
        whole = _Evaluation(*self._model(*blocks))
        self._parts = [whole.part(start, stop) for start, stop in self._spans]

    def give(self) -> None:
        for factor, part in zip(self._factors, self._parts, strict=True):
            factor._given = part

    def take(self) -> None:
        for factor in self._factors:
            factor._given = None


def _kind(factor: VectorizedFactor) -> Hashable:
    """Equal for factors whose models can be evaluated as one."""
    stacked = getattr(factor.model, "stacked", None)
    if stacked is None:
        return id(factor)
    model: Any = factor.model
    shared = tuple(getattr(model, f.name) for f in fields(model) if f.name not in stacked)
    absent = tuple(getattr(model, name) is None for name in stacked)
    return type(model), shared, absent, model.rows, tuple(factor.kinds)


def _stack(parts: Sequence[Any]) -> Any:
    """One array or dataclass of several, their `stacked` fields one after the other."""
    first = parts[0]
    if first is None or len(parts) == 1:
        return first
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    return replace(first, **{name: _stack([getattr(part, name) for part in parts]) for name in first.stacked})


def _square(residuals: Array) -> float:
    """Sum of all squares."""
    flat = residuals.ravel()
    return float(flat @ flat)


def _squares(residuals: Array) -> Array:
    """Sum of squares of each measurement (n,)."""
    return np.einsum("nm,nm->n", residuals, residuals)


def _read(values: gtsam.Values, key: int, rotation: bool) -> Any:
    return values.atRot3(key) if rotation else values.atVector(key)


def _array(variables: Sequence[Any], kind: Kind) -> Array:
    """Values of variables, (n, 4) or (n, d)."""
    if kind == "rotation":
        return np.array([r.toQuaternion().coeffs() for r in variables])[:, [3, 0, 1, 2]]
    return np.array(variables)


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
