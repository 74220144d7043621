"""Store of the results of many calibrations, written as they come; a failed calibration is a result as well.

A line of JSON is a result: an interrupted run continues where it stopped. A line that is no result, whatever it holds,
is passed over, and that result is made again.

Tables of results have rows that are mappings, and the columns of all rows in the order of their first appearance.
"""

from __future__ import annotations

import csv
import fcntl
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, Required, Self, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from typing_extensions import TypedDict  # pydantic needs it below Python 3.12, and brings it

from alidade.pipelines import errors
from alidade.pipelines.errors import IndeterminateError, InputError

if TYPE_CHECKING:
    from alidade.pipelines.reports.result import Calibration


FILE = "results.jsonl"

Result = TypeVar("Result")
RunStatus = Literal["calibrated", "weak", "unobservable", "inconsistent", "failed"]


class ParameterNumbers(TypedDict):
    """Value, sigma and verdict of a parameter of one recording; SI."""

    value: float
    sigma: float
    unit: str
    require: float | None
    verdict: str | None
    inflation: float


class _Calibrated(TypedDict, total=False):
    """Result of a recording's calibration; without an estimate, a reason and no parameters."""

    status: Required[RunStatus]
    exit_code: Required[int]
    reason: Required[str]  # empty where it is calibrated
    parameters: Required[dict[str, ParameterNumbers]]
    seconds: float  # wall time
    sha256: str  # absent where the file could not be read: it is tried again
    prior_sha256: str | None
    tag: str | None  # what a listing says of the file, by which it is known to be unchanged
    start_ns: int  # Unix
    duration_s: float
    method: str
    device: dict[str, float]  # parameter of the device: walk in the root of a day
    told: str  # information about the parameters, see `histories.packed`


class RecordingResult(_Calibrated, total=False):
    """Result of a recording as it is kept, with unit and date as the recording's metadata state them."""

    unit: str
    date: str


class UnitResult(_Calibrated, total=False):
    """Result of a recording with its unit and date, Unix s; the date is None where unknown."""

    unit: Required[str]
    date: Required[float | None]


class ParameterError(TypedDict):
    """Error of a parameter in a simulated run; SI."""

    error: float
    sigma: float
    unit: str
    require: float | None


class RunResult(TypedDict, total=False):
    """One solver's result of a simulated run."""

    status: Required[RunStatus]
    exit_code: Required[int]
    reason: Required[str]
    parameters: Required[dict[str, ParameterError]]
    seconds: float
    nees: float
    dof: int
    chi_square: float
    chi_square_dof: float


def settings_key(*settings: Any) -> str:
    """A hash of everything besides the recording that a result depends on."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


class Store(Generic[Result]):
    """Results of one kind by name, in `results.jsonl` of a folder; those of other settings are ignored.

    A context manager: without any result it leaves neither the file nor the folders that it made.

    Raises InputError when the folder cannot be written to, or another process keeps its results there.
    """

    def __init__(self, folder: Path, settings: str, kind: type[Result]) -> None:
        self._path, self._settings, self._kind = folder / FILE, settings, TypeAdapter(kind)
        self.results: dict[str, Result] = {}
        self._made = [each for each in (folder, *folder.parents) if not each.exists()]
        require_writable(folder)
        try:
            self._stream = self._path.open("a+b")
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{folder}: another process keeps its results there; give another folder") from error
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written ({error.strerror})") from error
        self._load()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if os.fstat(self._stream.fileno()).st_size:
            return
        with suppress(OSError):  # another has put something there, or taken it away
            self._path.unlink()
            for folder in self._made:
                folder.rmdir()

    def add(self, name: str, result: Result) -> None:
        """Append a result to the file, and flush the file before returning."""
        line = json.dumps({"settings": self._settings, "name": name, "result": result}, allow_nan=False)
        try:
            self._stream.write(line.encode() + b"\n")
            self._stream.flush()
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written ({error.strerror}); the same command goes on") from error
        self.results[name] = result

    def _load(self) -> None:
        line = b"\n"
        self._stream.seek(0)
        for line in self._stream:
            try:
                entry = _Entry.model_validate_json(line)
                if entry.settings == self._settings:
                    self.results[entry.name] = self._kind.validate_python(entry.result)
            except ValidationError:
                continue  # cut off when the machine went down, or another's; that one is done again
        if not line.endswith(b"\n"):
            self._stream.write(b"\n")
            self._stream.flush()


class _Entry(BaseModel):
    """Line of `results.jsonl`: a result, its name, and the hash of its settings."""

    model_config = ConfigDict(strict=True)

    settings: str
    name: str
    result: dict[str, Any]


def require_writable(folder: Path) -> None:
    """Make the folder; raises InputError when it cannot be made or written to, or is an address such as s3://bucket."""
    if re.match(r"\w+:/", str(folder)):
        raise InputError(f"{folder}: results are kept in a folder of this machine, to be copied from there")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: no folder to write results to ({os.strerror(error.errno or 0)})") from error


def run_isolated(summarise: Callable[[Calibration], dict[str, Any]], calibrate: Callable[[], Calibration]) -> Any:
    """Run a calibration; return status, exit code, reason, wall time, s, and the keys of `summarise`."""
    try:
        calibration = calibrate()
        return {
            "status": calibration.status,
            "exit_code": errors.EXIT_OF_STATUS[calibration.status],
            "reason": "" if calibration.status == "calibrated" else calibration.headline,
            "seconds": sum(calibration.timing.values()),
            **summarise(calibration),
        }
    except InputError as error:
        return failure(errors.EXIT_BAD_INPUT, str(error))
    except IndeterminateError as error:
        return failure(errors.EXIT_UNDETERMINED, str(error))
    except Exception as error:
        return failure(errors.EXIT_CRASHED, f"{type(error).__name__}: {error}")


def failure(exit_code: int, reason: str) -> Any:
    """Return the result of a calibration that gave no estimate."""
    return {"status": "failed", "exit_code": exit_code, "reason": " ".join(reason.split()), "parameters": {}}


def quarantined() -> Any:
    """The result recorded for a calibration that killed its workers."""
    return failure(errors.EXIT_KILLED, "killed its worker each time it was tried, at last alone; quarantined")


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
    """Write a Parquet file of columns of text, whole numbers or float64, null where a row has no value.

    By arro3: 12 MB to download and 35 installed, without dependencies, where pyarrow is 55 and 171.
    """
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
