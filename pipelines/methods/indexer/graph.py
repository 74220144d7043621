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
from numpy.typing import NDArray

from factors import so3
from factors.earth import EARTH_RATE, earth_rate
from factors.indexer import (
    AxisPath,
    IndexerAverageFactor,
    Option,
    PlatformRates,
    base_from_platform,
    gyro_edges,
    gyro_means,
    mounting,
    mounting_angles,
)
from pipelines.errors import InputError
from pipelines.graph.priors import prior_sigmas, vector_prior
from pipelines.graph.problem import Array, Attitudes, Factor, Parameter, Problem, Quantity, Step
from pipelines.graph.walking_bias import FIRST as FIRST_BIAS
from pipelines.graph.walking_bias import WalkingBias
from pipelines.judgement.validation import Validation
from pipelines.methods.indexer.recording import IndexerData
from pipelines.methods.indexer.runs import AxisMotion, Run, axis_motion
from pipelines.methods.indexer.topics import FIX, IndexerConfig
from pipelines.settings import DEFAULT_NOISE, Config, check_names, first_given

THETA = ("theta_x", "theta_y", "theta_z")
BIAS = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")
SCALE = ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")
EPSILON = ("axis_nonperpendicularity",)
NAMES = (*THETA, *BIAS, *SCALE, *EPSILON)

_KEYS: dict[str, int] = {
    name: int(gtsam.symbol(c, 0)) for name, c in zip(("theta", "scale", "epsilon"), "TSE", strict=True)
}

# The variable theta counts these, rad: a smoother linearises anew when a variable has moved by some hundredth, and
# angles that earlier turns left open by as much as their prior have to be followed to the arc second.
_THETA_UNIT = 1e-3
# Windows end where the driven axes have turned by this much, rad: short enough to see the earth's rate come and go.
_WINDOW_ANGLE = np.pi / 4
# Less than this over, rad, does not make a window of its own.
_CRUMB = 2e-3
# Encoder samples that a dwell leaves to the motion after it.
_DWELL_MARGIN = 5.0
# Groups and windows of fewer gyro samples than this are the crumbs of rounding.
_FEWEST_SAMPLES = 4
# A gyro that departs from the encoders by more than this share of the rate is not the gyro of this axis.
_DISAGREEMENT = 0.01
# So many groups stay in a smoother whatever its window, s: a schedule of four positions, to be linearised anew when its
# later positions move the angles that its earlier ones left open.
_KEPT = 64
# Encoder errors are in part slow (harmonics) if the config's noise is this much larger than the scatter at rest.
_SLOW = 2.0
# Encoder errors below this, rad, are beneath notice.
_NO_ERROR = 1e-8
# The other axis stands at the same angle when it differs by less than half of this, deg.
_SAME_ANGLE_DEG = 5.0
# Of the trajectory, Hz.
_ATTITUDE_RATE = 10.0


@dataclass(frozen=True)
class Group:
    """Adjoining windows of one run and what was measured in them.

    Attributes:
        kind: "turn" for a whole turn, "move" for less, "dwell".
        run: the run it is part of.
        gyro: (n, 3) mean rates in m, rad/s.
        rates: the platform's mean rates.
    """

    kind: str
    run: Run
    gyro: Array
    rates: PlatformRates

    @property
    def duration(self) -> float:
        """Length, s."""
        return float(self.rates.edges[-1] - self.rates.edges[0])

    @property
    def mean_gyro(self) -> Array:
        """(3,) mean rate over the whole group, rad/s."""
        return np.asarray(np.diff(self.rates.edges) @ self.gyro / self.duration)

    @property
    def mean_platform(self) -> Array:
        """(3,) mean rate of the platform over the whole group with perpendicular axes, in t, rad/s."""
        return np.asarray(np.diff(self.rates.edges) @ (self.rates.fixed + self.rates.cosine) / self.duration)

    @property
    def position(self) -> tuple[str, int] | None:
        """The axis that turns and at which angle the other stands, in steps; None when not one axis turns alone."""
        if self.run.axis not in ("outer", "inner"):
            return None
        steps = round(360.0 / _SAME_ANGLE_DEG)
        return self.run.axis, round(np.rad2deg(self.run.other) / _SAME_ANGLE_DEG) % steps


@dataclass(frozen=True)
class _Model:
    """The recording prepared for the graph: what every step needs."""

    data: IndexerData
    motion: AxisMotion
    groups: tuple[Group, ...]
    bias: WalkingBias
    density: float
    encoder: float  # white noise of a sample, rad
    slow: float  # sigma of the errors that come again with every turn, rad; 0: none
    parameters: tuple[Parameter, ...]
    theta_guess: Array
    bias_guess: Array
    frames: NDArray[np.intp]  # (F,) indexes of the gyro samples whose attitude the trajectory holds
    frame_edges: NDArray[np.intp]  # (groups + 1,) which of them come with a group

    @property
    def options(self) -> tuple[Option, ...]:
        """The factor's options that are parameters."""
        given = {p.key for p in self.parameters}
        names: tuple[Option, ...] = ("scale", "epsilon")
        return tuple(name for name in names if _KEYS[name] in given)


def problem(data: IndexerData, config: Config) -> Problem:
    """The graph of an indexer recording.

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
        attitude_name="nRb",
        advice=_advice,
        dropped=dropped,
    )


def validate(data: IndexerData, config: Config, values: Mapping[str, float]) -> list[Validation]:
    """Errors without and with a calibration: of the attitude put out, where there is one, and of the turns' mean rates.

    The carrier's attitude is nRb = nRm mRt tRb(outer, inner), without calibration mRt = identity and perpendicular
    axes; the carrier is the indexer's base and stands still at the config's `indexer.base_attitude`.

    Args:
        data: the session, with the attitude nRm that the INS puts out, or without.
        config: of the session.
        values: calibrated parameters by name; those not named are zero.

    Raises:
        InputError: the axes hardly turn.
    """
    motion = axis_motion(data)
    turning = [g for g in groups_of(data, config, motion) if g.position is not None]
    time, before = misfit(turning, {})
    after = misfit(turning, values)[1]
    found = [Validation("axis by mean rates, turn by turn", "rad", time, before, after)]
    if data.attitude is not None:
        rows = np.flatnonzero((data.gyro_t >= motion.t[0]) & (data.gyro_t <= motion.t[-1]))
        bRn = so3.inverse(np.array(config.section(IndexerConfig).base_attitude))
        errors = [
            so3.log(so3.multiply(bRn, _carrier(data, motion, rows, _several(some, THETA), *_several(some, EPSILON))))
            for some in ({}, values)
        ]
        claim = "the publication claims 0.005 deg over an hour"
        found.insert(0, Validation("attitude put out", "rad", data.gyro_t[rows], errors[0], errors[1], claim))
    return found


def misfit(groups: Sequence[Group], values: Mapping[str, float]) -> tuple[Array, Array]:
    """Ends (n,) of the groups, s, and their mean rates less what encoders and earth say, over the rate, (n, 3) in t.

    Args:
        groups: in which an axis turns.
        values: parameters by name; those not named are zero.
    """
    tRm, bias, gain = mounting(_several(values, THETA)), _several(values, BIAS), 1.0 + _several(values, SCALE)
    epsilon = _several(values, EPSILON)
    errors = []
    for group in groups:
        share = np.diff(group.rates.edges) / group.duration
        rates = group.rates.fixed + np.cos(epsilon) * group.rates.cosine + np.sin(epsilon) * group.rates.sine
        expected = share @ rates
        found = so3.rotate(tRm, (group.mean_gyro - bias) / gain)
        errors.append((found - expected) / np.linalg.norm(expected))
    return np.array([float(g.rates.edges[-1]) for g in groups]), np.array(errors).reshape(-1, 3)


def _several(values: Mapping[str, float], names: Sequence[str]) -> Array:
    return np.array([values.get(name, 0.0) for name in names])


def groups_of(data: IndexerData, config: Config, motion: AxisMotion, split: bool = True) -> tuple[Group, ...]:
    """The groups of a recording in time order; none shares an encoder sample with another."""
    nRbase = np.array(config.section(IndexerConfig).base_attitude)
    latitude = data.latitude_deg
    earth = np.zeros(3) if latitude is None else earth_rate(np.deg2rad(latitude))
    path = AxisPath(motion.t, motion.angles[:, 0], motion.angles[:, 1], so3.rotate(so3.inverse(nRbase), earth))
    edges = gyro_edges(data.gyro_t)
    middles = 0.5 * (edges[1:] + edges[:-1])
    groups: list[Group] = []
    free_from = before = -np.inf
    for run in motion.runs:
        if run.start > before:  # behind a gap, all samples are new
            free_from = -np.inf
        before = run.stop
        for kind, borders in _borders(motion, run):
            # The sample edges nearest to the borders, within what the run and the group before leave.
            first = np.searchsorted(edges, max(run.start, free_from))
            last = np.searchsorted(edges, run.stop, side="right") - 1
            if last - first < _FEWEST_SAMPLES:
                continue
            nearest = np.searchsorted(middles, borders if split else borders[[0, -1]])
            cuts = np.unique(np.clip(nearest, first, last))
            cuts = cuts[np.concatenate([[True], np.diff(cuts) >= _FEWEST_SAMPLES])]
            if len(cuts) < 2:
                continue
            groups.append(Group(kind, run, gyro_means(edges, data.gyro, cuts), path.rates(edges[cuts])))
            # The angle at the last edge is made of the two encoder samples on either side of it, and so is that at
            # the first edge of the next group.
            after = np.searchsorted(motion.t, edges[cuts[-1]], side="right") + 3
            free_from = motion.t[min(after, len(motion.t) - 1)]
    return tuple(groups)


def _borders(motion: AxisMotion, run: Run) -> Iterator[tuple[str, Array]]:
    """For each group of a run its kind and the times at which its windows begin and end."""
    if run.axis == "none":
        # Ends early enough for the motion that follows to start where it does.
        yield "dwell", np.array([run.start, run.stop - _DWELL_MARGIN * float(np.median(np.diff(motion.t)))])
        return
    first, last = np.searchsorted(motion.t, [run.start, run.stop])
    rows = slice(first, last + 1)
    t, angles = motion.t[rows], motion.angles[rows]
    driven = {"outer": [0], "inner": [1]}.get(run.axis, [0, 1])
    path = np.maximum.accumulate(np.abs(angles[:, driven] - angles[0, driven]).sum(axis=1))
    # The ends are the run's, at rest; a crossing searched for in a resting encoder would pick its noise.
    levels = np.arange(_WINDOW_ANGLE, path[-1] - _CRUMB, _WINDOW_ANGLE)
    borders = np.concatenate([[run.start], np.interp(levels, path, t), [run.stop]])
    per_turn = round(2.0 * np.pi / _WINDOW_ANGLE)
    for first in range(0, len(borders) - 1, per_turn):
        turned = path[-1] - first * _WINDOW_ANGLE
        yield "turn" if turned > 2.0 * np.pi - _CRUMB else "move", borders[first : first + per_turn + 1]


def _prepare(data: IndexerData, config: Config) -> tuple[_Model, dict[str, int]]:
    parameters = _parameters(config)
    motion = axis_motion(data)
    density = first_given(config.noise.gyro_density, data.gyro_density, DEFAULT_NOISE.gyro_density)
    encoder = first_given(config.noise.encoder, DEFAULT_NOISE.encoder)
    scatter = _scatter(motion)
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
    groups, disagreeing = _agreeing(groups, config, density, encoder)
    theta_guess, bias_guess = _guess(groups)
    starts = np.array([g.rates.edges[0] for g in groups])
    walk = first_given(config.noise.gyro_bias_walk, DEFAULT_NOISE.gyro_bias_walk)
    frames = _frames(data, motion)
    reasons = {
        "turn cut by a gap in the stamps (what lies before and after is used)": _cut_turns(motion),
        "turn in which gyro and encoder disagree by more than 1 %": disagreeing,
    }
    dropped = {**data.dropped, **{reason: number for reason, number in reasons.items() if number}}
    model = _Model(
        data=data,
        motion=motion,
        groups=groups,
        bias=WalkingBias(np.append(starts, groups[-1].rates.edges[-1]), walk, density, groups[-1].rates.edges[-1]),
        density=density,
        encoder=scatter if slow > 0.0 else encoder,
        slow=slow,
        parameters=parameters,
        theta_guess=theta_guess,
        bias_guess=bias_guess,
        frames=frames,
        frame_edges=np.append(0, np.searchsorted(data.gyro_t[frames], np.append(starts[1:], np.inf))),
    )
    return model, dropped


def _parameters(config: Config) -> tuple[Parameter, ...]:
    """The method's parameters with their priors; options only where the config gives them a prior other than 0."""
    check_names(config.priors, NAMES, "priors")
    check_names(config.require, NAMES, "require")

    def several(names: Sequence[str], unit: str, scale: float, require: float, default: float) -> tuple[Quantity, ...]:
        return tuple(
            Quantity(name, unit, config.priors.get(name, default), scale, config.require.get(name, require))
            for name in names
        )

    parameters = [
        Parameter(_KEYS["theta"], several(THETA, "rad", 0.1, 5e-5, 0.1), _theta_coordinates),
        Parameter(FIRST_BIAS, several(BIAS, "rad/s", 1e-3, 1e-5, 1e-3)),
    ]
    if any(config.priors.get(name, 0.0) != 0.0 for name in SCALE):
        parameters.append(Parameter(_KEYS["scale"], several(SCALE, "1", 0.01, 1e-3, 0.0)))
    if config.priors.get(EPSILON[0], 0.0) != 0.0:
        parameters.append(Parameter(_KEYS["epsilon"], several(EPSILON, "rad", 1e-2, 5e-5, 0.0)))
    return tuple(parameters)


def _theta_coordinates(values: gtsam.Values, key: int) -> tuple[Array, Array]:
    """The angles in rad."""
    return _THETA_UNIT * np.asarray(values.atVector(key)), _THETA_UNIT * np.eye(3)


def _agreeing(
    groups: tuple[Group, ...], config: Config, density: float, encoder: float
) -> tuple[tuple[Group, ...], int]:
    """The groups whose gyro follows the encoders, and how many do not.

    Fits gyro = A w + b over all groups, so that neither mounting nor bias counts as disagreement.

    Raises:
        InputError: the gyro turns against the encoder of an axis, or at a rate that differs by more than 1 % and by
            more than the priors of the gyro's scale allow.
    """
    w = np.array([g.mean_platform for g in groups])
    gyro = np.array([g.mean_gyro for g in groups])
    moving = np.array([g.position is not None for g in groups])
    speed = np.linalg.norm(w, axis=1)
    weight = np.array([g.duration for g in groups])
    for _ in range(10):
        A, b = _fit(w, gyro, weight)
        misfit = np.linalg.norm(gyro - w @ A.T - b, axis=1)
        # Least absolute misfit: one damaged turn does not bend the fit.
        weight = np.array([g.duration for g in groups]) / np.maximum(misfit, 1e-4 * speed.max())
    allowed = _DISAGREEMENT + 3.0 * max(
        [np.inf if config.priors.get(name, 0.0) is None else config.priors.get(name, 0.0) or 0.0 for name in SCALE]
    )
    for axis, name in (("outer", "outer_x"), ("inner", "inner_z")):
        mine = [i for i, g in enumerate(groups) if g.run.axis == axis]
        if not mine:
            continue
        unit = w[mine] / speed[mine, None]
        along = float(np.median(((unit @ A.T) * unit).sum(axis=1)))
        gain = float(np.median(np.linalg.norm(unit @ A.T, axis=1)))
        if along < 0.0:
            raise InputError(
                f"indexer: gyro and encoder of the axis {name} disagree in sign; check the directions of both"
            )
        if abs(gain - 1.0) > allowed:
            raise InputError(
                f"indexer: about the axis {name} the gyro turns at {100.0 * gain:.4g} % of the encoder's rate, more "
                "than 1 % off; check units and gear, or free the gyro's scale (priors: gyro_scale_x ...)"
            )
    duration = np.array([g.duration for g in groups])
    noise = np.sqrt(density**2 / duration + 2.0 * (encoder / duration) ** 2)
    good = ~moving | (misfit <= _DISAGREEMENT * np.maximum(speed, 0.1 * speed.max()) + 5.0 * noise)
    return tuple(g for g, ok in zip(groups, good, strict=True) if ok), int((~good).sum())


def _fit(w: Array, gyro: Array, weight: Array) -> tuple[Array, Array]:
    """A (3, 3) near the identity and b (3,) near zero with gyro = A w + b in weighted least squares."""
    rows = np.column_stack([w, np.ones(len(w))])
    # What no rotation excites stays with the prior: a mounting of some degrees, a bias below 1e-3 rad/s.
    hold = 1e-6 * weight.sum() * np.array([*[np.mean((w**2).sum(axis=1))] * 3, 1.0])
    normal = (rows * weight[:, None]).T @ rows + np.diag(hold)
    right = (rows * weight[:, None]).T @ gyro
    right[:3] += np.diag(hold[:3])
    solution = np.linalg.solve(normal, right)
    return np.asarray(solution[:3].T), np.asarray(solution[3])


def _guess(groups: tuple[Group, ...]) -> tuple[Array, Array]:
    """First guess of theta (3,) and the bias (3,): the rotation that best takes the platform's rates to the gyro's."""
    w = np.array([g.mean_platform for g in groups])
    gyro = np.array([g.mean_gyro for g in groups])
    weight = np.array([g.duration for g in groups])
    b = _fit(w, gyro, weight)[1]
    # A trace of the identity decides what one axis alone leaves open.
    trace = 1e-6 * np.linalg.norm(((gyro - b) * weight[:, None]).T @ w)
    tRm = so3.align(np.vstack([w, np.eye(3)]), np.vstack([gyro - b, np.eye(3)]), np.append(weight, np.full(3, trace)))
    return mounting_angles(tRm), b


def _scatter(motion: AxisMotion) -> float:
    """Noise from encoder sample to encoder sample while the axes rest, rad; 0 if they never do."""
    spread = []
    for run in motion.runs:
        if run.axis == "none":
            rows = slice(*np.searchsorted(motion.t, [run.start, run.stop]))
            second = np.diff(motion.angles[rows], n=2, axis=0)[3:-3]
            if len(second):
                spread.append(np.sqrt((second**2).mean() / 6.0))
    return float(np.median(spread)) if spread else 0.0


def _cut_turns(motion: AxisMotion) -> int:
    """Number of gaps during which an axis turned."""
    return sum(
        any(run.axis != "none" and (run.stop in (start,) or run.start in (stop,)) for run in motion.runs)
        for start, stop in motion.gaps
    )


def _steps(model: _Model, chunk: int) -> Iterator[Step]:
    """A step for every group; in batch (chunk > 1) its factor is handed over compressed."""
    seen: set[tuple[str, int]] = set()
    for i, group in enumerate(model.groups):
        step = Step(
            time=float(group.rates.edges[-1]),
            keyframes=range(int(model.frame_edges[i]), int(model.frame_edges[i + 1])),
        )
        if i == 0:
            _begin(model, step)
        _add_bias(model, i, step)
        _add_measurement(model, i, seen, step, compress=chunk > 1)
        yield step


def _begin(model: _Model, step: Step) -> None:
    """The calibration variables and their priors."""
    for parameter in model.parameters:
        size = len(parameter.quantities)
        if parameter.key == _KEYS["theta"]:
            step.initial.insert(parameter.key, model.theta_guess / _THETA_UNIT)
            noise = gtsam.noiseModel.Diagonal.Precisions((prior_sigmas(parameter) / _THETA_UNIT) ** -2)
            step.factors.append(Factor("prior", gtsam.PriorFactorVector(parameter.key, np.zeros(size), noise)))
            continue
        if parameter.key != FIRST_BIAS:
            step.initial.insert(parameter.key, np.zeros(size))
        step.factors.append(vector_prior(parameter, np.zeros(size)))


def _add_bias(model: _Model, i: int, step: Step) -> None:
    """The bias of a group and the mean so far, which is what is reported from then on."""
    bias = model.bias
    bias.begin(step, i, model.bias_guess)
    bias.end(step, i, model.bias_guess)
    alive = range(max(0, i + 1 - _KEPT), i + 1)
    bias.keep(step, alive, alive)
    if i > 0:
        step.current_keys[bias.key(0)] = bias.mean_key(i)


def _add_measurement(model: _Model, i: int, seen: set[tuple[str, int]], step: Step, compress: bool) -> None:
    """The factor of a group, and the tilt of its position when that is new."""
    group = model.groups[i]
    options = model.options
    columns = [_KEYS["theta"], model.bias.key(i), *(_KEYS[name] for name in options)]
    if model.slow > 0.0 and group.position is not None:
        axis, position = group.position
        key = int(gtsam.symbol("o" if axis == "outer" else "i", position))
        if group.position not in seen:
            seen.add(group.position)
            step.initial.insert(key, np.zeros(3))
            noise = gtsam.noiseModel.Isotropic.Sigma(3, model.slow)
            step.factors.append(Factor("prior", gtsam.PriorFactorVector(key, np.zeros(3), noise)))
        options, columns = (*options, "tilt"), [*columns, key]
    wander = model.slow if group.kind == "move" else 0.0
    # A resting encoder repeats its slow errors from edge to edge, a turning one need not (quantisation).
    turning = np.array([group.run.axis in ("outer", "both"), group.run.axis in ("inner", "both")])
    encoder = np.hypot(model.encoder, np.where(turning, model.slow, 0.0))
    average = IndexerAverageFactor.of(group.gyro, group.rates, model.density, encoder, options, wander, _THETA_UNIT)
    step.factors.append(Factor.of(group.kind, average.on(*columns, compress=compress)))


def _frames(data: IndexerData, motion: AxisMotion) -> NDArray[np.intp]:
    """Gyro samples for the trajectory; none when the INS puts out no attitude."""
    if data.attitude is None:
        return np.empty(0, dtype=np.intp)
    stride = max(1, round(1.0 / (_ATTITUDE_RATE * float(np.median(np.diff(data.gyro_t))))))
    return np.flatnonzero((data.gyro_t >= motion.t[0]) & (data.gyro_t <= motion.t[-1]))[::stride]


def _attitudes(model: _Model, keyframes: Sequence[int], values: gtsam.Values) -> Attitudes:
    """The carrier's attitude nRb."""
    rows = model.frames[list(keyframes)]
    epsilon = float(values.atVector(_KEYS["epsilon"])[0]) if "epsilon" in model.options else 0.0
    theta = _theta_coordinates(values, _KEYS["theta"])[0]
    return Attitudes(model.data.gyro_t[rows], _carrier(model.data, model.motion, rows, theta, epsilon))


def _carrier(data: IndexerData, motion: AxisMotion, rows: NDArray[np.intp], theta: Array, epsilon: float) -> Array:
    """nRb = nRm mRt tRb at gyro samples."""
    assert data.attitude is not None
    outer, inner = (np.interp(data.gyro_t[rows], motion.t, angle) for angle in motion.angles.T)
    mRb = so3.multiply(so3.inverse(mounting(theta)), so3.inverse(base_from_platform(outer, inner, epsilon)))
    return so3.multiply(data.attitude[rows], mRb)


def _advice(weights: Mapping[str, float]) -> str:
    """The motion that would make a weak direction observable."""
    strongest = {name for name, w in weights.items() if abs(w) > 0.3}
    if strongest & set(EPSILON):
        return "the axes' right angle needs turns about both axes, the outer one with the inner at 0 and at 180 degrees"
    if strongest & set(SCALE):
        return (
            "the gyro's scale needs turns about each of its axes: the outer axis with the inner at 0 and at 90 degrees"
        )
    if "theta_x" in strongest:
        return "theta_x needs turns about the inner axis, forward and back (positions 3 and 4), or the moves recorded"
    if "theta_z" in strongest:
        return "theta_z needs turns about the outer axis, forward and back (positions 1 and 2)"
    if "theta_y" in strongest:
        return "theta_y needs whole turns about either axis, forward and back"
    return "the gyro bias needs turns forward and back, or longer dwells"
