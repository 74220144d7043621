"""Noises that a graph may have: keys of the config's section `noise`, units, defaults and descriptions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NoiseSpec:
    """Declaration of a noise that a graph may have.

    Attributes:
        name: its key under `noise` in the config, where it is one.
        unit: SI, or pixels.
        description: a sentence for people.
        default: sigma or density where neither config nor messages state one; None: it is no key of the config.
        no_noise: beyond this it is no noise, where it is at its default, and half of it a note.
    """

    name: str
    unit: str
    description: str
    default: float | None = None
    no_noise: float = np.inf


# Blurred and distant tags scatter by two or three times the default; attitudes that scatter by 3.5 deg serve nobody;
# half as much, over a second, is a platform that sways; no gyro at rest has more than 3e-3 rad/s/sqrt(Hz), and none
# turns 5 % too far at random: a cheap one did .7 %.
_SPECS = (
    NoiseSpec("gyro_density", "rad/s/√Hz", "Gyro white noise.", 5.0e-5, 3.0e-3),
    NoiseSpec("gyro_rate_noise", "1/√Hz", "Gyro white noise that grows with the rate.", 5.0e-5),
    NoiseSpec("gyro_bias_walk", "rad/s/√s", "Gyro bias random walk.", 1.0e-6),
    NoiseSpec("gyro_scale", "", "", 0.0),
    NoiseSpec("platform_gyro_density", "rad/s/√Hz", "Platform gyro white noise.", 1.0e-5),
    NoiseSpec("accel_density", "m/s²/√Hz", "Accelerometer white noise.", 2.0e-3),
    NoiseSpec("mag_density", "T/√Hz", "Magnetometer white noise.", 5.0e-8),
    NoiseSpec("los_error", "rad", "LOS error, per measurement and axis.", 2.0e-5),
    NoiseSpec("los_roll", "rad", "Roll of the picture about the line of sight, per measurement.", 2.0e-4),
    NoiseSpec("encoder", "rad", "Encoder reading, per sample.", 1.0e-5),
    NoiseSpec("vision_attitude", "rad", "Vision attitude, per picture and axis.", 8.7e-3, 6.09e-2),
    NoiseSpec(
        "vision_rate_noise", "s", "Vision attitude noise proportional to the rate, per picture and axis.", 1.0e-4
    ),
    NoiseSpec("vision_correlated", "rad", "Vision attitude error that is correlated in time, per axis.", None, 3.05e-2),
    NoiseSpec("corner_px", "px", "Tag corner in a picture, per axis.", 0.3, 1.5),
    NoiseSpec("gyro_repeatability", "rad/s", "Gyro mean at rest, beyond white noise.", 2.0e-5),
    NoiseSpec("turn_repeatability", "", "Angle turned between rests, beyond white noise.", 1.0e-3, 5.0e-2),
    NoiseSpec("accel_repeatability", "m/s²", "Accelerometer mean at rest, beyond white noise.", 5.0e-4),
    NoiseSpec("mag_repeatability", "T", "Magnetometer mean at rest, beyond white noise.", 2.0e-8),
    NoiseSpec("turn_rate", "rad/s", "Mean rate over a turn."),
    NoiseSpec("move_rate", "rad/s", "Mean rate over a move between positions."),
    NoiseSpec("dwell_rate", "rad/s", "Mean rate over a dwell in a position."),
)
NOISES = {spec.name: spec for spec in _SPECS}
