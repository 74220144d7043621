"""What an indexer calibration is worth: the attitude put out, and the mean rates of the turns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.gyro import symmetric
from alidade.factors.indexer import mounting
from alidade.pipelines.diagnostics.cross_validation import Validation
from alidade.pipelines.estimation.problem import Array
from alidade.pipelines.methods.indexer.attitude import carrier
from alidade.pipelines.methods.indexer.groups import Group, groups_of
from alidade.pipelines.methods.indexer.parameters import BIAS, ENCODER, EPSILON, ERRORS, TEMPERATURE, THETA, several
from alidade.pipelines.methods.indexer.recording import IndexerData
from alidade.pipelines.methods.indexer.runs import AxisMotion, axis_motion
from alidade.pipelines.methods.indexer.topics import IndexerConfig
from alidade.pipelines.methods.temperature import FIRST
from alidade.pipelines.settings import Config


def validate(data: IndexerData, config: Config, values: Mapping[str, float]) -> list[Validation]:
    """Errors without and with a calibration: of the attitude put out, where there is one, and of the turns' mean rates.

    The carrier's attitude is nRb = nRm mRt tRb(outer, inner), without calibration mRt = identity and perpendicular
    axes; the carrier is the indexer's base and stands still at the config's `indexer.base_attitude`.

    Args:
        data: the session, with the attitude nRm that the INS puts out, or without.
        config: of the session.
        values: calibrated parameters by name; those not named are zero.

    Raises:
        InputError: the axes hardly turn.
    """
    motion = axis_motion(data)
    turning = [g for g in groups_of(data, config, motion) if g.position is not None]
    time, before = misfit(turning, {})
    after = misfit(turning, values)[1]
    found = [Validation("axis by mean rates, turn by turn", "rad", time, before, after)]
    if data.attitude is not None:
        rows = np.flatnonzero((data.gyro_t >= motion.t[0]) & (data.gyro_t <= motion.t[-1]))
        bRn = so3.inverse(np.array(config.section(IndexerConfig).base_attitude))
        errors = [so3.log(so3.multiply(bRn, _carrier(data, motion, rows, some))) for some in ({}, values)]
        claim = "the publication claims 0.005 deg over an hour"
        found.insert(0, Validation("attitude put out", "rad", data.gyro_t[rows], errors[0], errors[1], claim))
    return found


def _carrier(data: IndexerData, motion: AxisMotion, rows: NDArray[np.intp], values: Mapping[str, float]) -> Array:
    """The carrier's attitude at gyro samples, by calibrated parameters."""
    epsilon = float(several(values, EPSILON)[0])
    return carrier(data, motion, rows, several(values, THETA), epsilon, several(values, ENCODER))


def misfit(groups: Sequence[Group], values: Mapping[str, float]) -> tuple[Array, Array]:
    """Ends (n,) of the groups, s, and their mean rates less what encoders and earth say, over the rate, (n, 3) in t.

    Args:
        groups: in which an axis turns.
        values: parameters by name; those not named are zero.
    """
    tRm, bias, gain = (
        mounting(several(values, THETA)),
        several(values, BIAS),
        np.eye(3) + symmetric(several(values, ERRORS)),
    )
    epsilon, encoder = several(values, EPSILON), several(values, ENCODER)
    slope = several(values, TEMPERATURE.names)
    errors = []
    for group in groups:
        share = np.diff(group.rates.edges) / group.duration
        fixed, cosine, sine = np.moveaxis(group.rates.parts(encoder), 1, 0)
        expected = share @ (fixed + np.cos(epsilon) * cosine + np.sin(epsilon) * sine)
        warmth = group.warmth(values.get(FIRST))
        drift = bias if warmth is None else bias + share @ warmth * slope
        found = so3.rotate(tRm, np.linalg.solve(gain, group.mean_gyro - drift))
        errors.append((found - expected) / np.linalg.norm(expected))
    return np.array([float(g.rates.edges[-1]) for g in groups]), np.array(errors).reshape(-1, 3)
