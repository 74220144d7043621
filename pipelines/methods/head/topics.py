"""What the head method reads, and its section of the config."""

from __future__ import annotations

from typing import ClassVar

from alidade.pipelines.recording import messages
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, TEMPERATURE, Need, Setting, Topic
from alidade.pipelines.settings import Board, MethodSection

HEAD_IMU = Topic("head_imu", "/head/imu", messages.RATES)
PLATFORM_IMU = Topic("platform_imu", "/platform/imu", messages.RATES)
VISION_ATTITUDE = Topic("vision_attitude", "/vision/attitude", messages.ATTITUDES)
TRUTH_ATTITUDE = Topic("truth_attitude", "/truth/attitude", messages.ATTITUDES)


class HeadConfig(MethodSection):
    """The helmet."""

    key: ClassVar[str] = "head"

    board: Board | None = None  # tags on the helmet


TOPICS = (HEAD_IMU, PLATFORM_IMU, VISION_ATTITUDE, TRUTH_ATTITUDE, IMAGE, CAMERA_INFO, TEMPERATURE)
_BOARD = Setting("head.board in the config", lambda config: config.section(HeadConfig).board is not None)
NEEDS: tuple[Need, ...] = (((HEAD_IMU,),), ((VISION_ATTITUDE,), (IMAGE, CAMERA_INFO, _BOARD)))
