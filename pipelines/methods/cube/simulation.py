"""Simulator of the `cube` method: a device in a cube of tags, moved by hand through static poses before a camera.

Frames: n level East-North-Up, i which does not turn and is n at t = 0, b the cube, B the reference, C its camera
(optical), T a tag. Attitude and place of the cube are closed-form functions of time. A sample of gyro, accelerometer or
magnetometer is the mean over its interval of the exact quantity: of the rate the sum of the rotations over eight parts
of the interval, of force and field the mean over their middles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.polynomial import Polynomial
from pydantic import Field, model_validator

from alidade.factors import so3
from alidade.factors.array import Array, Index
from alidade.factors.earth import earth_rate, gravity, magnetic_field
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import stated
from alidade.pipelines.methods import Simulator
from alidade.pipelines.methods.cube.parameters import (
    CENTRE,
    CUBE,
    FOCAL,
    NUISANCE,
    PLACE,
    SENSITIVITY,
    SQUARE,
    TEMPERATURE,
    TILT,
    of_tag,
)
from alidade.pipelines.methods.cube.recording import CubeData, Sightings
from alidade.pipelines.methods.place import FIELD
from alidade.pipelines.settings import Config, SensorSheets
from alidade.pipelines.simulation.rendering import Quad, Renderer, encode, expose, tag_quad
from alidade.pipelines.simulation.scenario import EPOCH_NS, YEAR, NotNegative, Positive, ScenarioPart, Share, Simulated
from alidade.pipelines.simulation.sensors import (
    Warming,
    by_axis,
    drift,
    measured,
    recording_config,
    sample_times,
    strength_measured,
    true_values,
)
from alidade.pipelines.vision.camera import Camera

_HALF = float(np.sqrt(0.5))
# id -> (bodyRtag, normal), the faces of the cube.
FACES: dict[int, tuple[tuple[float, float, float, float], tuple[float, float, float]]] = {
    16: ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    17: ((0.5, 0.5, 0.5, 0.5), (1.0, 0.0, 0.0)),
    18: ((0.0, 0.0, _HALF, _HALF), (0.0, 1.0, 0.0)),
    19: ((0.5, 0.5, -0.5, -0.5), (-1.0, 0.0, 0.0)),
    20: ((_HALF, _HALF, 0.0, 0.0), (0.0, -1.0, 0.0)),
    21: ((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
}

Side = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
SIDES: dict[Side, tuple[float, float, float]] = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}


class Resting(ScenarioPart):
    """Attitude of a resting cube: side up, side to the north, then the top leaned to the east."""

    up: Side
    north: Side
    lean_deg: float = 0.0

    @model_validator(mode="after")
    def _across(self) -> Self:
        if self.up[1] == self.north[1]:
            raise ValueError(f"{self.up} up and {self.north} to the north: sides across each other are needed")
        return self

    @property
    def nRb(self) -> Array:
        """Attitude (4,) of the resting cube."""
        up, north = np.array(SIDES[self.up]), np.array(SIDES[self.north])
        level = so3.from_matrix(np.stack([np.cross(north, up), north, up]))
        return so3.multiply(so3.exp([0.0, np.deg2rad(self.lean_deg), 0.0]), level)

    def __str__(self) -> str:
        tag = next(i for i, (_, normal) in FACES.items() if normal == SIDES[self.up])
        lean = f", leaned by {abs(self.lean_deg):g} deg to the {'east' if self.lean_deg > 0.0 else 'west'}"
        return f"{self.up} (tag {tag}) up, {self.north} to the north{lean if self.lean_deg else ''}"


# BRC of a camera that looks along x of the reference, z up.
FORWARD = (-0.5, 0.5, -0.5, 0.5)


class CubeNoise(ScenarioPart):
    """Noise of the sensors, under the names the recording's config gives them."""

    gyro_density: Positive = 1.2e-4  # rad/s/sqrt(Hz)
    gyro_bias_walk: NotNegative = 2e-6  # rad/s/sqrt(s)
    accel_density: Positive = 1.5e-3  # m/s^2/sqrt(Hz)
    mag_density: Positive = 5e-8  # T/sqrt(Hz)
    corner_px: Positive = 0.2  # of the detections; pictures have their own


class Errors(ScenarioPart):
    """Sigmas from which a scenario draws the parameters."""

    gain: NotNegative = 0.02  # of each entry of K - 1
    accel_bias: NotNegative = 0.3  # m/s^2
    gyro_bias: NotNegative = 0.01  # rad/s
    mag_bias: NotNegative = 1e-5  # T
    camera_mount: NotNegative = 5e-3  # rad
    tag_mount: NotNegative = 3e-3  # rad


class FieldErrors(ScenarioPart):
    """Sigmas of the earth's field about its model, T; a data sheet of the field takes precedence."""

    direction: NotNegative = 5e-7  # each way across the model's field
    strength: NotNegative = 5e-7  # along it
    measured: Positive | None = 1e-7  # of the strength that was measured there; null: nobody did


class Place(ScenarioPart):
    """Place on the earth where a scenario is recorded."""

    latitude_deg: float = 40.0
    longitude_deg: float = 116.3
    height: float = 50.0


class TagCube(ScenarioPart):
    """Size and tags of the cube that carries the device, m."""

    edge: Positive = 0.16
    tag_size: Positive = 0.12
    hidden: tuple[int, ...] = ()  # ids of tags that are never seen


class Pictures(ScenarioPart):
    """Settings of the camera, where pictures replace detections."""

    rate_hz: Positive = 5.0
    blur_px: NotNegative = 0.7
    grey_noise: NotNegative = 2.0
    exposure_s: Positive = 4e-3


class CubeCamera(ScenarioPart):
    """The camera that looks at the cube."""

    rate_hz: Positive = 20.0
    distortion: tuple[float, ...] = (-0.12, 0.05, 4e-4, -3e-4, 0.0)
    occluded: Share = 0.05  # of the tags in a picture, by a finger
    pictures: Pictures = Pictures()


class Magnetometer(ScenarioPart):
    """Settings of the device's magnetometer, and of iron near some poses."""

    rate_hz: Positive = 50.0
    disturbed: Share = 0.0  # of the poses stand near iron
    disturbance: NotNegative = 2e-6  # T, sigma per axis


class ReferenceAttitude(ScenarioPart):
    """The attitude reference that carries the camera."""

    rate_hz: Positive = 10.0
    heading_deg: float = 0.0  # correction that its heading needs, and the sigma about it
    heading_error_deg: NotNegative = 0.573
    level_noise_deg: Positive = 0.02  # of roll and pitch, of a message
    heading_noise_deg: Positive = 0.05


class CubeScenario(ScenarioPart):
    """Settings of the `cube` simulator; every key has a default, `null` leaves a sensor out."""

    poses: Annotated[int, Field(ge=0)] = 24  # in random attitudes
    attitudes: list[Resting] = []  # of more poses, after those
    static_s: Positive = 4.0
    turn_rad_s: Positive = 0.8  # mean rate of the turns between poses
    turn_axes: list[tuple[float, float, float]] = []  # in b; turns about these only, in turn; none: any attitude
    distance: Positive = 0.7  # m, of the cube from the camera
    imu_rate_hz: Positive = 100.0
    noise: CubeNoise = CubeNoise()
    errors: Errors = Errors()
    field: FieldErrors = FieldErrors()
    place: Place = Place()
    cube: TagCube = TagCube()
    camera: CubeCamera | None = CubeCamera()
    magnetometer: Magnetometer | None = Magnetometer()
    reference: ReferenceAttitude | None = ReferenceAttitude()
    temperature: Warming | None = None  # of gyro and accelerometer; null: nobody measures it
    # Data sheets that errors of sensors and field are drawn from, passed on to the config; ideal: there are none but
    # those of the field; null: none either, but the config does not know.
    sensors: SensorSheets | None = None
    effects: dict[str, float] = {}  # assumptions by name and their true values, whatever the data sheets
    priors: dict[str, float | None] = {}  # passed on to the recording's config

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.poses + len(self.attitudes):
            raise ValueError("poses or attitudes are needed")
        return self


def cube_config(scenario: CubeScenario, images: bool = False, **more: object) -> str:
    """The recording's config (YAML): cube as drawn, noise simulated, the scenario's priors, more keys."""
    # Simulated sensors repeat as well as white noise lets them.
    repeats = {f"{name}_repeatability": 0.0 for name in ("gyro", "turn", "accel", "mag")}
    noise = {**scenario.noise.model_dump(), **repeats}
    if images:
        del noise["corner_px"]  # the tracker's own
    cube: dict[str, Any] = {}
    if scenario.camera:
        tags = {
            i: {
                "size": scenario.cube.tag_size,
                "rotation": list(wxyz),
                "position": [0.5 * scenario.cube.edge * x for x in normal],
            }
            for i, (wxyz, normal) in FACES.items()
        }
        cube = {"cube": {"tag_family": "36h11", "tags": tags, "camera_rotation": list(FORWARD)}}
    return recording_config("cube", scenario, noise, date="2026-11-20", **cube, **more)


_PARTS = 8
_SQUARE = 0.5 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
# A tag is read when the cosine between its normal and the way to the camera is more than this.
_LEAST_COSINE = 0.3


def simulate_cube(scenario: CubeScenario, seed: int, images: bool = False) -> Simulated:
    """Simulate a session with tag detections, or pictures if requested; the truth of a walking bias is its mean."""
    world = _World(scenario, seed)
    known = strength_measured(world.field, scenario.field.measured, seed) if scenario.magnetometer else {}
    config = cube_config(scenario, images, **known)
    if not images:
        return Simulated(world.data(), world.truth, config)
    if scenario.camera is None:
        raise InputError("pictures are asked for, but the scenario has no camera: take `camera: null` out of it")
    t = sample_times(world.duration, scenario.camera.pictures.rate_hz, 0.5)
    nothing = Sightings(t, *(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 4, 2)), None)
    data = replace(world.data(), sightings=nothing)
    return Simulated(data, world.truth, config, world.pictures(t, scenario.camera.pictures))


def attitudes(scenario: CubeScenario, seed: int) -> Array:
    """Attitudes nRb (P, 4) of the poses of a scenario's session."""
    return _World(scenario, seed).motion.nRb


class _World:
    """A simulated session: truth drawn from the seed, and the sensors."""

    def __init__(self, scenario: CubeScenario, seed: int) -> None:
        self.scenario = scenario
        # What sensors with errors add is drawn apart: a seed gives the same noise whatever they do.
        self.rng, rng_of_sensors = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        places = [of_tag(PLACE, tag) for tag in FACES if tag != min(FACES)]
        self.effects = true_values([*NUISANCE, *places], scenario, rng_of_sensors)
        self.place_rad = np.deg2rad([scenario.place.latitude_deg, scenario.place.longitude_deg])
        latitude, longitude = self.place_rad
        self.field, self.heading = self._surroundings(magnetic_field(latitude, longitude, scenario.place.height, YEAR))
        self.camera = Camera(
            1280,
            960,
            np.array([[1150.0, 0, 641.3], [0, 1150.0, 477.8], [0, 0, 1.0]]),
            "plumb_bob",
            np.array((scenario.camera or CubeCamera()).distortion),
        )
        off = np.array([self.effects[name] for name in (*FOCAL.names, *CENTRE.names)])
        intrinsics = self.camera.intrinsics.copy()
        intrinsics[:4] += np.append(off[0] * self.camera.focal, off[1:])
        # What is recorded is what CameraInfo says.
        self.lens = self.camera.with_intrinsics(intrinsics)
        self.nRB = so3.compose(
            so3.exp([0.0, 0.0, self.rng.uniform(-np.pi, np.pi)]), so3.exp(0.02 * self.rng.standard_normal(3))
        )
        self.mount = scenario.errors.camera_mount * self.rng.standard_normal(3)
        self.nRC = so3.compose(self.nRB, FORWARD, so3.exp(self.mount))
        # The lowest id defines the body frame.
        self.tags = {i: scenario.errors.tag_mount * self.rng.standard_normal(3) * (i != min(FACES)) for i in FACES}
        zero = dict.fromkeys(of_tag(PLACE, min(FACES)).names, 0.0)
        self.moved = {i: np.array([(zero | self.effects)[name] for name in of_tag(PLACE, i).names]) for i in FACES}
        self.K = {
            name: np.eye(3) + scenario.errors.gain * self.rng.standard_normal((3, 3))
            for name in ("accel", "gyro", "mag")
        }
        if not scenario.camera:
            # The accelerometer's own axes define the body frame: its K is upper triangular.
            upper = np.linalg.qr(self.K["accel"])[1]
            self.K["accel"] = np.sign(np.diag(upper))[:, None] * upper
        errors = scenario.errors
        sigmas = {"accel": errors.accel_bias, "gyro": errors.gyro_bias, "mag": errors.mag_bias}
        self.b = {name: sigma * self.rng.standard_normal(3) for name, sigma in sigmas.items()}
        self.motion = drawn_motion(scenario, self.rng)
        self.duration = float(self.motion.stop[-1])
        self.truth: dict[str, float] = {}

    def _surroundings(self, model: Array) -> tuple[Array, float]:
        """Draw the field (3,), T, and the heading correction of the reference, rad.

        The model errs more in the field's direction, by the iron of the building, than in its strength. The draws have
        a generator of their own: what else happens in a seed's session does not depend on them.
        """
        s, (rng,) = self.scenario, self.rng.spawn(1)
        along = model / np.linalg.norm(model)
        error = s.field.direction * rng.standard_normal(3)
        error += along * (s.field.strength * rng.standard_normal() - along @ error)
        if s.sensors is not None and "model_error" in s.sensors.field.model_fields_set:
            error = stated(Config(sensors=s.sensors), FIELD) * rng.standard_normal(3)
        if s.reference is None:
            return model + error, 0.0
        heading_deg = s.reference.heading_deg + s.reference.heading_error_deg * rng.standard_normal()
        return model + error, float(np.deg2rad(heading_deg))

    def data(self) -> CubeData:
        """Simulate all measurements, and set the truth."""
        s = self.scenario
        imu_t, gyro, accel = self._imu()
        data = CubeData(
            EPOCH_NS,
            imu_t,
            gyro,
            accel,
            latitude=float(self.place_rad[0]),
            longitude=float(self.place_rad[1]),
            height=s.place.height,
            gyro_density=s.noise.gyro_density,
            accel_density=s.noise.accel_density,
            temperature=measured(s.temperature, self.duration),
        )
        if s.magnetometer is not None:
            mag_t, mag = self._mag(s.magnetometer)
            data = replace(data, mag_t=mag_t, mag=mag, mag_density=s.noise.mag_density)
        if s.camera is not None:
            data = replace(data, camera=self.camera, sightings=self._sightings(s.camera))
        if s.reference is not None:
            t, wxyz, covariance = self._reference(s.reference)
            data = replace(data, reference_t=t, reference_wxyz=wxyz, reference_cov=covariance)
        self.truth = self._truth()
        return data

    def _moments(self, t: Array, rate_hz: float) -> Array:
        """Centres (N * parts,), s, of the parts that each sample's interval is divided into."""
        offsets = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5) / rate_hz
        return np.asarray((t[:, None] + offsets).ravel())

    def _raw(self, name: str, nominal: Array, density: float, rate_hz: float, walk: Array | float = 0.0) -> Array:
        noise = density * np.sqrt(rate_hz) * self.rng.standard_normal(nominal.shape)
        said = (nominal - self.b[name]) @ np.linalg.inv(self.K[name]).T + walk
        if name == "accel":
            square, cube = ([self.effects[f"accel_{term}_{i}"] for i in "123"] for term in ("square", "cube"))
            said = said + square * said**2 + cube * said**3
        return np.asarray(said + noise)

    def _imu(self) -> tuple[Array, Array, Array]:
        s, rate = self.scenario, self.scenario.imu_rate_hz
        t = sample_times(self.duration, rate)
        edges = np.append(t[:1] - 0.5 / rate, (t[:, None] + (np.arange(1, _PARTS + 1) / _PARTS - 0.5) / rate).ravel())
        iRn = so3.exp(edges[:, None] * earth_rate(self.place_rad[0]))
        iRb = so3.multiply(iRn, self.motion.attitude(edges))
        arcs = so3.local(iRb[:-1], iRb[1:])
        rates = arcs.reshape(-1, _PARTS, 3).sum(axis=1) * rate
        moments = self._moments(t, rate)
        force = so3.rotate(self.nRC, self.motion.position(moments, 2))
        force = force + [0.0, 0.0, float(gravity(self.place_rad[0], s.place.height))]
        accel = so3.rotate(so3.inverse(self.motion.attitude(moments)), force).reshape(-1, _PARTS, 3).mean(axis=1)
        walk = np.cumsum(s.noise.gyro_bias_walk / np.sqrt(rate) * self.rng.standard_normal(rates.shape), axis=0)
        felt = accel @ np.array([[self.effects[f"gyro_g_{i}{j}"] for i in "xyz"] for j in "xyz"])
        drifts = {name: drift(s.temperature, name, self.effects, t) for name in ("gyro", "accel")}
        gyro = self._raw("gyro", rates, s.noise.gyro_density, rate, walk + felt + drifts["gyro"])
        self.b["gyro"] = self.b["gyro"] - self.K["gyro"] @ walk.mean(axis=0)
        return t, gyro, self._raw("accel", accel, s.noise.accel_density, rate, drifts["accel"])

    def _mag(self, sensor: Magnetometer) -> tuple[Array, Array]:
        rate = sensor.rate_hz
        t = sample_times(self.duration, rate, 0.25)
        moments = self._moments(t, rate)
        iron = sensor.disturbance * self.rng.standard_normal((len(self.motion.start), 3))
        iron *= self.rng.random((len(self.motion.start), 1)) < sensor.disturbed
        nearest = np.argmin(np.abs(moments[:, None] - 0.5 * (self.motion.start + self.motion.stop)), axis=1)
        field = so3.rotate(so3.inverse(self.motion.attitude(moments)), self.field + iron[nearest])
        return t, self._raw("mag", field.reshape(-1, _PARTS, 3).mean(axis=1), self.scenario.noise.mag_density, rate)

    def _reference(self, sensor: ReferenceAttitude) -> tuple[Array, Array, Array]:
        t = sample_times(self.duration, sensor.rate_hz, 0.4)
        sigma = np.deg2rad([sensor.level_noise_deg, sensor.level_noise_deg, sensor.heading_noise_deg])
        off = so3.exp([-self.effects["reference_tilt_e"], -self.effects["reference_tilt_n"], -self.heading])
        wxyz = so3.compose(so3.exp(sigma * self.rng.standard_normal((len(t), 3))), off, self.nRB)
        return t, wxyz, np.tile(np.diag(sigma**2), (len(t), 1, 1))

    def _tag(self, tag: int, t: Array) -> tuple[Array, Array, Array]:
        """Tag attitudes cRt (N, 4), positions (N, 3) m, and cosines (N,) of the normal to the camera's direction."""
        wxyz, normal = FACES[tag]
        cRb = so3.multiply(so3.inverse(self.nRC), self.motion.attitude(t))
        cRt = so3.compose(cRb, wxyz, so3.exp(self.tags[tag]))
        in_body = 0.5 * self.scenario.cube.edge * np.array(normal) + self.moved[tag]
        centre = self.motion.position(t) + so3.rotate(cRb, in_body)
        facing = -(so3.rotate(cRt, [0.0, 0.0, 1.0]) * centre).sum(axis=1) / np.linalg.norm(centre, axis=1)
        return cRt, centre, facing

    def _shown(self) -> list[int]:
        return [i for i in FACES if i not in self.scenario.cube.hidden]

    def _sightings(self, sensor: CubeCamera) -> Sightings:
        s, size = self.scenario, np.array([self.camera.width, self.camera.height])
        times = sample_times(self.duration, sensor.rate_hz, 0.3)
        frames, ids, corners = [], [], []
        for i in self._shown():
            cRt, centre, facing = self._tag(i, times)
            rows = np.flatnonzero((facing > _LEAST_COSINE) & (self.rng.random(len(times)) >= sensor.occluded))
            seen = self.lens.project(centre[rows, None] + so3.rotate(cRt[rows, None], s.cube.tag_size * _SQUARE))
            inside = ((seen > 5.0) & (seen < size - 6.0)).all(axis=(1, 2))
            frames.append(rows[inside])
            ids.append(np.full(int(inside.sum()), i))
            corners.append(seen[inside] + s.noise.corner_px * self.rng.standard_normal((int(inside.sum()), 4, 2)))
        frame = np.concatenate(frames)
        order = np.argsort(frame, kind="stable")
        return Sightings(times, frame[order], np.concatenate(ids)[order], np.concatenate(corners)[order], None)

    def pictures(self, times: Array, kind: Pictures) -> Iterator[bytes]:
        """JPEG files of what the camera sees at the times, blurred by the motion while the shutter is open."""
        renderer = Renderer(self.lens)
        for t in times:
            finger = self._finger(float(t))
            still = bool(((self.motion.start <= t) & (t <= self.motion.stop)).any())
            moments = [t] if still else t + kind.exposure_s * np.array([-0.25, 0.25])
            light = np.mean([renderer.radiance(self._quads(float(m), finger)) for m in moments], axis=0)
            yield encode(expose(light, kind.blur_px, kind.grey_noise, self.rng), "jpeg", 95)

    def _tags_at(self, t: float) -> dict[int, tuple[Array, Array]]:
        """Attitude cRt and place (3,) m of the tags that face the camera."""
        found = {i: self._tag(i, np.array([t])) for i in self._shown()}
        return {i: (cRt[0], centre[0]) for i, (cRt, centre, facing) in found.items() if facing[0] > 0.0}

    def _quads(self, t: float, others: list[Quad]) -> list[Quad]:
        tags = self._tags_at(t).items()
        return [*others, *(tag_quad(i, self.scenario.cube.tag_size, cRt, centre) for i, (cRt, centre) in tags)]

    def _finger(self, t: float) -> list[Quad]:
        """A finger on the edge of a tag, drawn at random, as a quad; often none."""
        tags, camera = list(self._tags_at(t).values()), self.scenario.camera
        if not tags or camera is None or self.rng.random() > camera.occluded * len(tags):
            return []
        cRt, centre = tags[self.rng.integers(len(tags))]
        on_edge = so3.rotate(cRt, self.scenario.cube.tag_size * np.array([0.5, self.rng.uniform(-0.4, 0.4), 0.02]))
        return [Quad(np.full((1, 1), 120.0), (0.05, 0.018), cRt, (centre + on_edge) * 0.99)]

    def _truth(self) -> dict[str, float]:
        slopes = TEMPERATURE.values() if self.scenario.temperature else ()
        truth = {name: self.effects[name] for each in (SENSITIVITY, SQUARE, CUBE, *slopes) for name in each.names}
        for name in ("accel", "gyro", *(("mag",) if self.scenario.magnetometer else ())):
            truth |= {f"{name}_k{i + 1}{j + 1}": float(self.K[name][i, j]) for i in range(3) for j in range(3)}
            truth |= {f"{name}_b{i + 1}": float(self.b[name][i]) for i in range(3)}
        if self.scenario.magnetometer:
            truth |= {f"field_{axis}": float(x) for axis, x in zip("enu", self.field, strict=True)}
        if self.scenario.camera:
            truth |= {name: self.effects[name] for each in (FOCAL, CENTRE) for name in each.names}
            vectors = {f"tag_{i}": vector for i, vector in self.tags.items()}
            if self.scenario.reference:
                vectors["camera_mount"] = self.mount
                truth["reference_heading"] = self.heading
                truth |= {name: self.effects[name] for name in TILT.names}
            truth |= by_axis(**vectors)
            truth |= {f"tag_{i}_p{axis}": float(x) for i in FACES for axis, x in zip("xyz", self.moved[i], strict=True)}
        return truth


# From 0 to 1, and from 0 to 1 and back, over [0, 1], at rest with two derivatives at both ends.
_STEP = Polynomial([0, 0, 0, 10, -15, 6])
_BUMP = 64.0 * Polynomial([0, 0, 0, 1]) * Polynomial([1, -1]) ** 3


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the cube: attitudes nRb (P, 4), positions (P, 3), m in C, and detours of the hand between poses.

    start (P,), stop (P,): of the static poses, s. wobble (P - 1, 3) rad in b, detour (P - 1, 3) m.
    """

    start: Array
    stop: Array
    nRb: Array
    place: Array
    wobble: Array
    detour: Array

    def _phase(self, t: Array) -> tuple[Index, Array, Array]:
        """Index of the last static pose at times t, s, share (0 to 1) of the following turn, and its duration, s."""
        k = np.clip(np.searchsorted(self.start, t, side="right") - 1, 0, len(self.start) - 1)
        following = np.minimum(k + 1, len(self.start) - 1)
        duration = np.where(following > k, self.start[following] - self.stop[k], 1.0)
        return k, np.where(following > k, np.clip((t - self.stop[k]) / duration, 0.0, 1.0), 0.0), duration

    def attitude(self, t: Array) -> Array:
        """Attitudes nRb (N, 4) at the times."""
        k, u, _ = self._phase(t)
        if len(self.start) == 1:
            return np.broadcast_to(self.nRb[0], (len(t), 4))
        turn = np.append(so3.local(self.nRb[:-1], self.nRb[1:]), np.zeros((1, 3)), axis=0)
        wobble = np.append(self.wobble, np.zeros((1, 3)), axis=0)
        return so3.compose(self.nRb[k], so3.exp(turn[k] * _STEP(u)[:, None]), so3.exp(wobble[k] * _BUMP(u)[:, None]))

    def position(self, t: Array, derivative: int = 0) -> Array:
        """Position (N, 3), m, of the cube in C at times t, s, or a time derivative of it."""
        k, u, duration = self._phase(t)
        step, bump = (f.deriv(derivative) if derivative else f for f in (_STEP, _BUMP))
        after = np.append(self.place[1:], self.place[-1:], axis=0)
        detour = np.append(self.detour, np.zeros((1, 3)), axis=0)
        moved = (after[k] - self.place[k]) * step(u)[:, None] + detour[k] * bump(u)[:, None]
        return moved / duration[:, None] ** derivative + (0.0 if derivative else self.place[k])


def drawn_attitudes(scenario: CubeScenario, rng: np.random.Generator) -> Array:
    """Attitudes nRb (P, 4) of the poses: the random ones, then those given."""
    n = scenario.poses
    given = np.array([each.nRb for each in scenario.attitudes]).reshape(-1, 4)
    if not (n and scenario.turn_axes):
        return np.vstack([so3.normalize(rng.standard_normal((n, 4))), given])
    axes = np.array([scenario.turn_axes[k % len(scenario.turn_axes)] for k in range(n - 1)]).reshape(-1, 3)
    angle = rng.uniform(0.8, 2.4, n - 1) * rng.choice([-1.0, 1.0], n - 1)
    found = [so3.normalize(rng.standard_normal(4))]
    for axis, a in zip(axes, angle, strict=True):
        found.append(so3.multiply(found[-1], so3.exp(a * axis / np.linalg.norm(axis))))
    return np.vstack([np.array(found), given])


def drawn_motion(s: CubeScenario, rng: np.random.Generator) -> Motion:
    """Draw a motion through the scenario's poses."""
    nRb = drawn_attitudes(s, rng)
    n = len(nRb)
    place = np.array([0.0, 0.0, s.distance]) + [0.04, 0.03, 0.05] * rng.uniform(-1, 1, (n, 3))
    angles = np.linalg.norm(so3.local(nRb[:-1], nRb[1:]), axis=1)
    turning = np.maximum(angles, 0.5) / s.turn_rad_s
    start = np.concatenate([[0.0], np.cumsum(s.static_s + turning)])
    wobble = (0.0 if s.turn_axes else 0.15) * rng.standard_normal((n - 1, 3))
    return Motion(start, start + s.static_s, nRb, place, wobble, 0.05 * rng.standard_normal((n - 1, 3)))


SIMULATOR = Simulator(scenario=CubeScenario, simulate=simulate_cube, randomised=True, has_camera=True)
