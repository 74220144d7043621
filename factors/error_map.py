"""Measurements whose errors depend on where they are made: of vision on the attitude, of a tracker on gimbal angles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from alidade.factors.array import Array
from alidade.factors.model import Block, Residuals, WrappedModel


@dataclass(frozen=True)
class ErrorMapFactor(WrappedModel):
    """Measurement model plus an error linear in given functions of attitude or gimbal angles.

    The first `axes` numbers of measurement i are larger by e_i = sum_j f_ij c_j, so that its residual is that of the
    model less sqrt_information e_i; of a rotation to first order in e_i times the noise. Blocks: those of the model,
    then c, k times `axes` numbers, function by function, in the unit of the measurements.

    Attributes:
        model: of n measurements, with their `sqrt_information`, (n, m, m).
        functions: (n, k) f_ij.
        axes: how many numbers of a measurement have such errors.
    """

    functions: Array
    axes: int
    stacked: ClassVar = ("model", "functions")

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks of the model, then the map's coefficients c."""
        return (*self.model.blocks, self.functions.shape[1] * self.axes)

    def __call__(self, *blocks: Array) -> Residuals:
        """Residual (n, m) of the model minus the map's error, with Jacobians."""
        *own, c = blocks
        residuals, jacobians = self.model(*own)
        weight = self.model.sqrt_information[:, :, : self.axes]
        n, k = self.functions.shape
        error = np.einsum("nk,nka->na", self.functions, c.reshape(n, k, self.axes))

        def all_jacobians() -> tuple[Array, ...]:
            by_c = -weight[:, :, None] * self.functions[:, None, :, None]
            return (*jacobians(), by_c.reshape(n, self.rows, -1))

        return residuals - np.einsum("nma,na->nm", weight, error), all_jacobians
