"""Facts about a recording: its topics, their stamps, and which methods it can serve."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipelines.config import Config
from pipelines.errors import InputError
from pipelines.recording.message_reader import ENCODING, Topic
from pipelines.recording.reading import Recording
from pipelines.recording.topics import METHODS, NEEDED, TOPICS


@dataclass(frozen=True)
class TopicFacts:
    """One topic. Times are s from the session's start; None where there are too few messages to tell.

    rate_hz is one over the median interval between stamps; the largest gap is the longest interval and where it begins.
    """

    name: str
    type: str
    count: int
    start_s: float | None
    duration_s: float | None
    rate_hz: float | None
    largest_gap_s: float | None
    largest_gap_at_s: float | None
    duplicates: int
    out_of_order: int


@dataclass(frozen=True)
class SessionFacts:
    """A recording: its start (Unix ns), its length, its topics, and for every method what it lacks for it.

    lost: topic -> messages that are known to be lost; notes: sentences about what of the file cannot be used.
    """

    epoch_ns: int
    duration_s: float
    attachments: tuple[str, ...]
    topics: tuple[TopicFacts, ...]
    missing: dict[str, tuple[str, ...]]
    lost: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods the recording can serve."""
        return tuple(method for method, lacking in self.missing.items() if not lacking)


def session_facts(recording: Recording, config: Config) -> SessionFacts:
    """Facts about all topics of a recording."""
    epoch, times = recording.epoch_ns, recording.times
    topics = tuple(_facts(recording.topics[name], epoch, *times[name]) for name in recording.topics)
    missing = {method: missing_for(method, recording, config) for method in METHODS}
    return SessionFacts(
        epoch, recording.duration_s, recording.attachments, topics, missing, recording.missing, recording.notes
    )


def missing_for(method: str, recording: Recording, config: Config) -> tuple[str, ...]:
    """What a recording with this config lacks for a method, one phrase each; nothing if it can serve it."""
    phrases = []
    for groups in NEEDED[method]:
        lacking = [[_lack(key, recording, config) for key in group] for group in groups]
        texts = [" and ".join(filter(None, group)) for group in lacking]
        if all(texts):
            phrases.append(", or ".join(texts))
    return tuple(phrases)


def resolve_method(option: str | None, recording: Recording, config: Config) -> str:
    """The method to use: the option, else the config's, else the only one the recording has the topics for.

    Raises InputError when the option is no method, and when none or several methods could be meant.
    """
    if option is not None and option not in METHODS:
        raise InputError(f"no method {option!r}; the methods are {', '.join(METHODS)}")
    if option or config.method:
        return str(option or config.method)
    able = [method for method in METHODS if not missing_for(method, recording, config)]
    if len(able) == 1:
        return able[0]
    if able:
        raise InputError(f"{recording.path}: the topics serve {' and '.join(able)}; choose with --method")
    raise InputError(
        f"{recording.path}: no usable topics for any method; {recording.there()}; needed are ROS 2 messages "
        f"({ENCODING}): `alidade info` tells which for each method, `topics:` in the config can rename"
    )


def _facts(topic: Topic, epoch_ns: int, t_ns: NDArray[np.int64], log_ns: NDArray[np.int64]) -> TopicFacts:
    stamps = t_ns[np.argsort(log_ns, kind="stable")] - epoch_ns
    backward = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps))) if len(stamps) else 0
    stamps = np.sort(stamps)
    steps = np.diff(stamps)
    start = float(stamps[0]) / 1e9 if len(stamps) else None
    duration = rate = gap = gap_at = None
    if len(steps) and stamps[-1] > stamps[0]:
        duration = float(stamps[-1] - stamps[0]) / 1e9
        rate = 1e9 / float(np.median(steps[steps > 0]))
        widest = int(np.argmax(steps))
        gap, gap_at = float(steps[widest]) / 1e9, float(stamps[widest]) / 1e9
    duplicates = int(np.count_nonzero(steps == 0))
    return TopicFacts(topic.name, topic.type, len(stamps), start, duration, rate, gap, gap_at, duplicates, backward)


def _lack(key: str, recording: Recording, config: Config) -> str:
    """What is lacking of a topic or a key of the config, as a phrase; empty if nothing."""
    if key == "latitude_deg":
        return "" if config.latitude_deg is not None else "latitude_deg in the config"
    if key == "head.board":
        return "" if config.head.board is not None else "head.board in the config"
    if key == "cube.tags":
        return "" if config.cube.tags else "cube.tags in the config"
    if key == "method: cube":
        return "" if config.method == "cube" else "`method: cube` in the config"
    name = config.topic(key)
    found = recording.topics.get(name)
    types = " or ".join(TOPICS[key].types)
    if found is None:
        return f"{name} ({types})"
    if found.type not in TOPICS[key].types:
        return f"{name} as {types}, not {found.type}"
    if found.encoding != ENCODING:
        return f"{name} in the encoding {ENCODING}, not {found.encoding}"
    return "" if found.count else f"messages on {name}"
