"""The bridge to gtsam: layout, robust loss."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import FrozenInstanceError, dataclass
from typing import ClassVar

import gtsam
import numpy as np
import pytest

from alidade import factors
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.bridge import BoundModel
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import POSE3, Keys, Model, Residuals
from alidade.factors.testing import assert_jacobians


@dataclass(frozen=True)
class _Line(Model):
    """y = A_i x + b_i, two rows a measurement; linear, so gtsam's answer must be numpy's."""

    time: Array
    A: Array
    y: Array
    rows: int = 2
    blocks = (3, 2)
    stacked: ClassVar = ("time", "A", "y")

    def __call__(self, x: Array, b: Array) -> Residuals:
        residual = np.einsum("nij,nj->ni", self.A, x) + b - self.y
        return residual, lambda: (self.A, np.broadcast_to(np.eye(2), (len(self.A), 2, 2)))


def _line(n: int, seed: int = 0) -> _Line:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, 2, 3))
    y = A @ np.array([1.0, -2.0, 0.5]) + rng.normal(scale=0.1, size=(n, 2))
    return _Line(np.arange(float(n)), A, y)


def _values(*vectors: Array) -> gtsam.Values:
    values = gtsam.Values()
    for key, v in enumerate(vectors):
        values.insert(key, v)
    return values


def _normal_equations(factor: BoundModel, values: gtsam.Values) -> tuple[Array, Array]:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor.factor)
    return graph.linearize(values).hessian()


def test_shared_columns_stack_to_least_squares() -> None:
    model = _line(50)
    factor = model.on(0, 1)
    H, g = _normal_equations(factor, _values(np.zeros(3), np.zeros(2)))
    full = np.concatenate([model.A.reshape(-1, 3), np.tile(np.eye(2), (50, 1))], axis=1)
    np.testing.assert_allclose(H, full.T @ full, rtol=1e-12)
    np.testing.assert_allclose(g.ravel(), full.T @ model.y.ravel(), rtol=1e-12)


def test_own_and_shared_variables_are_laid_out_row_by_row() -> None:
    model = _line(4)
    factor = model.on([0, 1, 0, 2], 3)
    assert factor.keys == [0, 1, 2, 3]
    x = np.random.default_rng(1).normal(size=(3, 3))
    H, _ = _normal_equations(factor, _values(*x, np.zeros(2)))
    full = np.zeros((8, 11))
    for i, slot in enumerate([0, 1, 0, 2]):
        full[2 * i : 2 * i + 2, 3 * slot : 3 * slot + 3] = model.A[i]
        full[2 * i : 2 * i + 2, 9:] = np.eye(2)
    np.testing.assert_allclose(H, full.T @ full, rtol=1e-12, atol=1e-12)


def test_rows_are_the_plain_linearisation() -> None:
    model = _line(6)
    values = _values(np.array([0.2, 0.1, -0.3]), np.ones(2))
    loss = TruncatedLoss(gate=0.1)
    error, A = model.on(0, 1, loss=loss).rows(values)
    np.testing.assert_allclose(A, np.concatenate([model.A.reshape(-1, 3), np.tile(np.eye(2), (6, 1))], axis=1))
    np.testing.assert_allclose(error, A @ np.array([0.2, 0.1, -0.3, 1, 1]) - model.y.ravel())


def test_outliers_lose_their_pull_and_no_more() -> None:
    model = _line(200)
    bad = model.y.copy()
    bad[::5] += 50.0
    outlying = _Line(model.time, model.A, bad)
    factor = outlying.on(0, 1, loss=TruncatedLoss(gate=1.0))
    truth = _values(np.array([1.0, -2.0, 0.5]), np.zeros(2))
    assert factor.used(truth).tolist() == [i % 5 != 0 for i in range(200)]
    inliers = np.flatnonzero(np.arange(200) % 5)
    clean = _Line(model.time[inliers], model.A[inliers], bad[inliers]).on(0, 1)
    for got, expected in zip(_normal_equations(factor, truth), _normal_equations(clean, truth), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert factor.factor.error(truth) == pytest.approx(clean.factor.error(truth) + 40 * 0.5)


@pytest.mark.parametrize("mu", [0.0, 1e-4, 0.1, 1.0, 30.0, np.inf])
def test_loss_weight_is_the_slope_of_its_cost(mu: float) -> None:
    loss = TruncatedLoss(gate=3.0, mu=mu)
    square = np.linspace(0.01, 200.0, 4001) + 1e-4
    square = square[np.abs(square - 9.0) > 0.1] if np.isinf(mu) else square
    h = 1e-7 * square
    slope = (loss.cost(square + h) - loss.cost(square - h)) / (2 * h)
    np.testing.assert_allclose(loss.weight(square), slope, atol=1e-4)
    assert (np.diff(loss.cost(square)) >= -1e-12).all()


@pytest.mark.parametrize("loss", [None, TruncatedLoss(2.0), TruncatedLoss(2.0, mu=0.1)])
def test_a_system_made_in_one_piece_is_what_gtsam_asks_for_key_by_key(loss: TruncatedLoss | None) -> None:
    factor = _line(6).on([0, 1, 0, 2, 1, 0], 5, loss=loss)
    factor = factor.weighed(np.random.default_rng(2).uniform(0.5, 2.0, (6, 2)))
    values, rng = gtsam.Values(), np.random.default_rng(3)
    for key in factor.keys:
        values.insert(key, rng.normal(size=2 if key == factor.keys[-1] else 3))
    whole, asked = factor.linearized(values), factor.factor.linearize(values)
    assert type(whole) is gtsam.JacobianFactor
    assert list(whole.keys()) == list(asked.keys())
    np.testing.assert_array_equal(whole.augmentedJacobian(), asked.augmentedJacobian())


def test_a_loss_can_be_replaced_where_there_is_one() -> None:
    line = _line(8)
    spoilt = _Line(line.time, line.A, line.y + 5.0)
    weighed, plain = spoilt.on(0, 1, loss=TruncatedLoss(1.0)), spoilt.on(0, 1)
    values = _values(np.array([1.0, -2.0, 0.5]), np.zeros(2))
    full = plain.factor.error(values)
    for loss, error in ((None, full), (TruncatedLoss(1.0), 8 * 0.5), (TruncatedLoss(1.0, mu=0.0), full)):
        assert weighed.under(loss).factor.error(values) == pytest.approx(error)
    assert plain.under(TruncatedLoss(1.0)) is plain
    with pytest.raises(FrozenInstanceError):
        weighed.loss.mu = 0.0  # type: ignore[misc, union-attr]


@dataclass(frozen=True)
class _Misdeclared(_Line):
    """Says that x has two numbers; it has three."""

    blocks = (2, 2)


def test_a_factor_declared_with_the_wrong_length_is_refused_when_built() -> None:
    line = _line(5)
    with pytest.raises(ValueError, match=r"_Misdeclared cannot be evaluated with its blocks \[2, 2\]"):
        _Misdeclared(line.time, line.A, line.y).on(0, 1)


def test_a_jacobian_of_another_shape_than_declared_is_refused_when_built() -> None:
    @dataclass(frozen=True)
    class Flat(_Line):
        def __call__(self, x: Array, b: Array) -> Residuals:
            residual, jacobians = super().__call__(x, b)
            return residual, lambda: (jacobians()[0], jacobians()[1][:, :1])

    line = _line(5)
    with pytest.raises(ValueError, match=r"Flat declares block 1 as 2: .* \(5, 2, 2\), not \(5, 1, 2\)"):
        Flat(line.time, line.A, line.y).on(0, 1)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ((0,), r"_Line has 2 blocks \[3, 2\], given are 1"),
        (([0, 1], 5), r"_Line of 4 measurements got 2 keys for block 0"),
        ((7, 7), r"takes 7 both as 3 and as 2"),
    ],
)
def test_keys_that_do_not_fit_are_refused_when_built(keys: tuple[Keys, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _line(4).on(*keys)


def test_a_vector_of_another_length_is_named() -> None:
    factor = _line(4).on(gtsam.symbol("x", 1), 5)
    values = gtsam.Values()
    values.insert(gtsam.symbol("x", 1), np.zeros(4))
    values.insert(5, np.zeros(2))
    with pytest.raises(ValueError, match="x1 is a vector of 4 numbers, its factor takes 3"):
        factor.residuals(values)


def test_a_noise_model_whitens() -> None:
    line = _line(6)
    rng = np.random.default_rng(4)
    covariance = np.cov(rng.normal(size=(2, 9)))
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    values = _values(rng.normal(size=3), rng.normal(size=2))
    plain, whitened = line.on(0, 1).residuals(values), line.on(0, 1, noise=noise).residuals(values)
    np.testing.assert_allclose(
        (whitened**2).sum(axis=1), np.einsum("ni,ij,nj->n", plain, np.linalg.inv(covariance), plain)
    )
    H, _ = _normal_equations(line.on(0, 1, noise=noise), values)
    A = np.concatenate([line.A, np.tile(np.eye(2), (6, 1, 1))], axis=2)
    np.testing.assert_allclose(H, np.einsum("nik,ij,njl->kl", A, np.linalg.inv(covariance), A), rtol=1e-9)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        (gtsam.noiseModel.Isotropic.Sigma(3, 1.0), "one measurement has 2 rows, the noise model 3"),
        (gtsam.noiseModel.Constrained.All(2), "no constraint"),
        (
            gtsam.noiseModel.Robust.Create(
                gtsam.noiseModel.mEstimator.Huber.Create(1.0), gtsam.noiseModel.Unit.Create(2)
            ),
            "for outliers give a `loss`",
        ),
    ],
)
def test_a_noise_model_that_does_not_fit_is_refused_when_built(noise: gtsam.noiseModel.Base, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _line(4).on(0, 1, noise=noise)


@dataclass(frozen=True)
class _PoseToPose(Model):
    """wTa^-1 wTb as measured; to first order about agreement what gtsam's BetweenFactorPose3 is."""

    time: Array
    rotation: Array
    translation: Array
    rows: int = 6
    blocks = (POSE3, POSE3)

    def __call__(self, a: Array, b: Array) -> Residuals:
        aRb = so3.multiply(so3.inverse(a[:, :4]), b[:, :4])
        way = so3.rotate(so3.inverse(a[:, :4]), b[:, 4:] - a[:, 4:])
        error = so3.log(so3.multiply(so3.inverse(self.rotation), aRb))

        def jacobians() -> tuple[Array, ...]:
            by_a, by_b = np.zeros((2, len(a), 6, 6))
            right = so3.right_jacobian_inverse(error)
            by_a[:, :3, :3], by_b[:, :3, :3] = -right @ so3.matrix(so3.inverse(aRb)), right
            by_a[:, 3:, :3], by_a[:, 3:, 3:], by_b[:, 3:, 3:] = so3.hat(way), -np.eye(3), so3.matrix(aRb)
            return by_a, by_b

        return np.concatenate([error, way - self.translation], axis=1), jacobians


def _poses(n: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.concatenate([so3.exp(rng.normal(size=(n, 3))), rng.normal(size=(n, 3))], axis=1)


def test_jacobians_by_poses() -> None:
    measured = _poses(5, 0)
    assert_jacobians(_PoseToPose(np.arange(5.0), measured[:, :4], measured[:, 4:]), [_poses(5, 1), _poses(5, 2)])


def test_a_wrong_jacobian_is_found() -> None:
    @dataclass(frozen=True)
    class Wrong(_Line):
        def __call__(self, x: Array, b: Array) -> Residuals:
            residual, jacobians = super().__call__(x, b)
            return residual, lambda: (jacobians()[0], 1.001 * jacobians()[1])

    line = _line(5)
    blocks = [np.zeros((5, 3)), np.zeros((5, 2))]
    assert_jacobians(line, blocks)
    with pytest.raises(AssertionError, match="Jacobian by block 1, 2"):
        assert_jacobians(Wrong(line.time, line.A, line.y), blocks)


def test_poses_are_read_and_perturbed_as_gtsam_does() -> None:
    """Where the poses agree with the measurement, the factor is gtsam's own; a step by gtsam does what is foreseen."""
    a, b = gtsam.Pose3.Expmap(np.arange(6) / 5.0), gtsam.Pose3.Expmap(np.array([0.3, -1, 0.5, 2, 1, -1]))
    between = a.between(b)
    rotation = so3.from_gtsam([between.rotation()])
    factor = _PoseToPose(np.zeros(1), rotation, between.translation()[None]).on(0, [1])
    values = gtsam.Values()
    values.insert(0, a)
    values.insert(1, b)
    np.testing.assert_allclose(factor.residuals(values), 0.0, atol=1e-12)
    native = gtsam.NonlinearFactorGraph()
    native.add(gtsam.BetweenFactorPose3(0, 1, between, gtsam.noiseModel.Unit.Create(6)))
    # The translation's error is in a, gtsam's in b: the same but for a rotation of its three rows.
    for got, expected in zip(_normal_equations(factor, values), native.linearize(values).hessian(), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-9)
    step = gtsam.VectorValues()
    delta = 1e-6 * np.random.default_rng(0).normal(size=12)
    step.insert(0, delta[:6])
    step.insert(1, delta[6:])
    _, A = factor.rows(values)
    np.testing.assert_allclose(factor.residuals(values.retract(step)).ravel(), A @ delta, atol=1e-10)


def test_importing_factors_needs_no_gtsam() -> None:
    code = "import sys, factors; from factors import so3, model, Model; assert 'gtsam' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_every_exported_name_is_there() -> None:
    for name in factors.__all__:
        value = getattr(factors, name)
        assert getattr(value, "__name__", repr(value)) == name
