"""The digital calibration certificate: order of elements as in the schema, numbers as in certificate.json."""

from __future__ import annotations

import json
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from alidade import calibrate, certificate, simulate
from alidade.pipelines.errors import InputError
from alidade.pipelines.reports.dcc import NEEDED, d_si_unit
from tests.support.command import Command
from tests.support.short_problems import COARSE

FIELDS = """\
number: C-2026-017
country: DE
laboratory: |
  Laboratory of Examples
  1 Main Street
customer: Users & Co
item: rotating INS
serial: <U17>
manufacturer: Makers
type: INS-3
signatory: A. Person
received: 2026-11-19
issued: 2026-11-22
place: laboratory
environment: 23 °C
procedure: turns and dwells
remarks: none
limits:
  theta_y: {nominal: -5.236e-3, tolerance: 2.0e-6}
  theta_z: {nominal: 0.1, tolerance: 1.0e-3}
"""
# Children in the order of the schemas, DCC 3.3.0 and D-SI 2.2.1; those with a star may be left out.
ORDER = {
    "digitalCalibrationCertificate": "administrativeData measurementResults",
    "administrativeData": "dccSoftware coreData items calibrationLaboratory respPersons customer statements*",
    "software": "name release",
    "coreData": "countryCodeISO3166_1 usedLangCodeISO639_1 mandatoryLangCodeISO639_1 uniqueIdentifier receiptDate* "
    "beginPerformanceDate endPerformanceDate performanceLocation issueDate*",
    "item": "name manufacturer* model* identifications",
    "identification": "issuer value",
    "contact": "name location",
    "customer": "name location",
    "respPerson": "person mainSigner*",
    "measurementResult": "name usedMethods* usedSoftware* influenceConditions* results",
    "usedMethod": "name description*",
    "influenceCondition": "name data",
    "result": "name data",
    "list": "name* quantity",
    "quantity": "name* real* realListXMLList* measurementMetaData*",
    "metaData": "declaration* conformity*",
    "real": "value unit measurementUncertaintyUnivariate*",
    "expandedMU": "valueExpandedMU coverageFactor coverageProbability",
    "realListXMLList": "valueXMLList unitXMLList",
}
SPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certified")
    calibrate(simulate("indexer", COARSE, seed=1)).write(folder)
    (folder / "fields.yaml").write_text(FIELDS, encoding="utf-8")
    certificate(folder, folder / "fields.yaml", dcc=True)
    return folder


def _plain(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def test_elements_stand_in_the_order_of_the_schema(folder: Path) -> None:
    root = ET.parse(folder / "certificate.xml").getroot()
    assert root.get("schemaVersion") == "3.3.0"
    for element in root.iter():
        if _plain(element) in ORDER:
            found = list(dict.fromkeys(map(_plain, element)))
            order = ORDER[_plain(element)].split()
            assert found == [name for name in (each.rstrip("*") for each in order) if name in found], element
            assert {name for name in order if not name.endswith("*")} <= set(found), element
    assert root.findtext(".//dcc:issueDate", None, SPACES) == "2026-11-22"
    assert root.findtext(".//dcc:contact/dcc:name/dcc:content", None, SPACES) == "Laboratory of Examples"
    assert root.findtext(".//dcc:identification/dcc:value", None, SPACES) == "<U17>"


def test_numbers_are_those_of_the_certificate(folder: Path) -> None:
    results = ET.parse(folder / "certificate.xml").findall(".//dcc:result/dcc:data", SPACES)
    rows = json.loads((folder / "certificate.json").read_text())["results"]
    for row, quantity in zip(rows, results[0], strict=True):
        assert quantity.findtext("dcc:name/dcc:content", None, SPACES) == row["name"]
        numbers = [
            float(x.text or "")
            for x in quantity.iter()
            if re.fullmatch("value|.*MU|coverage.*", _plain(x)) and not len(x)
        ]
        assert numbers == [row["value"], row["expanded"], row["coverage"], 0.9545]
        stated = {"conforms": "pass", "does not conform": "fail"}.get(row["conformity"])
        assert quantity.findtext(".//dcc:conformity", None, SPACES) == stated
    covariance = np.array([x.text.split() for x in results[1].iterfind(".//si:valueXMLList", SPACES) if x.text], float)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [row["standard"] for row in rows], rtol=1e-12)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-12)
    for row, budget in zip(rows, results[2], strict=True):
        shares = [float(x.text or "") for x in budget.iterfind(".//si:value", SPACES)]
        assert shares == list(row["budget"].values())
        assert sum(shares) == pytest.approx(1.0)


@pytest.mark.skipif("DCC_XSD" not in os.environ, reason="DCC_XSD has to name PTB's dcc.xsd 3.3.0")
def test_it_is_valid_by_the_published_schema(folder: Path) -> None:
    schema = pytest.importorskip("xmlschema").XMLSchema(os.environ["DCC_XSD"])
    assert [error.reason for error in schema.iter_errors(folder / "certificate.xml")] == []


def test_mandatory_fields_are_asked_for_before_anything_is_written(
    folder: Path, tmp_path: Path, alidade: Command
) -> None:
    done = alidade("certificate", folder, "--dcc", "--out", tmp_path / "out")
    assert done.code == 2
    assert f"a digital certificate needs {', '.join(NEEDED)}: state them" in done.err
    assert not (tmp_path / "out").exists()
    (tmp_path / "f.yaml").write_text(FIELDS + "coverage_probability: 0.6\n", encoding="utf-8")
    with pytest.raises(InputError, match="no coverage factor below 1"):
        certificate(folder, tmp_path / "f.yaml", out=tmp_path / "out", dcc=True)


@pytest.mark.parametrize(
    ("unit", "named"),
    [
        ("rad", r"\radian"),
        ("rad/s", r"\radian\second\tothe{-1}"),
        ("m/s^2/K", r"\metre\second\tothe{-2}\kelvin\tothe{-1}"),
        ("rad/s/(m/s^2)", r"\radian\second\metre\tothe{-1}"),
        ("s^4/m^2", r"\second\tothe{4}\metre\tothe{-2}"),
        ("T/count", r"\tesla"),
        ("1/T", r"\tesla\tothe{-1}"),
        ("1", r"\one"),
        ("px", r"\one"),
    ],
)
def test_units_are_named_as_d_si_has_them(unit: str, named: str) -> None:
    assert d_si_unit(unit) == named
