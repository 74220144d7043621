"""The los method: mounting angles of the gyro and the camera of a gyro-stabilised line of sight.

The graph's states are tRm, the gyro's attitude in the frame of the target, at the pictures: gtsam's native AHRSFactor
joins them, or with errors of the gyro GyroIncrementFactor; LosDirectionFactor ties them to the picture and the gimbal.
ThroughGimbalFactor wraps both where errors are variables. Where a target stands is part of its first attitude, so a
target found anew starts a new chain. Methods page, section 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, Mask
from alidade.factors.chi_square import gate
from alidade.factors.gimbal import WINDOWS, GimbalPath, LocalMotion
from alidade.factors.los import LosContext, LosDirectionFactor
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import Model
from alidade.factors.preintegration import GyroPath
from alidade.factors.through_gimbal import GimbalErrors, ThroughGimbalFactor
from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.estimation.camera_clock import Clock, Keyframes
from alidade.pipelines.estimation.error_map import ErrorMap
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.gyro_chain import LAYOUT, ROOT, GyroChain, Trunk, as_slice
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameters import DEAD_BAND, acting
from alidade.pipelines.estimation.parameters import stated as stated_figure
from alidade.pipelines.estimation.priors import prior_of, rotation_about
from alidade.pipelines.estimation.problem import Estimate, Factor, Problem, Step
from alidade.pipelines.estimation.walking_bias import FIRST as FIRST_BIAS
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.formula import clock_constants
from alidade.pipelines.methods.los.initial_values import (
    camera,
    guess,
    guess_picture_clock,
    initial_attitudes,
    seen,
    select_pictures,
)
from alidade.pipelines.methods.los.parameters import (
    AZIMUTH_ZEROS,
    BIAS,
    LOS_MAP,
    SENSITIVITY,
    TIME_OFFSET,
    LosParameters,
)
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.methods.noise import at_most_sampled, sampled, stated, typical, walking
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.recording.plausibility import DEAD_BAND as HAS_DEAD_BAND
from alidade.pipelines.recording.plausibility import dead_band, hidden
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

# Sigmas, rad, of a chain's first attitude about t's axes: wide where pictures determine it. Rotation about the line of
# sight is free when no picture measures the camera's roll (it only rotates t), and fixed for numerical reasons.
_WIDE, _HELD = 0.3, 1e-3
# Families of pictures whose roll is not measured, and is.
_FAMILIES = ("los", "los with roll")
# Gimbal angles at a picture are settled this long after it, s.
_SETTLED = 0.05
# Pictures within so long, s, share a step, but no more than so many: nobody waits for the estimate between them, and
# five at once take a smoother little more time than one.
_TOGETHER, _MOST_TOGETHER = 0.1 - 1e-3, 10
# So far from its stamp, s, motion around it still has the rates of gyro and gimbal at the time of exposure.
_NEAR = 0.02


@dataclass(frozen=True)
class _Model:
    """A recording prepared for the graph."""

    chain: GyroChain  # tRm at the keyframes, which are the pictures used; a new chain for every target found
    mount: Array  # first guess of the mounting angles
    delay: float  # and of the encoders' delay
    measured: Array  # (K, 3) phx, phz, roll
    sqrt_information: Array  # (K, 3, 3), zero rows for a roll not measured
    angles: Array  # (K, 2) azimuth, elevation
    encoder: Array  # (K,) sigma of their noise in the picture, rad
    around: LosContext | None  # of the keyframes, when errors of the sensors are variables
    loss: TruncatedLoss
    parameters: LosParameters
    reference: float | None  # degrees Celsius, the temperature at which the bias is the bias; None: nobody measures it
    noises: dict[str, Level]  # by name
    clock: Clock  # by which stamps of the recording were moved to the keyframes' times
    dead_band: bool  # of the gyro

    @property
    def gimbal_errors(self) -> GimbalErrors:
        """Error model of gimbal mounting and encoders, for problems with sensor errors as variables."""
        return GimbalErrors(self.parameters.names, tuple(self.mount.tolist()))


def problem(data: LosData, config: Config) -> Problem:
    """Build the graph of a los recording.

    Raises:
        InputError: an unknown parameter in the config, only one of delta_pz and delta_gz, or fewer than ten pictures
            within the records of gyro and gimbal.
    """
    return _problem(config, data, *_prepare(data, config))


def _problem(config: Config, data: LosData, model: _Model, dropped: Mapping[str, int]) -> Problem:
    return Problem(
        method="los",
        parameters=model.parameters.all,
        steps=partial(_steps, model),
        steps_after=partial(_steps, model, 1),
        loss=model.loss,
        advice=_advice,
        dropped=dropped,
        # Errors from pictures are against the first picture of a target, which the end of a recording does not show.
        continuation=partial(_continuation, config, model) if data.error_cov is None and not model.dead_band else None,
        premises=(HAS_DEAD_BAND,) if model.dead_band else (),
        revision_horizon=max(
            _SETTLED if model.around is None else WINDOWS[0], temperature.longest_gap(data.temperature)
        ),
        noises=tuple(model.noises.values()),
        constants=temperature.constants(model.reference) | clock_constants(model.parameters.sight, model.clock.begun),
        keyframes=None if model.parameters.sight is None else Keyframes(model.clock, _NEAR),
        layout=LAYOUT,
        error_map=partial(_error_map, config, model),
    )


def _error_map(config: Config, model: _Model, _: Estimate) -> ErrorMap | None:
    """Error map of the LOS errors over the gimbal angles."""
    sine, cosine, each = np.sin(model.angles), np.cos(model.angles), np.eye(2)
    alone, slopes = np.hstack([sine, cosine]), np.hstack([cosine[..., None] * each, -sine[..., None] * each])
    i, j = [0, 0, 2, 2], [1, 3, 1, 3]
    by_both = slopes[:, i] * alone[:, j, None] + alone[:, i, None] * slopes[:, j]
    return ErrorMap.of(
        LOS_MAP.name,
        "xz",
        stated_figure(config, LOS_MAP),
        _FAMILIES,
        model.chain.time,
        np.hstack([alone, alone[:, i] * alone[:, j]]),
        {"azimuth": model.angles[:, 0], "elevation": model.angles[:, 1]},
        slopes=None if model.around is None else np.hstack([slopes, by_both]),
    )


def _noises(data: LosData, config: Config) -> dict[str, Level]:
    """Noises in use, by name; the tracker's rows include the encoders' noise."""
    los, roll = typical(data.error_cov, 0, 1), typical(data.error_cov, 2)
    found = [Level(stated("los_error", config, los, _FAMILIES, (0, 1)))]
    if np.isfinite(data.error[:, 2]).any():
        found.append(Level(stated("los_roll", config, roll, _FAMILIES[1:], (2,))))
    found.append(sampled(stated("gyro_density", config, data.gyro_density, ("gyro",)), data.gyro_t, data.gyro))
    found += [walking(config), at_most_sampled(stated("encoder", config), data.gimbal_t, data.gimbal)]
    return {level.noise.name: level for level in found}


def _continuation(config: Config, model: _Model, data: LosData, time: float) -> Problem | None:
    """Build the graph of the end of a growing recording; see Problem.continuation."""
    trunk = ROOT if time == -np.inf else model.chain.trunk(time)
    if trunk is None or (trunk is not ROOT and time not in data.image_t):
        return None
    if (data.temperature is None) != (model.reference is None):
        return None
    grown, dropped = _prepare(data, config, model, trunk, time)
    begins = trunk is ROOT or grown.chain.time[0] == time
    return _problem(config, data, grown, dropped) if begins and not grown.dead_band else None


def _prepare(
    data: LosData,
    config: Config,
    before: _Model | None = None,
    trunk: Trunk | None = None,
    start: float = -np.inf,
    clock: Clock | None = None,
    guessed: tuple[Array, Array, float] | None = None,
) -> tuple[_Model, dict[str, int]]:
    """Prepare the model of a recording, or of the end of a growing recording from a keyframe on.

    `clock`, `guessed` with mounting angles, bias and delay, moved the data's stamps already. Those of a recording that
    grows stay where they are, and so do its keyframes.
    """
    reference = temperature.reference(data.temperature) if before is None else before.reference
    half_width, side = dead_band(data.gyro_t, data.gyro)
    temperature_rise = temperature.above(data.temperature, reference, data.gyro_t)
    drivers = {SENSITIVITY: data.force, GYRO_SLOPE: temperature_rise, DEAD_BAND: side if half_width else None}
    caused = [each for each, driver in drivers.items() if driver is not None]
    parameters = LosParameters.of(config, caused, data.stamp_sigma)
    driving = acting(parameters.gyro, drivers)
    noises = _noises(data, config) if before is None else before.noises
    gimbal, gyro = GimbalPath(data.gimbal_t, data.gimbal), GyroPath(data.gyro_t, data.gyro)
    used, dropped = _Used.of(
        data, config, noises["encoder"].used, gimbal, WINDOWS[0] if parameters.sight else 0.0, start
    )
    chains, time, measured = used.chains, used.time, used.measured
    if before is not None:
        guessed = before.mount, before.chain.gyro.bias_hat, before.delay
    if guessed is None:
        known = parameters.angles, parameters.bias
        guessed = *guess(chains, time, used.angles, measured, gyro, known, used.sigma), 0.0
        if parameters.sight is not None:
            begun, by = float(data.image_t[0]), (*known, parameters.sight)
            found, guessed = guess_picture_clock(
                chains, time, begun, gimbal, measured, gyro, by, guessed[:2], used.sigma
            )
            late = found.late(data.image_t - begun)
            if np.abs(late).max() > _NEAR:
                return _prepare(replace(data, image_t=data.image_t + late), config, clock=found, guessed=guessed)
    mount, bias_hat, delay = guessed
    carried = initial_attitudes(chains, time, camera(used.angles, mount, parameters.names), measured, gyro)
    del gyro  # Another as large follows.
    motion = None
    if parameters.sight is not None:
        moved = None if before is None or before.around is None else before.around.motion
        motion = LocalMotion.around(time, data.gyro_t, data.gyro, gimbal, driving, moved)
    chain = GyroChain.over(
        time,
        used.starts,
        carried,
        GyroPath(data.gyro_t, data.gyro, bias_hat, driving, hidden=hidden(data.gyro_t, half_width, side)),
        density=noises["gyro_density"].used,
        walk=noises["gyro_bias_walk"].used,
        errors=parameters.gyro,
        trunk=trunk,
    )
    around, angles, clock = None, used.angles, clock or Clock(float(data.image_t[0]))
    if motion is not None:
        angles = motion.read
        clock, watched = _watched(used, clock, before, start)
        elapsed = clock.elapsed(time)
        around = LosContext(motion, elapsed, watched, clock.late(elapsed))
    model = _Model(
        chain=chain,
        mount=mount,
        delay=delay,
        measured=measured,
        sqrt_information=_sqrt_information(used.covariance),
        angles=angles,
        encoder=used.encoder,
        around=around,
        loss=TruncatedLoss(gate(3 if np.isfinite(measured[:, 2]).any() else 2)),
        parameters=parameters,
        reference=reference,
        noises=noises,
        clock=clock,
        dead_band=half_width > 0.0,
    )
    return model, {**data.dropped, **dropped}


@dataclass(frozen=True, eq=False)
class _Used:
    """The selected pictures and their measurements.

    Attributes:
        time: (K,) stamps, s.
        starts: (K,) which are the first of a target.
        chains: the pictures of each target.
        measured: (K, 3) phx, phz, roll, rad.
        covariance: (K, 3, 3) of these; NaN where not measured.
        angles: (K, 2) azimuth and elevation, rad.
        encoder: (K,) sigma of their noise, rad.
        sigma: of a LOS error, as is usual, rad.
    """

    time: Array
    starts: Mask
    chains: list[Index]
    measured: Array
    covariance: Array
    angles: Array
    encoder: Array
    sigma: float

    @classmethod
    def of(
        cls, data: LosData, config: Config, noise: float, gimbal: GimbalPath, margin: float, start: float
    ) -> tuple[_Used, dict[str, int]]:
        """Select pictures from `start` on and `margin` s away from gaps; return them and exclusion counts.

        `noise` is the encoders', rad a sample.
        """
        encoder = noise * np.linalg.norm(gimbal.weights(data.image_t)[1], axis=1)
        covariance = _covariance(data, gimbal, config, encoder)
        rows, starts, dropped = select_pictures(data, np.sqrt(covariance[:, 0, 0]), margin)
        late = data.image_t[rows] >= start
        rows, starts = rows[late], starts[late]
        starts[:1] = True
        time = data.image_t[rows]
        chains = np.split(np.arange(len(time)), np.flatnonzero(starts)[1:])
        sigma = float(np.sqrt(np.median(covariance[rows, 0, 0])))
        measured, angles = data.error[rows], gimbal.at(time)
        return cls(time, starts, chains, measured, covariance[rows], angles, encoder[rows], sigma), dropped


def _watched(used: _Used, clock: Clock, before: _Model | None, start: float) -> tuple[Clock, Array]:
    """Clock of the stamps, and time (K,), s, since each picture's target was found."""
    found = used.time[used.starts]
    if before is not None and before.around is not None and start > -np.inf:
        # The data are the recording's end, and its first target may have been found before.
        k = int(np.searchsorted(before.chain.time, start))
        clock = Clock(start - before.around.elapsed[k])
        found[0] = start - before.around.tracked[k]
    return clock, used.time - found[np.cumsum(used.starts) - 1]


def _covariance(data: LosData, gimbal: GimbalPath, config: Config, encoder: Array) -> Array:
    """Covariance (K, 3, 3) of phx, phz, roll, rad^2, by tracker or config plus encoders; NaN where not measured."""
    if data.error_cov is None:
        los = first_given(config.noise.los_error, DEFAULT_NOISE.los_error)
        roll = first_given(config.noise.los_roll, DEFAULT_NOISE.los_roll)
        covariance = np.tile(np.diag([los**2, los**2, roll**2]), (len(data.image_t), 1, 1))
    else:
        covariance = data.error_cov.copy()
    covariance[~np.isfinite(data.error[:, 2]), 2, :] = np.nan
    elevation = gimbal.at(data.image_t)[:, 1]
    # Azimuth turns the picture about an axis that is elevated against its own up.
    by_azimuth = np.stack([np.zeros_like(elevation), np.cos(elevation), np.sin(elevation)], axis=1)
    shape = np.diag([1.0, 0.0, 0.0]) + by_azimuth[:, :, None] * by_azimuth[:, None, :]
    return covariance + encoder[:, None, None] ** 2 * shape


def _sqrt_information(covariance: Array) -> Array:
    """Square-root information R (K, 3, 3), upper triangular, 1/rad; zero in row and column of a missing roll."""
    out = np.zeros_like(covariance)
    rolls = np.isfinite(covariance[:, 2, 2])
    for size, mine in ((3, rolls), (2, ~rolls)):
        root = np.linalg.cholesky(np.linalg.inv(covariance[mine][:, :size, :size]))
        out[mine, :size, :size] = np.swapaxes(root, 1, 2)
    return out


def _steps(model: _Model, chunk: int, after: float = -np.inf) -> Iterator[Step]:
    """Yield steps of at least `chunk` pictures (the last may be smaller); the first step adds variables and priors."""
    time = model.chain.time
    begin = int(np.searchsorted(time, after, side="right"))
    while begin < len(time):
        end = begin
        while end < len(time) and end - begin < chunk:
            end = min(int(np.searchsorted(time, time[end] + _TOGETHER)), end + _MOST_TOGETHER)
        yield _step(model, range(begin, end))
        begin = end


def _step(model: _Model, keyframes: range) -> Step:
    chain = model.chain
    step = Step(
        time=float(chain.time[keyframes[-1]]),
        predict=partial(chain.predict, keyframes, partial(_found, model)),
        keyframes=chain.numbers(keyframes),
    )
    if chain.first + keyframes.start == 0:
        p = model.parameters
        step.initial.insert(p.angles.key, model.mount)
        if p.sight is not None:
            sight = np.zeros(len(p.sight.quantities))
            sight[:2], sight[-1] = (model.clock.offset, model.clock.skew), model.delay
            step.initial.insert(p.sight.key, sight)
        if p.gyro is not None:
            step.initial.insert(p.gyro.key, np.zeros(len(p.gyro.quantities)))
        step.factors.extend(map(prior_of, p.all))
    step.factors.extend(_start_factor(model, k) for k in keyframes if chain.starts[k])
    chain.add(step, keyframes)
    step.factors[:] = [_whitened(model, factor) for factor in step.factors]
    step.factors.extend(_picture_factors(model, keyframes))
    if chain.bias.nodes > 1 and model.parameters.sight is not None:
        # All pictures take it.
        step.timestamps[FIRST_BIAS] = step.time
    return step


def _found(model: _Model, k: int, current: gtsam.Values) -> Array:
    """Attitude tRm (4,) at picture k, where a target is found, by the current mounting angles."""
    cRm = camera(model.angles[k : k + 1], current.atVector(model.parameters.angles.key), model.parameters.names)
    return seen(cRm, model.measured[k : k + 1])[0]


def _start_factor(model: _Model, k: int) -> Factor:
    """Wide prior on the attitude at a target's first picture."""
    rolls = np.isfinite(model.measured[:, 2]).any()
    sigmas = np.array([_WIDE, _WIDE if rolls else _HELD, _WIDE])
    initial = model.chain.initial[k]
    return rotation_about(model.chain.state(k), initial, so3.matrix(initial) / sigmas[:, None])


def _whitened(model: _Model, factor: Factor) -> Factor:
    """Wrap gyro increment factors so that gimbal errors leave their noise unchanged; return other factors as is."""
    increments, sight, around = factor.bound, model.parameters.sight, model.around
    if increments is None or sight is None or around is None or factor.family != "gyro":
        return factor
    at = np.searchsorted(model.chain.time, increments.model.time)
    errors, following = model.gimbal_errors, around.motion.following
    increment = ThroughGimbalFactor(increments.model, model.angles[at], errors, following=following)
    return factor.rebound(increment.on(*increments.tied, model.parameters.angles.key, sight.key))


def _picture_factors(model: _Model, keyframes: range) -> list[Factor]:
    """Build one factor of the pictures with roll and one of those without."""
    k = np.array(keyframes)
    rolls = np.isfinite(model.measured[k, 2])
    return [
        _picture_factor(model, k[mine], count, family)
        for count, family, mine in ((2, _FAMILIES[0], ~rolls), (3, _FAMILIES[1], rolls))
        if mine.any()
    ]


def _picture_factor(model: _Model, k: Index, count: int, family: str) -> Factor:
    p, some = model.parameters, as_slice(k)
    rows_model = LosDirectionFactor(
        model.chain.time[some],
        model.measured[some, :count],
        model.sqrt_information[some, :count, :count],
        model.angles[some],
        p.names,
        None if model.around is None else model.around[some],
        len(p.gyro.quantities) if p.gyro is not None and p.sight is not None else 0,
    )
    columns: list[int | list[int]] = [[model.chain.state(i) for i in k], p.angles.key]
    bound: Model = rows_model
    if p.sight is not None:
        bound = ThroughGimbalFactor(
            rows_model, model.angles[some], model.gimbal_errors, model.encoder[some], error_blocks=(1, 3)
        )
        # From stamp to picture the bias has no time to matter but as a whole. Each keyframe's own, where it may walk
        # far, would follow the picture's noise, the better the larger the time offset, which would grow without bounds.
        columns += [FIRST_BIAS, p.sight.key, *model.chain.error_keys]
    return Factor.of(family, bound.on(*columns, loss=model.loss))


def _advice(weights: Mapping[str, float]) -> Motion:
    """Motion that would make a weak direction observable."""
    strong = {name for name, weight in weights.items() if abs(weight) > 0.3}
    if {each.name for each in AZIMUTH_ZEROS} <= strong:
        return Motion(
            "ask for delta_z = delta_pz - delta_gz instead",
            why="delta_pz and delta_gz cannot be separated, turning the carrier's frame about the azimuth axis "
            "changes both alike",
        )
    if TIME_OFFSET.name in strong:
        return Motion(
            "turn the carrier back and forth within a second or two",
            swaying("xyz", "carrier"),
            "the time offset needs faster sway",
        )
    if "camera_roll" in strong:
        return Motion(
            "offset the gimbal while recording",
            why="the camera's roll needs the target to move across the picture",
        )
    if {"collimation", "axis_nonperpendicularity"} & strong:
        return Motion(
            "record targets at low and at high elevation",
            why="errors of the gimbal's axes need changing elevation",
        )
    if "delta_px" in strong:
        return Motion(
            "sway the carrier in azimuth too, or record targets at other azimuths and elevations",
            swaying("z", "carrier"),
            "delta_px trades against delta_gx and delta_gy",
        )
    if set(BIAS.names) & strong and not strong - set(BIAS.names):
        return Motion(
            "record longer with the target in sight, and sway across the line of sight",
            swaying("xz", "carrier"),
            "the gyro bias is not determined yet",
        )
    return Motion(
        "sway the carrier about all three axes while the target is in sight",
        swaying("xyz", "carrier"),
        "the mounting angles need it",
    )
