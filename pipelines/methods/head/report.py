"""Results of the head method: formulas, findings, figures, uses, validation, attitudes at gyro rate.

Frames: v helmet IMU, h markers, c camera, b platform. Methods page, section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, Mask
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.diagnostics.use import Applied, Line, Truth, Use
from alidade.pipelines.display.figure import AXES, COLORS, PALE, Figure, Plot
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import fixed_without_force
from alidade.pipelines.estimation.problem import Attitudes, Estimate, Findings
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods import Correction, Report
from alidade.pipelines.methods.formula import (
    Formula,
    apply,
    corrected_rates,
    gyro_rate,
    picture_time,
    symmetric_text,
    vector_text,
)
from alidade.pipelines.methods.head.parameters import CAMERA, HELMET, OFFSET, PLATFORM_BIAS, PLATFORM_SCALE, SENSITIVITY
from alidade.pipelines.methods.head.recording import HEAD_IMU, PLATFORM_IMU, HeadData
from alidade.pipelines.methods.triads import G, gyro_reading
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config

_PLATFORM_S = tuple(name for each in PLATFORM_SCALE for name in each.names)
_MOUNTS = *HELMET.names, *CAMERA.names


def formulas(parameters: Collection[str], _config: Config | None = None) -> list[Formula]:
    """Formulas of mounts, rates, attitude and time, with those gyro and clock errors that are parameters."""
    return [
        Formula("markers to helmet IMU", "vRh", "Exp(helmet_mount)", ()),
        Formula("platform to camera", "cRb", "Exp(camera_mount)", ()),
        Formula("rate of the helmet, rad/s in v", "w_iv", *gyro_rate(parameters)),
        *_platform_rate(parameters),
        Formula(
            "attitude of the helmet on the platform from a camera measurement cRh",
            "bRv",
            "inverse(cRb) * cRh * inverse(vRh)",
            ("cRh",),
        ),
        Formula(
            "time of that attitude on the gyro's clock, s", "time", picture_time({*parameters, OFFSET.name}), ("stamp",)
        ),
    ]


def _platform_rate(parameters: Collection[str]) -> list[Formula]:
    """Formula of the platform's rate, if errors of its gyro are parameters."""
    if not any(name in parameters for name in (*PLATFORM_BIAS.names, *_PLATFORM_S)):
        return []
    rate = f"platform_gyro - {vector_text(PLATFORM_BIAS.names, parameters)}"
    if any(name in parameters for name in _PLATFORM_S):
        rate = f"inverse({symmetric_text(_PLATFORM_S, parameters)}) * ({rate})"
    return [Formula("rate of the platform, rad/s in b", "w_ib", rate, ("platform_gyro",))]


def findings(data: HeadData, config: Config, _: Estimate) -> Findings:
    """Rows of `fixed_assumptions`: nuisance parameters that the recording cannot estimate, with the reason."""
    return {} if data.head_force is not None else fixed_without_force(SENSITIVITY, config, config.topic(HEAD_IMU))


def head_plots(data: HeadData, calibration: Calibration) -> list[Plot]:
    """Plots of the attitude bRv with that by vision, and their differences; none without a trajectory."""
    attitudes = calibration.estimate.attitudes
    if attitudes is None or len(attitudes.time) < 2:
        return []
    order = np.argsort(attitudes.time, kind="stable")
    attitudes = Attitudes(attitudes.time[order], attitudes.wxyz[order])
    seen = _from_vision(data, calibration, attitudes)
    plots = [_attitude(attitudes, seen), _difference(attitudes, seen)]
    error = _against_truth(data, calibration, attitudes, seen)
    return [error, *plots] if error else plots


def _from_vision(data: HeadData, calibration: Calibration, attitudes: Attitudes) -> Attitudes:
    """Attitudes bRv by single vision frames, with the estimated mounts and clock."""
    values = dict(zip(calibration.estimate.names, calibration.estimate.values.tolist(), strict=True))

    time = _picture_times(data, values)
    inside = _inside(attitudes, time)
    known = dict.fromkeys(_MOUNTS, 0.0) | values
    chosen = [each for each in formulas(known) if each.inputs in ((), ("cRh",))]
    return Attitudes(time[inside], apply(chosen, known, {"cRh": data.vision_wxyz[inside]})["bRv"])


def _attitude(attitudes: Attitudes, seen: Attitudes) -> Plot:
    out = Figure("rotation vector of bRv, deg", height=360)
    fused, vision = (np.rad2deg(so3.log(each.wxyz)) for each in (attitudes, seen))
    for i, axis in enumerate(AXES):
        out.points(seen.time, vision[:, i], f"vision {axis}", COLORS[i], 3, alpha=0.45)
    for i, axis in enumerate(AXES):
        out.line(attitudes.time, fused[:, i], f"fused {axis}", COLORS[i])
    return Plot(
        "Attitude of the helmet on the platform",
        "Lines: attitude bRv from gyros and vision together. Points: from vision alone, turned by the mounts found.",
        out,
    )


def _difference(attitudes: Attitudes, seen: Attitudes) -> Plot:
    delta = _delta(attitudes, seen)
    spread = robust_sigma(delta)
    out = Figure("vision minus fused, deg")
    for i, axis in enumerate(AXES):
        out.points(seen.time, delta[:, i], axis, COLORS[i], 3)
    out.y_range = (-6.0 * max(spread, 1e-3), 6.0 * max(spread, 1e-3))
    return Plot(
        "Vision against the fused attitude",
        f"Difference about the axes of the helmet IMU: {spread:.3g} deg per axis (standard deviation, from the "
        "median); outliers lie outside the axis.",
        out,
    )


def _against_truth(data: HeadData, calibration: Calibration, attitudes: Attitudes, seen: Attitudes) -> Plot | None:
    if data.truth_t is None or data.truth_wxyz is None or len(data.truth_t) < 2:
        return None
    truth = Attitudes(data.truth_t, data.truth_wxyz)
    without = ""
    if any(calibration.verdicts.get(name) in ("weak", "unobservable") for name in CAMERA.names):
        turn = _constant_turn(truth, attitudes)
        seen, attitudes = (Attitudes(a.time, so3.multiply(turn, a.wxyz)) for a in (seen, attitudes))
        without = " less its constant part on the platform's side, which is the camera mount that is not known"
    errors = {"vision alone": _error(truth, seen), "fused": _error(truth, attitudes)}
    out = Figure("attitude error, deg")
    for (name, (time, angle)), color in zip(errors.items(), (PALE, COLORS[1]), strict=True):
        out.points(time, angle, name, color, 3)
    said = ", ".join(f"{name} {float(np.sqrt((angle**2).mean())):.3g} deg RMS" for name, (_, angle) in errors.items())
    return Plot("Attitude against the truth", f"Angle between attitude and truth{without}: {said}.", out)


def _constant_turn(truth: Attitudes, attitudes: Attitudes) -> Array:
    """Rotation (4,) that aligns attitudes with the truth if multiplied from the left (Markley 2007)."""
    inside = _inside(truth, attitudes.time)
    at = so3.interpolate(truth.time, truth.wxyz, attitudes.time[inside])
    turns = so3.multiply(at, so3.inverse(attitudes.wxyz[inside]))
    return np.linalg.eigh(turns.T @ turns)[1][:, -1]


def _inside(attitudes: Attitudes, time: Array) -> Mask:
    return (time >= attitudes.time[0]) & (time <= attitudes.time[-1])


def _error(truth: Attitudes, attitudes: Attitudes) -> tuple[Array, Array]:
    """Times within the truth's, s, and angles between truth and attitudes there, deg."""
    inside = _inside(truth, attitudes.time)
    some = Attitudes(attitudes.time[inside], attitudes.wxyz[inside])
    return some.time, np.linalg.norm(_delta(truth, some), axis=1)


def _delta(attitudes: Attitudes, others: Attitudes) -> Array:
    """Rotation vectors (n, 3), deg, from interpolated attitudes to others at the others' times."""
    at = so3.interpolate(attitudes.time, attitudes.wxyz, others.time)
    return np.rad2deg(so3.local(at, others.wxyz))


# How long the gyros carry the attitude, s, and how far from that frames may lie.
_SPAN, _SLACK = 1.0, 0.25
# A window that neither way explains, this many times worse than is usual, ends or begins with a vision outlier.
_OUTLYING = 5.0


@dataclass(frozen=True)
class _Applied:
    """A calibration applied to a recording: mounts, corrected gyros, picture times (n,), s, on the gyro's clock."""

    vRh: Array
    cRb: Array
    helmet: GyroPath
    platform: GyroPath | None
    time: Array

    @classmethod
    def of(cls, data: HeadData, values: Mapping[str, float]) -> _Applied:
        """Apply parameter values to a recording; missing ones are zero."""
        known = dict.fromkeys(_MOUNTS, 0.0) | dict(values)
        mounts = apply([each for each in formulas(known) if not each.inputs], known, {})
        helmet, platform = helmet_gyro(data, known), _platform_gyro(data, known)
        return cls(mounts["vRh"], mounts["cRb"], helmet, platform, _picture_times(data, known))


def _picture_times(data: HeadData, values: Mapping[str, float]) -> Array:
    """Times of the pictures on the gyro's clock, (n,) s."""
    return apply(formulas(values)[-1:], {"first_stamp": data.vision_t[0], **values}, {"stamp": data.vision_t})["time"]


def validate(data: HeadData, config: Config, values: Mapping[str, float]) -> tuple[Validation, ...]:
    """Errors of attitudes propagated by the gyros, against vision and, where it is known, against the truth.

    Raises InputError when no two vision frames are about a second apart within the gyros' record.
    """
    ways = [_Applied.of(data, each) for each in ({}, values)]
    start, stop = _windows(data, ways)
    carried = [_carried_on(data, way, start, stop) for way in ways]
    seen = data.vision_wxyz[stop]
    by_vision = [so3.local(so3.compose(way.cRb, bRv, way.vRh), seen) for way, bRv in zip(ways, carried, strict=True)]
    time = data.vision_t[stop]
    out = [_validation("against vision", time, by_vision, _vision_noise(data, config, start, stop))]
    if data.truth_t is not None and data.truth_wxyz is not None:
        at = [way.time[stop] for way in ways]
        inside = (np.minimum(*at) >= data.truth_t[0]) & (np.maximum(*at) <= data.truth_t[-1])
        truth = [so3.interpolate(data.truth_t, data.truth_wxyz, t[inside]) for t in at]
        by_truth = [so3.local(bRv[inside], true) for bRv, true in zip(carried, truth, strict=True)]
        if inside.any():
            out.append(_validation("against the truth", time[inside], by_truth))
    return tuple(out)


def _windows(data: HeadData, ways: Sequence[_Applied]) -> tuple[Index, Index]:
    """Indices of start and stop vision frames of 1-s windows within the gyros' records."""
    t = data.vision_t
    start = np.arange(len(t))
    after = np.clip(np.searchsorted(t, t + _SPAN), 1, len(t) - 1)
    stop = np.where(t[after] - t - _SPAN < t + _SPAN - t[after - 1], after, after - 1)
    gyros = [g for g in (data.head_t, data.platform_t) if g is not None]
    first, last = max(g[0] for g in gyros), min(g[-1] for g in gyros)
    use = (np.abs(t[stop] - t - _SPAN) <= _SLACK) & (t + _SPAN <= t[-1])
    for way in ways:
        use &= (way.time >= first) & (way.time[stop] <= last)
    if not use.any():
        raise InputError("vision: no two frames about 1 s apart within the gyros' record; validation needs some")
    return start[use], stop[use]


def _carried_on(data: HeadData, way: _Applied, start: Index, stop: Index) -> Array:
    """Attitudes bRv (n, 4) at the `stop` frames, propagated by the gyros from vision at the `start` frames."""
    t0, t1 = way.time[start], way.time[stop]
    bRv = so3.compose(so3.inverse(way.cRb), data.vision_wxyz[start], so3.inverse(way.vRh))
    bRv = so3.multiply(bRv, way.helmet.increments(t0, t1).wxyz)
    return bRv if way.platform is None else so3.multiply(so3.inverse(way.platform.increments(t0, t1).wxyz), bRv)


def _validation(against: str, time: Array, errors: Sequence[Array], note: str = "") -> Validation:
    """Build a validation of propagated attitudes without windows with vision outliers."""
    lengths = np.minimum(*(np.linalg.norm(e, axis=1) for e in errors))
    good = lengths <= _OUTLYING * np.median(lengths)
    spoilt = int((~good).sum())
    notes = [note, f"{spoilt} of {len(good)} windows left out for vision outliers" if spoilt else ""]
    before, after = (e[good] for e in errors)
    name = f"attitude after 1 s on gyros, {against}"
    return Validation(name, "rad", time[good], before, after, "; ".join(filter(None, notes)))


def _vision_noise(data: HeadData, config: Config, start: Index, stop: Index) -> str:
    """Phrase: part of the error that the noise of the two vision frames causes."""
    if config.noise.vision_attitude is not None:
        variance = 6.0 * config.noise.vision_attitude**2
    elif data.vision_cov is not None:
        trace = np.trace(data.vision_cov, axis1=1, axis2=2)
        variance = float((trace[start] + trace[stop]).mean())
    else:
        return ""
    return f"noise of the two vision frames makes up {np.rad2deg(np.sqrt(variance)):.2g} deg RMS"


_YAW_DEG = np.linspace(-90.0, 90.0, 37)
_RATE_DEG = 100.0
_OUTAGE_S = np.linspace(0.0, 60.0, 31)
_EZ = np.array([0.0, 0.0, 1.0])


def uses(_true: Truth, _config: Config, noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a head calibration: attitude over head azimuth, and over the time since the last picture."""
    density, walk = noise.get("gyro_density", 0.0), noise.get("gyro_bias_walk", 0.0)
    gained = density**2 * _OUTAGE_S + walk**2 * _OUTAGE_S**3 / 3.0
    attitude = Use(
        "attitude",
        "Helmet attitude from the camera",
        _YAW_DEG,
        "head azimuth, deg",
        "attitude error, deg",
        "deg",
        float(np.degrees(1.0)),
        (Line("at rest", _by_vision(0.0)), Line(f"turning at {_RATE_DEG:g} deg/s", _by_vision(_RATE_DEG), "series1")),
        "e = Log(bRvᵀ (cRb)ᵀ cRh (vRh)ᵀ) + ω Δt; cRh as measured by true mounts and vision scale",
        "head level; rotation angle of the error",
        "helmet attitude, ±90 deg of azimuth",
    )
    outage = Use(
        "outage",
        "Helmet attitude while the camera sees nothing",
        _OUTAGE_S,
        "time since the last picture, s",
        "attitude error gained, deg",
        "deg",
        float(np.degrees(1.0)),
        (Line("head at rest", _outage, noise=gained),),
        "e = t (w_iv − ω); N(t) = N² t + K² t³/3",
        "against inertial space, head at rest, z up",
        "attitude gained in 10 s",
        at=5,
    )
    return attitude, outage


def _by_vision(rate_deg: float) -> Callable[[Applied, Truth], Array]:
    bRv = so3.exp(np.deg2rad(_YAW_DEG)[:, None] * _EZ)

    def compute(applied: Applied, true: Truth) -> Array:
        vRh, cRb = (so3.exp(true.xyz(name))[..., None, :] for name in ("helmet_mount", "camera_mount"))
        first = so3.multiply(cRb, vRh)
        seen = so3.log(so3.compose(so3.inverse(first), cRb, bRv, vRh))
        scaled = (1.0 + true.get("vision_scale"))[..., None, None] * seen
        found = applied(cRh=so3.multiply(first, so3.exp(scaled)))["bRv"]
        late = true.get("time_offset") - applied.values.get("time_offset", 0.0)
        return so3.local(bRv, found) + np.deg2rad(rate_deg) * late[..., None, None] * _EZ

    return compute


def _outage(applied: Applied, true: Truth) -> Array:
    rest, force = np.zeros((1, 3)), G * _EZ[None]
    return np.asarray(applied(gyro=gyro_reading(true, rest, force), accel=force)["w_iv"] * _OUTAGE_S[:, None])


CARDS = {
    "Mounts": (
        ("Markers to helmet IMU", "deg", ("helmet_mount_x", "helmet_mount_y", "helmet_mount_z")),
        ("Platform to camera", "deg", ("camera_mount_x", "camera_mount_y", "camera_mount_z")),
    ),
    "Helmet gyro": (
        ("Bias", "deg/s", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
        ("Scale error", "", ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")),
    ),
    "Timing and camera": (
        ("Delay of the pictures", "ms", ("time_offset",)),
        ("Clock skew", "", ("clock_skew",)),
        ("Scale of vision's angles", "", ("vision_scale",)),
    ),
}
REPORT = Report(
    uses=uses,
    cards=CARDS,
    formulas=formulas,
    corrections=(
        Correction(topic=HEAD_IMU, inputs={"gyro": "gyro", "accel": "accel"}, results={"gyro": "w_iv"}),
        Correction(topic=PLATFORM_IMU, inputs={"gyro": "platform_gyro"}, results={"gyro": "w_ib"}),
    ),
    findings=findings,
    figures=head_plots,
    validate=validate,
)


def at_gyro_rate(data: HeadData, attitudes: Attitudes, values: Mapping[str, float]) -> Attitudes:
    """Attitudes bRv at the samples of the helmet's gyro, from the first known attitude to the last; see `carried`."""
    if not len(attitudes.time):
        return attitudes
    at = data.head_t[(data.head_t >= attitudes.time.min()) & (data.head_t <= attitudes.time.max())]
    return Attitudes(at, carried(data, attitudes, values, at))


def carried(data: HeadData, attitudes: Attitudes, values: Mapping[str, float], at: Array) -> Array:
    """Attitudes bRv (n, 4) at times on the gyro's clock, propagated from the nearest known ones before and after.

    Args:
        data: the recording.
        attitudes: bRv that are known, one at least, within the gyros' records.
        values: parameters by name, of which the gyros' errors are applied.
        at: (n,) s; before the first and after the last attitude they are carried from that one alone.
    """
    time, first = np.unique(attitudes.time, return_index=True)
    return between(helmet_gyro(data, values), _platform_gyro(data, values), time, attitudes.wxyz[first], at)


def between(helmet: GyroPath, platform: GyroPath | None, time: Array, bRv: Array, at: Array) -> Array:
    """Attitudes bRv (n, 4) at times (n,), s, propagated by the gyros from known ones, whatever the turns between.

    Args:
        helmet, platform: gyros; without a second one the platform is at rest.
        time: (k,) of the known attitudes, s, increasing.
        bRv: (k, 4); before the first and after the last one they are carried from that one alone.
        at: (n,) s.
    """

    def by_gyros(t: Array) -> tuple[Array, Array]:
        return so3.identity(len(t)) if platform is None else platform.attitude(t), helmet.attitude(t)

    (base, own), (base_at, own_at) = by_gyros(time), by_gyros(at)
    frame = so3.compose(base, bRv, so3.inverse(own))
    if len(time) > 1:
        frame = so3.interpolate(time, frame, np.clip(at, time[0], time[-1]))
    return so3.compose(so3.inverse(base_at), frame, own_at)


def helmet_gyro(data: HeadData, values: Mapping[str, float]) -> GyroPath:
    """Helmet gyro without dead band, corrected by its formula; errors with unmeasured causes remain."""
    rates = corrected_rates(data.head_t, data.head_gyro, data.head_force, data.temperature, values)
    return GyroPath(data.head_t, rates)


def _platform_gyro(data: HeadData, values: Mapping[str, float]) -> GyroPath | None:
    """Platform gyro minus its errors; None for a platform at rest."""
    if data.platform_t is None or data.platform_gyro is None:
        return None
    own = _platform_rate(values)
    measured = {"platform_gyro": data.platform_gyro}
    rate = apply(own, values, measured)["w_ib"] if own else data.platform_gyro
    return GyroPath(data.platform_t, rate)
