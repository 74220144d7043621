"""Parameters of the cube method: priors, first values, and the numbers that they are reported as."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.triad import FieldPriorFactor, TriadPriorFactor, calibration, triad
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import (
    DEAD_BAND,
    ParameterSpec,
    accel_curvature,
    check_parameters,
    g_sensitivity,
    parameter,
    quantities,
    scalar,
    stated,
)
from alidade.pipelines.estimation.priors import prior_of, prior_sigmas, vector_about
from alidade.pipelines.estimation.problem import Factor, Parameter, Quantity, rotation_vector_coordinates
from alidade.pipelines.methods.cube.recording import CubeConfig, RawConversion
from alidade.pipelines.methods.place import FIELD, known_field
from alidade.pipelines.methods.temperature import ACCEL_SLOPE, GYRO_SLOPE
from alidade.pipelines.methods.triads import MAG_SHAPE, TRIADS, triad_names, triad_specs, with_factor
from alidade.pipelines.settings import Config

TRIAD_KEYS: dict[str, int] = {name: int(gtsam.symbol(c, 0)) for name, c in zip(TRIADS, "AGM", strict=True)}
MOUNT_KEY, SAID_KEY, FIELD_KEY, SENSITIVITY_KEY, CURVATURE_KEY, LENS_KEY, DEAD_BAND_KEY = (
    int(gtsam.symbol(c, 0)) for c in "CHFSQLD"
)
# Sensor -> variable of its slope over temperature.
SLOPE_KEYS: dict[str, int] = {"gyro": int(gtsam.symbol("K", 0)), "accel": int(gtsam.symbol("J", 0))}

# Prior sigma and accuracy wanted of entries of K, and of b.
_GAIN = 0.2, 5e-3
TRIAD_SPECS = {
    "accel": triad_specs("accel", "m/s^2", _GAIN, (2.0, 0.02), per_recording=True),
    "gyro": triad_specs("gyro", "rad/s", _GAIN, (0.2, 2e-3), per_recording=True),
    "mag": triad_specs("mag", "T", _GAIN, (1e-4, 5e-7)),
}
MOUNT = ParameterSpec(
    "camera_mount",
    "rad",
    5e-3,
    "Camera mount about {axis}, correction of the config.",
    require=1e-2,
    rotation="correction of BRC",
)
# Glued along a line: 0.2 mm at either end of a tag of 0.1 m.
TAG = ParameterSpec(
    "tag_{}",
    "rad",
    3e-3,
    "Tag {first} rotation about {last}, correction of the config.",
    "tags.rotation",
    axes=("*_x", "*_y", "*_z"),
    require=1e-2,
)
# A print on paper, glued by hand along a line.
PLACE = ParameterSpec(
    "tag_{}",
    "m",
    2e-4,
    "Tag {first} position along {last}, correction of the config.",
    "tags.position",
    axes=("*_px", "*_py", "*_pz"),
)
HEADING = scalar("reference_heading", "rad", 1e-2, "Heading error of the reference.", require=1e-2, per_recording=True)

# The grades of consumer MEMS sensors and of a dual-antenna reference, one sigma.
SENSITIVITY = g_sensitivity(2e-4)
SQUARE, CUBE = accel_curvature(1e-5, 1e-6)
TEMPERATURE = {"gyro": GYRO_SLOPE, "accel": ACCEL_SLOPE}
TILT = ParameterSpec(
    "reference_tilt",
    "rad",
    1e-3,
    "Tilt error of the reference about {axis}.",
    "reference.tilt",
    axes="en",
    per_recording=True,
)
# Errors of CameraInfo.
FOCAL = scalar("camera_focal", "", 5e-3, "Relative correction of the focal length.", "camera.focal")
CENTRE = ParameterSpec(
    "camera_centre", "px", 3.0, "Correction of the image centre along {axis}.", "camera.centre", axes="xy"
)
NUISANCE = (SENSITIVITY, SQUARE, CUBE, TILT, FOCAL, CENTRE, *TEMPERATURE.values())
PARAMETERS = (*chain.from_iterable(TRIAD_SPECS.values()), MOUNT, TAG, HEADING, *NUISANCE, DEAD_BAND, PLACE, FIELD)

# Without a camera these are zero by definition of the body frame.
_FRAME = ("accel_k21", "accel_k31", "accel_k32")


def tag_key(tag: int) -> int:
    """Key of a tag's attitude correction on the cube (Rot3)."""
    return int(gtsam.symbol("T", tag))


def tag_place_key(tag: int) -> int:
    """Key of a tag's position correction on the cube, (3,) m."""
    return int(gtsam.symbol("L", tag))


def of_tag(spec: ParameterSpec, tag: int) -> ParameterSpec:
    """Declare the parameters of one tag, from the declaration for all tags."""
    return replace(spec, axes=tuple(axis.replace("*", str(tag)) for axis in spec.axes))


@dataclass(frozen=True)
class Parameters:
    """The calibration variables of a recording.

    Attributes:
        triads: name -> parameter, reported for the raw numbers as recorded.
        priors: name -> (12,) sigmas of rows of K and of b in nominal units; 0 fixed, inf free.
        rotations: mount and tags, corrections about the identity; none without a camera.
        places: corrections of the tags' positions; none without a camera.
        said: correction of what the reference says, tilt about East and North and heading; None without a camera.
        field: the earth's field in n about the model, None without a magnetometer.
        field_prior: its mean (3,), T, and its factor.
        sensitivity: G of the gyro, None where it does not feel force.
        curvature: square and cube terms of the accelerometer, None where it has none.
        slopes: sensor -> what its offset does with its temperature, where that is known.
        lens: what the camera's focal length and centre are off by, None where they are exact.
        dead_band: what the gyro subtracts from its rates, None where it has no dead band, or a stated one.
    """

    triads: Mapping[str, Parameter]
    priors: Mapping[str, Array]
    rotations: tuple[Parameter, ...]
    places: tuple[Parameter, ...]
    said: Parameter | None
    field: Parameter | None
    field_prior: tuple[Array, Factor] | None
    sensitivity: Parameter | None
    curvature: Parameter | None
    slopes: Mapping[str, Parameter]
    lens: Parameter | None = None
    dead_band: Parameter | None = None

    @property
    def all(self) -> tuple[Parameter, ...]:
        """All parameters in reporting order."""
        rest = [*self.rotations[:1], self.said, *self.rotations[1:], *self.places, self.field, *self.assumed]
        return (*self.triads.values(), *(p for p in rest if p is not None))

    @property
    def assumed(self) -> tuple[Parameter | None, ...]:
        """The nuisance parameters."""
        return (self.sensitivity, self.curvature, self.lens, *self.slopes.values(), self.dead_band)

    @property
    def zeros(self) -> tuple[Parameter, ...]:
        """Vector parameters with zero prior mean."""
        return tuple(p for p in (self.said, *self.places, *self.assumed) if p is not None)

    def initial(self, gyro_bias: Array) -> gtsam.Values:
        """Initial values: nominal sensors except the gyro offset (3,), stated mounts, the field model."""
        values = gtsam.Values()
        for name, own in self.triads.items():
            b = -gyro_bias if name == "gyro" else np.zeros(3)
            values.insert(own.key, triad(np.eye(3), b))
        for rotation in self.rotations:
            values.insert(rotation.key, so3.to_gtsam(so3.identity()))
        for vector in self.zeros:
            values.insert(vector.key, np.zeros(len(vector.quantities)))
        if self.field is not None and self.field_prior is not None:
            values.insert(self.field.key, self.field_prior[0])
        return values


def first_priors(parameters: Parameters) -> list[Factor]:
    """Priors on all calibration variables."""
    mean = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    factors = []
    for name, own in parameters.triads.items():
        prior = TriadPriorFactor(np.zeros(1), mean[None], parameters.priors[name][None])
        factors.append(Factor.process_of("prior", prior.on(own.key)))
    factors += map(prior_of, (*parameters.rotations, *parameters.zeros))
    return factors if parameters.field_prior is None else [*factors, parameters.field_prior[1]]


def cube_parameters(
    config: Config,
    camera: bool,
    reference: bool,
    field: Array | None,
    thermometer: bool = False,
    dead_band: bool = False,
) -> Parameters:
    """Build the parameters of a recording, with the config's priors and requirements.

    Args:
        config: its priors and `cube`.
        camera: whether the cube is seen; without, its body frame is the accelerometer's.
        reference: whether the camera's attitude is measured; without, mount and heading mean nothing and are fixed.
        field: (3,) T, the field model in n; None without a magnetometer.
        thermometer: whether the temperature of gyro and accelerometer is measured.
        dead_band: whether the gyro has one.

    Raises:
        InputError: the config names a parameter that the method does not know, or states noise.gyro_scale.
    """
    if config.noise.gyro_scale:
        raise InputError(
            "noise.gyro_scale: cube estimates the gyro's scale and skew, gyro_k11 to gyro_k33, and its g-sensitivity; "
            "leave it out, or write priors: {gyro_k11: ...} and sensors: {gyro: {g_sensitivity: ...}} instead"
        )
    tags = sorted(config.section(CubeConfig).tags)
    check_parameters(
        PARAMETERS,
        config,
        [name for tag in tags for spec in (TAG, PLACE) for name in of_tag(spec, tag).names],
        [MAG_SHAPE],
    )

    def nuisance(spec: ParameterSpec, fixed: bool = False) -> tuple[Quantity, ...]:
        return tuple(replace(q, nuisance=True) for q in quantities(spec, config, fixed))

    triads, priors = {}, {}
    for name in TRIADS if field is not None else TRIADS[:2]:
        numbers = {q.name: q for spec in TRIAD_SPECS[name] for q in quantities(spec, config)}
        for entry in () if camera else _FRAME:
            if entry in numbers and entry not in config.priors:
                numbers[entry] = replace(numbers[entry], prior_sigma=0.0)
        plain = [numbers[entry] for entry in triad_names(name)]
        triads[name] = _triad_parameter(TRIAD_KEYS[name], plain, getattr(config.section(CubeConfig).raw, name))
        priors[name] = prior_sigmas(Parameter(0, tuple(plain)))
    rotations: list[Parameter] = []
    places: list[Parameter] = []
    said = None
    if camera:
        rotations.append(Parameter(MOUNT_KEY, nuisance(MOUNT, not reference), rotation_vector_coordinates))
        for tag in tags:
            # The first tag defines the body frame.
            own = nuisance(_given(of_tag(TAG, tag), config), tag == tags[0])
            rotations.append(Parameter(tag_key(tag), own, rotation_vector_coordinates))
            places.append(Parameter(tag_place_key(tag), quantities(of_tag(PLACE, tag), config, tag == tags[0])))
        tilt = [q if reference else replace(q, prior_sigma=0.0) for q in quantities(TILT, config)]
        said = Parameter(SAID_KEY, (*tilt, *nuisance(HEADING, not reference)))
    field_parameter = field_prior = None
    if field is not None:
        field_parameter, field_prior = _field(config, field)
        mag = triads["mag"]
        triads["mag"] = replace(mag, quantities=with_factor("mag", mag.quantities, config, _GAIN[1]))
    slopes = {name: parameter(SLOPE_KEYS[name], (each,), config) for name, each in TEMPERATURE.items()}
    return Parameters(
        triads=triads,
        priors=priors,
        rotations=tuple(rotations),
        places=tuple(places),
        said=said,
        field=field_parameter,
        field_prior=field_prior,
        sensitivity=parameter(SENSITIVITY_KEY, (SENSITIVITY,), config),
        curvature=parameter(CURVATURE_KEY, (SQUARE, CUBE), config),
        lens=parameter(LENS_KEY, (FOCAL, CENTRE), config) if camera else None,
        slopes={name: each for name, each in slopes.items() if thermometer and each is not None},
        dead_band=parameter(DEAD_BAND_KEY, (DEAD_BAND,), config) if dead_band else None,
    )


def _field(config: Config, model: Array) -> tuple[Parameter, tuple[Array, Factor]]:
    """Field parameter, its prior mean (3,) and prior factor; the config's priors take precedence."""
    mean, along, across = known_field(config, model)
    plain = tuple(
        replace(q, prior_mean=float(m), nuisance=True)
        for q, m in zip(quantities(_given(FIELD, config), config), mean, strict=True)
    )
    if config.priors.keys().isdisjoint(FIELD.names):
        squares = (mean / np.linalg.norm(mean)) ** 2
        sigmas = np.sqrt(along**2 * squares + across**2 * (1.0 - squares))
        plain = tuple(replace(q, prior_sigma=float(s)) for q, s in zip(plain, sigmas, strict=True))
        known = FieldPriorFactor(np.zeros(1), mean[None], np.array([along]), np.array([across]))
        prior = Factor.process_of("prior", known.on(FIELD_KEY))
    else:
        prior = vector_about(FIELD_KEY, mean, prior_sigmas(Parameter(FIELD_KEY, plain)))
    return Parameter(FIELD_KEY, with_factor("mag", plain, config, _GAIN[1])), (mean, prior)


def _given(spec: ParameterSpec, config: Config) -> ParameterSpec:
    """Give a spec its data-sheet prior without marking it as a sensor error."""
    return replace(spec, prior=stated(config, spec), data_sheet="")


def _triad_parameter(key: int, plain: Sequence[Quantity], conversion: RawConversion | None) -> Parameter:
    """Parameter of a triad as reported: nominal = K raw + b, for raw numbers as recorded.

    With nominal = K' (raw - offset) scale + b' it is K = K' scale, b = b' - K (offset, offset, offset); the sigmas of
    priors and the accuracies wanted follow.
    """
    means = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    if conversion is None:
        known = tuple(replace(q, prior_mean=float(mean)) for q, mean in zip(plain, means, strict=True))
        return Parameter(key, known, partial(_coordinates, np.eye(12)))
    scale, offset = conversion.scale, conversion.offset
    linear = np.diag([scale] * 9 + [1.0] * 3)
    for i in range(3):
        linear[9 + i, 3 * i : 3 * i + 3] = -offset * scale

    def through(sigmas: Sequence[float]) -> list[float]:
        return [float(s) for s in np.sqrt(linear**2 @ np.square(sigmas))]

    scales, requires = through([q.prior_scale for q in plain]), through([q.require for q in plain])
    sigmas = through([q.prior_scale if q.prior_sigma is None else q.prior_sigma for q in plain])
    reported = []
    for i, q in enumerate(plain):
        on = plain[3 * (i - 9) : 3 * (i - 9) + 3] if i >= 9 else []
        free = any(p.prior_sigma is None for p in (q, *on))
        unit = f"{plain[9].unit}/count" if i < 9 else q.unit
        sigma = None if free else sigmas[i]
        reported.append(Quantity(q.name, unit, sigma, scales[i], requires[i], prior_mean=float(linear[i] @ means)))
    return Parameter(key, tuple(reported), partial(_coordinates, linear))


def _coordinates(linear: Array, values: gtsam.Values, key: int) -> tuple[Array, Array]:
    """Reported numbers of a triad, as a linear function (12, 12) of K by rows and b, with Jacobian."""
    numbers, J = calibration(np.asarray(values.atVector(key), dtype=float))
    return linear @ numbers, linear @ J
