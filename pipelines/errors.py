"""Exceptions of known causes, how names stand in their messages, and the exit codes of what they end."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Self

# Exit codes of the command line, which a fleet prints for each recording.
EXIT_CALIBRATED = 0
EXIT_CRASHED = 1
EXIT_BAD_INPUT = 2
EXIT_UNDETERMINED = 3
EXIT_INCONSISTENT = 4
EXIT_INTERRUPTED = 130
EXIT_KILLED = 137

EXIT_OF_STATUS = {
    "calibrated": EXIT_CALIBRATED,
    "unobservable": EXIT_UNDETERMINED,
    "weak": EXIT_UNDETERMINED,
    "inconsistent": EXIT_INCONSISTENT,
}

EXIT_OF_VALIDATION = {
    "holds": EXIT_CALIBRATED,
    "same": EXIT_CALIBRATED,
    "unknown": EXIT_UNDETERMINED,
    "changed": EXIT_INCONSISTENT,
}

# Longer lines help nobody; names in a hostile recording can be as long as it likes.
_LONGEST = 2000
# What people call a noise density.
_DENSITY = ("noise", "sigma")
# Endings of archives and of compressed files.
_PACKED = {".7z", ".bz2", ".gz", ".rar", ".tar", ".tgz", ".xz", ".zip", ".zst"}


class InputError(Exception):
    """Input that cannot be used: a recording, a config, an option.

    The message is one line that says what is wrong, where (topic, time, key) and what to do. The command line prints it
    and exits with code 2.
    """

    def __str__(self) -> str:
        """Return the message as one line of printable characters, whatever names are in it."""
        return printable(super().__str__(), _LONGEST)


class NotARecordingError(InputError):
    """A file that cannot be used however long it grows: of no known format, or a table without `columns`."""

    @classmethod
    def of(cls, path: Path, why: str = "") -> Self:
        """Make the error for a file of no known format."""
        if path.suffix.lower() in _PACKED:
            return cls(f"{path}: an archive or a compressed file; unpack it first")
        return cls(
            f"{path}: not an MCAP file, ROS bag, PX4 or ArduPilot log, or table{why}; numbers of other files go in as "
            "arrays: alidade.open in Python"
        )


class IndeterminateError(Exception):
    """The recording does not determine the unknowns that an estimate needs."""


def printable(text: str, longest: int = 200) -> str:
    """Return text for a terminal: control characters as escapes, the middle of a text that is too long left out."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} ... {text[-longest // 2 :]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a phrase that names the known name nearest to a wrong one."""
    names = list(known)
    meant = [other for word in _DENSITY if (other := name.replace(word, "density")) in names]
    found = meant or difflib.get_close_matches(name, names, n=1, cutoff=0.0)
    return f"; the nearest known key is {found[0]}" if found else ""


def nearest_three(name: str, known: Iterable[str]) -> str:
    """Return a phrase that names the three known names nearest to a wrong one."""
    return f"the nearest are {', '.join(difflib.get_close_matches(name, list(known), n=3, cutoff=0.0))}"
