"""A graph divided into stretches of time against the same in one piece."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from rich.console import Console

from alidade.pipelines import parallel, progress
from alidade.pipelines.estimation.problem import Array, Estimate, Factor, Problem
from alidade.pipelines.solvers import system
from alidade.pipelines.solvers.assembly import CHUNK, Assembly
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.coloured import added_variance
from alidade.pipelines.solvers.influence import influence
from alidade.pipelines.solvers.marginals import IndeterminateError, joint_information
from alidade.pipelines.solvers.stretch import Keep
from tests.support.short_problems import head_problem, los_problem


def stretches(monkeypatch: pytest.MonkeyPatch, problem: Problem) -> tuple[system.System, gtsam.Values]:
    """A problem's system from now on in stretches of a hundred variables, and first guesses."""
    monkeypatch.setattr(system, "_UNDIVIDED", 100)
    monkeypatch.setattr(system, "_STRETCH", 100)
    whole = Assembly.of(problem.steps(CHUNK))
    found = system.System.of(whole.factors, whole.shared(problem), problem.loss, whole.boundaries)
    assert len(found.stretches) > 3
    assert sum(len(stretch.factors) for stretch in found.stretches) == len(whole.factors)
    return found, whole.initial


def divided(monkeypatch: pytest.MonkeyPatch, problem: Problem) -> Estimate:
    """The solution in stretches of a hundred variables."""
    stretches(monkeypatch, problem)
    return solve_batch(problem, budget=True, device=[problem.quantities[0].name])


@pytest.mark.parametrize("make", [los_problem, head_problem])
def test_stretches_leave_a_band(make: Callable[[], Problem], monkeypatch: pytest.MonkeyPatch) -> None:
    """A bias that walks is held by all stretches: eliminated first it would join them all."""
    joint, values = stretches(monkeypatch, make())
    cliques = joint.linearized(values).triangular.cliques
    assert max(len(clique.own) + len(clique.above) for clique in cliques) < 60 < sum(len(c.own) for c in cliques)


def test_what_is_known_moves_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """The states follow in either, those of stretches too."""
    whole = Assembly.of(los_problem().steps(CHUNK))
    shared = whole.shared(los_problem())
    alone = system.System.of(whole.factors, shared, None, whole.boundaries)
    parts, values = stretches(monkeypatch, los_problem())
    moved, expected = (each.linearized(values).of_the_known() for each in (parts.under(None), alone))
    for key in values.keys():
        np.testing.assert_allclose(moved.at(key), expected.at(key), atol=1e-9)
    assert max(np.abs(moved.at(key)).max() for key in values.keys()) > 1e-4


@pytest.mark.parametrize("whole", [True, False])
def test_states_follow_where_what_is_shared_is_moved(whole: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a step does that holds it there, but for what the step would do anyway."""
    assembly = Assembly.of(los_problem().steps(CHUNK))
    shared = assembly.shared(los_problem())
    alone = system.System.of(assembly.factors, shared, None, assembly.boundaries)
    values, parts = assembly.initial, alone if whole else stretches(monkeypatch, los_problem())[0].under(None)
    dims = values.dims()
    ends = np.cumsum([dims[key] for key in shared])
    moves = 1e-3 * np.random.default_rng(0).standard_normal((ends[-1], 2))
    linear = alone.linearized(values)
    still = linear.holding({key: np.zeros(dims[key]) for key in shared}).step()[0]
    for move, followed in zip(moves.T, parts.linearized(values).followed(shared, moves), strict=True):
        step = linear.holding(dict(zip(shared, np.split(move, ends[:-1]), strict=True))).step()[0]
        for key in values.keys():
            expected = step.at(key) - still.at(key)
            np.testing.assert_allclose(values.localCoordinates(followed).at(key), expected, atol=1e-9)


@pytest.mark.parametrize("make", [los_problem, head_problem])
@pytest.mark.parametrize("whole", [True, False])
def test_what_is_said_of_what_is_shared(
    make: Callable[[], Problem], whole: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rows that are eliminated last say what is left where all else is marginalised out."""
    assembly = Assembly.of(make().steps(CHUNK))
    shared = assembly.shared(make())
    alone = system.System.of(assembly.factors, shared, None, assembly.boundaries)
    parts = alone if whole else stretches(monkeypatch, make())[0].under(None)
    for keys in (shared, shared[::-1]):
        expected = joint_information(alone.linearize(assembly.initial), alone.ordering, keys)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        found = parts.linearized(assembly.initial).information(keys)
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-9)


def test_of_what_nothing_is_said_there_is_no_information() -> None:
    """Then there is no triangular factor."""
    a, b = gtsam.symbol("a", 0), gtsam.symbol("b", 0)
    known = gtsam.PriorFactorVector(a, np.zeros(2), gtsam.noiseModel.Isotropic.Sigma(2, 0.5))
    silent = gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [a, b], _silent)
    alone = system.System.of([Factor("prior", known), Factor("silent", silent)], [a, b], None)
    values = gtsam.Values()
    values.insert(a, np.zeros(2))
    values.insert(b, np.zeros(1))
    np.testing.assert_allclose(alone.linearized(values).information([b, a]), np.diag([0.0, 4.0, 4.0]), atol=1e-12)


def _silent(_: gtsam.CustomFactor, __: gtsam.Values, jacobians: list[Array] | None) -> Array:
    if jacobians is not None:
        jacobians[0], jacobians[1] = np.zeros((1, 2)), np.zeros((1, 1))
    return np.zeros(1)


def test_progress_is_shown(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(Console, "is_terminal", True)
    with progress.shown():
        divided(monkeypatch, los_problem())
    assert "stretch by stretch" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("make", "keep"), [(los_problem, Keep.ALL), (los_problem, Keep.TREES), (head_problem, Keep.NOTHING)]
)
def test_it_is_the_same_solution(make: Callable[[], Problem], keep: Keep, monkeypatch: pytest.MonkeyPatch) -> None:
    """However much is kept of a stretch."""
    if keep is not Keep.ALL:
        monkeypatch.setattr(system, "_KEPT", 0)
    if keep is Keep.NOTHING:
        monkeypatch.setattr(system, "_KEPT_TREES", 0)
    whole = solve_batch(make(), budget=True, device=[make().quantities[0].name])
    parts = divided(monkeypatch, make())
    sigmas = np.maximum(whole.sigmas, 1e-12)
    np.testing.assert_allclose(parts.values / sigmas, whole.values / sigmas, atol=1e-6)
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(parts.covariance / scale, whole.covariance / scale, atol=1e-6)
    assert whole.chi_square is not None
    assert parts.chi_square is not None
    assert parts.chi_square.value == pytest.approx(whole.chi_square.value, rel=1e-9)
    assert parts.chi_square.dof == pytest.approx(whole.chi_square.dof, rel=1e-9)
    for family, (square, dof) in whole.chi_square.families.items():
        # The families' shares of the degrees of freedom are sampled.
        assert parts.chi_square.families[family][0] == pytest.approx(square, rel=1e-6)
        assert parts.chi_square.families[family][1] == pytest.approx(dof, abs=4.0 * dof**0.5)
    assert parts.rejected == whole.rejected
    assert whole.budget is not None
    assert parts.budget is not None
    for name, shares in whole.budget.items():
        assert parts.budget[name] == pytest.approx(shares, abs=1e-6)
    assert whole.strongest is not None
    assert parts.strongest is not None
    assert [(p.family, p.time, p.parameter) for p in parts.strongest] == [
        (p.family, p.time, p.parameter) for p in whole.strongest
    ]
    assert whole.told is not None
    assert parts.told is not None
    np.testing.assert_allclose(parts.told.R.T @ parts.told.R, whole.told.R.T @ whole.told.R, rtol=1e-6)
    for family, residuals in whole.residuals.items():
        np.testing.assert_allclose(parts.residuals[family].whitened, residuals.whitened, atol=1e-6)
    if whole.smoothed is not None:
        assert parts.smoothed is not None
        np.testing.assert_allclose(parts.smoothed.sigmas, whole.smoothed.sigmas, rtol=1e-6)
    assert whole.course is not None
    assert parts.course is not None
    # Moments are ends of stretches: the last is that of the recording, and those of both are known alike.
    same = [(i, int(j)) for i, t in enumerate(parts.course.time) for j in np.flatnonzero(whole.course.time == t)]
    assert len(same) > 1
    for i, j in same:
        np.testing.assert_allclose(parts.course.values[i] / sigmas, whole.course.values[j] / sigmas, atol=1e-5)
        got, expected = (np.diag(c) for c in (parts.course.covariance[i], whole.course.covariance[j]))
        np.testing.assert_allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "kept"), [(los_problem, 150_000), pytest.param(head_problem, 0, marks=pytest.mark.slow)]
)
def test_several_processes_find_the_same(
    make: Callable[[], Problem], kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the last digit, and the budget, the strongest measurements and what other graphs would say with it."""
    monkeypatch.setattr(system, "_WORTH_WHILE", 1)
    monkeypatch.setattr(system, "_KEPT", kept)
    problem = make()
    stretches(monkeypatch, problem)
    changed = [("again", problem)]
    alone, together = (_with_processes(problem, changed, jobs) for jobs in (1, 3))
    for name in ("values", "covariance", "budget", "moved", "strongest", "rejected", "chi_square", "levels", "message"):
        np.testing.assert_equal(getattr(together, name), getattr(alone, name), name)
    assert alone.course is not None
    assert together.course is not None
    np.testing.assert_array_equal(together.course.covariance, alone.course.covariance)


@pytest.mark.parametrize(
    ("keep", "room", "several"), [(Keep.NOTHING, 0.0, False), (Keep.NOTHING, 1e12, True), (Keep.TREES, 0.0, True)]
)
def test_where_nothing_is_kept_processes_need_room(
    keep: Keep, room: float, several: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, _ = stretches(monkeypatch, los_problem())
    monkeypatch.setattr(system, "_WORTH_WHILE", 1)
    monkeypatch.setattr(system, "room", lambda: room)
    assert (replace(found, keep=keep)._processes() > 1) is several


def _with_processes(problem: Problem, changed: list[tuple[str, Problem]], jobs: int) -> Estimate:
    with parallel.processes(jobs):
        found = solve_batch(problem, budget=True, changed=changed)
    assert found.moved is not None
    assert list(found.moved) == ["again"]
    return found


def test_colours_of_a_family_that_a_stretch_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of one piece."""
    problem = los_problem()
    parts, values = stretches(monkeypatch, problem)
    lacking = set(map(id, parts.stretches[1].factors))
    factors = [
        Factor.of("others", f.measurement, f.beside) if id(f) in lacking and f.measurement is not None else f
        for f in parts.factors
    ]
    keys = Assembly.of(problem.steps(CHUNK)).current_keys
    one, several = (
        added_variance(influence(problem, of.linearized(values), keys), {"los": np.array([0.4, 0.2])})["los"]
        for of in (system.System.of(factors, parts.shared, None), parts.made_of(factors).under(None))
    )
    assert one.max() > 0.0
    np.testing.assert_allclose(several, one, rtol=1e-6)


def test_several_processes_name_a_state_that_is_not_determined(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one does."""
    monkeypatch.setattr(system, "_WORTH_WHILE", 1)
    found, values = stretches(monkeypatch, los_problem())
    lost = found.stretches[1].inner[0]
    free = found.made_of([_silenced(f) if lost in f.factor.keys() else f for f in found.factors])
    said = []
    for jobs in (1, 2):
        with parallel.processes(jobs):
            linear = free.linearized(values)
            with pytest.raises(IndeterminateError, match="does not determine the state") as raised:
                linear.drawn([], 1, np.random.default_rng(0))
        said.append(str(raised.value))
    assert said[0] == said[1]


def _silenced(factor: Factor) -> Factor:
    """One that says nothing."""
    assert factor.vectorized is not None
    of = Factor.process_of if factor.measurement is None else Factor.of
    return of(factor.family, factor.vectorized.weighed(np.zeros(factor.vectorized.model.rows)), factor.beside)


# Solving may take so much, MiB, of what 8 GiB allow for ten minutes of ten hours.
ALLOWED = 4096.0 * 10.0 / 600.0

LONG = """
import sys
from pathlib import Path

import alidade
from benchmarks.measure import peak_mib, resident_mib
from alidade.pipelines.solvers import system
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.marginals import joint_information

system._UNDIVIDED, system._STRETCH, system._KEPT, system._KEPT_TREES = 10_000, 600, 0, 0
scenario = {"duration_s": float(sys.argv[1]), "gyro_rate_hz": 100.0, "gimbal_rate_hz": 100.0}
problem = alidade.open(alidade.simulate("los", scenario)).problem()
before = resident_mib()
Path("/proc/self/clear_refs").write_text("5")
assert solve_batch(problem, budget=True).converged
print(peak_mib() - before)
"""


@pytest.mark.slow
def test_ten_more_minutes_take_little_memory() -> None:
    """In processes of their own, since a process does not give back what it once had.

    They give back what they let go of at once, and with one arena: how much simulating leaves to be used anew, and how
    many more arenas malloc opens for threads that wait, depends on what else the machine does.
    """
    malloc = {"ARENA_MAX": "1", "TRIM_THRESHOLD_": "131072", "MMAP_THRESHOLD_": "131072"}
    environment = {**os.environ, **{f"MALLOC_{name}": value for name, value in malloc.items()}}
    half, whole = (
        subprocess.run(
            [sys.executable, "-c", LONG, duration], capture_output=True, text=True, check=True, env=environment
        )
        for duration in ("600", "1200")
    )
    assert float(whole.stdout) - float(half.stdout) < ALLOWED
