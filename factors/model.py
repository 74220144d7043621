"""What a vectorised model is: many measurements predicted at once in numpy, and the variables they are predicted from.

A model knows nothing of gtsam; `on` ties it to the variables of a graph.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array, Index

if TYPE_CHECKING:
    import gtsam

    from alidade.factors.bridge import BoundModel
    from alidade.factors.loss import TruncatedLoss

# Whitened residuals (n, m) and, on demand, their Jacobians by the blocks, (n, m, d) each.
Residuals = tuple[Array, Callable[[], tuple[Array, ...]]]


class LieGroup(Enum):
    """Kinds of Lie group variables other than vectors."""

    ROT3 = "ROT3"
    POSE3 = "POSE3"

    def __repr__(self) -> str:
        return self.value


ROT3, POSE3 = LieGroup.ROT3, LieGroup.POSE3
# What a block's variable is: ROT3 (gtsam.Rot3), POSE3 (gtsam.Pose3) or a vector of so many numbers.
Block = LieGroup | int
# Measurements on which a model is tried.
_CHECKED = 100
# Measurements evaluated together: the rows of 16,384 leave the processor's cache, which costs a quarter of the time.
TOGETHER = 4096
# Fields of sigmas, which may be infinite where nothing is known.
_SIGMAS = ("sigma",)
# Of a block: one variable that all measurements share, or one for each of them.
Keys = int | Sequence[int] | NDArray[np.integer]


class Stacked:
    """Dataclass with per-row fields, named by `stacked`; `[rows]` selects rows of all these."""

    def __getitem__(self, rows: Any) -> Self:
        """Select rows of all `stacked` fields."""
        return cast(Self, select_rows(self, rows))


class Model:
    """Measurement model: n measurements of m rows, predicted from blocks of variables. Base of vectorised models.

    A subclass, best a frozen dataclass, has

    - `time`: (n,) when each measurement was made, s;
    - `rows`: m, the rows of one measurement;
    - `blocks`: what its variables are, in the order in which they are called with, for example (ROT3, 12);
    - `__call__(*blocks)`: the whitened residuals (n, m) and a function of nothing that gives their Jacobians (n, m, d).

    A block arrives as (n, 4) quaternions w x y z, (n, 7) quaternions and translations, or (n, d) vectors. Its tangent
    has d = 3, 6 (rotation first, as in gtsam) or d numbers; rotations and poses are perturbed on the right.

    A dataclass whose `stacked` names the fields that hold something for each measurement may be evaluated together with
    others that agree in all other fields; `shapes` says what that is, () a number. Where `divisible` is false
    measurements of one factor are used or left out together.

    Fields annotated as Array take lists too. A dataclass raises ValueError when it is made of numbers that are not
    finite, of sigmas that are not above zero, or of arrays of other shapes.
    """

    divisible: ClassVar[bool] = True
    shapes: ClassVar[Mapping[str, tuple[int, ...]]] = {}

    def __post_init__(self) -> None:
        """Validate the fields of a new instance. Raises ValueError for an invalid one."""
        try:
            _make_sound(self)
        except ValueError as error:
            raise ValueError(f"{type(self).__name__}: {error}") from error

    @cached_property
    def in_parts(self) -> list[Self]:
        """The model in parts of `TOGETHER` measurements, each with its own precomputed constants; needs `stacked`."""
        return [select_rows(self, slice(k, k + TOGETHER)) for k in range(0, len(self.time), TOGETHER)]

    if TYPE_CHECKING:

        @property
        def time(self) -> Array:
            """Times of the measurements (n,), s."""

        @property
        def rows(self) -> int:
            """Number m of rows of a measurement."""

        @property
        def blocks(self) -> tuple[Block, ...]:
            """Kinds of the variable blocks."""

        def __call__(self, *blocks: Any, **_: Any) -> Residuals:
            """Return whitened residuals (n, m), and a function that gives their Jacobians (n, m, d) by each block."""

    def without_noise(self, *_: Any) -> Model:
        """Return the model at the nearest measurements without noise, where its effect on the Jacobians matters."""
        return self

    def at_noise(self, _: Array) -> Model:
        """Return the model where noise sigmas are 1 / weights (n, m) times those stated; itself if it needs none."""
        return self

    def on(
        self,
        *keys: Keys,
        loss: TruncatedLoss | None = None,
        noise: gtsam.noiseModel.Base | None = None,
    ) -> BoundModel:
        """Bind the model to variables; the result's `factor` is for gtsam graphs.

        Args:
            keys: for each block one key that all measurements share, or a key for each of the n.
            loss: how outlying measurements are weighed; None counts all in full.
            noise: Gaussian, of one measurement's m rows, for a model whose residuals are not whitened.

        Raises:
            ValueError: keys, noise or the model's own blocks do not fit.
        """
        from alidade.factors.bridge import BoundModel

        return BoundModel(self, keys, loss, noise)


@dataclass(frozen=True)
class WrappedModel(Model):
    """Model that wraps another one, and by default has its measurements, rows and blocks.

    Attributes:
        model: the other one.
    """

    model: Any

    @property
    def time(self) -> Array:
        """Times of the measurements (n,), s."""
        return np.asarray(self.model.time)

    @property
    def rows(self) -> int:
        """Number of rows of a measurement."""
        return int(self.model.rows)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Kinds of the variable blocks."""
        return tuple(self.model.blocks)

    def at_noise(self, weights: Array) -> Model:
        """Return the wrapper around its model where noise sigmas are 1 / weights (n, m) times those stated."""
        model = self.model.at_noise(weights)
        return self if model is self.model else replace(self, model=model)

    @property
    def sqrt_information(self) -> Array:
        """Square-root information (n, m, m) of the measurements, if the wrapped model has it."""
        return np.asarray(self.model.sqrt_information)


def width(block: Block) -> int:
    """Number of values that represent one variable in a model's input."""
    return block if isinstance(block, int) else {ROT3: 4, POSE3: 7}[block]


def dimension(block: Block) -> int:
    """Dimension of a variable's tangent space."""
    return block if isinstance(block, int) else {ROT3: 3, POSE3: 6}[block]


def retract(values: Array, block: Block, delta: Array) -> Array:
    """Retract variables (n, width) along tangent vectors (dimension,) or (n, dimension)."""
    if block is ROT3:
        return so3.multiply(values, so3.exp(delta))
    if block is POSE3:
        turned = so3.multiply(values[..., :4], so3.exp(delta[..., :3]))
        return np.concatenate([turned, values[..., 4:] + so3.rotate(values[..., :4], delta[..., 3:])], axis=-1)
    return values + delta


def check(model: Model) -> None:
    """Evaluate a model once near the origin, to verify the declared shapes of residuals and Jacobians.

    Of many measurements that may be evaluated by themselves a hundred are tried.

    Raises:
        ValueError: they are not; says what differs.
    """
    if len(model.time) > _CHECKED and hasattr(model, "stacked"):
        model = select_rows(model, np.arange(_CHECKED))
    name, n, m = type(model).__name__, len(model.time), model.rows
    rng = np.random.default_rng(0)
    # Not at the origin itself, where matrices made of a block's numbers would be singular.
    near = [1e-3 * rng.standard_normal((n, dimension(block))) for block in model.blocks]
    start = [_origin(block, n) for block in model.blocks]
    blocks = [retract(at, block, delta) for at, block, delta in zip(start, model.blocks, near, strict=True)]
    try:
        with np.errstate(all="ignore"):
            residuals, linearize = model(*blocks)
            jacobians = linearize()
    except (TypeError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{name} cannot be evaluated with its blocks {list(model.blocks)}: {error}") from error
    if np.shape(residuals) != (n, m):
        raise ValueError(f"{name} of {n} measurements with {m} rows gives residuals of shape {np.shape(residuals)}")
    if len(jacobians) != len(model.blocks):
        raise ValueError(f"{name} declares {len(model.blocks)} blocks and gives {len(jacobians)} Jacobians")
    for i, (block, jacobian) in enumerate(zip(model.blocks, jacobians, strict=True)):
        if np.shape(jacobian) != (n, m, dimension(block)):
            raise ValueError(
                f"{name} declares block {i} as {block!r}: its Jacobian must have shape {(n, m, dimension(block))}, "
                f"not {np.shape(jacobian)}"
            )


def _make_sound(model: Any) -> None:
    """Convert a model's array fields to float arrays, and raise ValueError for an invalid one."""
    for field in fields(model):
        name, value = field.name, getattr(model, field.name)
        if str(field.type).partition(" ")[0] == "Array" and value is not None:
            try:
                array = np.asarray(value, dtype=float)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{name} is no array of numbers ({error})") from error
            object.__setattr__(model, name, array)  # the dataclass may be frozen
            _require_numbers(name, array)
        elif name in _SIGMAS and isinstance(value, int | float):
            _require_numbers(name, np.array(value, dtype=float))
        elif isinstance(value, list):
            for i, each in enumerate(value):
                _require_numbers(f"{name}[{i}]", each)
        elif is_dataclass(value):
            for part in fields(value):
                _require_numbers(f"{name}.{part.name}", getattr(value, part.name))
    n = len(model.time)
    for name in {*model.shapes, *getattr(model, "stacked", ())}:
        value = getattr(model, name)
        if isinstance(value, np.ndarray):
            expected = (n, *model.shapes.get(name, value.shape[1:]))
            if value.shape != expected:
                raise ValueError(f"{name} of {n} measurements has shape {value.shape}, not {expected}")
        elif isinstance(value, list) and len(value) != n:
            raise ValueError(f"{name} of {n} measurements has {len(value)} parts")


def _require_numbers(name: str, array: Any) -> None:
    """Raise ValueError for an array with a number that is not finite, or a sigma that is not positive."""
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
        return
    is_sigma = name in _SIGMAS
    sound = array > 0.0 if is_sigma else np.isfinite(array)
    if sound.all():
        return
    at = tuple(np.argwhere(~sound)[0].tolist())
    where = f"{name}{list(at)}" if at else name
    needed = "sigmas are larger than 0" if is_sigma else "it must be finite"
    raise ValueError(f"{where} is {array[at]:g}; {needed}")


def stacking_key(model: Model) -> Hashable:
    """Key that is equal for models that `stack_models` can combine: those that differ in `stacked` fields only."""
    stacked = getattr(model, "stacked", None)
    if stacked is None:
        return id(model)
    declared: Any = model
    alike = tuple(_hashable(getattr(model, f.name)) for f in fields(declared) if f.name not in stacked)
    parts = [getattr(model, name) for name in stacked]
    each = tuple(stacking_key(part) if isinstance(part, Model) else part is None for part in parts)
    return type(model), alike, each, model.rows, model.blocks


def stack_models(parts: Sequence[Any]) -> Any:
    """Concatenate models, arrays or lists along their rows; of models the `stacked` fields."""
    first = parts[0]
    if first is None or len(parts) == 1:
        return first
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    if isinstance(first, list):
        return list(chain.from_iterable(parts))
    return replace(first, **{name: stack_models([getattr(part, name) for part in parts]) for name in first.stacked})


def select_rows(whole: Any, rows: Index | slice) -> Any:
    """Select rows of a model's measurements, of an array, or of a list."""
    if whole is None or isinstance(whole, np.ndarray):
        return whole if whole is None else whole[rows]
    if isinstance(whole, list):
        return whole[rows] if isinstance(rows, slice) else [whole[row] for row in rows]
    return replace(whole, **{name: select_rows(getattr(whole, name), rows) for name in whole.stacked})


def _hashable(value: Any) -> Hashable:
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


def _origin(block: Block, n: int) -> Array:
    out = np.zeros((n, width(block)))
    if isinstance(block, LieGroup):
        out[:, 0] = 1.0
    return out
