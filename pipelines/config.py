"""Reader of a session's config: an attachment of the recording, overridden key by key by a file.

    recording, config = configured(recording, Path("more.yaml"))

Everything wrong in a config is an InputError that names the key and the source it stands in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ValidationError, create_model

from alidade.pipelines import methods
from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.files import MAX_YAML_BYTES, load_yaml, read_bytes
from alidade.pipelines.methods import Method
from alidade.pipelines.settings import (
    ATTACHMENT,
    Config,
    Noise,
    NoiseOrZero,
    Sensors,
    Sheet,
    SigmaOrZero,
    first_error,
    section_in,
    sensor_sheets,
    validated,
)

if TYPE_CHECKING:
    from alidade.pipelines.recording.recording import Recording


# What overrides a recording's own config: a Config, its keys, or a YAML file.
Settings = Config | Mapping[str, Any] | str | Path | None


def configured(recording: Recording, override: Settings = None) -> tuple[Recording, Config]:
    """Return a recording with the topics and columns of its config, and that config, overridden as by `load_config`.

    Raises InputError.
    """
    config = load_config(recording.attachment(ATTACHMENT, needed=override is None), override)
    return recording.with_config(config.topics.values(), config.columns), config


def load_config(attachment: bytes | None, override: Settings = None) -> Config:
    """Load the config in a recording's attachment, overridden key by key by a file or a config. Raises InputError."""
    attached = f"attachment {ATTACHMENT}"
    base = _read(attachment, attached) if attachment is not None else {}
    source, more = _override(override)
    try:
        config = model().model_validate(_merge(base, more))
    except ValidationError as error:
        path, text = first_error(error, model())
        raise InputError(f"{source if source and _has(more, path) else attached}: {text}") from error
    known = {topic.key for name in methods.names() for topic in methods.method(name).topics}
    for key in config.topics.keys() - known:
        where = source if _has(more, ("topics", key)) else attached
        raise InputError(f"{where}: unknown key topics.{key}{nearest(key, sorted(known))}")
    config = config.of(source or attached)
    prior = override.gaussian_prior if isinstance(override, Config) else None
    return config if prior is None else config.with_prior(prior)


def _override(given: object) -> tuple[str, Mapping[Any, Any]]:
    """Return source and content of what overrides a recording's config; both empty for None."""
    if given is None:
        return "", {}
    if isinstance(given, Mapping):
        given = validated(model(), {key: value for key, value in given.items() if value is not None}, "config")
    if isinstance(given, Config):
        return "config", given.model_dump(exclude_unset=True)
    if not isinstance(given, str | Path):
        raise InputError(f"config: a file, an alidade.Config or its keys are needed, not {type(given).__name__}")
    content = _read(read_bytes(Path(given), MAX_YAML_BYTES), str(given))
    if str(content.get("schema", "")).startswith("alidade."):
        raise InputError(f"{given}: that is a result, not a config; `calibrate --prior` takes it")
    return str(given), content


@cache
def model() -> type[Config]:
    """Return the model of a config with the sections, noises and data-sheet figures of all methods."""
    names = methods.names()
    declared = [methods.method(name) for name in names]
    sections = [each.config_section for each in declared if each.config_section is not None]
    fields: dict[str, Any] = {section.key: (section, section()) for section in sections}
    fields["method"] = (Literal[names] | None, None)
    own: dict[str, Any] = {spec.name: (NoiseOrZero | None, None) for each in declared for spec in each.noise}
    noise = create_model("Noise", __base__=Noise, __doc__=Noise.__doc__, **own) if own else Noise
    fields["noise"] = (noise, noise())
    sensors = _sensors(declared)
    fields["sensors"] = (sensor_sheets(sensors), sensors())
    return create_model("Config", __base__=Config, __doc__=Config.__doc__, **fields)


def _sensors(declared: Sequence[Method]) -> type[Sensors]:
    """Return the model of data sheets with those figures of the methods that are not common ones."""
    known, more = Sensors(), dict[str, Any]()
    for name in {name for each in declared for name in each.data_sheets}:
        sheet: Sheet = getattr(known, name, Sheet())
        base = type(sheet)
        figures = {figure for each in declared for figure in each.data_sheets.get(name, ())} - base.model_fields.keys()
        if figures:
            own: dict[str, Any] = dict.fromkeys(sorted(figures), (SigmaOrZero | None, None))
            made = create_model(f"{name.capitalize()}Sheet", __base__=base, **own)
            more[name] = (made, made())
    return create_model("Sensors", __base__=Sensors, __doc__=Sensors.__doc__, **more) if more else Sensors


def _read(data: bytes, where: str) -> dict[Any, Any]:
    content = load_yaml(data, where)
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"{where}: keys and values are needed, not a {type(content).__name__}")
    return content


def _merge(base: Mapping[Any, Any], more: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return `base` overridden by `more`, mapping by mapping."""
    merged = dict(base)
    for key, value in more.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both else value
    # A section left empty says nothing.
    return {key: value for key, value in merged.items() if value is not None or key not in _sections()}


def _has(content: Any, path: tuple[int | str, ...]) -> bool:
    """Whether content has a value at the path, or on the way to it a value without keys."""
    for i, key in enumerate(path):
        if not isinstance(content, Mapping):
            return i > 0
        if key not in content:
            return False
        content = content[key]
    return True


@cache
def _sections() -> frozenset[str]:
    """Return the keys, at any depth, that have keys under them."""

    def inside(section: type[BaseModel]) -> set[str]:
        found = set()
        for key, field in section.model_fields.items():
            deeper = section_in(field.annotation)
            if deeper is not None or getattr(field.annotation, "__origin__", None) is dict:
                found |= {key, *(inside(deeper) if deeper else ())}
        return found

    return frozenset(inside(model()))
