"""Pictures of flat textured things, seen by a camera with lens distortion: for simulators and tests.

Every pixel integrates the scene over its own area: the texture's integral over the pixel's footprint is taken from a
summed-area table, so edges stand where the geometry puts them to better than 0.01 px. Nothing here knows the detector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, reduce
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from alidade.factors import so3
from alidade.factors.array import Array, Mask
from alidade.pipelines.recording.series import CameraInfo
from alidade.pipelines.simulation.scenario import NotNegative, Positive, ScenarioPart
from alidade.pipelines.vision.camera import Camera

Picture = NDArray[np.uint8]

# A pixel is integrated over n by n parts of its area: (n, contrast of the texture in it, grey levels, up to which).
_PARTS = ((1, 20.0), (2, 80.0), (4, np.inf))
# Off the middle of the picture, px, as principal points are.
_OFF_CENTRE = (3.4, -2.7)
# Grey levels of a printed tag in daylight.
_BLACK, _WHITE = 20.0, 220.0
# About so many at a time, which stay in the cache with all that is made of them on the way.
_PIXELS = 8192


class PinholeCamera(ScenarioPart):
    """Settings of a camera and its pictures: pinhole, plumb_bob distortion, not quite centred."""

    width: Annotated[int, Field(gt=0)] = 640
    height: Annotated[int, Field(gt=0)] = 480
    focal_px: Positive
    distortion: list[float]  # k1 k2 p1 p2 k3
    blur_px: NotNegative = 0.7  # sigma
    grey_noise: NotNegative = 2.0  # sigma, grey levels of 255

    @property
    def camera(self) -> Camera:
        """The camera. Raises InputError where none can have that distortion."""
        x, y = 0.5 * (np.array([self.width, self.height]) - 1.0) + _OFF_CENTRE
        f = self.focal_px
        K = np.array([[f, 0.0, x], [0.0, f, y], [0.0, 0.0, 1.0]])
        return Camera(self.width, self.height, K, "plumb_bob", np.array(self.distortion))

    def info(self, t_ns: int) -> CameraInfo:
        """Description of the camera at a stamp, Unix ns."""
        camera = self.camera
        return CameraInfo.of(t_ns, (self.width, self.height), camera.distortion_model, camera.coefficients, camera.K)


@cache
def tag_bits(tag_id: int) -> Mask:
    """The official AprilTag 36h11 picture, 10x10 cells, upright, True where white.

    One cell of white margin, one of black border, 6x6 bits. OpenCV's table holds the pictures turned by 180 degrees.
    """
    import cv2

    table = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    black = cv2.aruco.generateImageMarker(table, tag_id, 8, borderBits=1)
    return np.asarray(np.pad(black[::-1, ::-1] > 0, 1, constant_values=True))


@dataclass(frozen=True, eq=False)
class Quad:
    """A flat rectangle with a texture, visible from its front.

    Attributes:
        texture: (rows, columns) grey levels, 0 to 255, upright as seen facing the front.
        size: (width, height), m.
        cRq: (4,) attitude in the camera's optical frame; the quad's x is right, y up, z out of the front.
        position: (3,) its centre in the optical frame, m.
    """

    texture: Array
    size: tuple[float, float]
    cRq: Array
    position: Array


def tag_quad(tag_id: int, size: float, cRt: ArrayLike, position: ArrayLike) -> Quad:
    """A tag 36h11 whose black square has the edge `size` (m); its white margin is one eighth of that wide."""
    texture = np.where(tag_bits(tag_id), _WHITE, _BLACK)
    return Quad(texture, (1.25 * size, 1.25 * size), np.asarray(cRt, dtype=float), np.asarray(position, dtype=float))


class Renderer:
    """Draws scenes of quads as one camera sees them (the directions of its pixels are worked out once)."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        x, y = np.meshgrid(np.arange(-1.0, camera.width + 1), np.arange(-1.0, camera.height + 1))
        rays = camera.rays(np.stack([x, y], axis=-1))
        # Central differences over two pixels: the direction is as good as linear within one.
        self._step_x = 0.5 * (rays[1:-1, 2:] - rays[1:-1, :-2])
        self._step_y = 0.5 * (rays[2:, 1:-1] - rays[:-2, 1:-1])
        self._rays = np.ascontiguousarray(rays[1:-1, 1:-1])

    def radiance(self, quads: Sequence[Quad], background: float | Array = 90.0) -> Array:
        """Light (height, width) on the sensor, in grey levels: no blur, no noise, not rounded.

        Nearer quads hide farther ones (by the distance of their centres); quads seen from behind are not drawn.
        `background` is a grey level or a picture of the camera's size. A moving scene: average several moments.
        """
        light = np.zeros((self.camera.height, self.camera.width))
        free = np.ones_like(light)
        for quad in sorted(quads, key=lambda q: float(np.linalg.norm(q.position))):
            if so3.rotate(quad.cRq, [0.0, 0.0, 1.0]) @ quad.position >= 0:
                continue
            rows, columns = self._window(quad)
            if rows.start >= rows.stop or columns.start >= columns.stop:
                continue
            share, grey = self._draw(quad, rows, columns)
            # What this quad adds lies beside what nearer ones cover already (exact for touching and for hiding quads).
            visible = np.minimum(share, free[rows, columns])
            light[rows, columns] += visible * grey
            free[rows, columns] -= visible
        return np.asarray(light + free * background)

    def _window(self, quad: Quad) -> tuple[slice, slice]:
        """Rows and columns that hold the quad's outline; the whole picture when a part of it is behind the camera."""
        s = np.linspace(-0.5, 0.5, 17)
        e = np.full_like(s, 0.5)
        edge = np.concatenate([np.stack(p, axis=1) for p in ((s, e), (s, -e), (e, s), (-e, s))]) * quad.size
        outline = self.camera.project(quad.position + so3.rotate(quad.cRq, np.pad(edge, ((0, 0), (0, 1)))))
        w, h = self.camera.width, self.camera.height
        if not np.isfinite(outline).all():
            return slice(0, h), slice(0, w)
        low, high = np.floor(outline.min(axis=0)) - 2, np.ceil(outline.max(axis=0)) + 3
        (left, top), (right, bottom) = np.clip(low, 0, (w, h)).astype(int), np.clip(high, 0, (w, h)).astype(int)
        return slice(top, bottom), slice(left, right)

    def _draw(self, quad: Quad, rows: slice, columns: slice) -> tuple[Array, Array]:
        """The share of each pixel that the quad covers, and the mean grey level of that share."""
        H = _ray_to_texel(quad)
        rays, dx, dy = self._rays[rows, columns], self._step_x[rows, columns], self._step_y[rows, columns]
        shape = rays.shape[:2]
        q, qx, qy = (H @ a.reshape(-1, 3).T for a in (rays, dx, dy))
        with np.errstate(all="ignore"):
            texel, width = _footprint(q, qx, qy)
        seen = (q[2] > 0) & np.isfinite(width).all(axis=0)
        size = np.array(quad.texture.shape[::-1], dtype=float)[:, None]
        seen &= ((texel > -width) & (texel < size + width)).all(axis=0)
        share, grey = np.zeros(len(seen)), np.zeros(len(seen))
        at = np.flatnonzero(seen)
        table = np.pad(quad.texture.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        contrast, level = _contrast(quad.texture, texel[:, at], width[:, at])
        share[at], grey[at] = 1.0, level
        least = 0.0
        for parts, most in _PARTS:
            part = at[(contrast > least) & (contrast <= most)]
            for some in np.array_split(part, len(part) // _PIXELS + 1):
                share[some], grey[some] = _integrate(quad.texture, table, q[:, some], qx[:, some], qy[:, some], parts)
            least = most
        return share.reshape(shape), grey.reshape(shape)


def _ray_to_texel(quad: Quad) -> Array:
    """(3, 3) from a direction in the optical frame to texels (column, row, 1) times the depth's inverse.

    Texel (0, 0) covers 0..1 in both; the third component is positive where the ray meets the front of the plane.
    """
    R = so3.matrix(quad.cRq)
    rows, columns = quad.texture.shape
    normal = R[:, 2]
    # Ray r meets the plane at r * (n.p)/(n.r); coordinates x = R0.(point - p).
    reach = float(normal @ quad.position)
    x, y = (reach * R[:, k] - (R[:, k] @ quad.position) * normal for k in (0, 1))
    u = x * (columns / quad.size[0]) + 0.5 * columns * normal
    v = -y * (rows / quad.size[1]) + 0.5 * rows * normal
    return np.asarray(np.stack([u, v, normal]) * np.sign(reach))


def _footprint(q: Array, qx: Array, qy: Array) -> tuple[Array, Array]:
    """Where pixels lie in the texture (2, n), and how far they reach there along its axes (2, n), texels.

    Args:
        q, qx, qy: (3, n) of rays and of their steps from pixel to pixel, as `_ray_to_texel` has them.
    """
    texel = q[:2] / q[2]
    reach_x, reach_y = (d[:2] / q[2] - texel * (d[2] / q[2]) for d in (qx, qy))
    return texel, np.sqrt(reach_x**2 + reach_y**2)


def _contrast(texture: Array, texel: Array, width: Array) -> tuple[Array, Array]:
    """The texture's contrast within each pixel, and its grey level where that is zero.

    Zero is certain: texels are larger than the footprint then. Infinite on the quad's border.
    """
    rows, columns = texture.shape
    # The footprint lies within this box even when it is turned by 45 degrees.
    reach = 0.75 * width + 1e-9
    low, high, size = texel - reach, texel + reach, np.array([[columns], [rows]])
    inside = (low >= 0).all(axis=0) & (high < size).all(axis=0)
    small = (reach < 0.5).all(axis=0)
    i0, i1 = (np.clip(p, 0, size - 1).astype(np.intp) for p in (low, high))
    grey = texture.ravel()
    corners = [grey[r * columns + c] for r in (i0[1], i1[1]) for c in (i0[0], i1[0])]
    contrast = reduce(np.maximum, corners) - reduce(np.minimum, corners)
    # Between the corners of a wide footprint there are more texels; their contrast is guessed from the corners'.
    contrast = np.where(small, contrast, np.maximum(2.0 * contrast, 1.0))
    return np.where(inside, contrast, np.inf), corners[0]


def _integrate(texture: Array, table: Array, q: Array, qx: Array, qy: Array, parts: int) -> tuple[Array, Array]:
    """Share and mean grey of pixels: the mean over parts by parts of their area; `table`: the summed texture."""
    size = np.array(texture.shape[::-1], dtype=float)[:, None]
    offsets = (np.arange(parts) + 0.5) / parts - 0.5
    share, grey = np.zeros(q.shape[1]), np.zeros(q.shape[1])
    for x in offsets:
        for y in offsets:
            texel, width = _footprint(q + x * qx + y * qy, qx, qy)
            # A box with the footprint's own spread along each axis of the texture.
            width = np.maximum(width / parts, 1e-9)
            low, high = (np.clip(texel + end * width, 0, size) for end in (-0.5, 0.5))
            total = _box_sum(table, low, high)
            area = 1.0 / (width[0] * width[1])
            share += (high[0] - low[0]) * (high[1] - low[1]) * area
            grey += total * area
    return share / parts**2, grey / np.maximum(share, 1e-12)


def _box_sum(table: Array, low: Array, high: Array) -> Array:
    """Integral of the texture over boxes, exact: the summed-area table is bilinear within each texel."""
    columns, last = table.shape[1], np.array(table.shape[::-1]) - 2
    flat = table.ravel()

    def at(x: Array, y: Array) -> Array:
        column, row = np.minimum(x.astype(np.intp), last[0]), np.minimum(y.astype(np.intp), last[1])
        right, down = x - column, y - row
        i = row * columns + column
        upper = flat[i] * (1 - right) + flat[i + 1] * right
        i += columns
        return np.asarray(upper * (1 - down) + (flat[i] * (1 - right) + flat[i + 1] * right) * down)

    (x0, y0), (x1, y1) = low, high
    return at(x1, y1) - at(x0, y1) - at(x1, y0) + at(x0, y0)


def expose(light: Array, blur_px: float = 0.0, noise: float = 0.0, rng: np.random.Generator | None = None) -> Picture:
    """The picture that a sensor makes of light: Gaussian blur of the optics (sigma, px), noise (sigma, grey levels)."""
    import cv2

    if blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), blur_px, borderType=cv2.BORDER_REPLICATE)
    if noise > 0:
        light = light + (rng or np.random.default_rng()).normal(scale=noise, size=light.shape)
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)


def encode(picture: Picture, kind: str = "png", quality: int = 90) -> bytes:
    """The picture as a PNG or JPEG file (`kind` "png" or "jpeg"; quality counts for JPEG)."""
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, 1] if kind == "png" else [cv2.IMWRITE_JPEG_QUALITY, quality]
    return bytes(cv2.imencode(f".{kind}", picture, options)[1])
