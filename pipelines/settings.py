"""What the config of a session may say. Reading and checking one is pipelines.config's work.

config.noise.gyro_density           # None where the config does not say
config.topic(IMU)                   # the topic's name, renamed or default
config.section(IndexerConfig)       # what is said for one method
"""

from __future__ import annotations

import datetime
from collections.abc import Collection, Iterable
from typing import Annotated, ClassVar, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    PrivateAttr,
    model_serializer,
)
from pydantic import Tag as Case

from pipelines.belief import Belief, independent
from pipelines.errors import InputError, nearest
from pipelines.recording.sources import TopicSource
from pipelines.recording.table_topics import TableTopic
from pipelines.recording.topics import Topic

# Names of the attachments that hold a recording's config and, if simulated, its truth.
ATTACHMENT = "alidade.yaml"
TRUTH = "truth.json"
_UNIT_TOLERANCE = 1e-3


def _unit(wxyz: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = sum(x * x for x in wxyz) ** 0.5
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise ValueError(f"a unit quaternion w, x, y, z is needed, this one has norm {norm:.4g}")
    w, x, y, z = (component / norm for component in wxyz)
    return w, x, y, z


def _date(value: object) -> object:
    return datetime.date.fromisoformat(value) if isinstance(value, str) else value


Sigma = Annotated[float, Field(gt=0.0)]
SigmaOrZero = Annotated[float, Field(ge=0.0)]
Date = Annotated[datetime.date, BeforeValidator(_date)]
Quaternion = Annotated[tuple[float, float, float, float], Field(strict=False), AfterValidator(_unit)]
Vector = Annotated[tuple[float, float, float], Field(strict=False)]


class Section(BaseModel):
    """Keys and values: strict, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Noise(Section):
    """Noise of the sensors: densities per sqrt(Hz), walks per sqrt(s), the others per sample; None where not given.

    gyro_scale (no unit) is what scale and alignment errors of the gyro add: a fraction of the angle turned. What the
    mean over a rest repeats to beside white noise: gyro_, accel_, mag_repeatability, in the sensor's unit; the
    angle turned from rest to rest: turn_repeatability, a fraction of it.
    """

    gyro_density: Sigma | None = None
    gyro_bias_walk: SigmaOrZero | None = None
    gyro_scale: SigmaOrZero | None = None
    platform_gyro_density: SigmaOrZero | None = None
    accel_density: Sigma | None = None
    mag_density: Sigma | None = None
    los_error: Sigma | None = None
    los_roll: Sigma | None = None
    encoder: SigmaOrZero | None = None
    vision_attitude: Sigma | None = None
    corner_px: Sigma | None = None
    gyro_repeatability: SigmaOrZero | None = None
    turn_repeatability: SigmaOrZero | None = None
    accel_repeatability: SigmaOrZero | None = None
    mag_repeatability: SigmaOrZero | None = None


# Where neither the config nor a message says anything.
DEFAULT_NOISE = Noise(
    gyro_density=5.0e-5,
    gyro_bias_walk=1.0e-6,
    gyro_scale=0.0,
    platform_gyro_density=1.0e-5,
    accel_density=2.0e-3,
    mag_density=5.0e-8,
    los_error=2.0e-5,
    los_roll=2.0e-4,
    encoder=1.0e-5,
    vision_attitude=8.7e-3,
    corner_px=0.3,
    gyro_repeatability=2.0e-5,
    turn_repeatability=1.0e-3,
    accel_repeatability=5.0e-4,
    mag_repeatability=2.0e-8,
)


class Sheet(Section):
    """A data sheet, one sigma each; a figure not given is that of the usual grade, one that is null ten times that."""

    @model_serializer
    def _given(self) -> dict[str, float | None]:
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}


class GyroSheet(Sheet):
    """Of a gyro.

    scale, no unit; skew, rad: half the angle error between two axes; g_sensitivity, rad/s per m/s^2; temperature: slope
    of the bias, rad/s/K.
    """

    scale: SigmaOrZero | None = None
    skew: SigmaOrZero | None = None
    g_sensitivity: SigmaOrZero | None = None
    temperature: SigmaOrZero | None = None


class PlatformGyroSheet(Sheet):
    """The same of a platform's gyro, with its bias, rad/s."""

    bias: SigmaOrZero | None = None
    scale: SigmaOrZero | None = None
    skew: SigmaOrZero | None = None


class CameraSheet(Sheet):
    """Of a camera, or of what makes angles of its pictures.

    scale of the angles, no unit; roll, rad: about its line of sight as it is mounted; focal, a share of CameraInfo's
    focal length, and centre, px: what these are off by.
    """

    scale: SigmaOrZero | None = None
    roll: SigmaOrZero | None = None
    focal: SigmaOrZero | None = None
    centre: SigmaOrZero | None = None


class EncoderSheet(Sheet):
    """Of encoders: amplitude of the error that comes once a turn, sine and cosine each, rad; delay of a reading, s."""

    once_per_turn: SigmaOrZero | None = None
    delay: SigmaOrZero | None = None


class ClockSheet(Sheet):
    """Of the pictures' clock against the gyro's: offset, s, of a tracker that was not calibrated; skew, s/s."""

    offset: SigmaOrZero | None = None
    skew: SigmaOrZero | None = None


class AccelSheet(Sheet):
    """Of an accelerometer that reads u + square u^2 + cube u^3: square, s^2/m, and cube, (s^2/m)^2.

    temperature: slope of its offset, m/s^2/K.
    """

    square: SigmaOrZero | None = None
    cube: SigmaOrZero | None = None
    temperature: SigmaOrZero | None = None


class ReferenceSheet(Sheet):
    """Of an attitude reference: tilt of its level, rad."""

    tilt: SigmaOrZero | None = None


class FieldSheet(Sheet):
    """Of the earth's magnetic field where the recording is made: model_error, T, of its model there."""

    model_error: Sigma | None = None


class GimbalSheet(Sheet):
    """Of a gimbal: collimation, the optical axis against the elevation axis, and its axes not perpendicular, rad."""

    collimation: SigmaOrZero | None = None
    nonperpendicularity: SigmaOrZero | None = None


class TargetSheet(Sheet):
    """Of a target: rate at which the direction to it turns, rad/s."""

    rate: SigmaOrZero | None = None


class Sensors(Section):
    """Data sheets of the sensors; what they do not say is as in sensors of the usual grade."""

    gyro: GyroSheet = GyroSheet()
    accel: AccelSheet = AccelSheet()
    platform_gyro: PlatformGyroSheet = PlatformGyroSheet()
    camera: CameraSheet = CameraSheet()
    clock: ClockSheet = ClockSheet()
    encoder: EncoderSheet = EncoderSheet()
    reference: ReferenceSheet = ReferenceSheet()
    field: FieldSheet = FieldSheet()
    gimbal: GimbalSheet = GimbalSheet()
    target: TargetSheet = TargetSheet()


def _ideal(value: object) -> object:
    """`ideal` written out: all figures 0, but for the field, which is no sensor."""
    if value == "ideal":
        sheets = {name: type(sheet).model_fields for name, sheet in Sensors() if name != "field"}
        return {name: dict.fromkeys(figures, 0.0) for name, figures in sheets.items()}
    if isinstance(value, str):
        raise ValueError(f"must be data sheets by sensor, or ideal, not {value!r}")
    return value


SensorSheets = Annotated[Sensors, BeforeValidator(_ideal)]


class Tag(Section):
    """A tag: edge of the black square m, rotation bodyRtag (w, x, y, z), position in the body m."""

    size: Sigma
    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    position: Vector = (0.0, 0.0, 0.0)


class Board(Section):
    """Tags on one rigid body, by id."""

    tag_family: str = "36h11"
    tags: dict[int, Tag] = {}


class KnownPrior(Section):
    """A prior with a mean; sigma 0 fixes the parameter there."""

    mean: float
    sigma: SigmaOrZero


# A sigma, null, or mean and sigma; the names of cases are left out of messages.
PriorEntry = Annotated[
    Annotated[SigmaOrZero | None, Case("[sigma]")] | Annotated[KnownPrior, Case("[known]")],
    Discriminator(lambda given: "[known]" if isinstance(given, (dict, KnownPrior)) else "[sigma]"),
]


def _share(value: object) -> str | float:
    if value in ("device", "recording"):
        return str(value)
    if isinstance(value, int | float) and not isinstance(value, bool) and 0.0 <= value < float("inf"):
        return float(value)
    raise ValueError("must be device, recording, or how far it walks in the root of a day")


Share = Annotated[str | float, PlainValidator(_share)]


class MethodSection(Section):
    """What a config says for one method alone, under that method's key."""

    key: ClassVar[str]


_Own = TypeVar("_Own", bound=MethodSection)


class Config(Section):
    """A whole config; every key optional. Sections of methods are added where it is read, see pipelines.config."""

    method: str | None = None
    topics: dict[str, TopicSource] = {}
    columns: dict[str, TableTopic] = {}
    noise: Noise = Noise()
    noise_known: SigmaOrZero = 0.1
    priors: dict[str, PriorEntry] = {}
    share: dict[str, Share] = {}
    require: dict[str, Sigma] = {}
    sensors: SensorSheets = Sensors()
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    longitude_deg: Annotated[float, Field(ge=-180.0, le=360.0)] | None = None
    height: float | None = None
    date: Date | None = None
    _belief: Belief | None = PrivateAttr(None)

    def prior(self, name: str, default: float | None) -> float | None:
        """Sigma of a parameter's prior where the config gives one, else the default."""
        given = self.priors.get(name, default)
        return given.sigma if isinstance(given, KnownPrior) else given

    def believing(self, belief: Belief) -> Config:
        """The same config with what is known from elsewhere; what it says of priors itself goes before that."""
        out = self.model_copy()
        out._belief = belief
        return out

    @property
    def beliefs(self) -> list[Belief]:
        """Priors with means: those given by hand, and what is known from elsewhere of the other parameters."""
        given = {name: prior for name, prior in self.priors.items() if isinstance(prior, KnownPrior)}
        by_hand = independent(list(given), [p.mean for p in given.values()], [p.sigma for p in given.values()])
        if self._belief is None:
            return [by_hand] if given else []
        return [by_hand, self._belief.of([name for name in self._belief.names if name not in self.priors])]

    def topic(self, topic: Topic) -> str:
        """Name of a topic, renamed or default."""
        source = self.topics.get(topic.key)
        return topic.name if source is None else source.name

    def section(self, kind: type[_Own]) -> _Own:
        """What it says for one method, by the model of that section; as by default where it says nothing."""
        found = getattr(self, kind.key, None)
        return found if isinstance(found, kind) else kind()


def check_names(given: Iterable[str], known: Collection[str], where: str) -> None:
    """Raise InputError, naming the nearest known name, if one given under the key `where` is not known."""
    for name in given:
        if name not in known:
            raise InputError(f"unknown key {where}.{name}{nearest(name, known)}")


def first_given(*values: float | None) -> float:
    """Of config, message covariance and default, in this order, the first that says something.

    Raises ValueError if none does.
    """
    for value in values:
        if value is not None:
            return value
    raise ValueError("no value given, not even a default")
