"""A sensor that warms up, for simulators: its temperature, and what that does to its readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from alidade.pipelines.estimation.assumptions import Assumption
from alidade.pipelines.recording.streams import Temperature

Array = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0.0)]


class Warming(BaseModel):
    """What a sensor's temperature does: it goes from one to another, slower and slower."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start_c: Annotated[float, Field(ge=-100.0, le=200.0)] = 20.0
    rise_k: Annotated[float, Field(ge=-100.0, le=100.0)] = 10.0  # after a long time
    time_constant_s: Positive = 40.0
    rate_hz: Annotated[float, Field(ge=0.1)] = 2.0  # of the messages

    def at(self, t: Array) -> Array:
        """Temperatures (n,) at times (n,), s, degrees Celsius."""
        return np.asarray(self.start_c - self.rise_k * np.expm1(-t / self.time_constant_s))

    def measured(self, duration: float) -> Temperature:
        """What messages say of it, s from the start on until the end."""
        t = np.arange(np.floor(duration * self.rate_hz) + 1.0) / self.rate_hz
        return Temperature(t, self.at(t))


def measured(warming: Warming | None, duration: float) -> Temperature | None:
    """What messages say; None without a topic."""
    return None if warming is None else warming.measured(duration)


def known(assumptions: Sequence[Assumption], warming: Warming | None) -> list[Assumption]:
    """Without those about a temperature, where there is none."""
    return [each for each in assumptions if warming is not None or each.figure != "temperature"]


def drift(warming: Warming | None, sensor: str, values: Mapping[str, float], t: Array) -> Array:
    """What a sensor reads too much at times t (n,), s, (n, 3): its slopes times what it is warmer than at first."""
    if warming is None:
        return np.zeros((len(t), 3))
    slope = np.array([values[f"{sensor}_temperature_{axis}"] for axis in "xyz"])
    return np.asarray(np.outer(warming.at(t) - warming.start_c, slope))
