"""The command as the tests of the fleet run it."""

from __future__ import annotations

import sys

import pytest

from alidade.pipelines.applications import cli


def alidade(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["alidade", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0
