"""The graph of two gyros on one body: rotations over short windows, three variables shared by all of them.

The factor predicts gyro b from gyro a's readings, whose noise looks like motion: about an axis without any the rotation
is reported with a sigma of a few degrees after a minute, less after longer, not with that of its prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.advice import Motion
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.priors import rotation_prior, vector_prior
from alidade.pipelines.estimation.problem import (
    Array,
    ChainLayout,
    Factor,
    Parameter,
    Problem,
    Quantity,
    Step,
    rotation_vector_coordinates,
)
from alidade.pipelines.methods.noise import stated
from alidade.pipelines.settings import DEFAULT_NOISE, Config, check_names, first_given
from gyro_pair.factor import GyroPairFactor
from gyro_pair.published import FARTHEST, align
from gyro_pair.recording import GyroPairData, densities

_ROTATION, _OFFSET, _DIFFERENCE = "rotation", "time_offset", "bias_difference"
_ROTATION_KEY, _OFFSET_KEY, _DIFFERENCE_KEY = (int(gtsam.symbol(c, 0)) for c in "RTd")

# A window lasts this long, s: short against turns; and this many samples: neighbours have parts of a sample in common,
# which is counted twice.
_WINDOW, _SAMPLES = 0.1, 20
_FEWEST_WINDOWS = 10


def problem(data: GyroPairData, config: Config) -> Problem:
    """The graph.

    Raises:
        InputError: the config names no such parameter, or there are fewer than ten windows that both gyros cover.
    """
    parameters = _parameters(config)
    guess = align(data)
    a, b = GyroPath(data.a_t, data.a_gyro), GyroPath(data.b_t, data.b_gyro, guess.difference)
    start, stop = windows(data)
    turns = b.increments(start, stop)
    unseen = turns.unseen + a.increments(start + guess.time_offset, stop + guess.time_offset).unseen
    # What scale errors add, once for each gyro.
    scale = first_given(config.noise.gyro_scale, DEFAULT_NOISE.gyro_scale) * np.linalg.norm(so3.log(turns.wxyz), axis=1)
    variance = sum(density**2 for density in densities(data, config)) * turns.duration + 2.0 * scale**2 + unseen
    measured = GyroPairFactor(stop, start, turns, np.sqrt(variance), a, b)

    initial = gtsam.Values()
    initial.insert(_ROTATION_KEY, so3.to_gtsam(guess.aRb))
    initial.insert(_OFFSET_KEY, np.array([guess.time_offset]))
    initial.insert(_DIFFERENCE_KEY, guess.difference)
    return Problem(
        method="gyro_pair",
        parameters=parameters,
        steps=partial(_steps, measured, parameters, initial),
        steps_after=partial(_steps, measured, parameters, initial, 1),
        advice=_advice,
        dropped=data.dropped,
        noises=(Level(stated("gyro_density", config, data.a_density, ("increment",))),),
        layout=ChainLayout(),
    )


def windows(data: GyroPairData) -> tuple[Array, Array]:
    """Starts and ends, by b's stamps, (n,) s each, of windows that adjoin and lie within a's record for any offset.

    They end in the middle between two samples of b, so that neighbours have next to none in common, and stay where they
    are while a recording grows. Raises InputError when they are too few.
    """
    steps = [float(np.median(np.diff(t))) for t in (data.a_t, data.b_t)]
    stride = int(np.ceil(max(_WINDOW, _SAMPLES * max(steps)) / steps[1]))
    edges = 0.5 * (data.b_t[1:] + data.b_t[:-1])[::stride]
    inside = (edges[:-1] >= data.a_t[0] + FARTHEST) & (edges[1:] <= data.a_t[-1] - FARTHEST)
    if inside.sum() < _FEWEST_WINDOWS:
        raise InputError(
            f"the gyros have {int(inside.sum())} windows of {stride * steps[1]:.2g} s in common, {FARTHEST:g} s from "
            f"the ends of gyro_a's record; at least {_FEWEST_WINDOWS} are needed: record longer, or check the clocks"
        )
    return edges[:-1][inside], edges[1:][inside]


def _parameters(config: Config) -> tuple[Parameter, ...]:
    """The three variables with their priors."""

    def quantity(name: str, unit: str, scale: float, require: float) -> Quantity:
        return Quantity(name, unit, config.prior(name, scale), scale, config.require.get(name, require))

    def triple(name: str, unit: str, scale: float, require: float) -> tuple[Quantity, ...]:
        return tuple(quantity(f"{name}_{axis}", unit, scale, require) for axis in "xyz")

    parameters = (
        Parameter(_ROTATION_KEY, triple(_ROTATION, "rad", np.pi, 1e-3), rotation_vector_coordinates),
        Parameter(_OFFSET_KEY, (quantity(_OFFSET, "s", 0.1, 5e-4),)),
        Parameter(_DIFFERENCE_KEY, triple(_DIFFERENCE, "rad/s", 0.1, 2e-4)),
    )
    names = [q.name for p in parameters for q in p.quantities]
    check_names(config.priors, names, "priors")
    check_names(config.require, names, "require")
    return parameters


def _steps(
    measured: GyroPairFactor,
    parameters: tuple[Parameter, ...],
    initial: gtsam.Values,
    chunk: int,
    after: float = -np.inf,
) -> Iterator[Step]:
    """`chunk` windows at a time; the first step brings the variables and their priors too."""
    rotation, offset, difference = parameters
    for begin in range(int(np.searchsorted(measured.time, after, side="right")), len(measured.time), chunk):
        rows = range(begin, min(begin + chunk, len(measured.time)))
        step = Step(time=float(measured.time[rows[-1]]), keyframes=rows)
        if begin == 0:
            step.initial.insert(initial)
            step.factors.append(rotation_prior(rotation))
            step.factors.extend([vector_prior(offset, np.zeros(1)), vector_prior(difference, np.zeros(3))])
        step.factors.append(_factor(measured, slice(rows.start, rows.stop)))
        yield step


def _factor(measured: GyroPairFactor, rows: slice) -> Factor:
    """Some of the windows, tied to the three variables."""
    some = {name: getattr(measured, name)[rows] for name in measured.stacked}
    return Factor.of("increment", replace(measured, **some).on(_ROTATION_KEY, _OFFSET_KEY, _DIFFERENCE_KEY))


def _advice(weights: Mapping[str, float]) -> Motion:
    """The motion that would make a weak direction observable."""
    strong = [name for name, weight in weights.items() if abs(weight) > 0.3]
    if any(name.startswith(_ROTATION) for name in strong):
        return Motion(
            "turn the body about one axis, then about another",
            swaying("xy", "body"),
            "the rotation needs motion about two axes",
        )
    if _OFFSET in strong:
        return Motion("turn the body back and forth within a second", why="the time offset needs changing rates")
    return Motion("record longer", why="the bias difference is not determined yet")
