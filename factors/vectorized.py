"""The bridge from vectorised models to gtsam: many measurements in one CustomFactor.

The bridge gathers the blocks from gtsam's Values and calls the model; `alidade.factors.answers` weighs outliers down
and lays the Jacobians out. One Python call for 20 measurements costs little more than for one.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.answers import Answers, Evaluation, Places, counting, laid_out, places_of, squares_of
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import (
    POSE3,
    ROT3,
    Array,
    Block,
    Keys,
    Model,
    Residuals,
    check,
    dimension,
    select_rows,
    stack_models,
    stacking_key,
    width,
)

# Models of these types, rows and blocks were seen to give what they declare.
_CHECKED: set[Hashable] = set()


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
        self.slots = [
            slots[column] if isinstance(column, int) else [slots[key] for key in column] for column in self.columns
        ]
        unknowns = sum(map(dimension, self.blocks))
        self.dim = unknowns + 1 if self.compress else len(self.model.time) * self.model.rows
        self._last: tuple[list[Any], Evaluation] | None = None
        self._given: tuple[Answers, int] | None = None

    def _require_fit(self) -> None:
        """Raise ValueError unless model, blocks and keys belong together."""
        name, n = type(self.model).__name__, len(self.model.time)
        if not (self.loss is None or isinstance(self.loss, TruncatedLoss)):
            raise ValueError(f"{name}: the loss must be an alidade.factors.TruncatedLoss, not {self.loss!r}")
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
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(self.dim), self.keys, self._evaluate)

    def residuals(self, values: gtsam.Values) -> Array:
        """Whitened residuals (n, m) at the values, outliers included."""
        return self._at(values).residuals

    def evaluated(self, values: gtsam.Values) -> Evaluation:
        """Residuals and, on demand, Jacobians by the model's blocks, weighed but whatever the loss."""
        return self._at(values)

    def rows(self, values: gtsam.Values) -> tuple[Array, Array]:
        """Residuals (n * m,) and their Jacobian (n * m, d) on the factor's keys, neither weighed nor compressed."""
        evaluation = self._at(values)
        (augmented,) = laid_out(evaluation.jacobians(), evaluation.residuals, self.places, 1)
        return -augmented[:, -1], augmented[:, :-1]

    def linearized(self, values: gtsam.Values) -> gtsam.JacobianFactor:
        """What `factor.linearize` gives, in a third of the time: that has gtsam take Jacobians key by key."""
        answers, i = self._answering(values)
        return jacobian_factor(self.keys, self.places.widths, answers.augmented(i))

    def used(self, values: gtsam.Values) -> NDArray[np.bool_]:
        """Which of the n measurements the loss lets count; all of them without one."""
        return counting(squares_of(self.residuals(values)), self._loss_in_force) > 0.5

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
        return VectorizedFactor(select_rows(self.model, rows), tied, self.loss, noise=self.noise, weights=weights)

    @property
    def divisible(self) -> bool:
        """Whether `only` serves."""
        return hasattr(self.model, "stacked") and self.model.divisible and not self.compress

    @property
    def _loss_in_force(self) -> TruncatedLoss | None:
        return self.loss if self._given is None else self._given[0].loss

    def _at(self, values: gtsam.Values) -> Evaluation:
        """The model at the values.

        The last evaluation is kept: a solver asks for the error, then for the Jacobians at the same values, and a
        smoother asks again and again while its linearisation point stays.
        """
        if self._given is not None:
            answers, i = self._given
            return answers.part(i)
        variables = [
            variable
            for column, block in zip(self.columns, self.blocks, strict=True)
            for variable in _read(values, [column] if isinstance(column, int) else column, block)
        ]
        if self._last is None or not all(map(_same, variables, self._last[0])):
            self._last = variables, Evaluation(*self.model(*self._arrays(variables))).weighed(self.weights)
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
        answers, i = self._answering(values)
        return answers.error(i) if jacobians is None else answers.linear(i, jacobians)

    def _answering(self, values: gtsam.Values) -> tuple[Answers, int]:
        """Who answers for these values, and for which factor."""
        return self._given or (Answers([self], self._at(values), None, self.loss), 0)

    @cached_property
    def places(self) -> Places:
        """Where blocks lie in the system by all keys, see `places_of`."""
        slots = tuple(each if isinstance(each, int) else tuple(each) for each in self.slots)
        return places_of(len(self.model.time), self.model.rows, slots, tuple(map(dimension, self.blocks)))


def jacobian_factor(keys: list[int], widths: list[int], augmented: Array) -> gtsam.JacobianFactor:
    """The linear factor of a whole system [A, b] (m, width); `widths` of its keys' columns, one after the other, and b.

    Only a conditional, here of nothing, can be made of a whole matrix in Python.
    """
    system = gtsam.VerticalBlockMatrix(widths, augmented)
    return gtsam.JacobianFactor(gtsam.GaussianConditional(keys, 0, system))


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

    @property
    def error(self) -> float:
        """Half the sum of squares of all factors; to be asked within the block of `at`."""
        return sum(group.answers.total for group in self._groups)

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
                each[0].forget_jacobians()
                factor._given = each
        yield
    finally:
        for factors in parts:
            for factor in factors:
                factor._given = None


class _Group:
    """Factors whose models are evaluated as one."""

    def __init__(self, factors: Sequence[VectorizedFactor], places: dict[Block, dict[int, int]]) -> None:
        self._factors = factors
        self._model = stack_models([f.model for f in factors])
        self._columns = [self._column(i, places.setdefault(block, {})) for i, block in enumerate(factors[0].blocks)]
        self._whole: Evaluation | None = None

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
        n = len(self._model.time)
        blocks = []
        for rows, block in zip(self._columns, self._factors[0].blocks, strict=True):
            array = read[block][rows]
            blocks.append(np.broadcast_to(array, (n, array.shape[1])))
        self._whole = Evaluation(*self._model(*blocks))

    def give(self, loss: TruncatedLoss | None, mixed: bool) -> None:
        assert self._whole is not None, "evaluated before"
        loss = None if self._factors[0].loss is None else loss
        answers = Answers(self._factors, self._whole, self._weights, loss, mixed)
        for i, factor in enumerate(self._factors):
            factor._given = answers, i

    def excess(self) -> Iterator[tuple[int, int, Array]]:
        """As Ensemble.excess has it."""
        turning = self._model.turning
        if turning is None or self._factors[0].compress:
            return
        yield from self.answers.excess(*turning)

    @property
    def answers(self) -> Answers:
        """What was given."""
        given = self._factors[0]._given
        assert given is not None, "within the block of `at`"
        return given[0]

    @cached_property
    def _weights(self) -> Array | None:
        """(N, m) of all rows; None: all are one."""
        if all(factor.weights is None for factor in self._factors):
            return None
        of = [(len(f.model.time), f.model.rows, f.weights) for f in self._factors]
        return np.concatenate([np.ones((n, m)) if weights is None else weights for n, m, weights in of])

    def take(self) -> None:
        for factor in self._factors:
            factor._given = None


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
    if getattr(factor.model, "stacked", None) is None:
        return id(factor)
    return stacking_key(factor.model), factor.loss is None, factor.compress


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
