"""Consistency in the initialisation phase: NEES of recordings that begin badly.

    python -m benchmarks.initialisation METHOD [--only CASE ...] [--solver SOLVER] [--seeds N]

Recordings that begin badly, with mounts and sensor errors drawn from their priors: at rest, about one axis, slowly,
with mounts without a prior, without pictures, among outliers. At ten moments of each recording the joint error is
compared with the joint covariance (NEES), online and in batch. The mean NEES over the seeds must lie inside a two-sided
99.9 % interval about the number of parameters: above it sigmas are too small, below it they are too large.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.estimation.problem import Estimate, Problem, Step, rotation_vector_coordinates
from alidade.pipelines.methods.cube.simulation import CubeScenario
from alidade.pipelines.methods.head.simulation import HeadScenario
from alidade.pipelines.methods.indexer.simulation import IndexerScenario, Position
from alidade.pipelines.methods.los.simulation import LosAngles, LosScenario
from alidade.pipelines.methods.triads import triad_names
from alidade.pipelines.methods.tumble.simulation import TumbleScenario
from alidade.pipelines.settings import Sensors
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.incremental import DEFAULT_WINDOW, IncrementalSolver

HEAD = HeadScenario(
    duration_s=30.0,
    vision_rate_hz=10.0,
    gyro_rate_hz=100.0,
    latitude_deg=None,
    sensors=Sensors(),
    gyro_turn_on_bias_deg_s=float(np.rad2deg(0.05)),
)  # to be changed by the cases, as those below
# The bias is the simulator's, 0.005 of its prior, but in a case of its own: it lets the target drift away.
LOS = LosScenario(duration_s=30.0, image_rate_hz=10.0, gyro_rate_hz=100.0, gimbal_rate_hz=50.0, sensors=Sensors())
INDEXER = IndexerScenario(
    positions=[
        Position(axis=axis, other_deg=other, turns=1.0) for axis in ("outer", "inner") for other in (0.0, 180.0)
    ],
    rate_deg_s=30.0,
    sensors=Sensors(),
)
# Gains and offsets of cube and tumble are the simulator's, a tenth of their priors: errors are to be smaller.
CUBE = CubeScenario(poses=16, sensors=Sensors())
TUMBLE = TumbleScenario()
# s at rest before anything moves, and deg that a mount may be off by where nobody knows it; by seed, in turn.
RESTS, MOUNTS = (10.0, 20.0, 30.0, 60.0), (90.0, 120.0, 180.0)
_AXES = ("yaw", "pitch", "roll")
# rad/s, the prior of los's gyro bias, and s that the target then stays in the picture.
BIAS, SEEN = 0.02, 5.0
# Shares of a recording's motion, or of the rest before it, at which errors are looked at.
_LATER = np.array([0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.75, 0.97])
_BEFORE, _AFTER = np.array([0.15, 0.5, 0.95]), np.array([0.07, 0.1, 0.15, 0.25, 0.4, 0.6, 0.97])
# Probability of the two-sided interval of the mean NEES.
LEVEL = 0.999
SOLVERS = ("online", "batch")

Case = Callable[[int], tuple[Any, Array]]


@dataclass(frozen=True)
class Followed:
    """Joint errors of one recording.

    Attributes:
        moments: s, at which the errors were evaluated.
        nees: joint errors there, squared sigmas.
        numbers: of free parameters.
        bounded: of those with a prior; the others have no true distribution, so that only the upper bound counts them.
        worst: the largest error of a single parameter, in its sigmas.
        message: of a run that did not converge; empty: it did.
        before: joint error of the priors' means in their sigmas, squared sigmas.
    """

    moments: list[float]
    nees: list[float]
    numbers: int
    bounded: int
    worst: float
    message: str
    before: float


@dataclass(frozen=True)
class Found(Followed):
    """The same with its recording and solver, and seconds of CPU time."""

    method: str
    case: str
    solver: str
    seed: int
    seconds: float


def beginning(motion: EulerMotion, since: Mapping[str, float], slowly: float = 0.0) -> EulerMotion:
    """A motion, each of the axes named from some second on, the others never; for `slowly` s at a twentieth."""
    axes: dict[str, list[Swing]] = {}
    for axis, start in since.items():
        whole = [swing.model_copy(update={"start_s": start + slowly}) for swing in getattr(motion, axis)]
        slight = [
            swing.model_copy(update={"start_s": start, "amplitude_deg": 0.05 * swing.amplitude_deg})
            for swing in getattr(motion, axis)
        ]
        axes[axis] = whole + (slight if slowly else [])
    return EulerMotion(**axes)


def drawn_head(seed: int, **changes: object) -> HeadScenario:
    """A head whose mount and time offset are drawn from their priors."""
    rng = np.random.default_rng([seed, 3])
    mount = tuple(np.rad2deg(0.35 * rng.standard_normal(3)).tolist())
    drawn = {"helmet_mount_deg": mount, "time_offset_s": 0.05 * float(rng.standard_normal())}
    return HEAD.model_copy(update={**drawn, **changes})


def drawn_los(seed: int, **changes: object) -> LosScenario:
    """A gimbal whose mounting angles are drawn from their priors."""
    rng = np.random.default_rng([seed, 3])
    angles = {f"delta_{name}": float(np.rad2deg(rng.normal(0.0, 0.1))) for name in ("px", "gx", "gy", "gz")}
    return LOS.model_copy(update={"angles_deg": LosAngles(delta_pz=0.0, **angles), **changes})


def _mount(seed: int) -> tuple[float, float, float]:
    """Rotation vector, deg, about any axis."""
    axis = np.random.default_rng([seed, 4]).standard_normal(3)
    x, y, z = (MOUNTS[seed % len(MOUNTS)] * axis / np.linalg.norm(axis)).tolist()
    return x, y, z


def _angles(rotation_deg: tuple[float, float, float]) -> tuple[float, float, float]:
    """The indexer's mounting angles, deg, of a rotation vector."""
    x, y, z = np.rad2deg(so3.angles(so3.exp(np.deg2rad(rotation_deg)))).tolist()
    return x, y, z


def _resting(drawn: Callable[..., HeadScenario | LosScenario], motion: EulerMotion, seed: int) -> tuple[object, Array]:
    rest = RESTS[seed % len(RESTS)]
    since = beginning(motion, dict.fromkeys(_AXES, rest))
    moving = {"head" if drawn is drawn_head else "carrier": since, "duration_s": rest + 20.0}
    return drawn(seed, **moving), np.concatenate([rest * _BEFORE, rest + 20.0 * _AFTER])


def _indexer(seed: int, **changes: object) -> tuple[object, Array]:
    mount = np.rad2deg(0.1 * np.random.default_rng([seed, 3]).standard_normal(3))
    return INDEXER.model_copy(update={"mounting_deg": tuple(mount.tolist()), **changes}), _LATER


def _free(names: Sequence[str]) -> dict[str, None]:
    return dict.fromkeys(names)


def _triad(sensor: str, gain: float, bias: float, symmetric: bool = False) -> dict[str, float]:
    """Priors of a triad's K and b."""
    *gains, b1, b2, b3 = triad_names(sensor, symmetric)
    return {**dict.fromkeys(gains, gain), **dict.fromkeys((b1, b2, b3), bias)}


BIASES = [f"gyro_bias_{axis}" for axis in "xyz"]
# Method -> the priors that the truths of a scenario are drawn from, where it draws from narrower ones than a config has
# that does not name them.
DRAWN: dict[str, Callable[[Any], dict[str, float]]] = {
    "head": lambda _: {},
    "los": lambda settings: dict.fromkeys(BIASES, settings.gyro_turn_on_bias),
    "indexer": lambda settings: dict.fromkeys(BIASES, float(np.deg2rad(settings.gyro_bias_deg_h / 3600.0))),
    "cube": lambda settings: {
        **_triad("accel", settings.errors.gain, settings.errors.accel_bias),
        **_triad("gyro", settings.errors.gain, settings.errors.gyro_bias),
        **_triad("mag", settings.errors.gain, settings.errors.mag_bias),
    },
    "tumble": lambda settings: _triad(
        "mag", settings.magnetometer.soft_iron, settings.magnetometer.hard_iron, symmetric=True
    ),
}
HELMET = [f"helmet_mount_{axis}" for axis in "xyz"]
THETA = [f"theta_{axis}" for axis in "xyz"]
ONE, ALL = {"yaw": 0.0}, dict.fromkeys(_AXES, 0.0)
# Method -> case -> a seed's scenario and the moments, s or, where the duration comes out of the motion, its shares.
CASES: dict[str, dict[str, Case]] = {
    "head": {
        "rest": lambda seed: _resting(drawn_head, HEAD.head, seed),
        "one axis": lambda seed: (drawn_head(seed, head=beginning(HEAD.head, ONE)), 30.0 * _LATER),
        "slow": lambda seed: (drawn_head(seed, head=beginning(HEAD.head, ALL, 15.0)), 30.0 * _LATER),
        "mount": lambda seed: (
            drawn_head(seed, helmet_mount_deg=_mount(seed), priors=_free(HELMET)),
            30.0 * _LATER,
        ),
        "dropouts": lambda seed: (
            drawn_head(seed, vision_outages_s=[(0.0, 0.8), (1.3, 3.0), (3.5, 6.0)]),
            30.0 * _LATER,
        ),
        "outliers": lambda seed: (drawn_head(seed, outlier_fraction=0.2), 30.0 * _LATER),
    },
    "los": {
        "rest": lambda seed: _resting(drawn_los, LOS.carrier, seed),
        "one axis": lambda seed: (drawn_los(seed, carrier=beginning(LOS.carrier, ONE)), 30.0 * _LATER),
        "slow": lambda seed: (drawn_los(seed, carrier=beginning(LOS.carrier, ALL, 15.0)), 30.0 * _LATER),
        "dropouts": lambda seed: (
            drawn_los(seed, dropouts_s=[(0.0, 0.8), (1.3, 3.0), (3.5, 6.0)]),
            30.0 * _LATER,
        ),
        "outliers": lambda seed: (drawn_los(seed, outlier_share=0.2), 30.0 * _LATER),
        "biases": lambda seed: (
            drawn_los(seed, gyro_turn_on_bias=BIAS, duration_s=SEEN),
            SEEN * np.linspace(0.2, 0.97, len(_LATER)),
        ),
    },
    "indexer": {
        "rest": lambda seed: _indexer(seed, dwell_s=RESTS[seed % len(RESTS)]),
        "one axis": lambda seed: _indexer(seed, positions=INDEXER.positions[:2]),
        "slow": lambda seed: _indexer(seed, acceleration_deg_s2=2.0),
        "mount": lambda seed: _indexer(seed, mounting_deg=_angles(_mount(seed)), priors=_free(THETA)),
    },
    "cube": {
        "rest": lambda _: (CUBE.model_copy(update={"static_s": 12.0}), _LATER),
        "one axis": lambda _: (CUBE.model_copy(update={"turn_axes": [(0.0, 0.0, 1.0)]}), _LATER),
        "slow": lambda _: (CUBE.model_copy(update={"turn_rad_s": 0.3}), _LATER),
    },
    "tumble": {
        "rest": lambda _: (TUMBLE.model_copy(update={"rest_s": 3.0}), _LATER),
        "one axis": lambda _: (TUMBLE.model_copy(update={"tilt_deg": 10.0}), _LATER),
        "slow": lambda _: (TUMBLE.model_copy(update={"turn_rad_s": 0.4}), _LATER),
    },
}


def made(method: str, settings: Any, seed: int) -> tuple[Problem, Array]:
    """The graph of a simulated recording and the true values (n,) of its parameters.

    Errors that the simulation does not have are not added to the sigmas.
    """
    chosen = methods.method(method)
    simulated = chosen.simulate(settings, seed)
    problem = Session.of(chosen, simulated).problem()
    parameters = tuple(
        replace(p, quantities=tuple(replace(q, extra_sigma=0.0) for q in p.quantities)) for p in problem.parameters
    )
    return replace(problem, parameters=parameters), np.array([simulated.truth[q.name] for q in problem.quantities])


def nees(values: Array, covariance: Array, truth: Array) -> tuple[float, int]:
    """Joint error in sigmas squared, and of how many numbers."""
    free = np.diag(covariance) > 0.0
    sigma = np.sqrt(np.diag(covariance)[free])
    error = (values - truth)[free] / sigma
    return float(error @ np.linalg.solve(covariance[np.ix_(free, free)] / np.outer(sigma, sigma), error)), len(error)


@dataclass(frozen=True)
class _Errors:
    """Errors collected at some moments of one recording."""

    problem: Problem
    truth: Array
    moments: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    worst: list[float] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)

    def add(self, time: float, estimate: Estimate, has_to_converge: bool = True) -> None:
        """Compare an estimate with the truth."""
        true, sigmas = _nearest(self.problem, self.truth, estimate.values), estimate.sigmas
        free = sigmas > 0.0
        self.moments.append(time)
        self.nees.append(nees(estimate.values, estimate.covariance, true)[0])
        self.worst.append(float(np.max(np.abs(estimate.values - true)[free] / sigmas[free])))
        self.messages.extend([estimate.message] if has_to_converge and not estimate.converged else [])

    def result(self) -> Followed:
        """All of them."""
        quantities = self.problem.quantities
        priors = [q.prior_sigma for q in quantities]
        off = [(v - q.prior_mean) / q.prior_sigma for v, q in zip(self.truth, quantities, strict=True) if q.prior_sigma]
        return Followed(
            self.moments,
            self.nees,
            sum(prior != 0.0 for prior in priors),
            sum(bool(prior) for prior in priors),
            max(self.worst, default=0.0),
            "; ".join(self.messages),
            float(np.square(off).sum()),
        )


def followed(problem: Problem, truth: Array, moments: Array) -> Followed:
    """Errors of the incremental solver at some moments, s."""
    run, errors = IncrementalSolver(problem, DEFAULT_WINDOW), _Errors(problem, truth)
    for step in problem.steps(1):
        run.add_step(step)
        if len(errors.nees) < len(moments) and step.time >= moments[len(errors.nees)]:
            # While a run begins, what does not converge is at its priors.
            errors.add(step.time, run.estimate(), has_to_converge=not run.initialising)
    final = run.finish(0.0)
    errors.messages.extend([] if final.converged else [final.message])
    return errors.result()


def solved(problem: Problem, truth: Array, moments: Array) -> Followed:
    """Errors of the batch solver on the recording until some moments, s."""
    errors, steps = _Errors(problem, truth), list(problem.steps(1))
    for moment in moments:
        end = next((i for i, step in enumerate(steps) if step.time >= moment), len(steps) - 1)
        errors.add(steps[end].time, solve_batch(_of_steps(problem, steps[: end + 1])))
    return errors.result()


def _of_steps(problem: Problem, steps: Sequence[Step]) -> Problem:
    """The problem of these steps alone."""
    return replace(problem, steps=lambda _: iter(steps))


def _nearest(problem: Problem, truth: Array, values: Array) -> Array:
    """The true values with rotation vectors, of which one turn more is the same, as near to the estimates as can be."""
    found, start = truth.copy(), 0
    for p in problem.parameters:
        of, start = slice(start, start + len(p.quantities)), start + len(p.quantities)
        if p.coordinates is rotation_vector_coordinates and (angle := np.linalg.norm(found[of])) > 0.0:
            other = found[of] * (1.0 - 2.0 * np.pi / angle)
            if np.linalg.norm(other - values[of]) < np.linalg.norm(found[of] - values[of]):
                found[of] = other
    return found


def run(method: str, case: str, seed: int, solver: str = "online") -> Found:
    """Simulate one recording and evaluate its errors; the priors are those that its truths are drawn from."""
    # No two cases of a method draw the same.
    number = 1000 * list(CASES[method]).index(case) + seed
    settings, moments = CASES[method][case](number)
    settings = settings.model_copy(update={"priors": {**DRAWN[method](settings), **settings.priors}})
    problem, truth = made(method, settings, number)
    if moments[-1] <= 1.0:
        moments = moments * [step.time for step in problem.steps(1)][-1]
    begun = time.process_time()
    found = (solved if solver == "batch" else followed)(problem, truth, moments)
    seconds = time.process_time() - begun
    return Found(**asdict(found), method=method, case=case, solver=solver, seed=seed, seconds=seconds)


def report(found: Sequence[Found]) -> Iterator[str]:
    """A table with the mean NEES at each moment, per case and solver, and how it compares with its interval."""
    yield (
        f"| case | solver | recordings | numbers | joint NEES of the priors | mean of it at the ten moments | "
        f"{100.0 * LEVEL:.1f} % interval | below | above | worst alone, sigmas | not converged |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    for case, solver in dict.fromkeys((f.case, f.solver) for f in found):
        of = [f for f in found if (f.case, f.solver) == (case, solver)]
        few = min(len(f.nees) for f in of)
        mean = np.mean([f.nees[:few] for f in of], axis=0)
        low, high = interval(of[0].bounded, of[0].numbers, len(of))
        before, at = np.mean([f.before for f in of]), ", ".join(f"{x:.1f}" for x in mean)
        yield (
            f"| {case} | {solver} | {len(of)} | {of[0].numbers} | {before:.1f} | {at} | {low:.1f} to {high:.1f} | "
            f"{int((mean < low).sum())} | {int((mean > high).sum())} | {max(f.worst for f in of):.1f} | "
            f"{sum(bool(f.message) for f in of)} |"
        )


def interval(bounded: int, numbers: int, recordings: int) -> tuple[float, float]:
    """Two-sided interval of the mean NEES of so many recordings under a true covariance.

    The lower bound counts the numbers that have a prior, the upper one all.
    """
    low = chi2.ppf(0.5 - 0.5 * LEVEL, bounded * recordings) / recordings
    high = chi2.ppf(0.5 + 0.5 * LEVEL, numbers * recordings) / recordings
    return float(low), float(high)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study of one method; what FILE already has is not run again."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.initialisation", description=__doc__.split("\n\n")[2])
    parser.add_argument("method", choices=CASES)
    parser.add_argument("--only", nargs="+", metavar="CASE", help="default: all")
    parser.add_argument("--solver", nargs="+", choices=SOLVERS, default=SOLVERS, help="default: both")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--out", type=Path, metavar="FILE", help="file for the errors, a line each (JSON)")
    options = parser.parse_args(arguments)
    found: list[Found] = []
    if options.out is not None and options.out.exists():
        found = [Found(**json.loads(line)) for line in options.out.read_text().splitlines()]
    done = {(f.method, f.case, f.solver, f.seed) for f in found}
    for seed, case, solver in product(range(options.seeds), options.only or CASES[options.method], options.solver):
        if (options.method, case, solver, seed) in done:
            continue
        found.append(run(options.method, case, seed, solver))
        if options.out is not None:
            with options.out.open("a") as lines:
                lines.write(json.dumps(asdict(found[-1])) + "\n")
    print("\n".join(report([f for f in found if f.method == options.method])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
