"""Priors of variables as measurements of them: whitened rows about a vector or a rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.model import ROT3, Block, Model, Residuals
from alidade.pipelines.estimation.linear import LinearModel
from alidade.pipelines.estimation.problem import Array, Factor, Parameter, Quantity

# A fixed quantity is held by a prior this much tighter than the accuracy wanted of it.
_PINNED = 1e-6
# A free quantity is held by a prior this much wider than the default one. It adds next to no information, but without
# it a smoother could not even begin where the data do not determine the quantity, or not yet.
_FREE = 10.0


@dataclass(frozen=True)
class RotationPrior(Model):
    """Prior of rotations: R Log(mean^-1 x) is white noise. Block: a rotation.

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
        """Residual (n, 3)."""
        error = so3.log(so3.multiply(so3.inverse(self.mean), rotation))
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
    """The sigma that holds a fixed quantity."""
    return _PINNED * min(quantity.require, quantity.prior_scale)


def vector_prior(parameter: Parameter, mean: Array) -> Factor:
    """Prior on a vector parameter about `mean`, in its own units."""
    return vector_about(parameter.key, mean, prior_sigmas(parameter))


def rotation_prior(parameter: Parameter) -> Factor:
    """Prior on a Rot3 parameter about the identity, sigmas per component of the rotation vector, rad."""
    return rotation_about(parameter.key, so3.identity(), np.diag(1.0 / prior_sigmas(parameter)))


def vector_about(key: int, mean: Array, sigmas: Array | float, family: str = "prior") -> Factor:
    """Prior on a vector variable (d,) about `mean`, with sigmas in its own units."""
    R = np.diag(1.0 / np.broadcast_to(np.asarray(sigmas, dtype=float), mean.shape))
    return Factor.process_of(family, LinearModel(np.zeros(1), (R @ mean)[None], R[None]).on(key))


def rotation_about(key: int, mean: Array, sqrt_information: Array, family: str = "prior") -> Factor:
    """Prior on a Rot3 variable about `mean` (4,), with the square root (3, 3) of its information in its own frame."""
    return Factor.process_of(family, RotationPrior(np.zeros(1), mean[None], sqrt_information[None]).on(key))
