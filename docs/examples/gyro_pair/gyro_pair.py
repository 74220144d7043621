"""Two gyros on one body: relative rotation, time offset and bias difference. A whole method in one file.

Frames: a, b of the two gyros; aRb maps coordinates in b to coordinates in a. One body has one rate, w_a = aRb w_b. Gyro
a reads w_a + e_a, gyro b w_b + e_b. Minus the bias difference d = e_b - bRa e_a, b reads bRa (w_a + e_a): the rotations
integrated over one window are conjugate, dB(d) = bRa dA aRb, exactly, with neither bias known by itself.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.model import ROT3, Array, Model, Residuals
from alidade.factors.preintegration import GyroPath, Increments
from alidade.pipelines.diagnostics.checklist import ChecklistItem, turned
from alidade.pipelines.diagnostics.cross_validation import Validation, rms
from alidade.pipelines.diagnostics.fault_models import AXES, FaultModel
from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.display.figure import COLORS, Figure, Plot
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.advice import Motion
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameter_problem import parameter_problem
from alidade.pipelines.estimation.parameters import ParameterSpec, scalar
from alidade.pipelines.estimation.problem import Estimate, Problem
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.methods import Guidance, Method, Report, Scenario, Simulator
from alidade.pipelines.methods.formula import Formula
from alidade.pipelines.methods.noise import stated
from alidade.pipelines.noises import NoiseSpec
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.checks import check_overlap
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Numbers, Vectors
from alidade.pipelines.recording.streams import StreamReader, imu_series
from alidade.pipelines.recording.topics import Topic
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.motion import EulerMotion, Swing, sample_times
from alidade.pipelines.simulation.scenario import ScenarioPart, sways
from alidade.pipelines.simulation.simulated import Simulated

MAX_OFFSET_S = 0.5  # the time offset is searched for within this
WINDOW_S, WINDOW_SAMPLES = 0.1, 20  # windows that are compared are at least this long: short against turns
MIN_WINDOWS = 10
GYRO_A, GYRO_B = (Topic(f"gyro_{each}", f"/gyro_{each}/imu", messages.RATES) for each in "ab")
B_DENSITY = NoiseSpec("gyro_b_density", "rad/s/√Hz", "Gyro b white noise.", 5e-5)
PARAMETERS = (
    ParameterSpec("rotation", "rad", np.pi, "Misalignment of gyro b in gyro a, {axis}.", require=1e-3, rotation="aRb"),
    scalar("time_offset", "s", 0.1, "Time offset of gyro b (true time minus stamp, on gyro a's clock).", require=5e-4),
    ParameterSpec("bias_difference", "rad/s", 0.1, "Bias b minus a, {axis}.", require=2e-4, per_recording=True),
)
FORMULAS = (
    Formula("gyro b to gyro a", "aRb", "Exp(rotation)", ()),
    Formula(
        "reading of gyro a, its bias included, rad/s in a", "gyro_a", "aRb * (gyro_b - bias_difference)", ("gyro_b",)
    ),
    Formula("time of that reading on gyro a's clock, s", "time", "stamp + time_offset", ("stamp",)),
)


@dataclass(frozen=True, eq=False)
class GyroPairData:
    """Stamps (N,) s from epoch_ns, rates (N, 3) rad/s, and densities, rad/s/sqrt(Hz), of gyros a and b."""

    epoch_ns: int
    a_t: Numbers
    a_gyro: Vectors
    b_t: Numbers
    b_gyro: Vectors
    a_density: float | None = None
    b_density: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)

    def densities(self, config: Config) -> tuple[float, float]:
        """White noise of a and b: of the config, else of the messages, else the default."""
        return stated("gyro_density", config, self.a_density).stated, stated(B_DENSITY, config, self.b_density).stated


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
        """Residual Log((bRa dA aRb)^T dB) / sigma, (n, 3)."""
        begin, end = self.start + offset[:, 0], self.time + offset[:, 0]
        dA = self.a.increments(begin, end)
        predicted = so3.compose(so3.inverse(aRb), dA.wxyz, aRb)
        correction = np.einsum("nij,nj->ni", self.turns.bias_jacobian, difference - self.b.bias_hat)
        error = so3.log(so3.multiply(so3.inverse(predicted), so3.multiply(self.turns.wxyz, so3.exp(correction))))
        weight = (1.0 / self.sigma)[:, None]

        def jacobians() -> tuple[Array, ...]:
            by_predicted = -so3.right_jacobian_inverse(-error) * weight[..., None]
            by_dB = so3.right_jacobian_inverse(error) * weight[..., None]
            # A later window gains the rate at its end and loses the one at its start.
            drift = dA.rate - so3.rotate(so3.inverse(dA.wxyz), self.a.rate(begin))
            return (
                by_predicted @ (np.eye(3) - so3.matrix(so3.inverse(predicted))),
                by_predicted @ so3.rotate(so3.inverse(aRb), drift)[..., None],
                by_dB @ so3.right_jacobian(correction) @ self.turns.bias_jacobian,
            )

        return error * weight, jacobians


def align(data: GyroPairData) -> dict[str, Array]:
    """Cross-correlation of the norms of the rates, then Kabsch's rotation (Furgale, Rehder, Siegwart, IROS 2013)."""
    step = min(float(np.median(np.diff(t))) for t in (data.a_t, data.b_t))
    grid = np.arange(max(data.a_t[0], data.b_t[0]) + MAX_OFFSET_S, min(data.a_t[-1], data.b_t[-1]) - MAX_OFFSET_S, step)
    a, b = np.linalg.norm(data.a_gyro, axis=1), np.interp(grid, data.b_t, np.linalg.norm(data.b_gyro, axis=1))
    shifts = step * np.arange(-int(MAX_OFFSET_S / step), int(MAX_OFFSET_S / step) + 1)
    fit = np.array([np.corrcoef(np.interp(grid + shift, data.a_t, a), b)[0, 1] for shift in shifts])
    best = int(np.clip(np.argmax(fit), 1, len(fit) - 2))
    left, top, right = fit[best - 1 : best + 2]
    offset = float(shifts[best] + 0.5 * step * (left - right) / (left - 2.0 * top + right))
    a, b = rates_at(data, offset)
    aRb = so3.align(a - a.mean(axis=0), b - b.mean(axis=0))
    return {
        "rotation": aRb,
        "time_offset": np.array([offset]),
        "bias_difference": (b - so3.rotate(so3.inverse(aRb), a)).mean(axis=0),
    }


def rates_at(data: GyroPairData, offset: float) -> tuple[Array, Array]:
    """Rates (n, 3) of both gyros at the moments of b's samples, each in its own frame."""
    at = data.b_t + offset
    inside = (at >= data.a_t[0]) & (at <= data.a_t[-1])
    return np.stack([np.interp(at[inside], data.a_t, each) for each in data.a_gyro.T], axis=1), data.b_gyro[inside]


def published(data: GyroPairData, config: Config, problem: Problem) -> Estimate:
    """The two stages of `align` as a solver; the covariance is the Cramer-Rao bound of each by itself, rates white."""
    start, found = time.perf_counter(), align(data)
    step, lag, offset = float(np.median(np.diff(data.b_t))), 20, float(found["time_offset"][0])
    variance = sum(density**2 for density in data.densities(config)) / step
    a, b = rates_at(data, offset)
    rate, slope = b - b.mean(axis=0), np.diff(np.linalg.norm(a, axis=1)[::lag]) / (lag * step)
    tangent = np.linalg.inv(np.eye(3) / np.pi**2 + ((rate**2).sum() * np.eye(3) - rate.T @ rate) / variance)
    phi = so3.log(found["rotation"])
    covariance = np.zeros((7, 7))
    covariance[:3, :3] = so3.right_jacobian_inverse(phi) @ tangent @ so3.right_jacobian_inverse(phi).T
    covariance[3, 3] = 1.0 / (1.0 / MAX_OFFSET_S**2 + lag * (slope**2).sum() / variance)
    covariance[4:, 4:] = variance / len(b) * np.eye(3)
    return Estimate(
        solver="published",
        names=tuple(q.name for q in problem.quantities),
        values=np.concatenate([phi, [offset], found["bias_difference"]]),
        covariance=covariance,
        converged=abs(offset) < MAX_OFFSET_S,
        message="cross-correlation, then singular values",
        seconds={"solve": time.perf_counter() - start},
    )


def windows(data: GyroPairData) -> tuple[Array, Array]:
    """Starts and ends (n,), s by b's stamps, of adjoining windows that gyro a covers for any offset.

    They end between two samples of b, so that neighbours share next to none. Raises InputError when they are too few.
    """
    steps = [float(np.median(np.diff(t))) for t in (data.a_t, data.b_t)]
    stride = int(np.ceil(max(WINDOW_S, WINDOW_SAMPLES * max(steps)) / steps[1]))
    edges = 0.5 * (data.b_t[1:] + data.b_t[:-1])[::stride]
    inside = (edges[:-1] >= data.a_t[0] + MAX_OFFSET_S) & (edges[1:] <= data.a_t[-1] - MAX_OFFSET_S)
    if inside.sum() < MIN_WINDOWS:
        raise InputError(
            f"the gyros have {int(inside.sum())} windows of {stride * steps[1]:.2g} s in common, {MAX_OFFSET_S:g} s "
            f"from the ends of gyro_a's record; at least {MIN_WINDOWS} are needed: record longer, or check the clocks"
        )
    return edges[:-1][inside], edges[1:][inside]


def problem(data: GyroPairData, config: Config) -> Problem:
    """Rotations over windows, three variables. Raises InputError for too few windows or an unknown parameter."""
    (start, stop), guess = windows(data), align(data)
    a, b = GyroPath(data.a_t, data.a_gyro), GyroPath(data.b_t, data.b_gyro, guess["bias_difference"])
    turns = b.increments(start, stop)
    unseen = turns.unseen + a.increments(start + guess["time_offset"], stop + guess["time_offset"]).unseen
    variance = sum(density**2 for density in data.densities(config)) * turns.duration + unseen
    model = ConjugateRotation(stop, start, turns, np.sqrt(variance), a, b)
    noises = (Level(stated("gyro_density", config, data.a_density, ("increment",))),)
    fields = {"advice": advice, "dropped": data.dropped, "noises": noises}
    return parameter_problem("gyro_pair", PARAMETERS, config, guess, "increment", model, **fields)


def advice(weights: Mapping[str, float]) -> Motion:
    """The motion that makes a weak direction observable."""
    strong = [name for name, weight in weights.items() if abs(weight) > 0.3]
    if any(name.startswith("rotation") for name in strong):
        why = "the rotation needs motion about two axes"
        return Motion("turn the body about one axis, then about another", swaying("xy", "body"), why)
    if "time_offset" in strong:
        return Motion("turn the body back and forth within a second", why="the time offset needs changing rates")
    return Motion("record longer", why="the bias difference is not determined yet")


def checklist(data: GyroPairData, _: Config) -> list[ChecklistItem]:
    """Turns about the axes of a, two of which are enough."""
    angles = np.rad2deg(turned(data.a_t, data.a_gyro))
    have = ", ".join(f"{axis} {angle:.0f} deg" for axis, angle in zip("xyz", angles, strict=True))
    return [ChecklistItem("turns", have, "" if (angles >= 20).sum() >= 2 else "turn the body by 20 deg about two axes")]


def variations(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """A planned motion with one more sway."""
    for words, motion in sways(scenario["motion"], {"amplitude_deg": 20.0, "frequency_hz": 0.29}):
        yield f"the body: {words}", {**scenario, "motion": motion}


def rates(data: GyroPairData, values: Mapping[str, float]) -> tuple[Array, Array, Array]:
    """Starts of windows (n,), s, and mean rates (n, 3), rad/s in b: by gyro b, and predicted from gyro a."""
    start, stop = windows(data)
    rotation, difference = (
        np.array([values.get(f"{name}_{axis}", 0.0) for axis in "xyz"]) for name in ("rotation", "bias_difference")
    )
    offset = values.get("time_offset", 0.0)
    a, b = GyroPath(data.a_t, data.a_gyro), GyroPath(data.b_t, data.b_gyro)
    by_a, by_b = (
        so3.log(turns.wxyz) / turns.duration[:, None]
        for turns in (a.increments(start + offset, stop + offset), b.increments(start, stop))
    )
    return start, by_b, so3.rotate(so3.inverse(so3.exp(rotation)), by_a) + difference


def validate(data: GyroPairData, _: Config, values: Mapping[str, float]) -> list[Validation]:
    """Rate of b minus that predicted from a, without and with a calibration."""
    start, by_b, before = rates(data, {})
    return [Validation("rate of gyro b against gyro a's", "rad/s", start, by_b - before, by_b - rates(data, values)[2])]


def figures(data: GyroPairData, calibration: Any) -> list[Plot]:
    """Both gyros' rates in one frame."""
    start, by_b, predicted = rates(data, calibration.values)
    both = Figure("rate in b, deg/s")
    for i, axis in enumerate("xyz"):
        both.points(start, np.rad2deg(by_b[:, i]), f"gyro b {axis}", COLORS[i], 3)
        both.line(start, np.rad2deg(predicted[:, i]), f"from gyro a {axis}", COLORS[i])
    left = np.rad2deg(rms(by_b - predicted))
    return [Plot("Both gyros in one frame", f"Mean rates over windows; difference {left:.3g} deg/s RMS.", both)]


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


def simulate(scenario: GyroPairScenario, seed: int, images: bool = False) -> Simulated:
    """Exact mean rates over each sample interval, constant biases, white noise. Raises InputError for pictures."""
    if images:
        raise InputError("gyro_pair has no camera: leave out --images")
    rng, aRb, samples, biases = np.random.default_rng(seed), so3.exp(np.deg2rad(scenario.rotation_deg)), [], []
    for gyro, aRg, late in ((scenario.gyro_a, so3.identity(), 0.0), (scenario.gyro_b, aRb, scenario.time_offset_s)):
        t = sample_times(scenario.duration_s, gyro.rate_hz, gyro.phase)
        edges: Array = (np.arange(len(t) + 1, dtype=float) + gyro.phase - 0.5) / gyro.rate_hz + late
        attitude = so3.multiply(scenario.motion.attitude(edges), aRg)
        rate = so3.log(so3.multiply(so3.inverse(attitude[:-1]), attitude[1:])) * gyro.rate_hz
        biases.append(np.deg2rad(gyro.bias_deg_s) * rng.standard_normal(3))
        samples.append((t, rate + biases[-1] + gyro.density * np.sqrt(gyro.rate_hz) * rng.standard_normal(rate.shape)))
    vectors = {"rotation": so3.log(aRb), "bias_difference": biases[1] - so3.rotate(so3.inverse(aRb), biases[0])}
    truth = {f"{name}_{axis}": float(x) for name, v in vectors.items() for axis, x in zip("xyz", v, strict=True)}
    (a_t, a_gyro), (b_t, b_gyro) = samples
    densities = scenario.gyro_a.density, scenario.gyro_b.density
    data = GyroPairData(1_795_176_000_000_000_000, a_t, a_gyro, b_t, b_gyro, *densities)
    config = dump_yaml({"method": "gyro_pair", "priors": scenario.priors})
    return Simulated(data, truth | {"time_offset": scenario.time_offset_s}, config)


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
    faults=FaultModel(
        streams={"a_t": ("a_gyro",), "b_t": ("b_gyro",)},
        signs={"a_gyro": ("gyro a", AXES), "b_gyro": ("gyro b", AXES)},
    ),
    simulator=Simulator(scenario=GyroPairScenario, simulate=simulate),
    guidance=Guidance(checklist=checklist, variations=variations),
    report=Report(formulas=lambda *_: FORMULAS, figures=figures, validate=validate),
)
