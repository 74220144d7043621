"""Static problems, 2 million rows: the batch solver's minimiser against numpy's normal equations.

The indexer's graph is not here: its rows are means over turns, three a turn, and never many.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.model import Model, Residuals
from alidade.factors.triad import AccelFactor
from alidade.pipelines.estimation.priors import LinearModel
from alidade.pipelines.estimation.problem import Factor
from alidade.pipelines.solvers.layout import Layout
from alidade.pipelines.solvers.levenberg import minimize
from alidade.pipelines.solvers.linearization import Linearization
from benchmarks.measure import Ratio, costs

ROWS = 2_000_000
SAME = 1e-9  # relative
GRAVITY = 9.8


@dataclass(frozen=True)
class AtKnownAttitudes(Model):
    """An accelerometer whose attitudes are known: of its factor, the triad alone is a variable."""

    whole: AccelFactor
    nRb: Array
    rows: int = 3
    blocks = (12,)

    @property
    def time(self) -> Array:
        return self.whole.time

    def __call__(self, triads: Array) -> Residuals:
        residuals, jacobians = self.whole(self.nRb, triads)
        return residuals, lambda: jacobians()[1:]


def linear_rates() -> tuple[Model, Array]:
    """Rates of two rows that are linear in 4 unknowns, and a start."""
    rng = np.random.default_rng(0)
    n = ROWS // 2
    sigma = rng.uniform(1e-3, 2e-3, n)
    H = rng.normal(scale=0.2, size=(n, 2, 4)) / sigma[:, None, None]
    measured = H @ np.array([8e-3, -9e-3, 7e-3, 5e-3]) + rng.standard_normal((n, 2))
    return LinearModel(np.arange(float(n)), measured, H), np.zeros(4)


def accelerometer() -> tuple[Model, Array]:
    """An accelerometer's matrix and offset, 12 unknowns, and the ideal one."""
    rng = np.random.default_rng(1)
    n = ROWS // 3
    nRb = so3.exp(rng.normal(size=(n, 3)))
    up = so3.rotate(so3.inverse(nRb), [0.0, 0.0, GRAVITY])
    A = np.eye(3) + rng.normal(scale=1e-2, size=(3, 3))
    sigma = rng.uniform(1e-3, 2e-3, n)
    raw = up @ A.T + 0.1 + sigma[:, None] * rng.standard_normal((n, 3))
    return AtKnownAttitudes(AccelFactor(np.arange(float(n)), raw, sigma, GRAVITY), nRb), np.append(
        np.eye(3), np.zeros(3)
    )


def ours(model: Model, start: Array) -> Array:
    """By the batch solver's minimiser."""
    initial = gtsam.Values()
    initial.insert(0, start)
    layout, values = Layout.of(None, initial, [0])
    engine = Linearization.of([Factor.of("rows", model.on(0))], layout)
    return layout.of_key(minimize(engine, values).values, 0)


def normal_equations(model: Model, start: Array) -> Array:
    """By numpy from the same whitened rows."""
    e, jacobians = model(np.broadcast_to(start, (len(model.time), len(start))))
    A, b = jacobians()[0].reshape(-1, len(start)), e.reshape(-1)
    return start - np.linalg.solve(A.T @ A, A.T @ b)


def run() -> Iterator[Ratio]:
    """Linear rates and an accelerometer. Raises AssertionError when the answers differ."""
    for name, (model, start) in {"los": linear_rates(), "cube": accelerometer()}.items():
        work = [partial(ours, model, start), partial(normal_equations, model, start)]
        x, y = (solve() for solve in work)
        assert np.linalg.norm(x - y) < SAME * np.linalg.norm(y), f"{x} is not {y}"
        a, b = costs(work)
        compared = f"the batch solver's minimiser over numpy normal equations, {ROWS:,} rows of {len(start)} unknowns"
        yield Ratio(f"static.{name}", compared, a.seconds / b.seconds, wanted=2.0, ours=a, theirs=b)
