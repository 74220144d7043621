"""Settings of the cube's simulator, and the config that its recordings carry."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from alidade.pipelines.methods.cube.faces import FACES, Resting
from alidade.pipelines.settings import SensorSheets
from alidade.pipelines.simulation.scenario import NotNegative, Positive, ScenarioPart, Share
from alidade.pipelines.simulation.sensors import Warming, recording_config

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
