"""Anything at all as a recording, a message, a definition or a config: read, or refused in one line, and soon."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import images, messages
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Config
from tests.support import forms
from tests.support.damage import Whole, check_sound, read, write_small
from tests.support.raw_messages import T0, read_any, write_raw

KINDS = [
    messages.IMU,
    messages.MAGNETIC_FIELD,
    messages.VECTOR,
    messages.QUATERNION,
    messages.POSE,
    messages.NAV_SAT_FIX,
    messages.JOINT_STATE,
]


def fuzzed(small: int, long: int) -> pytest.MarkDecorator:
    """A property tried with a few examples, and as a slow test with many."""

    def trial(examples: int) -> settings:
        checks = list(HealthCheck)
        return settings(
            max_examples=examples, derandomize=True, deadline=None, database=None, suppress_health_check=checks
        )

    return pytest.mark.parametrize(
        "trial",
        [
            pytest.param(trial(small), id=f"{small} examples"),
            pytest.param(trial(long), id=f"{long} examples", marks=pytest.mark.slow),
        ],
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, Whole, Path]:
    """The bytes of a small recording, what is in it, and where to put damaged copies."""
    folder = tmp_path_factory.mktemp("fuzz")
    path = write_small(folder / "s.mcap", "zstd", n=60)
    return path.read_bytes(), read(open_recording(path)), folder / "copy.mcap"


@fuzzed(12, 3000)
def test_edits_of_a_recording(trial: settings, recording: tuple[bytes, Whole, Path]) -> None:
    """Bytes replaced, removed and inserted: never a number that was not recorded, never a loss that is not told."""
    data, whole, path = recording
    place = st.integers(0, len(data))
    edits = st.lists(st.tuples(place, st.integers(0, 40), st.binary(max_size=40)), min_size=1, max_size=6)

    @trial
    @given(edits)
    def property_(edits: list[tuple[int, int, bytes]]) -> None:
        copy = data
        for at, removed, put in edits:
            copy = copy[:at] + put + copy[at + removed :]
        path.write_bytes(copy)
        check_sound(path, whole)

    property_()


@fuzzed(40, 5000)
def test_bytes_as_a_recording(trial: settings, recording: tuple[bytes, Whole, Path]) -> None:
    path = recording[2]
    opcodes = st.integers(1, 15).map(lambda opcode: bytes([opcode]))
    record = st.builds(
        lambda opcode, body, more: opcode + (len(body) + more).to_bytes(8, "little") + body,
        opcodes,
        st.binary(max_size=80),
        st.sampled_from([0, 0, 0, 1, 2**32, 2**63 - 100]),
    )

    @trial
    @given(st.lists(record, max_size=8), st.binary(max_size=20))
    def property_(records: list[bytes], end: bytes) -> None:
        path.write_bytes(b"\x89MCAP0\r\n" + b"".join(records) + end)
        with suppress(InputError):
            found = open_recording(path)
            _ = found.times, found.notes

    property_()


@pytest.mark.parametrize("kind", KINDS)
@fuzzed(15, 500)
def test_bytes_as_messages(trial: settings, kind: str, tmp_path: Path) -> None:
    text = messages.definition_text(kind)

    @trial
    @given(st.lists(st.binary(max_size=400).map(lambda tail: b"\0\1\0\0" + tail) | st.binary(max_size=40), min_size=1))
    def property_(data: list[bytes]) -> None:
        path = write_raw(tmp_path / "x.mcap", "/x", kind, text, data, [T0 + i for i in range(len(data))])
        with suppress(InputError):
            assert len(read_any(path, kind)["t_ns"]) == len(data)

    property_()


@fuzzed(15, 3000)
def test_texts_as_definitions(trial: settings, tmp_path: Path) -> None:
    lines = messages.definition_text(messages.JOINT_STATE).splitlines()
    words = ["float64", "string", "std_msgs/Header", "a/B", "int8[4]", "string[]", "x", "=" * 80, "MSG: a/B"]
    names = st.sampled_from(words)
    letters = st.text(st.characters(codec="utf-8"), max_size=20)
    line = st.sampled_from(lines) | st.tuples(names, letters).map(" ".join) | letters

    @trial
    @given(st.lists(line, max_size=12).map("\n".join) | st.just("\n".join(lines)), st.binary(max_size=60))
    def property_(text: str, data: bytes) -> None:
        path = write_raw(tmp_path / "x.mcap", "/x", messages.JOINT_STATE, text, [b"\0\1\0\0" + data], [T0])
        with suppress(InputError):
            read_any(path, messages.JOINT_STATE)

    property_()


@fuzzed(6, 150)
def test_texts_as_idl(trial: settings, tmp_path: Path) -> None:
    kind = messages.IMU
    lines = forms.idl(kind)[1].decode().splitlines()
    words = [
        "module a {",
        "};",
        "struct x {",
        "double y;",
        "sequence<double, 3> z;",
        "typedef long a__3[3];",
        "@a(b=1)",
    ]
    letters = st.text(st.characters(codec="utf-8"), max_size=20)
    line = st.sampled_from(lines) | st.sampled_from(words) | letters
    edits = st.lists(st.tuples(st.integers(0, len(lines)), st.integers(0, 3), line), max_size=3)

    @trial
    @given(edits, st.binary(max_size=60))
    def property_(edits: list[tuple[int, int, str]], data: bytes) -> None:
        text = list(lines)
        for at, removed, put in edits:
            text[at : at + removed] = [put]
        written = "\n".join(text).encode(errors="replace")
        path = tmp_path / "x.mcap"
        message = b"\0\1\0\0" + data
        forms.mcap([("/x", "", T0, b"")], path, lambda *_: message, "cdr", "ros2idl", lambda _: (kind, written))
        with suppress(InputError):
            read_any(path, kind)

    property_()


@fuzzed(20, 500)
def test_bytes_as_a_video(trial: settings) -> None:
    head = forms.h264_parameters(32, 32)
    unit = st.binary(max_size=60).map(lambda body: b"\0\0\0\1" + body)

    @trial
    @given(
        st.lists(st.tuples(st.booleans(), unit, unit).map(lambda m: (head if m[0] else b"") + m[1] + m[2]), max_size=4)
    )
    def property_(packets: list[bytes]) -> None:
        with suppress(ValueError):
            assert len(list(images.decode_video(enumerate(packets), "h264"))) == len(packets)

    property_()


@fuzzed(40, 10_000)
def test_anything_as_a_config(trial: settings) -> None:
    keys = st.sampled_from(
        [*Config.model_fields, "imu", "tags", "board", "gyro_density", "delta_px", "size", "16", "raw"]
    )
    value = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys | st.text(max_size=4), inner, max_size=4),
        max_leaves=12,
    )

    @trial
    @given(st.dictionaries(keys, value, max_size=4).map(json.dumps) | st.text(max_size=80))
    def property_(text: str) -> None:
        with suppress(InputError):
            load_config(text.encode(errors="surrogatepass"))

    property_()
