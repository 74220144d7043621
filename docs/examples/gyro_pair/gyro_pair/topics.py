"""What the gyro_pair method reads, and its section of the config."""

from __future__ import annotations

from typing import ClassVar

from alidade.pipelines.recording import messages
from alidade.pipelines.recording.topics import Need, Topic
from alidade.pipelines.settings import MethodSection, Sigma

GYRO_A = Topic("gyro_a", "/gyro_a/imu", messages.RATES)
GYRO_B = Topic("gyro_b", "/gyro_b/imu", messages.RATES)

TOPICS = (GYRO_A, GYRO_B)
NEEDS: tuple[Need, ...] = (((GYRO_A,),), ((GYRO_B,),))


class GyroPairConfig(MethodSection):
    """The second gyro's noise, rad/s/sqrt(Hz); `noise.gyro_density` is the first one's."""

    key: ClassVar[str] = "gyro_pair"

    gyro_b_density: Sigma | None = None
