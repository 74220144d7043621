"""Tables as recordings: CSV with columns that the config describes, and trajectories in TUM's form."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.arrays import ArrayContainer

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

# Nanoseconds of a unit of time.
TIME_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}
_TUM = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
# A line of a table of sensors is shorter, and has fewer columns.
_LONGEST_LINE, _MOST_COLUMNS = 1 << 16, 1000


def read_table(path: Path, data: Path) -> ArrayContainer:
    """A trajectory (TUM: `timestamp x y z qx qy qz qw`, s), or a CSV file, whose topics the config has to describe.

    Args:
        path: as it was named.
        data: the file to read.
    """
    head = _head(path, data)
    if "," not in head and ";" not in head and len(head.split()) == len(_TUM):
        return ArrayContainer(path, {"/trajectory": _trajectory(path, data)})
    columns = ", ".join(column_names(path, data)[:40])
    return CsvFile(path, data, [f"a table with the columns {columns}; `columns:` in the config says which is what"])


class CsvFile(ArrayContainer):
    """A CSV file; without topics until `described` says which column is what."""

    def __init__(self, path: Path, data: Path, remarks: Sequence[str] = ()) -> None:
        super().__init__(path, {}, remarks)
        self.data = data


def column_names(path: Path, data: Path) -> list[str]:
    """Names of the columns: the first line, without a leading `#`; `column 1` and so on where that is of numbers."""
    names = [name.strip() for name in next(csv.reader([_head(path, data).lstrip("#")]), [])]
    return [f"column {i}" for i in range(1, len(names) + 1)] if _are_numbers(names) else names


def read_columns(path: Path, data: Path, names: Sequence[str]) -> dict[str, NDArray[np.str_]]:
    """The named columns as texts, row by row. Raises InputError at one that is missing and a row that is too short."""
    there = column_names(path, data)
    lacking = [name for name in names if name not in there]
    if lacking:
        raise InputError(f"{path}: no column {lacking[0]}; the columns are {', '.join(there)}")
    wanted = [there.index(name) for name in names]
    rows: list[list[str]] = []
    first = 0 if there[:1] == ["column 1"] else 1
    with data.open(encoding="utf-8", errors="replace", newline="") as stream:
        try:
            for number, row in enumerate(itertools.islice(csv.reader(stream), first, None), start=first + 1):
                if not row or row[0].startswith("#"):
                    continue
                if len(row) < len(there):
                    raise InputError(f"{path}: line {number} has {len(row)} columns instead of {len(there)}")
                rows.append([row[i].strip() for i in wanted])
        except csv.Error as error:
            raise InputError(f"{path}: no CSV ({error})") from error
    table = np.array(rows, dtype=np.str_).reshape(len(rows), len(names))
    return {name: table[:, i] for i, name in enumerate(names)}


def nanoseconds(path: Path, texts: NDArray[np.str_], unit: str) -> Stamps:
    """Times as written, exactly, as integer ns. Raises InputError at one that is no number."""
    size = TIME_UNITS[unit]
    try:
        if size == 1:
            return texts.astype(np.int64)
        whole, _, rest = np.char.partition(texts, ".").T
        digits = len(str(size)) - 1
        exact = ~np.char.isdigit(np.char.lstrip(whole, "-")) | ~(np.char.isdigit(rest) | (rest == ""))
        if exact.any():  # with an exponent, say
            return np.rint(texts.astype(float) * size).astype(np.int64)
        fraction = np.array([one[:digits].ljust(digits, "0") for one in rest.tolist()], dtype=np.int64)
        sign = np.where(np.char.startswith(whole, "-"), -1, 1)
        return whole.astype(np.int64) * size + sign * fraction
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: a time that is no number in {unit} ({error})") from error


def numbers(path: Path, columns: Mapping[str, NDArray[np.str_]], names: Sequence[str]) -> Array:
    """Columns as numbers (N, len(names)); what is empty is NaN. Raises InputError at what is no number."""
    table = np.stack([columns[name] for name in names], axis=1)
    try:
        return np.where(table == "", "nan", table).astype(float)
    except ValueError as error:
        raise InputError(f"{path}: columns {', '.join(names)}: {error}") from error


def _are_numbers(texts: Sequence[str]) -> bool:
    try:
        return len([float(text) for text in texts]) > 0
    except ValueError:
        return False


def _trajectory(path: Path, data: Path) -> series.PoseSeries:
    rows = []
    for number, line in enumerate(data.read_text(errors="replace").splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        row = line.split()
        if len(row) != len(_TUM):
            raise InputError(f"{path}: line {number} has {len(row)} columns instead of {len(_TUM)}: {' '.join(_TUM)}")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: a trajectory without a pose")
    columns: dict[str, Any] = dict(zip(_TUM, np.array(rows, dtype=np.str_).T, strict=True))
    xyzw = numbers(path, columns, _TUM[4:])
    return series.PoseSeries(
        nanoseconds(path, columns["t"], "s"), xyzw[:, [3, 0, 1, 2]], numbers(path, columns, _TUM[1:4])
    )


def _head(path: Path, data: Path) -> str:
    """The first line of a table; of one without names the first row."""
    with data.open(encoding="utf-8", errors="replace") as stream:
        line = stream.readline(_LONGEST_LINE + 1)
        while line.startswith("#") and "," not in line:
            line = stream.readline(_LONGEST_LINE + 1)
    if len(line) > _LONGEST_LINE or line.count(",") > _MOST_COLUMNS or "\0" in line:
        raise InputError(f"{path}: not a table, nor any other recording that is known")
    return line
