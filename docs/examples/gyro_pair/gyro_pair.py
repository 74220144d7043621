"""Two gyros on one body: relative rotation, time offset and bias difference. A whole method in one file.

Frames: a, b of the two gyros; aRb maps coordinates in b to coordinates in a. One body has one rate, w_a = aRb w_b. Gyro
a reads w_a + e_a, gyro b w_b + e_b. Minus the bias difference d = e_b - bRa e_a, b reads bRa (w_a + e_a): the rotations
integrated over one window are conjugate, dB(d) = bRa dA aRb, exactly, with neither bias known by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import block_diag

# isort: off
from alidade.plugin import (
    AXES, COLORS, EPOCH_NS, ROT3, Array, Config, Estimate, EulerMotion, FaultModel, Figure, Formula, Guidance, GyroPath,
    Increments, InputError, Level, Method, Model, Motion, NoiseSpec, Numbers, ParameterSpec, PlatformRates, Plot,
    Problem, Recording, Report, Residuals, ScenarioPart, Simulated, Simulator, StreamReader, Swing, Topic, Validation,
    apply, by_axis, check_overlap, imu_series, messages, nanoseconds, pair, parameter_problem, recording_config, rms,
    sample_times, scalar, so3, stated, swaying, swayed, sways, turned,
)  # fmt: skip

MAX_OFFSET_S = 0.5  # the time offset is searched for within this
WINDOW_S, WINDOW_SAMPLES = 0.1, 20  # windows that are compared are at least this long: short against turns
MIN_WINDOWS = 10
TURN = np.deg2rad(20.0)  # about each axis, that `follow` asks for
SWAY = {"amplitude_deg": 20.0, "frequency_hz": 0.29}  # that `plan` proposes to add
GYRO_A, GYRO_B = (Topic(f"gyro_{each}", f"/gyro_{each}/imu", messages.RATES) for each in "ab")
B_DENSITY = NoiseSpec("gyro_b_density", "rad/s/√Hz", "Gyro b white noise.", 5e-5)
PARAMETERS = (
    ParameterSpec("rotation", "rad", np.pi, "Misalignment of gyro b in gyro a, {axis}.", require=1e-3, rotation="aRb"),
    scalar("time_offset", "s", 0.1, "Time offset of gyro b (true time minus stamp, on gyro a's clock).", require=5e-4),
    ParameterSpec("bias_difference", "rad/s", 0.1, "Bias b minus a, {axis}.", require=2e-4, per_recording=True),
)
FORMULAS = (
    Formula("gyro b to gyro a", "aRb", "Exp(rotation)", ()),
    Formula("rate in a, gyro a's bias in it, rad/s", "gyro_a", "aRb * (gyro_b - bias_difference)", ("gyro_b",)),
    Formula("time of that reading on gyro a's clock, s", "time", "stamp + time_offset", ("stamp",)),
)


@dataclass(frozen=True, eq=False)
class GyroPairData:
    """Stamps (N,) s from epoch_ns, rates (N, 3) rad/s, and densities, rad/s/sqrt(Hz), of gyros a and b."""

    epoch_ns: int
    a_t: Numbers
    a_gyro: PlatformRates
    b_t: Numbers
    b_gyro: PlatformRates
    a_density: float | None = None
    b_density: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)

    def variance(self, config: Config) -> float:
        """White noise of both rates, (rad/s)^2/Hz: of the config, else of the messages, else the default."""
        a, b = stated("gyro_density", config, self.a_density), stated(B_DENSITY, config, self.b_density)
        return a.stated**2 + b.stated**2


def read(recording: Recording, config: Config) -> GyroPairData:
    """Both gyros. Raises InputError when a topic is unusable, and when the two have no time in common."""
    names = config.topic(GYRO_A), config.topic(GYRO_B)
    reader = StreamReader(recording, dict.fromkeys(names, ()))
    a, b = (reader.gyro(name, may_be_constant=True) for name in names)
    check_overlap(dict(zip(names, (a.t, b.t), strict=True)))
    densities = reader.density(names[0], "gyro", a), reader.density(names[1], "gyro", b)
    return GyroPairData(reader.epoch_ns, a.t, a.series.gyro, b.t, b.series.gyro, *densities, reader.dropped)


def to_topics(data: GyroPairData, _pictures: None = None) -> dict[str, Any]:
    """Series by topic, to be written."""
    a = imu_series(data.epoch_ns, data.a_t, data.a_gyro, density=data.a_density, frame_id="a")
    b = imu_series(data.epoch_ns, data.b_t, data.b_gyro, density=data.b_density, frame_id="b")
    return {GYRO_A.name: a, GYRO_B.name: b}


@dataclass(frozen=True)
class ConjugateRotation(Model):
    """Increments of gyro b over n windows against those of gyro a; blocks: aRb, time offset (s), difference (rad/s)."""

    time: Array  # (n,) ends of the windows, s
    start: Array  # (n,)
    turns: Increments  # of b
    sigma: Array  # (n,) rad per axis
    a: GyroPath
    b: GyroPath
    rows: int = 3
    blocks = (ROT3, 1, 3)
    stacked: ClassVar = ("time", "start", "turns", "sigma")

    def __call__(self, aRb: Array, offset: Array, difference: Array) -> Residuals:
        """Residual (Log dB(difference) - bRa Log dA) / sigma, (n, 3); Log of a conjugate is the rotated Log."""
        begin = self.start + offset[:, 0]
        dA = self.a.increments(begin, self.time + offset[:, 0])
        turned_a, turned_b, bRa = so3.log(dA.wxyz), so3.log(self.turns.wxyz), so3.inverse(aRb)
        by_bias = so3.right_jacobian_inverse(turned_b) @ self.turns.bias_jacobian
        predicted, weight = so3.rotate(bRa, turned_a), 1.0 / self.sigma[:, None]
        error = turned_b + np.einsum("nij,nj->ni", by_bias, difference - self.b.bias_hat) - predicted

        def jacobians() -> tuple[Array, ...]:
            # A later window gains the rate at its end and loses the one at its start.
            drift = dA.rate - so3.rotate(so3.inverse(dA.wxyz), self.a.rate(begin))
            by_time = -so3.matrix(bRa) @ so3.right_jacobian_inverse(turned_a) @ drift[..., None]
            by_rotation = np.cross(predicted[:, None, :], np.eye(3)).swapaxes(1, 2)
            return tuple(weight[..., None] * each for each in (-by_rotation, by_time, by_bias))

        return error * weight, jacobians


def windows(data: GyroPairData) -> tuple[Array, Array]:
    """Starts and ends (n,), s by b's stamps, of windows between samples of b. Raises InputError for too few."""
    steps = [float(np.median(np.diff(t))) for t in (data.a_t, data.b_t)]
    stride = int(np.ceil(max(WINDOW_S, WINDOW_SAMPLES * max(steps)) / steps[1]))
    edges = 0.5 * (data.b_t[1:] + data.b_t[:-1])[::stride]
    inside = (edges[:-1] >= data.a_t[0] + MAX_OFFSET_S) & (edges[1:] <= data.a_t[-1] - MAX_OFFSET_S)
    if inside.sum() < MIN_WINDOWS:
        text = f"the gyros have {int(inside.sum())} windows of {stride * steps[1]:.2g} s in common, {MIN_WINDOWS} are"
        raise InputError(f"{text} needed {MAX_OFFSET_S:g} s from the ends: record longer, or check the clocks")
    return edges[:-1][inside], edges[1:][inside]


def rates(data: GyroPairData, offset: float) -> list[Array]:
    """Starts of windows (n,), s, and mean rates (n, 3), rad/s, of gyros a and b, each in its own frame."""
    start, stop = windows(data)
    turns_a = GyroPath(data.a_t, data.a_gyro).increments(start + offset, stop + offset)
    turns_b = GyroPath(data.b_t, data.b_gyro).increments(start, stop)
    return [start, *(so3.log(turns.wxyz) / turns.duration[:, None] for turns in (turns_a, turns_b))]


def align(data: GyroPairData) -> dict[str, Array]:
    """Cross-correlation of the norms of the rates, then Kabsch's rotation (Furgale, Rehder, Siegwart, IROS 2013)."""
    a_ns, b_ns = nanoseconds(data.a_t, 0), nanoseconds(data.b_t, 0)
    pairing = pair(a_ns, data.a_gyro, b_ns, GyroPath(data.b_t, data.b_gyro).attitude(data.b_t))
    offset = 0.0 if pairing is None else float(np.clip(pairing.offset_s, -MAX_OFFSET_S, MAX_OFFSET_S))
    _, a, b = rates(data, offset)
    aRb = so3.align(a - a.mean(axis=0), b - b.mean(axis=0))
    difference = (b - so3.rotate(so3.inverse(aRb), a)).mean(axis=0)
    return {"rotation": aRb, "time_offset": np.array([offset]), "bias_difference": difference}


def published(data: GyroPairData, config: Config, problem: Problem) -> Estimate:
    """The two stages of `align` as a solver; the covariance is the Cramer-Rao bound of each by itself, rates white."""
    found = align(data)
    offset, phi, difference = found["time_offset"], so3.log(found["rotation"]), found["bias_difference"]
    start, a, b = rates(data, float(offset[0]))
    length, J = float(start[1] - start[0]), so3.right_jacobian_inverse(phi)
    variance, rate = data.variance(config) / length, b - b.mean(axis=0)
    tangent = np.linalg.inv(np.eye(3) / np.pi**2 + ((rate**2).sum() * np.eye(3) - rate.T @ rate) / variance)
    slope = np.diff(np.linalg.norm(a, axis=1)) / length
    of_time = 1.0 / (1.0 / MAX_OFFSET_S**2 + (slope**2).sum() / variance)
    covariance = block_diag(J @ tangent @ J.T, of_time, variance / len(b) * np.eye(3))
    values, names = np.concatenate([phi, offset, difference]), tuple(q.name for q in problem.quantities)
    return Estimate("published", names, values, covariance, bool(abs(offset[0]) < MAX_OFFSET_S), "two stages")


def problem(data: GyroPairData, config: Config) -> Problem:
    """Rotations over windows, three variables. Raises InputError for too few windows or an unknown parameter."""
    (start, stop), guess = windows(data), align(data)
    a, b = GyroPath(data.a_t, data.a_gyro), GyroPath(data.b_t, data.b_gyro, guess["bias_difference"])
    turns = b.increments(start, stop)
    unseen = turns.unseen + a.increments(start + guess["time_offset"], stop + guess["time_offset"]).unseen
    model = ConjugateRotation(stop, start, turns, np.sqrt(data.variance(config) * turns.duration + unseen), a, b)
    noises = (Level(stated("gyro_density", config, data.a_density, ("increment",))),)
    more = {"advice": advice, "dropped": data.dropped, "noises": noises}
    return parameter_problem("gyro_pair", PARAMETERS, config, guess, "increment", model, **more)


def advice(weights: Mapping[str, float]) -> Motion:
    """The motion that makes a weak direction observable."""
    strong = [name.rstrip("_xyz") for name, weight in weights.items() if abs(weight) > 0.3]
    if "rotation" in strong:
        return Motion("turn the body about one axis, then another", swaying("xy", "body"), "a rotation needs two axes")
    if "time_offset" in strong:
        return Motion("turn the body back and forth within a second", why="the time offset needs changing rates")
    return Motion("record longer", why="the bias difference is not determined yet")


def compared(data: GyroPairData, values: Mapping[str, float]) -> tuple[Array, Array, Array]:
    """Starts of windows (n,), s, and mean rates (n, 3), rad/s in a: by gyro a, and by gyro b as the formulas say."""
    start, by_a, by_b = rates(data, values.get("time_offset", 0.0))
    return start, by_a, apply(FORMULAS, values, {"gyro_b": by_b})["gyro_a"]


def validate(data: GyroPairData, _: Config, values: Mapping[str, float]) -> list[Validation]:
    """Rate of a minus that by gyro b, without and with a calibration."""
    start, a, uncalibrated = compared(data, {})
    late, calibrated = compared(data, values)[1:]
    return [Validation("rate of gyro a against gyro b's", "rad/s", start, a - uncalibrated, late - calibrated)]


def figures(data: GyroPairData, calibration: Any) -> list[Plot]:
    """Both gyros' rates in one frame."""
    start, *both = compared(data, calibration.values)
    out = Figure("rate in a, deg/s")
    for i, axis in enumerate("xyz"):
        out.points(start, np.rad2deg(both[0][:, i]), f"gyro a {axis}", COLORS[i], 3)
        out.line(start, np.rad2deg(both[1][:, i]), f"from gyro b {axis}", COLORS[i])
    left = np.rad2deg(rms(both[0] - both[1]))
    return [Plot("Both gyros in one frame", f"Mean rates over windows; difference {left:.3g} deg/s RMS.", out)]


class Gyro(ScenarioPart):
    """Settings of one simulated gyro."""

    rate_hz: float = 200.0
    phase: float = 0.0  # of the first stamp, in sample intervals
    density: float = 1e-4  # rad/s/sqrt(Hz)
    bias_deg_s: float = 0.3  # sigma per axis


class GyroPairScenario(ScenarioPart):
    """Settings of the simulator."""

    duration_s: float = 60.0
    motion: EulerMotion = EulerMotion(
        yaw=[Swing(amplitude_deg=40, frequency_hz=0.31), Swing(amplitude_deg=6, frequency_hz=1.1)],
        pitch=[Swing(amplitude_deg=30, frequency_hz=0.23), Swing(amplitude_deg=5, frequency_hz=1.3)],
        roll=[Swing(amplitude_deg=25, frequency_hz=0.41)],
    )
    gyro_a: Gyro = Gyro()
    gyro_b: Gyro = Gyro(rate_hz=400.0, phase=0.4, density=2e-4)
    rotation_deg: tuple[float, float, float] = (60.0, -80.0, 70.0)  # rotation vector of aRb
    time_offset_s: float = 0.012  # positive: b's samples were taken later than their stamps say
    priors: dict[str, float | None] = {}  # passed on to the recording's config


def simulate(scenario: GyroPairScenario, seed: int, _images: bool = False) -> Simulated:
    """Exact mean rates over each sample interval, constant biases, white noise."""
    rng, aRb, samples, biases = np.random.default_rng(seed), so3.exp(np.deg2rad(scenario.rotation_deg)), [], []
    for gyro, aRg, late in ((scenario.gyro_a, so3.identity(), 0.0), (scenario.gyro_b, aRb, scenario.time_offset_s)):
        t = sample_times(scenario.duration_s, gyro.rate_hz, gyro.phase)
        edges: Array = (np.arange(len(t) + 1, dtype=float) + gyro.phase - 0.5) / gyro.rate_hz + late
        attitude = so3.multiply(scenario.motion.attitude(edges), aRg)
        rate = so3.local(attitude[:-1], attitude[1:]) * gyro.rate_hz
        biases.append(np.deg2rad(gyro.bias_deg_s) * rng.standard_normal(3))
        samples.append((t, rate + biases[-1] + gyro.density * np.sqrt(gyro.rate_hz) * rng.standard_normal(rate.shape)))
    data = GyroPairData(EPOCH_NS, *samples[0], *samples[1], scenario.gyro_a.density, scenario.gyro_b.density)
    truth = by_axis(rotation=so3.log(aRb), bias_difference=biases[1] - so3.rotate(so3.inverse(aRb), biases[0]))
    truth["time_offset"] = scenario.time_offset_s
    return Simulated(data, truth, recording_config("gyro_pair", scenario, {}))


METHOD = Method(
    name="gyro_pair",
    title="Two gyros",
    data=GyroPairData,
    topics=(GYRO_A, GYRO_B),
    requirements=(((GYRO_A,),), ((GYRO_B,),)),
    read=read,
    to_topics=to_topics,
    parameters=PARAMETERS,
    noise=(B_DENSITY,),
    problem=problem,
    published=published,
    faults=FaultModel({f"{g}_t": (f"{g}_gyro",) for g in "ab"}, {f"{g}_gyro": (f"gyro {g}", AXES) for g in "ab"}),
    simulator=Simulator(scenario=GyroPairScenario, simulate=simulate),
    guidance=Guidance(
        checklist=lambda d, _: swayed("body", turned(d.a_t, d.a_gyro), TURN, "turn the body about its", "body"),
        variations=lambda scenario: sways(scenario, "motion", "the body", SWAY),
    ),
    report=Report(formulas=lambda *_: FORMULAS, figures=figures, validate=validate),
)
