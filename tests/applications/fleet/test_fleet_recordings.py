"""A fleet of simulated recordings with planted faults, from files to the page."""

from __future__ import annotations

import csv
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.pipelines.applications.fleet import engine
from alidade.pipelines.applications.fleet.fleet import Settings, calibrate_recording
from alidade.pipelines.applications.fleet.recordings import find
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from tests.support.browser import fits
from tests.support.fleet_command import alidade
from tests.support.forms import split

pytest.importorskip("distributed", reason="needs the extra alidade[fleet]")
pytest.importorskip("arro3.io", reason="needs the extra alidade[fleet]")

DATES = ("20260301", "20260401")
UNITS_VARY = 0.2  # deg, from unit to unit
NAMES = ("--names", "{unit}_{date}")


def scenario(mount_deg: tuple[float, float, float], one_axis: bool = False) -> HeadScenario:
    """Six seconds of a helmet on a manoeuvring platform; the helmet's mount is unknown."""
    swing = {"amplitude_deg": 40.0, "frequency_hz": 0.3}
    head = {"yaw": [swing], "pitch": [] if one_axis else [swing | {"frequency_hz": 0.4}], "roll": []}
    return HeadScenario.model_validate(
        {
            "duration_s": 6.0,
            "head": head,
            "helmet_mount_deg": mount_deg,
            "gyro_rate_hz": 100.0,
            "vision_rate_hz": 20.0,
            "truth_rate_hz": 1.0,
            "priors": {"time_offset": 0},
            "sensors": "ideal",
        }
    )


def write(path: Path, seed: int, mount_deg: Any, one_axis: bool = False) -> Path:
    settings = scenario(tuple(mount_deg), one_axis)
    data, truth = simulate_head(settings, seed)
    method("head").write_data(path, data, truth, head_config(settings))
    return path


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine units at one date and five at two, among them four faults."""
    folder = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(5)
    for unit in range(14):
        mount = UNITS_VARY * rng.standard_normal(3)
        if unit == 3:
            mount += [0.0, 6.0, 0.0]  # has drifted away from the fleet
        for i, date in enumerate(DATES if unit >= 9 else DATES[unit % 2 :][:1]):
            if unit == 10 and i == 1:
                mount += [0.0, 0.0, 4.0]  # was knocked between the dates
            write(folder / f"U{unit:02}_{date}.mcap", 100 + 2 * unit + i, mount, one_axis=unit == 5)
    corrupt = folder / f"U08_{DATES[0]}.mcap"
    content = bytearray(corrupt.read_bytes())
    third = len(content) // 3
    content[third : 2 * third] = rng.bytes(third)
    corrupt.write_bytes(content)
    return folder


def failures(rows: dict[str, dict[str, str]]) -> dict[str, str]:
    return {name: row["exit_code"] for name, row in rows.items() if row["exit_code"] != "0"}


def page_text(path: Path) -> str:
    """What a reader sees of a page."""
    text = re.sub(r"<(script|style).*?</\1>", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]+>", " ", text).split())


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def calibrated(recordings: Path, local_cluster: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the command on them."""
    out = tmp_path_factory.mktemp("fleet")
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert (
            alidade(monkeypatch, "fleet", recordings / "*.mcap", *NAMES, "--scheduler", local_cluster, "--out", out)
            == 0
        )
    return out


def test_the_table_as_json_and_turn_on_biases_are_no_change(
    calibrated: Path,
    recordings: Path,
    local_cluster: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Biases differ by many sigmas from recording to recording in every unit, and have a repeatability for it."""
    common = ("fleet", recordings / "*.mcap", *NAMES, "--scheduler", local_cluster, "--out", calibrated)
    assert alidade(monkeypatch, *common, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["schema"], printed["wanted"], printed["interrupted"]) == ("alidade.fleet/1", 19, False)
    rows = {row["recording"]: row for row in rows_of(calibrated / "fleet.csv")}
    assert [unit["name"] for unit in printed["attention"]] == ["U10", "U03", "U08", "U05"]
    assert {row["recording"]: row["status"] for row in printed["recordings"]} == {
        k: v["status"] for k, v in rows.items()
    }
    assert any(change["unit"] == "U10" for change in printed["changes"])
    assert not [row for row in rows_of(calibrated / "changes.csv") if row["parameter"].startswith("gyro_bias")]
    parameters = {p["name"]: p for p in printed["parameters"]}
    bias, mount = parameters["gyro_bias_x"], parameters["helmet_mount_x"]
    assert (bias["of_device"], mount["of_device"]) == (False, True)
    assert bias["repeatability"]["value"] > 3.0 * bias["repeatability"]["sigma"]
    true = np.deg2rad(UNITS_VARY)
    assert mount["population"]["value"] == pytest.approx(true, abs=4.0 * mount["population"]["sigma"])
    assert mount["repeatability"]["value"] < 3.0 * (mount["repeatability"]["sigma"] or np.inf)
    assert mount["repeatability"]["upper"] < true


def test_the_table_is_complete(calibrated: Path) -> None:
    rows = rows_of(calibrated / "fleet.csv")
    assert len({row["recording"] for row in rows}) == len(rows) == 19
    assert len({row["unit"] for row in rows}) == 14
    good = [row for row in rows if row["status"] == "calibrated"]
    assert len(good) == 17
    for row in good:
        assert row["exit_code"] == "0"
        assert 0.0 < float(row["helmet_mount_x_sigma"]) < 0.01


def test_planted_faults_are_told_apart(calibrated: Path, tmp_path: Path) -> None:
    rows = {row["recording"].rsplit("/")[-1]: row for row in rows_of(calibrated / "fleet.csv")}
    assert failures(rows) == {f"U08_{DATES[0]}.mcap": "2", f"U05_{DATES[1]}.mcap": "3"}
    assert "damaged" in rows[f"U08_{DATES[0]}.mcap"]["reason"]
    assert "motion about two axes" in rows[f"U05_{DATES[1]}.mcap"]["reason"]
    changed = [row for row in rows_of(calibrated / "changes.csv") if row["changed"] == "1"]
    assert [(row["unit"], row["parameter"]) for row in changed] == [("U10", "helmet_mount_z")]
    assert float(changed[0]["difference"]) == pytest.approx(np.deg2rad(4.0), abs=5.0 * float(changed[0]["sigma"]))
    fits((calibrated / "fleet.html").read_text(), tmp_path)
    text = page_text(calibrated / "fleet.html")
    attention = text.split("Which units need attention?")[1].split("Parameters")[0]
    assert set(re.findall(r"U\d\d(?= )", attention)) >= {"U03", "U10", "U08", "U05"}
    assert "4 units need attention: U10, U03" in attention
    assert "helmet_mount about z moved by 4.0" in attention


def test_parquet_and_csv_say_the_same(calibrated: Path) -> None:
    from arro3.io import read_parquet

    table = read_parquet(calibrated / "fleet.parquet").read_all()
    rows = rows_of(calibrated / "fleet.csv")
    assert list(table.column_names) == list(rows[0])
    for name in ("recording", "exit_code", "helmet_mount_x", "reason"):
        cells = ["" if cell is None else str(cell) for cell in table[name].to_pylist()]
        assert cells == [row[name] for row in rows]


def test_nothing_is_done_twice(
    recordings: Path,
    local_cluster: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of files, config and version that are the same."""

    def run(pattern: str, *options: object) -> str:
        common = (*NAMES, "--scheduler", local_cluster, "--out", tmp_path / "out")
        assert alidade(monkeypatch, "fleet", tmp_path / pattern, *common, *options) == 0
        return capsys.readouterr().out

    for path in sorted(recordings.glob("U0[0-2]*.mcap")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    assert "2 of 2 recordings, 0 from an earlier run" in run("U0[01]*.mcap")
    before = (tmp_path / "out" / "results.jsonl").read_text()
    assert "3 of 3 recordings, 2 from an earlier run" in run("*.mcap")
    after = (tmp_path / "out" / "results.jsonl").read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == 3
    # A line cut off by a fall of the machine costs that one.
    (tmp_path / "out" / "results.jsonl").write_text(after[:-20])
    assert "3 of 3 recordings, 2 from an earlier run" in run("*.mcap")
    write(tmp_path / f"U00_{DATES[0]}.mcap", 999, (0.0, 0.0, 0.0))
    assert "3 of 3 recordings, 2 from an earlier run" in run("*.mcap")
    config = tmp_path / "config.yaml"
    config.write_text("noise: {vision_attitude: 0.009}\n")
    assert "1 of 1 recordings, 0 from an earlier run" in run("U00*.mcap", "--config", config)


@pytest.mark.parametrize("seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 20))])
def test_no_damage_of_a_file_costs_more_than_its_row(recordings: Path, tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    content = bytearray((recordings / f"U00_{DATES[0]}.mcap").read_bytes())
    if seed % 2:
        del content[int(rng.integers(len(content))) :]
    else:
        # Half of the changes near the end, where the index and the metadata's place are.
        first = len(content) - 3000 if seed % 4 else 0
        for place in rng.integers(first, len(content), 20):
            content[place] ^= int(rng.integers(1, 256))
    (tmp_path / "U.mcap").write_bytes(content)
    (recording,) = find([str(tmp_path / "U.mcap")]).values()
    result = calibrate_recording(recording, Settings())
    assert result is not None
    assert result["exit_code"] in (0, 2, 3, 4)
    assert "\n" not in result["reason"]


def test_recordings_come_from_other_file_systems(
    recordings: Path, local_cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An archive stands for S3: no path on this machine."""
    with zipfile.ZipFile(tmp_path / "campaign.zip", "w") as archive:
        for path in sorted(recordings.glob("U0[01]*.mcap")):
            archive.write(path, path.name)
    where = f"zip://*.mcap::{tmp_path}/campaign.zip"
    assert alidade(monkeypatch, "fleet", where, *NAMES, "--scheduler", local_cluster, "--out", tmp_path / "out") == 0
    rows = rows_of(tmp_path / "out" / "fleet.csv")
    assert [(row["unit"], row["status"]) for row in rows] == [("U00", "calibrated"), ("U01", "calibrated")]


def test_bag_folders_are_recordings(
    calibrated: Path, recordings: Path, local_cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By their names, by those of their parts, in an archive: each is one, with the numbers of the file it was."""
    source = next(iter(sorted(recordings.glob("U00*.mcap"))))
    bags = tmp_path / "bags"
    bags.mkdir()
    bag = split(source, bags / "ride")
    with (bag / "metadata.yaml").open("a") as metadata:
        metadata.write("  custom_data:\n    unit: 007\n")
    for pattern in ("ride", "*", "**/*.mcap", "ride/*"):
        assert list(find([f"{bags}/{pattern}"])) == [str(bag)]
    assert list(find([f"{bag}/ride_0.mcap"])) == [f"{bag}/ride_0.mcap"]
    with zipfile.ZipFile(tmp_path / "campaign.zip", "w") as archive:
        for path in sorted(bag.iterdir()):
            archive.write(path, f"ride/{path.name}")
    (tmp_path / "config.yaml").write_text(head_config(scenario((0.0, 0.0, 0.0))))
    common = ("--config", tmp_path / "config.yaml", "--scheduler", local_cluster, "--out", tmp_path / "out")
    assert alidade(monkeypatch, "fleet", bags / "*", f"zip://*::{tmp_path}/campaign.zip", *common) == 0
    rows = rows_of(tmp_path / "out" / "fleet.csv")
    (alone,) = (row for row in rows_of(calibrated / "fleet.csv") if row["unit"] == "U00")
    assert [row["unit"] for row in rows] == ["007", "007"]
    for row in rows:
        assert float(row["helmet_mount_x"]) == pytest.approx(float(alone["helmet_mount_x"]), rel=1e-9)


def test_unit_and_date_come_from_metadata(
    recordings: Path, local_cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of any record, or of rosbag2's custom data; else the file's name and the start of the recording stand in."""
    source = next(iter(sorted(recordings.glob("U00*.mcap"))))
    yaml = "version: 9\nstorage_identifier: mcap\ncustom_data:\n  unit: 007\n  date: 2026-02-03\n"
    with_metadata(source, tmp_path / "a.mcap", "campaign", {"unit": "U99", "date": "2026-02-01T10:00"})
    with_metadata(source, tmp_path / "b.mcap", "rosbag2", {"serialized_metadata": yaml})
    (tmp_path / "c.mcap").write_bytes(source.read_bytes())
    assert (
        alidade(monkeypatch, "fleet", tmp_path / "*.mcap", "--scheduler", local_cluster, "--out", tmp_path / "out") == 0
    )
    rows = rows_of(tmp_path / "out" / "fleet.csv")
    assert [(row["unit"], row["date"]) for row in rows] == [
        ("U99", "2026-02-01T10:00:00Z"),
        ("007", "2026-02-03T00:00:00Z"),
        ("c", "2026-11-20T12:00:00Z"),
    ]


def test_each_unit_begins_from_its_own_calibration(
    recordings: Path, local_cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording is done again when that has changed; one whose unit has none is told."""
    for path in [recordings / f"{unit}_{DATES[1]}.mcap" for unit in ("U09", "U11", "U12")]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    for unit in ("U09", "U11"):
        before = recordings / f"{unit}_{DATES[0]}.mcap"
        assert alidade(monkeypatch, "calibrate", before, "--quiet", "--out", tmp_path / "last" / unit) == 0

    def run() -> dict[str, dict[str, str]]:
        command = ("fleet", tmp_path / "*.mcap", *NAMES, "--scheduler", local_cluster, "--out", tmp_path / "out")
        assert alidade(monkeypatch, *command, "--prior", tmp_path / "last" / "{unit}" / "result.json") == 0
        return {row["unit"]: row for row in rows_of(tmp_path / "out" / "fleet.csv")}

    rows = run()
    assert [rows[unit]["exit_code"] for unit in ("U09", "U11", "U12")] == ["0", "0", "2"]
    assert "cannot be opened" in rows["U12"]["reason"]
    first = json.loads((tmp_path / "last" / "U09" / "result.json").read_text())
    alone = {p["name"]: p["sigma"] for p in first["parameters"]}
    # About as much as the first recording again.
    ratio = float(rows["U09"]["helmet_mount_x_sigma"]) / alone["helmet_mount_x"]
    assert ratio == pytest.approx(0.5**0.5, abs=0.1)
    (tmp_path / "last" / "U11" / "result.json").write_bytes((tmp_path / "last" / "U09" / "result.json").read_bytes())
    again = run()
    assert again["U09"] == rows["U09"]
    assert again["U11"]["helmet_mount_x"] != rows["U11"]["helmet_mount_x"]


def with_metadata(source: Path, target: Path, name: str, content: dict[str, str]) -> None:
    """A copy of a recording with a metadata record."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as stream, target.open("wb") as copy:
        writer = Writer(copy)
        writer.start("ros2")
        reader = make_reader(stream)
        channels: dict[int, int] = {}
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.add_metadata(name, content)
        writer.finish()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere/*.mcap"], "no recording matches nowhere/*.mcap"),
        (["{recordings}/"], "/*.mcap'"),
        (["{recordings}/*.mcap", "--names", "{unit}-{date}"], "does not fit --names {unit}-{date}"),
        (["{recordings}/*.mcap", "--names", "unit"], "needs {unit}, {date} or both"),
        (["{recordings}/*.mcap", "--method", "gyro"], "no method 'gyro'"),
        (["{recordings}/*.mcap", "--config", "nowhere.yaml"], "nowhere.yaml"),
        (
            ["{recordings}/*.mcap", "--out", "{recordings}/U00_20260301.mcap/out"],
            "U00_20260301.mcap is no folder)",
        ),
        (
            ["{recordings}/*.mcap", "--out", "s3://bucket/out"],
            "s3:/bucket/out: results are kept in a folder of this machine",
        ),
        (["{recordings}/*.mcap", "--jobs", "0"], "--jobs 0"),
        (["{recordings}/*.mcap", "--jobs", "0", "--out", "a/b/c"], "--jobs 0"),
        (["{recordings}/*.mcap", "--jobs", "2", "--scheduler", "tcp://127.0.0.1:1"], "not together with --scheduler"),
        (
            ["{recordings}/*.mcap", "--scheduler", "tcp://127.0.0.1:1"],
            "no scheduler at tcp://127.0.0.1:1: start one with `dask scheduler`, and workers with `dask worker tcp",
        ),
        (["gopher://x/*.mcap"], "gopher"),
    ],
)
def test_bad_input_is_one_line(
    recordings: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(engine, "_REACH", 1.0)
    code = alidade(monkeypatch, "fleet", *(a.replace("{recordings}", str(recordings)) for a in arguments))
    error = capsys.readouterr().err
    assert code == 2
    assert len(error.splitlines()) == 1
    assert said in error
    assert not list(tmp_path.iterdir())
