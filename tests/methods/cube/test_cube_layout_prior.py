"""What cube-layout knows of its tags, as the prior of calibrate."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.applications.session import Session
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Estimate
from alidade.pipelines.files import dump_yaml, load_yaml
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.model import problem
from alidade.pipelines.methods.cube.recording import CubeConfig, CubeData, LayoutCovariance
from alidade.pipelines.methods.cube.simulation import (
    CubeCamera,
    CubeScenario,
    Errors,
    TagCube,
    cube_config,
    simulate_cube,
)
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config, Sensors, TagsSheet
from alidade.pipelines.simulation.scenario import Simulated
from alidade.pipelines.solvers.batch import solve_batch
from tests.support.command import Command

TAGS = [17, 18, 19, 20, 21]


def _scenario(poses: int, tag_mount: float) -> CubeScenario:
    return CubeScenario(
        poses=poses,
        static_s=1.5,
        turn_rad_s=1.6,
        camera=CubeCamera(rate_hz=2.5),
        errors=Errors(tag_mount=tag_mount),
        magnetometer=None,
    )


def _covariance() -> np.ndarray:
    """Of five tags that share most of their error: 3 mrad and 0.5 mm, correlated to 0.8."""
    sigma = np.tile([3e-3, 3e-3, 3e-3, 5e-4, 5e-4, 5e-4], 5)
    correlation = np.kron(0.8 * np.ones((5, 5)) + 0.2 * np.eye(5), np.eye(6))
    return np.asarray(correlation * np.outer(sigma, sigma))


def _known(covariance: np.ndarray) -> LayoutCovariance:
    rows = [" ".join(f"{x:.17g}" for x in row[: i + 1]) for i, row in enumerate(covariance)]
    return LayoutCovariance(tags=TAGS, rows=rows)


def _session(seed: int) -> tuple[CubeData, Config, np.ndarray]:
    """A session whose layout is off by a draw (30,) of its covariance: rotation and position of each tag."""
    scenario = _scenario(16, 0.0)
    data, _ = simulate_cube(scenario, seed)
    config = load_config(cube_config(scenario).encode())
    covariance = _covariance()
    off = np.random.default_rng(seed).multivariate_normal(np.zeros(30), covariance)
    cube = config.section(CubeConfig)
    tags = dict(cube.tags)
    for i, each in zip(TAGS, off.reshape(-1, 6), strict=True):
        turned = so3.multiply(tags[i].rotation, so3.exp(-each[:3]))
        moved = np.array(tags[i].position) - each[3:]
        tags[i] = tags[i].model_copy(update={"rotation": tuple(turned), "position": tuple(moved)})
    known = cube.model_copy(update={"tags": tags, "covariance": _known(covariance)})
    return data, config.model_copy(update={"cube": known}), off


def _tags_of(estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    names = [f"tag_{i}_{number}" for i in TAGS for number in ("x", "y", "z", "px", "py", "pz")]
    rows = [estimate.names.index(name) for name in names]
    return estimate.values[rows], estimate.covariance[np.ix_(rows, rows)]


def test_tags_are_found_within_their_joint_sigmas() -> None:
    squares = []
    for seed in range(2):
        data, config, off = _session(seed)
        estimate = solve_batch(problem(data, config))
        found, covariance = _tags_of(estimate)
        error = found - off
        squares.append(float(error @ np.linalg.solve(covariance, error)) / len(error))
        # The recording adds to what the layout knew.
        assert np.trace(covariance) < 0.9 * np.trace(_covariance())
    assert 0.6 < np.mean(squares) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-4, 2e-3])
def test_tags_beside_where_the_drawing_has_them(size: float) -> None:
    """A tenth of a millimetre is within what a print is glued to; of two the tag is named. K is right in both.

    With exact positions K is 12 sigmas off at a tenth of a millimetre.
    """
    off = {"tag_18_px": size, "tag_19_py": -size, "tag_21_pz": 0.7 * size}
    scenario = _scenario(16, 3e-3).model_copy(update={"effects": off})
    data, truth = simulate_cube(scenario, 2)
    simulated = Simulated(data, truth, cube_config(scenario))
    found = Session.of(method("cube"), simulated).calibrate(report=False)
    errors = {n: (p.value - truth[n]) / p.sigma for n, p in found.parameters.items() if n in truth and p.sigma > 0.0}
    assert max(map(abs, errors.values())) < 4.0
    assert found.parameters["tag_18_px"].sigma < 1.2e-4  # the drawing: 0.39 mm
    assert found.status == ("inconsistent" if size > 5e-4 else "calibrated")
    if size > 5e-4:
        assert "contradicts its data sheet" in found.headline
        assert any(tag in found.headline for tag in off)


def _errors(found: Calibration, truth: Mapping[str, float]) -> float:
    """The largest of a calibration's K and offsets, in sigmas."""
    return max(
        abs(p.value - truth[n]) / p.sigma
        for n, p in found.parameters.items()
        if n.startswith(("accel_", "gyro_")) and n in truth and p.sigma > 0.0
    )


@pytest.mark.parametrize("rotation", [pytest.param(None, marks=pytest.mark.slow), 2e-2])
def test_all_tags_turned_on_their_drawing(rotation: float | None) -> None:
    """A degree of tilt each, that of the lowest id too, which defines the body: K is right, stated or not.

    With priors of each tag by itself K is 27 sigmas off.
    """
    scenario, cube = _scenario(16, 0.0), method("cube")
    data, truth = simulate_cube(scenario, 2)
    given = load_yaml(cube_config(scenario), "config")
    rng, tags = np.random.default_rng([2, 5]), given["cube"]["tags"]
    drawn = {i: so3.multiply(tag["rotation"], so3.exp(np.deg2rad(rng.standard_normal(3)))) for i, tag in tags.items()}
    # The drawing in the frame of the lowest id.
    turned, centre = so3.multiply(tags[16]["rotation"], so3.inverse(drawn[16])), np.array(tags[16]["position"])
    for i, tag in tags.items():
        place = so3.rotate(turned, np.array(tag["position"]) - centre) + centre
        tag |= {"rotation": so3.multiply(turned, drawn[i]).tolist(), "position": place.tolist()}
    sheet = {} if rotation is None else {"sensors": {"tags": {"rotation": rotation}}}
    found = Session.of(cube, Simulated(data, truth, dump_yaml(given | sheet))).calibrate(report=False)
    assert found.status == ("inconsistent" if rotation is None else "calibrated")
    assert _errors(found, truth) < 4.0


def test_positions_are_exact_where_the_data_sheet_says_so() -> None:
    data, config, _ = _session(0)
    exact = config.model_copy(
        update={
            "cube": config.section(CubeConfig).model_copy(update={"covariance": None}),
            "sensors": Sensors(tags=TagsSheet(position=0.0)),
        }
    )
    sigmas = {q.name: q.prior_sigma for q in problem(data, exact).quantities}
    assert {sigmas[f"tag_{tag}_p{axis}"] for tag in TAGS for axis in "xyz"} == {0.0}


def test_a_prior_given_by_hand_goes_before_the_layouts() -> None:
    data, config, _ = _session(0)
    by_hand = config.model_copy(update={"priors": {"tag_18_px": 2e-5, "tag_19_z": 0.0}})
    sigmas = {q.name: q.prior_sigma for q in problem(data, by_hand).quantities}
    assert sigmas["tag_18_px"] == 2e-5
    assert sigmas["tag_19_z"] == 0.0
    assert sigmas["tag_18_py"] == pytest.approx(5e-4)
    assert sigmas["tag_18_x"] == pytest.approx(3e-3)
    assert sigmas["tag_16_px"] == 0.0


@pytest.mark.parametrize(
    ("rows", "says"),
    [(["1", "0 1"], "need 6 rows"), (["1", "0 x", *["0"] * 4], "no number"), (["1", "0", *["0"] * 4], "has 2 numbers")],
)
def test_a_covariance_that_is_none_is_refused(tmp_path: Path, rows: list[str], says: str) -> None:
    text = ", ".join(f"'{row}'" for row in rows)
    (tmp_path / "c.yaml").write_text(f"cube: {{covariance: {{tags: [17], rows: [{text}]}}}}\n")
    with pytest.raises(InputError, match=says):
        load_config(None, tmp_path / "c.yaml")


def test_a_covariance_that_no_numbers_can_have_is_refused(tmp_path: Path) -> None:
    rows = ["1e-6", "2e-6 1e-6", *(" ".join([*["0"] * k, "1e-6"]) for k in range(2, 6))]
    text = ", ".join(f"'{row}'" for row in rows)
    (tmp_path / "c.yaml").write_text(f"cube: {{covariance: {{tags: [17], rows: [{text}]}}}}\n")
    with pytest.raises(InputError, match="negative variance"):
        load_config(None, tmp_path / "c.yaml")


@pytest.mark.slow
def test_a_layout_of_one_recording_serves_another(alidade: Command, tmp_path: Path) -> None:
    """Tags glued on by hand, a camera not as it says: refused as given, calibrated with what other pictures told."""
    off = {"camera_focal": 8e-3, "camera_centre_x": 4.0}
    for name, poses in (("turned", 20), ("still", 16)):
        scenario = _scenario(poses, 0.02).model_copy(update={"cube": TagCube(), "effects": off})
        data, truth = simulate_cube(scenario, 3)
        method("cube").write_data(tmp_path / f"{name}.mcap", data, truth, cube_config(scenario))
    assert (
        alidade("cube-layout", tmp_path / "turned.mcap", "--out", tmp_path / "cube.yaml", "--refine-camera").code == 0
    )
    as_given = alidade("calibrate", tmp_path / "still.mcap", "--out", tmp_path / "a")
    assert as_given.code == 4
    run = alidade("calibrate", tmp_path / "still.mcap", "--config", tmp_path / "cube.yaml", "--out", tmp_path / "b")
    assert run.code in (0, 3), run.out
    assert "the covariance of the tags' layout" in run.out
    parameters = json.loads((tmp_path / "b" / "result.json").read_text())["parameters"]
    found = {each["name"]: each for each in parameters}
    camera = load_config(None, tmp_path / "cube.yaml").section(CubeConfig).camera
    assert camera is not None
    # What is calibrated is what the layout's camera is off by yet.
    focal = found["camera_focal"]
    assert focal["sigma"] < 3e-3
    assert abs(camera.focal[0] * (1.0 + focal["value"]) / (1150.0 * 1.008) - 1.0) < 4.0 * focal["sigma"]
    centre = found["camera_centre_x"]
    assert abs(camera.centre[0] + centre["value"] - 645.3) < 4.0 * centre["sigma"]


def test_a_camera_of_another_recording_is_refused(alidade: Command, tmp_path: Path) -> None:
    scenario = _scenario(4, 0.0)
    data, truth = simulate_cube(scenario, 0)
    method("cube").write_data(tmp_path / "s.mcap", data, truth, cube_config(scenario))
    for text, says in (
        ("focal: [600, 600], centre: [640, 480], distortion: [0, 0, 0, 0, 0]", "its focal length is 600 px"),
        ("focal: [1150, 1150], centre: [640, 480], distortion: [0, 0, 0, 0]", "it has 4 coefficients of distortion"),
    ):
        (tmp_path / "c.yaml").write_text(f"cube: {{camera: {{{text}}}}}\n")
        run = alidade("calibrate", tmp_path / "s.mcap", "--config", tmp_path / "c.yaml")
        assert run.code == 2
        assert says in run.err.replace("\n", " ")
