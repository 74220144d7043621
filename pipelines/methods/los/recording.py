"""Topics and arrays of the los method, from and to a recording, and checks of gimbal and gyro."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise, product
from typing import Annotated

import numpy as np

from alidade.factors.array import Array, interpolated
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import temperature
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.checks import check_overlap, nanoseconds
from alidade.pipelines.recording.faults import drop_frozen
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import Numbers, Pairs, Rates, Rows, Vectors
from alidade.pipelines.recording.streams import StreamReader, Temperature, imu_series
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, IMU, TEMPERATURE, Need, Topic, wanted
from alidade.pipelines.settings import Config
from alidade.pipelines.vision.camera import camera_of

GIMBAL = Topic("gimbal", "/gimbal/joint_states", (messages.JOINT_STATE,))
LOS_ERROR = Topic("los_error", "/los/error", (messages.VECTOR,))

# The gimbal's axes, as its messages name them.
JOINTS = ("azimuth", "elevation")

TOPICS = (IMU, GIMBAL, LOS_ERROR, IMAGE, CAMERA_INFO, TEMPERATURE)
REQUIREMENTS: tuple[Need, ...] = (((IMU,),), ((GIMBAL,),), ((LOS_ERROR,), (IMAGE, CAMERA_INFO)))

# Beyond this elevation the azimuth axis would have to turn sec(elevation) > 5.8 times as fast as the sway.
_STEEPEST = np.deg2rad(80.0)
# No camera that measures LOS errors looks this far off its axis, rad; in pixels most errors are larger.
_WIDEST_ERROR = 0.5
# A tracker that reads whole pixels repeats itself while a good gimbal holds the target, but not one value as often.
_STUCK = 0.9
# A gimbal is checked in segments this long, s, and counts as moved by the carrier beyond this, rad.
_STRETCH, _MOVED = 2.0, 0.01
# Pictures this far apart, s, and at least so many, determine the signs of the gyro's axes.
_STRIDE, _FEWEST = 0.2, 20
# Another reading is reported where it leaves this part of the misfit; those of deg/s and of the gimbal only where the
# carrier's turn about any axis is this part of the largest: a mount off by 30 deg leaks half of one axis into another.
_FAR_BETTER, _LEAST_SPREAD = 0.3, 0.3
# What may be wrong -> weights (2, 3), each a way in which it may be, of the gyro's x, y, z in the turn of the picture
# about the camera's z and x.
_Weights = tuple[tuple[float, ...], ...]
_ALL, _NONE = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
_SIGNS: dict[str, list[_Weights]] = {
    f"the gyro's {' and '.join(axis for axis, sign in zip('xyz', signs, strict=True) if sign < 0)} has the opposite "
    "sign; the carrier's axes are x right, y ahead, z up: turn the gyro's axes, or the encoders', the right way": [
        (signs,)
    ]
    for signs in product((1.0, -1.0), repeat=3)
    if min(signs) < 0.0
}
_IN_DEGREES: dict[str, list[_Weights]] = {
    "the gyro is in deg/s; angular_velocity has to be in rad/s": [((np.pi / 180.0,) * 3,)]
}
_GIMBAL = "not follow the carrier: measured against the earth, or standing still; angles against the carrier are needed"
_OF_GIMBAL: dict[str, list[_Weights]] = {
    f"its azimuth does {_GIMBAL}": [((1.0, 1.0, 0.0), _ALL), (_NONE, _ALL)],
    f"its elevation does {_GIMBAL}": [(_ALL, _NONE)],
    f"it does {_GIMBAL}": [(_NONE, _NONE)],
}
# Samples of the gyro looked at together.
_BLOCK = 100_000
# Of an LOS error, what trackers may not measure.
_ROLL = (2,)
_ERRORS = Rows((3,), unmeasured=_ROLL)


@dataclass(frozen=True, eq=False)
class LosData:
    """Measurements of a los session. Times are s from epoch_ns (Unix ns), strictly increasing.

    gyro_t (N,), gyro (N, 3) rad/s: carrier gyro in m. gimbal_t (G,), gimbal (G, 2) rad: azimuth (continuous) and
    elevation. image_t (K,), error (K, 3) rad: phx, phz and the camera's roll since its target was found, NaN where the
    roll was not measured. error_cov (K, 3, 3) rad^2: the tracker's covariance, None if unknown. gyro_density,
    rad/s/sqrt(Hz): from the covariances of the messages, None if they have none. force (N, 3) m/s^2: specific force
    by the IMU's accelerometer in m, at gyro_t; None if it has none. dropped: reason -> messages. stamp_sigma, s: how
    well the stamps are known. temperature: of the IMU, None where nobody measures it.
    """

    epoch_ns: int
    gyro_t: Numbers
    gyro: Rates
    gimbal_t: Numbers
    gimbal: Pairs
    image_t: Numbers
    error: Annotated[Array, _ERRORS]
    error_cov: Annotated[Array, Rows((3, 3), unmeasured=_ROLL)] | None = None
    gyro_density: float | None = None
    force: Vectors | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    stamp_sigma: float = 0.0
    temperature: Temperature | None = None


def read_los(recording: Recording, config: Config) -> LosData:
    """Read and check a los session; without recorded LOS errors, measure these in the pictures.

    Raises InputError when a topic is missing or unusable (see alidade.pipelines.recording.checks), when the topics have
    no time in common, when the target was never found, when an encoder is in degrees, the elevation beyond 80 deg or
    the LOS error not in radians, and where gimbal, gyro and pictures contradict one another (`check`).
    """
    gyro_name, gimbal_name, error_name = map(config.topic, (IMU, GIMBAL, LOS_ERROR))
    reader = StreamReader(recording, {gyro_name: (), gimbal_name: JOINTS, error_name: ()})
    imu = reader.gyro(gyro_name)
    force, density = reader.force(gyro_name, imu), reader.density(gyro_name, "gyro", imu)
    gimbal_t, gimbal = _gimbal(reader, gimbal_name)
    covariance = None
    if wanted(recording, config, LOS_ERROR) or not wanted(recording, config, IMAGE):
        image_t, error = _error(reader, error_name)
    else:
        error_name = config.topic(IMAGE)
        image_t, error, covariance = _from_pictures(reader, config)
    check_overlap({gyro_name: imu.t, gimbal_name: gimbal_t, error_name: image_t})
    stamp_sigma = recording.stamp_sigma_s
    data = LosData(
        reader.epoch_ns,
        imu.t,
        imu.series.gyro,
        gimbal_t,
        gimbal,
        image_t,
        error,
        covariance,
        density,
        force,
        reader.dropped,
        stamp_sigma,
        temperature.read(reader, config, (temperature.GYRO_SLOPE,), imu.t),
    )
    check(data, gyro_name, gimbal_name)
    return data


def check(data: LosData, gyro: str, gimbal: str) -> None:
    """Raise InputError where gimbal, gyro and pictures contradict one another; the message names the topics."""
    check_gimbal(gimbal, data)
    check_motion(gyro, gimbal, data)


def los_topics(data: LosData, pictures: series.Pictures | None = None) -> dict[str, series.Topic]:
    """Topics of a recording under their default names, with pictures or LOS errors."""
    epoch = data.epoch_ns
    topics: dict[str, series.Topic] = {
        IMU.name: imu_series(epoch, data.gyro_t, data.gyro, data.force, data.gyro_density),
        GIMBAL.name: series.JointSeries(nanoseconds(data.gimbal_t, epoch), data.gimbal, JOINTS, frame_id="gimbal"),
    }
    if pictures is None:
        t_ns = nanoseconds(data.image_t, epoch)
        topics[LOS_ERROR.name] = series.VectorSeries(t_ns, data.error[:, [0, 2, 1]], frame_id="los")
    else:
        topics[CAMERA_INFO.name], topics[IMAGE.name] = pictures
    return topics | temperature.topics(data.temperature, epoch)


def check_gimbal(topic: str, data: LosData) -> None:
    """Raise InputError if an encoder is constant while the carrier rotates and the picture does not move.

    A gimbal locked on purpose differs from a frozen encoder in the LOS error, which then moves with the carrier.
    """
    turned = np.empty((len(data.gyro_t), 2))
    for some, by_axes in _turned_by_carrier(data):
        turned[some] = by_axes.sum(axis=2)
    for start, stop in pairwise(np.arange(data.gimbal_t[0], data.gimbal_t[-1], _STRETCH)):
        gimbal, turn, error = (
            _span(values[slice(*np.searchsorted(t, [start, stop]))])
            for t, values in (
                (data.gimbal_t, data.gimbal),
                (data.gyro_t, turned),
                (data.image_t, data.error[:, [1, 0]]),
            )
        )
        frozen = (gimbal == 0.0) & (turn > _MOVED) & (error < 0.3 * turn)
        for name, angle in zip(np.array(JOINTS)[frozen], turn[frozen], strict=True):
            raise InputError(
                f"topic {topic}: {name} stands still from {start:.3f} to {stop:.3f} s while the carrier turns by "
                f"{np.rad2deg(angle):.2f} deg and the target stays in the picture; the encoder is frozen: check its "
                "cable and its driver"
            )


def check_motion(gyro: str, gimbal: str, data: LosData) -> None:
    """Raise InputError if another sign or unit of gyro or gimbal explains the stabilisation far better.

    That is: gyro axes of the opposite sign, a gyro in deg/s, gimbal angles that do not follow the carrier.
    """
    at, held, turned = _between_pictures(data)
    if len(at) < _FEWEST:
        return
    readings = _SIGNS
    spread = np.linalg.eigvalsh(np.cov(np.add.reduceat(data.gyro, np.searchsorted(data.gyro_t, at)).T))
    if spread[0] > _LEAST_SPREAD**2 * spread[2]:
        readings = {**_SIGNS, **_IN_DEGREES, **_OF_GIMBAL}

    def miss(weights: _Weights) -> float:
        return float(np.median(np.linalg.norm(held + (turned * np.array(weights)).sum(axis=2), axis=1)))

    misses = {said: min(map(miss, ways)) for said, ways in readings.items()}
    best = min(misses, key=misses.__getitem__)
    if misses[best] < _FAR_BETTER * miss((_ALL,)):
        raise InputError(f"topic {gimbal if best in _OF_GIMBAL else gyro}: gimbal and pictures show that {best}")


def _between_pictures(data: LosData) -> tuple[Array, Array, Array]:
    """Picture times (n,), s, gimbal rotation (n - 1, 2), carrier rotation (n - 1, 2, 3) between them, rad.

    The first is the gimbal's own turn less what the picture shows of it, the second the carrier's by its gyro's axes.
    """
    t = data.image_t
    inside = (t >= max(data.gyro_t[0], data.gimbal_t[0])) & (t <= min(data.gyro_t[-1], data.gimbal_t[-1]))
    stride = max(1, round(_STRIDE / float(np.median(np.diff(t)))))
    at, error = t[inside][::stride], data.error[inside][::stride, [1, 0]]
    gimbal = interpolated(at, data.gimbal_t, data.gimbal)
    turned = np.empty((len(at), 2, 3))
    for some, by_axes in _turned_by_carrier(data):
        t = data.gyro_t[some]
        mine = slice(np.searchsorted(at, t[0]), np.searchsorted(at, t[-1], side="right"))
        turned[mine] = interpolated(at[mine], t, by_axes.reshape(len(t), 6)).reshape(-1, 2, 3)
    middle = 0.5 * (gimbal[1:, 1] + gimbal[:-1, 1])
    own = np.diff(gimbal, axis=0) * np.stack([np.cos(middle), np.ones_like(middle)], axis=1)
    return at, own - np.diff(error, axis=0), np.diff(turned, axis=0)


def _turned_by_carrier(data: LosData) -> Iterator[tuple[slice, Array]]:
    """Yield gyro samples and the picture's rotation since the start by each gyro axis, (n, 2, 3) rad.

    That is since the start. The samples come block by block, each with the last one of the block before.
    """
    step, before = np.gradient(data.gyro_t), np.zeros((1, 2, 3))
    for begin in range(0, len(step), _BLOCK):
        some = slice(max(begin - 1, 0), begin + _BLOCK)
        t, (wx, wy, wz) = data.gyro_t[some], data.gyro[some].T
        azimuth, elevation = interpolated(t, data.gimbal_t, data.gimbal).T
        s, c, se, ce = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
        about_z = np.stack([se * s * wx, -se * c * wy, ce * wz], axis=1)
        about_x = np.stack([c * wx, s * wy, np.zeros_like(wz)], axis=1)
        moves = np.stack([about_z, about_x], axis=1) * step[some, None, None]
        if begin:
            moves[:1] = before
        turned = np.cumsum(moves, axis=0)
        before = turned[-1:]
        yield some, turned


def _span(values: Array) -> Array:
    """Maximum minus minimum of each column; NaN for fewer than two rows."""
    return np.asarray(np.ptp(values, axis=0)) if len(values) > 1 else np.full(values.shape[1], np.nan)


def _gimbal(reader: StreamReader, topic: str) -> tuple[Array, Array]:
    joints = reader.samples(topic, reader.recording.joints(topic, JOINTS), "position", least=4)
    t, position = joints.t, joints.series.position
    gimbal = np.stack([np.unwrap(position[:, 0]), position[:, 1]], axis=1)
    worst = int(np.argmax(np.abs(gimbal[:, 1])))
    steepest = float(np.abs(gimbal[worst, 1]))
    if steepest > 0.5 * np.pi:
        raise InputError(
            f"topic {topic}: elevation of {gimbal[worst, 1]:.4g} at {t[worst]:.6f} s, beyond pi/2; "
            "is the encoder in degrees? position has to be in rad"
        )
    if steepest > _STEEPEST:
        raise InputError(
            f"topic {topic}: elevation of {np.rad2deg(gimbal[worst, 1]):.2f} deg at {t[worst]:.6f} s; beyond 80 deg "
            "the azimuth axis would have to turn sec(elevation) times as fast as the sway and cannot stabilise: record "
            "below 80 deg"
        )
    return t, gimbal


def _error(reader: StreamReader, topic: str) -> tuple[Array, Array]:
    """Read stamps and phx, phz, roll; messages without phx or phz (target lost) or with a frozen one are dropped."""
    errors = reader.recording.vector(topic)
    reader.count(topic, "stamped by log time (kept)", errors.stamped_by_log)
    offset = errors.vector[:, [0, 2]]
    if not np.isfinite(offset).all(axis=1).any():
        raise InputError(
            f"topic {topic}: the target was never found, none of the {len(errors)} messages has an LOS error; "
            "check what the tracker is locked on"
        )
    t, keep = reader.clean(topic, errors.t_ns, offset)
    error = errors.vector[keep][:, [0, 2, 1]]
    if missing := _ERRORS.placeholders(error):
        error[:, missing] = np.nan
        reader.recording.remark(f"topic {topic}: y, the roll, reads one value in all messages: it was not measured")
    size = np.abs(error[:, :2]).max(axis=1)
    if np.median(size) > _WIDEST_ERROR:
        raise InputError(
            f"topic {topic}: LOS errors of {np.median(size):.4g} (median, {size.max():.4g} at most), beyond "
            f"{_WIDEST_ERROR:g} rad; are they in pixels? divide by the focal length: x and z have to be in rad"
        )
    _check_tracked(topic, error[:, :2])
    sound = drop_frozen(topic, t, error[:, :2], reader.dropped, "rad", "xz")
    return t[sound], error[sound]


def _check_tracked(topic: str, offset: Array) -> None:
    """Raise InputError if phx or phz (N, 2) is nearly always one value, as from a tracker that is not locked."""
    share = np.array([np.unique(column, return_counts=True)[1].max() for column in offset.T]) / len(offset)
    stuck = " and ".join(axis for axis, much in zip("xz", share, strict=True) if much >= _STUCK)
    if stuck and len(offset) >= _FEWEST:
        least = share[share >= _STUCK].min()
        many = f"all {len(offset)}" if least == 1.0 else f"{100.0 * least:.0f} % of the {len(offset)}"
        raise InputError(
            f"topic {topic}: {stuck} {'read' if 'and' in stuck else 'reads'} the same value in {many} messages: the "
            "tracker did not measure; check that it is locked on the target and its driver fills in x and z, and "
            "record again"
        )


def _from_pictures(reader: StreamReader, config: Config) -> tuple[Array, Array, Array]:
    """Measure LOS errors in the pictures, of the target in the first, with the tracker's covariance."""
    from alidade.pipelines.vision.target import los_errors

    topic = config.topic(IMAGE)
    camera = camera_of(reader.recording, config)
    found = los_errors(reader.recording.images(topic), camera)
    for reason, number in found.dropped.items():
        reader.count(topic, reason, number)
    t, keep = reader.clean(topic, found.t_ns, found.error)
    covariance = found.covariance[keep]
    # The first picture agrees with itself without error, yet where it puts the target is as uncertain as elsewhere.
    covariance[0] = np.median(covariance, axis=0)
    return t, found.error[keep], covariance
