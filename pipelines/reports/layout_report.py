"""The layout of a cube's tags as a page and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.display.figure import COLORS, Figure, Plot
from alidade.pipelines.display.table import Column, Table
from alidade.pipelines.display.units import to_digits_of
from alidade.pipelines.files import plain_json
from alidade.pipelines.reports.report import Block, Bullets, Plots, Report, Section, Summary, Tone
from alidade.pipelines.reports.sentences import capital

if TYPE_CHECKING:
    from alidade.pipelines.vision.layout import Layout

_COLUMNS = ("tag", "pictures", "px", "sigma, deg", "sigma, mm", "false", "correlation")

# The first tag in less than this share of the pictures that show the others is what all their sigmas have in them.
_SELDOM = 0.25
# A tag that misses by this many times the others' median is no flat square of its size.
_MISFIT = 2.5
# Pictures determine a number whose sigma is below this share of its prior's.
_DETERMINED = 0.5


def _headline(layout: Layout) -> str:
    """Sentence: number of tags placed, fit of the pictures, and the tag that fits worst."""
    placed, of = len(layout.body.ids), len(layout.body.ids) + len(layout.unplaced)
    worst, seen = max(layout.seen.items(), key=lambda item: item[1].rms_px)
    return (
        f"{placed} of {of} tags placed from {layout.frames} pictures, corners to {layout.rms_px:.2f} px RMS; "
        f"worst is tag {worst} with {seen.rms_px:.2f} px"
    )


def _advice(layout: Layout) -> list[str]:
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
            "headline": _headline(layout),
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
            "advice": _advice(layout),
        },
    )


def layout_report(layout: Layout, recordings: Sequence[str]) -> Report:
    """Build the report of a layout."""
    steps = tuple(f"{capital(step)}." for step in _advice(layout))
    tone: Tone = "warn" if steps else "good"
    apply = "Use the section `cube: tags` that was written, in the config of recordings of this cube."
    answer = "in part" if layout.unplaced else "yes"
    unplaced = tuple(f"Tag {tag}: {why}." for tag, why in layout.unplaced.items())
    return Report(
        title=f"Layout of the tags ({', '.join(recordings)})",
        heading="Layout of the tags",
        about=", ".join(recordings),
        summary=Summary("Are all tags located?", answer, tone, f"{_headline(layout)}.", (), (*steps, apply)),
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
    return Table("", caption, _COLUMNS, rows, "tags", most_rows=None)


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
