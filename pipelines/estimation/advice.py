"""A motion that the person recording is asked to make."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Motion:
    """A motion of the device that would improve the recording.

    Attributes:
        words: a sentence, without its capital and its full stop.
        picture: of it, SVG as `alidade.pipelines.display.drawing` draws it; empty: none.
        why: what it is for; empty: that goes without saying.
    """

    words: str
    picture: str = ""
    why: str = ""

    @property
    def advice(self) -> str:
        """Advice as a sentence: why, and which motion."""
        return f"{self.why}: {self.words}" if self.why else self.words
