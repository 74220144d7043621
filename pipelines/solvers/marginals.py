"""Joint marginal covariance of the parameters and degrees of freedom of chi-square, from a linearised graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np

from pipelines.methods.base import Array, ChiSquare, Factor, Parameter, Problem

# A direction the data and priors say nothing about gets this many times its prior scale as sigma, so that it can be
# named with the others instead of making the system unsolvable.
_UNKNOWN = 1e4
_SAMPLES = 8


class IndeterminateError(Exception):
    """States other than the calibration parameters are not determined by the recording."""


def reported(problem: Problem, values: gtsam.Values, stand_ins: Mapping[int, int]) -> Array:
    """The numbers of all parameters at the values."""
    return np.concatenate([p.coordinates(values, stand_ins.get(p.key, p.key))[0] for p in problem.parameters])


def joint_covariance(
    problem: Problem,
    linear: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
    values: gtsam.Values,
    stand_ins: Mapping[int, int],
) -> Array:
    """Covariance (n, n) of the reported numbers, everything else marginalised out; works for singular systems.

    Raises:
        IndeterminateError: another variable is undetermined.
    """
    keys = [stand_ins.get(p.key, p.key) for p in problem.parameters]
    rest = [ordering.at(i) for i in range(ordering.size()) if ordering.at(i) not in set(keys)]
    remaining = linear
    if rest:
        first = gtsam.Ordering()
        for key in rest:
            first.push_back(key)
        try:
            remaining = linear.eliminatePartialMultifrontal(first)[1]
        except RuntimeError as error:
            raise IndeterminateError(_explain(str(error))) from None
    last = gtsam.Ordering()
    for key in keys:
        last.push_back(key)
    information = remaining.hessian(last)[0]
    return reported_covariance(problem.parameters, information, values, keys)


def reported_covariance(
    parameters: Sequence[Parameter], information: Array, values: gtsam.Values, keys: Sequence[int]
) -> Array:
    """Covariance of the reported numbers from the information matrix of the variables' tangents, in this order."""
    quantities = [q for p in parameters for q in p.quantities]
    blocks = [p.coordinates(values, key)[1] for p, key in zip(parameters, keys, strict=True)]
    jacobian = np.zeros((len(quantities), information.shape[0]))
    row = column = 0
    for block in blocks:
        jacobian[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    scale = np.array([q.prior_scale for q in quantities])
    # Information in units of the prior scales, so that one threshold serves angles, rates and seconds.
    unit = np.linalg.pinv(jacobian) * scale
    eigenvalues, vectors = np.linalg.eigh(unit.T @ information @ unit)
    variance = 1.0 / np.maximum(eigenvalues, _UNKNOWN**-2)
    covariance = (vectors * variance) @ vectors.T * np.outer(scale, scale)
    covariance += np.diag([q.extra_sigma**2 for q in quantities])
    known = np.array([q.prior_sigma != 0.0 for q in quantities])
    return np.where(np.outer(known, known), covariance, 0.0)


def chi_square(
    factors: Sequence[Factor],
    linear: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
    values: gtsam.Values,
) -> ChiSquare:
    """Sum of squares of the factors other than priors, with the degrees of freedom of each family.

    A family's degrees of freedom are its rows less its share of the unknowns, the trace of A S A' (A its whitened
    Jacobian, S the joint covariance), here the mean of |A dx|^2 over samples dx of the posterior (fixed seed).
    """
    families: dict[str, list[int]] = {}
    for i, f in enumerate(factors):
        families.setdefault(f.family, []).append(i)
    try:
        shares = _shares(families, linear, ordering)
    except RuntimeError:  # singular: unknowns without information have no share
        shares = dict.fromkeys(families, 0.0)
    summary: dict[str, tuple[float, float]] = {}
    for family, members in families.items():
        if family in ("prior", "definition"):
            continue
        value = rows = 0.0
        for i in members:
            measurement = factors[i].measurement
            if measurement is None:
                value += 2.0 * factors[i].factor.error(values)
                rows += factors[i].factor.dim()
            else:
                used = measurement.used(values)
                value += float((measurement.residuals(values)[used] ** 2).sum())
                rows += measurement.model.rows * int(used.sum())
        summary[family] = (value, rows - shares[family])
    return ChiSquare(sum(v for v, _ in summary.values()), sum(d for _, d in summary.values()), summary)


def _shares(
    families: Mapping[str, Sequence[int]], linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering
) -> dict[str, float]:
    """Number of unknowns each family determines."""
    bayes_net = linear.eliminateSequential(ordering)
    mean = bayes_net.optimize()
    graphs = {family: gtsam.GaussianFactorGraph() for family in families}
    for family, members in families.items():
        for i in members:
            graphs[family].add(linear.at(i))
    at_mean = {family: graph.error(mean) for family, graph in graphs.items()}
    sizes = {key: len(mean.at(key)) for key in linear.keyVector()}
    shares = dict.fromkeys(families, 0.0)
    generator = np.random.default_rng(0)
    for _ in range(_SAMPLES):
        white = gtsam.VectorValues()
        for key, size in sizes.items():
            white.insert(key, generator.standard_normal(size))
        departure = bayes_net.backSubstitute(white)
        for family, graph in graphs.items():
            # error is half the square; a pair mirrored at the optimum has no linear term
            pair = graph.error(mean.add(departure)) + graph.error(mean.subtract(departure))
            shares[family] += (pair - 2.0 * at_mean[family]) / _SAMPLES
    return shares


def _explain(message: str) -> str:
    """A sentence from gtsam's text about an indeterminate system, which names the variable as <letter><index>."""
    near = message.split("near variable", 1)[-1].split()[0].strip(".,") if "near variable" in message else "unknown"
    return f"the recording does not determine the state {near}: no measurement constrains it"
