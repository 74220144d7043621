"""Causes of residuals that do not fit: each made in a simulated recording, each to be named first."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from alidade.factors import so3
from alidade.pipelines.applications.cli import app
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics import cross_validation, hypothesis_tests
from alidade.pipelines.diagnostics.cross_validation import held_out_residuals, solve_trial, split_halves
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.diagnostics.hypothesis_tests import TrialCase, find_hypotheses, misstatements, trial_cases
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.problem import Estimate, Problem, Residuals, Step
from alidade.pipelines.methods import Method, method
from alidade.pipelines.methods.cube.recording import CubeConfig
from alidade.pipelines.methods.cube.simulation import CubeCamera, CubeScenario, cube_config, simulate_cube
from alidade.pipelines.methods.head.guidance import FAULTS
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, indexer_config, simulate_indexer
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.recording.topics import TopicSource
from alidade.pipelines.settings import Config, Sensors
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from tests.support.builders import IDEAL

Case = tuple[Method, Any, Config]


@pytest.fixture(scope="module")
def head() -> Case:
    """15 s, mounts known, no time offset, ideal sensors: what is tried is as without, and solved sooner."""
    return head_of(15.0)


def head_of(duration_s: float, sensors: Sensors | None = IDEAL, moving: bool = True) -> Case:
    known = [f"{mount}_{axis}" for mount in ("helmet_mount", "camera_mount") for axis in "xyz"]
    scenario = HeadScenario(
        duration_s=duration_s,
        vision_rate_hz=15,
        gyro_rate_hz=100,
        platform_gyro_rate_hz=100,
        platform=EulerMotion(
            yaw=[Swing(amplitude_deg=10, frequency_hz=0.3)], pitch=[Swing(amplitude_deg=12, frequency_hz=0.2)]
        )
        if moving
        else None,
        priors={**dict.fromkeys(known, 0.0), "time_offset": 0.0},
        sensors=sensors,
    )
    data, _ = simulate_head(scenario, 1)
    return method("head"), data, load_config(head_config(scenario).encode())


@pytest.fixture(scope="module")
def los() -> Case:
    return los_of(1)


def los_of(seed: int) -> Case:
    """15 s of sway about three axes."""
    scenario = LosScenario(duration_s=15, image_rate_hz=20, gyro_rate_hz=200, sensors=IDEAL)
    data, _ = simulate_los(scenario, seed)
    return method("los"), data, load_config(los_config(scenario).encode())


@pytest.fixture(scope="module")
def indexer() -> Case:
    """The four positions, a turn each way; with a data sheet of the encoders' delay it would be that which is named."""
    scenario = IndexerScenario(gyro_rate_hz=50, encoder_rate_hz=50, sensors=IDEAL)
    data, _ = simulate_indexer(scenario, 1)
    return method("indexer"), data, load_config(indexer_config(scenario).encode())


def with_noise(config: Config, **factors: float) -> Config:
    noise = {key: getattr(config.noise, key) * factor for key, factor in factors.items()}
    return config.model_copy(update={"noise": config.noise.model_copy(update=noise)})


def hypotheses(case: Case, estimate: Estimate | None = None) -> tuple[Finding, ...]:
    found, data, config = case
    return find_hypotheses(found.graph, found.faults, data, config, estimate)


def first_hypothesis(case: Case) -> str:
    return str(hypotheses(case)[0].evidence["label"])


def findings(case: Case) -> tuple[Finding, ...]:
    """Of the whole calibration, which need not have converged."""
    found, data, config = case
    return Session(found, data, config).calibrate(report=False).findings


def first_of_calibration(case: Case) -> str:
    """The first hypothesis on the whole calibration, of which some direction may not be observable besides."""
    return next(str(finding.evidence["label"]) for finding in findings(case) if finding.kind == "hypothesis")


def noise_notes(case: Case) -> dict[str, float]:
    """Noise -> used over stated, of a recording that has no other findings."""
    found = findings(case)
    assert {finding.kind for finding in found} <= {"noise", "remark"}
    assert all(finding.severity == Severity.NOTE for finding in found)
    return {each.evidence["noise"]: each.evidence["factor"] for each in found if each.kind == "noise"}


def test_what_fits_has_no_cause(head: Case) -> None:
    assert hypotheses(head) == ()


def test_noise_stated_three_times_too_small_is_no_cause_and_told(head: Case) -> None:
    find, data, config = head
    told = noise_notes((find, data, with_noise(config, vision_attitude=1.0 / 3.0)))
    assert told == {"vision_attitude": pytest.approx(3.0, rel=0.1)}


@pytest.mark.slow
def test_noise_known_exactly_and_three_times_too_small_does_not_fit() -> None:
    find, data, config = head_of(5.0)
    known = with_noise(config, vision_attitude=1.0 / 3.0).model_copy(update={"noise_known": 0.0})
    calibration = Session(find, data, known).calibrate(report=False)
    assert calibration.status == "inconsistent"
    assert any(f.kind == "misfit" and f.evidence["largest"] == "vision" for f in calibration.findings)


@pytest.mark.slow
@pytest.mark.parametrize("signs", [(-1.0, 1.0, 1.0), (1.0, -1.0, -1.0)])
def test_signs_of_the_helmet_gyro(head: Case, signs: tuple[float, ...]) -> None:
    find, data, config = head
    axes = " and ".join(axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0.0)
    label = first_hypothesis((find, replace(data, head_gyro=data.head_gyro * np.array(signs)), config))
    assert label == f"the sign of the helmet gyro's {axes} is wrong"


@pytest.mark.slow
def test_a_flipped_axis_where_mounts_and_scales_are_free_is_told_from_its_equivalents() -> None:
    """With nothing stated a scale of -1 and another mount fit as well, but for their priors."""
    scenario = HeadScenario(duration_s=12.0, vision_rate_hz=15, gyro_rate_hz=100, platform=None)
    data, _ = simulate_head(scenario, 1)
    flipped = replace(data, head_gyro=data.head_gyro * np.array([1.0, 1.0, -1.0]))
    assert first_hypothesis((method("head"), flipped, Config())) == "the sign of the helmet gyro's z is wrong"


@pytest.mark.slow
def test_sign_of_the_platform_gyro(head: Case) -> None:
    find, data, config = head
    wrong = replace(data, platform_gyro=data.platform_gyro * np.array([1.0, -1.0, 1.0]))
    assert first_hypothesis((find, wrong, config)) == "the sign of the platform gyro's y is wrong"


def test_faults_of_the_head_are_mended(head: Case) -> None:
    """What each trial changes, changed back by the same."""
    find, data, config = head
    inverted, reordered, reordered_back, *_, swapped, moving = find.faults.faults
    once = inverted.corrected(data, config)
    assert once is not None
    np.testing.assert_allclose(once[0].vision_wxyz, so3.inverse(data.vision_wxyz))
    again = inverted.corrected(*once)
    assert again is not None
    np.testing.assert_allclose(again[0].vision_wxyz, data.vision_wxyz)
    np.testing.assert_allclose(again[0].vision_cov, data.vision_cov, atol=1e-18)
    once = reordered.corrected(replace(data, vision_wxyz=data.vision_wxyz[:, [1, 2, 3, 0]]), config)
    assert once is not None
    np.testing.assert_array_equal(once[0].vision_wxyz, data.vision_wxyz)
    once = reordered_back.corrected(replace(data, vision_wxyz=data.vision_wxyz[:, [3, 0, 1, 2]]), config)
    assert once is not None
    np.testing.assert_array_equal(once[0].vision_wxyz, data.vision_wxyz)
    once = swapped.corrected(data, config)
    assert once is not None
    assert once[0].head_gyro is data.platform_gyro
    assert once[0].platform_gyro_density == data.gyro_density
    alone = replace(data, platform_t=None, platform_gyro=None)
    assert swapped.corrected(alone, config) is None
    assert moving.corrected(data, config) is None
    assert moving.corrected(alone, config) is not None
    assert moving.role == "fallback"


def test_inversion_that_the_config_states_of_misordered_quaternions_is_named() -> None:
    """As inverses they fit with another mount; where the inversion is right there is nothing to name."""
    find, data, config = head_of(5.0, moving=False)
    config = config.model_copy(update={"priors": {}})
    stated = config.model_copy(update={"topics": {"vision_attitude": TopicSource(topic="/tracker", invert=True)}})
    misordered = replace(data, vision_wxyz=so3.inverse(data.vision_wxyz[:, [1, 2, 3, 0]]), vision_cov=None)
    (found,) = misstatements(find.graph, find.faults, misordered, stated)
    assert found.severity == Severity.INCONSISTENT
    assert "not inverted as the config states: its quaternions are x, y, z, w" in found.evidence["label"]
    assert not misstatements(find.graph, find.faults, data, stated)
    assert not misstatements(find.graph, find.faults, misordered, config)


@pytest.mark.slow
def test_inverted_attitudes(head: Case) -> None:
    """Of vision: hRc where cRh is wanted, with the covariance of its error in the other frame."""
    find, data, config = head
    R = so3.matrix(data.vision_wxyz)
    covariance = R @ data.vision_cov @ np.swapaxes(R, 1, 2)
    wrong = replace(data, vision_wxyz=so3.inverse(data.vision_wxyz), vision_cov=covariance)
    assert first_of_calibration((find, wrong, config)).startswith("the attitudes of vision are inverted")


@pytest.mark.slow
def test_swapped_topics(head: Case) -> None:
    """The platform's IMU recorded as the helmet's and the other way round."""
    find, data, config = head
    wrong = replace(
        data,
        head_t=data.platform_t,
        head_gyro=data.platform_gyro,
        head_force=None,
        platform_t=data.head_t,
        platform_gyro=data.head_gyro,
    )
    assert first_of_calibration((find, wrong, config)).startswith("the topics of helmet and platform IMU are swapped")


@pytest.mark.slow
def test_a_platform_that_moves_without_a_topic(head: Case) -> None:
    find, data, config = head
    wrong = replace(data, platform_t=None, platform_gyro=None, platform_gyro_density=None)
    assert first_of_calibration((find, wrong, config)).startswith("the platform moves, and no topic measures it")


@pytest.mark.slow
def test_without_a_platform_topic_what_else_is_wrong_is_still_named() -> None:
    """A bias that may follow a platform would mend much: it is tried last."""
    find, data, config = head_of(15.0, moving=False)
    assert hypotheses((find, data, config)) == ()
    flipped = replace(data, head_gyro=data.head_gyro * [1.0, -1.0, 1.0])
    assert first_hypothesis((find, flipped, config)) == "the sign of the helmet gyro's y is wrong"
    assert "vision_attitude" in noise_notes((find, data, with_noise(config, vision_attitude=1.0 / 3.0)))


def contradicted(case: Case) -> dict[str, float]:
    """The number that the config fixes and the recording contradicts most, and what it is; no fault is named."""
    found = [each for each in findings(case) if each.kind in ("hypothesis", "contradiction")]
    assert {each.kind for each in found} == {"contradiction"}
    assert found[0].severity == Severity.INCONSISTENT
    return {found[0].evidence["parameter"]: found[0].evidence["value"]}


def test_delay_of_20_ms_with_the_time_offset_fixed(head: Case) -> None:
    find, data, config = head
    late = find, replace(data, vision_t=data.vision_t - 0.02), config
    assert contradicted(late) == {"time_offset": pytest.approx(0.02, abs=3e-3)}


@pytest.mark.slow
def test_delay_of_20_ms_of_the_los_pictures() -> None:
    """In sway slow enough the mounting angles take the delay up; this one is not."""
    sway = {
        axis: [Swing(amplitude_deg=5, frequency_hz=f), Swing(amplitude_deg=2, frequency_hz=3 * f)]
        for axis, f in (("roll", 0.21), ("pitch", 0.27), ("yaw", 0.33))
    }
    motion = EulerMotion(**sway)
    scenario = LosScenario(
        duration_s=15, image_rate_hz=30, carrier=motion, sensors=IDEAL, effects={"time_offset": 0.02}
    )
    data, _ = simulate_los(scenario, 1)
    late = method("los"), data, load_config(los_config(scenario).encode())
    assert contradicted(late) == {"time_offset": pytest.approx(0.02, abs=2e-3)}


@pytest.mark.slow
def test_encoders_read_20_ms_late(los: Case) -> None:
    find, data, config = los
    late = find, replace(data, gimbal_t=data.gimbal_t - 0.02), config
    assert contradicted(late) == {"encoder_delay": pytest.approx(0.02, abs=3e-4)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "factor", "seed"),
    [("gyro_density", 0.35, 1), ("los_error", 0.35, 1), ("los_error", 0.2, 2), ("encoder", 3.0, 1)],
)
def test_the_noise_that_is_stated_wrong_is_told_from_the_others(key: str, factor: float, seed: int) -> None:
    """And from `los_scale`, of which the encoders' share of the pictures' noise would be a function otherwise."""
    find, data, config = los_of(seed)
    assert list(noise_notes((find, data, with_noise(config, **{key: factor})))) == [key]


@pytest.mark.slow
def test_sign_of_the_los_gyro(los: Case) -> None:
    find, data, config = los
    wrong = replace(data, gyro=data.gyro * np.array([-1.0, 1.0, 1.0]))
    assert first_hypothesis((find, wrong, config)) == "the sign of the gyro's x is wrong"


@pytest.mark.slow
def test_swapped_axes(los: Case) -> None:
    find, data, config = los
    assert (
        first_hypothesis((find, replace(data, gyro=data.gyro[:, [1, 0, 2]]), config))
        == "the gyro's x and y are swapped"
    )


@pytest.mark.slow
def test_a_helmet_gyro_turned_by_a_right_angle(head: Case) -> None:
    find, data, config = head
    turned = np.stack([data.head_gyro[:, 1], -data.head_gyro[:, 0], data.head_gyro[:, 2]], axis=1)
    label = first_hypothesis((find, replace(data, head_gyro=turned), config))
    assert label == "the helmet gyro is turned by 90 deg about its z"


@pytest.mark.slow
def test_a_gyro_in_degrees_that_is_too_slow_to_be_refused(los: Case) -> None:
    find, data, config = los
    assert (
        first_hypothesis((find, replace(data, gyro=np.rad2deg(data.gyro)), config)) == "the gyro is in deg/s, not rad/s"
    )


@pytest.mark.slow
def test_late_encoders(indexer: Case) -> None:
    find, data, config = indexer
    label = first_hypothesis((find, replace(data, encoder_t=data.encoder_t + 0.02), config))
    assert label == "the stamps of the encoders are 20 ms too late"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
def test_size_of_the_cubes_tags(seed: int) -> None:
    scenario = CubeScenario(poses=8, static_s=2, imu_rate_hz=50, camera=CubeCamera(rate_hz=5), sensors=IDEAL)
    data, _ = simulate_cube(scenario, seed)
    config = load_config(cube_config(scenario).encode())
    tags = {i: tag.model_copy(update={"size": 1.03 * tag.size}) for i, tag in config.section(CubeConfig).tags.items()}
    wrong = config.model_copy(update={"cube": config.section(CubeConfig).model_copy(update={"tags": tags})})
    label = first_hypothesis((method("cube"), data, wrong))
    assert label.startswith("the tags are ")
    assert float(label.split()[3]) == pytest.approx(1.0 / 1.03, abs=0.005)


def test_a_cut_keeps_stamps_and_readings_together(head: Case) -> None:
    _, data, _ = head
    part = method("head").faults.segment(data, 3.0, 7.0)
    for stamps, values in ((part.head_t, part.head_gyro), (part.vision_t, part.vision_wxyz)):
        assert len(stamps) == len(values)
        assert 3.0 <= stamps[0] < stamps[-1] < 7.0
    rows = np.searchsorted(data.vision_t, part.vision_t)
    np.testing.assert_array_equal(part.vision_cov, data.vision_cov[rows])


def test_a_tenth_rejected_is_a_note_and_a_quarter_is_inconsistent(head: Case) -> None:
    def estimate(share: float) -> Estimate:
        used = np.random.default_rng(0).permutation(100) < 100 * share
        residuals = {"vision": Residuals(np.arange(100.0), np.zeros((100, 3)), used)}
        return Estimate("batch", (), np.zeros(0), np.zeros((0, 0)), True, "", residuals)

    def severity(share: float) -> list[Severity]:
        return [finding.severity for finding in diagnose(estimate(share), [])]

    assert severity(0.5) == severity(0.74) == [Severity.INCONSISTENT]
    assert severity(0.76) == severity(0.88) == [Severity.NOTE]
    assert severity(0.95) == []
    assert hypotheses(head, estimate(0.95)) == ()


def test_halves_of_a_recording_agree_and_those_of_two_do_not(head: Case) -> None:
    find, data, config = head
    halves, unsolved = split_halves(find.graph, find.faults, data, config)
    assert unsolved == ()
    assumed = {q.name for q in find.graph(data, config).quantities if q.group}
    assert set(halves) - assumed == {"gyro_bias_x", "gyro_bias_y", "gyro_bias_z"}
    assert max(abs(half.z) for half in halves.values()) < 4.0
    late = data.head_t > 0.5 * data.head_t[-1]
    jump = data.head_gyro + 0.02 * late[:, None] * np.array([1.0, 0.0, 0.0])
    changed = split_halves(find.graph, find.faults, replace(data, head_gyro=jump), config)[0]["gyro_bias_x"]
    assert changed.z > 4.0
    assert changed.step == pytest.approx(0.02, rel=0.3)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_corners_of_a_pose_held_out_are_predicted_by_the_turn_to_it(seed: int) -> None:
    """Alone that leaves the place open, and the attitude to some milliradians, tens of sigmas of a corner."""
    cube = method("cube")
    session = Session.of(cube, cube.simulate(CubeScenario(poses=20, static_s=1.5, imu_rate_hz=50.0), seed))
    assert held_out_residuals(session.problem())["tags"] == pytest.approx(1.0, abs=0.3)


def test_measurements_held_out_are_predicted_as_well_as_the_noise_allows(head: Case) -> None:
    # A fifth of 900 pictures: the robust sigma of their 540 numbers is known to 5 %.
    find, data, config = head_of(60.0)
    assert held_out_residuals(find.graph(data, config))["vision"] == pytest.approx(1.0, abs=0.15)
    find, data, config = head
    wrong = with_noise(config, vision_attitude=0.2)
    assert held_out_residuals(find.graph(replace(data, vision_cov=data.vision_cov / 25.0), wrong))["vision"] > 3.0


@pytest.mark.slow
def test_a_flipped_axis_ends_inconsistent_with_that_first(tmp_path: Path) -> None:
    """From the recording to the files: exit code 4, the cause at the head of the headline and in the report."""
    _, data, config = head_of(6.0, sensors=None)
    session, out = tmp_path / "flipped.mcap", tmp_path / "out"
    text = config.model_dump_json(exclude_defaults=True)
    method("head").write_data(session, replace(data, head_gyro=data.head_gyro * np.array([1.0, -1.0, 1.0])), None, text)
    ended = CliRunner().invoke(app, ["calibrate", str(session), "--out", str(out)])
    assert ended.exit_code == 4
    saved = json.loads((out / "result.json").read_text())
    assert saved["status"] == "inconsistent"
    label = "the sign of the helmet gyro's y is wrong"
    first = next(finding for finding in saved["findings"] if finding["severity"] == "inconsistent")
    assert first["kind"] == "hypothesis"
    assert first["label"] == saved["causes"][0]["label"] == label
    assert first["chi_square_after"] < 0.1 * first["chi_square_before"]
    assert f"Consistent with: {label} (chi-square" in saved["headline"]
    assert "Tested hypotheses" in (out / "report.html").read_text()


def test_a_trial_that_raises_ends_alone_and_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Three of twelve inconsistent recordings once ended in a RuntimeError of a trial's graph."""
    find, data, config = head_of(6.0)
    flipped = replace(data, head_gyro=data.head_gyro * [1.0, -1.0, 1.0])

    def fragile(data: Any, config: Config) -> Any:
        if np.abs(data.head_gyro).max() < 0.1 * np.abs(flipped.head_gyro).max():
            raise RuntimeError("no such key")
        return find.graph(data, config)

    def some(*of: Any) -> Iterator[TrialCase]:
        return (case for case in trial_cases(*of) if "y is wrong" in case.label or "deg/s, not" in case.label)

    monkeypatch.setattr(hypothesis_tests, "trial_cases", some)
    with caplog.at_level(logging.DEBUG, cross_validation.__name__):
        found = find_hypotheses(fragile, find.faults, flipped, config)
    assert found[0].evidence["label"] == "the sign of the helmet gyro's y is wrong"
    warnings = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert any("deg/s" in text and "RuntimeError: no such key" in text for text in warnings)
    assert any(record.exc_info for record in caplog.records)


def test_without_residual_families_there_is_no_worst_segment_and_no_crash(head: Case) -> None:
    """A method all of whose factors are processes has no measurements: the whole recording is used."""
    find, data, config = head
    nothing = Estimate("batch", (), np.zeros(0), np.zeros((0, 0)), True, "")

    def processes(data: Any, config: Config) -> Problem:
        built = find.graph(data, config)

        def steps(chunk: int) -> Iterator[Step]:
            for step in built.steps(chunk):
                factors = [replace(f, is_measurement=False) for f in step.factors]
                yield replace(step, factors=factors)

        return replace(built, steps=steps, loss=None)

    wrong = replace(data, head_gyro=data.head_gyro * [1.0, -1.0, 1.0])
    short = find.faults.segment(wrong, 0.0, 3.0)
    assert solve_trial(processes, short, config) is not None
    find_hypotheses(processes, replace(FAULTS, signs={}, faults=()), short, config, nothing)


@pytest.mark.slow
def test_a_noise_many_times_larger_is_never_an_explanation(head: Case) -> None:
    """Following such advice once ended in `calibrated` with an error of 157 sigmas."""
    method_, data, config = head
    rng = np.random.default_rng(0)
    noisy = replace(
        data, vision_wxyz=so3.multiply(data.vision_wxyz, so3.exp(0.1 * rng.normal(size=(len(data.vision_t), 3))))
    )
    found = hypotheses((method_, noisy, config))
    assert not [finding for finding in found if "times its statement" in finding.evidence["label"]]


def test_a_platform_taken_for_at_rest_is_a_note() -> None:
    import alidade

    calibration = alidade.open(alidade.simulate("head", {"duration_s": 10.0}, seed=1)).calibrate(report=False)
    assert "No platform IMU: the platform counts as at rest" in calibration.notes


def test_a_gyro_at_rest_with_a_fault_of_its_own_is_not_said_to_be_in_deg_s() -> None:
    """A drone on the ground, and a gyro that got stuck: the rates in any unit that are small enough fit."""
    find, data, config = head_of(10.0, moving=False)
    rng = np.random.default_rng(2)
    rates = 3e-4 * rng.standard_normal(data.head_gyro.shape)
    rates[500:520] += [1.0, -0.5, 0.7]
    first = np.broadcast_to(data.vision_wxyz[:1], data.vision_wxyz.shape)
    seen = so3.multiply(first, so3.exp(8.7e-3 * rng.standard_normal((len(first), 3))))
    still = replace(data, head_gyro=rates, vision_wxyz=seen)
    labels = [each.evidence["label"] for each in find_hypotheses(find.graph, find.faults, still, config)]
    assert not any("deg/s" in label for label in labels)
