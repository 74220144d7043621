"""Use of an indexer result: attitude by its IMU over an hour of indexing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import EARTH_RATE
from alidade.pipelines.diagnostics.use import Applied, Line, Truth, Use
from alidade.pipelines.methods.formula import passive
from alidade.pipelines.methods.uses import gyro_reading
from alidade.pipelines.settings import Config

# The inner axis dwells a minute at 0, 90, 180, 270 deg and goes back the same way; a quarter turn takes 10 s.
_STEP_S, _DWELL_S, _TURN_S, _HOUR_S = 10.0, 60.0, 10.0, 3600.0
_QUARTERS = (1.0, 1.0, 1.0, -1.0, -1.0, -1.0)
_LATITUDE = np.deg2rad(45.0)


def uses(_true: Truth, _config: Config, noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of an indexer calibration: attitude error over an hour."""
    time, angle, rate = _sequence()
    shown = slice(5, None, 6)
    density, walk = noise.get("gyro_density", 0.0), noise.get("gyro_bias_walk", 0.0)
    # Earth rate in the base, level and north along y, seen from the platform, and the turning.
    w = so3.rotate(so3.exp(-angle[:, None] * _EZ), EARTH_RATE * np.array([0.0, np.cos(_LATITUDE), np.sin(_LATITUDE)]))
    w = w + rate[:, None] * _EZ

    def error(applied: Applied, true: Truth) -> Array:
        mRt = so3.compose(*(passive(i, true.get(f"theta_{axis}")) for i, axis in enumerate("xyz")))
        reading = gyro_reading(true, so3.rotate(mRt[..., None, :], w), np.zeros((1, 3)))
        wrong = so3.rotate(so3.exp(angle[:, None] * _EZ), applied(gyro=reading)["w_it"] - w)
        return np.asarray(_STEP_S * np.cumsum(wrong, axis=-2)[..., shown, :])

    def part(axes: slice) -> Line:
        name = "heading" if axes.start == 2 else "level"
        color = "series1" if axes.start == 2 else "series0"
        return Line(name, lambda applied, true: error(applied, true)[..., axes], color, noise=_noise(time[shown]))

    def _noise(t: Array) -> Array:
        return np.asarray(density**2 * t + walk**2 * t**3 / 3.0)

    return (
        Use(
            "navigation",
            "Attitude by the IMU over an hour of indexing",
            time[shown] / 60.0,
            "time, min",
            "attitude error, arcsec",
            "arcsec",
            float(np.degrees(3600.0)),
            (part(slice(0, 2)), part(slice(2, 3))),
            "e = ∫ bRt (w_it − ω) dt; N(t) = N² t + K² t³/3",
            "inner axis through 0, 90, 180, 270 deg and back, a minute each, at 45 deg latitude",
            "attitude after an hour",
            at=-1,
        ),
    )


_EZ = np.array([0.0, 0.0, 1.0])


def _sequence() -> tuple[Array, Array, Array]:
    """Rotation sequence of an hour: times, s, angles of the inner axis, rad, and its rates, rad/s, (U,)."""
    time = np.arange(_STEP_S, _HOUR_S + 0.5 * _STEP_S, _STEP_S)
    middle = time - 0.5 * _STEP_S
    leg, into = np.divmod(middle, _DWELL_S + _TURN_S)
    moves = np.array(_QUARTERS)[np.arange(int(leg[-1]) + 1) % len(_QUARTERS)]
    at = np.concatenate([[0.0], np.cumsum(moves)])[leg.astype(int)]
    share = np.clip((into - _DWELL_S) / _TURN_S, 0.0, 1.0)
    quarter = 0.5 * np.pi
    turning = into > _DWELL_S
    return time, quarter * (at + share * moves[leg.astype(int)]), quarter / _TURN_S * turning * moves[leg.astype(int)]
