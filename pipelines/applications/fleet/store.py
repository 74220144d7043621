"""Results of many calibrations, kept as they come, and a calibration whose failure is a result.

A line of JSON is a result: an interrupted run continues where it stopped. A line that is no result, whatever it holds,
is passed over, and that result is made again.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationError

from alidade.pipelines.applications import exit_codes
from alidade.pipelines.errors import InputError

if TYPE_CHECKING:
    from alidade.pipelines.reports.result import Calibration

FILE = "results.jsonl"

Result = dict[str, Any]


def settings_key(*settings: Any) -> str:
    """A hash of everything besides the recording that a result depends on."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


class Store:
    """Results by name in `results.jsonl` of a folder; only those of the same settings count.

    Raises InputError when the folder cannot be written to, or another process keeps its results there.
    """

    def __init__(self, folder: Path, settings: str) -> None:
        self._path, self._settings = folder / FILE, settings
        self.results: dict[str, Result] = {}
        require_writable(folder)
        try:
            self._stream = self._path.open("a+b")
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{folder}: another process keeps its results there; give another folder") from error
        except OSError as error:
            raise InputError(f"{self._path}: cannot be written ({error.strerror})") from error
        self._load()

    def add(self, name: str, result: Result) -> None:
        """Keep a result, in the file before this returns."""
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
            except ValidationError:
                continue  # cut off when the machine went down, or another's; that one is done again
            if entry.settings == self._settings:
                self.results[entry.name] = entry.result
        if not line.endswith(b"\n"):
            self._stream.write(b"\n")
            self._stream.flush()


class _Entry(BaseModel):
    """A line of the file."""

    model_config = ConfigDict(strict=True)

    settings: str
    name: str
    result: Result


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


def run_isolated(summarise: Callable[[Calibration], Result], calibrate: Callable[[], Calibration]) -> Result:
    """Status, exit code, reason, seconds of wall time, and what `summarise` takes of the calibration. Never raises."""
    from alidade.pipelines.solvers.chain import IndeterminateError

    try:
        calibration = calibrate()
        return {
            "status": calibration.status,
            "exit_code": exit_codes.OF_STATUS[calibration.status],
            "reason": "" if calibration.status == "calibrated" else calibration.headline,
            "seconds": sum(calibration.timing.values()),
            **summarise(calibration),
        }
    except InputError as error:
        return failure(exit_codes.BAD_INPUT, str(error))
    except IndeterminateError as error:
        return failure(exit_codes.UNDETERMINED, str(error))
    except Exception as error:
        return failure(exit_codes.CRASHED, f"{type(error).__name__}: {error}")


def failure(exit_code: int, reason: str) -> Result:
    """The result of what came to no estimate."""
    return {"status": "failed", "exit_code": exit_code, "reason": " ".join(reason.split()), "parameters": {}}


def quarantined() -> Result:
    """The result of what killed its workers."""
    return failure(exit_codes.KILLED, "killed its worker each time it was tried, at last alone; quarantined")
