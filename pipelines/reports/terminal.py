"""Reports in a terminal: tables whose cells are never broken, sentences, last what is to be copied; facts as JSON."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text as RichText

from alidade.pipelines.display.table import Column, Table
from alidade.pipelines.errors import printable
from alidade.pipelines.files import plain_json
from alidade.pipelines.reports.report import Block, Bullets, Card, Code, Details, Heading, Report, Tables, Text, Tiles

if TYPE_CHECKING:
    from alidade.pipelines.applications.discovery import Suggestion
    from alidade.pipelines.applications.table_discovery import Columns
    from alidade.pipelines.recording.topics import SessionFacts

# A narrower terminal breaks the lines itself: columns would be left out, and at a width of 0 everything.
_MIN_WIDTH = 72
console = Console(highlight=False)
if console.width < _MIN_WIDTH:
    console.width = _MIN_WIDTH
# Characters of a line, and of lines into which sentences are broken.
_MAX_LINE, _SENTENCE = 10_000, 100
# The types of messages in what a method lacks: reference/messages.md has them.
_TYPE = re.compile(r" \(\w+/msg/\w+\)")

COLOURS = {
    "calibrated": "green",
    "observable": "green",
    "good": "green",
    "weak": "yellow",
    "prior": "yellow",
    "warn": "yellow",
    "unobservable": "red",
    "inconsistent": "red",
    "bad": "red",
    "fixed": "dim",
}


def say(text: str) -> None:
    """Print one line, never broken."""
    console.print(escape(printable(text, _MAX_LINE)), soft_wrap=True)


def print_report(report: Report, everything: bool = False) -> None:
    """Print the summary of a report, its tables and lists, and last what is to be copied.

    Args:
        report: to print.
        everything: also what a page collapses, and sections that are printed on request.
    """
    summary = report.summary
    if summary is not None:
        answered = f"{summary.question} {summary.answer}. {summary.text}".lstrip()
        _paragraph(answered, f"{summary.answer}.", f"bold {COLOURS[summary.tone]}")
        for line in (*(f"note: {note}" for note in summary.notes), *summary.next_steps):
            _paragraph(f"  {line}")
        if summary.badges:
            _paragraph(f"  {' · '.join(badge.text for badge in summary.badges)}")
        console.print()
    asked = ("always", "on request") if everything else ("always",)
    sections = [section for section in report.sections if section.blocks and section.printed in asked]
    for section in sections:
        _print_blocks(section.title, section.blocks, everything)
    for code in (block for section in sections for block in section.blocks if isinstance(block, Code)):
        for line in code.text.splitlines():
            say(line)


def _paragraph(text: str, marked: str = "", style: str = "") -> None:
    """Print a sentence, broken between words for people, with marked words in a style."""
    text = printable(text.replace("`", ""), _MAX_LINE)
    indent = " " * (len(text) - len(text.lstrip()) + 2)
    width = min(console.width, _SENTENCE) if console.is_terminal else _MAX_LINE
    lines = textwrap.wrap(text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    for i, line in enumerate(lines):
        shown = RichText(line)
        if marked and not i:
            shown.highlight_words([marked], style)
        console.print(shown, soft_wrap=True)


def _print_blocks(title: str, blocks: Sequence[Block], everything: bool) -> None:
    """Print the blocks that a terminal can show under their heading; collapsed ones only if `everything`."""
    kinds = (Heading, Text, Table, Tables, Bullets, Tiles, *((Card, Details) if everything else ()))
    shown = [block for block in blocks if isinstance(block, kinds) and not (isinstance(block, Text) and block.style)]
    if title and shown and not all(isinstance(block, Tables) for block in shown):
        say(title)
    for block in shown:
        match block:
            case Heading(text):
                say(text)
            case Text(text):
                _paragraph(f"  {text}")
            case Table():
                print_table(block)
            case Tables(tables):
                for table in tables:
                    print_table(table)
            case Bullets(items):
                for item in items:
                    _paragraph(f"  {item}")
            case Tiles(tiles):
                rows = tuple((tile.label, f"{tile.figure} {tile.unit}", tile.note) for tile in tiles)
                print_table(Table("", "", ("", "", Column("", "text")), rows))
            case Card(inner, heading) | Details(heading, inner):
                _print_blocks(heading, inner, everything)


def print_table(table: Table) -> None:
    """Print a table; groups of columns beyond the terminal's width follow below, with the shared columns repeated."""
    if table.title and table.style != "results":  # those have it above their first column
        say(table.title)
    shown = [i for i, head in enumerate(table.heads) if head.kind != "drawing"]
    groups = {head.group: [i for i in shown if table.heads[i].group == head.group] for head in table.heads}
    shared = groups.pop("", [])
    parts: list[list[int]] = [[]]
    for group in groups.values():
        if parts[-1] and _width(rich_table(table, [*shared, *parts[-1], *group])) > console.width:
            parts.append([])
        parts[-1] += group
    for part in parts:
        drawn = rich_table(table, sorted([*shared, *part]))
        if not any(head.kind == "prose" for head in table.heads):
            drawn.width = _width(drawn)  # no number is broken or left out, however narrow the terminal
        console.print(drawn, soft_wrap=True)
        for heading in (row[0] for row in table.cells if len(row) == 1 and row[0].small):
            say(f"{heading.text}: {heading.small}")
        console.print()
    if groups and table.caption:
        _paragraph(table.caption)


def rich_table(table: Table, columns: Sequence[int] | None = None) -> RichTable:
    """Return a table, or some of its columns, for rich, the names of the rows to the left."""
    columns = range(len(table.heads)) if columns is None else columns
    named = any(head.head for head in table.heads)
    out = RichTable(box=SIMPLE_HEAD, header_style="bold", pad_edge=False, show_edge=False, show_header=named)
    for i in columns:
        head = table.heads[i]
        justify: Literal["left", "right"] = "right" if i and head.kind == "number" else "left"
        out.add_column(head.head, justify=justify, no_wrap=head.kind != "prose", overflow="fold")
    heading, alone = "", False
    for k, row in enumerate(table.cells):
        if len(row) == 1 < len(table.heads):
            heading, alone = row[0].text, all(len(after) == 1 for after in table.cells[k + 2 : k + 3])
            continue
        cells = (f"{cell.text} {cell.tone}" if cell.tone and cell.hint else cell.text for cell in row[1:])
        texts = [heading if alone else _under(heading, row[0].text), *cells]
        out.add_row(*(RichText(printable(texts[i], _MAX_LINE), COLOURS.get(row[i].tone, "")) for i in columns))
    return out


def _under(heading: str, name: str) -> str:
    """Return the name of a row with the heading above it: "x" under "Bias, mg" is "Bias x, mg"."""
    what, comma, unit = heading.rpartition(", ")
    return f"{what if comma else unit} {name}{comma}{unit if comma else ''}".strip()


def _width(table: RichTable) -> int:
    return Measurement.get(console, console.options.update(max_width=_MAX_LINE), table).maximum


def as_text(report: Report) -> str:
    """The text that `print_report` prints, without colours."""
    with console.capture() as capture:
        print_report(report)
    return RichText.from_ansi(capture.get()).plain.rstrip()


def print_facts(
    name: str,
    facts: SessionFacts,
    found: Sequence[Suggestion] = (),
    unused: Sequence[str] = (),
    columns: Columns | None = None,
) -> None:
    """Print what a recording can calibrate and with which topics, what each method lacks, then its topics."""
    say(f"{name}, {facts.duration_s:.1f} s")
    _print_columns(columns)
    _print_methods(facts, found, columns)
    proposed = {str(name) for each in found for source in each.topics.values() for _, name in source}
    if left := [name for name in unused if name not in proposed]:
        _paragraph(f"not used: {', '.join(left)}")
    for note in facts.notes:
        _paragraph(f"note: {note}")
    rows = []
    for t in facts.topics:
        gap = "" if t.largest_gap_s is None or t.rate_hz is None else f"{t.largest_gap_s:.2g}"
        if t.largest_gap_s is not None and t.rate_hz is not None and t.largest_gap_s * t.rate_hz > 2:
            gap += f" at {t.largest_gap_at_s:.0f}"
        rate = "" if t.rate_hz is None else f"{t.rate_hz:.4g}"
        kind = t.type.rsplit("/", 1)[-1]
        rows.append((t.name, kind, str(t.count), rate, gap, str(t.duplicates), str(t.out_of_order)))
    heads = ("messages", "Hz", "gap, s", "dupli-\ncates", "out of\norder")
    print_table(Table("", "", ("topic", Column("type", "prose"), *heads), tuple(rows)))
    if facts.attachments:
        say(f"attachments: {', '.join(facts.attachments)}")


def _print_columns(columns: Columns | None) -> None:
    """Print the proposed section `columns`, with reasons and doubts."""
    if columns is None:
        return
    if columns.columns:
        console.print("[yellow]tables, proposed (use `calibrate --auto-columns` or paste into the config):[/]")
        for line in columns.yaml.split("\n"):
            say(f"  {line}")
    for sentence in (*columns.reasons, *(f"check: {doubt}" for doubt in columns.doubts)):
        _paragraph(f"  {sentence}")


def _print_methods(facts: SessionFacts, found: Sequence[Suggestion], columns: Columns | None) -> None:
    """Print the methods that a recording serves, those it could with other topics, and what the others lack."""
    for method, missing in facts.missing.items():
        if not missing:
            console.print(f"[green]{method}: yes[/]")
            for key in facts.proposed.get(method, ()):
                _paragraph(f"  proposed for the config: {key}")
    for suggestion in found:
        if not suggestion.missing:
            name = f"--method {suggestion.method} " if suggestion.has_to_be_asked_for else ""
            tables = "--auto-columns " if columns is not None and columns.columns else ""
            how = f"use `calibrate {name}{tables}--auto-topics` or paste them into the config"
            console.print(f"[yellow]{suggestion.method}: yes, with these topics ({how}):[/]")
            for reason in suggestion.reasons:
                _paragraph(f"  {reason}")
            for line in suggestion.yaml.split("\n"):
                say(f"  {line}")
        elif not suggestion.topics:
            _paragraph(f"{suggestion.method}: {'; '.join(suggestion.reasons)}")
    whole = {suggestion.method for suggestion in found if not suggestion.missing}
    for method, missing in facts.missing.items():
        if missing and method not in whole:
            _paragraph(f"{method}: missing {_TYPE.sub('', '; '.join(missing))}")


def facts_json(
    facts: SessionFacts, found: Sequence[Suggestion], unused: Sequence[str], columns: Columns | None = None
) -> str:
    """JSON text of `info`: a recording's facts, and the topics that each method finds, lacks or could use."""
    suggested = {suggestion.method: suggestion for suggestion in found}
    content = asdict(facts)
    proposed = content.pop("proposed")
    content["methods"] = {
        name: {
            "served": not missing,
            "missing": missing,
            "proposed": proposed.get(name, ()),
            "suggested": {key: source.model_dump() for key, source in suggested[name].topics.items()}
            if name in suggested
            else {},
            "reasons": suggested[name].reasons if name in suggested else (),
            "still_missing": suggested[name].missing if name in suggested else missing,
        }
        for name, missing in content.pop("missing").items()
    }
    if columns is not None:
        tables = {topic: table.model_dump(exclude_defaults=True) for topic, table in columns.columns.items()}
        content["columns"] = {"columns": tables, "reasons": list(columns.reasons), "doubts": list(columns.doubts)}
    return plain_json("info", content | {"unused": list(unused)})
