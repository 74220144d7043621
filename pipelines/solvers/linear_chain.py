"""A problem linearised about a solution: rows of measurements and processes over a chain of states.

The normal equations of the states, banded, are solved for any variances of the rows; the products J'J are made once: 10
ms a trial of 1,200 keyframes and 37 parameters, where QR (`chain.py`) takes 31. A noise level needs no digit that
squaring loses. Innovations come from Kalman filters over pieces of the chain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.factors.chi_square import gate
from alidade.factors.gauss_markov import GaussMarkovFactor
from alidade.pipelines.estimation.noise import CORRELATED_ERROR, Level, Noise
from alidade.pipelines.solvers.chain import Index
from alidade.pipelines.solvers.layout import Values
from alidade.pipelines.solvers.linearization import Linearization

# Of each group of a linearisation, (n,) by which the sigmas of its measurements are multiplied; infinite: rejected.
Widening = Sequence[Array]

# Keyframes that determine levels well enough: of a longer recording half of them are the liveliest.
ENOUGH_KEYFRAMES = 6000
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
        """Select some of the linearised rows, and renumber the states that they are about."""
        states = tuple((renumbered[i[kept]], J[kept]) for i, J in self.states)
        beside, fixed = (None if each is None else each[kept] for each in (self.beside, self.fixed))
        parts = (self.time[kept], self.residuals[kept], states, self.shared[kept], beside, fixed)
        return Rows(self.family, self.group, *parts, self.is_measurement)

    @cached_property
    def products(self) -> tuple[Array, list[Array], Array | None, list[Array], list[Array]]:
        """Products of the rows that no noise level changes: squares, J'J, J_i'J_j, J'r and J'J_shared."""
        r, transposed = self.residuals, [np.swapaxes(J, 1, 2) for _, J in self.states]
        own = [Jt @ J for Jt, (_, J) in zip(transposed, self.states, strict=True)]
        crossed = transposed[0] @ self.states[1][1] if len(self.states) == 2 else None
        projected = [(Jt @ r[..., None])[..., 0] for Jt in transposed]
        return np.square(r).sum(axis=1), own, crossed, projected, [Jt @ self.shared for Jt in transposed]

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
        """Variance (n,) of linearised rows by their own noise alone, over their stated one."""
        out = np.ones(len(self.time)) if self.fixed is None else 1.0 - self.fixed
        for level in levels:
            if self.has(level.noise) and not level.noise.beside:
                out *= level.scale**2
        return out

    def _added(self, level: Level) -> Array:
        """Variance (n,) that an additional noise, as of repeatability, adds to linearised rows, over the stated one."""
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
class Process:
    """Gauss-Markov process of three numbers: its stated sigma, correlation time, s, and values (N, 3) at the states."""

    sigma: float
    correlation_time: float
    values: Array


@dataclass(frozen=True, eq=False)
class LinearChain:
    """A problem linearised about a solution: a chain of states, and shared parameters.

    Attributes:
        size: N states of d numbers.
        rows: by kind; of a Gauss-Markov process last.
        prior: (r, p + 1) rows of the shared parameters alone, residuals last.
        times: (N,) s, of the states.
        process: that the last three numbers of a state are; None: there is none.
    """

    size: tuple[int, int]
    rows: tuple[Rows, ...]
    prior: Array
    times: Array
    process: Process | None = None

    @classmethod
    def of(cls, linearization: Linearization, values: Values) -> LinearChain:
        """Linearise a problem's factors at their stated noise about given values."""
        (n, d, _, c, p), drafts, process = linearization.layout.sizes, list[Rows](), None
        prior, times, errors = [np.zeros((0, p + 1))], np.zeros(n), np.zeros((n, 3))
        for number, group in enumerate(linearization.under(None).groups):
            if group.target == "walk":
                continue
            if isinstance(group.model, GaussMarkovFactor):
                times[group.place], errors[group.place] = group.model.time, group.gathered(values)[-1]
                process = Process(group.model.sigma, group.model.correlation_time, errors)
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
        if process is None:
            for rows in drafts:
                if len(rows.states) == 2:
                    times[rows.states[1][0]] = rows.time
            times[0] = times[1] - np.median(np.diff(times[1:])) if n > 2 else times[-1] - 1.0
        return cls((n, d), tuple(drafts), np.concatenate(prior), times)._with_process(process)

    def with_error(self, columns: Index, sigma: float, correlation_time: float) -> LinearChain:
        """Return the chain with a Gauss-Markov error of a rotation that measurements share as part of its states.

        Args:
            columns: of the rotation, among the shared parameters; measurements are about one state each.
            sigma: of the error, as stated, rad.
            correlation_time: s.
        """
        (n, d), wider = self.size, list[Rows]()
        for rows in self.rows:
            by_error = rows.shared[..., columns] if rows.is_measurement else np.zeros((*rows.residuals.shape, 3))
            states = tuple((i, np.concatenate([J, by_error], axis=2)) for i, J in rows.states)
            wider.append(replace(rows, states=states))
        process = Process(sigma, correlation_time, np.zeros((n, 3)))
        return replace(self, size=(n, d + 3), rows=tuple(wider))._with_process(process)

    def _with_process(self, process: Process | None) -> LinearChain:
        """Return the chain with the rows of a Gauss-Markov process, in place of those that it has."""
        if process is None:
            return self
        (n, d), p, drafts = self.size, self.prior.shape[1] - 1, list(self._without_process)
        for now, interval in ((np.arange(1), None), (np.arange(1, n), np.diff(self.times))):
            model = GaussMarkovFactor(self.times[now], process.sigma, process.correlation_time, interval)
            of = [now] if interval is None else [now - 1, now]
            residuals, jacobians = model(*(process.values[i] for i in of))
            states = [(i, np.pad(J, ((0, 0), (0, 0), (d - 3, 0)))) for i, J in zip(of, jacobians(), strict=True)]
            shared = np.zeros((len(now), 3, p))
            drafts.append(Rows(CORRELATED_ERROR, -1, model.time, residuals, tuple(states), shared, None, None, False))
        return replace(self, rows=tuple(drafts), process=process)

    @property
    def _without_process(self) -> tuple[Rows, ...]:
        """Linearised rows of the chain without those of its Gauss-Markov process, which come last."""
        return tuple(rows for rows in self.rows if rows.family != CORRELATED_ERROR)

    def with_correlation_time(self, correlation_time: float) -> LinearChain:
        """Return the chain with another correlation time, s, of its process."""
        assert self.process is not None
        return self._with_process(replace(self.process, correlation_time=correlation_time))

    @property
    def log_det_of_process(self) -> float:
        """Log det of the covariance that the process's rows are whitened by; 0 without one."""
        own = [rows.states[-1][1][..., -3:] for rows in self.rows if rows.family == CORRELATED_ERROR]
        return -2.0 * float(sum(np.linalg.slogdet(J)[1].sum() for J in own))

    def with_process_factors(self, factors: Sequence[Array]) -> list[Array]:
        """Variance factors (n,) of each kind of rows from those without the process, whose own are 1."""
        return [*factors, *(np.ones(len(rows.time)) for rows in self.rows[len(factors) :])]

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
        process, each = self.process, self._without_process
        inside = [np.all([np.ones(len(r.time), bool), *(kept[i] for i, _ in r.states)], axis=0) for r in each]
        some = tuple(rows.of(own, renumbered) for rows, own in zip(each, inside, strict=True))
        part = replace(self, size=(int(kept.sum()), self.size[1]), rows=some, times=self.times[kept])
        part = part._with_process(process and replace(process, values=process.values[kept]))
        return part, part.with_process_factors([factor[own] for factor, own in zip(factors, inside, strict=False)])

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
        each = [np.ones(len(r.time)) if widening is None or r.group < 0 else widening[r.group] for r in self.rows]
        return [np.where(np.isinf(wide), of_rejected, wide**2) for wide in each]

    def variances(
        self, levels: Sequence[Level], widening: Widening | None = None, of_rejected: float = np.inf
    ) -> list[Array]:
        """Variances (n,) of each kind of rows at some noise levels, relative to the stated ones, and widened."""
        factors = self.factors(widening, of_rejected)
        return [rows.variance(levels) * factor for rows, factor in zip(self.rows, factors, strict=True)]

    def solved(self, variances: Sequence[Array]) -> LinearSolution | None:
        """Solve for states and parameters given the rows' relative variances (n,); None where undetermined.

        Rows of infinite variance have no say.
        """
        from scipy.linalg import cho_solve_banded, cholesky_banded

        (n, d), p = self.size, self.prior.shape[1] - 1
        Hd, Ho, Hs, g = np.zeros((n, d, d)), np.zeros((n, d, d)), np.zeros((n, d, p)), np.zeros((n, d))
        Hss, gs = self.prior[:, :p].T @ self.prior[:, :p], self.prior[:, :p].T @ self.prior[:, p]
        total, weights = float((self.prior[:, p] ** 2).sum()), []
        for rows, variance in zip(self.rows, variances, strict=True):
            square, own, crossed, projected, mixed = rows.products
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
        found = LinearSolution(self, weights, root, X, small, np.zeros(n * d), np.zeros(p), 0.0)
        states, shared = found.solve(-g.reshape(-1, 1), -gs[:, None])
        chi_square = total + float(g.ravel() @ states[:, 0] + gs @ shared[:, 0])
        value = chi_square + 2.0 * float(np.log(root[-1]).sum() + np.log(np.diag(small)).sum())
        return replace(found, states=states[:, 0], shared=shared[:, 0], value=value)

    def moves(self, states: Array, shared: Array) -> list[Array]:
        """Multiply moves of states (N d, k) and shared numbers (p, k) by Jacobians: (n, m, k) by kind of rows."""
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
        x, P = np.zeros((len(begin), d, q)), np.tile(self._beforehand(variances), (len(begin), 1, 1))
        if self.process is not None:
            x[:, -3:, 0] = -self.process.values[begin]
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
            if len(rows.states) != 2:
                continue
            (_, before), (now, after) = rows.states
            # Of attitudes or of their error, the other numbers of a state.
            own = np.flatnonzero(after.any(axis=(0, 1)))
            if rows.residuals.shape[1] != len(own):
                continue
            joined = np.isfinite(variance)
            inverse, now = np.linalg.inv(after[joined][..., own]), now[joined]
            right, at = rows.right(joined, by_shared), (now[:, None], own)
            F[at], c[at] = -inverse @ before[joined], -inverse @ right
            Q[now[:, None, None], own[:, None], own] = (
                variance[joined, None, None] * inverse @ np.swapaxes(inverse, 1, 2)
            )
        return F, c, Q

    def _beforehand(self, variances: Sequence[Array]) -> Array:
        """Covariance (d, d) of a state before anything is measured: of a process its own, of the rest diffuse."""
        covariance = np.eye(self.size[1]) / _DIFFUSE
        if self.process is not None:
            (start,) = variances[len(self._without_process)]
            covariance[-3:, -3:] = start * self.process.sigma**2 * np.eye(3)
        return covariance


@dataclass(frozen=True, eq=False)
class LinearSolution:
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
        """Multiply moves of states (N d, k) and shared numbers (p, k) by whitened Jacobians: (n, m, k) by kind."""
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
    """Sort measurements by their states: the order, where each state's begin in it (n,), and how many they are."""
    counts = np.bincount(state, minlength=n)
    return np.argsort(state, kind="stable"), np.cumsum(counts) - counts, counts
