"""The files of a study or a fleet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from alidade.pipelines.applications.fleet.analysis import Population, table
from alidade.pipelines.applications.fleet.fleet import Outcome
from alidade.pipelines.applications.fleet.histories import History, change_table
from alidade.pipelines.applications.fleet.montecarlo import Study, run_table, summary_table
from alidade.pipelines.applications.fleet.pages import fleet_html, study_html
from alidade.pipelines.applications.fleet.tables import write_csv, write_parquet
from alidade.pipelines.errors import InputError


def write_fleet(out: Path, outcome: Outcome, fleet: Sequence[Population], found: Sequence[History]) -> tuple[Path, ...]:
    """fleet.html, fleet.csv, fleet.parquet and changes.csv; returns their paths."""
    rows = table(outcome.results, fleet)
    page = fleet_html(outcome, fleet, found)
    return _write(
        {
            out / "fleet.html": partial(_write_text, text=page),
            out / "fleet.csv": partial(write_csv, rows=rows),
            out / "fleet.parquet": partial(write_parquet, rows=rows),
            out / "changes.csv": partial(write_csv, rows=change_table(found)),
        }
    )


def write_study(out: Path, study: Study) -> tuple[Path, ...]:
    """montecarlo.html, runs.csv and summary.csv; returns their paths."""
    return _write(
        {
            out / "montecarlo.html": partial(_write_text, text=study_html(study)),
            out / "runs.csv": partial(write_csv, rows=run_table(study)),
            out / "summary.csv": partial(write_csv, rows=summary_table(study)),
        }
    )


def _write(files: Mapping[Path, Callable[[Path], None]]) -> tuple[Path, ...]:
    for path, write in files.items():
        try:
            write(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    return tuple(files)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
