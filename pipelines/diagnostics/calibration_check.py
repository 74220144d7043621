"""Whether an earlier calibration still holds on a recording.

What the recording says of the device is held against what the earlier calibration says, as two recordings of one device
are: the step of every parameter from one to the other, with the priors counted once. The recording's own numbers, its
bias and its time offset, are its own.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from alidade.pipelines.belief import Belief
from alidade.pipelines.diagnostics.device_changes import Change, Changes, changes
from alidade.pipelines.estimation.problem import Quantity, Told
from alidade.pipelines.solvers.joint import join
from alidade.pipelines.solvers.told import told_of

Verdict = Literal["holds", "changed", "unknown", "same"]


@dataclass(frozen=True)
class Holding:
    """What a recording says of an earlier calibration.

    Attributes:
        changes: of the parameters between the two.
        quantities: the parameters, by name.
    """

    changes: Changes
    quantities: Mapping[str, Quantity]

    @property
    def verdict(self) -> Verdict:
        """Unknown where the recording determines no parameter that could be compared."""
        if not self.changes.steps:
            return "unknown"
        return "changed" if self.changes.any else "holds"

    @property
    def steps(self) -> Sequence[Change]:
        """Of every parameter, those found as they are with all of them."""
        found = {step.name: step for step in self.changes.found}
        return [found.get(step.name, step) for step in self.changes.steps]

    @property
    def matters(self) -> bool:
        """Whether a parameter that changed did by more than is required of it."""
        return any(abs(step.size) > self.quantities[step.name].require for step in self.changes.found)


def holding(known: Belief, told: Told, quantities: Sequence[Quantity], inflations: Mapping[str, float]) -> Holding:
    """An earlier calibration beside what a recording says.

    Args:
        known: of the device, from the earlier calibration; no number is exactly known.
        told: what the recording says.
        quantities: of the recording's graph.
        inflations: by what the recording's sigmas are larger because noise is coloured.
    """
    by_name = {q.name: q for q in quantities}
    known = known.of(told.names)
    rates = dict.fromkeys([*known.names, *_of_device(told)], 0.0)
    before = told_of(known, [by_name[name].prior_scale for name in known.names])
    joined = join([before, told], rates, [0.0, 1.0])
    asked = {name for name in known.names if by_name[name].judged}
    return Holding(changes(joined, [0.0, 1.0], inflations, asked), by_name)


def _of_device(told: Told) -> Collection[str]:
    """The numbers whose priors are set apart."""
    about = (told.prior_R != 0.0).any(axis=0)
    return [name for name, yes in zip(told.names, about, strict=True) if yes]
