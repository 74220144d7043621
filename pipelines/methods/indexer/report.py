"""Results of the indexer method: formulas, figures, uses, validation.

Frames: n level, b base, t platform, m IMU on it. Methods page, section 2.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import cycle

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import EARTH_RATE
from alidade.factors.gyro import symmetric
from alidade.factors.indexer import IndexerAverageFactor
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.diagnostics.use import Applied, Line, Truth, Use
from alidade.pipelines.display.figure import AXES, COLORS, Figure, Plot
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import Report
from alidade.pipelines.methods.formula import Formula, axis_angles, gyro_rate, passive
from alidade.pipelines.methods.indexer.model import carrier
from alidade.pipelines.methods.indexer.parameters import (
    BIAS,
    DELAY,
    ENCODER,
    EPSILON,
    ERRORS,
    ONCE_PER_TURN,
    THETA,
    several,
)
from alidade.pipelines.methods.indexer.published import half_differences
from alidade.pipelines.methods.indexer.recording import IndexerConfig, IndexerData
from alidade.pipelines.methods.indexer.windows import Group, axis_motion, groups_of
from alidade.pipelines.methods.temperature import FIRST, GYRO_SLOPE
from alidade.pipelines.methods.triads import gyro_reading, rotated_imu
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config

_JOINT_NAMES = ("outer", "inner")


def formulas(parameters: Collection[str], _config: Config | None = None) -> list[Formula]:
    """Formulas of mounting, rate and attitude, with those sensor errors that are among the parameters."""
    angles = axis_angles(_JOINT_NAMES, ONCE_PER_TURN.names, DELAY.names[0], parameters)
    outer, inner = [angle.name for angle in angles] or _JOINT_NAMES
    rate, inputs = gyro_rate(parameters)
    tilt = "Exp(axis_nonperpendicularity ey) * " if "axis_nonperpendicularity" in parameters else ""
    return [
        Formula(
            "platform to IMU, Rx(a) = transpose(Exp(a ex)), Ry and Rz likewise",
            "mRt",
            "Rx(theta_x) * Ry(theta_y) * Rz(theta_z)",
            (),
        ),
        Formula("rate of the platform, rad/s", "w_it", f"inverse(mRt) * ({rate})", inputs),
        *angles,
        Formula(
            "platform to base, from the encoders' angles",
            "bRt",
            f"Exp({outer} ex) * {tilt}Exp({inner} ez)",
            ("outer", "inner"),
        ),
        Formula(
            "attitude of the carrier from that of the IMU",
            "nRb",
            "nRm * mRt * inverse(bRt)",
            ("outer", "inner", "nRm"),
        ),
    ]


_ARCSEC = np.rad2deg(1.0) * 3600.0


def indexer_plots(data: IndexerData, calibration: Calibration) -> list[Plot]:
    """Figures of the method for which the recording has data."""
    config = calibration.config
    estimate = calibration.estimate
    values = calibration.problem.numbers(estimate)
    turning = [g for g in groups_of(data, config, axis_motion(data)) if g.position is not None]
    plots = [_misfit(turning, values), _contributions(turning, values)]
    half = _half_differences(data, values)
    if half is not None:
        plots.insert(0, half)
    if data.attitude is not None:
        plots.insert(0, _attitude(data, config, values))
    return plots


def _half_differences(data: IndexerData, values: dict[str, float]) -> Plot | None:
    """Plot each position's half difference across its axis, before and after compensation by theta."""
    try:
        found = half_differences(data)
    except InputError:
        return None
    out = Figure("across the axis, arcsec", x_title="position")
    rows: list[list[float]] = []
    for name, theta, color in (
        ("as measured", np.zeros(3), COLORS[6]),
        ("compensated", several(values, THETA), COLORS[0]),
    ):
        labels, across = [], []
        for half in found:
            in_t = so3.rotate(so3.from_angles(theta), half.rate) / np.linalg.norm(half.rate) * _ARCSEC
            for axis in (1, 2) if half.axis == "outer" else (0, 1):
                labels.append(f"{half.position} {AXES[axis]}t")
                across.append(float(in_t[axis]))
        out.x_labels = tuple(labels)
        out.bars(across, name, color, (len(rows), 2))
        rows.append(across)
    return Plot(
        "Half differences",
        "Half the difference of the forward and the backward mean rate: components across the axis in the platform's "
        f"frame. After compensation the largest is {np.abs(rows[1]).max():.3g} arcsec.",
        out,
    )


def _misfit(turning: list[Group], values: dict[str, float]) -> Plot:
    """Plot mean gyro rate minus prediction over each turn or move, as an angle of the axis."""
    out = Figure("gyro less encoders, arcsec")
    time, error = misfit(turning, values)
    for i, axis in enumerate(AXES):
        out.points(time, error[:, i] * _ARCSEC, f"{axis}t", COLORS[i], 6)
    return Plot(
        "Misfit by turn",
        "Mean rate of each turn or move less what encoders, earth and calibration say, over the rate: the angle by "
        "which the axis seems to be off.",
        out,
    )


def _contributions(turning: list[Group], values: dict[str, float]) -> Plot:
    """Plot each position's share of the information about the mounting angles."""
    information: dict[str, Array] = {}
    for group in turning:
        n = len(group.gyro)
        factor = IndexerAverageFactor.of(group.gyro, group.rates, 1.0, 0.0)
        blocks = (np.tile(several(values, names), (n, 1)) for names in (THETA, BIAS))
        by_theta = factor(*blocks)[1]()[0].reshape(-1, 3)
        position = f"{group.run.axis}, other at {round(np.rad2deg(group.run.other)) % 360} deg"
        information[position] = information.get(position, np.zeros(3)) + (by_theta**2).sum(axis=0)
    total = np.sum(list(information.values()), axis=0)
    out = Figure("share, %", x_title="", x_labels=THETA)
    below, left = np.zeros(len(THETA)), np.arange(len(THETA)) - 0.4
    for (position, own), color in zip(information.items(), cycle(COLORS)):
        share = 100.0 * own / np.maximum(total, 1e-300)
        out.boxes(left, left + 0.8, below, below + share, position, color)
        below = below + share
    return Plot(
        "What each position says",
        "Share of the turns and moves about each axis, the other axis standing at an angle, in the information on the "
        "mounting angles by gyro noise alone.",
        out,
    )


def _attitude(data: IndexerData, config: Config, values: dict[str, float]) -> Plot:
    """Plot the error of the INS attitude output, before and after compensation."""
    found = validate(data, config, values)[0]
    out = Figure("attitude error, deg", y_scale="log")
    said = []
    for name, error, color in (("before", found.before, COLORS[6]), ("after", found.after, COLORS[0])):
        angle = np.rad2deg(np.linalg.norm(error, axis=1))
        out.line(found.time, angle, name, color)
        rms = float(np.sqrt((angle**2).mean()))
        said.append(f"{name} compensation {rms:.4g} deg ({3600.0 * rms:.3g} arcsec) RMS")
    out.levels(0.005, dash="dashed", name="published claim")
    return Plot("Attitude output", "Angle between nRb put out and the base's attitude: " + ", ".join(said) + ".", out)


def validate(data: IndexerData, config: Config, values: Mapping[str, float]) -> list[Validation]:
    """Errors before and after calibration: of the attitude output, if recorded, and of the turns' mean rates.

    The carrier's attitude is nRb = nRm mRt tRb(outer, inner), without calibration mRt = identity and perpendicular
    axes; the carrier is the indexer's base and stands still at the config's `indexer.base_attitude`.

    Raises InputError when the axes hardly turn.
    """
    motion = axis_motion(data)
    turning = [g for g in groups_of(data, config, motion) if g.position is not None]
    time, before = misfit(turning, {})
    after = misfit(turning, values)[1]
    found = [Validation("axis by mean rates, turn by turn", "rad", time, before, after)]
    if data.attitude is not None:
        rows = np.flatnonzero((data.gyro_t >= motion.t[0]) & (data.gyro_t <= motion.t[-1]))
        bRn = so3.inverse(np.array(config.section(IndexerConfig).base_attitude))
        errors = []
        for some in ({}, values):
            theta, epsilon, encoder = (several(some, names) for names in (THETA, EPSILON, ENCODER))
            nRb = carrier(data, motion, rows, theta, float(epsilon[0]), encoder)
            errors.append(so3.log(so3.multiply(bRn, nRb)))
        claim = "the publication claims 0.005 deg over an hour"
        found.insert(0, Validation("attitude put out", "rad", data.gyro_t[rows], errors[0], errors[1], claim))
    return found


def misfit(groups: Sequence[Group], values: Mapping[str, float]) -> tuple[Array, Array]:
    """End times (n,) of groups, s, and relative residuals (n, 3) of their mean rates in t.

    Args:
        groups: in which an axis turns.
        values: parameters by name; those not named are zero.
    """
    tRm, bias, gain = (
        so3.from_angles(several(values, THETA)),
        several(values, BIAS),
        np.eye(3) + symmetric(several(values, ERRORS)),
    )
    epsilon, encoder = several(values, EPSILON), several(values, ENCODER)
    slope = several(values, GYRO_SLOPE.names)
    errors = []
    for group in groups:
        share = np.diff(group.rates.edges) / group.duration
        fixed, cosine, sine = np.moveaxis(group.rates.parts(encoder), 1, 0)
        expected = share @ (fixed + np.cos(epsilon) * cosine + np.sin(epsilon) * sine)
        temperature_rise = group.temperature_rise(values.get(FIRST))
        drift = bias if temperature_rise is None else bias + share @ temperature_rise * slope
        found = so3.rotate(tRm, np.linalg.solve(gain, group.mean_gyro - drift))
        errors.append((found - expected) / np.linalg.norm(expected))
    return np.array([float(g.rates.edges[-1]) for g in groups]), np.array(errors).reshape(-1, 3)


# The inner axis dwells a minute at 0, 90, 180, 270 deg and goes back the same way; a quarter turn takes 10 s.
_STEP_S, _DWELL_S, _TURN_S, _HOUR_S = 10.0, 60.0, 10.0, 3600.0
_QUARTERS = (1.0, 1.0, 1.0, -1.0, -1.0, -1.0)
_LATITUDE = np.deg2rad(45.0)


def uses(_true: Truth, _config: Config, noise: Mapping[str, float]) -> Sequence[Use]:
    """Uses of an indexer calibration: attitude error over an hour."""
    time, angle, rate = _sequence()
    shown = slice(5, None, 6)
    density, walk = noise.get("gyro_density", 0.0), noise.get("gyro_bias_walk", 0.0)
    # Earth rate in the base, level and north along y, seen from the platform, and the turning.
    w = so3.rotate(so3.exp(-angle[:, None] * _EZ), EARTH_RATE * np.array([0.0, np.cos(_LATITUDE), np.sin(_LATITUDE)]))
    w = w + rate[:, None] * _EZ

    def error(applied: Applied, true: Truth) -> Array:
        mRt = so3.compose(*(passive(i, true.get(f"theta_{axis}")) for i, axis in enumerate("xyz")))
        reading = gyro_reading(true, so3.rotate(mRt[..., None, :], w), np.zeros((1, 3)))
        wrong = so3.rotate(so3.exp(angle[:, None] * _EZ), applied(gyro=reading)["w_it"] - w)
        return np.asarray(_STEP_S * np.cumsum(wrong, axis=-2)[..., shown, :])

    def part(axes: slice) -> Line:
        name = "heading" if axes.start == 2 else "level"
        color = "series1" if axes.start == 2 else "series0"
        return Line(name, lambda applied, true: error(applied, true)[..., axes], color, noise=_noise(time[shown]))

    def _noise(t: Array) -> Array:
        return np.asarray(density**2 * t + walk**2 * t**3 / 3.0)

    return (
        Use(
            "navigation",
            "Attitude by the IMU over an hour of indexing",
            time[shown] / 60.0,
            "time, min",
            "attitude error, arcsec",
            "arcsec",
            float(np.degrees(3600.0)),
            (part(slice(0, 2)), part(slice(2, 3))),
            "e = ∫ bRt (w_it − ω) dt; N(t) = N² t + K² t³/3",
            "inner axis through 0, 90, 180, 270 deg and back, a minute each, at 45 deg latitude",
            "attitude after an hour",
            at=-1,
        ),
    )


_EZ = np.array([0.0, 0.0, 1.0])


def _sequence() -> tuple[Array, Array, Array]:
    """Rotation sequence of an hour: times, s, angles of the inner axis, rad, and its rates, rad/s, (U,)."""
    time = np.arange(_STEP_S, _HOUR_S + 0.5 * _STEP_S, _STEP_S)
    middle = time - 0.5 * _STEP_S
    leg, into = np.divmod(middle, _DWELL_S + _TURN_S)
    moves = np.array(_QUARTERS)[np.arange(int(leg[-1]) + 1) % len(_QUARTERS)]
    at = np.concatenate([[0.0], np.cumsum(moves)])[leg.astype(int)]
    share = np.clip((into - _DWELL_S) / _TURN_S, 0.0, 1.0)
    quarter = 0.5 * np.pi
    turning = into > _DWELL_S
    return time, quarter * (at + share * moves[leg.astype(int)]), quarter / _TURN_S * turning * moves[leg.astype(int)]


CARDS = {
    "IMU on the indexer": (("Mounting", "", ("theta_x", "theta_y", "theta_z")),),
    "Gyro": (
        ("Bias", "", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
        ("Scale error", "", ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")),
    ),
}
REPORT = Report(
    uses=uses,
    cards=CARDS,
    formulas=formulas,
    corrections=rotated_imu("platform", "w_it", "inverse(mRt)"),
    figures=indexer_plots,
    validate=validate,
)
