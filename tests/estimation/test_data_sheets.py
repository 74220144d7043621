"""docs/data-sheets.md against the program: all figures, the defaults in force, sections that their methods take."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest

from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.assumptions import Assumption
from alidade.pipelines.methods.cube.parameters import ASSUMPTIONS as CUBE
from alidade.pipelines.methods.head.parameters import ASSUMPTIONS as HEAD
from alidade.pipelines.methods.indexer.parameters import ASSUMPTIONS as INDEXER
from alidade.pipelines.methods.los.parameters import ASSUMPTIONS as LOS
from alidade.pipelines.methods.place import FIELD
from alidade.pipelines.methods.tumble import turning
from alidade.pipelines.methods.tumble.recording import SLOPES
from alidade.pipelines.settings import Sensors
from tests.install.walk import steps

PAGE = Path(__file__).parents[2] / "docs" / "data-sheets.md"
ASSUMED: dict[str, Sequence[Assumption]] = {
    "los": LOS,
    "head": HEAD,
    "indexer": INDEXER,
    "cube": (*CUBE, FIELD),
    "tumble": (*turning.SCALE, turning.SENSITIVITY, turning.DELAY, *SLOPES, FIELD),
}
DEFAULTS = {
    (method, f"{each.sheet}.{each.figure}"): each.sigma for method, assumed in ASSUMED.items() for each in assumed
}
SECTIONS = [pytest.param(step.file.split("-")[0], step.text, id=step.file) for step in steps(PAGE)]


def test_every_figure_is_on_the_page() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for sensor, sheet in Sensors():
        for figure in type(sheet).model_fields:
            assert f"`{sensor}.{figure}`" in text, f"{sensor}.{figure}"


def test_defaults_are_those_of_the_program() -> None:
    table = PAGE.read_text(encoding="utf-8").split("## Defaults")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `([\w.]+)` \| ([^|]*)\|", table, re.MULTILINE)
    told = {
        (method, figure): float(value)
        for figure, defaults in rows
        for method, value in re.findall(r"(\w+) ([\d.e-]+)", defaults)
    }
    assert told == {key: DEFAULTS.get(key) for key in told}
    assert {figure for _, figure in DEFAULTS} <= {figure for figure, _ in rows}


@pytest.mark.parametrize(("method", "section"), SECTIONS)
def test_sections_state_what_their_methods_have_a_use_for(method: str, section: str) -> None:
    sensors = load_config(section.encode()).sensors
    for sensor in sensors.model_fields_set:
        assert sensor in methods.method(method).sheets
        for figure in getattr(sensors, sensor).model_fields_set:
            assert (method, f"{sensor}.{figure}") in DEFAULTS
