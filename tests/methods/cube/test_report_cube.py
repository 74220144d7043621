"""What the cube tells beside its parameters, and its own figures."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.config import load_config
from alidade.pipelines.display.figure import Plot
from alidade.pipelines.display.sphere_map import described
from alidade.pipelines.estimation.problem import Estimate, Findings
from alidade.pipelines.methods.cube.model import problem
from alidade.pipelines.methods.cube.recording import CubeData
from alidade.pipelines.methods.cube.report import cube_plots, findings, white_noise
from alidade.pipelines.methods.cube.simulation import CubeCamera, CubeScenario, cube_config, simulate_cube
from alidade.pipelines.methods.triads import parts_of
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config
from alidade.pipelines.solvers.batch import solve_batch

SCENARIO = CubeScenario(poses=10, static_s=3.0, turn_rad_s=1.2, camera=CubeCamera(rate_hz=5.0))
Solved = tuple[CubeData, Config, Estimate, Findings, dict[str, float]]


@pytest.fixture(scope="module")
def solved() -> Solved:
    data, truth = simulate_cube(SCENARIO, 1)
    config = load_config(cube_config(SCENARIO).encode())
    estimate = solve_batch(problem(data, config))
    return data, config, estimate, findings(data, config, estimate), truth


def _plots(solved: Solved) -> dict[str, Any]:
    data, config, estimate, found, _ = solved
    told = SimpleNamespace(config=config, problem=problem(data, config), estimate=estimate, tables=found)
    return {each.title: each for each in cube_plots(data, cast(Calibration, told))}


def test_parts_of_a_triad_made_of_them() -> None:
    """Axes with known scales and angles, mounted at a known rotation vector."""
    scale, across, mounting = np.array([1.02, 0.97, 1.01]), np.array([0.02, -0.01, 0.03]), [0.1, -0.2, 0.3]
    gram = np.eye(3)
    gram[[0, 0, 1], [1, 2, 2]] = gram[[1, 2, 2], [0, 0, 1]] = np.sin(across)
    # The symmetric root has no rotation in it.
    values, vectors = np.linalg.eigh(gram)
    axes = (vectors * np.sqrt(values)) @ vectors.T @ so3.matrix(so3.exp(np.array(mounting))).T
    found = parts_of(np.linalg.inv(scale[:, None] * axes))
    np.testing.assert_allclose(found, [*scale, *across, *mounting], atol=1e-12)
    for bad in (np.zeros((3, 3)), np.diag([1.0, 1.0, -1.0])):
        with pytest.raises(ValueError, match="singular or left-handed"):
            parts_of(bad)


def test_parts_and_their_sigmas_fit_the_truth(solved: Solved) -> None:
    _, _, _, found, truth = solved
    assert [row["sensor"] for row in found["triads"]] == ["accel", "gyro", "mag"]
    errors = []
    for row in found["triads"]:
        K = np.array([[truth[f"{row['sensor']}_k{i}{j}"] for j in "123"] for i in "123"])
        said, sigma = (
            [*cast(Any, row["scale" + s]), *cast(Any, row["nonorthogonality" + s]), *cast(Any, row["mounting" + s])]
            for s in ("", "_sigma")
        )
        errors.append((np.array(said) - parts_of(K)) / sigma)
    assert np.abs(errors).max() < 4.0
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_noise_at_rest_is_what_was_simulated_in_calibrated_units(solved: Solved) -> None:
    rows = {str(row["sensor"]): row for row in solved[3]["noise"]}
    noise, truth = SCENARIO.noise, solved[4]
    for name, density in (("accel", noise.accel_density), ("gyro", noise.gyro_density), ("mag", noise.mag_density)):
        K = np.array([[truth[f"{name}_k{i}{j}"] for j in "123"] for i in "123"])
        np.testing.assert_allclose(cast(Any, rows[name]["density"]), density * np.linalg.norm(K, axis=1), rtol=0.2)
        assert rows[name]["stated"] == density
    assert (rows["gyro"]["walk"], rows["gyro"]["walk_source"]) == (noise.gyro_bias_walk, "stated")
    assert rows["accel"]["walk_source"] == "upper bound"
    assert (rows["gyro"]["topic"], rows["gyro"]["rate_hz"], rows["mag"]["rate_hz"]) == ("/imu", 100.0, 50.0)


def test_white_noise_of_a_long_rest_and_none_of_a_short_one() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(60_000) / 200.0
    sigma = np.array([1.0, 2.0, 3.0])
    vectors = sigma * np.sqrt(200.0) * rng.normal(size=(len(t), 3)) + 5.0 * t[:, None] / t[-1]
    np.testing.assert_allclose(white_noise(t, vectors, np.array([[0.0, 300.0]]), 200.0), sigma, rtol=0.06)
    np.testing.assert_array_equal(white_noise(t, vectors, np.array([[0.0, 0.2]]), 200.0), 0.0)


def test_static_poses_are_told_with_what_was_used(solved: Solved) -> None:
    poses = solved[3]["static_poses"]
    assert len(poses) == SCENARIO.poses
    assert poses[0]["used"] == ["accelerometer", "gyro at rest", "magnetometer", "tags"]
    starts = [cast(float, pose["start_s"]) for pose in poses]
    ends = [cast(float, pose["end_s"]) for pose in poses]
    assert all(e > s for s, e in zip(starts, ends, strict=True))
    assert all(s > e for e, s in zip(ends[:-1], starts[1:], strict=True))
    np.testing.assert_allclose(np.linalg.norm([cast(Any, pose["up"]) for pose in poses], axis=1), 1.0, atol=1e-3)


def test_figures_and_tables(solved: Solved) -> None:
    plots = _plots(solved)
    assert list(plots) == [
        "White noise at rest",
        "Static poses",
        "Accelerometer before and after",
        "Gyro before and after",
        "Magnetometer before and after",
        "Sphere of the accelerometer",
        "Sphere of the magnetometer",
        "Attitudes covered",
    ]
    for name, least in (("Accelerometer", 50.0), ("Gyro", 30.0), ("Magnetometer", 50.0)):
        before, after = (mark.y for mark in plots[f"{name} before and after"].figure.marks)
        assert np.sqrt((before**2).mean()) > least * np.sqrt((after**2).mean())
    raw, good, _ = plots["Sphere of the accelerometer"].beside[1].marks
    assert np.abs(good.y).max() < 0.1 < 1.0 < np.abs(raw.y).max()
    covered = plots["Attitudes covered"]
    assert isinstance(covered, Plot)
    (poses,) = covered.figure.named("poses")
    assert len(poses.x) == SCENARIO.poses
    assert "deg from every pose" in covered.caption


def test_without_camera_and_magnetometer_there_is_less_to_show() -> None:
    scenario = SCENARIO.model_copy(update={"camera": None, "reference": None, "magnetometer": None, "poses": 8})
    data, truth = simulate_cube(scenario, 2)
    config = load_config(cube_config(scenario).encode())
    estimate = solve_batch(problem(data, config))
    plots = _plots((data, config, estimate, findings(data, config, estimate), truth))
    assert "Sphere of the accelerometer" in plots
    assert not [title for title in plots if "agnetometer" in title]
    assert plots["Static poses"].rows[0][-1] == ""
    assert "Used of each: accelerometer, gyro at rest, but" in plots["Static poses"].caption


@pytest.mark.parametrize(
    ("up", "words"),
    [((0, 0, 2.0), "+z"), ((0, -1, 0.02), "-y"), ((-1, 1e-9, 0.5), "-x, 27 deg towards +z"), ((1, 1, -1.1), None)],
)
def test_directions_in_words(up: tuple[float, float, float], words: str | None) -> None:
    assert described(up) == words if words else described(up).startswith("-z, 52 deg towards")
