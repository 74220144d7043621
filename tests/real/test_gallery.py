"""The public recordings of datasets/README.md: what comes out agrees with what others published."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from datasets.gallery import RECORDINGS, Recording, calibrated

README = (Path(__file__).parents[2] / "datasets" / "README.md").read_text(encoding="utf-8")
# How well the published numbers are known: scatter at rest, imucal's turns by hand, 0.3 % of the sheet, digits.
KNOWN_TO = {"head": 0.01, "indexer": 0.03, "cube": 1.25, "tumble": 0.006}


@pytest.mark.parametrize("recording", RECORDINGS, ids=lambda each: each.method)
def test_the_page_says_where_it_is_and_how_it_is_calibrated(recording: Recording) -> None:
    assert f"| {recording.method} | {recording.source} | {recording.commands} | {recording.what} |" in README


@pytest.mark.parametrize(
    "recording",
    [
        pytest.param(each, id=each.method, marks=() if each.method == "tumble" else pytest.mark.slow)
        for each in RECORDINGS
    ],
)
def test_numbers_agree_with_published_ones(recording: Recording, shared_data: Path) -> None:
    path = shared_data / recording.file
    assert hashlib.sha256(path.read_bytes()).hexdigest() == recording.sha256
    status, found, sigma = calibrated(recording, shared_data)
    assert status == "calibrated"
    off = np.abs(found - np.array(recording.published))
    assert (off < np.hypot(3.0 * sigma, KNOWN_TO[recording.method])).all(), (found, sigma)
