"""Head sessions: written and read back, checked, and every bad input one clear line."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.recording import HeadData, read_head
from alidade.pipelines.recording import checks, series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording

T0 = 1_800_000_000_000_000_000
NONE = load_config(None)


def made(platform: bool = True, cov: bool = True, truth: bool = True) -> HeadData:
    rng = np.random.default_rng(2)
    head_t, platform_t, vision_t = np.arange(1000) / 500, np.arange(400) / 200, 0.0437 + np.arange(50) / 30
    root = rng.normal(size=(50, 3, 3)) * 1e-2
    return HeadData(
        epoch_ns=T0,
        head_t=head_t,
        head_gyro=rng.normal(size=(1000, 3)),
        platform_t=platform_t if platform else None,
        platform_gyro=rng.normal(size=(400, 3)) if platform else None,
        vision_t=np.rint(vision_t * 1e9) / 1e9,
        vision_wxyz=so3.normalize(rng.normal(size=(50, 4))),
        vision_cov=root @ root.swapaxes(1, 2) + 1e-6 * np.eye(3) if cov else None,
        truth_t=head_t[::10] if truth else None,
        truth_wxyz=so3.normalize(rng.normal(size=(100, 4))) if truth else None,
        gyro_density=5e-5,
        platform_gyro_density=1e-5 if platform else None,
    )


def read(path: Path) -> HeadData:
    return read_head(open_recording(path), load_config(open_recording(path).attachment("alidade.yaml")))


@pytest.mark.parametrize("options", [{}, {"platform": False}, {"cov": False, "truth": False}])
def test_written_and_read_back_is_identical(options: dict[str, bool], tmp_path: Path) -> None:
    data = made(**options)
    method("head").write_data(tmp_path / "h.mcap", data, {"time_offset": 0.004}, "method: head\n")
    found = read(tmp_path / "h.mcap")
    for part in dataclasses.fields(HeadData):
        value = getattr(data, part.name)
        if part.name.endswith("density") and value is not None:
            value = pytest.approx(value, rel=1e-12)  # goes through a variance and a rate
            assert getattr(found, part.name) == value
        else:
            np.testing.assert_array_equal(getattr(found, part.name), value, err_msg=part.name)
    assert open_recording(tmp_path / "h.mcap").attachment("truth.json") == b'{\n "time_offset": 0.004\n}'


def test_the_independent_recording(shared_data: Path) -> None:
    data = read(shared_data / "contract" / "head_mounts.mcap")
    assert data.platform_t is not None
    assert (len(data.head_t), len(data.platform_t), len(data.vision_t)) == (30001, 12001, 1797)
    assert data.vision_cov is not None
    assert data.gyro_density == pytest.approx(4.36332313e-5, rel=1e-6)
    assert data.dropped == {}
    np.testing.assert_allclose(data.head_t, np.arange(30001) / 500, atol=1e-12)


Change = dict[str, Any]


def write_changed(path: Path, **changes: Any) -> Path:
    """A session with some of its series replaced; None leaves the topic out."""
    data = made()

    def ns(t: Any) -> Any:
        return checks.nanoseconds(t, T0)

    topics: dict[str, Any] = {
        "head": ("/head/imu", series.ImuSeries(ns(data.head_t), data.head_gyro)),
        "platform": ("/platform/imu", series.ImuSeries(ns(data.platform_t), data.platform_gyro)),  # type: ignore[arg-type]
        "vision": ("/vision/attitude", series.QuaternionSeries(ns(data.vision_t), data.vision_wxyz)),
    }
    for name, change in changes.items():
        topic, one = topics[name]
        topics[name] = (topic, change(one) if change else None)
    write_session(path, {topic: one for topic, one in topics.values() if one is not None})
    return path


def replaced(name: str, rows: Any, value: Any) -> Any:
    """A change of some rows of a series."""

    def change(one: Any) -> Any:
        values = getattr(one, name).copy()
        values[rows] = value
        return dataclasses.replace(one, **{name: values})

    return change


def shifted(seconds: float) -> Any:
    return lambda one: dataclasses.replace(one, t_ns=one.t_ns + int(seconds * 1e9))


def test_few_bad_samples_are_dropped_or_sorted_and_counted(tmp_path: Path) -> None:
    def change(one: series.ImuSeries) -> series.ImuSeries:
        t_ns, gyro = one.t_ns.copy(), one.gyro.copy()
        t_ns[100] = t_ns[99]
        t_ns[[200, 201]] = t_ns[[201, 200]]
        gyro[300] = [0.0, np.nan, 0.0]
        return series.ImuSeries(t_ns, gyro)

    data = read(write_changed(tmp_path / "h.mcap", head=change))
    assert data.dropped == {
        "/head/imu: not a finite number": 1,
        "/head/imu: stamp out of order (sorted, kept)": 1,
        "/head/imu: duplicate stamp": 1,
    }
    good = made()
    keep = np.delete(np.arange(1000), [100, 300])
    np.testing.assert_array_equal(data.head_t, good.head_t[keep])
    order = np.arange(1000)
    order[[200, 201]] = order[[201, 200]]
    np.testing.assert_array_equal(data.head_gyro, good.head_gyro[order[keep]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"head": None}, r"no topic /head/imu .*/platform/imu \(Imu\)"),
        ({"vision": None}, r"no topic /vision/attitude"),
        (
            {"head": lambda one: series.MagneticSeries(one.t_ns, one.gyro)},
            "topic /head/imu holds sensor_msgs/msg/MagneticField",
        ),
        (
            {"head": replaced("t_ns", slice(100, 200), T0)},
            r"topic /head/imu: 100 of 1000 stamps are out of order .*0\.000000 s",
        ),
        ({"head": lambda one: series.ImuSeries(one.t_ns // 10**8 * 10**8, one.gyro)}, "stamps are duplicate"),
        ({"head": replaced("gyro", slice(None), np.nan)}, "topic /head/imu: every one of the 1000 messages"),
        ({"head": lambda one: series.ImuSeries(one.t_ns[:1], one.gyro[:1])}, "1 usable messages, at least 2"),
        ({"head": lambda one: series.ImuSeries(one.t_ns, one.gyro * 57.3)}, r"/head/imu: rate of .* in deg/s\?"),
        ({"platform": replaced("gyro", slice(7, 9), 36.0)}, r"topic /platform/imu: rate of 62\.35 at 0\.035000 s"),
        ({"vision": replaced("wxyz", slice(None), 0.0)}, r"/vision/attitude: the quaternion at 0\.\d+ s is zero"),
        ({"vision": replaced("wxyz", slice(5, 8), 1.0)}, r"the quaternion at 0\.210\d+ s has norm 2 \(and 2 more\)"),
        ({"vision": replaced("wxyz", slice(None), np.nan)}, "topic /vision/attitude: every one of the 50 messages"),
        (
            {"vision": shifted(10.0)},
            r"/head/imu 0\.000 to 1\.998 s, .*/vision/attitude 10\.044 to 11\.677 s; are the clocks the same\?",
        ),
        ({"platform": shifted(-10.0)}, "no time is covered by all of"),
    ],
)
def test_bad_input_is_one_clear_line(changes: Change, message: str, tmp_path: Path) -> None:
    path = write_changed(tmp_path / "h.mcap", **changes)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)


def test_norms_within_the_tolerance_are_made_unit(tmp_path: Path) -> None:
    change = lambda one: series.QuaternionSeries(one.t_ns, one.wxyz * 1.0005)  # noqa: E731
    data = read(write_changed(tmp_path / "h.mcap", vision=change))
    np.testing.assert_allclose(data.vision_wxyz, made().vision_wxyz, atol=1e-15)


def poses(cov: Any) -> Any:
    return lambda one: series.PoseSeries(one.t_ns, one.wxyz, cov=cov)


def test_covariances_of_vision(tmp_path: Path) -> None:
    cov = np.zeros((50, 6, 6))
    cov[:, 3:, 3:] = np.diag([1e-4, 2e-4, 3e-4])
    cov[:, :3, :3] = 7.0
    data = read(write_changed(tmp_path / "a.mcap", vision=poses(cov)))
    np.testing.assert_array_equal(data.vision_cov, cov[:, 3:, 3:])
    some = cov.copy()
    some[3, 3:, 3:] = 0.0
    data = read(write_changed(tmp_path / "b.mcap", vision=poses(some)))
    assert len(data.vision_t) == 49
    assert data.dropped == {"/vision/attitude: no covariance, unlike the others": 1}
    some[3, 3:, 3:] = np.diag([1e-4, -1e-4, 1e-4])
    with pytest.raises(InputError, match=r"covariance of the rotation at 0\.143\d+ s is not positive definite"):
        read(write_changed(tmp_path / "c.mcap", vision=poses(some)))


def test_topics_can_be_renamed(tmp_path: Path) -> None:
    data = made()
    t_ns = checks.nanoseconds(data.head_t, T0)
    write_session(
        tmp_path / "h.mcap",
        {
            "/xsens/data": series.ImuSeries(t_ns, data.head_gyro),
            "/vision/attitude": series.QuaternionSeries(t_ns[::20], data.vision_wxyz),
        },
    )
    recording = open_recording(tmp_path / "h.mcap")
    assert len(read_head(recording, load_config(b"topics: {head_imu: /xsens/data}")).head_t) == 1000
    with pytest.raises(InputError, match="no topic /table/imu"):
        read_head(recording, load_config(b"topics: {head_imu: /xsens/data, platform_imu: /table/imu}"))


def test_nothing_unusual_in_clean_stamps() -> None:
    t_ns = T0 + np.arange(0, 10**9, 10**7)
    dropped: dict[str, int] = {}
    t, keep = checks.clean("/x", t_ns, T0, np.zeros((100, 3)), dropped)
    np.testing.assert_array_equal(t, np.arange(100) / 100)
    np.testing.assert_array_equal(keep, np.arange(100))
    np.testing.assert_array_equal(checks.nanoseconds(t, T0), t_ns)
    assert not dropped
