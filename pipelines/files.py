"""Files that a user names: read in bounds, with any fault of their YAML in one line; written whole or not at all.

    data = read_bytes(path, MAX_YAML_BYTES)
    content = load_yaml(data, str(path))
    write_whole(folder, {"report.html": page, "result.json": text})

All raise InputError. Processes that write into one folder wait for each other: the files there are those of one of
them, never of two. A command that finds the results of another that ended first leaves them with a message. A process
that is killed leaves those of before, or none.
"""

from __future__ import annotations

import datetime
import fcntl
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any, BinaryIO

from alidade.pipelines.errors import InputError

# A config, a scenario or a bag's metadata.yaml.
MAX_YAML_BYTES = 1 << 20
# A result.json with the covariance of a thousand numbers.
MAX_RESULT_BYTES = 1 << 28
# Values and keys of a YAML file, and the same with its aliases written out: pure Python reads 8,000 a second.
MAX_YAML_NODES, MAX_EXPANDED_NODES = 50_000, 500_000
MAX_YAML_DEPTH = 50
# Words that YAML takes for something else.
_YAML_WORDS = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")


def require_regular(path: Path) -> None:
    """Raise InputError when a path is neither a regular file nor a link to one: a device or a pipe may never end."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise _cannot_open(path, error) from error
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a device or a pipe"
        raise InputError(f"{path}: cannot be opened ({what}, and no regular file)")


def read_bytes(path: Path, most: int) -> bytes:
    """Return the bytes of a regular file, or of standard input, named `-`; InputError for more than `most`."""
    try:
        if str(path) == "-":
            data = sys.stdin.buffer.read(most + 1)
        else:
            # Without waiting for somebody who writes into it, should it be a pipe.
            with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as stream:
                require_regular(path)
                data = stream.read(most + 1)
    except (OSError, ValueError) as error:
        raise _cannot_open(path, error) from error
    if len(data) > most:
        raise InputError(f"{path}: over {most} bytes, which is more than any file of its kind has")
    return data


def open_binary(path: Path, named: Path | None = None) -> BinaryIO:
    """Open a file for reading; an InputError names the file `named`."""
    try:
        return path.open("rb")
    except OSError as error:
        raise _cannot_open(named or path, error) from error


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file that replaces `path` when the block ends without an error; InputError if it cannot."""
    require_place(path)
    if _is_special(path):
        raise InputError(f"{path}: there is no file to be written, it is something else")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            with part.open("wb") as stream:
                yield stream
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def dump_yaml(content: object, width: int = 80, is_sorted: bool = True) -> str:
    """YAML text of mappings, lists and scalars; mappings and lists of scalars alone stand on one line of that width."""
    from ruamel.yaml import YAML

    yaml: Any = YAML(typ="safe", pure=True)
    text = StringIO()
    yaml.default_flow_style, yaml.width, yaml.sort_base_mapping_type_on_output = None, width, is_sorted
    yaml.dump(content, text)
    return text.getvalue()


def plain_json(kind: str, content: Mapping[str, Any]) -> str:
    """JSON text of a command's result, SI, under its schema `alidade.<kind>/1`; null where a number is not finite."""
    from pydantic_core import to_json

    return to_json({"schema": f"alidade.{kind}/1", **content}, indent=1, inf_nan_mode="null").decode()


def yaml_float(value: float) -> str:
    """Return a float as YAML 1.1 reads it as one: 5.0e-05, since 5e-05 is a string there."""
    text = repr(value)
    return text if "." in text else text.replace("e", ".0e")


def flow_yaml(value: object) -> str:
    """Return a scalar, a list or a mapping as one line of YAML."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{flow_yaml(str(key))}: {flow_yaml(one)}' for key, one in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(flow_yaml, value))}]"
    if value is None:
        return "null"
    if not isinstance(value, str):
        return f"{value:g}" if isinstance(value, float) else str(value).lower()
    plain = re.fullmatch(r"[A-Za-z_/][A-Za-z0-9_/. ^-]*", value) and value.lower() not in _YAML_WORDS
    return value if plain else '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def as_date(text: str) -> datetime.datetime:
    """Parse an ISO 8601 date, with or without time, in UTC unless a zone is stated. Raises InputError."""
    try:
        date = datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(f"date {text!r}: must be like 2026-11-20 or 2026-11-20T12:00") from error
    return date if date.tzinfo else date.replace(tzinfo=datetime.UTC)


def load_yaml(data: bytes | str, where: str, as_text: bool = False) -> Any:
    """Parse the one document of a YAML file.

    Args:
        data: its content, UTF-8.
        where: it stands, for what is said about it.
        as_text: leave all scalars text.

    Raises:
        InputError: no UTF-8, no YAML, values that are not what their tags say, aliases that multiply.
    """
    from ruamel.yaml.error import MarkedYAMLError

    if len(data) > MAX_YAML_BYTES:
        raise InputError(f"{where}: {len(data)} bytes, which is no config")
    try:
        text = data.decode() if isinstance(data, bytes) else data
        constructor, parser = _bounded("base" if as_text else "safe").get_constructor_parser(text)
        try:
            node = constructor.composer.get_single_node()
            if node is None:
                return None
            if _nodes(node, {}) > MAX_EXPANDED_NODES:
                raise _TooLargeError(f"its aliases stand for over {MAX_EXPANDED_NODES} values")
            return constructor.construct_document(node)
        finally:
            parser.dispose()
    except _TooLargeError as error:
        raise InputError(f"{where}: unreadable YAML: {error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: not a YAML file, byte {error.start} is not UTF-8 text") from error
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(
            f"{where}: unreadable YAML{line}: {' '.join((error.problem or str(error)).split())}"
        ) from error
    except Exception as error:  # the library's constructors raise anything where a value is not what its tag says
        said = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{where}: unreadable YAML: a value is not valid ({said})") from error


class _TooLargeError(Exception):
    """Raised for YAML with more values, or deeper ones, than people or programs write."""


def _bounded(kind: str) -> Any:
    """Return a YAML reader that stops at MAX_YAML_NODES and MAX_YAML_DEPTH."""
    from ruamel.yaml import YAML
    from ruamel.yaml.composer import Composer

    class BoundedComposer(Composer):
        """Composer of YAML that limits number and depth of the nodes."""

        made = depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            self.made, self.depth = self.made + 1, self.depth + 1
            if self.made > MAX_YAML_NODES:
                raise _TooLargeError(f"over {MAX_YAML_NODES} values")
            if self.depth > MAX_YAML_DEPTH:
                raise _TooLargeError("it is nested too deep")
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

    yaml = YAML(typ=kind, pure=True)
    yaml.Composer = BoundedComposer
    return yaml


def _nodes(node: Any, known: dict[int, float]) -> float:
    """Return the number of nodes of a tree with all aliases written out; infinite for one that contains itself."""
    if id(node) not in known:
        known[id(node)] = float("inf")
        children = node.value if isinstance(node.value, list) else []
        parts = (part for child in children for part in (child if isinstance(child, tuple) else (child,)))
        known[id(node)] = 1.0 + sum(_nodes(part, known) for part in parts)
    return known[id(node)]


def _cannot_open(path: Path, error: Exception) -> InputError:
    if isinstance(error, IsADirectoryError):
        return InputError(f"{path}: is a folder; name a file in it")
    return InputError(f"{path}: cannot be opened ({getattr(error, 'strerror', None) or error})")


# Of a file: its text or bytes, a function that writes it to a path, or None where there is none.
Content = str | bytes | Callable[[Path], None] | None

# Others are waited for so long, s: pages and tables are made in a few seconds. Looked at so often, s.
_PATIENCE_S, _GLANCE_S = 60.0, 0.02
_PART = ".alidade."
# Folder -> when a command of this process claimed it, or wrote there last, Unix ns.
_claimed: dict[Path, int] = {}


def write_whole(out_dir: Path, contents: Mapping[str, Content]) -> tuple[Path, ...]:
    """Write files that belong together; returns the paths of those that have a content.

    They are made in a folder of their own and moved at the end. Files of earlier ones are replaced, or removed where
    there is no content now; others in out_dir stay.

    Args:
        out_dir: where they go.
        contents: by name, in the order in which they take their places; the last, gone first and back last, says that
            the others are its own, and always has a content.

    Raises:
        InputError: out_dir is a file, cannot be written to, another process does not come to an end there, or has
            written there since this one claimed the folder (`require_room`).
    """
    new, names = not out_dir.exists(), list(contents)
    try:
        with _alone(out_dir):
            for left in out_dir.glob(f"{_PART}*"):  # of processes that were killed: nobody else is here
                shutil.rmtree(left, ignore_errors=True)
            part = Path(tempfile.mkdtemp(prefix=_PART, dir=out_dir))
            try:
                for name, content in contents.items():
                    _write(part / name, content)
                return _move(part, out_dir, names)
            finally:
                shutil.rmtree(part, ignore_errors=True)
                if new and not (out_dir / names[-1]).exists():
                    shutil.rmtree(out_dir, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{out_dir}: the results cannot be written ({error.strerror})") from error


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Lock a folder, made if need be, for this process, with which the lock ends. Raises InputError."""
    patience = time.monotonic() + _PATIENCE_S
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise InputError(f"{folder}: no folder to write results to ({error.strerror})") from error
        try:
            if _locked(lock, patience, folder):
                yield
                return
        finally:
            os.close(lock)


def _locked(lock: int, patience: float, folder: Path) -> bool:
    """Whether the lock is acquired, and the locked folder is still the one with this name."""
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > patience:
                raise InputError(f"{folder}: another process is writing its results there; give another") from error
            time.sleep(_GLANCE_S)
            continue
        except OSError:  # a file system without locks
            return True
        return folder.exists() and os.path.samestat(os.fstat(lock), folder.stat())


def require_room(out_dir: Path | None) -> None:
    """Claim a folder before the work whose results are written there. Raises InputError if it is not writable."""
    if out_dir is None:
        return
    _claimed[out_dir.absolute()] = time.time_ns()
    there = next(folder for folder in (out_dir, *out_dir.absolute().parents) if folder.exists())
    if not there.is_dir():
        raise InputError(f"{out_dir}: no folder to write results to ({there} is no folder)")
    if not os.access(there, os.W_OK):
        raise InputError(f"{out_dir}: no folder to write results to ({there} may not be written to)")


def require_place(path: Path | None) -> None:
    """Raise InputError if no file can be written at a path: it is a folder, or its own folder cannot be written to."""
    if path is None:
        return
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file in it")
    if not _is_special(path) and not (path.parent.is_dir() and os.access(path.parent, os.W_OK)):
        raise InputError(f"{path}: cannot be written ({path.parent} is no folder that may be written to)")


def _is_special(path: Path) -> bool:
    """Whether something is there that is neither a file nor a folder: a pipe, a terminal."""
    return path.exists() and not path.is_file() and not path.is_dir()


def require_mcap_name(path: Path) -> None:
    """Raise InputError for a name that promises another format than MCAP."""
    if path.suffix.lower() not in ("", ".mcap"):
        raise InputError(f"{path}: an MCAP file is written: name it {path.stem}.mcap")


def write_file(path: Path, content: str | bytes) -> None:
    """Write a single file, whole or not at all. Raises InputError when it cannot be written."""
    data = content if isinstance(content, bytes) else content.encode()
    if _is_special(path):
        try:
            path.write_bytes(data)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error
        return
    with replacing(path) as stream:
        stream.write(data)


def _write(path: Path, content: Content) -> None:
    if callable(content):
        content(path)
    elif content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())


def _move(part: Path, out_dir: Path, names: Sequence[str]) -> tuple[Path, ...]:
    last, claimed = out_dir / names[-1], _claimed.get(out_dir.absolute())
    if claimed is not None and last.exists() and last.stat().st_mtime_ns > claimed:
        raise InputError(
            f"{out_dir}: another process has written its results there since this one began; those of this one are "
            "not written: give another folder"
        )
    for name in reversed(names):  # all of them, the last first: at no time do files of two writers stand together
        (out_dir / name).unlink(missing_ok=True)
    made = [name for name in names if (part / name).exists()]
    for name in made:
        os.replace(part / name, out_dir / name)
    if claimed is not None:
        _claimed[out_dir.absolute()] = last.stat().st_mtime_ns
    return tuple(out_dir / name for name in made)
