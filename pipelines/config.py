"""The config of a session: what it may say, and how attachment and file are put together.

    config = load_config(recording.attachment("alidade.yaml"), Path("more.yaml"))
    config.noise.gyro_density           # None where the config does not say

Everything wrong in a config is an InputError that names the key and the source it stands in.
"""

from __future__ import annotations

import datetime
import difflib
import reprlib
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from pipelines.errors import InputError
from pipelines.recording.topics import TOPICS, topic_name

ATTACHMENT = "alidade.yaml"
TRUTH = "truth.json"
_UNIT_TOLERANCE = 1e-3
_LONGEST = 1 << 20


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


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Noise(_Section):
    """Noise of the sensors: densities per sqrt(Hz), walks per sqrt(s), the others per sample; None where not given.

    gyro_scale (no unit) is what scale and alignment errors of the gyro add: a fraction of the angle turned.
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
)


class Tag(_Section):
    """A tag: edge of the black square m, rotation bodyRtag (w, x, y, z), position in the body m."""

    size: Sigma
    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    position: Vector = (0.0, 0.0, 0.0)


class Board(_Section):
    """Tags on one rigid body, by id."""

    tag_family: str = "36h11"
    tags: dict[int, Tag] = {}


class RawConversion(_Section):
    """Nominal conversion of counts: (raw - offset) * scale."""

    scale: Sigma
    offset: float = 0.0


class Raw(_Section):
    """Conversions of the sensors that record counts."""

    accel: RawConversion | None = None
    gyro: RawConversion | None = None
    mag: RawConversion | None = None


class Cube(Board):
    """The cube: its tags, the camera on the reference (BRC: w, x, y, z), counts, the date for the field model."""

    camera_rotation: Quaternion | None = None
    raw: Raw = Raw()
    date: Date | None = None


class Indexer(_Section):
    """The indexer: attitude nRbase (w, x, y, z) of its base."""

    base_attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Head(_Section):
    """The helmet: the tag board on it."""

    board: Board | None = None


class Config(_Section):
    """A whole config; every key optional."""

    method: Literal["los", "indexer", "head", "cube"] | None = None
    topics: dict[str, str] = {}
    noise: Noise = Noise()
    priors: dict[str, SigmaOrZero | None] = {}
    require: dict[str, Sigma] = {}
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    date: Date | None = None
    indexer: Indexer = Indexer()
    cube: Cube = Cube()
    head: Head = Head()

    def topic(self, key: str) -> str:
        """Name of the topic with this key (see topics.TOPICS), renamed or default."""
        return topic_name(key, self.topics)

    @property
    def field_date(self) -> datetime.date | None:
        """Date for the field model, at the top or under `cube`."""
        return self.date or self.cube.date


def load_config(attachment: bytes | None, override: Path | None = None) -> Config:
    """The config in a recording's attachment, overridden key by key by a file. Raises InputError."""
    base = _read(attachment, f"attachment {ATTACHMENT}") if attachment is not None else {}
    more: dict[Any, Any] = {}
    if override is not None:
        try:
            more = _read(override.read_bytes(), str(override))
        except OSError as error:
            raise InputError(f"{override}: cannot be opened ({error.strerror})") from error
    try:
        config = Config.model_validate(_merge(base, more))
    except ValidationError as error:
        # An unknown key explains more than what follows from it.
        first = min(error.errors(), key=lambda found: found["type"] != "extra_forbidden")
        path = tuple(part for part in first["loc"] if part != "[key]")
        said = path[:-1] if first["type"] == "missing" else path
        where = str(override) if _has(more, said) else f"attachment {ATTACHMENT}"
        raise InputError(f"{where}: {_explain(path, first)}") from error
    for key in config.topics.keys() - TOPICS.keys():
        where = str(override) if _has(more, ("topics", key)) else f"attachment {ATTACHMENT}"
        raise InputError(f"{where}: unknown key topics.{key}{nearest(key, TOPICS)}")
    return config


def check_names(given: Iterable[str], known: Collection[str], where: str) -> None:
    """Raise InputError, naming the nearest known name, if one given under the key `where` is not known."""
    for name in given:
        if name not in known:
            raise InputError(f"unknown key {where}.{name}{nearest(name, known)}")


def nearest(name: str, known: Collection[str]) -> str:
    """A phrase that names the known name nearest to a wrong one."""
    found = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    return f"; the nearest known key is {found[0]}" if found else ""


def first_given(*values: float | None) -> float:
    """Of config, message covariance and default, in this order, the first that says something.

    Raises ValueError if none does.
    """
    for value in values:
        if value is not None:
            return value
    raise ValueError("no value given, not even a default")


def _read(data: bytes, where: str) -> dict[Any, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    if len(data) > _LONGEST:
        raise InputError(f"{where}: {len(data)} bytes, which is no config")
    try:
        content = YAML(typ="safe", pure=True).load(data.decode())
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: not a YAML file, byte {error.start} is not UTF-8 text") from error
    except RecursionError as error:
        raise InputError(f"{where}: unreadable YAML: it is nested too deep") from error
    except (YAMLError, ValueError) as error:
        mark = error.problem_mark if isinstance(error, MarkedYAMLError) else None
        line = f", line {mark.line + 1}" if mark else ""
        problem = (error.problem if isinstance(error, MarkedYAMLError) else None) or str(error)
        raise InputError(f"{where}: unreadable YAML{line}: {' '.join(problem.split())}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"{where}: keys and values are needed, not a {type(content).__name__}")
    return content


def _merge(base: Mapping[Any, Any], more: Mapping[Any, Any]) -> dict[Any, Any]:
    """More over base, mapping by mapping."""
    merged = dict(base)
    for key, value in more.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both else value
    # A section left empty says nothing.
    return {key: value for key, value in merged.items() if value is not None or key not in _SECTIONS}


_SECTIONS = {"topics", "noise", "priors", "require", "indexer", "cube", "head", "raw"}


def _has(content: Any, path: tuple[int | str, ...]) -> bool:
    """Whether the content says something at the path, or something that has no keys on the way to it."""
    for i, key in enumerate(path):
        if not isinstance(content, Mapping):
            return i > 0
        if key not in content:
            return False
        content = content[key]
    return True


def _explain(path: tuple[int | str, ...], error: Any) -> str:
    key = ".".join(str(part) for part in path)
    if error["type"] == "extra_forbidden":
        return f"unknown key {key}{nearest(str(path[-1]), _known_at(path[:-1]))}"
    given = error["input"]
    shown = "" if error["type"] == "missing" or isinstance(given, dict) else f", not {reprlib.repr(given)}"
    text = "is missing" if error["type"] == "missing" else error["msg"].removeprefix("Value error, ")
    return f"{key}: {text.replace('Input should be', 'must be')}{shown}"


def _known_at(path: tuple[int | str, ...]) -> list[str]:
    """The keys of the section at the path."""
    section: type[BaseModel] = Config
    for key in path:
        field = section.model_fields.get(str(key))
        found = _section_in(field.annotation) if field else None
        section = found or section  # the id of a tag leads to no section of its own
    return list(section.model_fields)


def _section_in(annotation: Any) -> type[BaseModel] | None:
    """The section that a field of this type holds, alone or by key."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    arguments = getattr(annotation, "__args__", ())
    return next((found for found in map(_section_in, arguments) if found), None)
