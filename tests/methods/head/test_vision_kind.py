"""The kind of vision: what it fixes, what a wrong one is told, and what `info` proposes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import alidade
from alidade.factors import so3
from alidade.pipelines.applications.cli import app
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.model import problem
from alidade.pipelines.methods.head.recording import HeadData, white_angle
from alidade.pipelines.methods.head.simulation import HeadScenario, simulate_head

KINDS = ("mocap", "pnp", "vio", "other")


def made(rate_hz: float = 25.0, sigma: float = 8.7e-3) -> HeadData:
    """Attitudes without covariances."""
    scenario = {"duration_s": 12, "gyro_rate_hz": 200, "vision_rate_hz": rate_hz, "noise": {"vision_attitude": sigma}}
    return replace(simulate_head(HeadScenario.model_validate(scenario), 1).data, vision_cov=None)


def scale_prior(config: str) -> float | None:
    found = {q.name: q.prior_sigma for q in problem(made(), load_config(config.encode())).quantities}
    return found["vision_scale"]


def test_motion_capture_has_no_scale_unless_the_config_says_so() -> None:
    usual = scale_prior("{}")
    assert usual
    assert [scale_prior(f"vision: {{kind: {kind}}}") for kind in KINDS] == [0.0, usual, usual, usual]
    assert scale_prior("{vision: {kind: mocap}, sensors: {camera: {scale: 1.0e-3}}}") == 1e-3
    assert scale_prior("{vision: {kind: mocap}, priors: {vision_scale: 2.0e-3}}") == 2e-3


def test_other_kinds_are_refused_with_the_choices() -> None:
    with pytest.raises(InputError, match=r"vision\.kind: must be 'mocap', 'pnp', 'vio' or 'other', not 'vicon'$"):
        load_config(b"vision: {kind: vicon}")


def test_a_method_without_vision_refuses_it() -> None:
    simulated = alidade.simulate("indexer", seed=1)
    with pytest.raises(InputError, match="vision: method indexer has no use for it"):
        alidade.open(simulated, config=load_config(b"vision: {kind: mocap}")).problem()


def proposed(path: Path, config: str = "") -> list[str]:
    config_file = path.with_suffix(".yaml")
    config_file.write_text(config)
    run = CliRunner().invoke(app, ["info", str(path), "--json", "--config", str(config_file), "--quiet"])
    assert run.exit_code == 0, run.output
    found: list[str] = json.loads(run.output)["methods"]["head"]["proposed"]
    return found


@pytest.mark.parametrize(
    ("rate_hz", "sigma", "kind"),
    [(120.0, 8.7e-3, "mocap"), (25.0, 2e-4, "mocap"), (25.0, 8.7e-3, None)],
    ids=["fast", "quiet", "neither"],
)
def test_info_proposes_motion_capture_by_rate_or_noise(
    rate_hz: float, sigma: float, kind: str | None, tmp_path: Path
) -> None:
    method("head").write_data(tmp_path / "s.mcap", made(rate_hz, sigma))
    said = proposed(tmp_path / "s.mcap")
    assert len(said) == (kind is not None)
    if kind:
        assert said[0].startswith(f"vision: {{kind: {kind}}} ({rate_hz:g} attitudes/s on /vision/attitude, noise")
        shown = CliRunner().invoke(app, ["info", str(tmp_path / "s.mcap")]).output
        assert f"proposed for the config: vision: {{kind: {kind}}}" in shown
        # Proposed, not taken; a note of `calibrate` names the key; and not proposed to who has said what it is.
        session = alidade.open(tmp_path / "s.mcap")
        assert not session.config.model_fields_set & {"vision"}
        assert session.recording is not None
        assert session.recording.notes == ("proposed for the config, not assumed: vision: {kind: mocap}",)
        stated = alidade.open(tmp_path / "s.mcap", config=load_config(b"vision: {kind: other}"))
        assert stated.recording is not None
        assert not stated.recording.notes
        assert proposed(tmp_path / "s.mcap", "vision: {kind: other}") == []


def test_the_noise_of_attitudes_that_turn() -> None:
    """As it is where they rest, hardly more where they turn slowly, and infinite where there are too few."""
    t = np.arange(0.0, 20.0, 0.01)
    noise = so3.exp(1e-3 * np.random.default_rng(1).standard_normal((len(t), 3)))
    turning = so3.exp(np.outer(np.sin(t), [0.3, 0.2, 0.1]))
    assert white_angle(noise) == pytest.approx(1e-3, rel=0.3)
    assert white_angle(so3.multiply(turning, noise)) == pytest.approx(white_angle(noise), rel=0.05)
    assert white_angle(noise[:9]) == np.inf
