"""The rotations that were found, drawn into the sketch of the frames."""

from __future__ import annotations

import re

import numpy as np
import pytest

from alidade.factors.array import Array
from alidade.pipelines.display.drawing import rotation_text, sketch_with
from alidade.pipelines.methods import method


def turned(*degrees: float) -> Array:
    return np.deg2rad(degrees)


def test_the_axes_found_are_drawn_where_the_parents_are() -> None:
    sketch = method("los").frames
    assert sketch is not None
    svg = sketch.read_text()
    drawn = sketch_with(svg, {"M": turned(0.0, 0.0, 90.0)})
    x, y, z = re.findall(r'd="M120 235l(\S+) (\S+)" stroke="var\(--[xyz]\)"', drawn)
    # A quarter turn about z takes x to where y is in the sketch, and leaves z upright.
    assert float(x[0]) > 50.0
    assert (float(z[0]), float(z[1])) == pytest.approx((0.0, -62.0), abs=0.1)
    assert float(y[0]) > 0.0 > float(y[1])
    assert sketch_with(svg, {}) == svg


def test_small_turns_are_enlarged_and_told_so() -> None:
    small, large = rotation_text(turned(0.5, 0.0, 0.0)), rotation_text(turned(20.0, 0.0, 0.0))
    assert small.startswith("0.500 deg, rotation vector [0.500, ")
    assert small.endswith("drawn ten times as large")
    assert large.endswith("deg")
    assert rotation_text(turned(0.0, 0.0, 0.0)) == "not turned"
