"""What a sensor's own samples at rest tell of its noise: Allan deviation, coefficients, sinusoids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.diagnostics.allan import AllanCurve, allan_curve, confidence
from alidade.pipelines.diagnostics.noise_spectrum import NoiseFit, fit_noise
from alidade.pipelines.diagnostics.spectral_lines import Line, find_lines, without_lines

Array = NDArray[np.float64]

# What is taken out with a sinusoid are its neighbours in the transform of the record, so many on either side.
_BESIDE = 3.0
# A sensor whose step is larger than so many times its noise repeats itself, and what it repeats is no noise.
_COARSE = 2.0


@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Noise of one axis.

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
    """The noise of one axis from pieces (n,) of a record at rest, each evenly spaced by interval_s."""
    lines = find_lines(pieces, interval_s)
    steady = without_lines(pieces, interval_s, lines) if lines else pieces
    beside = _BESIDE / (interval_s * max(len(piece) for piece in pieces))
    bands = [(line.hz - beside, line.hz + beside) for line in lines]
    bands += [line.band_hz for line in find_lines(steady, interval_s)] if lines else []
    fit = fit_noise(steady, interval_s, bands)
    curve = allan_curve(pieces, interval_s)
    dof, low, high = confidence(curve, fit.squares)
    return AxisNoise(curve, low, high, dof, fit, lines, _coarse_step(pieces))


def _coarse_step(pieces: Sequence[Array]) -> float | None:
    """The smallest change of a reading, where it is no smaller than a couple of times the usual change."""
    change = np.concatenate([np.abs(np.diff(piece)) for piece in pieces])
    moved = change[change > 0.0]
    if not len(moved):
        return None
    step = float(moved.min())
    return step if step > _COARSE * float(np.sqrt(0.5 * np.mean(change**2))) else None
