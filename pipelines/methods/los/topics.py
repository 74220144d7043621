"""What the los method reads."""

from __future__ import annotations

from alidade.pipelines.recording import messages
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, IMU, TEMPERATURE, Need, Topic

GIMBAL = Topic("gimbal", "/gimbal/joint_states", (messages.JOINT_STATE,))
LOS_ERROR = Topic("los_error", "/los/error", (messages.VECTOR,))

# The gimbal's axes, as its messages name them.
JOINTS = ("azimuth", "elevation")

TOPICS = (IMU, GIMBAL, LOS_ERROR, IMAGE, CAMERA_INFO, TEMPERATURE)
NEEDS: tuple[Need, ...] = (((IMU,),), ((GIMBAL,),), ((LOS_ERROR,), (IMAGE, CAMERA_INFO)))
