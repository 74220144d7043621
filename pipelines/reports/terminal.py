"""Reports in a terminal: tables whose cells are never broken, sentences, and what is to be copied last."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text as RichText

from alidade.pipelines.display.table import Cell, Column, Table
from alidade.pipelines.display.units import rounded
from alidade.pipelines.errors import printable
from alidade.pipelines.reports.report import Block, Bullets, Code, Report, Tables

if TYPE_CHECKING:
    from alidade.pipelines.applications.discovery import Suggestion
    from alidade.pipelines.applications.table_discovery import Columns
    from alidade.pipelines.estimation.finding import Finding
    from alidade.pipelines.recording.info import SessionFacts
    from alidade.pipelines.reports.result import Calibration

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


def print_report(report: Report) -> None:
    """Print the tables and lists of a report, then its summary, then what is to be copied."""
    sections = [section for section in report.sections if section.blocks and not section.page_only]
    for section in sections:
        _print_blocks(section.title, section.blocks)
    if report.summary is not None:
        say(report.summary.text.replace("`", ""))
        for note in report.summary.notes:
            say(f"  note: {note}")
        for step in report.summary.next_steps:
            say(f"  {step.replace('`', '')}")
    for code in (block for section in sections for block in section.blocks if isinstance(block, Code)):
        for line in code.text.splitlines():
            say(line)


def _print_blocks(title: str, blocks: Sequence[Block]) -> None:
    """Print those that a terminal can show, under their heading."""
    shown = [block for block in blocks if isinstance(block, (Table, Tables, Bullets))]
    if title and shown:
        say(title)
    for block in shown:
        match block:
            case Table():
                print_table(block)
            case Tables(tables):
                for table in tables:
                    print_table(table)
            case Bullets(items):
                for item in items:
                    say(f"  {item.replace('`', '')}")


def print_table(table: Table) -> None:
    """Print a table; groups of columns that the terminal is too narrow for follow below, the other columns repeated."""
    shown = [i for i, head in enumerate(table.heads) if head.kind != "drawing"]
    groups = {head.group: [i for i in shown if table.heads[i].group == head.group] for head in table.heads}
    shared = groups.pop("", [])
    parts: list[list[int]] = [[]]
    for group in groups.values():
        if parts[-1] and _width(_rich(table, [*shared, *parts[-1], *group])) > console.width:
            parts.append([])
        parts[-1] += group
    for part in parts:
        drawn = _rich(table, sorted([*shared, *part]))
        if not any(head.kind == "prose" for head in table.heads):
            drawn.width = _width(drawn)  # no number is broken or left out, however narrow the terminal
        console.print(drawn, soft_wrap=True)
        console.print()
    if groups and table.caption:
        say(table.caption)


def _rich(table: Table, columns: Sequence[int]) -> RichTable:
    """The table with some of its columns, the names of the rows to the left."""
    out = RichTable(box=SIMPLE_HEAD, header_style="bold", pad_edge=False, show_edge=False)
    for i in columns:
        head = table.heads[i]
        justify: Literal["left", "right"] = "right" if i and head.kind == "number" else "left"
        out.add_column(head.head, justify=justify, no_wrap=head.kind != "prose", overflow="fold")
    for row in table.cells:
        row = row if len(row) > 1 else (*row, *(Cell(""),) * (len(table.heads) - 1))
        out.add_row(*(RichText(printable(row[i].text, _MAX_LINE), COLOURS.get(row[i].tone, "")) for i in columns))
    return out


def _width(table: RichTable) -> int:
    return Measurement.get(console, console.options.update(max_width=_MAX_LINE), table).maximum


def print_calibrations(calibrations: Sequence[Calibration]) -> None:
    """Print one table of all solvers, then the verdict of each."""
    from alidade.pipelines.reports.comparison_report import solver_table

    print_table(solver_table(calibrations))
    for calibration in calibrations:
        _print_verdict(calibration, name=len(calibrations) > 1)


def as_text(calibrations: Sequence[Calibration]) -> str:
    """The text that `print_calibrations` prints, without colours."""
    with console.capture() as capture:
        print_calibrations(calibrations)
    return RichText.from_ansi(capture.get()).plain.rstrip()


def show_json(calibrations: Sequence[Calibration]) -> None:
    """Print result.json of one calibration; of several a list of them."""
    from alidade.pipelines.reports.result_json import result_json

    texts = [result_json(calibration).rstrip() for calibration in calibrations]
    print(texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]")


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
    _print_methods(facts, found)
    proposed = {str(name) for each in found for source in each.topics.values() for _, name in source}
    if left := [name for name in unused if name not in proposed]:
        _say_wrapped(f"not used: {', '.join(left)}")
    for note in facts.notes:
        _say_wrapped(f"note: {note}")
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


def _say_wrapped(text: str) -> None:
    """Print lines that fit, those after the first indented; words are left whole."""
    lines = textwrap.wrap(text, _SENTENCE, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    for line in [text[: len(text) - len(text.lstrip())] + lines[0].lstrip(), *lines[1:]] if lines else []:
        say(line)


def _print_columns(columns: Columns | None) -> None:
    """Print the proposed section `columns`, with reasons and doubts."""
    if columns is None:
        return
    if columns.columns:
        console.print("[yellow]tables, proposed (use `calibrate --auto-columns` or paste into the config):[/]")
        for line in columns.yaml.split("\n"):
            say(f"  {line}")
    for sentence in (*columns.reasons, *(f"in doubt: {doubt}" for doubt in columns.doubts)):
        _say_wrapped(f"  {sentence}")


def _print_methods(facts: SessionFacts, found: Sequence[Suggestion]) -> None:
    """Print the methods that are served, those that could be with other topics, and what the others lack."""
    for method, missing in facts.missing.items():
        if not missing:
            console.print(f"[green]{method}: yes[/]")
            for key in facts.proposed.get(method, ()):
                _say_wrapped(f"  proposed for the config: {key}")
    for suggestion in found:
        if not suggestion.missing:
            name = f"--method {suggestion.method} " if suggestion.has_to_be_asked_for else ""
            how = f"use `calibrate {name}--auto-topics` or paste them into the config"
            console.print(f"[yellow]{suggestion.method}: yes, with these topics ({how}):[/]")
            for reason in suggestion.reasons:
                _say_wrapped(f"  {reason}")
            for line in suggestion.yaml.split("\n"):
                say(f"  {line}")
        elif not suggestion.topics:
            _say_wrapped(f"{suggestion.method}: {'; '.join(suggestion.reasons)}")
    whole = {suggestion.method for suggestion in found if not suggestion.missing}
    for method, missing in facts.missing.items():
        if missing and method not in whole:
            _say_wrapped(f"{method}: missing {_TYPE.sub('', '; '.join(missing))}")


def _print_verdict(calibration: Calibration, name: bool) -> None:
    published = calibration.estimate.solver == "published"
    solver = f"{calibration.estimate.solver}: " if name else ""
    headline, status = calibration.headline, calibration.status
    if published and calibration.directions:
        # The published solvers know their own model only, so they give no advice.
        short = [p.name for p in calibration.parameters.values() if p.observability in ("weak", "unobservable")]
        headline = f"By its own sigmas less accurate than required: {', '.join(short)}."
    console.print(f"{solver}[bold {COLOURS[status]}]{status}.[/] {escape(headline)}", soft_wrap=True)
    _print_directions(() if published else calibration.directions)
    for note in calibration.notes:
        say(f"  note: {note}")
    for line in _uses(calibration) if not name else ():
        say(f"  {line}")


def _uses(calibration: Calibration) -> list[str]:
    """Error before and after calibration, a line a use."""
    uses = calibration.uses
    width = max((len(found.use.label) for found in uses), default=0)
    return [
        f"{found.use.label:{width}}  {rounded(found.before, 3)} {found.use.unit} before, "
        f"{'± ' if found.use.signed else ''}{rounded(found.after)} {found.use.unit} after (95 %)"
        for found in uses
    ]


def _print_directions(directions: Sequence[Finding]) -> None:
    """Print a line a direction: verdict, parameters, advice."""
    from alidade.pipelines.reports.sentences import label

    for direction in directions:
        e = direction.evidence
        say(f"  {direction.severity.name.lower()}: {label(e['weights'])}: {e['advice']}")
