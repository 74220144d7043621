"""Results of the los method: formulas, findings, figures, uses, validation.

Frames: m gyro (IMU), b carrier, l line of sight. Methods page, section 1.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, Mask, interpolated
from alidade.factors.gimbal import WINDOWS, GimbalPath, command
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.diagnostics.use import Applied, Line, Truth, Use
from alidade.pipelines.display.figure import AXES, COLORS, Figure, Plot
from alidade.pipelines.display.units import rounded
from alidade.pipelines.estimation.camera_clock import Clock
from alidade.pipelines.estimation.parameters import fixed_without_force
from alidade.pipelines.estimation.problem import Estimate, Findings
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods import Report
from alidade.pipelines.methods.formula import (
    Formula,
    apply,
    axis_angles,
    corrected_rates,
    gyro_rate,
    passive,
    picture_time,
)
from alidade.pipelines.methods.los.initial_values import (
    camera,
    carried_errors,
    los_direction,
    los_error,
    select_pictures,
)
from alidade.pipelines.methods.los.parameters import ANGLES, DELAY, ONCE_PER_TURN, SENSITIVITY, TIME_OFFSET
from alidade.pipelines.methods.los.recording import JOINTS, LosData
from alidade.pipelines.methods.triads import G, gyro_reading, rotated_imu
from alidade.pipelines.recording.topics import IMU
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given


def formulas(parameters: Collection[str], _config: Config | None = None) -> list[Formula]:
    """Formulas of mounting, rate, camera and clock, with those sensor errors that are among the parameters."""
    angles = axis_angles(JOINTS, ONCE_PER_TURN.names, DELAY.names[0], parameters)
    azimuth, elevation = [angle.name for angle in angles] or JOINTS
    rate, inputs = gyro_rate(parameters)
    turns = {
        "camera_roll": "Ry(camera_roll)",
        "collimation": "Rz(collimation)",
        "": f"Rx({elevation} + delta_px)",
        "axis_nonperpendicularity": "Ry(axis_nonperpendicularity)",
    }
    camera = [turn for name, turn in turns.items() if not name or name in parameters]
    found = [
        Formula(
            "IMU to carrier, Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise",
            "M",
            "Rz(delta_z) * Rx(-delta_gx) * Ry(-delta_gy)",
            (),
        ),
        Formula("rate of the carrier, rad/s", "w_b", f"M * ({rate})", inputs),
        *angles,
        Formula("carrier to line of sight", "lRb", " * ".join([*camera, f"Rz({azimuth})"]), JOINTS),
        Formula("a direction d_b of the carrier in the line-of-sight frame", "d_l", "lRb * d_b", (*JOINTS, "d_b")),
    ]
    if "delta_pz" in parameters:
        found.insert(0, Formula("azimuth zero", "delta_z", "delta_pz - delta_gz", ()))
    if "los_scale" in parameters:
        found.append(
            Formula(
                "LOS error, rad, from the one measured",
                "los_error",
                "measured_error / (1 + los_scale)",
                ("measured_error",),
            )
        )
    if TIME_OFFSET.name in parameters or "clock_skew" in parameters:
        found.append(Formula("time of a picture on the gyro's clock, s", "time", picture_time(parameters), ("stamp",)))
    return found


def findings(data: LosData, config: Config, _: Estimate) -> Findings:
    """Rows of `fixed_assumptions`: nuisance parameters that the recording cannot estimate, with the reason."""
    return {} if data.force is not None else fixed_without_force(SENSITIVITY, config, config.topic(IMU))


_AXES = ("phx", "phz")
_MRAD = 1e3
_URAD = 1e6
# What is left is shown out to so many times its usual size; outliers lie beyond.
_SHOWN = 6.0


def los_plots(data: LosData, calibration: Calibration) -> list[Plot]:
    """Plots of LOS errors, measured and predicted, and their difference with and without the mounting angles."""
    config = calibration.config
    estimate = calibration.estimate
    values = calibration.problem.numbers(estimate)
    sigma = first_given(config.noise.los_error, DEFAULT_NOISE.los_error)
    margin = WINDOWS[0] if TIME_OFFSET.name in values else 0.0
    rows, starts, _ = select_pictures(data, np.full(len(data.image_t), sigma), margin)
    time, measured = data.image_t[rows], data.error[rows]
    chains = np.split(np.arange(len(rows)), np.flatnonzero(starts)[1:])
    unmounted = {name: value for name, value in values.items() if name not in ANGLES}
    gyro = GyroPath(data.gyro_t, rates(data, values))
    with_angles, without = (
        np.concatenate([_predicted(data, gyro, time[chain], measured[chain], v) for chain in chains])
        for v in (values, unmounted)
    )
    return [
        _measured_and_predicted(time, measured[:, :2], with_angles),
        _left(time, measured[:, :2] - without, measured[:, :2] - with_angles),
    ]


def _predicted(data: LosData, gyro: GyroPath, time: Array, measured: Array, values: Mapping[str, float]) -> Array:
    """LOS errors phx, phz (n, 2), rad, of one target's pictures, predicted from the first picture."""
    names = tuple(name for name in ANGLES if name in values)
    at = taken(data, time, values)
    cRm = camera(angles(data, at, values), np.array([values[name] for name in names]), names)
    scale = np.array([1.0 + values.get("los_scale", 0.0)] * 2 + [1.0])
    target_rate = np.array([values.get("target_rate_x", 0.0), 0.0, values.get("target_rate_z", 0.0)])
    return scale[:2] * carried_errors(at, cRm, measured / scale, gyro, target_rate)


def _measured_and_predicted(time: Array, measured: Array, predicted: Array) -> Plot:
    out = Figure("LOS error, mrad")
    for i, axis in enumerate(_AXES):
        out.points(time, _MRAD * measured[:, i], f"{axis} measured", COLORS[i], 3, alpha=0.45)
        out.line(time, _MRAD * predicted[:, i], f"{axis} predicted", COLORS[i])
    reach = 1.2 * _MRAD * max(float(np.abs(predicted).max()), _SHOWN * float(robust_sigma(measured - predicted)))
    middle = _MRAD * float(np.median(measured))
    out.y_range = (middle - reach, middle + reach)
    return Plot(
        "LOS error measured and predicted",
        "Points: where the camera saw the target. Lines: where it should be by gyro, gimbal and calibration alone, "
        "from the first picture of a target on.",
        out,
    )


def _left(time: Array, without: Array, compensated: Array) -> Plot:
    out = Figure("measured less predicted, µrad")
    for i, axis in enumerate(_AXES):
        out.points(time, _URAD * without[:, i], f"{axis}, mounting angles zero", COLORS[4 + 2 * i], 3)
    for i, axis in enumerate(_AXES):
        out.points(time, _URAD * compensated[:, i], f"{axis}, mounting angles found", COLORS[i], 3)
    spread = [_URAD * robust_sigma(errors) for errors in (without, compensated)]
    largest = [1.1 * _URAD * float(np.abs(errors).max(initial=0.0)) for errors in (without, compensated)]
    reach = max(*(min(_SHOWN * s, most) for s, most in zip(spread, largest, strict=True)), 1.0)
    out.y_range = (-reach, reach)
    return Plot(
        "What gyro, gimbal and calibration leave of the LOS error",
        f"phx is the angle to the target below, phz to the right. Per axis {rounded(spread[0], 3)} µrad with the "
        f"mounting angles zero, {rounded(spread[1], 3)} µrad with those found (standard deviations, from the median). "
        "The gyro's noise adds up from a target's first picture on, so what is left may wander; it should not follow "
        "the sway.",
        out,
    )


# The replayed gimbal feeds back on its own commands; each pass is better by the carrier's sway, about a tenth.
_PASSES = 6
# Pictures further from the median of so many neighbours than so many times what is usual are outliers.
_NEIGHBOURS, _OUTLYING = 9, 8.0


def validate(data: LosData, config: Config, values: Mapping[str, float]) -> tuple[Validation, ...]:
    """LOS error since each target's first picture, before and after compensation; again without steady drift.

    Raises InputError when too few pictures are within the records of gyro and gimbal.
    """
    sigma = first_given(config.noise.los_error, DEFAULT_NOISE.los_error)
    rows, starts, _ = select_pictures(data, np.full(len(data.image_t), sigma), 0.0)
    chains = np.split(rows, np.flatnonzero(starts)[1:])
    good = [chain[_near_neighbours(data.error[chain, :2])] for chain in chains]
    spoilt = len(rows) - sum(len(chain) for chain in good)
    pairs = [(data.error[chain, :2], _replayed(data, chain, values)) for chain in good]
    before, after = ([errors - errors[0] for errors in series] for series in zip(*pairs, strict=True))
    times = [data.image_t[chain] for chain in good]
    left_out = f"{spoilt} of {len(rows)} LOS errors left out as outliers" if spoilt else ""
    bias = "a gyro bias that has changed since the calibration is still in it"
    steady = [[_without_drift(t, e) for t, e in zip(times, errors, strict=True)] for errors in (before, after)]
    t, found = np.concatenate(times), []
    for name, (was, now), notes in (
        ("line of sight", (before, after), (bias, left_out)),
        ("line of sight, steady drift removed", steady, (left_out,)),
    ):
        errors = np.concatenate(was), np.concatenate(now)
        found.append(Validation(name, "rad", t, *errors, "; ".join(filter(None, notes)), micro=True))
    return tuple(found)


def _replayed(data: LosData, chain: Index, values: Mapping[str, float]) -> Array:
    """LOS errors phx, phz (n, 2), rad, of one target if compensated commands had driven the gimbal."""
    t = data.image_t[chain]
    inside = (data.gyro_t > t[0]) & (data.gyro_t < t[-1])
    at = np.concatenate([t[:1], data.gyro_t[inside], t[-1:]])
    gyro, true = (interpolated(at, data.gyro_t, samples) for samples in (data.gyro, rates(data, values)))
    gimbal = GimbalPath(data.gimbal_t, data.gimbal)
    recorded = gimbal.at(at)
    px = values.get("delta_px", 0.0)
    mounts = [each for each in formulas(values) if not each.inputs]
    rate = so3.rotate(apply(mounts, values, {})["M"], true)
    uncompensated = command(gyro, recorded)
    extra = np.zeros_like(recorded)
    for _ in range(_PASSES):
        difference = command(rate, recorded + extra + [0.0, px]) - uncompensated
        steps = 0.5 * np.diff(at)[:, None] * (difference[1:] + difference[:-1])
        extra = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    was = gimbal.at(t)
    would = was + interpolated(t, at, extra)
    cRc = so3.multiply(_camera_attitude(would, px), so3.inverse(_camera_attitude(was, px)))
    return los_error(so3.rotate(cRc, los_direction(data.error[chain])))


def _camera_attitude(gimbal: Array, px: float) -> Array:
    """Camera attitude cRb = Rx(eps + px) Rz(eta), (n, 4)."""
    return so3.multiply(passive(0, gimbal[:, 1] + px), passive(2, gimbal[:, 0]))


def _near_neighbours(error: Array) -> Mask:
    """Mask of LOS errors (n, 2) near the median of their neighbours."""
    if len(error) < _NEIGHBOURS:
        return np.ones(len(error), dtype=bool)
    half = _NEIGHBOURS // 2
    padded = np.pad(error, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    around = np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS, axis=0)
    off = np.linalg.norm(error - np.median(around, axis=2), axis=1)
    return np.asarray(off <= _OUTLYING * np.median(off))


def _without_drift(t: Array, error: Array) -> Array:
    """Subtract a fitted straight line from errors."""
    line = np.stack([np.ones_like(t), t - t.mean()], axis=1)
    return np.asarray(error - line @ np.linalg.lstsq(line, error)[0])


def rates(data: LosData, values: Mapping[str, float]) -> Array:
    """Corrected rates (N, 3), rad/s, at the gyro's samples; errors with unmeasured causes remain."""
    return corrected_rates(data.gyro_t, data.gyro, data.force, data.temperature, values)


def taken(data: LosData, stamps: Array, values: Mapping[str, float]) -> Array:
    """Exposure times (n,), s, of stamps, limited to the records of gyro and gimbal."""
    clock = Clock(float(data.image_t[0]), values.get("time_offset", 0.0), values.get("clock_skew", 0.0))
    delay = values.get("encoder_delay", 0.0)
    first = max(data.gyro_t[0], data.gimbal_t[0] + delay)
    last = min(data.gyro_t[-1], data.gimbal_t[-1] + delay)
    return np.clip(clock.exposed(stamps), first, last)


def angles(data: LosData, at: Array, values: Mapping[str, float]) -> Array:
    """Corrected azimuth and elevation (n, 2), rad, at true times."""
    read = GimbalPath(data.gimbal_t, data.gimbal).at(at - values.get("encoder_delay", 0.0))
    s, c = np.array([values.get(name, 0.0) for name in ONCE_PER_TURN.names]).reshape(2, 2).T
    return np.asarray(read - s * np.sin(read) - c * np.cos(read))


_AZIMUTH_DEG = np.linspace(-90.0, 90.0, 37)
_ELEVATIONS_DEG = (-30.0, 15.0, 60.0)
# Of the stabilisation: elevation, and rate of the carrier.
_ELEVATION_DEG, _RATE_DEG = 20.0, 10.0
_FORCE = np.array([[0.0, 0.0, G]])


def uses(_true: Truth, _config: Config, _noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of a los calibration: pointing over azimuth and elevation, and residual LOS rate under stabilisation."""
    pointing = Use(
        "pointing",
        "Line of sight against the IMU",
        _AZIMUTH_DEG,
        "azimuth, deg",
        "pointing error, mrad",
        "mrad",
        1e3,
        tuple(Line(f"elevation {e:.0f} deg", _pointing(e), f"series{i}") for i, e in enumerate(_ELEVATIONS_DEG)),
        "e = (v_x, v_z)/v_y, v = cRm_true (cRm_applied)ᵀ e_y, cRm = lRb M of the formulas",
        "direction of the optical axis in the IMU's frame, cross-elevation and elevation together",
        "pointing, any azimuth and elevation",
    )
    stabilisation = Use(
        "stabilisation",
        "Line-of-sight rate left by stabilisation",
        _AZIMUTH_DEG,
        "azimuth, deg",
        "residual LOS rate, mrad/s",
        "mrad/s",
        1e3,
        tuple(Line(f"carrier about {axis}", _stabilisation(i), axis) for i, axis in enumerate(AXES)),
        "e = (ω_x, ω_z) of ω_l = Rx(ε + px)(Rz(η) w_b + η' e_z) + ε' e_x; ε', η' commanded with applied M, px, gyro",
        f"carrier turning at {_RATE_DEG:g} deg/s about one axis, elevation {_ELEVATION_DEG:g} deg",
        f"LOS rate, carrier at {_RATE_DEG:g} deg/s",
    )
    return pointing, stabilisation


def _imu_to_carrier(true: Truth) -> Array:
    """Mounting rotation M (..., 4) from IMU to carrier."""
    z = true.get("delta_z") if "delta_z" in true else true.get("delta_pz") - true.get("delta_gz")
    return so3.compose(passive(2, z), passive(0, -true.get("delta_gx")), passive(1, -true.get("delta_gy")))


def _camera(true: Truth, azimuth: Array, elevation: Array) -> Array:
    """Camera attitude cRm (..., U, 4) at encoder readings (U,), rad."""
    one = {name: true.get(name)[..., None] for name in (*ONCE_PER_TURN.names, *_TURNS)}
    angles = []
    for reading, (sine, cosine) in ((azimuth, ONCE_PER_TURN.names[:2]), (elevation, ONCE_PER_TURN.names[2:])):
        angles.append(reading - one[sine] * np.sin(reading) - one[cosine] * np.cos(reading))
    return so3.compose(
        passive(1, one["camera_roll"]),
        passive(2, one["collimation"]),
        passive(0, angles[1] + one["delta_px"]),
        passive(1, one["axis_nonperpendicularity"]),
        passive(2, angles[0]),
        _imu_to_carrier(true)[..., None, :],
    )


_TURNS = ("camera_roll", "collimation", "delta_px", "axis_nonperpendicularity")


def _pointing(elevation_deg: float) -> Callable[[Applied, Truth], Array]:
    azimuth = np.deg2rad(_AZIMUTH_DEG)
    elevation = np.full_like(azimuth, np.deg2rad(elevation_deg))

    def compute(applied: Applied, true: Truth) -> Array:
        found = applied(azimuth=azimuth, elevation=elevation)
        axis = so3.rotate(so3.inverse(so3.multiply(found["lRb"], found["M"])), np.array([0.0, 1.0, 0.0]))
        v = so3.rotate(_camera(true, azimuth, elevation), axis)
        return np.stack([np.arctan2(v[..., 0], v[..., 1]), np.arctan2(v[..., 2], v[..., 1])], axis=-1)

    return compute


def _stabilisation(axis: int) -> Callable[[Applied, Truth], Array]:
    azimuth, elevation = np.deg2rad(_AZIMUTH_DEG), np.deg2rad(_ELEVATION_DEG)
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    w = np.deg2rad(_RATE_DEG) * np.eye(3)[axis : axis + 1]

    def compute(applied: Applied, true: Truth) -> Array:
        found = applied(gyro=gyro_reading(true, w, _FORCE), accel=_FORCE)["w_b"]
        real = so3.rotate(_imu_to_carrier(true)[..., None, :], w)
        elevation_rate = -(cosine * found[..., 0] + sine * found[..., 1])
        forward = cosine * found[..., 1] - sine * found[..., 0]
        azimuth_rate = np.tan(elevation + applied.values.get("delta_px", 0.0)) * forward - found[..., 2]
        angle = elevation + true.get("delta_px")[..., None]
        x = cosine * real[..., 0] + sine * real[..., 1] + elevation_rate
        z = np.cos(angle) * (real[..., 2] + azimuth_rate) - np.sin(angle) * (
            cosine * real[..., 1] - sine * real[..., 0]
        )
        return np.stack([x, z], axis=-1)

    return compute


CARDS = {
    "Mounting": (
        ("Camera on the gimbal, elevation", "deg", ("delta_px",)),
        ("IMU on the carrier", "deg", ("delta_gx", "delta_gy", "delta_gz")),
        ("Azimuth, camera minus IMU", "deg", ("delta_z", "delta_pz")),
    ),
    "Gyro and timing": (
        ("Gyro bias", "deg/h", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
        ("Delay of the pictures", "ms", ("time_offset",)),
        ("Delay of the encoders", "ms", ("encoder_delay",)),
    ),
    "Gimbal geometry": (
        ("Axes and camera", "deg", ("axis_nonperpendicularity", "collimation", "camera_roll")),
        ("Scale of the LOS error", "", ("los_scale",)),
    ),
}
REPORT = Report(
    uses=uses,
    cards=CARDS,
    formulas=formulas,
    corrections=rotated_imu("carrier", "w_b", "M"),
    findings=findings,
    figures=los_plots,
    validate=validate,
    residual_names={
        "los": ("phx, angle to the target below", "phz, angle to the target to the right", "roll of the picture")
    },
)
