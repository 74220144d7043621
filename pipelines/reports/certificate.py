"""A calibration certificate from result.json and what only people know, in a YAML file.

Its items are those of ISO/IEC 17025:2017, 7.8.2 and 7.8.4. What is not stated is printed as not stated, and listed.
Expanded uncertainties are U = k u, k from Student's t at the effective degrees of freedom (GUM, annex G.4).
"""

from __future__ import annotations

import datetime
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from alidade.factors.chi_square import student
from alidade.pipelines.display.table import Cell, Column, Table
from alidade.pipelines.display.units import minute, shown_unit, to_digits_of
from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.files import MAX_YAML_BYTES, Content, load_yaml, read_bytes, write_whole
from alidade.pipelines.methods import method
from alidade.pipelines.reports.calibration import load_known
from alidade.pipelines.reports.dcc import digital_certificate
from alidade.pipelines.reports.html import render_html
from alidade.pipelines.reports.report import Block, Bullets, Pairs, Report, Section, Summary, Text, Tone
from alidade.pipelines.reports.result_json import Result, read_result
from alidade.pipelines.settings import validated
from alidade.pipelines.solvers.joint import RECORDING

# Of effective degrees of freedom more than this are as good as infinitely many.
_MANY = 1e4

Conformity = Literal["conforms", "does not conform", "no statement"]
_Text = Annotated[str, BeforeValidator(lambda value: value.isoformat() if isinstance(value, datetime.date) else value)]


class _Fields(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Limits(_Fields):
    """Limits that a parameter is compared with, SI."""

    nominal: float = 0.0
    tolerance: Annotated[float, Field(gt=0.0)]


class Fields(_Fields):
    """Entries of a certificate that only people know; None where not stated."""

    number: _Text | None = None
    country: Annotated[str, Field(pattern="^[A-Z]{2}$")] | None = None  # ISO 3166-1 alpha-2; of the digital one
    laboratory: _Text | None = None
    customer: _Text | None = None
    item: _Text | None = None
    manufacturer: _Text | None = None
    type: _Text | None = None
    serial: _Text | None = None
    place: _Text | None = None
    received: _Text | None = None
    issued: _Text | None = None
    procedure: _Text | None = None
    environment: _Text | None = None
    traceability: _Text | None = None
    adjustment: _Text | None = None
    signatory: _Text | None = None
    remarks: _Text | None = None
    coverage_probability: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.9545
    limits: dict[str, Limits] = {}


@dataclass(frozen=True)
class Row:
    """A parameter with its expanded uncertainty, SI.

    Attributes:
        name, unit, value: of the parameter.
        standard: uncertainty.
        degrees: effective degrees of freedom; None: infinitely many.
        coverage: k.
        expanded: U.
        before: an earlier value; None where there is none.
        conformity: to its limits; None where it has none.
        budget: source -> share of the variance.
    """

    name: str
    unit: str
    value: float
    standard: float
    degrees: float | None
    coverage: float
    expanded: float
    before: float | None
    conformity: Conformity | None
    budget: Mapping[str, float]


def _recordings(result: Result) -> list[dict[str, Any]]:
    """Return the recordings that a result is from, as mappings; a single recording has no name there."""
    keys = ("recording", "sha256", "start", "duration_s", "dof")
    each: Sequence[object] = result.recordings or [result.session]
    return [{key: getattr(one, key, "" if key == "recording" else None) for key in keys} for one in each]


def certificate(
    results: str | Path,
    fields: str | Path | None = None,
    *,
    before: str | Path | None = None,
    out: str | Path | None = None,
    pdf: bool = False,
    dcc: bool = False,
) -> tuple[tuple[Path, ...], list[str]]:
    """Write a calibration certificate from a result; returns its files and the fields that are not stated.

    Args:
        results: folder of a calibration, or its result.json.
        fields: YAML; None: nothing is stated.
        before: an earlier calibration of the item, result.json or calibration.yaml, as found against it.
        out: folder; None: that of the results.
        pdf: print it, by WeasyPrint.
        dcc: write a Digital Calibration Certificate.

    Raises:
        InputError: a file cannot be used, the result is none to certify, there is no WeasyPrint that works, or a field
            that a digital certificate needs is not stated.
    """
    path, earlier_path = Path(results), None if before is None else Path(before)
    path = path / "result.json" if path.is_dir() else path
    result = read_result(path)
    given = None if fields is None else load_yaml(read_bytes(Path(fields), MAX_YAML_BYTES), str(fields))
    stated = validated(Fields, given or {}, fields)
    if result.status in ("inconsistent", "unobservable"):
        raise InputError(f"{path}: is {result.status}, there is nothing to certify: {result.headline}")
    earlier = {} if earlier_path is None else load_known(earlier_path).of_method(result.method).values
    rows = _rows(result, stated, earlier)
    for name in stated.limits:
        if name not in {row.name for row in rows}:
            raise InputError(f"{fields}: unknown key limits.{name}{nearest(name, [row.name for row in rows])}")
    missing = [
        name for name, value in stated.model_dump(exclude={"remarks", "limits", "country"}).items() if value is None
    ]
    content = _content(result, stated, rows, missing)
    page = render_html(certificate_report(result, stated, rows, missing, earlier_path))
    matrix = result.covariance
    files: dict[str, Content] = {
        "certificate.html": page,
        "certificate.pdf": _printed(page) if pdf else None,
        "certificate.xml": digital_certificate(content, matrix.order, matrix.matrix) if dcc else None,
        "certificate.json": json.dumps(content, indent=1, allow_nan=False) + "\n",
    }
    return write_whole(path.parent if out is None else Path(out), files), missing


def _rows(result: Result, stated: Fields, earlier: Mapping[str, float]) -> list[Row]:
    rows = []
    for p in result.parameters:
        if p.group is not None or p.require is None or p.sigma == 0.0:
            continue
        shares = (result.budget or {}).get(p.name, {})
        degrees = _effective(result, shares)
        normal = NormalDist().inv_cdf(0.5 + 0.5 * stated.coverage_probability)
        k = normal if degrees is None else student(normal, degrees)
        limits = stated.limits.get(p.name)
        conformity = None if limits is None else _conformity(p.value, k * p.sigma, limits)
        before = earlier.get(p.name)
        rows.append(Row(p.name, p.unit, p.value, p.sigma, degrees, k, k * p.sigma, before, conformity, shares))
    return rows


def _effective(result: Result, shares: Mapping[str, float]) -> float | None:
    """Return effective degrees of freedom (Welch, Satterthwaite) of a variance with these shares; None: very many.

    Noise that was stated and not asked of the recording, and priors, count as known.
    """
    freedoms: dict[str, float | None] = {f"{RECORDING}{part.recording}": part.dof for part in result.recordings or ()}
    if any(noise.estimated is not None for noise in result.noise):
        freedoms |= {name: fit.dof for name, fit in result.chi_square.families.items()}
    doubt = 0.0
    for source, share in shares.items():
        dof = freedoms.get(source)
        if dof is not None:
            doubt += share**2 / max(dof, 1.0)
    return None if doubt * _MANY < 1.0 else 1.0 / doubt


def _conformity(value: float, expanded: float, limits: Limits) -> Conformity:
    """Return the statement of conformity, with a guard band of U: less than 2.5 % of either statement is wrong."""
    off = abs(value - limits.nominal)
    if off + expanded <= limits.tolerance:
        return "conforms"
    return "does not conform" if off - expanded > limits.tolerance else "no statement"


def _content(result: Result, stated: Fields, rows: Sequence[Row], missing: Sequence[str]) -> dict[str, Any]:
    return {
        "schema": "alidade.certificate/1",
        "fields": stated.model_dump(),
        "not_stated": list(missing),
        "method": result.method,
        "solver": result.solver,
        "status": result.status,
        "recordings": _recordings(result),
        "software": result.software,
        "results": [asdict(row) for row in rows],
    }


def certificate_report(
    result: Result, stated: Fields, rows: Sequence[Row], missing: Sequence[str], before: Path | None
) -> Report:
    """Return the certificate as a report."""
    text = {name: "not stated" if value is None else str(value) for name, value in stated.model_dump().items()}
    readable = [_readable(row, result) for row in rows]
    shares = ((row.name, [f"{each} {100.0 * x:.1f} %" for each, x in row.budget.items() if x >= 5e-4]) for row in rows)
    budgets = tuple(f"{name}: {', '.join(sources)}" for name, sources in shares)
    adjustment = Text(f"Adjustment: {text['adjustment']}", style="")
    return Report(
        title=f"Calibration certificate {text['number']}",
        heading="Calibration certificate",
        about="",
        summary=_summary(result, rows, missing),
        sections=(
            Section("Item and calibration", (Pairs(_identity(result, text)),)),
            Section("Results", (_result_table(rows, readable, result, stated),)),
            Section("Conformity", _conformity_table(rows, readable, stated)),
            Section("As found, as left", (*_found_table(rows, readable, before), adjustment)),
            Section("Uncertainty budget", (Bullets(budgets), Text("Shares of the variance of each parameter."))),
            Section("Remarks", (Text(text["remarks"], ""), Text(_RESERVATION), Text(text["signatory"], "signature"))),
        ),
        style="certificate",
    )


_UNIT = Column("unit", "text")
_Readable = tuple[str, Callable[[float], str]]
_RESERVATION = (
    "The results relate only to the item calibrated, as it was then. This certificate may be reproduced only in full, "
    "unless the laboratory has approved of it in writing."
)


def _identity(result: Result, text: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """Return rows on what was calibrated, by whom, when and from which recordings."""
    recordings = _recordings(result)
    first = "recordings" if len(recordings) > 1 else "recording"
    return (
        *((name, text[name]) for name in ("number", "laboratory", "customer", "item")),
        ("manufacturer, type", f"{text['manufacturer']}, {text['type']}"),
        ("serial number", text["serial"]),
        ("received", text["received"]),
        ("calibrated", f"{minute(result.session.start)} UTC"),
        *((name, text[name]) for name in ("issued", "place", "environment", "procedure")),
        ("evaluation", f"method {result.method}, {result.solver} solver, alidade {result.software.get('alidade')}"),
        *(
            (
                "" if i else first,
                f"{part['recording']}{', ' if part['recording'] else ''}{minute(part['start'])} UTC, "
                f"{part['duration_s']:.1f} s, SHA-256 {part['sha256']}",
            )
            for i, part in enumerate(recordings)
        ),
        ("traceability", text["traceability"]),
    )


def _result_table(rows: Sequence[Row], readable: Sequence[_Readable], result: Result, stated: Fields) -> Table:
    columns = ("parameter", "value", "U", _UNIT, "k", "eff. d.o.f.")
    cells = tuple(
        (
            *(Cell(row.name, _meaning(result, row.name)), shown(row.value), shown(row.expanded), unit),
            *(f"{row.coverage:.2f}", "∞" if row.degrees is None else f"{row.degrees:.0f}"),
        )
        for row, (unit, shown) in zip(rows, readable, strict=True)
    )
    caption = (
        "U is the expanded uncertainty: the standard uncertainty multiplied by the coverage factor k, which for "
        "Student's t with the effective degrees of freedom corresponds to a coverage probability of about "
        f"{100.0 * stated.coverage_probability:.4g} %. The status of the calibration is {result.status}."
    )
    return Table("", caption, columns, cells, "results", "", None)


def _conformity_table(rows: Sequence[Row], readable: Sequence[_Readable], stated: Fields) -> tuple[Block, ...]:
    columns = ("parameter", "limits", _UNIT, Column("statement", "text"))
    cells = tuple(
        (row.name, f"{shown(limits.nominal)} ± {shown(limits.tolerance)}", unit, row.conformity)
        for row, (unit, shown) in zip(rows, readable, strict=True)
        if row.conformity and (limits := stated.limits[row.name])
    )
    rule = (
        "Decision rule: guard band of U on either side of each limit. It conforms where the value with U lies within "
        "the limits, it does not where the value with U lies outside them, and in between there is no statement."
    )
    return (Table("", rule, columns, cells, "conformity", "", None),) if cells else ()


def _found_table(rows: Sequence[Row], readable: Sequence[_Readable], before: Path | None) -> tuple[Block, ...]:
    if before is None:
        return ()
    columns = ("parameter", "earlier", "as found", "change", _UNIT)
    cells = tuple(
        (row.name, shown(row.before), shown(row.value), shown(row.value - row.before), unit)
        for row, (unit, shown) in zip(rows, readable, strict=True)
        if row.before is not None
    )
    return (Table("", f"Earlier values are those of {before.name}.", columns, cells, "found", "", None),)


def _summary(result: Result, rows: Sequence[Row], missing: Sequence[str]) -> Summary:
    """Return a summary: fields that are not stated; else conformity with limits, or the status without limits."""
    if missing:
        text = f"{len(missing)} fields are not stated: {', '.join(missing)}."
        steps = ("State them in the file given with `--fields`.",)
        return Summary("Is the certificate complete?", "incomplete", "fixed", text, (), steps)
    statements = [row.conformity for row in rows if row.conformity]
    tone: Tone = "good" if result.status == "calibrated" else "warn"
    if not statements:
        text = f"The status of the calibration is {result.status}; no limits are stated to compare the item with."
        return Summary("Is the item calibrated?", result.status, tone, text)
    within, count = statements.count("conforms"), len(statements)
    answer = "yes" if within == count else "no" if "does not conform" in statements else "no statement"
    text = f"{within} of {count} parameters with limits conform; the status of the calibration is {result.status}."
    return Summary("Is the item within its limits?", answer, tone if answer == "yes" else "bad", text)


def _readable(row: Row, result: Result) -> _Readable:
    """Return the unit people read a row in, and a formatter of SI values with as many digits as U warrants."""
    require = next((p.require for p in result.parameters if p.name == row.name), None)
    unit, factor = shown_unit(row.unit, require)
    return unit, lambda value: to_digits_of(factor * value, factor * row.expanded)


def _meaning(result: Result, name: str) -> str:
    """Meaning of a parameter; empty for a method that is not installed here."""
    with suppress(InputError):
        return method(result.method).describe(name)
    return ""


def _printed(page: str) -> bytes:
    """Return an HTML page as PDF."""
    try:
        from weasyprint import HTML
    except (ImportError, OSError) as error:  # OSError: the system has no Pango
        raise InputError(
            "--pdf needs WeasyPrint, pip install 'alidade[pdf]', and Pango of the system (Debian: apt install "
            "libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0); or print certificate.html by a browser"
        ) from error
    logging.getLogger("weasyprint").setLevel(logging.ERROR)  # else it warns of every style for screens
    out: bytes = HTML(string=page).write_pdf()
    return out
