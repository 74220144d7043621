"""Triads of the cube method, and factors of a static pose: accelerometer, gyro and magnetometer at rest, tags seen.

Frames: b body (the cube), n level East-North-Up, B an attitude reference, C the camera that it carries (optical: x
right, y down, z forward), T a tag on the body (x right, y up, z out of the face).

Each sensor is a *triad*, one vector of 12 numbers: the rows of A (3 x 3), then c (3), with raw = A nominal + c + noise,
`nominal` being what an ideal sensor along the axes of b would read. Calibrations state the inverse, nominal =
K raw + b: K = A^-1, b = -A^-1 c (`calibration`). The graph predicts the noisy raw from the nominal, not the reverse.
Source: methods page, section 4, after the patent on joint calibration of an inertial measurement unit and a geomagnetic
sensor with an AprilTag hexahedron.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.model import ROT3, Block, Model, Residuals

_UP = np.array([0.0, 0.0, 1.0])


def triad(K: Array, b: Array) -> Array:
    """Numbers (12,) of a triad with nominal = K raw + b, from K (3, 3) and b (3,)."""
    A = np.linalg.inv(K)
    return np.concatenate([A.ravel(), -A @ b])


def parts(triads: Array) -> tuple[Array, Array]:
    """Matrix A (..., 3, 3) and offset c (..., 3) of triads (..., 12)."""
    return triads[..., :9].reshape(*triads.shape[:-1], 3, 3), triads[..., 9:]


def calibration(triads: Array) -> tuple[Array, Array]:
    """Calibration (..., 12) of triads (..., 12): rows of K, then b; with Jacobian (..., 12, 12).

    dK = -K dA K, db = -K (dA b + dc).
    """
    A, c = parts(triads)
    K = np.linalg.inv(A)
    b = -np.einsum("...ij,...j->...i", K, c)
    J = np.zeros((*triads.shape, 12))
    by_A = -np.einsum("...ik,...lj->...ijkl", K, K)
    J[..., :9, :9] = by_A.reshape(*triads.shape[:-1], 9, 9)
    J[..., 9:, :9] = -np.einsum("...ik,...l->...ikl", K, b).reshape(*triads.shape[:-1], 3, 9)
    J[..., 9:, 9:] = -K
    return np.concatenate([K.reshape(*triads.shape[:-1], 9), b], axis=-1), J


@dataclass(frozen=True)
class TriadPriorFactor(Model):
    """Prior on K and b of a triad. Block: triad (12).

    Attributes:
        time: (n,) s.
        mean: (n, 12) rows of K, then b.
        sigma: (n, 12); inf where nothing is known.
    """

    time: Array
    mean: Array
    sigma: Array
    shapes: ClassVar = {"mean": (12,), "sigma": (12,)}
    rows: int = 12
    blocks = (12,)

    def __call__(self, triads: Array) -> Residuals:
        """Residual (K, b - mean) / sigma, (n, 12)."""
        known, J = calibration(triads)
        return (known - self.mean) / self.sigma, lambda: (J / self.sigma[..., None],)


@dataclass(frozen=True)
class FieldPriorFactor(Model):
    """Prior on a field's strength and direction. Block: field (3), T in n.

    The strength is that of the field itself, not of its component along the direction that is known: a field that is
    1e-6 T off across it would else be read as 10 nT stronger.

    Attributes:
        time: (n,) s.
        mean: (n, 3) T.
        along, across: (n,) sigmas of the strength and of each component across the mean, T.
    """

    time: Array
    mean: Array
    along: Array
    across: Array
    shapes: ClassVar = {"mean": (3,), "along": (), "across": ()}
    rows: int = 3
    blocks = (3,)

    def __call__(self, field: Array) -> Residuals:
        """Residual a (|F| - |mean|) / along + (F - a a'F) / across, a the direction of the mean, (n, 3)."""
        strength, known = (np.linalg.norm(each, axis=1, keepdims=True) for each in (field, self.mean))
        a, along, across = self.mean / known, self.along[:, None], self.across[:, None]
        residual = a * (strength - known) / along + (field - a * (a * field).sum(axis=1, keepdims=True)) / across

        def jacobians() -> tuple[Array, ...]:
            by_strength = a[:, :, None] * (field / strength / along)[:, None]
            return (by_strength + (np.eye(3) - a[:, :, None] * a[:, None]) / across[..., None],)

        return residual, jacobians


@dataclass(frozen=True)
class AccelFactor(Model):
    """Mean of an accelerometer at rest: u = A bRn (0, 0, g) + c + s dT, raw = u + square u^2 + cube u^3, axis by axis.

    Blocks: nRb (rotations), triad (12); of one that is curved its terms (3 square, s^2/m, and 3 cube, (s^2/m)^2); of
    one whose temperature is known s (3, in the unit of raw per K).

    Attributes:
        time: (n,) s.
        raw: (n, 3).
        sigma: (n,) per axis, in the unit of raw.
        gravity: g, m/s^2.
        curved: whether it has square and cube terms.
        temperature: (n,) dT, K above the temperature at which the offset is c; None: unknown.
    """

    time: Array
    raw: Array
    sigma: Array
    gravity: float
    curved: bool = False
    temperature: Array | None = None
    shapes: ClassVar = {"raw": (3,), "sigma": (), "temperature": ()}
    rows: int = 3
    stacked: ClassVar = ("time", "raw", "sigma", "temperature")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: attitude, triad, optional nonlinearity and temperature slope."""
        return (ROT3, 12, *([6] if self.curved else []), *([] if self.temperature is None else [3]))

    def __call__(self, nRb: Array, triads: Array, *terms: Array) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        drift, by_slope = _drift(self.temperature, self.sigma, terms)
        error, jacobians = _at_rest(self.raw - drift, self.sigma, nRb, triads, self.gravity * _UP)
        if not self.curved:
            return error, lambda: (*jacobians()[:2], *by_slope)
        square, cube = terms[0][:, :3], terms[0][:, 3:]
        weight = 1.0 / self.sigma[:, None]
        u = error / weight + self.raw
        nonlinear = (square * u**2 + cube * u**3) * weight

        def with_terms() -> tuple[Array, ...]:
            slope = (1.0 + 2.0 * square * u + 3.0 * cube * u**2)[..., None]
            powers = np.concatenate([(u**2 * weight)[..., None] * np.eye(3), (u**3 * weight)[..., None] * np.eye(3)], 2)
            by_attitude, by_triad, _ = jacobians()
            return slope * by_attitude, slope * by_triad, powers, *(slope * each for each in by_slope)

        return error + nonlinear, with_terms


@dataclass(frozen=True)
class GyroStaticFactor(Model):
    """Mean of a gyro at rest on the turning earth: raw = A bRn w_ie + c + d + G bRn (0, 0, g) + s dT.

    Blocks: nRb (rotations), triad (12), d (3; how far the gyro's offset has wandered, in the unit of raw) and, of one
    that feels gravity, G by rows (9, rad/s per m/s^2), of one whose temperature is known s (3, in the unit of raw per
    K).

    Attributes:
        time: (n,) s.
        raw: (n, 3).
        sigma: (n,) per axis, in the unit of raw.
        earth_rate: (3,) w_ie in n, rad/s.
        gravity: g, m/s^2, of a gyro that feels it; None: it does not.
        temperature: (n,) dT, K above the temperature at which the offset is c; None: unknown.
    """

    time: Array
    raw: Array
    sigma: Array
    earth_rate: Array
    gravity: float | None = None
    temperature: Array | None = None
    shapes: ClassVar = {"raw": (3,), "sigma": (), "temperature": ()}
    rows: int = 3
    stacked: ClassVar = ("time", "raw", "sigma", "temperature")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: attitude, triad, wandering offset, optional G and temperature slope."""
        return (ROT3, 12, 3, *([] if self.gravity is None else [9]), *([] if self.temperature is None else [3]))

    def __call__(self, nRb: Array, triads: Array, wandered: Array, *terms: Array) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        drift, by_slope = _drift(self.temperature, self.sigma, terms)
        error, jacobians = _at_rest(self.raw - wandered - drift, self.sigma, nRb, triads, self.earth_rate)
        weight = 1.0 / self.sigma
        by_wandered = np.eye(3) * weight[:, None, None]
        if self.gravity is None:
            return error, lambda: (*jacobians()[:2], by_wandered, *by_slope)
        force = so3.rotate(so3.inverse(nRb), self.gravity * _UP)
        G = terms[0].reshape(-1, 3, 3) * weight[:, None, None]

        def with_force() -> tuple[Array, ...]:
            by_attitude, by_triad, _ = jacobians()
            by_g = _by_triad(force, weight)[..., :9]
            return by_attitude + G @ so3.hat(force), by_triad, by_wandered, by_g, *by_slope

        return error + np.einsum("nij,nj->ni", G, force), with_force


@dataclass(frozen=True)
class MagFactor(Model):
    """Mean of a magnetometer at rest: raw = A bRn m + c. Blocks: nRb (rotations), triad (12), field m in n (3, T).

    Attributes:
        time: (n,) s.
        raw: (n, 3).
        sigma: (n,) per axis, in the unit of raw.
    """

    time: Array
    raw: Array
    sigma: Array
    shapes: ClassVar = {"raw": (3,), "sigma": ()}
    rows: int = 3
    blocks = (ROT3, 12, 3)
    stacked: ClassVar = ("time", "raw", "sigma")

    def __call__(self, nRb: Array, triads: Array, field: Array) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        return _at_rest(self.raw, self.sigma, nRb, triads, field)


def _drift(temperature: Array | None, sigma: Array, terms: Sequence[Array]) -> tuple[Array, tuple[Array, ...]]:
    """Temperature drift of the offset, (n or 1, 3), and its Jacobian by the slope, the model's last term."""
    if temperature is None:
        return np.zeros((1, 3)), ()
    return temperature[:, None] * terms[-1], ((temperature / sigma)[:, None, None] * np.eye(3),)


def _at_rest(raw: Array, sigma: Array, nRb: Array, triads: Array, vector: Array) -> Residuals:
    """Residuals of raw = A bRn v + c, with Jacobians by nRb, the triad and v, which is (3,) or (n, 3) in n."""
    A, c = parts(triads)
    nominal = so3.rotate(so3.inverse(nRb), vector)
    weight = 1.0 / sigma
    error = (np.einsum("nij,nj->ni", A, nominal) + c - raw) * weight[:, None]

    def jacobians() -> tuple[Array, ...]:
        scaled = A * weight[:, None, None]
        return scaled @ so3.hat(nominal), _by_triad(nominal, weight), scaled @ so3.matrix(so3.inverse(nRb))

    return error, jacobians


def _by_triad(nominal: Array, weight: Array) -> Array:
    """Jacobian (n, 3, 12) of weight * (A nominal + c) by the triad."""
    J = np.zeros((len(nominal), 3, 12))
    for i in range(3):
        J[:, i, 3 * i : 3 * i + 3] = nominal * weight[:, None]
        J[:, i, 9 + i] = weight
    return J


@dataclass(frozen=True)
class TagAttitudeFactor(Model):
    """Attitude of the body by tag corners: nRb = Exp(said) nRB BRC cRb, cRb observed through the corners.

    A corner at q in the tag's frame stands at P = cRb (position of the tag + bRt D q) + p in the camera's frame and is
    seen at (Px, Py) / Pz. All tags seen in one pose share nRb and p, so they settle the attitude together. Blocks: nRb
    (rotations), p (3; origin of b in C, m), nRB (rotations), said (3, rad about East, North and Up: correction of what
    the reference says as nRB), correction of BRC (rotations, on the right), correction D of bRt (rotations, on the
    right), correction of the tag's position (3, m, in b), and of a camera whose intrinsics may be off by how much (3:
    share of the focal length, centre in px).

    Attributes:
        time: (n,) s; a measurement is one tag seen in one pose.
        measured: (n, 4, 2) z = 1 coordinates of the corners, free of lens distortion.
        sqrt_information: (n, 4, 2, 2) of each corner.
        corners: (n, 4, 3) q, m.
        bRt: (n, 4) attitude of the tag in b as the layout has it.
        position: (n, 3) of the tag in b, m.
        BRC: (4,) camera mount as given.
        by_lens: (n, 4, 2, 3) derivatives of `measured` by the intrinsics, which enter linearly: half a per cent of
            focal length is off by 3e-5 of that; None: the intrinsics are exact.
    """

    time: Array
    measured: Array
    sqrt_information: Array
    corners: Array
    bRt: Array
    position: Array
    BRC: Array
    by_lens: Array | None = None
    shapes: ClassVar = {"measured": (4, 2), "sqrt_information": (4, 2, 2), "corners": (4, 3)}
    rows: int = 8
    stacked: ClassVar = ("time", "measured", "sqrt_information", "corners", "bRt", "position", "by_lens")
    # Tags of one pose settle its place among themselves: alone each would fit.
    divisible: ClassVar = False

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: body, position, reference, its correction, mount, tag, tag position, lens."""
        return (ROT3, 3, ROT3, 3, ROT3, ROT3, 3, *([] if self.by_lens is None else [3]))

    def __call__(
        self, nRb: Array, p: Array, nRB: Array, said: Array, mount: Array, tag: Array, moved: Array, *lens: Array
    ) -> Residuals:
        """Residual sqrt_information (predicted - measured), (n, 8)."""
        n = len(self.time)
        BRC = so3.multiply(self.BRC, mount)
        nRC = so3.compose(so3.exp(said), nRB, BRC)
        cRb = so3.multiply(so3.inverse(nRC), nRb)
        bRt = so3.multiply(self.bRt, tag)
        in_body = (self.position + moved)[:, None] + so3.rotate(bRt[:, None], self.corners)
        turned = so3.rotate(cRb[:, None], in_body)
        P = turned + p[:, None]
        # A corner behind the camera cannot be seen: a residual that no step may leave there.
        depth = np.where(P[..., 2:] > 0.0, P[..., 2:], np.inf)
        seen = np.where(P[..., 2:] > 0.0, P[..., :2] / depth, 1e3)
        measured = self.measured
        if self.by_lens is not None:
            measured = measured + np.einsum("nkij,nj->nki", self.by_lens, *lens)
        error = np.einsum("nkij,nkj->nki", self.sqrt_information, seen - measured)

        def jacobians() -> tuple[Array, ...]:
            by_point = np.zeros((n, 4, 2, 3))
            by_point[..., 0, 0] = by_point[..., 1, 1] = 1.0 / depth[..., 0]
            by_point[..., 2] = -seen / depth
            by_point = self.sqrt_information @ by_point
            body = by_point @ so3.matrix(cRb)[:, None]
            camera = by_point @ so3.hat(turned)
            blocks = (
                -body @ so3.hat(in_body),
                by_point,
                camera @ so3.matrix(so3.inverse(BRC))[:, None],
                camera @ (so3.matrix(so3.inverse(nRC)) @ so3.right_jacobian(-said))[:, None],
                camera,
                -body @ so3.matrix(bRt)[:, None] @ so3.hat(self.corners),
                body,
                *([] if self.by_lens is None else [-self.sqrt_information @ self.by_lens]),
            )
            return tuple(block.reshape(n, 8, -1) for block in blocks)

        return error.reshape(n, 8), jacobians
