"""Batched rotations on numpy arrays.

A rotation is a unit quaternion, shape (..., 4) in the order w, x, y, z; `aRb` maps coordinates in frame b to
coordinates in frame a. Tangent vectors, shape (..., 3) in radians, are ordered x, y, z and act on the right:
`R * Exp(delta)`, as in gtsam.Rot3. All functions broadcast over the leading dimensions.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from alidade.factors.array import Array

if TYPE_CHECKING:
    import gtsam

Complex = NDArray[np.complex128]

# Below this angle (rad) the closed forms lose more digits to cancellation than their series truncate.
_SMALL = 1e-2
# Vectors that are opposite to this, rad, have no rotation that is clearly the shortest.
_OPPOSITE = 1e-7
# So many rows fit into a processor's cache with all that is made of them on the way.
_ROWS = 8192

_Function = TypeVar("_Function", bound=Callable[..., Array])


def _in_cache(function: _Function) -> _Function:
    """Decorate a function to evaluate large arrays (n, d) in cache-sized blocks, in half the time."""

    @wraps(function)
    def some_at_a_time(*given: ArrayLike) -> Array:
        if max(map(np.size, given)) <= 4 * _ROWS:
            return function(*given)
        arrays = [np.asarray(each, dtype=float) for each in given]
        if any(array.ndim > 2 for array in arrays):
            return function(*given)
        n, whole = max(map(len, arrays)), np.empty(0)
        for begin in range(0, n, _ROWS):
            some = slice(begin, begin + _ROWS)
            part = function(*(each[some] if each.shape[:-1] == (n,) else each for each in arrays))
            whole = whole if begin else np.empty((n, *part.shape[1:]))
            whole[some] = part
        return whole

    return cast(_Function, some_at_a_time)


def _complex(v: Array) -> Complex:
    """View consecutive pairs of numbers (..., 2 k) as complex ones (..., k), without a copy if possible."""
    return np.asarray((v if v.strides[-1] == v.itemsize else v.copy()).view(complex))


def _pair(q: Array) -> tuple[Complex, Complex]:
    """Split quaternions a + b j into complex numbers a = w + x i and b = y + z i.

    A product takes four multiplications of these in place of sixteen, since j c is c* j.
    """
    numbers = _complex(q)
    return numbers[..., 0], numbers[..., 1]


def _by_conjugate(a: Complex, b: Complex) -> Complex:
    """Product a b* of complex arrays, always by the same rounding.

    As a call: of many, numpy would write `a * b.conj()` into the conjugate, and round otherwise than of few.
    """
    return np.multiply(a, b.conj())


def _square(v: Array) -> Array:
    """Squared lengths (...) of vectors (..., 3), faster than numpy's sum over a short axis."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.asarray(x * x + y * y + z * z)


def identity(shape: int | tuple[int, ...] = ()) -> Array:
    """Identity quaternions, (*shape, 4)."""
    shape = (shape,) if isinstance(shape, int) else shape
    q = np.zeros((*shape, 4))
    q[..., 0] = 1.0
    return q


def normalize(q: ArrayLike) -> Array:
    """Scale quaternions to unit length."""
    q = np.asarray(q, dtype=float)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def inverse(q: ArrayLike) -> Array:
    """Inverse rotations, aRb -> bRa."""
    return np.asarray(q, dtype=float) * np.array([1.0, -1.0, -1.0, -1.0])


@_in_cache
def multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Product of two rotations, aRb, bRc -> aRc."""
    # (a + b j) (c + d j).
    (a, b), (c, d) = _pair(np.asarray(p, dtype=float)), _pair(np.asarray(q, dtype=float))
    first, second = a * c, a * d
    first -= _by_conjugate(b, d)
    second += _by_conjugate(b, c)
    out = np.empty((*first.shape, 2), dtype=complex)
    out[..., 0], out[..., 1] = first, second
    return out.view(float)


def compose(*rotations: ArrayLike) -> Array:
    """Product of several rotations, left to right."""
    out = np.asarray(rotations[0], dtype=float)
    for q in rotations[1:]:
        out = multiply(out, q)
    return out


@_in_cache
def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    """Rotate vectors v (..., 3) from b to a by q = aRb."""
    q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
    # v is x i + c j. Of q v q* the part by j is a^2 c + b^2 c* - 2 i a b x, the other (|a|^2 - |b|^2) x + 2 Im(a b* c).
    (a, b), x, c = _pair(q), v[..., 0], _complex(v[..., 1:])[..., 0]
    across = np.multiply(a * a, c)
    across += _by_conjugate(b * b, c)
    ab, mixed = a * b, np.multiply(_by_conjugate(a, b), c)
    out = np.empty((*across.shape, 3))
    out[..., 0] = (1.0 - 2.0 * (b.real**2 + b.imag**2)) * x + 2.0 * mixed.imag
    out[..., 1] = across.real + 2.0 * ab.imag * x
    out[..., 2] = across.imag - 2.0 * ab.real * x
    return out


@_in_cache
def cross(a: Array, b: Array) -> Array:
    """Cross product of arrays (..., 3), faster than numpy's own."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    out = np.empty((*x.shape, 3))
    out[..., 0] = x
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def hat(v: ArrayLike) -> Array:
    """Skew-symmetric matrices (..., 3, 3) of vectors: hat(v) @ u = cross(v, u)."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


@_in_cache
def exp(phi: ArrayLike) -> Array:
    """Quaternions of rotation vectors (..., 3), rad."""
    phi = np.asarray(phi, dtype=float)
    phi = phi if phi.ndim else np.full(3, phi)  # no angle about any axis, as formulas have it where nothing is known
    # The least angle only avoids 0 / 0.
    half = np.maximum(0.5 * np.sqrt(_square(phi)), 1e-150)
    out = np.empty((*phi.shape[:-1], 4))
    # One tangent takes less than a sine and a cosine.
    tangent = np.tan(0.5 * half)
    share = 1.0 / (1.0 + tangent * tangent)
    out[..., 0] = 2.0 * share - 1.0
    share *= tangent / half
    for i in range(3):
        np.multiply(share, phi[..., i], out=out[..., 1 + i])
    return out


def log(q: ArrayLike) -> Array:
    """Rotation vectors (..., 3), rad, of quaternions, with length pi at most."""
    q = np.asarray(q, dtype=float)
    w, v = q[..., 0], q[..., 1:]
    sine = np.sqrt(_square(v))
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    # angle / sine -> 2 / w at zero; the guard only avoids 0 / 0.
    factor = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return v * (np.where(w < 0.0, -1.0, 1.0) * factor)[..., None]


def local(p: ArrayLike, q: ArrayLike) -> Array:
    """Rotation vectors v (..., 3), rad, from attitudes p to q (..., 4), in the axes of p: q = p Exp(v)."""
    return log(multiply(inverse(p), q))


@_in_cache
def matrix(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions."""
    q = np.asarray(q, dtype=float)
    # As `rotate` has it, of the axes.
    a, b = _pair(q)
    aa, bb, ab, mixed = a * a, b * b, a * b, _by_conjugate(a, b)
    out = np.empty((*a.shape, 3, 3))
    out[..., 0, 0] = 1.0 - 2.0 * (b.real**2 + b.imag**2)
    out[..., 0, 1], out[..., 0, 2] = 2.0 * mixed.imag, 2.0 * mixed.real
    out[..., 1, 0], out[..., 2, 0] = 2.0 * ab.imag, -2.0 * ab.real
    out[..., 1, 1], out[..., 2, 1] = aa.real + bb.real, aa.imag + bb.imag
    out[..., 1, 2], out[..., 2, 2] = bb.imag - aa.imag, aa.real - bb.real
    return out


def from_matrix(r: ArrayLike) -> Array:
    """Quaternions, w >= 0, of rotation matrices (..., 3, 3)."""
    r = np.asarray(r, dtype=float)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    wx, wy, wz = (r[..., 2, 1] - r[..., 1, 2]), (r[..., 0, 2] - r[..., 2, 0]), (r[..., 1, 0] - r[..., 0, 1])
    xy, xz, yz = (r[..., 0, 1] + r[..., 1, 0]), (r[..., 0, 2] + r[..., 2, 0]), (r[..., 1, 2] + r[..., 2, 1])
    # Four ways to the quaternion, rows of 4 q q'. Each is scaled by a component; by the largest it loses no digits.
    rows = [
        [1.0 + xx + yy + zz, wx, wy, wz],
        [wx, 1.0 + xx - yy - zz, xy, xz],
        [wy, xy, 1.0 + yy - xx - zz, yz],
        [wz, xz, yz, 1.0 + zz - xx - yy],
    ]
    ways = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.diagonal(ways, axis1=-2, axis2=-1), axis=-1)
    q = normalize(np.take_along_axis(ways, best[..., None, None], axis=-2)[..., 0, :])
    return np.where(q[..., :1] < 0.0, -q, q)


def from_angles(angles: ArrayLike) -> Array:
    """Rotations Exp(z ez) Exp(y ey) Exp(x ex), (..., 4), of angles x, y, z (..., 3), rad."""
    about_x, about_y, about_z = (np.asarray(angles, dtype=float)[..., i, None] * np.eye(3)[i] for i in range(3))
    return compose(exp(about_z), exp(about_y), exp(about_x))


def angles(q: ArrayLike) -> Array:
    """Angles x, y, z (..., 3), rad, of rotations as `from_angles` takes them, with y within +-pi/2."""
    m = matrix(q)
    y = -np.arcsin(np.clip(m[..., 2, 0], -1.0, 1.0))
    return np.stack([np.arctan2(m[..., 2, 1], m[..., 2, 2]), y, np.arctan2(m[..., 1, 0], m[..., 0, 0])], axis=-1)


@_in_cache
def right_jacobian(phi: ArrayLike) -> Array:
    """Right Jacobian J (..., 3, 3): Exp(phi + d) = Exp(phi) * Exp(J d) to first order.

    Solà, Deray, Atchuthan, "A micro Lie theory", 2018, eq. 143, with hat(phi)^2 = phi phi' - phi'phi I.
    """
    phi = np.asarray(phi, dtype=float)
    square = _square(phi)
    a, b = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    angle = np.sqrt(square)
    small = angle < _SMALL
    if not small.all():
        safe = np.where(small, 1.0, angle)
        tangent = np.tan(0.5 * safe)
        sine = 2.0 * tangent / (1.0 + tangent * tangent)
        a = np.where(small, a, tangent * sine / safe**2)  # the numerator is 1 - cos
        b = np.where(small, b, (safe - sine) / (safe * safe**2))
    return _polynomial(phi, -a, b)


@_in_cache
def right_jacobian_inverse(phi: ArrayLike) -> Array:
    """Inverse right Jacobian J: Log(Exp(phi) * Exp(d)) = phi + J d to first order (same source, eq. 144)."""
    phi = np.asarray(phi, dtype=float)
    square = _square(phi)
    b = 1.0 / 12.0 + square / 720.0
    angle = np.sqrt(square)
    small = angle < _SMALL
    if not small.all():
        safe = np.where(small, 1.0, angle)
        b = np.where(small, b, 1.0 / safe**2 - 0.5 / (safe * np.tan(0.5 * safe)))
    return _polynomial(phi, np.full_like(b, 0.5), b)


def _polynomial(phi: Array, a: Array, b: Array) -> Array:
    """Matrices I + a hat(phi) + b hat(phi)^2, (..., 3, 3), for phi (..., 3) and a, b (...)."""
    x, y, z = phi[..., 0], phi[..., 1], phi[..., 2]
    ax, ay, az, bx, by, bz = a * x, a * y, a * z, b * x, b * y, b * z
    xx, yy, zz, xy, yz, zx = bx * x, by * y, bz * z, bx * y, by * z, bz * x
    out = np.empty((*phi.shape, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1.0 - (yy + zz), xy - az, zx + ay
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = xy + az, 1.0 - (zz + xx), yz - ax
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = zx - ay, yz + ax, 1.0 - (xx + yy)
    return out


def align(a: ArrayLike, b: ArrayLike, weights: ArrayLike = 1.0) -> Array:
    """Rotation aRb (..., 4) that minimises the sum of weights |a - aRb b|^2 over n vectors, (..., n, 3) each.

    Vectors in one plane determine it, those along one line leave the turn about that line to chance. Positions are to
    be given less their means. Kabsch, Acta Crystallographica A32 (1976) 922.

    Args:
        a, b: the same vectors in frame a and in frame b.
        weights: (..., n), not negative; or one for all.
    """
    a, b, weights = np.asarray(a, dtype=float), np.asarray(b, dtype=float), np.asarray(weights, dtype=float)
    u, _, vt = np.linalg.svd(np.swapaxes(a * weights[..., None], -1, -2) @ b)
    # The nearest orthogonal matrix may be a reflection; the least certain axis is then turned round.
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return from_matrix(u @ vt)


def shortest(a: ArrayLike, b: ArrayLike) -> Array:
    """Shortest rotations (..., 4) that rotate unit vectors a to b, (..., 3); of opposite ones one of the half turns."""
    a, b = np.broadcast_arrays(np.asarray(a, dtype=float), np.asarray(b, dtype=float))
    q = np.concatenate([1.0 + (a * b).sum(axis=-1, keepdims=True), cross(a, b)], axis=-1)
    opposite = np.linalg.norm(q, axis=-1) < _OPPOSITE
    near = np.eye(3)[np.argmin(np.abs(a[opposite]), axis=-1)]
    across = near - (near * a[opposite]).sum(axis=-1, keepdims=True) * a[opposite]
    q[opposite] = np.pad(across, ((0, 0), (1, 0)))
    return normalize(q)


def interpolate(t: ArrayLike, q: ArrayLike, at: ArrayLike) -> Array:
    """Interpolate attitudes at times `at` on constant-rate arcs between the samples (t, q), t increasing.

    Outside the samples the nearest arc is followed on.
    """
    t, q, at = np.asarray(t, dtype=float), np.asarray(q, dtype=float), np.asarray(at, dtype=float)
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    arc = local(q[i], q[i + 1])
    return multiply(q[i], exp(arc * ((at - t[i]) / (t[i + 1] - t[i]))[..., None]))


def from_gtsam(rotations: list[gtsam.Rot3]) -> Array:
    """Convert gtsam rotations to unit quaternions (n, 4), w >= 0.

    gtsam normalises neither the product of matrices nor the quaternion of one: rounding would grow from state to state.
    """
    numbers: Any = [r.toQuaternion() for r in rotations]
    q = np.array([q.coeffs() for q in numbers]).reshape(-1, 4)[:, [3, 0, 1, 2]]
    return q / np.copysign(np.linalg.norm(q, axis=1, keepdims=True), q[:, :1])


def to_gtsam(q: ArrayLike) -> gtsam.Rot3:
    """Convert one quaternion (4,) to gtsam.Rot3."""
    import gtsam

    w, x, y, z = np.asarray(q, dtype=float).tolist()
    return gtsam.Rot3(w, x, y, z)
