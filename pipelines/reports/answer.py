"""What a page says first: the question it is for, the answer, and what to do next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Tone = Literal["good", "warn", "bad", "fixed"]


@dataclass(frozen=True)
class Answer:
    """The first box of a page.

    Attributes:
        question: that the page answers.
        word: the answer, in a word or a few.
        tone: good, warn, bad, or fixed where it is neither.
        sentence: the answer, in words.
        notes: what a reader has to know beside it, without full stops.
        next: what to do now, one sentence each.
    """

    question: str
    word: str
    tone: Tone
    sentence: str
    notes: tuple[str, ...] = ()
    next: tuple[str, ...] = ()
