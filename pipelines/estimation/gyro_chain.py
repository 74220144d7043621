"""Attitudes at keyframes, joined by a gyro whose bias walks: what the graphs of several methods are built on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Index, Mask
from alidade.factors.gyro import GyroIncrementFactor, carried, corrected, platform_errors
from alidade.factors.preintegration import GyroPath, Increments
from alidade.pipelines.estimation.problem import ChainLayout, Factor, Parameter, Step
from alidade.pipelines.estimation.walking_bias import NODES, WalkingBias

# Of a problem whose states are a gyro chain's attitudes.
LAYOUT = ChainLayout(states="x", nodes=NODES)


@lru_cache(maxsize=1000)
def state(keyframe: int) -> int:
    """Key of the attitude (Rot3) at a keyframe."""
    return int(gtsam.symbol("x", keyframe))


def shared_keyframes(stamps: Array, origin: float, shared: float, longest: float) -> tuple[Array, Index]:
    """Times (K,) of keyframes, and index (K + 1,) of the first measurement of each; none in gaps.

    Measurements share one as long as they are within the same `shared` s, counted from `origin`; it is the one in their
    middle. None is farther than `longest`, s, from the next.
    """
    group = np.floor((stamps - origin) / shared) if shared > 0.0 else np.arange(len(stamps))
    begins = np.flatnonzero(np.diff(group, prepend=-1.0))
    middles = stamps[(begins + np.append(begins[1:], len(stamps)) - 1) // 2]
    bridges = [
        np.linspace(a, b, int(np.ceil((b - a) / longest)) + 1)[1:-1] for a, b in pairwise(middles) if b - a > longest
    ]
    time = np.concatenate([middles, *bridges])
    count = np.zeros(len(time), dtype=int)
    count[: len(middles)] = np.diff(begins, append=len(stamps))
    order = np.argsort(time, kind="stable")
    return time[order], np.append(0, np.cumsum(count[order]))


def as_slice(of: Index) -> Index | slice:
    """Convert consecutive indices to a slice, which indexes an array without a copy."""
    return slice(int(of[0]), int(of[-1]) + 1) if len(of) and (np.diff(of) == 1).all() else of


@dataclass(frozen=True)
class Trunk:
    """State of a chain at a keyframe, to continue the chain as a recording grows.

    Attributes:
        keyframe: number of its first keyframe in the recording.
        begun: (n,) s, where the nodes of the bias begin, the last in force there; empty at the start of a recording.
    """

    keyframe: int
    begun: Array


# Of a chain that begins with a recording that grows.
ROOT = Trunk(0, np.empty(0))


@dataclass(frozen=True)
class GyroChain:
    """Attitudes aRm at K keyframes, joined by gyro increments; m: gyro frame, a: inertial or platform frame.

    That frame is inertial, or turns with a platform that has a gyro of its own.

    Attributes:
        time: (K,) of the keyframes, s.
        starts: (K,) whether a new chain begins at a keyframe: no increment leads to it.
        initial: (K, 4) first guess of the attitudes.
        gyro: integrated with the first guess of the bias taken off.
        turns: (K - 1,) increments from keyframe to keyframe.
        variance: (K - 1,) of each, rad^2 per axis, what the sensors do not see in gaps included.
        unseen: (K - 1,) part of it that is no noise: what the sensors may have turned in gaps of their records.
        bias: its nodes over the keyframes.
        nodes: (K,) whole numbers: the node in force up to each keyframe.
        errors: of the gyro, as alidade.factors.gyro has them; None: perfect.
        platform, platform_turns: the platform's gyro and its increments; None in an inertial frame.
        platform_errors: of that gyro, its bias first; None: perfect.
        first: number of the first keyframe in the recording, where the chain is over its end alone.
        share: of the increments' white variance that is the gyro's own, not the platform's.
    """

    time: Array
    starts: Mask
    initial: Array
    gyro: GyroPath
    turns: Increments
    variance: Array
    unseen: Array
    bias: WalkingBias
    nodes: Index
    errors: Parameter | None = None
    platform: GyroPath | None = None
    platform_turns: Increments | None = None
    platform_errors: Parameter | None = None
    first: int = 0
    share: float = 1.0

    @classmethod
    def over(
        cls,
        time: Array,
        starts: Mask,
        initial: Array,
        gyro: GyroPath,
        *,
        density: float,
        other_density: float = 0.0,
        walk: float,
        errors: Parameter | None = None,
        platform: GyroPath | None = None,
        platform_errors: Parameter | None = None,
        trunk: Trunk | None = None,
    ) -> GyroChain:
        """Build a chain over keyframes, with integrated gyro increments and bias nodes.

        Args:
            time, starts, initial, gyro: as above.
            density: of the gyro's white noise, rad/s/sqrt(Hz).
            other_density: what else an increment is uncertain by, as of another gyro that it is made relative to.
            walk: of the bias, rad/s/sqrt(s).
            errors, platform, platform_errors: as above.
            trunk: of a recording that grows, where the first keyframe is known already; None: the whole is there.
        """
        turns = gyro.increments(time[:-1], time[1:], scale=errors is not None)
        gyro.forget_blocks()
        unseen, platform_turns = turns.unseen, None
        if platform is not None:
            platform_turns = platform.increments(time[:-1], time[1:], scale=platform_errors is not None)
            platform.forget_blocks()
            unseen = unseen + platform_turns.unseen
        middles = np.where(starts, time, 0.5 * (time + np.roll(time, 1)))
        begun = None if trunk is None else time[:1]
        if trunk is not None and len(trunk.begun):
            begun, middles[0] = trunk.begun, trunk.begun[-1]
        bias = WalkingBias.over(time[0], time[-1], middles, walk, density, begun)
        return cls(
            time=time,
            starts=starts,
            initial=initial,
            gyro=gyro,
            turns=turns,
            variance=(density**2 + other_density**2) * turns.duration + unseen,
            unseen=unseen,
            bias=bias,
            nodes=bias.node_at(middles),
            errors=errors,
            platform=platform,
            platform_turns=platform_turns,
            platform_errors=platform_errors,
            first=0 if trunk is None else trunk.keyframe,
            share=density**2 / max(density**2 + other_density**2, 1e-300),
        )

    def trunk(self, time: float) -> Trunk | None:
        """State at a keyframe, to continue the chain as the recording grows; None if no keyframe has this time."""
        k = int(np.searchsorted(self.time, time))
        if k == len(self.time) or self.time[k] != time:
            return None
        return Trunk(self.first + k, self.bias.edges[: self.nodes[k] + 1])

    def state(self, keyframe: int) -> int:
        """Key of the attitude (Rot3) at a keyframe."""
        return state(self.first + keyframe)

    def numbers(self, keyframes: range) -> range:
        """Convert keyframes of this chain to their numbers in the whole recording."""
        return range(self.first + keyframes.start, self.first + keyframes.stop)

    def bias_keys(self, keyframes: Sequence[int] | Index) -> list[int]:
        """Keys of the gyro bias in force up to each of the keyframes."""
        nodes = self.nodes[keyframes].tolist()
        keys = {n: self.bias.key(n) for n in set(nodes)}
        return [keys[n] for n in nodes]

    @property
    def error_keys(self) -> list[int]:
        """Keys of the gyros' error variables, the last blocks of every factor with gyro increments."""
        return [p.key for p in (self.errors, self.platform_errors) if p is not None]

    def add(self, step: Step, keyframes: range) -> None:
        """Add the attitudes at keyframes, the increments to these, and the bias nodes that begin there.

        What determines the attitude at the start of a chain, and the first bias, is the caller's to add.
        """
        nodes, means = self._nodes_to_add(keyframes)
        for node in nodes:
            self.bias.begin(step, node, self.gyro.bias_hat)
        for node in means:
            self.bias.end(step, node, self.gyro.bias_hat)
        now = int(self.nodes[keyframes[-1]])
        if self.bias.nodes > 1:
            last = keyframes.stop == len(self.time)
            step.current_keys[self.bias.key(0)] = self.bias.mean_key(now) if last else self.bias.key(now)
            before = max(nodes.start - 1, 0)
            self.bias.keep(step, range(before, now + 1), range(max(before - 1, 0), means.stop))
        for k in keyframes:
            key = self.state(k)
            step.initial.insert(key, so3.to_gtsam(self.initial[k]))
            step.timestamps[key] = float(self.time[k])
        after = np.array([k for k in keyframes if not self.starts[k]], dtype=np.intp)
        if len(after):
            step.factors.extend(self._increments(after))

    def _nodes_to_add(self, keyframes: range) -> tuple[range, range]:
        """Bias nodes that begin at the keyframes, and bias nodes whose mean is complete with the keyframes."""
        first = 0 if keyframes.start == 0 else int(self.nodes[keyframes.start - 1]) + 1
        now = int(self.nodes[keyframes[-1]])
        last = keyframes.stop == len(self.time)
        return range(first, now + 1), range(max(first - 1, 1), now + 1 if last else now)

    def _increments(self, after: Index) -> list[Factor]:
        """Gyro increment factors from each keyframe's predecessor."""
        states = [self.state(k - 1) for k in after], [self.state(k) for k in after]
        bias, turns, variance = self.bias_keys(after), self.turns[as_slice(after - 1)], self.variance[after - 1]
        carrying = None if self.platform_turns is None else self.platform_turns[as_slice(after - 1)]
        errors = 0 if self.errors is None else len(self.errors.quantities)
        model = GyroIncrementFactor(
            self.time[as_slice(after)], turns, self.gyro, np.sqrt(variance), carrying, self.platform, self.share, errors
        )
        turned = np.linalg.norm(so3.log(turns.wxyz), axis=1)
        beside, fixed = turned / np.sqrt(turns.duration * variance), self.unseen[after - 1] / variance
        return [Factor.process_of("gyro", model.on(*states, bias, *self.error_keys), beside, fixed)]

    def predict(
        self, keyframes: range, seen: Callable[[int, gtsam.Values], Array], current: gtsam.Values
    ) -> gtsam.Values:
        """Initial values of the variables of `add`: attitudes propagated by the gyro, biases unchanged.

        Args:
            keyframes: the step's, not the first one.
            seen: attitude (4,) at a keyframe that starts a chain, from the current estimate.
            current: the estimate.
        """
        out = gtsam.Values()
        nodes, means = self._nodes_to_add(keyframes)
        bias = current.atVector(self.bias.key(nodes.start - 1))
        for key in [*map(self.bias.key, nodes), *map(self.bias.mean_key, means)]:
            out.insert(key, bias)
        carried_by, turned = self._turned(keyframes, bias, current)
        attitude = so3.identity()
        if not self.starts[keyframes.start]:
            attitude = so3.from_gtsam([current.atRot3(self.state(keyframes.start - 1))])[0]
        for k, carrier, turn in zip(keyframes, so3.inverse(carried_by), turned, strict=True):
            attitude = seen(k, current) if self.starts[k] else so3.compose(carrier, attitude, turn)
            out.insert(self.state(k), so3.to_gtsam(attitude))
        return out

    def _turned(self, keyframes: range, bias: Array, values: gtsam.Values) -> tuple[Array, Array]:
        """Corrected increments (n, 4) of platform and gyro, from each keyframe's predecessor, at the values."""
        n, rows = len(keyframes), slice(keyframes.start - 1, keyframes.stop - 1)
        errors, platform = self._errors(values, n)
        turned, _ = corrected(self.turns[rows], np.tile(bias - self.gyro.bias_hat, (n, 1)), errors)
        if self.platform is None or self.platform_turns is None:
            return so3.identity(n), turned
        platform_bias, scale = platform_errors(self.platform, platform, n)
        return corrected(self.platform_turns[rows], platform_bias - self.platform.bias_hat, scale)[0], turned

    def _errors(self, values: gtsam.Values, n: int) -> tuple[Array | None, Array | None]:
        """Error parameters (n, .) of gyro and platform gyro, in n equal rows; None for an ideal gyro."""
        own, platform = (
            None if p is None else np.broadcast_to(values.atVector(p.key), (n, len(p.quantities)))
            for p in (self.errors, self.platform_errors)
        )
        return own, platform

    def attitudes(self, keyframes: Index, stamps: Array, at: Array, values: gtsam.Values) -> Array:
        """Attitudes (n, 4) at times near keyframes, propagated from the keyframes' values.

        Args:
            keyframes: (n,) whose attitude is carried to each time.
            stamps: (n,) s, the times as first thought, between which and the keyframes the errors are evaluated.
            at: (n,) s, the times.
            values: an estimate.
        """
        n, start = len(at), self.time[keyframes]
        middle = 0.5 * (start + stamps)
        errors, platform = self._errors(values, n)
        bias = np.array([values.atVector(key) for key in self.bias_keys(keyframes)]).reshape(n, 3)
        attitude = so3.from_gtsam([values.atRot3(self.state(k)) for k in keyframes])
        attitude = so3.multiply(attitude, carried(self.gyro, start, middle, at, bias, errors)[0])
        if self.platform is None:
            return attitude
        carrier, *_ = carried(self.platform, start, middle, at, *platform_errors(self.platform, platform, n))
        return so3.multiply(so3.inverse(carrier), attitude)
