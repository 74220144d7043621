"""A layout of tags as people read it: a headline, a table, and a page with the layout as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from factors import so3
from pipelines.reports.plain_json import plain_json
from pipelines.reports.plots import COLORS, figure
from pipelines.reports.templating import environment
from pipelines.reports.units import to_digits_of

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from pipelines.vision.layout import Layout

COLUMNS = ("tag", "pictures", "px", "sigma, deg", "sigma, mm", "false", "correlation")

# A tag that misses by this many times the others' median is no flat square of its size.
_MISFIT = 2.5


def headline(layout: Layout) -> str:
    """How many tags are where, how well the pictures fit, and which tag fits worst."""
    placed, of = len(layout.body.ids), len(layout.body.ids) + len(layout.unplaced)
    worst, seen = max(layout.seen.items(), key=lambda item: item[1].rms_px)
    return (
        f"{placed} of {of} tags placed from {layout.frames} pictures, corners to {layout.rms_px:.2f} px RMS; "
        f"worst is tag {worst} with {seen.rms_px:.2f} px"
    )


def advice(layout: Layout) -> list[str]:
    """What to do about tags that fit badly, and those that could not be placed; sentences."""
    usual = float(np.median([seen.rms_px for seen in layout.seen.values()]))
    bad = [tag for tag, seen in layout.seen.items() if seen.rms_px > _MISFIT * usual]
    out = [f"tag {tag} could not be placed: {why}" for tag, why in layout.unplaced.items()]
    if bad:
        names = ", ".join(map(str, bad))
        out.append(
            f"tag{'s' if len(bad) > 1 else ''} {names}: corners miss by {_MISFIT:g} times as much as others' or more; "
            "check the size in the config, and that the tag is flat"
        )
    return out


def rows(layout: Layout) -> list[tuple[str, ...]]:
    """A row of COLUMNS a placed tag."""
    sigmas = np.sqrt(np.diag(layout.covariance)).reshape(-1, 6)
    degrees, mm = np.rad2deg(sigmas[:, :3].max(axis=1)), 1e3 * sigmas[:, 3:].max(axis=1)
    cells = [("0", "0"), *((f"{a:.2g}", f"{b:.2g}") for a, b in zip(degrees, mm, strict=True))]
    return [
        (str(tag), str(s.pictures), f"{s.rms_px:.2f}", *cell, str(s.rejected), f"{s.inflation:.1f}")
        for (tag, s), cell in zip(layout.seen.items(), cells, strict=True)
    ]


def layout_json(layout: Layout) -> str:
    """What the terminal tells, in SI and pixels: every tag placed with its sigmas, and why others are not."""
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
            "advice": advice(layout),
        },
    )


def camera_rows(layout: Layout) -> list[tuple[str, ...]]:
    """Camera, name, value given, value found and sigma of each number that was adjusted."""
    if layout.camera_sigma is None:
        return []
    out: list[tuple[str, ...]] = []
    for k, (found, given) in enumerate(zip(layout.cameras, layout.given_cameras, strict=True)):
        count = len(given.intrinsics) - 4
        names = ["fx, px", "fy, px", "cx, px", "cy, px", *(f"distortion {i + 1}" for i in range(count))]
        numbers = zip(names, given.intrinsics, found.intrinsics, layout.camera_sigma[k], strict=False)
        out += [
            (str(k + 1), name, to_digits_of(a, s), to_digits_of(b, s), f"{s:.2g}") for name, a, b, s in numbers if s
        ]
    return out


def layout_html(layout: Layout, recordings: Sequence[str]) -> str:
    """The page as one HTML text that opens offline."""
    plots = [
        ("The tags", _CAPTION, _div(_picture(layout), first=True)),
        ("Reprojection", "How far the corners of each tag are from where the layout has them.", _div(_bars(layout))),
    ]
    return (
        environment("pipelines.methods.cube")
        .get_template("layout.html")
        .render(
            recordings=", ".join(recordings),
            headline=headline(layout) + ".",
            unplaced=layout.unplaced,
            plots=plots,
            columns=COLUMNS,
            rows=rows(layout),
            cameras=camera_rows(layout),
        )
    )


_CAPTION = (
    "Each square is a tag as it faces outward, with its bottom edge drawn thick; the darker, the larger its error in "
    "the pictures. m, in the frame of the body."
)


def _picture(layout: Layout) -> go.Figure:
    """Squares in space, with ids and the way they face."""
    out = figure("", height=620)
    body, corners = layout.body, layout.body.corners
    errors = np.array([seen.rms_px for seen in layout.seen.values()])
    shade = np.repeat(errors, 4)
    i = (4 * np.arange(len(errors))[:, None] + [0, 0]).ravel()
    out.add_mesh3d(
        **_xyz(corners.reshape(-1, 3)),
        i=i,
        j=i + np.tile([1, 2], len(errors)),
        k=i + np.tile([2, 3], len(errors)),
        intensity=shade,
        colorscale=[[0.0, "#dcebf5"], [1.0, COLORS[0]]],
        colorbar={"title": {"text": "px"}, "thickness": 12},
        flatshading=True,
        hoverinfo="skip",
    )
    gap = np.full((len(corners), 1, 3), np.nan)
    outline = np.concatenate([corners, corners[:, :1], gap], axis=1).reshape(-1, 3)
    bottom = np.concatenate([corners[:, :2], gap], axis=1).reshape(-1, 3)
    for line, width in ((outline, 2), (bottom, 7)):
        style = {"color": "#33414e", "width": width}
        out.add_scatter3d(**_xyz(line), mode="lines", line=style, hoverinfo="skip", showlegend=False)
    above = body.position + so3.rotate(body.bRt, [0.0, 0.0, 1.0]) * 0.15 * body.size[:, None]
    words = [f"tag {tag}: {seen.rms_px:.2f} px, {seen.pictures} pictures" for tag, seen in layout.seen.items()]
    out.add_scatter3d(
        **_xyz(above), mode="text", text=body.ids.astype(str), hovertext=words, hoverinfo="text", showlegend=False
    )
    out.update_layout(scene={"aspectmode": "data", **{f"{axis}axis": {"title": {"text": axis}} for axis in "xyz"}})
    return out


def _xyz(points: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", points.T, strict=True))


def _bars(layout: Layout) -> go.Figure:
    out = figure("px RMS", height=300, x_title="tag")
    names = [str(tag) for tag in layout.seen]
    values = [seen.rms_px for seen in layout.seen.values()]
    out.add_bar(x=names, y=values, marker={"color": COLORS[0]}, showlegend=False)
    out.update_xaxes(type="category")
    return out


def _div(plot: go.Figure, first: bool = False) -> str:
    config = {"responsive": True, "displaylogo": False}
    return str(plot.to_html(full_html=False, include_plotlyjs=first, config=config))
