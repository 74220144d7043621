"""Rotations: group axioms, round trips and Jacobians, at random, near-zero and near-pi angles."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from alidade.factors import so3

RNG = np.random.default_rng(0)


def _unit(n: int) -> np.ndarray:
    v = RNG.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


TANGENTS = {
    "random": _unit(200) * RNG.uniform(0.0, np.pi, size=(200, 1)),
    "near zero": _unit(200) * 10.0 ** RNG.uniform(-12, -1, size=(200, 1)),
    "around the series limit": _unit(200) * RNG.uniform(0.009, 0.011, size=(200, 1)),
    "near pi": _unit(200) * (np.pi - 10.0 ** RNG.uniform(-6, -2, size=(200, 1))),
    "zero": np.zeros((1, 3)),
}
each_kind = pytest.mark.parametrize("phi", TANGENTS.values(), ids=TANGENTS.keys())


@each_kind
def test_log_undoes_exp(phi: np.ndarray) -> None:
    np.testing.assert_allclose(so3.log(so3.exp(phi)), phi, atol=1e-12)
    np.testing.assert_allclose(so3.log(-so3.exp(phi)), phi, atol=1e-12)


@each_kind
def test_agrees_with_gtsam(phi: np.ndarray) -> None:
    expected = np.array([gtsam.Rot3.Expmap(p).matrix() for p in phi])
    np.testing.assert_allclose(so3.matrix(so3.exp(phi)), expected, atol=1e-9)
    np.testing.assert_allclose(so3.from_gtsam([gtsam.Rot3.Expmap(p) for p in phi]), so3.from_matrix(expected))
    np.testing.assert_allclose(so3.to_gtsam(so3.exp(phi)[0]).matrix(), expected[0], atol=1e-9)


def test_rounding_of_gtsam_rotations_does_not_grow() -> None:
    """gtsam's matrices stay orthogonal through a thousand predictions of a filter, one from the other."""
    attitude = gtsam.Rot3()
    for turn in 0.2 * np.random.default_rng(0).normal(size=(1000, 3)):
        predicted = so3.multiply(so3.from_gtsam([attitude]), so3.exp(turn))[0]
        attitude = so3.to_gtsam(predicted).retract(np.full(3, 1e-3))
    np.testing.assert_allclose(attitude.matrix() @ attitude.matrix().T, np.eye(3), atol=1e-14)


@each_kind
def test_matrix_round_trip(phi: np.ndarray) -> None:
    r = so3.matrix(so3.exp(phi))
    np.testing.assert_allclose(so3.matrix(so3.from_matrix(r)), r, atol=1e-14)


@each_kind
def test_group_axioms(phi: np.ndarray) -> None:
    p, q, r = so3.exp(phi), so3.exp(RNG.normal(size=phi.shape)), so3.exp(RNG.normal(size=phi.shape))
    v = RNG.normal(size=phi.shape)
    np.testing.assert_allclose(so3.compose(p, q, r), so3.multiply(p, so3.multiply(q, r)), atol=1e-14)
    np.testing.assert_allclose(so3.multiply(p, so3.inverse(p)), so3.identity(len(p)), atol=1e-14)
    np.testing.assert_allclose(so3.rotate(so3.multiply(p, q), v), so3.rotate(p, so3.rotate(q, v)), atol=1e-13)
    np.testing.assert_allclose(so3.rotate(p, v), np.einsum("nij,nj->ni", so3.matrix(p), v), atol=1e-13)


@each_kind
def test_right_jacobian_against_differences(phi: np.ndarray) -> None:
    step = 1e-6
    for axis, d in enumerate(step * np.eye(3)):
        forward = so3.log(so3.multiply(so3.inverse(so3.exp(phi)), so3.exp(phi + d)))
        backward = so3.log(so3.multiply(so3.inverse(so3.exp(phi)), so3.exp(phi - d)))
        np.testing.assert_allclose(so3.right_jacobian(phi)[..., axis], (forward - backward) / (2 * step), atol=1e-8)


@each_kind
def test_right_jacobian_inverse(phi: np.ndarray) -> None:
    product = so3.right_jacobian(phi) @ so3.right_jacobian_inverse(phi)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-9)


def test_many_rows_and_few() -> None:
    """Both are evaluated in different ways."""
    phi, other = RNG.normal(size=(2, 40_000, 3))
    q, p = so3.exp(phi), so3.exp(other)
    of_many = [so3.multiply(q, p), so3.rotate(q, other), so3.matrix(q)]
    of_many += [so3.right_jacobian(phi), so3.right_jacobian_inverse(phi), so3.cross(phi, other)]
    some = slice(19_900, 20_100)
    of_few = [so3.multiply(q[some], p[some]), so3.rotate(q[some], other[some]), so3.matrix(q[some])]
    of_few += [so3.right_jacobian(phi[some]), so3.right_jacobian_inverse(phi[some]), so3.cross(phi[some], other[some])]
    for many, few in zip(of_many, of_few, strict=True):
        np.testing.assert_allclose(many[some], few, rtol=0.0, atol=1e-14)


def test_broadcasts() -> None:
    q, v = so3.exp(RNG.normal(size=(5, 1, 3))), RNG.normal(size=(7, 3))
    assert so3.rotate(q, v).shape == (5, 7, 3)
    assert so3.multiply(q, so3.exp(v)).shape == (5, 7, 4)
    np.testing.assert_allclose(so3.rotate(q, v)[3, 2], so3.rotate(q[3, 0], v[2]))


def test_interpolate_follows_constant_rates() -> None:
    rate = np.array([0.3, -0.2, 0.5])
    t = np.array([0.0, 0.5, 2.0])
    at = np.array([-0.1, 0.0, 0.2, 0.5, 1.7, 2.0])
    np.testing.assert_allclose(
        so3.interpolate(t, so3.exp(t[:, None] * rate), at), so3.exp(at[:, None] * rate), atol=1e-14
    )


def test_align_finds_the_rotation_between_vectors() -> None:
    aRb, b = so3.exp(RNG.normal(size=(6, 3))), RNG.normal(size=(6, 5, 3))
    found = so3.align(so3.rotate(aRb[:, None], b), b)
    np.testing.assert_allclose(so3.log(so3.multiply(so3.inverse(aRb), found)), 0.0, atol=1e-12)


def test_align_is_a_minimum_and_never_a_reflection() -> None:
    a, b, weights = RNG.normal(size=(5, 3)), RNG.normal(size=(5, 3)), RNG.uniform(0.1, 2.0, 5)
    a[:, 2] *= -1e-3

    def cost(q: np.ndarray) -> float:
        return float((weights[:, None] * (a - so3.rotate(q, b)) ** 2).sum())

    for mirrored in (b, -b):
        best = so3.align(a, mirrored, weights)
        b = mirrored
        assert all(cost(best) < cost(so3.multiply(best, so3.exp(d))) for d in 1e-3 * np.vstack([np.eye(3), -np.eye(3)]))
        assert all(cost(best) <= cost(so3.exp(phi)) for phi in RNG.normal(size=(200, 3)))


def test_align_of_vectors_without_weight_counts_nothing() -> None:
    aRb, b = so3.exp([0.3, -0.2, 0.5]), RNG.normal(size=(4, 3))
    a = so3.rotate(aRb, b)
    a[0] = [9.0, 9.0, 9.0]
    np.testing.assert_allclose(so3.align(a, b, [0.0, 1.0, 1.0, 1.0]), aRb, atol=1e-12)


def test_many_rows_give_what_few_do() -> None:
    """Evaluated some at a time; also where one rotation meets many vectors, and where rows have rows of their own."""
    v = RNG.normal(size=(20_001, 3))
    p, q = so3.exp(v), so3.exp(v[::-1])
    several = slice(8_000, 8_400)
    for function, arrays in (
        (so3.multiply, (p, q)),
        (so3.rotate, (q, v)),
        (so3.cross, (v, v[::-1])),
        (so3.exp, (v,)),
        (so3.matrix, (p,)),
        (so3.right_jacobian, (v,)),
    ):
        few = function(*(array[several] for array in arrays))
        np.testing.assert_array_equal(function(*arrays)[several], few)
    for one in (p[0], p[:1]):
        np.testing.assert_array_equal(so3.rotate(one, v)[several], so3.rotate(one, v[several]))
        np.testing.assert_array_equal(so3.multiply(p, one)[several], so3.multiply(p[several], one))
    np.testing.assert_array_equal(so3.rotate(p[:, None], v[:3])[several], so3.rotate(p[several, None], v[:3]))
    # No angle about any axis, as formulas have it where nothing is known.
    np.testing.assert_array_equal(so3.exp(np.array(0.0)), so3.identity())


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, np.pi - 1e-5, np.pi - 1e-9, np.pi])
def test_shortest_rotation_takes_one_vector_to_the_other(angle: float) -> None:
    a = np.vstack([_unit(50), np.eye(3), -np.eye(3)])
    axis = np.cross(a, _unit(len(a)))
    b = so3.rotate(so3.exp(angle * axis / np.linalg.norm(axis, axis=1, keepdims=True)), a)
    found = so3.shortest(a, b)
    np.testing.assert_allclose(so3.rotate(found, a), b, atol=2e-7 if angle > 3.0 else 1e-12)
    np.testing.assert_allclose(np.linalg.norm(so3.log(found), axis=1), angle, atol=2e-7 if angle > 3.0 else 1e-12)
    np.testing.assert_array_equal(so3.shortest(a[0], b[0]), found[0])


def test_angles_of_any_rotation_make_it_again() -> None:
    q = so3.normalize(np.random.default_rng(1).standard_normal((200, 4)))
    np.testing.assert_allclose(so3.local(so3.from_angles(so3.angles(q)), q), 0.0, atol=1e-8)
