"""Noise coefficients of a sensor at rest, by maximum likelihood.

The cosine transform (DCT-II) of evenly spaced samples splits them into independent numbers. With u = 4 sin^2(pi k / 2n)
their variances are, for samples tau0 apart and k = 1 ... n-1,

    N^2 / tau0  +  K^2 tau0 / u  +  B^2 / sqrt(u)  +  Q^2 u / tau0^2

White noise and random walk are split exactly (the basis is that of the walk's increments), the quantised integral but
for its ends; the term of B is the flicker of Hosking, "Fractional differencing", Biometrika 1981, and agrees with
B^2 / (2 pi f) of IEEE Std 952. So every number of the transform counts with all its information about the coefficients,
where slopes read from an Allan plot use a few of them; the likelihood is Whittle's (1953), exact for N and K.

Sinusoids (vibration, mains, a beat of the sampling) are lines far above the floor of a spectrum and taken out before.
That spectrum is Welch's, "The use of fast Fourier transform for the estimation of power spectra", IEEE Trans. Audio
Electroacoust. 1967: Hann windows that overlap by half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from alidade.factors.array import Array, Index, Mask
from alidade.factors.chi_square import interval, quantile
from alidade.pipelines.diagnostics.allan import NOISES, AllanCurve, allan_curve, confidence

# Power of sqrt(u) and of tau0 in the variance, in the order Q, N, B, K.
_POWER_U, _POWER_TAU = np.array([2.0, 0.0, -1.0, -2.0]), np.array([-2.0, -1.0, 0.0, 1.0])
_N, _EACH = NOISES.index("N"), np.arange(4)
# Numbers of the transform are averaged within bins of this part of an octave.
_PER_OCTAVE = 16
# A noise is part of the model when twice the logarithm of the likelihood rises by more than this without bound, and is
# determined when its square is so many of its sigmas from zero.
_INCLUDED, _DETERMINED = 10.0, 3.0
# 95 % of chi-square of one degree of freedom on one side.
_BELOW = 2.706
_CONFIDENCE = 0.95
# An octave contradicts the model when its mean power is off by more than this part, and by what chance does once in so
# many octaves.
_OFF, _ONCE_IN = 0.1, 3e6
# The band that is fitted spans at least so many octaves.
_LEAST_OCTAVES = 4.0
# A longer record could determine a noise up to this length, s.
_LONGEST_RECORD = 30.0 * 86400.0
# What is taken out with a sinusoid are its neighbours in the transform of the record, so many on either side.
_BESIDE = 3.0
# A sensor whose step is larger than so many times its noise repeats itself, and what it repeats is no noise.
_COARSE = 2.0


@dataclass(frozen=True)
class Coefficient:
    """Noise coefficient with its interval.

    Attributes:
        name: Q, N, B or K.
        value: its estimate; None when the record does not determine it.
        sigma: of the value, one standard deviation.
        low, high: 95 % interval; of an undetermined noise, 0 and the bound with 95 % confidence.
        needed_s: length of a record, s, that would determine a noise of half that bound; None where the value is
            determined, or no record of a month would.
    """

    name: str
    value: float | None
    sigma: float | None
    low: float
    high: float
    needed_s: float | None = None


@dataclass(frozen=True, eq=False)
class NoiseFit:
    """Noise coefficients fitted to one axis.

    Attributes:
        coefficients: Q, N, B, K.
        squares: (4,) Q^2, N^2, B^2, K^2 of the model that fits best, zero for what is not in it.
        band_hz: the frequencies it holds for.
        filtered: above the band the samples are smoother, or rougher, than any model: a filter in the sensor.
        misfit: factor between power found and power of the model in the octave where they differ most; 1 where they
            agree within chance.
        misfit_hz: that octave's middle.
    """

    coefficients: tuple[Coefficient, ...]
    squares: Array
    band_hz: tuple[float, float]
    filtered: bool
    misfit: float
    misfit_hz: float


@dataclass(frozen=True, eq=False)
class _Bins:
    """Frequency bins of a transform: mean power (n,), count (n,), and mean variance for each unit noise (n, 4)."""

    hz: Array
    power: Array
    count: Array
    basis: Array

    def below(self, hz: float) -> _Bins:
        keep = self.hz <= hz
        return _Bins(self.hz[keep], self.power[keep], self.count[keep], self.basis[keep])


def fit_noise(pieces: Sequence[Array], interval_s: float, lines: Sequence[tuple[float, float]] = ()) -> NoiseFit:
    """Fit noise coefficients to pieces of a record at rest.

    Args:
        pieces: samples of a rate, each piece evenly spaced by interval_s.
        interval_s: s.
        lines: bands, Hz, that are left out because a sinusoid is in them.
    """
    bins = _binned(pieces, interval_s, lines)
    top = float(bins.hz[-1])
    band, squares, model = _widest_band(bins)
    off, where = _worst_octave(band, band.basis @ squares)
    longest = max(len(piece) for piece in pieces)
    found = tuple(_coefficient(i, band, squares, model, longest, interval_s) for i in range(4))
    limits = float(band.hz[0]), float(band.hz[-1])
    return NoiseFit(found, squares, limits, limits[1] < 0.9 * top, off, where)


def _binned(pieces: Sequence[Array], interval_s: float, lines: Sequence[tuple[float, float]]) -> _Bins:
    from scipy.fft import dct

    longest = max(len(piece) for piece in pieces)
    # Bin i begins at this part of half the sampling rate, the last one below the lowest frequency of all.
    edges = 2.0 ** (-np.arange(np.ceil(_PER_OCTAVE * np.log2(longest)) + 2.0)[::-1] / _PER_OCTAVE)
    count, power, hz = np.zeros((3, len(edges) - 1))
    for piece in pieces:
        n = len(piece)
        square = dct(piece - piece.mean(), norm="ortho") ** 2
        f = np.arange(n) / (2.0 * n * interval_s)
        kept = np.ones(n)
        for low, high in lines:
            kept[slice(*np.searchsorted(f, [low, high]))] = 0.0
        square *= kept
        starts = np.ceil(n * edges).astype(np.intp)
        filled = np.flatnonzero(np.diff(starts))
        for total, values in ((count, kept), (power, square), (hz, f * kept)):
            total[filled] += np.add.reduceat(values, starts[filled])
    some = count > 0.0
    hz = hz[some] / count[some]
    # A bin is so narrow that its mean variance is that at its mean frequency, to 3e-4.
    return _Bins(hz, power[some] / count[some], count[some], _variances(hz, interval_s))


def _variances(hz: Array, interval_s: float) -> Array:
    """Variance of the transform at frequencies (n,), Hz, for each noise with a coefficient of one (n, 4)."""
    root_u = 2.0 * np.sin(np.pi * hz * interval_s)
    return np.asarray(root_u[:, None] ** _POWER_U * interval_s**_POWER_TAU)


def _widest_band(bins: _Bins) -> tuple[_Bins, Array, Mask]:
    """Find the band up to the highest frequency at which a model fits; the whole band if none fits.

    A sensor's own low-pass filter takes away noise near half the sampling rate; what is below it is the density that
    counts for an integral. Quantisation is what rises up to half the sampling rate; in a narrower band it has no place.
    """
    whole = bins, *_select(bins, NOISES)
    if _fits(*whole[:2]):
        return whole
    edge = float(bins.hz[-1])
    while edge >= bins.hz[0] * 2.0**_LEAST_OCTAVES:
        edge /= 2.0**0.5
        band = bins.below(edge)
        part = band, *_select(band, NOISES[1:])
        if _fits(*part[:2]):
            # What a filter takes away falls to a quarter an octave, and was just too little to be seen.
            lower = bins.below(max(0.5 * edge, bins.hz[0] * 2.0**_LEAST_OCTAVES))
            return lower, *_select(lower, NOISES[1:])
    return whole


def _fits(bins: _Bins, squares: Array) -> bool:
    return _worst_octave(bins, bins.basis @ squares)[0] == 1.0


def _select(bins: _Bins, candidates: Sequence[str]) -> tuple[Array, Mask]:
    """Select noises stepwise by likelihood; return squared coefficients (4,) and the mask of noises in the model."""
    left = {NOISES.index(name) for name in candidates} - {_N}
    model = _EACH == _N
    squares = _maximise(bins, model)
    best = _likelihood(bins, squares)
    while left:
        trials = []
        for i in left:
            trial = _maximise(bins, model | (i == _EACH))
            trials.append((_likelihood(bins, trial), i, trial))
        likelihood, i, trial = max(trials, key=lambda t: t[0])
        if likelihood - best < _INCLUDED:
            break
        model[i] = True
        left.remove(i)
        best, squares = likelihood, trial
    return squares, model


def _likelihood(bins: _Bins, squares: Array) -> float:
    """Twice the log likelihood of the bins' power under squared coefficients (4,)."""
    variance = bins.basis @ squares
    return -float(bins.count @ (np.log(variance) + bins.power / variance))


def _maximise(bins: _Bins, model: Mask, fixed: tuple[int, float] | None = None) -> Array:
    """Maximum-likelihood squared coefficients (4,), zero outside the model; `fixed` gives an index and its value.

    Fisher scoring in the logarithms, which keeps variances positive; a noise that is not there goes to nearly zero.
    """
    basis, weight, squares = bins.basis[:, model], np.sqrt(bins.count), np.zeros(4)
    # To begin with each explains its part of the power where it is strongest.
    squares[model] = (weight * bins.power) @ basis / (weight @ basis**2) / basis.shape[1]
    if fixed is not None:
        squares[fixed[0]] = fixed[1]
    now, damping = _likelihood(bins, squares), 1e-6
    for _ in range(200):
        variance = bins.basis @ squares
        relative = basis * squares[model] / variance[:, None]
        gradient = relative.T @ (bins.count * (bins.power / variance - 1.0))
        information = relative.T @ (bins.count[:, None] * relative)
        information[np.diag_indices_from(information)] += damping * np.diag(information) + 1e-12
        trial = squares.copy()
        trial[model] *= np.exp(np.clip(np.linalg.solve(information, gradient), -3.0, 3.0))
        new = _likelihood(bins, trial)
        if new < now:
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e6:
                break
            continue
        gained, squares, now, damping = new - now, trial, new, 0.1 * damping
        if gained < 1e-7:
            break
    return squares


def _sigmas(bins: _Bins, squares: Array, model: Mask) -> Array:
    """Sigmas (4,) of the squared coefficients in the model, from the Fisher information of all bins."""
    relative = bins.basis[:, model] * squares[model] / (bins.basis @ squares)[:, None]
    information = 0.5 * relative.T @ (bins.count[:, None] * relative)
    out = np.zeros(4)
    out[model] = np.sqrt(np.diag(np.linalg.pinv(information))) * squares[model]
    return out


def _coefficient(i: int, bins: _Bins, squares: Array, model: Mask, samples: int, interval_s: float) -> Coefficient:
    sigma = _sigmas(bins, squares, model)[i]
    if model[i] and squares[i] >= _DETERMINED * sigma:
        low, high = interval(_CONFIDENCE, float(2.0 * (squares[i] / sigma) ** 2))
        root = float(np.sqrt(squares[i]))
        return Coefficient(NOISES[i], root, float(0.5 * sigma) / root, root * low**0.5, root * high**0.5)
    bound = _bound(i, bins, squares, model)
    needed = _length_needed(i, bins, squares, model, bound / 4.0, samples, interval_s)
    return Coefficient(NOISES[i], None, None, 0.0, float(np.sqrt(bound)), needed)


def _bound(i: int, bins: _Bins, squares: Array, model: Mask) -> float:
    """Upper limit (95 %) of the squared coefficient i, by the profile likelihood."""
    start = _maximise(bins, model | (i == _EACH))
    best = max(_likelihood(bins, start), _likelihood(bins, squares))
    others = model & (i != _EACH)

    def fallen(square: float) -> bool:
        return best - _likelihood(bins, _maximise(bins, others, (i, square))) > _BELOW

    # More than all the power there is it cannot be.
    low, high = float(start[i]), 10.0 * float(np.max(bins.power / bins.basis[:, i]))
    while high > 1.02 * low:
        middle = float(np.sqrt(max(low, 1e-12 * high) * high))
        low, high = (low, middle) if fallen(middle) else (middle, high)
    return high


def _length_needed(
    i: int, bins: _Bins, squares: Array, model: Mask, square: float, samples: int, interval_s: float
) -> float | None:
    """Length, s, of one record that would determine noise i with this squared coefficient."""
    with_it, there = model | (i == _EACH), np.where(i == _EACH, square, squares)
    edges = 2.0 ** np.arange(np.log2(2.0 * bins.hz[-1] * interval_s), -60.0, -1.0 / _PER_OCTAVE)
    length = samples * interval_s
    while length < _LONGEST_RECORD:
        numbers = length / interval_s
        mine = edges[edges > 1.0 / numbers]
        middle = 0.5 * mine / interval_s
        basis = _variances(middle, interval_s)
        count = numbers * mine * (1.0 - 2.0 ** (-1.0 / _PER_OCTAVE))
        ideal = _Bins(middle, basis @ there, count, basis)
        if square >= _DETERMINED * _sigmas(ideal, there, with_it)[i]:
            return length
        length *= 2.0**0.25
    return None


def _worst_octave(bins: _Bins, variance: Array) -> tuple[float, float]:
    """Observed over modelled power in the octave of largest difference (1: not significant), and its centre, Hz."""
    edges = np.append(np.arange(len(bins.hz), 0, -_PER_OCTAVE), 0)[::-1]
    worst, where = 1.0, float(bins.hz[-1])
    for start, stop in pairwise(edges.tolist()):
        count = bins.count[start:stop]
        ratio = float(count @ (bins.power / variance)[start:stop] / count.sum())
        low, high = (quantile(p, count.sum()) / count.sum() for p in (1.0 / _ONCE_IN, 1.0 - 1.0 / _ONCE_IN))
        beyond = not low < ratio < high and abs(ratio - 1.0) > _OFF
        if beyond and abs(np.log(ratio)) > abs(np.log(worst)):
            worst, where = ratio, float(np.sqrt(bins.hz[start] * bins.hz[stop - 1]))
    return worst, where


@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Noise of one sensor axis: Allan deviation, noise coefficients, sinusoids.

    Attributes:
        curve: its Allan deviation, sinusoids included.
        low, high: 95 % interval of the deviation, (n,) each; dof: its equivalent degrees of freedom.
        fit: the coefficients, sinusoids taken out.
        lines: sinusoids, the strongest first.
        coarse: the step of the readings where it hides the noise, else None.
    """

    curve: AllanCurve
    low: Array
    high: Array
    dof: Array
    fit: NoiseFit
    lines: tuple[Line, ...]
    coarse: float | None


def axis_noise(pieces: Sequence[Array], interval_s: float) -> AxisNoise:
    """Estimate one axis' noise from pieces (n,) of a record at rest, each evenly spaced by interval_s."""
    lines = find_lines(pieces, interval_s)
    steady = _without_lines(pieces, interval_s, lines) if lines else pieces
    beside = _BESIDE / (interval_s * max(len(piece) for piece in pieces))
    bands = [(line.hz - beside, line.hz + beside) for line in lines]
    bands += [line.band_hz for line in find_lines(steady, interval_s)] if lines else []
    fit = fit_noise(steady, interval_s, bands)
    curve = allan_curve(pieces, interval_s)
    dof, low, high = confidence(curve, fit.squares)
    return AxisNoise(curve, low, high, dof, fit, lines, _coarse_step(pieces))


def _coarse_step(pieces: Sequence[Array]) -> float | None:
    """Quantisation step of the readings where it hides the noise, else None."""
    change = np.concatenate([np.abs(np.diff(piece)) for piece in pieces])
    moved = change[change > 0.0]
    if not len(moved):
        return None
    step = float(moved.min())
    return step if step > _COARSE * float(np.sqrt(0.5 * np.mean(change**2))) else None


# A record is cut into so many windows of at most and at least so many samples.
_WINDOWS, _LONGEST, _SHORTEST = 8, 1 << 16, 128
# Degrees of freedom a Hann window that overlaps by half adds.
_DOF_PER_WINDOW = 1.06
# The floor is the median over so many neighbours; a line stands at least so far above it, and above what chance does in
# one record of so many.
_NEIGHBOURS, _ABOVE, _CHANCE = 41, 4.0, 1e-4
# A Hann window spreads a line over so many numbers on either side.
_SPREAD = 2
# The lowest numbers are the drift's.
_FIRST = 8
# The transform of the whole record spreads a line beyond these; left out is where it adds more than this part.
_LEAST_ADDED = 0.01
_MOST_LINES = 10
# Blocks of a piece, eight to a window, that make its own estimate of a line's frequency better than the spectrum's.
_REFINED = 8


@dataclass(frozen=True)
class Line:
    """A sinusoid: frequency hz with resolution_hz, peak amplitude in the sensor's unit, disturbed band_hz."""

    hz: float
    amplitude: float
    resolution_hz: float
    band_hz: tuple[float, float]


def find_lines(pieces: Sequence[Array], interval_s: float) -> tuple[Line, ...]:
    """Find the strongest sinusoids in pieces of a record at rest, by amplitude; none if the record is too short.

    Args:
        pieces: samples, each piece evenly spaced by interval_s.
        interval_s: s.
    """
    longest = max(len(piece) for piece in pieces)
    size = min(_LONGEST, 1 << int(np.log2(max(1, longest // _WINDOWS))))
    if size < _SHORTEST:
        return ()
    power, windows = _welch(pieces, size)
    power *= interval_s
    # Neither zero, nor what a drift leaks into, nor half the sampling rate.
    inner, floor = power[_FIRST:-1], _floor(power)[_FIRST:-1]
    dof = 2.0 * _DOF_PER_WINDOW * windows
    enough = max(_ABOVE, quantile(1.0 - _CHANCE / len(inner), dof) / dof)
    high = inner > enough * floor
    edges = np.flatnonzero(np.diff(np.concatenate([[False], high, [False]]).astype(int))).reshape(-1, 2)
    resolution = 1.0 / (size * interval_s)
    found = []
    for start, stop in _merged(edges).tolist():
        around = slice(max(0, start - _SPREAD), min(len(inner), stop + _SPREAD))
        excess = np.maximum(inner[around] - floor[around], 0.0)
        hz = float((_FIRST + np.arange(len(inner))[around]) @ excess / excess.sum()) * resolution
        variance = float(excess.sum()) * resolution
        density = 0.5 * float(floor[start:stop].min())  # two-sided
        leak = np.sqrt(variance / (_LEAST_ADDED * density * longest * interval_s)) / np.pi
        reach = max(leak, (0.5 * (stop - start) + _SPREAD) * resolution)
        found.append(Line(hz, float(np.sqrt(2.0 * variance)), resolution, (hz - reach, hz + reach)))
    return tuple(sorted(found, key=lambda line: -line.amplitude)[:_MOST_LINES])


def _without_lines(pieces: Sequence[Array], interval_s: float, lines: Sequence[Line]) -> list[Array]:
    """Subtract from each piece the sinusoids' steady part, of constant frequency, phase and amplitude."""
    out = []
    for piece in pieces:
        left = piece - piece.mean()
        for line in lines:
            left = _notched(left, 2.0 * np.pi * line.hz * interval_s, 2.0 * np.pi * line.resolution_hz * interval_s)
        out.append(left)
    return out


def _notched(x: Array, rate: float, resolution: float) -> Array:
    """Subtract the best-fitting sinusoid near a rate from x; rate and resolution in rad per sample."""
    # Turned down to nearly zero and averaged in blocks, the line is the peak of a short spectrum.
    block = max(1, int(np.pi / (4.0 * resolution)))
    count = -(-len(x) // block)
    blocks = np.pad(x, (0, count * block - len(x))).reshape(count, block)
    within, start = np.arange(block) - 0.5 * (block - 1), block * (np.arange(count) - 0.5 * (count - 1))
    slow = (blocks @ np.cos(rate * within) - 1j * (blocks @ np.sin(rate * within))) * np.exp(-1j * rate * start)
    slow /= np.append(np.full(count - 1, block), len(x) - block * (count - 1))
    offset = 0.0
    # A short piece cannot determine the rate better than it is known.
    if count >= _REFINED and np.any(slow):
        spectrum = np.fft.fft(slow, 8 * count)
        offset = 2.0 * np.pi * float(np.fft.fftfreq(8 * count, block)[np.argmax(np.abs(spectrum))])
        for _ in range(3):
            turned = slow * np.exp(-1j * offset * start)
            amplitude = turned.mean()
            offset += float(start @ (turned * amplitude.conj()).imag) / (abs(amplitude) ** 2 * float(start @ start))
    # The average over a block took away a little of it.
    amplitude = 2.0 * (slow * np.exp(-1j * offset * start)).mean() / np.sinc(offset * block / (2.0 * np.pi))
    rate += offset
    slowly = amplitude * np.exp(1j * rate * start)
    wave = np.stack([slowly.real, -slowly.imag], axis=1) @ np.stack([np.cos(rate * within), np.sin(rate * within)])
    return (blocks - wave).ravel()[: len(x)]


def _welch(pieces: Sequence[Array], size: int) -> tuple[Array, int]:
    """Welch's one-sided density (size/2 + 1,), squares per cycle per sample, and the number of windows."""
    window = np.hanning(size + 1)[:-1]
    total, windows = np.zeros(size // 2 + 1), 0
    for piece in pieces:
        for start in range(0, len(piece) - size + 1, size // 2):
            part = piece[start : start + size]
            total += np.abs(np.fft.rfft(window * (part - part.mean()))) ** 2
            windows += 1
    return 2.0 * total / windows / (window @ window), windows


def _floor(power: Array) -> Array:
    """Noise floor of a power spectrum: running median, of a shorter symmetric window at both ends."""
    half = _NEIGHBOURS // 2
    out = np.empty(len(power))
    out[half : len(power) - half] = np.median(np.lib.stride_tricks.sliding_window_view(power, 2 * half + 1), axis=1)
    for i in (*range(2 * half), *range(len(power) - half, len(power))):
        reach = max(1, min(half, i // 2, len(power) - 1 - i))
        out[i] = np.median(power[max(0, i - reach) : i + reach + 1])
    return out


def _merged(edges: Index) -> Index:
    """Merge ranges [start, stop) nearer to each other than the spread of a window."""
    if not len(edges):
        return edges
    apart = edges[1:, 0] - edges[:-1, 1] > 2 * _SPREAD
    return np.stack([edges[np.append(True, apart), 0], edges[np.append(apart, True), 1]], axis=1)
