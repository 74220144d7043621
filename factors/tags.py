"""Tags on the cube's body, seen by a camera that an attitude reference carries.

Frames: b body (the cube), n level East-North-Up, B reference, C its camera (optical: x right, y down, z forward), T a
tag on the body (x right, y up, z out of the face). Source: methods page, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.model import ROT3, Block, Model, Residuals


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
