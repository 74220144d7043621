"""A fleet from recordings to files, and files and JSON of fleets and studies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from alidade.pipelines.applications.fleet.analysis import (
    Population,
    counting,
    populations,
    sentence,
    table,
    units_of_interest,
)
from alidade.pipelines.applications.fleet.fleet import Outcome, Settings, calibrate_fleet
from alidade.pipelines.applications.fleet.histories import History, change_table, histories
from alidade.pipelines.applications.fleet.montecarlo import Study, run_table, summary_table
from alidade.pipelines.applications.fleet.pages import fleet_report, study_report
from alidade.pipelines.applications.fleet.recordings import find
from alidade.pipelines.applications.fleet.store import csv_text, write_parquet
from alidade.pipelines.files import write_whole
from alidade.pipelines.reports.html import render_html
from alidade.pipelines.reports.plain_json import plain_json


@dataclass(frozen=True, repr=False)
class FleetResult:
    """Results of a calibrated fleet: by recording, of parameters over units, of units over recordings; the files."""

    outcome: Outcome
    populations: Sequence[Population]
    histories: Sequence[History]
    written: tuple[Path, ...]

    @property
    def summary(self) -> list[str]:
        """Summary: how many recordings with what verdicts, and which units need attention."""
        units = units_of_interest(self.outcome.results, self.populations, self.histories)
        return [*self.outcome.summary, sentence(units)]

    def __repr__(self) -> str:
        return f"<FleetResult: {self.outcome.summary[0]}>"


def fleet(
    recordings: Sequence[str | Path],
    out: str | Path,
    *,
    method: str | None = None,
    config: str | Path | None = None,
    solver: str = "batch",
    window: float | None = 1.0,
    names: str | None = None,
    prior: str | None = None,
    scheduler: str | None = None,
    jobs: int | None = None,
) -> FleetResult:
    """Calibrate recordings of many units (paths or patterns); writes fleet.html and tables to `out` and resumes there.

    Raises:
        InputError: a pattern matches nothing, or a setting cannot be used.
    """
    settings, out = Settings.of(method, None if config is None else Path(config), solver, window, prior), Path(out)
    outcome = calibrate_fleet(find([str(each) for each in recordings]), settings, out, scheduler, jobs, names)
    several = histories(outcome.results, {name: counting(result) for name, result in outcome.results.items()})
    found = populations(outcome.results, several)
    return FleetResult(outcome, found, several, write_fleet(out, outcome, found, several))


def write_fleet(out: Path, outcome: Outcome, fleet: Sequence[Population], found: Sequence[History]) -> tuple[Path, ...]:
    """Write a fleet's report and tables (CSV, Parquet), all of them or none; returns their paths."""
    rows = table(outcome.results, fleet)
    return write_whole(
        out,
        {
            "fleet.csv": csv_text(rows),
            "fleet.parquet": partial(write_parquet, rows=rows),
            "changes.csv": csv_text(change_table(found)),
            "fleet.html": render_html(fleet_report(outcome, fleet, found)),
        },
    )


def fleet_json(found: FleetResult) -> str:
    """JSON of `fleet`: rows of fleet.csv and changes.csv, components of every parameter, who needs attention."""
    outcome, fleet, histories = found.outcome, found.populations, found.histories
    return plain_json(
        "fleet",
        {
            "recordings": table(outcome.results, fleet),
            "changes": change_table(histories),
            "attention": units_of_interest(outcome.results, fleet, histories),
            "parameters": [
                {"name": p.name, "method": p.method, "of_device": p.of_device}
                | {"population": p.population, "repeatability": p.repeatability}
                for p in fleet
            ],
            "wanted": outcome.recordings,
            "interrupted": outcome.interrupted,
        },
    )


def study_json(study: Study) -> str:
    """JSON of `montecarlo`: the rows of runs.csv and summary.csv."""
    return plain_json(
        "montecarlo",
        {
            "method": study.method,
            "scenario": study.scenario,
            "runs": run_table(study),
            "summary": summary_table(study),
            "wanted": study.seeds,
            "interrupted": study.interrupted,
        },
    )


def write_study(out: Path, study: Study) -> tuple[Path, ...]:
    """Write runs.csv, summary.csv and montecarlo.html, all or none of them; return their paths."""
    return write_whole(
        out,
        {
            "runs.csv": csv_text(run_table(study)),
            "summary.csv": csv_text(summary_table(study)),
            "montecarlo.html": render_html(study_report(study)),
        },
    )
