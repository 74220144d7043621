"""Joint marginal covariance of the parameters and degrees of freedom of chi-square, from a linearised graph."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array

from pipelines.graph.problem import Array, ChiSquare, Factor, History, Parameter, Problem

# A direction the data and priors say nothing about gets this many times its prior scale as sigma, so that it can be
# named with the others instead of making the system unsolvable.
_UNKNOWN = 1e4
# Random right sides that tell traces: many where that costs little, few where every one tells enough.
_SAMPLES, _MOST_SAMPLES, _SAMPLED_ROWS = 6, 60, 30_000
# Families whose residuals say nothing about the noise of the recording.
_NO_MEASUREMENTS = ("prior", "definition")


class IndeterminateError(Exception):
    """States other than the calibration parameters are not determined by the recording."""


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
    problem: Problem,
    linear: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
    values: gtsam.Values,
    current_keys: Mapping[int, int],
    noise: Array | None = None,
) -> Array:
    """Covariance (n, n) of the reported numbers, everything else marginalised out; works for singular systems.

    `noise` is information that counts for nothing, see pipelines.solvers.spurious.

    Raises:
        IndeterminateError: another variable is undetermined.
    """
    keys = [current_keys.get(p.key, p.key) for p in problem.parameters]
    return reported_covariance(problem.parameters, joint_information(linear, ordering, keys), values, keys, noise)


def joint_information(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, keys: Sequence[int]) -> Array:
    """Information (d, d) of some variables, in their order, everything else marginalised out.

    Raises:
        IndeterminateError: another variable is undetermined.
    """
    return reduced(linear, ordering, keys)[0]


def reduced(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering, keys: Sequence[int]) -> tuple[Array, Array]:
    """The normal equations (d, d), (d,) of some variables, in their order, everything else marginalised out.

    Raises:
        IndeterminateError: another variable is undetermined.
    """
    rest = [ordering.at(i) for i in range(ordering.size()) if ordering.at(i) not in set(keys)]
    remaining = linear
    if rest:
        try:
            remaining = linear.eliminatePartialMultifrontal(ordering_of(rest), gtsam.EliminateQR)[1]
        except RuntimeError as error:
            raise IndeterminateError(explain(str(error))) from None
    information, slope = remaining.hessian(ordering_of(keys))
    return np.asarray(information), np.asarray(slope)


def smoothed(
    problem: Problem,
    linear: gtsam.GaussianFactorGraph,
    ordering: gtsam.Ordering,
    values: gtsam.Values,
    held: Sequence[tuple[float, Mapping[int, int]]],
    covariance: Array,
) -> History | None:
    """Smoothed values and sigmas over time of parameters that move along; the others as they are at the end.

    Args:
        held: time and, from then on, parameter key -> variable that held it.
        covariance: (n, n) of the reported numbers, for those that do not move.

    Returns None when the system is singular.
    """
    try:
        tree = linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
        sigmas = [_sigmas_of(problem, tree, values, current_keys, covariance) for _, current_keys in held]
    except RuntimeError:
        return None
    times = np.array([time for time, _ in held])
    return History(times, np.array([reported(problem, values, s) for _, s in held]), np.array(sigmas))


def _sigmas_of(
    problem: Problem,
    tree: gtsam.GaussianBayesTree,
    values: gtsam.Values,
    current_keys: Mapping[int, int],
    covariance: Array,
) -> Array:
    """(n,) sigmas, of the current keys where there are others, else from the covariance."""
    sigmas = np.sqrt(np.diag(covariance))
    start = 0
    for p in problem.parameters:
        stop = start + len(p.quantities)
        if p.key in current_keys:
            key = current_keys[p.key]
            moving = reported_covariance([p], tree.marginalInformation(key), values, [key])
            sigmas[start:stop] = np.sqrt(np.diag(moving))
        start = stop
    return sigmas


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
            known[key] = np.asarray(np.linalg.pinv(p.coordinates(values, key)[1]), dtype=float)
    own = [known[key] for key in keys]
    inverse = np.zeros((sum(b.shape[0] for b in own), sum(b.shape[1] for b in own)))
    row = column = 0
    for block in own:
        inverse[row : row + block.shape[0], column : column + block.shape[1]] = block
        row, column = row + block.shape[0], column + block.shape[1]
    return inverse


def eliminated(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.GaussianBayesNet:
    """The triangular factor of a linear system, cliques of variables together in the order of their elimination.

    One variable at a time would take a factor on many of them apart as many times.

    Raises:
        IndeterminateError: names a variable that is not determined.
    """
    bayes_net = gtsam.GaussianBayesNet()

    # gtsam's tree does not hand out its cliques, but asks for each to be eliminated, children before parents.
    def kept(
        graph: gtsam.GaussianFactorGraph, keys: gtsam.Ordering
    ) -> tuple[gtsam.GaussianConditional, gtsam.GaussianFactor]:
        # By QR: tight processes beside loose priors cost Cholesky its digits, and with them the whole system.
        conditional, rest = gtsam.EliminateQR(graph, keys)
        bayes_net.push_back(conditional)
        return conditional, rest

    try:
        linear.eliminateMultifrontal(ordering, kept)
        bayes_net.optimize()
        return bayes_net
    except RuntimeError as error:
        raise IndeterminateError(explain(str(error))) from None


def solved(bayes_net: gtsam.GaussianBayesNet, places: Mapping[int, slice], right: Array) -> Array:
    """N^-1 times right sides (d, k), N the information of a whole system.

    Args:
        bayes_net: the system's triangular factor.
        places: variable -> its rows among the d.
        right: by columns.
    """
    x = right.copy()
    cliques = []
    for i in range(bayes_net.size()):
        conditional = bayes_net.at(i)
        rows = np.concatenate([np.arange(places[key].start, places[key].stop) for key in conditional.keys()])
        R, S = conditional.R(), conditional.S()
        cliques.append((R, S, rows[: len(R)], rows[len(R) :]))
    for R, S, own, parents in cliques:
        x[own] = solve_triangular(R, x[own], trans="T", check_finite=False)
        x[parents] -= S.T @ x[own]
    for R, S, own, parents in reversed(cliques):
        x[own] = solve_triangular(R, x[own] - S @ x[parents], check_finite=False)
    return x


def places_of(linear: gtsam.GaussianFactorGraph) -> dict[int, slice]:
    """Variable -> its rows in vectors over all variables of a linear system, which stand there by their keys."""
    gradient = linear.gradientAtZero()
    keys = sorted(linear.keyVector())
    ends = np.cumsum([len(gradient.at(key)) for key in keys]).tolist()
    return {key: slice(start, stop) for key, start, stop in zip(keys, [0, *ends[:-1]], ends, strict=True)}


def drawn(
    bayes_net: gtsam.GaussianBayesNet, values: gtsam.Values, keys: Collection[int], count: int
) -> list[gtsam.Values]:
    """Values drawn from their covariance about the estimate, by what some variables add to it."""
    generator = np.random.default_rng(0)
    zero = gtsam.VectorValues.Zero(bayes_net.optimize())
    found = []
    for _ in range(count):
        unit = gtsam.VectorValues()
        for key in values.keys():
            size = len(zero.at(key))
            unit.insert(key, generator.standard_normal(size) if key in keys else np.zeros(size))
        found.append(values.retract(bayes_net.backSubstitute(unit)))
    return found


def chi_square(
    problem: Problem,
    factors: Sequence[Factor],
    values: gtsam.Values,
    covariance: Array,
    expected: Mapping[tuple[str, int], float],
) -> ChiSquare:
    """Sum of squares of measurements and processes (not of priors) and its degrees of freedom, whole and by family.

    The whole: rows used, less unknowns, plus what the priors contribute to the unknowns. The families' shares are
    sampled, the largest family's taken as what is left of the whole.

    Args:
        problem: the graph's.
        factors: of the graph.
        values: the estimate.
        covariance: of the reported numbers.
        expected: see `expected_squares`.
    """
    value: dict[str, float] = {}
    rows = rows_used(factors, values)
    for f in factors:
        if f.family not in _NO_MEASUREMENTS:
            value[f.family] = value.get(f.family, 0.0) + sum_of_squares(f, values)
    counted = sum(count for f, count in zip(factors, rows, strict=True) if f.family != "prior")
    dof = counted - values.dim() + _from_priors(problem, covariance)
    families = dict.fromkeys(value, 0.0)
    for (family, _), square in expected.items():
        if family in families:
            families[family] += square
    largest = max(value, key=lambda family: families[family])
    families[largest] = dof - sum(families[family] for family in value if family != largest)
    return ChiSquare(sum(value.values()), dof, {family: (value[family], families[family]) for family in value})


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


def _from_priors(problem: Problem, covariance: Array) -> float:
    """How many unknowns the priors determine: the sum of posterior over prior variance."""
    share = 0.0
    for q, variance in zip(problem.quantities, np.diag(covariance), strict=True):
        if q.prior_sigma == 0.0:
            share += 1.0
        elif q.prior_sigma is not None:
            share += min((variance - q.extra_sigma**2) / q.prior_sigma**2, 1.0)
    return share


def expected_squares(
    factors: Sequence[Factor],
    linear: gtsam.GaussianFactorGraph,
    bayes_net: gtsam.GaussianBayesNet,
    values: gtsam.Values,
) -> dict[tuple[str, int], float]:
    """(family, row of its measurements) -> expected sum of squares, of random signs after solving for the unknowns.

    Noise of variance one would do too; signs tell the traces of projections with less scatter (Hutchinson 1989). The
    rows of what is no measurement, or compressed, count as one.

    Args:
        factors: of the graph.
        linear: the same, linearised; a compressed one has fewer rows than it stands for.
        bayes_net: the system's triangular factor.
        values: the estimate.
    """
    places = places_of(linear)
    width = max(place.stop for place in places.values())
    # Nonzero elements of the system: rows in the order of the factors, columns in that of the keys, then those of b.
    elements = linear.sparseJacobian_()
    elements = elements[:, elements[1] <= width]
    row, column, element = elements[0].astype(int) - 1, elements[1].astype(int) - 1, elements[2]
    sizes = [len(linear.at(i).jacobian()[1]) for i in range(linear.size())]
    labels: dict[tuple[str, int], int] = {}
    group = np.concatenate([_labelled(f, size, labels) for f, size in zip(factors, sizes, strict=True)])
    # Rejected measurements and free priors have empty rows, which are no measurements.
    counted = np.bincount(row, minlength=len(group)) > 0
    held = np.bincount(np.repeat(np.arange(len(sizes)), sizes), counted, len(sizes))
    measured = np.array([f.measurement is not None for f in factors])
    # What compression took out of the system holds no unknowns: each such row is expected to be one.
    first = group[np.append(0, np.cumsum(sizes))[:-1]]
    stands = np.array(rows_used(factors, values), dtype=float)
    square: Array = np.bincount(first, np.where(measured, stands - held, 0.0), len(labels)).astype(float)
    generator = np.random.default_rng(0)
    samples = int(np.clip(_SAMPLED_ROWS // len(group), _SAMPLES, _MOST_SAMPLES))
    signs = np.array([generator.choice([-1.0, 1.0], len(group)) for _ in range(samples)]).T
    noise = np.where(counted[:, None], signs, 0.0)
    A = csr_array((element, (row, column)), shape=(len(group), width))
    left = A @ solved(bayes_net, places, A.T @ noise) - noise
    square = square + np.bincount(group, (left**2).sum(axis=1) / samples, len(labels))
    return dict(zip(labels, square.tolist(), strict=True))


def _labelled(factor: Factor, size: int, labels: dict[tuple[str, int], int]) -> NDArray[np.intp]:
    """(size,) number of the label of each row of a linearised factor; new labels are added."""
    measurement = factor.measurement
    rows = 1 if measurement is None or measurement.compress else measurement.model.rows
    own = [labels.setdefault((factor.family, row), len(labels)) for row in range(rows)]
    return np.resize(np.array(own, dtype=np.intp), size)


def explain(message: str) -> str:
    """A sentence from gtsam's text about an indeterminate system, which names the variable by its key."""
    key = re.search(r"near variable\s+(\d+)", message)
    name = gtsam.Symbol(int(key.group(1))).string() if key else "unknown"
    return f"the recording does not determine the state {name}: no measurement constrains it"
