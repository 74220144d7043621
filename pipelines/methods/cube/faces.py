"""The faces of a cube as it is drawn, with their tags, and attitudes stated by them."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.simulation.scenario import ScenarioPart

_HALF = float(np.sqrt(0.5))
# id -> (bodyRtag, normal), the faces of the cube.
FACES: dict[int, tuple[tuple[float, float, float, float], tuple[float, float, float]]] = {
    16: ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    17: ((0.5, 0.5, 0.5, 0.5), (1.0, 0.0, 0.0)),
    18: ((0.0, 0.0, _HALF, _HALF), (0.0, 1.0, 0.0)),
    19: ((0.5, 0.5, -0.5, -0.5), (-1.0, 0.0, 0.0)),
    20: ((_HALF, _HALF, 0.0, 0.0), (0.0, -1.0, 0.0)),
    21: ((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
}

Side = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
SIDES: dict[Side, tuple[float, float, float]] = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}


class Resting(ScenarioPart):
    """Attitude of a resting cube: side up, side to the north, then the top leaned to the east."""

    up: Side
    north: Side
    lean_deg: float = 0.0

    @model_validator(mode="after")
    def _across(self) -> Self:
        if self.up[1] == self.north[1]:
            raise ValueError(f"{self.up} up and {self.north} to the north: sides across each other are needed")
        return self

    @property
    def nRb(self) -> Array:
        """Attitude (4,) of the resting cube."""
        up, north = np.array(SIDES[self.up]), np.array(SIDES[self.north])
        level = so3.from_matrix(np.stack([np.cross(north, up), north, up]))
        return so3.multiply(so3.exp([0.0, np.deg2rad(self.lean_deg), 0.0]), level)

    def __str__(self) -> str:
        tag = next(i for i, (_, normal) in FACES.items() if normal == SIDES[self.up])
        lean = f", leaned by {abs(self.lean_deg):g} deg to the {'east' if self.lean_deg > 0.0 else 'west'}"
        return f"{self.up} (tag {tag}) up, {self.north} to the north{lean if self.lean_deg else ''}"
