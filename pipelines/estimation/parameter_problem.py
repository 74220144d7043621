"""Graphs without states: every measurement depends on the shared parameters alone.

parameter_problem("mine", PARAMETERS, config, initial, "increment", model, dropped=data.dropped)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.estimation.parameters import ParameterSpec, check_parameters, quantities
from alidade.pipelines.estimation.priors import rotation_prior, vector_prior
from alidade.pipelines.estimation.problem import (
    ChainLayout,
    Factor,
    Parameter,
    Problem,
    Step,
    rotation_vector_coordinates,
)


def parameter_problem(
    method: str,
    specs: Sequence[ParameterSpec],
    config: Any,
    initial: Mapping[str, ArrayLike],
    family: str,
    model: Any,
    **fields: Any,
) -> Problem:
    """Build the graph of one measurement model over shared parameters, one variable and prior for each spec.

    Args:
        method: its name.
        specs: of the parameters, in the order of the model's blocks; one with a rotation is a Rot3.
        config: priors, data sheets, accuracies wanted.
        initial: name of a spec -> first guess: a quaternion w, x, y, z, a vector or a number.
        family: of the measurements.
        model: alidade.factors.model.Model of all measurements in time order; `model.time` (n,), s.
        fields: of the Problem.

    Raises:
        InputError: the config names an unknown parameter.
    """
    check_parameters(specs, config)
    parameters = tuple(
        Parameter(
            int(gtsam.symbol("P", i)),
            quantities(spec, config),
            **({"coordinates": rotation_vector_coordinates} if spec.rotation else {}),
        )
        for i, spec in enumerate(specs)
    )
    values = gtsam.Values()
    for parameter, spec in zip(parameters, specs, strict=True):
        guess = np.atleast_1d(np.asarray(initial[spec.name], dtype=float))
        values.insert(parameter.key, so3.to_gtsam(guess) if spec.rotation else guess)
    time: Array = model.time

    def steps(chunk: int, after: float = -np.inf) -> Iterator[Step]:
        for begin in range(int(np.searchsorted(time, after, side="right")), len(time), chunk):
            rows = slice(begin, min(begin + chunk, len(time)))
            step = Step(time=float(time[rows.stop - 1]), keyframes=range(rows.start, rows.stop))
            if begin == 0:
                step.initial.insert(values)
                step.factors.extend(_prior(each) for each in parameters)
            some = replace(model, **{name: getattr(model, name)[rows] for name in model.stacked})
            step.factors.append(Factor.of(family, some.on(*(each.key for each in parameters))))
            yield step

    return Problem(method, parameters, steps, steps_after=lambda after: steps(1, after), layout=ChainLayout(), **fields)


def _prior(parameter: Parameter) -> Factor:
    if parameter.is_rotation:
        return rotation_prior(parameter)
    return vector_prior(parameter, np.zeros(len(parameter.quantities)))
