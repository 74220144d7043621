"""The head method: helmet attitude, gyro bias, mounts and time offset from a helmet MIMU, platform IMU and vision.

The graph's states are bRv at keyframes, joined by what the helmet's and the platform's gyro measured between them. A
keyframe serves all pictures around it: the gyros carry its attitude to their times. Methods page, section 3.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, Mask
from alidade.factors.attitude import FADE, OFFSET_COLUMN, SKEW_COLUMN, VisionAttitudeFactor
from alidade.factors.chi_square import gate
from alidade.factors.gauss_markov import GaussMarkovFactor
from alidade.factors.loss import TruncatedLoss
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.camera_clock import Clock, Keyframes
from alidade.pipelines.estimation.error_map import ErrorMap
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.gyro_chain import LAYOUT, ROOT, GyroChain, Trunk, shared_keyframes
from alidade.pipelines.estimation.noise import CORRELATED_ERROR, Level, Noise
from alidade.pipelines.estimation.parameters import DEAD_BAND, acting
from alidade.pipelines.estimation.parameters import stated as stated_figure
from alidade.pipelines.estimation.priors import prior_of
from alidade.pipelines.estimation.problem import Attitudes, CorrelatedError, Estimate, Factor, Problem, Step
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.formula import clock_constants
from alidade.pipelines.methods.head.initial_values import guess, guess_camera, guess_picture_clock
from alidade.pipelines.methods.head.parameters import CAMERA, HELMET, OFFSET, SENSITIVITY, VISION_MAP, HeadParameters
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.methods.head.report import at_gyro_rate, between
from alidade.pipelines.methods.noise import HARDLY, at_least_at_rest, estimated, mean_at_rest, sampled, stated, typical
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.recording.plausibility import DEAD_BAND as HAS_DEAD_BAND
from alidade.pipelines.recording.plausibility import dead_band, hidden
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

# Pictures share a keyframe within this time, s, and keyframes are never farther apart than this, s: increments are
# corrected for the gyro's errors to first order only, see alidade.factors.gyro.
_SHARED, _LONGEST_INCREMENT = 0.1, 0.25
# Pictures share a keyframe as far as what gyro noise adds on the way is at most this part of vision's.
_NEGLIGIBLE = 0.1
# All noise over the rate, 1/sqrt(Hz), beyond which it is none: healthy gyros in motion have .008 at most (UPenn), those
# with an axis inverted .025 and more (BROAD).
_NO_NOISE = 0.014
# So far from its stamp, s, the gyros carry an attitude to where its picture was taken.
_NEAR = 0.1
_FEWEST_FRAMES = 10
# Attitudes of which a larger share is turned by half a turn are no outliers.
_FEW_OUTLIERS = 0.02
_FAMILY, _CORRELATED = "vision", "vision_correlated"
# Errors by attitude of motion capture, rad rms, which no vision has less of. In six trials of BROAD .04 to .6 mrad are
# likeliest; by their noise alone, chi-square of their common mount is 154 of 15, with this 43.
_LEAST_MAP = 3.5e-4
# Share of what is required of a mount from which on an error of vision is material.
_MATERIAL = 0.5

# Stated in the report where it is assumed.
_AT_REST = "No platform IMU: the platform counts as at rest."


@dataclass(frozen=True)
class _Model:
    """A recording prepared for the graph."""

    chain: GyroChain  # bRv at the keyframes
    carriers: tuple[GyroPath, GyroPath | None]  # of the helmet and the platform, without the noise at rest
    pictures: Index  # (K + 1,) those of keyframe k are from pictures[k] to pictures[k + 1]
    stamps: Array  # (frames,)
    taken: Array  # (frames,) s, about when
    clock: Clock  # of the pictures
    origins: tuple[float, float, float]  # s: of `elapsed`, of the groups that share a keyframe, and how long these are
    elapsed: Array  # (frames,) since the recording's first stamp
    measured: Array  # (frames, 4) cRh
    first: Array  # (4,) cRh of the recording's first picture
    sqrt_information: Array  # (frames, 3, 3)
    loss: TruncatedLoss
    parameters: HeadParameters
    helmet_guess: Array  # vRh
    camera_guess: Array  # cRb
    reference: float | None  # degrees Celsius, the temperature at which the bias is the bias; None: nobody measures it
    noises: dict[str, Level]  # by name
    dead_band: bool  # of the helmet's gyro


def problem(data: HeadData, config: Config) -> Problem:
    """Build the graph of a head recording.

    Raises:
        InputError: fewer than ten vision frames lie within the helmet gyro's record.
    """
    return _problem(config, data, _prepare(data, config))


def _problem(config: Config, data: HeadData, model: _Model) -> Problem:
    return Problem(
        method="head",
        parameters=model.parameters.all,
        steps=partial(_steps, model),
        steps_after=partial(_steps, model, 1),
        loss=model.loss,
        attitudes=partial(_attitudes, model),
        at_gyro_rate=partial(at_gyro_rate, data),
        advice=_advice,
        dropped=data.dropped,
        premises=(
            *(() if data.platform_t is not None else (_AT_REST,)),
            *((HAS_DEAD_BAND,) if model.dead_band else ()),
        ),
        continuation=None if model.dead_band else partial(_continuation, config, model),
        revision_horizon=temperature.longest_gap(data.temperature),
        noises=tuple(model.noises.values()),
        constants=temperature.constants(model.reference) | clock_constants(model.parameters.picture, model.clock.begun),
        keyframes=Keyframes(model.clock, _NEAR),
        layout=replace(LAYOUT, states="xu"),
        marginal_likelihood=True,
        step_candidates=(model.parameters.helmet.key,),
        offsets=(tuple(q.name for q in model.parameters.bias.quantities),),
        correlated_error=_correlated_error(model),
        refined_graph=partial(_refined_graph, config, data, model),
        error_map=partial(_error_map, config, model),
    )


def _error_map(config: Config, model: _Model, estimate: Estimate) -> ErrorMap | None:
    """Error map of vision over the estimated attitude.

    They move nothing: what depends on the attitude may be the gyro's as well. In BROAD's first trial such errors are
    the same in both halves; freed, they move attitudes by .3 deg from motion capture's, .04 deg before.
    """
    assert estimate.attitudes is not None
    stated, bRv = stated_figure(config, VISION_MAP), estimate.attitudes.wxyz
    turned = so3.local(bRv[:1], bRv)
    places = {f"{axis} of bRv": turned[:, i] for i, axis in enumerate("xyz")}
    return ErrorMap.of(
        VISION_MAP.name,
        "xyz",
        stated,
        (_FAMILY,),
        model.stamps,
        so3.matrix(bRv).reshape(-1, 9),
        places,
        moves=False,
        least=min(stated, _LEAST_MAP),
    )


def _refined_graph(config: Config, data: HeadData, model: _Model, levels: Sequence[Level]) -> Problem | None:
    """Build a head recording's graph with the keyframes and states that noise levels need; None where it has them."""
    noises = model.noises | {level.noise.name: level for level in levels}
    if _CORRELATED not in noises and _shared(data, noises) > 0.5 * model.origins[2]:
        return None
    return replace(_problem(config, data, _prepare(data, config, clock=model.clock, noises=noises)), refined_graph=None)


def _shared(data: HeadData, noises: Mapping[str, Level]) -> float:
    """Time, s, within which pictures share a keyframe, since gyro noise and vision's correlated error change little."""
    density = [noises["gyro_density"].used, noises["gyro_rate_noise"].used * _rate(data)]
    if "platform_gyro_density" in noises:
        density.append(noises["platform_gyro_density"].used)
    if (error := noises.get(_CORRELATED)) is not None:
        assert error.noise.correlation_time is not None
        density.append(error.used * float(np.sqrt(2.0 / error.noise.correlation_time)))
    vision = noises["vision_attitude"].used, noises["vision_rate_noise"].used * _rate(data)
    return min(_SHARED, _NEGLIGIBLE**2 * float(np.square(vision).sum()) / max(float(np.square(density).sum()), 1e-300))


def _rate(data: HeadData) -> float:
    """Root mean square rate of the helmet, rad/s."""
    return float(np.sqrt((data.head_gyro**2).sum(axis=1).mean()))


def _bounded(level: Level, no_noise: float) -> Level:
    return replace(level, noise=replace(level.noise, no_noise=no_noise))


def _noises(data: HeadData, config: Config) -> dict[str, Level]:
    """Noises in use, by name."""
    density = estimated("gyro_density", config, ("gyro",), data.gyro_density)
    density = at_least_at_rest(density, data.head_t, data.head_gyro, data.head_force)
    rate = max(_rate(data), 1e-12)
    no_noise = max(density.noise.spec.no_noise, _NO_NOISE * rate)
    vision = estimated("vision_attitude", config, (_FAMILY,), typical(data.vision_cov, 0, 1, 2))
    by_rate = estimated("vision_rate_noise", config, (_FAMILY,), beside=True)
    found = [
        vision,
        _bounded(by_rate, vision.noise.spec.no_noise / rate),
        _bounded(density, no_noise),
        _bounded(estimated("gyro_rate_noise", config, ("gyro",), beside=True), no_noise / rate),
        Level(stated("gyro_bias_walk", config)),
    ]
    if data.platform_t is not None and data.platform_gyro is not None:
        platform = stated("platform_gyro_density", config, data.platform_gyro_density)
        found.append(sampled(platform, data.platform_t, data.platform_gyro))
    return {level.noise.name: level for level in found}


def _correlated_error(model: _Model) -> CorrelatedError:
    """Describe the error of vision, correlated in time, to be looked for: about as large as vision's default noise."""
    vision = model.noises["vision_attitude"].noise
    assert vision.spec.default is not None
    noise = Noise(_CORRELATED, vision.spec.default, "default", vision.known and HARDLY, (CORRELATED_ERROR,))
    helmet = model.parameters.helmet
    return CorrelatedError(helmet.key, Level(noise), _MATERIAL * min(q.require for q in helmet.quantities))


def _continuation(config: Config, model: _Model, data: HeadData, time: float) -> Problem | None:
    """Build the graph of the end of a growing recording; see Problem.continuation."""
    trunk = ROOT if time == -np.inf else model.chain.trunk(time)
    if trunk is None or (trunk is not ROOT and time < data.vision_t[0]):
        return None
    if (data.temperature is None) != (model.reference is None):
        return None
    grown = _prepare(data, config, model, trunk, time)
    begins = trunk is ROOT or grown.chain.time[0] == time
    return _problem(config, data, grown) if begins and not grown.dead_band else None


def _prepare(
    data: HeadData,
    config: Config,
    before: _Model | None = None,
    trunk: Trunk | None = None,
    start: float = -np.inf,
    clock: Clock | None = None,
    noises: Mapping[str, Level] | None = None,
) -> _Model:
    """Prepare the model of a recording, or of the end of a growing recording from a keyframe on.

    `noises` are those in force; None: as stated. `clock` has the times of the pictures. Those of a recording that
    grows count as taken at their stamps.
    """
    begun = float(data.vision_t[0]) if before is None else before.clock.begun
    taken = data.vision_t + (Clock(begun) if clock is None else clock).late(data.vision_t - begun)
    inside = _inside(data, taken)
    stamps, taken, measured = data.vision_t[inside], taken[inside], data.vision_wxyz[inside]
    noises = dict(noises or _noises(data, config)) if before is None else before.noises
    density, platform, platform_density = noises["gyro_density"].noise.stated, None, 0.0
    if data.platform_t is not None and data.platform_gyro is not None:
        platform = GyroPath(data.platform_t, data.platform_gyro)
        platform_density = noises["platform_gyro_density"].used
    reference = temperature.reference(data.temperature) if before is None else before.reference
    temperature_rise = temperature.above(data.temperature, reference, data.head_t)
    half_width, side = dead_band(data.head_t, data.head_gyro)
    hidden_rate = hidden(data.head_t, half_width, side)
    drivers = {SENSITIVITY: data.head_force, GYRO_SLOPE: temperature_rise, DEAD_BAND: side if half_width else None}
    caused = [each for each, driver in drivers.items() if driver is not None]
    if before is None:
        around = _all_around(data.vision_wxyz)
        parameters = HeadParameters.of(config, platform is not None, caused, data.stamp_sigma, around)
    else:
        parameters = before.parameters
    sqrt_information = _sqrt_information(data.vision_cov, inside, config)
    sigma = float(1.0 / np.median(1.0 / _sigmas(sqrt_information)))
    if before is None:
        gyro = GyroPath(data.head_t, data.head_gyro)
        cRb = so3.identity()
        if platform is not None and all(q.prior_sigma != 0.0 for q in parameters.camera.quantities):
            cRb = guess_camera(gyro, platform, taken, measured, sigma)
        bRh = so3.multiply(so3.inverse(cRb), measured)
        if parameters.has_picture_errors and clock is None:
            by = parameters.helmet, parameters.bias, parameters.picture
            guessed = guess_picture_clock(gyro, platform, stamps - begun, begun, bRh, by, sigma)
            if np.abs(guessed.late(stamps - begun)).max() > _NEAR:
                return _prepare(data, config, clock=guessed, noises=noises)
        iRb = so3.identity(len(taken)) if platform is None else platform.attitude(taken)
        bias_hat, vRh = guess(gyro, taken, so3.multiply(iRb, bRh), sigma)
        first, origins = data.vision_wxyz[0], (begun, taken[0], _shared(data, noises))
    else:
        bias_hat, vRh, cRb = before.chain.gyro.bias_hat, before.helmet_guess, before.camera_guess
        first, origins = before.first, before.origins
        if trunk is ROOT:
            origins = origins[0], taken[0], origins[2]
    time, pictures = shared_keyframes(taken, *origins[1:], _LONGEST_INCREMENT)
    late = int(np.searchsorted(time, start))
    time, pictures = time[late:], pictures[late:] - pictures[late]
    frames = slice(len(taken) - pictures[-1], None)
    stamps, taken, measured = stamps[frames], taken[frames], measured[frames]
    driving = acting(parameters.gyro, drivers)
    gyro = GyroPath(data.head_t, data.head_gyro, bias_hat, driving, hidden=hidden_rate)
    chain = GyroChain.over(
        time,
        np.arange(len(time)) == 0,
        between(gyro, platform, taken, so3.compose(so3.inverse(cRb), measured, so3.inverse(vRh)), time),
        gyro,
        density=density,
        other_density=platform_density,
        walk=noises["gyro_bias_walk"].used,
        errors=parameters.gyro,
        platform=platform,
        platform_errors=parameters.platform,
        trunk=trunk,
    )
    return _Model(
        chain=chain,
        carriers=(_carrier(gyro, data.head_force), None if platform is None else _carrier(platform, None)),
        pictures=pictures,
        stamps=stamps,
        taken=taken,
        clock=Clock(begun) if clock is None else clock,
        origins=origins,
        elapsed=stamps - origins[0],
        measured=measured,
        first=first,
        sqrt_information=sqrt_information[frames],
        loss=TruncatedLoss(gate(3)),
        parameters=parameters,
        helmet_guess=vRh,
        camera_guess=cRb,
        reference=reference,
        noises=noises,
        dead_band=half_width > 0.0,
    )


def _carrier(gyro: GyroPath, force: Array | None) -> GyroPath:
    """Gyro for propagation from keyframes to pictures, with rates at rest replaced by their mean.

    The time offset turns what is seen by the rate: at rest by noise, which passes for information about it.
    """
    rate = mean_at_rest(gyro.t, gyro.read, force)
    return gyro if rate is gyro.read else gyro.with_rate(rate)


def _all_around(attitudes: Array) -> bool:
    """Whether a significant share of attitudes (n, 4) is farther than FADE from the first."""
    angles = np.linalg.norm(so3.local(attitudes[:1], attitudes), axis=1)
    return bool((angles > FADE).mean() > _FEW_OUTLIERS)


def _inside(data: HeadData, taken: Array) -> Mask:
    """Mask of frames within the gyros' records. Raises InputError if these are too few."""
    inside = (taken >= data.head_t[0]) & (taken <= data.head_t[-1])
    if data.platform_t is not None:
        inside &= (taken >= data.platform_t[0]) & (taken <= data.platform_t[-1])
    if inside.sum() < _FEWEST_FRAMES:
        raise InputError(
            f"vision: only {int(inside.sum())} of {len(inside)} frames lie within the gyros' record; "
            f"at least {_FEWEST_FRAMES} are needed: check the topics and their clocks"
        )
    return np.asarray(inside)


def _sqrt_information(covariance: Array | None, inside: Mask, config: Config) -> Array:
    """Square-root information (n, 3, 3) of vision attitudes, 1/rad: by config, else messages, else default."""
    if covariance is None or config.noise.vision_attitude is not None:
        sigma = first_given(config.noise.vision_attitude, DEFAULT_NOISE.vision_attitude)
        return np.broadcast_to(np.eye(3) / sigma, (int(inside.sum()), 3, 3))
    root: Array = np.linalg.cholesky(np.linalg.inv(covariance[inside]))
    return np.swapaxes(root, 1, 2)


def _steps(model: _Model, chunk: int, after: float = -np.inf) -> Iterator[Step]:
    """Yield the first keyframe with calibration variables and priors, then `chunk` keyframes at a time."""
    time = model.chain.time
    taken = int(np.searchsorted(time, after, side="right"))
    if taken == 0:
        yield _step(model, range(1))
    # Pictures that share keyframes make longer factors: fewer keyframes in each.
    chunk = max(1, chunk // 2) if len(model.stamps) > 1.5 * len(time) else chunk
    for begin in range(max(taken, 1), len(time), chunk):
        yield _step(model, range(begin, min(begin + chunk, len(time))))


def _step(model: _Model, keyframes: range) -> Step:
    chain = model.chain
    step = Step(
        time=float(chain.time[keyframes[-1]]),
        predict=partial(_predicted, model, keyframes),
        keyframes=chain.numbers(keyframes),
    )
    if chain.first + keyframes.start == 0:
        _begin(model, step)
    chain.add(step, keyframes)
    if _CORRELATED in model.noises:
        _add_correlated_error(model, step, keyframes)
    step.factors.extend(_vision_factor(model, keyframes))
    return step


def _add_correlated_error(model: _Model, step: Step, keyframes: range) -> None:
    """Add vision's correlated error at keyframes, and its transitions to these."""
    time, noise = model.chain.time, model.noises[_CORRELATED].noise
    assert noise.correlation_time is not None
    error = partial(GaussMarkovFactor, sigma=noise.stated, correlation_time=noise.correlation_time)
    for k in keyframes:
        step.initial.insert(_error_key(model, k), np.zeros(3))
        step.timestamps[_error_key(model, k)] = float(time[k])
    if keyframes.start == 0:
        step.factors.append(Factor.process_of(CORRELATED_ERROR, error(time[:1]).on(_error_key(model, 0))))
    after = np.arange(max(keyframes.start, 1), keyframes.stop)
    if len(after):
        keys = [[_error_key(model, int(k)) for k in each] for each in (after - 1, after)]
        moved = error(time[after], interval=time[after] - time[after - 1])
        step.factors.append(Factor.process_of(CORRELATED_ERROR, moved.on(*keys)))


def _error_key(model: _Model, keyframe: int) -> int:
    """Key of vision's correlated error at a keyframe, (3,) rad."""
    return int(gtsam.symbol("u", model.chain.first + keyframe))


def _predicted(model: _Model, keyframes: range, current: gtsam.Values) -> gtsam.Values:
    """Initial values of the variables that some keyframes add to the graph, predicted from the current estimate."""
    out = model.chain.predict(keyframes, lambda k, _: model.chain.initial[k], current)
    if _CORRELATED in model.noises:
        for k in keyframes:
            out.insert(_error_key(model, k), np.zeros(3))
    return out


def _begin(model: _Model, step: Step) -> None:
    """Add the calibration variables and their priors to the first step."""
    p = model.parameters
    step.initial.insert(p.helmet.key, so3.to_gtsam(model.helmet_guess))
    step.initial.insert(p.camera.key, so3.to_gtsam(model.camera_guess))
    step.factors.extend(map(prior_of, (p.bias, p.helmet, p.camera)))
    for vector in (p.picture, p.gyro, p.platform):
        if vector is not None:
            initial = np.zeros(len(vector.quantities))
            if vector is p.picture and p.has_picture_errors:
                initial[[OFFSET_COLUMN, SKEW_COLUMN]] = model.clock.offset, model.clock.skew
            step.initial.insert(vector.key, initial)
            step.factors.append(prior_of(vector))


def _pictures(model: _Model, keyframes: Sequence[int]) -> tuple[Index, Index]:
    """Indices of the pictures of some keyframes, and the keyframe of each picture."""
    rows = [np.arange(*model.pictures[k : k + 2]) for k in keyframes]
    return np.concatenate(rows), np.repeat(np.array(keyframes, dtype=np.intp), [len(r) for r in rows])


def _vision_factor(model: _Model, keyframes: range) -> list[Factor]:
    rows, of = _pictures(model, keyframes)
    if len(rows) == 0:
        return []
    chain, p = model.chain, model.parameters
    # Carried through a gap of the gyro's record a picture says less of its keyframe.
    information, unseen = model.sqrt_information[rows], chain.gyro.unseen(chain.time[of], model.taken[rows])
    sigma = _sigmas(information)
    less = 1.0 / np.sqrt(1.0 + unseen / sigma**2)
    seen = VisionAttitudeFactor(
        model.stamps[rows],
        model.measured[rows],
        information * less[:, None, None],
        *model.carriers,
        errors=0 if p.gyro is None else len(p.gyro.quantities),
        platform_errors=p.platform is not None,
        anchor=chain.time[of],
        expected=model.taken[rows],
        elapsed=model.elapsed[rows] if p.has_picture_errors else None,
        first=np.broadcast_to(model.first, (len(rows), 4)) if p.has_picture_errors else None,
        correlated=_CORRELATED in model.noises,
    )
    states = [chain.state(k) for k in of]
    keys = [p.camera.key, p.helmet.key, p.picture.key, *chain.error_keys]
    errors = [[_error_key(model, k) for k in of]] if seen.correlated else []
    bound = seen.on(states, chain.bias_keys(of), *keys, *errors, loss=model.loss)
    return [Factor.of(_FAMILY, bound, np.linalg.norm(_rate_in_pictures(model, rows), axis=1) * less / sigma)]


def _sigmas(sqrt_information: Array) -> Array:
    """Sigmas (n,), rad an axis, of attitudes with square-root information (n, 3, 3): of their mean precision."""
    return np.asarray(np.sqrt(3.0) / np.linalg.norm(sqrt_information, axis=(1, 2)))


def _rate_in_pictures(model: _Model, rows: Index) -> Array:
    """Rate (n, 3), rad/s, of the helmet relative to the camera at some pictures, by the first guess of the mounts."""
    helmet, platform = model.carriers
    rate = helmet.rate(model.taken[rows])
    if platform is None:
        return rate
    cRb, vRh = model.camera_guess, model.helmet_guess
    bRv = so3.compose(so3.inverse(cRb), model.measured[rows], so3.inverse(vRh))
    return np.asarray(rate - so3.rotate(so3.inverse(bRv), platform.rate(model.taken[rows])))


def _attitudes(model: _Model, keyframes: Sequence[int], values: gtsam.Values) -> Attitudes:
    """Attitudes bRv at the pictures' true times on the gyro's clock."""
    rows, of = _pictures(model, [k - model.chain.first for k in keyframes])
    if len(rows) == 0:
        return Attitudes(np.empty(0), np.empty((0, 4)))
    offset_and_skew = values.atVector(model.parameters.picture.key)[: SKEW_COLUMN + 1]
    at = Clock(model.origins[0], *offset_and_skew).exposed(model.stamps[rows])
    return Attitudes(at, model.chain.attitudes(of, model.taken[rows], at, values))


def _advice(weights: Mapping[str, float]) -> Motion:
    """Motion that would make a weak direction observable."""
    strongest = {name.rsplit("_", 1)[0] if name != OFFSET.name else name for name, w in weights.items() if abs(w) > 0.3}
    platform = swaying("xy", "platform")
    if {CAMERA.name, HELMET.name} <= strongest:
        return Motion(
            "turn the platform about two axes while recording",
            platform,
            "camera and helmet mounts trade against each other",
        )
    if CAMERA.name in strongest:
        return Motion(
            "turn the platform about two axes while recording", platform, "the camera mount needs platform motion"
        )
    if HELMET.name in strongest:
        return Motion(
            "nod and shake the head", swaying("yz", "helmet"), "the helmet mount needs head motion about two axes"
        )
    if OFFSET.name in strongest:
        return Motion(
            "turn the head back and forth within a second",
            swaying("xyz", "helmet"),
            "the time offset needs faster head motion",
        )
    return Motion("record longer with the markers in sight", why="the gyro bias is not determined yet")
