"""The head method on one session: an independent simulator's, validation, and what bad input is told."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from alidade.factors import so3
from alidade.pipelines.applications.cli import app
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.cross_validation import peak, rms
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.model import problem
from alidade.pipelines.methods.head.report import validate
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import Simulated, load_scenario
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.solved import calibrate

QUIET = {"gyro_density": 0.0, "gyro_bias_walk": 0.0, "platform_gyro_density": 0.0, "vision_attitude": 0.0}


def scenario(**changes: object) -> HeadScenario:
    settings = {"duration_s": 12, "vision_rate_hz": 20, "gyro_rate_hz": 200, **changes}
    return HeadScenario.model_validate(load_scenario(HeadScenario, "head_mounts").model_dump() | settings)


def made(**changes: object) -> Simulated:
    return simulate_head(scenario(**changes), 1)


def test_session_of_an_independent_simulator(shared_data: Path) -> None:
    path = shared_data / "contract" / "head_mounts.mcap"
    (calibration,) = calibrate(path, ["batch"])
    estimate = calibration.estimate
    truth = json.loads((shared_data / "contract" / "head_mounts.truth.json").read_text())
    known = [name in truth for name in estimate.names]
    assert sum(known) == 10
    true = np.array([truth.get(name, 0.0) for name in estimate.names])
    off = ((estimate.values - true) / estimate.sigmas)[known]
    assert np.abs(off).max() < 3.0
    assert calibration.status == "calibrated"
    found, true = estimate.attitudes, truth["_attitude"]
    assert found is not None
    time = found.time + (calibration.facts.epoch_ns - truth["_t0"] * 10**9) * 1e-9
    inside = (time >= true["t"][0]) & (time <= true["t"][-1])
    bRv = so3.interpolate(true["t"], np.roll(true["q"], 1, axis=1), time[inside])
    assert inside.mean() > 0.99
    assert np.rad2deg(rms(so3.log(so3.multiply(so3.inverse(bRv), found.wxyz[inside])))) < 0.12


def test_exact_calibration_of_noise_free_data_leaves_nothing() -> None:
    data, truth = made(noise=QUIET)
    for one in validate(data, Config(), truth):
        assert one.before.shape == one.after.shape == (len(one.time), 3)
        assert np.rad2deg(peak(one.after)) < 2e-3
        assert np.rad2deg(rms(one.before)) > 0.5


def test_validation_applies_gyro_errors_and_clock_drift() -> None:
    """Before, errors of the gyros' scale and of the clock were left in."""
    effects = {"gyro_scale_z": 0.03, "gyro_skew_xy": 0.01, "platform_scale_x": 0.02, "clock_skew": 1e-3}
    data, truth = made(noise=QUIET, effects=effects)
    assert max(abs(truth[name] - value) for name, value in effects.items()) < 1e-12
    for one in validate(data, Config(), truth):
        assert np.rad2deg(peak(one.after)) < 5e-3
    ignored = validate(data, Config(), {name: value for name, value in truth.items() if name not in effects})
    assert all(np.rad2deg(peak(one.after)) > 0.1 for one in ignored)


def test_bias_alone_shows_in_full_after_a_second() -> None:
    """At rest: where the helmet turns, the bias turns with it."""
    mounts = {"helmet_mount_deg": (0, 0, 0), "camera_mount_deg": (0, 0, 0), "time_offset_s": 0.0}
    data, truth = made(noise=QUIET, head={}, platform=None, latitude_deg=None, **mounts)
    against_vision, against_truth = validate(data, Config(), truth)
    bias = np.linalg.norm([truth[f"gyro_bias_{axis}"] for axis in "xyz"])
    assert rms(against_vision.before) == pytest.approx(bias, rel=1e-6)
    assert rms(against_truth.before) == pytest.approx(bias, rel=1e-6)


def test_what_is_left_is_the_noise_that_is_named() -> None:
    data, truth = made()
    against_vision, _ = validate(data, Config(), truth)
    noise = np.sqrt(6.0) * 8.7e-3
    assert rms(against_vision.after) == pytest.approx(noise, rel=0.1)
    assert f"{np.rad2deg(noise):.2g} deg RMS" in against_vision.note


def test_windows_with_vision_outliers_are_left_out_and_counted() -> None:
    data, truth = made(outlier_fraction=0.05)
    clean, _ = made()
    against_vision, _ = validate(data, Config(), truth)
    reference, _ = validate(clean, Config(), truth)
    assert rms(against_vision.after) == pytest.approx(rms(reference.after), rel=0.05)
    assert "left out for vision outliers" in against_vision.note
    spoilt = np.linalg.norm(so3.log(so3.multiply(so3.inverse(clean.vision_wxyz), data.vision_wxyz)), axis=1) > 0.1
    left_out = len(reference.time) - len(against_vision.time)
    # Each outlier begins one window and ends another, but for those near the ends.
    assert spoilt.sum() <= left_out <= 2 * spoilt.sum()


def test_gaps_have_no_windows() -> None:
    data, truth = made(vision_outages_s=[(3.0, 9.0)])
    against_vision, _ = validate(data, Config(), truth)
    assert not ((against_vision.time > 3.0) & (against_vision.time < 9.9)).any()
    one, two = (made(vision_outages_s=[(start, 12.0)]).data for start in (0.5, 2.0))
    assert len(validate(two, Config(), truth)[0].time) > 10
    with pytest.raises(InputError, match="no two frames about 1 s apart"):
        validate(one, Config(), truth)


def test_validate_on_another_recording_writes_a_page(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1)):
        settings = scenario(
            time_offset_s=0.012 if name == "a" else 0.0120001,
            sensors="ideal",
            vision_rate_hz=10,
            gyro_rate_hz=100,
        )
        data, truth = simulate_head(settings, seed)
        method("head").write_data(tmp_path / f"{name}.mcap", data, truth, head_config(settings))
    run = CliRunner()
    assert run.invoke(app, ["calibrate", str(tmp_path / "a.mcap"), "--out", str(tmp_path / "cal")]).exit_code == 0
    command = ["validate", "--calibration", str(tmp_path / "cal" / "calibration.yaml")]
    result = run.invoke(app, [*command, str(tmp_path / "b.mcap"), "--out", str(tmp_path / "v")])
    assert result.exit_code == 0
    before, after = (float(x) for x in _line(result.output, "against the truth").split("truth")[1].split()[:2])
    assert after < 0.5 * before
    assert "calibrated on" not in result.output
    page = (tmp_path / "v" / "validation.html").read_text()
    assert "Content-Security-Policy" in page
    assert page.count('class="plot"') == 2
    assert "Validate on another recording" in run.invoke(app, [*command, str(tmp_path / "a.mcap")]).output


def _line(text: str, part: str) -> str:
    return next(line for line in text.splitlines() if part in line)


def test_calibration_of_another_method_is_refused(tmp_path: Path) -> None:
    settings = scenario()
    data, truth = simulate_head(settings, 1)
    method("head").write_data(tmp_path / "s.mcap", data, truth, head_config(settings))
    (tmp_path / "c.yaml").write_text(
        "schema: alidade.calibration/1\nmethod: los\nsolver: batch\nstatus: calibrated\n"
        "recording: {file: x, sha256: x, start: '2026-01-01T00:00:00+00:00'}\nparameters: {}\n"
    )
    command = ["validate", str(tmp_path / "s.mcap"), "--calibration", str(tmp_path / "c.yaml")]
    said = "is a calibration of los, not of head; give one that `calibrate --method head` wrote"
    for more in ([], ["--method", "head"]):
        result = CliRunner().invoke(app, [*command, *more])
        assert isinstance(result.exception, InputError)
        assert str(result.exception) == f"{tmp_path / 'c.yaml'}: {said}"


def test_without_platform_topic_the_camera_mount_is_fixed() -> None:
    data, _ = made(platform=None)
    sigmas = {q.name: q.prior_sigma for q in problem(data, Config()).quantities}
    assert all(sigmas[f"camera_mount_{axis}"] == 0.0 for axis in "xyz")
    freed = load_config(b"priors: {camera_mount_x: 0.1}")
    assert {q.name: q.prior_sigma for q in problem(data, freed).quantities}["camera_mount_x"] == 0.1


def test_unknown_prior_names_the_nearest() -> None:
    data, _ = made()
    with pytest.raises(InputError, match=r"priors\.camera_mont_x.*camera_mount_x"):
        problem(data, load_config(b"priors: {camera_mont_x: 0.1}"))


def test_too_few_frames_is_one_clear_line() -> None:
    data, _ = made()
    few = replace(data, vision_t=data.vision_t + 11.8)
    with pytest.raises(InputError, match=r"vision: only \d of 240 frames lie within the gyros' record") as caught:
        problem(few, Config())
    assert "\n" not in str(caught.value)


def _guessed(mount_deg: tuple[float, float, float], **changes: object) -> np.ndarray:
    """First guess of the camera's mount, rotation vector, deg."""
    data, _ = made(helmet_mount_deg=(-46.0, 128.0, 29.0), camera_mount_deg=mount_deg, **changes)
    guessed = problem(data, Config()).graph()[1].atRot3(gtsam.symbol("C", 0))
    return np.rad2deg(so3.log(so3.from_gtsam([guessed])[0]))


@pytest.mark.parametrize("mount_deg", [(5.0, 103.0, 115.0), (-101.0, 17.0, -22.0)])
def test_the_first_guess_finds_a_camera_at_any_angle(mount_deg: tuple[float, float, float]) -> None:
    """As far as 12 s of noisy rates allow, where from zero the solution was missed by 154 deg."""
    off = so3.local(so3.exp(np.deg2rad(mount_deg)), so3.exp(np.deg2rad(_guessed(mount_deg))))
    assert np.linalg.norm(off) < np.deg2rad(25.0)


def test_the_first_guess_turns_no_camera_by_what_the_platform_leaves_open() -> None:
    """A platform that only yaws does not show how far its camera is turned about the vertical."""
    platform = scenario().platform
    assert platform is not None
    yawing = platform.model_copy(update={"pitch": [], "roll": []}).model_dump()
    for seed_mount in ((20.0, -15.0, 10.0), (0.0, 0.0, 60.0)):
        assert np.linalg.norm(_guessed(seed_mount, platform=yawing)) < 45.0


def test_a_camera_at_any_angle_is_calibrated() -> None:
    data, truth = made(helmet_mount_deg=(-46.0, 128.0, 29.0), camera_mount_deg=(5.0, 103.0, 115.0))
    estimate = solve_batch(problem(data, Config()))
    assert estimate.converged
    mounts = [i for i, name in enumerate(estimate.names) if "mount" in name]
    error = estimate.values[mounts] - [truth[estimate.names[i]] for i in mounts]
    assert np.abs(error / estimate.sigmas[mounts]).max() < 4.0
