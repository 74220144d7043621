"""Open a path: a file of a supported format, a folder of parts, a pattern, a list of them."""

from __future__ import annotations

import glob
import hashlib
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zstandard

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import MAX_YAML_BYTES, load_yaml, open_binary, read_bytes, require_regular
from alidade.pipelines.recording import ros1_bag
from alidade.pipelines.recording.array_container import ArrayContainer
from alidade.pipelines.recording.camera_files import IS_RESULT, SUFFIXES, CameraFile, read_cameras
from alidade.pipelines.recording.container import Container, MultiPartContainer
from alidade.pipelines.recording.images import is_video
from alidade.pipelines.recording.mcap_file import McapFile
from alidade.pipelines.recording.mcap_records import MAGIC

_ZSTD, _SQLITE, _ULOG, _ARDUPILOT = b"\x28\xb5\x2f\xfd", b"SQLite format 3\0", b"ULog\x01\x12\x35", b"\xa3\x95"
# Bytes of a file's beginning by which its form is recognised.
_START = 1024
# How tables may be called, in a folder that has nothing else of a recording.
_TABLES = (".csv", ".txt", ".tsv", ".tum", ".log", ".dat")
# How the parts of a recording may be called.
PARTS = (".mcap", ".db3", ".bag", ".zstd", ".zst")
# The bytes of a file that distinguish it from others of its form and stay as they are while it grows: the heads of some
# forms count messages. ROS 1: behind the bag's header; SQLite: of the first page, which defines the tables.
_IDENTITY = {ros1_bag.MAGIC: (4096, 8192), _SQLITE: (100, 4096)}
_USUAL_IDENTITY = (0, 4096)
# A compressed file may unpack to so many times its size, beyond so many bytes.
_LARGEST_RATIO, _SMALL = 100, 1 << 28
METADATA, BAG = "metadata.yaml", "rosbag2_bagfile_information"
# What distinguishes the parts of one recording: their number, and their suffix.
_PART_NAME = re.compile(r"(_\d+)?(\.[a-z0-9]+)+$")

Where = Path | str | Sequence[Path | str]


def open_container(where: Where, strict: bool = False) -> Container:
    """Open the recording that a path, a pattern or a list of paths names, as a container of messages.

    Raises InputError when something is missing, is no recording, or cannot be read; with `strict` also when anything
    is lost, for which everything is read once.
    """
    container = _open(where)
    if strict:
        container.require_complete()
    return container


def _open(where: Where) -> Container:
    if not isinstance(where, (str, Path)):
        if not all(isinstance(file, str | Path) for file in where):
            raise InputError("open([...]) takes the files of one recording; calibrate([...]) takes several recordings")
        return _together([Path(one) for one in where])
    path = Path(where)
    if path.is_dir():
        return _folder(path if path.name else path.resolve())
    if not path.exists() and any(letter in str(path) for letter in "*?["):
        found = [Path(name) for name in sorted(glob.glob(str(path)))]
        if not found:
            raise InputError(f"{path}: no file is named so")
        return _together(found)
    return _together([path])


def group_recordings(paths: Sequence[Path]) -> list[Where]:
    """Group paths by recording: each path is one, except that parts of a bag (metadata.yaml beside them) go together.

    Folders and patterns stand for all of their parts.
    """
    found: dict[Path | int, list[Path]] = {}  # by bag, or by place in the list
    for i, path in enumerate(paths):
        metadata = path.parent / METADATA
        is_part = path.is_file() and path.name in parts_of_bag(_metadata(metadata))
        found.setdefault(metadata.resolve() if is_part else i, []).append(path)
    return [parts[0] if len(parts) == 1 else parts for parts in found.values()]


def describe_recordings(recordings: Sequence[Where]) -> str:
    """Return the file names of recordings as text, the parts of one recording joined by `+`."""
    each = [[one] if isinstance(one, (str, Path)) else list(one) for one in recordings]
    return ", ".join(" + ".join(Path(part).name for part in parts) for parts in each)


@contextmanager
def naming_parts(recordings: Sequence[Where]) -> Iterator[None]:
    """Context manager that adds to an InputError on several tables how to name those of one recording."""
    try:
        yield
    except InputError as error:
        if not all(isinstance(each, str | Path) and Path(each).suffix.lower() in _TABLES for each in recordings):
            raise
        raise InputError(
            f"{error}; each of the {len(recordings)} tables counts as a recording: name those of one by their folder, "
            "or by a pattern in quotes"
        ) from error


def _together(paths: Sequence[Path], folder: Path | None = None) -> Container:
    """Open several files as the parts of one recording."""
    if not paths:
        raise InputError("a recording of no files")
    if len({os.path.realpath(path) for path in paths}) < len(paths):
        raise InputError(f"{paths[0]}: the same file is named twice")
    parts = [_file(path) for path in paths]
    if any(isinstance(part, CameraFile) for part in parts):
        begin = min((part.first_log_ns for part in parts if not isinstance(part, CameraFile)), default=0)
        parts = [CameraFile(p.path, p.cameras, p.data, begin) if isinstance(p, CameraFile) else p for p in parts]
    whole = parts[0] if len(parts) == 1 else MultiPartContainer(folder or paths[0], parts)
    if folder is None:
        whole.assumptions = (*_part_of(paths), *whole.assumptions)
    return whole


def _file(path: Path) -> Container:
    """Open one file as the format that its first bytes indicate."""
    require_regular(path)
    container = _by_content(path, path)
    container.require_readable()
    return container


def _by_content(path: Path, data: Path) -> Container:
    """Open the file `data`, which messages name `path`, as the format that its first bytes indicate."""
    with open_binary(data, path) as stream:
        start = stream.read(_START)
    if start.startswith(ros1_bag.MAGIC):
        return ros1_bag.Ros1Bag(path, data)
    if start.startswith(_SQLITE):
        from alidade.pipelines.recording.sqlite_file import SqliteFile

        return SqliteFile(path, data)
    if start.startswith(_ULOG):
        from alidade.pipelines.recording.ulog import read_ulog

        return read_ulog(path, data)
    if start.startswith(_ARDUPILOT):
        from alidade.pipelines.recording.dataflash import read_dataflash

        return read_dataflash(path, data)
    if start.startswith(_ZSTD):
        if data != path:
            raise InputError(f"{path}: compressed twice")
        return _decompressed(path)
    if is_video(start):
        return ArrayContainer(path, {}, ["a video; `columns:` in the config says which table has its pictures' stamps"])
    from alidade.pipelines.recording.tables import looks_like_text, read_table

    if path.suffix in SUFFIXES and looks_like_text(start):
        return read_cameras(path, data)
    if re.match(rb'\s*\{\s*"schema": "alidade\.', start):
        raise InputError(f"{path}: {IS_RESULT}")
    is_table = looks_like_text(start) and not start.startswith(MAGIC)
    return read_table(path, data) if is_table else McapFile(path, data)


def _decompressed(path: Path) -> Container:
    """Open a file that is compressed as a whole, from a temporary copy that lives as long as the container."""
    whole = tempfile.NamedTemporaryFile(prefix="alidade-", suffix=".unpacked")  # noqa: SIM115
    limit = _SMALL + _LARGEST_RATIO * path.stat().st_size
    damaged = ""
    with path.open("rb") as stream:
        try:
            reader = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(stream, read_across_frames=True)
            while piece := reader.read(1 << 20):
                whole.write(piece)
                if whole.tell() > limit:
                    raise InputError(f"{path}: unpacks to over {limit >> 20} MiB; it may be made to exhaust the disk")
        except zstandard.ZstdError:
            damaged = "its compression is damaged, what is behind cannot be read"
    whole.flush()
    if damaged and whole.tell() == 0:
        raise InputError(f"{path}: {damaged}: record again")
    container = _by_content(path, Path(whole.name))
    container.temporary = (container.temporary, whole)
    if damaged:
        container.incomplete = (*container.incomplete, damaged)
    return container


def _folder(path: Path) -> Container:
    """Open a folder: a bag with its metadata.yaml, the parts of one recording, or a data set in EuRoC's form."""
    metadata = _metadata(path / METADATA)
    listed = parts_of_bag(metadata)
    if listed:
        there = [found for name in listed if (found := _stored(path / name)) is not None]
        lost = [name for name in listed if _stored(path / name) is None]
        if not there:
            raise InputError(f"{path}: none of the files is there that its {METADATA} names: {', '.join(lost)}")
        whole = _together(there, path)
        if lost:
            absent = f"{len(lost)} of {len(listed)} parts are not there: {', '.join(lost)}"
            whole.incomplete = (absent, *whole.incomplete)
        whole.message_compression = str(metadata.get("compression_mode")).lower() == "message"
        return whole
    from alidade.pipelines.recording.euroc import find_euroc, read_euroc

    root = find_euroc(path)
    if root is not None:
        return read_euroc(path, root)
    there = parts_in(path) or _tables_in(path)
    if not there:
        raise InputError(f"{path}: a folder without a recording")
    return _together(there, path)


def file_identity(path: Path) -> str:
    """Identity of a file that may still grow, twelve hexadecimal digits."""
    with path.open("rb") as stream:
        start = stream.read(16)
        first, last = next((at for mark, at in _IDENTITY.items() if start.startswith(mark)), _USUAL_IDENTITY)
        stream.seek(first)
        return hashlib.sha256(stream.read(last - first)).hexdigest()[:12]


def is_closed(path: Path) -> bool:
    """Whether a file has the end mark of a finished one; False also for formats without such a mark."""
    with path.open("rb") as stream:
        if stream.read(len(ros1_bag.MAGIC)) == ros1_bag.MAGIC:
            return ros1_bag.is_closed(stream)
        size = stream.seek(0, 2)
        stream.seek(max(0, size - len(MAGIC)))
        return size >= 2 * len(MAGIC) and stream.read() == MAGIC


def parts_in(path: Path) -> list[Path]:
    """Return the files in a folder, by name, of the one recording there. Raises InputError if there are several."""
    there = sorted(file for file in path.iterdir() if file.suffix in PARTS and file.is_file())
    if len({_PART_NAME.sub("", file.name) for file in there}) > 1:
        names = ", ".join(file.name for file in there)
        raise InputError(f"{path}: a folder of several recordings ({names}); name one, or the parts by a pattern")
    return there


def _tables_in(path: Path) -> list[Path]:
    """Return the tables in a folder that have rows of numbers; phone apps write a table for each sensor."""
    from alidade.pipelines.recording.tables import looks_like_text, table_form

    found = []
    for file in sorted(path.iterdir()):
        if file.suffix.lower() in _TABLES and file.is_file():
            with file.open("rb") as stream:
                is_text = looks_like_text(stream.read(_START))
            try:
                if is_text and table_form(file, file).width:
                    found.append(file)
            except InputError:
                continue
    return found


def _metadata(path: Path) -> dict[str, Any]:
    """Content of a bag's metadata.yaml; empty if it is not there or is something else."""
    try:
        return bag_metadata(read_bytes(path, MAX_YAML_BYTES))
    except InputError:
        return {}


def bag_metadata(text: bytes | str) -> dict[str, Any]:
    """Parse the text of a bag's metadata.yaml; empty if the text is anything else."""
    try:
        content = load_yaml(text, METADATA)
    except InputError:
        return {}
    bag = content.get(BAG) if isinstance(content, dict) else None
    return bag if isinstance(bag, dict) else {}


def parts_of_bag(metadata: dict[str, Any]) -> list[str]:
    """Return the names of a bag's files in the order in which its metadata lists them; invalid entries are left out."""
    names = metadata.get("relative_file_paths")
    return [Path(name).name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def _stored(path: Path) -> Path | None:
    """Return the file of that name, or its compressed form `.zstd`; None if neither exists."""
    try:
        return next((one for one in (path, path.with_name(f"{path.name}.zstd")) if one.is_file()), None)
    except (OSError, ValueError):  # no file can have such a name
        return None


def _part_of(paths: Sequence[Path]) -> Sequence[str]:
    """Return a sentence if the files are some parts of a bag, but not all; else nothing."""
    listed = parts_of_bag(_metadata(paths[0].with_name(METADATA)))
    here = [i for i, name in enumerate(listed, start=1) if name in {path.name for path in paths}]
    if not here or len(here) == len(listed):
        return ()
    which = f"part {here[0]}" if len(here) == 1 else f"parts {', '.join(map(str, here))}"
    return (f"{which} of {len(listed)} of a bag; name the folder to read all of it",)
