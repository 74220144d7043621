"""Topics by the keys they have in the config, and what a method needs of a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from alidade.pipelines.recording import messages

if TYPE_CHECKING:
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.settings import Config


@dataclass(frozen=True)
class Topic:
    """A topic of the contract: its key in the config, its default name and the message types it may have."""

    key: str
    name: str
    types: tuple[str, ...]


@dataclass(frozen=True)
class Setting:
    """A key of the config that replaces a topic: how to ask for it, and whether a config has it."""

    phrase: str
    given: Callable[[Config], bool]


# One thing a method cannot do without: all topics and settings of at least one group.
Need = Sequence[Sequence[Topic | Setting]]

# Topics that several methods read.
IMU = Topic("imu", "/imu", (messages.IMU,))
MAG = Topic("mag", "/mag", (messages.MAGNETIC_FIELD,))
FIX = Topic("fix", "/fix", (messages.NAV_SAT_FIX,))
TEMPERATURE = Topic("temperature", "/temperature", (messages.TEMPERATURE,))
IMAGE = Topic("image", "/camera/image/compressed", messages.PICTURES)
CAMERA_INFO = Topic("camera_info", "/camera/camera_info", (messages.CAMERA_INFO,))


def wanted(recording: Recording, config: Config, topic: Topic) -> bool:
    """Whether an optional topic is there with messages in it, or the config asks for it by name."""
    found = recording.topics.get(config.topic(topic))
    return bool(found and found.count) or topic.key in config.topics
