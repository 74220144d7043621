"""Pictures of motions show what their words say."""

from __future__ import annotations

import re
from itertools import permutations
from xml.etree import ElementTree

import numpy as np
import pytest

from alidade.pipelines.display.drawing import along, covered, swaying
from alidade.pipelines.methods.cube.guidance import rested
from alidade.pipelines.methods.cube.simulation import SIDES, Side
from alidade.pipelines.methods.indexer.guidance import turning


def _words(picture: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(picture).iter() if element.tag.endswith("text")]


def test_a_cube_shows_its_top_and_the_sides_to_the_south_and_to_the_east() -> None:
    for up, north in permutations(SIDES, 2):
        if up[1] == north[1]:
            continue
        east = np.cross(SIDES[north], SIDES[up])
        (right,) = (side for side, normal in SIDES.items() if np.array_equal(normal, east))
        opposite = ("-" if north[0] == "+" else "+") + north[1]
        assert set(_words(rested(up, north))) == {up, opposite, right, "up", "N"}


@pytest.mark.parametrize("up", SIDES)
def test_names_of_sides_are_not_seen_in_a_mirror(up: Side) -> None:
    matrices = re.findall(r"matrix\((\S+) (\S+) (\S+) (\S+) ", rested(up))
    assert len(matrices) == 3
    for entries in matrices:
        a, b, c, d = map(float, entries)
        assert a * d - b * c > 0.0


@pytest.mark.parametrize(("axes", "heads"), [("x", 2), ("yz", 4), ("xyz", 6)])
def test_arrows_go_both_ways_about_the_axes_to_sway_about(axes: str, heads: int) -> None:
    picture = swaying(axes, "carrier")
    assert f"swaying about {' and '.join(axes)}" in picture
    lit = len(re.findall(r'<polygon points="[^"]*" fill="var\(--accent', picture))
    assert lit == heads + len(axes), "two ends of each arc, and the tip of each axis"


def test_forward_and_back_are_turned_as_they_are_asked_for() -> None:
    both, forward, back = (turning("outer", 0.0, ways) for ways in ("start end", "end", "start"))
    assert len({both, forward, back}) == 3
    assert "inner axis at 180 deg" in _words(turning("outer", 180.0))


def test_the_direction_asked_for_has_its_name() -> None:
    assert "field" in _words(along(np.array([0.0, -0.6, 0.8]), "field"))


def test_every_direction_paints_as_much_of_the_map() -> None:
    """As it is of equal area; what is near the edge is painted on both halves."""
    tilted = np.array([[np.sin(a), 0.0, np.cos(a)] for a in np.deg2rad([0.0, 30.0, 80.0])])
    ellipses = [
        [tuple(map(float, found)) for found in re.findall(r'rx="(\S+)" ry="(\S+)"', covered(one[None], "sides up"))]
        for one in tilted
    ]
    assert [len(one) for one in ellipses] == [1, 1, 2]
    areas = [a * b for one in ellipses for a, b in one]
    assert areas == pytest.approx([areas[0]] * 4, rel=0.02)
    assert areas[0] == pytest.approx(90.0**2 * (1.0 - np.cos(np.deg2rad(30.0))), rel=0.02)
