"""Factors beside the measurements, whitened when they are built: priors, and linear relations between vectors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.bridge import BoundModel
from alidade.factors.model import ROT3, Block, Model, Residuals
from alidade.pipelines.estimation.problem import Factor, Parameter, Quantity

# A fixed quantity is held by a prior this much tighter than the accuracy wanted of it.
_PINNED = 1e-6
# A free quantity is held by a prior this much wider than the default one. It adds next to no information, but without
# it a smoother could not even begin where the data do not determine the quantity, or not yet.
_FREE = 10.0


@dataclass(frozen=True)
class LinearModel(Model):
    """Measurement model linear in one to three vectors: n measurements of m whitened rows.

    Attributes:
        time: (n,) s; 0 of what is known beforehand.
        right: (n, m) right side.
        first, second, third: (n, m, d) coefficients of each vector; None: there are fewer vectors.
    """

    time: Array
    right: Array
    first: Array
    second: Array | None = None
    third: Array | None = None
    stacked: ClassVar = ("time", "right", "first", "second", "third")

    @property
    def coefficients(self) -> tuple[Array, ...]:
        """Coefficients (n, m, d) of each vector."""
        return tuple(each for each in (self.first, self.second, self.third) if each is not None)

    @property
    def rows(self) -> int:
        """Number m of rows of a residual."""
        return int(self.right.shape[1])

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Sizes of the vector variables."""
        return tuple(int(each.shape[2]) for each in self.coefficients)

    def __call__(self, *vectors: Array) -> Residuals:
        """Evaluate the residuals, sum of A_i x_i minus the right side, (n, m)."""
        parts = [np.einsum("nij,nj->ni", A, x) for A, x in zip(self.coefficients, vectors, strict=True)]
        return sum(parts, start=-self.right), lambda: self.coefficients


@dataclass(frozen=True)
class RotationPrior(Model):
    """Prior of a rotation with white residual R Log(mean^-1 x), where R is square-root information.

    Attributes:
        time: (n,) s.
        mean: (n, 4) w x y z.
        sqrt_information: (n, 3, 3), in the frame that the rotation turns.
    """

    time: Array
    mean: Array
    sqrt_information: Array
    rows: int = 3
    blocks: tuple[Block, ...] = (ROT3,)
    stacked: ClassVar = ("time", "mean", "sqrt_information")

    def __call__(self, rotation: Array) -> Residuals:
        """Evaluate the residuals R Log(mean^-1 x), (n, 3)."""
        error = so3.local(self.mean, rotation)
        return (
            np.einsum("nij,nj->ni", self.sqrt_information, error),
            lambda: (self.sqrt_information @ so3.right_jacobian_inverse(error),),
        )


def prior_sigmas(parameter: Parameter) -> Array:
    """Sigmas (n,) of the prior factor."""
    return np.array(
        [_FREE * q.prior_scale if q.prior_sigma is None else q.prior_sigma or pinned(q) for q in parameter.quantities]
    )


def pinned(quantity: Quantity) -> float:
    """Sigma of the tight prior that stands for a fixed quantity, in the quantity's unit."""
    return _PINNED * min(quantity.require, quantity.prior_scale)


def prior_of(parameter: Parameter) -> Factor:
    """Prior on a parameter about zero, in its own units; on a Rot3 about the identity, in its rotation vector, rad."""
    sigmas = prior_sigmas(parameter)
    if parameter.is_rotation:
        return rotation_about(parameter.key, so3.identity(), np.diag(1.0 / sigmas))
    return vector_about(parameter.key, np.zeros(len(sigmas)), sigmas)


def vector_about(key: int, mean: Array, sigmas: Array | float, family: str = "prior") -> Factor:
    """Prior on a vector variable (d,) about `mean`, with sigmas in its own units."""
    R = np.diag(1.0 / np.broadcast_to(np.asarray(sigmas, dtype=float), mean.shape))
    return Factor.process_of(family, LinearModel(np.zeros(1), (R @ mean)[None], R[None]).on(key))


def rotation_about(key: int, mean: Array, sqrt_information: Array, family: str = "prior") -> Factor:
    """Prior on a Rot3 variable about `mean` (4,), with square-root information (3, 3) in its own frame."""
    return Factor.process_of(family, RotationPrior(np.zeros(1), mean[None], sqrt_information[None]).on(key))


def linear_factor(blocks: Mapping[int, Array], sigma: float) -> BoundModel:
    """Factor 0 = sum of blocks[key] x[key], up to three blocks (m, d), with `sigma` in each of m rows.

    The rows are divided by sigma here. With a noise model beside them gtsam's elimination would take any row whose
    sigma is below 1e-8, in whatever unit, for an exact constraint, which later steps then cannot handle.
    """
    coefficients = [block[None] / sigma for block in blocks.values()]
    return LinearModel(np.zeros(1), np.zeros(coefficients[0].shape[:2]), *coefficients).on(*blocks)
