"""Uncertainty in use: the error that a calibration leaves when it is applied, with its 95 % band.

A use error is e(u; applied, true): what a reading of a sensor with the parameters `true` becomes when `applied` is used
on it, less what is right, at the operating point u (heading, rate, direction, gimbal angle, time). With the estimate x,
its joint covariance P, and x_a, the values that the formulas apply,

    after:   m(u) = e(u; x_a, x),      J(u) = d e(u; x_a, t) / d t at t = x,  S(u) = J P J' + N(u)
    before:  the same with nominal values applied: K = I, b = 0, mounts and delays 0.

N is noise of the use itself (angle random walk of an integrated attitude; 0 elsewhere). A scalar error has the band
m +- 1.96 sqrt(S). Of a vector the length is shown with the 95 % quantile of |N(m, S)|, whose square is matched in mean
and variance by a scaled chi-square (Patnaik 1949): mean tr S + m'm, variance 2 tr S^2 + 4 m' S m. Derivatives are
central differences of a tenth of a sigma. Where 2,000 draws of true ~ N(x, P) show that the error is not linear, the
bound is the quantile of 4,000 draws. Bands are conditional on the posterior: NEES over seeds is the test of P itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from alidade.factors.array import Array

Z95 = 1.959963984540054
# Draws that test whether the error is linear, the coverage that they may show, and draws that give bounds where not.
_TEST_DRAWS, _COVERAGE, _BOUND_DRAWS = 2000, (0.93, 0.97), 4000
_CHUNK = 250
# Bounds smaller than this share of the largest are rounding.
_NOTHING = 1e-9
# Of a sigma, for derivatives.
_STEP = 0.1


class Truth:
    """Sets of true parameter values (..., n) by name; unknown parameters are 0."""

    def __init__(self, names: Sequence[str], values: Array) -> None:
        self.index = {name: i for i, name in enumerate(names)}
        self.values = values

    def __contains__(self, name: str) -> bool:
        return name in self.index

    def get(self, name: str, default: float = 0.0) -> Array:
        """Values (...,) of a parameter, by name."""
        if name in self.index:
            return np.asarray(self.values[..., self.index[name]])
        return np.full(self.values.shape[:-1], default)

    def vector(self, *names: str) -> Array:
        """Values (..., len(names)) of several parameters."""
        return np.stack([self.get(name) for name in names], axis=-1)

    def xyz(self, stem: str) -> Array:
        """Vectors (..., 3) of the parameters stem_x, stem_y, stem_z."""
        return self.vector(*(f"{stem}_{axis}" for axis in "xyz"))

    def matrix(self, rows: Sequence[Sequence[str]], diagonal: float = 0.0) -> Array:
        """Matrix (..., 3, 3) of parameters; unknown entries on the diagonal are `diagonal`."""
        each = [[self.get(n, diagonal * (i == j)) for j, n in enumerate(row)] for i, row in enumerate(rows)]
        return np.stack([np.stack(row, axis=-1) for row in each], axis=-2)


class Applied(Protocol):
    """Formulas of a calibration with values inserted."""

    @property
    def values(self) -> Mapping[str, float]:
        """Applied values, by parameter."""

    def __call__(self, **measured: Array) -> Mapping[str, Array]:
        """Apply the calibration to measurements; return the results by name."""


@dataclass(frozen=True)
class Line:
    """A curve of errors over operating points: `error(applied, true)` (..., U), or vectors (..., U, d) for lengths.

    `noise` is a variance per component, (U,); `color` is one of the palette.
    """

    name: str
    error: Callable[[Applied, Truth], Array]
    color: str = "series0"
    noise: Array | None = None


@dataclass(frozen=True)
class Coefficients:
    """Coefficients that summarise a curve of scalar errors: `of` maps (..., U) to (..., k), nan if undefined."""

    names: tuple[str, ...]
    of: Callable[[Array], Array]
    formula: str


@dataclass(frozen=True)
class Use:
    """An application of a calibration, with the error that remains there.

    Attributes:
        name: for programs.
        title: for people.
        x: operating points (U,), and x_title their axis.
        y_title, unit, factor: of the error, and what its SI number is multiplied by.
        lines: curves.
        formula: of the error; condition: under which it is shown.
        label: of the headline figure.
        at: operating point of the headline figure; None: the worst.
        signed: a scalar error.
        coefficients: of each curve of a scalar error.
    """

    name: str
    title: str
    x: Array
    x_title: str
    y_title: str
    unit: str
    factor: float
    lines: tuple[Line, ...]
    formula: str
    condition: str
    label: str
    at: int | None = None
    signed: bool = False
    coefficients: Coefficients | None = None


@dataclass(frozen=True)
class Posterior:
    """An estimate, with the part of it that the application applies.

    Attributes:
        names, x, P: of the parameters.
        require: accuracy wanted of each, 0 where none.
        applied, nominal, whole: the formulas with the values applied, with nominal ones, and with all estimates.
        truth: values (n,), where known.
    """

    names: Sequence[str]
    x: Array
    P: Array
    require: Array
    applied: Applied
    nominal: Applied
    whole: Applied
    truth: Array | None = None


@dataclass(frozen=True)
class Band:
    """Error band over the operating points, (U,), SI; for a vector, of its length.

    Attributes:
        before, before_bounds: nominal values applied: error with its lower and upper bound.
        after, bound: m, and the half-width about it of a scalar, the 95 % quantile of a vector's length.
        allowed: bound if the parameters only just met their requirements.
        uncorrelated: bound from the sigmas alone.
        whole: bound if all estimates were applied, those of nuisance parameters too.
        actual: error by the truth, where known.
        coefficients: (k, 4) before, sigma, after, sigma; None where the use has none.
    """

    before: Array
    before_bounds: tuple[Array, Array]
    after: Array
    bound: Array
    allowed: Array
    uncorrelated: Array
    whole: Array
    actual: Array | None
    coefficients: Array | None = None


# Unit -> largest error of a direction, which linear bands exceed where it is not determined.
_LARGEST = {"deg": 180.0, "mrad": 1e3 * np.pi}


@dataclass(frozen=True, repr=False)
class UseBands:
    """A use with the band of each of its lines; `drawn`: bounds are quantiles of draws."""

    use: Use
    bands: Mapping[str, Band]
    drawn: bool = False

    def __repr__(self) -> str:
        return f"<{self.use.name}: {self.before:.3g} {self.use.unit} before, {self.after:.3g} after, 95 %>"

    def figure(self, values: Callable[[Band], Array]) -> float:
        """Largest value of the bands, or that at the operating point `at`, in the use's unit; at most half a turn."""
        at, most = self.use.at, _LARGEST.get(self.use.unit, np.inf)
        found = max(float(v.max() if at is None else v[at]) for v in map(values, self.bands.values()))
        return float(min(self.use.factor * found, most))

    @property
    def before(self) -> float:
        """Largest 95 % bound of the error in use without the calibration, in the use's unit."""
        return self.figure(lambda band: np.maximum(*map(np.abs, band.before_bounds)))

    @property
    def after(self) -> float:
        """Largest 95 % bound of the error in use with the calibration, in the use's unit."""
        return self.figure(lambda band: band.bound + np.abs(band.after) * self.use.signed)

    @property
    def required(self) -> float | None:
        """Largest 95 % bound of the error in use if all sigmas were as large as required, in the use's unit.

        None without requirements.
        """
        return self.figure(lambda band: band.allowed) or None

    @property
    def coefficients(self) -> dict[str, dict[str, dict[str, float]]] | None:
        """Coefficients of each line: before, before_sigma, after, after_sigma, in the use's unit; None if undefined."""
        if self.use.coefficients is None:
            return None
        columns = ("before", "before_sigma", "after", "after_sigma")
        return {
            line: {
                name: dict(zip(columns, (self.use.factor * row).tolist(), strict=True))
                for name, row in zip(self.use.coefficients.names, band.coefficients, strict=True)
            }
            for line, band in self.bands.items()
            if band.coefficients is not None
        }


def use_bands(use: Use, posterior: Posterior) -> UseBands:
    """Compute the error bands of a use; linearised bounds are checked by draws and replaced if inaccurate."""
    found = UseBands(use, {line.name: _band(use, line, posterior) for line in use.lines})
    shares = coverage(found, posterior, _TEST_DRAWS, seed=1)
    low, high = _COVERAGE
    if all(low < share < high for each in shares.values() for share in each[np.isfinite(each)]):
        return found
    bounds = {name: np.quantile(e, 0.95, axis=0) for name, e in _draws(found, posterior, _BOUND_DRAWS, 2).items()}
    return replace(found, bands={n: replace(b, bound=bounds[n]) for n, b in found.bands.items()}, drawn=True)


def coverage(found: UseBands, posterior: Posterior, draws: int = 10_000, seed: int = 0) -> dict[str, Array]:
    """Share (U,) of drawn calibrations with exact error within the band, by line; nan where nothing is uncertain."""
    shares = {}
    for name, errors in _draws(found, posterior, draws, seed).items():
        bound = found.bands[name].bound
        shares[name] = np.where(bound > _NOTHING * bound.max(), (errors <= bound).mean(axis=0), np.nan)
    return shares


def _draws(found: UseBands, posterior: Posterior, draws: int, seed: int) -> dict[str, Array]:
    """Errors (draws, U) without linearisation for truths drawn from N(x, P): |e - m| of scalars, |e| of vectors."""
    values, vectors = np.linalg.eigh(posterior.P)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    rng = np.random.default_rng(seed)
    parts: dict[str, list[Array]] = {line.name: [] for line in found.use.lines}
    for _ in range(0, draws, _CHUNK):
        true = Truth(posterior.names, posterior.x + rng.standard_normal((_CHUNK, len(posterior.x))) @ root.T)
        for line in found.use.lines:
            e = _components(line.error(posterior.applied, true), found.use.signed)
            if line.noise is not None:
                e = e + np.sqrt(line.noise)[:, None] * rng.standard_normal(e.shape)
            center = found.bands[line.name].after[:, None] if found.use.signed else 0.0
            parts[line.name].append(np.linalg.norm(e - center, axis=-1))
    return {name: np.concatenate(each) for name, each in parts.items()}


def _band(use: Use, line: Line, posterior: Posterior) -> Band:
    def linear(applied: Applied) -> tuple[Array, Array]:
        return _linearised(lambda t: _components(line.error(applied, Truth(posterior.names, t)), use.signed), posterior)

    def size(error: Array) -> Array:
        return np.asarray(error[:, 0] if use.signed else np.linalg.norm(error, axis=-1))

    def bound(mean: Array, S: Array) -> Array:
        return np.asarray(Z95 * np.sqrt(S[:, 0, 0])) if use.signed else _length_bound(mean, S)

    (mean, J), (mean0, J0), (mean_w, J_w) = (linear(a) for a in (posterior.applied, posterior.nominal, posterior.whole))
    noise = 0.0 if line.noise is None else line.noise[:, None, None] * np.eye(mean.shape[-1])
    covariances = (posterior.P, np.diag(np.diag(posterior.P)), np.diag(posterior.require**2))
    S, alone, allowed = (J @ each @ np.swapaxes(J, -1, -2) for each in covariances)
    S0, S_w = (each @ posterior.P @ np.swapaxes(each, -1, -2) for each in (J0, J_w))
    along = mean0 / np.maximum(np.linalg.norm(mean0, axis=-1), 1e-300)[:, None]
    before, spread = size(mean0), Z95 * np.sqrt(np.einsum("ui,uij,uj->u", along, S0, along))
    actual = None
    if posterior.truth is not None:
        actual = _components(line.error(posterior.applied, Truth(posterior.names, posterior.truth)), use.signed)
    return Band(
        before=before,
        before_bounds=(np.maximum(before - spread, -np.inf if use.signed else 0.0), before + spread),
        after=size(mean),
        bound=bound(mean, S + noise),
        allowed=bound(np.zeros_like(mean), allowed),
        uncorrelated=bound(mean, alone + noise),
        whole=bound(mean_w, S_w + noise),
        actual=None if actual is None else size(actual),
        coefficients=None if use.coefficients is None else _coefficients(use.coefficients, line, posterior),
    )


def _coefficients(coefficients: Coefficients, line: Line, posterior: Posterior) -> Array:
    """Coefficients (k, 4) of a line: value and sigma with nominal parameters applied, then with estimated ones."""
    columns = []
    for applied in (posterior.nominal, posterior.applied):

        def compute(t: Array, applied: Applied = applied) -> Array:
            return coefficients.of(line.error(applied, Truth(posterior.names, t)))[..., None]

        mean, J = _linearised(compute, posterior)
        columns += [mean[:, 0], np.sqrt(np.einsum("ki,ij,kj->k", J[:, 0], posterior.P, J[:, 0]))]
    return np.stack(columns, axis=1)


def _linearised(error: Callable[[Array], Array], posterior: Posterior) -> tuple[Array, Array]:
    """Mean error (U, d), and its Jacobian (U, d, n) by the true parameters, at the estimate."""
    x, step = posterior.x, _STEP * np.sqrt(np.diag(posterior.P))
    free = np.flatnonzero(step > 0.0)
    mean = error(x)
    J = np.zeros((*mean.shape, len(x)))
    if len(free):
        h = (np.eye(len(x)) * step)[free]
        differences = error(x + h) - error(x - h)
        J[..., free] = np.moveaxis(differences / (2.0 * step[free])[:, None, None], 0, -1)
    return mean, J


def _components(error: Array, signed: bool) -> Array:
    return error[..., None] if signed else error


def _length_bound(mean: Array, S: Array) -> Array:
    """95 % quantile of the length of N(mean (U, d), S (U, d, d))."""
    # Importing it takes longer than most commands that need no quantile.
    from scipy.special import gammaincinv

    first = np.trace(S, axis1=-2, axis2=-1) + (mean**2).sum(-1)
    second = 2.0 * np.einsum("uij,uji->u", S, S) + 4.0 * np.einsum("ui,uij,uj->u", mean, S, mean)
    nu = np.clip(2.0 * first**2 / np.maximum(second, 1e-300), 1.0, 1e6)
    return np.asarray(np.sqrt(first / nu * 2.0 * gammaincinv(0.5 * nu, 0.95)))
