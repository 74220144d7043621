"""Validation of the los method: the stabilisation error of a recording, as it was and as compensation would leave it.

The recording is replayed. On top of what the gimbal did it is turned by the integral of compensated less uncompensated
commands, and the target's recorded direction is carried over from the gimbal as it was to the gimbal as it would have
been. Compensated commands hold the frame Rx(eps + px) Rz(eta) still against w_b = Rz(dz) Rx(-gx) Ry(-gy) w, w the rate
of the gyro with its errors taken off:

    eps' = -(cos(eta) wx + sin(eta) wy),  eta' = tan(eps + px) (cos(eta) wy - sin(eta) wx) - wz.

CN102288133B, steps three and four.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.gimbal import GimbalPath, command
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.los.corrected import rates
from alidade.pipelines.methods.los.guess import los_direction, los_error
from alidade.pipelines.methods.los.pictures import select_pictures
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

# The replayed gimbal feeds back on its own commands; each pass is better by the carrier's sway, about a tenth.
_PASSES = 6
# Pictures further from the median of so many neighbours than so many times what is usual are outliers.
_NEIGHBOURS, _OUTLYING = 9, 8.0


def validate(data: LosData, config: Config, values: Mapping[str, float]) -> tuple[Validation, ...]:
    """LOS error since each target was found, before and after compensation; once more without its steady drift.

    Args:
        data: the session.
        config: of the session.
        values: calibrated parameters by name, SI; those not there are zero.

    Raises:
        InputError: too few pictures within the records of gyro and gimbal.
    """
    sigma = first_given(config.noise.los_error, DEFAULT_NOISE.los_error)
    rows, starts, _ = select_pictures(data, np.full(len(data.image_t), sigma), 0.0)
    chains = np.split(rows, np.flatnonzero(starts)[1:])
    good = [chain[_near_neighbours(data.error[chain, :2])] for chain in chains]
    spoilt = len(rows) - sum(len(chain) for chain in good)
    pairs = [(data.error[chain, :2], _replayed(data, chain, values)) for chain in good]
    before, after = ([errors - errors[0] for errors in series] for series in zip(*pairs, strict=True))
    times = [data.image_t[chain] for chain in good]
    left_out = f"{spoilt} of {len(rows)} LOS errors left out as outliers" if spoilt else ""
    bias = "a gyro bias that has changed since the calibration is still in it"
    drifting = Validation(
        "line of sight",
        "rad",
        np.concatenate(times),
        np.concatenate(before),
        np.concatenate(after),
        "; ".join(filter(None, [bias, left_out])),
        micro=True,
    )
    steady = Validation(
        "line of sight, steady drift removed",
        "rad",
        np.concatenate(times),
        np.concatenate([_without_drift(t, e) for t, e in zip(times, before, strict=True)]),
        np.concatenate([_without_drift(t, e) for t, e in zip(times, after, strict=True)]),
        left_out,
        micro=True,
    )
    return drifting, steady


def _replayed(data: LosData, chain: NDArray[np.intp], values: Mapping[str, float]) -> Array:
    """phx, phz (n, 2) of one target's pictures with the gimbal driven by compensated commands since the first."""
    t = data.image_t[chain]
    inside = (data.gyro_t > t[0]) & (data.gyro_t < t[-1])
    at = np.concatenate([t[:1], data.gyro_t[inside], t[-1:]])
    gyro, true = (
        np.stack([np.interp(at, data.gyro_t, each) for each in samples.T], axis=1)
        for samples in (data.gyro, rates(data, values))
    )
    gimbal = GimbalPath(data.gimbal_t, data.gimbal)
    recorded = gimbal.at(at)
    px = values.get("delta_px", 0.0)
    rate = so3.rotate(_carrier_from_gyro(values), true)
    uncompensated = command(gyro, recorded)
    extra = np.zeros_like(recorded)
    for _ in range(_PASSES):
        difference = command(rate, recorded + extra + [0.0, px]) - uncompensated
        steps = 0.5 * np.diff(at)[:, None] * (difference[1:] + difference[:-1])
        extra = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    was = gimbal.at(t)
    would = was + np.stack([np.interp(t, at, extra[:, k]) for k in range(2)], axis=1)
    cRc = so3.multiply(_camera(would, px), so3.inverse(_camera(was, px)))
    return los_error(so3.rotate(cRc, los_direction(data.error[chain])))


def _carrier_from_gyro(values: Mapping[str, float]) -> Array:
    """M = Rz(dz) Rx(-gx) Ry(-gy), (4,), passive Rx, Ry, Rz."""
    dz = values.get("delta_z", values.get("delta_pz", 0.0) - values.get("delta_gz", 0.0))
    gx, gy = values.get("delta_gx", 0.0), values.get("delta_gy", 0.0)
    return so3.compose(so3.exp([0.0, 0.0, -dz]), so3.exp([gx, 0.0, 0.0]), so3.exp([0.0, gy, 0.0]))


def _camera(gimbal: Array, px: float) -> Array:
    """cRb = Rx(eps + px) Rz(eta), (n, 4)."""
    zero = np.zeros(len(gimbal))
    lift = so3.exp(np.stack([-gimbal[:, 1] - px, zero, zero], axis=1))
    return so3.multiply(lift, so3.exp(np.stack([zero, zero, -gimbal[:, 0]], axis=1)))


def _near_neighbours(error: Array) -> NDArray[np.bool_]:
    """Which LOS errors (n, 2) lie near the median of those around them."""
    if len(error) < _NEIGHBOURS:
        return np.ones(len(error), dtype=bool)
    half = _NEIGHBOURS // 2
    padded = np.pad(error, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    around = np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS, axis=0)
    off = np.linalg.norm(error - np.median(around, axis=2), axis=1)
    return np.asarray(off <= _OUTLYING * np.median(off))


def _without_drift(t: Array, error: Array) -> Array:
    """Errors less the straight line fitted to them."""
    line = np.stack([np.ones_like(t), t - t.mean()], axis=1)
    return np.asarray(error - line @ np.linalg.lstsq(line, error)[0])
