"""The command `alidade noise`, and how it finds the time at rest."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from alidade.pipelines.applications.noise import even_pieces, noise
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.static_intervals import stretches_at_rest
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.reports.noise_report import length
from datasets.broad import read_trial
from tests.support import noises
from tests.support.broad_trials import TRIALS
from tests.support.browser import fits
from tests.support.command import Command

Array = NDArray[np.float64]

T0 = 1_800_000_000_000_000_000
GYRO, WALK, ACCEL, MAG = 1e-4, 2e-5, 2e-3, 5e-8


def stamps(t: Array) -> NDArray[np.int64]:
    return T0 + np.rint(1e9 * t).astype(np.int64)


def grid(n: int, interval: float) -> Array:
    return interval * np.arange(n, dtype=np.float64)


def axes(make: Any, rng: np.random.Generator, n: int, interval: float, size: float) -> Array:
    return np.stack([make(rng, n, interval, size) for _ in range(3)], axis=1)


def device(rng: np.random.Generator, seconds: float) -> tuple[Array, Array, Array]:
    """Times at 100 Hz, gyro and accelerometer lying still."""
    n = round(100.0 * seconds)
    gyro = axes(noises.white, rng, n, 0.01, GYRO) + axes(noises.walk, rng, n, 0.01, WALK) + [0.01, -0.02, 0.005]
    accel = axes(noises.white, rng, n, 0.01, ACCEL) + [0.1, 0.3, 9.8]
    return grid(n, 0.01), gyro, accel


@pytest.fixture(scope="module")
def static(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 min of an IMU with a magnetometer."""
    return written(tmp_path_factory.mktemp("noise") / "static.mcap", 1200.0)


def written(path: Path, seconds: float) -> Path:
    """An IMU with a magnetometer at rest."""
    rng = np.random.default_rng(0)
    t, gyro, accel = device(rng, seconds)
    n = round(20.0 * seconds)
    field = axes(noises.white, rng, n, 0.05, MAG) + [2e-5, 0.0, -4e-5]
    topics = {
        "/imu": series.ImuSeries(stamps(t), gyro, accel),
        "/mag": series.MagneticSeries(stamps(grid(n, 0.05)), field),
        "/attitude": series.ImuSeries(stamps(t[::10]), np.zeros((len(t[::10]), 3))),
    }
    write_session(path, topics)
    return path


def test_table_section_and_files(static: Path, alidade: Command, tmp_path: Path) -> None:
    run = alidade("noise", static, "--out", tmp_path / "out", "--quiet")
    assert run.code == 0, run.err
    for words in ("/imu gyro", "100 Hz, at rest from 0.0 to 1200.0 s", "deg/√h", "µg/√Hz", "nT/√Hz"):
        assert words in run.out
    # The section is a config as it stands.
    pasted = tmp_path / "pasted.yaml"
    pasted.write_text(run.out[run.out.index("noise:\n") : run.out.index("Results in")], encoding="utf-8")
    noise = load_config(None, pasted).noise
    assert noise.gyro_density == pytest.approx(GYRO, rel=0.02)
    assert noise.gyro_bias_walk == pytest.approx(WALK, rel=0.1)
    assert noise.accel_density == pytest.approx(ACCEL, rel=0.02)
    assert noise.mag_density == pytest.approx(MAG, rel=0.02)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["noise.html", "noise.json"]
    page = (tmp_path / "out" / "noise.html").read_text(encoding="utf-8")
    fits(page, tmp_path)
    assert "gyro_bias_walk: " in page
    assert "random walk: 20 min at rest do not determine it" in page  # of the accelerometer


def test_json_is_all_there_is_on_stdout(alidade: Command, tmp_path: Path) -> None:
    run = alidade("noise", written(tmp_path / "s.mcap", 120.0), "--json")
    content = json.loads(run.out, parse_constant=lambda word: pytest.fail(word))
    assert content["schema"] == "alidade.noise/1"
    assert [(s["topic"], s["sensor"]) for s in content["sensors"]] == [
        ("/imu", "gyro"),
        ("/imu", "accel"),
        ("/mag", "mag"),
    ]
    for sensor, density in zip(content["sensors"], (GYRO, ACCEL, MAG), strict=True):
        assert sensor["length_s"] == pytest.approx(120.0)
        for axis in sensor["axes"]:
            white = next(c for c in axis["coefficients"] if c["name"] == "N")
            assert white["low"] < white["value"] < white["high"]
            assert abs(white["value"] - density) < 4.0 * white["sigma"]
            assert not axis["lines"]
            assert all(p["low"] < p["deviation"] < (p["high"] or math.inf) for p in axis["allan"])


def test_tables_and_rates_alone_are_measured_as_the_config_describes_them(alidade: Command, tmp_path: Path) -> None:
    t, gyro, accel = device(np.random.default_rng(3), 60.0)
    write_session(tmp_path / "s.mcap", {"/imu": series.ImuSeries(stamps(t), gyro, accel)})
    rows = zip(stamps(t).tolist(), *gyro.T.tolist(), *accel.T.tolist(), strict=True)
    (tmp_path / "s.csv").write_text("\n".join(["t,gx,gy,gz,ax,ay,az", *(",".join(map(repr, row)) for row in rows)]))
    columns = "columns: {/imu: {time: t, unit: ns, gyro: [gx, gy, gz], accel: [ax, ay, az]}}"
    (tmp_path / "table.yaml").write_text(columns)
    told = [json.loads(alidade("noise", tmp_path / "s.mcap", "--json").out)]
    told.append(json.loads(alidade("noise", tmp_path / "s.csv", "--config", tmp_path / "table.yaml", "--json").out))
    assert len(told[0]["sensors"]) == 2
    assert told[0]["sensors"] == told[1]["sensors"]
    refused = alidade("noise", tmp_path / "s.csv")
    assert refused.code == 2
    assert "columns" in refused.err

    write_session(tmp_path / "rates.mcap", {"/rates": series.VectorSeries(stamps(t), gyro)})
    (tmp_path / "rates.yaml").write_text("topics: {head_imu: /rates}")
    run = alidade("noise", tmp_path / "rates.mcap", "--config", tmp_path / "rates.yaml", "--json")
    assert run.code == 0, run.err
    (found,) = json.loads(run.out)["sensors"]
    assert (found["topic"], found["sensor"]) == ("/rates", "gyro")
    assert alidade("noise", tmp_path / "rates.mcap").code == 2


def moving(t: Array) -> Array:
    return np.stack([0.3 * np.sin(2.1 * t), 0.2 * np.sin(1.3 * t + 1.0), 0.25 * np.cos(1.7 * t)], axis=1)


def test_stretches_of_a_recording_in_motion_are_pooled(alidade: Command, tmp_path: Path) -> None:
    t, gyro, accel = device(np.random.default_rng(1), 120.0)
    motion = (t > 20.0) & (t < 50.0) | (t > 65.0) & (t < 100.0)
    gyro[motion] += moving(t[motion])
    write_session(tmp_path / "s.mcap", {"/imu": series.ImuSeries(stamps(t), gyro, accel)})
    run = alidade("noise", tmp_path / "s.mcap")
    assert run.code == 0, run.err
    assert "3 static intervals" in run.out
    (found, _) = noise(tmp_path / "s.mcap").sensors
    for start, end in found.rests:
        assert not motion[(t >= start) & (t <= end)].any()
    assert 40.0 < found.length_s < 55.0
    for axis in found.axes.values():
        (white,) = (c for c in axis.fit.coefficients if c.name == "N")
        assert white.value == pytest.approx(GYRO, rel=0.05)


@pytest.mark.parametrize("motion", ["sway", "jitter", "turn"])
def test_a_recording_that_never_rests_is_told_so(motion: str, alidade: Command, tmp_path: Path) -> None:
    t, gyro, _ = device(np.random.default_rng(2), 60.0)
    gyro += {"sway": moving(t), "jitter": moving(5.0 * t), "turn": np.array([0.0, 0.0, 0.5])}[motion]
    write_session(tmp_path / "s.mcap", {"/imu": series.ImuSeries(stamps(t), gyro)})
    run = alidade("noise", tmp_path / "s.mcap", "--out", tmp_path / "out")
    assert run.code == 2
    assert run.err.count("\n") == 1
    assert "topic /imu: nowhere at rest for two seconds in 60 s; record it lying still" in run.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        (
            {"/imu": series.ImuSeries(stamps(grid(900, 0.01)), 8.0 * moving(grid(900, 0.05)))},
            "more than any gyro's at rest (0.003): record it lying still; if it did, is it in deg/s?",
        ),
        ({"/truth": series.QuaternionSeries(stamps(np.arange(3.0)), np.eye(4)[:3])}, "no messages of an inertial"),
        ({"/imu": series.ImuSeries(stamps(np.arange(300.0)), np.zeros((300, 3)))}, "no sensor, all values are zero"),
        ({"/imu": series.ImuSeries(stamps(grid(40, 0.01)), np.ones((40, 3)))}, "nowhere at rest"),
        ({"/imu": series.ImuSeries(stamps(grid(900, 0.01)), np.full((900, 3), np.nan))}, "NaN"),
        ({"/imu": series.ImuSeries(stamps(grid(900, 0.01)), np.full((900, 3), 0.05))}, "reads the same value"),
    ],
)
def test_what_cannot_be_used_is_one_line(
    topics: dict[str, series.Topic], words: str, alidade: Command, tmp_path: Path
) -> None:
    write_session(tmp_path / "s.mcap", topics)
    run = alidade("noise", tmp_path / "s.mcap")
    assert (run.code, run.out) == (2, "")
    assert words in run.err
    assert run.err.count("\n") == 1


def test_gaps_lost_samples_and_nan(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    t, gyro, accel = device(rng, 300.0)
    gyro[rng.choice(len(t), 50, replace=False)] = np.nan
    keep = rng.random(len(t)) > 0.005
    keep[10_000:12_000] = False
    jitter = 2e-3 * rng.random(len(t))
    write_session(tmp_path / "s.mcap", {"/imu": series.ImuSeries(stamps(t + jitter)[keep], gyro[keep], accel[keep])})
    found, _ = noise(tmp_path / "s.mcap").sensors
    assert found.rate_hz == pytest.approx(100.0, rel=1e-3)
    assert 100 < found.filled < 250
    assert len(found.rests) == 2
    for axis in found.axes.values():
        (white,) = (c for c in axis.fit.coefficients if c.name == "N")
        assert white.value == pytest.approx(GYRO, rel=0.03)


def test_readings_that_a_driver_holds_are_measured_once(tmp_path: Path) -> None:
    t, gyro, _ = device(np.random.default_rng(4), 60.0)
    session = series.ImuSeries(stamps(grid(4 * len(t), 0.0025)), np.repeat(gyro, 4, axis=0))
    write_session(tmp_path / "s.mcap", {"/imu": session})
    study = noise(tmp_path / "s.mcap")
    (found,) = study.sensors
    assert found.rate_hz == pytest.approx(100.0)
    assert f"/imu gyro: repeats the reading before, used once: {3 * len(t)}" in study.notes
    for axis in found.axes.values():
        (white,) = (c for c in axis.fit.coefficients if c.name == "N")
        assert white.value == pytest.approx(GYRO, rel=0.03)


def test_several_gyros_keep_their_names(tmp_path: Path, alidade: Command) -> None:
    topics = {}
    for i, name in enumerate(("/head/imu", "/platform/imu", "/spare")):
        t, gyro, _ = device(np.random.default_rng(i), 60.0)
        topics[name] = series.ImuSeries(stamps(t), (1.0 + i) * gyro)
    write_session(tmp_path / "s.mcap", topics)
    content = json.loads(alidade("noise", tmp_path / "s.mcap", "--json").out)
    assert content["noise"]["gyro_density"] == pytest.approx(GYRO, rel=0.05)
    assert content["noise"]["platform_gyro_density"] == pytest.approx(2.0 * GYRO, rel=0.05)
    (line,) = (x for x in content["section"].splitlines() if "/spare" in x and "density" in x)
    assert line.startswith("  # gyro_density: 3.")


def test_lost_samples_are_told_from_late_stamps() -> None:
    t = grid(200, 0.01)
    t[50] += 0.008
    t[120:] += 0.03  # three samples lost
    pieces, interval, filled = even_pieces(t, np.arange(400.0).reshape(200, 2))
    assert interval == pytest.approx(0.01, rel=1e-3)
    assert (len(pieces), filled) == (1, 3)
    assert len(pieces[0]) == 203
    assert pieces[0][118:125, 0] == pytest.approx([236.0, 238.0, 238.5, 239.0, 239.5, 240.0, 242.0])
    t[160:] += 1.0
    pieces, _, _ = even_pieces(t, np.ones((200, 1)))
    assert [len(piece) for piece in pieces] == [163, 40]


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("rate", [20.0, 100.0, 1000.0])
def test_a_long_rest_is_one_stretch(rate: float, filtered: bool) -> None:
    rng = np.random.default_rng(0)
    n = round(600.0 * rate)
    x = rng.normal(size=(n, 3))
    if filtered:
        kernel = 0.7 ** np.arange(30)
        x = np.stack([np.convolve(column, kernel, "same") for column in x.T], axis=1)
    (rest,) = stretches_at_rest(np.arange(n) / rate, [x])
    assert rest == pytest.approx([0.0, (n - 1) / rate])


@pytest.mark.parametrize(("seconds", "text"), [(7.26, "7.3 s"), (90.0, "90 s"), (600.0, "10 min"), (9000.0, "2.5 h")])
def test_lengths_as_people_say_them(seconds: float, text: str) -> None:
    assert length(seconds) == text


def test_rests_of_broad_trials(shared_data: Path) -> None:
    """Real data: the trials start and end at rest, at 1.1e-4 rad/s/sqrt(Hz)."""
    for name in TRIALS:
        trial = read_trial(shared_data / "broad" / f"{name}.mat")
        rests = stretches_at_rest(trial.t, [trial.gyro], trial.gyro)
        assert len(rests) >= 2
        for start, end in rests:
            assert not trial.moving[(trial.t >= start) & (trial.t <= end)].any()
        assert np.ptp(rests, axis=1).sum() > 0.9 * np.count_nonzero(~trial.moving) * np.median(np.diff(trial.t))


def test_noise_of_a_broad_trial(shared_data: Path, tmp_path: Path) -> None:
    trial = read_trial(shared_data / "broad" / "21_undisturbed_fast_combined.mat")
    write_session(tmp_path / "s.mcap", {"/imu": series.ImuSeries(stamps(trial.t), trial.gyro)})
    (gyro,) = noise(tmp_path / "s.mcap").sensors
    for axis in gyro.axes.values():
        found = {c.name: c for c in axis.fit.coefficients}
        assert found["N"].value == pytest.approx(1e-4, rel=0.25)
        # A minute does not tell how a bias walks.
        assert found["K"].value is None
        assert found["K"].needed_s is not None
        assert found["K"].needed_s > 200.0


def test_contract_recordings_have_the_noise_they_were_made_with(shared_data: Path) -> None:
    cube = {s.kind: s for s in noise(shared_data / "contract" / "cube_nominal.mcap").sensors}
    assert len(cube["gyro"].rests) == 24
    for kind, density in (("accel", 1.5e-3), ("mag", 5e-8)):
        for axis in cube[kind].axes.values():
            assert axis.fit.coefficients[1].value == pytest.approx(density, rel=0.05)


def test_a_real_imu_on_a_table(shared_data: Path) -> None:
    gyro, accel = noise(shared_data / "openaxes_imu9" / "adxl.mcap").sensors
    for sensor, low, high in ((gyro, 5e-5, 2e-4), (accel, 2e-4, 2e-3)):
        for axis in sensor.axes.values():
            (white,) = (c for c in axis.fit.coefficients if c.name == "N")
            assert white.value is not None
            assert low < white.value < high
    # Something in the room turns at 23.5 Hz.
    assert all(abs(axis.lines[0].hz - 23.5) < 0.2 for axis in accel.axes.values())


@pytest.mark.parametrize("size", [5e-324, 1e-160, 1e-20])
def test_readings_that_differ_by_less_than_any_noise_are_one_value(size: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    t, _, accel = device(rng, 60.0)
    imu = series.ImuSeries(stamps(t), np.asarray(size * rng.integers(-3, 4, accel.shape), dtype=float), accel)
    write_session(tmp_path / "s.mcap", {"/imu": imu})
    study = noise(tmp_path / "s.mcap")
    assert [sensor.kind for sensor in study.sensors] == ["accel"]
    assert sum("reads the same value whenever it is at rest" in note for note in study.notes) == 3
