"""H.264 video, a message a picture, as files of its pictures: OpenCV's FFmpeg decodes it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator

from pipelines.recording.netpbm import colour_file

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
    # FFmpeg's remarks on damaged pictures would go to the terminal; what matters of them is the number of pictures.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    import cv2

    stamps = []
    with tempfile.NamedTemporaryFile(prefix="alidade-", suffix=".h264") as whole:
        for t_ns, data in packets:
            # FFmpeg goes by what a file begins with, and other forms name files of their own to be read.
            if not data.startswith(_STARTS):
                raise ValueError("a message of the video is no H.264 (Annex B)")
            whole.write(data)
            stamps.append(t_ns)
        whole.flush()
        video = cv2.VideoCapture(whole.name, cv2.CAP_FFMPEG)
        width, height = (int(video.get(size)) for size in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        try:
            if width * height > _LARGEST:
                raise ValueError(f"pictures of {width} x {height}, which no camera makes")
            for i, t_ns in enumerate(stamps):
                is_there, pixels = video.read()
                if not is_there:
                    raise ValueError(
                        f"only {i} of {len(stamps)} pictures of the video can be decoded, so that nobody knows which "
                        "they are: it has to begin with a key picture, and a message has to be a picture"
                    )
                yield t_ns, colour_file(pixels[:, :, ::-1])
            if video.grab():
                raise ValueError(f"the video has more pictures than its {len(stamps)} messages")
        finally:
            video.release()
