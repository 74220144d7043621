"""Linear factors between vector variables, whitened when they are built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from alidade.pipelines.estimation.problem import Array


def linear_factor(
    blocks: Mapping[int, Array], origin: Mapping[int, Array], sigma: float
) -> gtsam.LinearContainerFactor:
    """The measurement 0 = sum of blocks[key] (x[key] - origin[key]), with `sigma` in each of its m rows.

    The rows are divided by sigma here. With a noise model beside them gtsam's elimination would take any row whose
    sigma is below 1e-8, in whatever unit, for an exact constraint, which later steps then cannot handle.

    Args:
        blocks: up to three variables and their coefficients (m, d).
        origin: variable -> (d,).
        sigma: of each row, in the unit of the rows.
    """
    terms = [part for key, block in blocks.items() for part in (key, block / sigma)]
    rows = len(next(iter(blocks.values())))
    values = gtsam.Values()
    for key in blocks:
        values.insert(key, origin[key])
    return _container(terms, np.zeros(rows), values)


def rescaled(factor: gtsam.LinearContainerFactor, scale: float) -> gtsam.LinearContainerFactor:
    """A factor of linear_factor, between variables of one size, with the sigma of its rows times `scale`."""
    keys = list(factor.keys())
    size = factor.toJacobian().getA().shape[1] // len(keys)
    zero = gtsam.Values()
    for key in keys:
        zero.insert(key, np.zeros(size))
    linear: Any = factor.linearize(zero)
    A, b = linear.getA() / scale, linear.getb() / scale
    terms = [part for i, key in enumerate(keys) for part in (key, A[:, size * i : size * (i + 1)])]
    return _container(terms, b, zero)


def _container(terms: Sequence[Any], b: Array, values: gtsam.Values) -> gtsam.LinearContainerFactor:
    """Whitened rows about the values: keys and blocks by turns, and the right side."""
    jacobian: Any = gtsam.JacobianFactor  # its stubs cannot be called with as many blocks as there are
    return gtsam.LinearContainerFactor(jacobian(*terms, b, gtsam.noiseModel.Unit.Create(len(b))), values)
