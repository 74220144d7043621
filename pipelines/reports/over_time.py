"""Tables of a joint calibration: the recordings, and what they say by themselves."""

from __future__ import annotations

from collections.abc import Sequence

from pipelines.reports.result import Calibration, Plot, Table
from pipelines.reports.units import human_unit, to_digits_of


def recordings_shown(calibration: Calibration) -> Sequence[Plot | Table]:
    """For the report."""
    parts = calibration.recordings
    units = {q.name: human_unit(q) for q in calibration.problem.quantities}

    def shown(value: float, sigma: float, name: str) -> str:
        unit, factor = units.get(name, ("", 1.0))
        number = to_digits_of(factor * value, factor * sigma)
        return f"{number} ± {to_digits_of(factor * sigma, factor * sigma)} {unit.removeprefix('1')}".strip()

    rows = tuple((p.recording, p.start[:16].replace("T", " "), f"{p.duration_s:.0f} s", p.status) for p in parts)
    own = tuple(
        (
            n.name,
            *(next((shown(m.value, m.sigma, m.name) for m in p.parameters if m.name == n.name), "") for p in parts),
        )
        for n in parts[-1].parameters
    )
    heads = tuple(p.recording for p in parts)
    return [
        Table("Recordings", "In the order of their dates, each with its verdict by itself.", _RECORDINGS, rows),
        Table("Of the recordings", "What each recording has of its own, from all of them.", ("parameter", *heads), own),
    ]


_RECORDINGS = ("recording", "start", "length", "by itself")
