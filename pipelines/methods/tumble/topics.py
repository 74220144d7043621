"""What the tumble method reads."""

from __future__ import annotations

from alidade.pipelines.recording.topics import FIX, IMU, MAG, TEMPERATURE, Need, Setting

TOPICS = (MAG, IMU, FIX, TEMPERATURE)
_METHOD = Setting("`method: tumble` in the config", lambda config: config.method == "tumble")
# An accelerometer by itself is in most recordings, and seldom meant.
REQUIREMENTS: tuple[Need, ...] = (((MAG,), (IMU, _METHOD)),)
