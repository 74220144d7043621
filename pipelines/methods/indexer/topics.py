"""What the indexer method reads, and its section of the config."""

from __future__ import annotations

from typing import ClassVar

from alidade.pipelines.recording import messages
from alidade.pipelines.recording.topics import FIX, IMU, TEMPERATURE, Need, Setting, Topic
from alidade.pipelines.settings import MethodSection, Quaternion

INDEXER = Topic("indexer", "/indexer/joint_states", (messages.JOINT_STATE,))

# The axes, as the messages name them.
JOINTS = ("outer_x", "inner_z")

TOPICS = (IMU, INDEXER, FIX, TEMPERATURE)
_LATITUDE = Setting("latitude_deg in the config", lambda config: config.latitude_deg is not None)
NEEDS: tuple[Need, ...] = (((IMU,),), ((INDEXER,),), ((FIX,), (_LATITUDE,)))


class IndexerConfig(MethodSection):
    """The indexer."""

    key: ClassVar[str] = "indexer"

    base_attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)  # nRbase: w, x, y, z
