"""A recording of two gyros as arrays, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import check_overlap, nanoseconds
from alidade.pipelines.recording.mcap_writer import attached, write_session
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Numbers, Vectors
from alidade.pipelines.recording.streams import StreamReader
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given
from gyro_pair.topics import GYRO_A, GYRO_B, GyroPairConfig

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GyroPairData:
    """What two gyros measured. Times are stamps, s from epoch_ns (Unix ns), strictly increasing.

    a_t (N,), a_gyro (N, 3) rad/s: gyro a, in its frame a; b_t (M,), b_gyro (M, 3): gyro b, in b. a_density, b_density,
    rad/s/sqrt(Hz): from the covariances of the messages, None if they say nothing. dropped: reason -> messages.
    """

    epoch_ns: int
    a_t: Numbers
    a_gyro: Vectors
    b_t: Numbers
    b_gyro: Vectors
    a_density: float | None = None
    b_density: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)


def densities(data: GyroPairData, config: Config) -> tuple[float, float]:
    """Noise of a and b, rad/s/sqrt(Hz): of the config, else of the messages, else the default."""
    own = config.section(GyroPairConfig)
    return (
        first_given(config.noise.gyro_density, data.a_density, DEFAULT_NOISE.gyro_density),
        first_given(own.gyro_b_density, data.b_density, DEFAULT_NOISE.gyro_density),
    )


def read_gyro_pair(recording: Recording, config: Config) -> GyroPairData:
    """Read and check both gyros.

    Raises InputError when a topic is missing or unusable, and when the two have no time in common.
    """
    a, b = config.topic(GYRO_A), config.topic(GYRO_B)
    reader = StreamReader(recording, {a: (), b: ()})
    of_a, of_b = (reader.gyro(name, may_be_constant=True) for name in (a, b))
    check_overlap({a: of_a.t, b: of_b.t})
    densities = reader.density(a, "gyro", of_a), reader.density(b, "gyro", of_b)
    return GyroPairData(reader.epoch_ns, of_a.t, of_a.series.gyro, of_b.t, of_b.series.gyro, *densities, reader.dropped)


def write_gyro_pair(
    path: Path, data: GyroPairData, truth: Mapping[str, float], config: str, _pictures: None = None
) -> None:
    """Write simulated data under the default topic names, with truth and config attached.

    Stamps are rounded to ns. read_gyro_pair gives the same data back if the first sample is the one at t = 0.
    """

    def imu(t: Array, gyro: Array, density: float | None, frame: str) -> series.ImuSeries:
        variance = 0.0 if density is None else density**2 / np.median(np.diff(t))
        return series.ImuSeries(nanoseconds(t, data.epoch_ns), gyro, gyro_cov=variance * np.eye(3), frame_id=frame)

    topics: dict[str, series.Topic] = {
        GYRO_A.name: imu(data.a_t, data.a_gyro, data.a_density, "a"),
        GYRO_B.name: imu(data.b_t, data.b_gyro, data.b_density, "b"),
    }
    write_session(path, topics, attached(truth, config))
