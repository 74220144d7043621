"""Recordings of a fleet: location, unit and date of each.

Each is a file or a bag folder. Paths are fsspec's: a folder of this machine or of a network file system, or
s3://bucket/... with the package of that file system. A worker opens its recording by itself; what is not on a local
file system is copied for that time.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from alidade.pipelines.applications.fleet import require_extra
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import MAX_YAML_BYTES, load_yaml, read_bytes
from alidade.pipelines.recording.opening import BAG, METADATA, bag_metadata, parts_of_bag

if TYPE_CHECKING:
    from fsspec.core import OpenFile

# Of a file or folder, as fsspec lists it.
_Info = Mapping[str, Any]
_FIELDS = {"{unit}": r"(?P<unit>.+?)", "{date}": r"(?P<date>\d{4}-?\d\d-?\d\d(?:T\d\d:?\d\d(?::?\d\d)?Z?)?)", "*": ".*"}


@dataclass(frozen=True)
class Recording:
    """Recording of a fleet: a file or a bag folder, on this machine or a remote one.

    Attributes:
        file: where it is.
        tag: an object store's own mark of the content (ETag), as it lists it; None where there is none.
        is_bag: whether it is a bag folder.
    """

    file: OpenFile
    tag: str | None = None
    is_bag: bool = False


def find(patterns: Sequence[str]) -> dict[str, Recording]:
    """Find recordings by patterns: name -> recording, in order; a bag folder in place of its parts.

    Raises InputError when a pattern matches none or cannot be looked up.
    """
    require_extra()
    from fsspec.core import OpenFile, url_to_fs

    found: dict[str, Recording] = {}
    for pattern in patterns:
        with _one_line_error(pattern, "looked up"):
            fs, path = url_to_fs(pattern)
            fs.invalidate_cache()  # what was listed before may have changed
            bags, files = _bags_and_files(fs, fs.glob(path, detail=True))
            is_folder = not bags and not files and fs.isdir(path)
        if not bags and not files:
            inside = f": that is a folder; give what is in it, '{pattern.rstrip('/')}/*.mcap'" if is_folder else ""
            raise InputError(f"no recording matches {pattern}{inside}")
        for address in (*bags, *files):
            file, info = OpenFile(fs, address), files.get(address, {})
            name = file.path if _is_local(file) else file.full_name
            found[name] = Recording(file, info.get("ETag") or info.get("etag"), address in bags)
    return dict(sorted(found.items()))


def _bags_and_files(fs: Any, listed: Mapping[str, _Info]) -> tuple[set[str], dict[str, _Info]]:
    """Split what a pattern lists into the paths of bag folders, and the other files."""
    files = {name: info for name, info in listed.items() if info["type"] == "file" or _links_to(fs.isfile, info)}
    folders = {name for name, info in listed.items() if info["type"] == "directory" or _links_to(fs.isdir, info)}
    # One that matches alone in its folder is a recording: to look beside each of a million would take hours.
    beside = Counter(_folder(name) for name in files)
    folders.update(folder for folder, count in beside.items() if count > 1)
    parts = {folder: _parts(fs, folder) for folder in folders}
    return (
        {folder for folder, own in parts.items() if own},
        {name: info for name, info in files.items() if name not in parts.get(_folder(name), ())},
    )


def _parts(fs: Any, folder: str) -> set[str]:
    """Return the paths of a bag's files, metadata.yaml included; empty if the folder is no bag."""
    at = f"{folder}/" if folder else ""
    try:
        text = fs.cat_file(at + METADATA, end=MAX_YAML_BYTES + 1)
    except FileNotFoundError:
        return set()
    names = parts_of_bag(bag_metadata(text))
    return {at + name for part in names for name in (part, f"{part}.zstd", METADATA)}


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _links_to(kind: Callable[[str], bool], info: _Info) -> bool:
    return bool(info.get("islink")) and kind(info["name"])


@contextmanager
def local(file: OpenFile, is_folder: bool = False) -> Iterator[Path]:
    """Yield a file or folder as a path on this machine. Raises InputError when it cannot be read."""
    if _is_local(file):
        yield Path(file.path)
        return
    with TemporaryDirectory(prefix="alidade.") as folder:
        path = Path(folder) / Path(file.path).name
        with _one_line_error(file.full_name, "read"):
            file.fs.get(file.path, str(path), recursive=True) if is_folder else file.fs.get_file(file.path, str(path))
        yield path


@contextmanager
def _one_line_error(what: str, done: str) -> Iterator[None]:
    """Context manager that makes an InputError in one line of any error that a file system raises."""
    try:
        yield
    except Exception as error:
        raise InputError(f"{what}: cannot be {done}: {' '.join(str(error).split()) or type(error).__name__}") from error


def from_name(name: str, names: str | None) -> dict[str, str]:
    """Return unit and date in a file's name, those of the two that the pattern has.

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
    """Return unit and date in a recording's metadata, those of the two that are there.

    Any MCAP metadata record with a key `unit` or `date`, or the custom data of rosbag2 (`ros2 bag record --custom-data
    unit=U17`), of a folder that in its metadata.yaml.
    """
    found = _custom(read_bytes(path / METADATA, MAX_YAML_BYTES)) if path.is_dir() else _recorded(path)
    return {key: found[key] for key in ("unit", "date") if found.get(key)}


def _recorded(path: Path) -> dict[str, str]:
    """Return the entries in the metadata records of an MCAP file, rosbag2's custom data included."""
    from mcap.reader import make_reader

    found: dict[str, str] = {}
    with path.open("rb") as stream:
        try:
            for record in make_reader(stream).iter_metadata():
                own = {**_custom(record.metadata.get("serialized_metadata", "")), **record.metadata}
                found |= {key: value for key, value in own.items() if value}
        except Exception:
            # A damaged file fails in any way here. Its error is reported when its messages are read.
            return {}
    return found


def _custom(text: bytes | str) -> dict[str, str]:
    """Return rosbag2's custom data in the YAML of a metadata record or metadata.yaml, as text (`unit: 007`)."""
    try:
        content = load_yaml(text, METADATA, as_text=True)
    except InputError:
        return {}
    content = content.get(BAG, content) if isinstance(content, dict) else {}
    custom = content.get("custom_data") if isinstance(content, dict) else None
    return {key: value for key, value in custom.items() if isinstance(value, str)} if isinstance(custom, dict) else {}


def _is_local(file: OpenFile) -> bool:
    from fsspec.implementations.local import LocalFileSystem

    return isinstance(file.fs, LocalFileSystem)
