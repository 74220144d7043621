"""Normal equations of a bundle, with the pictures eliminated (Schur complement): a step costs what the tags cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.vision.layout.additional import Additional
from alidade.pipelines.vision.layout.sights import Array, Bundle, Rows, Sights

_DIAGONAL = np.arange(6)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations with the pictures eliminated.

    Attributes:
        free: (p,) which of the numbers shared by pictures are adjusted: six a tag, then the additional ones.
        information: (q, q) of those that are free.
        projection: (q,) their gradient.
        across: (f, 6, q) picture's poses against them.
        inverse: (f, 6, 6) of the pictures' own blocks.
        gradient: (f, 6) of the pictures.
    """

    free: NDArray[np.bool_]
    information: Array
    projection: Array
    across: Array
    inverse: Array
    gradient: Array

    def step(self) -> tuple[Array, Array]:
        """Of the shared numbers (p,), zero where fixed, and of the pictures (f, 6)."""
        moved = -np.linalg.solve(self.information, self.projection)
        pictures = -np.einsum("fij,fj->fi", self.inverse, self.gradient + self.across @ moved)
        shared = np.zeros(len(self.free))
        shared[self.free] = moved
        return shared, pictures


def shared_rows(bundle: Bundle, sights: Sights, rows: Rows, additional: Additional) -> Array:
    """Jacobian (m, 8, p) of the errors by all that pictures share: the tags' poses, then additional parameters."""
    m, tags = len(sights), len(bundle.body.ids)
    out = np.zeros((m, 8, 6 * tags))
    columns = 6 * sights.tag[:, None] + np.arange(6)
    np.put_along_axis(out, np.broadcast_to(columns[:, None], (m, 8, 6)), rows.by_tag, axis=2)
    return np.concatenate([out, additional.rows(bundle, sights, rows)], axis=2) if additional.free.any() else out


def normal_equations(
    bundle: Bundle, sights: Sights, rows: Rows, weights: Array, fixed: int, additional: Additional, damping: float = 0.0
) -> Normal:
    """Normal equations of weighted errors; tag number `fixed` stays, Levenberg's damping is relative."""
    f = len(bundle.cRb)
    own, gradient, At = of_pictures(sights, rows, weights, f)
    information, vector, across = _of_tags(bundle, sights, rows, weights, At)
    free = np.repeat(np.arange(len(bundle.body.ids)) != fixed, 6)
    if additional.free.any():
        information, vector, across = _with_additional(
            bundle, sights, rows, weights, additional, (information, vector, across)
        )
        free = np.concatenate([free, additional.free])
    information, vector, across = information[np.ix_(free, free)], vector[free], across[..., free]
    own[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping
    diagonal = np.diag_indices_from(information)
    # A tag of which nothing is left stays where it is.
    information[diagonal] = np.where(information[diagonal] > 0.0, (1.0 + damping) * information[diagonal], 1.0)
    inverse = np.zeros_like(own)
    seen = own[:, 0, 0] > 0.0
    inverse[seen] = np.linalg.inv(own[seen])
    flat = (inverse @ across).reshape(6 * f, -1)
    information = information - across.reshape(6 * f, -1).T @ flat
    vector = vector - flat.T @ gradient.ravel()
    return Normal(free, np.asarray(information, dtype=float), vector, across, inverse, gradient)


def of_pictures(sights: Sights, rows: Rows, weights: Array, f: int) -> tuple[Array, Array, Array]:
    """Information (f, 6, 6) and gradient (f, 6) of the pictures' poses, and the weighted Jacobians' transposes."""
    At = np.swapaxes(rows.by_picture, 1, 2) * weights[:, None, None]
    own, gradient = np.zeros((f, 6, 6)), np.zeros((f, 6))
    np.add.at(own, sights.picture, At @ rows.by_picture)
    np.add.at(gradient, sights.picture, (At @ rows.miss[..., None])[..., 0])
    return own, gradient, At


def _of_tags(bundle: Bundle, sights: Sights, rows: Rows, weights: Array, At: Array) -> tuple[Array, Array, Array]:
    """The tags' information, gradient and what they share with pictures, before these are eliminated."""
    f, tags = len(bundle.cRb), len(bundle.body.ids)
    Bt = np.swapaxes(rows.by_tag, 1, 2) * weights[:, None, None]
    blocks, gradient, across = np.zeros((tags, 6, 6)), np.zeros((tags, 6)), np.zeros((f, tags, 6, 6))
    np.add.at(blocks, sights.tag, Bt @ rows.by_tag)
    np.add.at(gradient, sights.tag, (Bt @ rows.miss[..., None])[..., 0])
    np.add.at(across, (sights.picture, sights.tag), At @ rows.by_tag)
    information = np.zeros((tags, 6, tags, 6))
    information[np.arange(tags), :, np.arange(tags)] = blocks
    n = 6 * tags
    return information.reshape(n, n), gradient.ravel(), across.transpose(0, 2, 1, 3).reshape(f, 6, n)


def _with_additional(
    bundle: Bundle,
    sights: Sights,
    rows: Rows,
    weights: Array,
    additional: Additional,
    tags: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """What `_of_tags` gives, with the additional parameters and their priors after the tags'."""
    information, gradient, across = tags
    C = additional.rows(bundle, sights, rows)
    f, n = len(bundle.cRb), C.shape[2]
    weighted = C * weights[:, None, None]
    Ct = np.swapaxes(weighted, 1, 2)
    with_pictures, with_tags = np.zeros((f, n, 6)), np.zeros((len(bundle.body.ids), n, 6))
    np.add.at(with_pictures, sights.picture, Ct @ rows.by_picture)
    np.add.at(with_tags, sights.tag, Ct @ rows.by_tag)
    mixed = with_tags.transpose(1, 0, 2).reshape(n, -1)
    precision = np.where(additional.free, additional.sigma, 1.0) ** -2.0
    flat = weighted.reshape(-1, n).T
    own = flat @ C.reshape(-1, n) + np.diag(precision)
    pull = flat @ rows.miss.ravel() + precision * additional.off(bundle)
    return (
        np.block([[information, mixed.T], [mixed, own]]),
        np.concatenate([gradient, pull]),
        np.concatenate([across, with_pictures.transpose(0, 2, 1)], axis=2),
    )
