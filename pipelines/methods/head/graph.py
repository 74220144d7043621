"""The head method: helmet attitude, gyro bias, mounts and time offset from a helmet MIMU, platform IMU and vision.

The graph's states are iRv = iRb bRv at the vision frames, i the platform's frame at the start: with the platform's
rotation iRb integrated from its own gyro, gtsam's native AHRSFactor joins them. Methods page, section 3.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import so3
from factors.attitude import VisionAttitudeFactor
from factors.chi_square import gate
from factors.earth import EARTH_RATE
from factors.loss import TruncatedLoss
from factors.preintegration import GyroPath
from pipelines.errors import InputError
from pipelines.graph.gyro_chain import GyroChain, state
from pipelines.graph.priors import rotation_prior, vector_prior
from pipelines.graph.problem import (
    Array,
    Attitudes,
    Factor,
    Parameter,
    Problem,
    Quantity,
    Step,
    rotation_vector_coordinates,
)
from pipelines.graph.walking_bias import FIRST as FIRST_BIAS
from pipelines.methods.head.recording import HeadData
from pipelines.settings import DEFAULT_NOISE, Config, check_names, first_given

# Without vision for longer than this, s, a keyframe is set in between: gtsam corrects an increment for the bias to
# first order only.
_LONGEST_INCREMENT = 1.0
# Rates for the first guess are taken over this time, s: long against vision noise, short against turns.
_GUESS_SPAN = 0.3
_FEWEST_FRAMES = 10

# Said where it is taken for granted.
_AT_REST = "No platform IMU: the platform counts as at rest."

_BIAS, _HELMET, _CAMERA, _OFFSET = "gyro_bias", "helmet_mount", "camera_mount", "time_offset"
_HELMET_KEY, _CAMERA_KEY, _OFFSET_KEY = (int(gtsam.symbol(c, 0)) for c in "HCT")


@dataclass(frozen=True)
class _Model:
    """The recording prepared for the graph: what every step needs."""

    chain: GyroChain  # iRv at the keyframes
    vision: NDArray[np.intp]  # (K,) index into the vision frames, -1 where a keyframe only bridges a gap
    measured: Array  # (frames, 4) cRh
    sqrt_information: Array  # (frames, 3, 3)
    platform: GyroPath | None
    loss: TruncatedLoss
    parameters: tuple[Parameter, ...]
    helmet_guess: Array  # vRh


def problem(data: HeadData, config: Config) -> Problem:
    """The graph of a head recording.

    Raises:
        InputError: fewer than ten vision frames lie within the helmet gyro's record.
    """
    model = _prepare(data, config)
    return Problem(
        method="head",
        parameters=model.parameters,
        steps=partial(_steps, model),
        steps_after=partial(_steps, model, 1),
        loss=model.loss,
        attitudes=partial(_attitudes, model),
        attitude_name="bRv",
        advice=_advice,
        dropped=data.dropped,
        premises=() if data.platform_t is not None else (_AT_REST,),
    )


def _prepare(data: HeadData, config: Config) -> _Model:
    inside = (data.vision_t >= data.head_t[0]) & (data.vision_t <= data.head_t[-1])
    if data.platform_t is not None:
        inside &= (data.vision_t >= data.platform_t[0]) & (data.vision_t <= data.platform_t[-1])
    if inside.sum() < _FEWEST_FRAMES:
        raise InputError(
            f"vision: only {int(inside.sum())} of {len(inside)} frames lie within the gyros' record; "
            f"at least {_FEWEST_FRAMES} are needed: check the topics and their clocks"
        )
    vision_t, measured = data.vision_t[inside], data.vision_wxyz[inside]
    density = first_given(config.noise.gyro_density, data.gyro_density, DEFAULT_NOISE.gyro_density)
    platform_density = 0.0
    platform = None
    if data.platform_t is not None and data.platform_gyro is not None:
        platform = GyroPath(data.platform_t, data.platform_gyro)
        platform_density = first_given(
            config.noise.platform_gyro_density, data.platform_gyro_density, DEFAULT_NOISE.platform_gyro_density
        )
    sqrt_information = _sqrt_information(data.vision_cov, inside, config)

    bRi = so3.identity(len(vision_t)) if platform is None else so3.inverse(platform.attitude(vision_t))
    iRh = so3.multiply(so3.inverse(bRi), measured)
    sigma = float(1.0 / np.median(np.linalg.norm(sqrt_information, axis=(1, 2)) / np.sqrt(3.0)))
    bias_hat, vRh = _guess(data, vision_t, iRh, sigma)
    time, vision = _keyframes(vision_t)
    chain = GyroChain.over(
        time,
        np.arange(len(time)) == 0,
        so3.interpolate(vision_t, so3.multiply(iRh, so3.inverse(vRh)), time),
        GyroPath(data.head_t, data.head_gyro, bias_hat),
        density=density,
        other_density=platform_density,
        walk=first_given(config.noise.gyro_bias_walk, DEFAULT_NOISE.gyro_bias_walk),
        scale_error=first_given(config.noise.gyro_scale, DEFAULT_NOISE.gyro_scale),
    )
    return _Model(
        chain=chain,
        vision=vision,
        measured=measured,
        sqrt_information=sqrt_information,
        platform=platform,
        loss=TruncatedLoss(gate(3)),
        parameters=_parameters(config, platform is not None),
        helmet_guess=vRh,
    )


def _sqrt_information(covariance: Array | None, inside: NDArray[np.bool_], config: Config) -> Array:
    """(n, 3, 3): from the config, else from the messages, else the default."""
    if covariance is None or config.noise.vision_attitude is not None:
        sigma = first_given(config.noise.vision_attitude, DEFAULT_NOISE.vision_attitude)
        return np.broadcast_to(np.eye(3) / sigma, (int(inside.sum()), 3, 3))
    root: Array = np.linalg.cholesky(np.linalg.inv(covariance[inside]))
    return np.swapaxes(root, 1, 2)


def _keyframes(vision_t: Array) -> tuple[Array, NDArray[np.intp]]:
    """Vision frames and, in gaps, keyframes that bridge them."""
    bridges = [
        np.linspace(a, b, int(np.ceil((b - a) / _LONGEST_INCREMENT)) + 1)[1:-1]
        for a, b in pairwise(vision_t)
        if b - a > _LONGEST_INCREMENT
    ]
    time = np.concatenate([vision_t, *bridges])
    vision = np.full(len(time), -1)
    vision[: len(vision_t)] = np.arange(len(vision_t))
    order = np.argsort(time, kind="stable")
    return time[order], vision[order]


def _guess(data: HeadData, vision_t: Array, iRh: Array, sigma: float) -> tuple[Array, Array]:
    """First guess of the gyro bias (3,) and vRh (4,) from rates: w_v = vRh w_h + bias over short windows.

    Rates seen by vision beyond what the gyro's length allows are outliers. The mount is the rotation between the
    rates when the motion is about more than one axis, else the identity.
    """
    stride = max(1, round(_GUESS_SPAN / max(float(np.median(np.diff(vision_t))), 1e-3)))
    if len(vision_t) <= stride:
        return np.zeros(3), so3.identity()
    start, stop = vision_t[:-stride], vision_t[stride:]
    span = (stop - start)[:, None]
    gyro = so3.log(GyroPath(data.head_t, data.head_gyro).increments(start, stop).wxyz) / span
    seen = so3.log(so3.multiply(so3.inverse(iRh[:-stride]), iRh[stride:])) / span
    mismatch = np.abs(np.linalg.norm(gyro, axis=1) - np.linalg.norm(seen, axis=1))
    good = (span[:, 0] < 2.0 * _GUESS_SPAN) & (mismatch < 0.05 + 5.0 * sigma / span[:, 0])
    if good.sum() < _FEWEST_FRAMES:
        return np.zeros(3), so3.identity()
    gyro, seen = gyro[good], seen[good]
    a, b = gyro - gyro.mean(axis=0), seen - seen.mean(axis=0)
    s = np.linalg.svd(a.T @ b, compute_uv=False)
    noise = 2.0 * (sigma / _GUESS_SPAN) ** 2 * len(gyro)
    two_axes = s[1] > 3.0 * noise / np.sqrt(len(gyro)) and s[1] > 0.01 * s[0]
    vRh = so3.align(a, b) if two_axes else so3.identity()
    return np.median(gyro - so3.rotate(vRh, seen), axis=0), vRh


def _parameters(config: Config, platform: bool) -> tuple[Parameter, ...]:
    """The method's parameters with their priors; without a platform topic the camera mount is fixed by default."""

    def quantity(
        name: str, unit: str, scale: float, require: float, fixed: bool = False, extra: float = 0.0
    ) -> Quantity:
        prior = config.priors.get(name, 0.0 if fixed else scale)
        return Quantity(name, unit, prior, scale, config.require.get(name, require), extra)

    def triple(
        name: str, unit: str, scale: float, require: float, fixed: bool = False, extra: float = 0.0
    ) -> tuple[Quantity, ...]:
        return tuple(quantity(f"{name}_{axis}", unit, scale, require, fixed, extra) for axis in "xyz")

    parameters = (
        Parameter(FIRST_BIAS, triple(_BIAS, "rad/s", 0.05, 2e-3, extra=0.0 if platform else EARTH_RATE)),
        Parameter(_HELMET_KEY, triple(_HELMET, "rad", 0.35, 1e-2), rotation_vector_coordinates),
        Parameter(_CAMERA_KEY, triple(_CAMERA, "rad", 0.35, 1e-2, fixed=not platform), rotation_vector_coordinates),
        Parameter(_OFFSET_KEY, (quantity(_OFFSET, "s", 0.05, 5e-3),)),
    )
    names = [q.name for p in parameters for q in p.quantities]
    check_names(config.priors, names, "priors")
    check_names(config.require, names, "require")
    return parameters


def _steps(model: _Model, chunk: int, after: float = -np.inf) -> Iterator[Step]:
    """The first keyframe with the calibration variables and their priors, then `chunk` keyframes at a time."""
    time = model.chain.time
    taken = int(np.searchsorted(time, after, side="right"))
    if taken == 0:
        yield _step(model, range(1))
    for begin in range(max(taken, 1), len(time), chunk):
        yield _step(model, range(begin, min(begin + chunk, len(time))))


def _step(model: _Model, keyframes: range) -> Step:
    chain = model.chain
    step = Step(
        time=float(chain.time[keyframes[-1]]),
        predict=partial(chain.predict, keyframes, lambda k, _: chain.initial[k]),
        keyframes=keyframes,
    )
    if keyframes.start == 0:
        _begin(model, step)
    chain.add(step)
    step.factors.extend(_vision_factor(model, keyframes))
    return step


def _begin(model: _Model, step: Step) -> None:
    """The calibration variables and their priors."""
    step.initial.insert(_HELMET_KEY, so3.to_gtsam(model.helmet_guess))
    step.initial.insert(_CAMERA_KEY, so3.to_gtsam(so3.identity()))
    step.initial.insert(_OFFSET_KEY, np.zeros(1))
    bias, helmet, camera, offset = model.parameters
    step.factors.extend(
        [
            vector_prior(bias, np.zeros(3)),
            rotation_prior(helmet),
            rotation_prior(camera),
            vector_prior(offset, np.zeros(1)),
        ]
    )


def _vision_factor(model: _Model, keyframes: range) -> list[Factor]:
    seen = [k for k in keyframes if model.vision[k] >= 0]
    if not seen:
        return []
    chain, rows = model.chain, model.vision[seen]
    rows_model = VisionAttitudeFactor(
        chain.time[seen], model.measured[rows], model.sqrt_information[rows], chain.gyro, model.platform
    )
    measurement = rows_model.on(
        [state(k) for k in seen],
        chain.bias_keys(seen),
        _CAMERA_KEY,
        _HELMET_KEY,
        _OFFSET_KEY,
        loss=model.loss,
    )
    return [Factor.of("vision", measurement)]


def _attitudes(model: _Model, keyframes: Sequence[int], values: gtsam.Values) -> Attitudes:
    """bRv at the vision frames' true times, stamp + time offset, on the gyro's clock."""
    seen = [k for k in keyframes if model.vision[k] >= 0]
    if not seen:
        return Attitudes(np.empty(0), np.empty((0, 4)))
    chain = model.chain
    stamps = chain.time[seen]
    at = stamps + float(values.atVector(_OFFSET_KEY)[0])
    iRv = so3.from_gtsam([values.atRot3(state(k)) for k in seen])
    bias = np.array([values.atVector(key) for key in chain.bias_keys(seen)])
    step = chain.gyro.increments(stamps, at)
    correction = np.einsum("nij,nj->ni", step.bias_jacobian, bias - chain.gyro.bias_hat)
    iRv_at = so3.compose(iRv, step.wxyz, so3.exp(correction))
    if model.platform is None:
        return Attitudes(at, iRv_at)
    return Attitudes(at, so3.multiply(so3.inverse(model.platform.attitude(at)), iRv_at))


def _advice(weights: Mapping[str, float]) -> str:
    """The motion that would make a weak direction observable."""
    strongest = {name.rsplit("_", 1)[0] if name != _OFFSET else name for name, w in weights.items() if abs(w) > 0.3}
    if {_CAMERA, _HELMET} <= strongest:
        return "camera and helmet mounts trade against each other: turn the platform about two axes while recording"
    if _CAMERA in strongest:
        return "the camera mount needs platform motion: turn the platform about two axes while recording"
    if _HELMET in strongest:
        return "the helmet mount needs head motion about two axes: nod and shake the head"
    if _OFFSET in strongest:
        return "the time offset needs faster head motion: turn the head back and forth within a second"
    return "the gyro bias needs a longer recording with vision"
