"""The indexer method in batch: what it must reach, on simulated, independent and real recordings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.chi_square import quantile
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.cross_validation import rms
from alidade.pipelines.estimation.parameters import prior_z_score
from alidade.pipelines.estimation.problem import Estimate, Quantity
from alidade.pipelines.methods.indexer.model import problem
from alidade.pipelines.methods.indexer.parameters import indexer_parameters
from alidade.pipelines.methods.indexer.published import half_differences, published_estimate, search
from alidade.pipelines.methods.indexer.recording import read_indexer
from alidade.pipelines.methods.indexer.report import validate
from alidade.pipelines.methods.indexer.simulation import ARCSEC, IndexerScenario, indexer_config, simulate_indexer
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Config, Sensors
from alidade.pipelines.simulation.scenario import load_scenario
from alidade.pipelines.solvers.batch import solve_batch
from datasets.imucal import CONFIG, COUNTS, read_parts, to_session
from tests.support.builders import IDEAL

# The whole claim of the publication, and the tenth part of it that the graph must hold.
MILLIDEGREE = np.deg2rad(1e-3)
RATES = {"gyro_rate_hz": 50.0, "encoder_rate_hz": 50.0}


def _solve(scenario: IndexerScenario, seed: int) -> tuple[Estimate, np.ndarray]:
    """The batch estimate and its errors."""
    data, truth = simulate_indexer(scenario, seed)
    estimate = solve_batch(problem(data, load_config(indexer_config(scenario).encode())))
    return estimate, estimate.values - np.array([truth[name] for name in estimate.names])


def _scenario(name: str) -> IndexerScenario:
    """Of ideal sensors, and no more samples than it takes."""
    return load_scenario(IndexerScenario, f"indexer_{name}").model_copy(update={"sensors": IDEAL, **RATES})


def _assert_consistent(estimate: Estimate, probability: float = 1e-3) -> None:
    chi = estimate.chi_square
    assert chi is not None
    assert quantile(0.5 * probability, chi.dof) < chi.value < quantile(1.0 - 0.5 * probability, chi.dof)


@pytest.mark.parametrize("name", [pytest.param("ideal", marks=pytest.mark.slow), "large_angles"])
def test_ideal_axes_within_a_tenth_of_an_arc_second(name: str) -> None:
    estimate, error = _solve(_scenario(name), 1)
    assert np.abs(error[:3]).max() < 0.1 * ARCSEC
    assert np.abs(error / estimate.sigmas).max() < 3.0
    assert estimate.sigmas[:3].max() < 0.05 * ARCSEC
    _assert_consistent(estimate)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_rough_axes_within_a_millidegree_and_three_sigma(seed: int) -> None:
    estimate, error = _solve(_scenario("rough"), seed)
    assert np.abs(error[:3]).max() < MILLIDEGREE
    assert np.abs(error / estimate.sigmas).max() < 3.0
    _assert_consistent(estimate)


def test_published_search_beside_the_graph_on_rough_axes() -> None:
    """Harmonics of the encoder tilt the axis for both alike."""
    scenario = _scenario("rough")
    data, truth = simulate_indexer(scenario, 1)
    expected = np.array([truth[f"theta_{a}"] for a in "xyz"])
    graph = problem(data, load_config(indexer_config(scenario).encode()))
    exact = solve_batch(graph).values[:3] - expected
    published = published_estimate(data, load_config(indexer_config(scenario).encode()), graph)
    assert np.abs(published.values - expected - exact).max() < 0.2 * ARCSEC
    assert published.converged


def test_two_positions_without_the_move_leave_theta_x_weak_and_named() -> None:
    scenario = _scenario("two_positions")
    data, truth = simulate_indexer(scenario, 1)
    graph = problem(data, load_config(indexer_config(scenario).encode()))
    estimate = solve_batch(graph)
    sigma = dict(zip(estimate.names, estimate.sigmas, strict=True))
    # The earth's rate alone tells theta_x, to some minutes of arc.
    assert 100 * ARCSEC < sigma["theta_x"] < 500 * ARCSEC
    assert max(sigma["theta_y"], sigma["theta_z"]) < 5e-5
    assert abs(estimate.values[0] - truth["theta_x"]) < 3.0 * sigma["theta_x"]
    assert graph.advice is not None
    assert "inner axis" in graph.advice({"theta_x": 0.99, "theta_y": 0.02}).advice
    assert search(half_differences(data)).flat[0]


def test_the_recorded_move_makes_theta_x_observable() -> None:
    scenario = _scenario("two_positions").model_copy(update={"record_moves": True})
    estimate, error = _solve(scenario, 1)
    assert estimate.sigmas[0] < 1.0 * ARCSEC
    assert abs(error[0]) < 3.0 * estimate.sigmas[0]


def test_gyro_scale_and_axes_not_perpendicular_are_recovered() -> None:
    free = {"gyro_scale_x": 1e-2, "gyro_scale_y": 1e-2, "gyro_scale_z": 1e-2, "axis_nonperpendicularity": 1e-2}
    scenario = _scenario("ideal").model_copy(
        update={
            "effects": {"gyro_scale_x": 3e-3, "gyro_scale_y": -2e-3, "gyro_scale_z": 1e-3},
            "axis_nonperpendicularity_arcsec": 300.0,
            "priors": free,
        }
    )
    estimate, error = _solve(scenario, 3)
    # What the data sheet of ideal sensors fixes comes along as long as something else of the same sensor is free.
    fixed = estimate.sigmas < 1e-9
    assert tuple(np.array(estimate.names)[~fixed][6:]) == tuple(free)
    assert np.abs(error[~fixed] / estimate.sigmas[~fixed]).max() < 3.5
    assert estimate.sigmas[-1] < 5e-5
    assert np.abs(error[[6, 8]]).max() < 1e-6


def test_tilted_base() -> None:
    tilted = tuple(so3.exp([0.3, -0.2, 1.9]).tolist())
    estimate, error = _solve(_scenario("ideal").model_copy(update={"base_attitude": tilted}), 2)
    assert np.abs(error / estimate.sigmas).max() < 3.5


@pytest.mark.parametrize(("runs", "name"), [(3, "ideal"), pytest.param(50, "ideal", marks=pytest.mark.slow)])
def test_errors_agree_with_the_covariance(runs: int, name: str) -> None:
    """Mean NEES over the runs inside its 99 % interval."""
    nees = []
    for seed in range(100, 100 + runs):
        estimate, error = _solve(_scenario(name), seed)
        nees.append(error @ np.linalg.solve(estimate.covariance, error))
    dof = runs * len(error)
    assert quantile(0.005, dof) < np.sum(nees) < quantile(0.995, dof)


def _effect(seed: int, **effects: float) -> tuple[Estimate, np.ndarray]:
    scenario = load_scenario(IndexerScenario, "indexer_nominal").model_copy(
        update={"effects": effects, "gyro_rate_hz": 50.0, "encoder_rate_hz": 50.0}
    )
    return _solve(scenario, seed)


@pytest.mark.parametrize(
    "effects",
    [
        {"gyro_scale_x": 1e-4, "gyro_scale_y": -1e-4, "gyro_scale_z": 1e-4},
        {"gyro_skew_xy": 2e-5, "gyro_skew_xz": -2e-5, "gyro_skew_yz": 2e-5},
        {"encoder_outer_x_sin": 5e-6, "encoder_outer_x_cos": -5e-6},
        pytest.param({"encoder_inner_z_sin": 5e-6, "encoder_inner_z_cos": 5e-6}, marks=pytest.mark.slow),
        pytest.param({"encoder_delay": 1e-3}, marks=pytest.mark.slow),
    ],
    ids=lambda effects: next(iter(effects)),
)
def test_an_effect_of_the_data_sheets_size_is_within_three_sigma(effects: dict[str, float]) -> None:
    estimate, error = _effect(0, **effects)
    assert np.abs(error / estimate.sigmas).max() < 3.5
    _assert_consistent(estimate)


def test_encoder_errors_are_told_by_the_recording() -> None:
    """Ten times the data sheet's, with the mounting right all the same; left out they cost eight sigmas."""
    effects = {"encoder_inner_z_cos": 5e-5, "encoder_delay": 1e-2}
    estimate, error = _effect(1, **effects)
    assert np.abs(error / estimate.sigmas).max() < 3.5
    pulls = {q.name: prior_z_score(q, v, s) for q, v, s in _reported(estimate)}
    assert pulls["encoder_inner_z_cos"] == pytest.approx(10.0, rel=0.05)
    assert pulls["encoder_delay"] == pytest.approx(10.0, rel=0.05)
    assert all(abs(p or 0.0) < 3.0 for name, p in pulls.items() if name not in effects)


def _reported(estimate: Estimate) -> list[tuple[Quantity, float, float]]:
    """The assumptions of a default config."""
    quantities = {q.name: q for p in indexer_parameters(Config()) for q in p.quantities if q.group == "assumption"}
    return [
        (quantities[name], float(value), float(sigma))
        for name, value, sigma in zip(estimate.names, estimate.values, estimate.sigmas, strict=True)
        if name in quantities
    ]


@pytest.mark.parametrize(("runs", "name"), [(2, "nominal"), pytest.param(50, "nominal", marks=pytest.mark.slow)])
def test_errors_of_real_sensors_agree_with_the_covariance(runs: int, name: str) -> None:
    """Mean NEES over the runs inside its 99 % interval, with effects drawn from what is assumed of them."""
    scenario = load_scenario(IndexerScenario, f"indexer_{name}").model_copy(update={"sensors": Sensors(), **RATES})
    nees = []
    for seed in range(runs):
        estimate, error = _solve(scenario, seed)
        nees.append(error @ np.linalg.solve(estimate.covariance, error))
    dof = runs * len(error)
    assert quantile(0.005, dof) < np.sum(nees) < quantile(0.995, dof)


@pytest.mark.parametrize("factor", [pytest.param(1.0 / 3.0, marks=pytest.mark.slow), 3.0])
def test_noise_stated_wrong_but_hardly_known_leaves_the_sigmas(factor: float) -> None:
    """Encoder noise stated three times too large passed for slow errors: sigmas were eight times too large."""
    scenario = _scenario("nominal")
    data, _ = simulate_indexer(scenario, 1)
    config = load_config(indexer_config(scenario).encode())
    assert config.noise.gyro_density is not None
    assert config.noise.encoder is not None
    sigmas = []
    for size in (1.0, factor):
        stated = {"gyro_density": size * config.noise.gyro_density, "encoder": size * config.noise.encoder}
        known = {"noise": config.noise.model_copy(update=stated), "noise_known": 1.0}
        sigmas.append(solve_batch(problem(data, config.model_copy(update=known))).sigmas)
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=0.03)


def test_priors_beat_sensors_beat_the_defaults() -> None:
    sensors = Sensors.model_validate({"gyro": {"scale": 3e-4}, "encoder": {"once_per_turn": None}})
    config = Config(sensors=sensors, priors={"gyro_scale_y": 0.0, "gyro_scale_z": None, "encoder_delay": 2e-3})
    sigmas = {q.name: q.prior_sigma for p in indexer_parameters(config) for q in p.quantities}
    assert [sigmas[f"gyro_scale_{axis}"] for axis in "xyz"] == pytest.approx([3e-4, 0.0, 3e-3])
    assert sigmas["gyro_skew_xy"] == pytest.approx(2e-5)
    assert sigmas["encoder_outer_x_sin"] == pytest.approx(5e-5)
    assert sigmas["encoder_delay"] == pytest.approx(2e-3)
    assert "axis_nonperpendicularity" not in sigmas
    ideal = indexer_parameters(Config(sensors=IDEAL))
    assert [q.name for p in ideal for q in p.quantities][-1] == "gyro_bias_z"


@pytest.mark.slow
def test_an_hour_of_attitude_is_within_a_millidegree_after_compensation() -> None:
    scenario = _scenario("hour")
    data, truth = simulate_indexer(scenario, 1)
    assert data.gyro_t[-1] > 3600.0
    config = load_config(indexer_config(scenario).encode())
    estimate = solve_batch(problem(data, config))
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    attitude, turns = validate(data, config, values)
    assert rms(attitude.before) > 0.05 * np.deg2rad(1.0)
    assert rms(attitude.after) < MILLIDEGREE
    # Little but the noise of the INS itself, one arc second about each of three axes, and of the encoders is left.
    assert rms(attitude.after) < 2.0 * ARCSEC
    assert rms(turns.after) < 0.01 * rms(turns.before)
    assert estimate.attitudes is not None
    np.testing.assert_allclose(np.abs(estimate.attitudes.wxyz[:, 0]), 1.0, atol=1e-9)
    assert truth["theta_x"] == pytest.approx(values["theta_x"], abs=0.2 * ARCSEC)


@pytest.mark.parametrize(
    ("sensors", "limit"),
    [pytest.param(IDEAL, 0.1 * ARCSEC, marks=pytest.mark.slow), (Sensors(), 2.1e-5)],
    ids=["ideal", "real"],
)
def test_independent_simulator_within_three_sigma(shared_data: Path, sensors: Sensors, limit: float) -> None:
    """What real sensors may have wrong costs what it does; that these had nothing wrong is within it."""
    recording = open_recording(shared_data / "contract" / "indexer_nominal.mcap")
    config = load_config(recording.attachment("alidade.yaml")).model_copy(update={"sensors": sensors})
    truth = json.loads((shared_data / "contract" / "indexer_nominal.truth.json").read_text())
    estimate = solve_batch(problem(read_indexer(recording, config), config))
    assert sum(name in truth for name in estimate.names) == 6
    expected = np.array([truth.get(name, 0.0) for name in estimate.names])
    assert np.abs((estimate.values - expected) / estimate.sigmas).max() < 3.0
    assert estimate.sigmas[:3].max() < limit
    _assert_consistent(estimate)


def test_real_turns_by_hand_against_imucal(shared_data: Path) -> None:
    """One whole turn about each axis.

    imucal counts its turns as -360 degrees, hence the sign of its R_g. Its K_g R_g is
    (1 + scale) mRt here, but for gyro axes 0.3 degrees from perpendicular, which are left out here.
    """
    data = to_session(read_parts(shared_data / "imucal" / "annotated_session.csv"))
    published = json.loads((shared_data / "imucal" / "example_cal.json").read_text())
    estimate = solve_batch(problem(data, load_config(CONFIG.encode())))
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    scale, theta, bias = (np.array([values[f"{n}_{a}"] for a in "xyz"]) for n in ("gyro_scale", "theta", "gyro_bias"))
    np.testing.assert_allclose(COUNTS * (1.0 + scale), np.diag(published["K_g"]), rtol=2e-3)
    mRt = so3.matrix(so3.inverse(so3.from_angles(theta)))
    np.testing.assert_allclose(np.rad2deg(mRt), -np.rad2deg(published["R_g"]), atol=0.25)
    np.testing.assert_allclose(np.rad2deg(bias) * COUNTS, published["b_g"], atol=0.1)


def test_families_account_for_every_degree_of_freedom() -> None:
    """A bias that hardly walks leaves nothing over: its tight rows take no freedom from the turns."""
    scenario = load_scenario(IndexerScenario, "indexer_nominal").model_copy(update=RATES)
    data, _ = simulate_indexer(scenario, 0)
    estimate = solve_batch(problem(data, load_config(indexer_config(scenario).encode())))
    assert estimate.chi_square is not None
    dof = {family: d for family, (_, d) in estimate.chi_square.families.items()}
    assert dof["bias walk"] < 1.0
    assert dof["turn"] > 0.8 * estimate.chi_square.dof
    # Also of factors that are compressed: a family's squares are what its freedoms say.
    for square, freedoms in estimate.chi_square.families.values():
        assert abs(square - freedoms) < 4.0 * np.sqrt(2.0 * freedoms) + 1.0
