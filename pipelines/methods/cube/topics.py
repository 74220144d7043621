"""What the cube method reads, and its section of the config."""

from __future__ import annotations

import datetime
from typing import ClassVar

from pipelines.recording import messages
from pipelines.recording.topics import CAMERA_INFO, IMAGE, IMU, MAG, Need, Setting, Topic
from pipelines.settings import Board, Config, Date, MethodSection, Quaternion, Section, Sigma

REFERENCE_FIX = Topic("reference_fix", "/reference/fix", (messages.NAV_SAT_FIX,))
REFERENCE_IMU = Topic("reference_imu", "/reference/imu", (messages.IMU,))
TAG_DETECTIONS = Topic("tag_detections", "/tag_detections", (messages.TAG_DETECTIONS,))


class RawConversion(Section):
    """Nominal conversion of counts: (raw - offset) * scale."""

    scale: Sigma
    offset: float = 0.0


class Raw(Section):
    """Conversions of the sensors that record counts."""

    accel: RawConversion | None = None
    gyro: RawConversion | None = None
    mag: RawConversion | None = None


class CubeConfig(Board, MethodSection):
    """The cube: its tags, the camera on the reference (BRC: w, x, y, z), counts, the date for the field model."""

    key: ClassVar[str] = "cube"

    camera_rotation: Quaternion | None = None
    raw: Raw = Raw()
    date: Date | None = None


def field_date(config: Config) -> datetime.date | None:
    """Date for the field model, at the top or under `cube`."""
    return config.date or config.section(CubeConfig).date


TOPICS = (IMU, MAG, REFERENCE_FIX, REFERENCE_IMU, TAG_DETECTIONS, IMAGE, CAMERA_INFO)
_TAGS = Setting("cube.tags in the config", lambda config: bool(config.section(CubeConfig).tags))
_METHOD = Setting("`method: cube` in the config", lambda config: config.method == "cube")
NEEDS: tuple[Need, ...] = (
    ((IMU,),),
    # Pictures alone could be of anything. Without camera the turns between poses and gravity serve; the config has to
    # say that this is meant.
    ((TAG_DETECTIONS, CAMERA_INFO), (IMAGE, CAMERA_INFO, REFERENCE_IMU), (IMAGE, CAMERA_INFO, _TAGS), (_METHOD,)),
)
