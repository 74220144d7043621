"""How a cube result is applied. Frames: b cube's body, B reference, C camera, n level. Methods page, section 4."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.pipelines.methods.cube.compensation import straightened
from alidade.pipelines.methods.cube.data import nominal, recorded
from alidade.pipelines.methods.cube.parameters import CUBE, SENSITIVITY, SQUARE, TEMPERATURE, TILT
from alidade.pipelines.methods.cube.topics import CubeConfig, RawConversion
from alidade.pipelines.methods.formula import (
    Formula,
    matrix_text,
    numbers_of,
    over_temperature,
    temperature_text,
    vector_text,
)
from alidade.pipelines.methods.triads import triad_formula
from alidade.pipelines.settings import Config


def formulas(parameters: Collection[str], config: Config) -> list[Formula]:
    """Of the sensors, mounts and tags that are among the parameters; raw numbers are as recorded.

    The accelerometer's curvature, the gyro's g-sensitivity and their slopes over temperature, which are about nominal
    units, where they are known.
    """
    raw = config.section(CubeConfig).raw
    found: list[Formula] = []
    if "accel_k11" in parameters:
        found += _accelerometer(parameters, raw.accel)
    if "gyro_k11" in parameters:
        found.append(_gyro(parameters, raw.gyro))
    if "mag_k11" in parameters:
        found.append(triad_formula("mag", parameters, "mag", ("mag",), lambda v: v.mag))
    if "camera_mount_x" in parameters:
        found.append(
            Formula(
                "camera to reference, camera_rotation as the config gives it",
                "BRC",
                "camera_rotation * Exp(camera_mount)",
                ("camera_rotation",),
                lambda v: so3.multiply(v.camera_rotation, so3.exp(v.camera_mount)),
            )
        )
    tags = sorted(int(name[4:-2]) for name in parameters if name.startswith("tag_") and name.endswith("_x"))
    found += [_tag(tag) for tag in tags]
    if "reference_heading" in parameters:
        names = (*TILT.names, "reference_heading")
        found.append(
            Formula(
                "reference to level, from its own attitude nRB_said in East-North-Up",
                "nRB",
                f"Exp({vector_text(names, parameters)}) * nRB_said",
                ("nRB_said",),
                lambda v: so3.multiply(so3.exp(numbers_of(v, names)), v.nRB_said),
            )
        )
    if "camera_mount_x" in parameters and "reference_heading" in parameters:
        found.append(
            Formula(
                "attitude of the cube from a tag seen at CRT that stands on it at bodyRtag",
                "nRb",
                "nRB * BRC * CRT * inverse(bodyRtag)",
                ("camera_rotation", "nRB_said", "CRT", "bodyRtag"),
                lambda v: so3.compose(v.nRB, v.BRC, v.CRT, so3.inverse(v.bodyRtag)),
            )
        )
    return found


def stated(config: Config) -> dict[str, so3.Array]:
    """The camera's mount and the tags' rotations as the config gives them, by their names in the formulas."""
    cube = config.section(CubeConfig)
    tags = {f"rotation_{tag}": np.array(each.rotation) for tag, each in cube.tags.items()}
    return tags if cube.camera_rotation is None else {**tags, "camera_rotation": np.array(cube.camera_rotation)}


def _accelerometer(parameters: Collection[str], conversion: RawConversion | None) -> list[Formula]:
    """With its curvature and its drift taken off, in nominal units, as far as they are known."""
    drift, off = _drift("accel", parameters)
    needs = ("accel", *(["temperature"] if drift else []))
    if not any(name in parameters for each in (SQUARE, CUBE) for name in each.names):
        text, scale = _less("accel", [drift], conversion)
        return [triad_formula("accel", parameters, text, needs, lambda v: v.accel - off(v) / scale)]
    square, cube = (vector_text(each.names, parameters) for each in (SQUARE, CUBE))
    said = "accel" if conversion is None else f"(accel - {conversion.offset!r}) * {conversion.scale!r}"
    unbent = f"(accel_u - {drift})" if drift else "accel_u"
    back = unbent if conversion is None else f"({unbent} / {conversion.scale!r} + {conversion.offset!r})"

    def bent(by: str) -> str:
        return f"{said} - {square} * {by}**2 - {cube} * {by}**3"

    def once(v: Any) -> so3.Array:
        read = nominal(v.accel, conversion)
        return np.asarray(read - numbers_of(v, SQUARE.names) * read**2 - numbers_of(v, CUBE.names) * read**3)

    def straight(v: Any) -> so3.Array:
        return straightened(nominal(v.accel, conversion), numbers_of(v, SQUARE.names), numbers_of(v, CUBE.names))

    meaning = "accelerometer without its curvature, m/s^2, axis by axis"
    first = said if conversion is None else f"({said})"
    return [
        Formula(f"{meaning}, nearly", "accel_near", bent(first), ("accel",), once),
        Formula(meaning, "accel_u", bent("accel_near"), ("accel",), straight),
        triad_formula("accel", parameters, back, needs, lambda v: recorded(v.accel_u - off(v), conversion)),
    ]


def _gyro(parameters: Collection[str], conversion: RawConversion | None) -> Formula:
    """With what it says for the specific force and for its temperature taken off, as far as that is known."""
    feels = any(name in parameters for name in SENSITIVITY.names)
    felt = f"{matrix_text([SENSITIVITY.names[i : i + 3] for i in (0, 3, 6)], parameters)} * f_b" if feels else ""
    drift, off = _drift("gyro", parameters)
    text, scale = _less("gyro", [felt, drift], conversion)

    def read(v: Any) -> so3.Array:
        excess = off(v)
        if feels:
            excess = excess + v.f_b @ numbers_of(v, SENSITIVITY.names).reshape(3, 3).T
        return np.asarray(v.gyro - excess / scale)

    needs = "gyro", *(["accel"] if feels else []), *(["temperature"] if drift else [])
    return triad_formula("gyro", parameters, text, needs, read)


def _drift(sensor: str, parameters: Collection[str]) -> tuple[str, Callable[[Any], so3.Array]]:
    """What a sensor reads too much at its temperature, in nominal units: as text, empty where unknown, and as code."""
    names = TEMPERATURE[sensor].names
    if not any(name in parameters for name in names):
        return "", lambda _: np.zeros(3)
    return temperature_text(names, parameters), lambda v: over_temperature(v, names)


def _less(reading: str, excesses: Sequence[str], conversion: RawConversion | None) -> tuple[str, float]:
    """A reading less what is in it too much, in nominal units, as text, and how much of these its unit is."""
    scale = 1.0 if conversion is None else conversion.scale
    each = [f" - {excess}" if conversion is None else f" - {excess} / {scale!r}" for excess in excesses if excess]
    return f"({reading}{''.join(each)})" if each else reading, scale


def _tag(tag: int) -> Formula:
    return Formula(
        f"tag {tag} to cube, rotation_{tag} as the config gives it",
        f"bodyRtag_{tag}",
        f"rotation_{tag} * Exp(tag_{tag})",
        (f"rotation_{tag}",),
        lambda v: so3.multiply(getattr(v, f"rotation_{tag}"), so3.exp(getattr(v, f"tag_{tag}"))),
    )
