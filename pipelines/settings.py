"""Model of a session's config. Reading and checking one is alidade.pipelines.config's work.

config.noise.gyro_density           # None where the config does not say
config.topic(IMU)                   # the topic's name, renamed or default
config.section(IndexerConfig)       # what is said for one method
"""

from __future__ import annotations

import datetime
import reprlib
from collections.abc import Collection, Iterable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic import Tag as Case

from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.gaussian_prior import GaussianPrior, independent
from alidade.pipelines.noises import NOISES
from alidade.pipelines.recording.table_topics import TableTopic
from alidade.pipelines.recording.topics import Topic, TopicSource

# Names of the attachments that hold a recording's config and, if simulated, its truth.
ATTACHMENT = "alidade.yaml"
TRUTH = "truth.json"
# Before a corrected topic's name, the name of the attachment that states which topic was corrected.
CORRECTED = "corrected:"
_UNIT_TOLERANCE = 1e-3


def _unit(wxyz: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = sum(x * x for x in wxyz) ** 0.5
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise ValueError(f"a unit quaternion w, x, y, z is needed, this one has norm {norm:.4g}")
    w, x, y, z = (component / norm for component in wxyz)
    return w, x, y, z


def _date(value: object) -> object:
    try:
        return datetime.date.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        raise ValueError("a date year-month-day is needed, as 2026-11-20") from None


# In whatever SI unit no figure of a sensor, a mount or a site is larger, and no sigma but 0 smaller: their squares and
# products overflow or vanish, in native code without a word.
_LARGEST, _LEAST_SIGMA = 1e9, 1e-15
# T: of a field in a shield or coils that a magnetometer can be calibrated in; other numbers are of another unit.
_WEAKEST_FIELD, _STRONGEST_FIELD = 1e-6, 1e-3


def _not_tiny(sigma: float) -> float:
    if 0.0 < sigma < _LEAST_SIGMA:
        raise ValueError(f"must be 0 or at least {_LEAST_SIGMA:g}")
    return sigma


Sigma = Annotated[float, Field(gt=0.0), AfterValidator(_not_tiny)]
SigmaOrZero = Annotated[float, Field(ge=0.0), AfterValidator(_not_tiny)]
# Beyond it native code that looks for the pose of a tag ends the process.
TagSize = Annotated[float, Field(gt=0.0, le=100.0), AfterValidator(_not_tiny)]
# No sensor has more, in any of the units below; beyond it arithmetic overflows.
NoiseSigma = Annotated[float, Field(gt=0.0, le=1e3), AfterValidator(_not_tiny)]
NoiseOrZero = Annotated[float, Field(ge=0.0, le=1e3), AfterValidator(_not_tiny)]
Date = Annotated[datetime.date, BeforeValidator(_date)]
Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False), AfterValidator(_unit)]
Vector = Annotated[tuple[float, float, float], Field(strict=False)]


class Section(BaseModel):
    """Base of a config's sections: strict, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _bounded(cls, value: object) -> object:
        """Check the size of every number, however deep in a list or a mapping."""
        if isinstance(value, float | int) and abs(value) > _LARGEST:
            raise ValueError(f"must be between -{_LARGEST:g} and {_LARGEST:g}")
        if isinstance(value, list | tuple | dict):
            for one in value.values() if isinstance(value, dict) else value:
                cls._bounded(one)
        return value


class Noise(Section):
    """Noise of the sensors, one sigma each; null where not given."""

    gyro_density: NoiseSigma | None = None  # rad/s/sqrt(Hz), white noise
    gyro_rate_noise: NoiseOrZero | None = None  # 1/sqrt(Hz), white noise that grows with the rate
    gyro_bias_walk: NoiseOrZero | None = None  # rad/s/sqrt(s)
    gyro_scale: NoiseOrZero | None = None  # fraction of the angle turned that errors not estimated add
    platform_gyro_density: NoiseOrZero | None = None  # rad/s/sqrt(Hz)
    accel_density: NoiseSigma | None = None  # m/s^2/sqrt(Hz)
    mag_density: NoiseSigma | None = None  # T/sqrt(Hz)
    los_error: NoiseSigma | None = None  # rad per measurement
    los_roll: NoiseSigma | None = None  # rad per measurement
    encoder: NoiseOrZero | None = None  # rad per sample
    vision_attitude: NoiseSigma | None = None  # rad per axis and frame
    vision_rate_noise: NoiseOrZero | None = None  # s: rad per axis and frame at 1 rad/s
    corner_px: NoiseSigma | None = None  # px per axis
    gyro_repeatability: NoiseOrZero | None = None  # rad/s, of means over a rest, beside white noise
    turn_repeatability: NoiseOrZero | None = None  # fraction of the angle turned from rest to rest
    accel_repeatability: NoiseOrZero | None = None  # m/s^2, of means over a rest
    mag_repeatability: NoiseOrZero | None = None  # T, of means over a rest


# Where neither the config nor a message says anything.
DEFAULT_NOISE = Noise.model_validate({name: spec.default for name, spec in NOISES.items() if spec.default is not None})


class Sheet(Section):
    """A data sheet, one sigma each; a figure not given is that of the usual grade, one that is null ten times that."""

    @model_serializer
    def _given(self) -> dict[str, float | None]:
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}


class GyroSheet(Sheet):
    """Data sheet of a gyro, one sigma each."""

    scale: SigmaOrZero | None = None  # no unit
    skew: SigmaOrZero | None = None  # rad: half the angle error between two axes
    g_sensitivity: SigmaOrZero | None = None  # rad/s per m/s^2
    filter: SigmaOrZero | None = None  # s^2, half the second moment of its impulse response, beyond a sample interval's
    temperature: SigmaOrZero | None = None  # rad/s/K, slope of the bias
    dead_band: SigmaOrZero | None = None  # rad/s, what a gyro with one subtracts from the size of its rates


class PlatformGyroSheet(Sheet):
    """Data sheet of a platform's gyro, one sigma each."""

    bias: SigmaOrZero | None = None  # rad/s
    scale: SigmaOrZero | None = None  # no unit
    skew: SigmaOrZero | None = None  # rad: half the angle error between two axes


class CameraSheet(Sheet):
    """Data sheet of a camera, or of what makes angles of its pictures."""

    scale: SigmaOrZero | None = None  # of the angles, no unit
    filter: SigmaOrZero | None = None  # s^2, half of second moments of impulse responses, the camera's less the gyro's
    map: SigmaOrZero | None = None  # rad rms, of errors by attitude or gimbal angles
    roll: SigmaOrZero | None = None  # rad, about its line of sight as it is mounted
    focal: SigmaOrZero | None = None  # a share of CameraInfo's focal length that this is off by
    centre: SigmaOrZero | None = None  # px that CameraInfo's centre is off by


class EncoderSheet(Sheet):
    """Data sheet of encoders."""

    once_per_turn: SigmaOrZero | None = None  # rad: amplitude of the error that comes once a turn, sine and cosine each
    delay: SigmaOrZero | None = None  # s: how late a reading was taken


class ClockSheet(Sheet):
    """Data sheet of the pictures' clock against the gyro's."""

    offset: SigmaOrZero | None = None  # s, of a tracker that was not calibrated
    skew: SigmaOrZero | None = None  # s/s


class AccelSheet(Sheet):
    """Data sheet of an accelerometer that reads u + square u^2 + cube u^3."""

    square: SigmaOrZero | None = None  # s^2/m
    cube: SigmaOrZero | None = None  # (s^2/m)^2
    temperature: SigmaOrZero | None = None  # m/s^2/K, slope of the offset


class MagSheet(Sheet):
    """Data sheet of a magnetometer."""

    delay: SigmaOrZero | None = None  # s, of a reading against its stamp


class ReferenceSheet(Sheet):
    """Data sheet of an attitude reference."""

    tilt: SigmaOrZero | None = None  # rad, of its level


class FieldSheet(Sheet):
    """Uncertainty of the earth's magnetic field where the recording is made."""

    model_error: Sigma | None = None  # T, of its model there


class Strength(Section):
    """Measured strength of the magnetic field."""

    value: float  # T
    sigma: Sigma  # T

    @model_validator(mode="after")
    def _in_tesla(self) -> Self:
        if not (_WEAKEST_FIELD <= self.value <= _STRONGEST_FIELD and self.sigma < self.value):
            raise ValueError("value and sigma are in T; the earth's field has 2.2e-5 to 6.7e-5")
        return self


class EarthField(Section):
    """Settings of the earth's magnetic field."""

    strength: Strength | None = None  # null: the model's


class GimbalSheet(Sheet):
    """Data sheet of a gimbal."""

    collimation: SigmaOrZero | None = None  # rad: optical axis against elevation axis
    nonperpendicularity: SigmaOrZero | None = None  # rad: elevation axis against azimuth axis


class TargetSheet(Sheet):
    """Data sheet of a target."""

    rate: SigmaOrZero | None = None  # rad/s: turn of the direction to it


class TagsSheet(Sheet):
    """Uncertainty of tags on a body, placed as a drawing says."""

    position: SigmaOrZero | None = None  # m, each way, against the tag with the lowest id
    rotation: SigmaOrZero | None = None  # rad, about each axis, of every tag


class Sensors(Section):
    """Data sheets of the sensors; what they do not say is as in sensors of the usual grade."""

    gyro: GyroSheet = GyroSheet()
    accel: AccelSheet = AccelSheet()
    mag: MagSheet = MagSheet()
    platform_gyro: PlatformGyroSheet = PlatformGyroSheet()
    camera: CameraSheet = CameraSheet()
    clock: ClockSheet = ClockSheet()
    encoder: EncoderSheet = EncoderSheet()
    reference: ReferenceSheet = ReferenceSheet()
    field: FieldSheet = FieldSheet()
    gimbal: GimbalSheet = GimbalSheet()
    target: TargetSheet = TargetSheet()
    tags: TagsSheet = TagsSheet()


def _ideal(kind: type[Sensors], value: object) -> object:
    """Expand `ideal` to data sheets of zeros, apart from the field and the rotation of tags, which are no sensors."""
    if value == "ideal":
        sheets = {name: type(sheet).model_fields.keys() for name, sheet in kind() if name != "field"}
        return {name: dict.fromkeys(figures - {"rotation"}, 0.0) for name, figures in sheets.items()}
    if isinstance(value, str):
        raise ValueError("must be data sheets by sensor, or ideal")
    return value


def sensor_sheets(kind: type[Sensors]) -> Any:
    """Return the type of a config's data sheets: by sensor, or `ideal`."""
    return Annotated[kind, BeforeValidator(partial(_ideal, kind))]


SensorSheets = Annotated[Sensors, BeforeValidator(partial(_ideal, Sensors))]


class Vision(Section):
    """Settings of what measures attitudes."""

    kind: Literal["mocap", "pnp", "vio", "other"] = "other"  # mocap: its vision_scale is 0


class Tag(Section):
    """A tag on a body."""

    size: TagSize  # m: edge of the black square
    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)  # bodyRtag as w, x, y, z
    position: Vector = (0.0, 0.0, 0.0)  # in the body, m


class Board(Section):
    """Tags on one rigid body, by id."""

    tag_family: str = "36h11"  # of AprilTag
    tags: dict[int, Tag] = {}  # by id


class KnownPrior(Section):
    """A prior with a mean; sigma 0 fixes the parameter there."""

    mean: float  # SI, as the result reports the parameter
    sigma: SigmaOrZero  # one sigma, SI


# A sigma, null, or mean and sigma; the names of cases are left out of messages.
PriorEntry = Annotated[
    Annotated[SigmaOrZero | None, Case("[sigma]")] | Annotated[KnownPrior, Case("[known]")],
    Discriminator(lambda given: "[known]" if isinstance(given, (dict, KnownPrior)) else "[sigma]"),
]


def _share(value: object) -> str | float:
    if value in ("device", "recording", "walks"):
        return str(value)
    if isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value < float("inf"):
        return float(value)
    raise ValueError("must be device, recording, walks, or how far it walks in the root of a day")


Share = Annotated[str | float, PlainValidator(_share)]


class MethodSection(Section):
    """Base of a config's section for one method alone, under that method's key."""

    key: ClassVar[str]


_Own = TypeVar("_Own", bound=MethodSection)
_Model = TypeVar("_Model", bound=BaseModel)


class Config(Section):
    """A whole config; every key optional. Sections of methods are added where it is read, see pipelines.config."""

    method: str | None = None  # that is meant; by default what fits
    topics: dict[str, TopicSource] = {}  # key of a topic: its name, or what it is made of
    columns: dict[str, TableTopic] = {}  # topic: the columns of a table that make it
    noise: Noise = Noise()  # of the sensors
    noise_known: Annotated[SigmaOrZero, Field(le=10.0)] = (
        0.1  # how well figures under noise are known: sigma of the logarithm; 0: exactly
    )
    priors: dict[str, PriorEntry] = {}  # parameter: sigma, or mean and sigma; 0 fixes it, null leaves it free
    share: dict[str, Share] = {}  # parameter or pattern: device, recording, walks, or how far in the root of a day
    require: dict[str, Sigma] = {}  # parameter: sigma wanted
    sensors: SensorSheets = Sensors()  # data sheets; ideal: all figures 0
    vision: Vision = Vision()  # what measures attitudes
    field: EarthField = EarthField()
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None  # deg north; wins over fixes
    longitude_deg: Annotated[float, Field(ge=-180.0, le=360.0)] | None = None  # deg east
    altitude_m: float | None = None  # above the ellipsoid
    date: Date | None = None  # of the field model; default: the stamps
    _gaussian_prior: GaussianPrior | None = PrivateAttr(None)
    _origin: str = PrivateAttr("")

    @property
    def origin(self) -> str:
        """Name of the file that the config's keys are from, or of its substitute; empty where unknown."""
        return self._origin

    def of(self, origin: str) -> Config:
        """The config with the name of the file that it is from."""
        out = self.model_copy()
        out._origin = origin
        return out

    def prior(self, name: str, default: float | None) -> float | None:
        """Return the sigma of a parameter's prior: the config's if it states one, else the default."""
        given = self.priors.get(name, default)
        return given.sigma if isinstance(given, KnownPrior) else given

    @property
    def gaussian_prior(self) -> GaussianPrior | None:
        """Prior means and covariance from outside the config, such as an earlier calibration; None without."""
        return self._gaussian_prior

    def with_prior(self, gaussian_prior: GaussianPrior) -> Config:
        """Return the config with a prior from outside; priors that the config itself states take precedence."""
        out = self.model_copy()
        out._gaussian_prior = gaussian_prior
        return out

    @property
    def gaussian_priors(self) -> list[GaussianPrior]:
        """Return the priors with means: those in the config, and for other parameters those from outside."""
        given = {name: prior for name, prior in self.priors.items() if isinstance(prior, KnownPrior)}
        by_hand = independent(list(given), [p.mean for p in given.values()], [p.sigma for p in given.values()])
        if self._gaussian_prior is None:
            return [by_hand] if given else []
        return [
            by_hand,
            self._gaussian_prior.of([name for name in self._gaussian_prior.names if name not in self.priors]),
        ]

    def topic(self, topic: Topic) -> str:
        """Name of a topic, renamed or default."""
        source = self.topics.get(topic.key)
        return topic.name if source is None else source.name

    def base(self, topic: Topic) -> str:
        """Name of the recorded topic whose stamps a topic has."""
        source = self.topics.get(topic.key)
        return topic.name if source is None else source.parts[0]

    def section(self, kind: type[_Own]) -> _Own:
        """Section of one method, by its model; defaults where the config has none."""
        found = getattr(self, kind.key, None)
        return found if isinstance(found, kind) else kind()


def check_names(given: Iterable[str], known: Collection[str], where: str) -> None:
    """Raise InputError, with the nearest known name, for the first given name that is not known under `where`."""
    for name in given:
        if name not in known:
            raise InputError(f"unknown key {where}.{name}{nearest(name, known)}")


def first_given(*values: float | None) -> float:
    """Return the first value that is not None: of config, message covariance and default, in this order.

    Raises ValueError if none does.
    """
    for value in values:
        if value is not None:
            return value
    raise ValueError("no value given, not even a default")


def first_error(error: ValidationError, model: type[BaseModel]) -> tuple[tuple[int | str, ...], str]:
    """Return the path of the first error in content that a model rejects, and a sentence about it."""
    # An unknown key explains more than what follows from it.
    first: Any = min(error.errors(), key=lambda found: found["type"] != "extra_forbidden")
    path = tuple(part for part in first["loc"] if not str(part).startswith("["))
    key, given = ".".join(map(str, path)) or "the whole", first["input"]
    if first["type"] == "extra_forbidden":
        return path, f"unknown key {key}{nearest(str(path[-1]), _known_at(model, path[:-1]))}"
    if first["type"] == "missing":
        return path[:-1], f"{key}: is missing"
    if first["type"] in ("model_type", "dict_type", "model_attributes_type"):
        return path, f"{key}: must be a section of keys, not {reprlib.repr(given)}"
    text = first["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    return path, f"{key}: {text}{'' if isinstance(given, dict) else f', not {reprlib.repr(given)}'}"


def validated(model: type[_Model], content: object, where: object) -> _Model:
    """Return content as a model. Raises InputError with the first error, and where it is."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{where}: {first_error(error, model)[1]}") from error


def _known_at(model: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the section at a path."""
    for key in path:
        field = model.model_fields.get(str(key))
        model = (section_in(field.annotation) if field else None) or model  # the id of a tag leads to none of its own
    return list(model.model_fields)


def section_in(annotation: Any) -> type[BaseModel] | None:
    """Return the section that a field of this type has, alone or by key; None without one."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    arguments = getattr(annotation, "__args__", ())
    return next((found for found in map(section_in, arguments) if found), None)
