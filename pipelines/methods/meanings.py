"""What each parameter is, in a sentence for people.

    meaning(method("los"), "gyro_bias_x")    # "Gyro bias about x."

A method says what is its own in `Method.meanings`; what several methods have stands here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from alidade.pipelines.methods import Method

_SENSORS = {"accel": "accelerometer", "gyro": "gyro", "mag": "magnetometer"}
_AXES = dict(zip("123", "xyz", strict=True))
_WORDS = {**_SENSORS, **_AXES, "e": "east", "n": "north", "u": "up", "sin": "sine", "cos": "cosine"}

# Patterns of names -> a sentence with the groups of the pattern, in words.
COMMON: Mapping[str, str] = {
    r"gyro_bias_([xyz])": "Gyro bias about {0}.",
    r"gyro_scale_([xyz])": "Gyro scale-factor error, {0}.",
    r"gyro_skew_([xyz])([xyz])": "Gyro non-orthogonality {0}{1} (half the angle error).",
    r"gyro_g_([xyz])([xyz])": "Gyro g-sensitivity: reading about {0} due to specific force along {1}.",
    r"(accel|gyro|mag)_temperature_([xyz])": "Temperature slope of the {0} bias, {1}.",
    r"mag_delay": "Magnetometer time delay (true time minus stamp).",
    r"platform_bias_([xyz])": "Platform gyro bias about {0}.",
    r"platform_scale_([xyz])": "Platform gyro scale-factor error, {0}.",
    r"platform_skew_([xyz])([xyz])": "Platform gyro non-orthogonality {0}{1} (half the angle error).",
    r"time_offset": "Camera time offset (exposure minus stamp, on the gyro's clock).",
    r"clock_skew": "Clock drift, camera against gyro.",
    r"encoder_([a-z_]+)_(sin|cos)": "Encoder error once per turn, {0} axis, {1} term.",
    r"encoder_delay": "Encoder time delay (true time minus stamp).",
    r"(accel|gyro|mag)_k([123])\2": "{0} gain, {1}.",
    r"(accel|gyro|mag)_k([123])([123])": "{0} cross-axis term ({2} into {1}).",
    r"(accel|gyro|mag)_b([123])": "{0} offset, {1} (after K).",
    r"accel_square_([123])": "Accelerometer quadratic nonlinearity, {0}.",
    r"accel_arm_([xyz])": "Lever arm from the point of rotation to the accelerometer, {0}.",
    r"field_([enu])": "Local magnetic field, {0} component.",
    r"field_strength": "Strength of the local magnetic field.",
    r"field_dip": "Inclination of the magnetic field, positive down.",
    r"gravity": "Local gravity.",
}

# Noises by their names in the config.
NOISES: Mapping[str, str] = {
    "gyro_density": "Gyro white noise.",
    "gyro_bias_walk": "Gyro bias random walk.",
    "gyro_repeatability": "Gyro mean at rest, beyond white noise.",
    "turn_repeatability": "Angle turned between rests, beyond white noise.",
    "platform_gyro_density": "Platform gyro white noise.",
    "accel_density": "Accelerometer white noise.",
    "accel_repeatability": "Accelerometer mean at rest, beyond white noise.",
    "mag_density": "Magnetometer white noise.",
    "mag_repeatability": "Magnetometer mean at rest, beyond white noise.",
    "los_error": "LOS error, per measurement and axis.",
    "los_roll": "Roll of the picture about the line of sight, per measurement.",
    "encoder": "Encoder reading, per sample.",
    "vision_attitude": "Vision attitude, per picture and axis.",
    "corner_px": "Tag corner in a picture, per axis.",
    "turn_rate": "Mean rate over a turn.",
    "move_rate": "Mean rate over a move between positions.",
    "dwell_rate": "Mean rate over a dwell in a position.",
}


def meaning(method: Method, name: str) -> str:
    """A parameter of a method in a sentence; empty where nothing is said of it."""
    for pattern, sentence in (*method.meanings.items(), *COMMON.items()):
        match = re.fullmatch(pattern, name)
        if match:
            text = sentence.format(*(_WORDS.get(group, group.replace("_", " ")) for group in match.groups()))
            return text[:1].upper() + text[1:]
    return ""
