"""Attitudes at keyframes, joined by a gyro whose bias walks: what the graphs of several methods are built on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import so3
from factors.attitude import ahrs_factors
from factors.preintegration import GyroPath, Increments
from pipelines.graph.problem import Array, Factor, Step
from pipelines.graph.walking_bias import WalkingBias


def state(keyframe: int) -> int:
    """Variable of the attitude at a keyframe, Rot3."""
    return int(gtsam.symbol("x", keyframe))


@dataclass(frozen=True)
class GyroChain:
    """Attitudes aRm at K keyframes: m the gyro, a a frame that a chain of increments holds on to.

    Attributes:
        time: (K,) of the keyframes, s.
        starts: (K,) whether a new chain begins at a keyframe: no increment leads to it.
        initial: (K, 4) first guess of the attitudes.
        gyro: integrated with the first guess of the bias taken off.
        turns: (K - 1,) increments from keyframe to keyframe.
        variance: (K - 1,) of each, rad^2 per axis.
        bias: its nodes over the keyframes.
        nodes: (K,) whole numbers: the node in force up to each keyframe.
    """

    time: Array
    starts: NDArray[np.bool_]
    initial: Array
    gyro: GyroPath
    turns: Increments
    variance: Array
    bias: WalkingBias
    nodes: NDArray[np.intp]

    @classmethod
    def over(
        cls,
        time: Array,
        starts: NDArray[np.bool_],
        initial: Array,
        gyro: GyroPath,
        *,
        density: float,
        other_density: float = 0.0,
        walk: float,
        scale_error: float,
    ) -> GyroChain:
        """A chain over keyframes.

        Args:
            time, starts, initial, gyro: as above.
            density: of the gyro's white noise, rad/s/sqrt(Hz).
            other_density: what else an increment is uncertain by, as of another gyro that it is made relative to.
            walk: of the bias, rad/s/sqrt(s).
            scale_error: sigma of an increment per angle turned.
        """
        turns = gyro.increments(time[:-1], time[1:])
        by_scale = scale_error * np.linalg.norm(so3.log(turns.wxyz), axis=1)
        middles = np.where(starts, time, 0.5 * (time + np.roll(time, 1)))
        bias = WalkingBias.over(time[0], time[-1], middles, walk, density)
        return cls(
            time=time,
            starts=starts,
            initial=initial,
            gyro=gyro,
            turns=turns,
            variance=(density**2 + other_density**2) * turns.duration + by_scale**2 + turns.unseen,
            bias=bias,
            nodes=bias.node_at(middles),
        )

    def bias_keys(self, keyframes: Sequence[int] | NDArray[np.intp]) -> list[int]:
        """Variables of the bias in force up to keyframes."""
        return [self.bias.key(int(n)) for n in self.nodes[keyframes]]

    def add(self, step: Step) -> None:
        """The attitudes at a step's keyframes, the increments that lead there, and the bias nodes that begin with them.

        What determines the attitude at the start of a chain, and the first bias, is the caller's to add.
        """
        nodes, means = self._new(step.keyframes)
        for node in nodes:
            self.bias.begin(step, node, self.gyro.bias_hat)
        for node in means:
            self.bias.end(step, node, self.gyro.bias_hat)
        now = int(self.nodes[step.keyframes[-1]])
        if self.bias.nodes > 1:
            last = step.keyframes.stop == len(self.time)
            step.current_keys[self.bias.key(0)] = self.bias.mean_key(now) if last else self.bias.key(now)
            before = max(nodes.start - 1, 0)
            self.bias.keep(step, range(before, now + 1), range(max(before - 1, 0), means.stop))
        for k in step.keyframes:
            step.initial.insert(state(k), so3.to_gtsam(self.initial[k]))
            step.timestamps[state(k)] = float(self.time[k])
        step.factors.extend(self._increments([k for k in step.keyframes if not self.starts[k]]))

    def _new(self, keyframes: range) -> tuple[range, range]:
        """The bias nodes that begin with keyframes, and those that end, so that the mean up to there is defined."""
        first = 0 if keyframes.start == 0 else int(self.nodes[keyframes.start - 1]) + 1
        now = int(self.nodes[keyframes[-1]])
        last = keyframes.stop == len(self.time)
        return range(first, now + 1), range(max(first - 1, 1), now + 1 if last else now)

    def _increments(self, after: list[int]) -> list[Factor]:
        """Those that lead to keyframes, gtsam's native factors."""
        ends = np.array(after, dtype=np.intp)
        native = ahrs_factors(
            [state(k - 1) for k in after],
            [state(k) for k in after],
            self.bias_keys(ends),
            self.turns[ends - 1],
            self.gyro.bias_hat,
            self.variance[ends - 1],
        )
        return [Factor("gyro", f) for f in native]

    def predict(
        self, keyframes: range, seen: Callable[[int, gtsam.Values], Array], current: gtsam.Values
    ) -> gtsam.Values:
        """What `add` adds, from the current estimate: attitudes carried by the gyro, biases carried over.

        Args:
            keyframes: the step's, not the first one.
            seen: attitude (4,) at a keyframe that starts a chain, from the current estimate.
            current: the estimate.
        """
        out = gtsam.Values()
        nodes, means = self._new(keyframes)
        bias = current.atVector(self.bias.key(nodes.start - 1))
        for key in [*map(self.bias.key, nodes), *map(self.bias.mean_key, means)]:
            out.insert(key, bias)
        for k in keyframes:
            if self.starts[k]:
                attitude = seen(k, current)
            else:
                before = (out if out.exists(state(k - 1)) else current).atRot3(state(k - 1))
                turn = self.turns[k - 1]
                correction = so3.exp(turn.bias_jacobian @ (bias - self.gyro.bias_hat))
                attitude = so3.compose(so3.from_gtsam([before])[0], turn.wxyz, correction)
            out.insert(state(k), so3.to_gtsam(attitude))
        return out
