"""Videos as files of their pictures: H.264, a message a picture, and files. OpenCV's FFmpeg decodes them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.netpbm import colour_file

# How the formats of messages are called; what is read, and what else a video may be.
H264 = ("h264", "avc", "x264", "libx264")
OTHERS = ("h265", "hevc", "vp8", "vp9", "av1")
_LARGEST = 1 << 26
# What a message of H.264 begins with (Annex B of ITU-T H.264).
_STARTS = (b"\0\0\1", b"\0\0\0\1")


def decoded(packets: Iterable[tuple[int, bytes]]) -> Iterator[tuple[int, bytes]]:
    """(stamp, file in the Netpbm form) of each (stamp, message): one picture a message, none out of order.

    Raises ValueError where that is not what the messages are, or nothing of them can be decoded.
    """
    stamps = []
    with tempfile.NamedTemporaryFile(prefix="alidade-", suffix=".h264") as whole:
        for t_ns, data in packets:
            # FFmpeg goes by what a file begins with, and other forms name files of their own to be read.
            if not data.startswith(_STARTS):
                raise ValueError("a message of the video is no H.264 (Annex B)")
            whole.write(data)
            stamps.append(t_ns)
        whole.flush()
        needed = "it has to begin with a key picture, and a message has to be a picture"
        yield from zip(stamps, _pictures(whole.name, len(stamps), "messages", needed), strict=True)


def is_video(start: bytes) -> bool:
    """Whether a file that begins so, 12 bytes, is one of the video files that are read: MP4 or AVI."""
    return start[4:8] == b"ftyp" or (start[:4] == b"RIFF" and start[8:12] == b"AVI ")


class VideoFile:
    """The pictures of an MP4 or AVI file as files in the Netpbm form, one by one and anew each time.

    Args:
        path: of the file.
        count: pictures there have to be.

    Raises:
        InputError: it is no such file; when iterating, it cannot be decoded or has more or fewer pictures.
    """

    def __init__(self, path: Path, count: int) -> None:
        self.path, self._count = path, count
        try:
            with path.open("rb") as stream:
                start = stream.read(12)
        except OSError as error:
            raise InputError(f"{path}: cannot be opened ({error.strerror})") from error
        if not is_video(start):
            raise InputError(f"{path}: neither an MP4 nor an AVI file")

    def __iter__(self) -> Iterator[bytes]:
        try:
            needed = "the file has to be whole, its codec one of FFmpeg's, and its table has to have a row for each"
            yield from _pictures(str(self.path), self._count, "stamps", needed)
        except ValueError as error:
            raise InputError(f"{self.path}: {error}") from error


def _pictures(name: str, count: int, of: str, needed: str) -> Iterator[bytes]:
    """The pictures of a video, which there are `count` of. Raises ValueError otherwise, with what is needed."""
    # Remarks on what is damaged would go to the terminal; what matters of them is the number of pictures.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    import cv2

    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    try:
        width, height = (int(video.get(size)) for size in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > _LARGEST:
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
            yield colour_file(pixels[:, :, ::-1])
    finally:
        video.release()
