"""Files that are none, and YAML and SQLite that hold more than data: one line, at once, whatever reads them."""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from alidade.pipelines import files
from alidade.pipelines.applications.fleet.store import RecordingResult, Store, csv_text
from alidade.pipelines.applications.follow.sources import source_of
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import MAX_YAML_BYTES, load_yaml
from alidade.pipelines.recording.opening import bag_metadata, group_recordings
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.reports.calibration import load_calibration, load_known
from alidade.pipelines.reports.certificate import certificate
from alidade.pipelines.simulation.scenario import load_scenario
from tests.support.command import Command

READERS: dict[str, Callable[[Path], object]] = {
    "recording": open_recording,
    "config": lambda path: load_config(None, path),
    "prior": load_known,
    "calibration": load_calibration,
    "certificate": certificate,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["device", "pipe", "folder", "link to itself", "missing"])
def test_what_is_no_regular_file_is_refused_at_once(reader: str, kind: str, tmp_path: Path) -> None:
    path = {"device": Path("/dev/zero"), "folder": tmp_path}.get(kind, tmp_path / "x")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link to itself":
        path.symlink_to(path)
    start = time.monotonic()
    with pytest.raises(InputError) as refused:
        READERS[reader](path)
    assert time.monotonic() - start < 1.0
    assert str(path) in str(refused.value)


@pytest.mark.parametrize("kind", ["device", "pipe"])
def test_what_never_ends_is_not_followed(kind: str, tmp_path: Path) -> None:
    path = Path("/dev/zero") if kind == "device" else tmp_path / "x"
    if kind == "pipe":
        os.mkfifo(path)
    with pytest.raises(InputError, match="a device or a pipe, and no regular file"):
        source_of(str(path))


YAML = {
    "an empty whole number": "a: !!int ''",
    "no truth value": "a: !!bool x",
    "no float": "a: !!float ''",
    "no date": "a: !!timestamp x",
    "no bytes": "a: !!binary é",
    "no set": "a: !!set [b]",
    "aliases that multiply": "a: &a [x, x]\n"
    + "".join(f"{chr(b + 1)}: &{chr(b + 1)} [{', '.join([f'*{chr(b)}'] * 9)}]\n" for b in range(ord("a"), ord("y"))),
    "a circle": "a: &a [*a]",
    "deep": "a: " + "[" * 3_000,
    "many values": "[" + "1," * 3_000 + "]",
    "long": "x" * (MAX_YAML_BYTES + 1),
    "two documents": "---\na: 1\n---\nb: 1",
}


@pytest.mark.parametrize("case", YAML)
def test_yaml_of_any_make_is_one_line_for_every_reader(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "MAX_YAML_NODES", 2000)
    start = time.process_time()
    with pytest.raises(InputError) as refused:
        load_yaml(YAML[case], "x")
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 1000
    (tmp_path / "x.yaml").write_text(YAML[case])
    with pytest.raises(InputError):
        load_config(None, tmp_path / "x.yaml")
    assert bag_metadata(YAML[case]) == {}
    assert time.process_time() - start < 10.0


METADATA = {
    "names of 300 letters": f"rosbag2_bagfile_information: {{relative_file_paths: [{'x' * 300}.db3]}}",
    "names that are none": "rosbag2_bagfile_information: {relative_file_paths: [[1], {a: b}, 1.5, null]}",
    "a null character": 'rosbag2_bagfile_information: {relative_file_paths: ["a\\0b.db3"]}',
    **{case: f"rosbag2_bagfile_information: {{relative_file_paths: [x.mcap]}}\n{text}" for case, text in YAML.items()},
}


@pytest.mark.parametrize("case", METADATA)
def test_a_bag_folder_with_any_metadata_is_one_line(case: str, tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text(METADATA[case])
    with pytest.raises(InputError) as refused:
        open_recording(tmp_path)
    assert str(refused.value).isprintable()
    (tmp_path / "x.mcap").write_bytes(b"")
    assert group_recordings([tmp_path / "x.mcap"])


def test_metadata_that_links_to_itself_is_none(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").symlink_to(tmp_path / "metadata.yaml")
    with pytest.raises(InputError, match="a folder without a recording"):
        open_recording(tmp_path)


def test_dash_is_standard_input_for_a_config(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("latitude_deg: 12.5")
    with (tmp_path / "c.yaml").open() as stream:
        monkeypatch.setattr("sys.stdin", stream)
        assert load_config(None, Path("-")).latitude_deg == 12.5


# -- SQLite

TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
ROWS = "INSERT INTO topics VALUES(1, '/imu', 'sensor_msgs/msg/Imu', 'cdr');"
ENDLESS = "(WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT count(*) FROM c)"
SQLITE = {
    "a view of topics": f"CREATE VIEW topics AS SELECT {ENDLESS} AS id, 1 AS name, 1 AS type, 1 AS form;" + MESSAGES,
    "a view of messages": TOPICS + ROWS + f"CREATE VIEW messages AS SELECT {ENDLESS} AS topic_id, 1 AS timestamp;",
    "a view of definitions": TOPICS
    + ROWS
    + MESSAGES
    + f"CREATE VIEW message_definitions AS SELECT {ENDLESS} AS topic_type, 1 AS encoding;",
    "a computed column": TOPICS
    + ROWS
    + "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB AS (printf('%.*c', 200000000, 'x')) VIRTUAL); INSERT INTO messages VALUES(1, 1, 1);",
    "a stored computed column": TOPICS
    + ROWS
    + "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB AS (id) STORED);",
    "a virtual table": TOPICS + ROWS + "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data);",
    "no id": TOPICS.replace(" PRIMARY KEY", "") + MESSAGES + "INSERT INTO topics VALUES(NULL, '/imu', 'x', 'cdr');",
    "text as id": TOPICS.replace("INTEGER PRIMARY KEY", "TEXT")
    + MESSAGES
    + "INSERT INTO topics VALUES('x', '/imu', 'x', 'cdr');",
    "bytes as id": TOPICS.replace("INTEGER PRIMARY KEY", "BLOB")
    + MESSAGES
    + "INSERT INTO topics VALUES(x'00', '/imu', 'x', 'cdr');",
}


@pytest.mark.parametrize("case", SQLITE)
def test_sqlite_that_computes_is_refused_at_once(case: str, tmp_path: Path) -> None:
    path = tmp_path / "x.db3"
    database = sqlite3.connect(path)
    database.executescript(SQLITE[case])
    database.commit()
    database.close()
    start = time.process_time()
    with pytest.raises(InputError) as refused:
        open_recording(path).imu("/imu")
    assert str(refused.value).isprintable()
    assert time.process_time() - start < 5.0


def test_a_query_that_comes_to_no_row_is_ended(tmp_path: Path) -> None:
    """Whatever of SQLite gets past what is known to compute."""
    from alidade.pipelines.recording.sqlite_file import SqliteFile

    path = tmp_path / "x.db3"
    database = sqlite3.connect(path)
    database.executescript(TOPICS + ROWS + MESSAGES + "INSERT INTO messages VALUES(1, 1, 1, x'00');")
    database.close()
    file = SqliteFile(path)
    with file._open() as opened, pytest.raises(sqlite3.OperationalError, match="interrupted"):
        opened.execute(f"SELECT {ENDLESS}").fetchone()


# -- fleet

LINES = [
    b"1\n",
    b"[]\n",
    b"null\n",
    b"\xff\xfe\n",
    b"[" * 100_000 + b"\n",
    b'{"settings": "s", "name": 1, "result": {}}\n',
    b'{"settings": "s", "name": "x", "result": 3}\n',
    b'{"settings": "s", "name": "x", "result": {}}\n',
    b'{"settings": "s", "name": "x", "result": {"status": "x", "exit_code": 0, "reason": "", "parameters": {}}}\n',
    b'{"settings": "s"}\n',
    b"\n",
    b'{"settings": "s", "name": "cut',
]


def test_lines_that_are_no_results_are_passed_over_and_the_file_goes_on(tmp_path: Path) -> None:
    failed = RecordingResult(status="failed", exit_code=2, reason="no topics", parameters={})
    good = json.dumps({"settings": "s", "name": "a", "result": failed}).encode() + b"\n"
    (tmp_path / "results.jsonl").write_bytes(good.join(LINES))
    store = Store(tmp_path, "s", RecordingResult)
    assert store.results == {"a": failed}
    store.add("b", failed)
    with pytest.raises(InputError, match="another process keeps its results there"):
        Store(tmp_path, "s", RecordingResult)
    del store
    assert Store(tmp_path, "s", RecordingResult).results.keys() == {"a", "b"}


def test_no_cell_of_a_table_is_a_formula() -> None:
    names = ["=cmd|' /C calc'!A0", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1"]
    text = csv_text([{"unit": name, "value": -1.5} for name in (*names, "U17")])
    assert text.count("'") == len(names) + 2
    assert "-1.5" in text
    assert "\nU17," in text


# -- the system


def test_a_folder_for_temporary_files_without_room_is_one_line(
    alidade: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.mkdtemp", fails)
    run = alidade("calibrate", tmp_path / "x.mcap")
    assert run.code == 2
    assert run.err.count("\n") == 1
    assert "No space left on device" in run.err


def test_a_scenario_is_read_as_any_file(tmp_path: Path) -> None:
    from pydantic import BaseModel

    (tmp_path / "x.yaml").write_text(YAML["an empty whole number"])
    with pytest.raises(InputError, match="unreadable YAML"):
        load_scenario(BaseModel, tmp_path / "x.yaml")
