"""The layout of a cube's tags from recordings of pictures or detections, and as a config."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.methods.cube.recording import TAG_DETECTIONS, CubeConfig
from alidade.pipelines.methods.cube.tags import read_camera
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.topics import IMAGE
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

if TYPE_CHECKING:
    from alidade.pipelines.vision.camera import Camera
    from alidade.pipelines.vision.layout import Layout, Shots
    from alidade.pipelines.vision.tags import Detections


# A line of the file holds whatever belongs together.
_WIDE = 10_000
# Many pictures of one pose add little to a few; each is a pose to be found.
_MOST_PICTURES = 800


def cube_layout(recordings: Sequence[tuple[Recording, Config]], refine_camera: bool = False) -> Layout:
    """Estimate the poses of the cube's tags from pictures of all sides; the first config gives ids and sizes.

    Of a long recording pictures are taken at even distances, a few hundred.

    Args:
        recordings: each with its config; of one camera or of several.
        refine_camera: adjust the cameras' intrinsics too.

    Raises InputError when there are no pictures or detections, or none that ties the tags together.
    """
    from alidade.pipelines.vision.layout import estimate_layout
    from alidade.pipelines.vision.pose import TagBody

    shots = [_shots(recording, config) for recording, config in recordings]
    if not any(len(found) for each in shots for found in each.pictures):
        pictures = sum(len(each.pictures) for each in shots)
        raise InputError(f"no tag in any of {pictures} pictures; are they blurred, or the tags of another family?")
    return estimate_layout(shots, TagBody.from_board(recordings[0][1].section(CubeConfig)), refine_camera)


def _shots(recording: Recording, config: Config) -> Shots:
    """Read the camera, and detect the tags in each picture."""
    from alidade.pipelines.vision.layout import Shots

    found = _tags(recording, config)
    time = [(t_ns - found[0][0]) / 1e9 for t_ns, _ in found]
    return Shots(read_camera(recording, config), [tags for _, tags in found], time)


def _tags(recording: Recording, config: Config) -> list[tuple[int, Detections]]:
    """Detected tags of each picture with its stamp, ns, in time order."""
    topic = config.topic(IMAGE)
    if topic not in recording.topics:
        return _detections(recording, config)
    from alidade.pipelines.vision.tags import detections

    pictures = islice(recording.images(topic), None, None, _every(recording.topics[topic].count))
    seen = detections(pictures, config.section(CubeConfig).tag_family, read_camera(recording, config))
    return [(t_ns, tags) for t_ns, tags in seen if tags is not None]


def _every(pictures: int) -> int:
    """Stride through pictures that keeps at most `_MOST_PICTURES`."""
    return -(-pictures // _MOST_PICTURES)


def _detections(recording: Recording, config: Config) -> list[tuple[int, Detections]]:
    from alidade.pipelines.vision.tags import Detections

    seen = recording.detections(config.topic(TAG_DETECTIONS))
    sigma = first_given(config.noise.corner_px, DEFAULT_NOISE.corner_px)
    found = []
    for frame in range(0, len(seen), _every(len(seen))):
        rows = np.flatnonzero(seen.frame == frame)
        covariance = np.tile(sigma**2 * np.eye(2), (len(rows), 4, 1, 1))
        tags = Detections(seen.tag_id[rows], seen.corners[rows], covariance)
        found.append((int(seen.t_ns[frame]), tags))
    return found


def layout_yaml(layout: Layout) -> str:
    """Config text (YAML) of a layout, with `cube.tags` for `calibrate --config` and sigmas in comments."""
    body = layout.body
    tags = {
        int(i): {"size": float(size), "rotation": bRt.tolist(), "position": position.tolist()}
        for i, size, bRt, position in zip(body.ids, body.size, body.bRt, body.position, strict=True)
    }
    cube: dict[str, object] = {"tag_family": body.family, "tags": tags, "covariance": _covariance(layout)}
    if layout.with_camera is not None:
        cube["camera"] = _camera(layout.cameras[0])
    sigmas = np.sqrt(np.diag(layout.covariance)).reshape(-1, 6)
    lines = [
        f"# From {layout.frames} pictures; corners good to {layout.rms_px:.3f} px RMS, tags flat and square to "
        f"{layout.bend:.2%} of their size. Sigmas:"
    ]
    lines.append(f"# tag {body.ids[0]}: defines the body frame")
    lines += [
        f"# tag {i}: {np.rad2deg(s[:3].max()):.3f} deg, {1e3 * s[3:].max():.3f} mm"
        for i, s in zip(body.ids[1:], sigmas, strict=True)
    ]
    lines += [f"# tag {i} could not be placed: {why}" for i, why in layout.unplaced.items()]
    return "\n".join([*lines, dump_yaml({"cube": cube}, _WIDE)])


def _covariance(layout: Layout) -> dict[str, object]:
    """Convert a layout's covariance to the form of the config's cube.covariance."""
    known = layout.covariance if layout.with_camera is None else layout.with_camera
    rows = [" ".join(f"{x:.7g}" for x in row[: i + 1]) for i, row in enumerate(known.tolist())]
    tags: dict[str, object] = {"tags": [int(i) for i in layout.body.ids[1:]]}
    return {**tags, **({} if layout.with_camera is None else {"camera": True}), "rows": rows}


def _camera(camera: Camera) -> dict[str, object]:
    """Convert a camera to the form of the config's cube.camera."""
    return {
        "focal": camera.focal.tolist(),
        "centre": camera.centre.tolist(),
        "distortion": camera.coefficients.tolist(),
    }
