"""Topics, config section and arrays of the indexer method, from and to a recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.place import median_fix
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.checks import check_overlap, nanoseconds, unit_quaternions
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Numbers, Quaternions, Rates
from alidade.pipelines.recording.streams import StreamReader, Temperature, imu_series
from alidade.pipelines.recording.topics import FIX, IMU, TEMPERATURE, Need, Setting, Topic, wanted
from alidade.pipelines.settings import Config, MethodSection, Quaternion

INDEXER = Topic("indexer", "/indexer/joint_states", (messages.JOINT_STATE,))

# The axes, as the messages name them.
JOINTS = ("outer_x", "inner_z")

TOPICS = (IMU, INDEXER, FIX, TEMPERATURE)
_LATITUDE = Setting("latitude_deg in the config", lambda config: config.latitude_deg is not None)
REQUIREMENTS: tuple[Need, ...] = (((IMU,),), ((INDEXER,),), ((FIX,), (_LATITUDE,)))


class IndexerConfig(MethodSection):
    """Section `indexer` of a config."""

    key: ClassVar[str] = "indexer"

    base_attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)  # nRbase: w, x, y, z


@dataclass(frozen=True)
class IndexerData:
    """Measurements of an indexer session. Times are s from epoch_ns (Unix ns), strictly increasing.

    gyro_t (N,), gyro (N, 3) rad/s: rate w_im of the IMU on the indexer, in m. encoder_t (M,), outer (M,), inner (M,)
    rad: axis angles as recorded, wrapped or continuous. latitude_deg: from /fix or the config, None if unknown.
    attitude (N, 4): nRm as the INS puts it out with each gyro sample, unit, or None. gyro_density, rad/s/sqrt(Hz): from
    the covariances of the messages, None if they have none. dropped: reason -> messages. stamp_sigma, s: how well the
    stamps are known. temperature: of the IMU, None where nobody measures it.
    """

    epoch_ns: int
    gyro_t: Numbers
    gyro: Rates
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
    imu_topic, encoder_topic = config.topic(IMU), config.topic(INDEXER)
    reader = StreamReader(recording, {imu_topic: (), encoder_topic: JOINTS, config.topic(FIX): ()})
    imu = reader.gyro(imu_topic, least=3)
    attitude, wxyz = None, imu.series.wxyz
    # A message that does not say it has zeros, one value, or NaN.
    if (imu.series.wxyz_cov[:, 0, 0] >= 0.0).all() and np.isfinite(wxyz).all() and np.ptp(wxyz, axis=0).any():
        attitude = unit_quaternions(imu_topic, imu.t, wxyz)

    joints = recording.joints(encoder_topic, JOINTS)
    reader.count(encoder_topic, "without both joints", joints.without)
    encoders = reader.samples(encoder_topic, joints, "position", least=3)
    outer, inner = encoders.series.position.T
    check_overlap({imu_topic: imu.t, encoder_topic: encoders.t})
    return IndexerData(
        reader.epoch_ns,
        imu.t,
        imu.series.gyro,
        encoders.t,
        outer,
        inner,
        _latitude(recording, config),
        attitude,
        reader.density(imu_topic, "gyro", imu),
        reader.dropped,
        recording.stamp_sigma_s,
        temperature.read(reader, config, (temperature.GYRO_SLOPE,), imu.t),
    )


def indexer_topics(data: IndexerData, _pictures: None = None) -> dict[str, series.Topic]:
    """Topics of a recording under their default names."""
    epoch = data.epoch_ns
    imu = imu_series(epoch, data.gyro_t, data.gyro, density=data.gyro_density)
    if data.attitude is not None:
        imu = replace(imu, wxyz=data.attitude, wxyz_cov=np.zeros((3, 3)))
    angles = np.column_stack([data.outer, data.inner])
    topics: dict[str, series.Topic] = {
        IMU.name: imu,
        INDEXER.name: series.JointSeries(nanoseconds(data.encoder_t, epoch), angles, JOINTS, frame_id="indexer"),
    }
    if data.latitude_deg is not None:
        start = np.array([epoch])
        topics[FIX.name] = series.FixSeries(start, np.array([data.latitude_deg]), np.zeros(1), frame_id="gnss")
    return topics | temperature.topics(data.temperature, epoch)


def _latitude(recording: Recording, config: Config) -> float | None:
    """Latitude, deg: from the config, else the median of the fixes, else None."""
    if config.latitude_deg is not None or not wanted(recording, config, FIX):
        return config.latitude_deg
    return median_fix(recording, config.topic(FIX))[0]
