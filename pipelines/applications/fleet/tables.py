"""Tables as CSV and Parquet: rows are mappings, columns are those of all rows in the order of their first appearance.

Parquet by arro3: 12 MB to download and 35 installed, without dependencies, where pyarrow is 55 and 171.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

# What text begins with that spreadsheets take for a formula (OWASP, CSV injection); an apostrophe before it says text.
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")
Cell = str | int | float | None
Row = Mapping[str, Cell]


def csv_text(rows: Sequence[Row]) -> str:
    """Return rows as CSV: numbers with all digits, empty where a value is missing, no text that spreadsheets run."""
    stream = StringIO()
    writer = csv.DictWriter(stream, columns(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _inert(cell) for name, cell in row.items()} for row in rows)
    return stream.getvalue()


def _inert(cell: Cell) -> Cell:
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(_FORMULA) else cell


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write a Parquet file of columns of text, whole numbers or float64, null where a row has no value."""
    from arro3.core import Array, DataType, Table
    from arro3.io import write_parquet as write

    table: dict[str, Any] = {}
    for name in columns(rows):
        cells = [row.get(name) for row in rows]
        kinds = {type(cell) for cell in cells if cell is not None}
        kind = DataType.utf8() if str in kinds else DataType.int64() if kinds == {int} else DataType.float64()
        if float in kinds:
            cells = [None if cell is None else float(cell) for cell in cells]
        table[name] = Array(cells, kind)
    write(Table.from_pydict(table), path)


def columns(rows: Sequence[Row]) -> list[str]:
    """Names of the columns of some rows, in the order of their first use."""
    return list(dict.fromkeys(name for row in rows for name in row))
