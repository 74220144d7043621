"""What a simulator hands over: a recording's data in memory, with its truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

# 2026-11-20 12:00 UTC: simulated recordings start here; and the year of that day for the field model.
EPOCH_NS, YEAR = 1_795_176_000_000_000_000, 2026.8849315068493


@dataclass(frozen=True, eq=False, repr=False)
class Simulated:
    """A simulated recording.

    Attributes:
        data: what its method reads from such a recording.
        truth: parameter -> true value, SI.
        config: the recording's config, YAML: the noise that was simulated and what else the scenario says.
        pictures: as the method writes them in place of what is measured in them; None without.
    """

    data: Any
    truth: Mapping[str, float]
    config: str
    pictures: Any = None

    def __iter__(self) -> Iterator[Any]:
        """Data and truth: `data, truth = simulate(...)`."""
        return iter((self.data, self.truth))

    def __repr__(self) -> str:
        """One line."""
        return f"<Simulated {type(self.data).__name__}, {len(self.truth)} true parameters>"
