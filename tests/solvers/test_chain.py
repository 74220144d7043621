"""The chain's elimination against dense least squares."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from alidade.pipelines.solvers.chain import ChainFactorization, ChainSystem, IndeterminateStateError

Array = NDArray[np.float64]


def random_chain(
    n: int, d: int = 3, s: int = 35, m: int = 2, b: int = 3, c: int = 0, pieces: int = 1, seed: int = 0, q: int = 0
) -> ChainSystem:
    """Rows of white noise about states that stiff rows join to their predecessors."""
    rng = np.random.default_rng(seed)
    measured = rng.standard_normal((n, m, d + c + s + 1))
    between = rng.standard_normal((n, b, 2 * d + c + s + 1)) * 0.3
    if b >= d:
        between[:, :d, :d] += 5.0 * np.eye(d)
        between[:, :d, d : 2 * d] -= 5.0 * np.eye(d)
    between[0] = 0.0
    piece = walk = None
    if c:
        cuts = np.sort(rng.choice(np.arange(1, n), pieces - 1, replace=False))
        piece = np.searchsorted(cuts, np.arange(n), side="right")
        walk = np.zeros((pieces, c, 2 * c + 1))
        walk[:, :, :c], walk[:, :, c:-1] = 4.0 * np.eye(c), -4.0 * np.eye(c)
        walk[:, :, -1] = rng.standard_normal((pieces, c))
        walk[0] = 0.0
    prior = np.zeros((s, s + 1))
    prior[:, :s] = np.eye(s) * 0.1
    return ChainSystem(measured, between, rng.standard_normal((n, q, c + s + 1)), prior, d, piece, walk)


def dense(chain: ChainSystem, until: int | None = None) -> Array:
    """All rows, or those of states up to `until`; columns: states, nodes, shared unknowns, right side."""
    n, d, c = len(chain.measured), chain.d, chain.c
    s, nodes = chain.border - c - 1, 0 if chain.walk is None else len(chain.walk)
    width = n * d + nodes * c + s + 1
    out = []

    def put(rows: Array, places: list[tuple[int, int]]) -> None:
        whole, begin = np.zeros((len(rows), width)), 0
        for place, size in places:
            whole[:, place : place + size] += rows[:, begin : begin + size]
            begin += size
        out.append(whole)

    last, rest = n - 1 if until is None else until, (width - s - 1, s + 1)
    for k in range(last + 1):
        z = [] if chain.piece is None else [(n * d + int(chain.piece[k]) * c, c)]
        put(chain.measured[k], [(k * d, d), *z, rest])
        put(chain.beside[k], [*z, rest])
        put(chain.between[k], [(k * d, d), (max(k - 1, 0) * d, d), *z, rest])
    if chain.walk is not None and chain.piece is not None:
        for j in range(int(chain.piece[last]) + 1):
            put(chain.walk[j], [(n * d + j * c, c), (n * d + max(j - 1, 0) * c, c), (width - 1, 1)])
    put(chain.shared, [rest])
    return np.concatenate(out)


CHAINS: dict[str, dict[str, Any]] = {
    "in time order": {"n": 40, "s": 7},
    "one level": {"n": 200, "s": 7},
    "two levels": {"n": 420, "s": 5, "seed": 2},
    "many shared unknowns": {"n": 220, "seed": 3},
    "states of 12 numbers, uncoupled": {"n": 70, "d": 12, "s": 9, "m": 20, "b": 0, "seed": 5},
    "nodes": {"n": 200, "s": 6, "c": 3, "pieces": 7, "seed": 6},
    "nodes and nothing else": {"n": 130, "d": 0, "b": 0, "s": 6, "c": 6, "pieces": 130, "m": 8},
    "short pieces": {"n": 140, "s": 6, "c": 6, "m": 4, "pieces": 70, "seed": 7, "q": 1},
    "shared unknowns alone": {"n": 1, "d": 0, "b": 0, "s": 6, "m": 40},
}


@pytest.fixture(params=CHAINS, scope="module")
def chain(request: pytest.FixtureRequest) -> ChainSystem:
    return random_chain(**CHAINS[request.param])


def test_solution_covariance_and_determinant_are_those_of_dense_least_squares(chain: ChainSystem) -> None:
    whole = dense(chain)
    A, b = whole[:, :-1], whole[:, -1]
    inverse = np.linalg.inv(np.linalg.qr(A, mode="r"))
    covariance = inverse @ inverse.T
    x = covariance @ (A.T @ b)
    x += covariance @ (A.T @ (b - A @ x))
    sigma = np.sqrt(np.diag(covariance))
    f = ChainFactorization.of(chain)
    states, nodes, shared = f.solve()
    found = np.concatenate([states.ravel(), nodes.ravel(), shared])
    tail = np.arange(len(x) - len(f.root) + 1, len(x))
    R = f.root[:-1, :-1]
    np.testing.assert_array_equal(chain.root(), f.root)
    assert np.abs((found - x) / sigma).max() < 1e-10
    scale = np.outer(sigma[tail], sigma[tail])
    assert np.abs((np.linalg.inv(R.T @ R) - covariance[np.ix_(tail, tail)]) / scale).max() < 1e-10
    assert f.minimum == pytest.approx(((A @ x - b) ** 2).sum(), rel=1e-10)
    states, nodes = f.propagate(np.eye(len(tail)))
    moved = np.concatenate([states.reshape(-1, len(tail)), nodes.reshape(-1, len(tail))])
    assert np.abs(moved - (covariance[:, tail] @ R.T @ R)[: len(moved)]).max(initial=0.0) < 1e-8


def test_prefix_roots_are_the_information_of_what_came_until_then(chain: ChainSystem) -> None:
    n, d, c = len(chain.measured), chain.d, chain.c
    nodes = 0 if chain.walk is None else len(chain.walk)
    keyframes, roots = ChainFactorization.of(chain).prefix_roots()
    assert keyframes[-1] == n - 1
    assert (np.diff(keyframes) > 0).all()
    for k, root in list(zip(keyframes.tolist(), roots, strict=True))[:: max(1, len(roots) // 7)]:
        part = dense(chain, k)
        first = n * d + (0 if chain.piece is None else int(chain.piece[k]) * c)
        kept = [*range(first, first + c), *range(n * d + nodes * c, part.shape[1] - 1)]
        used = np.abs(part[:, :-1]).sum(axis=0) > 0.0
        others = [i for i in np.flatnonzero(used) if i not in kept]
        R = np.asarray(np.linalg.qr(part[:, [*others, *kept, -1]], mode="r"))
        rest = R[len(others) :, len(others) :]
        theirs, own = rest[:, :-1].T @ rest, root[:, :-1].T @ root
        assert np.abs(theirs - own).max() < 1e-9 * np.abs(theirs).max()


def test_draws_have_the_posterior_covariance() -> None:
    chain = random_chain(**CHAINS["nodes"])
    whole = dense(chain)
    sigma = np.sqrt(np.diag(np.linalg.inv(whole[:, :-1].T @ whole[:, :-1])))
    parts = ChainFactorization.of(chain).sample(4000, np.random.default_rng(1))
    drawn = np.concatenate([part.reshape(-1, 4000) for part in parts])
    ratio = drawn.var(axis=1) / sigma**2
    assert ratio.min() > 0.85
    assert ratio.max() < 1.15


def test_state_without_measurement_and_neighbour_is_indeterminate() -> None:
    chain = random_chain(300, s=4)
    chain.measured[100:, :, 0] = 0.0
    chain.between[100:, :, [0, 3]] = 0.0
    with pytest.raises(IndeterminateStateError):
        ChainFactorization.of(chain)


def test_break_of_the_chain_leaves_both_parts_to_their_measurements() -> None:
    chain = random_chain(210, s=6, m=5, seed=4)
    for k in (51, 52, 201):
        chain.between[k] = 0.0
    whole = dense(chain)
    x = np.linalg.solve(whole[:, :-1].T @ whole[:, :-1], whole[:, :-1].T @ whole[:, -1])
    states, _, shared = ChainFactorization.of(chain).solve()
    assert np.abs(np.concatenate([states.ravel(), shared]) - x).max() < 1e-10
