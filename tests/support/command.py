"""The command as tests run it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass
class Run:
    code: int
    out: str
    err: str


Command = Callable[..., Run]
