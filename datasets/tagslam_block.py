"""TagSLAM's block: its tag layout estimated anew from the detections, compared with the published one.

tagslam_test (B. Pfrommer, K. Daniilidis, arXiv 1910.00679) tumbles a block with ten tags in front of a camera.

    python -m datasets.tagslam_block tagslam_block
"""

from __future__ import annotations

import argparse
import gzip
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Mask
from alidade.pipelines.errors import InputError
from alidade.pipelines.vision.camera import Camera
from alidade.pipelines.vision.layout import Layout, Shots, estimate_layout
from alidade.pipelines.vision.pose import TagBody, estimate_pose
from alidade.pipelines.vision.tags import Detections

_CORNER_PX = 0.2


@dataclass(frozen=True, eq=False)
class Block:
    """The block recording: camera, published layout, tags found in each picture."""

    camera: Camera
    published: TagBody
    pictures: list[Detections]


@dataclass(frozen=True)
class Comparison:
    """Differences of a layout from the published one after alignment, and errors on held-out pictures.

    Attributes:
        position_mm, rotation_deg: root mean square over the tags.
        held_out_px: median over the pictures of the reprojection error, px per axis; the published one's in
            `published_px`.
        pictures: how many were looked at.
    """

    position_mm: float
    rotation_deg: float
    held_out_px: float
    published_px: float
    pictures: int


def read_block(folder: Path) -> Block:
    """Read the block recording.

    Raises:
        InputError: the files are not there or have other contents.
    """
    try:
        content = json.loads((folder / "layout.json").read_text())
        with gzip.open(folder / "detections.csv.gz", "rt") as stream:
            rows = np.loadtxt(stream, delimiter=",", skiprows=1)
        given = content["cameras"]["cam0"]
        fx, fy, cx, cy = given["intrinsics"]
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        width, height = given["resolution"]
        camera = Camera(width, height, K, "plumb_bob", np.array(given["distortion"]))
        tags = sorted((int(i), tag) for i, tag in content["bodies"]["block"].items())
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: not TagSLAM's block (layout.json, detections.csv.gz): {error}") from error
    body = TagBody(
        np.array([i for i, _ in tags]),
        np.array([tag["size"] for _, tag in tags]),
        so3.exp([tag["rotation_vector"] for _, tag in tags]),
        np.array([tag["position"] for _, tag in tags], dtype=float),
    )
    pictures = [_detections(rows[rows[:, 1] == t], body) for t in np.unique(rows[:, 1])]
    return Block(camera, body, [found for found in pictures if len(found)])


def _detections(rows: Array, body: TagBody) -> Detections:
    rows = rows[np.isin(rows[:, 2], body.ids)]
    covariance = np.tile(_CORNER_PX**2 * np.eye(2), (len(rows), 4, 1, 1))
    return Detections(rows[:, 2].astype(np.int64), rows[:, 3:].reshape(-1, 4, 2), covariance)


def compare(block: Block) -> tuple[Layout, Comparison]:
    """Estimate the layout from every other picture and score it on the rest."""
    layout = estimate_layout([Shots(block.camera, block.pictures[::2])], block.published)
    errors, published = (_reprojection(block, body) for body in (layout.body, block.published))
    keep = np.isin(block.published.ids, layout.body.ids)
    position, rotation = _apart(layout.body, block.published, keep)
    return layout, Comparison(
        position_mm=1e3 * position,
        rotation_deg=float(np.rad2deg(rotation)),
        held_out_px=float(np.median(errors)),
        published_px=float(np.median(published)),
        pictures=len(errors),
    )


def _reprojection(block: Block, body: TagBody) -> list[float]:
    """Reprojection errors, px per axis, of held-out pictures with two tags or more."""
    poses = [estimate_pose(block.camera, body, found) for found in block.pictures[1::2]]
    return [pose.rms_px for pose in poses if pose is not None and len(pose.ids) > 1]


def _apart(found: TagBody, published: TagBody, keep: Mask) -> tuple[float, float]:
    """Root mean square distance (m) and angle (rad) between the tags of two layouts after alignment."""
    a, b = found.corners.reshape(-1, 3), published.corners[keep].reshape(-1, 3)
    turn = so3.align(b - b.mean(axis=0), a - a.mean(axis=0))
    moved = so3.rotate(turn, found.position - a.mean(axis=0)) + b.mean(axis=0)
    distance = np.linalg.norm(moved - published.position[keep], axis=1)
    angle = np.linalg.norm(so3.local(so3.multiply(turn, found.bRt), published.bRt[keep]), axis=1)
    return float(np.sqrt(np.mean(distance**2))), float(np.sqrt(np.mean(angle**2)))


def main() -> None:
    """Estimate the block's layout and print the comparison with the published one."""
    parser = argparse.ArgumentParser(description="Estimate the layout of TagSLAM's block from its detections.")
    parser.add_argument("folder", type=Path, help="with layout.json and detections.csv.gz")
    options = parser.parse_args()
    try:
        layout, comparison = compare(read_block(options.folder))
    except InputError as error:
        parser.error(str(error))
    sigmas = np.sqrt(np.diag(layout.covariance)).reshape(-1, 6)
    print(f"{len(layout.body.ids)} tags from {layout.frames} pictures, corners good to {layout.sigma_px:.3f} px")
    print(f"sigma (median): {np.rad2deg(np.median(sigmas[:, :3])):.3f} deg, {1e3 * np.median(sigmas[:, 3:]):.3f} mm")
    print(f"against the published layout: {comparison.position_mm:.2f} mm, {comparison.rotation_deg:.3f} deg RMS")
    print(
        f"{comparison.pictures} other pictures: {comparison.held_out_px:.3f} px (published layout "
        f"{comparison.published_px:.3f} px), median"
    )


if __name__ == "__main__":
    main()
