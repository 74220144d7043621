"""Each method's known null and weak directions are named on a motion that has them, and not on one that has not."""

from __future__ import annotations

from typing import Any

import pytest

from alidade.pipelines.applications.planning import Prediction, predict
from alidade.pipelines.methods.cube.simulation import CubeScenario
from alidade.pipelines.methods.head.simulation import HeadScenario
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, Position
from alidade.pipelines.methods.los.simulation import LosScenario
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from tests.support.builders import IDEAL

_Scenario = LosScenario | HeadScenario | IndexerScenario | CubeScenario

_LOS: dict[str, Any] = {"duration_s": 15, "image_rate_hz": 10, "gyro_rate_hz": 100, "gimbal_rate_hz": 100}
_TWO_AXES = EulerMotion(
    roll=[Swing(amplitude_deg=6, frequency_hz=0.21)], pitch=[Swing(amplitude_deg=5, frequency_hz=0.17)]
)
_SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.3)],
    pitch=[Swing(amplitude_deg=15, frequency_hz=0.4)],
    roll=[Swing(amplitude_deg=10, frequency_hz=0.5)],
)
_MANOEUVRE = EulerMotion(
    yaw=[Swing(amplitude_deg=15, frequency_hz=0.17)],
    pitch=[Swing(amplitude_deg=20, frequency_hz=0.23)],
    roll=[Swing(amplitude_deg=30, frequency_hz=0.11)],
)
_ONE_AXIS = EulerMotion(yaw=[Swing(amplitude_deg=20, frequency_hz=0.3)])
_HEAD: dict[str, Any] = {"duration_s": 15, "vision_rate_hz": 10, "gyro_rate_hz": 100, "platform_gyro_rate_hz": 100}
_FREE_CAMERA: dict[str, float | None] = {f"camera_mount_{axis}": 0.35 for axis in "xyz"}
_INDEXER: dict[str, Any] = {"gyro_rate_hz": 50, "encoder_rate_hz": 50, "record_moves": False}
_OUTER = [Position(axis="outer", other_deg=0.0), Position(axis="outer", other_deg=180.0)]
_CUBE: dict[str, Any] = {"static_s": 1.5, "imu_rate_hz": 50, "camera": {"rate_hz": 2}}


def predicted(scenario: _Scenario) -> Prediction:
    name = type(scenario).__name__.removesuffix("Scenario").lower()
    return predict(name, scenario.model_dump(), None, {})


@pytest.mark.parametrize(
    ("scenario", "verdict", "trade", "advice"),
    [
        (
            LosScenario(**_LOS, carrier=_TWO_AXES, elevation_deg=0),
            "weak",
            {"delta_px", "delta_gx"},
            "sway the carrier in azimuth",
        ),
        (
            LosScenario(**_LOS, priors={"delta_pz": 0.1, "delta_gz": 0.1}),
            "unobservable",
            {"delta_pz", "delta_gz"},
            "cannot be separated",
        ),
        (IndexerScenario(**_INDEXER, positions=_OUTER), "weak", {"theta_x"}, "turns about the inner axis"),
        (
            HeadScenario(**_HEAD, head=_SWAY, priors=_FREE_CAMERA),
            "unobservable",
            {"camera_mount_x"},
            "platform",
        ),
        (HeadScenario(**_HEAD, head=_ONE_AXIS), "unobservable", {"helmet_mount_z"}, "about two axes"),
        (CubeScenario(**_CUBE, poses=2), "unobservable", {"mag_k11"}, "poses"),
    ],
    ids=["los azimuth", "los gauge", "indexer theta_x", "head camera", "head one axis", "cube poses"],
)
def test_a_motion_that_leaves_a_direction_open_is_told_so(
    scenario: _Scenario, verdict: str, trade: set[str], advice: str
) -> None:
    assessment = predicted(scenario)
    assert assessment.status in ("weak", "unobservable")
    blamed = [d for d in assessment.directions if trade <= set(d.evidence["weights"])]
    assert blamed, [d.evidence["weights"] for d in assessment.directions]
    assert verdict in {d.severity.name.lower() for d in blamed}
    assert any(advice in d.evidence["advice"] for d in blamed)


@pytest.mark.parametrize(
    "scenario",
    [
        LosScenario(**_LOS, sensors=IDEAL),
        IndexerScenario(**_INDEXER),
        HeadScenario(**_HEAD, head=_SWAY, platform=_MANOEUVRE),
        pytest.param(CubeScenario(**_CUBE, poses=18), marks=pytest.mark.slow),
    ],
    ids=["los", "indexer", "head", "cube"],
)
def test_a_motion_that_tells_everything_has_no_such_direction(
    scenario: _Scenario,
) -> None:
    assert predicted(scenario).directions == ()
