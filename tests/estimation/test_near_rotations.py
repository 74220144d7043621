"""Rotations near half a turn: +pi in one recording, -pi in the next, and one mount."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.estimation.problem import NearRotationVector, rotation_vector_coordinates

AXES = [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8), (-0.48, 0.64, 0.6)]


def values_of(vector: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(1, gtsam.Rot3.Expmap(vector))
    return values


@pytest.mark.parametrize("axis", AXES)
def test_half_a_turn_is_reported_near_its_reference(axis: tuple[float, float, float]) -> None:
    unit = np.array(axis)
    reference = (np.pi - 1e-3) * unit
    beyond = (np.pi + 1e-3) * unit
    plain, _ = rotation_vector_coordinates(values_of(beyond), 1)
    assert plain @ unit == pytest.approx(-(np.pi - 1e-3))
    near, _ = NearRotationVector(tuple(reference.tolist()))(values_of(beyond), 1)
    np.testing.assert_allclose(near, beyond, atol=1e-9)
    same, _ = NearRotationVector(tuple(reference.tolist()))(values_of(reference), 1)
    np.testing.assert_allclose(same, reference, atol=1e-9)


@pytest.mark.parametrize("axis", AXES)
def test_its_jacobian_is_that_of_differences(axis: tuple[float, float, float]) -> None:
    unit = np.array(axis)
    coordinates = NearRotationVector(tuple((3.1 * unit).tolist()))
    at = gtsam.Rot3.Expmap((np.pi + 0.02) * unit)

    def reported(step: np.ndarray) -> np.ndarray:
        values = gtsam.Values()
        values.insert(1, at.compose(gtsam.Rot3.Expmap(step)))
        return coordinates(values, 1)[0]

    values = gtsam.Values()
    values.insert(1, at)
    _, J = coordinates(values, 1)
    numeric = np.stack([(reported(1e-6 * e) - reported(-1e-6 * e)) / 2e-6 for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(J, numeric, atol=1e-7)


@pytest.mark.parametrize("axis", AXES)
def test_small_rotations_are_as_they_are(axis: tuple[float, float, float]) -> None:
    vector = 0.3 * np.array(axis)
    near, J = NearRotationVector((0.0, 0.1, 0.0))(values_of(vector), 1)
    np.testing.assert_allclose(near, vector, atol=1e-12)
    np.testing.assert_allclose(J, so3.right_jacobian_inverse(vector), atol=1e-12)
