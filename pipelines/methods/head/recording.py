"""Topics, config section and arrays of the head method; the arrays from and to a recording."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.noise import typical
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.checks import check_overlap, nanoseconds
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Covariances, Numbers, PlatformRates, Quaternions, Rates, Vectors
from alidade.pipelines.recording.streams import StreamReader, Temperature, imu_series
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, TEMPERATURE, Need, Setting, Topic, wanted
from alidade.pipelines.settings import Board, Config, MethodSection
from alidade.pipelines.vision.camera import camera_of

HEAD_IMU = Topic("head_imu", "/head/imu", messages.RATES)
PLATFORM_IMU = Topic("platform_imu", "/platform/imu", messages.RATES)
VISION_ATTITUDE = Topic("vision_attitude", "/vision/attitude", messages.ATTITUDES)
TRUTH_ATTITUDE = Topic("truth_attitude", "/truth/attitude", messages.ATTITUDES)


class HeadConfig(MethodSection):
    """Section `head` of a config."""

    key: ClassVar[str] = "head"

    board: Board | None = None  # tags on the helmet


TOPICS = (HEAD_IMU, PLATFORM_IMU, VISION_ATTITUDE, TRUTH_ATTITUDE, IMAGE, CAMERA_INFO, TEMPERATURE)
_BOARD = Setting("head.board in the config", lambda config: config.section(HeadConfig).board is not None)
REQUIREMENTS: tuple[Need, ...] = (((HEAD_IMU,),), ((VISION_ATTITUDE,), (IMAGE, CAMERA_INFO, _BOARD)))


_NUMBERS = (HEAD_IMU, PLATFORM_IMU, VISION_ATTITUDE, TRUTH_ATTITUDE)
# rad^2; no tracker on a helmet is as good. Drivers that know nothing write 1e-12, say.
_LEAST_VARIANCE = 1e-11
_ROTATION = slice(3, 6)  # of the 6x6 covariance of a pose


@dataclass(frozen=True, eq=False)
class HeadData:
    """Measurements of a head session. Times are s from epoch_ns (Unix ns), strictly increasing.

    head_t (N,), head_gyro (N, 3) rad/s: helmet gyro w_iv in v. platform_t (M,), platform_gyro (M, 3) rad/s: platform
    gyro w_ib in b; both None when there is no platform topic. vision_t (K,), vision_wxyz (K, 4): measured cRh, unit.
    vision_cov (K, 3, 3) rad^2: covariance of delta in R*Exp(delta), delta in h; None if unknown. truth_t (T,),
    truth_wxyz (T, 4): bRv, for scoring only, or None. gyro_density, platform_gyro_density, rad/s/sqrt(Hz): from the
    covariances of the messages, None if they have none. head_force (N, 3) m/s^2: specific force by the helmet's
    accelerometer in v, at head_t; None if it has none. dropped: reason -> messages. stamp_sigma, s: how well the stamps
    are known, 0 where they are those of the sensors. temperature: of the helmet's IMU, None where nobody measures it.
    """

    epoch_ns: int
    head_t: Numbers
    head_gyro: Rates
    platform_t: Numbers | None
    platform_gyro: PlatformRates | None
    vision_t: Numbers
    vision_wxyz: Quaternions
    vision_cov: Covariances | None
    truth_t: Numbers | None = None
    truth_wxyz: Quaternions | None = None
    gyro_density: float | None = None
    platform_gyro_density: float | None = None
    head_force: Vectors | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    stamp_sigma: float = 0.0
    temperature: Temperature | None = None


def read_head(recording: Recording, config: Config) -> HeadData:
    """Read and check a head session; without recorded attitudes, measure these in pictures of the tag board.

    Raises InputError when a topic is missing or unusable, see alidade.pipelines.recording.checks, and when the topics
    have no time in common.
    """
    reader = StreamReader(recording, dict.fromkeys(map(config.topic, _NUMBERS), ()))
    name = config.topic(HEAD_IMU)
    head = reader.gyro(name)
    head_force, density = reader.force(name, head), reader.density(name, "gyro", head)
    spans = {name: head.t}

    platform = platform_density = None
    name = config.topic(PLATFORM_IMU)
    # One that is there and empty is no platform at rest.
    if name in recording.topics or wanted(recording, config, PLATFORM_IMU):
        platform = reader.gyro(name, may_be_constant=True)
        platform_density = reader.density(name, "gyro", platform)
        spans[name] = platform.t

    name = config.topic(VISION_ATTITUDE)
    vision_cov: Array | None
    if wanted(recording, config, VISION_ATTITUDE) or not wanted(recording, config, IMAGE):
        vision_t, vision_wxyz, vision_cov = _vision(reader, name)
        if _like_mocap(recording, config, name, vision_t, vision_wxyz, vision_cov):
            recording.remark(f"proposed for the config, not assumed: {_MOCAP_KIND}")
    else:
        name = config.topic(IMAGE)
        vision_t, vision_wxyz, vision_cov = _from_pictures(reader, config)
    check_overlap({**spans, name: vision_t})

    truth_t = truth_wxyz = None
    if wanted(recording, config, TRUTH_ATTITUDE):
        truth_t, truth_wxyz, _ = _vision(reader, config.topic(TRUTH_ATTITUDE))
    return HeadData(
        reader.epoch_ns,
        head.t,
        head.series.gyro,
        platform and platform.t,
        platform and platform.series.gyro,
        vision_t,
        vision_wxyz,
        vision_cov,
        truth_t,
        truth_wxyz,
        density,
        platform_density,
        head_force,
        reader.dropped,
        recording.stamp_sigma_s,
        temperature.read(reader, config, (temperature.GYRO_SLOPE,), head.t),
    )


def head_topics(data: HeadData, pictures: series.Pictures | None = None) -> dict[str, series.Topic]:
    """Topics of a recording under their default names, with pictures or vision attitudes."""
    epoch = data.epoch_ns
    topics: dict[str, series.Topic] = {
        HEAD_IMU.name: imu_series(epoch, data.head_t, data.head_gyro, data.head_force, data.gyro_density),
    }
    if data.platform_t is not None and data.platform_gyro is not None:
        density = data.platform_gyro_density
        topics[PLATFORM_IMU.name] = imu_series(epoch, data.platform_t, data.platform_gyro, density=density)
    if pictures is None:
        cov = np.zeros((len(data.vision_t), 6, 6))
        if data.vision_cov is not None:
            cov[:, _ROTATION, _ROTATION] = data.vision_cov
        t_ns = nanoseconds(data.vision_t, epoch)
        topics[VISION_ATTITUDE.name] = series.PoseSeries(t_ns, data.vision_wxyz, cov=cov, frame_id="camera")
    else:
        topics[CAMERA_INFO.name], topics[IMAGE.name] = pictures
    if data.truth_t is not None and data.truth_wxyz is not None:
        t_ns = nanoseconds(data.truth_t, epoch)
        topics[TRUTH_ATTITUDE.name] = series.QuaternionSeries(t_ns, data.truth_wxyz, frame_id="platform")
    return topics | temperature.topics(data.temperature, epoch)


def _from_pictures(reader: StreamReader, config: Config) -> tuple[Array, Array, Array]:
    """Measure attitudes of the helmet's tag board in the pictures."""
    from alidade.pipelines.vision.board import board_attitudes
    from alidade.pipelines.vision.pose import TagBody

    topic = config.topic(IMAGE)
    on_helmet = config.section(HeadConfig).board
    if on_helmet is None or not on_helmet.tags:
        raise InputError(
            f"topic {topic}: the pictures need the tags on the helmet: give them in the config as head.board"
        )
    camera = camera_of(reader.recording, config)
    board = TagBody.from_board(on_helmet)
    seen = board_attitudes(reader.recording.images(topic), camera, board, config.noise.corner_px)
    for reason, number in seen.dropped.items():
        reader.count(topic, reason, number)
    t, keep = reader.clean(topic, seen.t_ns, seen.cRh)
    return t, seen.cRh[keep], seen.covariance[keep]


def _vision(reader: StreamReader, topic: str) -> tuple[Array, Array, Array | None]:
    t, wxyz, cov = reader.attitude(topic, _LEAST_VARIANCE)
    known = np.abs(cov).max(axis=(1, 2)) > 0.0
    if not known.any():
        return t, wxyz, None
    reader.count(topic, "no covariance, unlike the others", int(np.count_nonzero(~known)))
    t, wxyz, cov = t[known], wxyz[known], cov[known]
    bad = np.flatnonzero(~(np.linalg.eigvalsh(0.5 * (cov + cov.swapaxes(1, 2)))[:, 0] > 0.0))
    if len(bad):
        raise InputError(
            f"topic {topic}: the covariance of the rotation at {t[bad[0]]:.6f} s is not positive definite "
            f"(and {len(bad) - 1} more); all zeros would mean that it is unknown"
        )
    return t, wxyz, cov


# Cameras that look for tags deliver fewer attitudes a second.
_FAST_HZ = 80.0
# rad; so measured, motion capture at 25 Hz has 7e-5 to 5e-4 (six BROAD trials), with .5 deg of noise added 7e-3.
_TINY = 1e-3
_MOCAP_KIND = "vision: {kind: mocap}"
_MOCAP = re.compile(r"mocap|vicon|optitrack|qualisys|motion_?capture", re.IGNORECASE)
# Fourth differences of white noise have so many times its variance: the binomial of 8 over 4.
_FOURTH = 70.0
# They are looked at so many at a time, three axes each, and noise is that of the quietest of these, but for a few.
_FEW, _QUIET = 25, 0.05


def proposed(recording: Recording, config: Config) -> tuple[str, ...]:
    """Propose motion capture by name, rate or noise of the attitudes, with the reason; other kinds change nothing."""
    name = config.topic(VISION_ATTITUDE)
    if not wanted(recording, config, VISION_ATTITUDE):
        return ()
    try:
        poses = recording.poses(name)
    except InputError:
        return ()
    order = np.argsort(poses.t_ns, kind="stable")
    t = np.asarray(1e-9 * poses.t_ns[order], dtype=float)
    why = _like_mocap(recording, config, name, t, poses.wxyz[order], poses.cov[:, 3:, 3:])
    return (f"{_MOCAP_KIND} ({why})",) if why else ()


def _like_mocap(recording: Recording, config: Config, name: str, t: Array, wxyz: Array, cov: Array | None) -> str:
    """Why attitudes (n, 4) at t (n,), s, with covariances (n, 3, 3) look like motion capture's.

    Empty where they do not, or where the config states the kind of vision.
    """
    if "kind" in config.vision.model_fields_set:
        return ""
    if _MOCAP.search(name):
        return f"the name {name}"
    steps = np.diff(t)
    rate = 1.0 / float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    # Drivers that know nothing state next to nothing.
    noise = max(typical(cov, 0, 1, 2) or 0.0, white_angle(wxyz))
    is_odometry = name in recording.topics and recording.topics[name].type == messages.ODOMETRY
    if is_odometry or (rate < _FAST_HZ and noise >= _TINY):
        return ""
    return f"{rate:.3g} attitudes/s on {name}, noise {np.rad2deg(noise):.2g} deg"


def white_angle(wxyz: Array) -> float:
    """White noise of attitudes (n, 4), rad per axis, from fourth differences where rotation is least."""
    turns = so3.local(wxyz[:-1], wxyz[1:])
    fourth = np.diff(turns, 3, axis=0)
    if len(fourth) < _FEW:
        return np.inf
    pieces = np.array_split(fourth, len(fourth) // _FEW)
    return float(np.quantile([robust_sigma(piece) for piece in pieces], _QUIET)) / _FOURTH**0.5
