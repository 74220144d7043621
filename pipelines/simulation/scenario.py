"""Scenario files, a simulator's settings in YAML; and what a simulator hands over."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from alidade.pipelines.errors import InputError, nearest_three
from alidade.pipelines.files import MAX_YAML_BYTES, load_yaml, read_bytes
from alidade.pipelines.settings import validated

Model = TypeVar("Model", bound=BaseModel)

# Installed beside this file; in a source tree among the data sets.
_FOLDERS = (Path(__file__).parent / "scenarios", Path(__file__).resolve().parents[2] / "datasets" / "scenarios")


# 2026-11-20 12:00 UTC: simulated recordings start here; and the year of that day for the field model.
EPOCH_NS, YEAR = 1_795_176_000_000_000_000, 2026.8849315068493


Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class ScenarioPart(BaseModel):
    """Settings of a simulator, or a part of them: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True, eq=False, repr=False)
class Simulated:
    """A simulated recording.

    Attributes:
        data: what its method reads from such a recording.
        truth: parameter -> true value, SI.
        config: the recording's config, YAML: the noise that was simulated and what else the scenario says.
        pictures: as the method writes them in place of what is measured in them; None without.
    """

    data: Any
    truth: Mapping[str, float]
    config: str
    pictures: Any = None

    def __iter__(self) -> Iterator[Any]:
        """Data and truth: `data, truth = simulate(...)`."""
        return iter((self.data, self.truth))

    def __repr__(self) -> str:
        return f"<Simulated {type(self.data).__name__}, {len(self.truth)} true parameters>"


def load_scenario(model: type[Model], name_or_path: str | Path, folder: Path | None = None) -> Model:
    """The scenario of that name (a shipped one, `head_nominal`) or in that file, as the simulator's model.

    Args:
        model: to be filled.
        name_or_path: of the scenario.
        folder: where more scenarios are found by name.

    Raises:
        InputError: no such scenario, unreadable YAML, an unknown key or a value that does not fit.
    """
    path = _find(name_or_path, folder)
    content = load_yaml(read_bytes(path, MAX_YAML_BYTES), str(path))
    return validated(model, {} if content is None else content, path)


def shipped(folder: Path | None = None) -> dict[str, Path]:
    """Name -> file of the scenarios that come with the toolkit, and of those in a method's own folder."""
    folders = _FOLDERS if folder is None else (*_FOLDERS, folder)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}


def summary(path: Path) -> str:
    """Summary of a scenario file: the comment that it begins with, on one line."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return " ".join(line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), lines))


def _find(name_or_path: str | Path, folder: Path | None) -> Path:
    path = Path(name_or_path)
    if path.is_file():
        return path
    known = shipped(folder)
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    raise InputError(f"no scenario file {name_or_path}; {nearest_three(str(name_or_path), sorted(known))}")


def sways(
    scenario: Mapping[str, Any], key: str, who: str, sway: Mapping[str, float]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """A scenario with one more sway about each axis of the motion under a key, and what that is in words.

    Args:
        scenario: as a mapping.
        key: of a motion in it: yaw, pitch and roll, or None.
        who: sways, for the words.
        sway: amplitude_deg and frequency_hz.
    """
    for i, axis in enumerate(("yaw", "pitch", "roll")):
        # Sways of one frequency on two axes would be one sway about an axis between them.
        more = {**sway, "frequency_hz": round(sway["frequency_hz"] + 0.04 * i, 3)}
        now: dict[str, Sequence[Any]] = {"yaw": [], "pitch": [], "roll": [], **(scenario[key] or {})}
        words = f"{who}: sway by {more['amplitude_deg']:g} deg at {more['frequency_hz']:g} Hz in {axis}"
        yield words, {**scenario, key: {**now, axis: [*now[axis], more]}}
