"""Shapes of simulated motion: angles over time as sums of oscillations and turns, and the attitudes they make."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from alidade.factors import so3
from alidade.factors.so3 import Array
from alidade.pipelines.simulation.scenario import ScenarioPart


class Swing(ScenarioPart):
    """One part of an angle: an oscillation and a turn at constant rate, between `start_s` and `end_s`.

    angle = amplitude * sin(2 pi * frequency * s + phase) + rate * s, with s = clip(t, start, end) - start in seconds:
    constant outside the interval, continuous everywhere.
    """

    amplitude_deg: float = 0.0
    frequency_hz: float = 0.0
    phase_deg: float = 0.0
    rate_deg_s: float = 0.0
    start_s: float = 0.0
    end_s: float = float("inf")


class EulerMotion(ScenarioPart):
    """Yaw, pitch and roll over time, each the sum of its swings; no swings = zero."""

    yaw: list[Swing] = Field(default_factory=list)
    pitch: list[Swing] = Field(default_factory=list)
    roll: list[Swing] = Field(default_factory=list)

    def attitude(self, t: Array) -> Array:
        """aRb at the times t (s), shape (N, 4), b turned from a by yaw about z, then pitch about y, then roll about x.

        In the passive matrices of the publications bRa = Rx(roll) Ry(pitch) Rz(yaw).
        """
        angles = [angle(self.yaw, t), angle(self.pitch, t), angle(self.roll, t)]
        turns = [so3.exp(a[:, None] * axis) for a, axis in zip(angles, np.eye(3)[::-1], strict=True)]
        return so3.compose(*turns)


def angle(swings: Sequence[Swing], t: Array) -> Array:
    """Sum of the swings at the times t (s), rad, shape of t."""
    total = np.zeros_like(t)
    for swing in swings:
        s = np.clip(t, swing.start_s, swing.end_s) - swing.start_s
        phase = 2.0 * np.pi * swing.frequency_hz * s + np.deg2rad(swing.phase_deg)
        total += np.deg2rad(swing.amplitude_deg) * np.sin(phase) + np.deg2rad(swing.rate_deg_s) * s
    return total


def sample_times(duration_s: float, rate_hz: float, phase: float = 0.0) -> Array:
    """Stamps (k + phase) / rate in [0, duration), s, on whole nanoseconds as message stamps are."""
    t = (np.arange(np.ceil(duration_s * rate_hz)) + phase) / rate_hz
    return np.asarray(np.round(t[t < duration_s] * 1e9) / 1e9)
