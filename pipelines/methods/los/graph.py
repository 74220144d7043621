"""The los method: mounting angles of the gyro and the camera of a gyro-stabilised line of sight.

The graph's states are tRm, the gyro's attitude in the frame of the target, at the pictures: gtsam's native AHRSFactor
joins them, LosDirectionFactor ties them to the picture and the gimbal. Where a target stands is part of its first
attitude, so a target found anew starts a new chain. Methods page, section 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import so3
from factors.chi_square import gate
from factors.los import SMOOTHING, GimbalPath, LocalMotion, LosDirectionFactor
from factors.loss import TruncatedLoss
from factors.preintegration import GyroPath
from pipelines.errors import InputError
from pipelines.graph.gyro_chain import GyroChain, state
from pipelines.graph.priors import vector_prior
from pipelines.graph.problem import Array, Factor, Parameter, Problem, Quantity, Step
from pipelines.graph.walking_bias import FIRST as FIRST_BIAS
from pipelines.methods.los.guess import camera, guess, initial_attitudes, seen
from pipelines.methods.los.recording import LosData
from pipelines.settings import DEFAULT_NOISE, Config, check_names, first_given

_ANGLES = ("delta_px", "delta_gx", "delta_gy")
_SPLIT = ("delta_pz", "delta_gz")
_OPTIONS = ("camera_roll", "collimation", "axis_nonperpendicularity")
_BIAS = ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")
_OFFSET = "time_offset"
# Everything but gyro bias and time offset: the angles by which gyro, gimbal axes and camera are mounted.
ANGLES = (*_ANGLES, "delta_z", *_SPLIT, *_OPTIONS)
NAMES = (*ANGLES, *_BIAS, _OFFSET)

_ANGLES_KEY, _OFFSET_KEY = int(gtsam.symbol("a", 0)), int(gtsam.symbol("T", 0))
_PRIOR_ANGLE, _PRIOR_BIAS, _PRIOR_OFFSET = 0.1, 0.02, 0.05

# After a gap longer than this, s, the camera may hold on to another target.
_LOST = 0.5
# A gap in gyro or gimbal longer than so many sample intervals is no sampling jitter.
_GAP = 5.0
_FEWEST_PICTURES = 10
# Sigmas, rad, of a chain's first attitude about t's axes: wide where pictures tell. Its turn about the line of sight is
# free when no picture tells the camera's roll (it only turns t), and held for the sake of the arithmetic.
_WIDE, _HELD = 0.3, 1e-3
# Pictures that a target's first one has to agree with.
_FOLLOWERS = 5


@dataclass(frozen=True)
class _Model:
    """The recording prepared for the graph: what every step needs."""

    chain: GyroChain  # tRm at the keyframes, which are the pictures used; a new chain for every target found
    mount: Array  # first guess of the mounting angles
    measured: Array  # (K, 3) phx, phz, roll
    sqrt_information: Array  # (K, 3, 3), zero rows for a roll not measured
    angles: Array  # (K, 2) azimuth, elevation
    motion: LocalMotion | None  # around the keyframes, when the time offset is a variable
    loss: TruncatedLoss
    parameters: tuple[Parameter, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The mounting angles that are variables."""
        return tuple(q.name for q in self.parameters[0].quantities)


def problem(data: LosData, config: Config) -> Problem:
    """The graph of a los recording.

    Raises:
        InputError: an unknown parameter in the config, only one of delta_pz and delta_gz, or fewer than ten pictures
            within the records of gyro and gimbal.
    """
    model, dropped = _prepare(data, config)
    return Problem(
        method="los",
        parameters=model.parameters,
        steps=partial(_steps, model),
        steps_after=partial(_steps, model, 1),
        loss=model.loss,
        advice=_advice,
        dropped=dropped,
    )


def _prepare(data: LosData, config: Config) -> tuple[_Model, dict[str, int]]:
    parameters = _parameters(config)
    noise = config.noise
    density = first_given(noise.gyro_density, data.gyro_density, DEFAULT_NOISE.gyro_density)
    gimbal, gyro = GimbalPath(data.gimbal_t, data.gimbal), GyroPath(data.gyro_t, data.gyro)
    covariance = _covariance(data, gimbal, config)
    has_offset = len(parameters) == 3
    rows, starts, dropped = select_pictures(data, np.sqrt(covariance[:, 0, 0]), SMOOTHING if has_offset else 0.0)
    time, measured = data.image_t[rows], data.error[rows]
    angles = gimbal.at(time)
    chains = np.split(np.arange(len(time)), np.flatnonzero(starts)[1:])
    sigma = float(np.sqrt(np.median(covariance[rows, 0, 0])))
    mount, bias_hat = guess(chains, time, angles, measured, gyro, parameters, sigma)
    names = tuple(q.name for q in parameters[0].quantities)
    gyro = GyroPath(data.gyro_t, data.gyro, bias_hat)
    motion = LocalMotion.around(time, data.gyro_t, data.gyro, gimbal) if has_offset else None
    chain = GyroChain.over(
        time,
        starts,
        initial_attitudes(chains, time, camera(angles, mount, names), measured, gyro),
        gyro,
        density=density,
        walk=first_given(noise.gyro_bias_walk, DEFAULT_NOISE.gyro_bias_walk),
        scale_error=first_given(noise.gyro_scale, DEFAULT_NOISE.gyro_scale),
    )
    model = _Model(
        chain=chain,
        mount=mount,
        measured=measured,
        sqrt_information=_sqrt_information(covariance[rows]),
        angles=angles,
        motion=motion,
        loss=TruncatedLoss(gate(3 if np.isfinite(measured[:, 2]).any() else 2)),
        parameters=parameters,
    )
    return model, {**data.dropped, **dropped}


def _covariance(data: LosData, gimbal: GimbalPath, config: Config) -> Array:
    """(K, 3, 3) of phx, phz, roll: the tracker's or the config's, and the encoders'; NaN where not measured."""
    if data.error_cov is None:
        los = first_given(config.noise.los_error, DEFAULT_NOISE.los_error)
        roll = first_given(config.noise.los_roll, DEFAULT_NOISE.los_roll)
        covariance = np.tile(np.diag([los**2, los**2, roll**2]), (len(data.image_t), 1, 1))
    else:
        covariance = data.error_cov.copy()
    covariance[~np.isfinite(data.error[:, 2]), 2, :] = np.nan
    _, weights = gimbal.weights(data.image_t)
    elevation = gimbal.at(data.image_t)[:, 1]
    # Azimuth turns the picture about an axis that is elevated against its own up.
    by_azimuth = np.stack([np.zeros_like(elevation), np.cos(elevation), np.sin(elevation)], axis=1)
    encoder = first_given(config.noise.encoder, DEFAULT_NOISE.encoder) ** 2 * (weights**2).sum(axis=1)
    shape = np.diag([1.0, 0.0, 0.0]) + by_azimuth[:, :, None] * by_azimuth[:, None, :]
    return covariance + encoder[:, None, None] * shape


def _sqrt_information(covariance: Array) -> Array:
    """(K, 3, 3) upper triangular R with R'R the information; the last row and column are zero without roll."""
    out = np.zeros_like(covariance)
    rolls = np.isfinite(covariance[:, 2, 2])
    for size, mine in ((3, rolls), (2, ~rolls)):
        root = np.linalg.cholesky(np.linalg.inv(covariance[mine][:, :size, :size]))
        block = np.zeros((int(mine.sum()), 3, 3))
        block[:, :size, :size] = np.swapaxes(root, 1, 2)
        out[mine] = block
    return out


def select_pictures(
    data: LosData, sigma: Array, margin: float
) -> tuple[NDArray[np.intp], NDArray[np.bool_], dict[str, int]]:
    """The pictures used, which of them are the first of their target, and what was left out.

    `margin`, s, is left out on either side of a gap in which the gimbal may have turned to another target.
    """
    t = data.image_t
    outside = (t < max(data.gyro_t[0], data.gimbal_t[0])) | (t > min(data.gyro_t[-1], data.gimbal_t[-1]))
    blind = ~outside & (_in_gap(data.gimbal_t, t) | _in_gap(data.gyro_t, t))
    rows = np.flatnonzero(~outside & ~blind)
    chains = np.split(rows, np.flatnonzero(_first_of_target(data, rows))[1:])
    close, early, lone = (np.zeros(len(t), dtype=bool) for _ in range(3))
    starts = np.zeros(len(t), dtype=bool)
    for i, chain in enumerate(chains):
        after = t[chain] - t[chain[0]] if i > 0 else np.inf
        before = t[chain[-1]] - t[chain] if i < len(chains) - 1 else np.inf
        close[chain] = np.minimum(after, before) < margin
        left = chain[~close[chain]]
        wrong = _wrong_before_followers(data.error[left, :2], sigma[left])
        early[left[:wrong]] = True
        if len(left) - wrong < 2:
            lone[left[wrong:]] = True
        else:
            starts[left[wrong]] = True
    keep = rows[~(close | early | lone)[rows]]
    if len(keep) < _FEWEST_PICTURES:
        raise InputError(
            f"only {len(keep)} of {len(t)} LOS errors can be used, at least {_FEWEST_PICTURES} are needed: "
            f"{int(outside.sum())} lie outside the records of gyro and gimbal, {int(blind.sum())} in their gaps, "
            f"{int(lone.sum())} stand alone; check the topics and their clocks"
        )
    reasons = {
        "LOS error outside the records of gyro and gimbal": outside,
        "LOS error in a gap of gyro or gimbal": blind,
        "LOS error beside a gap, where the time offset cannot be followed": close,
        "LOS error disagrees with those after it where a target is found": early,
        "LOS error alone between gaps": lone,
    }
    return keep, starts[keep], {reason: int(mask.sum()) for reason, mask in reasons.items() if mask.any()}


def _in_gap(t: Array, at: Array) -> NDArray[np.bool_]:
    """Whether times lie between two samples that are too far apart."""
    step = np.diff(t)
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(step) - 1)
    return np.asarray(step[i] > _GAP * np.median(step))


def _first_of_target(data: LosData, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Where a chain starts: after a gap in which the target may have changed, and after a gap of the gyro."""
    starts = np.ones(len(rows), dtype=bool)
    if len(rows) < 2:
        return starts
    step = np.diff(data.image_t[rows])
    gyro_step = np.diff(data.gyro_t)
    gaps = data.gyro_t[:-1][gyro_step > _GAP * np.median(gyro_step)]
    gaps_before = np.searchsorted(gaps, data.image_t[rows])
    starts[1:] = (step > max(_LOST, _GAP * float(np.median(step)))) | (np.diff(gaps_before) > 0)
    return starts


def _wrong_before_followers(error: Array, sigma: Array) -> int:
    """How many LOS errors at the start of a chain disagree with the median of those that follow."""
    for i in range(len(error) - _FOLLOWERS):
        after = error[i + 1 : i + 1 + _FOLLOWERS]
        drift = np.median(np.abs(np.diff(after, axis=0)), axis=0)
        if np.all(np.abs(error[i] - np.median(after, axis=0)) < 6.0 * sigma[i] + _FOLLOWERS * drift):
            return i
    return 0


def _parameters(config: Config) -> tuple[Parameter, ...]:
    """The method's parameters with their priors; options only where the config gives them a prior other than 0."""
    check_names(config.priors, NAMES, "priors")
    check_names(config.require, NAMES, "require")
    given = [name for name in _SPLIT if name in config.priors]
    if len(given) == 1:
        raise InputError(f"priors: {given[0]} alone; delta_pz and delta_gz are given both, or neither for delta_z")

    def quantity(name: str, unit: str, scale: float) -> Quantity:
        return Quantity(name, unit, config.priors.get(name, scale), scale, config.require.get(name, 1e-3))

    names = (*_ANGLES, *(_SPLIT if given else ("delta_z",)), *(n for n in _OPTIONS if config.priors.get(n, 0.0) != 0.0))
    parameters = [
        Parameter(_ANGLES_KEY, tuple(quantity(name, "rad", _PRIOR_ANGLE) for name in names)),
        Parameter(FIRST_BIAS, tuple(quantity(name, "rad/s", _PRIOR_BIAS) for name in _BIAS)),
    ]
    if config.priors.get(_OFFSET, 0.0) != 0.0:
        parameters.append(Parameter(_OFFSET_KEY, (quantity(_OFFSET, "s", _PRIOR_OFFSET),)))
    return tuple(parameters)


def _steps(model: _Model, chunk: int, after: float = -np.inf) -> Iterator[Step]:
    """`chunk` keyframes at a time; the first step brings the calibration variables and their priors too."""
    time = model.chain.time
    for begin in range(int(np.searchsorted(time, after, side="right")), len(time), chunk):
        yield _step(model, range(begin, min(begin + chunk, len(time))))


def _step(model: _Model, keyframes: range) -> Step:
    chain = model.chain
    step = Step(
        time=float(chain.time[keyframes[-1]]),
        predict=partial(chain.predict, keyframes, partial(_found, model)),
        keyframes=keyframes,
    )
    if keyframes.start == 0:
        step.initial.insert(_ANGLES_KEY, model.mount)
        if model.motion is not None:
            step.initial.insert(_OFFSET_KEY, np.zeros(1))
        step.factors.extend(vector_prior(p, np.zeros(len(p.quantities))) for p in model.parameters)
    step.factors.extend(_start_factor(model, k) for k in keyframes if chain.starts[k])
    chain.add(step)
    step.factors.extend(_picture_factors(model, keyframes))
    return step


def _found(model: _Model, k: int, current: gtsam.Values) -> Array:
    """tRm (4,) where a target is found, with the mounting angles as estimated by now."""
    cRm = camera(model.angles[k : k + 1], current.atVector(_ANGLES_KEY), model.names)
    return seen(cRm, model.measured[k : k + 1])[0]


def _start_factor(model: _Model, k: int) -> Factor:
    """Wide prior on the first attitude of a target."""
    rolls = np.isfinite(model.measured[:, 2]).any()
    sigmas = np.array([_WIDE, _WIDE if rolls else _HELD, _WIDE])
    initial = model.chain.initial[k]
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(so3.matrix(initial) / sigmas[:, None], False)
    return Factor("prior", gtsam.PriorFactorRot3(state(k), so3.to_gtsam(initial), noise))


def _picture_factors(model: _Model, keyframes: range) -> list[Factor]:
    """One factor for the pictures with roll, one for those without."""
    k = np.array(keyframes)
    rolls = np.isfinite(model.measured[k, 2])
    return [
        _picture_factor(model, k[mine], rows, family)
        for rows, family, mine in ((2, "los", ~rolls), (3, "los with roll", rolls))
        if mine.any()
    ]


def _picture_factor(model: _Model, k: NDArray[np.intp], rows: int, family: str) -> Factor:
    rows_model = LosDirectionFactor(
        model.chain.time[k],
        model.measured[k, :rows],
        model.sqrt_information[k, :rows, :rows],
        model.angles[k],
        model.names,
        None if model.motion is None else model.motion[k],
    )
    columns: list[int | list[int]] = [[state(i) for i in k], _ANGLES_KEY]
    if model.motion is not None:
        columns += [model.chain.bias_keys(k), _OFFSET_KEY]
    return Factor.of(family, rows_model.on(*columns, loss=model.loss))


def _advice(weights: Mapping[str, float]) -> str:
    """What would make a weak direction observable."""
    strong = {name for name, weight in weights.items() if abs(weight) > 0.3}
    if set(_SPLIT) <= strong:
        return (
            "delta_pz and delta_gz can never be told apart, turning the carrier's frame about the azimuth axis changes "
            "both alike: ask for delta_z = delta_pz - delta_gz instead"
        )
    if _OFFSET in strong:
        return "the time offset needs faster sway: turn the carrier back and forth within a second or two"
    if "camera_roll" in strong:
        return "the camera's roll needs the target to move across the picture: offset the gimbal while recording"
    if {"collimation", "axis_nonperpendicularity"} & strong:
        return "errors of the gimbal's axes need changing elevation: record targets at low and at high elevation"
    if "delta_px" in strong:
        return (
            "delta_px trades against delta_gx and delta_gy: sway the carrier in azimuth too, or record targets at "
            "other azimuths and elevations"
        )
    if set(_BIAS) & strong and not strong - set(_BIAS):
        return "the gyro bias needs a longer recording with the target in sight, and sway across the line of sight"
    return "the mounting angles need sway of the carrier about all three axes while the target is in sight"
