"""What factors answer gtsam when it asks for their errors and Jacobians, of models that were evaluated as one.

Measurements are weighed, by their factor's weights and by the loss in force, and laid out as the linear systems [A, b]
that gtsam wants, those of a few factors of the same form at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import takewhile
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import Array

if TYPE_CHECKING:
    from alidade.factors.vectorized import VectorizedFactor

# Linear systems of so many factors are laid out at once: few enough to stay in the cache.
_AT_A_TIME = 16


class Evaluation:
    """A model's residuals at some values, and its Jacobians once asked for."""

    def __init__(self, residuals: Array, linearize: Callable[[], tuple[Array, ...]]) -> None:
        self.residuals = residuals
        self._linearize: Callable[[], tuple[Array, ...]] | None = linearize
        self._jacobians: tuple[Array, ...] = ()

    def jacobians(self) -> tuple[Array, ...]:
        """By the model's blocks, (n, m, d) each."""
        if self._linearize is not None:
            self._jacobians, self._linearize = self._linearize(), None
        return self._jacobians

    def part(self, start: int, stop: int) -> Evaluation:
        """That of some consecutive measurements."""
        return Evaluation(
            self.residuals[start:stop], lambda: tuple(jacobian[start:stop] for jacobian in self.jacobians())
        )

    def weighed(self, weights: Array | None) -> Evaluation:
        """With rows multiplied by weights (n, m); None: as it is."""
        if weights is None:
            return self
        return Evaluation(weights * self.residuals, lambda: _scaled(self.jacobians(), weights))


class Answers:
    """What factors answer gtsam whose models were evaluated as one: errors, residuals and Jacobians under a loss.

    Linear systems are laid out for a few factors at a time, as they are asked for in turn.

    Attributes:
        loss: in force; None counts all in full.
        residuals: (N, m) of all measurements.
    """

    def __init__(
        self,
        factors: Sequence[VectorizedFactor],
        whole: Evaluation,
        weights: Array | None,
        loss: TruncatedLoss | None,
        mixed: bool = False,
    ) -> None:
        self.loss = loss
        self.residuals = whole.residuals if weights is None else weights * whole.residuals
        self._factors, self._whole, self._weights = factors, whole, weights
        ends = np.cumsum([len(factor.model.time) for factor in factors]).tolist()
        self._spans = list(zip([0, *ends[:-1]], ends, strict=True))
        self._turning = factors[0].model.turning if mixed and not factors[0].compress else None
        self._first, self._laid = 0, np.zeros((0, 0, 0))  # linear systems of some factors, from the first of them on

    def part(self, i: int) -> Evaluation:
        """The evaluation of a factor, whatever the loss."""
        start, stop = self._spans[i]
        return self._whole.part(start, stop).weighed(None if self._weights is None else self._weights[start:stop])

    def error(self, i: int) -> Array:
        """What gtsam takes for a factor's error when it asks for nothing else."""
        start, stop = self._spans[i]
        if self.loss is None and not self._factors[i].compress:
            return self.residuals[start:stop].ravel()
        error = np.zeros(self._factors[i].dim)
        error[0] = self._norms[i]
        return error

    def linear(self, i: int, jacobians: list[Array]) -> Array:
        """A factor's error, and its Jacobians by its keys."""
        augmented = self.augmented(i)
        for slot, column in enumerate(self._factors[i].places.columns):
            jacobians[slot] = augmented[:, column]
        return -augmented[:, -1]

    def augmented(self, i: int) -> Array:
        """A factor's linear system [A, b] by all its keys: Jacobians, and the errors' negatives."""
        if self._factors[i].compress:
            start, stop = self._spans[i]
            return _compressed(self._weighed(start, stop), self._blocks(start, stop))
        if not self._first <= i < self._first + len(self._laid):
            self._lay_out(i)
        return np.asarray(self._laid[i - self._first])

    def forget_jacobians(self) -> None:
        """Answer with residuals alone from now on."""
        self._whole = Evaluation(self._whole.residuals, _no_jacobians)

    def excess(self, block: int, number: int) -> Iterator[tuple[int, int, Array]]:
        """As Ensemble.excess has it, of a number that turns rows."""
        added = _at_right_angles(self.residuals)
        by = self._whole.jacobians()[block][:, :2, number]
        if self._weights is not None:
            by = self._weights[:, :2] * by
        counts = counting(self._squares, self.loss)
        information = counts[:, None] * np.stack([squares_of(added), (by * added).sum(axis=1)], axis=1)
        sums = np.add.reduceat(information, [start for start, _ in self._spans])
        for factor, each in zip(self._factors, sums, strict=True):
            key = factor.columns[block]
            assert isinstance(key, int), "a number that turns rows is shared"
            yield key, number, each

    @property
    def total(self) -> float:
        """The error of all factors together: half the sum of squares, as the loss counts them."""
        return 0.5 * float(self._costs.sum())

    @cached_property
    def _squares(self) -> Array:
        """(N,) of all measurements."""
        return squares_of(self.residuals)

    @cached_property
    def _costs(self) -> Array:
        """(N,) of all measurements under the loss."""
        return self._squares if self.loss is None else np.asarray(self.loss.cost(self._squares))

    @cached_property
    def _norms(self) -> list[float]:
        """Of the factors' errors."""
        return np.sqrt(np.add.reduceat(self._costs, [start for start, _ in self._spans])).tolist()

    @cached_property
    def _root(self) -> Array:
        """(N, 1) by which the loss multiplies rows."""
        return np.sqrt(counting(self._squares, self.loss))[:, None]

    def _weighed(self, start: int, stop: int) -> Array:
        """Residuals (n, m) of some measurements under the loss."""
        own = self.residuals[start:stop]
        return own if self.loss is None else self._root[start:stop] * own

    def _blocks(self, start: int, stop: int) -> tuple[Array, ...]:
        """Jacobians (n, m, d) of some measurements by the model's blocks under the loss."""
        blocks = self._whole.part(start, stop).jacobians()
        if self._weights is not None:
            blocks = _scaled(blocks, self._weights[start:stop])
        if self.loss is not None:
            blocks = _scaled(blocks, self._root[start:stop])
        if self._turning is not None:
            blocks = _turned(blocks, self._weighed(start, stop), *self._turning)
        return blocks

    def _lay_out(self, first: int) -> None:
        """Lay out the linear systems of factors of the same form, from this one on."""
        places = self._factors[first].places
        like = takewhile(lambda factor: factor.places is places, self._factors[first : first + _AT_A_TIME])
        count = sum(1 for _ in like)
        start, stop = self._spans[first][0], self._spans[first + count - 1][1]
        self._first = first
        self._laid = laid_out(self._blocks(start, stop), self._weighed(start, stop), places, count)


def _no_jacobians() -> tuple[Array, ...]:
    raise RuntimeError("evaluated for residuals alone")


def _compressed(residuals: Array, blocks: Sequence[Array]) -> Array:
    """The square root of the normal equations, and one more row that keeps the error exact."""
    rows = [b.reshape(-1, b.shape[2]) for b in blocks]
    A = np.concatenate(rows, axis=1) if len(rows) > 1 else rows[0]
    R, d, rest = square_root(A.T @ A, A.T @ residuals.ravel(), _square(residuals))
    augmented = np.zeros((len(R) + 1, len(R) + 1))
    augmented[:-1, :-1], augmented[:-1, -1], augmented[-1, -1] = R, -d, -rest
    return augmented


def _scaled(blocks: Sequence[Array], by: Array) -> tuple[Array, ...]:
    """Jacobians (n, m, d) with rows multiplied by (n, m) or (n, 1)."""
    return tuple(by[..., None] * block for block in blocks)


def _turned(blocks: Sequence[Array], residuals: Array, block: int, number: int) -> tuple[Array, ...]:
    """Jacobians by blocks, that by a number which turns the first two rows with the residuals turned likewise."""
    by = blocks[block].copy()
    by[:, :2, number] += _at_right_angles(residuals)
    return *blocks[:block], by, *blocks[block + 1 :]


def _at_right_angles(residuals: Array) -> Array:
    """The first two rows (n, 2) of residuals (n, m), turned back in their plane."""
    return np.stack([residuals[:, 1], -residuals[:, 0]], axis=1)


# Where a block (n, m, d) is added to the whole system: offset and strides, bytes, where its keys follow each other
# evenly, or the elements.
_Place = tuple[int, tuple[int, int, int]] | NDArray[np.intp]


class Places(NamedTuple):
    """How a factor's linear system [A, b] is laid out.

    Attributes:
        columns: of each key.
        widths: the same as numbers of columns, and that of b.
        targets: the place of each block.
    """

    columns: list[slice]
    widths: list[int]
    targets: list[_Place]


@lru_cache(maxsize=1000)
def places_of(n: int, m: int, slots: tuple[int | tuple[int, ...], ...], dimensions: tuple[int, ...]) -> Places:
    """The columns of each key in the whole system (n, m, width), and where each block is added.

    Most factors of a graph have the same.

    Args:
        n, m: measurements, and the rows of each.
        slots: of each block the position of its key, or of each measurement's, among the factor's keys.
        dimensions: of each block.
    """
    widths: dict[int, int] = {}
    for own, size in zip(slots, dimensions, strict=True):
        widths |= dict.fromkeys([own] if isinstance(own, int) else own, size)
    by_slot = [widths[slot] for slot in range(len(widths))]
    ends = np.cumsum(by_slot)
    columns = [slice(int(end) - size, int(end)) for size, end in zip(by_slot, ends, strict=True)]
    width = int(ends[-1]) + 1
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
    return Places(columns, [*by_slot, 1], targets)


def laid_out(blocks: Sequence[Array], residuals: Array, places: Places, count: int) -> Array:
    """Linear systems [A, b] (count, n * m, width) of so many factors of the same form, from Jacobians by blocks."""
    total, m = residuals.shape
    rows = total // count * m
    whole = np.zeros((count, rows, places.columns[-1].stop + 1))
    np.negative(residuals.reshape(count, rows), out=whole[:, :, -1])
    for target, block in zip(places.targets, blocks, strict=True):
        each = block.reshape(count, -1, m, block.shape[2])
        if isinstance(target, tuple):
            offset, strides = target
            place = np.ndarray(each.shape, whole.dtype, whole, offset, (whole.strides[0], *strides))
            place += each
        else:
            whole.reshape(count, -1)[:, target] += each
    return whole


def _square(residuals: Array) -> float:
    """Sum of all squares."""
    flat = residuals.ravel()
    return float(flat @ flat)


def counting(squares: Array, loss: TruncatedLoss | None) -> Array:
    """By how much a loss lets measurements count whose sums of squares are (n,)."""
    return np.ones(len(squares)) if loss is None else loss.weight(squares)


def squares_of(residuals: Array) -> Array:
    """Sum of squares of each measurement (n,)."""
    return np.einsum("nm,nm->n", residuals, residuals)


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
