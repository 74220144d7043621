"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

# As the command has it, and before anything imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real and independent recordings beside the checkout."""
    if not _SHARED.is_dir():
        pytest.skip("needs the recordings in ../shared/data, which are not part of the project")
    return _SHARED
