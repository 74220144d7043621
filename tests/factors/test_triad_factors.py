"""Properties of the cube's factors: Jacobians, batches, truth, and the integrated gyro against a closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.earth import earth_rate
from alidade.factors.model import Block, Model, dimension, retract
from alidade.factors.testing import assert_jacobians
from alidade.factors.triad import (
    AccelFactor,
    FieldPriorFactor,
    GyroStaticFactor,
    MagFactor,
    TagAttitudeFactor,
    TriadPriorFactor,
    calibration,
    parts,
    triad,
)
from alidade.factors.turns import GyroRotationFactor
from tests.support.numerics import assert_rows_are_independent

N = 7
TIMES = np.arange(float(N))
EARTH = earth_rate(0.7)
SQUARE = 0.06 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _rotations(rng: np.random.Generator, angle: float = 1.5) -> Array:
    return so3.exp(rng.normal(size=(N, 3)) * angle)


def _triads(rng: np.random.Generator, spread: float = 0.1) -> Array:
    return np.array([triad(np.eye(3) + spread * rng.normal(size=(3, 3)), spread * rng.normal(size=3)) for _ in TIMES])


def _sigma(rows: np.ndarray) -> Array:
    return np.linspace(0.5, 2.0, N)[rows]


# K above that at which offsets are what they are.
TEMPERATURE = np.linspace(-2.0, 6.0, N)


def _static(kind: str, rows: np.ndarray) -> Model:
    raw = _rng(5).normal(size=(N, 3))[rows]
    temperature = TEMPERATURE[rows] if kind.startswith("warm") else None
    if "accel" in kind:
        return AccelFactor(TIMES[rows], raw, _sigma(rows), 9.8, "curved" in kind, temperature)
    if "gyro" in kind:
        gravity = 9.8 if kind.endswith("gyro that feels gravity") else None
        return GyroStaticFactor(TIMES[rows], raw, _sigma(rows), EARTH * 1e4, gravity, temperature)
    return MagFactor(TIMES[rows], raw, _sigma(rows))


def _static_blocks(kind: str) -> list[Array]:
    rng = _rng(1)
    blocks: list[Array] = [_rotations(rng), _triads(rng)]
    if kind == "mag":
        return [*blocks, rng.normal(size=(N, 3))]
    if "gyro" in kind:
        blocks.append(0.1 * rng.normal(size=(N, 3)))
    if kind.endswith("gyro that feels gravity"):
        blocks.append(0.1 * rng.normal(size=(N, 9)))
    if "curved" in kind:
        blocks.append(np.repeat([1e-2, 1e-3], 3) * rng.normal(size=(N, 6)))
    if kind.startswith("warm"):
        blocks.append(0.1 * rng.normal(size=(N, 3)))
    return blocks


KINDS = ("accel", "curved accel", "gyro", "gyro that feels gravity")


@pytest.mark.parametrize("kind", [*KINDS, *(f"warm {kind}" for kind in KINDS), "mag"])
def test_static_jacobians(kind: str) -> None:
    blocks = _static_blocks(kind)
    assert_jacobians(_static(kind, np.arange(N)), blocks)
    assert_rows_are_independent(lambda rows: _static(kind, rows), blocks)


def test_static_models_are_what_they_say() -> None:
    """Axis by axis, from the attitude's matrix; at another temperature the readings are off by the slope times that."""
    rng = _rng(13)
    slope = 0.1 * rng.normal(size=(N, 3))
    drift = TEMPERATURE[:, None] * slope
    (nRb, triads, wandered, G), terms = _static_blocks("gyro that feels gravity"), 1e-3 * rng.normal(size=(N, 6))
    A, c = parts(triads)
    up = so3.matrix(nRb)[:, 2]
    sigma = np.ones(N)
    raw = np.einsum("nij,nkj,k->ni", A, so3.matrix(nRb), EARTH) + c + wandered
    raw += 9.8 * np.einsum("nij,nj->ni", G.reshape(N, 3, 3), up)
    np.testing.assert_allclose(
        GyroStaticFactor(TIMES, raw, sigma, EARTH, 9.8)(nRb, triads, wandered, G)[0], 0, atol=1e-13
    )
    warm = GyroStaticFactor(TIMES, raw + drift, sigma, EARTH, 9.8, TEMPERATURE)
    np.testing.assert_allclose(warm(nRb, triads, wandered, G, slope)[0], 0, atol=1e-13)
    u = 9.8 * np.einsum("nij,nj->ni", A, up) + c
    raw = u + terms[:, :3] * u**2 + terms[:, 3:] * u**3
    np.testing.assert_allclose(AccelFactor(TIMES, raw, sigma, 9.8, curved=True)(nRb, triads, terms)[0], 0, atol=1e-12)
    u += drift
    raw = u + terms[:, :3] * u**2 + terms[:, 3:] * u**3
    bent = AccelFactor(TIMES, raw, sigma, 9.8, curved=True, temperature=TEMPERATURE)
    np.testing.assert_allclose(bent(nRb, triads, terms, slope)[0], 0, atol=1e-12)


def _turns(
    rows: np.ndarray, angle: float, feels: bool = False, warm: bool = False, banded: bool = False
) -> GyroRotationFactor:
    """Turns of different length and number of samples, at rates and forces that change direction."""
    stamps, raw, accel = [], [], []
    for i in rows:
        rng = _rng(100 + i)
        t = np.arange(0.0, 0.8 + 0.1 * i, 0.01)
        stamps.append(t)
        raw.append(angle * np.sin(rng.uniform(0.5, 3, size=3) * t[:, None] + rng.uniform(0, 6, size=3)))
        accel.append(9.8 * np.sin(rng.uniform(0.5, 3, size=3) * t[:, None] + rng.uniform(0, 6, size=3)))
    felt, temperature = accel if feels else None, [TEMPERATURE[i] + t**2 for i, t in zip(rows, stamps, strict=True)]
    beyond = [np.sign(each) * (np.abs(each) > 0.3 * angle) for each in raw] if banded else None
    return GyroRotationFactor(
        TIMES[rows], stamps, raw, EARTH * 1e3, _sigma(rows), felt, temperature if warm else None, warm and feels, beyond
    )


@pytest.mark.parametrize(
    ("feels", "warm", "banded", "angle", "miss"),
    [
        *(
            (each, each, each, angle, miss)
            for each in (False, True)
            for angle in (2.0, 1e-6)
            for miss in (1.0, 1e-7, 3.0)
        ),
        *((*each, 2.0, 1.0) for each in ((True, False, False), (False, True, False), (True, True, False))),
        (False, False, True, 2.0, 1.0),
    ],
)
def test_turn_jacobians(feels: bool, warm: bool, banded: bool, angle: float, miss: float) -> None:
    rng = _rng(2)
    model = _turns(np.arange(N), angle, feels, warm, banded)
    start, triads = _rotations(rng), _triads(rng, 0.05)
    others = list(0.01 * rng.normal(size=(2, N, 3)))
    if feels:
        others += [1e-2 * rng.normal(size=(N, 9)), _triads(rng, 0.05)]
    if warm:
        others += [1e-2 * rng.normal(size=(N, 3)), *([0.1 * rng.normal(size=(N, 3))] if feels else [])]
    if banded:
        others += [1e-2 * rng.normal(size=(N, 1))]
    # Attitudes at the end that miss the prediction by `miss` rad.
    error = model(start, so3.identity(N), triads, *others)[0] * _sigma(np.arange(N))[:, None]
    predicted = so3.inverse(so3.exp(error))
    direction = rng.normal(size=(N, 3))
    delta = miss * direction / np.linalg.norm(direction, axis=1)[:, None]
    blocks = [start, so3.multiply(predicted, so3.exp(delta)), triads, *others]
    tolerance = 2e-5 if miss > 2.0 else 2e-6
    assert_jacobians(model, blocks, rtol=tolerance)
    assert_rows_are_independent(lambda rows: _turns(rows, angle, feels, warm, banded), blocks)


def test_turn_of_a_miscalibrated_gyro_on_the_turning_earth() -> None:
    """A constant rate against inertial space: the closed form, through K, b and the earth's rotation."""
    rng = _rng(3)
    K, b = np.eye(3) + 0.05 * rng.normal(size=(3, 3)), 0.1 * rng.normal(size=3)
    t = np.arange(0.0, 2.0001, 0.02)
    w_ib = np.array([0.9, -0.4, 0.6])
    wandered = 0.01 * rng.normal(size=(2, 1, 3))
    raw = np.tile(np.linalg.solve(K, w_ib - b) + wandered.mean(axis=0), (len(t), 1))
    accel_K, accel_b, G = np.eye(3) + 0.05 * rng.normal(size=(3, 3)), rng.normal(size=3), 1e-2 * rng.normal(size=(3, 3))
    force = 9.8 * np.sin(rng.uniform(0.5, 3, size=3) * t[:, None])
    accel = (force - accel_b) @ np.linalg.inv(accel_K).T
    iRb0 = so3.exp(np.array([[0.3, 1.0, -0.7]]))
    nRb1 = so3.compose(so3.exp(-EARTH * t[-1]), iRb0, so3.exp(w_ib * t[-1]))
    model = GyroRotationFactor(t[-1:], [t], [raw], EARTH, np.ones(1))
    np.testing.assert_allclose(model(iRb0, nRb1, triad(K, b)[None], *wandered)[0], 0.0, atol=1e-12)
    feels = GyroRotationFactor(t[-1:], [t], [raw + force @ G.T], EARTH, np.ones(1), [accel])
    of_force = G.reshape(1, 9), triad(accel_K, accel_b)[None]
    np.testing.assert_allclose(feels(iRb0, nRb1, triad(K, b)[None], *wandered, *of_force)[0], 0.0, atol=1e-12)
    slopes, temperature = 1e-3 * rng.normal(size=(2, 1, 3)), 8.0 + 3.0 * t**2
    drifted = [raw + force @ G.T + np.outer(temperature, slopes[0])], [accel + np.outer(temperature, slopes[1])]
    warm = GyroRotationFactor(t[-1:], [t], drifted[0], EARTH, np.ones(1), drifted[1], [temperature], drifts=True)
    np.testing.assert_allclose(warm(iRb0, nRb1, triad(K, b)[None], *wandered, *of_force, *slopes)[0], 0.0, atol=1e-12)
    short, beyond = np.array([[0.05]]), [np.sign(raw)]
    banded = GyroRotationFactor(t[-1:], [t], [raw - 0.05 * np.sign(raw)], EARTH, np.ones(1), beyond=beyond)
    np.testing.assert_allclose(banded(iRb0, nRb1, triad(K, b)[None], *wandered, short)[0], 0.0, atol=1e-12)


def _tags(rows: np.ndarray, blocks: list[Array] | None) -> TagAttitudeFactor:
    rng = _rng(6)
    root = 10 * rng.normal(size=(N, 4, 2, 2))
    bRt, position = so3.exp(rng.normal(size=(N, 3))), 0.08 * rng.normal(size=(N, 3))
    measured = rng.normal(size=(N, 4, 2))
    corners = np.tile(SQUARE, (N, 1, 1))
    BRC = so3.exp(np.array([0.5, -1.0, 0.3]))
    whole = TagAttitudeFactor(TIMES, measured, root, corners, bRt, position, BRC)
    if blocks is not None:
        error = whole(*blocks)[0].reshape(N, 4, 2)
        measured = measured + np.linalg.solve(root, error[..., None])[..., 0]
    return TagAttitudeFactor(
        TIMES[rows], measured[rows], root[rows], corners[rows], bRt[rows], position[rows], whole.BRC
    )


def _tag_blocks(angle: float) -> list[Array]:
    rng = _rng(7)
    return [
        _rotations(rng),
        np.array([0.1, -0.05, 0.7]) + 0.05 * rng.normal(size=(N, 3)),
        _rotations(rng),
        angle * rng.normal(size=(N, 3)),
        _rotations(rng, angle),
        _rotations(rng, angle),
        1e-2 * angle * rng.normal(size=(N, 3)),
    ]


@pytest.mark.parametrize("angle", [1.0, 1e-7])
def test_tag_jacobians(angle: float) -> None:
    blocks = _tag_blocks(angle)
    whole = _tags(np.arange(N), None)
    assert_jacobians(whole, blocks)
    off = replace(whole, by_lens=_rng(8).normal(size=(N, 4, 2, 3)))
    assert_jacobians(off, [*blocks, 0.1 * _rng(9).normal(size=(N, 3))])
    assert_rows_are_independent(lambda rows: _tags(rows, None), blocks)


def test_tags_are_met_at_the_truth_and_missed_beside_it() -> None:
    blocks = _tag_blocks(0.5)
    model = _tags(np.arange(N), blocks)
    np.testing.assert_allclose(model(*blocks)[0], 0.0, atol=1e-9)
    declared: tuple[Block, ...] = model.blocks
    for j, block in enumerate(declared):
        moved = list(blocks)
        moved[j] = retract(blocks[j], block, np.full(dimension(block), 1e-3))
        assert np.abs(model(*moved)[0]).max() > 1e-4


def test_tags_of_one_pose_are_used_or_left_out_together() -> None:
    """Alone each would fit, at some place of the cube; readings at rest stand for themselves."""
    rows = np.arange(N)
    assert not _tags(rows, None).on(rows, N + rows, 20, 21, 22, 23, 24).divisible
    assert _static("mag", rows).on(rows, 20, 21).divisible


def test_a_corner_behind_the_camera_is_a_finite_large_residual() -> None:
    blocks = _tag_blocks(0.5)
    model = _tags(np.arange(N), blocks)
    blocks[1] = blocks[1] * np.array([1.0, 1.0, -1.0])
    residual, jacobians = model(*blocks)
    assert np.isfinite(residual).all()
    assert np.linalg.norm(residual) > 1e3
    assert all(np.isfinite(J).all() for J in jacobians())


def test_triad_and_calibration_are_inverse() -> None:
    rng = _rng(8)
    K, b = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), rng.normal(size=3)
    found, _ = calibration(triad(K, b))
    np.testing.assert_allclose(found, [*K.ravel(), *b], atol=1e-12)
    A, c = parts(triad(K, b))
    nominal = rng.normal(size=3)
    np.testing.assert_allclose(K @ (A @ nominal + c) + b, nominal, atol=1e-12)


def test_prior_jacobians() -> None:
    rng = _rng(9)
    sigma = rng.uniform(0.1, 2.0, size=(N, 12))
    model = TriadPriorFactor(TIMES, rng.normal(size=(N, 12)), sigma)
    assert_jacobians(model, [_triads(rng, 0.2)])


def test_field_prior_jacobians() -> None:
    rng = _rng(11)
    along, across = rng.uniform(0.1, 2.0, size=(2, N))
    assert_jacobians(FieldPriorFactor(TIMES, rng.normal(size=(N, 3)), along, across), [rng.normal(size=(N, 3))])


def test_a_field_prior_is_of_the_fields_own_strength() -> None:
    """A field turned off its model, as strong as it was measured, misses the model's direction alone."""
    mean, angle = np.array([[0.0, 3e-5, -4e-5]]), 0.1
    field = so3.rotate(so3.exp([angle, 0.0, 0.0]), mean)
    residual, _ = FieldPriorFactor(np.zeros(1), mean, np.array([1e-8]), np.array([5e-6]))(field)
    assert np.linalg.norm(residual) == pytest.approx(5e-5 * np.sin(angle) / 5e-6)
    residual, _ = FieldPriorFactor(np.zeros(1), mean, np.array([1e-8]), np.array([5e-6]))(mean * (1.0 + 2e-8 / 5e-5))
    assert np.linalg.norm(residual) == pytest.approx(2.0)


def test_an_unknown_quantity_has_no_prior() -> None:
    rng = _rng(10)
    sigma = np.full((N, 12), np.inf)
    residual, jacobians = TriadPriorFactor(TIMES, rng.normal(size=(N, 12)), sigma)(_triads(rng))
    assert not residual.any()
    assert not jacobians()[0].any()
