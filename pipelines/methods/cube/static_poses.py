"""Measurements in each static pose of a cube session: means of sensors and of tags' corners, reference's attitude.

The reference carries the camera; without one it is the camera itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.diagnostics.static_intervals import ACCEL_TREMOR, GYRO_TREMOR, Stream, find_static_intervals
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import stated
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.methods.cube.parameters import PLACE
from alidade.pipelines.methods.cube.recording import (
    REFERENCE_IMU,
    CubeConfig,
    CubeData,
    Sightings,
    computed_once,
    nominal,
    stated_density,
)
from alidade.pipelines.recording.checks import count
from alidade.pipelines.settings import DEFAULT_NOISE, Config, first_given

if TYPE_CHECKING:
    from alidade.pipelines.vision.pose import BodyPose, TagBody
    from alidade.pipelines.vision.tags import Detections


# Corners this many sigmas from the median of their pose are left out of its mean.
_FAR = 6.0
# Corners that are this many sigmas from their median in half of the pictures move; at rest the largest of a tag's eight
# numbers is 1.7 sigmas away.
_MOVED = 3.0
# What stays of a corner's error when pictures of a tag at rest are averaged, px.
_CORNER_BIAS = 0.01
# A tag misses the layout when its corners miss the pose by this share of its side (one made by hand is good to half
# a per cent).
_MISFIT_SHARE = 0.03


@dataclass(frozen=True, eq=False)
class SeenTags:
    """The cube's tags as seen in one pose.

    Attributes:
        ids: (k,), ascending.
        corners: (k, 4, 2) px, means over the pictures.
        covariance: (k, 4, 2, 2) px^2, of the means.
        t: (F,) s, stamps of the pictures.
        pose: of the cube in the camera, with the layout as given.
    """

    ids: NDArray[np.int64]
    corners: Array
    covariance: Array
    t: Array
    pose: BodyPose


@dataclass(frozen=True, eq=False)
class StaticPoses:
    """The static poses of a session. Means are in nominal SI units.

    Attributes:
        span: (P, 2) s, beginning and end.
        gyro, accel: (P, 3) rad/s, m/s^2.
        duration: (P,) s, time that gyro and accelerometer are averaged over.
        unrest: (P, 2) scatter of gyro and accelerometer over that of the quieter poses, at least 1: a hand's tremor.
        mag: (P, 3) T, NaN for a pose without samples, or None.
        mag_duration: (P,) s.
        celsius: (P,) mean temperatures, degrees Celsius; None where nobody measures them.
        tags: one a pose, None where no tag of the cube is seen well.
        dropped: reason -> number of tags, poses or intervals.
    """

    span: Array
    gyro: Array
    accel: Array
    duration: Array
    unrest: Array
    mag: Array | None
    mag_duration: Array
    celsius: Array | None
    tags: tuple[SeenTags | None, ...]
    dropped: dict[str, int]

    def __len__(self) -> int:
        return len(self.span)


@computed_once
def static_poses(data: CubeData, config: Config) -> StaticPoses:
    """Find the static poses and average all sensors over each.

    Raises:
        InputError: there is no static pose, no tag is seen in any though there is a camera, or a tag does not fit the
            others.
    """
    span, turning = _static_intervals(data, config)
    raw = config.section(CubeConfig).raw
    gyro, duration = _means(data.imu_t, nominal(data.gyro, raw.gyro), span)
    accel, _ = _means(data.imu_t, nominal(data.accel, raw.accel), span)
    mag, mag_duration = None, np.zeros(len(span))
    if data.mag_t is not None and data.mag is not None:
        mag, mag_duration = _means(data.mag_t, nominal(data.mag, raw.mag), span)
    dropped: dict[str, int] = {}
    tags: tuple[SeenTags | None, ...] = (None,) * len(span)
    if data.camera is not None:
        tags = _seen_tags(data, config, span, gyro, dropped)
    celsius = None
    if data.temperature is not None:
        celsius = _means(data.imu_t, data.temperature.above(0.0, data.imu_t)[:, None], span)[0][:, 0]
    raws = (data.gyro, data.accel)
    unrest = np.stack([_unrest(data.imu_t, values, span) for values in raws], axis=1)
    return StaticPoses(span, gyro, accel, duration, unrest, mag, mag_duration, celsius, tags, turning | dropped)


def _means(t: Array, values: Array, span: Array) -> tuple[Array, Array]:
    """Means (P, d) over the spans, NaN over empty ones, and averaging time (P,), s."""
    first, last = np.searchsorted(t, span[:, 0]), np.searchsorted(t, span[:, 1], side="right")
    number = last - first
    # About the whole mean, so that cumulative sums of counts keep their digits.
    centre = values.mean(axis=0)
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - centre, axis=0)])
    means: Array = (sums[last] - sums[first]) / np.maximum(number, 1)[:, None] + centre
    means[number == 0] = np.nan
    return means, np.asarray(number * np.median(np.diff(t)))


def _unrest(t: Array, values: Array, span: Array) -> Array:
    """Scatter (P,) of vectors within each span, over that of the quietest quarter of spans; at least 1."""
    rows = np.searchsorted(t, span)
    scatter = np.sqrt([values[first : last + 1].var(axis=0).mean() for first, last in rows])
    quiet = float(np.quantile(scatter, 0.25))
    return np.maximum(scatter / quiet, 1.0) if quiet else np.ones(len(scatter))


def _seen_tags(
    data: CubeData, config: Config, span: Array, gyro: Array, dropped: dict[str, int]
) -> tuple[SeenTags | None, ...]:
    from alidade.pipelines.vision.pose import TagBody

    assert data.sightings is not None
    body = replace(TagBody.from_board(config.section(CubeConfig)), accuracy=stated(config, PLACE))
    sigma = _corner_sigma(data.sightings, span, config)
    # The rates' median over the static intervals is the bias, near enough for what a pose is expected to be.
    path = GyroPath(data.imu_t, nominal(data.gyro, config.section(CubeConfig).raw.gyro), np.median(gyro, axis=0))
    found: list[SeenTags | None] = []
    last: tuple[float, Array] | None = None
    wrong: dict[int, int] = {}
    several: list[Detections] = []
    for start, stop in span:
        expected = None
        if last is not None:
            expected = so3.multiply(last[1], path.increments(np.array([last[0]]), np.array([start])).wxyz[0])
        tags, t = _tags_in(data.sightings, sigma, config, start, stop)
        if len(tags.ids) > 1:
            several.append(tags)
        seen = _seen_in(tags, t, data, body, expected, wrong, dropped)
        found.append(seen)
        if seen is not None:
            last = float(stop), seen.pose.cRb
    _check_camera(data, sigma, body, several, bool(wrong), found)
    _check_rigid(wrong, found)
    if not any(found):
        reasons = ", ".join(f"{reason} ({n})" for reason, n in dropped.items()) or "no tag in sight"
        raise InputError(f"no tag of the cube is seen well in any of {len(span)} static poses: {reasons}")
    if config.noise.corner_px is None and data.sightings.covariance is not None:
        return tuple(found)
    # Poses are found by the measured noise, measurements are weighted by the stated one, whose level is estimated.
    return tuple(
        seen and replace(seen, covariance=(_stated_px(config) / sigma) ** 2 * seen.covariance) for seen in found
    )


def _corner_sigma(seen: Sightings, span: Array, config: Config) -> float:
    """Corner noise of one picture, px per axis, from consecutive pictures of the static poses (P, 2).

    Second differences: a camera that moves evenly does not show in them. As stated where no tag is in three pictures.
    """
    pose = np.searchsorted(span[:, 0], seen.t[seen.frame], side="right") - 1
    rows = np.flatnonzero((pose >= 0) & (seen.t[seen.frame] <= span[pose, 1]))
    rows = rows[np.lexsort((seen.frame[rows], seen.ids[rows]))]
    alike = (seen.ids[rows[2:]] == seen.ids[rows[:-2]]) & (pose[rows[2:]] == pose[rows[:-2]])
    return robust_sigma(np.diff(seen.corners[rows], n=2, axis=0)[alike]) / np.sqrt(6.0) or _stated_px(config)


def _stated_px(config: Config) -> float:
    """Corner noise of one picture, px per axis, as stated by the config, else the default."""
    return first_given(config.noise.corner_px, DEFAULT_NOISE.corner_px)


def _tags_in(seen: Sightings, sigma: float, config: Config, start: float, stop: float) -> tuple[Detections, Array]:
    """Average the tags' corners over the pictures from start to stop, s; also return these pictures' stamps.

    Where the corners move, as before a camera that does, all tags are averaged over the same pictures.
    """
    from alidade.pipelines.vision.tags import Detections

    rows = np.flatnonzero((seen.t[seen.frame] >= start) & (seen.t[seen.frame] <= stop))
    if not len(rows):
        return Detections(seen.ids[rows], np.empty((0, 4, 2)), np.empty((0, 4, 2, 2))), np.empty(0)
    ids = np.unique(seen.ids[rows])
    moved = [np.median(_away(seen.corners[rows[seen.ids[rows] == tag]])) for tag in ids]
    if max(moved) > _MOVED * sigma:
        rows = _in_common(seen, rows)
        ids = np.unique(seen.ids[rows])
    averages = [_mean_corners(seen, sigma, config, rows[seen.ids[rows] == tag]) for tag in ids]
    corners, covariance = (np.array(column) for column in zip(*averages, strict=True))
    return Detections(ids, corners, covariance), seen.t[np.unique(seen.frame[rows])]


def _away(corners: Array) -> Array:
    """Largest distance (n,), px, of each picture's corners (n, 4, 2) from their median over pictures."""
    return np.asarray(np.abs(corners - np.median(corners, axis=0)).max(axis=(1, 2)))


def _in_common(seen: Sightings, rows: Index) -> Index:
    """Select detections of one set of tags, in the pictures that show all of these, with the most rows."""
    frames, ids = seen.frame[rows], seen.ids[rows]
    shown = {frame: frozenset(ids[frames == frame].tolist()) for frame in frames.tolist()}
    pictures = {tags: [frame for frame, whole in shown.items() if whole >= tags] for tags in shown.values()}
    best = max(pictures, key=lambda tags: len(tags) * len(pictures[tags]))
    return rows[np.isin(frames, pictures[best]) & np.isin(ids, list(best))]


def _seen_in(
    tags: Detections,
    t: Array,
    data: CubeData,
    body: TagBody,
    expected: Array | None,
    wrong: dict[int, int],
    dropped: dict[str, int],
) -> SeenTags | None:
    """Tags that fit the pose; misfits are counted in `wrong`."""
    from alidade.pipelines.vision.pose import estimate_pose
    from alidade.pipelines.vision.tags import edge_lengths

    assert data.camera is not None
    if not len(tags.ids):
        count(dropped, "static pose without a tag in sight", 1)
        return None
    pose = estimate_pose(data.camera, body, tags, None, expected)
    if pose is None or pose.ambiguous:
        count(dropped, "static pose with its tags' planar flip unresolved" if pose else "static pose not solved", 1)
        return None
    side = edge_lengths(tags.corners).mean()
    misfit = bool((pose.tag_rms_px > _MISFIT_SHARE * side).any())
    # Of two tags that disagree either may be the wrong one.
    for tag in [*pose.rejected, *(pose.ids.tolist() if misfit else [])]:
        wrong[tag] = wrong.get(tag, 0) + 1
    if misfit:
        count(dropped, "static pose whose tags do not fit the layout", 1)
        return None
    keep = np.isin(tags.ids, pose.ids)
    return SeenTags(tags.ids[keep], tags.corners[keep], tags.covariance[keep], t, pose)


def _mean_corners(seen: Sightings, sigma: float, config: Config, rows: Index) -> tuple[Array, Array]:
    """Mean (4, 2) px of one tag's corners over its pictures, and the mean's covariance (4, 2, 2) px^2."""
    corners = seen.corners[rows]
    if config.noise.corner_px is None and seen.covariance is not None:
        covariance = seen.covariance[rows].mean(axis=0)
    else:
        covariance = np.tile(sigma**2 * np.eye(2), (4, 1, 1))
    away = _away(corners)
    good = away <= _FAR * max(sigma, float(np.median(away)))
    bias = 0.0 if seen.covariance is None else _CORNER_BIAS
    return corners[good].mean(axis=0), covariance / int(good.sum()) + bias**2 * np.eye(2)


def _check_camera(
    data: CubeData,
    sigma: float,
    body: TagBody,
    several: list[Detections],
    disagree: bool,
    found: list[SeenTags | None],
) -> None:
    """Raise InputError if tags do not fit, but would all fit with another camera description."""
    from alidade.pipelines.vision.camera_faults import camera_fault

    assert data.camera is not None
    errors = [seen.pose.rms_px for seen in found if seen is not None and len(seen.ids) > 1]
    if errors and not disagree and np.median(errors) <= 2.0 * sigma:
        return
    fault = camera_fault(data.camera, body, several, sigma)
    if fault is not None:
        raise InputError(fault)


def _check_rigid(wrong: dict[int, int], found: list[SeenTags | None]) -> None:
    """Raise InputError if a tag disagrees with other tags more often than not."""
    agrees = {tag: sum(len(seen.ids) > 1 and tag in seen.ids for seen in found if seen is not None) for tag in wrong}
    often = {tag: times for tag, times in wrong.items() if times > agrees[tag]}
    if not often:
        return
    worst = sorted(tag for tag, times in often.items() if times == max(often.values()))
    names = " or ".join(str(tag) for tag in worst)
    raise InputError(
        f"cube not rigid: tag {names} disagrees with others in {often[worst[0]]} of "
        f"{often[worst[0]] + agrees[worst[0]]} static poses; check size, rotation and position in the config "
        f"(cube.tags.{worst[0]}) and that it is glued down"
    )


def static_intervals(data: CubeData, config: Config) -> Array:
    """Start and end, (P, 2) s, of the device's static intervals. Raises InputError if there is none."""
    return _static_intervals(data, config)[0]


@computed_once
def _static_intervals(data: CubeData, config: Config) -> tuple[Array, dict[str, int]]:
    """Find `static_intervals`; return them with the number of quiet intervals left out, by reason."""
    root_rate = float(np.median(np.diff(data.imu_t))) ** -0.5
    gyro_sigma, accel_sigma = (
        stated_density(name, data, config).stated * root_rate for name in ("gyro_density", "accel_density")
    )
    raw = config.section(CubeConfig).raw
    gyro = Stream(nominal(data.gyro, raw.gyro), gyro_sigma, GYRO_TREMOR)
    accel, dropped = Stream(nominal(data.accel, raw.accel), accel_sigma, ACCEL_TREMOR), dict[str, int]()
    return find_static_intervals(data.imu_t, accel, gyro, dropped=dropped), dropped


# Messages that scatter by more than this many times their variance are those of a reference that moved.
_MOVES = 2.0
# rad^2; no message is better.
_LEAST_VARIANCE = 1e-12
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Reference:
    """Attitude of the frame B that carries the camera; without a reference, of the stationary camera C itself.

    Attributes:
        nRB: (P, 4) at each pose, all the same when it stands still.
        covariance: (P, 3, 3) rad^2, of delta in nRB Exp(delta); None when nothing measured it.
        moves: whether it differs from pose to pose.
        BRC: (4,) camera mount as given.
    """

    nRB: Array
    covariance: Array | None
    moves: bool
    BRC: Array

    @property
    def nRC(self) -> Array:
        """Attitudes nRC (P, 4) of the camera, with the mount as stated."""
        return so3.multiply(self.nRB, self.BRC)


def cube_reference(data: CubeData, config: Config, poses: StaticPoses, field: Array | None) -> Reference:
    """Attitude of the reference at each pose.

    A reference that stands still is one attitude, the mean of all messages; one that moves has the mean of each pose.

    Raises:
        InputError: the camera's mount is not given, or the reference moves and has no message in a pose.
    """
    if data.camera is None:
        return Reference(so3.identity(len(poses)), None, False, so3.identity())
    if data.reference_t is None or data.reference_wxyz is None:
        return Reference(_camera_at_rest(poses, field), None, False, so3.identity())
    if config.section(CubeConfig).camera_rotation is None:
        raise InputError(
            "the camera's mount on the reference is not given: cube.camera_rotation, the quaternion BRC of reference "
            "body from camera (x right, y down, z forward)"
        )
    BRC = np.array(config.section(CubeConfig).camera_rotation)
    wxyz = data.reference_wxyz
    whole, scatter = _mean(wxyz)
    noise = data.reference_cov if data.reference_cov is not None else _noise(scatter)
    if _squares(scatter, noise) <= _MOVES:
        about_n = noise.mean(axis=0) / len(wxyz)
        return Reference(np.tile(whole, (len(poses), 1)), _on_the_right(whole, about_n, len(poses)), False, BRC)
    means, covariances = [], []
    for (start, stop), seen in zip(poses.span, poses.tags, strict=True):
        rows = (data.reference_t >= start) & (data.reference_t <= stop)
        if not rows.any():
            raise InputError(
                f"topic {config.topic(REFERENCE_IMU)}: no attitude of the moving reference between {start:.3f} and "
                f"{stop:.3f} s, while the cube stood still"
            )
        # When the pictures were taken: it moves on while there is none.
        at = data.reference_t[rows] if seen is None else np.clip(seen.t, data.reference_t[0], data.reference_t[-1])
        mean, _ = _mean(so3.interpolate(data.reference_t, wxyz, at))
        means.append(mean)
        covariances.append(_on_the_right(mean, noise[rows].mean(axis=0) / rows.sum(), 1)[0])
    return Reference(np.array(means), np.array(covariances), True, BRC)


def _noise(errors: Array) -> Array:
    """Covariance (N, 3, 3), rad^2, of attitude errors (N, 3) without a stated noise, from successive differences.

    Those of a motion are small: von Neumann, "Distribution of the ratio of the mean square successive difference to the
    variance", Ann. Math. Stat. 1941.
    """
    steps = np.diff(errors, axis=0)
    covariance = steps.T @ steps / (2.0 * max(len(steps), 1)) + _LEAST_VARIANCE * np.eye(3)
    return np.tile(covariance, (len(errors), 1, 1))


def _mean(wxyz: Array) -> tuple[Array, Array]:
    """Mean attitude (4,) and the samples' errors (N, 3) about the axes of n: sample = Exp(error) mean."""
    mean = wxyz[0]
    for _ in range(5):
        error = so3.log(so3.multiply(wxyz, so3.inverse(mean)))
        mean = so3.multiply(so3.exp(error.mean(axis=0)), mean)
    return mean, so3.log(so3.multiply(wxyz, so3.inverse(mean)))


def _squares(errors: Array, covariance: Array) -> float:
    """Mean square of whitened errors, 1 for the stated noise."""
    return float(np.einsum("ni,nij,nj->", errors, np.linalg.inv(covariance), errors) / errors.size)


def _on_the_right(mean: Array, about_n: Array, copies: int) -> Array:
    """Convert a covariance about the axes of n to that of delta in mean Exp(delta), (copies, 3, 3)."""
    R = so3.matrix(mean)
    return np.tile(R.T @ about_n @ R, (copies, 1, 1))


def _camera_at_rest(poses: StaticPoses, field: Array | None) -> Array:
    """Initial nRC, equal at all poses: up by the accelerometer, north by the magnetometer, if any."""
    seen = [k for k, tags in enumerate(poses.tags) if tags is not None]
    cRb = np.array([tags.pose.cRb for tags in poses.tags if tags is not None])
    up = so3.rotate(cRb, poses.accel[seen]).mean(axis=0)
    mag = None
    if field is not None and poses.mag is not None:
        mag = np.nanmean(so3.rotate(cRb, poses.mag[seen]), axis=0)
    return np.tile(from_vectors(up, mag, field), (len(poses), 1))


def from_vectors(up: Array, mag: Array | None, field: Array | None) -> Array:
    """Attitude nRa (4,) from specific force `up` at rest and field `mag` in a; without a field any heading."""
    if mag is None or field is None or not np.isfinite(mag).all():
        # Any direction across will do for north.
        mag, field = np.eye(3)[np.argmin(np.abs(up))], np.array([0.0, 1.0, 0.0])

    def axes(vertical: Array, other: Array) -> Array:
        z = vertical / np.linalg.norm(vertical)
        y = so3.cross(z, other)
        y = y / np.linalg.norm(y)
        return np.stack([so3.cross(y, z), y, z], axis=1)

    return so3.from_matrix(axes(_UP, field) @ axes(up, mag).T)
