"""Motions with one more sway, to be tried when planning a recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

Motion = dict[str, Any]


def sways(motion: Mapping[str, Sequence[Any]] | None, sway: Mapping[str, float]) -> Iterator[tuple[str, Motion]]:
    """A motion with one more sway about each axis."""
    for i, axis in enumerate(("yaw", "pitch", "roll")):
        # Sways of one frequency on two axes would be one sway about an axis between them.
        more = {**sway, "frequency_hz": round(sway["frequency_hz"] + 0.04 * i, 3)}
        now: dict[str, Sequence[Any]] = {"yaw": [], "pitch": [], "roll": [], **(motion or {})}
        words = f"sway by {more['amplitude_deg']:g} deg at {more['frequency_hz']:g} Hz in {axis}"
        yield words, {**now, axis: [*now[axis], more]}
