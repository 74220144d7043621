"""What each parameter is, in a sentence for people.

    meaning(method("los"), "gyro_bias_x")    # "What the gyro reads about its x axis when it does not turn."

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
    r"gyro_bias_([xyz])": "What the gyro reads about its {0} axis when it does not turn.",
    r"gyro_scale_([xyz])": "By how much of the rate the gyro reads too much about its {0} axis.",
    r"gyro_skew_([xyz])([xyz])": "Part of a rate about {0} that the gyro reads about {1}, and the other way round: its "
    "axes are not square.",
    r"gyro_g_([xyz])([xyz])": "What the gyro reads about {0} for a specific force along {1} alone.",
    r"(accel|gyro|mag)_temperature_([xyz])": "By how much the {0}'s reading of {1} at rest changes with each kelvin.",
    r"mag_delay": "How much later than its stamp a reading of the magnetometer is true.",
    r"platform_bias_([xyz])": "What the platform's gyro reads about its {0} axis when it does not turn.",
    r"platform_scale_([xyz])": "Part of the rate by which the platform's gyro reads too much about its {0} axis.",
    r"platform_skew_([xyz])([xyz])": "Part of a rate about {0} that the platform's gyro reads about {1}, and the other "
    "way round.",
    r"time_offset": "How much later a picture was taken than its stamp says, on the gyro's clock.",
    r"clock_skew": "Part of the time by which the pictures' clock runs faster than the gyro's.",
    r"encoder_([a-z_]+)_(sin|cos)": "Error of the {0} axis' encoder that comes once a turn with the {1} of its angle.",
    r"encoder_delay": "How much later than its stamp an encoder's reading is true.",
    r"(accel|gyro|mag)_k([123])\2": "Factor of the {0}'s {1}.",
    r"(accel|gyro|mag)_k([123])([123])": "Share of the {0}'s {2} that is added to {1}.",
    r"(accel|gyro|mag)_b([123])": "Offset added to the {0}'s {1} after that.",
    r"field_([enu])": "Magnetic field where it was recorded, its part towards {0}.",
    r"field_strength": "Strength of the magnetic field, to which the magnetometer is scaled.",
    r"field_dip": "Angle by which the magnetic field points below the horizon.",
    r"gravity": "Strength of gravity, to which the accelerometer is scaled.",
}

# Noises by their names in the config.
NOISES: Mapping[str, str] = {
    "gyro_density": "White noise of the gyro.",
    "gyro_bias_walk": "Random walk of the gyro's bias.",
    "gyro_repeatability": "From rest to rest, beyond white noise.",
    "turn_repeatability": "Of the angle turned, beyond white noise.",
    "platform_gyro_density": "White noise of the platform's gyro.",
    "accel_density": "White noise of the accelerometer.",
    "accel_repeatability": "From rest to rest, beyond white noise.",
    "mag_density": "White noise of the magnetometer.",
    "mag_repeatability": "From rest to rest, beyond white noise.",
    "los_error": "Line-of-sight error, of one measurement and axis.",
    "los_roll": "Rotation of the picture about the line of sight, of one measurement.",
    "encoder": "Encoder, of one sample.",
    "vision_attitude": "Attitude by vision, of one frame and axis.",
    "corner_px": "Corner of a tag in a picture, of one axis.",
    "turn_rate": "Mean rate over a turn.",
    "move_rate": "Mean rate over a move between positions.",
    "dwell_rate": "Mean rate over a dwell in a position.",
}


def meaning(method: Method, name: str) -> str:
    """A parameter of a method in a sentence; empty where nothing is said of it."""
    for pattern, sentence in (*method.meanings.items(), *COMMON.items()):
        match = re.fullmatch(pattern, name)
        if match:
            return sentence.format(*(_WORDS.get(group, group.replace("_", " ")) for group in match.groups()))
    return ""
