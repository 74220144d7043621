"""Which topics a method reads, by the keys they have in the config."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipelines.recording import messages

METHODS = ("los", "indexer", "head", "cube")


@dataclass(frozen=True)
class Topic:
    """A topic of the contract: its default name and the message types it may have."""

    name: str
    types: tuple[str, ...]


# Key in the config -> topic.
TOPICS = {
    "imu": Topic("/imu", (messages.IMU,)),
    "mag": Topic("/mag", (messages.MAGNETIC_FIELD,)),
    "gimbal": Topic("/gimbal/joint_states", (messages.JOINT_STATE,)),
    "los_error": Topic("/los/error", (messages.VECTOR,)),
    "indexer": Topic("/indexer/joint_states", (messages.JOINT_STATE,)),
    "fix": Topic("/fix", (messages.NAV_SAT_FIX,)),
    "head_imu": Topic("/head/imu", (messages.IMU,)),
    "platform_imu": Topic("/platform/imu", (messages.IMU,)),
    "vision_attitude": Topic("/vision/attitude", (messages.POSE, messages.QUATERNION)),
    "truth_attitude": Topic("/truth/attitude", (messages.QUATERNION,)),
    "reference_fix": Topic("/reference/fix", (messages.NAV_SAT_FIX,)),
    "reference_imu": Topic("/reference/imu", (messages.IMU,)),
    "tag_detections": Topic("/tag_detections", (messages.TAG_DETECTIONS,)),
    "image": Topic("/camera/image/compressed", (messages.COMPRESSED_IMAGE,)),
    "camera_info": Topic("/camera/camera_info", (messages.CAMERA_INFO,)),
}

# What a method cannot do without: of each line, all topics of at least one group.
NEEDED: dict[str, tuple[tuple[tuple[str, ...], ...], ...]] = {
    "los": ((("imu",),), (("gimbal",),), (("los_error",), ("image", "camera_info"))),
    "indexer": ((("imu",),), (("indexer",),), (("fix",), ("latitude_deg",))),
    "head": ((("head_imu",),), (("vision_attitude",), ("image", "camera_info", "head.board"))),
    "cube": (
        (("imu",),),
        # Pictures alone could be of anything. Without camera the turns between poses and gravity serve; the config has
        # to say that this is meant.
        (
            ("tag_detections", "camera_info"),
            ("image", "camera_info", "reference_imu"),
            ("image", "camera_info", "cube.tags"),
            ("method: cube",),
        ),
    ),
}


def topic_name(key: str, renamed: Mapping[str, str]) -> str:
    """Name of the topic with this key, as the config renames it."""
    return renamed.get(key, TOPICS[key].name)
