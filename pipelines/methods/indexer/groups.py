"""Groups of adjoining windows of an indexer recording, and what gyro and encoders say in each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from alidade.factors import so3
from alidade.factors.earth import earth_rate
from alidade.factors.indexer import AxisPath, PlatformRates, gyro_edges, gyro_means
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.runs import AxisMotion, Run
from alidade.pipelines.methods.indexer.topics import IndexerConfig
from alidade.pipelines.settings import Config

# Windows end where the driven axes have turned by this much, rad: short enough to see the earth's rate come and go.
_WINDOW_ANGLE = np.pi / 4
# Less than this over, rad, does not make a window of its own.
_CRUMB = 2e-3
# Encoder samples that a dwell leaves to the motion after it.
_DWELL_MARGIN = 5.0
# Groups and windows of fewer gyro samples than this are the crumbs of rounding.
_FEWEST_SAMPLES = 4
# The other axis stands at the same angle when it differs by less than half of this, deg.
_SAME_ANGLE_DEG = 5.0

# Whole turns, less than these, and rests.
KINDS = ("turn", "move", "dwell")


@dataclass(frozen=True)
class Group:
    """Adjoining windows of one run and what was measured in them.

    Attributes:
        kind: "turn" for a whole turn, "move" for less, "dwell".
        run: the run it is part of.
        gyro: (n, 3) mean rates in m, rad/s.
        rates: the platform's mean rates.
        celsius: (n,) mean temperatures, degrees Celsius; None where nobody measures them.
    """

    kind: str
    run: Run
    gyro: Array
    rates: PlatformRates
    celsius: Array | None = None

    @property
    def duration(self) -> float:
        """Length, s."""
        return float(self.rates.edges[-1] - self.rates.edges[0])

    @property
    def mean_gyro(self) -> Array:
        """(3,) mean rate over the whole group, rad/s."""
        return np.asarray(np.diff(self.rates.edges) @ self.gyro / self.duration)

    def warmth(self, reference: float | None) -> Array | None:
        """Mean temperatures (n,) above another, degrees Celsius, K; None where nobody measures them."""
        return None if self.celsius is None or reference is None else self.celsius - reference

    @property
    def mean_platform(self) -> Array:
        """(3,) mean rate of the platform over the whole group with perpendicular axes, in t, rad/s."""
        return np.asarray(np.diff(self.rates.edges) @ (self.rates.fixed + self.rates.cosine) / self.duration)

    @property
    def position(self) -> tuple[str, int] | None:
        """The axis that turns and at which angle the other stands, in steps; None when not one axis turns alone."""
        if self.run.axis not in ("outer", "inner"):
            return None
        steps = round(360.0 / _SAME_ANGLE_DEG)
        return self.run.axis, round(np.rad2deg(self.run.other) / _SAME_ANGLE_DEG) % steps


def groups_of(data: IndexerData, config: Config, motion: AxisMotion, split: bool = True) -> tuple[Group, ...]:
    """The groups of a recording in time order; none shares an encoder sample with another."""
    nRbase = np.array(config.section(IndexerConfig).base_attitude)
    latitude = data.latitude_deg
    earth = np.zeros(3) if latitude is None else earth_rate(np.deg2rad(latitude))
    path = AxisPath(motion.t, motion.angles[:, 0], motion.angles[:, 1], so3.rotate(so3.inverse(nRbase), earth))
    edges = gyro_edges(data.gyro_t)
    middles = 0.5 * (edges[1:] + edges[:-1])
    celsius = temperature.above(data.temperature, 0.0, data.gyro_t)
    groups: list[Group] = []
    free_from = before = -np.inf
    for run in motion.runs:
        if run.start > before:  # behind a gap, all samples are new
            free_from = -np.inf
        before = run.stop
        for kind, borders in _borders(motion, run):
            # The sample edges nearest to the borders, within what the run and the group before leave.
            first = np.searchsorted(edges, max(run.start, free_from))
            last = np.searchsorted(edges, run.stop, side="right") - 1
            if last - first < _FEWEST_SAMPLES:
                continue
            nearest = np.searchsorted(middles, borders if split else borders[[0, -1]])
            cuts = np.unique(np.clip(nearest, first, last))
            cuts = cuts[np.concatenate([[True], np.diff(cuts) >= _FEWEST_SAMPLES])]
            if len(cuts) < 2:
                continue
            mean = None if celsius is None else gyro_means(edges, celsius[:, None], cuts)[:, 0]
            groups.append(Group(kind, run, gyro_means(edges, data.gyro, cuts), path.rates(edges[cuts]), mean))
            # The angle at the last edge is made of the two encoder samples on either side of it, and so is that at
            # the first edge of the next group.
            after = np.searchsorted(motion.t, edges[cuts[-1]], side="right") + 3
            free_from = motion.t[min(after, len(motion.t) - 1)]
    return tuple(groups)


def _borders(motion: AxisMotion, run: Run) -> Iterator[tuple[str, Array]]:
    """For each group of a run its kind and the times at which its windows begin and end."""
    if run.axis == "none":
        # Ends early enough for the motion that follows to start where it does.
        yield "dwell", np.array([run.start, run.stop - _DWELL_MARGIN * float(np.median(np.diff(motion.t)))])
        return
    first, last = np.searchsorted(motion.t, [run.start, run.stop])
    rows = slice(first, last + 1)
    t, angles = motion.t[rows], motion.angles[rows]
    driven = {"outer": [0], "inner": [1]}.get(run.axis, [0, 1])
    path = np.maximum.accumulate(np.abs(angles[:, driven] - angles[0, driven]).sum(axis=1))
    # The ends are the run's, at rest; a crossing searched for in a resting encoder would pick its noise.
    levels = np.arange(_WINDOW_ANGLE, path[-1] - _CRUMB, _WINDOW_ANGLE)
    borders = np.concatenate([[run.start], np.interp(levels, path, t), [run.stop]])
    per_turn = round(2.0 * np.pi / _WINDOW_ANGLE)
    for first in range(0, len(borders) - 1, per_turn):
        turned = path[-1] - first * _WINDOW_ANGLE
        yield "turn" if turned > 2.0 * np.pi - _CRUMB else "move", borders[first : first + per_turn + 1]
