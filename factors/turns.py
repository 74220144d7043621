"""A gyro's rotation between two attitudes of a body, with the gyro's whole triad.

Frames: b body (the cube), n level East-North-Up. Source: methods page, section 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.model import ROT3, Block, Model, Residuals
from alidade.factors.preintegration import running_product, trapezoid_excess
from alidade.factors.triad import parts


@dataclass(frozen=True)
class GyroRotationFactor(Model):
    """Gyro rotation between two attitudes, by the whole triad: nRb_j = Exp(w_ie T)^T nRb_i dR(A, c).

    Blocks: nRb_i, nRb_j (rotations), triad (12), d_i, d_j (3 each; how far the gyro's offset has wandered at both ends,
    in the unit of raw: their mean adds to c). Of a gyro that feels specific force also G by rows (9, rad/s per m/s^2)
    and the accelerometer's triad (12): raw = A w + c + d + G f, with the f of that accelerometer, its curvature left
    out. Where the temperature is known also s (3, in the unit of raw per K), and that of an accelerometer that drifts
    too (3): s dT adds to c. Of a gyro with a dead band, last, what it subtracts from the size of its readings (1, in
    the unit of raw). Samples are mean rates centred on their stamps, integrated as alidade.factors.preintegration does:
    the arc between point rates w0 and w1 is T (w0 + w1) / 2 + T^2 (w0 x w1) / 12.

    Attributes:
        time: (n,) ends of the turns, s.
        stamps: n times (N,), s; a turn goes from its first stamp to its last.
        raw: n times (N, 3), at the stamps.
        earth_rate: (3,) w_ie in n, rad/s.
        sigma: (n,) rad per axis.
        accel: n times (N, 3), the accelerometer's readings at the stamps; None: the gyro does not feel force.
        temperature: n times (N,) dT, K above the temperature at which the offset is c; None: unknown.
        drifts: whether the accelerometer has a slope over temperature too.
        beyond: n times (N, 3), -1 or 1 where a reading is beyond the dead band, 0 within; None: there is none.
    """

    time: Array
    stamps: list[Array]
    raw: list[Array]
    earth_rate: Array
    sigma: Array
    accel: list[Array] | None = None
    temperature: list[Array] | None = None
    drifts: bool = False
    beyond: list[Array] | None = None
    shapes: ClassVar = {"sigma": ()}
    rows: int = 3
    stacked: ClassVar = ("time", "stamps", "raw", "sigma", "accel", "temperature", "beyond")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: attitudes, triad, wandering offsets, optional G and triad, slopes, dead band."""
        of_force = [] if self.accel is None else [9, 12]
        slopes = [] if self.temperature is None else [3, 3] if self.drifts else [3]
        return (ROT3, ROT3, 12, 3, 3, *of_force, *slopes, *([] if self.beyond is None else [1]))

    def __call__(
        self, nRb_i: Array, nRb_j: Array, triads: Array, wandered_i: Array, wandered_j: Array, *terms: Array
    ) -> Residuals:
        """Residual Log(predicted^T nRb_j) / sigma, (n, 3)."""
        offsets = np.concatenate([triads[:, :9], triads[:, 9:] + 0.5 * (wandered_i + wandered_j)], axis=1)
        felt, slopes = ((), terms) if self.accel is None else (terms[:2], terms[2:])
        raw, accel, temperature, beyond = self._joined
        samples = self._samples
        if beyond is not None:
            raw, slopes = raw + beyond * slopes[-1][samples.turn], slopes[:-1]
        if temperature is not None:
            raw = raw - temperature[:, None] * slopes[0][samples.turn]
        if temperature is not None and accel is not None and self.drifts:
            accel = accel - temperature[:, None] * slopes[1][samples.turn]
        turns = Turns.of(samples, raw, offsets, *felt, *(() if accel is None else (accel,)))
        dR = turns.rotation
        earth = (samples.t[samples.last] - samples.t[samples.first])[:, None] * self.earth_rate
        predicted = so3.compose(so3.exp(-earth), nRb_i, dR)
        error = so3.local(predicted, nRb_j)
        weight = 1.0 / self.sigma

        def jacobians() -> tuple[Array, ...]:
            left = -so3.right_jacobian_inverse(-error) * weight[:, None, None]
            right = so3.right_jacobian_inverse(error) * weight[:, None, None]
            by = [*turns.derivatives(), *(() if temperature is None else turns.by_slopes(temperature)[: len(slopes)])]
            by += [] if beyond is None else [turns.by_size(beyond)]
            by = [left @ each for each in by]
            by_offset = by[0][..., 9:]
            ends = left @ so3.matrix(so3.inverse(dR)), right
            return *ends, by[0], 0.5 * by_offset, 0.5 * by_offset, *by[1:]

        return error * weight[:, None], jacobians

    @cached_property
    def _samples(self) -> Samples:
        return Samples.of(self.stamps)

    @cached_property
    def _joined(self) -> tuple[Array, Array | None, Array | None, Array | None]:
        """Concatenate readings of gyro and accelerometer, temperature and dead-band sides over all turns."""
        others = (self.accel, self.temperature, self.beyond)
        accel, temperature, beyond = (None if each is None else np.concatenate(each) for each in others)
        return np.concatenate(self.raw), accel, temperature, beyond


@dataclass(frozen=True)
class Samples:
    """Stamps of the N samples of n rotations, one rotation after the other.

    Attributes:
        t: (N,) stamps, s.
        first, last: (n,) indexes of each turn's samples.
        turn: (N,) index of each sample's turn.
        step: (N - 1, 1) s to the next sample; none from one turn to another.
    """

    t: Array
    first: Index
    last: Index
    turn: Index
    step: Array

    @classmethod
    def of(cls, stamps: Sequence[Array]) -> Samples:
        """Build the samples of all turns from the stamps, s, of each turn, two at least."""
        counts = np.array([len(each) for each in stamps])
        t, ends = np.concatenate(stamps), np.cumsum(counts)
        step = np.diff(t)[:, None]
        step[ends[:-1] - 1] = 0.0
        return cls(t, ends - counts, ends - 1, np.repeat(np.arange(len(counts)), counts), step)

    def points(self, means: Array) -> Array:
        """Point values (N, d) whose linear interpolation integrates to the measured means (N, d)."""
        excess = trapezoid_excess(self.t, means)
        excess[self.first] = excess[self.last] = 0.0
        return np.asarray(means - excess)

    def turned(self, matrices: Array, vectors: Array) -> Array:
        """Multiply each sample's vector (N, 3) by its turn's matrix (n, 3, 3)."""
        return np.einsum("kij,kj->ki", matrices[self.turn], vectors)

    def products(self, matrices: Array, vectors: Array) -> Array:
        """Sum products of sample matrices (N, 3, 3) and vector components (N, d) over each turn: (n, 3, 3, d)."""
        rows = matrices.reshape(-1, 9)
        slices = map(slice, self.first.tolist(), (self.last + 1).tolist())
        return np.array([rows[some].T @ vectors[some] for some in slices]).reshape(len(self.first), 3, 3, -1)


@dataclass(frozen=True)
class Turns:
    """Rotations over n turns, integrated from a gyro with a given triad.

    Attributes:
        samples: the samples of all turns.
        rate: (N, 3) calibrated point rates, linear in between, rad/s.
        K: (n, 3, 3), the inverse of the gyro's A.
        force: (N, 3) likewise, m/s^2; None where the gyro does not feel it.
        G: (n, 3, 3), likewise.
        accel_K: (n, 3, 3), the inverse of the accelerometer's A, likewise.
    """

    samples: Samples
    rate: Array
    K: Array
    force: Array | None = None
    G: Array | None = None
    accel_K: Array | None = None

    @classmethod
    def of(
        cls,
        samples: Samples,
        raw: Array,
        triads: Array,
        sensitivity: Array | None = None,
        accel_triads: Array | None = None,
        accel: Array | None = None,
    ) -> Turns:
        """Integrate turns from gyro and optional accelerometer readings (N, 3), with G (n, 9), triads (n, 12)."""
        A, c = parts(triads)
        K, offset = np.asarray(np.linalg.inv(A), dtype=float), c[samples.turn]
        if sensitivity is None or accel_triads is None or accel is None:
            return cls(samples, samples.points(samples.turned(K, raw - offset)), K)
        accel_A, accel_c = parts(accel_triads)
        accel_K = np.asarray(np.linalg.inv(accel_A), dtype=float)
        force, G = samples.turned(accel_K, accel - accel_c[samples.turn]), sensitivity.reshape(-1, 3, 3)
        rate = samples.turned(K, raw - offset - samples.turned(G, force))
        return cls(samples, samples.points(rate), K, samples.points(force), G, accel_K)

    @property
    def rotation(self) -> Array:
        """Rotation (n, 4) of each turn, from its first stamp to its last."""
        first, last = self._attitude[self.samples.first], self._attitude[self.samples.last]
        return so3.multiply(so3.inverse(first), last)

    def derivatives(self) -> tuple[Array, ...]:
        """Derivatives of the rotations, perturbed on the right, by the gyro's triad and the terms of specific force.

        Shapes: triad (n, 3, 12); with specific force also G (n, 3, 9) and the accelerometer's triad (n, 3, 12).

        dw = -K (dA w + dc + dG f + G df), df = -K_a (dA_a f + dc_a).
        """
        by_triad = _by_numbers(self._sums(self.rate), -self.K)
        if self.force is None or self.G is None or self.accel_K is None:
            return (by_triad,)
        by_force = self._sums(self.force)
        by_accel = _by_numbers(by_force, self.K @ self.G @ self.accel_K)
        return by_triad, _by_numbers(by_force, -self.K)[..., :9], by_accel

    def by_slopes(self, temperature: Array) -> tuple[Array, ...]:
        """Right-side derivatives (n, 3, 3) of the rotations by the temperature slopes of gyro and accelerometer.

        Without specific force only the gyro's. The temperature (N,) counts from that of the offsets, K.
        """
        by_rate = self.samples.products(self._by_rate, self.samples.points(temperature[:, None]))[..., 0]
        if self.G is None or self.accel_K is None:
            return (-by_rate @ self.K,)
        return -by_rate @ self.K, by_rate @ self.K @ self.G @ self.accel_K

    def by_size(self, signs: Array) -> Array:
        """Derivative (n, 3, 1) of the rotations by the size of an addition to readings with signs (N, 3)."""
        by_rate = self.samples.products(self._by_rate, self.samples.points(signs))
        return np.einsum("naij,nij->na", by_rate, self.K)[..., None]

    @cached_property
    def _arcs(self) -> Array:
        """Rotation vectors (N - 1, 3) from each sample to the next."""
        w0, w1, step = self.rate[:-1], self.rate[1:], self.samples.step
        return np.asarray(0.5 * step * (w0 + w1) + step**2 / 12.0 * so3.cross(w0, w1))

    @cached_property
    def _attitude(self) -> Array:
        """Attitude at each sample (N, 4), continued from one turn to the next."""
        return np.concatenate([so3.identity(1), running_product(so3.exp(self._arcs))])

    @cached_property
    def _by_rate(self) -> Array:
        """Derivative (N, 3, 3) of a turn's rotation, perturbed on the right, by its rate at each sample."""
        step, attitude = self.samples.step[..., None], so3.matrix(self._attitude)
        end = np.swapaxes(attitude[self.samples.last], 1, 2)
        # What a change of each arc does to the end.
        carried = end[self.samples.turn[:-1]] @ attitude[1:] @ so3.right_jacobian(self._arcs)
        by_rate = np.zeros_like(attitude)
        by_rate[:-1] += carried @ (0.5 * step * np.eye(3) - step**2 / 12.0 * so3.hat(self.rate[1:]))
        by_rate[1:] += carried @ (0.5 * step * np.eye(3) + step**2 / 12.0 * so3.hat(self.rate[:-1]))
        return by_rate

    def _sums(self, vectors: Array) -> Array:
        """Sums (n, 3, 3, 4) over each turn of rate derivatives times vectors (N, 3), and of the derivatives alone."""
        return self.samples.products(self._by_rate, np.concatenate([vectors, np.ones((len(vectors), 1))], axis=1))


def _by_numbers(sums: Array, matrices: Array) -> Array:
    """Derivative (n, 3, 12) of rotations by a matrix D (rows) and an offset d, where dw = M (D v + d).

    Args:
        sums: (n, 3, 3, 4), derivatives by w times v, then the derivatives alone.
        matrices: (n, 3, 3) M.
    """
    by_numbers = np.einsum("niab,nac->nicb", sums, matrices)
    by_matrix = by_numbers[..., :3].reshape(len(matrices), 3, 9)
    return np.concatenate([by_matrix, by_numbers[..., 3]], axis=2)
