"""An address as a QR code in a terminal, for a phone's camera."""

from __future__ import annotations

import numpy as np
from rich.text import Text

# Readers want four light modules around the code; the encoder leaves two.
_QUIET = 2
# Two modules above each other are one character, by whether the upper and the lower one are dark.
_HALVES = {(False, False): " ", (True, False): "▀", (False, True): "▄", (True, True): "█"}


def qr(address: str) -> Text:
    """Dark on light whatever the terminal's own colours are."""
    import cv2  # takes long, and most runs show no code

    dark = np.pad(cv2.QRCodeEncoder.create().encode(address) == 0, _QUIET)
    rows = dark if len(dark) % 2 == 0 else np.vstack([dark, np.zeros_like(dark[:1])])
    lines = [
        "".join(_HALVES[bool(a), bool(b)] for a, b in zip(upper, lower, strict=True))
        for upper, lower in zip(rows[::2], rows[1::2], strict=True)
    ]
    return Text("\n".join(lines), style="black on white", no_wrap=True)
