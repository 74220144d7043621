"""Tables as data, drawn by a page, a notebook and a terminal.

Table("Poses", "Attitudes at rest.", ("pose", "duration, s"), (("1", "3.0"), ("2", "2.5")))
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        head: what stands above it.
        kind: "number" is aligned to the right, "text" to the left, "prose" may be broken into lines, "drawing" is shown
            by pages alone.
        group: columns of one group stay together where a terminal is too narrow for all.
        wide: cells take the whole width of a phone.
        label: in place of `head`, on a phone.
    """

    head: str
    kind: Literal["number", "text", "prose", "drawing"] = "number"
    group: str = ""
    wide: bool = False
    label: str = ""


@dataclass(frozen=True)
class Interval:
    """Sigma beside the required one, drawn as bars of +-2 about the value; all numbers in one unit.

    Attributes:
        sigma: standard deviation.
        require: the one required; None: none is.
        error: value less truth, where that is known.
        offset: of the value from the middle.
    """

    sigma: float
    require: float | None = None
    error: float | None = None
    offset: float = 0.0


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes:
        text: the content.
        small: in small print below: the meaning of a name, a number in SI.
        tone: a verdict, or good, warn, bad, which colours the text.
        shares: of a whole, drawn as a bar above the text.
        hint: what a page says where it is pointed at, and a screen reader in place of the text.
        interval: drawn in place of the text.
    """

    text: str
    small: str = ""
    tone: str = ""
    shares: tuple[float, ...] = ()
    hint: str = ""
    interval: Interval | None = None


Columns = tuple[Column | str, ...]
Row = tuple[Cell | str, ...]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: heading; empty where that of the section suffices.
        caption: what the table shows, with units.
        columns: a text is a column of numbers with that head; the first column has the names of the rows.
        rows: cells in the order of the columns; a single cell is a heading for the rows below it.
        id: of the HTML element.
        style: of style.css: dense, lines, many, columns.
        most_rows: a page collapses longer tables; None: never.
    """

    title: str
    caption: str
    columns: Columns
    rows: tuple[Row, ...]
    id: str = ""
    style: str = "lines"
    most_rows: int | None = 12

    @property
    def heads(self) -> tuple[Column, ...]:
        """Columns of the table; plain texts become Column."""
        return tuple(Column(each) if isinstance(each, str) else each for each in self.columns)

    @property
    def cells(self) -> tuple[tuple[Cell, ...], ...]:
        """Rows of the table; plain texts become Cell."""
        return tuple(tuple(Cell(each) if isinstance(each, str) else each for each in row) for row in self.rows)

    @property
    def is_folded(self) -> bool:
        """Whether a page collapses the table."""
        return self.most_rows is not None and len(self.rows) > self.most_rows
