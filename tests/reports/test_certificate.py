"""The calibration certificate: items, uncertainties, statements of conformity, and what is not stated."""

from __future__ import annotations

import json
import re
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from alidade import calibrate, simulate
from alidade.factors.chi_square import student
from alidade.pipelines.errors import InputError
from alidade.pipelines.reports.certificate import certificate
from tests.support.browser import fits
from tests.support.command import Command

FIELDS = """\
number: C-2026-017
laboratory: |
  Laboratory of Examples
  1 Main Street
item: rotating INS
serial: <U17>
issued: 2026-11-22
limits:
  theta_y: {nominal: -5.236e-3, tolerance: 2.0e-6}
  theta_x: {nominal: 8.7266e-3, tolerance: 1.0e-5}
  theta_z: {nominal: 0.1, tolerance: 1.0e-3}
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    calibrate(simulate("indexer", None, seed=1)).write(folder)
    return folder


def test_the_command_writes_a_certificate(results: Path, tmp_path: Path, alidade: Command) -> None:
    fields, out = tmp_path / "certificate.yaml", tmp_path / "out"
    fields.write_text(FIELDS)
    done = alidade("certificate", results, "--fields", fields, "--before", results / "result.json", "--out", out)
    assert done.code == 0
    assert "not stated: customer, manufacturer" in done.out
    page, content = (out / "certificate.html").read_text(), json.loads((out / "certificate.json").read_text())
    fits(page, tmp_path)
    for text in ("C-2026-017", "Laboratory of Examples", "&lt;U17&gt;", "not stated", "counter(pages)", "guard band"):
        assert text in page
    result = json.loads((results / "result.json").read_text())
    sigmas = {p["name"]: p["sigma"] for p in result["parameters"]}
    rows = {row["name"]: row for row in content["results"]}
    assert set(rows) == {f"{name}_{axis}" for name in ("theta", "gyro_bias") for axis in "xyz"}
    for row in rows.values():
        assert row["expanded"] == pytest.approx(row["coverage"] * sigmas[row["name"]])
        assert sum(row["budget"].values()) == pytest.approx(1.0)
        assert row["before"] == row["value"]
    assert [rows[f"theta_{axis}"]["conformity"] for axis in "yxz"] == ["conforms", "no statement", "does not conform"]
    assert rows["theta_x"]["degrees"] is None  # nearly all of it is the prior of a skew
    # Turns, moves and dwells, whose residuals tell their noise.
    families, shares = result["chi_square"]["families"], rows["gyro_bias_x"]["budget"]
    doubt = sum(share**2 / max(families[source]["dof"], 1.0) for source, share in shares.items() if source in families)
    assert rows["gyro_bias_x"]["degrees"] == pytest.approx(1.0 / doubt)
    assert "customer" in content["not_stated"]


@pytest.mark.parametrize(("dof", "k"), [(5, 2.65), (10, 2.28), (20, 2.13), (50, 2.05)])
def test_coverage_factors_are_those_of_the_guide(dof: float, k: float) -> None:
    """GUM, table G.2, 95.45 %."""
    assert student(2.0, dof) == pytest.approx(k, abs=0.01)
    assert student(2.0, 1e9) == pytest.approx(2.0, abs=1e-6)


def test_fewer_degrees_of_freedom_need_a_larger_factor(results: Path, tmp_path: Path) -> None:
    changed = json.loads((results / "result.json").read_text())
    for fit in changed["chi_square"]["families"].values():
        fit["dof"] = 6.0
    (tmp_path / "result.json").write_text(json.dumps(changed))
    certificate(tmp_path)
    rows = {row["name"]: row for row in json.loads((tmp_path / "certificate.json").read_text())["results"]}
    shares = np.array([share for source, share in rows["gyro_bias_x"]["budget"].items() if "prior" not in source])
    assert rows["gyro_bias_x"]["degrees"] == pytest.approx(6.0 / (shares**2).sum(), rel=1e-6)
    assert rows["gyro_bias_x"]["coverage"] > 2.3


def test_expanded_uncertainties_are_those_of_the_gum_tree_calculator(results: Path, tmp_path: Path) -> None:
    gtc = pytest.importorskip("GTC", reason="GTC is not installed")
    changed = json.loads((results / "result.json").read_text())
    for i, fit in enumerate(changed["chi_square"]["families"].values()):
        fit["dof"] = 5.0 + i
    (tmp_path / "result.json").write_text(json.dumps(changed))
    certificate(tmp_path)
    freedoms = {name: fit["dof"] for name, fit in changed["chi_square"]["families"].items()}
    rows = json.loads((tmp_path / "certificate.json").read_text())["results"]
    for row in rows:
        y = sum(
            gtc.ureal(0.0, row["standard"] * share**0.5, freedoms.get(source, gtc.inf))
            for source, share in row["budget"].items()
        )
        assert row["standard"] == pytest.approx(gtc.uncertainty(y), rel=1e-9)
        if row["degrees"] is not None:
            assert row["degrees"] == pytest.approx(gtc.dof(y), rel=1e-9)
        assert row["coverage"] == pytest.approx(gtc.reporting.k_factor(gtc.dof(y), 95.45), rel=1e-6)
    assert any(row["degrees"] is not None for row in rows)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ("serail: U17", "unknown key serail; the nearest known key is serial"),
        ("limits: {theta_w: {tolerance: 1.0}}", r"unknown key limits\.theta_w; the nearest known key is theta_"),
        ("limits: {theta_x: {tolerance: -1.0}}", r"limits\.theta_x\.tolerance"),
        ("a: [", "unreadable YAML"),
    ],
)
def test_fields_that_mean_nothing(results: Path, tmp_path: Path, fields: str, message: str) -> None:
    path = tmp_path / "certificate.yaml"
    path.write_text(fields)
    with pytest.raises(InputError, match=message):
        certificate(results, path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_no_result_is_not_certified(results: Path, tmp_path: Path) -> None:
    changed = json.loads((results / "result.json").read_text())
    changed["status"] = "inconsistent"
    (tmp_path / "result.json").write_text(json.dumps(changed))
    with pytest.raises(InputError, match="is inconsistent, there is nothing to certify"):
        certificate(tmp_path)
    with pytest.raises(InputError, match="cannot be opened"):
        certificate(tmp_path / "none")


def pages(pdf: bytes) -> int:
    """Of a PDF, whose objects are packed."""
    streams = [
        pdf[found.end() :] for found in re.finditer(rb"stream\r?\n", pdf) if not pdf[: found.start()].endswith(b"end")
    ]
    unpacked = b"".join(zlib.decompressobj().decompress(each) for each in streams if each[:1] == b"x")
    return len(re.findall(rb"/Type /Page(?!s)", unpacked + pdf))


def test_it_is_printed_page_by_page(results: Path, tmp_path: Path, alidade: Command) -> None:
    """As many pages as the PDF says, and none is left behind by the next one that is not printed."""
    try:
        import weasyprint  # noqa: F401
    except (ImportError, OSError):
        pytest.skip("needs the extra alidade[pdf] and Pango")
    (tmp_path / "f.yaml").write_text(FIELDS)
    arguments = ("certificate", results, "--fields", tmp_path / "f.yaml", "--out", tmp_path / "out")
    assert alidade(*arguments, "--pdf").code == 0
    printed = (tmp_path / "out" / "certificate.pdf").read_bytes()
    assert printed.startswith(b"%PDF")
    assert printed.rstrip().endswith(b"%%EOF")
    assert pages(printed) == 2
    assert alidade(*arguments).code == 0
    assert not (tmp_path / "out" / "certificate.pdf").exists()


def test_without_a_printer_nothing_is_written(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with pytest.raises(InputError, match=r"--pdf needs WeasyPrint, pip install 'alidade\[pdf\]', and Pango"):
        certificate(results, out=tmp_path / "out", pdf=True)
    assert not (tmp_path / "out").exists()


def test_of_several_recordings_each_counts_with_its_freedoms(results: Path, tmp_path: Path) -> None:
    changed = json.loads((results / "result.json").read_text())
    part = {"start": "2026-03-01T12:00:00+00:00", "duration_s": 60.0, "status": "calibrated", "headline": ""}
    part |= {"parameters": [], "alone": []}
    sources = {"march.mcap": 20.0, "june.mcap": 5.0, "stated.mcap": None}
    changed["recordings"] = [{"recording": name, "sha256": name, "dof": dof, **part} for name, dof in sources.items()]
    changed["noise"] = []
    changed["budget"]["theta_y"] = {f"recording {name}": 0.3 for name in sources} | {"prior of gyro_skew_xz": 0.1}
    (tmp_path / "result.json").write_text(json.dumps(changed))
    certificate(tmp_path)
    rows = {row["name"]: row for row in json.loads((tmp_path / "certificate.json").read_text())["results"]}
    assert rows["theta_y"]["degrees"] == pytest.approx(1.0 / (0.3**2 / 20.0 + 0.3**2 / 5.0))
    page = (tmp_path / "certificate.html").read_text()
    assert page.count("SHA-256") == 3
    assert "recording june.mcap 30.0 %" in page
