"""What a cube's sensors, reference and place are off: simulated, found or made room for, named when far beyond."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import alidade
from alidade.factors import so3
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Severity
from alidade.pipelines.estimation.problem import Estimate
from alidade.pipelines.methods.cube.model import problem
from alidade.pipelines.methods.cube.recording import CubeData
from alidade.pipelines.methods.cube.simulation import CubeCamera, CubeScenario, cube_config, simulate_cube
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import solve_incremental

SHORT: dict[str, Any] = {"poses": 16, "static_s": 2.0, "turn_rad_s": 1.6, "camera": {"rate_hz": 5.0}}
# One of everything, beyond or within its prior.
EFFECTS = {
    "gyro_g_xz": 5e-4,
    "gyro_g_yy": -3e-4,
    "accel_square_1": 3e-5,
    "accel_cube_2": -2e-6,
    "reference_tilt_e": 2e-3,
    "reference_tilt_n": -1e-3,
}


def _scenario(**options: Any) -> CubeScenario:
    return CubeScenario.model_validate(SHORT | options)


@cache
def _with_effects() -> tuple[CubeData, dict[str, float], Config]:
    scenario = _scenario(effects=EFFECTS)
    return *simulate_cube(scenario, 3), load_config(cube_config(scenario).encode())


def _off(estimate: Estimate, truth: dict[str, float]) -> dict[str, float]:
    """Errors in sigmas of what is estimated and known."""
    rows = zip(estimate.names, estimate.values, estimate.sigmas, strict=True)
    return {n: abs(v - truth[n]) / s for n, v, s in rows if n in truth and s > 0.0}


def test_the_simulator_adds_what_the_contract_says() -> None:
    (plain, _), (data, truth, _) = simulate_cube(_scenario(), 3), _with_effects()
    assert {name: truth[name] for name in EFFECTS} == EFFECTS
    assert truth["gyro_g_zz"] == 0.0
    noise = 10.0 * 1.5e-3
    u = plain.accel
    added = data.accel - u
    np.testing.assert_allclose(added[:, 0], 3e-5 * u[:, 0] ** 2, atol=5.0 * 3e-5 * 40.0 * noise)
    np.testing.assert_allclose(added[:, 1], -2e-6 * u[:, 1] ** 3, atol=5.0 * 2e-6 * 600.0 * noise)
    assert not added[:, 2].any()
    K = np.array([[truth[f"accel_k{i}{j}"] for j in "123"] for i in "123"])
    force = u @ K.T + [truth[f"accel_b{i}"] for i in "123"]
    felt = np.stack([5e-4 * force[:, 2], -3e-4 * force[:, 1], np.zeros(len(u))], axis=1)
    np.testing.assert_allclose(data.gyro - plain.gyro, felt, atol=5.0 * 5e-4 * noise)
    assert plain.reference_wxyz is not None
    assert data.reference_wxyz is not None
    turned = so3.log(so3.multiply(plain.reference_wxyz, so3.inverse(data.reference_wxyz)))
    np.testing.assert_allclose(turned[:, :2], np.tile([2e-3, -1e-3], (len(turned), 1)), atol=1e-4)


def test_effects_are_found_or_made_room_for() -> None:
    data, truth, config = _with_effects()
    estimate = solve_batch(problem(data, config))
    assert max(_off(estimate, truth).values()) < 4.0
    found = dict(zip(estimate.names, zip(estimate.values, estimate.sigmas, strict=True), strict=True))
    for name in ("gyro_g_xz", "gyro_g_yy"):
        assert abs(found[name][0]) > 10.0 * found[name][1]


def test_a_camera_whose_focal_length_and_centre_are_off() -> None:
    """0.6 % and 3 px, a sigma each of what CameraInfo is usually off by: found, and what is calibrated is right."""
    off = {"camera_focal": 6e-3, "camera_centre_x": 3.0, "camera_centre_y": -2.0}
    scenario = CubeScenario(poses=14, static_s=2.0, effects=off, camera=CubeCamera(rate_hz=8.0))
    data, truth = simulate_cube(scenario, 2)
    estimate = solve_batch(problem(data, load_config(cube_config(scenario).encode())))
    assert max(_off(estimate, truth).values()) < 4.0
    found = dict(zip(estimate.names, zip(estimate.values, estimate.sigmas, strict=True), strict=True))
    assert found["camera_focal"][1] < 2.5e-3


def test_ideal_sensors_leave_mounts_tags_heading_and_field_alone_and_go_wrong() -> None:
    scenario = _scenario(effects=EFFECTS, sensors="ideal")
    data, truth = simulate_cube(scenario, 3)
    # With the noise stated: what the graph lacks would be taken for noise.
    known = load_config(cube_config(scenario).encode()).model_copy(update={"noise_known": 0.0})
    built = problem(data, known)
    free = {q.name: q.prior_sigma for q in built.quantities if q.prior_sigma}
    assert not [name for name in free if name.startswith(("gyro_g", "accel_s", "accel_c", "reference_t"))]
    usual = {"camera_mount_x": 5e-3, "tag_17_x": 3e-3, "field_e": 5e-7, "reference_heading": 1e-2}
    assert {name: free[name] for name in usual} == usual
    assert max(_off(solve_batch(built), truth).values()) > 10.0


def _conflicts(calibration: Calibration) -> list[str]:
    """Parameters that contradict their priors, materially, worst first."""
    conflicts = [f for f in calibration.findings if f.kind == "prior_conflict" and f.severity == Severity.INCONSISTENT]
    return [finding.evidence["parameter"] for finding in conflicts]


def test_a_gyro_that_feels_force_far_beyond_its_data_sheet_is_named_first() -> None:
    simulated = alidade.simulate("cube", _scenario(effects={"gyro_g_xz": 1.2e-3}), seed=4)
    wrong = alidade.open(simulated).calibrate(report=False)
    assert wrong.status == "inconsistent"
    assert _conflicts(wrong)[0] == "gyro_g_xz"
    stated = Config.model_validate({"sensors": {"gyro": {"g_sensitivity": 1.2e-3}}})
    right = alidade.open(simulated, config=stated).calibrate(report=False)
    assert right.status == "calibrated"
    gyro_g = right.parameters["gyro_g_xz"]
    assert abs(gyro_g.value - 1.2e-3) < 4.0 * gyro_g.sigma
    assert gyro_g.group == "assumption"


def test_what_contradicts_a_data_sheet_by_little_is_in_the_sigmas() -> None:
    """Cubic terms ten times their prior, of which the recording shows some: K was 7 of its sigmas off."""
    cubic = {f"accel_cube_{axis}": 1e-5 for axis in "123"}
    simulated = alidade.simulate("cube", _scenario(static_s=4.0, poses=20, effects=cubic), seed=0)
    found = alidade.open(simulated).calibrate(report=False)
    assert found.status == "calibrated"
    assert any("contradicts its data sheet" in note for note in found.notes)
    judged = [p for p in found.parameters.values() if p.group is None and p.sigma > 0.0]
    assert max(abs(p.value - simulated.truth[p.name]) / p.sigma for p in judged) < 4.0


def test_a_tilt_of_the_reference_that_no_residual_shows_is_named() -> None:
    """Of a reference that stands still it is as the camera's mount: both go wrong together, within 5e-3 rad unseen."""
    tilted = _scenario(effects={"reference_tilt_e": 6e-3, "reference_tilt_n": -6e-3})
    found = alidade.open(alidade.simulate("cube", tilted, seed=0)).calibrate(report=False)
    assert any("check sensors.reference.tilt" in note for note in found.notes)


def test_a_field_far_from_its_model_is_named_and_has_room_where_stated() -> None:
    """What a building does to the field's direction it does to its strength, which no motion tells from a scale."""
    far = {"direction": 5e-6, "strength": 5e-6, "measured": None}
    simulated = alidade.simulate("cube", _scenario(field=far), seed=3)
    wrong = alidade.open(simulated).calibrate(report=False)
    assert wrong.status == "inconsistent"
    assert _conflicts(wrong)[0] == "field_e"
    stated = Config.model_validate({"sensors": {"field": {"model_error": 5e-6}}})
    right = alidade.open(simulated, config=stated).calibrate(report=False)
    assert right.status == "weak"
    assert "mag_scale" in right.headline
    assert right.parameters["mag_k11"].sigma > 0.05
    errors = {n: abs(p.value - simulated.truth[n]) / p.sigma for n, p in right.parameters.items() if p.sigma > 0.0}
    assert max(errors.values()) < 4.0


def test_a_stated_field_is_drawn_as_stated() -> None:
    stated = {"sensors": {"field": {"model_error": 5e-6}}, "poses": 1, "static_s": 0.5}
    field = [simulate_cube(_scenario(**stated), seed).truth for seed in range(40)]
    middle = simulate_cube(_scenario(poses=1, static_s=0.5, field={"direction": 0.0, "strength": 0.0}), 0).truth
    off = np.array([[each[f"field_{a}"] - middle[f"field_{a}"] for a in "enu"] for each in field])
    assert np.sqrt((off**2).mean()) == pytest.approx(5e-6, rel=3.0 / np.sqrt(2 * off.size))


def test_the_old_option_says_what_to_write_instead() -> None:
    data, _, config = _with_effects()
    noise = config.noise.model_copy(update={"gyro_scale": 5e-3})
    with pytest.raises(InputError, match=r"noise\.gyro_scale: cube estimates .*sensors: \{gyro: \{g_sensitivity:"):
        problem(data, config.model_copy(update={"noise": noise}))


def _assert_consistent(seeds: range, solve: Any, **options: Any) -> None:
    """Mean NEES of everything estimated inside its 99 % interval, all assumptions drawn from their priors."""
    found = []
    for seed in seeds:
        scenario = _scenario(**({"sensors": {}} | options))
        data, truth = simulate_cube(scenario, seed)
        estimate = solve(problem(data, load_config(cube_config(scenario).encode())))
        rows = [i for i, s in enumerate(estimate.sigmas) if s > 0.0]
        error = estimate.values[rows] - [truth[estimate.names[i]] for i in rows]
        found.append(error @ np.linalg.solve(estimate.covariance[np.ix_(rows, rows)], error))
    low, high = chi2.ppf([0.005, 0.995], len(rows) * len(found)) / len(found)
    assert low < np.mean(found) < high


def test_sigmas_are_consistent() -> None:
    _assert_consistent(range(1000, 1002), solve_batch)


@pytest.mark.slow
@pytest.mark.parametrize("solve", [solve_batch, solve_incremental], ids=["batch", "incremental"])
def test_sigmas_are_consistent_over_twenty_runs(solve: Any) -> None:
    _assert_consistent(range(1000, 1020), solve)


@pytest.mark.slow
def test_sigmas_are_consistent_in_a_building() -> None:
    _assert_consistent(range(1000, 1020), solve_batch, sensors={"field": {"model_error": 5e-6}})
