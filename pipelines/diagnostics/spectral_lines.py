"""Sinusoids in the noise of a sensor (vibration, mains, a beat of the sampling): lines far above a spectrum's floor.

The spectrum is Welch's, "The use of fast Fourier transform for the estimation of power spectra", IEEE Trans. Audio
Electroacoust. 1967: Hann windows that overlap by half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alidade.factors.array import Array, Index
from alidade.factors.chi_square import quantile

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


def without_lines(pieces: Sequence[Array], interval_s: float, lines: Sequence[Line]) -> list[Array]:
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
