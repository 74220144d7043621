"""Guidance of the cube method: motion while recording and of a plan, faults of the data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import magnetic_field
from alidade.pipelines.diagnostics.checklist import ChecklistItem
from alidade.pipelines.diagnostics.fault_models import ExactInput, FaultModel, ScaleFactor
from alidade.pipelines.display.drawing import covered, resting, swaying
from alidade.pipelines.display.figure import AXES
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.methods import Guidance, Scenario
from alidade.pipelines.methods.cube.recording import CubeConfig, CubeData
from alidade.pipelines.methods.cube.simulation import SIDES, CubeScenario, Resting, Side, attitudes
from alidade.pipelines.methods.cube.static_poses import static_poses
from alidade.pipelines.methods.place import STRENGTH_ADVICE
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import YEAR

# Poses that determine the twelve numbers of a triad, and those of published practice: each of six faces thrice.
_FEWEST_POSES, _POSES_A_FACE = 4, 3


def checklist(data: CubeData, config: Config) -> Sequence[ChecklistItem]:
    """Checklist of poses and upward faces, tags seen, and the next best pose."""
    poses = static_poses(data, config)
    up = poses.accel / np.linalg.norm(poses.accel, axis=1, keepdims=True)
    faces = np.argmax(up @ np.array(list(SIDES.values())).T, axis=1)
    count = {face: int((faces == k).sum()) for k, face in enumerate(SIDES)}
    few = [face for face, n in count.items() if n < _POSES_A_FACE]
    tags = sorted({int(tag) for seen in poses.tags if seen is not None for tag in seen.ids})
    wanted = f"at least {_FEWEST_POSES}" if len(up) < _FEWEST_POSES else ""
    found = [
        ChecklistItem("poses", f"{len(up)} at rest", wanted, min(len(up) / _FEWEST_POSES, 1.0)),
        ChecklistItem(
            "faces up",
            ", ".join(f"{face} {n}" for face, n in count.items()),
            f"{_POSES_A_FACE} poses each recommended, too few of {', '.join(few)}" if few else "",
            sum(min(n, _POSES_A_FACE) for n in count.values()) / (_POSES_A_FACE * len(count)),
            chart=covered(up, "sides up") if len(up) else "",
        ),
    ]
    if data.camera is not None:
        found.append(ChecklistItem("tags seen", ", ".join(map(str, tags)) or "none", "" if tags else "show the cube"))
    if few:
        pose = next_pose(up, poses.mag)
        found.append(ChecklistItem("next", f"{len(up) + 1}. pose", pose.words, motion=pose))
    return found


def next_pose(up: Array, mag: Array | None) -> Motion:
    """Select the most informative of 24 axis-aligned attitudes for accelerometer and magnetometer.

    What a pose with nominal vector n adds to what a triad's twelve numbers are known by is x'N^-1x, x = (n, 1), N the
    sum of xx' over the poses there are.
    """
    known, field = [_information(up)], None
    if mag is not None and (seen := np.isfinite(mag).all(axis=1)).any():
        measured = mag[seen] / np.linalg.norm(mag[seen], axis=1, keepdims=True)
        dip = float(np.median((measured * up[seen]).sum(axis=1)))  # sine of the field's angle above the horizon
        field = np.array([0.0, np.sqrt(max(1.0 - dip**2, 0.0)), dip])
        known.append(_information(measured))
    choices = _choices((0.0,))
    gains = np.expm1(_gains(known, choices, field, None)).sum(axis=1)
    best = choices[int(np.argmax(gains > gains.max() * (1.0 - 1e-9)))]
    north = None if field is None else best.north
    ahead = "" if north is None else f" and {north} to the north"
    return Motion(f"rest the cube with {best.up} up{ahead}", rested(best.up, north))


def _information(vectors: Array) -> Array:
    rows = np.column_stack([vectors, np.ones(len(vectors))])
    return np.asarray(rows.T @ rows + _REGULARISER * np.eye(4))


# Poses that are proposed together, and the seed of their simulation.
_SERIES, _SEED = 6, 0


def candidates(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    """Yield changes of a scenario worth trying: a phrase, and the changed scenario."""
    single, series = next_poses(CubeScenario.model_validate(scenario), _SEED, _SERIES)
    for poses in (*([pose] for pose in single), series):
        more = [*scenario["attitudes"], *(pose.model_dump() for pose in poses)]
        words = "; then ".join(str(pose) for pose in poses)
        yield (
            f"{'one more pose' if len(poses) == 1 else f'{len(poses)} more poses'}: {words}",
            {**scenario, "attitudes": more},
        )
    yield "each pose held twice as long", {**scenario, "static_s": 2.0 * scenario["static_s"]}
    if scenario["turn_axes"]:
        yield "turns about any axis", {**scenario, "turn_axes": []}
    if scenario["cube"]["hidden"]:
        yield "every face shown", {**scenario, "cube": {**scenario["cube"], "hidden": []}}


def _tag_sizes(data: CubeData, config: Config, factor: float) -> tuple[CubeData, Config] | None:
    """Scale all tag sizes in the config by a factor; None where the config names no tag."""
    cube = config.section(CubeConfig)
    if not cube.tags:
        return None
    tags = {i: tag.model_copy(update={"size": factor * tag.size}) for i, tag in cube.tags.items()}
    return data, config.model_copy(update={"cube": cube.model_copy(update={"tags": tags})})


def _latitude(data: CubeData, config: Config, change: float) -> tuple[CubeData, Config] | None:
    if data.latitude is None:
        return None
    return _as_found(data, config, replace(data, latitude=data.latitude + np.deg2rad(change)), config)


def _tag_size(data: CubeData, config: Config, change: float) -> tuple[CubeData, Config] | None:
    changed = _tag_sizes(replace(data), config, 1.0 + change)
    return None if data.camera is None or changed is None else _as_found(data, config, *changed)


def _as_found(data: CubeData, config: Config, changed: CubeData, other: Config) -> tuple[CubeData, Config]:
    """Give changed data the static poses cached for the unchanged data.

    They would be the same, but for first guesses; finding them takes longer than all the rest.
    """
    before, after = config.model_dump_json(), other.model_dump_json()
    changed.computed.update({(name, after): found for (name, of), found in data.computed.items() if of == before})
    return changed, other


# Opposite signs of accelerometer and magnetometer are part of what is calibrated.
FAULTS = FaultModel(
    streams={"imu_t": ("gyro", "accel"), "mag_t": ("mag",), "reference_t": ("reference_wxyz", "reference_cov")},
    signs={"gyro": ("gyro", AXES)},
    scalings=(ScaleFactor("the tags are {factor:.3g} times as large as the config says", _tag_sizes),),
    exact=(
        ExactInput("latitude_deg", "deg", 0.1, _latitude),
        ExactInput("tag_size", "1", 2e-3, _tag_size),
    ),
    cut=False,
)


_UP: dict[str, Side] = {"x": "+x", "y": "+y", "z": "+z"}


def advice(weights: Mapping[str, float]) -> Motion:
    """Motion that would make a weak direction observable."""
    if "mag_scale" in weights:
        return STRENGTH_ADVICE
    strongest = [name for name, w in weights.items() if abs(w) > 0.3] or list(weights)
    gyro = "".join(sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith("gyro_k")}))
    if gyro:
        words = f"turn the cube between poses about its {' and '.join(gyro)} axis, by a quarter turn or more, both ways"
        return Motion(words, swaying(gyro, "cube", (0.8, 0.8, 0.8)))
    still = {name.split("_")[0] for name in strongest if name.startswith(("accel", "mag"))}
    if still:
        axes = sorted({"xyz"[int(name[-1]) - 1] for name in strongest if name.startswith(("accel_k", "mag_k"))})
        about = f", its {' and '.join(axes)} axis up, down and level" if axes else ""
        picture = rested(_UP[axes[0] if axes else "x"])
        return Motion(f"add static poses in other attitudes{about}", picture, " and ".join(sorted(still)))
    if any(name.startswith("gyro_b") for name in strongest):
        return Motion("let the cube stand still longer")
    if any(name.startswith("tag_") for name in strongest):
        tags = sorted({name.split("_")[1] for name in strongest if name.startswith("tag_")})
        return Motion(f"show tag {' and '.join(tags)} to the camera together with its neighbours")
    return Motion(
        "turn the cube through more attitudes", why="heading, camera mount and field trade against each other"
    )


_LEANS = (0.0, 45.0)
# Fisher information before any pose, small beside what one adds: makes the sum invertible.
_REGULARISER = 1e-3


def next_poses(scenario: CubeScenario, seed: int, together: int) -> tuple[list[Resting], list[Resting]]:
    """Most informative single poses, for one sensor or all, and the best sequence of a given number of poses."""
    field = None
    if scenario.magnetometer:
        place = np.deg2rad([scenario.place.latitude_deg, scenario.place.longitude_deg])
        field = magnetic_field(float(place[0]), float(place[1]), scenario.place.height, YEAR)
        field = field / np.linalg.norm(field)
    # Of accelerometer, magnetometer, if any, and turns.
    known, last = [_REGULARISER * np.eye(n) for n in ((4, 3) if field is None else (4, 4, 3))], None
    for nRb in attitudes(scenario, seed):
        known, last = _after(known, nRb, field, last), nRb
    choices = _choices(_LEANS)
    gains = _gains(known, choices, field, last)
    single = [choices[int(np.argmax(column))] for column in [gains.sum(axis=1), *gains.T]]
    series: list[Resting] = []
    for _ in range(together):
        series.append(choices[int(np.argmax(_gains(known, choices, field, last).sum(axis=1)))])
        known, last = _after(known, series[-1].nRb, field, last), series[-1].nRb
    return list(dict.fromkeys(single)), series


def _choices(leans: Sequence[float]) -> list[Resting]:
    """Axis-aligned resting attitudes, each with the top leaned by given angles, deg."""
    sides = [(up, north) for up in SIDES for north in SIDES if up[1] != north[1]]
    return [Resting(up=up, north=north, lean_deg=lean) for up, north in sides for lean in leans]


def _rows(nRb: Array, field: Array | None, last: Array | None) -> list[Array]:
    """Rows that a rest in nRb adds to what is known of each sensor and, by the turn from the last one, of turns."""
    bRn = so3.inverse(nRb)
    vectors = [np.array([0.0, 0.0, 1.0]), *([] if field is None else [field])]
    turned = np.zeros(3) if last is None else so3.local(last, nRb)
    return [*(np.append(so3.rotate(bRn, vector), 1.0) for vector in vectors), turned]


def _after(known: Sequence[Array], nRb: Array, field: Array | None, last: Array | None) -> list[Array]:
    """Fisher information after a rest in nRb."""
    return [information + np.outer(row, row) for information, row in zip(known, _rows(nRb, field, last), strict=True)]


def _gains(known: Sequence[Array], choices: Sequence[Resting], field: Array | None, last: Array | None) -> Array:
    """Information gain of each choice for each of what is known, (choices, known)."""
    return np.array(
        [
            [
                np.log1p(row @ np.linalg.solve(information, row))
                for information, row in zip(known, _rows(each.nRb, field, last), strict=False)
            ]
            for each in choices
        ]
    )


@cache
def rested(up: Side, north: Side | None = None) -> str:
    """Drawing of a cube resting on a side, with a compass if another side is to point north."""
    ahead = next(side for side in SIDES if side[1] != up[1]) if north is None else north
    return resting(Resting(up=up, north=ahead).nRb, compass=north is not None)


GUIDANCE = Guidance(checklist=checklist, variations=candidates)
