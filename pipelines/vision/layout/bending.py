"""How far tags are from the flat squares that they are taken for, as the pictures tell it.

A printed tag on a cube is not flat, nor is it quite square: in all its pictures its corners err alike, which neither
their noise nor its correlation from picture to picture accounts for. What they are off by that no pose takes up has one
sigma for all tags, as a share of their size, the most likely one. It is not adjusted but counted in the sigmas of the
layout: adjusted, it takes up errors of another kind too, and halves of real recordings then agree less well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.pipelines.vision.layout.sights import Array, Bundle, Rows, Sights
from alidade.pipelines.vision.pose import SQUARE

# What paper is like, of a corner each way, and how well that is known, in the logarithm.
_PAPER, _ROUGHLY = 2e-3, 2.0
_LEVELS = np.geomspace(1e-5, 3e-2, 400)
# Information below this share of the largest is rounding.
_ROUNDING = 1e-9


def _bends() -> Array:
    """(6, 4, 3) of unit length: size, height over width, shear, keystone along x and along y, twist.

    With the six numbers of a pose these are all that four corners may be off by.
    """
    x, y = SQUARE[:, 0], SQUARE[:, 1]
    out = np.zeros((6, 4, 3))
    out[0, :, 0], out[0, :, 1] = x, y
    out[1, :, 0], out[1, :, 1] = -x, y
    out[2, :, 0], out[2, :, 1] = y, x
    out[3, :, 0] = out[4, :, 1] = out[5, :, 2] = x * y
    return np.asarray(out / np.linalg.norm(out, axis=(1, 2), keepdims=True))


BENDS = _bends()


@dataclass(frozen=True, eq=False)
class Bending:
    """What bent tags do to a layout.

    Attributes:
        level: sigma of a corner, each way, as a share of the tag's size.
        spread: (q, q) covariance that this brings to all that pictures share.
    """

    level: float
    spread: Array


def bend_rows(bundle: Bundle, sights: Sights, rows: Rows) -> Array:
    """Jacobian (m, 8, 6) of the errors by what each tag's corners are off along `BENDS`, as shares of its size."""
    m = len(sights)
    by_corner = rows.by_tag[..., 3:].reshape(m, 4, 2, 3) @ so3.matrix(bundle.body.bRt[sights.tag])[:, None]
    by_bends = np.einsum("mkij,bkj,m->mkib", by_corner, BENDS, bundle.body.size[sights.tag])
    return by_bends.reshape(m, 8, len(BENDS))


def bending(miss: Array, by_bends: Array, own: Array, white: Array) -> Bending:
    """The most likely level, and its effect.

    Errors are linear in the bends x, and x in their gradient g = J x, J the information on x with all else eliminated:
    along the axes of J a component of g has the variance l + l^2 level^2, l its information.

    Args:
        miss: (m, 8) errors of the adjusted bundle.
        by_bends: (m, 8, 6 n) with the pictures' poses eliminated.
        own: (m, 8, q) likewise, by all that is adjusted and that pictures share.
        white: (q, q) covariance of these, were errors independent.
    """
    across = np.tensordot(own, by_bends, ((0, 1), (0, 1)))
    moved = white @ across
    J = np.tensordot(by_bends, by_bends, ((0, 1), (0, 1))) - across.T @ moved
    information, axes = np.linalg.eigh(J)
    gradient = axes.T @ np.tensordot(by_bends, miss, ((0, 1), (0, 1)))
    told = information > _ROUNDING * information.max()
    variance = information[told] + (information[told] * _LEVELS[:, None]) ** 2
    unlikely = (np.log(variance) + gradient[told] ** 2 / variance).sum(axis=1)
    level = float(_LEVELS[(unlikely + (np.log(_LEVELS / _PAPER) / _ROUGHLY) ** 2).argmin()])
    return Bending(level, level**2 * np.asarray(moved @ moved.T))
