"""Figures of any method's report."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.graph.problem import Array, History, Quantity, Residuals
from pipelines.reports.result import Calibration, Plot, quantities_of
from pipelines.reports.units import human_unit

if TYPE_CHECKING:
    import plotly.graph_objects as go

# Okabe, Ito: told apart by the colour-blind too. The last is kept for what was rejected.
COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#8a7300", "#555555", "#7f3fbf", "#a0522d")
REJECTED = "#d11d1d"

_MOST_POINTS = 3000
# Numbers are written into the correlation map up to this many parameters.
_MOST_LABELLED = 12
# Ellipses are drawn of so many pairs that are correlated at least so much.
_MOST_ELLIPSES, _STRONG = 5, 0.5
# The estimates' axis shows what came after this part of the recording.
_SETTLED = 0.1


# A template of plotly's own is copied and checked in every figure, at 25 ms and 7 kB each; this is what is used of one.
_AXIS = {
    "gridcolor": "#ebf0f8",
    "linecolor": "#ebf0f8",
    "zerolinecolor": "#ebf0f8",
    "zerolinewidth": 2,
    "ticks": "",
    "automargin": True,
    "title": {"standoff": 15},
}
_SPACE = {"backgroundcolor": "white", "gridcolor": "#dfe8f3", "linecolor": "#ebf0f8", "zerolinecolor": "#ebf0f8"}
_STYLE = {
    "layout": {
        "autotypenumbers": "strict",
        "font": {"color": "#2a3f5f"},
        "hoverlabel": {"align": "left"},
        "hovermode": "closest",
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "scene": {"xaxis": _SPACE, "yaxis": _SPACE, "zaxis": _SPACE},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
    }
}


def figure(y_title: str, height: int = 320, x_title: str = "time, s") -> go.Figure:
    """An empty figure in the report's style."""
    import plotly.graph_objects as go

    return go.Figure(
        layout={
            "template": _STYLE,
            "height": height,
            "margin": {"l": 56, "r": 12, "t": 12, "b": 44},
            "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0.0},
            "font": {"family": "system-ui, sans-serif", "size": 13},
            "xaxis": {"title": {"text": x_title}},
            "yaxis": {"title": {"text": y_title}},
        }
    )


def thin(count: int) -> slice:
    """Every n-th of so many points, so that no trace has more than a few thousand."""
    return slice(None, None, max(1, -(-count // _MOST_POINTS)))


def add_points(out: go.Figure, time: Array, values: Array, name: str, color: str, size: int = 4) -> None:
    """Scatter values (n,) over time, thinned."""
    some = thin(len(time))
    out.add_scatter(
        x=np.round(time[some], 4),
        y=values[some].astype(np.float32),
        mode="markers",
        name=name,
        marker={"color": color, "size": size},
    )


def add_line(
    out: go.Figure, time: Array, values: Array, name: str, color: str, dash: str | None = None, shown: bool = True
) -> None:
    """A line over time, thinned."""
    some = thin(len(time))
    out.add_scatter(
        x=np.round(time[some], 4),
        y=values[some].astype(np.float32),
        mode="lines",
        name=name,
        showlegend=shown,
        line={"color": color, "width": 1.5, "dash": dash},
    )


def common_plots(calibration: Calibration) -> list[Plot]:
    """Estimates over time, residuals or innovations, correlations."""
    estimate = calibration.estimate
    history = estimate.history
    plots = _histories(calibration, history) if history is not None and len(history.time) else []
    if calibration.learning and history is not None:
        plots.append(_learning(calibration, history))
    for family, residuals in estimate.residuals.items():
        if len(residuals.time):
            plots.append(_residuals(family, residuals, estimate.solver == "incremental"))
            if estimate.solver == "incremental":
                plots.append(_squares(family, residuals))
    correlation, ellipses = _correlation(calibration), _ellipses(calibration)
    return [*plots, *([correlation] if correlation else []), *([ellipses] if ellipses else [])]


def _residuals(family: str, residuals: Residuals, innovations: bool) -> Plot:
    what = "innovation" if innovations else "residual"
    out = figure(f"{what}, sigmas")
    used = residuals.used
    width = residuals.whitened.shape[1]
    for i, color in zip(range(width), cycle(COLORS)):
        add_points(out, residuals.time[used], residuals.whitened[used, i], f"component {i + 1}", color, 3)
    if not used.all():
        low, high = _view(residuals.whitened[used])
        far = np.minimum(np.linalg.norm(residuals.whitened[~used], axis=1), 0.97 * high)
        add_points(out, residuals.time[~used], far, "rejected (length)", REJECTED, 5)
        out.update_yaxes(range=[low, high])
    for bound in (-3.0, 3.0):
        out.add_hline(y=bound, line={"color": "#888888", "width": 1, "dash": "dot"})
    share = float((np.abs(residuals.whitened[used]) > 3.0).mean()) if used.any() else 0.0
    return Plot(
        f"{what.capitalize()}s of {family}",
        f"{int(used.sum())} measurements used, {int((~used).sum())} rejected as outliers. In units of their sigma: "
        f"{100.0 * share:.2g} % lie beyond 3 (dotted), 0.27 % would be normal.",
        out,
    )


def _view(used: Array) -> tuple[float, float]:
    """Range of an axis that shows what was used, and above it what was rejected; the farthest stand at its edge."""
    reach = max(5.0, 1.2 * float(np.abs(used).max(initial=0.0)))
    return -reach, 2.0 * reach


def _squares(family: str, residuals: Residuals) -> Plot:
    """Normalised innovation squared with its running mean."""
    time, rows = residuals.time[residuals.used], residuals.whitened[residuals.used]
    square = (rows**2).sum(axis=1)
    width = max(1, min(100, len(square) // 10))
    mean = np.convolve(square, np.full(width, 1.0 / width), mode="valid")
    out = figure("innovation squared (NIS)")
    add_points(out, time, square, "NIS", "#9ab6cc", 3)
    add_line(out, time[width - 1 :], mean, f"mean of {width}", COLORS[0])
    out.add_hline(y=rows.shape[1], line={"color": "#888888", "width": 1, "dash": "dot"})
    return Plot(
        f"Innovations squared of {family}",
        f"The mean should stay at {rows.shape[1]} (dotted): above it noise is larger than reckoned with or the model "
        "lacks something at that time, below it noise is smaller.",
        out,
    )


def variables(calibration: Calibration) -> list[tuple[str, str, list[Quantity]]]:
    """Title, SI unit and quantities of each variable that was estimated; numbers of unlike units stand apart."""
    found = []
    for parameter in calibration.problem.parameters:
        free = [q for q in parameter.quantities if q.name in calibration.estimate.names and q.prior_sigma != 0.0]
        groups = {human_unit(q): [r for r in free if human_unit(r) == human_unit(q)] for q in free}
        found += [(_common_name([q.name for q in members]), members[0].unit, members) for members in groups.values()]
    return found


def _histories(calibration: Calibration, history: History) -> list[Plot]:
    """One figure per variable: its numbers over time with a band of one sigma."""
    column = {name: i for i, name in enumerate(calibration.estimate.names)}
    plots = []
    for title, _, members in variables(calibration):
        unit, factor = human_unit(members[0])
        out = figure(unit)
        settled = history.time >= history.time[0] + _SETTLED * np.ptp(history.time)
        reach, shown = [], set()
        for q, color in zip(members, cycle(COLORS)):
            values = factor * history.values[:, column[q.name]]
            sigmas = factor * history.sigmas[:, column[q.name]]
            band(out, history.time, values, sigmas, color)
            add_line(out, history.time, values, q.name, color)
            shown |= _others(out, calibration, q.name, factor, color)
            reach += [(values - 2.0 * sigmas)[settled].min(), (values + 2.0 * sigmas)[settled].max()]
        out.update_yaxes(range=[min(reach), max(reach)])
        plots.append(
            Plot(
                f"{title} over time",
                f"Estimate at each moment from what was recorded until then, {unit}; the band is one sigma"
                + "".join(f", {line}" for line in _OTHERS if line in shown)
                + ".",
                out,
            )
        )
    return plots


# Lines beside the estimate, in the order in which captions name them.
_OTHERS = (
    "dotted is the published solver",
    "dash-dotted is the value at that moment from the whole recording",
    "dashed is the truth",
)


def _others(out: go.Figure, calibration: Calibration, name: str, factor: float, color: str) -> set[str]:
    """Draws what else is known of a parameter over time; returns which of _OTHERS that was."""
    estimate, beside = calibration.estimate, calibration.beside() if calibration.beside else None
    published, smooth, truth = _OTHERS
    shown = set()
    if beside is not None and beside.history is not None and name in beside.names:
        values = factor * beside.history.values[:, beside.names.index(name)]
        add_line(out, beside.history.time, values, name, color, "dot", shown=False)
        shown.add(published)
    moving = estimate.smoothed
    if moving is not None and np.ptp(values := factor * moving.values[:, estimate.names.index(name)]) > 0.0:
        add_line(out, moving.time, values, name, color, "dashdot", shown=False)
        shown.add(smooth)
    known = (calibration.truth or {}).get(name)
    if isinstance(known, int | float):
        out.add_hline(y=factor * known, line={"color": color, "width": 1, "dash": "dash"})
        shown.add(truth)
    return shown


def _learning(calibration: Calibration, history: History) -> Plot:
    """Sigmas over what is required, as they fell."""
    column = {name: i for i, name in enumerate(calibration.estimate.names)}
    out = figure("sigma / required")
    require = {q.name: q.require for q in calibration.problem.quantities}
    for name, color in zip(calibration.learning, cycle(COLORS)):
        add_line(out, history.time, history.sigmas[:, column[name]] / require[name], name, color)
    out.add_hline(y=1.0, line={"color": "#888888", "width": 1, "dash": "dot"})
    out.update_yaxes(type="log", exponentformat="power")
    return Plot(
        "What was known when",
        "Sigma of each parameter over the one required, as the recording went on; below the dotted line it is as "
        "accurate as required. Where a line falls steeply the motion said much.",
        out,
    )


def band(out: go.Figure, time: Array, values: Array, sigmas: Array, color: str) -> None:
    """A band of one sigma around values over time, thinned."""
    some = thin(2 * len(time))
    x = np.concatenate([time[some], time[some][::-1]])
    y = np.concatenate([(values + sigmas)[some], (values - sigmas)[some][::-1]])
    out.add_scatter(
        x=np.round(x, 4),
        y=y.astype(np.float32),
        fill="toself",
        fillcolor=color,
        opacity=0.18,
        line={"width": 0},
        hoverinfo="skip",
        showlegend=False,
    )


def _common_name(names: Sequence[str]) -> str:
    """What the names of one variable have in common, for a title."""
    if len(names) == 1:
        return names[0]
    common = names[0]
    while common and not all(name.startswith(common) for name in names):
        common = common[:-1]
    return common.rstrip("_") or ", ".join(names)


def _correlation(calibration: Calibration) -> Plot | None:
    import plotly.graph_objects as go

    quantities = quantities_of(calibration.problem, calibration.estimate)
    sigmas = calibration.assessment.sigmas
    shown: NDArray[np.intp] = np.flatnonzero(sigmas > 0.0)
    if len(shown) < 2:
        return None
    covariance = calibration.assessment.covariance[np.ix_(shown, shown)]
    correlation = np.clip(covariance / np.outer(sigmas[shown], sigmas[shown]), -1.0, 1.0)
    names = [quantities[i].name for i in shown]
    out = figure("", height=max(320, 130 + 24 * len(names)), x_title="")
    out.add_trace(
        go.Heatmap(
            z=correlation.astype(np.float32),
            x=names,
            y=names,
            zmin=-1.0,
            zmax=1.0,
            colorscale="RdBu",
            reversescale=True,
            showscale=False,
            texttemplate="%{z:.1f}" if len(names) <= _MOST_LABELLED else None,
            hovertemplate="%{y}, %{x}: %{z:.3f}<extra></extra>",
        )
    )
    out.update_xaxes(tickangle=-60, dtick=1, automargin=True, showgrid=False)
    out.update_yaxes(autorange="reversed", dtick=1, automargin=True, showgrid=False)
    return Plot(
        "Correlation of the parameters",
        "Red +1, blue -1. Near either two parameters trade against each other: their errors are not independent.",
        out,
    )


def _ellipses(calibration: Calibration) -> Plot | None:
    """One-sigma ellipses of the pairs with the strongest correlation, each in units of its own two sigmas."""
    quantities = quantities_of(calibration.problem, calibration.estimate)
    covariance, sigmas = calibration.assessment.covariance, calibration.assessment.sigmas
    pairs = [
        (float(covariance[i, j] / (sigmas[i] * sigmas[j])), i, j)
        for i in range(len(sigmas))
        for j in range(i)
        if sigmas[i] > 0.0 and sigmas[j] > 0.0
    ]
    strong = sorted((pair for pair in pairs if abs(pair[0]) > _STRONG), key=lambda pair: -abs(pair[0]))[:_MOST_ELLIPSES]
    if not strong:
        return None
    out = figure("error of the second, sigmas", height=380, x_title="error of the first, sigmas")
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for (correlation, i, j), color in zip(strong, cycle(COLORS)):
        correlation = float(np.clip(correlation, -1.0, 1.0))
        x, y = np.array([[1.0, 0.0], [correlation, np.sqrt(1.0 - correlation**2)]]) @ circle
        out.add_scatter(
            x=np.round(x, 4),
            y=np.round(y, 4),
            mode="lines",
            name=f"{quantities[j].name}, {quantities[i].name}: {correlation:+.2f}",
            line={"color": color, "width": 1.5},
        )
    out.update_yaxes(scaleanchor="x")
    return Plot(
        "Parameters that trade against each other",
        "One-sigma ellipses of the most correlated pairs: the thinner, the more the error of one is that of the other.",
        out,
    )
