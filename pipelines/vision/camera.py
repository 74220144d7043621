"""Cameras as sensor_msgs/msg/CameraInfo describes them: pixels to directions and back, exactly.

Optical frame: x right, y down, z forward. Integer pixel coordinates are pixel centres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.topics import CAMERA_INFO

if TYPE_CHECKING:
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.series import CameraInfo
    from alidade.pipelines.settings import Config


# Number of coefficients that each distortion model may come with; missing ones are zero.
_COEFFICIENTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 4, 5, 8), "equidistant": (0, 4)}
# Other names of the same formulas, lower case: Kalibr, older ROS calibrators, RealSense, drivers.
_PLUMB_BOB = ("", "none", "pinhole", "plumb bob", "radtan", "radial-tangential", "radial_tangential")
_FISHEYE = ("fisheye", "equi", "kannala_brandt", "kannala_brandt4", "kannala_brandt8", "opencv_fisheye")
_SYNONYMS = {
    **dict.fromkeys((*_PLUMB_BOB, "brown_conrady", "brown-conrady", "opencv"), "plumb_bob"),
    "rational": "rational_polynomial",
    **dict.fromkeys(_FISHEYE, "equidistant"),
}
_RATIONAL = "; eight are those of rational_polynomial"
# What to do about another model.
_OTHER_MODEL = "rectify the pictures and record their camera_info, or calibrate the lens as one of these"
_NEWTON_STEPS = 30
_PIXEL_TOLERANCE = 1e-9


def lens_model(name: str, coefficients: Array) -> tuple[str, Array]:
    """Translate a driver's distortion model name; return it and the coefficients without padding zeros.

    Raises InputError where the model is another, or has another number of coefficients.
    """
    model, d = _SYNONYMS.get(name.strip().lower(), name.strip().lower()), np.trim_zeros(coefficients, "b")
    if model not in _COEFFICIENTS:
        raise InputError(
            f"camera_info: distortion model {name!r} is none of {', '.join(_COEFFICIENTS)}: {_OTHER_MODEL}"
        )
    lengths = _COEFFICIENTS[model]
    if d.size > lengths[-1] or not np.isfinite(d).all():
        raise InputError(
            f"camera_info: {model} takes {' or '.join(map(str, lengths))} finite coefficients, not "
            f"{coefficients.tolist()}: {_OTHER_MODEL}{_RATIONAL if model == 'plumb_bob' and d.size == 8 else ''}"
        )
    return model, d


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with lens distortion.

    Attributes:
        width, height: picture size, px.
        K: (3, 3) camera matrix, px, without skew.
        distortion_model: `plumb_bob` (k1 k2 p1 p2 k3), `rational_polynomial` (k1 k2 p1 p2 k3 k4 k5 k6) or `equidistant`
            (k1 k2 k3 k4), or another name of the same formula.
        coefficients: in ROS's order, which is OpenCV's; empty stands for no distortion.
        rectified: (3, 3) camera matrix of its rectified pictures (P of CameraInfo), px; None where unknown.

    Raises:
        InputError: sizes, K or coefficients that no camera can have.

    The models are those of OpenCV's calib3d and fisheye modules (J. Kannala, S. Brandt, 2006, for `equidistant`).
    """

    width: int
    height: int
    K: Array
    distortion_model: str = "plumb_bob"
    coefficients: Array = ()  # type: ignore[assignment]
    rectified: Array | None = None

    def __post_init__(self) -> None:
        K = np.asarray(self.K, dtype=float).reshape(3, 3)
        d = np.asarray(self.coefficients, dtype=float).ravel()
        model, d = lens_model(self.distortion_model, d)
        if self.width <= 0 or self.height <= 0 or not K.any():
            raise InputError(
                f"camera_info zero: picture {self.width}x{self.height}, K {K.ravel().tolist()}; "
                "the camera was never calibrated: record a calibrated camera_info"
            )
        plain = np.array([[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])
        if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0 or not np.array_equal(K, plain):
            skew = f"; a skew of {K[0, 1]:g} may be set to 0 where it is less than a pixel" if K[0, 1] else ""
            raise InputError(
                f"camera_info: K {K.ravel().tolist()} is not [fx 0 cx, 0 fy cy, 0 0 1] with fx, fy > 0{skew}"
            )
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion_model", model)
        object.__setattr__(self, "coefficients", np.pad(d, (0, _COEFFICIENTS[model][-1] - d.size)))

    @property
    def focal(self) -> Array:
        """Focal lengths (2,) fx, fy in px."""
        return np.array([self.K[0, 0], self.K[1, 1]])

    @property
    def centre(self) -> Array:
        """Principal point (2,) in px."""
        return np.asarray(self.K[:2, 2])

    def project(self, points: ArrayLike) -> Array:
        """Project points (..., 3) in the optical frame, any unit, to pixels (..., 2); NaN behind the camera."""
        return np.asarray(self._distorted(np.asarray(points, dtype=float))[0] * self.focal + self.centre)

    @property
    def intrinsics(self) -> Array:
        """Intrinsics (4 + n,): fx, fy, cx, cy in px, then the distortion coefficients."""
        return np.concatenate([self.focal, self.centre, self.coefficients])

    def with_intrinsics(self, intrinsics: Array) -> Camera:
        """Return the camera with other intrinsics, in the order of `intrinsics`."""
        fx, fy, cx, cy = intrinsics[:4]
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return replace(self, K=K, coefficients=intrinsics[4:])

    def project_with_jacobian(self, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) as `project`, with their Jacobian (..., 2, 3) by the points; NaN behind the camera."""
        flat, jacobian = self._distorted(points)
        return flat * self.focal + self.centre, self.focal[:, None] * jacobian()

    def _distorted(self, points: Array) -> tuple[Array, Callable[[], Array]]:
        """Distorted z = 1 coordinates (..., 2) of points, and a function that gives their Jacobian (..., 2, 3)."""
        z = points[..., 2]
        if self.distortion_model != "equidistant":
            z = np.where(z > 0, z, np.nan)[..., None]
            flat = points[..., :2] / z
            distorted, by_flat = self._distort(flat)

            def pinhole() -> Array:
                J = np.empty((*flat.shape, 3))
                J[..., :2] = by_flat / z[..., None]
                J[..., 2] = -(J[..., :2] @ flat[..., None])[..., 0]
                return J

            return distorted, pinhole
        rho = np.hypot(points[..., 0], points[..., 1])
        angle, slope = self._angle(np.arctan2(rho, z))
        # On the axis the limits are those of a pinhole.
        scale = np.where(rho > 0, angle, 1.0) / np.where(rho > 0, rho, z)

        def equidistant() -> Array:
            out, square = points[..., :2] / np.where(rho > 0, rho, 1.0)[..., None], rho**2 + z**2
            J = np.empty((*out.shape, 3))
            radial = (slope * z / square - scale)[..., None, None] * out[..., :, None] * out[..., None, :]
            J[..., :2] = scale[..., None, None] * np.eye(2) + radial
            J[..., 2] = -(slope * rho / square)[..., None] * out
            return J

        return scale[..., None] * points[..., :2], equidistant

    def by_intrinsics(self, points: Array) -> Array:
        """Jacobian (..., 2, 4 + n) of projected points (..., 3) by the `intrinsics`; NaN where there are none."""
        import cv2

        if self.distortion_model == "equidistant":  # that of OpenCV ends at 90 deg from the axis
            J = np.zeros((*points.shape[:-1], 2, len(self.intrinsics)))
            J[..., [0, 1], [0, 1]], J[..., [0, 1], [2, 3]] = self._distorted(points)[0], 1.0
            rho = np.hypot(points[..., 0], points[..., 1])
            powers = np.arctan2(rho, points[..., 2])[..., None] ** [3, 5, 7, 9]
            out = points[..., :2] / np.where(rho > 0, rho, 1.0)[..., None]
            J[..., 4:] = (self.focal * out)[..., None] * powers[..., None, :]
            return J
        flat, still = np.where(points[..., 2:] > 0, points, np.nan).reshape(-1, 1, 3), np.zeros(3)
        J = cv2.projectPoints(flat, still, still, self.K, self.coefficients)[1]
        # By the turn, the shift, f, c, k.
        return np.asarray(J[:, 6 : 6 + len(self.intrinsics)].reshape(*points.shape[:-1], 2, -1))

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit directions (..., 3) in the optical frame of pixels (..., 2).

        Exact to 1e-9 px; NaN where the distortion model has no inverse.
        """
        flat = (np.asarray(pixels, dtype=float) - self.centre) / self.focal
        if self.distortion_model == "equidistant":
            return self._undistort_angle(flat)
        ray = np.concatenate([self._undistort(flat), np.ones((*flat.shape[:-1], 1))], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def _distort(self, u: Array) -> tuple[Array, Array]:
        """Distort z = 1 coordinates (..., 2); return these and the Jacobian (..., 2, 2)."""
        k1, k2, p1, p2, k3, k4, k5, k6 = [*self.coefficients.tolist(), 0.0, 0.0, 0.0][:8]
        x, y = u[..., 0], u[..., 1]
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3)
        if k4 or k5 or k6:
            under = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
            radial = radial / under
            slope = (slope - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / under
        xy, xx, yy = 2 * x * y, 2 * x * x, 2 * y * y
        out, J = np.empty(u.shape), np.empty((*u.shape, 2))
        out[..., 0] = x * radial + p1 * xy + p2 * (r2 + xx)
        out[..., 1] = y * radial + p1 * (r2 + yy) + p2 * xy
        px, py = 2 * p1 * x + 2 * p2 * y, 2 * p2 * x + 2 * p1 * y
        J[..., 0, 0] = radial + xx * slope + py + 4 * p2 * x
        J[..., 0, 1] = J[..., 1, 0] = xy * slope + px
        J[..., 1, 1] = radial + yy * slope + py + 4 * p1 * y
        return out, J

    def _undistort(self, flat: Array) -> Array:
        """Invert `_distort` by Newton's iteration; NaN where the iteration does not converge."""
        if not self.coefficients.any():
            return flat
        u = flat.copy()
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                out, J = self._distort(u)
                miss = out - flat
                if np.nanmax(np.abs(miss) * self.focal, initial=0.0) < _PIXEL_TOLERANCE:
                    break
                det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
                u[..., 0] -= (J[..., 1, 1] * miss[..., 0] - J[..., 0, 1] * miss[..., 1]) / det
                u[..., 1] -= (J[..., 0, 0] * miss[..., 1] - J[..., 1, 0] * miss[..., 0]) / det
            else:
                out, J = self._distort(u)
            # Beyond the radius where a polynomial turns back, a point has no image or a mirrored one.
            good = (np.abs(out - flat) * self.focal < _PIXEL_TOLERANCE).all(axis=-1)
            good &= (J[..., 0, 0] + J[..., 1, 1] > 0) & (J[..., 0, 0] * J[..., 1, 1] > J[..., 0, 1] * J[..., 1, 0])
        return np.where(good[..., None], u, np.nan)

    def _angle(self, theta: Array) -> tuple[Array, Array]:
        """Return the distorted angle of the equidistant camera model and its derivative, rad."""
        k1, k2, k3, k4 = self.coefficients
        t2 = theta * theta
        distorted = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        return distorted, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))

    def _undistort_angle(self, flat: Array) -> Array:
        radius = np.hypot(flat[..., 0], flat[..., 1])
        theta = np.minimum(radius, np.pi)
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                distorted, slope = self._angle(theta)
                theta = theta - (distorted - radius) / slope
            distorted, slope = self._angle(theta)
            miss = np.abs(distorted - radius) * self.focal.max()
            theta = np.where((miss < _PIXEL_TOLERANCE) & (slope > 0) & (theta <= np.pi), theta, np.nan)
        side = np.sinc(theta / np.pi) * theta / np.where(radius > 0, radius, 1.0)
        return np.concatenate([flat * side[..., None], np.cos(theta)[..., None]], axis=-1)


def camera_of(recording: Recording, config: Config) -> Camera:
    """Read the camera of a recording. Raises InputError if its topic is missing or describes no valid camera."""
    info = recording.camera_info(config.topic(CAMERA_INFO))
    camera = Camera(info.width, info.height, info.k, info.distortion_model, info.d, _rectified(info))
    if info.distortion_model not in ("", camera.distortion_model):
        recording.remark(f"camera_info: distortion model {info.distortion_model} is read as {camera.distortion_model}")
    if len(info.d) > len(camera.coefficients):
        recording.remark(
            f"camera_info: {len(info.d)} coefficients, of which the last {len(info.d) - len(camera.coefficients)} are "
            "zero and none of the model's"
        )
    return camera


def _rectified(info: CameraInfo) -> Array | None:
    """Left three columns of the projection matrix P; None where P is not filled in."""
    P = info.p[:, :3]
    plain = np.isfinite(P).all() and P[0, 0] > 0.0 and P[1, 1] > 0.0 and P[0, 1] == 0.0
    return P if plain else None
