"""What is finished, kept as it comes: a line of JSON a result, so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any

from alidade.pipelines.errors import InputError

FILE = "results.jsonl"

Result = dict[str, Any]


def settings_key(*settings: Any) -> str:
    """A hash of everything besides the recording that a result depends on."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


class Store:
    """Results by name in `results.jsonl` of a folder; only those of the same settings count.

    Raises InputError when the folder cannot be written to.
    """

    def __init__(self, folder: Path, settings: str) -> None:
        self._path, self._settings = folder / FILE, settings
        self.results: dict[str, Result] = {}
        require_writable(folder)
        if self._path.exists():
            self._load()

    def add(self, name: str, result: Result) -> None:
        """Keep a result, in the file before this returns."""
        line = json.dumps({"settings": self._settings, "name": name, "result": result}, allow_nan=False)
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(line + "\n")
        self.results[name] = result

    def _load(self) -> None:
        line = "\n"
        with self._path.open("r+", encoding="utf-8") as stream:
            for line in stream:
                try:
                    entry = json.loads(line)
                except json.JSONDecodeError:
                    continue  # cut off when the machine went down; that one is done again
                if entry["settings"] == self._settings:
                    self.results[entry["name"]] = entry["result"]
            if not line.endswith("\n"):
                stream.write("\n")


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
