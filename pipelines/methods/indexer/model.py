"""The indexer method: mounting of an IMU against the axes of a two-axis indexer, from mean gyro rates.

The recording is cut into groups of adjoining windows: a group for every whole turn, for what is left of a run, for
every move between positions and for every dwell. A window ends where the driven axis has turned by an eighth of a turn.
Each group is one factor on the mounting and the gyro's bias in force. Methods page, section 2.

The config's encoder noise may be larger than the scatter of a resting encoder shows. The rest is slow: harmonics of
the encoder, wobble of the axes, errors that come again with every turn. Then a whole turn is a single window, over
which they cancel but for a constant tilt of the axis, an unknown of each position.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.chi_square import gate
from alidade.factors.earth import EARTH_RATE
from alidade.factors.indexer import ENCODER_ERRORS, IndexerAverageFactor, Option, base_from_platform
from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.noise import Level, Noise
from alidade.pipelines.estimation.priors import prior_of, prior_sigmas, vector_about
from alidade.pipelines.estimation.problem import Attitudes, ChainLayout, Factor, Parameter, Problem, Step
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.estimation.walking_bias import NODES, WalkingBias
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.indexer.guidance import turning
from alidade.pipelines.methods.indexer.parameters import (
    EPSILON,
    KEYS,
    SCALE,
    SKEW,
    THETA,
    THETA_UNIT,
    indexer_parameters,
    theta_coordinates,
)
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.windows import (
    KINDS,
    AxisMotion,
    Group,
    axis_motion,
    cut_turns,
    encoder_scatter,
    groups_of,
)
from alidade.pipelines.methods.noise import sampled, stated, walking, weighed
from alidade.pipelines.recording.topics import FIX
from alidade.pipelines.settings import Config

# So many groups stay in a smoother whatever its window, s: a schedule of four positions, to be linearised anew when its
# later positions move the angles that its earlier ones left open.
_KEPT = 64
# Encoder errors are in part slow (harmonics) if the config's noise is this much larger than the scatter at rest.
_SLOW = 2.0
# Encoder errors below this, rad, are beneath notice.
_NO_ERROR = 1e-8
# Accuracy of their noise as estimated from the scatter at rest, one sigma of the logarithm.
_SCATTERED = 0.05
# What is stated and the scatter at rest certainly differ beyond so many sigmas of the former.
_CERTAIN = 2.0
# Of windows in which the gyro stuck, or an encoder slipped.
_LOSS = TruncatedLoss(gate(3))


@dataclass(frozen=True)
class _Model:
    """A recording prepared for the graph."""

    data: IndexerData
    motion: AxisMotion
    groups: tuple[Group, ...]
    bias: WalkingBias
    noises: tuple[Level, ...]
    density: float
    encoder: float  # white noise of a sample, rad
    slow: float  # sigma of the errors that come again with every turn, rad; 0: none
    parameters: tuple[Parameter, ...]
    theta_guess: Array
    bias_guess: Array
    frames: Index  # (F,) indexes of the gyro samples whose attitude the trajectory holds
    frame_edges: Index  # (groups + 1,) which of them come with a group

    @property
    def options(self) -> tuple[Option, ...]:
        """Optional variables of the factor that are parameters here."""
        given = {p.key for p in self.parameters}
        names: tuple[Option, ...] = ("errors", "temperature", "encoder", "epsilon")
        return tuple(name for name in names if KEYS[name] in given)


def problem(data: IndexerData, config: Config) -> Problem:
    """Build the graph of an indexer recording.

    Raises:
        InputError: an unknown parameter in the config, no rotation, no latitude although the windows need it, or gyro
            and encoders that disagree.
    """
    model, dropped = _prepare(data, config)
    return Problem(
        method="indexer",
        parameters=model.parameters,
        steps=partial(_steps, model),
        attitudes=partial(_attitudes, model) if len(model.frames) else None,
        advice=_advice,
        dropped=dropped,
        noises=model.noises,
        loss=_LOSS,
        constants=temperature.constants(temperature.reference(data.temperature)),
        layout=ChainLayout(nodes=NODES),
    )


def _mean_rates(groups: Sequence[Group], gyro: Level, encoders: Level) -> tuple[Level, ...]:
    """Noise levels of mean rates for each kind of window: gyro, encoders and additional noise."""
    found = []
    known = max(gyro.noise.known, encoders.noise.known)
    source = gyro.noise.source if encoders.noise.known < known else encoders.noise.source
    for kind in KINDS:
        windows = [np.diff(g.rates.edges) for g in groups if g.kind == kind]
        if windows:
            window = float(np.median(np.concatenate(windows)))
            white = gyro.used / window**0.5
            sigma = float(np.hypot(white, 2.0**0.5 * encoders.used / window))
            least = white / sigma if encoders.noise.source == "default" else 1.0
            found.append(Level(Noise(f"{kind}_rate", sigma, source, known, (kind,), least=least)))
    return tuple(found)


def _encoders(noise: Noise, scatter: float) -> Level:
    """Encoder noise level from the scatter at rest, rad, weighted with the stated level.

    A figure that is certainly another, by how well it is known, stands for more than this noise, and stays.
    """
    ratio = scatter / noise.stated if noise.stated > 0.0 else np.inf
    if scatter <= _NO_ERROR or (noise.source != "default" and abs(np.log(ratio)) >= _CERTAIN * noise.known):
        return Level(noise)
    return weighed(Level(noise, 1.0, ratio, _SCATTERED * ratio)) if noise.known > 0.0 else Level(noise)


def _prepare(data: IndexerData, config: Config) -> tuple[_Model, dict[str, int]]:
    parameters = indexer_parameters(config, data.stamp_sigma, data.temperature is not None)
    motion = axis_motion(data)
    scatter = encoder_scatter(motion)
    gyro, encoders = (
        sampled(stated("gyro_density", config, data.gyro_density), data.gyro_t, data.gyro),
        _encoders(stated("encoder", config), scatter),
    )
    density, encoder = gyro.used, encoders.used
    slow = float(np.sqrt(encoder**2 - scatter**2)) if encoder > max(_SLOW * scatter, _NO_ERROR) else 0.0
    groups = groups_of(data, config, motion, split=slow == 0.0)
    if not any(g.kind != "dwell" for g in groups):
        raise InputError("indexer: no turn or move is free of gaps in the stamps; record again")
    if data.latitude_deg is None:
        shortest = max(float(np.diff(g.rates.edges).max()) for g in groups)
        if density / np.sqrt(shortest) < EARTH_RATE:
            raise InputError(
                f"indexer: the earth's rate shows in windows of {shortest:.3g} s and the latitude is not known; "
                f"record {config.topic(FIX)} or give latitude_deg in the config"
            )
    require_agreeing(groups, parameters)
    theta_guess, bias_guess = guess(groups)
    starts = np.array([g.rates.edges[0] for g in groups])
    walks = walking(config)
    walk = walks.used
    rows = frames(data, motion)
    cut = cut_turns(motion)
    dropped = dict(data.dropped)
    if cut:
        dropped["turn cut by a gap in the stamps (what lies before and after is used)"] = cut
    model = _Model(
        data=data,
        motion=motion,
        groups=groups,
        bias=WalkingBias(np.append(starts, groups[-1].rates.edges[-1]), walk, density, groups[-1].rates.edges[-1]),
        noises=(gyro, walks, encoders, *_mean_rates(groups, gyro, encoders)),
        density=density,
        encoder=scatter if slow > 0.0 else encoder,
        slow=slow,
        parameters=parameters,
        theta_guess=theta_guess,
        bias_guess=bias_guess,
        frames=rows,
        frame_edges=np.append(0, np.searchsorted(data.gyro_t[rows], np.append(starts[1:], np.inf))),
    )
    return model, dropped


def _steps(model: _Model, _: int) -> Iterator[Step]:
    """Yield a step for each group of windows."""
    seen: set[tuple[str, int]] = set()
    for i, group in enumerate(model.groups):
        step = Step(
            time=float(group.rates.edges[-1]),
            keyframes=range(int(model.frame_edges[i]), int(model.frame_edges[i + 1])),
        )
        if i == 0:
            _begin(model, step)
        _add_bias(model, i, step)
        _add_measurement(model, i, seen, step)
        yield step


def _begin(model: _Model, step: Step) -> None:
    """Add the calibration variables and their priors to the first step."""
    for parameter in model.parameters:
        size = len(parameter.quantities)
        if parameter.key == KEYS["theta"]:
            step.initial.insert(parameter.key, model.theta_guess / THETA_UNIT)
            step.factors.append(vector_about(parameter.key, np.zeros(size), prior_sigmas(parameter) / THETA_UNIT))
            continue
        if parameter.key != FIRST_BIAS:
            step.initial.insert(parameter.key, np.zeros(size))
        step.factors.append(prior_of(parameter))


def _add_bias(model: _Model, i: int, step: Step) -> None:
    """Add the bias of group i and the mean bias until then, the reported one, to a step."""
    bias = model.bias
    bias.begin(step, i, model.bias_guess)
    bias.end(step, i, model.bias_guess)
    alive = range(max(0, i + 1 - _KEPT), i + 1)
    bias.keep(step, alive, alive)
    if i > 0:
        step.current_keys[bias.key(0)] = bias.mean_key(i)


def _add_measurement(model: _Model, i: int, seen: set[tuple[str, int]], step: Step) -> None:
    """Add the factor of group i to a step, with the tilt of its position when that is new."""
    group = model.groups[i]
    options = model.options
    columns = [KEYS["theta"], model.bias.key(i), *(KEYS[name] for name in options)]
    if model.slow > 0.0 and group.position is not None:
        axis, position = group.position
        key = int(gtsam.symbol("o" if axis == "outer" else "i", position))
        if group.position not in seen:
            seen.add(group.position)
            step.initial.insert(key, np.zeros(3))
            step.factors.append(vector_about(key, np.zeros(3), model.slow))
        options, columns = (*options, "tilt"), [*columns, key]
    wander = model.slow if group.kind == "move" else 0.0
    # A resting encoder repeats its slow errors from edge to edge, a turning one need not (quantisation).
    turning = np.array([group.run.axis in ("outer", "both"), group.run.axis in ("inner", "both")])
    encoder = np.hypot(model.encoder, np.where(turning, model.slow, 0.0))
    temperature_rise = group.temperature_rise(temperature.reference(model.data.temperature))
    average = IndexerAverageFactor.of(
        group.gyro, group.rates, model.density, encoder, options, wander, THETA_UNIT, temperature_rise
    )
    step.factors.append(Factor.of(group.kind, average.on(*columns, loss=_LOSS)))


def _attitudes(model: _Model, keyframes: Sequence[int], values: gtsam.Values) -> Attitudes:
    """Carrier's attitude nRb over the frames of the trajectory."""
    rows = model.frames[list(keyframes)]
    epsilon = float(values.atVector(KEYS["epsilon"])[0]) if "epsilon" in model.options else 0.0
    encoder = values.atVector(KEYS["encoder"]) if "encoder" in model.options else np.zeros(len(ENCODER_ERRORS))
    theta = theta_coordinates(values, KEYS["theta"])[0]
    return Attitudes(model.data.gyro_t[rows], carrier(model.data, model.motion, rows, theta, epsilon, encoder))


def _advice(weights: Mapping[str, float]) -> Motion:
    """Motion that would make a weak direction observable."""
    strongest = {name for name, w in weights.items() if abs(w) > 0.3}
    outer = turning("outer", 0.0)
    if strongest & set(EPSILON):
        return Motion(
            "make turns about both axes, about the outer one with the inner at 0 and at 180 degrees",
            turning("outer", 180.0),
            "the axes' right angle is not determined",
        )
    if strongest & set(SKEW.names):
        return Motion(
            "make turns about the outer axis with the inner at 90 and at -90 degrees",
            turning("outer", 90.0),
            "the gyro's skew is not determined",
        )
    if strongest & set(SCALE.names):
        return Motion(
            "make turns about the outer axis with the inner at 0 and at 90 degrees",
            turning("outer", 90.0),
            "the gyro's scale needs turns about each of its axes",
        )
    if "theta_x" in strongest:
        return Motion(
            "make turns about the inner axis, forward and back (positions 3 and 4), or record the moves",
            turning("inner", 0.0),
            "theta_x is not determined",
        )
    if "theta_z" in strongest:
        return Motion(
            "make turns about the outer axis, forward and back (positions 1 and 2)", outer, "theta_z is not determined"
        )
    if "theta_y" in strongest:
        return Motion("make whole turns about either axis, forward and back", outer, "theta_y is not determined")
    return Motion("make turns forward and back, or dwell longer", outer, "the gyro bias is not determined")


# A gyro that departs from the encoders by more than this share of the rate is not the gyro of this axis.
_DISAGREEMENT = 0.01


def require_agreeing(groups: tuple[Group, ...], parameters: Sequence[Parameter]) -> None:
    """Raise InputError if the gyro turns the other way, or at another rate, than an encoder of the indexer.

    Fits gyro = A w + b over all groups, so that neither mounting nor bias counts as disagreement.

    Raises:
        InputError: the gyro turns against the encoder of an axis though the mounting's priors exclude that it is upside
            down, or at a rate that differs by more than 1 % and by more than the priors of the gyro's scale allow.
    """
    w = np.array([g.mean_platform for g in groups])
    gyro = np.array([g.mean_gyro for g in groups])
    speed = np.linalg.norm(w, axis=1)
    weight = np.array([g.duration for g in groups])
    for _ in range(10):
        A, b = _fit(w, gyro, weight)
        misfit = np.linalg.norm(gyro - w @ A.T - b, axis=1)
        # Least absolute misfit: one damaged turn does not bend the fit.
        weight = np.array([g.duration for g in groups]) / np.maximum(misfit, 1e-4 * speed.max())
    quantities = [q for p in parameters for q in p.quantities]
    scales = [q.prior_sigma or 0.0 for q in quantities if q.name in SCALE.names]
    allowed = _DISAGREEMENT + 3.0 * max(scales, default=0.0)
    angles = [np.inf if q.prior_sigma is None else q.prior_sigma for q in quantities if q.name in THETA]
    upright = 3.0 * max(angles, default=0.0) < 0.5 * np.pi
    for axis, name in (("outer", "outer_x"), ("inner", "inner_z")):
        mine = [i for i, g in enumerate(groups) if g.run.axis == axis]
        if not mine:
            continue
        unit = w[mine] / speed[mine, None]
        along = float(np.median(((unit @ A.T) * unit).sum(axis=1)))
        gain = float(np.median(np.linalg.norm(unit @ A.T, axis=1)))
        if along < 0.0 and upright:
            raise InputError(
                f"indexer: gyro and encoder of the axis {name} disagree in sign; check the directions of both"
            )
        if abs(gain - 1.0) > allowed:
            raise InputError(
                f"indexer: about the axis {name} the gyro turns at {100.0 * gain:.4g} % of the encoder's rate, more "
                "than 1 % off; check units and gear, or state the gyro's scale error (sensors: {gyro: {scale: 0.05}})"
            )


def _fit(w: Array, gyro: Array, weight: Array) -> tuple[Array, Array]:
    """Fit gyro = A w + b by weighted least squares, with A (3, 3) near the identity and b (3,) near zero."""
    rows = np.column_stack([w, np.ones(len(w))])
    # What no rotation excites stays with the prior: a mounting of some degrees, a bias below 1e-3 rad/s.
    hold = 1e-6 * weight.sum() * np.array([*[np.mean((w**2).sum(axis=1))] * 3, 1.0])
    normal = (rows * weight[:, None]).T @ rows + np.diag(hold)
    right = (rows * weight[:, None]).T @ gyro
    right[:3] += np.diag(hold[:3])
    solution = np.linalg.solve(normal, right)
    return np.asarray(solution[:3].T), np.asarray(solution[3])


def guess(groups: tuple[Group, ...]) -> tuple[Array, Array]:
    """Initial mounting theta (3,), rad, and bias (3,), by aligning the platform's mean rates with the gyro's."""
    w = np.array([g.mean_platform for g in groups])
    gyro = np.array([g.mean_gyro for g in groups])
    weight = np.array([g.duration for g in groups])
    b = _fit(w, gyro, weight)[1]
    # A trace of the identity decides what one axis alone leaves open.
    trace = 1e-6 * np.linalg.norm(((gyro - b) * weight[:, None]).T @ w)
    tRm = so3.align(np.vstack([w, np.eye(3)]), np.vstack([gyro - b, np.eye(3)]), np.append(weight, np.full(3, trace)))
    return so3.angles(tRm), b


# Of the trajectory, Hz.
_ATTITUDE_RATE = 10.0


def frames(data: IndexerData, motion: AxisMotion) -> Index:
    """Indices of gyro samples for the trajectory; empty if the INS outputs no attitude."""
    if data.attitude is None:
        return np.empty(0, dtype=np.intp)
    stride = max(1, round(1.0 / (_ATTITUDE_RATE * float(np.median(np.diff(data.gyro_t))))))
    return np.flatnonzero((data.gyro_t >= motion.t[0]) & (data.gyro_t <= motion.t[-1]))[::stride]


def carrier(data: IndexerData, motion: AxisMotion, rows: Index, theta: Array, epsilon: float, encoder: Array) -> Array:
    """Attitude nRb = nRm mRt tRb at gyro samples; encoder errors (5,) as in alidade.factors.indexer."""
    assert data.attitude is not None
    at = data.gyro_t[rows] - encoder[4]
    outer, inner = (
        angle - sine * np.sin(angle) - cosine * np.cos(angle)
        for angle, (sine, cosine) in zip(
            (np.interp(at, motion.t, read) for read in motion.angles.T), encoder[:4].reshape(2, 2), strict=True
        )
    )
    mRb = so3.multiply(so3.inverse(so3.from_angles(theta)), so3.inverse(base_from_platform(outer, inner, epsilon)))
    return so3.multiply(data.attitude[rows], mRb)
