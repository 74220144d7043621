"""What cube-layout knows of where the tags are, and of the camera, as parameters and as their joint prior."""

from __future__ import annotations

import gtsam
import numpy as np

from alidade.pipelines.belief import Belief
from alidade.pipelines.estimation.problem import Parameter, Quantity
from alidade.pipelines.methods.cube.topics import CubeConfig
from alidade.pipelines.settings import Config

# Of a tag, as cube.covariance has them: rotation, position.
_NUMBERS = ("x", "y", "z", "px", "py", "pz")
# Of a camera, likewise.
CAMERA_NUMBERS = ("camera_focal", "camera_centre_x", "camera_centre_y")
# The yardstick of a tag's position, m.
_PRIOR = 1e-3


def tag_place_key(tag: int) -> int:
    """Variable of the correction of a tag's position on the cube, (3,) m."""
    return int(gtsam.symbol("L", tag))


def tag_place_names(config: Config) -> list[str]:
    """Names of the numbers of `tag_places`."""
    return [quantity.name for parameter in tag_places(config) for quantity in parameter.quantities]


def tag_places(config: Config) -> tuple[Parameter, ...]:
    """Corrections of all tags' positions, if there is a covariance of the layout; exact where that is silent."""
    cube = config.section(CubeConfig)
    if cube.covariance is None:
        return ()

    def quantity(tag: int, axis: str) -> Quantity:
        name = f"tag_{tag}_p{axis}"
        sigma = config.prior(name, _PRIOR if tag in _told(cube) else 0.0)
        return Quantity(name, "m", sigma, _PRIOR, np.inf, nuisance=True)

    return tuple(Parameter(tag_place_key(tag), tuple(quantity(tag, a) for a in "xyz")) for tag in sorted(cube.tags))


def layout_belief(config: Config) -> Belief | None:
    """What the layout's covariance says of tags and of the camera, but for numbers with a prior given elsewhere."""
    cube = config.section(CubeConfig)
    if cube.covariance is None:
        return None
    elsewhere = {*config.priors, *(name for belief in config.beliefs for name in belief.names)}
    of_camera = CAMERA_NUMBERS if cube.covariance.camera else ()
    names = (*(f"tag_{tag}_{number}" for tag in cube.covariance.tags for number in _NUMBERS), *of_camera)
    told = {*(f"tag_{tag}_{number}" for tag in _told(cube) for number in _NUMBERS), *of_camera}
    whole = Belief(names, np.zeros(len(names)), cube.covariance.matrix, "the covariance of the tags' layout")
    return whole.of(told - elsewhere)


def _told(cube: CubeConfig) -> list[int]:
    """Tags on the cube that the layout's covariance is of; the lowest id is exact."""
    tags = () if cube.covariance is None else cube.covariance.tags
    return [tag for tag in tags if tag in cube.tags and tag != min(cube.tags)]
