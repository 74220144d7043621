"""Damaged copies of a small recording, and what may be read of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_records import HEAD, MAGIC
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import Recording, open_recording

T0 = 1_700_000_000_123_456_789
CONFIG = b"method: head\n"
# Topic -> stamps (n,) and numbers (n, k).
Whole = dict[str, tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]]
# How the mcap package's own writer is asked to write: the forms that recorders use.
FORMS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "without chunks": {"use_chunking": False, "enable_data_crcs": True},
}


def topics(n: int = 120) -> dict[str, series.Topic]:
    """Random numbers of some kinds, no two alike."""
    rng = np.random.default_rng(3)
    fast, slow = (T0 + step * np.arange(n // every) for step, every in ((5_000_000, 1), (20_000_000, 4)))
    pose = series.PoseSeries(slow, rng.normal(size=(n // 4, 4)), cov=rng.normal(size=(n // 4, 6, 6)))
    return {
        "/imu": series.ImuSeries(fast, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), frame_id="imu"),
        "/joints": series.JointSeries(slow, rng.normal(size=(n // 4, 2)), ("azimuth", "elevation")),
        "/pose": pose,
    }


def write_small(path: Path, form: str, chunk_size: int = 4000, n: int = 120) -> Path:
    """A small recording with an attached config, in chunks of about this size."""
    write_session(path, topics(n), {"alidade.yaml": CONFIG})
    return rewrite(path, path.with_name(f"{form}.mcap"), chunk_size=chunk_size, **FORMS[form])


def rewrite(source: Path, path: Path, renamed: Mapping[str, str] | None = None, **options: Any) -> Path:
    """The same messages and attachments through the mcap package's own writer, with options of its; topics renamed."""
    with source.open("rb") as stream, path.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, **options)
        writer.start("ros2")
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    (renamed or {}).get(channel.topic, channel.topic), "cdr", number
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def boundaries(data: bytes) -> list[int]:
    """Where the records outside chunks begin, and where the last one ends."""
    places, at = [], len(MAGIC)
    while at + HEAD.size <= len(data):
        places.append(at)
        at += HEAD.size + HEAD.unpack_from(data, at)[1]
    return places


def has_chunks(data: bytes) -> bool:
    return any(data[at] == Opcode.CHUNK for at in boundaries(data)[:-1])


def cuts(data: bytes) -> list[bytes]:
    """Cut at every record boundary and one byte beside it."""
    return [data[: at + off] for at in boundaries(data) for off in (-1, 0, 1)]


def flips(data: bytes, number: int, seed: int) -> Iterator[bytes]:
    """Copies with one byte replaced by another one, at random places."""
    rng = np.random.default_rng(seed)
    for at, other in zip(rng.integers(0, len(data), number), rng.integers(1, 256, number), strict=True):
        yield data[:at] + bytes([data[at] ^ int(other)]) + data[at + 1 :]


def spoilt(data: bytes, number: int, seed: int) -> Iterator[bytes]:
    """Copies with a stretch zeroed, missing, inserted or random, or with several bytes replaced."""
    rng = np.random.default_rng(seed)
    for i in range(number):
        at, length = int(rng.integers(len(data))), int(rng.integers(1, 2000))
        end = min(len(data), at + length)
        if i % 5 == 4:
            copy = bytearray(data)
            for place in rng.integers(0, len(data), int(rng.integers(2, 40))):
                copy[place] = int(rng.integers(256))
            yield bytes(copy)
        else:
            middle = [bytes(end - at), b"", rng.bytes(length) + data[at:end], rng.bytes(end - at)][i % 5]
            yield data[:at] + middle + data[end:]


def read(recording: Recording) -> Whole:
    """What can be read of those of `topics` that are there with messages."""
    found = {}
    for name, topic in recording.topics.items():
        if not topic.count or name not in ("/imu", "/joints", "/pose"):
            continue
        if name == "/imu":
            imu = recording.imu(name)
            found[name] = imu.t_ns, np.hstack([imu.gyro, imu.accel])
        elif name == "/joints":
            joints = recording.joints(name, ("azimuth", "elevation"))
            found[name] = joints.t_ns, joints.position
        else:
            poses = recording.poses(name)
            found[name] = poses.t_ns, np.hstack([poses.wxyz, poses.cov.reshape(len(poses), -1)])
    return found


def check_sound(path: Path, whole: Whole) -> str:
    """Read a damaged file: what comes out is a part of what was written, and what is missing is told.

    Returns what happened: `whole`, `part` or `refused`. Anything but an InputError of one line goes through.
    """
    try:
        recording = open_recording(path)
        found = read(recording)
        recording.attachment("alidade.yaml")
    except InputError:
        return "refused"
    lost = 0
    for name, (t_ns, values) in whole.items():
        left_t, left = found.get(name, (np.empty(0, np.int64), np.empty((0, values.shape[1]))))
        rows = np.searchsorted(t_ns, left_t)
        np.testing.assert_array_equal(left_t, t_ns[rows])
        np.testing.assert_array_equal(left, values[rows])
        assert len(set(rows.tolist())) == len(rows)
        lost += len(t_ns) - len(left_t)
    assert recording.notes or not lost
    if recording.container.losses and not any(
        loss.kind in ("cut", "summary", "definition") for loss in recording.container.losses
    ):
        assert sum(recording.container.missing.values()) == lost
    return "part" if lost else "whole"
