"""Every parameter of every method has its meaning in a sentence, and every method a sketch of its frames."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from alidade.pipelines.methods import method
from alidade.pipelines.settings import Config
from tests.support.formulas import CASES

NAMES = {
    "los": ["gyro_temperature_x", "target_rate_x", "encoder_azimuth_sin"],
    "indexer": ["encoder_outer_x_cos", "encoder_delay"],
    "head": ["platform_bias_x", "platform_skew_xy", "clock_skew", "vision_scale"],
    "cube": ["field_e", "accel_cube_2", "camera_focal", "camera_centre_x", "gyro_g_xy"],
    "tumble": ["mag_delay", "field_strength", "field_dip", "gravity", "mag_k12", "accel_b1"],
}


@pytest.mark.parametrize("case", CASES)
def test_every_parameter_has_a_meaning(case: str) -> None:
    name, parameters = CASES[case]
    for each in (*parameters, *NAMES.get(name, ())):
        assert method(name).describe(each).endswith("."), each


def test_the_words_are_of_the_parameter() -> None:
    assert method("head").describe("gyro_bias_y") == "Gyro bias about y."
    assert method("cube").describe("mag_k12") == "Magnetometer cross-axis term (y into x)."
    assert method("head").describe("unheard_of") == ""


@pytest.mark.parametrize("name", NAMES)
def test_sketches_are_svg_of_the_transforms_that_there_are(name: str) -> None:
    sketch = method(name).frames
    assert sketch is not None
    root = ET.parse(sketch).getroot()
    assert root.tag.endswith("svg")
    turns = {each.attrib["data-turn"] for each in root.iter() if "data-turn" in each.attrib}
    parameters = next((known for of, known in CASES.values() if of == name), ())
    assert turns <= {formula.name for formula in method(name).report.formulas(parameters, Config())}
