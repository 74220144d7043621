"""Errors of measurements that are a smooth function of where they are made, as nuisance parameters of a problem.

A map is sum_j f_j c_j, with f the low-order harmonics of an attitude (entries of its matrix) or of gimbal angles
(sines, cosines and their products). Over the measurements of a recording the f have mean 0, since a constant error is a
mount, are uncorrelated and of rms 1: principal components of the harmonics. So each c is the rms of an error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.factors.model import Block, Model, Residuals, WrappedModel
from alidade.factors.through_gimbal import GimbalMap, ThroughGimbalFactor
from alidade.pipelines.estimation.priors import prior_of
from alidade.pipelines.estimation.problem import (
    Estimate,
    Factor,
    Parameter,
    Problem,
    Quantity,
    SqrtInformation,
    Step,
    changed,
)
from alidade.pipelines.estimation.widening import widened

# Components of harmonics below this share of the largest one's rms are of high order, or noise.
_LEAST = 0.01
# The data sheet that it is on, and the unit of its numbers.
SHEET, UNIT = "camera.map", "rad"
# Of a variance, in the budget.
SOURCE = "errors by where measurements are made"


@dataclass(frozen=True)
class ErrorMapFactor(WrappedModel):
    """Measurement model plus an error linear in given functions of attitude or gimbal angles.

    The first `axes` numbers of measurement i are larger by e_i = sum_j f_ij c_j, so that its residual is that of the
    model less sqrt_information e_i; of a rotation to first order in e_i times the noise. Blocks: those of the model,
    then c, k times `axes` numbers, function by function, in the unit of the measurements.

    Attributes:
        model: of n measurements, with their `sqrt_information`, (n, m, m).
        functions: (n, k) f_ij.
        axes: how many numbers of a measurement have such errors.
    """

    functions: Array
    axes: int
    stacked: ClassVar = ("model", "functions")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the model, then the map's coefficients c."""
        return (*self.model.blocks, self.functions.shape[1] * self.axes)

    def __call__(self, *blocks: Array) -> Residuals:
        """Evaluate the whitened residuals (n, m): those of the model less the whitened error of the map."""
        *own, c = blocks
        residuals, jacobians = self.model(*own)
        weight = self.model.sqrt_information[:, :, : self.axes]
        n, k = self.functions.shape
        error = np.einsum("nk,nka->na", self.functions, c.reshape(n, k, self.axes))

        def all_jacobians() -> tuple[Array, ...]:
            by_c = -weight[:, :, None] * self.functions[:, None, :, None]
            return (*jacobians(), by_c.reshape(n, self.rows, -1))

        return residuals - np.einsum("nma,na->nm", weight, error), all_jacobians


@dataclass(frozen=True, eq=False)
class ErrorMap:
    """Smooth map of systematic errors over position, which measurements of some families may share.

    Attributes:
        name, axes: its parameters are named after it and the axes, a letter each.
        prior: sigma of each, in force.
        stated: that of the data sheet.
        families: of the measurements.
        time: (n,) their times, s, increasing.
        functions: (n, k) of mean 0 and rms 1.
        places: where each measurement was made, name -> (n,), rad, to be drawn.
        moves: whether it moves an estimate; else it may be an error of other sensors as well, and widens sigmas alone.
        least: sigma of each that is assumed where a recording shows no map.
        slopes: (n, k, places) derivatives of the functions by the places, where these are the angles of a gimbal that
            the gyro drives; else None.
    """

    name: str
    axes: str
    prior: float
    stated: float
    families: tuple[str, ...]
    time: Array
    functions: Array
    places: Mapping[str, Array]
    moves: bool = True
    least: float = 0.0
    slopes: Array | None = None

    @classmethod
    def of(
        cls,
        name: str,
        axes: str,
        prior: float,
        families: tuple[str, ...],
        time: Array,
        harmonics: Array,
        places: Mapping[str, Array],
        moves: bool = True,
        least: float = 0.0,
        slopes: Array | None = None,
    ) -> ErrorMap | None:
        """Build the map's functions from harmonics (n, h) at the measurements, and slopes (n, h, places).

        None where it is fixed, or nothing varies.
        """
        centred = harmonics - harmonics.mean(axis=0)
        U, sizes, V = np.linalg.svd(centred, full_matrices=False)
        kept = sizes > max(_LEAST * sizes.max(initial=0.0), np.finfo(float).eps * len(time))
        if prior == 0.0 or not kept.any():
            return None
        order = np.argsort(time, kind="stable")
        functions, places = U[:, kept] * np.sqrt(len(time)), {place: x[order] for place, x in places.items()}
        if slopes is not None:
            slopes = np.einsum("nhp,kh->nkp", slopes[order], V[kept] * (np.sqrt(len(time)) / sizes[kept, None]))
        return cls(name, axes, prior, prior, families, time[order], functions[order], places, moves, least, slopes)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the map's parameters, function by function."""
        return tuple(f"{self.name}_{axis}_{j + 1}" for j in range(self.functions.shape[1]) for axis in self.axes)

    @property
    def parameter(self) -> Parameter:
        """Graph variable of the map's coefficients."""
        numbers = self.prior, self.stated, math.inf
        quantities = (Quantity(name, UNIT, *numbers, group="assumption", sheet=SHEET) for name in self.names)
        return Parameter(int(gtsam.symbol("M", 0)), tuple(quantities))

    def of_model(self, family: str, model: Any) -> Model | None:
        """Extend a family's model by the map as a variable; None where the map does not enter the model."""
        at = np.minimum(np.searchsorted(self.time, model.time), len(self.time) - 1)
        mapped = ErrorMapFactor(model, self.functions[at], len(self.axes)) if family in self.families else None
        if self.slopes is None or (mapped is None and family != "gyro"):
            return mapped
        gimbal = np.column_stack(list(self.places.values()))[at]
        errors = GimbalMap(self.functions[at], self.slopes[at])
        if mapped is None:
            return ThroughGimbalFactor(model, gimbal, errors, following=model.following)
        return ThroughGimbalFactor(mapped, gimbal, errors, model.encoder, error_blocks=(len(model.blocks),))

    def error(self, c: Array) -> Array:
        """Evaluate the map's errors (n, axes) of the measurements."""
        return np.asarray(self.functions @ c.reshape(self.functions.shape[1], -1))

    def added_to(self, problem: Problem) -> Problem:
        """Return the problem with the map as a free parameter, to be solved as a whole."""
        parameter = self.parameter
        return replace(
            problem,
            parameters=(*problem.parameters, parameter),
            steps=lambda chunk: self._steps(problem.steps(chunk), parameter),
            steps_after=None,
            continuation=None,
            refined_graph=changed(problem.refined_graph, self.added_to),
            error_map=None,
        )

    def _steps(self, steps: Iterator[Step], parameter: Parameter) -> Iterator[Step]:
        for number, step in enumerate(steps):
            factors, initial = [self._with_map(factor, parameter.key) for factor in step.factors], step.initial
            if number == 0:
                initial = gtsam.Values(step.initial)
                initial.insert(parameter.key, np.zeros(len(parameter.quantities)))
                factors.append(prior_of(parameter))
            yield replace(step, initial=initial, factors=factors)

    def _with_map(self, factor: Factor, key: int) -> Factor:
        bound = factor.bound
        model = None if bound is None else self.of_model(factor.family, bound.model)
        if bound is None or model is None:
            return factor
        return factor.rebound(model.on(*bound.tied, key, loss=bound.loss))


@dataclass(frozen=True, eq=False)
class FoundMap:
    """A significant error map, with its effect on an estimate of n numbers.

    Attributes:
        map: with the prior in force, wider than its data sheet where that is too small.
        error: (n, axes) of the measurements, in the unit of the map.
        chi_square, dof: of the score test, at the levels found with it.
        names: of the estimate's numbers.
        shift: (n,) by which correcting the errors moves them.
        columns: (n, m) S: its uncertainty adds S S' to their covariance.
    """

    map: ErrorMap
    error: Array
    chi_square: float
    dof: int
    names: tuple[str, ...]
    shift: Array
    columns: Array

    @property
    def rms(self) -> float:
        """Root mean square of the map's errors per axis, in the unit of the map."""
        return float(np.sqrt(np.square(self.error).mean()))

    def applied(self, estimate: Estimate) -> Estimate:
        """Return the estimate, made without the map, with the map's shift and covariance applied."""
        out = widened(estimate, SOURCE, self.columns)
        if not self.map.moves:
            return out
        sqrt_info = None if out.sqrt_info is None else self.moved(out.sqrt_info)
        return replace(out, values=out.values + self.shift, sqrt_info=sqrt_info)

    def moved(self, sqrt_info: SqrtInformation) -> SqrtInformation:
        """Shift a recording's square-root information, made without the map, by the map's correction of its numbers."""
        shift = dict(zip(self.names, self.shift.tolist(), strict=True))
        return replace(sqrt_info, at=sqrt_info.at + [shift[name] for name in sqrt_info.names])
