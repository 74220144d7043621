"""The cube method: accelerometer, gyro and magnetometer calibrated in a cube of AprilTags.

The graph's states are the attitudes nRb of the static poses. Each is seen by the camera through the corners of its tags
(with the cube's place in the camera as a by-product), by gravity, the earth's field and the earth's rate; the gyro's
whole model is integrated over the turns between them. Methods page, section 4.

What the recording holds decides what is known: without a magnetometer, or without a position for the field model, there
is no magnetometer to calibrate; without a reference the camera stands still at an unknown attitude; without a camera
the poses follow from gravity and the turns alone, and the accelerometer's own axes define the body frame: accel_k21,
accel_k31 and accel_k32 are zero unless given a prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.turns import Samples, Turns
from alidade.pipelines.estimation.believing import believing
from alidade.pipelines.estimation.priors import rotation_about, vector_about
from alidade.pipelines.estimation.problem import Attitudes, ChainLayout, Factor, Problem, Step
from alidade.pipelines.methods import temperature
from alidade.pipelines.methods.cube.advice import advice
from alidade.pipelines.methods.cube.data import CubeData
from alidade.pipelines.methods.cube.measurements import (
    place_key,
    pose_key,
    reference_key,
    sensor_factors,
    tag_factor,
    turn_factor,
)
from alidade.pipelines.methods.cube.model import Model, prepare
from alidade.pipelines.methods.cube.noises import noises
from alidade.pipelines.methods.cube.parameters import SENSITIVITY_KEY, SLOPE_KEYS, TRIAD_KEYS, first_priors
from alidade.pipelines.methods.cube.tag_places import layout_belief
from alidade.pipelines.methods.cube.wandering import deviation_key, sum_key
from alidade.pipelines.settings import Config

_NO_FIELD = (
    "The magnetometer is not calibrated, for the field is not known where nobody says where it was: give latitude_deg "
    "and longitude_deg in the config, or record /reference/fix."
)
# Sigmas of priors as good as none, m on the cube's place in the camera and rad on an attitude that no gyro leads to:
# these only make the new variables of a step determined without its measurements.
_POSITION_PRIOR_SIGMA, _ATTITUDE_PRIOR_SIGMA = 10.0, np.pi


def problem(data: CubeData, config: Config) -> Problem:
    """The graph of a cube recording.

    Raises:
        InputError: there is no static pose, the position is unknown, the date is outside the field model, or no tag of
            the cube is seen well though there is a camera.
    """
    model, layout = prepare(data, config), layout_belief(config)
    graph = Problem(
        method="cube",
        parameters=model.parameters.all,
        steps=partial(_steps, model),
        loss=model.loss,
        attitudes=partial(_trajectory, model),
        advice=advice,
        dropped=model.dropped,
        premises=(_NO_FIELD,) if model.poses.mag is not None and model.field is None else (),
        noises=tuple(noises(data, config).values()),
        constants=temperature.constants(temperature.reference(data.temperature)),
        layout=ChainLayout(states="xdepR" if model.reference.moves else "xdep"),
    )
    return graph if layout is None or data.camera is None else believing(graph, [layout])


def _steps(model: Model, _: int) -> Iterator[Step]:
    """One step a static pose, with the turn before it; the calibration variables come with the first.

    No variable ages: a session has tens of poses, few enough to keep them all.
    """
    yield from (_step(model, k) for k in range(len(model.poses)))


def _step(model: Model, k: int) -> Step:
    initial = gtsam.Values()
    factors: list[Factor] = []
    if k == 0:
        initial.insert(model.parameters.initial(model.gyro_bias))
        factors += first_priors(model.parameters)
    initial.insert(pose_key(k), so3.to_gtsam(model.initial[k]))
    initial.insert(deviation_key(k), np.zeros(3))
    initial.insert(sum_key(k), np.zeros(3))
    factors += [*model.deviation.factors(k), *_process(model, k)]
    seen = model.poses.tags[k]
    if seen is not None:
        initial.insert(place_key(k), seen.pose.position)
        factors.append(vector_about(place_key(k), seen.pose.position, _POSITION_PRIOR_SIGMA))
    if model.data.camera is not None and (seen is not None if model.reference.moves else k == 0):
        initial.insert(reference_key(k), so3.to_gtsam(model.reference.nRB[k]))
        if model.reference.covariance is not None:
            R = np.linalg.cholesky(np.linalg.inv(model.reference.covariance[k])).T
            factors.append(rotation_about(reference_key(k), model.reference.nRB[k], R, "reference"))
    factors += sensor_factors(model, k)
    if seen is not None:
        factors.append(tag_factor(model, k, seen))
    return Step(
        time=float(model.poses.span[k, 1]),
        initial=initial,
        factors=factors,
        predict=partial(_predict, model, k, initial) if k > 0 and model.samples(k).whole else None,
        keyframes=range(k, k + 1),
    )


def _trajectory(model: Model, poses: Sequence[int], values: gtsam.Values) -> Attitudes:
    """Attitudes nRb of the static poses, at their middles."""
    wxyz = so3.from_gtsam([values.atRot3(pose_key(k)) for k in poses])
    return Attitudes(model.poses.span[list(poses)].mean(axis=1), wxyz)


def _process(model: Model, k: int) -> list[Factor]:
    """What leads to the attitude of pose k: the turn before it, or nothing."""
    if k > 0 and model.samples(k).whole:
        return [turn_factor(model, k)]
    return [rotation_about(pose_key(k), model.initial[k], np.eye(3) / _ATTITUDE_PRIOR_SIGMA)]


def _predict(model: Model, k: int, initial: gtsam.Values, current: gtsam.Values) -> gtsam.Values:
    """The attitude of pose k carried on by the gyro as calibrated so far; the rest as measured."""
    out = gtsam.Values(initial)
    samples, deviation = model.samples(k), current.atVector(deviation_key(k - 1))
    own = current.atVector(TRIAD_KEYS["gyro"]) + np.append(np.zeros(9), deviation)
    gyro, accel = samples.gyro, samples.accel
    if samples.warmth is not None:
        slopes = model.parameters.slopes
        drifts = {name: np.outer(samples.warmth, current.atVector(SLOPE_KEYS[name])) for name in slopes}
        gyro, accel = gyro - drifts.get("gyro", 0.0), accel - drifts.get("accel", 0.0)
    of_force = []
    if model.parameters.sensitivity is not None:
        of_force = [current.atVector(SENSITIVITY_KEY)[None], current.atVector(TRIAD_KEYS["accel"])[None], accel]
    (turned,) = Turns.of(Samples.of([samples.t]), gyro, own[None], *of_force).rotation
    out.update(deviation_key(k), model.deviation.correlation[k] * deviation)
    before = so3.from_gtsam([current.atRot3(pose_key(k - 1))])[0]
    earth = so3.exp(-model.earth_rate * (samples.t[-1] - samples.t[0]))
    out.update(pose_key(k), so3.to_gtsam(so3.compose(earth, before, turned)))
    return out
