"""Raw pictures as files in the Netpbm form, which any decoder of pictures takes: a line of text and the pixels."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]

# Channels, and the order of those that are red, green, blue.
_COLOURS = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "8UC3": (3, [2, 1, 0]),
}
_GREY = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
# Two pixels in four bytes; which of them are brightness.
_YUV = {"yuv422": 1, "uyvy": 1, "UYVY": 1, "yuv422_yuy2": 0, "yuyv": 0, "YUYV": 0}
# Where red is in a square of four pixels, row and column.
_RED = {"rggb": (0, 0), "bggr": (1, 1), "gbrg": (1, 0), "grbg": (0, 1)}
_BAYER = re.compile("bayer_(?P<pattern>rggb|bggr|gbrg|grbg)(?P<bits>8|16)")
_LARGEST = 1 << 28


def netpbm(image: Any) -> bytes:
    """A sensor_msgs/msg/Image as a file: grey, or in colour, with 8 bits.

    Of pictures with 16 bits the upper ones that are used are kept, 8 of them. Raises ValueError where the encoding is
    another, or the size does not agree with the data.
    """
    encoding, data = str(image.encoding), np.asarray(image.data, np.uint8)
    height, width, step = int(image.height), int(image.width), int(image.step)
    if encoding in _GREY:
        pixels = _rows(data, height, width * np.dtype(_GREY[encoding]).itemsize, step)
        if _GREY[encoding] == "u2":
            return _file(_eight_bits(pixels.view(">u2" if image.is_bigendian else "<u2")))
        return _file(pixels)
    if encoding in _COLOURS:
        channels, order = _COLOURS[encoding]
        pixels = _rows(data, height, width * channels, step).reshape(height, width, channels)
        return _file(pixels[:, :, order])
    if encoding in _YUV:
        return _file(_rows(data, height, 2 * width, step)[:, _YUV[encoding] :: 2])
    bayer = _BAYER.fullmatch(encoding)
    if bayer is None:
        raise ValueError(f"the encoding {encoding!r} is not one of mono, rgb, bgr, rgba, bgra, bayer, yuv422")
    is_wide = bayer["bits"] == "16"
    pixels = _rows(data, height, width * (2 if is_wide else 1), step)
    if is_wide:
        pixels = _eight_bits(pixels.view(">u2" if image.is_bigendian else "<u2"))
    return _file(_colours(pixels, _RED[bayer["pattern"]]))


def colour_file(rgb: Pixels) -> bytes:
    """A picture (height, width, 3) of 8 bits as a file."""
    return _file(np.ascontiguousarray(rgb))


def _rows(data: NDArray[np.uint8], height: int, used: int, step: int) -> NDArray[np.uint8]:
    """The bytes that are used of each row."""
    if not 0 < used <= step or height <= 0 or height * step != len(data) or len(data) > _LARGEST:
        raise ValueError(f"{height} rows of {step} bytes with {used} used, in {len(data)} bytes of data")
    return np.ascontiguousarray(data.reshape(height, step)[:, :used])


def _eight_bits(pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The upper 8 bits of those that the picture uses: cameras with 10 or 12 bits leave the highest ones zero."""
    shift = max(0, int(pixels.max()).bit_length() - 8)
    return (pixels >> shift).astype(np.uint8)


def _colours(pixels: NDArray[np.uint8], red: tuple[int, int]) -> Pixels:
    """Red, green and blue of a Bayer picture, with red at (row, column) of each square of four."""
    import cv2

    # OpenCV names a pattern by the square that begins at the second row and column.
    codes = {
        (0, 0): cv2.COLOR_BayerBG2RGB,
        (1, 1): cv2.COLOR_BayerRG2RGB,
        (1, 0): cv2.COLOR_BayerGR2RGB,
        (0, 1): cv2.COLOR_BayerGB2RGB,
    }
    return np.asarray(cv2.cvtColor(pixels, codes[red]))


def _file(pixels: Pixels) -> bytes:
    kind = "P5" if pixels.ndim == 2 else "P6"
    return f"{kind} {pixels.shape[1]} {pixels.shape[0]} 255\n".encode() + pixels.tobytes()
