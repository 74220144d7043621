"""Figures of any method's report."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.factors.chi_square import interval
from alidade.pipelines.display.figure import AXES, COLORS, PALE, REJECTED, Figure, Plot
from alidade.pipelines.display.units import human_unit, noise_unit
from alidade.pipelines.estimation.error_map import UNIT, FoundMap
from alidade.pipelines.estimation.problem import History, Quantity, Residuals
from alidade.pipelines.reports.result import Calibration

# Suffix of a number of one variable: an axis, an element, a harmonic.
_AXIS = re.compile(r"_([xyzenu]{1,2}|sin|cos)$|_?\d+$")
# So many variables are named in a title.
_MOST_NAMED = 3
# Innovations of a piece of which a spectrum is made, and of which there are so many at least.
_PIECE, _LEAST_SPECTRUM = 256, 100
# Numbers are written into the correlation map up to this many parameters.
_MOST_LABELLED = 12
# Ellipses are drawn of so many pairs that are correlated at least so much.
_MOST_ELLIPSES, _STRONG = 5, 0.5
# The estimates' axis shows what came after this part of the recording.
_SETTLED = 0.3
# Numbers of a variable farther apart than so many of their ranges are shown less their last estimates: those of K.
_APART = 4.0


def common_plots(calibration: Calibration) -> list[Plot]:
    """Return the plots of any method: estimates over time, residuals or innovations, correlations."""
    estimate = calibration.estimate
    history = estimate.history
    plots = histories(calibration)
    if calibration.learning and history is not None:
        plots.append(_learning(calibration, history))
    for family, residuals in estimate.residuals.items():
        if len(residuals.time):
            names = components(calibration.method.report.residual_names.get(family), residuals)
            plots.append(_residuals(family, residuals, names, estimate.has_innovations))
            if estimate.has_innovations:
                plots.append(_squares(family, residuals))
            innovations = residuals if estimate.has_innovations else estimate.innovations.get(family)
            if innovations is not None and innovations.used.sum() >= _LEAST_SPECTRUM:
                plots.append(_spectrum(family, innovations, names))
    if estimate.error_map is not None:
        plots.append(_error_map(estimate.error_map))
    return [*plots, *_correlations(calibration)]


def _error_map(found: FoundMap) -> Plot:
    """Plot an error map: the errors over each coordinate of where measurements were made."""
    places, figures = list(found.map.places.items()), list[Figure]()
    unit, factor = noise_unit(found.map.name, UNIT)
    for i, (place, x) in enumerate(places):
        out = Figure(f"error, {unit}" if i == 0 else "", f"{place}, deg", share=1.0 / len(places), y_shared=i > 0)
        for axis, error in zip(found.map.axes, found.error.T, strict=True):
            out.points(np.rad2deg(x), factor * error, axis, axis, 3)
        figures.append(out)
    return Plot(
        f"Errors that depend on where measurements are made ({found.map.name})",
        f"Part of the errors of the measurements that is a smooth function of these numbers, {factor * found.rms:.2g} "
        f"{unit} rms about an axis. Sigmas include what is not known of it.",
        figures[0],
        tuple(figures[1:]),
    )


def components(names: Sequence[str] | None, residuals: Residuals) -> list[str]:
    """Return the names of a residual's components; x, y, z for three and tag corners for eight without own names."""
    width = residuals.whitened.shape[1]
    if names is not None:
        return list(names[:width])
    if width == 8:
        return [f"corner {i // 2 + 1} {'down' if i % 2 else 'across'}" for i in range(width)]
    return ["x", "y", "z"] if width == 3 else [f"number {i + 1} of {width}" for i in range(width)]


def _residuals(family: str, residuals: Residuals, names: Sequence[str], innovations: bool) -> Plot:
    what = "innovation" if innovations else "residual"
    out = Figure(f"{what}, sigmas")
    used = residuals.used
    for i, (name, color) in enumerate(zip(names, _colors(names), strict=False)):
        out.points(residuals.time[used], residuals.whitened[used, i], name, color, 3)
    if not used.all():
        # All used residuals are shown, with room for rejected ones above them.
        reach = max(5.0, 1.2 * float(np.abs(residuals.whitened[used]).max(initial=0.0)))
        out.y_range = (-reach, 2.0 * reach)
        far = np.minimum(np.linalg.norm(residuals.whitened[~used], axis=1), 0.97 * out.y_range[1])
        out.points(residuals.time[~used], far, "rejected (length)", REJECTED, 6, shape="x")
    out.levels((-3.0, 3.0))
    share = float((np.abs(residuals.whitened[used]) > 3.0).mean()) if used.any() else 0.0
    return Plot(
        f"{what.capitalize()}s of {family}",
        f"{int(used.sum())} measurements used, {int((~used).sum())} rejected as outliers. In units of their sigma: "
        f"{100.0 * share:.2g} % lie beyond 3 (dotted), 0.27 % would be normal.",
        out,
    )


def _colors(names: Sequence[str]) -> Iterable[str]:
    """Return the colours of the axes for names that end in x, y, z, else the palette's in turn."""
    axes = [name.rpartition("_")[2] for name in names]
    return axes if set(axes) <= set(AXES) and len(set(axes)) == len(axes) else cycle(COLORS)


def _squares(family: str, residuals: Residuals) -> Plot:
    """Plot the normalised innovation squared (NIS) with its running mean."""
    time, rows = residuals.time[residuals.used], residuals.whitened[residuals.used]
    square = (rows**2).sum(axis=1)
    width = max(1, min(100, len(square) // 10))
    mean = np.convolve(square, np.full(width, 1.0 / width), mode="valid")
    out = Figure("innovation squared (NIS)")
    out.points(time, square, "NIS", PALE, 3)
    out.line(time[width - 1 :], mean, f"mean of {width}", COLORS[0])
    out.levels(rows.shape[1])
    return Plot(
        f"Innovations squared of {family}",
        f"The mean should stay at {rows.shape[1]} (dotted): above it noise is larger than assumed or the model "
        "lacks something at that time, below it noise is smaller.",
        out,
    )


def _spectrum(family: str, innovations: Residuals, names: Sequence[str]) -> Plot:
    """Plot the power spectrum of innovations over the model's, with the 99 % band of white noise."""
    time, rows = innovations.time[innovations.used], innovations.whitened[innovations.used]
    frequency, power, dof = power_spectrum(float(np.median(np.diff(time))), rows)
    out = Figure("power over the model's", "frequency, Hz", x_scale="log", y_scale="log")
    bounds = [interval(0.99, each) for each in dof]
    low, high = [1.0 / b for _, b in bounds], [1.0 / b for b, _ in bounds]
    out.band(frequency, low, high, PALE, "99 % by chance")
    out.line(frequency, np.ones(len(frequency)), "99 % by chance", PALE, "dashed")
    for i, (name, color) in enumerate(zip(names, _colors(names), strict=False)):
        out.line(frequency, power[:, i], name, color)
    return Plot(
        f"Spectrum of {family}",
        "Innovations are white if the noise model is right: 1 at every frequency. Higher at low frequencies: a slow "
        "error, as with the pose, or a correlated reference.",
        out,
    )


def power_spectrum(period: float, rows: Array) -> tuple[Array, Array, Array]:
    """Return frequencies (k,), Hz, power (k, m) of rows (n, m), 1 for unit white noise, and degrees of freedom (k,).

    Mean of half-overlapping pieces under a Hann window (Welch, IEEE Trans. Audio Electroacoust. 1967), over half
    octaves.
    """
    size = min(_PIECE, len(rows))
    window = np.hanning(size)
    begins = range(0, len(rows) - size + 1, max(size // 2, 1))
    pieces = np.array([rows[begin : begin + size] * window[:, None] for begin in begins])
    power = (np.abs(np.fft.rfft(pieces, axis=1)[:, 1:-1]) ** 2).mean(axis=0) / (window**2).sum()
    number = np.arange(1, len(power) + 1)
    octave = np.unique(np.floor(2.0 * np.log2(number)), return_inverse=True)[1]
    count = np.bincount(octave)
    mean = np.stack([np.bincount(octave, column) / count for column in power.T], axis=1)
    # Of a Hann window's lines two in three are independent, as are pieces that overlap by half all but nearly.
    dof = np.maximum(2.0 * len(pieces) * count / 1.5, 2.0)
    return np.bincount(octave, number) / count / (size * period), mean, dof


def variables(calibration: Calibration) -> list[tuple[str, str, list[Quantity]]]:
    """Return title, SI unit and quantities of each estimated variable; numbers of unlike units are apart."""
    found = []
    for parameter in calibration.problem.parameters:
        free = [q for q in parameter.quantities if q.name in calibration.estimate.names and q.prior_sigma != 0.0]
        groups = {human_unit(q): [r for r in free if human_unit(r) == human_unit(q)] for q in free}
        found += [(_common_name([q.name for q in members]), members[0].unit, members) for members in groups.values()]
    return found


def histories(calibration: Calibration) -> list[Plot]:
    """One figure per variable: its numbers over time with a band of one sigma; none without a history.

    Those of nuisance parameters are on paper only where one contradicts its prior.
    """
    history = calibration.estimate.history
    if history is None or not len(history.time):
        return []
    column = {name: i for i, name in enumerate(calibration.estimate.names)}
    conflicts = {each.evidence["parameter"] for each in calibration.findings if each.kind == "prior_conflict"}
    plots = []
    for title, _, members in variables(calibration):
        unit, factor = human_unit(members[0])
        out = Figure(unit)
        settled = history.time >= history.time[0] + _SETTLED * np.ptp(history.time)
        shown: set[str] = set()
        at = [column[q.name] for q in members]
        values, sigmas = factor * history.values[:, at], factor * history.sigmas[:, at]
        low, high = (values - 2.0 * sigmas)[settled].min(axis=0), (values + 2.0 * sigmas)[settled].max(axis=0)
        apart = np.ptp(values[-1]) > _APART * (high - low).max()
        last = values[-1] if apart else np.zeros(len(members))
        for i, (q, color) in enumerate(zip(members, _colors([q.name for q in members]), strict=False)):
            middle, sigma = values[:, i] - last[i], sigmas[:, i]
            out.band(history.time, middle - sigma, middle + sigma, color, q.name)
            out.line(history.time, middle, q.name, color)
            shown |= _others(out, calibration, q.name, factor, color, last[i])
        out.y_range = (float((low - last).min()), float((high - last).max()))
        less = ", less the last one" if apart else ""
        plots.append(
            Plot(
                f"{title} over time",
                f"Estimate at each moment from what was recorded until then{less}; the band is one sigma"
                + "".join(f", {line}" for line in _OTHERS if line in shown)
                + ".",
                out,
                printed=any(not q.assumed or q.name in conflicts for q in members),
            )
        )
    return plots


# Lines beside the estimate, in the order in which captions name them.
_OTHERS = (
    "dotted is the published solver",
    "dash-dotted is the value at that moment from the whole recording",
    "dashed is the truth",
)


def _others(out: Figure, calibration: Calibration, name: str, factor: float, color: str, less: float) -> set[str]:
    """Draw a parameter's published, smoothed and true values over time, less an offset; return which were drawn."""
    estimate, beside = calibration.estimate, calibration.beside
    published, smooth, truth = _OTHERS
    shown = set()
    if beside is not None and beside.history is not None and name in beside.names:
        values = factor * beside.history.values[:, beside.names.index(name)]
        out.line(beside.history.time, values - less, name, color, "dotted", shown=False)
        shown.add(published)
    moving = estimate.smoothed
    if moving is not None and np.ptp(values := factor * moving.values[:, estimate.names.index(name)]) > 0.0:
        out.line(moving.time, values - less, name, color, "dotdash", shown=False)
        shown.add(smooth)
    known = (calibration.truth or {}).get(name)
    if isinstance(known, int | float):
        out.levels(factor * known - less, color, "dashed")
        shown.add(truth)
    return shown


def _learning(calibration: Calibration, history: History) -> Plot:
    """Plot sigmas over the required ones as they decrease over time."""
    column = {name: i for i, name in enumerate(calibration.estimate.names)}
    out = Figure("sigma / required", y_scale="log")
    require = {q.name: q.require for q in calibration.problem.quantities}
    last = {name: history.sigmas[-1, column[name]] / require[name] for name in calibration.learning}
    slowest = sorted(last, key=lambda name: -last[name])[: len(COLORS)]
    for name, color in zip([name for name in last if name in slowest], COLORS, strict=False):
        out.line(history.time, history.sigmas[:, column[name]] / require[name], name, color)
    out.levels(1.0)
    return Plot(
        "Sigmas over time",
        "Sigma of each parameter over the one required; below the dotted line it is as accurate as required. Where a "
        "line falls steeply the motion was informative."
        + (f" The {len(slowest)} of {len(last)} with the largest ratio." if len(last) > len(slowest) else ""),
        out,
    )


def _common_name(names: Sequence[str]) -> str:
    """Return the common part of the names of one variable, for a title."""
    stems = list(dict.fromkeys(_AXIS.sub("", name) for name in names)) if len(names) > 1 else list(names)
    more = len(stems) - _MOST_NAMED
    return ", ".join(stems[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _correlations(calibration: Calibration) -> Iterator[Plot]:
    """Yield a map of the parameters' correlations and ellipses of the strongest pairs, axes in units of two sigmas."""
    sigmas = calibration.estimate.sigmas
    free: NDArray[np.intp] = np.flatnonzero(sigmas > 0.0)
    if len(free) < 2:
        return
    covariance = calibration.covariance[np.ix_(free, free)]
    correlation = np.clip(covariance / np.outer(sigmas[free], sigmas[free]), -1.0, 1.0)
    names = tuple(calibration.estimate.names[i] for i in free)
    ends = (-0.5, len(names) - 0.5)
    height = 130 + max(190, round(float(np.clip(900 / len(names), 13, 24)) * len(names)))
    out = Figure("", "", height, x_labels=names, y_labels=names, x_range=ends)
    out.y_range = ends[::-1]
    out.heat(correlation, numbers=len(names) <= _MOST_LABELLED)
    yield Plot(
        "Correlation of the parameters",
        "Red +1, blue -1. Near either, two parameters trade against each other: their errors are not independent.",
        out,
    )
    pairs = [(float(correlation[i, j]), i, j) for i in range(len(names)) for j in range(i)]
    strong = sorted((pair for pair in pairs if abs(pair[0]) > _STRONG), key=lambda pair: -abs(pair[0]))[:_MOST_ELLIPSES]
    if not strong:
        return
    out = Figure("error of the second, sigmas", "error of the first, sigmas", 380, square=True)
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for (r, i, j), color in zip(strong, cycle(COLORS)):
        x, y = np.array([[1.0, 0.0], [r, np.sqrt(1.0 - r**2)]]) @ circle
        out.line(x, y, f"{names[j]}, {names[i]}: {r:+.2f}", color)
    yield Plot(
        "Most correlated parameters",
        "One-sigma ellipses of the most correlated pairs: the thinner, the more the error of one is that of the other.",
        out,
    )
