"""Several minima: a deeper one is taken, one that is nearly as deep is told."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.estimation.problem import Problem, Step
from alidade.pipelines.methods.tumble.simulation import TumbledAccelerometer, TumbledMagnetometer, TumbleScenario
from alidade.pipelines.solvers.batch import CLOSE, solve_batch
from alidade.pipelines.solvers.engines import ALL, Compiled

# Iron by which one axis of the magnetometer says little.
STRONG = TumbleScenario(magnetometer=TumbledMagnetometer(soft_iron=0.3))


def tumbled(scenario: TumbleScenario, seed: int) -> Session:
    method = methods.method("tumble")
    return Session.of(method, method.simulate(scenario, seed))


def test_mirrored_values_explain_all_measurements_alike() -> None:
    both = TumbleScenario(attitudes=12, rest_s=2.0, accelerometer=TumbledAccelerometer())
    problem = tumbled(both, 0).problem()
    assert problem.elsewhere is not None
    compiled = Compiled.of(problem)
    layout, engine = compiled.layout, compiled.engine.under(None)
    measured = engine.with_groups([group for group in engine.groups if group.is_measurement])
    mirrored = problem.elsewhere(layout.to_gtsam(compiled.initial))
    costs = [measured.cost(layout.from_gtsam(values)) for values in mirrored]
    assert len(costs) == 7
    np.testing.assert_allclose(costs, measured.cost(compiled.initial), rtol=1e-9)


def test_a_solution_nearly_as_likely_is_told(tmp_path: Path) -> None:
    calibration = tumbled(STRONG, 1).calibrate()
    calibration.write(tmp_path)
    found = json.loads((tmp_path / "result.json").read_text())
    assert found["status"] == "calibrated"
    second = found["second_best"]
    assert 0.0 < second["chi_square"] < CLOSE
    k33 = calibration.parameters["mag_k33"]
    assert abs(second["parameters"]["mag_k33"] - k33.value) > 100.0 * k33.sigma
    (ambiguous,) = [each for each in found["findings"] if each["kind"] == "ambiguous_solution"]
    assert ambiguous["severity"] == "note"
    assert ambiguous["values"]["mag_k33"][0] == second["parameters"]["mag_k33"]
    sentence = f"chi-square with priors is higher by {second['chi_square']:.1f}"
    assert any(sentence in note for note in found["notes"])
    assert sentence in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("seed", range(4))
def test_nominal_recordings_have_one_solution(seed: int) -> None:
    session = tumbled(methods.method("tumble").settings(), seed)
    assert solve_batch(session.problem()).second is None


def test_the_deepest_minimum_is_found_from_another() -> None:
    problem = tumbled(STRONG, 1).problem()
    assert problem.elsewhere is not None
    best = solve_batch(problem)
    (first, *rest) = problem.steps(ALL)
    others = list(problem.elsewhere(first.initial))
    alone = []
    for other in others:
        begun: list[Step] = [replace(first, initial=other), *rest]
        lost: Problem = replace(problem, steps=lambda _, begun=begun: iter(begun))  # type: ignore[misc]
        np.testing.assert_allclose(solve_batch(lost).values, best.values, rtol=1e-3, atol=1e-7)
        alone.append(solve_batch(replace(lost, elsewhere=None)).values)
    assert any(np.abs(values - best.values).max() > 0.1 for values in alone)
