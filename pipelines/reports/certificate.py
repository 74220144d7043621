"""A calibration certificate from result.json and what only people know, in a YAML file.

Its items are those of ISO/IEC 17025:2017, 7.8.2 and 7.8.4. What is not stated is printed as not stated, and listed.
Expanded uncertainties are U = k u, k from Student's t at the effective degrees of freedom (GUM, annex G.4).
"""

from __future__ import annotations

import datetime
import json
import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from alidade.factors.chi_square import student
from alidade.pipelines.display.units import human_unit, to_digits_of
from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.files import MAX_RESULT_BYTES, MAX_YAML_BYTES, load_yaml, read_bytes
from alidade.pipelines.methods import method
from alidade.pipelines.methods.meanings import meaning
from alidade.pipelines.reports.answer import Answer, Tone
from alidade.pipelines.reports.known import load_known
from alidade.pipelines.reports.templating import environment
from alidade.pipelines.reports.whole import write_whole
from alidade.pipelines.solvers.joint import RECORDING

FILES = ("certificate.html", "certificate.pdf", "certificate.json")
# Of effective degrees of freedom more than this are as good as infinitely many.
_MANY = 1e4

Conformity = Literal["conforms", "does not conform", "no statement"]
Text = Annotated[str, BeforeValidator(lambda value: value.isoformat() if isinstance(value, datetime.date) else value)]


class _Fields(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Limits(_Fields):
    """What a parameter is held against, SI."""

    nominal: float = 0.0
    tolerance: Annotated[float, Field(gt=0.0)]


class Fields(_Fields):
    """What only people know; None where it is not stated."""

    number: Text | None = None
    laboratory: Text | None = None
    customer: Text | None = None
    item: Text | None = None
    manufacturer: Text | None = None
    type: Text | None = None
    serial: Text | None = None
    place: Text | None = None
    received: Text | None = None
    issued: Text | None = None
    procedure: Text | None = None
    environment: Text | None = None
    traceability: Text | None = None
    adjustment: Text | None = None
    signatory: Text | None = None
    remarks: Text | None = None
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


class _Read(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False, populate_by_name=True)


class _Parameter(_Read):
    name: str
    value: float
    sigma: float
    unit: str
    require: float | None
    group: str | None = None


class _Noise(_Read):
    name: str
    estimated: float | None


class _Fit(_Read):
    dof: float | None


class _ChiSquare(_Fit):
    families: dict[str, _Fit]


class _Session(_Read):
    recording: str = ""
    sha256: str
    start: str
    duration_s: float
    dof: float | None = None


class _Result(_Read):
    schema_name: Annotated[Literal["alidade.result/1"], Field(alias="schema")]
    method: str
    solver: str
    status: str
    headline: str
    parameters: list[_Parameter]
    chi_square: _ChiSquare
    noise: list[_Noise]
    session: _Session
    software: dict[str, str]
    budget: dict[str, dict[str, float]] | None
    recordings: list[_Session] = []


def write_certificate(
    results: Path, fields: Path | None, before: Path | None, out: Path | None, pdf: bool = False
) -> tuple[tuple[Path, ...], list[str]]:
    """Write certificate.html, certificate.json and certificate.pdf; returns their paths and what was not stated.

    Args:
        results: folder of a calibration, or its result.json.
        fields: YAML; None: nothing is stated.
        before: an earlier calibration of the item, result.json or calibration.yaml, as found against it.
        out: folder; None: that of the results.
        pdf: print it, by WeasyPrint.

    Raises:
        InputError: a file cannot be used, the result is none to certify, or there is no WeasyPrint that works.
    """
    path = results / "result.json" if results.is_dir() else results
    result, stated = _read_result(path), _read_fields(fields)
    earlier = {} if before is None else _earlier(before, result.method)
    rows = _rows(result, stated, earlier)
    for name in stated.limits:
        if name not in {row.name for row in rows}:
            raise InputError(f"{fields}: unknown key limits.{name}{nearest(name, [row.name for row in rows])}")
    missing = [name for name, value in stated.model_dump(exclude={"remarks", "limits"}).items() if value is None]
    content = _content(result, stated, rows, missing)

    page = _html(result, stated, rows, before)
    printed = _printed(page) if pdf else None

    def make(folder: Path) -> None:
        (folder / FILES[0]).write_text(page, encoding="utf-8")
        if printed is not None:
            (folder / FILES[1]).write_bytes(printed)
        (folder / FILES[2]).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")

    return write_whole(out or path.parent, FILES, make), missing


def _read_result(path: Path) -> _Result:
    data = read_bytes(path, MAX_RESULT_BYTES)
    try:
        result = _Result.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{path}: not a result.json: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    if result.status in ("inconsistent", "unobservable"):
        raise InputError(f"{path}: is {result.status}, there is nothing to certify: {result.headline}")
    return result


def _read_fields(path: Path | None) -> Fields:
    if path is None:
        return Fields()
    content = load_yaml(read_bytes(path, MAX_YAML_BYTES), str(path)) or {}
    try:
        return Fields.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        if first["type"] == "extra_forbidden":
            raise InputError(f"{path}: unknown key {where}{nearest(where, list(Fields.model_fields))}") from error
        raise InputError(f"{path}: {where}: {first['msg']}") from error


def _earlier(path: Path, method: str) -> dict[str, float]:
    known = load_known(path).of_method(method)
    return dict(zip(known.belief.names, known.belief.mean.tolist(), strict=True))


def _rows(result: _Result, stated: Fields, earlier: Mapping[str, float]) -> list[Row]:
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


def _effective(result: _Result, shares: Mapping[str, float]) -> float | None:
    """Welch and Satterthwaite: what a family of measurements adds is known as well as its residuals tell its noise.

    Noise that was stated and not asked of the recording, and priors, count as known.
    """
    freedoms: dict[str, float | None] = {f"{RECORDING}{part.recording}": part.dof for part in result.recordings}
    if any(noise.estimated is not None for noise in result.noise):
        freedoms |= {name: fit.dof for name, fit in result.chi_square.families.items()}
    doubt = 0.0
    for source, share in shares.items():
        dof = freedoms.get(source)
        if dof is not None:
            doubt += share**2 / max(dof, 1.0)
    return None if doubt * _MANY < 1.0 else 1.0 / doubt


def _conformity(value: float, expanded: float, limits: Limits) -> Conformity:
    """With a guard band of U on either side of the limits: less than 2.5 % of either statement is wrong."""
    off = abs(value - limits.nominal)
    if off + expanded <= limits.tolerance:
        return "conforms"
    return "does not conform" if off - expanded > limits.tolerance else "no statement"


def _content(result: _Result, stated: Fields, rows: Sequence[Row], missing: Sequence[str]) -> dict[str, Any]:
    return {
        "schema": "alidade.certificate/1",
        "fields": stated.model_dump(),
        "not_stated": list(missing),
        "method": result.method,
        "solver": result.solver,
        "status": result.status,
        "recordings": [each.model_dump() for each in result.recordings or [result.session]],
        "software": result.software,
        "results": [asdict(row) for row in rows],
    }


def _html(result: _Result, stated: Fields, rows: Sequence[Row], before: Path | None) -> str:
    quantities = {p.name: Quantity(p.name, p.unit, None, 1.0, p.require or math.inf) for p in result.parameters}
    said = {name: "not stated" if value is None else value for name, value in stated.model_dump().items()}
    return (
        environment("alidade.pipelines.reports")
        .get_template("certificate.html")
        .render(
            f=said,
            result=result,
            rows=[_readable(row, quantities[row.name], stated) for row in rows],
            meanings=_meanings(result.method, [row.name for row in rows]),
            budgets=[(row.name, [(s, 100.0 * x) for s, x in row.budget.items() if x >= 5e-4]) for row in rows],
            probability=f"{100.0 * stated.coverage_probability:.4g}",
            before=None if before is None else before.name,
            limited=any(row.conformity for row in rows),
            answer=_answer(result, rows, [name for name, value in said.items() if value == "not stated"]),
        )
    )


def _meanings(name: str, parameters: Sequence[str]) -> dict[str, str]:
    """What the parameters are; of a method that is not installed here, nothing."""
    with suppress(InputError):
        made_by = method(name)
        return {parameter: meaning(made_by, parameter) for parameter in parameters}
    return {}


def _answer(result: _Result, rows: Sequence[Row], missing: Sequence[str]) -> Answer:
    """Whether the item is within its limits, or, where it has none, what the calibration is worth."""
    steps = (f"Still to be stated, in the file given with `--fields`: {', '.join(missing)}.",) if missing else ()
    held = [row.conformity for row in rows if row.conformity]
    tone: Tone = "good" if result.status == "calibrated" else "warn"
    if not held:
        said = f"The status of the calibration is {result.status}; no limits are stated to compare the item with."
        return Answer("Is the item calibrated?", result.status, tone, said, (), steps)
    within = held.count("conforms")
    word = "yes" if within == len(held) else "no" if "does not conform" in held else "no statement"
    said = f"{within} of {len(held)} parameters with limits conform; the status of the calibration is {result.status}."
    return Answer("Is the item within its limits?", word, tone if word == "yes" else "bad", said, (), steps)


def _printed(page: str) -> bytes:
    """The page as PDF."""
    try:
        from weasyprint import HTML
    except (ImportError, OSError) as error:  # OSError: the system has no Pango
        raise InputError(
            "--pdf needs WeasyPrint, pip install 'alidade[pdf]', and Pango of the system (Debian: apt install "
            "libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0); or print certificate.html by a browser"
        ) from error
    logging.getLogger("weasyprint").setLevel(logging.ERROR)  # else it tells of every style that is for screens
    out: bytes = HTML(string=page).write_pdf()
    return out


def _readable(row: Row, quantity: Quantity, stated: Fields) -> dict[str, str]:
    """A row in the unit people read, as many digits as U warrants."""
    unit, factor = human_unit(quantity)

    def shown(value: float) -> str:
        return to_digits_of(factor * value, factor * row.expanded)

    limits = stated.limits.get(row.name)
    return {
        "name": row.name,
        "unit": unit,
        "value": shown(row.value),
        "expanded": shown(row.expanded),
        "coverage": f"{row.coverage:.2f}",
        "degrees": "∞" if row.degrees is None else f"{row.degrees:.0f}",
        "before": "" if row.before is None else shown(row.before),
        "change": "" if row.before is None else shown(row.value - row.before),
        "limits": "" if limits is None else f"{shown(limits.nominal)} ± {shown(limits.tolerance)}",
        "conformity": row.conformity or "",
    }
