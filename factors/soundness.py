"""What a model is made of, looked at when it is made: finite numbers of the stated shapes, sigmas above zero."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Fields of sigmas, which may be infinite where nothing is known.
_SIGMAS = ("sigma",)


def make_sound(model: Any, shapes: Mapping[str, tuple[int, ...]], stacked: Sequence[str]) -> None:
    """Make arrays of a dataclass's fields that hold numbers, and look at each.

    Args:
        model: a dataclass with `time`, (n,).
        shapes: field -> shape of what it holds for each of the n measurements.
        stacked: fields that hold something for each measurement.

    Raises:
        ValueError: in one line, which field of which model, and where in it.
    """
    for field in fields(model):
        value = getattr(model, field.name)
        if str(field.type).partition(" ")[0] == "Array" and value is not None:
            array = _array(model, field.name, value)
            if array is not value:
                object.__setattr__(model, field.name, array)  # the dataclass may be frozen
            _require_numbers(model, field.name, array)
        elif field.name in _SIGMAS and isinstance(value, int | float):
            _require_numbers(model, field.name, np.array(value, dtype=float))
        elif isinstance(value, list):
            for i, each in enumerate(value):
                if isinstance(each, np.ndarray):
                    _require_numbers(model, f"{field.name}[{i}]", each)
        elif is_dataclass(value):
            _require_parts(model, field.name, value)
    n = len(model.time)
    for name in {*shapes, *stacked}:
        value = getattr(model, name)
        if isinstance(value, np.ndarray):
            expected = (n, *shapes.get(name, value.shape[1:]))
            if value.shape != expected:
                raise ValueError(f"{_name(model)}: {name} of {n} measurements has shape {value.shape}, not {expected}")
        elif isinstance(value, list) and len(value) != n:
            raise ValueError(f"{_name(model)}: {name} of {n} measurements has {len(value)} parts")


def _array(model: Any, name: str, value: Any) -> NDArray[np.float64]:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{_name(model)}: {name} is no array of numbers ({error})") from error


def _require_numbers(model: Any, name: str, array: NDArray[Any]) -> None:
    is_sigma = name in _SIGMAS
    sound = array > 0.0 if is_sigma else np.isfinite(array)
    if sound.all():
        return
    at = tuple(np.argwhere(~sound)[0].tolist())
    where = f"{name}{list(at)}" if at else name
    needed = "sigmas are larger than 0" if is_sigma else "it must be finite"
    raise ValueError(f"{_name(model)}: {where} is {array[at]:g}; {needed}")


def _require_parts(model: Any, name: str, part: Any) -> None:
    for field in fields(part):
        value = getattr(part, field.name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            _require_numbers(model, f"{name}.{field.name}", value)


def _name(model: Any) -> str:
    return type(model).__name__
