"""The files of a study or a fleet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from alidade.pipelines.applications.fleet.analysis import Population, table
from alidade.pipelines.applications.fleet.fleet import Outcome
from alidade.pipelines.applications.fleet.histories import History, change_table
from alidade.pipelines.applications.fleet.montecarlo import Study, run_table, summary_table
from alidade.pipelines.applications.fleet.pages import fleet_report, study_report
from alidade.pipelines.applications.fleet.tables import write_csv, write_parquet
from alidade.pipelines.reports.html import render_html
from alidade.pipelines.reports.whole import write_whole


def write_fleet(out: Path, outcome: Outcome, fleet: Sequence[Population], found: Sequence[History]) -> tuple[Path, ...]:
    """fleet.html, fleet.csv, fleet.parquet and changes.csv, whole or not at all; returns their paths."""
    rows = table(outcome.results, fleet)
    page = render_html(fleet_report(outcome, fleet, found))

    def make(folder: Path) -> None:
        write_csv(folder / "fleet.csv", rows)
        write_parquet(folder / "fleet.parquet", rows)
        write_csv(folder / "changes.csv", change_table(found))
        (folder / "fleet.html").write_text(page, encoding="utf-8")

    return write_whole(out, ["fleet.csv", "fleet.parquet", "changes.csv", "fleet.html"], make)


def write_study(out: Path, study: Study) -> tuple[Path, ...]:
    """montecarlo.html, runs.csv and summary.csv, whole or not at all; returns their paths."""

    def make(folder: Path) -> None:
        write_csv(folder / "runs.csv", run_table(study))
        write_csv(folder / "summary.csv", summary_table(study))
        (folder / "montecarlo.html").write_text(render_html(study_report(study)), encoding="utf-8")

    return write_whole(out, ["runs.csv", "summary.csv", "montecarlo.html"], make)
