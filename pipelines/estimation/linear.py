"""Linear measurements between vector variables, whitened when they are built: sum of A_i x_i = right side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors.bridge import BoundModel
from alidade.factors.model import Block, Model, Residuals
from alidade.pipelines.estimation.problem import Array


@dataclass(frozen=True)
class LinearModel(Model):
    """n measurements of m whitened rows each, linear in one to three vectors. Blocks: the vectors.

    Attributes:
        time: (n,) s; 0 of what is known beforehand.
        right: (n, m) right side.
        first, second, third: (n, m, d) coefficients of each vector; None: there are fewer vectors.
    """

    time: Array
    right: Array
    first: Array
    second: Array | None = None
    third: Array | None = None
    stacked: ClassVar = ("time", "right", "first", "second", "third")

    @property
    def coefficients(self) -> tuple[Array, ...]:
        """Coefficients (n, m, d) of each vector."""
        return tuple(each for each in (self.first, self.second, self.third) if each is not None)

    @property
    def rows(self) -> int:
        """m."""
        return int(self.right.shape[1])

    @property
    def blocks(self) -> tuple[Block, ...]:
        """The vectors' sizes."""
        return tuple(int(each.shape[2]) for each in self.coefficients)

    def __call__(self, *vectors: Array) -> Residuals:
        """Residual sum of A_i x_i less the right side, (n, m)."""
        parts = [np.einsum("nij,nj->ni", A, x) for A, x in zip(self.coefficients, vectors, strict=True)]
        return sum(parts, start=-self.right), lambda: self.coefficients


def linear_factor(blocks: Mapping[int, Array], origin: Mapping[int, Array], sigma: float) -> BoundModel:
    """The measurement 0 = sum of blocks[key] (x[key] - origin[key]), with `sigma` in each of its m rows.

    The rows are divided by sigma here. With a noise model beside them gtsam's elimination would take any row whose
    sigma is below 1e-8, in whatever unit, for an exact constraint, which later steps then cannot handle.

    Args:
        blocks: up to three variables and their coefficients (m, d).
        origin: variable -> (d,).
        sigma: of each row, in the unit of the rows.
    """
    coefficients = [block[None] / sigma for block in blocks.values()]
    right = sum(A @ origin[key] for key, A in zip(blocks, coefficients, strict=True))
    return LinearModel(np.zeros(1), np.asarray(right), *coefficients).on(*blocks)
