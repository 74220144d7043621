"""A distribution whose method cannot be loaded: one line about it, and every command goes on without it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from alidade.pipelines import methods
from alidade.pipelines.errors import InputError
from tests.support.command import Command


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    entry = EntryPoint("torn", "no_such_module:Torn", methods.GROUP)
    monkeypatch.setattr(methods, "_plugins", lambda: {"torn": entry})
    methods._is_sound.cache_clear()
    yield
    methods._is_sound.cache_clear()


@pytest.mark.usefixtures("broken")
def test_the_others_are_listed_and_the_broken_one_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "alidade"):
        assert methods.names() == methods.names() == ("los", "indexer", "head", "cube", "tumble")
    (said,) = caplog.messages
    assert said.startswith("method torn, brought by no_such_module:Torn, cannot be loaded: No module named")


@pytest.mark.usefixtures("broken")
def test_help_and_info_are_as_without_it(alidade: Command, tmp_path: Path) -> None:
    assert "calibrate" in alidade("--help").out
    scenario = tmp_path / "s.yaml"
    scenario.write_text("{duration_s: 5, gyro_rate_hz: 50, vision_rate_hz: 10}")
    alidade("simulate", "head", "--scenario", scenario, "--out", tmp_path / "s.mcap")
    assert alidade("info", tmp_path / "s.mcap").code == 0
    asked = alidade("calibrate", tmp_path / "s.mcap", "--method", "torn")
    assert asked.code == 2
    assert "method torn, brought by no_such_module:Torn, cannot be loaded" in asked.err
    with pytest.raises(InputError, match="cannot be loaded"):
        methods.method("torn")
