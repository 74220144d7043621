"""Figures as data: marks on two axes, drawn by the page that shows them.

    out = Figure("rate, deg/s")
    out.points(time, rates, "measured", COLORS[0])

Colours are names from PALETTE, which has a light and a dark form of each, so that a page can follow its reader.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from alidade.factors.array import Array
from alidade.pipelines.files import as_date

# The first three are Paul Tol's high-contrast scheme: distinguishable for the colour-blind, and in grey. On dark ground
# their lighter forms. "rejected" is kept for what was rejected, the last ones for what stands behind.
PALETTE = {
    # Axes of frames, as RViz, ROS and Foxglove have them; plots name them too.
    "x": ("#c62828", "#ff6b6b"),
    "y": ("#2e7d32", "#63c46a"),
    "z": ("#1e5fd0", "#6fa3ff"),
    "series0": ("#004488", "#7db4ea"),
    "series1": ("#d9a520", "#f0cc66"),
    "series2": ("#bb5566", "#f28fa1"),
    "series3": ("#44aa99", "#6fd1c1"),
    "series4": ("#555f6b", "#c3ccd6"),
    "series5": ("#6fb7e6", "#3d86b8"),
    "series6": ("#117733", "#4fb070"),
    "series7": ("#aa4499", "#d98bce"),
    "series8": ("#8a7300", "#b8a640"),
    "rejected": ("#cc3311", "#ff7755"),
    "pale": ("#9ab6cc", "#58738a"),
    "before": ("#8a949e", "#7c8792"),
    "grid": ("#c9d1d9", "#3a4551"),
    "gap": ("#f6dfae", "#5c4a1c"),
    "ink": ("#1b2530", "#e4e9ee"),
    "soft": ("#5b6875", "#a3afbb"),
    "paper": ("#ffffff", "#1a2027"),
}
COLORS = tuple(name for name in PALETTE if name.startswith("series"))
AXES = ("x", "y", "z")
REJECTED, PALE, BEFORE, GRID = "rejected", "pale", "before", "grid"

Dash = Literal["solid", "dotted", "dashed", "dotdash"]
Shape = Literal["circle", "ring", "x"]
Scale = Literal["linear", "log", "datetime"]

_MOST_POINTS = 3000
# Figures higher than this, px, are as broad as the page.
_BROAD_PX = 380


@dataclass
class Mark:
    """Points, lines or areas of one colour.

    Attributes:
        kind: points, line, band, boxes, segments, levels, moments, text, heat or patches.
        columns: its numbers, each (n,): x, y; for a band x, low, high; for boxes left, right, low, high; for segments
            x, y, x1, y1; for levels y; for moments x; for heat x, y, value; for patches x, y, one
            after the other with a nan between, and value.
        color: from PALETTE.
        name: in the legend, and where it is pointed at; marks of one name are shown and hidden together.
        shown: whether the legend has it.
        size, dash, shape, alpha: how it looks.
        texts: of each point, shown when it is pointed at, or drawn.
    """

    kind: str
    columns: dict[str, Array]
    color: str = "soft"
    name: str = ""
    shown: bool = False
    size: float = 1.0
    dash: Dash = "solid"
    shape: Shape = "circle"
    alpha: float = 1.0
    texts: Sequence[str] = ()

    @property
    def x(self) -> Array:
        """Horizontal coordinates of the mark."""
        return self.columns["x"]

    @property
    def y(self) -> Array:
        """Vertical coordinates of the mark."""
        return self.columns["y"]


@dataclass
class Figure:
    """Figure of marks on two axes.

    Attributes:
        y_title, x_title: of the axes, with unit.
        height: px.
        share: of the width of the page, where figures stand beside one another.
        x_scale, y_scale: of the axes.
        x_range, y_range: what is shown at first; None: everything, levels and moments aside.
        x_labels, y_labels: what stands at 0, 1, ... in place of numbers.
        square: a unit is as long upwards as across.
        bare: without axes.
        y_shared: the y axis is that of the figure before.
        marks: in the order in which they are drawn.
    """

    y_title: str = ""
    x_title: str = "time, s"
    height: int = 270
    share: float = 1.0
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    x_labels: tuple[str, ...] = ()
    y_labels: tuple[str, ...] = ()
    square: bool = False
    bare: bool = False
    y_shared: bool = False
    marks: list[Mark] = field(default_factory=list)

    def named(self, name: str) -> list[Mark]:
        """The marks of a figure that have a name."""
        return [mark for mark in self.marks if mark.name == name]

    def points(
        self,
        x: ArrayLike,
        y: ArrayLike,
        name: str = "",
        color: str = COLORS[0],
        size: float = 4,
        *,
        shape: Shape = "circle",
        alpha: float = 1.0,
        texts: Sequence[str] = (),
    ) -> None:
        """Draw points (n,), thinned where they are very many and have no texts."""
        some = slice(None) if texts else thin(np.size(x))
        self._add("points", {"x": x, "y": y}, some, color, name, size=size, shape=shape, alpha=alpha, texts=texts)

    def line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        name: str = "",
        color: str = COLORS[0],
        dash: Dash = "solid",
        *,
        width: float = 1.5,
        shown: bool = True,
    ) -> None:
        """Draw a line through points (n,), thinned; the line is broken where y is not a number."""
        self._add("line", {"x": x, "y": y}, thin(np.size(x)), color, name, shown, size=width, dash=dash)

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, color: str, name: str = "") -> None:
        """Draw a band between two lines (n,), thinned; the band belongs to the line called `name`."""
        columns = {"x": x, "low": low, "high": high}
        self._add("band", columns, thin(2 * np.size(x)), color, name, False, alpha=0.2)

    def boxes(
        self,
        left: ArrayLike,
        right: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        name: str,
        color: str,
        texts: Sequence[str] = (),
        alpha: float = 1.0,
    ) -> None:
        """Draw filled boxes (n,), such as bars."""
        columns = {"left": left, "right": right, "low": low, "high": high}
        self._add("boxes", columns, slice(None), color, name, alpha=alpha, texts=texts)

    def bars(self, heights: ArrayLike, name: str, color: str, place: tuple[int, int] = (0, 1)) -> None:
        """Draw bars (n,) at the x_labels; `place` (i, count) is that of the i-th of `count` bars side by side."""
        heights = np.asarray(heights, dtype=float)
        i, count = place
        left = np.arange(len(heights)) - 0.4 + 0.8 * i / count
        zero = np.zeros(len(heights))
        self.boxes(left, left + 0.8 / count, zero, heights, name, color, self.x_labels)

    def segments(self, x: ArrayLike, y: ArrayLike, x1: ArrayLike, y1: ArrayLike, color: str, name: str = "") -> None:
        """Draw lines (n,) from (x, y) to (x1, y1), which belong to the points called `name`."""
        self._add("segments", {"x": x, "y": y, "x1": x1, "y1": y1}, slice(None), color, name, False)

    def levels(self, y: ArrayLike, color: str = "soft", dash: Dash = "dotted", name: str = "") -> None:
        """Draw horizontal lines at heights (n,)."""
        self._add("levels", {"y": y}, slice(None), color, name, bool(name), dash=dash)

    def moments(self, x: ArrayLike, color: str = "soft", name: str = "") -> None:
        """Draw dashed vertical lines at places (n,)."""
        self._add("moments", {"x": x}, slice(None), color, name, False, dash="dashed")

    def words(self, x: ArrayLike, y: ArrayLike, texts: Sequence[str]) -> None:
        """Write words at places (n,)."""
        self._add("text", {"x": x, "y": y}, slice(None), "ink", "", False, texts=texts)

    def heat(self, values: Array, numbers: bool) -> None:
        """Draw a map of values (rows, columns) from -1 to 1 at the y_labels and x_labels; `numbers` writes them in."""
        rows, columns = np.indices(values.shape)
        texts = [f"{v:.1f}" for v in values.ravel()] if numbers else ()
        places = {"x": columns.ravel(), "y": rows.ravel(), "value": values.ravel()}
        self._add("heat", places, slice(None), "ink", "", False, texts=texts)

    def patches(self, outlines: Array, values: Array, color: str, texts: Sequence[str]) -> None:
        """Draw polygons (n, corners, 2), darker for larger values (n,)."""
        gap = np.full((len(outlines), 1, 2), np.nan)
        at = np.concatenate([outlines, gap], axis=1).reshape(-1, 2)
        self._add(
            "patches", {"x": at[:, 0], "y": at[:, 1], "value": values}, slice(None), color, "", False, texts=texts
        )

    def _add(
        self,
        kind: str,
        columns: dict[str, Any],
        some: slice,
        color: str,
        name: str,
        shown: bool = True,
        **look: Any,
    ) -> None:
        numbers = {key: np.atleast_1d(np.asarray(each, dtype=float))[some] for key, each in columns.items()}
        self.marks.append(Mark(kind, numbers, color, name, bool(name) and shown, **look))


@dataclass(frozen=True, eq=False)
class Plot:
    """A figure with its title and caption.

    Attributes:
        title: in a few words.
        caption: what is seen, with units.
        figure: the first figure.
        beside: figures that belong to it, beside it or below.
        printed: whether on paper too.
    """

    title: str
    caption: str
    figure: Figure
    beside: tuple[Figure, ...] = ()
    printed: bool = True

    @property
    def figures(self) -> tuple[Figure, ...]:
        """All figures, from left to right."""
        return (self.figure, *self.beside)

    @property
    def legend(self) -> tuple[Mark, ...]:
        """First mark of each name that the legend shows."""
        marks: dict[str, Mark] = {}
        for mark in (mark for figure in self.figures for mark in figure.marks if mark.shown):
            marks.setdefault(mark.name, mark)
        return tuple(marks.values())

    @property
    def broad(self) -> bool:
        """Whether the plot takes the whole width of a page."""
        return bool(self.beside) or self.figure.height > _BROAD_PX


def thin(count: int) -> slice:
    """Return the slice that thins so many points to a few thousand at most."""
    return slice(None, None, max(1, -(-count // _MOST_POINTS)))


def milliseconds(dates: Iterable[str | None]) -> Array:
    """Convert ISO dates (n,) to ms since 1970 UTC, as the datetime scale needs; NaN for None."""
    return np.array([1e3 * as_date(each).timestamp() if each else np.nan for each in dates])
