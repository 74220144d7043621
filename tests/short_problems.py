"""Problems of half a minute, of simulated sessions."""

from __future__ import annotations

from pipelines.config import load_config
from pipelines.graph.problem import Problem
from pipelines.methods.head import graph as head
from pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from pipelines.methods.los import graph as los
from pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from pipelines.simulation.motion import EulerMotion, Swing

LOS = LosScenario(duration_s=30.0, image_rate_hz=20.0, gyro_rate_hz=200.0, gimbal_rate_hz=100.0)
SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.05)],
    pitch=[Swing(amplitude_deg=8, frequency_hz=0.11)],
    roll=[Swing(amplitude_deg=12, frequency_hz=0.07)],
)
HEAD = HeadScenario(
    duration_s=30.0, platform=SWAY, helmet_mount_deg=(3.0, -4.0, 2.0), gyro_rate_hz=100.0, vision_rate_hz=20.0
)


def los_problem() -> Problem:
    return los.problem(simulate_los(LOS, 3)[0], load_config(los_config(LOS).encode()))


def head_problem() -> Problem:
    return head.problem(simulate_head(HEAD, 3)[0], load_config(head_config(HEAD).encode()))
