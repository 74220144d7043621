"""Guidance of the head method: motion while recording and of a plan, faults of the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from alidade.factors import so3
from alidade.pipelines.diagnostics.checklist import ChecklistItem, swayed, turned
from alidade.pipelines.diagnostics.fault_models import DataFault, FaultModel
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.methods import Guidance, Scenario
from alidade.pipelines.methods.head.recording import VISION_ATTITUDE, HeadData
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import sways

# Turns of a head and of the platform it sits in count from these angles on, rad.
_NOD, _MANOEUVRE = np.deg2rad(10.0), np.deg2rad(5.0)


def checklist(data: HeadData, _: Config) -> Sequence[ChecklistItem]:
    """Checklist of motion of the head and, if present, of the platform."""
    found = [ChecklistItem("vision", f"{1.0 / np.median(np.diff(data.vision_t)):.3g} attitudes/s")]
    found += swayed("head", turned(data.head_t, data.head_gyro), _NOD, "turn the head about its", "helmet")
    if data.platform_t is not None and data.platform_gyro is not None:
        platform = turned(data.platform_t, data.platform_gyro)
        found += swayed("platform", platform, _MANOEUVRE, "turn the platform about its", "platform")
    return found


# The sway added.
_SWAY = {"amplitude_deg": 20.0, "frequency_hz": 0.29}


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """Yield changes of a scenario worth trying: a phrase, and the changed scenario."""
    for key in ("head", "platform"):
        yield from sways(scenario, key, f"the {key}", _SWAY)


# Random walk of a platform's rate that acts as a bias, rad/s/sqrt(s): an aircraft's manoeuvres.
_MANOEUVRES = 0.3


def _inverted(data: HeadData, config: Config) -> tuple[HeadData, Config]:
    """Invert vision attitudes hRc to cRh, with rotated covariances."""
    covariance = data.vision_cov
    if covariance is not None:
        R = so3.matrix(data.vision_wxyz)
        covariance = R @ covariance @ np.swapaxes(R, 1, 2)
    return replace(data, vision_wxyz=so3.inverse(data.vision_wxyz), vision_cov=covariance), config


def _reordered(data: HeadData, config: Config, order: tuple[int, ...]) -> tuple[HeadData, Config]:
    """Permute the components of vision's quaternions, without their covariances."""
    return replace(data, vision_wxyz=data.vision_wxyz[:, order], vision_cov=None), config


def _misordered(data: HeadData, config: Config, order: tuple[int, ...]) -> tuple[HeadData, Config] | None:
    """Undo the config's `invert` and permute the quaternion components; None without `invert`."""
    source = config.topics.get(VISION_ATTITUDE.key)
    return _reordered(*_inverted(data, config), order) if source is not None and source.invert else None


def _swapped(data: HeadData, config: Config) -> tuple[HeadData, Config] | None:
    """Exchange the helmet's and the platform's gyro; None without a platform gyro."""
    if data.platform_t is None or data.platform_gyro is None:
        return None
    swapped = replace(
        data,
        head_t=data.platform_t,
        head_gyro=data.platform_gyro,
        gyro_density=data.platform_gyro_density,
        head_force=None,
        temperature=None,
        platform_t=data.head_t,
        platform_gyro=data.head_gyro,
        platform_gyro_density=data.gyro_density,
    )
    return swapped, config


def _moving(data: HeadData, config: Config) -> tuple[HeadData, Config] | None:
    """Let the gyro bias walk fast enough to follow an unmeasured platform rate; None with a platform gyro."""
    if data.platform_t is not None:
        return None
    noise = config.noise.model_copy(update={"gyro_bias_walk": _MANOEUVRES})
    return data, config.model_copy(update={"noise": noise})


FAULTS = FaultModel(
    streams={
        "head_t": ("head_gyro", "head_force"),
        "platform_t": ("platform_gyro",),
        "vision_t": ("vision_wxyz", "vision_cov"),
        "truth_t": ("truth_wxyz",),
    },
    signs={"head_gyro": ("helmet gyro", AXES), "platform_gyro": ("platform gyro", AXES)},
    faults=(
        DataFault(
            "the attitudes of vision are inverted: they map the camera's frame to the markers', not back", _inverted
        ),
        DataFault(
            "the quaternions of vision are given as x, y, z, w where w, x, y, z is meant",
            partial(_reordered, order=(3, 0, 1, 2)),
        ),
        DataFault(
            "the quaternions of vision are given as w, x, y, z where x, y, z, w is meant",
            partial(_reordered, order=(1, 2, 3, 0)),
        ),
        *(
            DataFault(
                f"vision is not inverted as the config states: its quaternions are {one} where {other} is meant, which "
                "fits as well and has the mount nearer to its prior",
                partial(_misordered, order=order),
                role="stated",
            )
            for one, other, order in (
                ("x, y, z, w", "w, x, y, z", (3, 0, 1, 2)),
                ("w, x, y, z", "x, y, z, w", (1, 2, 3, 0)),
            )
        ),
        DataFault("the topics of helmet and platform IMU are swapped", _swapped),
        DataFault("the platform moves, and no topic measures it: record /platform/imu", _moving, role="fallback"),
    ),
)

GUIDANCE = Guidance(checklist=checklist, variations=candidates)
