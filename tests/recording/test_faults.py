"""Faults of sensors in otherwise good recordings: dropped and counted, or refused in one line; never a wrong answer."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head import model as head
from alidade.pipelines.methods.head.recording import read_head
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.recording import read_los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.methods.tumble.simulation import TumbledAccelerometer, TumbledGyro
from alidade.pipelines.recording.faults import drop_faults
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.recording.table_topics import of_yaw_pitch_roll
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.builders import make_calibration
from tests.support.judged import judge

SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.15)],
    pitch=[Swing(amplitude_deg=8, frequency_hz=0.31)],
    roll=[Swing(amplitude_deg=12, frequency_hz=0.21)],
)
LOS = LosScenario(duration_s=30.0, carrier=SWAY, image_rate_hz=6.0, gyro_rate_hz=100.0, gimbal_rate_hz=50.0)
HEAD = HeadScenario(
    duration_s=30.0, platform=SWAY, helmet_mount_deg=(3.0, -4.0, 2.0), gyro_rate_hz=200.0, vision_rate_hz=20.0
)
_RNG = np.random.default_rng(5)


def _frozen(t: Array, rate: Array) -> tuple[Array, Array]:
    rate = rate.copy()
    rate[2301:2501] = rate[2300]
    return t, rate


def _one_axis_frozen(t: Array, rate: Array) -> tuple[Array, Array]:
    rate = rate.copy()
    rate[2301:2501, 1] = rate[2300, 1]
    return t, rate


def _clipped(t: Array, rate: Array) -> tuple[Array, Array]:
    most = 0.93 * np.abs(rate).max(axis=0)
    return t, np.clip(rate, -most, most)


def _clipped_where_the_end_wanders(t: Array, rate: Array) -> tuple[Array, Array]:
    """As a real gyro does: at 7.2346 to 7.2653 rad/s."""
    most = 0.9 * np.abs(rate).max(axis=0) * (1.0 + 0.002 * np.sin(0.9 * t + 3.0 * np.sin(0.31 * t)))[:, None]
    return t, np.clip(rate, -most, most)


def _spiky(t: Array, rate: Array) -> tuple[Array, Array]:
    rate = rate.copy()
    rows = 7 + 60 * np.arange(len(t) // 60)
    rate[rows, np.arange(len(rows)) % 3] = 300.0 * (-1.0) ** np.arange(len(rows))
    return t, rate


def _gappy(t: Array, rate: Array) -> tuple[Array, Array]:
    keep = np.ones(len(t), dtype=bool)
    keep[2000:2100] = False  # half a second
    keep[_RNG.choice(len(t), len(t) // 20, replace=False)] = False  # and one sample in twenty
    keep[[0, -1]] = True
    return t[keep], rate[keep]


def _half_the_rate(t: Array, rate: Array) -> tuple[Array, Array]:
    half = len(t) // 2 // 2 * 2
    paired = rate[half:][: (len(t) - half) // 2 * 2].reshape(-1, 2, 3).mean(axis=1)
    times = t[half:][: 2 * len(paired)].reshape(-1, 2).mean(axis=1)
    return np.concatenate([t[:half], times]), np.concatenate([rate[:half], paired])


def _not_numbers(t: Array, rate: Array) -> tuple[Array, Array]:
    rate = rate.copy()
    rate[100:140] = np.nan
    rate[900, 2] = np.inf
    return t, rate


Fault = Callable[[Array, Array], tuple[Array, Array]]
FAULTS: dict[Fault, str] = {
    _frozen: "stuck",
    _one_axis_frozen: "stuck",
    _clipped: "saturated",
    _spiky: "spike",
    _gappy: "",
    _half_the_rate: "",
    _not_numbers: "not a finite number",
}


@dataclass(frozen=True)
class Case:
    """A good session and how its gyro is spoilt: the fields of its stamps and rates."""

    data: Any
    truth: dict[str, float]
    config: str
    gyro: tuple[str, str]
    write: Callable[..., None]
    read: Callable[[Recording, Config], Any]
    problem: Callable[[Any, Config], Problem]

    @cached_property
    def clean(self) -> Estimate:
        return solve_batch(self.problem(self.data, load_config(self.config.encode())))


@cache
def case(name: str) -> Case:
    # What a fault does to the gyro's samples it does not do to the accelerometer's: without them.
    # With levels held: found anew they change sigmas by a few percent.
    if name == "head":
        data, truth = simulate_head(HEAD, 3)
        made = replace(data, head_force=None), truth, head_config(HEAD) + "noise_known: 0\n"
        return Case(*made, ("head_t", "head_gyro"), method("head").write_data, read_head, head.problem)
    los_data, truth = simulate_los(LOS, 3)
    los_made = replace(los_data, force=None), truth, los_config(LOS) + "noise_known: 0\n"
    return Case(*los_made, ("gyro_t", "gyro"), method("los").write_data, read_los, los.problem)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        *(("los", fault) for fault in FAULTS),
        *(pytest.param("head", fault, marks=pytest.mark.slow) for fault in FAULTS),
    ],
)
def test_a_faulty_gyro_moves_no_parameter(name: str, fault: Fault, tmp_path: Path) -> None:
    good = case(name)
    fields = good.gyro
    spoilt = dict(zip(fields, fault(*(getattr(good.data, field) for field in fields)), strict=True))
    good.write(tmp_path / "s.mcap", replace(good.data, **spoilt), good.truth, good.config)
    config = load_config(good.config.encode())
    read = good.read(open_recording(tmp_path / "s.mcap"), config)
    assert any(FAULTS[fault] in reason for reason in read.dropped) or not FAULTS[fault]
    problem = good.problem(read, config)
    estimate = solve_batch(problem)
    judged = judge(problem.quantities, estimate.covariance, estimate.chi_square, problem.advice)
    assert judged.status == "calibrated"
    error = np.abs(estimate.values - [good.truth.get(name, 0.0) for name in estimate.names]) / estimate.sigmas
    assert error.max() < 4.0
    assert (estimate.sigmas > 0.99 * good.clean.sigmas).all()


@pytest.mark.parametrize(
    ("name", "rates", "brief"),
    [
        ("los", "gyro", {"duration_s": 20.0, "gyro_rate_hz": 100.0, "gimbal_rate_hz": 50.0, "image_rate_hz": 5.0}),
        ("head", "head_gyro", {"duration_s": 20.0, "gyro_rate_hz": 100.0}),
        ("indexer", "gyro", {}),
        ("cube", "gyro", {"poses": 3, "static_s": 2.0, "camera": None}),
        ("cube", "accel", {"poses": 3, "static_s": 2.0, "camera": None}),
        ("tumble", "gyro", {"attitudes": 10, "gyro": TumbledGyro()}),
    ],
)
@pytest.mark.parametrize("wanders", [False, True])
def test_saturated_samples_are_left_out_and_reported_by_every_method(
    name: str, rates: str, brief: dict[str, Any], wanders: bool, tmp_path: Path
) -> None:
    if wanders and name == "indexer":
        pytest.skip("a turntable's steady turns look like plateaus that wander")
    if wanders and rates == "accel":
        pytest.skip("gravity that lingers along an axis looks like one, and ranges begin at 2 g")
    chosen = method(name)
    simulated = chosen.simulate(chosen.settings().model_copy(update=brief), 3)
    whole = getattr(simulated.data, rates)
    most = np.sort(np.abs(whole), axis=0)[-len(whole) // 40]
    wander = 1.0 + (0.002 * np.sin(np.arange(len(whole)) / 40.0)[:, None] if wanders else 0.0)
    clipped = replace(simulated.data, **{rates: np.clip(whole, -most * wander, most * wander)})
    chosen.write(tmp_path / "s.mcap", replace(simulated, data=clipped))
    recording = open_recording(tmp_path / "s.mcap")
    found = chosen.read(recording, load_config(recording.attachment("alidade.yaml")))
    ((what, count),) = ((what, n) for what, n in found.dropped.items() if what.endswith("saturated"))
    # Fewer than three in a row may be what there was.
    assert count > 0.1 * np.count_nonzero((np.abs(whole) > most * wander).any(axis=1))
    told = make_calibration()
    told = replace(told, problem=replace(told.problem, dropped=found.dropped))
    assert f"{what}: {count} samples left out" in told.notes


def test_what_is_dropped_is_what_was_spoilt() -> None:
    data = case("los").data
    for fault in (_frozen, _clipped, _clipped_where_the_end_wanders, _spiky):
        t, rate = fault(data.gyro_t, data.gyro)
        spoilt = np.flatnonzero((rate != data.gyro).any(axis=1))
        lost = np.setdiff1d(np.arange(len(t)), drop_faults("/imu", t, rate, {}, "rad/s"))
        # A reading clipped alone or in pairs cannot be told from the peak that it is.
        # Where the end wanders readings beside a plateau are within it, and the top of a peak is none.
        assert np.isin(lost, spoilt).mean() >= (0.99 if fault is _clipped_where_the_end_wanders else 1.0)
        assert len(lost) > 0.8 * len(spoilt)
    assert len(drop_faults("/imu", data.gyro_t, data.gyro, {}, "rad/s")) == len(data.gyro)


def test_a_flat_top_of_smooth_motion_is_no_saturation() -> None:
    t = np.arange(0.0, 40.0, 0.005)

    def attitude(t: Array) -> Array:
        yaw = 0.8 * np.sin(2.0 * np.pi * 0.31 * t) + 0.3 * np.sin(2.0 * np.pi * 0.83 * t)
        pitch, roll = 0.5 * np.sin(2.0 * np.pi * 0.43 * t + 1.0), 0.4 * np.sin(2.0 * np.pi * 0.57 * t + 2.0)
        return of_yaw_pitch_roll(np.stack([yaw, pitch, roll], axis=1))

    rate = so3.local(attitude(t - 1e-4), attitude(t + 1e-4)) / 2e-4
    for seed in (186, 195):
        noisy = rate + 0.002 * np.random.default_rng(seed).normal(size=len(t))[:, None]
        assert len(drop_faults("/imu", t, noisy, {}, "rad/s")) == len(t)


@pytest.mark.parametrize(("peaks", "left_out"), [(1, 8), (200, 0)])
def test_one_flat_top_among_many_peaks_as_high_is_chance(peaks: int, left_out: int) -> None:
    """An hour at 1 kHz has thousands of noisy peaks; where a range ends most are flat."""
    t = np.arange(0.0, peaks, 2e-3)
    x = np.sin(2.0 * np.pi * t) + np.random.default_rng(3).normal(0.0, 1e-3, len(t))
    top = 125
    x[top - 12 : top + 12] -= 0.05
    x[top - 4 : top + 4] = 1.0 + 1e-5 * np.arange(8)
    dropped: dict[str, int] = {}
    drop_faults("/imu", t, x[:, None], dropped, "rad/s")
    assert dropped.get("/imu: saturated", 0) == left_out


def test_gravity_that_lingers_along_an_axis_for_less_than_a_second_is_no_plateau() -> None:
    t = np.arange(0.0, 10.0, 0.01)
    turn = np.cumsum(np.where(np.abs(t - 5.0) < 0.3, 0.0, 0.02))
    turn = turn - turn[len(t) // 2]
    accel = 9.81 * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    accel += 0.02 * np.random.default_rng(2).normal(size=accel.shape)
    assert len(drop_faults("/imu", t, accel, {}, "m/s^2")) == len(t)
    assert len(drop_faults("/imu", t, 4.0 * accel, {}, "m/s^2")) < len(t) - 50, "of a range of 4 g it may be its end"


@pytest.mark.parametrize(("name", "brief"), [("indexer", {}), ("cube", {"poses": 6, "camera": None}), ("tumble", {})])
def test_rests_and_steady_turns_are_no_plateaus(name: str, brief: dict[str, Any]) -> None:
    chosen = method(name)
    data = chosen.simulate(chosen.settings().model_copy(update=brief), 2).data
    for stamps, values in (
        ("gyro_t", "gyro"),
        ("imu_t", "gyro"),
        ("imu_t", "accel"),
        ("accel_t", "accel"),
        ("mag_t", "mag"),
    ):
        t, x = getattr(data, stamps, None), getattr(data, values, None)
        if t is not None and x is not None and len(t) == len(x):
            dropped: dict[str, int] = {}
            drop_faults("/imu", t, x, dropped, "", may_stand=True)
            assert not any("saturated" in reason for reason in dropped)


def test_a_real_gyro_that_saturates_where_the_end_of_its_range_wanders(shared_data: Path) -> None:
    (path,) = shared_data.glob("repoimu/**/tstick_05.mcap")
    imu = open_recording(path).imu("/head/imu")
    dropped: dict[str, int] = {}
    kept = drop_faults("/head/imu", (imu.t_ns - imu.t_ns[0]) * 1e-9, np.asarray(imu.gyro), dropped, "rad/s")
    assert 1200 < dropped["/head/imu: saturated"] < 1400
    at_end = np.abs(imu.gyro[:, 0]) > 7.2
    assert at_end[kept].sum() < 0.15 * at_end.sum()


def test_a_quantised_sensor_at_rest_is_sound() -> None:
    t = np.arange(20_000) / 100.0
    moving = (np.maximum(-np.sin(0.05 * np.pi * t), 0.0) ** 2 * np.sin(3.0 * t))[:, None] * [1.0, -0.5, 2.0]
    counts = np.round((moving + 0.3e-3 * np.random.default_rng(0).standard_normal((len(t), 3))) / 1e-3) * 1e-3
    assert len(drop_faults("/imu", t, counts, {}, "rad/s")) == len(t)


def test_a_coarse_accelerometer_at_rest_between_knocks_is_not_stuck() -> None:
    """In steps of 31 mg it reads one value throughout a rest; it was refused as stuck for 25 % of the samples."""
    t, rng = np.arange(6000) / 100.0, np.random.default_rng(1)
    since = t % 6.0 - 4.0  # s from the end of each rest
    knock = np.where((np.abs(since) < 0.05) | (np.abs(since - 1.95) < 0.05), 6.0, 0.02)
    attitude = 9.8 * so3.rotate(so3.exp(0.4 * np.floor(t / 6.0)[:, None] * [1.0, 0.5, 0.2]), np.array([0.0, 0.6, 0.8]))
    accel = attitude + np.where(since > 0.0, 5.0 * np.sin(3.0 * np.pi * since), 0.0)[:, None] * [1.0, -1.0, 0.7]
    accel = 0.306 * np.round((accel + knock[:, None] * rng.standard_normal((len(t), 3))) / 0.306)
    assert len(drop_faults("/imu", t, accel, {}, "m/s^2")) == len(t)
    stuck = slice(2216, 2250)
    accel[stuck] = accel[stuck.start]
    dropped: dict[str, int] = {}
    kept = drop_faults("/imu", t, accel, dropped, "m/s^2")
    assert not np.isin(np.arange(stuck.start + 1, stuck.stop), kept).any()


@pytest.mark.parametrize(("largest", "lost"), [(13.13, False), (12.97, True)])
def test_a_motion_that_lingers_below_the_largest_reading_is_no_saturation(largest: float, lost: bool) -> None:
    """As of a real gyro turned at 750 deg/s: ten readings within .4 %, 1.4 % below the largest one."""
    t, rng = np.arange(2000) / 286.0, np.random.default_rng(3)
    rate = 5.0 * np.sin(2.0 * np.pi * 0.7 * t) + 0.005 * rng.standard_normal(len(t))
    rise = [6.0, 8.0, 9.5, 10.8, 11.7, 12.02, 12.38, 12.6]
    rate[300:326] = [*rise, *(12.93 + 0.03 * np.sin(np.arange(10.0))), *rise[::-1]]
    rate[900:917] = [*rise, largest, *rise[::-1]]
    kept = drop_faults("/imu", t, np.column_stack([rate, rng.standard_normal((len(t), 2))]), {}, "rad/s")
    assert (len(kept) < len(t)) == lost


def test_the_top_of_coarse_readings_is_no_plateau() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    rates = np.rint(8.0 * np.sin(2.0 * np.pi * 0.3 * t[:, None] + [0.0, 1.0, 2.0]))
    assert len(drop_faults("/imu", t, rates, {}, "rad/s")) == len(t)


@pytest.mark.parametrize(
    ("size", "unit", "shown"),
    [(6000.0, "T", ""), (5e-5, "T", " T"), (2048.0, "m/s^2", ""), (9.8, "m/s^2", " m/s^2"), (900.0, "rad/s", "")],
)
def test_the_unit_of_counts_is_not_named(size: float, unit: str, shown: str) -> None:
    t = np.arange(2000) / 50.0
    values = size * np.stack([np.cos(t), np.sin(t), 0.1 * np.cos(3.0 * t)], axis=1)
    values += 1e-3 * size * np.random.default_rng(0).standard_normal(values.shape)
    values[500:1300] = values[500]
    with pytest.raises(
        InputError, match=rf"stuck at one value \([-.\de+]+{re.escape(shown)} on axis x, the first at 10"
    ):
        drop_faults("/imu", t, values, {}, unit)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda g: g * [1.0, 1.0, 0.0], "topic /imu: axis z reads 0 throughout while the others move"),
        (lambda g: g * 0.0 + [0.0, 0.0, 9.8], r"topic /imu: all axes read the same throughout, \(0, 0, 9.8\) rad/s; "),
        (lambda g: np.clip(g, -0.05, 0.05), r"topic /imu: \d+ % of the samples cannot be used: saturated"),
    ],
)
def test_a_useless_sensor_is_refused(spoil: Callable[[Array], Array], message: str) -> None:
    data = case("los").data
    with pytest.raises(InputError, match=message):
        drop_faults("/imu", data.gyro_t, spoil(data.gyro), {}, "rad/s")


def test_a_dead_axis_of_a_coarse_gyro_is_refused() -> None:
    """In steps of 1 deg/s, mostly at rest, its other axes repeat in three samples of ten."""
    t = np.arange(6000) / 100.0
    rates = np.where(t > 45.0, np.sin(3.0 * t), 0.0)[:, None] * [1.0, -0.5, 2.0]
    rates += 0.012 * np.random.default_rng(0).standard_normal(rates.shape)
    counts = 0.0169 * np.round(rates / 0.0169)
    assert (np.diff(counts, axis=0) == 0.0).mean(axis=0).min() > 0.25
    assert len(drop_faults("/imu", t, counts, {}, "rad/s")) == len(t)
    with pytest.raises(InputError, match="axis y reads 0 throughout while the others move"):
        drop_faults("/imu", t, counts * [1.0, 0.0, 1.0], {}, "rad/s")


@pytest.mark.parametrize(
    ("name", "readings", "brief"),
    [
        ("los", "gyro", {"duration_s": 5.0}),
        ("head", "head_gyro", {"duration_s": 5.0}),
        ("indexer", "gyro", {}),
        *(("cube", readings, {"poses": 3, "static_s": 2.0, "camera": None}) for readings in ("gyro", "accel", "mag")),
        *(("tumble", sensor, {"attitudes": 5, "accelerometer": TumbledAccelerometer()}) for sensor in ("mag", "accel")),
    ],
)
def test_a_sensor_that_measures_nothing_is_refused_by_every_method(
    name: str, readings: str, brief: dict[str, Any], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"topic /.*: all axes read the same throughout") as caught:
        _read_standing(name, readings, brief, tmp_path / "s.mcap")
    assert "\n" not in str(caught.value)


def test_the_gyro_of_a_parked_platform_may_read_zero(tmp_path: Path) -> None:
    assert not _read_standing("head", "platform_gyro", {"duration_s": 5.0}, tmp_path / "s.mcap").platform_gyro.any()


def _read_standing(name: str, readings: str, brief: dict[str, Any], path: Path) -> Any:
    """A simulated recording one of whose sensors reads the same throughout, as its method reads it.

    That is zero, but for an accelerometer, which is none if it reads zero.
    """
    chosen = method(name)
    simulated = chosen.simulate(chosen.settings().model_copy(update=brief), 3)
    same = np.full_like(getattr(simulated.data, readings), 9.8 if readings == "accel" else 0.0)
    chosen.write(path, replace(simulated, data=replace(simulated.data, **{readings: same})))
    recording = open_recording(path)
    return chosen.read(recording, load_config(recording.attachment("alidade.yaml")))
