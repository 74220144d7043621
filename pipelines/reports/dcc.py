"""A calibration certificate as Digital Calibration Certificate: XML after PTB's DCC 3.3.0, quantities after D-SI 2.2.1.

Each parameter is a quantity with its expanded uncertainty; the joint covariance and the uncertainty budgets follow as
results of their own. Units are SI; counts and pixels are 1.
"""

from __future__ import annotations

import datetime
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from alidade.pipelines.errors import InputError

SCHEMA = "3.3.0"
# Fields that are mandatory in the schema.
NEEDED = ("number", "country", "laboratory", "customer", "item", "serial", "signatory")
_SPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si", "xsi": "http://www.w3.org/2001/XMLSchema-instance"}
_UNITS = {"rad": r"\radian", "s": r"\second", "m": r"\metre", "T": r"\tesla", "K": r"\kelvin"}
_CONFORMITY = {"conforms": "pass", "does not conform": "fail"}


def digital_certificate(content: Mapping[str, Any], order: Sequence[str], covariance: Sequence[Sequence[float]]) -> str:
    """Return the Digital Calibration Certificate as XML text.

    Args:
        content: of certificate.json.
        order: parameters of the covariance.
        covariance: row by row, SI.

    Raises:
        InputError: a mandatory field is not stated, or a coverage factor is below 1, which D-SI does not have.
    """
    if missing := [name for name in NEEDED if not (content["fields"][name] or "").strip()]:
        raise InputError(
            f"a digital certificate needs {', '.join(missing)}: state them in the file given with --fields"
        )
    if any(row["coverage"] < 1.0 for row in content["results"]):
        raise InputError("a digital certificate has no coverage factor below 1: state a larger coverage_probability")
    for prefix, uri in _SPACES.items():
        ET.register_namespace(prefix, uri)
    results = _tag("measurementResults", _measurement(content, order, covariance))
    root = _tag("digitalCalibrationCertificate", _administration(content), results, schemaVersion=SCHEMA)
    root.set(f"{{{_SPACES['xsi']}}}schemaLocation", f"{_SPACES['dcc']} {_SPACES['dcc']}/v{SCHEMA}/dcc.xsd")
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True).decode() + "\n"


def d_si_unit(*units: str) -> str:
    """Return the product of units such as rad/s/(m/s^2) in the notation of D-SI; counts and pixels are 1."""
    powers: dict[str, int] = {}
    for unit in units:
        sign = group = 1
        for mark, name, power in re.findall(r"([/()])|([A-Za-z]+)(?:\^(\d))?", unit):
            if mark:
                sign, group = (-1, group) if mark == "/" else (1, sign if mark == "(" else 1)
            elif name in _UNITS:
                powers[name] = powers.get(name, 0) + group * sign * int(power or 1)
    named = (_UNITS[name] + ("" if n == 1 else rf"\tothe{{{n}}}") for name, n in powers.items() if n)
    return "".join(named) or r"\one"


def _tag(name: str, *children: ET.Element | str | None, **attributes: str) -> ET.Element:
    """Make an XML element of `dcc`, or of the prefix in its name, without children that are None."""
    prefix, _, local = name.rpartition(":")
    element = ET.Element(f"{{{_SPACES[prefix or 'dcc']}}}{local}", attributes)
    element.text = next((child for child in children if isinstance(child, str)), None)
    element.extend(child for child in children if isinstance(child, ET.Element))
    return element


def _text(name: str, text: str | None) -> ET.Element | None:
    return None if text is None else _tag(name, _tag("content", text))


def _date(name: str, text: str | None) -> ET.Element | None:
    """Make an element with an ISO 8601 date; None for any other text."""
    return _tag(name, text) if text and re.fullmatch(r"\d{4}-\d\d-\d\d", text) else None


def _software(software: Mapping[str, str]) -> Iterator[ET.Element]:
    return (_tag("software", _text("name", name), _tag("release", f"v{release}")) for name, release in software.items())


def _contact(name: str, text: str, country: str | None = None) -> ET.Element:
    """Make the element of a contact from a text: name in the first line, address in the lines after it."""
    first, *rest = text.strip().splitlines()
    address = _text("further", " ".join(rest) or first)
    return _tag(name, _text("name", first), _tag("location", country and _tag("countryCode", country), address))


def _administration(content: Mapping[str, Any]) -> ET.Element:
    fields, recordings = content["fields"], content["recordings"]
    starts = [datetime.datetime.fromisoformat(each["start"]) for each in recordings]
    ends = [t + datetime.timedelta(seconds=each["duration_s"]) for t, each in zip(starts, recordings, strict=True)]
    core = _tag(
        "coreData",
        _tag("countryCodeISO3166_1", fields["country"]),
        _tag("usedLangCodeISO639_1", "en"),
        _tag("mandatoryLangCodeISO639_1", "en"),
        _tag("uniqueIdentifier", fields["number"]),
        _date("receiptDate", fields["received"]),
        _tag("beginPerformanceDate", min(starts).date().isoformat()),
        _tag("endPerformanceDate", max(ends).date().isoformat()),
        _tag("performanceLocation", fields["place"] if fields["place"] in ("laboratory", "customer") else "other"),
        _date("issueDate", fields["issued"]),
    )
    item = _tag(
        "item",
        _text("name", fields["item"]),
        fields["manufacturer"] and _tag("manufacturer", _text("name", fields["manufacturer"])),
        fields["type"] and _tag("model", fields["type"]),
        _tag(
            "identifications", _tag("identification", _tag("issuer", "manufacturer"), _tag("value", fields["serial"]))
        ),
    )
    said = [_text("declaration", fields[name]) for name in ("traceability", "adjustment", "remarks") if fields[name]]
    signatory = _tag("respPerson", _tag("person", _text("name", fields["signatory"])), _tag("mainSigner", "true"))
    return _tag(
        "administrativeData",
        _tag("dccSoftware", *_software({"alidade": content["software"]["alidade"]})),
        core,
        _tag("items", item),
        _tag("calibrationLaboratory", _contact("contact", fields["laboratory"], fields["country"])),
        _tag("respPersons", signatory),
        _contact("customer", fields["customer"]),
        _tag("statements", *(_tag("statement", each) for each in said)) if said else None,
    )


def _measurement(content: Mapping[str, Any], order: Sequence[str], covariance: Sequence[Sequence[float]]) -> ET.Element:
    fields, rows = content["fields"], content["results"]
    name = _text("name", f"method {content['method']}, {content['solver']} solver")
    around = _tag(
        "influenceCondition", _text("name", "environment"), _tag("data", _text("text", fields["environment"]))
    )
    results = {
        "results": [_quantity(row, fields) for row in rows],
        "covariance": [*_covariance(rows, order, covariance)],
        "uncertainty budget, shares of the variance": [_budget(row) for row in rows if row["budget"]],
    }
    return _tag(
        "measurementResult",
        _text("name", f"calibration, {content['status']}"),
        _tag("usedMethods", _tag("usedMethod", name, _text("description", fields["procedure"]))),
        _tag("usedSoftware", *_software(content["software"])),
        _tag("influenceConditions", around) if fields["environment"] else None,
        _tag(
            "results", *(_tag("result", _text("name", n), _tag("data", *data)) for n, data in results.items() if data)
        ),
    )


def _quantity(row: Mapping[str, Any], fields: Mapping[str, Any]) -> ET.Element:
    """Make the element of a parameter with its expanded uncertainty and, if there is one, statement of conformity."""
    numbers = zip(
        ("valueExpandedMU", "coverageFactor", "coverageProbability"),
        (row["expanded"], row["coverage"], fields["coverage_probability"]),
        strict=True,
    )
    expanded = _tag("si:expandedMU", *(_tag(f"si:{name}", repr(number)) for name, number in numbers))
    real = _real(row["value"], row["unit"], _tag("si:measurementUncertaintyUnivariate", expanded))
    stated = None
    if row["conformity"] in _CONFORMITY:
        limits = "limits {nominal!r} ± {tolerance!r} {unit}, guard band of U".format(
            **fields["limits"][row["name"]], unit=row["unit"]
        )
        found = _tag("conformity", _CONFORMITY[row["conformity"]])
        meta = _tag("metaData", _text("declaration", limits), found, refType="basic_conformity")
        stated = _tag("measurementMetaData", meta)
    return _tag("quantity", _text("name", row["name"]), real, stated, refType="basic_measuredValue")


def _real(value: float, unit: str, uncertainty: ET.Element | None = None) -> ET.Element:
    return _tag("si:real", _tag("si:value", repr(value)), _tag("si:unit", d_si_unit(unit)), uncertainty)


def _covariance(
    rows: Sequence[Mapping[str, Any]], order: Sequence[str], covariance: Sequence[Sequence[float]]
) -> Iterator[ET.Element]:
    """Yield the rows of the results' joint covariance as elements, in the order of the results."""
    for row in rows:
        numbers = " ".join(repr(covariance[order.index(row["name"])][order.index(each["name"])]) for each in rows)
        units = _tag("si:unitXMLList", " ".join(d_si_unit(row["unit"], each["unit"]) for each in rows))
        name = _text("name", f"covariance of {row['name']} with each of the results")
        yield _tag("quantity", name, _tag("si:realListXMLList", _tag("si:valueXMLList", numbers), units))


def _budget(row: Mapping[str, Any]) -> ET.Element:
    shares = (_tag("quantity", _text("name", source), _real(share, "1")) for source, share in row["budget"].items())
    return _tag("list", _text("name", row["name"]), *shares)
