"""Priors of calibration parameters as factors."""

from __future__ import annotations

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.pipelines.estimation.problem import Array, Factor, Parameter, Quantity

# A fixed quantity is held by a prior this much tighter than the accuracy wanted of it.
_PINNED = 1e-6
# A free quantity is held by a prior this much wider than the default one. It adds next to no information, but without
# it a smoother could not even begin where the data do not determine the quantity, or not yet.
_FREE = 10.0


def prior_sigmas(parameter: Parameter) -> Array:
    """(n,) sigmas of the prior factor."""
    return np.array(
        [_FREE * q.prior_scale if q.prior_sigma is None else q.prior_sigma or pinned(q) for q in parameter.quantities]
    )


def pinned(quantity: Quantity) -> float:
    """The sigma that holds a fixed quantity."""
    return _PINNED * min(quantity.require, quantity.prior_scale)


def vector_prior(parameter: Parameter, mean: Array) -> Factor:
    """Prior on a vector parameter about `mean`, in its own units."""
    noise = gtsam.noiseModel.Diagonal.Precisions(prior_sigmas(parameter) ** -2)
    return Factor("prior", gtsam.PriorFactorVector(parameter.key, mean, noise))


def rotation_prior(parameter: Parameter) -> Factor:
    """Prior on a Rot3 parameter about the identity, sigmas per component of the rotation vector, rad."""
    noise = gtsam.noiseModel.Diagonal.Precisions(prior_sigmas(parameter) ** -2)
    return Factor("prior", gtsam.PriorFactorRot3(parameter.key, so3.to_gtsam(so3.identity()), noise))
