"""Posterior of the reported numbers at moments of the recording, and a walking bias over time.

The last few dozen states of the chain are eliminated in time order; `ChainFactorization.prefix_roots` has the
square-root information of (node, shared unknowns) after each of them, all linearised at the final estimate. Where a
walking bias has few pieces these are few (one a piece): short recordings are then eliminated anew until each moment.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from alidade.pipelines.estimation.problem import History, PosteriorHistory, Problem
from alidade.pipelines.solvers.chain import Array, ChainFactorization, ChainSystem, IndeterminateStateError, Index
from alidade.pipelines.solvers.layout import Layout, Values
from alidade.pipelines.solvers.linearization import Linearization
from alidade.pipelines.solvers.posterior import Reported
from alidade.pipelines.solvers.weak_directions import WeakDirections, constrained_step

# Moments of the history, and how many keyframes may be eliminated once more for them (2 s at 20 us each).
MOMENTS, ELIMINATED = 48, 100_000


def posterior_history(
    problem: Problem,
    linearization: Linearization,
    system: ChainSystem,
    factorization: ChainFactorization,
    values: Values,
    current_keys: Mapping[int, int],
    time: Array,
    final: tuple[Array, Array] | None = None,
) -> PosteriorHistory | None:
    """Values and joint covariance of the reported numbers at moments, weak directions at their priors.

    Args:
        problem: of which the numbers are.
        linearization: of its factors.
        system: of these at the values.
        factorization: of the system.
        values: the estimate.
        current_keys: parameter key -> variable that holds its value at the end.
        time: (N,) s of the keyframes.
        final: numbers (n,) and covariance (n, n) of the estimate, which the last moment has.

    Returns None where there is but one moment.
    """
    keyframes, roots = prefix_roots(system, factorization)
    if len(keyframes) < 2:
        return None
    layout, nodes = linearization.layout, linearization.piece[keyframes]
    own = {p.key: current_keys.get(p.key, p.key) for p in problem.parameters}
    end = Reported.of(problem, layout, values, current_keys)
    found = [
        _known(problem, layout, values, _keys_at(layout, own, int(node)), end, root)
        for node, root in zip(nodes, roots, strict=True)
    ]
    if final is not None:
        found[-1] = final
    numbers, covariances = (np.array(each) for each in zip(*found, strict=True))
    moving = [layout.sizes[3] > 0 and layout.node[layout.at([key])[0]] >= 0 for key in own.values()]
    steady = ~np.repeat(moving, [len(p.quantities) for p in problem.parameters])
    return PosteriorHistory(time[keyframes], numbers, covariances, steady)


def prefix_roots(system: ChainSystem, factorization: ChainFactorization) -> tuple[Index, list[Array]]:
    """Keyframes (M,), and R of (node, shared unknowns, right side) given all until each.

    The coarse chain of few pieces of a walking bias has few states; of short recordings prefixes are eliminated anew.
    """
    keyframes, roots = factorization.prefix_roots()
    n = len(system.measured)
    count = min(MOMENTS, ELIMINATED // (n // 2 + 1))
    if count <= len(keyframes) or n < 2:
        return keyframes, roots
    wanted = np.unique(np.linspace(0, n - 1, count + 1).astype(np.intp)[1:])
    found, known = [], []
    for keyframe in wanted.tolist():
        try:
            known.append(ChainFactorization.of(_until(system, keyframe)).root)
        except IndeterminateStateError:
            continue
        found.append(keyframe)
    return np.array(found, dtype=np.intp), known


def _until(system: ChainSystem, keyframe: int) -> ChainSystem:
    """The system of the recording until a keyframe."""
    end = keyframe + 1
    piece, walk = system.piece, system.walk
    if piece is not None and walk is not None:
        piece, walk = piece[:end], walk[: piece[keyframe] + 1]
    return replace(
        system,
        measured=system.measured[:end],
        between=system.between[:end],
        beside=system.beside[:end],
        piece=piece,
        walk=walk,
    )


def _known(
    problem: Problem,
    layout: Layout,
    values: Values,
    keys: Mapping[int, int],
    end: Reported,
    root: Array,
) -> tuple[Array, Array]:
    """Numbers (n,) and their covariance (n, n) at a moment, `keys` the variables that hold the parameters then.

    `end` is the same at the end, which `root` is about.
    """
    if layout.sizes[3] and set(keys.values()) == set(_keys_at(layout, keys, 0).values()):
        # The first node is among the shared unknowns, and has no numbers beside these.
        jacobian = end.jacobian.copy()
        jacobian[:, : layout.sizes[3]] = 0.0
        end = replace(end, jacobian=jacobian)
    known = layout.to_gtsam(values, keys.values())
    here = np.concatenate([p.coordinates(known, keys[p.key])[0] for p in problem.parameters])
    width = end.jacobian.shape[1] + 1
    padded = np.zeros((max(len(root), width), width))
    padded[: len(root)] = root
    found = end.root(padded)
    directions = WeakDirections.of(found.R, end.prior, end.calibrated)
    u = (here[end.free] - end.mean) / end.scale
    numbers = here.copy()
    numbers[end.free] += end.scale * constrained_step(directions, found.R, found.d, u)
    return numbers, end.covariance(directions.covariance())


def _keys_at(layout: Layout, own: Mapping[int, int], node: int) -> dict[int, int]:
    """Parameter key -> the variable that holds its value while a node is in force; `own`: at the end."""
    return {key: _at_node(layout, variable, node) for key, variable in own.items()}


def _at_node(layout: Layout, variable: int, node: int) -> int:
    """The variable of the same kind at a node; itself where it belongs to none."""
    (at,) = layout.at([variable])
    if layout.sizes[3] == 0 or layout.node[at] < 0:
        return variable
    alike = (layout.node == node) & ((layout.part == layout.part[at]) | (node == 0))
    return int(layout.key[np.flatnonzero(alike)[0]])


def smoothed_bias(
    layout: Layout, factorization: ChainFactorization, values: Values, node_time: Array, nodes: Index, part: slice
) -> History:
    """A walking bias over time from the whole recording: values and sigmas of nodes.

    Args:
        layout: of the variables.
        factorization: of the system at the values.
        values: the estimate.
        node_time: (k,) s at which the nodes begin.
        nodes: (k,) keys of the variables.
        part: numbers of a node that the bias is.
    """
    _, given = factorization.given_shared()
    roots, c, own = factorization.shared_roots, factorization.c, np.arange(part.start, part.stop)
    columns = layout.shared[layout.at(nodes[:1])][0] + own - part.start
    squares = given[:, own, own]
    squares[0] = 0.0  # the first node does not deviate from itself
    for last in np.split(roots, range(1, roots.shape[1]), axis=1):
        moved = factorization.propagate(last)[1][:, own, 0]
        moved[0] = 0.0
        squares = squares + np.square(moved + last[c + columns, 0])
    numbers = np.array([layout.of_key(values, int(key)) for key in nodes])
    return History(node_time, numbers, np.sqrt(squares))
