"""The layout of a cube's tags from recordings of pictures or detections: as a config, a page and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.display.figure import COLORS, Figure, Plot
from alidade.pipelines.display.table import Column, Table
from alidade.pipelines.display.units import to_digits_of
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.methods.cube.recording import TAG_DETECTIONS, CubeConfig
from alidade.pipelines.methods.cube.tags import read_camera
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.topics import IMAGE
from alidade.pipelines.reports.plain_json import plain_json
from alidade.pipelines.reports.report import Block, Bullets, Plots, Report, Section, Summary, Tone
from alidade.pipelines.reports.sentences import capital
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


COLUMNS = ("tag", "pictures", "px", "sigma, deg", "sigma, mm", "false", "correlation")

# The first tag in less than this share of the pictures that show the others is what all their sigmas have in them.
_SELDOM = 0.25
# A tag that misses by this many times the others' median is no flat square of its size.
_MISFIT = 2.5
# Pictures determine a number whose sigma is below this share of its prior's.
_DETERMINED = 0.5


def headline(layout: Layout) -> str:
    """Sentence: number of tags placed, fit of the pictures, and the tag that fits worst."""
    placed, of = len(layout.body.ids), len(layout.body.ids) + len(layout.unplaced)
    worst, seen = max(layout.seen.items(), key=lambda item: item[1].rms_px)
    return (
        f"{placed} of {of} tags placed from {layout.frames} pictures, corners to {layout.rms_px:.2f} px RMS; "
        f"worst is tag {worst} with {seen.rms_px:.2f} px"
    )


def advice(layout: Layout) -> list[str]:
    """Sentences about tags that fit badly or could not be placed."""
    usual = float(np.median([seen.rms_px for seen in layout.seen.values()]))
    bad = [tag for tag, seen in layout.seen.items() if seen.rms_px > _MISFIT * usual]
    out = [f"tag {tag} could not be placed: {why}" for tag, why in layout.unplaced.items()]
    if bad:
        names = ", ".join(map(str, bad))
        out.append(
            f"tag{'s' if len(bad) > 1 else ''} {names}: corners miss by {_MISFIT:g} times as much as others' or more; "
            "check the size in the config, and that the tag is flat"
        )
    first, *others = layout.seen.items()
    often = float(np.median([seen.pictures for _, seen in others]))
    if first[1].pictures < _SELDOM * often:
        out.append(
            f"tag {first[0]} defines the body's frame and is in {first[1].pictures} pictures only, others in "
            f"{often:.0f}: its error is in the sigmas of all; take more pictures of it with others"
        )
    return out


def layout_json(layout: Layout) -> str:
    """JSON text of a cube's layout: tags, their poses and sigmas."""
    sigmas = np.sqrt(np.diag(layout.covariance)).reshape(-1, 6).tolist()
    body = layout.body
    return plain_json(
        "layout",
        {
            "headline": headline(layout),
            "pictures": layout.frames,
            "rms_px": layout.rms_px,
            "tags": [
                {
                    "id": tag,
                    "pictures": seen.pictures,
                    "rejected": seen.rejected,
                    "rms_px": seen.rms_px,
                    "rotation": body.bRt[i].tolist(),
                    "position": body.position[i].tolist(),
                    "rotation_sigma": [0.0] * 3 if i == 0 else sigmas[i - 1][:3],
                    "position_sigma": [0.0] * 3 if i == 0 else sigmas[i - 1][3:],
                }
                for i, (tag, seen) in enumerate(layout.seen.items())
            ],
            "unplaced": {str(tag): why for tag, why in layout.unplaced.items()},
            "bend": layout.bend,
            "line_time": layout.line_time.tolist(),
            "line_time_sigma": layout.line_time_sigma.tolist(),
            "advice": advice(layout),
        },
    )


def layout_report(layout: Layout, recordings: Sequence[str]) -> Report:
    """Build the report of a layout."""
    steps = tuple(f"{capital(step)}." for step in advice(layout))
    tone: Tone = "warn" if steps else "good"
    apply = "Use the section `cube: tags` that was written, in the config of recordings of this cube."
    answer = "in part" if layout.unplaced else "yes"
    unplaced = tuple(f"Tag {tag}: {why}." for tag, why in layout.unplaced.items())
    return Report(
        title=f"Layout of the tags ({', '.join(recordings)})",
        heading="Layout of the tags",
        about=", ".join(recordings),
        summary=Summary("Are all tags located?", answer, tone, f"{headline(layout)}.", (), (*steps, apply)),
        sections=(
            Section("Not placed", (Bullets(unplaced),) if unplaced else (), printed="never"),
            Section("Plots", (Plots((_picture(layout), _bars(layout))),)),
            Section("Tag by tag", (_tag_table(layout),)),
            Section("Cameras", _cameras(layout)),
        ),
    )


def _tag_table(layout: Layout) -> Table:
    """Table of the placed tags; the first one defines the body frame."""
    sigmas = np.sqrt(np.diag(layout.covariance)).reshape(-1, 6)
    degrees, mm = np.rad2deg(sigmas[:, :3].max(axis=1)), 1e3 * sigmas[:, 3:].max(axis=1)
    cells = [("0", "0"), *((f"{a:.2g}", f"{b:.2g}") for a, b in zip(degrees, mm, strict=True))]
    rows = tuple(
        (str(tag), str(s.pictures), f"{s.rms_px:.2f}", *cell, str(s.rejected), f"{s.inflation:.1f}")
        for (tag, s), cell in zip(layout.seen.items(), cells, strict=True)
    )
    caption = (
        "px: root mean square error of the corners, per axis, sharp pictures weighted more than blurred ones. Sigmas "
        "are those of the worst axis. False: pictures in which the tag does not fit the others of the same picture by "
        "far, left out. Correlation: by how much the sigmas exceed those of corners that err independently and of tags "
        f"that are flat squares: in all pictures alike corners are off by {layout.bend:.2%} of the tag's size, one "
        "sigma each way, whether the paper is curved or the print is askew."
    )
    return Table("", caption, COLUMNS, rows, "tags", most_rows=None)


def _cameras(layout: Layout) -> tuple[Block, ...]:
    """Tables of the adjusted cameras' intrinsics that the pictures determine."""
    from alidade.pipelines.vision.layout import LINE_TIME

    rows: list[tuple[str, ...]] = []
    for k, (found, given) in enumerate(zip(layout.cameras, layout.given_cameras, strict=True)):
        count = len(given.intrinsics) - 4
        names = ["fx, px", "fy, px", "cx, px", "cy, px", *(f"distortion {i + 1}" for i in range(count))]
        sigmas = np.zeros(len(names)) if layout.camera_sigma is None else layout.camera_sigma[k]
        numbers = list(zip(names, given.intrinsics, found.intrinsics, sigmas, strict=False))
        if layout.line_time_sigma[k] < _DETERMINED * LINE_TIME:
            numbers.append(("line time, us", 0.0, 1e6 * layout.line_time[k], 1e6 * layout.line_time_sigma[k]))
        rows += [
            (str(k + 1), name, to_digits_of(a, s), to_digits_of(b, s), f"{s:.2g}") for name, a, b, s in numbers if s
        ]
    columns = ("camera", Column("number", "text"), "given", "found", "sigma")
    several = layout.camera_sigma is not None and layout.with_camera is None
    note = "calibrate takes the camera's numbers from a layout of one camera; here they are several"
    table = Table("", "", columns, tuple(rows), "cameras", most_rows=None)
    return ((table,) if rows else ()) + ((Bullets((note,)),) if several else ())


_CAPTION = (
    "The body from two opposite sides, without what is hidden. Each square is a tag as it faces outward, with its "
    "bottom edge drawn thick; the darker, the larger its error in the pictures. m, in the frame of the body."
)
# Where the two viewers stand, in the frame of the body.
_VIEWERS = {"from +x +y +z": (1.0, 0.7, 0.6), "from -x -y -z": (-1.0, -0.7, -0.6)}


def _picture(layout: Layout) -> Plot:
    """Plot the tags' squares from two sides, with ids; averted tags are hidden."""
    views = [_view(layout, f"seen {words}", np.array(at)) for words, at in _VIEWERS.items()]
    return Plot("The tags", _CAPTION, views[0], (views[1],))


def _view(layout: Layout, words: str, viewer: Array) -> Figure:
    """Parallel projection of the tags; up is the body's +z where possible."""
    out = Figure("", words, 420, 0.5, square=True)
    body, towards = layout.body, viewer / np.linalg.norm(viewer)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    onto = np.stack([right, np.cross(towards, right)], axis=1)
    faces = so3.rotate(body.bRt, [0.0, 0.0, 1.0]) @ towards > 0.0
    corners, middles = body.corners[faces] @ onto, body.position[faces] @ onto
    seen = [seen for seen, shown in zip(layout.seen.items(), faces, strict=True) if shown]
    texts = [f"tag {tag}: {each.rms_px:.2f} px, {each.pictures} pictures" for tag, each in seen]
    out.patches(corners, np.array([each.rms_px for _, each in seen]), COLORS[0], texts)
    bottom = np.concatenate([corners[:, :2], np.full((len(corners), 1, 2), np.nan)], axis=1).reshape(-1, 2)
    out.line(bottom[:, 0], bottom[:, 1], color="ink", width=4.0)
    out.words(middles[:, 0], middles[:, 1], [str(tag) for tag, _ in seen])
    return out


def _bars(layout: Layout) -> Plot:
    out = Figure("px RMS", "tag", 300, x_labels=tuple(str(tag) for tag in layout.seen))
    out.bars([seen.rms_px for seen in layout.seen.values()], "", COLORS[0])
    return Plot("Reprojection", "How far the corners of each tag are from where the layout has them.", out)
