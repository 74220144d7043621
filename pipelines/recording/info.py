"""Facts about a recording: its topics, their stamps, and which methods it can serve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.recording.recording import Recording, TopicInfo
from alidade.pipelines.recording.topics import Need, Setting, Topic
from alidade.pipelines.settings import Config


@dataclass(frozen=True)
class TopicFacts:
    """Rates and gaps of one topic. Times are s from the session's start; None where there are too few messages.

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
    """Facts about a recording: start, Unix ns, length, s, topics, and method -> what the recording lacks for it.

    lost: topic -> messages that are known to be lost; notes: sentences about what of the file cannot be used;
    proposed: method -> keys of the config that the recording suggests, each with the reason.
    """

    epoch_ns: int
    duration_s: float
    attachments: tuple[str, ...]
    topics: tuple[TopicFacts, ...]
    missing: dict[str, tuple[str, ...]]
    lost: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    proposed: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods for which the recording lacks nothing."""
        return tuple(method for method, lacking in self.missing.items() if not lacking)


def facts_of(recording: Recording, config: Config, needs: Mapping[str, Sequence[Need]]) -> SessionFacts:
    """Return facts about all topics of a recording, and for each method its needs that the recording does not meet."""
    epoch, times = recording.epoch_ns, recording.times
    topics = tuple(_facts(recording.topics[name], epoch, *times[name]) for name in recording.topics)
    missing = {method: lacking(wanted, recording, config) for method, wanted in needs.items()}
    return SessionFacts(
        epoch,
        recording.duration_s,
        recording.container.attachments,
        topics,
        missing,
        recording.container.missing,
        recording.notes,
    )


def lacking(needs: Sequence[Need], recording: Recording, config: Config) -> tuple[str, ...]:
    """Needs of a method that a recording with this config does not meet, one phrase each."""
    phrases = []
    for groups in needs:
        texts = [" and ".join(filter(None, (_lack(one, recording, config) for one in group))) for group in groups]
        if all(texts):
            phrases.append(", or ".join(texts))
    return tuple(phrases)


def _facts(topic: TopicInfo, epoch_ns: int, t_ns: NDArray[np.int64], log_ns: NDArray[np.int64]) -> TopicFacts:
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


def _lack(need: Topic | Setting, recording: Recording, config: Config) -> str:
    """Phrase for a missing topic or config key; empty if it is there."""
    if isinstance(need, Setting):
        return "" if need.given(config) else need.phrase
    name = config.topic(need)
    found = recording.topics.get(name)
    types = " or ".join(need.types)
    if found is None:
        return f"{name} ({need.types[0]})"
    if found.type not in need.types:
        return f"{name} as {types}, not {found.type}"
    if not found.is_readable:
        return f"{name} in an encoding that is read, not {found.encoding}"
    return "" if found.count else f"messages on {name}"
