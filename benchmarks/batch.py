"""The batch solver against graphs of native GTSAM factors and against GTSAM's own optimizer, timed in turns.

python -m benchmarks.batch
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from typing import Any

import gtsam
import numpy as np

from pipelines.methods import head, los
from pipelines.methods.base import Factor, Problem
from pipelines.sessions.config import load_config
from pipelines.simulation.head import HeadScenario, head_config, simulate_head
from pipelines.simulation.los import LosScenario, los_config, simulate_los
from pipelines.simulation.motion import EulerMotion, Swing
from pipelines.solvers.batch import CHUNK, Solution, optimize

MOUNT = int(gtsam.symbol("M", 0))
IMAGES_PER_S = 50.0
# Three-axis, for the platform of the head benchmark.
SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.05)],
    pitch=[Swing(amplitude_deg=8, frequency_hz=0.11)],
    roll=[Swing(amplitude_deg=12, frequency_hz=0.07)],
)

Graph = tuple[list[Factor], gtsam.Values]


def los_problem(keyframes: int) -> Problem:
    """50 LOS errors/s, gyro at 1 kHz."""
    scenario = LosScenario(duration_s=keyframes / IMAGES_PER_S, gyro_rate_hz=1000.0, image_rate_hz=IMAGES_PER_S)
    data, _ = simulate_los(scenario, 0)
    return los.problem(data, load_config(los_config(scenario).encode()))


def head_problem(frames: int) -> Problem:
    """60 vision frames/s, 500 gyro samples/s; bias, both mounts and the time offset free."""
    scenario = HeadScenario(
        duration_s=frames / 60.0,
        platform=SWAY,
        helmet_mount_deg=(3.0, -4.0, 2.0),
        camera_mount_deg=(-2.0, 1.0, 3.0),
        time_offset_s=0.012,
        gyro_rate_hz=500.0,
        platform_gyro_rate_hz=500.0,
        vision_rate_hz=60.0,
    )
    data, _ = simulate_head(scenario, 0)
    return head.problem(data, load_config(head_config(scenario).encode()))


def build(problem: Problem, chunk: int) -> Graph:
    """The whole graph, `chunk` measurements in a factor."""
    factors: list[Factor] = []
    values = gtsam.Values()
    for step in problem.steps(chunk):
        factors.extend(step.factors)
        values.insert(step.initial)
    return factors, values


def native(problem: Problem) -> Graph:
    """The same keyframes, gyro factors and biases, each measurement a native factor.

    It is a BetweenFactorRot3 of the keyframe and one mount that all share: three rows where a LOS error has two, three
    shared unknowns where it has four and vision has ten.
    """
    factors, values = build(problem, CHUNK)
    mounts = {p.key for p in problem.parameters} - {int(gtsam.symbol("b", 0))}
    kept = [f for f in factors if f.measurement is None and not mounts & set(f.factor.keys())]
    for key in mounts:
        values.erase(key)
    values.insert(MOUNT, gtsam.Rot3.Expmap(np.full(3, 0.01)))
    # Without it nothing holds mount and keyframes where they are.
    kept.append(Factor("prior", gtsam.PriorFactorRot3(MOUNT, gtsam.Rot3(), gtsam.noiseModel.Isotropic.Sigma(3, 0.1))))
    rng = np.random.default_rng(0)
    sigma = 2e-5 if problem.method == "los" else 8.7e-3
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    for f in factors:
        for key in [] if f.measurement is None else f.factor.keys():
            if gtsam.Symbol(key).chr() == ord("x"):
                seen = values.atRot3(key).compose(gtsam.Rot3.Expmap(sigma * rng.standard_normal(3)))
                kept.append(Factor(f.family, gtsam.BetweenFactorRot3(MOUNT, key, seen, noise)))
    return kept, values


def solve(problem: Problem, graph: Graph) -> Solution:
    """By the batch solver's outer loop, ordering included."""
    present = set(graph[1].keys())
    shared = [key for key in [*(p.key for p in problem.parameters), MOUNT] if key in present]
    loss = problem.loss if any(f.measurement for f in graph[0]) else None
    return optimize(*graph, shared, loss)


def default_optimizer(problem: Problem, graph: Graph) -> int:
    """By gtsam.LevenbergMarquardtOptimizer as it comes, plain least squares; returns its iterations."""
    assert problem.loss is not None
    problem.loss.mu = 0.0
    whole = gtsam.NonlinearFactorGraph()
    for f in graph[0]:
        whole.add(f.factor)
    optimizer = gtsam.LevenbergMarquardtOptimizer(whole, graph[1])
    optimizer.optimize()
    return int(optimizer.iterations())


def in_turns(work: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """Median seconds of each, run one after the other round after round, a round to warm up first."""
    seconds = np.empty((rounds + 1, len(work)))
    for row in seconds:
        for i, run in enumerate(work):
            gc.collect()
            start = time.perf_counter()
            run()
            row[i] = time.perf_counter() - start
    return [float(s) for s in np.median(seconds[1:], axis=0)]


def against_native(name: str, problem: Problem, rounds: int = 3) -> tuple[float, float]:
    """Prints the ratio of solve times; returns the batch solver's seconds, all in all and for one iteration."""
    ours, theirs = build(problem, CHUNK), native(problem)
    keyframes = sum(gtsam.Symbol(key).chr() == ord("x") for key in ours[1].keys())
    a, b = in_turns([lambda: solve(problem, ours), lambda: solve(problem, theirs)], rounds)
    steps = solve(problem, ours).iterations, solve(problem, theirs).iterations
    print(
        f"{name}, {keyframes} keyframes: {a:.2f} s in {steps[0]} iterations, native-only {b:.2f} s in {steps[1]}: "
        f"ratio {a / b:.2f} (3 wanted), {a * steps[1] / (b * steps[0]):.2f} an iteration",
        flush=True,
    )
    return a, a / steps[0]


def against_default(keyframes: int) -> None:
    """Prints the ratio of the default route's time to ours."""
    problem = los_problem(keyframes)
    single, chunks = build(problem, 1), build(problem, CHUNK)
    a, b = in_turns([lambda: default_optimizer(problem, single), lambda: solve(problem, chunks)], 1)
    print(f"los, {keyframes} keyframes: default optimizer {a:.1f} s, ours {b:.2f} s: {a / b:.0f} times", flush=True)


def main() -> None:
    sizes = (3_000, 6_000, 30_000)
    seconds = [against_native("los", los_problem(n)) for n in sizes]
    whole, one = np.log(np.divide(seconds[-1], seconds[0])) / np.log(sizes[-1] / sizes[0])
    span = f"los, {sizes[0]} to {sizes[-1]} keyframes"
    print(f"{span}: time grows with exponent {whole:.2f} (1.1 wanted), {one:.2f} an iteration")
    for n in (1_500, 3_000, 6_000):
        against_default(n)
    against_native("head", head_problem(36_000))


if __name__ == "__main__":
    main()
