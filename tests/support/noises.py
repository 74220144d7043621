"""Noise of known coefficients, made in ways of its own: nothing here is of the code under test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def white(rng: np.random.Generator, n: int, interval: float, density: float) -> Array:
    return density / np.sqrt(interval) * rng.normal(size=n)


def walk(rng: np.random.Generator, n: int, interval: float, rate: float) -> Array:
    return np.asarray(np.cumsum(rate * np.sqrt(interval) * rng.normal(size=n)))


def flicker(rng: np.random.Generator, n: int, interval: float, instability: float) -> Array:
    """Rate noise of two-sided density B^2 / (2 pi f), from first-order Gauss-Markov processes, four to a decade.

    Processes of variance v and correlation times T_i = r^i T_0 add up to v / (2 f ln r) between the slowest and the
    fastest (the integral of 2 T / (1 + (2 pi f T)^2) over ln T is 1 / (2 f)).
    """
    ratio = 10.0**0.25
    times = interval * ratio ** np.arange(-2, np.log(100.0 * n) / np.log(ratio))
    variance = instability**2 * np.log(ratio) / np.pi
    decay = np.exp(-interval / times)
    out = np.zeros(n)
    for a in decay:
        # An autoregression of first order, as the convolution of its noise with a^k.
        noise = rng.normal(size=n) * np.sqrt(variance * (1.0 - a**2))
        noise[0] = rng.normal() * np.sqrt(variance)
        size = 2 * n
        kernel = np.fft.rfft(a ** np.arange(n), size)
        out += np.fft.irfft(kernel * np.fft.rfft(noise, size), size)[:n]
    return out


def synthetic_flicker(rng: np.random.Generator, n: int, interval: float, instability: float) -> Array:
    """The same from its spectrum, a stretch of a record eight times as long."""
    size = 8 * n
    density = np.zeros(size // 2 + 1)
    density[1:] = instability**2 / (2.0 * np.pi * np.fft.rfftfreq(size, interval)[1:])
    amplitude = np.sqrt(0.5 * density * size / interval)
    spectrum = amplitude * (rng.normal(size=len(density)) + 1j * rng.normal(size=len(density)))
    return np.asarray(np.fft.irfft(spectrum, size)[:n])


def quantised(rng: np.random.Generator, n: int, interval: float, coefficient: float) -> Array:
    """A rate whose integral is read with independent errors of standard deviation Q."""
    return np.asarray(np.diff(coefficient * rng.uniform(-(3.0**0.5), 3.0**0.5, size=n + 1)) / interval)
