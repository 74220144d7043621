"""Noise levels by maximum marginal likelihood (Laplace), all families together with the parameters.

About a solution the problem is linear: rows r + J x of variance v(h), h the noise levels, x the states of a chain and
the shared parameters. Integrating x out leaves, up to a constant,

    -2 log L = chi2(minimum) + log det H + sum log v + sum ((log h - log h0) / sigma_h)^2

with H the information of states and parameters, priors included (Harville, J. Amer. Stat. Assoc. 1977; Barfoot, Forbes,
Yoon, IEEE RA-L 2020). Its gradient is zero where restricted maximum likelihood's equations hold. It is maximised over
log h at a fixed linearisation; the caller then solves with the levels found, and linearises again.

The levels are tried by the normal equations of the states, banded, whose products J'J are made once: 10 ms a trial of
1,200 keyframes and 37 parameters, where QR (`chain.py`) takes 31. A level needs no digit that squaring loses; the
solution at the levels found is QR's.

Measurements whose innovation lies beyond the gate are widened until it does not, never left out for that: leaving them
out lowers the level, and the lower level leaves out more. The nodes of a bias that walks stay where the solution has
them, relative to the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.factors.chi_square import gate
from alidade.pipelines import deadline
from alidade.pipelines.estimation.noise import ROUGHLY, Level, Noise
from alidade.pipelines.estimation.problem import Residuals
from alidade.pipelines.solvers.chain import UNDETERMINED, IndeterminateStateError, Index
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.error_budget import certain_ratio, sigma_ratio
from alidade.pipelines.solvers.layout import Tangent, Values
from alidade.pipelines.solvers.levenberg import LevenbergConfig, Solution, minimize, states_first
from alidade.pipelines.solvers.linearization import Linearization
from alidade.pipelines.solvers.noise_estimation import apply_levels
from alidade.pipelines.solvers.posterior import Reported

# Of each group of a linearisation, (n,) by which the sigmas of its measurements are multiplied; infinite: rejected.
Widening = Sequence[Array]

# A measurement is widened to the 99.9 % gate of its innovation, and an outlier beyond so many times that.
OUTLIER_GATES = 3.0
# By which the variance of a measurement without a say is multiplied, where it cannot be infinite.
NO_SAY = 1e12
# Keyframes that determine levels well enough: of a longer recording half of them are the liveliest.
ENOUGH_KEYFRAMES = 6000
# Newton steps, none longer than this in the logarithm of a level; one that lowers -2 log L by less is the last: levels
# are then within .2 of their sigmas, as random signs have them.
_MOST_STEPS, _LONGEST_STEP, _SETTLED = 12, 1.5, 0.05
# A step may be shortened so often, and raise -2 log L by so much: rounding.
_HALVINGS, _FINE = 6, 1e-3
# s, within which errors may be correlated however they are.
SANDWICH_BLOCK_S = 5.0
# Linearisations before the first solution; solutions at most, or linearisations without solutions between; levels have
# settled whose logarithms move by less.
_ROUNDS, _MOST_SOLUTIONS, _STEADY = 2, 6, 0.05
# Sigmas above what is stated at which two noises of the same rows begin, see `_from_above`, and up to which a default
# is expected.
_ABOVE = 2.0
# Ratio of the noise of measurements at two sets of levels up to which these are the same.
_SAME = 1.2
# By which another maximum has to lower -2 log L: what one more noise does by chance once in a thousand.
_CLEARLY = 10.8
# Random right sides that estimate traces: a quarter of a level's own sigma.
_SIGNS = 24
# Innovations are predicted from so many keyframes before at least, in pieces of so many.
_WARM_UP, _PIECE = 50, 100
# Information of a state before anything is known, over that of its neighbour's rows.
_DIFFUSE = 1e-4


@dataclass(frozen=True, eq=False)
class Rows:
    """Linearised rows of the measurements of one kind, whitened by the stated noise.

    Attributes:
        family: of all of them.
        group: number of theirs among the linearisation's.
        time: (n,) s.
        residuals: (n, m).
        states: the states (n,) that they are about, none, one or two, and Jacobians (n, m, d).
        shared: (n, m, p).
        beside: (n,) what a unit of the noise beside their own adds, or None.
        fixed: (n,) part of the stated variance that no level scales, or None.
        is_measurement: whether they may be outliers.
    """

    family: str
    group: int
    time: Array
    residuals: Array
    states: tuple[tuple[Index, Array], ...]
    shared: Array
    beside: Array | None
    fixed: Array | None
    is_measurement: bool

    def of(self, kept: Mask, renumbered: Index) -> Rows:
        """Select some rows and renumber their states."""
        states = tuple((renumbered[i[kept]], J[kept]) for i, J in self.states)
        beside, fixed = (None if each is None else each[kept] for each in (self.beside, self.fixed))
        parts = (self.time[kept], self.residuals[kept], states, self.shared[kept], beside, fixed)
        return Rows(self.family, self.group, *parts, self.is_measurement)

    def right(self, some: Any = ..., by_shared: bool = True) -> Array:
        """Residuals of selected rows, with the Jacobian by the shared parameters beside: (n, m, 1 + p or 1)."""
        residuals = self.residuals[some][..., None]
        return np.concatenate([residuals, self.shared[some]], axis=2) if by_shared else residuals

    def has(self, noise: Noise) -> bool:
        """Whether a noise contributes to the variance of these rows."""
        return self.family in noise.families and (self.beside is not None or not noise.beside)

    def variance(self, levels: Sequence[Level]) -> Array:
        """Variance (n,) of the rows at some noise levels, relative to the stated variance."""
        out = self._white(levels) + (0.0 if self.fixed is None else self.fixed)
        for level in levels:
            if level.noise.beside and self.has(level.noise):
                out += self._added(level)
        return out

    def share(self, level: Level, levels: Sequence[Level]) -> Array:
        """Share (n,) of the rows' variance at some noise levels that one of the levels contributes."""
        if not self.has(level.noise):
            return np.zeros(len(self.time))
        return (self._added(level) if level.noise.beside else self._white(levels)) / self.variance(levels)

    def _white(self, levels: Sequence[Level]) -> Array:
        """Contribution (n,) of the rows' own noise to their variance, relative to the stated one."""
        out = np.ones(len(self.time)) if self.fixed is None else 1.0 - self.fixed
        for level in levels:
            if self.has(level.noise) and not level.noise.beside:
                out *= level.scale**2
        return out

    def _added(self, level: Level) -> Array:
        """Contribution (n,) of an additional noise to the rows' variance, relative to the stated one."""
        assert self.beside is not None
        return np.asarray((level.used * self.beside) ** 2)


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of n measurements of one kind: normalised squares, and whitened with derivatives.

    Attributes:
        squares: (n,) of their norms over their own covariance.
        whitened: (n, m, 1 + p) by the covariance they are used with, and their derivatives by the shared parameters,
            none where these were not asked for.
    """

    squares: Array
    whitened: Array


@dataclass(frozen=True, eq=False)
class LinearChain:
    """A problem linearised about a solution: a chain of states, and shared parameters.

    Attributes:
        size: N states of d numbers.
        rows: by kind.
        prior: (r, p + 1) rows of the shared parameters alone, residuals last.
    """

    size: tuple[int, int]
    rows: tuple[Rows, ...]
    prior: Array

    @classmethod
    def of(cls, linearization: Linearization, values: Values) -> LinearChain:
        """Linearise a problem's factors at their stated noise about given values."""
        (n, d, _, c, p), drafts = linearization.layout.sizes, list[Rows]()
        prior = [np.zeros((0, p + 1))]
        for number, group in enumerate(linearization.under(None).groups):
            if group.target == "walk":
                continue
            begin = {"state": d + c, "pair": 2 * d + c, "shared": 0}[group.target]
            whole, _ = group.rows(values, begin + p + 1)
            whole[..., -1] *= -1.0
            if group.target == "shared" and not group.is_measurement:
                prior.append(whole.reshape(-1, p + 1))
                continue
            states: tuple[tuple[Index, Array], ...] = ()
            if group.target != "shared":
                states = ((group.place, whole[..., :d]),)
            if group.target == "pair":
                states = ((group.place - 1, whole[..., d : 2 * d]), *states)
            drafts.append(
                Rows(
                    group.family,
                    number,
                    np.asarray(group.model.time),
                    whole[..., -1],
                    states,
                    whole[..., begin:-1],
                    group.beside,
                    group.fixed,
                    group.is_measurement,
                )
            )
        return cls((n, d), tuple(drafts), np.concatenate(prior))

    def liveliest(self, factors: list[Array], most: int = ENOUGH_KEYFRAMES) -> tuple[LinearChain, list[Array]]:
        """Keep about `most` keyframes, half of them in the pieces with most motion; select `factors` alike.

        What grows with motion shows there; what is white everywhere.
        """
        n = self.size[0]
        if n <= most:
            return self, factors
        drive = np.zeros(n)
        for rows in self.rows:
            if rows.beside is not None and rows.states:
                np.maximum.at(drive, rows.states[-1][0], rows.beside)
        pieces, wanted = np.arange(n) // (2 * _PIECE), most // (2 * _PIECE)
        size = np.bincount(pieces, drive) / np.bincount(pieces)
        chosen = np.zeros(len(size), dtype=bool)
        chosen[np.argsort(-size)[: wanted // 2]] = True
        rest = np.flatnonzero(~chosen)
        chosen[rest[np.linspace(0, len(rest) - 1, wanted - wanted // 2).astype(int)]] = True
        kept = chosen[pieces]
        renumbered = np.cumsum(kept) - 1
        inside = [np.all([np.ones(len(r.time), bool), *(kept[i] for i, _ in r.states)], axis=0) for r in self.rows]
        some = tuple(rows.of(own, renumbered) for rows, own in zip(self.rows, inside, strict=True))
        part = replace(self, size=(int(kept.sum()), self.size[1]), rows=some)
        return part, [each[own] for each, own in zip(factors, inside, strict=True)]

    def reversed(self) -> LinearChain:
        """Return the same chain with its states in the opposite order."""
        last = self.size[0] - 1
        rows = tuple(replace(r, states=tuple((last - i, J) for i, J in r.states[::-1])) for r in self.rows)
        return replace(self, rows=rows)

    @property
    def limits(self) -> list[float]:
        """Gate of the squared normalised innovations of each kind of rows."""
        return [gate(rows.residuals.shape[1]) ** 2 for rows in self.rows]

    def factors(self, widening: Widening | None, of_rejected: float = np.inf) -> list[Array]:
        """Variance factors (n,) of each kind of rows by a widening; `of_rejected` is that of rejected measurements."""
        each = [np.ones(len(rows.time)) if widening is None else widening[rows.group] for rows in self.rows]
        return [np.where(np.isinf(wide), of_rejected, wide**2) for wide in each]

    def variances(
        self, levels: Sequence[Level], widening: Widening | None = None, of_rejected: float = np.inf
    ) -> list[Array]:
        """Variances (n,) of each kind of rows at some noise levels, relative to the stated ones, and widened."""
        factors = self.factors(widening, of_rejected)
        return [rows.variance(levels) * factor for rows, factor in zip(self.rows, factors, strict=True)]

    def solved(self, variances: Sequence[Array]) -> _Solution | None:
        """Solve for states and parameters given the rows' relative variances (n,); None where undetermined.

        Rows of infinite variance have no say.
        """
        from scipy.linalg import cho_solve_banded, cholesky_banded

        (n, d), p = self.size, self.prior.shape[1] - 1
        Hd, Ho, Hs, g = np.zeros((n, d, d)), np.zeros((n, d, d)), np.zeros((n, d, p)), np.zeros((n, d))
        Hss, gs = self.prior[:, :p].T @ self.prior[:, :p], self.prior[:, :p].T @ self.prior[:, p]
        total, weights = float((self.prior[:, p] ** 2).sum()), []
        for rows, variance, (square, own, crossed, projected, mixed) in zip(
            self.rows, variances, self._products, strict=True
        ):
            counted = np.isfinite(variance)
            w = np.where(counted, 1.0 / variance, 0.0)
            weights.append(np.sqrt(w))
            total += float((w * square).sum()) + rows.residuals.shape[1] * float(np.log(variance[counted]).sum())
            for (i, _), JJ, Jr, JS in zip(rows.states, own, projected, mixed, strict=True):
                add_blocks(Hd, i, w[:, None, None] * JJ)
                add_blocks(g, i, w[:, None] * Jr)
                add_blocks(Hs, i, w[:, None, None] * JS)
            if crossed is not None:
                add_blocks(Ho, rows.states[0][0], w[:, None, None] * crossed)
            flat = (weights[-1][:, None, None] * rows.shared).reshape(-1, p)
            Hss += flat.T @ flat
            gs += flat.T @ (weights[-1][:, None] * rows.residuals).ravel()
        try:
            root = cholesky_banded(_banded(Hd, Ho), check_finite=False)
            border = Hs.reshape(n * d, p)
            X = cho_solve_banded((root, False), border, check_finite=False)
            small = np.linalg.cholesky(Hss - border.T @ X)
        except np.linalg.LinAlgError:
            return None
        found = _Solution(self, weights, root, X, small, np.zeros(n * d), np.zeros(p), 0.0)
        states, shared = found.solve(-g.reshape(-1, 1), -gs[:, None])
        chi_square = total + float(g.ravel() @ states[:, 0] + gs @ shared[:, 0])
        value = chi_square + 2.0 * float(np.log(root[-1]).sum() + np.log(np.diag(small)).sum())
        return replace(found, states=states[:, 0], shared=shared[:, 0], value=value)

    @cached_property
    def _products(self) -> list[tuple[Array, list[Array], Array | None, list[Array], list[Array]]]:
        """Products of each kind of rows that no level changes: squares, J'J, J_i'J_j, J'r and J'J_shared."""
        found = []
        for rows in self.rows:
            r, transposed = rows.residuals, [np.swapaxes(J, 1, 2) for _, J in rows.states]
            own = [Jt @ J for Jt, (_, J) in zip(transposed, rows.states, strict=True)]
            crossed = transposed[0] @ rows.states[1][1] if len(rows.states) == 2 else None
            projected = [(Jt @ r[..., None])[..., 0] for Jt in transposed]
            found.append((np.square(r).sum(axis=1), own, crossed, projected, [Jt @ rows.shared for Jt in transposed]))
        return found

    def moves(self, states: Array, shared: Array) -> list[Array]:
        """Product A x, (n, m, k) for each kind of rows, with states (N d, k) and shared parameters (p, k)."""
        n, d = self.size
        each, out = states.reshape(n, d, -1), []
        for rows in self.rows:
            y = rows.shared @ shared
            for i, J in rows.states:
                y += J @ each[i]
            out.append(y)
        return out

    def innovations(
        self, variances: Sequence[Array], limits: Sequence[float], by_shared: bool = False
    ) -> dict[int, Innovations]:
        """Innovations of the measurements by index of their kind, from Kalman filters over overlapping pieces.

        Predicted from the keyframes before, parameters as they are, by a filter that uses what lies beyond a limit with
        a variance that takes it there. In pieces that begin with nothing known `_WARM_UP` keyframes before, all at the
        same time.

        Args:
            variances: of each kind of rows (n,).
            limits: of their squares, of each kind.
            by_shared: also how they go with the shared parameters.
        """
        n, d = self.size
        q = 1 + (self.prior.shape[1] - 1 if by_shared else 0)
        F, c, Q = self.transitions(variances, by_shared)
        seen = [k for k, rows in enumerate(self.rows) if rows.is_measurement and len(rows.states) == 1]
        queues = {k: _queue(self.rows[k].states[0][0], n) for k in seen}
        squares = {k: np.zeros(len(self.rows[k].time)) for k in seen}
        right = {k: self.rows[k].right(by_shared=by_shared) for k in seen}
        whitened = {k: np.zeros_like(each) for k, each in right.items()}
        starts = np.arange(0, n, _PIECE)
        begin = np.maximum(starts - _WARM_UP, 0)
        x, P = np.zeros((len(begin), d, q)), np.tile(np.eye(d) / _DIFFUSE, (len(begin), 1, 1))
        for step_ in range(_PIECE + _WARM_UP):
            live = np.flatnonzero(begin + step_ < np.minimum(starts + _PIECE, n))
            k = begin[live] + step_
            if step_ and len(live):
                x[live] = F[k] @ x[live] + c[k]
                P[live] = F[k] @ P[live] @ np.swapaxes(F[k], 1, 2) + Q[k]
            for kind in seen:
                order, begins, counts = queues[kind]
                for again in range(int(counts[k].max(initial=0))):
                    some = np.flatnonzero(counts[k] > again)
                    own, row = live[some], order[begins[k[some]] + again]
                    J, y = self.rows[kind].states[0][1][row], right[kind][row]
                    JP = J @ P[own]
                    S, v = JP @ np.swapaxes(J, 1, 2), variances[kind][row][:, None, None] * np.eye(y.shape[1])
                    both = y + J @ x[own]
                    z = np.linalg.solve(np.linalg.cholesky(S + v), both)
                    square = np.square(z[..., 0]).sum(axis=1)
                    wide = square > limits[kind]
                    if wide.any():
                        v[wide] *= (square[wide] / limits[kind])[:, None, None]
                        z[wide] = np.linalg.solve(np.linalg.cholesky(S[wide] + v[wide]), both[wide])
                    squares[kind][row], whitened[kind][row] = square, z
                    gain = np.swapaxes(np.linalg.solve(S + v, JP), 1, 2)
                    x[own] -= gain @ both
                    # Joseph's form stays positive where a measurement is better by 1e8 than the prediction.
                    rest = np.eye(d) - gain @ J
                    P[own] = rest @ P[own] @ np.swapaxes(rest, 1, 2) + gain @ v @ np.swapaxes(gain, 1, 2)
        return {kind: Innovations(squares[kind], whitened[kind]) for kind in seen}

    def transitions(self, variances: Sequence[Array], by_shared: bool) -> tuple[Array, Array, Array]:
        """Transitions x_k = F_k x_k-1 + c_k with covariance Q_k; diffuse where no factor joins two states.

        `c` has the derivatives by the shared parameters beside it where they are asked for.
        """
        n, d = self.size
        q = self.prior.shape[1] if by_shared else 1
        F, c, Q = np.zeros((n, d, d)), np.zeros((n, d, q)), np.tile(np.eye(d) / _DIFFUSE, (n, 1, 1))
        for rows, variance in zip(self.rows, variances, strict=True):
            if len(rows.states) != 2 or rows.residuals.shape[1] != d:
                continue
            (_, before), (now, after) = rows.states
            joined = np.isfinite(variance)
            inverse, now = np.linalg.inv(after[joined]), now[joined]
            right = rows.right(joined, by_shared)
            F[now], c[now] = -inverse @ before[joined], -inverse @ right
            Q[now] = variance[joined, None, None] * inverse @ np.swapaxes(inverse, 1, 2)
        return F, c, Q


@dataclass(frozen=True, eq=False)
class _Solution:
    """Most likely states and parameters of a linear chain, with the factorized information.

    Attributes:
        chain: the problem.
        weights: of each kind of rows, (n,) their inverse sigmas, 0 for those without a say.
        root: Cholesky factor of the states' information, banded.
        border: (N d, p) that information's inverse times the part it has in common with the shared parameters.
        small: Cholesky factor of the shared parameters' information, states integrated out.
        states, shared: (N d,), (p,).
        value: -2 log L but for the levels' prior.
    """

    chain: LinearChain
    weights: list[Array]
    root: Array
    border: Array
    small: Array
    states: Array
    shared: Array
    value: float

    def solve(self, states: Array, shared: Array) -> tuple[Array, Array]:
        """Solve the normal equations for right sides (N d, k) of the states and (p, k) of the shared parameters."""
        from scipy.linalg import cho_solve_banded

        right = shared - self.border.T @ states
        x = np.linalg.solve(self.small.T, np.linalg.solve(self.small, right))
        return cho_solve_banded((self.root, False), states, check_finite=False) - self.border @ x, x

    def covariance(self, by_shared: Array) -> Array:
        """Covariance (r, r) of r functions with Jacobian (r, p) by the shared parameters."""
        half = np.linalg.solve(self.small, by_shared.T)
        return np.asarray(half.T @ half)

    def gathered(self, of_rows: Sequence[Array]) -> tuple[Array, Array]:
        """Product A'y for whitened rows y (n, m, k) of each kind: states (N d, k), shared parameters (p, k)."""
        (n, d), p, k = self.chain.size, self.chain.prior.shape[1] - 1, of_rows[0].shape[2]
        states, shared = np.zeros((n, d, k)), np.zeros((p, k))
        for rows, w, y in zip(self.chain.rows, self.weights, of_rows, strict=True):
            weighed = w[:, None, None] * y
            for i, J in rows.states:
                add_blocks(states, i, np.swapaxes(J, 1, 2) @ weighed)
            shared += rows.shared.reshape(-1, p).T @ weighed.reshape(-1, k)
        return states.reshape(n * d, k), shared

    def spread(self, states: Array, shared: Array) -> list[Array]:
        """Product A x with whitened rows, (n, m, k) by kind, from states (N d, k) and shared parameters (p, k)."""
        moves = self.chain.moves(states, shared)
        return [w[:, None, None] * move for w, move in zip(self.weights, moves, strict=True)]

    def residuals(self) -> list[Array]:
        """Residuals (n, m) of each kind of rows at the solution, whitened by the stated noise."""
        moves = self.chain.moves(self.states[:, None], self.shared[:, None])
        return [rows.residuals + move[..., 0] for rows, move in zip(self.chain.rows, moves, strict=True)]

    def score(self, parts: Sequence[Sequence[Array]], signs: Sequence[Array]) -> tuple[Array, Array]:
        """Half the gradient (q,) of -2 log L by the logarithms of levels, and the average information (q, q).

        With v a row's variance, f the part of it that is a level's, e its whitened residual and l its leverage, the
        gradient is sum f (1 - l - e^2), traces by random signs (Hutchinson 1989), and the information 2 (f e)' P (f e)
        with P = I - A H^-1 A' (Gilmour, Thompson, Cullis, Biometrics 1995).

        Args:
            parts: f of each level, (n,) for each kind of rows.
            signs: (n, m, k) for each kind of rows.
        """
        moved, q = self.spread(self.states[:, None], self.shared[:, None]), len(parts)
        whitened = zip(self.weights, self.chain.rows, moved, strict=True)
        e = [w[:, None] * rows.residuals + move[..., 0] for w, rows, move in whitened]
        scaled = [
            np.stack([part[i][:, None] * e[i] for part in parts], axis=2) if q else np.zeros((*e[i].shape, 0))
            for i in range(len(e))
        ]
        drawn = [(w > 0.0)[:, None, None] * sign for w, sign in zip(self.weights, signs, strict=True)]
        both = [np.concatenate([y, sign], axis=2) for y, sign in zip(scaled, drawn, strict=True)]
        projected = self.spread(*self.solve(*self.gathered(both)))
        gradient, information = np.zeros(q), np.zeros((q, q))
        for i, (y, hat) in enumerate(zip(scaled, projected, strict=True)):
            information += 2.0 * np.einsum("nmc,nmd->cd", y, y - hat[..., :q])
            counted = self.weights[i] > 0.0
            leverage = (drawn[i] * hat[..., q:]).sum(axis=1).mean(axis=1)
            left = np.where(counted, e[i].shape[1] - leverage - (e[i] ** 2).sum(axis=1), 0.0)
            gradient += [float((part[i] * left).sum()) for part in parts]
        return gradient, 0.5 * (information + information.T)


def estimate_levels(
    chain: LinearChain, levels: Sequence[Level], widening: Widening | None = None, from_above: bool = False
) -> tuple[Level, ...]:
    """Estimate the noise levels of largest marginal likelihood at a linearisation, by average-information steps.

    What is stated counts as roughly known at first, which gives what the recording says; then as well as it is known,
    unless the recording contradicts it.

    Args:
        chain: the problem about a solution.
        levels: to begin with.
        widening: as it is, None: none.
        from_above: whether another maximum is looked for, see `_from_above`.

    Raises:
        IndeterminateStateError: states or parameters are not determined at the levels to begin with.
    """
    some, factors = chain.liveliest(chain.factors(widening))
    free = [
        i for i, level in enumerate(levels) if level.noise.estimated and any(r.has(level.noise) for r in chain.rows)
    ]
    if not free:
        return tuple(levels)
    roughly = np.array([max(levels[i].noise.known, ROUGHLY) for i in free])
    found, value = _maximum(some, factors, levels, free, roughly)
    above = _from_above(some, levels) if from_above else None
    if above is not None:
        other, least = _maximum(some, factors, above, free, roughly)
        if least < value - _CLEARLY:
            found = other
    closely = np.array([found[i].known for i in free])
    if (closely >= roughly).all():
        return found
    used, _ = _maximum(some, factors, found, free, closely)
    return tuple(replace(now, found=then.found, sigma=then.sigma) for now, then in zip(used, found, strict=True))


def _maximum(
    chain: LinearChain, factors: Sequence[Array], levels: Sequence[Level], free: Sequence[int], known: Array
) -> tuple[tuple[Level, ...], float]:
    """Maximise the marginal likelihood over the free levels; return all levels and -2 log L with their prior.

    What parameters miss their priors by is not in it: a scale beyond its data sheet is no noise.

    Args:
        chain, levels: as above.
        factors: (n,) of the variances of each kind of rows.
        free: which levels.
        known: (k,) how well they are, sigmas of their logarithms.
    """
    generator = np.random.default_rng(0)
    signs = [generator.choice([-1.0, 1.0], (*rows.residuals.shape, _SIGNS)) for rows in chain.rows]

    def at(u: Array) -> tuple[float, tuple[Level, ...], _Solution | None]:
        scales = dict(zip(free, np.exp(u).tolist(), strict=True))
        tried = tuple(replace(level, scale=scales.get(i, level.scale)) for i, level in enumerate(levels))
        found = chain.solved([v * f for v, f in zip(chain.variances(tried), factors, strict=True)])
        return np.inf if found is None else found.value + float(((u / known) ** 2).sum()), tried, found

    lowest = np.log([max(levels[i].noise.least, 1e-300) for i in free])
    u = np.maximum(np.log([levels[i].scale for i in free]), lowest)
    value, tried, solution = at(u)
    if solution is None:
        raise IndeterminateStateError(UNDETERMINED)
    information = np.diag(known**-2.0)
    for _ in range(_MOST_STEPS):
        if deadline.passed():
            break
        gradient, information = solution.score(_shares(chain, tried, free), signs)
        gradient, information = gradient + u / known**2, information + np.diag(known**-2.0)
        # What lies at its bound, and would go below, stays.
        moving = np.flatnonzero((u > lowest) | (gradient < 0.0))
        move = np.zeros(len(free))
        move[moving] = -np.linalg.solve(information[np.ix_(moving, moving)], gradient[moving])
        move = np.maximum(move, lowest - u)
        predicted, before = -float(gradient @ move), value
        move *= min(1.0, _LONGEST_STEP / max(float(np.abs(move).max()), 1e-300))
        for _ in range(_HALVINGS):
            ahead = at(u + move)
            if ahead[0] < value + _FINE:
                break
            move = 0.3 * move
        else:
            break
        u = u + move
        value, tried, solution = ahead
        assert solution is not None
        if min(predicted, before - value) < _SETTLED:
            break
    covariance = np.asarray(np.linalg.inv(information), dtype=float)
    spread = dict(zip(free, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    found = tuple(
        replace(level, found=level.scale, sigma=level.scale * spread[i]) if i in spread else level
        for i, level in enumerate(tried)
    )
    missed = chain.prior[:, :-1] @ solution.shared + chain.prior[:, -1]
    return _effective(chain, found, free, covariance), value - float(missed @ missed)


def unwidened(used: Sequence[Mask]) -> Widening:
    """Widening without effect: factor 1 for each group's inliers (n,), infinity for the rejected measurements."""
    return [np.where(own, 1.0, np.inf) for own in used]


def widened(chain: LinearChain, levels: Sequence[Level], widening: Widening) -> Widening:
    """Widening of the measurements at given noise levels; `widening` marks the measurements rejected so far.

    An outlier is what was rejected and, without any say of its own, lies beyond `OUTLIER_GATES` gates of the solution:
    the innovation of the first measurements has no prediction.

    Raises:
        IndeterminateStateError: states or parameters are not determined without what was rejected, if anything was.
    """
    rejected = [np.isinf(each) for each in widening]
    stated, kept = chain.variances(levels), chain.variances(levels, unwidened([~each for each in rejected]), NO_SAY)
    residuals = [rows.residuals for rows in chain.rows]
    if any(rejected[rows.group].any() for rows in chain.rows):
        # Only what was rejected is judged by the residuals that the solution leaves.
        solution = chain.solved(kept)
        if solution is None:
            raise IndeterminateStateError(UNDETERMINED)
        residuals = solution.residuals()
    limits, found = chain.limits, list(widening)
    for kind, each in chain.innovations(kept, limits).items():
        group, limit = chain.rows[kind].group, limits[kind]
        left = (residuals[kind] ** 2).sum(axis=1) / stated[kind]
        wide = np.sqrt(np.maximum(np.where(rejected[group], left, each.squares) / limit, 1.0))
        found[group] = np.where(rejected[group] & (left > OUTLIER_GATES**2 * limit), np.inf, wide)
    return found


def scores(chain: LinearChain, variances: Sequence[Array], at: Array | None = None) -> tuple[Array, Array, int]:
    """Return information (p, p) of the shared parameters, covariance (p, p) of its scores, and the number of blocks.

    With innovations e and their derivatives G by the shared parameters the one is G'G, the other, which is the same for
    white noise, the sum over blocks of `SANDWICH_BLOCK_S` of G'e e'G, whatever is correlated within blocks. Both have
    the prior's information.

    Args:
        chain: about the solution.
        variances: (n,) of each kind of rows.
        at: (p,) the solution, from where the chain is about it; None: there.
    """
    p = chain.prior.shape[1] - 1
    known = chain.prior[:, :p].T @ chain.prior[:, :p]
    information, of_scores, blocks = known.copy(), known.copy(), 0
    for kind, each in chain.innovations(variances, chain.limits, by_shared=True).items():
        time = chain.rows[kind].time
        G = each.whitened[..., 1:]
        e = each.whitened[..., 0] + (0.0 if at is None else G @ at)
        information += np.einsum("nmi,nmj->ij", G, G)
        block = ((time - time.min()) / SANDWICH_BLOCK_S).astype(int)
        blocks = int(block.max()) + 1
        sums = np.zeros((blocks, p))
        np.add.at(sums, block, np.einsum("nmi,nm->ni", G, e))
        of_scores += sums.T @ sums
    return information, of_scores, blocks


def sandwich(information: Array, of_scores: Array) -> tuple[Array, Array]:
    """Return nominal and sandwich covariance from the information (p, p) and the covariance of its scores (p, p).

    C = information^-1 and C B C with B of the scores: Liang, Zeger, Biometrika 1986.
    """
    C = np.asarray(np.linalg.pinv(information, hermitian=True))
    return C, C @ of_scores @ C


def _shares(chain: LinearChain, levels: Sequence[Level], which: Sequence[int]) -> list[list[Array]]:
    """Shares (n,) of the variance of each kind of rows that the levels `which` contribute."""
    return [[rows.share(levels[i], levels) for rows in chain.rows] for i in which]


def _effective(
    chain: LinearChain, levels: Sequence[Level], free: Sequence[int], covariance: Array
) -> tuple[Level, ...]:
    """Set the effective total noise of each level whose rows an additional noise shares that nobody states.

    `covariance` (k, k) is of the logarithms of the free ones.
    """
    unstated = [level.noise for level in levels if level.noise.beside and level.noise.source == "default"]
    out, added = list(levels), {family for noise in unstated for family in noise.families}
    for i, level in enumerate(levels):
        own = [k for k, rows in enumerate(chain.rows) if rows.family in added & {*level.noise.families}]
        if level.noise.beside or not own:
            continue
        variance = np.concatenate([chain.rows[k].variance(levels) for k in own])
        parts = [np.concatenate([each[k] for k in own]) for each in _shares(chain, levels, free)]
        shares = np.array([(part * variance).sum() for part in parts]) / variance.sum()
        size = float(np.sqrt(variance.mean()))
        out[i] = replace(level, effective=(size, size * float(shares @ covariance @ shares) ** 0.5))
    return tuple(out)


def add_blocks(to: Array, at: Index, blocks: Array) -> None:
    """Add blocks (n, ...) to an array at positions that may repeat, as `np.add.at` to the last digit, but faster."""
    if len(at) and (np.diff(at) > 0).all():
        to[at] += blocks
        return
    order, begins, counts = _queue(at, len(to))
    for again in range(int(counts.max(initial=0))):
        some = np.flatnonzero(counts > again)
        to[some] += blocks[order[begins[some] + again]]


def _banded(diagonal: Array, ahead: Array) -> Array:
    """Upper band of a block-tridiagonal matrix from its diagonal blocks (n, d, d) and those to the next state."""
    n, d, _ = diagonal.shape
    u = 2 * d - 1
    band = np.zeros((u + 1, n * d))
    for a in range(d):
        for b in range(d):
            if b >= a:
                band[u + a - b, b::d] = diagonal[:, a, b]
            band[u + a - b - d, d + b :: d] = ahead[:-1, a, b]
    return band


def _queue(state: Index, n: int) -> tuple[Index, Index, Index]:
    """Order of measurements by state, and the first one (n,) and the number (n,) of each state's."""
    counts = np.bincount(state, minlength=n)
    return np.argsort(state, kind="stable"), np.cumsum(counts) - counts, counts


@dataclass(frozen=True, eq=False)
class LikelihoodMaximum:
    """Values, noise levels and widening at or near the maximum of the marginal likelihood.

    Attributes:
        values: of all variables.
        levels: of the noises.
        widening: of the measurements.
    """

    values: Values
    levels: tuple[Level, ...]
    widening: Widening


def maximise_likelihood(
    linearization: Linearization, start: LikelihoodMaximum, rounds: int = _MOST_SOLUTIONS, from_above: bool = False
) -> LikelihoodMaximum:
    """Maximise the marginal likelihood by alternating noise levels and Gauss-Newton steps of the values.

    Nodes of a bias stay where they are.

    Args:
        linearization: of the factors, with the noise stated.
        start: values near the solution, levels, what is widened and rejected.
        rounds: linearisations, at most; two or more end once the levels have settled.
        from_above: whether another maximum is looked for, see `_from_above`.
    """
    _, _, nodes, c, _ = linearization.layout.sizes
    for number in range(rounds):
        if deadline.passed():
            break
        chain, before = LinearChain.of(linearization, start.values), start.levels
        levels = estimate_levels(chain, start.levels, start.widening, from_above)
        widening, values = widened(chain, levels, start.widening), start.values
        solution = chain.solved(chain.variances(levels, widening))
        if solution is not None:
            step = Tangent(solution.states.reshape(chain.size), np.zeros((nodes, c)), solution.shared)
            values = linearization.layout.retract(values, step)
        start = LikelihoodMaximum(values, levels, widening)
        if number and _settled(levels, before):
            break
    return start


def _settled(levels: Sequence[Level], before: Sequence[Level]) -> bool:
    """Whether no noise level moved by `_STEADY` in its logarithm from the one before."""
    return all(abs(np.log(a.scale / b.scale)) < _STEADY for a, b in zip(levels, before, strict=True))


def _from_above(chain: LinearChain, levels: Sequence[Level]) -> tuple[Level, ...] | None:
    """Start levels with equal shares, at `_ABOVE`, of all noises that have rows in common; None where none have any.

    -2 log L is flat in the logarithm of a level whose share vanishes: what begins there stays, and another noise takes
    its part.
    """
    out, found = list(levels), False
    for i, added in enumerate(levels):
        parts = [r.beside for r in chain.rows if r.family in added.noise.families and r.beside is not None]
        if not (added.noise.beside and added.noise.estimated and parts):
            continue
        for j, own in enumerate(levels):
            if not own.noise.beside and set(own.noise.families) & set(added.noise.families):
                above = float(np.exp(_ABOVE * own.noise.known)) if own.noise.estimated else 1.0
                out[j] = replace(own, scale=max(own.scale, above))
                unit = added.noise.stated * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
                out[i], found = replace(added, scale=out[j].scale / max(unit, 1e-300)), True
    return tuple(out) if found else None


def _engine_at(linearization: Linearization, found: LikelihoodMaximum) -> Linearization:
    """Return a linearisation weighted by the noise levels of a likelihood maximum, and widened; outliers left out."""
    used = [np.isfinite(wide) for wide in found.widening]
    engine = apply_levels(linearization, found.levels).counting(used)
    groups = [
        replace(group, weights=group.all_weights / np.where(own, wide, 1.0)[:, None]) if group.is_measurement else group
        for group, wide, own in zip(engine.groups, found.widening, used, strict=True)
    ]
    return engine.with_groups(groups)


def solve_likelihood(
    compiled: Compiled, solution: Solution, levels: Sequence[Level], config: LevenbergConfig
) -> tuple[Compiled, Solution, tuple[Level, ...]]:
    """Minimise at the noise levels of largest marginal likelihood, on a denser graph if the levels need one.

    Args:
        compiled: the problem, compiled for the chain.
        solution: with the levels given.
        levels: to begin with.
        config: of the last minimisation.
    """
    problem, engine = compiled.problem, compiled.engine
    used = solution.engine.inliers(solution.values)
    found = LikelihoodMaximum(solution.values, tuple(levels), unwidened(used))
    if problem.denser_graph is not None:
        found = maximise_likelihood(engine, found, rounds=1, from_above=True)
        denser = problem.denser_graph(found.levels)
        if denser is not None:
            known, compiled = compiled, Compiled.of(denser, "chain")
            engine = compiled.engine
            late = [g.model.time[np.isinf(w)] for g, w in zip(known.engine.groups, found.widening, strict=True)]
            times = np.concatenate(late)
            used = [~(np.isin(g.model.time, times) & g.is_measurement) for g in engine.groups]
            found = LikelihoodMaximum(_with_parameters(compiled, known, found.values), found.levels, unwidened(used))
            # Its first states follow vision's noise, and about these a scale of the gyro's rates would fit noise.
            found = replace(found, values=states_first(_engine_at(engine, found), found.values))
    for number in range(_MOST_SOLUTIONS):
        before = found.levels
        found = maximise_likelihood(engine, found, 1 if number else _ROUNDS, from_above=not number)
        solution = minimize(_engine_at(engine, found), found.values, config)
        found = replace(found, values=solution.values)
        if deadline.passed() or (number and _settled(found.levels, before)):
            break
    return compiled, solution, found.levels


def _with_parameters(compiled: Compiled, known: Compiled, values: Values) -> Values:
    """Initial values of a problem with the parameters replaced by those of another graph of the problem."""
    layout, arrays = compiled.layout, {block: array.copy() for block, array in compiled.initial.arrays.items()}
    keys = [p.key for p in compiled.problem.parameters]
    for key, at in zip(keys, layout.at(keys).tolist(), strict=True):
        arrays[layout.blocks[layout.block[at]]][layout.row[at]] = known.layout.of_key(values, key)
    return Values(arrays)


def sandwich_of(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> Array:
    """Ratio (n,) of sandwich to nominal sigma of the reported numbers; at least 1, and 1 if not significant.

    Above 1 where something errs slowly that no noise of the model has, as with the pose. Up to `certain_ratio` it
    counts as 1.
    """
    chain, variances = _at(compiled, levels, solution)
    reported = Reported.of(compiled, solution.values).jacobian[:, compiled.layout.sizes[3] :]
    information, of_scores, blocks = scores(chain, variances)
    nominal, robust = sandwich(information, of_scores)
    above, below = (np.einsum("ri,ij,rj->r", reported, C, reported) for C in (robust, nominal))
    ratio = sigma_ratio(below, above)
    return np.where(ratio > certain_ratio(blocks), np.maximum(ratio, 1.0), 1.0)


def _at(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> tuple[LinearChain, list[Array]]:
    """Linearise the chain about a solution; return it and the variances (n,) of each kind of rows."""
    chain = LinearChain.of(compiled.engine, solution.values)
    return chain, chain.variances(levels, unwidened(solution.engine.inliers(solution.values)), NO_SAY)


def levels_settled(
    compiled: Compiled, levels: Sequence[Level], solution: Solution, before: Sequence[Level], since: float
) -> bool:
    """Whether noise levels suffice for the measurements to come: determined, and the same as from less.

    A default is determined if the measurements exclude levels above it as its prior does: at `_ABOVE` of the prior's
    sigmas -2 log L rises by as much as the prior adds there. At rest it does not for what grows with motion; of
    measurements, that does not matter while it is a fifth of their noise even there. Levels are the same that give the
    measurements since then the same noise, to a fifth, as the levels before.

    Args:
        compiled, levels, solution: as above.
        before: levels of the solution before.
        since: time of that one, s.
    """
    chain = LinearChain.of(compiled.engine, solution.values)
    widening = unwidened(solution.engine.inliers(solution.values))
    found = chain.solved(chain.variances(levels, widening, NO_SAY))
    if found is None:
        return False
    for rows in chain.rows:
        late = rows.time > since
        now, then = (float(rows.variance(each)[late].mean()) if late.any() else 1.0 for each in (levels, before))
        if not _SAME**-2 < now / then < _SAME**2:
            return False
    for i, level in enumerate(levels):
        if not (level.noise.estimated and level.noise.source == "default"):
            continue
        above = replace(level, scale=level.scale * float(np.exp(_ABOVE * level.noise.known)))
        larger = [*levels[:i], above, *levels[i + 1 :]]
        own = [rows for rows in chain.rows if rows.has(level.noise)]
        if own and all(
            r.is_measurement and r.variance(larger).mean() < _SAME**2 * r.variance(levels).mean() for r in own
        ):
            continue
        tried = chain.solved(chain.variances(larger, widening, NO_SAY))
        if tried is not None and tried.value < found.value + _ABOVE**2:
            return False
    return True


def innovations_of(compiled: Compiled, levels: Sequence[Level], solution: Solution) -> dict[str, Residuals]:
    """Innovations of each family at given noise levels: white, of unit variance, if the model is right."""
    chain, variances = _at(compiled, levels, solution)
    used = solution.engine.inliers(solution.values)
    return {
        chain.rows[k].family: Residuals(chain.rows[k].time, each.whitened[..., 0], used[chain.rows[k].group])
        for k, each in chain.innovations(variances, chain.limits).items()
    }
