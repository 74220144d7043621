"""Recordings and earlier calibrations on object storage: an S3 server, asked over HTTP from other processes."""

from __future__ import annotations

import csv
import json
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import pytest

from alidade.pipelines.applications.fleet.fleet import Settings, calibrate_recording
from alidade.pipelines.applications.fleet.recordings import find
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from tests.support.builders import IDEAL
from tests.support.command import Command

fsspec = pytest.importorskip("fsspec", reason="needs the extra alidade[fleet]")
pytest.importorskip("distributed", reason="needs the extra alidade[fleet]")

UNITS = 4


@dataclass
class Bucket:
    """The bucket `campaign` of a server, and what has been asked of it."""

    store: Any
    server: Any
    asked: list[str] = field(default_factory=list)

    def put(self, source: Path, name: str) -> None:
        self.store.put_file(str(source), f"campaign/{name}")

    def fetched(self) -> list[str]:
        """Names of the objects that were fetched, once for each time, since this was last asked."""
        names = [m[1] for line in self.asked if (m := re.search(r'"GET /campaign/([^ ?]+) ', line))]
        self.asked.clear()
        return sorted(names)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    # Imported here: it takes a second, also where these tests are left out.
    pytest.importorskip("s3fs", reason="needs the extra alidade[s3]")
    moto = pytest.importorskip("moto.server", reason="needs the tests' tools, alidade[dev]")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    address = f"http://{host}:{port}"
    # Servers of one process share what they hold.
    urlopen(Request(f"{address}/moto-api/reset", method="POST")).close()
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "tester")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    store = fsspec.filesystem("s3")
    store.mkdir("campaign")
    made = Bucket(store, server)
    log = logging.getLogger("werkzeug")
    handler = logging.Handler()
    handler.emit = lambda record: made.asked.append(record.getMessage())  # type: ignore[method-assign]
    log.addHandler(handler)
    yield made
    log.removeHandler(handler)
    server.stop()
    fsspec.get_filesystem_class("s3").clear_instance_cache()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    for seed in range(UNITS + 1):
        write(folder / f"U{seed}.mcap", seed)
    return folder


def write(path: Path, seed: int) -> None:
    scenario = HeadScenario(duration_s=4.0, gyro_rate_hz=100.0, vision_rate_hz=20.0, truth_rate_hz=1.0, sensors=IDEAL)
    data, truth = simulate_head(scenario, seed)
    method("head").write_data(path, data, truth, head_config(scenario))


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / "fleet.csv").open(newline="") as stream:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(stream)]


@pytest.mark.slow
def test_a_campaign_on_object_storage(bucket: Bucket, recordings: Path, tmp_path: Path, alidade: Command) -> None:
    """The numbers are those of the same files on disk; each object is fetched once, and again only when it changed."""
    for unit in range(UNITS):
        bucket.put(recordings / f"U{unit}.mcap", f"2026/U{unit}.mcap")
    out, common = tmp_path / "out", ("fleet", "s3://campaign/*/U*.mcap", "--jobs", "2", "--out")
    first = alidade(*common, out)
    assert (first.code, first.err) == (0, "")
    assert bucket.fetched() == [f"2026/U{unit}.mcap" for unit in range(UNITS)]
    rows = rows_of(out)
    assert [row["recording"] for row in rows] == [f"s3://campaign/2026/U{unit}.mcap" for unit in range(UNITS)]
    assert alidade("fleet", recordings / "U[0-3].mcap", "--jobs", "2", "--out", tmp_path / "local").code == 0
    local = rows_of(tmp_path / "local")
    assert [row | {"recording": ""} for row in rows] == [row | {"recording": ""} for row in local]

    again = alidade(*common, out)
    assert f"{UNITS} of {UNITS} recordings, {UNITS} from an earlier run" in again.out
    assert bucket.fetched() == []
    assert rows_of(out) == rows

    bucket.put(recordings / f"U{UNITS}.mcap", "2026/U1.mcap")
    bucket.put(recordings / f"U{UNITS}.mcap", "2026/U9.mcap")
    changed = alidade(*common, out)
    assert f"{UNITS + 1} of {UNITS + 1} recordings, {UNITS - 1} from an earlier run" in changed.out
    assert bucket.fetched() == ["2026/U1.mcap", "2026/U9.mcap"]
    now = rows_of(out)
    assert [i for i in range(UNITS) if now[i]["sha256"] != rows[i]["sha256"]] == [1]
    assert now[1]["sha256"] == now[4]["sha256"]
    assert now[1]["helmet_mount_x"] == now[4]["helmet_mount_x"] != rows[1]["helmet_mount_x"]


@pytest.mark.slow
def test_objects_that_cannot_be_read_cost_their_row(bucket: Bucket, recordings: Path, tmp_path: Path) -> None:
    """Damaged, deleted since they were listed, or out of reach; what was not read is tried again."""
    damaged = bytearray((recordings / "U0.mcap").read_bytes())
    third = len(damaged) // 3
    damaged[third : 2 * third] = bytes(third)
    (tmp_path / "U0.mcap").write_bytes(damaged)
    bucket.put(tmp_path / "U0.mcap", "U0.mcap")
    for unit in (1, 2):
        bucket.put(recordings / f"U{unit}.mcap", f"U{unit}.mcap")
    found = find(["s3://campaign/*.mcap"])
    bucket.store.rm("campaign/U1.mcap")
    made = {name.rsplit("/")[-1]: calibrate_recording(each, Settings()) for name, each in found.items()}
    results = {name: result for name, result in made.items() if result is not None}
    assert {name: result["exit_code"] for name, result in results.items()} == {"U0.mcap": 2, "U1.mcap": 2, "U2.mcap": 0}
    assert "sha256" in results["U0.mcap"]
    assert results["U1.mcap"]["reason"].startswith("s3://campaign/U1.mcap: cannot be read: ")
    bucket.server.stop()
    unreached = calibrate_recording(found["s3://campaign/U2.mcap"], Settings())
    assert unreached is not None
    assert unreached["exit_code"] == 2
    assert "s3://campaign/U2.mcap: cannot be read: Could not connect" in unreached["reason"]
    assert not {"sha256", "tag"} & {*results["U1.mcap"], *unreached}


@pytest.mark.slow
def test_units_begin_from_calibrations_on_object_storage(
    bucket: Bucket, recordings: Path, tmp_path: Path, alidade: Command
) -> None:
    bucket.put(recordings / "U0.mcap", "U0.mcap")
    bucket.put(recordings / "U1.mcap", "U1.mcap")
    assert alidade("calibrate", recordings / "U2.mcap", "--quiet", "--out", tmp_path / "last").code == 0
    bucket.put(tmp_path / "last" / "result.json", "last/U0/result.json")
    address = "s3://campaign/last/{unit}/result.json"
    out = tmp_path / "out"
    run = alidade("fleet", "s3://campaign/*.mcap", "--prior", address, "--jobs", "1", "--out", out, "--json")
    assert run.code == 0
    first, second = json.loads(run.out)["recordings"]
    assert (first["status"], second["exit_code"]) == ("calibrated", 2)
    assert second["reason"].startswith("s3://campaign/last/U1/result.json: cannot be read: ")
    (recording,) = find([str(recordings / "U0.mcap")]).values()
    on_disk = calibrate_recording(recording, Settings(prior=str(tmp_path / "last" / "result.json")))
    assert on_disk is not None
    row = next(iter(rows_of(out)))
    for name, parameter in on_disk["parameters"].items():
        assert (float(row[name]), float(row[f"{name}_sigma"])) == (parameter["value"], parameter["sigma"])


@pytest.mark.slow
def test_faults_of_object_storage_are_one_line(
    bucket: Bucket, tmp_path: Path, alidade: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(*words: str) -> str:
        run = alidade("fleet", *words, "--out", tmp_path / "out")
        assert (run.code, run.out, len(run.err.splitlines())) == (2, "", 1)
        return run.err

    assert "no recording matches s3://nowhere/*.mcap" in said("s3://nowhere/*.mcap")
    assert "no recording matches s3://campaign/*.mcap" in said("s3://campaign/*.mcap")
    assert "s3://campaign/last.json: cannot be read" in said(
        "s3://campaign/*.mcap", "--prior", "s3://campaign/last.json"
    )
    bucket.server.stop()
    assert "s3://campaign/*.mcap: cannot be looked up: Could not connect" in said("s3://campaign/*.mcap")
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    assert "cannot be looked up: Unable to locate credentials" in said("s3://campaign/*.mcap")
