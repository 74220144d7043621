"""Posterior of the reported numbers from the factor R of a chain: covariance, chi-square, square-root information.

The reported numbers q are functions of the last bias node and the shared unknowns x, with Jacobian J; `root` is R of x
with its right side. With T = [N U], N the directions of x that no number sees and U the moves of x that change one free
number each by its prior sigma,

    QR of root [N U | b]  ->  last rows  R_q du = d_q

is the square-root information of the numbers u in prior units, everything else marginalised out and fixed numbers
conditioned on. All else follows from R_q; nothing is squared. Rows of R give the leverage h of each measurement row a,
the variance of a x under the posterior, and a family of n rows has n - sum of h degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.estimation.problem import ChiSquare, Problem, SqrtInformation
from alidade.pipelines.gaussian_prior import GaussianPrior, root_of_information
from alidade.pipelines.solvers.chain import Chain, ChainFactorization, Factorization
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.layout import Layout, Tangent, Values
from alidade.pipelines.solvers.levenberg import followed
from alidade.pipelines.solvers.linearization import NOT_MEASURED, Group, Linearization, System

if TYPE_CHECKING:
    import gtsam

# A direction without any information gets this many times its prior scale as sigma.
WIDEST = 1e4
# Combinations whose sigma would be more than this many times their prior's are left out of square-root information.
MAX_CONDITION = 1e6
# Sigma of a prior where the config frees a number, in units of its default prior's sigma; see estimation.priors.
FREE_PRIOR = 10.0
# Draws whose mean squares give leverages where the system is no chain: 13 % of each, 1 % of a hundred's sum.
DRAWS = 120
# Singular values below this share of the largest, and to the power of 3/4 coefficients of a row, are rounding.
UNSEEN = 1e-12


@dataclass(frozen=True, eq=False)
class Reported:
    """Reported numbers at some values, with their Jacobian and priors.

    Attributes:
        names: (n,) of all numbers.
        numbers: (n,) at the values.
        jacobian: (n, c + s) by the last node and the shared unknowns.
        free: (m,) which numbers are not fixed.
        mean, scale: (m,) means of the priors in force, and sigmas of the default ones.
        prior: (m, m) precision of the priors in force, in units of the scales.
        extra: (n,) sigmas of errors that no measurement model has.
        calibrated: (m,) which free numbers are what is calibrated, and no assumed sensor errors.
        bounded: (m,) which free numbers have a prior; `prior` has FREE_PRIOR for the others.
    """

    names: tuple[str, ...]
    numbers: Array
    jacobian: Array
    free: NDArray[np.intp]
    mean: Array
    scale: Array
    prior: Array
    extra: Array
    calibrated: NDArray[np.bool_]
    bounded: NDArray[np.bool_]

    @classmethod
    def of(cls, compiled: Compiled, values: Values) -> Reported:
        """Evaluate the coordinates of all parameters of a problem."""
        layout, keys = compiled.layout, compiled.keys
        return cls.at(compiled.problem, layout.to_gtsam(values, keys), keys, [layout.root_columns(k) for k in keys])

    @classmethod
    def at(cls, problem: Problem, known: gtsam.Values, keys: Sequence[int], columns: Sequence[Array]) -> Reported:
        """Evaluate the coordinates of all parameters at gtsam values, with their Jacobians by the unknowns.

        Args:
            problem: of which the parameters are.
            known: values of the variables that hold them.
            keys: of these, one a parameter.
            columns: (d, c + s) of each, where its tangent is among all.
        """
        pairs = [p.coordinates(known, key) for p, key in zip(problem.parameters, keys, strict=True)]
        quantities = problem.quantities
        fixed = np.array([q.prior_sigma == 0.0 for q in quantities])
        free = np.flatnonzero(~fixed)
        # The default priors are the yardstick: an earlier calibration as prior makes nothing weak that it determined.
        scale = np.array([quantities[i].prior_scale for i in free])
        sigma = np.array([quantities[i].prior_sigma or FREE_PRIOR * quantities[i].prior_scale for i in free])
        names = [quantities[i].name for i in free]
        prior = problem.prior_covariance(names, sigma) / np.outer(scale, scale)
        return cls(
            names=tuple(q.name for q in quantities),
            numbers=np.where(fixed, [q.prior_mean for q in quantities], np.concatenate([each for each, _ in pairs])),
            jacobian=np.vstack([J @ own for (_, J), own in zip(pairs, columns, strict=True)]),
            free=free,
            mean=np.array([quantities[i].prior_mean for i in free]),
            scale=scale,
            prior=np.asarray(np.linalg.inv(prior), dtype=float),
            extra=np.where(fixed, 0.0, [q.extra_sigma for q in quantities]),
            calibrated=np.array([not quantities[i].assumed for i in free], dtype=bool),
            bounded=np.array([quantities[i].prior_sigma is not None for i in free], dtype=bool),
        )

    @property
    def u(self) -> Array:
        """The free numbers (m,) in prior units, relative to their prior means."""
        return np.asarray((self.numbers[self.free] - self.mean) / self.scale)

    @cached_property
    def basis(self) -> Array:
        """Basis (c + s, p + m) of last node and shared unknowns: p directions that move no number, then those of u."""
        inverse = np.linalg.pinv(self.jacobian)
        _, sizes, axes = np.linalg.svd(self.jacobian, full_matrices=True)
        seen = int(np.count_nonzero(sizes > UNSEEN * sizes.max(initial=0.0)))
        return np.hstack([axes[seen:].T, inverse[:, self.free] * self.scale])

    def root(self, root: Array) -> ReportedRoot:
        """Project R of (last node, shared unknowns, right side) on the free numbers' square-root information."""
        basis = self.basis
        R = np.asarray(np.linalg.qr(np.column_stack([root[:, :-1] @ basis, root[:, -1]]), mode="r"), dtype=float)
        missing = max(0, R.shape[1] - len(R))  # rows, where there are fewer than numbers
        return ReportedRoot(basis, np.pad(R, ((0, missing), (0, 0))), basis.shape[1] - len(self.free))

    def covariance(self, of_u: Array) -> Array:
        """Covariance (n, n) of all numbers from that of u (m, m); rows of fixed numbers are zero."""
        out = np.diag(self.extra**2)
        out[np.ix_(self.free, self.free)] += of_u * np.outer(self.scale, self.scale)
        return out


@dataclass(frozen=True, eq=False)
class ReportedRoot:
    """Square-root information |R du - d| about moves of the free reported numbers u.

    Attributes:
        basis: (c + s, p + m) moves of the last node and the shared unknowns: p that no number sees, then those of u.
        triangle: (p + m + 1, p + m + 1) R in this basis, right side last.
        unseen: p.
    """

    basis: Array
    triangle: Array
    unseen: int

    @property
    def R(self) -> Array:
        """Square-root information (m, m) of u, all other unknowns marginalised out."""
        return self.triangle[self.unseen : -1, self.unseen : -1]

    @property
    def d(self) -> Array:
        """Right side (m,): |R du - d| is minimal at the solution."""
        return self.triangle[self.unseen : -1, -1]

    def last(self, du: Array, right: float = 1.0) -> Array:
        """Moves (c + s, k) of last node and shared unknowns for moves (m, k) of u, other directions optimal.

        `right`: factor of the right side; 0 for the response to the moves alone.
        """
        p, rows = self.unseen, self.triangle[: self.unseen]
        y = np.linalg.solve(rows[:, :p], right * rows[:, -1:] - rows[:, p:-1] @ du) if p else np.zeros((0, du.shape[1]))
        return np.asarray(self.basis @ np.vstack([y, du]))

    def covariance(self) -> Array:
        """Covariance (m, m) of u from the linear system, valid for singular R as well."""
        _, sizes, axes = np.linalg.svd(self.R)
        root = axes.T / np.maximum(sizes, 1.0 / WIDEST)
        return np.asarray(root @ root.T)


def responses(factorization: Factorization, jacobian: Array, basis: Array) -> Tangent:
    """Solve N x = J' for the Jacobian J (n, c + s) by last node and shared unknowns: all unknowns, n columns.

    Args:
        factorization: of the system.
        jacobian: (n, c + s).
        basis: (c + s, k) of the moves that are free.

    Raises:
        LinAlgError: these are not determined.
    """
    R = np.asarray(np.linalg.qr(factorization.root[:, :-1] @ basis, mode="r"), dtype=float)
    last = basis @ np.linalg.solve(R, np.linalg.solve(R.T, basis.T @ jacobian.T))
    states, nodes = factorization.propagate(last)
    return Tangent(states, nodes, last[factorization.c :])


def draws(factorization: Factorization, count: int, generator: np.random.Generator) -> Tangent:
    """Draw deviations of all unknowns from the posterior mean; the first bias node's own part is zero."""
    states, nodes, shared = factorization.sample(count, generator)
    nodes[:1] = 0.0
    return Tangent(states, nodes, shared)


@dataclass(frozen=True, eq=False)
class Leverage:
    """Leverages (n, m) of a group's whitened rows.

    Attributes:
        group: of n measurements of m rows.
        used: (n,) which the loss does not reject.
        h: (n, m) variance of what the rows predict under the posterior, in squared sigmas of their noise.
        squares: (n, m) of the whitened residuals.
    """

    group: Group
    used: NDArray[np.bool_]
    h: Array
    squares: Array


def leverages(engine: Linearization, system: System, factorization: Factorization, values: Values) -> list[Leverage]:
    """Compute the leverages of all measurements, processes and priors.

    In a chain they are exact: what a row predicts has the variance that the shared unknowns leave, by the covariances
    of neighbours, and that of the shared ones, by the squares of what follows them. Of another engine they are the mean
    square of A x over draws x of the posterior, those of rows about shared unknowns alone exact, made to sum to the
    number of unknowns.

    Args:
        engine: of the factors.
        system: of these at the values.
        factorization: of the system.
        values: the estimate.
    """
    if not (isinstance(system, Chain) and isinstance(factorization, ChainFactorization)):
        drawn, found = draws(factorization, DRAWS, np.random.default_rng(1)), []
        for group in engine.groups:
            moves, right = engine.products(group, values, drawn)
            h = np.square(moves).mean(axis=2)
            if group.target == "shared":
                h = _of_shared(engine.layout, factorization, group, values)
            found.append(Leverage(group, group.inliers(values), h, np.square(right)))
        return _summing_to(found, _unknowns(engine.layout))
    variances, begin, found = _Variances.of(system, factorization), 0, []
    for group in engine.groups:
        shape = n, m = len(group.model.time), group.model.rows
        if group.target == "walk":
            rows, _ = group.rows(values, 2 * system.c + factorization.root.shape[1] - factorization.c)
            h, right = variances.of_walk(rows[..., : 2 * system.c], group.place), rows[..., -1]
        elif group.target == "shared":
            some = slice(begin, begin + n * m)
            h, right, begin = variances.shared[some].reshape(shape), system.shared[some, -1].reshape(shape), some.stop
        else:
            at = group.place[:, None], group.row[:, None] + np.arange(m)
            h, right = (variances.measured if group.target == "state" else variances.between)[:, *at]
        found.append(Leverage(group, group.inliers(values), h, np.square(right)))
    return found


def _of_shared(layout: Layout, factorization: Factorization, group: Group, values: Values) -> Array:
    """Exact leverages (n, m) of rows about the shared unknowns alone."""
    s = layout.sizes[4]
    rows, _ = group.rows(values, s + 1)
    A = np.pad(rows[..., :-1].reshape(-1, s), ((0, 0), (factorization.c, 0)))
    root = np.linalg.lstsq(factorization.root[:-1, :-1].T, A.T, rcond=None)[0]
    return np.asarray(np.square(root).sum(axis=0).reshape(rows.shape[:2]))


def _summing_to(found: Sequence[Leverage], unknowns: int) -> list[Leverage]:
    """Correct uncertain leverages, those neither 0 nor 1, so that all sum to the number of unknowns."""
    weights = [max(float((each.h - each.h**2)[each.used].sum()), 0.0) for each in found]
    share = (unknowns - sum(float(each.h.sum()) for each in found)) / max(sum(weights), 1e-300)
    return [
        replace(each, h=each.h + share * weight / max(each.used.sum() * each.h.shape[1], 1) * each.used[:, None])
        for each, weight in zip(found, weights, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _Variances:
    """Posterior variances of the predictions of a chain's rows.

    Attributes:
        measured, between: (2, N, m), (2, N, b) of the rows of these names, and their right sides.
        shared: (r,) of the rows about shared unknowns alone.
        nodes: (J, 2 c, 2 c) covariance of (node, node before) where the shared unknowns are known.
        moves: (J, 2 c, s) by which these follow the shared unknowns.
    """

    measured: Array
    between: Array
    shared: Array
    nodes: Array
    moves: Array

    @classmethod
    def of(cls, system: Chain, factorization: ChainFactorization) -> _Variances:
        d, c, roots = system.d, system.c, factorization.shared_roots
        pair, state = np.arange(2 * d + c), np.r_[:d, 2 * d : 2 * d + c]
        measured, between = list[Array](), list[Array]()
        for some, covariances, moves in factorization.parts(roots, system.piece):
            own = system.part(some.start, some.stop)
            for rows, of, out in ((own.measured, state, measured), (own.between, pair, between)):
                h = _quadratic(rows[..., : len(of)], covariances[:, of[:, None], of])
                h += np.square(_moved(rows, moves[:, of], roots[c:])).sum(axis=2)
                out.append(np.stack([h, rows[..., -1]]))
        shared = np.square(system.shared[:, :-1] @ roots[c:]).sum(axis=1)
        return cls(
            np.concatenate(measured, axis=1), np.concatenate(between, axis=1), shared, *factorization.nodes(roots)
        )

    def of_walk(self, rows: Array, node: NDArray[np.intp]) -> Array:
        """Variances (n, m) of the predictions of rows (n, m, 2 c) about consecutive nodes."""
        return _quadratic(rows, self.nodes[node]) + np.square(rows @ self.moves[node]).sum(axis=2)


def _moved(rows: Array, following: Array, shared: Array) -> Array:
    """Multiply rows (n, m, k + s + 1) by moves (n, k, q) of states and (s, q) of shared unknowns: (n, m, q)."""
    n, k, q = following.shape
    about = rows.reshape(-1, rows.shape[2])[:, k:-1] @ shared
    return np.asarray(rows[..., :k] @ following + about.reshape(n, rows.shape[1], q))


def _quadratic(rows: Array, covariances: Array) -> Array:
    """Variances (n, m) of the combinations in rows (n, m, k), from covariances (n, k, k)."""
    return np.einsum("nmk,nmk->nm", rows @ covariances, rows)


def _unknowns(layout: Layout) -> int:
    """Number of unknowns of a layout."""
    return int(layout.kept[0].sum() + layout.kept[1].sum() + layout.sizes[4])


def chi_square(found: Sequence[Leverage]) -> ChiSquare:
    """Sum of squares and degrees of freedom of measurements and processes, in total and by family."""
    families: dict[str, tuple[float, float]] = {}
    for each in found:
        family, used = each.group.family, each.used
        if family not in NOT_MEASURED:
            value, dof = families.get(family, (0.0, 0.0))
            families[family] = value + float(each.squares[used].sum()), dof + float((1.0 - each.h[used]).sum())
    families = {family: (value, max(dof, 0.0)) for family, (value, dof) in families.items()}
    sums = [sum(each[i] for each in families.values()) for i in range(2)]
    return ChiSquare(sums[0], sums[1], families)


def expected_squares(
    engine: Linearization, system: System, factorization: Factorization, values: Values
) -> dict[tuple[str, int], float]:
    """Expected sum of squares under unit noise, by family and row of the measurements.

    Rows of a process or a prior count as one. Arguments and errors are those of `leverages`.
    """
    squares: dict[tuple[str, int], float] = {}
    for each in leverages(engine, system, factorization, values):
        for row, more in enumerate((1.0 - each.h[each.used]).sum(axis=0).tolist()):
            label = each.group.family, row if each.group.is_measurement else 0
            squares[label] = squares.get(label, 0.0) + more
    return {label: max(square, 0.0) for label, square in squares.items()}


def sqrt_information(
    compiled: Compiled, engine: Linearization, values: Values, device: Collection[str]
) -> SqrtInformation:
    """Square-root information about the free reported numbers, with the device's priors kept separate.

    Args:
        compiled: the problem.
        engine: of its factors, rejected measurements left out.
        values: the estimate.
        device: names of the numbers whose priors are set apart.

    Raises:
        IndeterminateStateError: a state is not determined.
    """
    problem, reported = compiled.problem, Reported.of(compiled, values)
    without, prior_R, prior_d = without_priors(problem, reported, engine, values, device)
    found = reported.root(without.at(values)[0].root())
    rows, d = fewest(found.R / reported.scale, found.d, reported.scale)
    return SqrtInformation(
        names=tuple(reported.names[i] for i in reported.free),
        at=reported.numbers[reported.free],
        R=rows,
        d=d,
        prior_R=prior_R,
        prior_d=prior_d,
        scales=np.array([problem.quantities[i].prior_scale for i in reported.free]),
    )


def without_priors(
    problem: Problem, reported: Reported, engine: Linearization, values: Values, device: Collection[str]
) -> tuple[Linearization, Array, Array]:
    """Take the priors of the device's numbers out of a linearisation.

    Args:
        problem, engine: with them.
        reported: the numbers at the values.
        values: about which they are linear.
        device: names of the numbers.

    Returns the linearisation without them, and their rows about the free reported numbers: (r, n) and right side (r,).
    """
    layout, J = engine.layout, reported.jacobian
    c = layout.sizes[3]
    inverse = np.linalg.pinv(J)[c:]
    # Rounding, which units that differ by many orders make large.
    inverse[np.abs(inverse) < UNSEEN * np.abs(inverse).max(initial=0.0)] = 0.0
    named = np.array([name in device for name in reported.names], dtype=bool)
    scales = np.array([q.prior_scale for q in problem.quantities])
    groups, prior_R, prior_d = [], [np.empty((0, len(reported.free)))], [np.empty(0)]
    for group in engine.groups:
        if group.target == "shared" and group.family == "prior":
            rows, _ = group.rows(values, layout.sizes[4] + 1)
            whole = rows[..., :-1] @ inverse
            # The first node of a bias that walks has a prior, and is not what is reported.
            off = np.abs(whole @ J - np.pad(rows[..., :-1], ((0, 0), (0, 0), (c, 0)))).max(axis=2)
            about = whole[..., reported.free]
            of_device = _about_alone((whole * scales).reshape(-1, len(named)), named).reshape(rows.shape[:2])
            of_device &= off <= UNSEEN**0.5 * np.abs(rows[..., :-1]).max(axis=2)
            prior_R.append(about[of_device])
            prior_d.append(rows[of_device, -1])
            groups.append(replace(group, weights=group.all_weights * ~of_device))
        else:
            groups.append(group)
    return engine.with_groups(groups), np.concatenate(prior_R), np.concatenate(prior_d)


def moved_to(compiled: Compiled, engine: Linearization, values: Values, numbers: Mapping[str, float]) -> Values:
    """Move some reported numbers to given values, keep the others, and re-optimise the states to first order."""
    reported = Reported.of(compiled, values)
    wanted = np.array([numbers.get(n, here) for n, here in zip(reported.names, reported.numbers, strict=True)])
    du = (wanted - reported.numbers)[reported.free] / reported.scale
    factorization = engine.at(values)[0].eliminate()
    last = reported.root(factorization.root).last(du[:, None])
    return engine.layout.retract(values, followed(factorization, last))


def _about_alone(rows: Array, named: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (r,) of rows that involve some of the named numbers and no others; columns in prior units."""
    about = np.abs(rows) > UNSEEN**0.75 * np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
    return np.asarray((about & named).any(axis=1) & ~(about & ~named).any(axis=1))


def sqrt_information_of(gaussian_prior: GaussianPrior, scales: Sequence[float]) -> SqrtInformation:
    """Convert a Gaussian prior, without fixed numbers, to rows of unit variance; `scales` (n,) of default priors."""
    n, sigmas = len(gaussian_prior.names), gaussian_prior.sigmas
    R = root_of_information(gaussian_prior.covariance / np.outer(sigmas, sigmas), sigmas)
    return SqrtInformation(
        gaussian_prior.names,
        gaussian_prior.mean,
        R,
        np.zeros(n),
        np.empty((0, n)),
        np.empty(0),
        np.array(scales, dtype=float),
    )


def fewest(R: Array, d: Array, scales: Array) -> tuple[Array, Array]:
    """Compress square-root information (R, d) to its rank by SVD, scaled by `scales` (n,)."""
    if not len(R):
        return R, d
    u, s, vt = np.linalg.svd(R * scales, full_matrices=False)
    kept = s > 1.0 / MAX_CONDITION
    return (s[kept, None] * vt[kept]) / scales, u.T[kept] @ d
