"""Tables: columns of numbers in a text file, however it is written, trajectories in TUM's form, messages of any type.

How a table is written is read off its own lines: the delimiter and the decimal mark are those that make most of its
cells numbers; the header is the last line of words ahead of the first row of numbers; what stands before it (names of
devices, dates, comments) is the preamble. A line of units below the header belongs to it.

Of messages, as a laboratory's own, each is a row, each number and word in it a column, described as those of a file:

    columns:
      /imu: {file: /fmu/out/sensor_combined, time: timestamp, unit: us, gyro: ['gyro_rad[0]', 'gyro_rad[1]', ...]}

Their last column, log_time, is that of the times at which they were recorded, unless they have a field of that name.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array, Stamps
from alidade.pipelines.errors import InputError, NotARecordingError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import ArrayContainer
from alidade.pipelines.recording.container import Container, MessageBlock
from alidade.pipelines.recording.decoding import FIRST_MESSAGES, LOG_TIME, MessageFormat, formats_of
from alidade.pipelines.recording.messages import SENSORS, MessageError
from alidade.pipelines.recording.table_values import TIME_NAME, bare_name, nanoseconds, unit_hinted, unit_in, unit_named

# Texts of a table's cells by the names of their columns.
Columns = dict[str, NDArray[np.str_]]

_TUM = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
# A line of a table of sensors is shorter, and has fewer columns.
_LONGEST_LINE, MOST_COLUMNS = 1 << 16, 1000
# How a table is written is looked for in so much of its beginning, B, and so many of its lines.
_HEAD, _SAMPLE = 1 << 18, 200
# Numbers of a row that begins with a word, at least: a vector.
_LEAST_LABELLED = 3
# Least share of rows that are numbered one after the other where rows are numbered: some are lost.
_COUNTED = 0.8
# Rows whose cells are kept as Python's strings at once.
_BLOCK = 1 << 16
# Rows cut short, as by a logger that lost power, are dropped up to this share of all.
_MOST_CUT = 0.01
_BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_COMMENTS = ("#", "//", "%")
# What a cell without a number holds, lower case.
_ABSENT = {"", "nan", "na", "n/a", "null", "none", "-", "--"}
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?", re.IGNORECASE)
# Bytes of a message beyond which its numbers are those of a picture or a scan; a pose with covariances has 400.
_LARGEST_MESSAGE = 1 << 14
# ns since 1970, of 1973.
_UNIX_NS = 10**17
_CLOCK = re.compile(r"(\d{4}-\d\d-\d\d[T ])?\d{1,2}:\d\d(:\d\d([.,]\d+)?)?( ?(Z|UTC|[+-]\d\d:?\d\d))?")


@dataclass(frozen=True)
class TableHead:
    """Names and units of the columns of a table of sensor readings, and the lines above the table.

    Attributes:
        names: of its columns; `column 1` and so on where it has no header.
        units: of its columns as the header has them, in the words of `table_values.UNITS`; empty where it says nothing.
        preamble: what stands ahead of the header.
    """

    path: Path
    names: tuple[str, ...]
    units: tuple[str, ...]
    preamble: tuple[str, ...]

    def index(self, name: str) -> int:
        """Number of the column of a name, or of `column 3`. Raises InputError where none or several have it."""
        found = [i for i, one in enumerate(self.names) if one == name]
        numbered = re.fullmatch(r"column (\d+)", name)
        if not found and numbered and 0 < int(numbered[1]) <= len(self.names):
            found = [int(numbered[1]) - 1]
        if not found:
            raise InputError(f"{self.path}: no column {name}; the columns are {', '.join(self.names)}")
        if len(found) > 1:
            places = " and ".join(f"`column {i + 1}`" for i in found)
            raise InputError(f"{self.path}: {len(found)} columns are called {name}; name one of them as {places}")
        return found[0]

    def called(self, columns: Sequence[int]) -> list[str]:
        """Return what `index` finds columns by: names, and numbers in place of names that occur twice."""
        return [self.names[i] if self.names.count(self.names[i]) == 1 else f"column {i + 1}" for i in columns]

    def stated_unit(self, i: int) -> str:
        """Return the unit of a column by the header; empty where there is none."""
        return self.units[i] or unit_hinted(self.names[i])


@dataclass(frozen=True)
class TableForm(TableHead):
    """Format of a table in a text file: encoding, delimiter, decimal mark, columns.

    Attributes:
        delimiter: between cells; a blank stands for one or more.
        decimal: mark of a fraction, a point or a comma.
        first: number of lines ahead of its first row.
        width: cells of a row.
    """

    data: Path
    encoding: str
    delimiter: str
    decimal: str
    first: int
    width: int


def read_table(path: Path, data: Path) -> ArrayContainer:
    """Read a text file: a trajectory (TUM: `timestamp x y z qx qy qz qw`, s), or a table that the config describes."""
    form = table_form(path, data)
    if not form.width:
        # A file that grows may still have one.
        raise InputError(str(NotARecordingError.of(path, ": no line of numbers in it")))
    if (poses := _trajectory(form)) is not None:
        return ArrayContainer(path, {"/trajectory": poses})
    return CsvFile(form)


class CsvFile(ArrayContainer):
    """Container of a table; has no topics until `table_topics.described` assigns the columns."""

    def __init__(self, form: TableForm) -> None:
        columns = ", ".join(form.names[:40])
        assumed = f"a table with the columns {columns}; `columns:` in the config says which is what"
        super().__init__(form.path, {}, [assumed], form.data)
        self.name, self.form = form.path.name, form

    def read(self, names: Sequence[str], most: int | None = None) -> tuple[Columns, list[str], None]:
        """Return the named columns as texts, a sentence about each kind of row left out, and no log times."""
        return *read_columns(self.form, names, most), None


class MessageTable:
    """Table of the messages of the topic `name` of a container, with the formats of its channels by id."""

    def __init__(self, container: Container, name: str, formats: Mapping[int, MessageFormat]) -> None:
        self.name, self._container, self._formats = name, container, formats

    @property
    def is_proposed(self) -> bool:
        """Whether `info` may propose columns for the topic: its message type is unknown and no message is a picture."""
        is_small = self._first is not None and int(self._first.size.max(initial=0)) <= _LARGEST_MESSAGE
        return is_small and not any(each.type in SENSORS for each in self._formats.values())

    @cached_property
    def form(self) -> TableHead:
        """Names of the columns, those of the first messages. Raises InputError."""
        path = self._container.path / self.name.strip("/")
        first: dict[str, object] = {}
        if self._first is not None:
            try:
                for cells in islice(self._formats[self._first.channel].cells(self._first), FIRST_MESSAGES):
                    first = {**cells, **first}
            except MessageError as error:
                raise InputError(f"{self._container.path}: topic {self.name}: {error}") from error
        if len(first) > MOST_COLUMNS:
            raise InputError(f"{self._container.path}: topic {self.name}: its messages have {len(first)} fields")
        names = tuple(sorted(first, key=lambda name: name == LOG_TIME))
        # Integers so large can only be times in ns since 1970.
        times = {name for name, value in first.items() if isinstance(value, int) and value > _UNIX_NS}
        return TableHead(path, names, tuple("ns" if name in times else unit_in(name) for name in names), ())

    @cached_property
    def _first(self) -> MessageBlock | None:
        """First block of messages; None without any."""
        return next(self._container.blocks(set(self._formats)), None)

    def read(self, names: Sequence[str], most: int | None = None) -> tuple[Columns, list[str], Stamps]:
        """Return the named columns as texts (N,), empty where a message lacks the field, and log times (N,), Unix ns.

        Between them the list of sentences about rows left out, as tables of files have it: there are none. After `most`
        messages no more are looked at. Raises InputError when a column is missing, or a message cannot be read.
        """
        wanted = [self.form.names[self.form.index(name)] for name in names]
        parts: list[list[NDArray[np.str_]]] = []
        logged = [np.empty(0, np.int64)]
        for block in self._container.blocks(set(self._formats)):
            try:
                parts.append(self._formats[block.channel].texts(block, wanted))
            except MessageError as error:
                raise InputError(f"{self._container.path}: topic {self.name}: {error}") from error
            logged.append(block.log_ns)
            if most is not None and sum(map(len, logged)) >= most:
                break
        texts = [np.concatenate(column) for column in zip(*parts, strict=True)] or [np.empty(0, np.str_)] * len(names)
        return dict(zip(names, texts, strict=True)), [], np.concatenate(logged)


def looks_like_text(start: bytes) -> bool:
    """Whether the first bytes of a file are those of a text file."""
    if start.startswith(tuple(_BOMS)):
        return True
    return bool(start) and not any(byte < 32 and byte not in b"\t\n\r\f" for byte in start)


def table_form(path: Path, data: Path) -> TableForm:
    """Return the format of a table from the start of its file. Raises InputError for a file that is no table."""
    with data.open("rb") as stream:
        start = stream.read(_HEAD)
    encoding = _encoding(start)
    text = start.decode(encoding, errors="replace")
    lines = text.splitlines()
    # The last line may be cut.
    lines = lines[:-1] if len(start) == _HEAD else lines
    if "\0" in text or not lines or max(map(len, lines)) > _LONGEST_LINE:
        raise NotARecordingError.of(path)
    delimiter, decimal = _separators(lines)
    cells = [_cells(line, delimiter) for line in lines]
    if max(map(len, cells)) > MOST_COLUMNS:
        raise NotARecordingError.of(path)
    sample = [row for row in cells[-_SAMPLE:] if any(row)]
    usual = Counter((len(row), _begins_with_value(row)) for row in sample).most_common(1)[0][0] if sample else (0, True)
    first = next((i for i, row in enumerate(cells) if _is_row(row, usual) and not _is_comment(lines[i])), len(lines))
    width = len(cells[first]) if first < len(lines) else 0
    header, units = _header(lines[:first], delimiter, width)
    if not width and header is None:
        raise NotARecordingError.of(path, ": no line of numbers in it")
    if header is None and delimiter == ",":
        _check_decimal_commas(path, lines[:first], width)
    names = (
        [f"column {i + 1}" for i in range(width)] if header is None else _cells(_uncommented(lines[header]), delimiter)
    )
    stated = [unit_named(cell) for cell in _cells(lines[units], delimiter)] if units is not None else []
    if header is not None and _lacks_first_name(names, cells[first:], width):
        names = ["row", *names]
        stated = ["", *stated] if len(stated) < width else stated
    names = names[:-1] if len(names) > 1 and not names[-1] else names
    stated += [""] * (len(names) - len(stated))
    return TableForm(
        path,
        tuple(names),
        tuple(unit_in(name) or unit for name, unit in zip(names, stated, strict=False)),
        tuple(line.strip() for line in lines[: first if header is None else header] if line.strip()),
        data,
        encoding,
        delimiter,
        decimal,
        first,
        min(width, len(names)),
    )


def _lacks_first_name(names: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> bool:
    """Whether the header of a table lacks the name of its first column, which numbers the rows.

    It is one name short then, and its first name is that of a time.
    """
    whole = [row for row in rows[:_SAMPLE] if len(row) == width]
    if len(names) != width - 1 or len(whole) < 2 or not TIME_NAME.search(bare_name(names[0])):
        return False
    if not all(row[0].isdigit() and row[-1] for row in whole):
        return False
    return bool(np.mean(np.diff([int(row[0]) for row in whole]) == 1) > _COUNTED)


def _check_decimal_commas(path: Path, above: Sequence[str], width: int) -> None:
    """Raise InputError for rows of about twice as many cells as names: commas mark the decimals too."""
    names = _cells(_uncommented(next((line for line in reversed(above) if line.strip()), "")), ",")
    if len(names) > 2 and width in (2 * len(names) - 1, 2 * len(names)):
        raise InputError(
            f"{path}: commas separate columns and mark decimals, {len(names)} names over {width} cells: write it with "
            "semicolons between columns, or with decimal points"
        )


def read_columns(form: TableForm, names: Sequence[str], most: int | None = None) -> tuple[Columns, list[str]]:
    """Return the named columns as texts, row by row, and sentences about rows that are left out.

    Decimal marks are points, what stands for no number is empty. Headers that are repeated, blank lines and comments
    are no rows; a last row that is cut short is left out, and so are others up to 1 % of all. At most `most` rows are
    looked at.

    Raises:
        InputError: a column is missing, or more rows are too short; the first of them is named.
    """
    wanted = [form.index(name) for name in names]
    blocks: list[list[NDArray[np.str_]]] = [[] for _ in wanted]
    rows: list[list[str]] = []
    cut: list[tuple[int, int]] = []
    count, headers, needed = 0, 1, max(form.width, *(i + 1 for i in wanted))

    def close() -> None:
        """Store the rows so far as arrays: a cell in a list takes several times its place there."""
        for i, block in enumerate(blocks):
            block.append(np.array([row[i] for row in rows], dtype=np.str_))
        rows.clear()

    for number, row in islice(_rows(form), most):
        if len(row) < needed:
            cut.append((number, len(row)))
        elif row[: len(form.names)] == list(form.names[: len(row)]):
            headers += 1
        else:
            count += 1
            rows.append([row[i] for i in wanted])
            if len(rows) == _BLOCK:
                close()
    close()
    if len(cut) > max(1, _MOST_CUT * count):
        number, width = cut[0]
        raise InputError(f"{form.path}: line {number} has {width} columns instead of {needed}")
    notes = [f"{form.path.name}: rows cut short, the first in line {cut[0][0]}: {len(cut)} left out"] if cut else []
    if headers > 1:
        notes.append(f"{form.path.name}: its header is there {headers} times, as of a logger that was started again")
    columns = [np.concatenate(blocks.pop(0)) for _ in wanted]
    if form.decimal == ",":
        columns = [np.char.replace(column, ",", ".") for column in columns]
    return dict(zip(names, columns, strict=True)), notes


def numbers(path: Path, columns: Mapping[str, NDArray[np.str_]], names: Sequence[str]) -> Array:
    """Convert columns to numbers (N, len(names)), NaN for missing ones. Raises InputError, naming the cell, at text."""
    return np.column_stack([_numbers(path, name, columns[name]) for name in names])


def _numbers(path: Path, name: str, texts: NDArray[np.str_]) -> Array:
    try:
        return np.where(texts == "", "nan", texts).astype(float)
    except ValueError:
        pass
    out = np.full(len(texts), np.nan)
    for i, cell in enumerate(texts.tolist()):
        if cell.lower() not in _ABSENT:
            try:
                out[i] = float(cell)
            except ValueError:
                raise InputError(f"{path}: row {i + 1}, column {name}: {cell[:40]!r} is no number") from None
    return out


def numbers_or_times(texts: NDArray[np.str_]) -> NDArray[np.bool_]:
    """Mask (N,) of the cells of a column that hold something, neither empty nor a placeholder for no number."""
    return ~np.isin(np.char.lower(texts), list(_ABSENT))


def _encoding(start: bytes) -> str:
    for mark, encoding in _BOMS.items():
        if start.startswith(mark):
            return encoding
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _separators(lines: Sequence[str]) -> tuple[str, str]:
    """Return the delimiter and decimal mark by which most cells in a sample of lines are numbers."""
    sample = [line for line in lines if line.strip() and not _is_comment(line)][-_SAMPLE:]
    best = (0, ",", ".")
    for delimiter in ("\t", ";", ",", "|", " "):
        rows = [_cells(line, delimiter) for line in sample]
        width, _ = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        cells = [cell for row in rows if len(row) == width for cell in row]
        filled = [cell for cell in cells if cell.lower() not in _ABSENT]
        score = sum(1 if _is_value(cell) else -1 for cell in filled)
        if width > 1 and score > best[0]:
            comma = delimiter != "," and any("," in cell for cell in filled if _NUMBER.fullmatch(cell))
            best = (score, delimiter, "," if comma else ".")
    return best[1], best[2]


def _header(lines: Sequence[str], delimiter: str, width: int) -> tuple[int | None, int | None]:
    """Return the line numbers of the header and of the line of units above the first row; None where missing."""
    there = [i for i, line in enumerate(lines) if line.strip()]
    found: list[int] = []
    for i in reversed(there):
        cells = _cells(_uncommented(lines[i]), delimiter)
        # A header may lack the names of last columns, and end with a delimiter where rows do not.
        if (width and len(cells) not in (width - 1, width, width + 1)) or len(cells) < (2 if width != 1 else 1):
            break
        if any(map(_is_value, filter(None, cells))):
            break
        found.append(i)
        if len(found) == 2 or not _are_units(cells):
            break
    if not found:
        return None, None
    if len(found) == 2 and _are_units(_cells(_uncommented(lines[found[0]]), delimiter)):
        return found[1], found[0]
    return found[0], None


def _are_units(cells: Sequence[str]) -> bool:
    """Whether most cells that are not empty name units; others may be of a vendor's own (`local_flux`)."""
    filled = [cell for cell in cells if cell]
    return 2 * sum(bool(unit_named(cell)) for cell in filled) > len(filled)


def _rows(form: TableForm) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the stripped cells of each row; skips blank lines and comments."""
    with form.data.open(encoding=form.encoding, errors="replace", newline=None) as stream:
        for _ in range(form.first):
            stream.readline()
        reader = csv.reader(stream, delimiter=form.delimiter, skipinitialspace=True)
        try:
            for row in reader:
                cells = [cell.strip() for cell in row]
                while len(cells) > len(form.names) and not cells[-1]:
                    cells.pop()
                if any(cells) and not cells[0].startswith(_COMMENTS):
                    yield form.first + reader.line_num, cells
        except csv.Error as error:
            raise InputError(f"{form.path}: line {form.first + reader.line_num}: no table ({error})") from error


def _cells(line: str, delimiter: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    except csv.Error:
        return [line]


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _uncommented(line: str) -> str:
    return line.lstrip().lstrip("#/%").strip() if _is_comment(line) else line


def _is_row(cells: Sequence[str], usual: tuple[int, bool]) -> bool:
    """Whether most cells are numbers, times or empty, and as many as in half of a usual row at least.

    What begins with a word is one, and no line of a preamble, if rows usually do: with as many cells, three numbers or
    more among them.
    """
    filled = [cell for cell in cells if cell.lower() not in _ABSENT]
    values = sum(map(_is_value, filled))
    if not filled or 2 * values < len(filled) or 2 * len(cells) < usual[0]:
        return False
    return _begins_with_value(cells) or (values >= _LEAST_LABELLED and usual == (len(cells), False))


def _begins_with_value(cells: Sequence[str]) -> bool:
    """Whether the first cell of a row that holds something is a number or a time."""
    return _is_value(next((cell for cell in cells if cell.lower() not in _ABSENT), ""))


def _is_value(cell: str) -> bool:
    return _NUMBER.fullmatch(cell) is not None or _CLOCK.fullmatch(cell) is not None


def _trajectory(form: TableForm) -> series.PoseSeries | None:
    """Read a TUM trajectory, eight columns separated by blanks, the last four a unit quaternion; else None."""
    if form.delimiter != " " or len(form.names) != len(_TUM):
        return None
    _, first = next(_rows(form), (0, []))
    try:
        if len(first) != len(_TUM) or not abs(float(np.linalg.norm([float(x) for x in first[4:]])) - 1.0) < 0.01:
            return None
    except ValueError:
        return None
    texts, _ = read_columns(form, [f"column {i + 1}" for i in range(len(_TUM))])
    columns = dict(zip(_TUM, texts.values(), strict=True))
    position, xyzw = (numbers(form.path, columns, names) for names in (_TUM[1:4], _TUM[4:]))
    return series.PoseSeries(nanoseconds(form.path, columns["t"], "s"), xyzw[:, [3, 0, 1, 2]], position)


def message_tables(container: Container) -> dict[str, MessageTable]:
    """Return the topics of a recording as tables, by name."""
    formats: dict[str, dict[int, MessageFormat]] = {}
    for number, found in formats_of(container).items():
        if found.is_parsed and container.counts.get(number):
            formats.setdefault(container.channels[number].topic, {})[number] = found
    return {name: MessageTable(container, name, own) for name, own in formats.items()}
