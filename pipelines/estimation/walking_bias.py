"""A gyro bias that walks, with its mean over the session as the reported parameter.

The bias is constant over segments, one node each, joined by the random walk. A second chain carries the mean of the
bias up to the end of each segment, so that batch and smoothers with a window report the same session mean without
holding every node.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from alidade.factors.array import Array, Index
from alidade.pipelines.estimation.priors import linear_factor
from alidade.pipelines.estimation.problem import Factor, Step

# The bias walk over a segment moves the angle by this fraction of what gyro noise does ...
_FRACTION = 0.2
# ... and is never longer than this, s, so that the bias over time can be seen.
_LONGEST = 10.0
# The last segment is at least this share of the others, and as much longer at most.
_SHORTEST = 0.1
# What follows without error, a bias that does not walk and the mean of the nodes, is given these shares of what gyro
# noise leaves unknown of a segment's bias, which keeps the arithmetic well conditioned.
_SLACK = 1e-4
_MEAN_SLACK = 1e-2

# The first segment's node, which is the whole bias where it does not walk.
FIRST = int(gtsam.symbol("b", 0))


# Letters of the symbols of nodes and of running means.
NODES = "bm"


@dataclass(frozen=True)
class WalkingBias:
    """Random walk of a gyro bias, piecewise constant: one node for each segment.

    Attributes:
        edges: (J + 1,) s, ends of the segments.
        walk: rad/s/sqrt(s).
        density: of the gyro's white noise, rad/s/sqrt(Hz).
        stop: s, where the last segment really ends.
    """

    edges: Array
    walk: float
    density: float
    stop: float

    @classmethod
    def over(
        cls, start: float, stop: float, middles: Array, walk: float, density: float, begun: Array | None = None
    ) -> WalkingBias:
        """Divide a recording into segments short enough for the walk to stay below the gyro noise.

        All are of one length, so that those behind stay as they are while a recording grows; but one that holds none
        of the times at which the bias is asked for is part of the segment before it.

        Args:
            start, stop: s.
            middles: (n,) s, the times at which `node_at` will be asked, increasing; every node is in force at one.
            walk, density: as above.
            begun: (n,) s, where the nodes before begin in a recording that still grows, the one in force at `start`
                the last: the others follow, and the last of all is as short as it may be, so that it does not change.
        """
        known = np.array([start]) if begun is None else begun
        if walk <= 0.0:
            return cls(np.array([known[0], stop]), 0.0, density, stop)
        length = max(min(_LONGEST, _FRACTION * np.sqrt(3.0) * density / walk), 1e-3)
        count = max(1, int(np.ceil((stop - known[-1]) / length - (_SHORTEST if begun is None else 0.0))))
        edges = known[-1] + length * np.arange(count + 1)
        asked = np.unique(np.searchsorted(edges[1:-1], middles, side="right"))
        new = asked[1:] if begun is None else asked[asked > 0]
        return cls(np.concatenate([known, edges[new], edges[count:]]), walk, density, stop)

    @property
    def nodes(self) -> int:
        """Number of bias nodes."""
        return len(self.edges) - 1

    def node_at(self, time: Array) -> Index:
        """Index of the node in force at given times."""
        return np.clip(np.searchsorted(self.edges, time, side="right") - 1, 0, self.nodes - 1)

    def key(self, node: int) -> int:
        """Key of the variable of a node, (3,) rad/s."""
        return int(gtsam.symbol("b", node))

    def mean_key(self, node: int) -> int:
        """Key of the mean bias up to the end of a node's segment; the first node is its own mean."""
        return self.key(0) if node == 0 else int(gtsam.symbol("m", node))

    def begin(self, step: Step, node: int, guess: Array) -> None:
        """Add a node to a step, with `guess` (3,) rad/s; the caller adds factors that determine the first node."""
        step.initial.insert(self.key(node), guess)
        if node > 0:
            spacing = 0.5 * (self.edges[node + 1] - self.edges[node - 1])
            sigma = float(np.hypot(self.walk * np.sqrt(spacing), _SLACK * self._unknown(spacing)))
            blocks = {self.key(node - 1): -np.eye(3), self.key(node): np.eye(3)}
            step.factors.append(Factor.process_of("bias walk", linear_factor(blocks, sigma)))

    def end(self, step: Step, node: int, guess: Array) -> None:
        """Add the mean bias up to the end of a node's segment to a step; the first node is its own mean."""
        if node == 0:
            return
        end = self.stop if node == self.nodes - 1 else self.edges[node + 1]
        whole, segment = end - self.edges[0], end - self.edges[node]
        share = float(segment / whole)
        # Within the segment the walk's own mean departs from the node's constant by this much.
        departure = self.walk * np.sqrt(segment / 12.0) * share
        sigma = float(np.hypot(departure, _MEAN_SLACK * self._unknown(segment) * share))
        blocks = {self.mean_key(node): 1.0, self.mean_key(node - 1): share - 1.0, self.key(node): -share}
        factor = linear_factor({key: scale * np.eye(3) for key, scale in blocks.items()}, sigma)
        step.initial.insert(self.mean_key(node), guess)
        step.factors.append(Factor.process_of("definition", factor))

    def keep(self, step: Step, nodes: range, means: range) -> None:
        """Keep nodes and means in a smoother's window until the step's time; a single node never leaves it."""
        if self.nodes > 1:
            keys = [*map(self.key, nodes), *map(self.mean_key, means)]
            step.timestamps.update(dict.fromkeys(keys, step.time))

    def _unknown(self, segment: float) -> float:
        """Sigma of a segment's mean bias by gyro noise alone, rad/s; `segment` in s."""
        return self.density / float(np.sqrt(segment))
