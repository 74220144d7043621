"""gtsam's own simulated data set of a gyro and two direction sensors: bias and sensor mount within 3 sigma.

The gyro goes through the head method's preintegration and native factors, the directions through the same bridge as the
vision attitudes, the whole through the batch solver.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.model import ROT3, Model, Residuals
from alidade.factors.preintegration import GyroPath
from alidade.factors.testing import assert_jacobians
from alidade.pipelines.estimation.problem import Factor, Parameter, Problem, Quantity, Step, rotation_vector_coordinates
from alidade.pipelines.solvers.batch import solve_batch
from benchmarks.ahrs import ahrs_factors

BIAS, MOUNT = gtsam.symbol("b", 0), gtsam.symbol("C", 0)
LAST = 11_980  # the record's last samples jump


@dataclass(frozen=True)
class _DirectionFactor(Model):
    """A sensor mounted at vRs sees known directions: (vRs^T nRv^T direction) across the measured one, over sigma."""

    time: Array
    direction: Array  # (n, 3) in n
    measured: Array  # (n, 3) in s
    sigma: float
    rows: int = 2
    blocks = (ROT3, ROT3)

    def __call__(self, nRv: Array, vRs: Array) -> Residuals:
        in_v = so3.rotate(so3.inverse(nRv), self.direction)
        in_s = so3.rotate(so3.inverse(vRs), in_v)
        helper = np.eye(3)[np.argmin(np.abs(self.measured), axis=1)]
        across = so3.cross(self.measured, helper)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        basis = np.stack([across, so3.cross(self.measured, across)], axis=1) / self.sigma

        def jacobians() -> tuple[Array, ...]:
            return basis @ so3.matrix(so3.inverse(vRs)) @ so3.hat(in_v), basis @ so3.hat(in_s)

        return np.einsum("nij,nj->ni", basis, in_s), jacobians


def _read(last: int) -> np.ndarray:
    path = str(gtsam.findExampleDataFile("EqFdata.csv"))  # type: ignore[no-untyped-call]
    return np.asarray(np.genfromtxt(path, delimiter=",", names=True))[:last]


def _columns(data: np.ndarray, pattern: str, names: str = "xyz") -> Array:
    return np.stack([data[pattern.format(name)] for name in names], axis=1)


def _problem(data: np.ndarray) -> Problem:
    t = data["t"]
    first, second = _columns(data, "y_{}_0"), _columns(data, "y_{}_1")
    frames = np.flatnonzero(np.isfinite(first[:, 0]) | np.isfinite(second[:, 0]))
    path = GyroPath(t, _columns(data, "w_{}"))
    steps = path.increments(t[frames[:-1]], t[frames[1:]])
    density = data["std_w_x"][0] * np.sqrt(t[1] - t[0])
    keys = [gtsam.symbol("x", k) for k in range(len(frames))]
    start = _columns(data, "q_{}", "wxyz")[frames]
    scatter = so3.exp(np.random.default_rng(0).normal(scale=0.1, size=(len(frames), 3)))

    def seen(vectors: Array, directions: Array, sigma: float, columns: list[int] | int) -> Iterator[Factor]:
        """In chunks; the body itself is the second sensor's frame, a mount that is held at the identity."""
        rows = np.flatnonzero(np.isfinite(vectors[frames, 0]))
        for part in np.array_split(rows, max(1, len(rows) // 20)):
            model = _DirectionFactor(t[frames[part]], directions[frames[part]], vectors[frames[part]], sigma)
            yield Factor.of("directions", model.on([keys[k] for k in part], columns))

    def build(_: int) -> Iterator[Step]:
        values = gtsam.Values()
        for key, q in zip(keys, so3.multiply(start, scatter), strict=True):
            values.insert(key, so3.to_gtsam(q))
        values.insert(BIAS, np.zeros(3))
        values.insert(MOUNT, so3.to_gtsam(so3.identity()))
        body = gtsam.symbol("I", 0)
        values.insert(body, gtsam.Rot3())
        factors = [
            Factor("prior", gtsam.PriorFactorRot3(body, gtsam.Rot3(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6))),
            *(
                Factor("gyro", f)
                for f in ahrs_factors(
                    keys[:-1], keys[1:], [BIAS] * (len(keys) - 1), steps, np.zeros(3), density**2 * steps.duration
                )
            ),
            *seen(first, _columns(data, "d_{}_0"), data["std_y_x_0"][0], MOUNT),
            *seen(second, _columns(data, "d_{}_1"), data["std_y_x_1"][0], body),
        ]
        yield Step(0.0, values, factors)

    bias = Parameter(BIAS, tuple(Quantity(f"bias_{a}", "rad/s", None, 0.05, 1e-3) for a in "xyz"))
    mount = Parameter(
        MOUNT, tuple(Quantity(f"mount_{a}", "rad", None, 0.5, 1e-2) for a in "xyz"), rotation_vector_coordinates
    )
    return Problem("directions", (bias, mount), build)


def test_direction_jacobians() -> None:
    rng = np.random.default_rng(1)
    unit = rng.normal(size=(2, 9, 3))
    unit /= np.linalg.norm(unit, axis=2, keepdims=True)
    model = _DirectionFactor(np.arange(9.0), unit[0], unit[1], 0.1)
    assert_jacobians(model, [so3.exp(rng.normal(size=(9, 3))) for _ in range(2)])


@pytest.mark.parametrize("last", [LAST // 4, pytest.param(LAST, marks=pytest.mark.slow)])
def test_bias_and_mount_within_three_sigma(last: int) -> None:
    data = _read(last)
    estimate = solve_batch(_problem(data))
    assert estimate.converged, estimate.message
    truth = np.concatenate([_columns(data, "b_{}").mean(axis=0), so3.log(_columns(data, "cq_{}_0", "wxyz")[0])])
    z = (estimate.values - truth) / estimate.sigmas
    assert np.abs(z).max() < 3.0, z
    wider = (LAST / last) ** 0.5
    assert estimate.sigmas[:3].max() < 2e-3 * wider  # the body spins about z, so x and y biases hardly move it
    assert estimate.sigmas[3:].max() < 1e-2 * wider
