"""Innovations: measurements against what is predicted of them, and the gate that they must pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.factors.chi_square import gate
from alidade.pipelines.estimation.problem import Array, ChiSquare, Factor, Residuals
from alidade.pipelines.solvers.linear_system import linear_graph_of
from alidade.pipelines.solvers.marginals import ordering_of
from alidade.pipelines.solvers.rows import Rows
from alidade.pipelines.solvers.smoother import Smoother, slices
from alidade.pipelines.solvers.system import residuals_of

# After so many rejections in a row it is the prediction that is wrong: take the measurement.
_MOST_REJECTED = 10


@dataclass(frozen=True)
class Prediction:
    """The new variables of a step as its processes predict them from the old ones.

    Attributes:
        smoother: what is known of the old ones.
        processes: factors that are no measurements.
        about: values of all variables, about which the prediction is linear.
        new: those of the new ones.
    """

    smoother: Smoother
    processes: Sequence[Factor]
    about: gtsam.Values
    new: gtsam.Values

    def of(self, keys: Sequence[int]) -> tuple[Array, Array]:
        """Where variables, old and new, are from `about` (d,), and their joint covariance (d, d)."""
        dims = self.about.dims()
        fresh = list(self.new.keys())
        involved = set(self._process.keyVector())
        held = [k for k in dict.fromkeys([*keys, *involved]) if k not in fresh]
        P, moves = self.smoother.covariance(held), self.smoother.moves(held)
        where = slices(held + fresh, dims)
        if fresh:
            order = [k for k in held if k in involved] + fresh
            A, b = self._process.jacobian(ordering_of(order))
            columns = slices(order, dims)
            inverse = np.linalg.pinv(A[:, columns[fresh[0]].start :])
            carry = np.zeros((inverse.shape[0], P.shape[0]))
            for key in order[: -len(fresh)]:
                carry[:, where[key]] = -inverse @ A[:, columns[key]]
            across = carry @ P
            P = np.block([[P, across.T], [across, across @ carry.T + inverse @ inverse.T]])
            moves = np.append(moves, carry @ moves + inverse @ b)
        pick = np.concatenate([np.arange(P.shape[0])[where[key]] for key in keys])
        return moves[pick], P[np.ix_(pick, pick)]

    @cached_property
    def _process(self) -> gtsam.GaussianFactorGraph:
        return linear_graph_of(self.processes, self.about)


@dataclass
class Innovations:
    """The innovations of a run, and which measurements were used.

    Attributes:
        families: family -> rows of time, 1 if used, and the innovation whitened by its own covariance, whose norm
            squared is the NIS.
        unusable: family -> number of measurements left out because they gave no finite numbers.
        rejected_in_a_row: until now.
        tried, refused: measurements, and those rejected, since `begin_count`.
    """

    families: dict[str, Rows] = field(default_factory=dict)
    unusable: dict[str, int] = field(default_factory=dict)
    rejected_in_a_row: int = 0
    tried: int = 0
    refused: int = 0

    def begin_count(self) -> None:
        """Count rejections from now on."""
        self.rejected_in_a_row = self.tried = self.refused = 0

    def doubtful(self, in_a_row: int, share: float) -> bool:
        """Whether so many were rejected in a row, or more than a share by more than chance, since `begin_count`."""
        chance = 2.0 * np.sqrt(share * (1.0 - share) * self.tried)
        return self.rejected_in_a_row >= in_a_row or self.refused > share * self.tried + chance

    def undecided(self, few: int, share: float) -> bool:
        """Whether there are fewer measurements than that in all, and more than a share of them is rejected."""
        if sum(map(len, self.families.values())) >= few:
            return False
        used = [used for rows in self.families.values() for used in rows.array[:, 1]]
        return used.count(0.0) > share * len(used)

    def accept(self, factor: Factor, prediction: Prediction, gated: bool) -> Factor | None:
        """What of a factor is to be used, the measurements whose innovation lies within the gate; notes all of them."""
        measurement = factor.measurement
        assert measurement is not None
        error, A = measurement.rows(prediction.about)
        n = len(measurement.model.time)
        if not (np.isfinite(error).all() and np.isfinite(A).all()):
            self.unusable[factor.family] = self.unusable.get(factor.family, 0) + n
            return None
        moves, P = prediction.of(measurement.keys)
        error, S = error + A @ moves, A @ P @ A.T + np.eye(len(error))
        parts = n if measurement.divisible else 1
        size = len(error) // parts
        single, part = error.reshape(parts, size), np.arange(parts)
        blocks = S.reshape(parts, size, parts, size)[part, :, part]
        squares = (single * np.linalg.solve(blocks, single[:, :, None])[:, :, 0]).sum(axis=1)
        used = squares < gate(size) ** 2 if gated else np.ones(parts, dtype=bool)
        self.rejected_in_a_row = 0 if used.any() else self.rejected_in_a_row + 1
        if self.rejected_in_a_row > _MOST_REJECTED:
            used[:], self.rejected_in_a_row = True, 0
        self.tried, self.refused = self.tried + parts, self.refused + int((~used).sum())
        whitened = np.zeros(len(error))
        standing = np.arange(len(error)).reshape(parts, size)
        for rows in (standing[used].ravel(), *standing[~used]):
            whitened[rows] = np.linalg.solve(np.linalg.cholesky(S[np.ix_(rows, rows)]), error[rows])
        self.note(factor, whitened.reshape(n, -1), np.repeat(used, n // parts))
        if used.all() or not used.any():
            return factor if used.all() else None
        return Factor.of(factor.family, measurement.only(used))

    def note(self, factor: Factor, whitened: Array, used: NDArray[np.bool_]) -> None:
        """Add the innovations (n, m) of a measurement."""
        assert factor.measurement is not None
        time = factor.measurement.model.time
        rows = self.families.setdefault(factor.family, Rows())
        rows.add(np.column_stack([time, used, whitened.reshape(len(time), -1)]))

    def revise(self, factors: Sequence[Factor], values: gtsam.Values) -> None:
        """Take a solution's word for which measurements are used, and its residuals where innovations had it else."""
        solved = residuals_of(factors, values)
        for family, found in solved.items():
            rows = np.column_stack([found.time, found.used, found.whitened])
            live = self.families.setdefault(family, Rows()).array
            if len(live):
                known = len(live)
                kept = (live[:, 1] > 0.0) & found.used[:known]
                rows[:known][kept] = live[kept]
            self.families[family] = Rows(rows)

    def chi_square(self) -> ChiSquare:
        """The sum of the squared innovations of the measurements used."""
        families = {}
        for family, rows in self.families.items():
            used = rows.array[rows.array[:, 1] > 0.0, 2:]
            families[family] = float((used**2).sum()), float(used.size)
        return ChiSquare(sum(v for v, _ in families.values()), sum(d for _, d in families.values()), families)

    def residuals(self) -> dict[str, Residuals]:
        """Family -> the innovations."""
        return {
            family: Residuals(rows.array[:, 0].copy(), rows.array[:, 2:].copy(), rows.array[:, 1] > 0.0)
            for family, rows in self.families.items()
        }

    def rejected(self) -> dict[str, int]:
        """Family -> number of measurements left out."""
        return {
            family: int((rows.array[:, 1] == 0.0).sum()) + self.unusable.get(family, 0)
            for family, rows in self.families.items()
        }
