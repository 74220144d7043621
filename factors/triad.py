"""Factors of the cube method: an accelerometer, a gyro and a magnetometer in a body seen by a camera.

Frames: b body (the cube), n level East-North-Up, B reference, C its camera (optical: x right, y down, z forward), T a
tag on the body (x right, y up, z out of the face).

Each sensor is a *triad*, one vector of 12 numbers: the rows of A (3 x 3), then c (3), with raw = A nominal + c + noise,
`nominal` being what an ideal sensor along the axes of b would say. Calibrations are told the other way round, nominal =
K raw + b: K = A^-1, b = -A^-1 c (`calibration`). The graph predicts the noisy raw from the nominal, not the reverse.
Source: methods page, section 4, after the patent on joint calibration of an inertial measurement unit and a geomagnetic
sensor with an AprilTag hexahedron.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors import so3
from factors.model import ROT3, Array, Block, Model, Residuals
from factors.preintegration import GyroPath

_UP = np.array([0.0, 0.0, 1.0])


def triad(K: Array, b: Array) -> Array:
    """The triad (12,) with nominal = K raw + b; K (3, 3), b (3,)."""
    A = np.linalg.inv(K)
    return np.concatenate([A.ravel(), -A @ b])


def parts(triads: Array) -> tuple[Array, Array]:
    """A, shape (..., 3, 3), and c, shape (..., 3), of triads (..., 12)."""
    return triads[..., :9].reshape(*triads.shape[:-1], 3, 3), triads[..., 9:]


def calibration(triads: Array) -> tuple[Array, Array]:
    """Rows of K, then b, of triads (..., 12): shape (..., 12), and the Jacobian, shape (..., 12, 12).

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
    """What is known of K and b beforehand. Block: triad (12).

    Attributes:
        time: (n,) s.
        mean: (n, 12) rows of K, then b.
        sigma: (n, 12); inf where nothing is known.
    """

    time: Array
    mean: Array
    sigma: Array
    rows: int = 12
    blocks = (12,)

    def __call__(self, triads: Array) -> Residuals:
        """Residual (K, b - mean) / sigma, (n, 12)."""
        known, J = calibration(triads)
        return (known - self.mean) / self.sigma, lambda: (J / self.sigma[..., None],)


@dataclass(frozen=True)
class AccelFactor(Model):
    """Mean of an accelerometer at rest: raw = A bRn (0, 0, g) + c. Blocks: nRb (rotations), triad (12).

    Attributes:
        time: (n,) s.
        raw: (n, 3).
        sigma: (n,) per axis, in the unit of raw.
        gravity: g, m/s^2.
    """

    time: Array
    raw: Array
    sigma: Array
    gravity: float
    rows: int = 3
    blocks = (ROT3, 12)

    def __call__(self, nRb: Array, triads: Array) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        error, jacobians = _at_rest(self.raw, self.sigma, nRb, triads, self.gravity * _UP)
        return error, lambda: jacobians()[:2]


@dataclass(frozen=True)
class GyroStaticFactor(Model):
    """Mean of a gyro at rest on the turning earth: raw = A bRn w_ie + c + d.

    Blocks: nRb (rotations), triad (12), d (3; how far the gyro's offset has wandered, in the unit of raw).

    Attributes:
        time: (n,) s.
        raw: (n, 3).
        sigma: (n,) per axis, in the unit of raw.
        earth_rate: (3,) w_ie in n, rad/s.
    """

    time: Array
    raw: Array
    sigma: Array
    earth_rate: Array
    rows: int = 3
    blocks = (ROT3, 12, 3)

    def __call__(self, nRb: Array, triads: Array, wandered: Array) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        error, jacobians = _at_rest(self.raw - wandered, self.sigma, nRb, triads, self.earth_rate)
        return error, lambda: (*jacobians()[:2], np.eye(3) / self.sigma[:, None, None])


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
    rows: int = 3
    blocks = (ROT3, 12, 3)

    def __call__(self, nRb: Array, triads: Array, field: Array) -> Residuals:
        """Residual (predicted - raw) / sigma, (n, 3)."""
        return _at_rest(self.raw, self.sigma, nRb, triads, field)


def _at_rest(raw: Array, sigma: Array, nRb: Array, triads: Array, vector: Array) -> Residuals:
    """raw = A bRn v + c with Jacobians by nRb, the triad and v; v (3,) or (n, 3) in n."""
    A, c = parts(triads)
    nominal = so3.rotate(so3.inverse(nRb), vector)
    weight = 1.0 / sigma
    error = (np.einsum("nij,nj->ni", A, nominal) + c - raw) * weight[:, None]

    def jacobians() -> tuple[Array, ...]:
        scaled = A * weight[:, None, None]
        return scaled @ so3.hat(nominal), _by_triad(nominal, weight), scaled @ so3.matrix(so3.inverse(nRb))

    return error, jacobians


def _by_triad(nominal: Array, weight: Array) -> Array:
    """Jacobian (n, 3, 12) of weight * (A nominal + c)."""
    J = np.zeros((len(nominal), 3, 12))
    for i in range(3):
        J[:, i, 3 * i : 3 * i + 3] = nominal * weight[:, None]
        J[:, i, 9 + i] = weight
    return J


@dataclass(frozen=True)
class GyroRotationFactor(Model):
    """A gyro's rotation between two attitudes, integrated with its whole triad: nRb_j = Exp(w_ie T)^T nRb_i dR(A, c).

    Blocks: nRb_i, nRb_j (rotations), triad (12), d_i, d_j (3 each; how far the gyro's offset has wandered at both ends,
    in the unit of raw: their mean adds to c). Samples are mean rates centred on their stamps, integrated as
    factors.preintegration does: the arc between point rates w0 and w1 is T (w0 + w1) / 2 + T^2 (w0 x w1) / 12.

    Attributes:
        time: (n,) ends of the turns, s.
        stamps: n times (N,), s; a turn goes from its first stamp to its last.
        raw: n times (N, 3), at the stamps.
        earth_rate: (3,) w_ie in n, rad/s.
        sigma: (n,) rad per axis.
    """

    time: Array
    stamps: Sequence[Array]
    raw: Sequence[Array]
    earth_rate: Array
    sigma: Array
    rows: int = 3
    blocks = (ROT3, ROT3, 12, 3, 3)

    def __call__(self, nRb_i: Array, nRb_j: Array, triads: Array, wandered_i: Array, wandered_j: Array) -> Residuals:
        """Residual Log(predicted^T nRb_j) / sigma, (n, 3)."""
        A, c = parts(triads)
        offsets = c + 0.5 * (wandered_i + wandered_j)
        K = np.linalg.inv(A)
        rates = [(raw - offset) @ k.T for raw, offset, k in zip(self.raw, offsets, K, strict=True)]
        paths = [GyroPath(t, w) for t, w in zip(self.stamps, rates, strict=True)]
        dR = np.array([path.attitude(path.t[-1:])[0] for path in paths])
        turned = np.array([t[-1] - t[0] for t in self.stamps])[:, None] * self.earth_rate
        predicted = so3.compose(so3.exp(-turned), nRb_i, dR)
        error = so3.log(so3.multiply(so3.inverse(predicted), nRb_j))
        weight = 1.0 / self.sigma

        def jacobians() -> tuple[Array, ...]:
            left = -so3.right_jacobian_inverse(-error) * weight[:, None, None]
            right = so3.right_jacobian_inverse(error) * weight[:, None, None]
            by_triad = left @ np.array([_turn_by_triad(p, w, k) for p, w, k in zip(paths, rates, K, strict=True)])
            by_wandered = 0.5 * by_triad[..., 9:]
            return left @ so3.matrix(so3.inverse(dR)), right, by_triad, by_wandered, by_wandered

        return error * weight[:, None], jacobians


@dataclass(frozen=True)
class WeightedSumFactor(Model):
    """The weighted sum of several vectors is zero. Blocks: as many vectors (3) as weights.

    Attributes:
        time: (1,) s.
        weights: (k,).
        sigma: of the sum.
    """

    time: Array
    weights: Array
    sigma: float
    rows: int = 3

    @property
    def blocks(self) -> tuple[Block, ...]:
        """A vector for each weight."""
        return (3,) * len(self.weights)

    def __call__(self, *vectors: Array) -> Residuals:
        """Residual sum / sigma, (1, 3)."""
        scaled = self.weights / self.sigma
        total = sum((w * v for w, v in zip(scaled, vectors, strict=True)), start=np.zeros((1, 3)))
        return total, lambda: tuple(w * np.eye(3)[None] for w in scaled)


def _turn_by_triad(path: GyroPath, rate: Array, K: Array) -> Array:
    """Jacobian (3, 12) of a turn's rotation, perturbed on the right, by the triad; dw = -K (dA w + dc)."""
    # The rates that the path takes as linear in between; at its last stamp that is the sample itself.
    points = path.rate(path.t)
    points[-1] = rate[-1]
    dt = np.diff(path.t)[:, None, None]
    w0, w1 = points[:-1], points[1:]
    arcs = 0.5 * dt[..., 0] * (w0 + w1) + dt[..., 0] ** 2 / 12.0 * so3.cross(w0, w1)
    attitude = so3.matrix(path.attitude(path.t))
    # What a change of each arc does to the end.
    carried = attitude[-1].T @ attitude[1:] @ so3.right_jacobian(arcs)
    by_rate = np.zeros((len(points), 3, 3))
    by_rate[:-1] += carried @ (0.5 * dt * np.eye(3) - dt**2 / 12.0 * so3.hat(w1))
    by_rate[1:] += carried @ (0.5 * dt * np.eye(3) + dt**2 / 12.0 * so3.hat(w0))
    by_c = -by_rate @ K
    by_A = np.einsum("kia,kb->iab", by_c, points).reshape(3, 9)
    return np.concatenate([by_A, by_c.sum(axis=0)], axis=1)


@dataclass(frozen=True)
class TagAttitudeFactor(Model):
    """Attitude of the body by the corners of its tags: nRb = Exp(heading Up) nRB BRC cRb, cRb seen through the corners.

    A corner at q in the tag's frame stands at P = cRb (position of the tag + bRt D q) + p in the camera's frame and is
    seen at (Px, Py) / Pz. All tags seen in one pose share nRb and p, so they settle the attitude together. Blocks: nRb
    (rotations), p (3; origin of b in C, m), nRB (rotations), heading (1, rad; correction of nRB about Up), correction
    of BRC (rotations, on the right), correction D of bRt (rotations, on the right).

    Attributes:
        time: (n,) s; a measurement is one tag seen in one pose.
        measured: (n, 4, 2) z = 1 coordinates of the corners, free of lens distortion.
        sqrt_information: (n, 4, 2, 2) of each corner.
        corners: (n, 4, 3) q, m.
        bRt: (n, 4) attitude of the tag in b as the layout has it.
        position: (n, 3) of the tag in b, m.
        BRC: (4,) camera mount as given.
    """

    time: Array
    measured: Array
    sqrt_information: Array
    corners: Array
    bRt: Array
    position: Array
    BRC: Array
    rows: int = 8
    blocks = (ROT3, 3, ROT3, 1, ROT3, ROT3)

    def __call__(self, nRb: Array, p: Array, nRB: Array, heading: Array, mount: Array, tag: Array) -> Residuals:
        """Residual sqrt_information (predicted - measured), (n, 8)."""
        n = len(self.time)
        BRC = so3.multiply(self.BRC, mount)
        nRC = so3.compose(so3.exp(heading * _UP), nRB, BRC)
        cRb = so3.multiply(so3.inverse(nRC), nRb)
        bRt = so3.multiply(self.bRt, tag)
        in_body = self.position[:, None] + so3.rotate(bRt[:, None], self.corners)
        turned = so3.rotate(cRb[:, None], in_body)
        P = turned + p[:, None]
        # A corner behind the camera cannot be seen: a residual that no step may leave there.
        depth = np.where(P[..., 2:] > 0.0, P[..., 2:], np.inf)
        seen = np.where(P[..., 2:] > 0.0, P[..., :2] / depth, 1e3)
        error = np.einsum("nkij,nkj->nki", self.sqrt_information, seen - self.measured)

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
                camera @ so3.rotate(so3.inverse(nRC), _UP)[:, None, :, None],
                camera,
                -body @ so3.matrix(bRt)[:, None] @ so3.hat(self.corners),
            )
            return tuple(block.reshape(n, 8, -1) for block in blocks)

        return error.reshape(n, 8), jacobians
