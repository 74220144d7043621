"""Readers of messages that come one by one: intrinsics, pictures, tag detections, transforms.

A message without a field, or with a field of another kind, is an AttributeError, TypeError, KeyError or ValueError; a
video that is not read is a MessageError.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from alidade.pipelines.recording import images, series
from alidade.pipelines.recording.decoding import DecodedMessage, one_clock
from alidade.pipelines.recording.messages import MessageError


def camera_info(message: DecodedMessage) -> series.CameraInfo:
    """Return the intrinsics in a sensor_msgs/CameraInfo message."""
    found = message.content
    k, r, p, d = (np.array(values, dtype=float) for values in (found.k, found.r, found.p, found.d))
    size = int(found.width), int(found.height)
    matrices = k.reshape(3, 3), r.reshape(3, 3), p.reshape(3, 4)
    return series.CameraInfo(message.t_ns, *size, found.distortion_model, d, *matrices, found.header.frame_id)


def pictures(messages: Iterable[DecodedMessage], is_raw: bool) -> Iterator[tuple[int, bytes]]:
    """Yield pictures as (stamp in ns, file); raw ones and frames of a video become files in the Netpbm form."""
    return ((t_ns, file) for t_ns, file in _files(messages, is_raw) if t_ns is not None)


def _files(messages: Iterable[DecodedMessage], is_raw: bool) -> Iterator[tuple[int | None, bytes]]:
    """Yield a picture for each message; its stamp is None where the message is left out."""
    files = (_file(message, is_raw) for message in messages)
    for t_ns, form, data in files:
        if form in images.ANNEX_B or form in images.BY_PYAV:
            packets = itertools.chain([(t_ns, data)], ((t_ns, data) for t_ns, _, data in files))
            try:
                yield from images.decode_video(packets, form)
            except ValueError as error:
                raise MessageError(str(error)) from error
            return
        yield t_ns, data


def _file(message: DecodedMessage, is_raw: bool) -> tuple[int | None, str, bytes]:
    """Return a message's stamp, ns, its format, and its picture as a file, or its packet of a video."""
    found, t_ns = message.content, None if message.left_out else message.t_ns
    if is_raw:
        return t_ns, "netpbm", images.netpbm(found)
    return t_ns, found.format.lower(), found.data.tobytes()


def tag_detections(messages: Iterable[DecodedMessage]) -> series.DetectionSeries:
    """Detections of apriltag_msgs/AprilTagDetectionArray messages, with corners as points or as plain numbers."""
    stamps: list[tuple[int, bool]] = []
    rows: list[tuple[int, int, Any, str]] = []
    for i, message in enumerate(message for message in messages if not message.left_out):
        stamps.append((message.t_ns, message.from_log_time))
        numbers = message.definition.numbers
        for found in message.content.detections:
            # (x, y) or (x, y, z) of each
            xy = numbers(found.corners).reshape(4, -1)[:, :2]
            rows.append((i, int(numbers(found.id)[0]), xy, found.family))
    frame, tag_id, corners, family = ([row[k] for row in rows] for k in range(4))
    return series.DetectionSeries(
        np.array([t_ns for t_ns, _ in stamps], dtype=np.int64),
        np.array(frame, dtype=np.int64),
        np.array(tag_id, dtype=np.int64),
        np.array(corners, dtype=float).reshape(-1, 4, 2),
        np.array(family, dtype=np.str_),
        stamped_by_log=sum(from_log for _, from_log in stamps),
    )


def transforms(messages: Iterable[DecodedMessage]) -> dict[tuple[str, str], tuple[series.PoseSeries, int]]:
    """Transforms of tf2_msgs/TFMessage messages, and how many are left out, by (parent frame, child frame)."""
    rows: dict[tuple[str, str], list[tuple[int, int, Any]]] = {}
    for message in messages:
        for one in message.content.transforms:
            t_ns = one.header.stamp.sec * 1_000_000_000 + one.header.stamp.nanosec
            row = t_ns, message.t_ns, message.definition.numbers(one.transform)
            pair = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
            rows.setdefault(pair, []).append(row)
    return {pair: _poses(found) for pair, found in rows.items()}


def _poses(rows: list[tuple[int, int, Any]]) -> tuple[series.PoseSeries, int]:
    """Make poses of rows of stamp (0: none), log time, and x, y, z, qx, qy, qz, qw; count those left out."""
    stamps, log_ns = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2).T
    kept, absent = one_clock(stamps, log_ns)
    numbers = np.array([row[2] for row in rows]).reshape(-1, 7)[kept]
    t_ns, from_log = (log_ns, len(rows)) if absent else (stamps[kept], 0)
    poses = series.PoseSeries(t_ns, numbers[:, [6, 3, 4, 5]], numbers[:, :3], stamped_by_log=from_log)
    return poses, int(np.count_nonzero(~kept))
