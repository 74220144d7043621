"""A calibration applied to a recording: corrected topics beside what was recorded."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import alidade as door
from alidade.pipelines import methods
from alidade.pipelines.applications.discovery import idle
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import series
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.reports.calibration import SavedCalibration, SavedParameter, SavedRecording
from alidade.pipelines.settings import Config
from tests.support import forms
from tests.support.command import Command
from tests.support.recorded import T0, session

RNG = np.random.default_rng(12)
IDENTITY = {f"{sensor}_k{i}{i}": 1.0 for sensor in ("accel", "gyro", "mag") for i in "123"}


def saved(method: str, names: list[str], **changes: Any) -> SavedCalibration:
    """A calibration with small errors of these names."""
    values = {name: IDENTITY.get(name, 0.0) + 0.01 * RNG.normal() for name in names}
    return SavedCalibration(
        method=method,
        solver="batch",
        status="calibrated",
        recording=SavedRecording(file="s.mcap", sha256="", start=""),
        parameters={n: SavedParameter(value=v, sigma=0.1, unit="1", verdict=None) for n, v in values.items()},
        formulas=[formula.text for formula in methods.method(method).report.formulas(names, Config())],
    ).model_copy(update=changes)


def triad(name: str) -> list[str]:
    return [f"{name}_{part}" for part in (*(f"k{i}{j}" for i in "123" for j in "123"), "b1", "b2", "b3")]


def xyz(*stems: str) -> list[str]:
    return [f"{stem}_{axis}" for stem in stems for axis in "xyz"]


SENSITIVITY = [f"gyro_g_{i}{j}" for i in "xyz" for j in "xyz"]
GYRO = [*xyz("gyro_bias", "gyro_scale"), *(f"gyro_skew_{i}" for i in ("xy", "xz", "yz")), *SENSITIVITY]
SLOPES = xyz("gyro_temperature")
# Method -> parameters, results by topic and column, frame of the first topic.
CASES: dict[str, tuple[list[str], dict[str, dict[str, str]], str]] = {
    "cube": (
        [*triad("accel"), *triad("gyro"), *triad("mag"), *SENSITIVITY, *(f"accel_square_{i}" for i in "123")],
        {"/imu": {"gyro": "w_b", "accel": "f_b"}, "/mag": {"field": "m_b"}},
        "cube",
    ),
    "tumble": (
        [*triad("accel"), *triad("mag"), *GYRO, *SLOPES],
        {"/imu": {"gyro": "w_b", "accel": "f_b"}, "/mag": {"field": "m_b"}},
        "imu_link",
    ),
    "head": (
        [*GYRO, *xyz("helmet_mount", "platform_bias")],
        {"/head/imu": {"gyro": "w_iv"}, "/platform/imu": {"gyro": "w_ib"}},
        "imu_link",
    ),
    "los": (["delta_px", "delta_gx", "delta_gy", "delta_z", *GYRO], {"/imu": {"gyro": "w_b"}}, "carrier"),
    "indexer": ([*xyz("theta"), *GYRO[:9]], {"/imu": {"gyro": "w_it"}}, "platform"),
}


def sensors(n: int = 200) -> dict[str, series.Topic]:
    """IMUs, a magnetometer and a thermometer, logged at their stamps."""
    t = T0 + 10_000_000 * np.arange(n)

    def imu() -> series.ImuSeries:
        return series.ImuSeries(
            t,
            RNG.normal(size=(n, 3)),
            RNG.normal(size=(n, 3)) + [0.0, 0.0, 9.8],
            RNG.normal(size=(n, 4)),
            gyro_cov=np.diag([1e-6, 2e-6, 3e-6]),
            wxyz_cov=np.diag([1e-4, 1e-4, 1e-4]),
            frame_id="imu_link",
        )

    return {
        "/imu": imu(),
        "/head/imu": imu(),
        "/platform/imu": imu(),
        "/mag": series.MagneticSeries(t, RNG.normal(size=(n, 3)), field_cov=np.diag([1e-3] * 3), frame_id="mag_link"),
        "/temperature": series.TemperatureSeries(t[::20], 20.0 + RNG.random(n // 20)),
        "/image": series.ImageSeries(t[::20], [RNG.bytes(int(k)) for k in RNG.integers(0, 9000, n // 20)]),
    }


def raw(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Log times and bytes by topic, by the reader of the format's authors."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


@pytest.mark.parametrize("method", CASES)
def test_corrected_samples_are_those_of_python(method: str, tmp_path: Path) -> None:
    names, expected, frame = CASES[method]
    topics, calibration = sensors(), saved(method, names, constants={"first_temperature": 20.0})
    write_session(tmp_path / "s.mcap", topics, {"notes.txt": b"kept"})
    applied = door.apply(tmp_path / "s.mcap", calibration, tmp_path / "c.mcap")
    assert [topic.recorded for topic in applied.topics] == list(expected)
    recording = open_recording(tmp_path / "c.mcap")
    assert recording.attachment("notes.txt") == b"kept"
    for name, results in expected.items():
        given: Any = topics[name]
        made: Any = recording.magnetic(f"{name}_calibrated") if name == "/mag" else recording.imu(f"{name}_calibrated")
        if name == "/mag":
            measured = {"mag": given.field}
        else:
            measured = {"platform_gyro" if name == "/platform/imu" else "gyro": given.gyro, "accel": given.accel}
            if method == "tumble":
                warm: Any = topics["/temperature"]
                measured["temperature"] = np.interp(given.t_ns - T0, warm.t_ns - T0, warm.celsius)
        if name == "/platform/imu" or method == "indexer":
            measured.pop("accel")
        applied_by_hand = calibration.apply(**measured)
        np.testing.assert_array_equal(made.t_ns, given.t_ns)
        assert made.frame_id == ("cube" if method == "cube" else frame)
        for column, result in results.items():
            np.testing.assert_allclose(getattr(made, column), applied_by_hand[result], rtol=1e-9, atol=1e-12)
        # Of the first sensor, column by column: the covariance of noise through the correction.
        column = next(iter(results))
        rng, C = np.random.default_rng(1), getattr(given, f"{column}_cov")[0]
        noise = rng.multivariate_normal(np.zeros(3), C, 20_000)
        key = "mag" if name == "/mag" else next(iter(measured))
        still = {other: values[:1] for other, values in measured.items()} | {key: measured[key][:1] + noise}
        still = {other: np.broadcast_to(v, (len(noise), *v.shape[1:])) for other, v in still.items()}
        sample = np.cov(calibration.apply(**still)[results[column]].T)
        np.testing.assert_allclose(getattr(made, f"{column}_cov")[0], sample, rtol=0.05, atol=0.03 * sample.max())
        if name != "/mag" and frame == "imu_link":
            np.testing.assert_array_equal(made.wxyz, given.wxyz)
        elif name != "/mag":
            assert (made.wxyz_cov[:, 0, 0] == -1.0).all()


@pytest.mark.parametrize(("method", "turn"), [("los", "M"), ("indexer", "mRt")])
def test_mounting_turns_the_accelerometer_with_the_gyro(method: str, turn: str, tmp_path: Path) -> None:
    topics, calibration = sensors(), saved(method, CASES[method][0])
    write_session(tmp_path / "s.mcap", topics)
    door.apply(tmp_path / "s.mcap", calibration, tmp_path / "c.mcap")
    from alidade.factors import so3

    made, given = open_recording(tmp_path / "c.mcap").imu("/imu_calibrated"), topics["/imu"]
    assert isinstance(given, series.ImuSeries)
    rotation = calibration.apply()[turn]
    rotation = rotation if method == "los" else so3.inverse(rotation)
    np.testing.assert_allclose(made.accel, so3.rotate(rotation, given.accel), rtol=1e-9)
    np.testing.assert_array_equal(made.accel_cov, 0.0)  # unknown stays unknown


def test_everything_recorded_is_copied_to_the_byte(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", session())
    calibration = saved("tumble", triad("mag"))
    door.apply(tmp_path / "s.mcap", calibration, tmp_path / "c.mcap", suffix="/corrected")
    before, after = raw(tmp_path / "s.mcap"), raw(tmp_path / "c.mcap")
    corrected = after.pop("/mag/corrected")
    assert after == before
    assert [log for log, _ in corrected] == [log for log, _ in before["/mag"]]


def test_a_corrected_topic_is_no_other_sensor_whatever_its_suffix(tmp_path: Path) -> None:
    """One with a suffix of one's own was once proposed as the platform's gyro."""
    write_session(tmp_path / "s.mcap", {"/head/imu": sensors()["/head/imu"]})
    calibration = saved("head", GYRO)
    door.apply(tmp_path / "s.mcap", calibration, tmp_path / "c.mcap", suffix="/corrected")
    door.apply(tmp_path / "c.mcap", calibration, tmp_path / "d.mcap", suffix="/again")
    corrected = open_recording(tmp_path / "d.mcap")
    assert {"/head/imu/corrected", "/head/imu/again"} <= corrected.topics.keys()
    assert idle(corrected, Config(), "head") == ()


def test_messages_that_nobody_reads_are_copied(tmp_path: Path) -> None:
    """Without a schema, without content, in an encoding of their own, of undefined types."""
    write_session(tmp_path / "m.mcap", {"/mag": sensors(60)["/mag"]})
    with (tmp_path / "s.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        kind, text = forms.ros2_schema("sensor_msgs/msg/MagneticField")
        mag = writer.register_channel("/mag", "cdr", writer.register_schema(kind, "ros2msg", text))
        bare = writer.register_channel("/bare", "json", 0)
        own = writer.register_channel("/own", "x-own", writer.register_schema("own/Type", "x-own", b"what"))
        empty = writer.register_channel("/empty", "ros1", writer.register_schema("std_msgs/Empty", "ros1msg", b""))
        for t, data in raw(tmp_path / "m.mcap")["/mag"]:
            writer.add_message(mag, t, data, t)
            for channel, other in ((bare, b"{}"), (own, RNG.bytes(int(RNG.integers(0, 9)))), (empty, b"")):
                writer.add_message(channel, t + 1, other, t + 1)
        writer.finish()  # type: ignore[no-untyped-call]
    door.apply(tmp_path / "s.mcap", saved("tumble", triad("mag")), tmp_path / "c.mcap")
    after = raw(tmp_path / "c.mcap")
    assert len(after.pop("/mag_calibrated")) == 60
    assert after == raw(tmp_path / "s.mcap")


@pytest.mark.parametrize("form", forms.FORMS)
def test_every_form_of_a_recording(form: str, tmp_path: Path) -> None:
    calibration = saved("tumble", [*triad("accel"), *triad("mag")])
    topics = {name: topic for name, topic in sensors(60).items() if name in ("/imu", "/mag")}
    write_session(tmp_path / "s.mcap", topics)
    door.apply(tmp_path / "s.mcap", calibration, tmp_path / "direct.mcap")
    other = forms.FORMS[form](tmp_path / "s.mcap", tmp_path)
    door.apply(other, calibration, tmp_path / "c.mcap")
    found, expected = raw(tmp_path / "c.mcap"), raw(tmp_path / "direct.mcap")
    assert found.keys() == expected.keys()
    for name in ("/imu_calibrated", "/mag_calibrated"):
        assert found[name] == expected[name]
    recording = open_recording(tmp_path / "c.mcap")
    np.testing.assert_array_equal(recording.imu("/imu").accel, open_recording(tmp_path / "s.mcap").imu("/imu").accel)


def test_a_table_becomes_a_recording(tmp_path: Path) -> None:
    values = np.round(RNG.normal(size=(50, 3)), 6)
    rows = [f"{0.01 * i:.2f},{x},{y},{z}" for i, (x, y, z) in enumerate(values.tolist())]
    (tmp_path / "m.csv").write_text("\n".join(["t,mx,my,mz", *rows, ""]))
    calibration = saved("tumble", triad("mag"))
    columns = {"/mag": {"file": "m.csv", "time": "t", "field": ["mx", "my", "mz"]}}
    door.apply(tmp_path / "m.csv", calibration, tmp_path / "c.mcap", config={"columns": columns})
    recording = open_recording(tmp_path / "c.mcap")
    np.testing.assert_allclose(recording.magnetic("/mag_calibrated").field, calibration.apply(mag=values)["m_b"])
    np.testing.assert_array_equal(recording.magnetic("/mag").field, values)


def test_a_gyro_and_an_accelerometer_on_topics_of_their_own(tmp_path: Path) -> None:
    given: Any = sensors()["/imu"]
    late = given.t_ns + 3_000_000
    topics = {
        "/gyro": series.VectorSeries(given.t_ns, given.gyro, frame_id="gyro"),
        "/accel": series.VectorSeries(late, given.accel),
    }
    write_session(tmp_path / "s.mcap", topics)
    calibration = saved("tumble", [*triad("accel"), *GYRO])
    config = {"topics": {"imu": {"gyro": "/gyro", "accel": "/accel", "axes": ["y", "-x", "z"]}}}
    (topic,) = door.apply(tmp_path / "s.mcap", calibration, tmp_path / "c.mcap", config=config).topics
    made = open_recording(tmp_path / "c.mcap").imu("/gyro_calibrated")
    read = open_recording(tmp_path / "s.mcap").with_config(Config.model_validate(config).topics.values())
    imu = read.imu("/gyro with /accel along y, -x, z")
    np.testing.assert_array_equal(imu.gyro[:, 0], given.gyro[:, 1])
    np.testing.assert_allclose(made.gyro, calibration.apply(gyro=imu.gyro, accel=imu.accel)["w_b"])
    assert (topic.name, topic.sensors, topic.messages.frame_id) == (
        "/gyro_calibrated", ("gyro", "accelerometer"), "gyro",
    )  # fmt: skip


def test_rates_alone_become_an_imu_without_accelerometer(tmp_path: Path) -> None:
    given: Any = sensors()["/platform/imu"]
    write_session(tmp_path / "s.mcap", {"/platform/imu": series.VectorSeries(given.t_ns, given.gyro)})
    calibration = saved("head", xyz("platform_bias"))
    door.apply(tmp_path / "s.mcap", calibration, tmp_path / "c.mcap")
    made = open_recording(tmp_path / "c.mcap").imu("/platform/imu_calibrated")
    np.testing.assert_allclose(made.gyro, calibration.apply(platform_gyro=given.gyro)["w_ib"], rtol=1e-12)
    np.testing.assert_array_equal(made.accel, 0.0)
    assert (made.accel_cov[:, 0, 0] == -1.0).all()


def test_sensors_that_were_not_calibrated_stay_as_recorded(tmp_path: Path) -> None:
    topics = sensors()
    write_session(tmp_path / "s.mcap", topics)
    applied = door.apply(tmp_path / "s.mcap", saved("tumble", triad("accel")), tmp_path / "c.mcap")
    assert [(topic.name, topic.sensors) for topic in applied.topics] == [("/imu_calibrated", ("accelerometer",))]
    given: Any = topics["/imu"]
    np.testing.assert_array_equal(open_recording(tmp_path / "c.mcap").imu("/imu_calibrated").gyro, given.gyro)


def test_damaged_recordings_are_corrected_as_far_as_they_are_read(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", session(20_000))
    data = (tmp_path / "s.mcap").read_bytes()
    (tmp_path / "s.mcap").write_bytes(data[: len(data) * 2 // 3])
    applied = door.apply(tmp_path / "s.mcap", saved("tumble", triad("mag")), tmp_path / "c.mcap")
    assert any("truncated" in note for note in applied.notes)
    assert len(raw(tmp_path / "c.mcap")["/mag_calibrated"]) == len(raw(tmp_path / "c.mcap")["/mag"]) > 0
    with pytest.raises(InputError, match="--strict"):
        door.apply(tmp_path / "s.mcap", saved("tumble", triad("mag")), tmp_path / "d.mcap", strict=True)


def test_what_cannot_be_corrected_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    topics, tumble = sensors(), saved("tumble", triad("mag"))
    write_session(tmp_path / "s.mcap", topics)
    write_session(tmp_path / "bare.mcap", {"/imu": topics["/imu"]})
    door.apply(tmp_path / "s.mcap", tumble, tmp_path / "c.mcap")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    cases = [
        ("s.mcap", tumble, "s.mcap", "that is the recording"),
        ("c.mcap", tumble, "d.mcap", "/mag_calibrated is there already"),
        ("bare.mcap", tumble, "d.mcap", "nothing is there that the calibration"),
        ("bare.mcap", saved("tumble", [*triad("accel"), *GYRO, *SLOPES]), "d.mcap", "takes temperature too"),
        ("s.mcap", tumble.model_copy(update={"formulas": ["x = y"]}), "d.mcap", "formulas in the calibration are not"),
        ("s.mcap", tumble, "no/d.mcap", "cannot be written"),
        ("s.mcap", tumble, "d.csv", "an MCAP file is written: name it d.mcap"),
    ]
    for recording, calibration, out, message in cases:
        with pytest.raises(InputError, match=message):
            door.apply(tmp_path / recording, calibration, tmp_path / out)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_method_that_corrects_nothing_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_session(tmp_path / "s.mcap", sensors())
    tumble = methods.method("tumble")
    without = dataclasses.replace(tumble, report=methods.Report())
    monkeypatch.setattr(methods, "method", lambda _: without)
    with pytest.raises(InputError, match="method tumble corrects no sensor's readings"):
        door.apply(tmp_path / "s.mcap", saved("tumble", triad("mag")), tmp_path / "c.mcap")


def test_command(tmp_path: Path, alidade: Command) -> None:
    recording, results, out = tmp_path / "s.mcap", tmp_path / "results", tmp_path / "c.mcap"
    assert alidade("simulate", "tumble", "--scenario", "tumble_imu", "--seed", "3", "--out", recording).code == 0
    assert alidade("calibrate", recording, "--out", results, "--solver", "published").code == 0
    run = alidade("apply", recording, results / "calibration.yaml", "--out", out)
    assert (run.code, run.err) == (0, "")
    assert "/imu_calibrated: accelerometer of /imu, 12094 messages, frame b" in run.out
    run = alidade("apply", recording, results / "calibration.yaml", "--out", tmp_path / "d.mcap", "--json")
    told = json.loads(run.out)
    assert told["schema"] == "alidade.applied/1"
    assert [topic["name"] for topic in told["topics"]] == ["/imu_calibrated", "/mag_calibrated"]
    run = alidade("apply", recording, results / "calibration.yaml", "--out", recording)
    assert (run.code, run.out) == (2, "")
    assert run.err.count("\n") == 1


# Scenarios and the parameters that a corrected recording has at identity, by their beginnings.
ROUND_TRIPS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "tumble": ("tumble_imu", ("accel_k", "accel_b", "mag_k", "mag_b")),
    "head": ({"duration_s": 30.0}, ("gyro_bias", "gyro_scale", "gyro_skew")),
    "los": ({"duration_s": 30.0}, ("delta_g", "delta_z", "gyro_bias", "gyro_scale", "gyro_skew")),
    "indexer": (None, ("theta", "gyro_bias")),
    "cube": ({"poses": 20}, ("accel_k", "accel_b", "gyro_k", "gyro_b", "mag_k", "mag_b")),
}


@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=[pytest.mark.slow] * (name != "tumble")) for name in ROUND_TRIPS]
)
def test_calibration_of_the_corrected_topics_is_identity(method: str, tmp_path: Path) -> None:
    """The noise is the same in both, so that estimates differ from identity by parts of a sigma."""
    scenario, names = ROUND_TRIPS[method]
    chosen = methods.method(method)
    chosen.write(tmp_path / "s.mcap", door.simulate(method, scenario, seed=3))
    first = door.calibrate(tmp_path / "s.mcap")
    applied = door.apply(tmp_path / "s.mcap", first, tmp_path / "c.mcap")
    topics = {topic.key: f"{topic.name}_calibrated" for topic in chosen.topics}
    corrected = {topic.name for topic in applied.topics}
    config = {"topics": {key: name for key, name in topics.items() if name in corrected}}
    second = door.calibrate(tmp_path / "c.mcap", config=config)
    checked = {name: p for name, p in second.parameters.items() if name.startswith(names)}
    assert second.status == "calibrated"
    assert checked
    distance = {name: (p.value - IDENTITY.get(name, 0.0)) / p.sigma for name, p in checked.items()}
    assert max(map(abs, distance.values())) < 2.0, distance
    before = [first.parameters[name].value - IDENTITY.get(name, 0.0) for name in checked]
    assert max(abs(x) / p.sigma for x, p in zip(before, checked.values(), strict=True)) > 10.0
