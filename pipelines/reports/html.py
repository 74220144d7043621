"""A report as one HTML file that opens offline, and in a frame of a notebook.

The page forbids itself any access to the network (Content-Security-Policy): a report seen anywhere shows what it shows
here. Figures are drawn by BokehJS, which is in the page, compressed.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.metadata import distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.display.figure import PALETTE, Figure, Mark, Plot
from alidade.pipelines.display.svg import interval_bar, svg
from alidade.pipelines.display.table import Cell, Column, Table
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
        from alidade.pipelines.reports.whole import write_file

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
    from markupsafe import Markup, escape

    return Markup(_CODE.sub(r"<code>\1</code>", str(escape(text))))


def _classes(cell: Cell, column: Column, table: Table) -> str:
    """Return the attribute `class` of a cell in HTML."""
    from markupsafe import Markup

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
    return {**vars(figure), "marks": [_mark(mark, figure.x_scale == "datetime") for mark in figure.marks]}


def _mark(mark: Mark, dates: bool) -> dict[str, Any]:
    columns = {
        name: _numbers(column, dates and name in ("x", "x1", "left", "right")) for name, column in mark.columns.items()
    }
    return {**vars(mark), "texts": list(mark.texts), "columns": columns}


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
