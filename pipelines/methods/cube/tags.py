"""The cube's tags in the pictures of a recording, the camera that took them, and the layout of the tags."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import stated
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.methods.cube.parameters import PLACE, TAG
from alidade.pipelines.methods.cube.recording import TAG_DETECTIONS, CubeConfig, CubeData, RefinedCamera, Sightings
from alidade.pipelines.methods.cube.static_poses import static_intervals
from alidade.pipelines.recording.checks import clean, count
from alidade.pipelines.recording.container import require_distinct
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.topics import IMAGE, wanted
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given
from alidade.pipelines.vision.camera import Camera, camera_of

if TYPE_CHECKING:
    from alidade.pipelines.vision.layout import Layout, Shots
    from alidade.pipelines.vision.tags import Detections


_FAMILIES = ("", "36h11", "tag36h11")
# More pictures than this share with one id twice are two tags with one id, not a false detection.
_TWICE = 0.1
# Focal lengths that differ by more than this share are of two cameras.
_OTHER_CAMERA = 0.05


def read_camera(recording: Recording, config: Config) -> Camera:
    """Read the camera that observes the cube. Raises InputError if camera or tags are not described."""
    if not config.section(CubeConfig).tags:
        raise InputError(
            "the tags on the cube are not given: name them in the config as cube.tags {id: {size, rotation, position}}"
        )
    camera, refined = camera_of(recording, config), config.section(CubeConfig).camera
    return camera if refined is None else _refined(camera, refined)


def _refined(camera: Camera, refined: RefinedCamera) -> Camera:
    """Apply the config's intrinsics to the recording's camera. Raises InputError if these are of another camera."""
    if np.abs(np.array(refined.focal) / camera.focal - 1.0).max() > _OTHER_CAMERA:
        raise InputError(
            f"cube.camera is of another camera: its focal length is {refined.focal[0]:.6g} px, that of the recording's "
            f"CameraInfo {camera.focal[0]:.6g}; take cube.camera out, and `camera` out of cube.covariance"
        )
    if len(refined.distortion) != len(camera.coefficients):
        raise InputError(
            f"cube.camera is of another camera: it has {len(refined.distortion)} coefficients of distortion, that of "
            f"the recording's CameraInfo {len(camera.coefficients)}"
        )
    return camera.with_intrinsics(np.array([*refined.focal, *refined.centre, *refined.distortion]))


def read_sightings(recording: Recording, data: CubeData, config: Config, dropped: dict[str, int]) -> Sightings:
    """Read the cube's tags from the pictures of static intervals, or else from recorded detections.

    Where both are there the config may name the detections under `topics`, and no pictures.

    Raises InputError when a topic is unusable, with pictures when there is no static interval, or no tag of the cube.
    """
    if wanted(recording, config, IMAGE) and (IMAGE.key in config.topics or TAG_DETECTIONS.key not in config.topics):
        return _pictures(recording, config, data, dropped)
    return _detections(recording, config, data.epoch_ns, dropped)


def _detections(recording: Recording, config: Config, epoch_ns: int, dropped: dict[str, int]) -> Sightings:
    topic = config.topic(TAG_DETECTIONS)
    found = recording.detections(topic)
    count(dropped, f"{topic}: stamped by log time (kept)", found.stamped_by_log)
    t, keep = clean(topic, found.t_ns, epoch_ns, np.arange(float(len(found)))[:, None], dropped, least=1)
    place = np.full(len(found), -1)
    place[keep] = np.arange(len(keep))
    good = (place[found.frame] >= 0) & np.isfinite(found.corners).all(axis=(1, 2))
    good &= np.isin(found.family, _FAMILIES)
    return _sightings(
        topic, config, t, place[found.frame[good]], found.tag_id[good], found.corners[good], None, dropped
    )


def _pictures(recording: Recording, config: Config, data: CubeData, dropped: dict[str, int]) -> Sightings:
    """Detect tags in the pictures of the static intervals only."""
    from alidade.pipelines.vision.tags import UNREADABLE, detections

    assert data.camera is not None
    epoch_ns, (start, stop) = data.epoch_ns, static_intervals(data, config).T
    topic = config.topic(IMAGE)
    stamps: list[int] = []
    frame: list[int] = []
    parts = []
    at_rest = (
        (t_ns, encoded)
        for t_ns, encoded in recording.images(topic)
        if ((start <= (t_ns - epoch_ns) / 1e9) & ((t_ns - epoch_ns) / 1e9 <= stop)).any()
    )
    for t_ns, seen in detections(at_rest, config.section(CubeConfig).tag_family, data.camera):
        if seen is None:
            count(dropped, f"{topic}: {UNREADABLE}", 1)
            continue
        sharp = np.isfinite(seen.covariance).all(axis=(1, 2, 3))
        count(dropped, f"{topic}: tag with an edge that cannot be measured", int((~sharp).sum()))
        frame += [len(stamps)] * int(sharp.sum())
        stamps.append(t_ns)
        parts.append((seen.ids[sharp], seen.corners[sharp], seen.covariance[sharp]))
    if not frame:
        raise InputError(
            f"topic {topic}: no tag is seen sharply in any of the {len(stamps)} pictures of the static poses; are they "
            "blurred, or the tags of another family?"
        )
    t, keep = clean(
        topic, np.array(stamps, dtype=np.int64), epoch_ns, np.arange(float(len(stamps)))[:, None], dropped, least=1
    )
    place = np.full(len(stamps), -1)
    place[keep] = np.arange(len(keep))
    frames = place[np.array(frame, dtype=np.int64)]
    ids, corners, covariance = (np.concatenate(column) for column in zip(*parts, strict=True))
    good = frames >= 0
    return _sightings(topic, config, t, frames[good], ids[good], corners[good], covariance[good], dropped)


def _sightings(
    topic: str,
    config: Config,
    t: Array,
    frame: NDArray[np.int64],
    ids: NDArray[np.int64],
    corners: Array,
    covariance: Array | None,
    dropped: dict[str, int],
) -> Sightings:
    """Select the cube's tags among detections; ids seen twice in a picture are dropped there."""
    known = np.isin(ids, list(config.section(CubeConfig).tags))
    if not known.any():
        raise InputError(
            f"topic {topic}: no tag of the cube in any of {len(t)} pictures: seen {np.unique(ids).tolist() or 'none'}, "
            f"the config names {sorted(config.section(CubeConfig).tags)}"
        )
    count(dropped, f"{topic}: tag that is not on the cube", int((~known).sum()))
    _, inverse, counts = np.unique(np.stack([frame, ids]), axis=1, return_inverse=True, return_counts=True)
    once = counts[inverse.ravel()] == 1
    for tag in np.unique(ids[known & ~once]):
        pictures = len(np.unique(frame[(ids == tag) & ~once]))
        if pictures > _TWICE * len(np.unique(frame[ids == tag])):
            raise InputError(
                f"topic {topic}: tag {tag} is seen twice in {pictures} pictures; every tag in sight needs its own id"
            )
    count(dropped, f"{topic}: tag seen twice in a picture", int((known & ~once).sum()))
    good = known & once
    return Sightings(t, frame[good], ids[good], corners[good], None if covariance is None else covariance[good])


# Of a tag, as cube.covariance has them: rotation, position.
_NUMBERS = ("x", "y", "z", "px", "py", "pz")
# Of a camera, likewise.
CAMERA_NUMBERS = ("camera_focal", "camera_centre_x", "camera_centre_y")


def layout_prior(config: Config) -> GaussianPrior:
    """Joint prior of tags and camera from the layout's or drawing's covariance, except numbers with own priors.

    The tag with the lowest id is exact.
    """
    cube = config.section(CubeConfig)
    layout, others = cube.covariance, sorted(cube.tags)[1:]
    tags, covariance = (others, _drawing_covariance(config)) if layout is None else (layout.tags, layout.matrix)
    source = "that of tags on a drawing" if layout is None else "the covariance of the tags' layout"
    of_camera = CAMERA_NUMBERS if layout is not None and layout.camera else ()
    elsewhere = {*config.priors, *(name for gaussian_prior in config.gaussian_priors for name in gaussian_prior.names)}
    names = (*(f"tag_{tag}_{number}" for tag in tags for number in _NUMBERS), *of_camera)
    known = {*(f"tag_{tag}_{number}" for tag in others for number in _NUMBERS), *of_camera}
    return GaussianPrior(names, np.zeros(len(names)), covariance, source).of(known - elsewhere)


def _drawing_covariance(config: Config) -> Array:
    """Covariance (6 n, 6 n) of rotations (rad) and positions (m) of a drawing's n tags, all but that of the lowest id.

    Each tag is turned by a vector of its own. That of the lowest id, w, whose pose defines the body, turns the others
    against it by -R^T w and moves them by r x w, with their attitude R and place r against it; none where places are
    exact.
    """
    from alidade.pipelines.vision.pose import TagBody

    body = TagBody.from_board(config.section(CubeConfig))
    turned, moved = so3.matrix(so3.inverse(body.bRt[1:])), so3.hat(body.position[1:] - body.position[0])
    common = np.concatenate([-turned, moved], axis=1).reshape(-1, 3)
    rotation, position = stated(config, TAG), stated(config, PLACE)
    own = np.tile(np.repeat([rotation, position], 3), len(body.ids) - 1)
    return np.asarray(np.diag(own**2) + (rotation**2 * common @ common.T if position else 0.0))


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

    Raises InputError when there are no pictures or detections, or none that ties the tags together, or a recording is
    named twice.
    """
    from alidade.pipelines.vision.layout import estimate_layout
    from alidade.pipelines.vision.pose import TagBody

    require_distinct((recording.path.name, recording.sha256()) for recording, _ in recordings)
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
        return _recorded_tags(recording, config)
    from alidade.pipelines.vision.tags import detections

    pictures = islice(recording.images(topic), None, None, _every(recording.topics[topic].count))
    seen = detections(pictures, config.section(CubeConfig).tag_family, read_camera(recording, config))
    return [(t_ns, tags) for t_ns, tags in seen if tags is not None]


def _every(pictures: int) -> int:
    """Stride through pictures that keeps at most `_MOST_PICTURES`."""
    return -(-pictures // _MOST_PICTURES)


def _recorded_tags(recording: Recording, config: Config) -> list[tuple[int, Detections]]:
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
    cube: dict[str, object] = {"tag_family": body.family, "tags": tags, "covariance": _covariance_section(layout)}
    if layout.with_camera is not None:
        camera = layout.cameras[0]
        cube["camera"] = {
            "focal": camera.focal.tolist(),
            "centre": camera.centre.tolist(),
            "distortion": camera.coefficients.tolist(),
        }
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


def _covariance_section(layout: Layout) -> dict[str, object]:
    """Convert a layout's covariance to the form of the config's cube.covariance."""
    known = layout.covariance if layout.with_camera is None else layout.with_camera
    rows = [" ".join(f"{x:.7g}" for x in row[: i + 1]) for i, row in enumerate(known.tolist())]
    tags: dict[str, object] = {"tags": [int(i) for i in layout.body.ids[1:]]}
    return {**tags, **({} if layout.with_camera is None else {"camera": True}), "rows": rows}
