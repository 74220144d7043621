"""How all pages are made: templates, and their figures with the library that draws them, packed."""

from __future__ import annotations

import base64
import gzip
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.display.figure import PALETTE, Figure, Mark
from alidade.pipelines.estimation.problem import Array

if TYPE_CHECKING:
    from jinja2 import Environment

    from alidade.pipelines.reports.result import Plot

# A figure of more px than this is as broad as the page.
_TALL = 380
_CODE = re.compile(r"`([^`]+)`")
_SCRIPT = Path(__file__).parent / "templates" / "figures.js"
_BOKEH = ("bokeh.min.js", "bokeh-api.min.js")
# Of 24 bits of a number so many are as good as nothing in a picture, and pack badly.
_DROPPED = 8


@dataclass(frozen=True)
class Drawn:
    """A plot with its place among those of the page.

    Attributes:
        title, caption: of the plot.
        number: its place.
        figures: side by side.
        legend: a mark for each name.
    """

    title: str
    caption: str
    number: int
    figures: tuple[Figure, ...]
    legend: tuple[Mark, ...]

    @property
    def broad(self) -> bool:
        """Whether it wants the whole width."""
        return len(self.figures) > 1 or self.figures[0].height > _TALL


@cache
def environment(package: str) -> Environment:
    """Templates of a package on top of the base of all: every string escaped, a name that is not given is an error."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("alidade.pipelines.reports")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["coded"] = _coded
    made.globals |= {"palette": PALETTE, "drawing": (), "drawing_script": _SCRIPT.read_text(encoding="utf-8")}
    return made


def page(package: str, template: str, plots: Sequence[Plot], **context: Any) -> str:
    """A page as one HTML text that opens offline, with figures; the template has them as `plots`, see `Drawn`."""
    drawn = [_drawn(plot, number) for number, plot in enumerate(plots)]
    return (
        environment(package)
        .get_template(template)
        .render(plots=drawn, drawing=_packed([each.figures for each in drawn]) if drawn else (), **context)
    )


def _coded(text: str) -> str:
    """A sentence as HTML, what stands between backquotes as code."""
    from markupsafe import Markup, escape

    return Markup(_CODE.sub(r"<code>\1</code>", str(escape(text))))


def _drawn(plot: Plot, number: int) -> Drawn:
    figures = (plot.figure, *plot.beside)
    legend = {mark.name: mark for figure in figures for mark in reversed(figure.marks) if mark.shown}
    order = dict.fromkeys(mark.name for figure in figures for mark in figure.marks if mark.shown)
    return Drawn(plot.title, plot.caption, number, figures, tuple(legend[name] for name in order))


def _packed(plots: Sequence[Sequence[Figure]]) -> tuple[tuple[str, str], ...]:
    """The library, the figures and their numbers, each compressed and in base64, by the ids that the script knows."""
    places: dict[bytes, int] = {}
    columns: list[NDArray[np.float32]] = []

    def placed(column: Array, origin: float) -> list[float]:
        numbers = (column - origin).astype(np.float32)
        key = numbers.tobytes()
        if key not in places:
            places[key] = sum(map(len, columns))
            columns.append(numbers)
        return [places[key], len(numbers), origin]

    def described(figure: Figure) -> dict[str, Any]:
        said = {name: value for name, value in vars(figure).items() if name != "marks"}
        return {**said, "marks": [_mark(mark, figure, placed) for mark in figure.marks]}

    text = json.dumps([[described(figure) for figure in figures] for figures in plots], separators=(",", ":"))
    numbers = np.concatenate(columns) if columns else np.zeros(0, dtype=np.float32)
    return ("bokeh", _bokeh()), ("figures", _compressed(text.encode())), ("numbers", _compressed(_planes(numbers)))


def _mark(mark: Mark, figure: Figure, placed: Any) -> dict[str, Any]:
    # Dates have more digits than the packed numbers: these count from a date of their own.
    dates = figure.x_scale == "datetime"
    columns = {}
    for key, column in mark.columns.items():
        far = dates and key in ("x", "x1", "left", "right") and np.isfinite(column).any()
        columns[key] = placed(column, float(np.floor(np.nanmin(column))) if far else 0.0)
    said = {name: value for name, value in vars(mark).items() if name not in ("columns", "shown")}
    return {**said, "texts": list(mark.texts), "columns": columns}


def _planes(numbers: NDArray[np.float32]) -> bytes:
    """Rounded numbers by bytes: first bytes of all, second bytes of all, ..., which packs better."""
    bits = numbers.view(np.uint32)
    rounded = (bits + np.uint32(1 << (_DROPPED - 1))) & np.uint32(0xFFFFFFFF << _DROPPED & 0xFFFFFFFF)
    return np.where(np.isfinite(numbers), rounded, bits).view(np.uint8).reshape(-1, 4).T.tobytes()


@cache
def _bokeh() -> str:
    """BokehJS from the installed package, which takes long to import and is not needed for it."""
    folder = Path(str(distribution("bokeh").locate_file("bokeh/server/static/js")))
    return _compressed(b"\n".join((folder / name).read_bytes() for name in _BOKEH))


def _compressed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()
