"""Influence of every measurement on the reported numbers, and what follows from it.

That is the error budget, the most influential measurements, the effect of fixed inputs, and the inflation by residuals
that are correlated in time. At the minimum a small change r of the right side, minus the whitened residuals, moves the
numbers by L r,

    L = J B (B'N B)^-1 B'A',    N = A'A

A the linearised, whitened system, J the Jacobian of the numbers, B a basis of all moves but those along weak directions
(`weak_directions`), which stay at their priors. The squares of a row of L are the parts of the residuals in a
number's variance. One column B (B'N B)^-1 B'J' a number is kept for all unknowns; L follows group by group as A x.

Noise of a family whose autocorrelation at lag k is g(k) adds 2 sum_k g(k) sum_i L_i+k L_i to a variance (Newey, West,
"A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica
1987, with influence functions in place of regressors). Each family's correlation counts for its own residuals alone.

Residuals of a fit are less correlated than their noise: it absorbs what is slow. A noise of variance v, a share f of it
correlated by exp(-k / T), has the restricted likelihood (Harville, J. Am. Stat. Assoc. 72, 1977)

    -2 log L = (n - m) log q + log det V + log det Q'V^-1 Q,    q = min_x (y - Q x)'V^-1 (y - Q x)

V = (1 - f) I + f exp(-|i - j| / T), Q an orthonormal basis of what the m numbers move the n residuals y by, at
measurements without their noise: with it Q reproduces y, beside a constant so large that only a long T allows it. But
for both ends the cosine transform makes V diagonal. v = q / r, r the redundancy of the measurements that are used: what
states and numbers leave of their count. Weights correspond to v = 1; a smaller estimate means that states absorbed
correlated noise, so v is at least 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.pipelines.estimation.noise import CORRELATED_ERROR
from alidade.pipelines.estimation.problem import InfluentialMeasurement
from alidade.pipelines.solvers.layout import Tangent, Values
from alidade.pipelines.solvers.levenberg import Point
from alidade.pipelines.solvers.linearization import Group, Linearization
from alidade.pipelines.solvers.posterior import Reported, responses
from alidade.pipelines.solvers.weak_directions import Posterior, WeakDirections

# Fewer measurements show no autocorrelation.
MIN_MEASUREMENTS = 100
# Sigmas of zero below which a mean of autocorrelations has died out, and above which one shows that there are any.
DIED_OUT, CORRELATED = 2.0, 4.0
# Longest lag, share of the recording.
MAX_LAG = 0.25
# Level of the test for coloured noise, which has two numbers more than white noise.
_COLOURED = 0.999
# A fit that absorbs more than this share of white residuals, a hundredth of their sigma, may hide their correlation.
_ABSORBED = 0.02
# Of a correlated share: white noise beside it keeps V regular.
_MIN_SHARE, _MAX_SHARE = 1e-6, 1.0 - 1e-6
# Frequencies with a band of their own, and by what the bands beyond grow: their spectrum is even to a twentieth.
_UNBANDED, _BAND = 64, 1.05
# Variance over the largest below which a direction is rounding.
_LEAST_SQUARE = 1e-12
# Correlation lengths after which exp(-lag / length) is left out.
_LONGEST_LAG = 8.0
# Blocks of a recording by which variances are judged, each with as many measurements as there are numbers at least.
_BLOCKS = 16
# Coefficients of a prior's row below this share of its largest are rounding.
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Influence:
    """Influence of all residuals on the free reported numbers.

    Attributes:
        at: the estimate; the engine of all factors.
        reported: the numbers there.
        step: m columns B (B'N B)^-1 B'J'.
        from_priors: (m, 2 m) square root of what the priors of the weak directions add to the covariance of these and
            of the others, columns for each number's prior.
    """

    at: Point
    reported: Reported
    step: Tangent
    from_priors: Array

    @classmethod
    def of(cls, posterior: Posterior) -> Influence:
        """Compute the influence at an estimate.

        Raises:
            LinAlgError: the shared unknowns are not determined.
        """
        at, reported, directions = posterior.at, posterior.reported, posterior.directions
        found, scale, weak = reported.root(at.factorization.root), reported.scale, directions.weak
        p, strong = found.unseen, directions.strong
        basis = np.hstack([found.basis[:, :p], found.basis[:, p:] @ strong])
        step = responses(at.factorization, reported.jacobian[reported.free], basis)
        slope = np.linalg.lstsq(found.R @ strong, -found.R @ weak, rcond=None)[0]
        root = np.linalg.cholesky(reported.prior)
        roots = [
            scale[:, None] * (axes @ directions.prior_covariance @ weak.T) @ root for axes in (weak, strong @ slope)
        ]
        return cls(at, reported, step, np.hstack(roots))

    @property
    def names(self) -> tuple[str, ...]:
        """Names (m,) of the reported numbers that are free."""
        return tuple(self.reported.names[i] for i in self.reported.free)

    def rows(self, group: Group) -> tuple[Array, Array]:
        """Influence L (n, rows, m) of a group's residuals and the negative weighted residuals (n, rows)."""
        return self.at.engine.products(group, self.at.values, self.step)

    def moves(self, changed: Linearization) -> Array:
        """First-order changes (m,) of the numbers if other factors of the same layout replace the graph's."""
        return self._moved(changed) - self._unchanged

    @cached_property
    def _unchanged(self) -> Array:
        return self._moved(self.at.engine)

    def _moved(self, engine: Linearization) -> Array:
        """First-order step (m,) of the numbers from all residuals of a linearisation; zero at its minimum."""
        moved = np.zeros(len(self.names))
        for group in engine.divided():
            moved += np.einsum("nrm,nr->m", *engine.products(group, self.at.values, self.step))
        return moved


# Numbers that a joint prior is named after: a vector's. One of more is about a transformation of many.
_MOST_NAMED = 3


def error_budget(influence: Influence, added: Mapping[str, Array], covariance: Array) -> dict[str, dict[str, float]]:
    """Share of each source in each number's variance, the largest first; shares sum to one.

    Sources are the families of the noise, each prior ("prior of NAME, ..."; "prior" of many numbers together), and what
    no measurement model has, together with what is of second order ("not modelled").

    Args:
        influence: of the residuals.
        added: family -> covariance (m, m) that correlation of its residuals adds, see `added_covariance`.
        covariance: (n, n) final posterior of all reported numbers.
    """
    names, variances = influence.names, dict[str, Array]()
    for group in influence.at.engine.divided():
        L, _ = influence.rows(group)
        for source, variance in _sources(influence, group, np.square(L)):
            variances[source] = variances.get(source, np.zeros(len(names))) + variance
    for name, column in zip(2 * names, np.square(influence.from_priors).T, strict=True):
        variances[f"prior of {name}"] = variances.get(f"prior of {name}", np.zeros(len(names))) + column
    for family, more in added.items():
        variances[family] = variances[family] + np.diag(more)
    known = np.sum(list(variances.values()), axis=0)
    final = np.diag(covariance)[influence.reported.free]
    variances["not modelled"] = np.maximum(final - known, ROUNDING * final) * (final - known > 1e-6 * final)
    total = np.sum(list(variances.values()), axis=0)
    return {
        name: dict(
            sorted(
                ((source, float(v[j] / total[j])) for source, v in variances.items() if v[j] > 0.0),
                key=lambda share: -share[1],
            )
        )
        for j, name in enumerate(names)
    }


def _sources(influence: Influence, group: Group, squares: Array) -> list[tuple[str, Array]]:
    """Sources of error of a group, and each one's variance (m,), from squared influences (n, rows, m)."""
    if group.family != "prior" or group.target != "shared":
        return [(group.family, squares.sum(axis=(0, 1)))]
    layout, reported = influence.at.engine.layout, influence.reported
    rows, _ = group.rows(influence.at.values, layout.sizes[4] + 1)
    A = np.pad(rows[..., :-1].reshape(-1, layout.sizes[4]), ((0, 0), (layout.sizes[3], 0)))
    about = np.abs(A @ np.linalg.pinv(reported.jacobian[reported.free] / reported.scale[:, None]))
    largest = about > ROUNDING * about.max(axis=1, keepdims=True, initial=0.0)
    about_each = [[influence.names[i] for i in np.flatnonzero(row)] for row in largest]
    labels = [f"prior of {', '.join(n)}" if 0 < len(n) <= _MOST_NAMED else group.family for n in about_each]
    return list(zip(labels, squares.reshape(-1, squares.shape[2]), strict=True))


def most_influential(
    influence: Influence, sigmas: Mapping[str, float], count: int
) -> tuple[InfluentialMeasurement, ...]:
    """The measurements with the largest influence on a number, in sigmas, each with the number's name.

    A measurement with the right side b, minus its whitened residuals, moves the numbers by its columns of L times b; at
    the minimum all of these and the priors' are in balance. Rejected measurements have no influence.

    Args:
        influence: of the residuals.
        sigmas: of the numbers that are considered, by name.
        count: number of measurements at most.
    """
    names = [name for name in influence.names if name in sigmas]
    if not names:
        return ()
    columns = [influence.names.index(name) for name in names]
    scale = np.array([sigmas[name] for name in names])
    found: list[tuple[float, str, float, str]] = []
    for group in influence.at.engine.divided():
        if (group.target == "shared" and group.family == "prior") or group.family == CORRELATED_ERROR:
            continue
        L, right = influence.rows(group)
        moves = np.einsum("nrm,nr->nm", L[..., columns], right) / scale
        which = np.abs(moves).argmax(axis=1)
        moved = moves[np.arange(len(moves)), which]
        first = np.argsort(-np.abs(moved), kind="stable")[:count].tolist()
        found += [(float(moved[i]), group.family, float(group.model.time[i]), names[int(which[i])]) for i in first]
    found.sort(key=lambda each: -abs(each[0]))
    return tuple(InfluentialMeasurement(family, time, name, move) for move, family, time, name in found[:count])


def autocorrelation(whitened: Array, shown: float = CORRELATED) -> Array:
    """Autocorrelation (K,) of residuals (n, r) at lags 1 ... K, up to where it vanishes; empty if white.

    Its means over the lags 1, 2 to 3, 4 to 7 and so on: what is small and long shows in no lag alone, and widens most.
    One of them is `shown` sigmas above zero.
    """
    n, r = whitened.shape
    if n < MIN_MEASUREMENTS:
        return np.empty(0)
    sums = _lagged(whitened, int(MAX_LAG * n))
    if not sums[0] > 0.0:
        return np.empty(0)
    correlation = sums[1:] / sums[0]
    begins = 2 ** np.arange(len(correlation).bit_length()) - 1
    count = np.diff(np.append(begins, len(correlation)))
    means = np.add.reduceat(correlation, begins) / count
    length, end = 1.0, 0
    for j, mean in enumerate(means.tolist()):
        # Estimates of neighbouring lags are correlated as the residuals are (Bartlett, J. Roy. Stat. Soc. Suppl. 1946).
        size = mean * float(n * r * count[j]) ** 0.5 / length
        if size > (DIED_OUT if end else shown):
            end = j + 1
            length = max(1.0, 1.0 + 2.0 * float(means[:end] @ count[:end]))
        elif end:
            break
    return np.repeat(means[:end], count[:end])


@dataclass(frozen=True)
class ColouredNoise:
    """Noise of n consecutive measurements: a white share, and one with correlation exp(-lag / length).

    Attributes:
        share: of the variance that is correlated.
        length: of the correlation, in measurements.
        variance: over that of the weights, at least 1.
        fall: decrease of -2 log L relative to white noise.
    """

    share: float
    length: float
    variance: float
    fall: float

    @classmethod
    def fitted(cls, whitened: Array, basis: Array, redundancy: float, together: float) -> ColouredNoise:
        """Fit coloured noise to residuals (n, r) by restricted maximum likelihood.

        Args:
            whitened: residuals (n, r), in time order; each column is a noise of its own.
            basis: (n, r, m), orthonormal, of what a fit has absorbed of them.
            redundancy: sum of their squares that white noise of the weights' variance leaves, on average.
            together: first guess of how many of them count as one.
        """
        from scipy.optimize import minimize

        spectrum, longest = _Spectrum.of(whitened, basis), MAX_LAG * len(whitened)

        def numbers(u: Array) -> tuple[float, float]:
            share = float(np.clip(1.0 / (1.0 + np.exp(-u[0])), _MIN_SHARE, _MAX_SHARE))
            return share, float(np.exp(np.clip(u[1], np.log(0.1), np.log(longest))))

        def cost(u: Array) -> float:
            return spectrum.likelihood(*numbers(u))[0]

        start = np.array([0.0, np.log(min(max(0.5 * together, 1.0), longest))])
        simplex = start + np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
        options = {"xatol": 0.02, "fatol": 0.02, "initial_simplex": simplex}
        best = minimize(cost, start, method="Nelder-Mead", options=options)
        share, length = numbers(best.x)
        white, square = spectrum.likelihood(0.0, 1.0)[0], spectrum.likelihood(share, length)[1]
        return cls(share, length, max(square / redundancy, 1.0), white - float(best.fun))

    @property
    def correlation(self) -> Array:
        """Autocorrelation (K,) of the noise at lags 1 ... K, up to where it vanishes."""
        return np.asarray(self.share * np.exp(-np.arange(1.0, _LONGEST_LAG * self.length + 2.0) / self.length))

    @property
    def together(self) -> float:
        """Number of correlated measurements that determine a mean as well as one independent measurement."""
        return 1.0 + 2.0 * float(self.correlation.sum())


@dataclass(frozen=True)
class _Spectrum:
    """Banded cosine spectrum of residuals and of the basis a fit absorbs, where V is nearly diagonal.

    Attributes:
        cosine: (b,) of the frequency, of bands in which the spectrum is even.
        count: (b,) frequencies in each.
        products: (b, 1 + m, 1 + m) sums over a band, of residuals first.
        size: residuals n r, of r columns.
    """

    cosine: Array
    count: Array
    products: Array
    size: tuple[int, int]

    @classmethod
    def of(cls, whitened: Array, basis: Array) -> _Spectrum:
        """Sum the cosine transforms of residuals (n, r) and of a basis (n, r, m) over frequency bands."""
        from scipy.fft import dct

        rows = dct(np.concatenate([whitened[..., None], basis], axis=2), axis=0, norm="ortho")
        n, columns = len(rows), rows.shape[2]
        wide = _UNBANDED * _BAND ** np.arange(np.log(max(n / _UNBANDED, 1.0)) / np.log(_BAND))
        edges = np.unique(np.r_[np.arange(min(n, _UNBANDED)), wide.astype(int), n])
        bands = [rows[a:b].reshape(-1, columns) for a, b in pairwise(edges.tolist())]
        middle = 0.5 * (edges[1:] + edges[:-1] - 1)
        products = np.array([band.T @ band for band in bands])
        return cls(np.cos(np.pi * middle / n), np.diff(edges).astype(float), products, whitened.shape)

    def likelihood(self, share: float, length: float) -> tuple[float, float]:
        """Restricted -2 log L and weighted square q of coloured noise, by share and correlation length."""
        a, (n, r) = float(np.exp(-1.0 / length)), self.size
        power = 1.0 - share + share * (1.0 - a**2) / (1.0 + a**2 - 2.0 * a * self.cosine)
        sums = np.tensordot(1.0 / power, self.products, axes=1)
        absorbed, across = sums[1:, 1:], sums[1:, 0]
        left = float(sums[0, 0] - across @ np.linalg.solve(absorbed, across))
        square, count = max(left, np.finfo(float).tiny), n * r - len(across)
        log_det = r * float(self.count @ np.log(power)) + float(np.linalg.slogdet(absorbed)[1])
        return count * float(np.log(square)) + log_det, square


def autocorrelations(engine: Linearization, values: Values, fitted: int) -> dict[str, Array]:
    """Autocorrelation of each family's residuals, for families whose noise may be coloured.

    It may where they are so few that what `fitted` numbers absorb of them hides it.
    """
    found = {}
    for family, groups in engine.measured.items():
        if len({group.model.rows for group in groups}) == 1:
            whitened = _residuals(groups, values)
            lags, left = autocorrelation(whitened, DIED_OUT), whitened.size - fitted
            hides = len(whitened) >= MIN_MEASUREMENTS <= left and fitted > _ABSORBED * whitened.size
            if left > 0 and whitened.any() and (len(lags) or hides):
                found[family] = lags
    return found


def coloured_noises(
    influence: Influence, correlations: Mapping[str, Array], squares: Mapping[str, tuple[float, float]]
) -> dict[str, ColouredNoise]:
    """Fitted coloured noise of each family of measurements whose residuals are not white.

    Args:
        influence: of the residuals.
        correlations: first guesses, see `autocorrelations`.
        squares: family -> sum of its whitened squares, and their redundancy.
    """
    found = {}
    for family, lags in correlations.items():
        if squares[family][1] < 1.0:  # the fit leaves it no degree of freedom
            continue
        whitened = _residuals(influence.at.engine.measured[family], influence.at.values)
        together = 1.0 + 2.0 * float(lags.sum())
        noise = ColouredNoise.fitted(whitened, _basis(influence, family), squares[family][1], together)
        if noise.fall > quantile(_COLOURED, 2):
            found[family] = noise
    return found


def added_covariance(influence: Influence, noises: Mapping[str, ColouredNoise]) -> dict[str, Array]:
    """Positive semidefinite covariance (m, m) that each family's coloured noise adds to the numbers.

    Residuals of variance v and correlation I + T leave the covariance v L'(I + T) L instead of the L'L of white ones.

    By their autocorrelation, as if errors knew nothing of the motion; by the sandwich over blocks of the recording
    (Liang, Zeger, Biometrika 1986) where that is certainly larger, as of a field that differs from place to place.

    Args:
        influence: of the residuals.
        noises: see `coloured_noises`.
    """
    added, scale = {}, influence.reported.scale
    for family, noise in noises.items():
        L, right = _influences(influence, family)
        groups = influence.at.engine.measured[family]
        time = np.concatenate([group.model.time for group in groups])[_used_in_time(groups, influence.at.values)]
        nominal = np.einsum("nri,nrj->ij", L, L)
        whole = noise.variance * (nominal + _correlated(L, noise.correlation[: len(L) - 1]))
        ratio = ratio_by_blocks(time, np.einsum("nrm,nr->nm", L, right), np.diag(whole))
        more = (np.outer(ratio, ratio) * whole - nominal) / np.outer(scale, scale)
        variances, axes = np.linalg.eigh(0.5 * (more + more.T))
        root = scale[:, None] * axes * np.sqrt(np.maximum(variances, 0.0))
        added[family] = root @ root.T
    return added


def _residuals(groups: Sequence[Group], values: Values) -> Array:
    """Weighted residuals (n, r) of the inliers of several groups, in time order."""
    return np.concatenate([g.weighted(g.residuals(values)) for g in groups])[_used_in_time(groups, values)]


def _influences(influence: Influence, family: str, noise: bool = True) -> tuple[Array, Array]:
    """Influences L (n, r, m) and negative weighted residuals (n, r) of a family's inliers, in time order.

    Args:
        influence: of the residuals.
        family: of measurements.
        noise: whether L is linearised at the measurements as they are; False: at noise-free ones.
    """
    groups, values = influence.at.engine.measured[family], influence.at.values
    found = [influence.rows(group if noise else group.without_noise(values)) for group in groups]
    order = _used_in_time(groups, values)
    return np.concatenate([each[0] for each in found])[order], np.concatenate([each[1] for each in found])[order]


def _basis(influence: Influence, family: str) -> Array:
    """Orthonormal basis (n, r, k) of the changes of noise-free residuals of a family that the numbers cause."""
    L, _ = _influences(influence, family, noise=False)
    flat = (L / influence.reported.scale).reshape(-1, L.shape[2])
    squares, axes = np.linalg.eigh(flat.T @ flat)
    some = squares > _LEAST_SQUARE * squares.max(initial=0.0)
    return np.asarray((flat @ (axes[:, some] / np.sqrt(squares[some]))).reshape(*L.shape[:2], -1))


def variance_shares(posterior: Posterior) -> dict[str, Array]:
    """Share (m, m) of the covariance of the free numbers that white noise of each family causes.

    With C the covariance of the strong directions and L'L the part of it that white noise of a family causes, both in
    units of the priors, and symmetric roots, it is C^-1/2 L'L C^-1/2.
    """
    influence, parts = Influence.of(posterior), dict[str, Array]()
    inverse = posterior.directions.root(-1.0) / posterior.reported.scale
    for family, groups in posterior.at.engine.measured.items():
        some = (each for group in groups for each in group.divided())
        rows = [influence.rows(each)[0].reshape(-1, len(inverse)) @ inverse.T for each in some]
        parts[family] = sum((each.T @ each for each in rows), np.zeros(inverse.shape))
    return parts


def added_by_shares(directions: WeakDirections, shares: Mapping[str, Array], lengths: Mapping[str, float]) -> Array:
    """Covariance (m, m), in prior units, that correlated innovations add to the free numbers.

    Its measurements are gone: families have the shares of the covariance that they once had.

    Args:
        directions: of the covariance that white noise leaves.
        shares: see `variance_shares`; a family that has none may have caused all.
        lengths: family -> how many of its innovations in a row count as one.
    """
    root = directions.root(1.0)
    each = [(length - 1.0) * shares.get(family, np.eye(len(root))) for family, length in lengths.items()]
    return np.asarray(root @ sum(each, np.zeros(root.shape)) @ root)


def _correlated(L: Array, correlation: Array) -> Array:
    """Covariance L'TL (m, m) that correlation adds, for L (n, r, m) and autocorrelation (K,) at lags 1 ... K."""
    size = 1 << (2 * len(L) - 1).bit_length()
    kernel = np.fft.rfft(
        np.concatenate([[0.0], correlation, np.zeros(size - 2 * len(correlation) - 1), correlation[::-1]])
    ).real
    out = np.empty((L.shape[2], L.shape[2]))
    for j in range(L.shape[2]):  # one number at a time: the transform of all would be several times L
        moved = np.fft.irfft(kernel[:, None] * np.fft.rfft(L[..., j], size, axis=0), size, axis=0)[: len(L)]
        out[:, j] = np.einsum("nrm,nr->m", L, moved)
    return out


def ratio_by_blocks(time: Array, moves: Array, expected: Array) -> Array:
    """Ratio (m,) of block-wise to expected sigmas of the numbers; ones if none is significantly above 1.

    Args:
        time: (n,) s, in order.
        moves: (n, m) of the numbers, by each measurement.
        expected: (m,) variance.
    """
    if len(moves) < _BLOCKS * moves.shape[1]:
        return np.ones(moves.shape[1])
    block = np.minimum(_BLOCKS * (time - time[0]) / max(time[-1] - time[0], 1e-300), _BLOCKS - 1).astype(int)
    sums = np.zeros((_BLOCKS, moves.shape[1]))
    np.add.at(sums, block, moves)
    found = np.square(sums).sum(axis=0)
    ratio = sigma_ratio(expected, found)
    certain = ratio.max(initial=1.0) > certain_ratio(_BLOCKS)
    return np.maximum(ratio, 1.0) if certain else np.ones(len(ratio))


def _used_in_time(groups: Sequence[Group], values: Values) -> NDArray[np.intp]:
    """Indices (n,) of the measurements of several groups that are used, in order of time."""
    order = np.argsort(np.concatenate([group.model.time for group in groups]), kind="stable")
    return order[np.concatenate([group.inliers(values) for group in groups])[order]]


def _lagged(whitened: Array, lags: int) -> Array:
    """Sums (lags,) of products of residuals (n, r) at lags 0 ... lags - 1, by FFT."""
    size = 1 << (2 * len(whitened) - 1).bit_length()
    power = (np.abs(np.fft.rfft(whitened, size, axis=0)) ** 2).sum(axis=1)
    return np.asarray(np.fft.irfft(power, size)[: min(lags, len(whitened))])


def certain_ratio(blocks: int) -> float:
    """Ratio of block-wise to expected sigmas that is significantly above 1: by three of its own sigmas.

    These are 1 / sqrt(2 n) for n blocks.
    """
    return float(1.0 + 3.0 / np.sqrt(2.0 * max(blocks, 1)))


def sigma_ratio(variance: Array, grown: Array) -> Array:
    """Ratio (n,) of inflated to nominal sigmas, from the variances; 1 for fixed numbers."""
    return np.sqrt(np.divide(grown, variance, out=np.ones_like(variance), where=variance > 0.0))
