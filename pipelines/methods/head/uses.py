"""Use of a head result: the helmet's attitude, from vision and, without vision, from the gyro."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.diagnostics.use import Applied, Line, Truth, Use
from alidade.pipelines.methods.uses import G, gyro_reading
from alidade.pipelines.settings import Config

_YAW_DEG = np.linspace(-90.0, 90.0, 37)
_RATE_DEG = 100.0
_OUTAGE_S = np.linspace(0.0, 60.0, 31)
_EZ = np.array([0.0, 0.0, 1.0])


def uses(_true: Truth, _config: Config, noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a head calibration: attitude over head azimuth, and over the time since the last picture."""
    density, walk = noise.get("gyro_density", 0.0), noise.get("gyro_bias_walk", 0.0)
    gained = density**2 * _OUTAGE_S + walk**2 * _OUTAGE_S**3 / 3.0
    attitude = Use(
        "attitude",
        "Helmet attitude from the camera",
        _YAW_DEG,
        "head azimuth, deg",
        "attitude error, deg",
        "deg",
        float(np.degrees(1.0)),
        (Line("at rest", _attitude(0.0)), Line(f"turning at {_RATE_DEG:g} deg/s", _attitude(_RATE_DEG), "series1")),
        "e = Log(bRvᵀ (cRb)ᵀ cRh (vRh)ᵀ) + ω Δt; cRh as measured by true mounts and vision scale",
        "head level; rotation angle of the error",
        "helmet attitude, ±90 deg of azimuth",
    )
    outage = Use(
        "outage",
        "Helmet attitude while the camera sees nothing",
        _OUTAGE_S,
        "time since the last picture, s",
        "attitude error gained, deg",
        "deg",
        float(np.degrees(1.0)),
        (Line("head at rest", _outage, noise=gained),),
        "e = t (w_iv − ω); N(t) = N² t + K² t³/3",
        "against inertial space, head at rest, z up",
        "attitude gained in 10 s",
        at=5,
    )
    return attitude, outage


def _attitude(rate_deg: float) -> Callable[[Applied, Truth], Array]:
    bRv = so3.exp(np.deg2rad(_YAW_DEG)[:, None] * _EZ)

    def compute(applied: Applied, true: Truth) -> Array:
        vRh, cRb = (so3.exp(true.xyz(name))[..., None, :] for name in ("helmet_mount", "camera_mount"))
        first = so3.multiply(cRb, vRh)
        seen = so3.log(so3.compose(so3.inverse(first), cRb, bRv, vRh))
        scaled = (1.0 + true.get("vision_scale"))[..., None, None] * seen
        found = applied(cRh=so3.multiply(first, so3.exp(scaled)))["bRv"]
        late = true.get("time_offset") - applied.values.get("time_offset", 0.0)
        return so3.local(bRv, found) + np.deg2rad(rate_deg) * late[..., None, None] * _EZ

    return compute


def _outage(applied: Applied, true: Truth) -> Array:
    rest, force = np.zeros((1, 3)), G * _EZ[None]
    return np.asarray(applied(gyro=gyro_reading(true, rest, force), accel=force)["w_iv"] * _OUTAGE_S[:, None])
