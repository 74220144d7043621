"""Brief recordings, and problems of a quarter of a minute, of simulated sessions, each made once."""

from __future__ import annotations

from functools import cache
from typing import Any

from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.head import model as head
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.simulation.sensors import EulerMotion, Swing

LOS = LosScenario(duration_s=12.0, image_rate_hz=12.0, gyro_rate_hz=200.0, gimbal_rate_hz=100.0)
SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.05)],
    pitch=[Swing(amplitude_deg=8, frequency_hz=0.11)],
    roll=[Swing(amplitude_deg=12, frequency_hz=0.07)],
)
HEAD = HeadScenario(
    duration_s=15.0, platform=SWAY, helmet_mount_deg=(3.0, -4.0, 2.0), gyro_rate_hz=100.0, vision_rate_hz=10.0
)
# An indexer that turns about either axis at two attitudes of the other, a third of its usual schedule; and with few
# samples, a tenth of the usual time of the processor.
FOUR_POSITIONS: dict[str, Any] = {
    "positions": [
        {"axis": axis, "other_deg": other, "turns": 1.0} for axis in ("outer", "inner") for other in (0.0, 180.0)
    ]
}
COARSE: dict[str, Any] = {"gyro_rate_hz": 50.0, "encoder_rate_hz": 50.0, **FOUR_POSITIONS}


@cache
def los_problem() -> Problem:
    return los.problem(simulate_los(LOS, 3).data, load_config(los_config(LOS).encode()))


@cache
def head_problem() -> Problem:
    return head.problem(simulate_head(HEAD, 3).data, load_config(head_config(HEAD).encode()))
