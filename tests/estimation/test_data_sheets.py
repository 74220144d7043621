"""docs/reference/data-sheets: every figure with the program's defaults; sections that their methods accept."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.parameters import DEAD_BAND, ParameterSpec
from alidade.pipelines.methods.cube.parameters import NUISANCE as CUBE
from alidade.pipelines.methods.head.parameters import NUISANCE as HEAD
from alidade.pipelines.methods.indexer.parameters import NUISANCE as INDEXER
from alidade.pipelines.methods.los.parameters import NUISANCE as LOS
from alidade.pipelines.methods.place import FIELD
from alidade.pipelines.methods.tumble import turning
from alidade.pipelines.methods.tumble.recording import ACCEL_CURVATURE, SLOPES
from alidade.pipelines.settings import Sensors
from docs._site.tables import SHEETS, default_sigmas
from tests.install.walk import steps

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "data-sheets.md"
ASSUMED: dict[str, Sequence[ParameterSpec]] = {
    "los": (*LOS, DEAD_BAND),
    "head": (*HEAD, DEAD_BAND),
    "indexer": INDEXER,
    "cube": (*CUBE, FIELD, DEAD_BAND),
    "tumble": (*turning.SCALE, turning.SENSITIVITY, turning.DELAY, *SLOPES, FIELD, *ACCEL_CURVATURE, DEAD_BAND),
}
DEFAULTS = {
    (method, f"{each.sheet}.{each.figure}"): each.prior for method, assumed in ASSUMED.items() for each in assumed
}
SECTIONS = [pytest.param(step.file.split("-")[0], step.text, id=step.file) for step in steps(PAGE)]


def test_every_figure_has_an_entry_with_its_sources() -> None:
    sheets = YAML(typ="safe").load(SHEETS.read_text(encoding="utf-8"))
    stated = {f"{sensor}.{figure}" for sensor, sheet in Sensors() for figure in type(sheet).model_fields}
    used = {spec.data_sheet for name in methods.names() for spec in methods.method(name).parameters if spec.data_sheet}
    assert used <= stated, "figures that settings.py does not have"
    assert sheets["figures"].keys() == stated
    cited = {
        key for entry in sheets["figures"].values() for device in entry.get("devices", ()) for key in _cited(device)
    }
    assert cited <= sheets["sources"].keys()


def _cited(device: Sequence[str]) -> list[str]:
    return re.findall(r"\[(\w+)\]", device[-1])


def test_defaults_shown_are_those_of_the_program() -> None:
    shown = {
        (method, figure): sigma
        for figure in {figure for _, figure in DEFAULTS}
        for method, sigma in default_sigmas(figure).items()
    }
    assert shown == DEFAULTS


@pytest.mark.parametrize(("method", "section"), SECTIONS)
def test_sections_state_what_their_methods_have_a_use_for(method: str, section: str) -> None:
    sensors = load_config(section.encode()).sensors
    for sensor in sensors.model_fields_set:
        assert sensor in methods.method(method).data_sheets
        for figure in getattr(sensors, sensor).model_fields_set:
            assert (method, f"{sensor}.{figure}") in DEFAULTS
