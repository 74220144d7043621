"""What a cube session shows beside its parameters: K taken apart, the sensors' noise at rest, the static poses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from alidade.factors import so3
from alidade.pipelines.estimation.problem import Array, Estimate, Findings
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.cube.compensation import calibrated
from alidade.pipelines.methods.cube.data import CubeData, local_field, noise_densities, nominal
from alidade.pipelines.methods.cube.noises import noises
from alidade.pipelines.methods.cube.poses import StaticPoses, static_poses
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.methods.place import FIELD
from alidade.pipelines.methods.triads import TRIADS, parts_row, parts_with_sigmas, triad_names
from alidade.pipelines.recording.topics import IMU, MAG
from alidade.pipelines.settings import Config

# White noise is told from means over this much time, s: shorter ones are what the device's own filter leaves.
_BLOCK = 0.25
_UNITS = {"accel": "m/s^2/sqrt(Hz)", "gyro": "rad/s/sqrt(Hz)", "mag": "T/sqrt(Hz)"}


def findings(data: CubeData, config: Config, estimate: Estimate) -> Findings:
    """Rows of `triads`, `noise`, `static_poses` and `disturbed_poses`, SI, for the triads that the estimate knows.

    triads: scale of each axis against the nominal one; nonorthogonality, rad, of x and y, x and z, y and z, positive
    where they are closer than a right angle; mounting, rad, the rotation vector that turns the body's axes into the
    sensor's; each with its sigmas. None for a K that is no sensor's: singular, or left-handed.
    noise: white noise density of each axis with K applied, measured over the static poses, beside the one that the
    solution took; walk of the bias per sqrt(s), stated or an upper bound.
    static_poses: beginning and end, s, the direction of up in the body, and the kinds of measurement that were used.
    disturbed_poses: those whose magnetometer was left out: number, beginning and end, s, and by what vector, T in n,
    and how much the field was off there.
    """
    values = dict(zip(estimate.names, estimate.values.tolist(), strict=True))
    values |= temperature.constants(temperature.reference(data.temperature))
    poses = static_poses(data, config)
    known = [name for name in TRIADS if f"{name}_k11" in values]
    return {
        "triads": [row for name in known if (row := _triad(name, config, estimate)) is not None],
        "noise": [_noise(name, data, config, poses, values) for name in known],
        "static_poses": _poses(poses, config, estimate, values),
        "disturbed_poses": _disturbed(data, poses, config, estimate, values),
    }


def _triad(name: str, config: Config, estimate: Estimate) -> dict[str, object] | None:
    rows = [estimate.names.index(entry) for entry in triad_names(name)[:9]]
    conversion = getattr(config.section(CubeConfig).raw, name)
    unit = 1.0 if conversion is None else conversion.scale
    K, covariance = estimate.values[rows].reshape(3, 3) / unit, estimate.covariance[np.ix_(rows, rows)] / unit**2
    parts = parts_with_sigmas(K, covariance)
    return None if parts is None else parts_row(name, *parts)


def _disturbed(
    data: CubeData, poses: StaticPoses, config: Config, estimate: Estimate, values: Mapping[str, float]
) -> list[dict[str, object]]:
    """The poses near iron, or in reach of a current: their magnetometer was rejected."""
    residuals, attitudes = estimate.residuals.get("magnetometer"), estimate.attitudes
    if residuals is None or attitudes is None or poses.mag is None or "mag_k11" not in values:
        return []
    middle = poses.span.mean(axis=1)
    field = np.array([values[name] for name in FIELD.names]) if FIELD.names[0] in values else local_field(data, config)
    rows = []
    for time in residuals.time[~residuals.used]:
        k = int(np.argmin(np.abs(middle - time)))
        nRb = attitudes.wxyz[int(np.argmin(np.abs(attitudes.time - time)))]
        off = so3.rotate(nRb, calibrated("mag", poses.mag[k : k + 1], config, values)[0]) - field
        rows.append(
            {
                "pose": k + 1,
                "start_s": float(poses.span[k, 0]),
                "end_s": float(poses.span[k, 1]),
                "off": off.tolist(),
                "size": float(np.linalg.norm(off)),
            }
        )
    return rows


def _noise(
    name: str, data: CubeData, config: Config, poses: StaticPoses, values: Mapping[str, float]
) -> dict[str, object]:
    t, samples = {
        "accel": (data.imu_t, data.accel),
        "gyro": (data.imu_t, data.gyro),
        "mag": (data.mag_t, data.mag),
    }[name]
    assert t is not None
    assert samples is not None
    vectors = calibrated(name, nominal(samples, getattr(config.section(CubeConfig).raw, name)), config, values)
    rate = 1.0 / float(np.median(np.diff(t)))
    density = white_noise(t, vectors, poses.span, rate)
    stated = dict(zip(("gyro", "accel", "mag"), noise_densities(data, config), strict=True))[name]
    row: dict[str, object] = {
        "sensor": name,
        "topic": config.topic(MAG if name == "mag" else IMU),
        "rate_hz": float(f"{rate:.6g}"),
        "unit": _UNITS[name],
        "density": density.tolist(),
        "stated": stated,
    }
    taken = noises(data, config)["gyro_bias_walk"].used if name == "gyro" else 0.0
    # One that adds up to more over the recording than the mean of one rest is good to would have shown.
    length = float(poses.span[-1, 1] - poses.span[0, 0])
    bound = float(np.mean(density) / np.sqrt(np.median(poses.duration) * length))
    return row | ({"walk": taken, "walk_source": "stated"} if taken else {"walk": bound, "walk_source": "upper bound"})


def white_noise(t: Array, vectors: Array, spans: Array, rate: float) -> Array:
    """Density (3,), unit/sqrt(Hz), of the white noise of vectors (n, 3) at t (n,) s within the spans (P, 2) s.

    From the overlapping Allan variance over a quarter of a second (IEEE 1139): half the mean square of the differences
    of means that follow each other, times that time. Zero where no span is as long as two of them.
    """
    size = max(1, round(_BLOCK * rate))
    squares = []
    for first, last in np.searchsorted(t, spans):
        sums = np.cumsum(vectors[first:last] - vectors[first], axis=0)
        squares.append((sums[2 * size :] - 2.0 * sums[size:-size] + sums[: -2 * size]) ** 2)
    gathered = np.concatenate(squares)
    return np.asarray(np.sqrt(0.5 * gathered.mean(axis=0) / (size * rate))) if len(gathered) else np.zeros(3)


def _poses(
    poses: StaticPoses, config: Config, estimate: Estimate, values: Mapping[str, float]
) -> list[dict[str, object]]:
    up = (
        calibrated("accel", poses.accel, config, values, celsius=poses.celsius)
        if "accel_k11" in values
        else poses.accel
    )
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
    used = {family: r.time[r.used] for family, r in estimate.residuals.items()}
    return [
        {
            "start_s": float(start),
            "end_s": float(end),
            "up": np.round(direction, 4).tolist(),
            "used": [family for family, time in used.items() if ((start <= time) & (time <= end)).any()],
        }
        for (start, end), direction in zip(poses.span, up, strict=True)
    ]
