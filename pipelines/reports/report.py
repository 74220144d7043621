"""The view model of all pages, terminal output and notebooks: a summary, and sections of blocks.

`html.py` renders a report as one page, `terminal.py` prints it; whoever has something to show builds a `Report`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from alidade.pipelines.display.figure import Figure, Plot
from alidade.pipelines.display.table import Table

Tone = Literal["good", "warn", "bad", "fixed"]


@dataclass(frozen=True)
class Summary:
    """The first box of a page: a question, its answer, and what to do next.

    Attributes:
        question: that the report answers.
        answer: in a few words.
        tone: good, warn, bad, or fixed where it is neither.
        text: the answer in sentences; `code` stands between backquotes.
        notes: what a reader must know beside it, without full stops.
        next_steps: what to do now, one sentence each.
        badges: what matters beside it, in a few words each.
    """

    question: str
    answer: str
    tone: Tone
    text: str
    notes: tuple[str, ...] = ()
    next_steps: tuple[str, ...] = ()
    badges: tuple[Badge, ...] = ()


@dataclass(frozen=True)
class Badge:
    """A remark of a few words; `hint` where it is pointed at."""

    text: str
    tone: Tone
    hint: str = ""


@dataclass(frozen=True)
class Heading:
    """A subheading within a section of a report."""

    text: str


@dataclass(frozen=True)
class Text:
    """A paragraph, in small print if "soft", or a line to sign with the name below; `code` is between backquotes."""

    text: str
    style: Literal["soft", "", "signature"] = "soft"


@dataclass(frozen=True)
class Bullets:
    """A list of sentences; `code` stands between backquotes."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Code:
    """Preformatted text; `copied`: with a button that copies it."""

    text: str
    copied: bool = False


@dataclass(frozen=True)
class Svg:
    """A drawing of the project's own, as SVG."""

    markup: str


@dataclass(frozen=True)
class Details:
    """Blocks that a page collapses under a summary line; `style` and `id` are those of style.css."""

    summary: str
    blocks: tuple[Block, ...]
    style: str = ""
    id: str = ""


@dataclass(frozen=True)
class Card:
    """Blocks in one box; `style` and `id` are those of style.css."""

    blocks: tuple[Block, ...]
    title: str = ""
    id: str = ""
    style: str = ""


@dataclass(frozen=True)
class Plots:
    """Figures side by side."""

    plots: tuple[Plot, ...]


@dataclass(frozen=True)
class Tables:
    """Tables beside one another: on paper, or, in the style "cards", wherever there is room."""

    tables: tuple[Table, ...]
    style: Literal["tables", "cards", "pair"] = "tables"


@dataclass(frozen=True)
class Pairs:
    """List of names, each with what it stands for."""

    items: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Tile:
    """A headline figure: what of, the figure with its unit, and a line below."""

    label: str
    figure: str
    unit: str
    note: str
    tone: str = ""


@dataclass(frozen=True)
class Tiles:
    """Headline figures side by side."""

    tiles: tuple[Tile, ...]


@dataclass(frozen=True)
class Curves:
    """Small figures beside one another, each with its caption, and one legend: name, colour and dash of each line."""

    figures: tuple[tuple[str, Figure], ...]
    legend: tuple[tuple[str, str, str], ...]


Block = Heading | Tiles | Curves | Pairs | Text | Bullets | Code | Svg | Details | Card | Plots | Tables | Table


@dataclass(frozen=True)
class Section:
    """Blocks under a heading; `printed`: whether in a terminal, `narrow_collapsed`: collapsed on a phone."""

    title: str
    blocks: tuple[Block, ...]
    printed: Literal["always", "on request", "never"] = "always"
    narrow_collapsed: bool = False


@dataclass(frozen=True)
class Report:
    """Report as data: sections with their blocks, which html.py and terminal.py render.

    Attributes:
        title: of the window.
        heading: of the page.
        about: the line below the heading.
        sections: in their order; those without blocks are left out.
        summary: what comes first.
        style: of the page.
    """

    title: str
    heading: str
    about: str
    sections: tuple[Section, ...]
    summary: Summary | None = None
    style: Literal["", "certificate"] = ""


def plots_of(blocks: Sequence[Block]) -> list[Plot]:
    """Return all plots in some blocks, nested ones included, in the order of the page."""
    found: list[Plot] = []
    for block in blocks:
        match block:
            case Plots(plots):
                found += plots
            case Card(inner) | Details(_, inner):
                found += plots_of(inner)
    return found
