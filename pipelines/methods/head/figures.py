"""Figures of the head method's report: attitude against vision, and against the truth where it is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.pipelines.display.figure import COLORS, PALE, Figure, Plot
from alidade.pipelines.estimation.problem import Array, Attitudes
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods.head.recording import HeadData
from alidade.pipelines.reports.result import Calibration

_AXES = "xyz"


def head_plots(data: HeadData, calibration: Calibration) -> list[Plot]:
    """Attitude bRv with what vision says of it, and their differences; nothing without a trajectory."""
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
    """bRv that each vision frame alone stands for, with the mounts and the time offset found."""
    values = dict(zip(calibration.estimate.names, calibration.estimate.values.tolist(), strict=True))

    def mount(name: str) -> Array:
        return so3.exp(np.array([values.get(f"{name}_{axis}", 0.0) for axis in _AXES]))

    time = data.vision_t + values.get("time_offset", 0.0)
    inside = _inside(attitudes, time)
    cRh = data.vision_wxyz[inside]
    bRv = so3.compose(so3.inverse(mount("camera_mount")), cRh, so3.inverse(mount("helmet_mount")))
    return Attitudes(time[inside], bRv)


def _attitude(attitudes: Attitudes, seen: Attitudes) -> Plot:
    out = Figure("rotation vector of bRv, deg", height=360)
    fused, vision = _vectors(attitudes.wxyz), _vectors(seen.wxyz)
    for i, axis in enumerate(_AXES):
        out.points(seen.time, vision[:, i], f"vision {axis}", COLORS[i], 3, alpha=0.45)
    for i, axis in enumerate(_AXES):
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
    for i, axis in enumerate(_AXES):
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
    if _camera_mount_unknown(calibration):
        turn = _constant_turn(truth, attitudes)
        seen, attitudes = (Attitudes(a.time, so3.multiply(turn, a.wxyz)) for a in (seen, attitudes))
        without = " less its constant part on the platform's side, which is the camera mount that is not known"
    errors = {"vision alone": _error(truth, seen), "fused": _error(truth, attitudes)}
    out = Figure("attitude error, deg")
    for (name, (time, angle)), color in zip(errors.items(), (PALE, COLORS[1]), strict=True):
        out.points(time, angle, name, color, 3)
    said = ", ".join(f"{name} {float(np.sqrt((angle**2).mean())):.3g} deg RMS" for name, (_, angle) in errors.items())
    return Plot("Attitude against the truth", f"Angle between attitude and truth{without}: {said}.", out)


def _camera_mount_unknown(calibration: Calibration) -> bool:
    verdicts = calibration.verdicts
    return any(verdicts.get(f"camera_mount_{axis}") in ("weak", "unobservable") for axis in _AXES)


def _constant_turn(truth: Attitudes, attitudes: Attitudes) -> Array:
    """The rotation (4,) that, on the left of the attitudes, brings them nearest to the truth (Markley 2007)."""
    inside = _inside(truth, attitudes.time)
    at = so3.interpolate(truth.time, truth.wxyz, attitudes.time[inside])
    turns = so3.multiply(at, so3.inverse(attitudes.wxyz[inside]))
    return np.linalg.eigh(turns.T @ turns)[1][:, -1]


def _inside(attitudes: Attitudes, time: Array) -> NDArray[np.bool_]:
    return (time >= attitudes.time[0]) & (time <= attitudes.time[-1])


def _error(truth: Attitudes, attitudes: Attitudes) -> tuple[Array, Array]:
    """Times within the truth's, and the angles to it there, deg."""
    inside = _inside(truth, attitudes.time)
    some = Attitudes(attitudes.time[inside], attitudes.wxyz[inside])
    return some.time, np.linalg.norm(_delta(truth, some), axis=1)


def _delta(attitudes: Attitudes, others: Attitudes) -> Array:
    """Rotation vectors, deg, from the attitudes, taken at the others' times, to the others."""
    at = so3.interpolate(attitudes.time, attitudes.wxyz, others.time)
    return np.rad2deg(so3.log(so3.multiply(so3.inverse(at), others.wxyz)))


def _vectors(wxyz: Array) -> Array:
    """Rotation vectors, deg."""
    return np.rad2deg(so3.log(wxyz))
