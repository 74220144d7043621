"""The layout of a cube's tags from what a camera sees, against the simulator's truth and TagSLAM's block."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.recording import CubeConfig
from alidade.pipelines.methods.cube.simulation import (
    CubeCamera,
    CubeScenario,
    Errors,
    TagCube,
    cube_config,
    simulate_cube,
)
from alidade.pipelines.methods.cube.tags import cube_layout, layout_yaml
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.vision.layout import Layout
from tests.support.browser import fits
from tests.support.command import Command
from tests.support.pages import Page

SCENARIO = CubeScenario(
    poses=16,
    static_s=1.0,
    turn_rad_s=1.5,
    camera=CubeCamera(rate_hz=2.0),
    errors=Errors(tag_mount=0.02),
    magnetometer=None,
)
HIDDEN = SCENARIO.model_copy(update={"cube": TagCube(hidden=(19,))})
# Corners enough to tell their own noise.
DENSE = SCENARIO.model_copy(update={"camera": CubeCamera(rate_hz=4.0)})


def _session(path: Path, seed: int, scenario: CubeScenario = SCENARIO) -> dict[str, float]:
    data, truth = simulate_cube(scenario, seed)
    method("cube").write_data(path, data, truth, cube_config(scenario))
    return truth


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in which one tag is in no picture."""
    path = tmp_path_factory.mktemp("hidden") / "5.mcap"
    _session(path, 5, HIDDEN)
    return path


@pytest.fixture(scope="module")
def layout(hidden: Path) -> Layout:
    """What that recording tells."""
    recording = open_recording(hidden)
    return cube_layout([(recording, load_config(recording.attachment("alidade.yaml")))])


@pytest.mark.slow
def test_tags_are_found_where_they_are_with_honest_sigmas(tmp_path: Path) -> None:
    squares = []
    for seed in range(2):
        truth = _session(tmp_path / "s.mcap", seed, DENSE)
        recording = open_recording(tmp_path / "s.mcap")
        config = load_config(recording.attachment("alidade.yaml"))
        layout = cube_layout([(recording, config)])
        assert layout.body.ids.tolist() == sorted(config.section(CubeConfig).tags)
        assert layout.sigma_px == pytest.approx(DENSE.noise.corner_px, rel=0.1)
        error = []
        for k, tag in enumerate(layout.body.ids.tolist()):
            given = config.section(CubeConfig).tags[tag]
            true = so3.multiply(given.rotation, so3.exp([truth[f"tag_{tag}_{axis}"] for axis in "xyz"]))
            delta = so3.log(so3.multiply(so3.inverse(true), layout.body.bRt[k]))
            error.append(np.concatenate([delta, layout.body.position[k] - given.position]))
        np.testing.assert_allclose(error[0], 0.0, atol=1e-12)
        off = np.concatenate(error[1:])
        squares.append(float(off @ np.linalg.solve(layout.covariance, off)) / len(off))
        assert np.abs(off.reshape(-1, 6)[:, :3]).max() < 5e-3
        assert np.abs(off.reshape(-1, 6)[:, 3:]).max() < 5e-4
    assert 0.6 < np.mean(squares) < 1.5


def test_layout_as_a_config_reads_back(layout: Layout, tmp_path: Path) -> None:
    (tmp_path / "cube.yaml").write_text(layout_yaml(layout))
    config = load_config(None, tmp_path / "cube.yaml")
    for k, tag in enumerate(layout.body.ids.tolist()):
        np.testing.assert_allclose(config.section(CubeConfig).tags[tag].position, layout.body.position[k], rtol=1e-12)
        np.testing.assert_allclose(config.section(CubeConfig).tags[tag].rotation, layout.body.bRt[k], rtol=1e-9)


def test_a_tag_never_seen_is_not_placed(layout: Layout) -> None:
    assert layout.unplaced == {19: "in no picture"}
    assert "tag 19 could not be placed: in no picture" in layout_yaml(layout)


def test_one_tag_alone_places_nothing(tmp_path: Path) -> None:
    data, _ = simulate_cube(SCENARIO, 6)
    assert data.sightings is not None
    one = data.sightings.ids == 16
    seen = data.sightings
    data = replace(data, sightings=replace(seen, frame=seen.frame[one], ids=seen.ids[one], corners=seen.corners[one]))
    method("cube").write_data(tmp_path / "s.mcap", data, None, cube_config(SCENARIO))
    recording = open_recording(tmp_path / "s.mcap")
    with pytest.raises(InputError, match="no picture shows tag 16 together with another tag"):
        cube_layout([(recording, load_config(recording.attachment("alidade.yaml")))])


def test_the_command_says_what_was_found(hidden: Path, alidade: Command, tmp_path: Path) -> None:
    out = tmp_path / "cube.yaml"
    other = tmp_path / "other.mcap"
    method("cube").write_data(other, simulate_cube(HIDDEN, 5).data, None, cube_config(HIDDEN))
    run = alidade("cube-layout", hidden, other, "--out", out, "--refine-camera")
    assert run.code == 0
    assert "5 of 6 tags placed" in run.out
    assert "Tag 19 could not be placed: in no picture" in run.out
    assert "fx, px" in run.out
    page = Page((tmp_path / "cube.html").read_text())
    fits((tmp_path / "cube.html").read_text(), tmp_path)
    assert not page.loaded
    assert "5 of 6 tags placed" in page.text
    assert "Tag 19: in no picture." in page.text
    assert "distortion 1" in page.text


def test_a_recording_named_twice_is_refused(hidden: Path, alidade: Command, tmp_path: Path) -> None:
    (tmp_path / "copy.mcap").symlink_to(hidden)
    run = alidade("cube-layout", hidden, tmp_path / "copy.mcap", "--out", tmp_path / "cube.yaml")
    assert (run.code, run.err) == (
        2,
        "alidade: copy.mcap: the same recording is named twice; it would count twice\n",
    )


def test_the_page_takes_no_name_from_the_config(hidden: Path, alidade: Command, tmp_path: Path) -> None:
    run = alidade("cube-layout", hidden, "--out", tmp_path / "cube.html")
    assert run.code == 2
    assert "call it .yaml" in run.err
    assert not (tmp_path / "cube.html").exists()


def test_with_json_it_prints_the_tags_and_nothing_else(hidden: Path, alidade: Command, tmp_path: Path) -> None:
    run = alidade("cube-layout", hidden, "--out", tmp_path / "cube.yaml", "--json")
    found = json.loads(run.out)
    assert [tag["id"] for tag in found["tags"]] == [16, 17, 18, 20, 21]
    assert found["unplaced"] == {"19": "in no picture"}
    config = load_config(None, tmp_path / "cube.yaml").section(CubeConfig)
    assert tuple(found["tags"][1]["position"]) == pytest.approx(config.tags[17].position)
    assert found["tags"][0]["position_sigma"] == [0.0] * 3 < found["tags"][1]["position_sigma"]
