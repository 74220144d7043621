"""A recording of every kind of message, and its comparison."""

from __future__ import annotations

from typing import Any

import numpy as np

from alidade.pipelines.recording import series

T0 = 1_700_000_000_123_456_789


def session(n: int = 2000) -> dict[str, series.Topic]:
    """One topic of every kind, at rates and phases of their own."""
    rng = np.random.default_rng(8)

    def stamps(step: int, phase: int = 0) -> np.ndarray[Any, Any]:
        return T0 + phase + step * np.arange(max(1, n * 1_000_000 // step))

    imu, slow = stamps(1_000_000), stamps(33_333_333, 777)
    frames = np.repeat(np.arange(len(slow)), rng.integers(0, 4, len(slow)))
    count = len(frames)
    return {
        "/imu": series.ImuSeries(
            imu,
            rng.normal(size=(n, 3)),
            rng.normal(size=(n, 3)),
            rng.normal(size=(n, 4)),
            gyro_cov=np.diag([1e-6, 2e-6, 3e-6]),
            wxyz_cov=rng.normal(size=(n, 3, 3)),
            frame_id="imu_link",
        ),
        "/mag": series.MagneticSeries(slow, rng.normal(size=(len(slow), 3)), frame_id="mag"),
        "/joints": series.JointSeries(stamps(5_000_000), rng.normal(size=(n // 5, 2)), ("azimuth", "elevation")),
        "/vector": series.VectorSeries(slow, np.where(rng.random((len(slow), 3)) < 0.2, np.nan, 1.5)),
        "/quaternion": series.QuaternionSeries(slow, rng.normal(size=(len(slow), 4))),
        "/pose": series.PoseSeries(slow, rng.normal(size=(len(slow), 4)), cov=rng.normal(size=(len(slow), 6, 6))),
        "/fix": series.FixSeries(
            slow,
            rng.normal(size=len(slow)),
            rng.normal(size=len(slow)),
            rng.normal(size=len(slow)),
            status=np.array(-1.0),
        ),
        "/camera_info": series.CameraInfo(
            T0, 640, 480, "plumb_bob", rng.normal(size=5), rng.normal(size=(3, 3)), np.eye(3), rng.normal(size=(3, 4))
        ),
        "/image": series.ImageSeries(slow, [rng.bytes(int(k)) for k in rng.integers(0, 90_000, len(slow))]),
        "/tags": series.DetectionSeries(
            slow,
            frames,
            rng.integers(0, 500, count),
            rng.normal(size=(count, 4, 2)),
            np.full(count, "tag36h11"),
        ),
    }


def assert_same(found: dict[str, Any], made: dict[str, Any]) -> None:
    assert found.keys() == made.keys()
    for topic, one in made.items():
        if isinstance(one, series.ImageSeries):
            assert found[topic] == list(zip(one.t_ns.tolist(), one.data, strict=True))
            continue
        for name, value in vars(one).items():
            if name != "frame_id":
                np.testing.assert_array_equal(getattr(found[topic], name), value, err_msg=f"{topic} {name}")
