"""The runner of the benchmarks and its gate."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

import alidade
from alidade.pipelines.solvers.engines import Compiled
from benchmarks import __main__ as runner
from benchmarks import broad, static
from benchmarks.batch import los_problem, los_recording, native_los, solve
from benchmarks.measure import Ratio, costs, growth, worse

SLOW = """
from benchmarks.measure import Ratio, costs

def run():
    a, b = costs([lambda: sum(range(100_000)), lambda: sum(range(1_000_000))])
    # Not of the times: the machine's load must not decide a test.
    yield Ratio("toy.sum", "short over long sum", 0.1, tolerance=0.5, ours=a, theirs=b)
"""


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A benchmark of its own among the others, and a folder."""
    import benchmarks

    (tmp_path / "toy.py").write_text(SLOW)
    monkeypatch.setattr(benchmarks, "__path__", [*benchmarks.__path__, str(tmp_path)])
    # Processes the runner starts find it beside the real ones.
    (tmp_path / "sitecustomize.py").write_text(
        f"import sys; sys.path.insert(0, {str(Path(runner.__file__).parents[1])!r})\n"
        f"import benchmarks; benchmarks.__path__.append({str(tmp_path)!r})\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


def test_gate_passes_its_own_baseline_and_fails_a_ratio_made_worse(
    toy: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    baseline, report = toy / "baseline.json", toy / "report.json"
    common = ["toy", "--baseline", str(baseline)]
    assert runner.main([*common, "--save", "--json", str(report)], ("toy",)) == 0
    (measured,) = json.loads(report.read_text())
    assert measured["ours"][0] < measured["theirs"][0]
    assert measured["ours"][1] > 1.0  # MiB
    assert runner.main([*common, "--gate"], ("toy",)) == 0
    baseline.write_text(json.dumps({"toy.sum": measured["value"] / 10.0}))
    capfd.readouterr()
    assert runner.main([*common, "--gate"], ("toy",)) == 1
    assert "toy.sum" in capfd.readouterr().err


@pytest.mark.usefixtures("few_solutions")
@pytest.mark.parametrize(("words", "is_checked"), [((), True), (("--no-check",), False)])
def test_broad_ends_incremental_runs_as_the_command_does(
    words: tuple[str, ...],
    is_checked: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "01.mat").touch()
    session = alidade.open(alidade.simulate("head", {"duration_s": 4.0, "gyro_rate_hz": 100.0}, seed=1))
    monkeypatch.setattr(broad, "read_trial", lambda _: None)
    monkeypatch.setattr(broad, "_parts", lambda *_: [(0.0, session)])
    monkeypatch.setattr(broad, "_line", lambda _, calibration: " ".join(calibration.notes))
    assert broad.main(["--data", str(tmp_path), "--noise", "0", "--solver", "incremental", *words]) == 0
    assert ("all measurements were solved together" in capsys.readouterr().out) == is_checked


def test_unknown_names_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert runner.main(["nothing"], ("toy",)) == 2
    assert "no benchmark nothing" in capsys.readouterr().err


@pytest.mark.parametrize(("better", "good", "bad"), [("lower", 1.2, 1.4), ("higher", 0.8, 0.7)])
def test_worse_is_beyond_the_tolerance_in_its_direction(better: str, good: float, bad: float) -> None:
    ratio = Ratio("a", "b", good, "lower" if better == "lower" else "higher", 0.3)
    assert worse([ratio], {"a": 1.0}) == []
    assert len(worse([replace(ratio, value=bad)], {"a": 1.0})) == 1
    assert worse([replace(ratio, value=bad)], {}) == []


def test_growth_is_the_exponent() -> None:
    assert growth([1e3, 1e4, 1e5], [2e-3, 2e-2 * 10**0.1, 0.2 * 10**0.2]) == pytest.approx(1.1)


def test_peak_memory_is_that_of_the_work() -> None:
    small, large = costs([lambda: np.zeros(10), lambda: np.ones(8_000_000)], rounds=1, warm=False)
    assert large.peak_mib is not None
    assert small.peak_mib is not None
    assert 50.0 < large.peak_mib - small.peak_mib < 75.0


def test_committed_baseline_names_what_is_measured() -> None:
    baseline = json.loads(runner.BASELINE.read_text())
    assert {name.split(".")[0] for name in baseline} <= set(runner.SUITE)
    assert all(value > 0.0 for value in baseline.values())


def test_the_native_graph_has_the_gyro_between_its_keyframes_and_converges() -> None:
    _, data = los_recording(200)
    graph, values = native_los(data)
    keyframes = values.size() - 2
    assert graph.size() == (keyframes - 1) + keyframes + 2
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    optimizer.optimize()
    # Only the measurements have noise, part of which the keyframes follow.
    assert 0.3 < 2.0 * optimizer.error() / (3 * keyframes) < 1.0
    assert solve(Compiled.of(los_problem(200))).converged


def test_static_minimum_is_that_of_the_normal_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(static, "ROWS", 3_000)
    for model, start in (static.linear_rates(), static.accelerometer()):
        np.testing.assert_allclose(static.ours(model, start), static.normal_equations(model, start), rtol=1e-6)


def test_scipy_gets_the_rows_of_our_graph() -> None:
    from benchmarks.peers import los_peers

    problem, rows = los_peers()
    compiled = Compiled.of(problem)
    ours = compiled.engine.under(None).cost(compiled.initial)
    assert np.square(rows.residuals(rows.x0)).sum() == pytest.approx(ours, rel=1e-2)
