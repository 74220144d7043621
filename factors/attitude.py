"""Factor of the head method: attitudes seen by a camera.

Frames: v helmet IMU, b platform, c camera fixed to the platform, h marker frame fixed to the helmet, i the platform's
frame at the session's start, held fixed ("inertial"). Source: methods page, section 3; the relative rates of
"Comprehensive measurement of head motion based on MIMU", Electronics Optics & Control 2018(4), integrated exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.gyro import Derivatives, by_platform_errors, carried, error_blocks, needed, parted, platform_errors
from alidade.factors.model import ROT3, Block, Model, Residuals
from alidade.factors.preintegration import GyroPath

# The pictures' errors, in the order of their block, and their columns there: s, s/s, share of an angle, s^2.
PICTURE_ERRORS = "time_offset", "clock_skew", "vision_scale", "vision_filter"
OFFSET_COLUMN, SKEW_COLUMN, SCALE_COLUMN, FILTER_COLUMN = range(len(PICTURE_ERRORS))
# rad, beyond which a scale of angles fades out.
FADE = np.deg2rad(150.0)


@dataclass(frozen=True)
class VisionAttitudeFactor(Model):
    """Attitudes of the helmet's marker frame in the platform's camera, at uncertain times.

    Predicted: cRh = cRb bRv(at) vRh with bRv(at) = dB(anchor, at)^T bRv(anchor) dV(anchor, at), the gyros' own samples
    carrying the attitude from the time of the variable to that of the picture. Blocks: bRv at the anchors (rotations),
    gyro bias (3), cRb, vRh (rotations), the pictures' errors (1 or 4) and, unless the gyros are perfect, the helmet
    gyro's errors (6 to 19) and those of the platform's gyro (9), see alidade.factors.gyro. The pictures' errors are
    time offset, s, positive when a picture was taken later than its stamp says; clock skew, at = stamp + time offset -
    skew * elapsed; angle scale, Log(first^T cRh) is measured 1 + scale times as large; filter, s^2, half the difference
    of the second moments of both impulse responses, vision's less the gyro's, which adds Exp(filter * acceleration) to
    bRv, the angular acceleration of the helmet on its platform as both gyros read it.

    Scale and filter act on the prediction: a measurement that is scaled shrinks its own noise. The scale fades out
    between FADE and half a turn from the first attitude, where the logarithm changes sign.

    Attributes:
        time: (n,) stamps, s.
        measured: (n, 4) cRh.
        sqrt_information: (n, 3, 3); the error is cRh * Exp(delta), delta in frame h.
        helmet: the helmet's gyro.
        platform: the platform's gyro, None for a platform at rest.
        errors: numbers of the helmet gyro's errors, 0 for a perfect gyro.
        platform_errors: whether the platform's gyro has errors too.
        anchor: (n,) times of the variables, s; None: the stamps.
        expected: (n,) about when the pictures were taken, s; None: at their stamps. The gyros' errors are evaluated
            halfway between it and the anchor.
        elapsed, first: (n,) s since the recording's first stamp, (n, 4) cRh of its first picture; with both, skew,
            angle scale and filter are variables.
        correlated: whether vision has an error u that lasts from picture to picture, the marker frame's: vRh Exp(u) in
            place of vRh. Its block (3), rad, is the last one.
    """

    time: Array
    measured: Array
    sqrt_information: Array
    helmet: GyroPath
    platform: GyroPath | None
    errors: int = 0
    platform_errors: bool = False
    anchor: Array | None = None
    expected: Array | None = None
    elapsed: Array | None = None
    first: Array | None = None
    correlated: bool = False
    shapes: ClassVar = {"measured": (4,), "sqrt_information": (3, 3)}
    rows: int = 3
    stacked: ClassVar = ("time", "measured", "sqrt_information", "anchor", "expected", "elapsed", "first")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the variables: attitudes, bias, mounts, picture errors, gyro errors."""
        picture = 1 if self.elapsed is None else len(PICTURE_ERRORS)
        errors = error_blocks(self.errors, self.platform_errors)
        return ROT3, 3, ROT3, ROT3, picture, *errors, *((3,) if self.correlated else ())

    def __call__(self, bRv: Array, bias: Array, cRb: Array, vRh: Array, picture: Array, *others: Array) -> Residuals:
        """Residual sqrt_information * Log(predicted^T measured), (n, 3)."""
        of_gyros, u = (others[:-1], others[-1]) if self.correlated else (others, None)
        errors, platform = parted(of_gyros, self.errors > 0)
        vRh = vRh if u is None else so3.multiply(vRh, so3.exp(u))
        at, by_at = self.exposed(picture)
        anchor = self.time if self.anchor is None else self.anchor
        middle = 0.5 * (anchor + (self.time if self.expected is None else self.expected))
        dV, rate, by_gyro = carried(self.helmet, anchor, middle, at, bias, errors)
        bRv = so3.multiply(bRv, dV)
        by_dB: Derivatives = tuple
        if self.platform is not None:
            base_bias, base_errors = platform_errors(self.platform, platform, len(at))
            dB, platform_rate, by_dB = carried(self.platform, anchor, middle, at, base_bias, base_errors)
            bRv = so3.multiply(so3.inverse(dB), bRv)
            rate = rate - so3.rotate(so3.inverse(bRv), platform_rate)
        filtered, acceleration, filtered_by_time, filtered_by_turn = self._filtered(at, picture, bRv, rate)
        lag = so3.exp(filtered)
        seen, by_cRh, by_scale = self._seen(so3.compose(cRb, bRv, lag, vRh), picture)
        error = so3.local(seen, self.measured)

        def jacobians() -> tuple[Array, ...]:
            # A right perturbation eta of what is seen changes the error by -Jr^-1(-error) eta.
            weight = -self.sqrt_information @ so3.right_jacobian_inverse(-error)
            by_picture = weight @ by_scale
            weight = weight @ by_cRh()
            by_lag = weight @ so3.matrix(so3.inverse(vRh))
            by_cRb = by_lag @ so3.matrix(so3.inverse(so3.multiply(bRv, lag)))
            by_filtered, unfiltered = by_lag @ so3.right_jacobian(filtered), by_lag @ so3.matrix(so3.inverse(lag))
            by_times = (unfiltered @ rate[..., None] + by_filtered @ filtered_by_time[..., None]) * by_at[:, None]
            by_filter = [by_filtered @ acceleration[..., None]] if picture.shape[1] > 1 else []
            by_bRv = unfiltered + by_filtered @ filtered_by_turn
            by_platform = by_bRv @ so3.matrix(so3.inverse(bRv))
            by_bias, *by_errors = (by_bRv @ each for each in by_gyro())
            by_u = () if u is None else (weight @ so3.right_jacobian(u),)
            # The columns of the pictures' errors stand as in PICTURE_ERRORS.
            return (
                by_bRv @ so3.matrix(so3.inverse(dV)),
                by_bias,
                by_cRb,
                weight if u is None else weight @ so3.matrix(so3.exp(-u)),
                np.concatenate([by_times, by_picture, *by_filter], axis=2),
                *by_errors,
                *(-by_platform @ each for each in by_platform_errors(by_dB, platform)),
                *by_u,
            )

        return np.einsum("nij,nj->ni", self.sqrt_information, error), jacobians

    def _filtered(self, at: Array, picture: Array, bRv: Array, rate: Array) -> tuple[Array, Array, Array, Array]:
        """Return vision's low-pass as rotation vectors (n, 3), rad, right of bRv; derivatives by filter, time, bRv.

        With w, b the rates that both gyros read and u = bRv^T b, the helmet turns on its platform at w - u, which
        changes by w' - bRv^T b' + w x u. `rate` is that at which bRv turns.
        """
        if picture.shape[1] == 1:
            nothing = np.zeros((len(at), 3))
            return nothing, nothing, nothing, np.zeros((len(at), 3, 3))
        acceleration, jerk = self.helmet.acceleration(at)
        by_turn = np.zeros((len(at), 3, 3))
        if self.platform is not None:
            w, by_w = self.helmet.rate_and_slope(at)
            read = *self.platform.rate_and_slope(at), *self.platform.acceleration(at)
            u, by_u, swing, by_swing = (so3.rotate(so3.inverse(bRv), each) for each in read)
            by_u, by_swing = by_u - np.cross(rate, u), by_swing - np.cross(rate, swing)
            by_turn = so3.hat(w) @ so3.hat(u) - so3.hat(swing)
            acceleration = acceleration - swing + np.cross(w, u)
            jerk = jerk - by_swing + np.cross(by_w, u) + np.cross(w, by_u)
        filter_ = picture[:, [FILTER_COLUMN]]
        return filter_ * acceleration, acceleration, filter_ * jerk, filter_[..., None] * by_turn

    def exposed(self, picture: Array) -> tuple[Array, Array]:
        """Exposure times (n,), s, and their derivatives by time offset and skew (n, 1 or 2)."""
        offset = picture[:, OFFSET_COLUMN]
        if picture.shape[1] == 1:
            return self.time + offset, np.ones((len(picture), 1))
        elapsed = needed(self.elapsed)
        at = self.time + offset - picture[:, SKEW_COLUMN] * elapsed
        return at, np.stack([np.ones_like(elapsed), -elapsed], axis=1)

    def _seen(self, cRh: Array, picture: Array) -> tuple[Array, Callable[[], Array], Array]:
        """Predicted attitudes, scaled as vision errs, their derivatives by cRh, and (n, 3, .) by the scale."""
        n = len(cRh)
        if picture.shape[1] == 1:
            return cRh, lambda: np.eye(3), np.empty((n, 3, 0))
        first, scale = needed(self.first), picture[:, [SCALE_COLUMN]]
        turned = so3.local(first, cRh)
        angle = np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
        share, slope = faded(angle)
        along = turned / angle
        scaled = (1.0 + scale * share) * turned

        def by_cRh() -> Array:
            across = 1.0 + scale * share
            both = along[:, :, None] * along[:, None, :]
            grown = across[..., None] * (np.eye(3) - both) + (1.0 + scale * slope)[..., None] * both
            return so3.right_jacobian(scaled) @ grown @ so3.right_jacobian_inverse(turned)

        return so3.multiply(first, so3.exp(scaled)), by_cRh, (share * turned)[..., None]


def faded(angle: Array) -> tuple[Array, Array]:
    """Weight of an angle scale, falling from 1 at FADE to 0 at half a turn, and d(weight * angle) / d angle."""
    phase = np.pi * np.clip((angle - FADE) / (np.pi - FADE), 0.0, 1.0)
    share = 0.5 * (1.0 + np.cos(phase))
    return share, share - angle * 0.5 * np.sin(phase) * np.pi / (np.pi - FADE)
