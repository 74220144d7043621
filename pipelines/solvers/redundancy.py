"""How redundant measurements are: the sums of squares that the residuals of each family are expected to have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.estimation.problem import Array, Factor
from alidade.pipelines.solvers.stretch import Part
from alidade.pipelines.solvers.system import Linear

# Elements of a row of a rejected measurement or a free prior.
_EMPTY = 1e-12
# Random right sides that tell traces: many where that costs little, few where every one tells enough.
_SAMPLES, _MOST_SAMPLES, _SAMPLED_ROWS = 6, 60, 30_000


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
    ends = np.cumsum([sum(f.factor.dim() for f in stretch.factors) for stretch in linear.system.stretches]).tolist()
    samples = int(np.clip(_SAMPLED_ROWS // ends[-1], _SAMPLES, _MOST_SAMPLES))
    generator = np.random.default_rng(0)
    drawn = [generator.choice([-1.0, 1.0], ends[-1]).astype(np.int8) for _ in range(samples)]
    signs = np.split(np.stack(drawn, axis=1), ends[:-1])
    halfway = linear.ask(_halfway, list(zip(stands, signs, strict=True)))
    joint = linear.gathered([each.held for each in halfway])
    joint = linear.triangular.back(linear.triangular.forward(joint))
    given = [(held, each.reduced, each.signs) for held, each in zip(linear.handed(joint), halfway, strict=True)]
    found: dict[tuple[str, int], float] = {}
    for each, squares in zip(halfway, linear.ask(_squares, given), strict=True):
        summed = np.bincount(each.group, squares, len(each.labels)) + each.beside
        for label, square in zip(each.labels, summed.tolist(), strict=True):
            found[label] = found.get(label, 0.0) + square
    return found


class _Halfway(NamedTuple):
    """A part before what others hold too is solved for.

    Attributes:
        signs: (m, k), none where nothing was measured: rows of rejected measurements and free priors are empty.
        reduced: (D, k) their right side, as far as its own variables go.
        held: (d, k) what that leaves of those that others hold too.
        labels: families and their rows.
        group: (m,) the label of each row.
        beside: by label, what compression took out of the system.
    """

    signs: NDArray[np.int8]
    reduced: Array
    held: Array
    labels: list[tuple[str, int]]
    group: NDArray[np.intp]
    beside: Array


def _halfway(part: Part, stands: Array, signs: NDArray[np.int8]) -> _Halfway:
    """A part's own variables eliminated from the right sides that signs (m, k) make."""
    labels: dict[tuple[str, int], int] = {}
    some = [np.asarray((np.abs(A) > _EMPTY).any(axis=1)) for A, _ in part.blocks()]
    sizes, factors = [len(each) for each in some], part.stretch.factors
    group = np.concatenate([_labelled(f, size, labels) for f, size in zip(factors, sizes, strict=True)])
    counted = signs * np.concatenate(some)[:, None]
    right = np.zeros((part.triangular.size, signs.shape[1]))
    ends = np.cumsum(sizes)
    for (A, rows), own in zip(part.blocks(), np.split(counted, ends[:-1]), strict=True):
        right[rows] += A.T @ own
    reduced = part.triangular.forward(right)
    # What compression took out of the system holds no unknowns: each such row is expected to be one.
    measured = np.array([f.measurement is not None for f in factors])
    out = np.where(measured, stands - [each.sum() for each in some], 0.0)
    beside = np.bincount(group[np.append(0, ends)[:-1]], out, len(labels)).astype(float)
    return _Halfway(counted, reduced, reduced[part.held], list(labels), group, beside)


def _squares(part: Part, held: Array, reduced: Array, signs: NDArray[np.int8]) -> Array:
    """(m,) the mean over k of the squares that are left of signs (m, k) once all is solved for."""
    x = part.solved(held, reduced)
    left = np.concatenate([A @ x[rows] for A, rows in part.blocks()]) - signs
    return np.asarray((left**2).mean(axis=1))


def _labelled(factor: Factor, size: int, labels: dict[tuple[str, int], int]) -> NDArray[np.intp]:
    """(size,) number of the label of each row of a linearised factor; new labels are added."""
    measurement = factor.measurement
    rows = 1 if measurement is None or measurement.compress else measurement.model.rows
    own = [labels.setdefault((factor.family, row), len(labels)) for row in range(rows)]
    return np.resize(np.array(own, dtype=np.intp), size)
