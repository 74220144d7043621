"""The batch solver against graphs of native GTSAM factors, solved by GTSAM's own optimizer."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.head import model as head
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.settings import Config, Sensors
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from alidade.pipelines.solvers.batch import solve_batch
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.levenberg import Solution
from alidade.pipelines.solvers.noise_estimation import apply_levels
from alidade.pipelines.solvers.robust import solve_robust
from benchmarks.ahrs import ahrs_factors
from benchmarks.measure import Ratio, costs, growth

IDEAL = Config.model_validate({"sensors": "ideal"}).sensors
MOUNT, BIAS = (int(gtsam.symbol(c, 0)) for c in "Mb")
IMAGES_PER_S = 50.0
# Three-axis, for the platform of the head benchmark.
SWAY = EulerMotion(
    yaw=[Swing(amplitude_deg=20, frequency_hz=0.05)],
    pitch=[Swing(amplitude_deg=8, frequency_hz=0.11)],
    roll=[Swing(amplitude_deg=12, frequency_hz=0.07)],
)

# Of native factors, with first guesses.
Graph = tuple[gtsam.NonlinearFactorGraph, gtsam.Values]


def los_problem(keyframes: int, sensors: Sensors | None = None) -> Problem:
    """50 LOS errors/s, gyro at 1 kHz; the sensors as the config has them, by default with all assumptions free."""
    scenario, data = los_recording(keyframes)
    config = los_config(scenario.model_copy(update={"sensors": sensors}))
    return los.problem(data, load_config(config.encode()))


def los_recording(keyframes: int) -> tuple[LosScenario, LosData]:
    """A scenario and its recording."""
    scenario = LosScenario(duration_s=keyframes / IMAGES_PER_S, gyro_rate_hz=1000.0, image_rate_hz=IMAGES_PER_S)
    return scenario, simulate_los(scenario, 0).data


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


def native_los(data: LosData) -> Graph:
    """A native graph with a keyframe for every picture."""
    return native(data.gyro_t, data.gyro, data.image_t, 2e-5)


def native_head(data: HeadData) -> Graph:
    """A native graph with a keyframe for every picture and the helmet gyro's bias as the only error of the gyros."""
    return native(data.head_t, data.head_gyro, data.vision_t, 8.7e-3)


def native(t: Array, gyro: Array, seen: Array, sigma: float) -> Graph:
    """A graph of three shared angles: AHRSFactors between keyframes and a BetweenFactorRot3 to the mount at each.

    It has three rows where a LOS error has two, and six shared unknowns where the methods' have tens.

    Args:
        t: (N,) s of the gyro's samples.
        gyro: (N, 3) rad/s.
        seen: (K,) s of the measurements.
        sigma: of these, rad.
    """
    time, path = seen[(seen >= t[0]) & (seen <= t[-1])], GyroPath(t, gyro)
    keys, n = [int(gtsam.symbol("x", k)) for k in range(len(time))], len(time)
    turns = path.increments(time[:-1], time[1:])
    graph, values, rng = gtsam.NonlinearFactorGraph(), gtsam.Values(), np.random.default_rng(0)
    variance = 1e-4**2 * np.diff(time)
    for factor in ahrs_factors(keys[:-1], keys[1:], [BIAS] * (n - 1), turns, path.bias_hat, variance):
        graph.add(factor)
    values.insert(BIAS, np.zeros(3))
    graph.add(gtsam.PriorFactorVector(BIAS, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.05)))
    values.insert(MOUNT, gtsam.Rot3.Expmap(np.full(3, 0.01)))
    # Without it nothing holds mount and keyframes where they are.
    graph.add(gtsam.PriorFactorRot3(MOUNT, gtsam.Rot3(), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
    for key, wxyz in zip(keys, path.attitude(time), strict=True):
        attitude = so3.to_gtsam(wxyz)
        values.insert(key, attitude)
        measured = attitude.compose(gtsam.Rot3.Expmap(sigma * rng.standard_normal(3)))
        graph.add(gtsam.BetweenFactorRot3(MOUNT, key, measured, noise))
    return graph, values


def solve(compiled: Compiled) -> Solution:
    """By the batch solver's outer loop, gate included, noise levels as stated."""
    engine = apply_levels(compiled.engine, compiled.problem.noises)
    return solve_robust(engine, compiled.initial, compiled.problem.loss).at_inliers()


def solve_native(graph: Graph) -> int:
    """By gtsam.LevenbergMarquardtOptimizer as it comes; returns its iterations."""
    optimizer = gtsam.LevenbergMarquardtOptimizer(*graph)
    optimizer.optimize()
    return int(optimizer.iterations())


def in_gtsam(problem: Problem) -> Graph:
    """The whole problem as a graph of gtsam, a CustomFactor a measurement, without loss."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for step in problem.steps(1):
        values.insert(step.initial)
        for f in step.factors:
            graph.add(f.factor if f.measurement is None else f.measurement.under(None).factor)
    return graph, values


def against_native(name: str, problem: Problem, theirs: Graph, compared: str, wanted: float) -> Ratio:
    """The batch solver's outer loop on our problem, compiled, and gtsam's optimizer on a graph of native factors."""
    ours = Compiled.of(problem)
    a, b = costs([lambda: solve(ours), lambda: solve_native(theirs)])
    return Ratio(name, compared, a.seconds / b.seconds, wanted=wanted, ours=a, theirs=b)


def whole_answer(name: str, problem: Problem, theirs: Graph, compared: str) -> Ratio:
    """All that is computed of a recording, noise levels, covariance and influence included, against the same graph."""
    a, b = costs([lambda: solve_batch(problem, budget=True), lambda: solve_native(theirs)])
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
    single, compiled = in_gtsam(problem), Compiled.of(problem)
    a, b = costs([lambda: solve(compiled), lambda: solve_native(single)], 1, warm=False)
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
            theirs = native_los(los_recording(n)[1])
            ratio = against_native("batch.los", problem, theirs, compared, 1.3)
            yield ratio
            compared = "the same with noise levels, covariance, influence and all else computed, over native-only"
            yield whole_answer("batch.los.whole", problem, theirs, compared)
            yield against_ideal(n)
            assert ratio.ours is not None
            seconds.append(ratio.ours.seconds)
        else:
            seconds += [costs([partial(solve, Compiled.of(problem))])[0].seconds]
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
