"""A fleet of simulated recordings with planted faults, from files to the page."""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines import cli
from pipelines.sessions.head import write_head
from pipelines.simulation.head import HeadScenario, head_config, simulate_head

pytest.importorskip("distributed", reason="needs the extra alidade[fleet]")
pytest.importorskip("arro3.io", reason="needs the extra alidade[fleet]")

ROOT = Path(__file__).parents[1]
DATES = ("20260301", "20260401")
UNITS_VARY = 0.2  # deg, from unit to unit
COMMON = ("--names", "{unit}_{date}", "--jobs", 2)


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
        }
    )


def write(path: Path, seed: int, mount_deg: Any, one_axis: bool = False) -> Path:
    settings = scenario(tuple(mount_deg), one_axis)
    data, truth = simulate_head(settings, seed)
    write_head(path, data, truth, head_config(settings))
    return path


@pytest.fixture(scope="module")
def forty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """30 units at one date and 5 at two, among them four faults."""
    folder = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(5)
    for unit in range(35):
        mount = UNITS_VARY * rng.standard_normal(3)
        if unit == 7:
            mount += [0.0, 6.0, 0.0]  # has drifted away from the fleet
        for i, date in enumerate(DATES if unit >= 30 else DATES[unit % 2 :][:1]):
            if unit == 33 and i == 1:
                mount += [0.0, 0.0, 4.0]  # was knocked between the dates
            write(folder / f"U{unit:02}_{date}.mcap", 100 + 2 * unit + i, mount, one_axis=unit == 12)
    corrupt = folder / f"U20_{DATES[0]}.mcap"
    content = bytearray(corrupt.read_bytes())
    third = len(content) // 3
    content[third : 2 * third] = rng.bytes(third)
    corrupt.write_bytes(content)
    return folder


def alidade(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["alidade", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


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
def calibrated(forty: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the command on the forty."""
    out = tmp_path_factory.mktemp("fleet")
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert alidade(monkeypatch, "fleet", forty / "*.mcap", *COMMON, "--out", out) == 0
    return out


def test_the_table_is_complete(calibrated: Path) -> None:
    rows = rows_of(calibrated / "fleet.csv")
    assert len({row["recording"] for row in rows}) == len(rows) == 40
    assert len({row["unit"] for row in rows}) == 35
    good = [row for row in rows if row["status"] == "calibrated"]
    assert len(good) == 38
    for row in good:
        assert row["exit_code"] == "0"
        assert 0.0 < float(row["helmet_mount_x_sigma"]) < 0.01


def test_planted_faults_are_told_apart(calibrated: Path) -> None:
    rows = {row["recording"].rsplit("/")[-1]: row for row in rows_of(calibrated / "fleet.csv")}
    assert failures(rows) == {f"U20_{DATES[0]}.mcap": "2", f"U12_{DATES[0]}.mcap": "3"}
    assert "damaged" in rows[f"U20_{DATES[0]}.mcap"]["reason"]
    assert "motion about two axes" in rows[f"U12_{DATES[0]}.mcap"]["reason"]
    changed = [row for row in rows_of(calibrated / "changes.csv") if row["changed"] == "1"]
    assert [(row["unit"], row["parameter"]) for row in changed] == [("U33", "helmet_mount_z")]
    assert float(changed[0]["difference"]) == pytest.approx(np.deg2rad(4.0), abs=5.0 * float(changed[0]["sigma"]))
    text = page_text(calibrated / "fleet.html")
    outlying = text.split("Outlying units")[1].split("Units that changed")[0]
    # The unit that was knocked stands out after the knock, and is told from the drifted one by its change.
    assert set(re.findall(r"U\d\d(?= )", outlying)) == {"U07", "U33"}


def test_turn_on_biases_are_no_change(calibrated: Path) -> None:
    """They differ by many sigmas from session to session in every unit."""
    biases = [row for row in rows_of(calibrated / "changes.csv") if row["parameter"].startswith("gyro_bias")]
    assert sum(abs(float(row["z"])) > 3.0 for row in biases) > 0.6 * len(biases)
    assert all(row["changed"] == "0" for row in biases)


def test_parquet_and_csv_say_the_same(calibrated: Path) -> None:
    from arro3.io import read_parquet

    table = read_parquet(calibrated / "fleet.parquet").read_all()
    rows = rows_of(calibrated / "fleet.csv")
    assert list(table.column_names) == list(rows[0])
    for name in ("recording", "exit_code", "helmet_mount_x", "reason"):
        cells = ["" if cell.as_py() is None else str(cell.as_py()) for cell in table[name]]
        assert cells == [row[name] for row in rows]


def test_nothing_is_done_twice(
    forty: Path, calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of files, config and version that are the same; one new recording is calibrated, the others kept."""
    for path in sorted(forty.glob("U0[0-3]*.mcap")):
        (tmp_path / path.name).symlink_to(path)
    first = [tmp_path / "U00*.mcap", tmp_path / "U01*.mcap", tmp_path / "U02*.mcap"]
    assert alidade(monkeypatch, "fleet", *first, *COMMON, "--out", tmp_path / "out") == 0
    before = (tmp_path / "out" / "results.jsonl").read_text()
    assert alidade(monkeypatch, "fleet", tmp_path / "*.mcap", *COMMON, "--out", tmp_path / "out") == 0
    after = (tmp_path / "out" / "results.jsonl").read_text()
    assert "4 of 4 recordings, 3 from an earlier run" in capsys.readouterr().out
    assert after.startswith(before)
    assert len(after.splitlines()) == 4

    # Another content under the same name, and another config: done again.
    (tmp_path / f"U00_{DATES[0]}.mcap").unlink()
    write(tmp_path / f"U00_{DATES[0]}.mcap", 999, (0.0, 0.0, 0.0))
    assert alidade(monkeypatch, "fleet", tmp_path / "*.mcap", *COMMON, "--out", tmp_path / "out") == 0
    assert "3 from an earlier run" in capsys.readouterr().out
    config = tmp_path / "config.yaml"
    config.write_text("noise: {vision_attitude: 0.009}\n")
    assert (
        alidade(monkeypatch, "fleet", tmp_path / "*.mcap", *COMMON, "--out", tmp_path / "out", "--config", config) == 0
    )
    assert "0 from an earlier run" in capsys.readouterr().out
