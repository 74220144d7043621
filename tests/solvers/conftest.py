"""Fixtures of the solvers' tests."""

from __future__ import annotations

import pytest

from alidade.pipelines.solvers import incremental


@pytest.fixture
def early_smoother(monkeypatch: pytest.MonkeyPatch) -> None:
    """The initialisation phase, in which all is batch, may end after 20 steps; by default after 100."""
    monkeypatch.setattr(incremental, "MIN_STEPS", 20)
