"""How redundant measurements are: the sums of squares that the residuals of each family are expected to have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.graph.problem import Array, Factor
from pipelines.solvers.system import Linear, Part, shown

# Elements of a row of a rejected measurement or a free prior.
_EMPTY = 1e-12
# Random right sides that tell traces: many where that costs little, few where every one tells enough.
_SAMPLES, _MOST_SAMPLES, _SAMPLED_ROWS = 6, 60, 30_000


@dataclass(frozen=True, eq=False)
class _Rows:
    """The rows of a stretch's linear system.

    Attributes:
        part: the stretch, whose matrix is A (m, D).
        ends: (factors,) of the rows of each factor.
        group: (m,) the label of each row.
        counted: (m,) rejected measurements and free priors have empty rows, which are no measurements.
        beside: by label, what compression took out of the system.
    """

    part: Part
    ends: NDArray[np.intp]
    group: NDArray[np.intp]
    counted: NDArray[np.bool_]
    beside: Array

    @classmethod
    def of(cls, part: Part, stands: Array, labels: dict[tuple[str, int], int]) -> _Rows:
        """Of a part whose factors stand for so many rows; new labels are added."""
        some = [np.asarray((np.abs(A) > _EMPTY).any(axis=1)) for A, _ in part.blocks()]
        sizes, counted = [len(each) for each in some], np.concatenate(some)
        group = np.concatenate([_labelled(f, size, labels) for f, size in zip(part.factors, sizes, strict=True)])
        held = np.array([each.sum() for each in some])
        measured = np.array([f.measurement is not None for f in part.factors])
        # What compression took out of the system holds no unknowns: each such row is expected to be one.
        ends = np.cumsum(sizes)
        first = group[np.append(0, ends)[:-1]]
        beside = np.bincount(first, np.where(measured, stands - held, 0.0), len(labels)).astype(float)
        return cls(part, ends, group, counted, beside)

    def across(self, x: Array) -> Array:
        """(m, k) A x of x (D, k)."""
        return np.concatenate([A @ x[rows] for A, rows in self.part.blocks()])

    def back(self, y: Array) -> Array:
        """(D, k) A'y of y (m, k)."""
        out = np.zeros((self.part.triangular.size, y.shape[1]))
        for (A, rows), own in zip(self.part.blocks(), np.split(y, self.ends[:-1]), strict=True):
            out[rows] += A.T @ own
        return out

    def noise(self, signs: NDArray[np.int8]) -> Array:
        """(m, k) of signs (m, k), none where nothing was measured."""
        return np.where(self.counted[:, None], signs, 0.0)

    def squares(self, left: Array) -> Array:
        """By label, the mean over k of the squares of rows (m, k)."""
        return np.asarray(np.bincount(self.group, (left**2).mean(axis=1), len(self.beside)), dtype=float)


def expected_squares(linear: Linear, stands: Sequence[Array]) -> dict[tuple[str, int], float]:
    """(family, row of its measurements) -> expected sum of squares, of random signs after solving for the unknowns.

    Noise of variance one would do too; signs tell the traces of projections with less scatter (Hutchinson 1989). The
    rows of what is no measurement, or compressed, count as one.

    Args:
        linear: a graph about an estimate; compressed factors have fewer rows than they stand for.
        stands: for each stretch how many rows each of its factors stands for, see marginals.rows_used.

    Raises:
        IndeterminateError: a variable is not determined.
    """
    labels: dict[tuple[str, int], int] = {}
    found: list[Array] = []
    halfway: list[Array] = []
    ends = np.cumsum([sum(f.factor.dim() for f in stretch.factors) for stretch in linear.system.stretches]).tolist()
    samples = int(np.clip(_SAMPLED_ROWS // ends[-1], _SAMPLES, _MOST_SAMPLES))
    generator = np.random.default_rng(0)
    drawn = [generator.choice([-1.0, 1.0], ends[-1]).astype(np.int8) for _ in range(samples)]
    signs = np.split(np.stack(drawn, axis=1), ends[:-1])
    joint = np.zeros((linear.triangular.size, samples))
    for part, stood, its_signs in zip(linear.parts(), stands, signs, strict=True):
        rows = _Rows.of(part, stood, labels)
        reduced = part.triangular.forward(rows.back(rows.noise(its_signs)))
        ours, its = linear.shared(part)
        joint[ours] += reduced[its]
        found.append(rows.beside)
        halfway.append(reduced)
    joint = linear.triangular.back(linear.triangular.forward(joint))
    for i in shown(range(len(stands))[::-1]):
        # The last one is still at hand.
        if i < len(stands) - 1:
            part = linear.part(i)
            rows = _Rows.of(part, stands[i], labels)
        ours, its = linear.shared(part)
        right = halfway.pop()
        right[its] = joint[ours]
        found.append(rows.squares(rows.across(part.triangular.back(right)) - rows.noise(signs[i])))
    square = np.sum([np.pad(each, (0, len(labels) - len(each))) for each in found], axis=0)
    return dict(zip(labels, square.tolist(), strict=True))


def _labelled(factor: Factor, size: int, labels: dict[tuple[str, int], int]) -> NDArray[np.intp]:
    """(size,) number of the label of each row of a linearised factor; new labels are added."""
    measurement = factor.measurement
    rows = 1 if measurement is None or measurement.compress else measurement.model.rows
    own = [labels.setdefault((factor.family, row), len(labels)) for row in range(rows)]
    return np.resize(np.array(own, dtype=np.intp), size)
