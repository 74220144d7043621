"""The bridge from vectorised models to gtsam: many measurements in one CustomFactor.

A bound model gathers its blocks from gtsam's Values, calls the model, weighs outliers down and lays the Jacobians out
by its keys. One Python call for 20 measurements costs little more than for one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Mask
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import (
    POSE3,
    ROT3,
    Block,
    Keys,
    Model,
    Residuals,
    WrappedModel,
    check,
    dimension,
    select_rows,
    width,
)

# Models of these types, rows and blocks were seen to give what they declare.
_CHECKED: set[Hashable] = set()


class _Evaluation:
    """Whitened residuals (n, m) at some values, with Jacobians (n, m, d) by block computed on demand."""

    def __init__(self, residuals: Array, linearize: Callable[[], tuple[Array, ...]], weights: Array | None) -> None:
        self.residuals = residuals if weights is None else weights * residuals
        self._linearize, self._weights = linearize, weights
        self._jacobians: tuple[Array, ...] | None = None

    @property
    def jacobians(self) -> tuple[Array, ...]:
        """Jacobians (n, m, d) by each of the model's blocks."""
        if self._jacobians is None:
            blocks = self._linearize()
            self._jacobians = blocks if self._weights is None else _scaled(blocks, self._weights)
        return self._jacobians


@dataclass
class BoundModel:
    """A model bound to graph variables, as a gtsam factor (`factor`) and for reports (`residuals`).

    Built by `Model.on`, which says what the fields are. `weights` (n, m) multiply the whitened residuals.

    Raises:
        ValueError: keys, noise or what the model declares do not fit.
    """

    model: Model
    tied: Sequence[Keys]
    loss: TruncatedLoss | None = None
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
        # Variable -> numbers of its tangent, in order of first appearance.
        sizes: dict[int, int] = {}
        for column, block in zip(self.columns, self.blocks, strict=True):
            for key in [column] if isinstance(column, int) else column:
                sizes.setdefault(key, dimension(block))
        self.keys, self.widths = list(sizes), list(sizes.values())
        self._begin = dict(zip(sizes, np.cumsum([0, *self.widths]).tolist(), strict=False))
        self.dim = len(self.model.time) * self.model.rows
        self._last: tuple[list[Any], _Evaluation] | None = None

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

    @property
    def factor(self) -> gtsam.CustomFactor:
        """Build a gtsam factor that evaluates this model and keeps the model alive.

        It is not kept here: the two would keep each other for good, since Python's garbage collector cannot see what
        gtsam holds.
        """
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(self.dim), self.keys, self._evaluate)

    def residuals(self, values: gtsam.Values) -> Array:
        """Whitened residuals (n, m) at the values, outliers included."""
        return self._at(values).residuals

    def rows(self, values: gtsam.Values) -> tuple[Array, Array]:
        """Residuals (n * m,) and their Jacobian (n * m, d) by the keys, outliers at full weight."""
        augmented = self._augmented(values, None)
        return -augmented[:, -1], augmented[:, :-1]

    def linearized(self, values: gtsam.Values) -> gtsam.JacobianFactor:
        """Linearise as `factor.linearize` does, but in a third of the time, without gtsam's copies key by key."""
        return jacobian_factor(self.keys, [*self.widths, 1], self._augmented(values, self.loss))

    def used(self, values: gtsam.Values) -> Mask:
        """Mask (n,) of the measurements that the loss does not reject; all True without a loss."""
        return self._counts(self.residuals(values), self.loss) > 0.5

    def under(self, loss: TruncatedLoss | None) -> BoundModel:
        """Return the model with another loss; unchanged if the model has none."""
        if self.loss is None or self.loss == loss:
            return self
        other = copy(self)
        other.loss = loss
        return other

    def weighed(self, weights: Array) -> BoundModel:
        """Multiply the whitened residuals by weights (m,) or (n, m): noise of 1 / weights.

        They take the place of those it has.
        """
        other = copy(self)
        other.weights = np.broadcast_to(weights, (len(self.model.time), self.model.rows))
        other.model = self.model.at_noise(other.weights)
        other._last = None
        return other

    def only(self, kept: Mask) -> BoundModel:
        """Restrict the model to some of its n measurements; its class must declare `stacked`."""
        rows = np.flatnonzero(kept)
        tied = [column if isinstance(column, int) else [column[i] for i in rows] for column in self.columns]
        weights = None if self.weights is None else self.weights[rows]
        return BoundModel(select_rows(self.model, rows), tied, self.loss, noise=self.noise, weights=weights)

    @property
    def divisible(self) -> bool:
        """Whether the model can be restricted by `only`."""
        return hasattr(self.model, "stacked") and self.model.divisible

    def _counts(self, residuals: Array, loss: TruncatedLoss | None) -> Array:
        """Robust weights (n,) of the measurements, from whitened residuals (n, m)."""
        return np.ones(len(residuals)) if loss is None else loss.weight(np.square(residuals).sum(axis=1))

    def _at(self, values: gtsam.Values) -> _Evaluation:
        """Evaluate the model at the values, with a cache of the last evaluation.

        The last evaluation is kept: a solver asks for the error, then for the Jacobians at the same values, and a
        smoother asks again and again while its linearisation point stays.
        """
        variables = [
            variable
            for column, block in zip(self.columns, self.blocks, strict=True)
            for variable in _read(values, [column] if isinstance(column, int) else column, block)
        ]
        if self._last is None or not all(map(_same, variables, self._last[0])):
            self._last = variables, _Evaluation(*self.model(*self._arrays(variables)), self.weights)
        return self._last[1]

    def _arrays(self, variables: list[Any]) -> Iterator[Array]:
        """Yield the values of each column's variables, (n, width)."""
        n = len(self.model.time)
        start = 0
        for column, block in zip(self.columns, self.blocks, strict=True):
            stop = start + (1 if isinstance(column, int) else len(column))
            array = _array(variables[start:stop], block)
            yield np.broadcast_to(array, (n, array.shape[1]))
            start = stop

    def _evaluate(self, _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        """Return the whitened error of the gtsam factor, and write its Jacobians by key if requested."""
        if jacobians is None:
            residuals = self._at(values).residuals
            if self.loss is None:
                return residuals.ravel()
            error = np.zeros(self.dim)
            error[0] = self.loss.cost(np.square(residuals).sum(axis=1)).sum() ** 0.5
            return error
        augmented, begin = self._augmented(values, self.loss), 0
        for slot, size in enumerate(self.widths):
            jacobians[slot] = augmented[:, begin : begin + size]
            begin += size
        return np.asarray(-augmented[:, -1])

    def _augmented(self, values: gtsam.Values, loss: TruncatedLoss | None) -> Array:
        """Linear system [A, b] (n * m, d + 1) by all keys, weighted by a loss."""
        at = self._at(values)
        residuals, blocks = at.residuals, at.jacobians
        if loss is not None:
            root = np.sqrt(self._counts(residuals, loss))[:, None]
            residuals, blocks = root * residuals, _scaled(blocks, root)
        n, m = residuals.shape
        whole = np.zeros((n, m, sum(self.widths) + 1))
        whole[:, :, -1] = -residuals
        for column, block in zip(self.columns, blocks, strict=True):
            d = block.shape[2]
            if isinstance(column, int):
                begin = self._begin[column]
                whole[:, :, begin : begin + d] += block
            else:
                begins = np.array([self._begin[key] for key in column])
                at_columns = begins[:, None, None] + np.arange(d)
                whole[np.arange(n)[:, None, None], np.arange(m)[:, None], at_columns] += block
        return whole.reshape(n * m, -1)


def jacobian_factor(keys: list[int], widths: list[int], augmented: Array) -> gtsam.JacobianFactor:
    """Build a linear factor from a whole system [A, b] (m, width); `widths` of each key's columns and of b.

    Only a conditional, here of nothing, can be made of a whole matrix in Python.
    """
    system = gtsam.VerticalBlockMatrix(widths, augmented)
    return gtsam.JacobianFactor(gtsam.GaussianConditional(keys, 0, system))


@dataclass(frozen=True)
class _Whitened(WrappedModel):
    """A model whose residuals this wrapper whitens.

    Attributes:
        model: whose residuals are not.
        R: (m, m) square root of the information of one measurement.
    """

    R: Array

    @classmethod
    def by(cls, model: Model, noise: gtsam.noiseModel.Base) -> _Whitened:
        """Whiten a model with a Gaussian noise model of one measurement."""
        gaussian, name = gtsam.noiseModel.Gaussian, type(model).__name__
        if not isinstance(noise, gaussian) or isinstance(noise, gtsam.noiseModel.Constrained):
            raise ValueError(f"{name}: the noise model must be Gaussian and no constraint; for outliers give a `loss`")
        if noise.dim() != model.rows:
            raise ValueError(f"{name}: one measurement has {model.rows} rows, the noise model {noise.dim()}")
        return cls(model, noise.R())

    def __call__(self, *blocks: Array) -> Residuals:
        residuals, linearize = self.model(*blocks)
        return residuals @ self.R.T, lambda: tuple(self.R @ jacobian for jacobian in linearize())


def _read(values: gtsam.Values, keys: Sequence[int], block: Block) -> list[Any]:
    """Read the values of variables of one kind from gtsam."""
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
    """Convert the values of variables to an array (n, width)."""
    if not isinstance(block, int):
        out = np.empty((len(variables), width(block)))
        rotations = list(variables) if block is ROT3 else [pose.rotation() for pose in variables]
        out[:, :4] = so3.from_gtsam(rotations)
        if block is POSE3:
            out[:, 4:] = [pose.translation() for pose in variables]
        return out
    return np.array(variables)


def value_at(values: gtsam.Values, key: int) -> gtsam.Rot3 | Array:
    """Read a variable that is a rotation or a vector from gtsam values."""
    try:
        return values.atRot3(key)
    except RuntimeError:
        return values.atVector(key)


def _name(key: int) -> str:
    """Name of a variable for error messages."""
    symbol = gtsam.Symbol(key)
    return str(symbol.string()) if symbol.chr() else str(key)


def _same(a: Any, b: Any) -> bool:
    """Whether two values of a variable are identical to the last bit."""
    return a.tobytes() == b.tobytes() if isinstance(a, np.ndarray) else bool(a.equals(b, 0.0))


def _scaled(blocks: Sequence[Array], by: Array) -> tuple[Array, ...]:
    """Multiply the rows of Jacobians (n, m, d) by (n, m) or (n, 1)."""
    return tuple(by[..., None] * block for block in blocks)
