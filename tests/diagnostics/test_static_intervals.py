"""Rests by one detector: of devices on a table, in a hand, of a second, turned slowly, turned without end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from alidade.pipelines.diagnostics.static_intervals import ACCEL_TREMOR, GYRO_TREMOR, Stream, find_static_intervals
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.tumble.simulation import TumbleScenario

Array = np.ndarray
TUMBLE = method("tumble")
TUMBLED: dict[str, Any] = {"attitudes": 20, "magnetometer": None, "accelerometer": {}, "gyro": {}}
GYRO_NOISE, ACCEL_NOISE = 1.5e-3, 0.035


def _by_hand(rests: int, rest_s: float, tremor: Array, rate_hz: float = 100.0) -> tuple[Array, Array, Array, Array]:
    """Rests with a tremor (rad/s) of 9 Hz, turns of a second between: times, gyro, accelerometer, middles of rests."""
    rng = np.random.default_rng(5)
    period = rest_s + 1.0
    t = np.arange(0.0, rests * period, 1.0 / rate_hz)
    k, phase = (t // period).astype(int), t % period - rest_s
    bump = np.where(phase > 0.0, np.sin(np.pi * np.clip(phase, 0.0, 1.0)) ** 2, 0.0)[:, None]
    axes = rng.standard_normal((rests, 3))
    trembles = tremor[k, None] * np.sin(2.0 * np.pi * 9.0 * t[:, None] + rng.uniform(0.0, 6.0, 3))
    gyro = 2.0 * bump * axes[k] + trembles + GYRO_NOISE * rng.standard_normal((len(t), 3))
    accel = 3.0 * bump * axes[k] + 2.0 * trembles + ACCEL_NOISE * rng.standard_normal((len(t), 3)) + (0.0, 0.0, 9.8)
    return t, gyro, accel, np.arange(rests) * period + 0.5 * rest_s


def _found(t: Array, gyro: Array, accel: Array) -> Array:
    """Rests with the noise of cheap parts stated."""
    return find_static_intervals(t, Stream(accel, ACCEL_NOISE, ACCEL_TREMOR), Stream(gyro, GYRO_NOISE, GYRO_TREMOR))


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 400.0])
def test_rests_in_a_trembling_hand_are_found_beside_one_on_a_table(rate_hz: float) -> None:
    t, gyro, accel, middle = _by_hand(10, 3.0, np.append(0.0, np.linspace(0.005, 0.025, 9)), rate_hz)
    found = _found(t, gyro, accel)
    assert len(found) == 10
    assert ((found[:, 0] < middle) & (middle < found[:, 1])).all()
    assert np.diff(found).min() > 1.5


def test_what_trembles_more_than_a_hand_is_no_rest() -> None:
    t, gyro, accel, _ = _by_hand(10, 3.0, np.append(0.0, np.full(9, 0.2)))
    assert len(_found(t, gyro, accel)) == 1


@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.parametrize("rest_s", [1.0, 1.5, 3.0])
def test_rests_of_a_tumbled_device(rest_s: float, beside: bool) -> None:
    data = TUMBLE.simulate(TumbleScenario(**TUMBLED, rest_s=rest_s), 2).data
    gyro = Stream(data.gyro, 1e-3, GYRO_TREMOR) if beside else None
    assert len(find_static_intervals(data.accel_t, Stream(data.accel, 0.015, ACCEL_TREMOR), gyro)) == 20


@pytest.mark.parametrize("turn_rad_s", [0.4, 1.5])
def test_motion_without_rests_has_none(turn_rad_s: float) -> None:
    """Between attitudes that it goes through without a stop a device turns more slowly, not less."""
    data = TUMBLE.simulate(TumbleScenario(**TUMBLED, turn_rad_s=turn_rad_s), 1).data
    try:
        found = find_static_intervals(
            data.accel_t, Stream(data.accel, 0.015, ACCEL_TREMOR), Stream(data.gyro, 1e-3, GYRO_TREMOR)
        )
    except InputError:
        return
    assert len(found) < 3
