"""The los direction graph by scipy's sparse least squares, and an accelerometer by pyceres, to the same accuracy.

The peers get the same models' rows, vectorised, and no outliers. Keyframes are rotation vectors about their start.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import gtsam
import numpy as np
import pyceres
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.gyro import GyroIncrementFactor
from alidade.factors.model import Model
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.methods.los import model as los
from alidade.pipelines.methods.los.recording import LosData
from alidade.pipelines.methods.los.simulation import LosNoise, LosScenario, los_config, simulate_los
from alidade.pipelines.solvers.engines import Compiled
from benchmarks import static
from benchmarks.batch import IDEAL, solve
from benchmarks.measure import Ratio, costs

KEYFRAMES = 3_000
_SAME = 1e-5  # rad, a tenth of the mounting angles' sigmas or less
_SCENARIO = LosScenario(
    duration_s=KEYFRAMES / 50.0, gyro_rate_hz=1000.0, image_rate_hz=50.0, noise=LosNoise(gyro_bias_walk=0.0)
)


class LosRows:
    """All rows of the los direction graph with a constant bias; x = keyframes' moves, bias, angles."""

    def __init__(self, problem: Problem, data: LosData) -> None:
        (step,) = problem.steps(10**9)
        (picture,) = [f.measurement for f in step.factors if f.measurement is not None]
        self.model: Model = picture.model
        K = len(self.model.time)
        self.bias_hat = np.asarray(step.initial.atVector(problem.parameters[1].key))
        self.start = so3.from_gtsam([step.initial.atRot3(int(gtsam.symbol("x", k))) for k in range(K)])
        angles = np.asarray(step.initial.atVector(problem.parameters[0].key))
        self.x0 = np.concatenate([np.zeros(3 * K), self.bias_hat, angles])
        path = GyroPath(data.gyro_t, data.gyro, self.bias_hat)
        turns = path.increments(self.model.time[:-1], self.model.time[1:])
        sigma = _SCENARIO.noise.gyro_density * np.sqrt(turns.duration)
        self.gyro = GyroIncrementFactor(self.model.time[1:], turns, path, sigma)
        self.prior = np.array([q.prior_sigma or np.inf for p in problem.parameters for q in p.quantities])
        self.prior = np.concatenate([self.prior[-3:], self.prior[:-3]])
        # The first attitude's prior, as in the graph: wide where pictures tell, held about the line of sight.
        self.first = so3.matrix(self.start[0]) / np.array([0.3, 1e-3, 0.3])[:, None]

    def _blocks(self, x: Array) -> tuple[Array, Array, Array, Array]:
        K = len(self.start)
        moves = x[: 3 * K].reshape(K, 3)
        return moves, so3.multiply(self.start, so3.exp(moves)), x[3 * K : 3 * K + 3], x[3 * K + 3 :]

    def residuals(self, x: Array) -> Array:
        """(m,)."""
        moves, tRm, bias, angles = self._blocks(x)
        K = len(tRm)
        gyro, _ = self.gyro(tRm[:-1], tRm[1:], np.broadcast_to(bias, (K - 1, 3)))
        picture, _ = self.model(tRm, np.broadcast_to(angles, (K, len(angles))))
        prior = np.append(bias, angles) / self.prior
        return np.concatenate([gyro.ravel(), picture.ravel(), prior, self.first @ moves[0]])

    def jacobian(self, x: Array) -> csr_matrix:
        """(m, n)."""
        moves, tRm, bias, angles = self._blocks(x)
        K = len(tRm)
        own = so3.right_jacobian(moves)
        by_before, by_after, by_bias = self.gyro(tRm[:-1], tRm[1:], np.broadcast_to(bias, (K - 1, 3)))[1]()
        by_attitude, by_angles = self.model(tRm, np.broadcast_to(angles, (K, len(angles))))[1]()
        k, d = np.arange(K), len(angles)
        top, bottom = 3 * (K - 1), 3 * (K - 1) + 2 * K
        pieces = [
            _block(by_before @ own[:-1], 3 * k[:-1], 3 * k[:-1]),
            _block(by_after @ own[1:], 3 * k[:-1], 3 * k[1:]),
            _block(by_bias, 3 * k[:-1], np.full(K - 1, 3 * K)),
            _block(by_attitude @ own, top + 2 * k, 3 * k),
            _block(by_angles, top + 2 * k, np.full(K, 3 * K + 3)),
            _block(np.diag(1.0 / self.prior)[None], np.array([bottom]), np.array([3 * K])),
            _block(self.first[None], np.array([bottom + 3 + d]), np.array([0])),
        ]
        values, rows, columns = (np.concatenate(part) for part in zip(*pieces, strict=True))
        return csr_matrix((values, (rows, columns)), shape=(bottom + 6 + d, len(x)))

    def solve(self) -> Array:
        """Mounting angles by scipy, iterated until they stay."""
        found = least_squares(
            self.residuals,
            self.x0,
            self.jacobian,
            x_scale="jac",
            tr_solver="lsmr",
            tr_options={"atol": 1e-10, "btol": 1e-10, "conlim": 1e14, "maxiter": 20_000, "regularize": False},
            ftol=1e-12,
            xtol=1e-12,
            gtol=1e-12,
            max_nfev=30,
        )
        return np.asarray(found.x[-(len(self.prior) - 3) :])


def _block(values: Array, rows: Index, columns: Index) -> tuple[Array, Array, Array]:
    """Elements of (n, m, d) blocks whose first row and column are given, with their rows and columns."""
    _, m, d = values.shape
    row = np.broadcast_to(rows[:, None, None] + np.arange(m)[:, None], values.shape)
    column = np.broadcast_to(columns[:, None, None] + np.arange(d), values.shape)
    return values.ravel(), row.ravel(), column.ravel()


class _Cost(pyceres.CostFunction):  # type: ignore[misc]
    """A whole model as one cost of pyceres."""

    def __init__(self, model: Model, unknowns: int) -> None:
        pyceres.CostFunction.__init__(self)
        self._model, self._unknowns = model, unknowns
        self.set_num_residuals(len(model.time) * model.rows)
        self.set_parameter_block_sizes([unknowns])

    def Evaluate(self, parameters: list[Array], residuals: Array, jacobians: list[Array] | None) -> bool:
        x = np.broadcast_to(parameters[0], (len(self._model.time), self._unknowns))
        error, linearize = self._model(x)
        residuals[:] = error.ravel()
        if jacobians is not None:
            jacobians[0][:] = linearize()[0].ravel()
        return True


def by_ceres(model: Model, start: Array) -> Array:
    """A static problem by pyceres."""
    x = start.copy()
    problem = pyceres.Problem()
    problem.add_residual_block(_Cost(model, len(x)), None, [x])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
    options.minimizer_progress_to_stdout = False
    options.num_threads = 1
    pyceres.solve(options, problem, pyceres.SolverSummary())
    return x


def los_peers() -> tuple[Problem, LosRows]:
    """A graph and the same as rows."""
    data, _ = simulate_los(_SCENARIO, 0)
    config = load_config(los_config(_SCENARIO).encode()).model_copy(update={"sensors": IDEAL})
    problem = los.problem(data, config)
    return problem, LosRows(problem, data)


def run() -> Iterator[Ratio]:
    """Both peers. Raises AssertionError when the answers differ."""
    problem, rows = los_peers()
    compiled = Compiled.of(problem)
    angles = compiled.layout.of_key(solve(compiled).values, problem.parameters[0].key)
    found: list[Array] = []
    a, b = costs([partial(solve, compiled), lambda: found.append(rows.solve())], 1, warm=False)
    off = np.abs(found[0] - angles)
    assert off.max() < _SAME, f"scipy's angles are {off} rad off"
    compared = f"scipy's sparse least_squares over ours, los direction graph of {KEYFRAMES:,} keyframes"
    yield Ratio("peers.scipy", compared, b.seconds / a.seconds, "higher", 0.5, 5.0, a, b)

    model, start = static.accelerometer()
    assert np.allclose(by_ceres(model, start), static.ours(model, start), rtol=1e-6)
    a, b = costs([partial(static.ours, model, start), partial(by_ceres, model, start)], 1)
    compared = f"pyceres over ours, an accelerometer's matrix and offset, {static.ROWS:,} rows"
    yield Ratio("peers.ceres", compared, b.seconds / a.seconds, "higher", 0.5, None, a, b)
