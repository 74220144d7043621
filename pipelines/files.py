"""Reader of files that a user names: regular ones, bounded in size, with any fault of their YAML in one line.

    data = read_bytes(path, MAX_YAML_BYTES)
    content = load_yaml(data, str(path))

All raise InputError.
"""

from __future__ import annotations

import datetime
import os
import re
import stat
import sys
from collections.abc import Iterator
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
    if not path.name or (path.exists() and not path.is_file()):
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
    return InputError(f"{path}: cannot be opened ({getattr(error, 'strerror', None) or error})")
