"""Sensors with errors, for simulators: true values of assumptions, and what such a gyro reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.estimation.assumptions import Assumption, quantities
from alidade.pipelines.settings import Config, Sensors

Array = NDArray[np.float64]


def true_values(
    assumptions: Sequence[Assumption],
    sensors: Sensors | None,
    given: Mapping[str, float],
    rng: np.random.Generator,
) -> dict[str, float]:
    """A value for each parameter: as given, else drawn from the prior that data sheets make, else 0 for perfect ones.

    Raises InputError, naming the nearest known name, for one given that is not known.
    """
    config = Config(sensors=sensors or Sensors())
    known = [q for assumption in assumptions for q in quantities(assumption, config)]
    drawn = {q.name: float((q.prior_sigma or 0.0) * rng.standard_normal()) if sensors else 0.0 for q in known}
    for name in given:
        if name not in drawn:
            raise InputError(f"unknown key effects.{name}{nearest(name, list(drawn))}")
    return {**drawn, **given}


def read_by(rate: Array, sensor: str, values: Mapping[str, float], force: Array | None = None) -> Array:
    """What a gyro of known errors reads, without bias and noise: (I + S) w + G f, (n, 3) rad/s."""
    x, y, z = (values[f"{sensor}_scale_{axis}"] for axis in "xyz")
    xy, xz, yz = (values[f"{sensor}_skew_{axes}"] for axes in ("xy", "xz", "yz"))
    read = rate + rate @ np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]])
    if force is not None:
        read = read + force @ np.array([[values[f"{sensor}_g_{row}{column}"] for row in "xyz"] for column in "xyz"])
    return np.asarray(read)
