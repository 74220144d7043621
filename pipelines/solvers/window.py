"""Window of the incremental solver: it keeps states for some seconds, keyframes, or for ever."""

from __future__ import annotations

import numbers

from alidade.pipelines.errors import InputError

# After a number of keyframes.
_KEYFRAMES = "kf"


class Keyframes(int):
    """Window length as a number of keyframes; a plain number counts seconds."""

    def __str__(self) -> str:
        return f"{int(self)}{_KEYFRAMES}"


Window = Keyframes | float | None


def check_window(window: object) -> None:
    """Raise InputError unless a window is a positive length or None."""
    if window is not None and not (isinstance(window, numbers.Real) and 0.0 < float(window) < float("inf")):
        raise InputError(f"window: {window!r}; seconds above zero are needed, or None for the whole history")


def parse_window(text: str) -> Window:
    """Parse `--window`: seconds, keyframes ("50kf"), or None for "all". Raises InputError."""
    if text == "all":
        return None
    number, read = (text.removesuffix(_KEYFRAMES), Keyframes) if text.endswith(_KEYFRAMES) else (text, float)
    try:
        length: Keyframes | float = read(number)
    except ValueError:
        length = 0.0
    if not 0.0 < length < float("inf"):
        raise InputError(f"--window {text}: seconds above zero are needed, keyframes such as 50kf, or 'all'")
    return length
