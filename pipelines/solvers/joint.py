"""Recordings of one device put together: what each says of its numbers, joined by square roots of information.

Numbers of the device are one unknown, or one for each recording where they walk between dates; those of a recording are
its own. Each recording's own numbers are eliminated first, so that what is left is as small as the device.

    joined = join([first.sqrt_info, second.sqrt_info], rates, days)
    joined.all(0)                           # the numbers of the first recording, from all recordings
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.estimation.problem import SqrtInformation
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.solvers.posterior import fewest

# Two dates are never nearer than this, days.
LEAST_DAYS = 1e-6
# Of what recordings say of the device, directions with a sigma beyond so many times the priors' are not compared.
_FAINT = 1e4

# Elements of a prior's row below this share of its largest are rounding.
_ROUNDING = 1e-9
# Sources of a joint variance beside priors.
RECORDING, WALK = "recording ", "walk between recordings"

# A number of the device: its name and, where it walks, the recording.
Unknown = tuple[str, int | None]


@dataclass(frozen=True, eq=False)
class Part:
    """A recording's square-root information, R y = d on the device's numbers y, S y + T z = e on its own z.

    Attributes:
        names: (n,) of the device's numbers.
        own: (m,) of the recording's.
        R, d: (r, n), (r,), rows of unit variance.
        S, T, e: (m, n), (m, m), (m,).
        scales: (n,) of the priors.
    """

    names: tuple[str, ...]
    own: tuple[str, ...]
    R: Array
    d: Array
    S: Array
    T: Array
    e: Array
    scales: Array

    @classmethod
    def of(cls, sqrt_info: SqrtInformation, device: Mapping[str, float]) -> Part:
        """Eliminate a recording's own numbers from its information; y and z are absolute, no steps."""
        shared = [i for i, name in enumerate(sqrt_info.names) if name in device]
        own = [i for i, name in enumerate(sqrt_info.names) if name not in device]
        n, scales = len(own), sqrt_info.scales[shared]
        whole = np.column_stack([sqrt_info.R[:, own + shared], sqrt_info.d + sqrt_info.R @ sqrt_info.at])
        triangle = np.linalg.qr(whole).R
        R, d = fewest(triangle[n:, n:-1], triangle[n:, -1], scales)
        return cls(
            names=tuple(sqrt_info.names[i] for i in shared),
            own=tuple(sqrt_info.names[i] for i in own),
            R=R,
            d=d,
            S=triangle[:n, n:-1],
            T=triangle[:n, :n],
            e=triangle[:n, -1],
            scales=scales,
        )


@dataclass(frozen=True, eq=False)
class Joined:
    """The joint estimate of several recordings.

    Attributes:
        parts: the recordings, in the order of their dates.
        unknowns: of the device.
        rows: for each recording, of its walk and of the priors: coefficients (r, n) of the unknowns, right sides (r,).
        scales: (n,) of the unknowns' priors.
        values: (n,) of the unknowns.
        covariance: (n, n).
    """

    parts: Sequence[Part]
    unknowns: tuple[Unknown, ...]
    rows: Sequence[tuple[Array, Array]]
    scales: Array
    values: Array
    covariance: Array

    def all(self, recording: int) -> GaussianPrior:
        """Posterior of all numbers as of a recording: the device's, known or last known, and the recording's own."""
        part = self.parts[recording]
        names, gain, inverse = self._of_unknowns(recording)
        covariance, mean = gain @ self.covariance @ gain.T, gain @ self.values
        own = slice(len(names) - len(part.own), None)
        covariance[own, own] += inverse @ inverse.T
        mean[own] += inverse @ part.e
        return GaussianPrior(names, mean, covariance)

    def budget(self, recording: int, recordings: Sequence[str]) -> dict[str, dict[str, float]]:
        """Error budget of the numbers of `all`: each source's share of the variance, the largest first; sums to one.

        Sources are the recordings (what each says, with its own numbers' priors), every prior of the device by itself
        ("prior of NAME"; "prior" of several together), and the walk between recordings.

        Args:
            recording: in which the numbers are as they are.
            recordings: what they are called.
        """
        names, gain, inverse = self._of_unknowns(recording)
        sources = [f"{RECORDING}{name}" for name in recordings]
        variances: dict[str, Array] = {}
        for source, (A, _) in zip([*sources, WALK, ""], self.rows, strict=True):
            squares = (gain @ self.covariance @ A.T) ** 2
            for label, column in zip(self._priors(A) if source == "" else [source] * len(A), squares.T, strict=True):
                variances[label] = variances.get(label, np.zeros(len(names))) + column
        variances[sources[recording]][len(names) - len(inverse) :] += (inverse**2).sum(axis=1)
        total = np.sum(list(variances.values()), axis=0)
        return {
            name: dict(
                sorted(((s, float(v[k] / total[k])) for s, v in variances.items() if v[k] > 0.0), key=lambda x: -x[1])
            )
            for k, name in enumerate(names)
        }

    def _of_unknowns(self, recording: int) -> tuple[tuple[str, ...], Array, Array]:
        """Names (k,) of the numbers of `all`, their gain (k, n) by the unknowns, and own inverse root T^-1 (m, m)."""
        part = self.parts[recording]
        latest = {name: i for i, (name, _) in enumerate(self.unknowns)}
        missing = [name for name in latest if name not in part.names]
        select = np.eye(len(self.unknowns))[[*self._places(recording), *(latest[name] for name in missing)]]
        inverse = np.linalg.inv(part.T)
        gain = np.vstack([select, -inverse @ part.S @ select[: len(part.names)]])
        return (*part.names, *missing, *part.own), gain, np.asarray(inverse)

    def _priors(self, A: Array) -> list[str]:
        """Source label of each prior row: "prior of NAME", or "prior" where a row has several numbers."""
        size = np.abs(A * self.scales)
        about = [np.flatnonzero(row > _ROUNDING * row.max(initial=0.0)) for row in size]
        return [f"prior of {self.unknowns[k[0]][0]}" if len(k) == 1 else "prior" for k in about]

    def distance(self, recording: int, sqrt_info: SqrtInformation) -> float:
        """Distance of the joint estimate from a recording's linearisation point, in the recording's sigmas."""
        means = self.all(recording).means
        return float(np.linalg.norm(sqrt_info.R @ ([means[name] for name in sqrt_info.names] - sqrt_info.at)))

    @property
    def walking(self) -> tuple[str, ...]:
        """Names of the device's numbers that change from recording to recording as a random walk."""
        return tuple(dict.fromkeys(name for name, recording in self.unknowns if recording is not None))

    def sigmas_to(self, other: Joined) -> float:
        """Largest difference from another joint estimate of the same unknowns, in this one's sigmas."""
        return float(np.max(np.abs(other.values - self.values) / np.sqrt(np.diag(self.covariance)), initial=0.0))

    @property
    def disagreement(self) -> tuple[float, int]:
        """Chi-square of the recordings' residuals about a common device, without priors, and its degrees of freedom."""
        A, b = (np.concatenate(each) for each in zip(*self.rows[:-1], strict=True))
        u, s, _ = np.linalg.svd(A * self.scales, full_matrices=False)
        fitted = u[:, s > 1.0 / _FAINT]
        left = b - fitted @ (fitted.T @ b)
        return float(left @ left), len(b) - fitted.shape[1]

    def _places(self, recording: int) -> list[int]:
        """Positions among the unknowns of the device's numbers as of a recording."""
        places = {unknown: i for i, unknown in enumerate(self.unknowns)}
        names = self.parts[recording].names
        return [places[name, None] if (name, None) in places else places[name, recording] for name in names]


def grown(sigmas: Sequence[float], inflations: Sequence[float]) -> float:
    """Inflation of a joint sigma: rms of the recordings' inflations, weighted by their information on the number."""
    found = [(sigma, inflation) for sigma, inflation in zip(sigmas, inflations, strict=True) if sigma > 0.0]
    if not found:
        return 1.0
    own, factors = np.array(found).T
    return float(np.average(factors**2, weights=own**-2.0) ** 0.5)


def join(informations: Sequence[SqrtInformation], rates: Mapping[str, float], days: Sequence[float]) -> Joined:
    """Join recordings of one device into a joint estimate.

    Args:
        informations: of each, in the order of their dates.
        rates: of the device's numbers, how far they walk in the root of a day; 0: not at all.
        days: of the recordings, from any.
    """
    parts = [Part.of(each, rates) for each in informations]
    unknowns: dict[Unknown, float] = {}
    for i, part in enumerate(parts):
        for name, scale in zip(part.names, part.scales, strict=True):
            unknowns.setdefault((name, i if rates[name] else None), float(scale))
    places = {unknown: k for k, unknown in enumerate(unknowns)}

    def spread(R: Array, names: Sequence[str], i: int) -> Array:
        """Map rows about one recording's numbers to columns of the joint unknowns."""
        out = np.zeros((len(R), len(unknowns)))
        for k, name in enumerate(names):
            out[:, places[name, i if rates[name] else None]] = R[:, k]
        return out

    rows = [(spread(part.R, part.names, i), part.d) for i, part in enumerate(parts)]
    rows += [_walks(places, rates, days), _priors(informations, rates, spread)]
    scales = np.array(list(unknowns.values()))
    return Joined(parts, tuple(unknowns), rows, scales, *_solved(rows, scales))


def _walks(places: Mapping[Unknown, int], rates: Mapping[str, float], days: Sequence[float]) -> tuple[Array, Array]:
    """Random-walk rows [A | 0] between consecutive recordings, for the numbers with a rate."""
    rows = [np.empty((0, len(places)))]
    for name, rate in rates.items():
        for before, after in pairwise([i for i in range(len(days)) if rate and (name, i) in places]):
            row = np.zeros((1, len(places)))
            sigma = rate * max(abs(days[after] - days[before]), LEAST_DAYS) ** 0.5
            row[0, [places[name, before], places[name, after]]] = -1.0 / sigma, 1.0 / sigma
            rows.append(row)
    A = np.concatenate(rows)
    return A, np.zeros(len(A))


def _priors(
    informations: Sequence[SqrtInformation],
    rates: Mapping[str, float],
    spread: Callable[[Array, Sequence[str], int], Array],
) -> tuple[Array, Array]:
    """Prior rows of the device; a number's prior is that of the first recording that has the number."""
    rows, rights = [], []
    covered: set[str] = set()
    for i, each in enumerate(informations):
        of_device = [k for k, name in enumerate(each.names) if name in rates]
        names = [each.names[k] for k in of_device]
        R = each.prior_R[:, of_device]
        new = [name not in covered for name in names]
        kept = (R[:, new] != 0.0).any(axis=1)
        rows.append(spread(R[kept], names, i))
        rights.append((each.prior_d + each.prior_R @ each.at)[kept])
        covered.update(names)
    return np.concatenate(rows), np.concatenate(rights)


def _solved(rows: Sequence[tuple[Array, Array]], scales: Array) -> tuple[Array, Array]:
    """Solve stacked rows by least squares; return the unknowns (n,) and their covariance (n, n)."""
    A, b = (np.concatenate(each) for each in zip(*rows, strict=True))
    triangle = np.linalg.qr(np.column_stack([A * scales, b])).R
    n = len(scales)
    inverse = np.linalg.inv(triangle[:n, :n])
    return scales * (inverse @ triangle[:n, n]), (inverse @ inverse.T) * np.outer(scales, scales)
