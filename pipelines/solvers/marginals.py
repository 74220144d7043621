"""Joint marginal covariance of the parameters from a linearised graph."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.problem import Array, Factor, Parameter, Problem
from alidade.pipelines.solvers.chain import IndeterminateError as IndeterminateError

if TYPE_CHECKING:
    from alidade.pipelines.solvers.system import Linear

# A direction the data and priors say nothing about gets this many times its prior scale as sigma, so that it can be
# named with the others instead of making the system unsolvable.
_UNKNOWN = 1e4


def reported(problem: Problem, values: gtsam.Values, current_keys: Mapping[int, int]) -> Array:
    """The numbers of all parameters at the values."""
    return np.concatenate([p.coordinates(values, current_keys.get(p.key, p.key))[0] for p in problem.parameters])


def ordering_of(keys: Iterable[int]) -> gtsam.Ordering:
    """The keys as gtsam's ordering."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def joint_covariance(
    problem: Problem, about: Linear, current_keys: Mapping[int, int], noise: Array | None = None
) -> Array:
    """Covariance (n, n) of the reported numbers, everything else marginalised out; works for singular systems.

    `noise` is information that counts for nothing.

    Raises:
        IndeterminateError: another variable is undetermined.
    """
    keys = [current_keys.get(p.key, p.key) for p in problem.parameters]
    return reported_covariance(problem.parameters, about.information(keys), about.values, keys, noise)


def joint_information(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, keys: Sequence[int]) -> Array:
    """Information (d, d) of some variables, in their order, everything else marginalised out.

    Raises:
        IndeterminateError: another variable is undetermined.
    """
    information, _ = marginal(linear, ordering, keys).hessian(ordering_of(keys))
    return np.asarray(information)


def information_of(covariance: Array) -> Array:
    """The inverse (d, d) of a covariance.

    By its eigenvalues, in units of its own sigmas: where some directions are known a million times better than others,
    the inverse by elimination has less information than none about these. Raises LinAlgError if it is not finite.
    """
    sigmas = np.sqrt(np.diag(covariance))
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(sigmas, sigmas))
    eigenvalues = np.maximum(eigenvalues, np.finfo(float).eps * eigenvalues[-1])
    return np.asarray((vectors / eigenvalues) @ vectors.T / np.outer(sigmas, sigmas))


def marginal(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, keys: Sequence[int]
) -> gtsam.GaussianFactorGraph:
    """What a system says of some variables, everything else marginalised out.

    Raises:
        IndeterminateError: another variable is undetermined.
    """
    kept = set(keys)
    rest = [key for key in (ordering.at(i) for i in range(ordering.size())) if key not in kept]
    return eliminated(linear, ordering_of(rest))[1] if rest else linear


def eliminated(
    linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> tuple[gtsam.GaussianBayesTree, gtsam.GaussianFactorGraph]:
    """All or some variables of a system eliminated in order, and what that leaves of it.

    By QR: tight processes beside loose priors cost Cholesky its digits, and with them the whole system.

    Raises:
        IndeterminateError: a variable is not determined; names it.
    """
    try:
        tree, left = linear.eliminatePartialMultifrontal(ordering, gtsam.EliminateQR)
    except RuntimeError as error:
        raise IndeterminateError(explain(str(error))) from None
    return tree, left


def reported_covariance(
    parameters: Sequence[Parameter],
    information: Array,
    values: gtsam.Values,
    keys: Sequence[int],
    noise: Array | None = None,
    blocks: dict[int, Array] | None = None,
) -> Array:
    """Covariance of the reported numbers from the information matrix of the variables' tangents, in this order.

    `noise` is as joint_covariance has it, `blocks` as coordinate_inverse.
    """
    quantities = [q for p in parameters for q in p.quantities]
    free, scale, unit = prior_units(parameters, values, keys, blocks)
    extra = np.array([quantities[i].extra_sigma for i in free])
    own = unit.T @ information @ unit
    eigenvalues, vectors = np.linalg.eigh(own if noise is None else own - noise)
    variance = 1.0 / np.maximum(eigenvalues, _UNKNOWN**-2)
    covariance = np.zeros((len(quantities), len(quantities)))
    covariance[np.ix_(free, free)] = (vectors * variance) @ vectors.T * np.outer(scale, scale) + np.diag(extra**2)
    return covariance


def prior_units(
    parameters: Sequence[Parameter],
    values: gtsam.Values,
    keys: Sequence[int],
    blocks: dict[int, Array] | None = None,
) -> tuple[NDArray[np.intp], Array, Array]:
    """Which reported numbers are free, their prior scales, and by columns what one of these is of the tangents.

    In these units one threshold serves angles, rates and seconds. Fixed numbers are left out: their huge information
    would cost the others their digits. `blocks` are as coordinate_inverse has them.
    """
    quantities = [q for p in parameters for q in p.quantities]
    free = np.flatnonzero([q.prior_sigma != 0.0 for q in quantities])
    scale = np.array([quantities[i].prior_scale for i in free])
    return free, scale, coordinate_inverse(parameters, values, keys, blocks)[:, free] * scale


def coordinate_inverse(
    parameters: Sequence[Parameter],
    values: gtsam.Values,
    keys: Sequence[int],
    blocks: dict[int, Array] | None = None,
) -> Array:
    """Pseudo-inverse of the Jacobian of the reported numbers by the variables' tangents, stacked in this order.

    Each number follows from one variable, so that the inverse has the same blocks. Those of variables looked at again
    and again at the same values are kept in `blocks`, by key.
    """
    known = {} if blocks is None else blocks
    for p, key in zip(parameters, keys, strict=True):
        if key not in known:
            known[key] = _inverse(p.coordinates(values, key)[1])
    own = [known[key] for key in keys]
    inverse = np.zeros((sum(b.shape[0] for b in own), sum(b.shape[1] for b in own)))
    row = column = 0
    for block in own:
        inverse[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return inverse


def _inverse(J: Array) -> Array:
    """The pseudo-inverse; numbers that are a variable's own have none to be found."""
    own = J.shape[0] == J.shape[1] and bool((np.eye(len(J)) == J).all())
    return J if own else np.asarray(np.linalg.pinv(J), dtype=float)


def rows_used(factors: Sequence[Factor], values: gtsam.Values) -> list[int]:
    """How many rows each factor stands for, rejected measurements left out."""
    return [
        f.factor.dim() if f.measurement is None else f.measurement.model.rows * int(f.measurement.used(values).sum())
        for f in factors
    ]


def sum_of_squares(factor: Factor, values: gtsam.Values) -> float:
    """Sum of squares of a factor's whitened residuals, rejected ones left out."""
    if factor.measurement is None:
        return 2.0 * float(factor.factor.error(values))
    return float((factor.measurement.residuals(values)[factor.measurement.used(values)] ** 2).sum())


def explain(message: str) -> str:
    """A sentence from gtsam's text about an indeterminate system, which names the variable by its key."""
    key = re.search(r"near variable\s+(\d+)", message)
    name = gtsam.Symbol(int(key.group(1))).string() if key else "unknown"
    return f"the recording does not determine the state {name}: no measurement constrains it"
