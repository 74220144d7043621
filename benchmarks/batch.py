"""The batch solver against graphs of native GTSAM factors and against GTSAM's own optimizer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import gtsam
import numpy as np

from alidade.factors.preintegration import GyroPath
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.gyro_chain import GyroChain, state
from alidade.pipelines.estimation.problem import Factor, Problem, Step
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.methods.head import graph as head
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los import graph as los
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.settings import Config, Sensors
from alidade.pipelines.simulation.motion import EulerMotion, Swing
from alidade.pipelines.solvers.assembly import CHUNK, Assembly, StepBoundary
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.gauss_newton import Solution
from alidade.pipelines.solvers.weighing import optimize
from benchmarks.measure import Ratio, costs, growth

IDEAL = Config.model_validate({"sensors": "ideal"}).sensors
MOUNT = int(gtsam.symbol("M", 0))
IMAGES_PER_S = 50.0
# Three-axis, for the platform of the head benchmark.
SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.05)],
    pitch=[Swing(amplitude_deg=8, frequency_hz=0.11)],
    roll=[Swing(amplitude_deg=12, frequency_hz=0.07)],
)

# Factors, first guesses, and the ends of the steps.
Graph = tuple[list[Factor], gtsam.Values, Sequence[StepBoundary]]


def los_problem(keyframes: int, sensors: Sensors | None = None) -> Problem:
    """50 LOS errors/s, gyro at 1 kHz; the sensors as the config has them, by default with all assumptions free."""
    scenario = LosScenario(duration_s=keyframes / IMAGES_PER_S, gyro_rate_hz=1000.0, image_rate_hz=IMAGES_PER_S)
    data, _ = simulate_los(scenario, 0)
    config = los_config(scenario.model_copy(update={"sensors": sensors}))
    return los.problem(data, load_config(config.encode()))


def head_recording(frames: int) -> tuple[HeadData, Config]:
    """60 vision frames/s, 500 gyro samples/s; bias, both mounts, the time offset and all assumptions free."""
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
    return data, load_config(head_config(scenario).encode())


def build(problem: Problem, chunk: int) -> Graph:
    """The whole graph, `chunk` measurements in a factor."""
    whole = Assembly.of(problem.steps(chunk))
    return whole.factors, whole.initial, whole.boundaries


def native(problem: Problem) -> Graph:
    """The same keyframes, gyro factors and biases, each measurement a native factor.

    It is a BetweenFactorRot3 of the keyframe and one mount that all share: three rows where a LOS error has two, three
    shared unknowns where it has four and vision has ten.
    """
    factors, values, _ = build(problem, CHUNK)
    mounts = {p.key for p in problem.parameters} - {int(gtsam.symbol("b", 0))}
    kept = [f for f in factors if f.measurement is None and not mounts & set(f.factor.keys())]
    for key in mounts:
        values.erase(key)
    seen = [key for f in factors if f.measurement is not None for key in f.factor.keys()]
    return with_mount(kept, values, [key for key in seen if gtsam.Symbol(key).chr() == ord("x")], "los", 2e-5)


def native_head(data: HeadData) -> Graph:
    """The same for a head recording, with a keyframe for every picture and the bias as the gyro's only error."""
    time = data.vision_t[(data.vision_t >= data.head_t[0]) & (data.vision_t <= data.head_t[-1])]
    gyro = GyroPath(data.head_t, data.head_gyro)
    starts = np.arange(len(time)) == 0
    chain = GyroChain.over(time, starts, gyro.attitude(time), gyro, density=1e-4, walk=1e-6)
    step = Step(float(time[-1]), keyframes=range(len(time)))
    chain.add(step, step.keyframes)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
    step.factors.append(Factor("prior", gtsam.PriorFactorVector(FIRST_BIAS, np.zeros(3), noise)))
    return with_mount(step.factors, step.initial, [state(k) for k in step.keyframes], "vision", 8.7e-3)


def with_mount(kept: list[Factor], values: gtsam.Values, seen: list[int], family: str, sigma: float) -> Graph:
    """A graph with measurements (rad) of keyframes by native factors."""
    values.insert(MOUNT, gtsam.Rot3.Expmap(np.full(3, 0.01)))
    # Without it nothing holds mount and keyframes where they are.
    kept.append(Factor("prior", gtsam.PriorFactorRot3(MOUNT, gtsam.Rot3(), gtsam.noiseModel.Isotropic.Sigma(3, 0.1))))
    rng = np.random.default_rng(0)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    for key in seen:
        measured = values.atRot3(key).compose(gtsam.Rot3.Expmap(sigma * rng.standard_normal(3)))
        kept.append(Factor(family, gtsam.BetweenFactorRot3(MOUNT, key, measured, noise)))
    return kept, values, ()


def solve(problem: Problem, graph: Graph) -> Solution:
    """By the batch solver's outer loop, ordering included."""
    present = set(graph[1].keys())
    shared = [key for key in [*(p.key for p in problem.parameters), MOUNT] if key in present]
    factors, values, boundaries = graph
    loss = problem.loss if any(f.measurement for f in factors) else None
    return optimize(factors, values, shared, loss, boundaries=boundaries)


def default_optimizer(graph: Graph) -> int:
    """By gtsam.LevenbergMarquardtOptimizer as it comes, plain least squares; returns its iterations."""
    whole = gtsam.NonlinearFactorGraph()
    for f in graph[0]:
        whole.add(f.factor if f.measurement is None else f.measurement.under(None).factor)
    optimizer = gtsam.LevenbergMarquardtOptimizer(whole, graph[1])
    optimizer.optimize()
    return int(optimizer.iterations())


def against_native(name: str, problem: Problem, theirs: Graph, compared: str, wanted: float) -> Ratio:
    """The batch solver's outer loop, gate included, on our graph and on one of native factors."""
    ours = build(problem, CHUNK)
    a, b = costs([lambda: solve(problem, ours), lambda: solve(problem, theirs)])
    return Ratio(name, compared, a.seconds / b.seconds, wanted=wanted, ours=a, theirs=b)


def whole_answer(name: str, problem: Problem, theirs: Graph, compared: str) -> Ratio:
    """All that is computed of a recording, noise levels, covariance and influence included, against the same graph."""
    a, b = costs([lambda: solve_batch(problem, budget=True), lambda: solve(problem, theirs)])
    return Ratio(name, compared, a.seconds / b.seconds, ours=a, theirs=b)


def against_ideal(keyframes: int) -> Ratio:
    """All of a los recording with every assumption free against the same with none."""
    problems = los_problem(keyframes), los_problem(keyframes, IDEAL)
    a, b = costs([partial(solve_batch, problem, budget=True) for problem in problems])
    compared = f"los with all assumptions over ideal sensors, everything computed, {keyframes:,} keyframes"
    return Ratio("batch.los.assumptions", compared, a.seconds / b.seconds, wanted=1.3, ours=a, theirs=b)


def against_default(keyframes: int) -> Ratio:
    """The default route's time over ours."""
    problem = los_problem(keyframes)
    single, chunks = build(problem, 1), build(problem, CHUNK)
    a, b = costs([lambda: solve(problem, chunks), lambda: default_optimizer(single)], 1, warm=False)
    compared = f"LevenbergMarquardtOptimizer with a CustomFactor a measurement over ours, {keyframes} keyframes"
    return Ratio(f"batch.default.{keyframes}", compared, b.seconds / a.seconds, "higher", 0.4, 20.0, a, b)


def run() -> Iterator[Ratio]:
    """Batch against native-only graphs, its growth, and against the default optimizer with its growth."""
    sizes = (3_000, 10_000, 30_000, 100_000)
    seconds = []
    for n in sizes:
        problem = los_problem(n)
        if n == 30_000:
            compared = "los direction graph with all assumptions over native-only, 30,000 keyframes"
            theirs = native(problem)
            ratio = against_native("batch.los", problem, theirs, compared, 1.3)
            yield ratio
            compared = "the same with noise levels, covariance, influence and all else computed, over native-only"
            yield whole_answer("batch.los.whole", problem, theirs, compared)
            yield against_ideal(n)
            assert ratio.ours is not None
            seconds.append(ratio.ours.seconds)
        else:
            graph = build(problem, CHUNK)
            seconds += [costs([partial(solve, problem, graph)])[0].seconds]
    yield Ratio(
        "batch.los.growth",
        "exponent from 3,000 to 100,000 keyframes",
        growth(sizes, seconds),
        wanted=1.05,
        tolerance=0.1,
    )
    data, config = head_recording(36_000)
    compared = "head graph with all assumptions over native-only, 36,000 frames, 300,000 samples"
    problem, theirs = head.problem(data, config), native_head(data)
    yield against_native("batch.head", problem, theirs, compared, 1.7)
    compared = "the same with noise levels, covariance, influence and all else computed, over native-only"
    yield whole_answer("batch.head.whole", problem, theirs, compared)
    small = against_default(3_000)
    large = against_default(6_000)
    yield small
    yield large
    assert small.theirs is not None
    assert large.theirs is not None
    exponent = growth((3_000, 6_000), (small.theirs.seconds, large.theirs.seconds))
    yield Ratio("batch.default.growth", "exponent of the default optimizer", exponent, "higher")
