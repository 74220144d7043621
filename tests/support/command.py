"""The command as tests run it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Run(NamedTuple):
    code: int
    out: str
    err: str


Command = Callable[..., Run]

# Times the usual time limit in the tests' own process.
LONGER = 10.0
