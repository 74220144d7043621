"""The recordings of a fleet: where they are, which unit each shows, and when.

Paths are fsspec's: a folder of this machine or of a network file system, or s3://bucket/... with the package of that
file system. A worker opens its recording by itself; what is not on a local file system is copied for that time.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from pipelines.errors import InputError
from pipelines.fleet import require_extra

if TYPE_CHECKING:
    from fsspec.core import OpenFile

_FIELDS = {"{unit}": r"(?P<unit>.+?)", "{date}": r"(?P<date>\d{4}-?\d\d-?\d\d(?:T\d\d:?\d\d(?::?\d\d)?Z?)?)", "*": ".*"}


@dataclass(frozen=True)
class Recording:
    """A file of a fleet.

    Attributes:
        file: where it is.
        tag: an object store's own mark of the content (ETag), as it lists it; None where there is none.
    """

    file: OpenFile
    tag: str | None = None


def find(patterns: Sequence[str]) -> dict[str, Recording]:
    """The files that match, by name, in order. Raises InputError when a pattern matches none or cannot be looked up."""
    require_extra()
    from fsspec.core import OpenFile, url_to_fs

    found: dict[str, Recording] = {}
    for pattern in patterns:
        with _told(pattern, "looked up"):
            fs, path = url_to_fs(pattern)
            fs.invalidate_cache()  # what was listed before may have changed
            listed = fs.glob(path, detail=True).values()
            matches = [i for i in listed if i["type"] == "file" or (i.get("islink") and fs.isfile(i["name"]))]
        if not matches:
            raise InputError(f"no file matches {pattern}")
        for info in matches:
            file = OpenFile(fs, info["name"])
            name = file.path if _is_local(file) else file.full_name
            found[name] = Recording(file, info.get("ETag") or info.get("etag"))
    return dict(sorted(found.items()))


@contextmanager
def local(file: OpenFile) -> Iterator[Path]:
    """The file on this machine. Raises InputError when it cannot be read."""
    if _is_local(file):
        yield Path(file.path)
        return
    with TemporaryDirectory(prefix="alidade.") as folder:
        path = Path(folder) / Path(file.path).name
        with _told(file.full_name, "read"):
            file.fs.get_file(file.path, str(path))
        yield path


@contextmanager
def _told(what: str, done: str) -> Iterator[None]:
    """Makes one line of whatever goes wrong: file systems raise what the libraries below them raise."""
    try:
        yield
    except Exception as error:
        raise InputError(f"{what}: cannot be {done}: {' '.join(str(error).split()) or type(error).__name__}") from error


def from_name(name: str, names: str | None) -> dict[str, str]:
    """Unit and date in the file's name, as far as the pattern has them.

    Args:
        name: the file's, with or without folders.
        names: like `{unit}_{date}*`, of the name without its ending; `*` stands for anything. Dates are ISO 8601.

    Raises:
        InputError: the pattern has neither field, or the name does not fit it.
    """
    if names is None:
        return {}
    if "{unit}" not in names and "{date}" not in names:
        raise InputError(f"--names {names}: needs {{unit}}, {{date}} or both, like '{{unit}}_{{date}}*'")
    parts = re.split(r"(\{unit\}|\{date\}|\*)", names)
    expression = "".join(_FIELDS.get(part, re.escape(part)) for part in parts)
    try:
        match = re.fullmatch(expression, Path(name).stem)
    except re.error as error:
        raise InputError(f"--names {names}: {{unit}} and {{date}} may each occur once") from error
    if match is None:
        raise InputError(f"{name}: the name does not fit --names {names}")
    return match.groupdict()


def from_metadata(path: Path) -> dict[str, str]:
    """Unit and date in the recording's metadata, as far as they are there.

    Any MCAP metadata record with a key `unit` or `date`, or the custom data of rosbag2 (`ros2 bag record --custom-data
    unit=U17`).
    """
    from mcap.reader import make_reader

    found: dict[str, str] = {}
    with path.open("rb") as stream:
        try:
            for record in make_reader(stream).iter_metadata():
                found |= {k: v for k, v in {**_custom(record.metadata), **record.metadata}.items() if v}
        except Exception:
            # A damaged file fails in any way here. What is wrong with it is told when its messages are read.
            return {}
    return {key: found[key] for key in ("unit", "date") if key in found}


def as_date(text: str) -> datetime.datetime:
    """A date of ISO 8601, with or without time; UTC unless it says otherwise. Raises InputError when it is none."""
    try:
        date = datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(f"date {text!r}: must be like 2026-11-20 or 2026-11-20T12:00") from error
    return date if date.tzinfo else date.replace(tzinfo=datetime.UTC)


def _custom(metadata: dict[str, str]) -> dict[str, str]:
    """rosbag2's custom data: YAML inside one metadata record. All of it is text, `unit: 007` too."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="base", pure=True).load(metadata.get("serialized_metadata", ""))
    except YAMLError:
        return {}
    custom = content.get("custom_data") if isinstance(content, dict) else None
    return custom if isinstance(custom, dict) else {}


def _is_local(file: OpenFile) -> bool:
    from fsspec.implementations.local import LocalFileSystem

    return isinstance(file.fs, LocalFileSystem)
