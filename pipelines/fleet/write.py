"""The files of a study or a fleet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.errors import InputError
from pipelines.fleet.analysis import Population, change_table, table
from pipelines.fleet.fleet import Outcome
from pipelines.fleet.montecarlo import Study, run_table, summary_table
from pipelines.fleet.pages import fleet_html, study_html
from pipelines.fleet.tables import Row, write_csv, write_parquet


def write_fleet(out: Path, outcome: Outcome, fleet: Sequence[Population]) -> tuple[Path, ...]:
    """fleet.csv, fleet.parquet, changes.csv and fleet.html; returns their paths."""
    rows = table(outcome.results, fleet)
    changes = change_table(fleet)
    written = _write(out, {"fleet": rows, "changes": changes}, {"fleet.html": fleet_html(outcome, fleet)})
    write_parquet(out / "fleet.parquet", rows)
    return (*written, out / "fleet.parquet")


def write_study(out: Path, study: Study) -> tuple[Path, ...]:
    """runs.csv, summary.csv and montecarlo.html; returns their paths."""
    tables = {"runs": run_table(study), "summary": summary_table(study)}
    return _write(out, tables, {"montecarlo.html": study_html(study)})


def _write(out: Path, tables: dict[str, list[Row]], pages: dict[str, str]) -> tuple[Path, ...]:
    try:
        for name, rows in tables.items():
            write_csv(out / f"{name}.csv", rows)
        for name, text in pages.items():
            (out / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: the results cannot be written ({error.strerror})") from error
    return (*(out / name for name in pages), *(out / f"{name}.csv" for name in tables))
