"""The innovation gate: measurements against their prediction, and which of them the smoother takes.

With the joint covariance P of the variables of a measurement, its whitened error e and Jacobian A, the innovation has
the covariance S = A P A' + I. Its normalised square (NIS) e' S^-1 e is chi-square distributed if the measurement is
good; beyond the gate, which one good measurement in 10,000 exceeds, it is rejected (Bar-Shalom, Li, Kirubarajan,
"Estimation with applications to tracking and navigation", 2001, section 5.4).

Each family of measurements has its own binomial test: whether it is certain that most of it is good.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.factors.chi_square import gate
from alidade.pipelines.estimation.problem import ChiSquare, Factor, Residuals
from alidade.pipelines.solvers.error_budget import autocorrelation
from alidade.pipelines.solvers.smoother import Smoother, linear_graph_of, ordering_of, slices

# Steps in a row that are rejected whole before one is taken nevertheless: by then it is the prediction that is wrong.
MAX_REJECTED_IN_A_ROW = 10
# Significance of the binomial test.
FALSE_ALARM = 1e-3
# Outliers are a minority of every family of measurements.
MAX_OUTLIER_SHARE = 0.5


class RowBuffer:
    """Growing array of rows of one width, whose capacity doubles when full.

    A list of small arrays would take ten times the memory over hours.
    """

    def __init__(self, array: Array | None = None) -> None:
        self._array = np.empty((0, 0)) if array is None else array.copy()
        self._count = len(self._array)

    def __len__(self) -> int:
        return self._count

    @property
    def array(self) -> Array:
        """The rows (n, width) as a view, valid until the next row is added."""
        return self._array[: self._count]

    def add(self, rows: Array) -> None:
        """Append rows (n, width)."""
        if not len(rows):
            return
        needed = self._count + len(rows)
        if needed > len(self._array):
            grown = np.empty((max(needed, 2 * len(self._array)), rows.shape[1]))
            if self._count:
                grown[: self._count] = self.array
            self._array = grown
        self._array[self._count : needed] = rows
        self._count = needed

    def clear(self) -> None:
        """Remove all rows."""
        self._count = 0


def binomial_tail(rejected: int, count: int, share: float) -> float:
    """Probability that at least `rejected` of `count` measurements are rejected, each with probability `share`."""
    from scipy.special import bdtrc

    return 1.0 if rejected <= 0 else float(bdtrc(rejected - 1, count, share))


@dataclass(frozen=True)
class Prediction:
    """Predicted distribution of a step's new variables, by its processes from the old ones.

    Attributes:
        smoother: holds the old variables.
        processes: factors of the step that are no measurements.
        about: values of all variables, about which the prediction is linear.
        new: values of the new variables.
    """

    smoother: Smoother
    processes: Sequence[Factor]
    about: gtsam.Values
    new: gtsam.Values

    def of(self, keys: Sequence[int]) -> tuple[Array, Array]:
        """Mean (d,) of the moves of variables, old and new, from `about`, and their joint covariance (d, d)."""
        dims = self.about.dims()
        fresh = list(self.new.keys())
        involved = set(self._process.keyVector())
        known_keys = [k for k in dict.fromkeys([*keys, *involved]) if k not in fresh]
        P, moves = self.smoother.covariance(known_keys), self.smoother.moves(known_keys)
        where = slices(known_keys + fresh, dims)
        if fresh:
            order = [k for k in known_keys if k in involved] + fresh
            A, b = self._process.jacobian(ordering_of(order))
            columns = slices(order, dims)
            inverse = np.linalg.pinv(A[:, columns[fresh[0]].start :])
            response = np.zeros((inverse.shape[0], P.shape[0]))
            for key in order[: -len(fresh)]:
                response[:, where[key]] = -inverse @ A[:, columns[key]]
            across = response @ P
            P = np.block([[P, across.T], [across, across @ response.T + inverse @ inverse.T]])
            moves = np.append(moves, response @ moves + inverse @ b)
        pick = np.concatenate([np.arange(P.shape[0])[where[key]] for key in keys])
        return moves[pick], P[np.ix_(pick, pick)]

    @cached_property
    def _process(self) -> gtsam.GaussianFactorGraph:
        return linear_graph_of(self.processes, self.about)


@dataclass
class InnovationGate:
    """Innovations of a run by family, with the inlier mask of the measurements.

    Attributes:
        families: family -> rows of time, 1 if used, and the innovation whitened by its own covariance, whose norm
            squared is the NIS.
        unusable: family -> number of measurements left out because they gave no finite numbers.
        rejected_in_a_row: number of steps until now.
    """

    families: dict[str, RowBuffer] = field(default_factory=dict)
    unusable: dict[str, int] = field(default_factory=dict)
    rejected_in_a_row: int = 0

    def too_few_to_decide(self) -> bool:
        """Whether a family has rejections, but too few measurements to exclude a majority of outliers.

        The wrong ones cannot be identified then: they may agree by chance.
        """
        return any(
            rejected > 0 and 1.0 - binomial_tail(rejected + 1, count, MAX_OUTLIER_SHARE) > FALSE_ALARM
            for count, rejected in self._counts().values()
        )

    def select(self, factor: Factor, prediction: Prediction, gated: bool) -> Factor | None:
        """Select the measurements of a factor whose innovation lies within the gate, and record all innovations.

        Args:
            factor: with a measurement.
            prediction: of its variables.
            gated: whether innovations outside the gate are rejected.

        Returns:
            The factor on the measurements used; None: none is.
        """
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
        rows = np.arange(len(error)).reshape(parts, -1)
        used = self._within_gate(error[rows], S[rows[:, :, None], rows[:, None, :]], gated)
        whitened = np.zeros(len(error))
        for block in (rows[used].ravel(), *rows[~used]):
            whitened[block] = np.linalg.solve(np.linalg.cholesky(S[np.ix_(block, block)]), error[block])
        self.record(factor, whitened.reshape(n, -1), np.repeat(used, n // parts))
        if used.all() or not used.any():
            return factor if used.all() else None
        return Factor.of(factor.family, measurement.only(used))

    def _within_gate(self, error: Array, S: Array, gated: bool) -> NDArray[np.bool_]:
        """Inlier mask (p,) of innovations (p, m) with covariances (p, m, m)."""
        squares = (error * np.linalg.solve(S, error[:, :, None])[:, :, 0]).sum(axis=1)
        used = squares < gate(error.shape[1]) ** 2 if gated else np.ones(len(error), dtype=bool)
        self.rejected_in_a_row = 0 if used.any() else self.rejected_in_a_row + 1
        if self.rejected_in_a_row > MAX_REJECTED_IN_A_ROW:
            used[:], self.rejected_in_a_row = True, 0
        return np.asarray(used)

    def record(self, factor: Factor, whitened: Array, used: NDArray[np.bool_]) -> None:
        """Append the innovations (n, m) of a measurement to its family."""
        assert factor.measurement is not None
        time = factor.measurement.model.time
        rows = self.families.setdefault(factor.family, RowBuffer())
        rows.add(np.column_stack([time, used, whitened.reshape(len(time), -1)]))

    def adopt(self, residuals: Mapping[str, Residuals]) -> None:
        """Replace the innovations and inlier masks by the residuals and inliers of a solution."""
        self.families = {
            family: RowBuffer(np.column_stack([found.time, found.used, found.whitened]))
            for family, found in residuals.items()
        }

    def chi_square(self) -> ChiSquare:
        """Sum of squared innovations over the inliers."""
        families = {}
        for family, rows in self.families.items():
            used = rows.array[rows.array[:, 1] > 0.0, 2:]
            families[family] = float((used**2).sum()), float(used.size)
        return ChiSquare(sum(v for v, _ in families.values()), sum(d for _, d in families.values()), families)

    def residuals(self) -> dict[str, Residuals]:
        """Innovations of each family, as residuals."""
        return {
            family: Residuals(rows.array[:, 0].copy(), rows.array[:, 2:].copy(), rows.array[:, 1] > 0.0)
            for family, rows in self.families.items()
        }

    def correlation_lengths(self) -> dict[str, float]:
        """Number of consecutive innovations that count as one, by family, for correlated families."""
        found = {
            family: autocorrelation(np.where(each.used[:, None], each.whitened, 0.0))
            for family, each in self.residuals().items()
        }
        return {family: 1.0 + 2.0 * float(lags.sum()) for family, lags in found.items() if len(lags)}

    def rejected(self) -> dict[str, int]:
        """Number of rejected measurements of each family."""
        return {family: rejected + self.unusable.get(family, 0) for family, (_, rejected) in self._counts().items()}

    def _counts(self) -> dict[str, tuple[int, int]]:
        """Number of measurements and number of rejected ones, by family."""
        return {family: (len(rows), int((rows.array[:, 1] == 0.0).sum())) for family, rows in self.families.items()}
