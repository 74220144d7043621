"""A gyro's rotation between two attitudes of a body, with the gyro's whole triad.

Frames: b body (the cube), n level East-North-Up. Source: methods page, section 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import starmap

import numpy as np

from factors import so3
from factors.model import ROT3, Array, Block, Model, Residuals
from factors.preintegration import GyroPath, trapezoid_excess
from factors.triad import parts


@dataclass(frozen=True)
class GyroRotationFactor(Model):
    """A gyro's rotation between two attitudes, integrated with its whole triad: nRb_j = Exp(w_ie T)^T nRb_i dR(A, c).

    Blocks: nRb_i, nRb_j (rotations), triad (12), d_i, d_j (3 each; how far the gyro's offset has wandered at both ends,
    in the unit of raw: their mean adds to c). Of a gyro that feels specific force also G by rows (9, rad/s per m/s^2)
    and the accelerometer's triad (12): raw = A w + c + d + G f, with the f of that accelerometer, its curvature left
    out. Where the temperature is known also s (3, in the unit of raw per K), and that of an accelerometer that drifts
    too (3): s warmth adds to c. Samples are mean rates centred on their stamps, integrated as factors.preintegration
    does: the arc between point rates w0 and w1 is T (w0 + w1) / 2 + T^2 (w0 x w1) / 12.

    Attributes:
        time: (n,) ends of the turns, s.
        stamps: n times (N,), s; a turn goes from its first stamp to its last.
        raw: n times (N, 3), at the stamps.
        earth_rate: (3,) w_ie in n, rad/s.
        sigma: (n,) rad per axis.
        accel: n times (N, 3), what the accelerometer says at the stamps; None: the gyro does not feel force.
        warmth: n times (N,) K, temperature at the stamps above that at which c is the offset; None: not known.
        drifts: whether the accelerometer has a slope over temperature too.
    """

    time: Array
    stamps: Sequence[Array]
    raw: Sequence[Array]
    earth_rate: Array
    sigma: Array
    accel: Sequence[Array] | None = None
    warmth: Sequence[Array] | None = None
    drifts: bool = False
    rows: int = 3

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Attitudes, triad, wandered offsets and, where there are such, G with the accelerometer's triad and slope."""
        of_force = [] if self.accel is None else [9, 12]
        slopes = [] if self.warmth is None else [3, 3] if self.drifts else [3]
        return (ROT3, ROT3, 12, 3, 3, *of_force, *slopes)

    def __call__(
        self, nRb_i: Array, nRb_j: Array, triads: Array, wandered_i: Array, wandered_j: Array, *terms: Array
    ) -> Residuals:
        """Residual Log(predicted^T nRb_j) / sigma, (n, 3)."""
        offsets = np.concatenate([triads[:, :9], triads[:, 9:] + 0.5 * (wandered_i + wandered_j)], axis=1)
        felt, slopes = ((), terms) if self.accel is None else (terms[:2], terms[2:])
        raw = self._undrifted(self.raw, slopes[:1])
        of_force = () if self.accel is None else (*felt, self._undrifted(self.accel, slopes[1:]))
        of_each = zip(self.stamps, raw, offsets, *of_force, strict=True)
        turned = list(starmap(Turn.of, of_each))
        dR = np.array([each.rotation for each in turned])
        earth = np.array([t[-1] - t[0] for t in self.stamps])[:, None] * self.earth_rate
        predicted = so3.compose(so3.exp(-earth), nRb_i, dR)
        error = so3.log(so3.multiply(so3.inverse(predicted), nRb_j))
        weight = 1.0 / self.sigma

        def jacobians() -> tuple[Array, ...]:
            left = -so3.right_jacobian_inverse(-error) * weight[:, None, None]
            right = so3.right_jacobian_inverse(error) * weight[:, None, None]
            by = [left @ np.array(each) for each in zip(*self._derivatives(turned), strict=True)]
            by_offset = by[0][..., 9:]
            ends = left @ so3.matrix(so3.inverse(dR)), right
            return *ends, by[0], 0.5 * by_offset, 0.5 * by_offset, *by[1:]

        return error * weight[:, None], jacobians

    def _undrifted(self, readings: Sequence[Array], slope: Sequence[Array]) -> Sequence[Array]:
        """Readings less what they drift by a slope (n, 3) over temperature; as they are without one."""
        if self.warmth is None or not slope:
            return readings
        return [each - np.outer(*by) for each, *by in zip(readings, self.warmth, slope[0], strict=True)]

    def _derivatives(self, turned: Sequence[Turn]) -> list[tuple[Array, ...]]:
        """Of each turn's rotation by what is shared, in the order of the blocks."""
        if self.warmth is None:
            return [turn.derivatives() for turn in turned]
        count = 2 if self.drifts else 1
        pairs = zip(turned, self.warmth, strict=True)
        return [(*turn.derivatives(), *turn.by_slopes(warmth)[:count]) for turn, warmth in pairs]


@dataclass(frozen=True)
class Turn:
    """One turn as a gyro with its triad sees it.

    Attributes:
        path: of the calibrated rates.
        rate: (N, 3) calibrated, rad/s.
        K: (3, 3), the inverse of the gyro's A.
        force: (N, 3) m/s^2; None where the gyro does not feel it.
        G: (3, 3), likewise.
        accel_K: (3, 3), the inverse of the accelerometer's A, likewise.
    """

    path: GyroPath
    rate: Array
    K: Array
    force: Array | None = None
    G: Array | None = None
    accel_K: Array | None = None

    @classmethod
    def of(
        cls,
        t: Array,
        raw: Array,
        triad: Array,
        sensitivity: Array | None = None,
        accel_triad: Array | None = None,
        accel: Array | None = None,
    ) -> Turn:
        """From samples (N, 3) at t (N,) s of gyro and, if it feels force, accelerometer, and their triads (12,)."""
        A, c = parts(triad)
        K = np.asarray(np.linalg.inv(A), dtype=float)
        if sensitivity is None or accel_triad is None or accel is None:
            rate = (raw - c) @ K.T
            return cls(GyroPath(t, rate), rate, K)
        accel_A, accel_c = parts(accel_triad)
        accel_K = np.asarray(np.linalg.inv(accel_A), dtype=float)
        force, G = (accel - accel_c) @ accel_K.T, sensitivity.reshape(3, 3)
        rate = (raw - c - force @ G.T) @ K.T
        return cls(GyroPath(t, rate, drivers=force), rate, K, force, G, accel_K)

    @property
    def rotation(self) -> Array:
        """From its first stamp to its last, (4,)."""
        return self.path.attitude(self.path.t[-1:])[0]

    def derivatives(self) -> tuple[Array, ...]:
        """Of the rotation, perturbed on the right, by the gyro's triad (3, 12) and, where there is force, by G (3, 9)
        and the accelerometer's triad (3, 12).

        dw = -K (dA w + dc + dG f + G df), df = -K_a (dA_a f + dc_a).
        """
        points = self._points
        by_offset = self._by_offset
        if self.force is None or self.G is None or self.accel_K is None:
            return (_by_numbers(by_offset, points),)
        forces = self.path.drivers(self.path.t)
        assert forces is not None
        by_accel_offset = -by_offset @ self.G @ self.accel_K
        return (
            _by_numbers(by_offset, points),
            _by_numbers(by_offset, forces)[:, :9],
            _by_numbers(by_accel_offset, forces),
        )

    def by_slopes(self, warmth: Array) -> tuple[Array, ...]:
        """Likewise by the slopes over temperature of the gyro and, where there is force, of the accelerometer, (3, 3)
        each, for a temperature (N,), K, above that at which the offsets are what they are."""
        point_warmth = warmth - trapezoid_excess(self.path.t, warmth[:, None])[:, 0]
        by_slope = np.einsum("kia,k->ia", self._by_offset, point_warmth)
        if self.G is None or self.accel_K is None:
            return (by_slope,)
        return by_slope, -by_slope @ self.G @ self.accel_K

    @cached_property
    def _points(self) -> Array:
        """The rates (N, 3) that the path takes as linear in between; at its last stamp that is the sample itself."""
        points = self.path.rate(self.path.t)
        points[-1] = self.rate[-1]
        return points

    @cached_property
    def _by_offset(self) -> Array:
        """Derivative (N, 3, 3) of the rotation by what is added to each reading."""
        return np.asarray(-_by_rate(self.path, self._points) @ self.K)


def _by_rate(path: GyroPath, points: Array) -> Array:
    """Derivative (N, 3, 3) of a path's whole rotation, perturbed on the right, by its rates at each stamp (N, 3)."""
    dt = np.diff(path.t)[:, None, None]
    w0, w1 = points[:-1], points[1:]
    arcs = 0.5 * dt[..., 0] * (w0 + w1) + dt[..., 0] ** 2 / 12.0 * so3.cross(w0, w1)
    attitude = so3.matrix(path.attitude(path.t))
    # What a change of each arc does to the end.
    carried = attitude[-1].T @ attitude[1:] @ so3.right_jacobian(arcs)
    by_rate = np.zeros((len(points), 3, 3))
    by_rate[:-1] += carried @ (0.5 * dt * np.eye(3) - dt**2 / 12.0 * so3.hat(w1))
    by_rate[1:] += carried @ (0.5 * dt * np.eye(3) + dt**2 / 12.0 * so3.hat(w0))
    return by_rate


def _by_numbers(by_offset: Array, vectors: Array) -> Array:
    """Derivative (3, 12) by a matrix (rows) that acts on vectors (N, 3) and by an offset beside it, (N, 3, 3) each."""
    by_matrix = np.einsum("kia,kb->iab", by_offset, vectors).reshape(3, 9)
    return np.concatenate([by_matrix, by_offset.sum(axis=0)], axis=1)
