"""Calibrations made by hand, for the tests of what is reported of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from alidade.factors import so3
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.diagnostics.observability import finite_covariance
from alidade.pipelines.estimation.problem import (
    Attitudes,
    ChiSquare,
    Estimate,
    History,
    Parameter,
    Problem,
    Quantity,
    Residuals,
    Step,
    rotation_vector_coordinates,
)
from alidade.pipelines.methods import method
from alidade.pipelines.recording.topics import SessionFacts, TopicFacts
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.sensors import EulerMotion, Swing

# Data sheets of sensors without errors.
IDEAL = Config.model_validate({"sensors": "ideal"}).sensors
# Sway of a carrier, swift enough for a short recording.
BRISK = EulerMotion(
    roll=[Swing(amplitude_deg=6, frequency_hz=0.31)],
    pitch=[Swing(amplitude_deg=5, frequency_hz=0.27)],
    yaw=[Swing(amplitude_deg=6, frequency_hz=0.23)],
)
EPOCH_NS = 1_795_176_000_123_456_789
MOUNT = np.array([0.03, -0.02, 0.5])
NAMES = ("helmet_mount_x", "helmet_mount_y", "helmet_mount_z", "time_offset", "free", "pinned")


def no_steps(_: int) -> Iterator[Step]:
    return iter(())


def make_problem() -> Problem:
    mount = tuple(Quantity(name, "rad", 0.35, 0.35, 1e-2) for name in NAMES[:3])
    others = (
        Quantity("time_offset", "s", 0.05, 0.05, 5e-3),
        Quantity("free", "rad/s", None, 0.05, 2e-3),
        Quantity("pinned", "rad", 0.0, 0.35, 1e-2),
    )
    parameters = (
        Parameter(1, mount, rotation_vector_coordinates),
        *(Parameter(2 + i, (q,)) for i, q in enumerate(others)),
    )
    return Problem("head", parameters, no_steps, dropped={"/vision/attitude: not finite": 3})


def make_calibration(**changes: object) -> Calibration:
    rng = np.random.default_rng(0)
    sigmas = np.array([1e-3, 1e-3, 2e-3, 2e-4, 1e-4, 0.0])
    values = np.array([*MOUNT, 0.012, 5e-5, 0.0])
    time = np.linspace(0.0, 9.5, 200)
    used = np.arange(200) % 50 != 7
    estimate = Estimate(
        solver="incremental",
        names=NAMES,
        values=values,
        covariance=np.diag(sigmas**2),
        converged=True,
        message="all steps taken",
        residuals={"vision": Residuals(time, rng.standard_normal((200, 3)) + 9.0 * ~used[:, None], used)},
        chi_square=ChiSquare(570.0, 588.0, {"vision": (570.0, 588.0)}),
        history=History(time[::10], np.tile(values, (20, 1)), np.tile(sigmas, (20, 1))),
        attitudes=Attitudes(time, so3.exp(rng.standard_normal((200, 3)))),
        rejected={"vision": 4},
        seconds={"solve": 1.5},
    )
    estimate = replace(estimate, **{k: v for k, v in changes.items() if hasattr(estimate, k)})  # type: ignore[arg-type]
    problem = make_problem()
    quantities = tuple(q for q in problem.quantities if q.name in estimate.names)
    estimate = replace(estimate, covariance=finite_covariance(quantities, estimate.covariance))
    calibration = Calibration(
        method=method("head"),
        problem=problem,
        estimate=estimate,
        findings=diagnose(estimate, quantities),
        recording="ride.mcap",
        sha256="ab" * 32,
        facts=SessionFacts(
            EPOCH_NS,
            9.5,
            (),
            (TopicFacts("/head/imu", "sensor_msgs/msg/Imu", 3800, 0.0, 9.5, 400.0, 0.0025, 0.1, 0, 0),),
            {},
        ),
        config=Config(method="head"),
        seconds={"read": 0.2},
    )
    return replace(calibration, **{k: v for k, v in changes.items() if not hasattr(estimate, k)})  # type: ignore[arg-type]
