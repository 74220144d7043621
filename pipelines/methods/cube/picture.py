"""A picture of the attitude in which a cube is to be rested."""

from __future__ import annotations

from functools import cache

from alidade.pipelines.display.drawing import resting
from alidade.pipelines.methods.cube.faces import SIDES, Resting, Side


@cache
def rested(up: Side, north: Side | None = None) -> str:
    """A side up; with another one to the north a compass is drawn."""
    ahead = next(side for side in SIDES if side[1] != up[1]) if north is None else north
    return resting(Resting(up=up, north=ahead).nRb, compass=north is not None)
