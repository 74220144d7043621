"""Pictures as files in the Netpbm form, which any decoder of pictures reads: a line of text and the pixels.

Raw pictures of any encoding become such files, and so do those of videos, a message a picture, and of MP4 and AVI
files. OpenCV's FFmpeg decodes H.264, H.265 and files; PyAV (extra `video`) decodes AV1, VP8 and VP9.
"""

from __future__ import annotations

import itertools
import os
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import open_binary
from alidade.pipelines.recording.decoding import DecodedMessage
from alidade.pipelines.recording.messages import MessageError

Pixels = NDArray[Any]
Stamp = TypeVar("Stamp")

# Channels, and the order of those that are red, green, blue.
_COLOURS = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "8UC3": (3, [2, 1, 0]),
}
# Bytes of a pixel.
_GREY = {"mono8": 1, "8UC1": 1, "mono16": 2, "16UC1": 2}
# Two pixels in four bytes; which of them are brightness.
_YUV = {"yuv422": 1, "uyvy": 1, "UYVY": 1, "yuv422_yuy2": 0, "yuyv": 0, "YUYV": 0}
# OpenCV names a pattern by the square that begins at the second row and column.
_OPENCV_BAYER = {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}
_BAYER = re.compile("bayer_(?P<pattern>rggb|bggr|gbrg|grbg)(?P<bits>8|16)")
MAX_PICTURE_BYTES = 1 << 28
# Formats of messages -> ending of a file that FFmpeg takes for that form.
ANNEX_B = {
    **dict.fromkeys(("h264", "avc", "x264", "libx264"), ".h264"),
    **dict.fromkeys(("h265", "hevc", "x265", "libx265"), ".h265"),
}
# Formats of messages -> PyAV's decoder.
BY_PYAV = {"av1": "libdav1d", "vp8": "vp8", "vp9": "vp9"}
MAX_PICTURE_PIXELS = 1 << 26
# What a message of H.264 or H.265 begins with (Annex B of ITU-T H.264 and H.265).
_STARTS = (b"\0\0\1", b"\0\0\0\1")
_NEEDED = "it has to begin with a key picture, and a message has to be a picture"


def netpbm(image: Any) -> bytes:
    """A sensor_msgs/msg/Image as a file: grey, or in colour, with 8 bits.

    Of pictures with 16 bits the upper ones that are used are kept, 8 of them. Raises ValueError where the encoding is
    another, or the size does not agree with the data.
    """
    encoding, data = str(image.encoding), np.asarray(image.data, np.uint8)
    height, width, step = int(image.height), int(image.width), int(image.step)
    if encoding in _GREY:
        return _file(_eight_bits(_used_bytes(data, height, width * _GREY[encoding], step), width, image))
    if encoding in _COLOURS:
        channels, order = _COLOURS[encoding]
        pixels = _used_bytes(data, height, width * channels, step).reshape(height, width, channels)
        return _file(pixels[:, :, order])
    if encoding in _YUV:
        return _file(_used_bytes(data, height, 2 * width, step)[:, _YUV[encoding] :: 2])
    bayer = _BAYER.fullmatch(encoding)
    if bayer is None:
        raise ValueError(f"the encoding {encoding!r} is not one of mono, rgb, bgr, rgba, bgra, bayer, yuv422")
    import cv2

    pixels = _eight_bits(_used_bytes(data, height, width * int(bayer["bits"]) // 8, step), width, image)
    return _file(np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_Bayer{_OPENCV_BAYER[bayer['pattern']]}2RGB"))))


def _used_bytes(data: NDArray[np.uint8], height: int, used: int, step: int) -> NDArray[np.uint8]:
    """Return the used bytes (height, used) of each row of a picture, without the padding."""
    if not 0 < used <= step or height <= 0 or height * step != len(data) or len(data) > MAX_PICTURE_BYTES:
        raise ValueError(f"{height} rows of {step} bytes with {used} used, in {len(data)} bytes of data")
    return np.ascontiguousarray(data.reshape(height, step)[:, :used])


def _eight_bits(rows: NDArray[np.uint8], width: int, image: Any) -> NDArray[np.uint8]:
    """Return 8-bit pixels unchanged, and the upper 8 of the bits in use of 16-bit pixels (often only 10 or 12 are)."""
    if rows.shape[1] == width:
        return rows
    pixels = rows.view(">u2" if image.is_bigendian else "<u2")
    shift = max(0, int(pixels.max()).bit_length() - 8)
    return (pixels >> shift).astype(np.uint8)


def _file(pixels: Pixels) -> bytes:
    """Return a picture (height, width) or (height, width, 3) of 8 bits as a file in the Netpbm form."""
    kind = "P5" if pixels.ndim == 2 else "P6"
    return f"{kind} {pixels.shape[1]} {pixels.shape[0]} 255\n".encode() + pixels.tobytes()


def pictures(messages: Iterable[DecodedMessage], is_raw: bool) -> Iterator[tuple[int, bytes]]:
    """Yield the pictures in a topic's messages as (stamp in Unix ns, content of a picture file).

    Raw pictures and frames of a video become files in the Netpbm form. Raises MessageError.
    """
    packets = (_packet(message, is_raw) for message in messages)
    for t_ns, form, data in packets:
        if form in ANNEX_B or form in BY_PYAV:
            video = itertools.chain([(t_ns, data)], ((t_ns, data) for t_ns, _, data in packets))
            try:
                yield from ((stamp, file) for stamp, file in decode_video(video, form) if stamp is not None)
            except ValueError as error:
                raise MessageError(str(error)) from error
        elif t_ns is not None:
            yield t_ns, data


def _packet(message: DecodedMessage, is_raw: bool) -> tuple[int | None, str, bytes]:
    """Return a message's stamp, ns (None: left out), format, and picture as a file, or packet of a video."""
    found, t_ns = message.content, None if message.left_out else message.t_ns
    if is_raw:
        return t_ns, "netpbm", netpbm(found)
    return t_ns, found.format.lower(), found.data.tobytes()


def decode_video(packets: Iterable[tuple[Stamp, bytes]], form: str) -> Iterator[tuple[Stamp, bytes]]:
    """Decode messages (stamp, message) of a video into (stamp, file in the Netpbm form), one picture each, in order.

    Raises ValueError where the messages are not of that form, or nothing of them can be decoded.
    """
    if form in BY_PYAV:
        yield from _decoded_by_pyav(packets, form)
        return
    stamps = []
    with tempfile.NamedTemporaryFile(prefix="alidade-", suffix=ANNEX_B[form]) as whole:
        for t_ns, data in packets:
            # FFmpeg goes by what a file begins with, and other forms name files of their own to be read.
            if not data.startswith(_STARTS):
                raise ValueError(f"a message of the video is no {form.upper()} (Annex B)")
            whole.write(data)
            stamps.append(t_ns)
        whole.flush()
        yield from zip(stamps, _decoded_pictures(whole.name, len(stamps), "messages", _NEEDED), strict=True)


def _decoded_by_pyav(packets: Iterable[tuple[Stamp, bytes]], form: str) -> Iterator[tuple[Stamp, bytes]]:
    """Decode a video with PyAV in one thread, which has no delay: each message is a picture at once."""
    try:
        import av
    except ImportError as error:
        raise ValueError(f"a video in {form} needs PyAV: pip install 'alidade[video]'") from error
    decoder = av.CodecContext.create(BY_PYAV[form], "r")
    decoder.thread_count = 1
    for i, (t_ns, data) in enumerate(packets):
        try:
            frames = decoder.decode(av.Packet(data))
        except av.FFmpegError as error:
            raise ValueError(f"picture {i + 1} of the video cannot be decoded: {_NEEDED}") from error
        if len(frames) != 1:
            raise ValueError(f"message {i + 1} of the video has {len(frames)} pictures: {_NEEDED}")
        if frames[0].width * frames[0].height > MAX_PICTURE_PIXELS:
            raise ValueError(f"pictures of {frames[0].width} x {frames[0].height}, which no camera makes")
        yield t_ns, _file(frames[0].to_ndarray(format="rgb24"))


def is_video(start: bytes) -> bool:
    """Whether the first 12 bytes of a file are those of a video file that is read: MP4 or AVI."""
    return start[4:8] == b"ftyp" or (start[:4] == b"RIFF" and start[8:12] == b"AVI ")


class VideoFile:
    """Iterable of the pictures of an MP4 or AVI file as files in the Netpbm form, decoded anew on each iteration.

    Raises InputError when it is no such file; when iterating, if it cannot be decoded or has not `count` pictures.
    """

    def __init__(self, path: Path, count: int) -> None:
        self.path, self._count = path, count
        with open_binary(path) as stream:
            if not is_video(stream.read(12)):
                raise InputError(f"{path}: neither an MP4 nor an AVI file")

    def __iter__(self) -> Iterator[bytes]:
        try:
            needed = "the file has to be whole, its codec one of FFmpeg's, and its table has to have a row for each"
            yield from _decoded_pictures(str(self.path), self._count, "stamps", needed)
        except ValueError as error:
            raise InputError(f"{self.path}: {error}") from error


def _decoded_pictures(name: str, count: int, of: str, needed: str) -> Iterator[bytes]:
    """Yield the `count` pictures of a video as files in the Netpbm form. Raises ValueError if there are not so many."""
    # Remarks on what is damaged would go to the terminal; what matters of them is the number of pictures.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    import cv2

    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    try:
        width, height = (int(video.get(size)) for size in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_PICTURE_PIXELS:
            raise ValueError(f"pictures of {width} x {height}, which no camera makes")
        for i in range(count):
            is_there, pixels = video.read()
            if not is_there:
                raise ValueError(
                    f"only {i} of {count} pictures of the video can be decoded, so that nobody knows which they are: "
                    f"{needed}"
                )
            if i == count - 1 and video.grab():
                raise ValueError(f"the video has more pictures than its {count} {of}")
            yield _file(pixels[:, :, ::-1])
    finally:
        video.release()
