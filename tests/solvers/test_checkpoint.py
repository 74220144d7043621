"""A run of the incremental solver saved and taken up again in another process, and what it survives."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.problem import Attitudes, Estimate, Problem
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.model import problem
from alidade.pipelines.methods.los.recording import read_los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from alidade.pipelines.solvers import incremental
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.checkpoint import load_checkpoint, save_checkpoint
from alidade.pipelines.solvers.incremental import IncrementalSolver, solve_incremental
from alidade.pipelines.solvers.smoother import FixedLagSmoother
from tests.support.builders import IDEAL

BRISK = EulerMotion(
    roll=[Swing(amplitude_deg=6, frequency_hz=0.31)],
    pitch=[Swing(amplitude_deg=5, frequency_hz=0.27)],
    yaw=[Swing(amplitude_deg=6, frequency_hz=0.23)],
)
SCENARIO = LosScenario(
    duration_s=51.0, carrier=BRISK, image_rate_hz=3.0, gyro_rate_hz=50.0, gimbal_rate_hz=50.0, sensors=IDEAL
)
IDENTITY = {"recording": "first", "config": "{}"}

RESUME = """
import json, sys
from pathlib import Path
from alidade.pipelines.methods.los.model import problem
from alidade.pipelines.config import load_config
from alidade.pipelines.methods.los.recording import read_los
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.solvers.checkpoint import load_checkpoint
from alidade.pipelines.solvers.incremental import IncrementalSolver
recording = open_recording(Path(sys.argv[1]))
config = load_config(recording.attachment("alidade.yaml"))
made = problem(read_los(recording, config), config)
saved = load_checkpoint(Path(sys.argv[2]), {"recording": "first", "config": "{}"})
run = IncrementalSolver.resumed(made, saved)
for step in made.steps(1):
    if step.time > run.time:
        run.add_step(step)
end = run.finish(0.0)
chi = end.chi_square.value
print(json.dumps([end.values.tolist(), end.sigmas.tolist(), chi, len(end.history.time), end.rejected]))
"""


@dataclass(frozen=True)
class Saved:
    session: Path
    checkpoint: Path
    made: Problem
    levels: tuple[Level, ...]
    end: Estimate


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Saved:
    """A whole run that was saved on its way, wherever that was possible first."""
    folder = tmp_path_factory.mktemp("checkpoint")
    session, checkpoint = folder / "s.mcap", folder / "s.checkpoint"
    data, truth = simulate_los(SCENARIO, 5)
    method("los").write_data(session, data, truth, los_config(SCENARIO))
    recording = open_recording(session)
    config = load_config(recording.attachment("alidade.yaml"))
    made = problem(read_los(recording, config), config)
    run = IncrementalSolver(made, 1.0)
    times = 0
    with pytest.MonkeyPatch.context() as patch:  # an initialisation phase of twenty steps
        patch.setattr(incremental, "SOLVE_GROWTH", 2.0)
        patch.setattr(incremental, "MIN_STEPS", 20)
        for step in made.steps(1):
            run.add_step(step)
            if run.can_checkpoint:
                times += 1
                if times == 1:
                    save_checkpoint(checkpoint, run.state, IDENTITY)
                    levels = run.state.levels
    assert times > 1, "the past has to be marginalised out again after the one that is saved"
    return Saved(session, checkpoint, made, levels, run.finish(0.0))


def test_a_new_process_ends_at_the_same_estimates(saved: Saved) -> None:
    command = [sys.executable, "-c", RESUME, str(saved.session), str(saved.checkpoint)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    values, sigmas, chi_square, moments, rejected = json.loads(done.stdout)
    end = saved.end
    assert end.history is not None
    assert end.chi_square is not None
    np.testing.assert_allclose(values, end.values, rtol=1e-9, atol=1e-9 * end.sigmas.min())
    np.testing.assert_allclose(sigmas, end.sigmas, rtol=1e-9)
    assert chi_square == pytest.approx(end.chi_square.value, rel=1e-9)
    assert (moments, rejected) == (len(end.history.time), end.rejected)


def test_a_resumed_run_keeps_noise_levels_and_the_reason_for_not_converging(saved: Saved, tmp_path: Path) -> None:
    """Noise section, verdict and exit code follow from these."""
    run = IncrementalSolver.resumed(saved.made, load_checkpoint(saved.checkpoint, IDENTITY))
    assert run.state.levels == saved.levels
    assert {level.noise.name for level in run.state.levels if level.found is not None} == {"los_error", "gyro_density"}
    run.state.trouble = "the first 40.0 s: no step lowers the error"
    save_checkpoint(tmp_path / "c", run.state, IDENTITY)
    resumed = IncrementalSolver.resumed(saved.made, load_checkpoint(tmp_path / "c", IDENTITY))
    for step in saved.made.steps(1):
        if step.time > resumed.time:
            resumed.add_step(step)
    end = resumed.finish(0.0)
    assert (end.converged, end.message) == (False, run.state.trouble)
    assert end.levels == saved.end.levels


def test_marginalizing_the_past_loses_nothing(saved: Saved) -> None:
    batch = solve_batch(saved.made)
    assert saved.end.rejected == batch.rejected == {"los": 0}
    assert np.abs((saved.end.values - batch.values) / batch.sigmas).max() < 0.02
    np.testing.assert_allclose(saved.end.sigmas, batch.sigmas, rtol=0.01)


@pytest.mark.parametrize("what", ["recording", "config"])
def test_a_checkpoint_of_something_else_is_refused_and_both_are_named(saved: Saved, what: str) -> None:
    with pytest.raises(InputError, match=f"another {what}, {IDENTITY[what]}, not second"):
        load_checkpoint(saved.checkpoint, {**IDENTITY, what: "second"})


def _damaged(content: bytes) -> Iterator[bytes]:
    yield b""
    yield b"no checkpoint at all"
    for cut in range(1, len(content), len(content) // 10):
        yield content[:cut]
    generator = np.random.default_rng(0)
    for at in generator.integers(0, len(content), 30):
        yield content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :]


def test_a_damaged_checkpoint_is_refused_or_whole(saved: Saved, tmp_path: Path) -> None:
    """A flipped byte that nothing checks, such as a time of day in the archive, may pass; nothing else does."""
    reference = IncrementalSolver.resumed(saved.made, load_checkpoint(saved.checkpoint, IDENTITY))
    path = tmp_path / "damaged"
    refused = 0
    cases = list(_damaged(saved.checkpoint.read_bytes()))
    for content in cases:
        path.write_bytes(content)
        try:
            run = IncrementalSolver.resumed(saved.made, load_checkpoint(path, IDENTITY))
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(run.values(), reference.values())
    assert refused > 0.8 * len(cases)


def test_a_checkpoint_takes_the_place_of_the_old_one_whole_or_not_at_all(
    saved: Saved, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c"
    path.write_bytes(saved.checkpoint.read_bytes())
    run = load_checkpoint(path, IDENTITY)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(InputError, match="cannot be written"):
        save_checkpoint(path, run, IDENTITY)
    assert path.read_bytes() == saved.checkpoint.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["c"]


@pytest.mark.usefixtures("few_solutions", "early_smoother")
def test_a_smoother_that_throws_is_built_anew_from_what_is_known(saved: Saved, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attitudes from before the past was marginalised out were recorded then, and only then: none is lost."""
    whole = FixedLagSmoother.update
    calls = 0

    def update(*arguments: object) -> None:
        nonlocal calls
        calls += 1
        if calls in (20, 80):  # before the past is marginalised out first, and after it
            raise RuntimeError("indeterminate")
        whole(*arguments)  # type: ignore[arg-type]

    def attitudes(keyframes: Sequence[int], _: object) -> Attitudes:
        return Attitudes(np.array(keyframes, dtype=float), np.tile([1.0, 0.0, 0.0, 0.0], (len(keyframes), 1)))

    monkeypatch.setattr(FixedLagSmoother, "update", update)
    end = solve_incremental(replace(saved.made, attitudes=attitudes))
    assert calls > 80
    assert np.abs((end.values - saved.end.values) / saved.end.sigmas).max() < 0.05
    assert end.attitudes is not None
    np.testing.assert_array_equal(end.attitudes.time, np.arange(len(end.attitudes.time)))
    assert len(end.attitudes.time) == sum(len(step.keyframes) for step in saved.made.steps(1))
