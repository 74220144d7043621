"""compare.html: the solvers side by side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from alidade.factors.array import Array
from alidade.pipelines.applications.comparison import Comparison
from alidade.pipelines.diagnostics import cross_validation
from alidade.pipelines.diagnostics.cross_validation import SplitHalf, TrialFit, split_halves
from alidade.pipelines.diagnostics.fault_models import FaultModel
from alidade.pipelines.errors import InputError
from alidade.pipelines.reports.comparison_report import comparison_report
from alidade.pipelines.reports.html import render_html
from alidade.pipelines.reports.plots import common_plots
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config
from tests.support.browser import drawn, needs_browser
from tests.support.builders import make_calibration, make_problem
from tests.support.pages import Page


@dataclass(frozen=True)
class Stamps:
    """Data of a method of one stream."""

    t: Array


def page_of(calibrations: list[Calibration], halves: dict[str, SplitHalf], predicted: dict[str, float]) -> str:
    return render_html(comparison_report(Comparison(tuple(calibrations), halves, predicted, tested=True)))


def solvers(truth: dict[str, object] | None = None) -> list[Calibration]:
    """A batch result, and one that is two of its sigmas off."""
    batch = make_calibration(truth=truth)
    batch = replace(batch, estimate=replace(batch.estimate, solver="batch"))
    off = batch.estimate.values + 2.0 * batch.estimate.sigmas
    return [batch, replace(batch, estimate=replace(batch.estimate, solver="incremental", values=off))]


def test_differences_are_in_sigmas_of_batch() -> None:
    page = Page(page_of(solvers(), {}, {}))
    assert page.loaded == []
    estimated = [q for q in solvers()[0].problem.quantities if q.prior_sigma != 0.0]
    assert page.text.count("+2.0") == len(estimated)
    assert "difference from batch" in page.text
    assert "no Batch and incremental differ by 2.0 sigma" in page.text
    assert "Neither half determines a parameter by itself." in page.text


def test_answer_is_no_where_incremental_is_more_than_a_sigma_from_batch_or_halves_differ() -> None:
    batch, off = solvers()
    same = replace(batch, estimate=replace(batch.estimate, solver="incremental"))
    close, wide = SplitHalf(0.010, 0.003, 0.020, 0.004), SplitHalf(0.010, 0.003, 0.040, 0.004)
    assert Comparison((batch, off)).answer == "no"
    assert Comparison((batch, same)).answer == "yes"
    assert Comparison((batch, same), {"time_offset": close}, tested=True).answer == "yes"
    assert Comparison((batch, same), {"time_offset": wide}, tested=True).answer == "no"
    assert Comparison((batch, same), tested=True).answer == "cannot say"
    assert Comparison((batch,)).answer == "cannot say"


def test_a_half_without_a_solution_is_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its values at the end of the iterations were "106.8 sigma" from those of the other half."""
    solution = TrialFit.of(make_problem(), make_calibration().estimate)
    assert solution is not None
    lost = replace(solution, estimate=replace(solution.estimate, converged=False))
    trials = {"0 to 5 s": solution, "5 to 11 s": lost}
    monkeypatch.setattr(cross_validation, "solve_trial", lambda *given, **_: trials[given[-1]])
    faults = FaultModel(streams={"t": ()}, signs={})
    halves, unsolved = split_halves(lambda *_: make_problem(), faults, Stamps(np.linspace(0.0, 10.0, 5)), Config())
    assert (halves, unsolved) == ({}, ("second",))
    summary = comparison_report(Comparison(tuple(solvers()), {}, unsolved=unsolved, tested=True)).summary
    assert summary is not None
    assert "The second half does not determine the calibration by itself: it has no solution." in summary.text


def test_truth_halves_and_held_out_measurements_are_told() -> None:
    halves = {"time_offset": SplitHalf(0.010, 0.003, 0.020, 0.004)}
    page = Page(page_of(solvers({"time_offset": 0.0125}), halves, {"vision": 1.06}))
    assert "z: error over sigma" in page.text
    assert "Both halves agree in all 1 parameters: 2.0 sigma at most" in page.text
    assert "10.0 ± 3.0 20.0 ± 4.0 +2.0" in page.text
    assert "predicted to 1.06 (vision) of their sigmas" in page.text


def test_halves_that_differ_by_more_than_chance_are_told() -> None:
    halves = {"time_offset": SplitHalf(0.010, 0.003, 0.040, 0.004), "gyro_bias_x": SplitHalf(0.0, 1e-3, 1e-4, 1e-3)}
    page = Page(page_of(solvers(), halves, {}))
    assert "Do the solvers and both halves agree? no" in page.text
    assert "time_offset (+6.0)" in page.text


def test_ellipses_are_drawn_of_correlated_pairs_only() -> None:
    def titles(correlation: float) -> list[str]:
        covariance = np.diag([1e-6, 1e-6, 1e-6, 1e-8, 1e-8, 0.0])
        covariance[0, 1] = covariance[1, 0] = correlation * 1e-6
        return [plot.title for plot in common_plots(make_calibration(covariance=covariance))]

    assert "Most correlated parameters" in titles(0.9)
    assert "Most correlated parameters" not in titles(0.1)


def test_what_cannot_be_written_is_bad_input(tmp_path: Path) -> None:
    assert Comparison(tuple(solvers())).write(tmp_path / "new").read_text().startswith("<!doctype html>")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="no folder to write results to"):
        Comparison(tuple(solvers())).write(tmp_path / "file")


@needs_browser
def test_a_browser_draws_it_without_complaint(tmp_path: Path) -> None:
    text = page_of(solvers(), {"time_offset": SplitHalf(0.010, 0.003, 0.020, 0.004)}, {"vision": 1.06})
    assert drawn(text, tmp_path) == text.count('class="plot"') >= 2
