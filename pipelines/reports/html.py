"""A report as one HTML file that opens offline, and in a frame of a notebook.

The page forbids itself any access to the network (Content-Security-Policy): a report seen anywhere shows what it shows
here. Figures are drawn by BokehJS, which is in the page, compressed; small ones, beside a number, are SVG.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.metadata import distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from alidade.factors.array import Array
from alidade.pipelines.display.figure import PALETTE, Figure, Mark, Plot
from alidade.pipelines.display.table import Cell, Column, Interval, Table
from alidade.pipelines.files import write_file
from alidade.pipelines.reports.report import Report, plots_of

if TYPE_CHECKING:
    from jinja2 import Environment


_CODE = re.compile(r"`([^`]+)`")
_TEMPLATES = Path(__file__).parent / "templates"
_BOKEH = ("bokeh.min.js", "bokeh-api.min.js")
# Significant digits of a figure's numbers: a pixel is a thousandth of an axis. Dates are whole ms.
_DIGITS = 5
# Characters of a cell that is not broken into lines.
_SHORT = 26


def render_html(report: Report) -> str:
    """Return a report as one HTML text."""
    plots = plots_of([block for section in report.sections for block in section.blocks])
    return environment().get_template("page.html").render(report=report, plots=plots, packed=_packed(plots))


@dataclass(frozen=True)
class Page:
    """HTML page that a notebook shows in a frame."""

    html: str
    height_px: int = 640

    def __repr__(self) -> str:
        return f"<Page of {len(self.html) // 1000} kB; .write(path) saves it>"

    def _repr_html_(self) -> str:
        frame = 'style="width:100%;border:0" sandbox="allow-scripts"'
        return f'<iframe {frame} height="{self.height_px}" srcdoc="{escape(self.html, quote=True)}"></iframe>'

    def write(self, path: str | Path) -> Path:
        """Write the page to a file. Raises InputError when the file cannot be written."""
        write_file(Path(path), self.html)
        return Path(path)


@cache
def environment() -> Environment:
    """Return the environment of the templates: every text is escaped, an undefined name is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "coded": _coded,
        "kind": lambda block: type(block).__name__,
        "classes": _classes,
        "bar": interval_bar,
        "curve": svg,
        "slug": lambda text: text.lower().replace(" ", "-"),
    }
    # Not a template: Bokeh's formats of dates look like statements.
    made.globals |= {"palette": PALETTE, "drawing": (_TEMPLATES / "figures.js").read_text(encoding="utf-8")}
    return made


def _coded(text: str) -> str:
    """Return a text as HTML, with text between backquotes as code."""
    return Markup(_CODE.sub(r"<code>\1</code>", str(Markup.escape(text))))


def _classes(cell: Cell, column: Column, table: Table) -> str:
    """Return the attribute `class` of a cell in HTML."""
    short = column.kind == "number" and len(cell.text) < _SHORT and table.style in ("", "lines", "lines many")
    chosen = {"text": column.kind == "text", "long": column.kind == "prose", "wide": column.wide, "short": short}
    names = [*(name for name, applies in chosen.items() if applies), *([cell.tone] if cell.tone else [])]
    return Markup(' class="{}"').format(" ".join(names)) if names else ""


def _packed(plots: Sequence[Plot]) -> dict[str, str]:
    """Return BokehJS and the figures, compressed, by the ids that figures.js uses."""
    if not plots:
        return {}
    figures = [[_described(figure) for figure in plot.figures] for plot in plots]
    text = json.dumps(figures, separators=(",", ":"), allow_nan=False)
    return {"bokeh": _bokeh(), "figures": _compressed(text.encode())}


def _described(figure: Figure) -> dict[str, Any]:
    marks = []
    for mark in figure.marks:
        dates = ("x", "x1", "left", "right") if figure.x_scale == "datetime" else ()
        columns = {name: _numbers(column, name in dates) for name, column in mark.columns.items()}
        marks.append({**vars(mark), "texts": list(mark.texts), "columns": columns})
    return {**vars(figure), "marks": marks}


def _numbers(column: Array, dates: bool) -> list[float | None]:
    """Return a column's numbers rounded for a figure; None where not finite."""
    finite = np.isfinite(column) & (column != 0.0)
    size = np.floor(np.log10(np.abs(column, where=finite, out=np.ones_like(column))))
    scale = np.ones_like(column) if dates else 10.0 ** (_DIGITS - 1 - size)
    rounded = np.round(column * scale) / scale
    return [value if value - value == 0.0 else None for value in rounded.tolist()]


@cache
def _bokeh() -> str:
    """Return BokehJS, compressed, from the files of the package bokeh, which takes long to import."""
    folder = Path(str(distribution("bokeh").locate_file("bokeh/server/static/js")))
    return _compressed(b"\n".join((folder / name).read_bytes() for name in _BOKEH))


def _compressed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


# Size of the drawing and edges of its plot, px; the last one is the distance from below.
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 470.0, 56.0, 450.0, 20.0, 40.0
_DASHES = {"solid": "", "dashed": "7 3", "dotdash": "9 3 2 3", "dotted": "2 3"}
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
_ANGLES = (15.0, 30.0, 45.0, 90.0)


def svg(figure: Figure) -> str:
    """Return a small figure of lines, bands and levels as SVG, without a script.

    Colours are the page's CSS variables; the y axis begins at 0 unless values are below.
    """
    return _Drawing(figure).markup()


class _Drawing:
    def __init__(self, figure: Figure) -> None:
        self._figure, self._height = figure, float(figure.height)
        x = np.concatenate([mark.x for mark in figure.marks if "x" in mark.columns])
        self._x = figure.x_range or (float(x.min()), float(x.max()))
        self._y = figure.y_range or self._reach()

    def markup(self) -> str:
        f, middle = self._figure, 0.5 * (_LEFT + _RIGHT)
        title = f'<text class="title" x="6" y="12">{escape(f.y_title)}</text>'
        below = (
            f'<text class="title" x="{middle:.0f}" y="{self._height - 4:.0f}" text-anchor="middle">{escape(f.x_title)}'
        )
        marks = "".join(self._band(m) for m in f.marks if m.kind == "band")
        marks += "".join(self._line(m) for m in f.marks if m.kind == "line")
        names = f"{f.y_title} over {f.x_title}: {', '.join(dict.fromkeys(m.name for m in f.marks if m.name))}"
        return (
            f'<svg class="curve" viewBox="0 0 {_WIDTH:.0f} {self._height:.0f}" role="img" aria-label="{escape(names)}">'
            f"{''.join(self._axes())}{marks}{title}{below}</text></svg>"
        )

    def _reach(self) -> tuple[float, float]:
        ends = [mark.columns[key] for mark in self._figure.marks for key in ("y", "low", "high") if key in mark.columns]
        y = np.concatenate(ends)
        low, high = min(0.0, float(np.nanmin(y))), max(0.0, float(np.nanmax(y)))
        return (1.06 * low, 1.06 * high) if high > low else (-1.0, 1.0)

    def _at(self, x: float, y: float) -> tuple[float, float]:
        (x0, x1), (y0, y1) = self._x, self._y
        across, up = (x - x0) / (x1 - x0), (y - y0) / (y1 - y0)
        return _LEFT + across * (_RIGHT - _LEFT), self._height - _BOTTOM - up * (self._height - _BOTTOM - _TOP)

    def _axes(self) -> Iterator[str]:
        """Yield the lines of the grid with their numbers."""
        for value, text in ticks(*self._x, 6, "deg" in self._figure.x_title):
            x, bottom = self._at(value, self._y[0])
            yield f'<path class="grid" d="M{x:.1f} {_TOP:.0f}V{bottom:.1f}"/>'
            yield f'<text x="{x:.1f}" y="{bottom + 15:.1f}" text-anchor="middle">{text}</text>'
        for value, text in ticks(*self._y, 4):
            y = self._at(self._x[0], value)[1]
            yield f'<path class="{"grid zero" if value == 0.0 else "grid"}" d="M{_LEFT:.0f} {y:.1f}H{_RIGHT:.0f}"/>'
            yield f'<text x="{_LEFT - 5:.0f}" y="{y + 4:.1f}" text-anchor="end">{text}</text>'

    def _line(self, mark: Mark) -> str:
        pieces, pen = [], "M"
        for x, y in zip(mark.x.tolist(), mark.y.tolist(), strict=True):
            if y != y:
                pen = "M"
                continue
            pieces.append("{}{:.1f} {:.1f}".format(pen, *self._at(x, y)))
            pen = "L"
        dash = f' stroke-dasharray="{_DASHES[mark.dash]}"' if mark.dash != "solid" else ""
        style = f"stroke:var(--{mark.color});stroke-width:{mark.size:g}"
        return f'<path class="line" style="{style}"{dash} d="{"".join(pieces)}"/>'

    def _band(self, mark: Mark) -> str:
        columns = (mark.x.tolist(), mark.columns["low"].tolist(), mark.columns["high"].tolist())
        there = [self._at(x, high) for x, _, high in zip(*columns, strict=True)]
        back = [self._at(x, low) for x, low, _ in zip(*columns, strict=True)]
        outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in [*there, *back[::-1]])
        return f'<polygon style="fill:var(--{mark.color});fill-opacity:{mark.alpha:g}" points="{outline}"/>'


def ticks(low: float, high: float, count: int, angles: bool = False) -> list[tuple[float, str]]:
    """Return at most `count` round values between two limits, with their texts; of angles multiples of 15 deg."""
    steps = _ANGLES if angles and high - low > _ANGLES[0] * 2 else ()
    base = 10.0 ** np.floor(np.log10((high - low) / count))
    step = float(next(s for s in (*steps, *(m * base for m in _STEPS)) if (high - low) / s <= count))
    places = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    digits = next((n for n in range(6) if abs(round(step, n) - step) < 1e-9 * step), 6)
    return [
        (float(v), f"{v:.{digits}f}".replace("-", "\N{MINUS SIGN}") if abs(v) > 1e-9 * step else "0") for v in places
    ]


def interval_bar(interval: Interval) -> str:
    """Return an SVG bar of +-2 sigma over one of +-2 required, 84 x 14 px; a triangle marks the truth."""
    if not interval.sigma > 0.0:
        return ""
    width, half = 84.0, 36.0
    scale = half / (2.0 * interval.require if interval.require else 3.0 * interval.sigma)
    reach = min(max(2.0 * interval.sigma * scale, 1.2), width / 2.0)
    track = (
        f'<rect class="track" x="{width / 2 - half:.1f}" y="5" width="{2 * half:.1f}" height="7" rx="2"/>'
        if interval.require
        else f'<path class="none" d="M2 8.5H{width - 2:.0f}"/>'
    )
    middle = width / 2 + min(max(interval.offset * scale, -half), half)
    bar = f'<rect class="bar" x="{middle - reach:.1f}" y="4" width="{2 * reach:.1f}" height="9" rx="1"/>'
    over = f'<path class="over" d="M3 8.5l4-3v6zM{width - 3:.0f} 8.5l-4-3v6z"/>' if reach > width / 2 - 1 else ""
    truth = ""
    if interval.error is not None:
        at = width / 2 - min(max(interval.error * scale, 3.0 - width / 2), width / 2 - 3.0)
        truth = f'<path class="truth" d="M{at:.1f} 4.5l-3-4.5h6z"/>'
    size = 'viewBox="0 0 84 14" width="84" height="14" aria-hidden="true"'
    return f'<svg class="interval" {size}>{track}{bar}{over}{truth}</svg>'
