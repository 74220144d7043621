"""Shapes of the arrays of a method's data, from the annotations of their class.

    gyro_t: Numbers
    gyro: Rates
    gyro_cov: Covariances | None = None

A plain `Array` is one of any shape.
"""

from __future__ import annotations

import datetime
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError

# From so many rows on a component that never changes was not measured.
_MEASURED = 20


@dataclass(frozen=True)
class Rows:
    """Annotation of an array with one row for each stamp.

    Attributes:
        shape: of a row; None: any.
        unmeasured: components of a row that may be NaN, where they were not measured; of a covariance its rows and
            columns.
        unit: SI, of readings that are screened for faults, see `streams.screened`; empty: they are not.
        may_be_constant: whether all axes may read the same throughout.
    """

    shape: tuple[int, ...] | None = None
    unmeasured: tuple[int, ...] = ()
    unit: str = ""
    may_be_constant: bool = False

    def read(self, name: str, value: Any) -> Array:
        """Convert user input for the array called `name` to floats; masked values become NaN.

        Raises:
            InputError: it has anything but numbers, no rows, or rows of another shape.
        """
        try:
            array = np.asanyarray(value)  # masked ones as they are
            if array.dtype == object and array.size and not any(isinstance(one, str) for one in array.flat):
                array = array.astype(float)
        except (ValueError, TypeError) as error:
            raise InputError(f"{name} is no array: its rows differ in length{_odd_row(value)}") from error
        if array.dtype.kind not in "iuf":
            raise InputError(f"{name} has to be numbers, not {array.dtype.type.__name__.rstrip('_')}")
        if array.shape[:1] == (0,):
            raise InputError(f"{name} has no rows; what was not recorded is left out")
        if array.ndim == 0 or (self.shape is not None and array.shape[1:] != self.shape):
            needed = ", ".join(["N", *map(str, self.shape or ())])
            raise InputError(f"{name} has the shape {array.shape}; ({needed}) is needed")
        return np.asarray(np.ma.filled(array.astype(float, copy=False), np.nan))

    def lost(self, values: Array) -> NDArray[np.intp]:
        """Return the indexes of the rows in which a required component is not finite."""
        for axis in range(1, values.ndim) if self.unmeasured else ():
            values = np.delete(values, self.unmeasured, axis)
        return np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))

    def placeholders(self, values: Array) -> list[int]:
        """Return the optional components of the rows (N, n) that were not measured: they read one value throughout.

        A driver that measures two angles leaves the third as it is.
        """
        own = self.unmeasured if values.ndim == 2 and len(values) >= _MEASURED else ()
        return [i for i in own if np.ptp(values[:, i]) == 0.0]


Numbers = Annotated[Array, Rows(())]
Pairs = Annotated[Array, Rows((2,))]
Vectors = Annotated[Array, Rows((3,))]
Quaternions = Annotated[Array, Rows((4,))]
Covariances = Annotated[Array, Rows((3, 3))]
# Readings of gyros, those of a platform that may be parked, of accelerometers and of magnetometers.
Rates = Annotated[Array, Rows((3,), unit="rad/s")]
PlatformRates = Annotated[Array, Rows((3,), unit="rad/s", may_be_constant=True)]
Forces = Annotated[Array, Rows((3,), unit="m/s^2")]
Fields = Annotated[Array, Rows((3,), unit="T")]


def as_dates(value: Any) -> NDArray[np.int64] | None:
    """Convert dates, or times since a start, of numpy or pandas to integer ns (N,); None for anything else."""
    if isinstance(value, list | tuple):
        if not value or not isinstance(value[0], datetime.datetime | datetime.timedelta | np.datetime64):
            return None
        kind = "timedelta64[ns]" if isinstance(value[0], datetime.timedelta) else "datetime64[ns]"
        return np.array([_without_zone(one) for one in value], dtype=kind).astype(np.int64)
    if getattr(getattr(value, "dtype", None), "tz", None):  # of pandas, which numpy would have as objects
        value = getattr(value, "dt", value).tz_convert(None)
    values = np.asarray(value)
    return values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64) if values.dtype.kind in "mM" else None


def _without_zone(date: Any) -> Any:
    """Return a date converted to UTC, without its time zone."""
    return date.astimezone(datetime.UTC).replace(tzinfo=None) if getattr(date, "tzinfo", None) else date


def _odd_row(value: Any) -> str:
    """Return the end of a sentence about the first row whose length differs from row 0; empty if there is none."""
    try:
        lengths = [len(row) if hasattr(row, "__len__") else -1 for row in value]
    except TypeError:
        return ""
    at = next((i for i, length in enumerate(lengths) if length != lengths[0]), None)
    return "" if at is None else f": row {at} is {str(value[at])[:40]}"


def rows_by_name(kind: type) -> Mapping[str, Rows]:
    """Return the annotations of the array fields of a data class, by field name."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {name: rows for name, hint in hints.items() if (rows := _rows(hint)) is not None}


def _rows(hint: Any) -> Rows | None:
    if hint == Array:
        return Rows()
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return next((part for part in parts if isinstance(part, Rows)), _rows(parts[0]))
    if origin in (typing.Union, types.UnionType):
        return next(filter(None, map(_rows, parts)), None)
    return None
