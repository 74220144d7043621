"""A recording of the indexer method as arrays, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.indexer import parameters
from alidade.pipelines.methods.indexer.topics import INDEXER, JOINTS
from alidade.pipelines.recording import series
from alidade.pipelines.recording.checks import (
    LEAST_GYRO,
    check_overlap,
    clean,
    count,
    nanoseconds,
    unit_quaternions,
)
from alidade.pipelines.recording.gyro import usable
from alidade.pipelines.recording.mcap_writer import attached, write_session
from alidade.pipelines.recording.placeholders import density
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Numbers, Quaternions, Vectors
from alidade.pipelines.recording.temperature import Temperature
from alidade.pipelines.recording.topics import FIX, IMU, wanted
from alidade.pipelines.settings import Config

Array = NDArray[np.float64]


@dataclass(frozen=True)
class IndexerData:
    """What an indexer session has measured. Times are s from epoch_ns (Unix ns), strictly increasing.

    gyro_t (N,), gyro (N, 3) rad/s: rate w_im of the IMU on the indexer, in m. encoder_t (M,), outer (M,), inner (M,)
    rad: axis angles as recorded, wrapped or continuous. latitude_deg: from /fix or the config, None if unknown.
    attitude (N, 4): nRm as the INS puts it out with each gyro sample, unit, or None. gyro_density, rad/s/sqrt(Hz): from
    the covariances of the messages, None if they have none. dropped: reason -> messages. stamp_sigma, s: how well the
    stamps are known. temperature: of the IMU, None where nobody measures it.
    """

    epoch_ns: int
    gyro_t: Numbers
    gyro: Vectors
    encoder_t: Numbers
    outer: Numbers
    inner: Numbers
    latitude_deg: float | None
    attitude: Quaternions | None = None
    gyro_density: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    stamp_sigma: float = 0.0
    temperature: Temperature | None = None


def read_indexer(recording: Recording, config: Config) -> IndexerData:
    """Read and check an indexer session.

    Raises InputError when a topic is missing or unusable, see alidade.pipelines.recording.checks, and when gyro and
    encoders have no time in common. A missing latitude is left to the method, which knows whether it is needed.
    """
    dropped: dict[str, int] = {}
    epoch = recording.epoch_ns
    imu_topic, encoder_topic = config.topic(IMU), config.topic(INDEXER)
    recording.read_together({imu_topic: (), encoder_topic: JOINTS, config.topic(FIX): ()})
    imu = recording.imu(imu_topic)
    gyro_t, keep = usable(imu_topic, imu, epoch, dropped, least=3)
    gyro = imu.gyro[keep]
    attitude, wxyz = None, imu.wxyz[keep]
    # A message that does not say it has zeros, one value, or NaN.
    if (imu.wxyz_cov[keep, 0, 0] >= 0.0).all() and np.isfinite(wxyz).all() and np.ptp(wxyz, axis=0).any():
        attitude = unit_quaternions(imu_topic, gyro_t, wxyz)

    joints = recording.joints(encoder_topic, JOINTS)
    count(dropped, f"{encoder_topic}: stamped by log time (kept)", joints.stamped_by_log)
    count(dropped, f"{encoder_topic}: without both joints", joints.without)
    encoder_t, used = clean(encoder_topic, joints.t_ns, epoch, joints.position, dropped, least=3)
    outer, inner = joints.position[used].T
    check_overlap({imu_topic: gyro_t, encoder_topic: encoder_t})
    return IndexerData(
        epoch,
        gyro_t,
        gyro,
        encoder_t,
        outer,
        inner,
        _latitude(recording, config),
        attitude,
        density(imu_topic, "gyro", gyro_t, imu.gyro_cov[keep], LEAST_GYRO, dropped),
        dropped,
        recording.stamp_sigma_s,
        temperature.read(recording, config, (parameters.TEMPERATURE,), gyro_t, dropped),
    )


def write_indexer(
    path: Path | str, data: IndexerData, truth: Mapping[str, float] | None = None, config_yaml: str | None = None
) -> None:
    """Write an indexer session under the default topic names, with its truth and config as attachments.

    Stamps are rounded to ns. read_indexer gives the same data back if the first sample is the one at t = 0.
    """
    gyro_ns, encoder_ns = nanoseconds(data.gyro_t, data.epoch_ns), nanoseconds(data.encoder_t, data.epoch_ns)
    variance = 0.0 if data.gyro_density is None else data.gyro_density**2 / np.median(np.diff(data.gyro_t))
    orientation: dict[str, Any] = {} if data.attitude is None else {"wxyz": data.attitude, "wxyz_cov": np.zeros((3, 3))}
    imu = series.ImuSeries(gyro_ns, data.gyro, gyro_cov=variance * np.eye(3), frame_id="imu", **orientation)
    angles = np.column_stack([data.outer, data.inner])
    topics: dict[str, series.Topic] = {
        IMU.name: imu,
        INDEXER.name: series.JointSeries(encoder_ns, angles, JOINTS, frame_id="indexer"),
    }
    if data.latitude_deg is not None:
        start = np.array([data.epoch_ns])
        fix = series.FixSeries(start, np.array([data.latitude_deg]), np.zeros(1), frame_id="gnss")
        topics[FIX.name] = fix
    topics |= temperature.topics(data.temperature, data.epoch_ns)
    write_session(path, topics, attached(truth, config_yaml))


def _latitude(recording: Recording, config: Config) -> float | None:
    """Degrees: from the config, else the median of the fixes, else None."""
    topic = config.topic(FIX)
    if config.latitude_deg is not None:
        return config.latitude_deg
    if not wanted(recording, config, FIX):
        return None
    fixes = recording.fixes(topic)
    good = fixes.latitude_deg[(fixes.status >= 0) & np.isfinite(fixes.latitude_deg)]
    if not len(good):
        return None
    latitude = float(np.median(good))
    if abs(latitude) > 90.0:
        raise InputError(f"topic {topic}: latitude of {latitude:g}, beyond 90 degrees; NavSatFix is in degrees")
    return latitude
