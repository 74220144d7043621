"""Discovery of the topics in a recording that a method could use, by type, content and name.

Nothing is taken silently: what is found is a suggestion, with its reasons, for people to put into the config.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from alidade.pipelines import methods
from alidade.pipelines.applications import CALIBRATED
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import flow_yaml
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.pairing import BELONGS, INTERVAL, MAX_MOUNT, Pairing, pair
from alidade.pipelines.recording.plausibility import is_there
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.series import ImuSeries
from alidade.pipelines.recording.topics import Setting, Topic, TopicSource, lacking, wanted
from alidade.pipelines.settings import CORRECTED, Config

# Correlations are compared up to this one.
_HIGHEST = 1.0 - 1e-9
# Names are alike above this ratio of difflib.
_ALIKE = 0.6
# ... and one is meant rather than another by a ratio so much larger.
_CLEARLY = 0.1
# Of the pairs of frames of a TFMessage so many are tried, those with so many transforms at least.
_MOST_PAIRS, _FEWEST = 12, 20
# Units of rates and of times differ by ten and more: half of that, as a power.
_OTHER_UNIT = 0.5
# Delays worth a word, s.
_DELAY = 0.002


@dataclass(frozen=True)
class Suggestion:
    """The topics that a method could read in a recording, with reasons, and what would still be missing.

    Attributes:
        topics: key in the config -> where it could come from; the keys that are lacking alone.
        has_to_be_asked_for: whether it serves only where the method is named.
    """

    method: str
    topics: dict[str, TopicSource]
    reasons: tuple[str, ...]
    missing: tuple[str, ...]
    has_to_be_asked_for: bool = False

    @property
    def yaml(self) -> str:
        """Config section `topics:` of the suggestion, to paste."""
        given = {key: source.model_dump() for key, source in self.topics.items()}
        return "\n".join(["topics:", *(f"  {key}: {flow_yaml(value)}" for key, value in given.items())])


def suggestions(recording: Recording, config: Config, only: Sequence[str] | None = None) -> tuple[Suggestion, ...]:
    """Return suggested topics for each method (of `only`) that lacks something that the recording could provide."""
    found = []
    pairings: dict[tuple[str, str], Pairing | None] = {}
    for name in methods.names() if only is None else only:
        if lacking(methods.method(name).requirements, recording, config):
            made = _Search(recording, config, name, pairings).suggestion()
            if made.topics and made.missing and config.method is None:
                asked = config.model_copy(update={"method": name})
                by_name = _Search(recording, asked, name, pairings).suggestion()
                made = replace(by_name, has_to_be_asked_for=True) if not by_name.missing else made
            if made.topics or made.reasons:
                found.append(made)
    return tuple(found)


def with_suggested(recording: Recording, config: Config, method: str | None = None) -> tuple[Recording, Config]:
    """Return recording and config with the topics suggested for a method, or for the only one that could be served.

    Both are as they were where nothing is lacking; the recording notes what was chosen. Raises InputError when no
    method could be served, or several.
    """
    asked = method or config.method
    config = config.model_copy(update={"method": asked}) if asked else config
    served = [name for name in methods.names() if not lacking(methods.method(name).requirements, recording, config)]
    if asked in served or (asked is None and served):
        return recording, config
    # Through a copy, for the search reads topics that may not be used.
    copy = recording.with_config(config.topics.values())
    found = suggestions(copy, config, [asked] if asked else None)
    whole = [suggestion for suggestion in found if not suggestion.missing and not suggestion.has_to_be_asked_for]
    if len(whole) != 1:
        which = " and ".join(suggestion.method for suggestion in whole)
        what = f"topics could be found for {which}; choose with --method" if whole else nearest_suggestion(found)
        raise InputError(f"{recording.path}: {what or 'no topics for any method were found'}; {recording.there()}")
    more = config.model_copy(update={"topics": {**config.topics, **whole[0].topics}, "method": whole[0].method})
    recording = recording.with_config(more.topics.values())
    recording.remark(f"topics chosen automatically ({whole[0].method}): {'; '.join(whole[0].reasons)}")
    return recording, more


def nearest_suggestion(found: Sequence[Suggestion]) -> str:
    """Return a phrase with the suggestion for the method that lacks least; empty if there is no suggestion."""
    if not found:
        return ""
    best = min(found, key=lambda suggestion: len(suggestion.missing))
    by_name = f"--method {best.method} " if best.has_to_be_asked_for else ""
    lacks = f"; still missing: {'; '.join(best.missing)}" if best.missing else f", which `{by_name}--auto-topics` uses"
    if not best.topics:
        return f"for {best.method}: {'; '.join(best.reasons)}{lacks}"
    topics = flow_yaml({key: source.model_dump() for key, source in best.topics.items()})
    return f"for {best.method}: {'; '.join(best.reasons)}: `topics: {topics}`{lacks}"


def unused(recording: Recording, config: Config) -> tuple[str, ...]:
    """Topics of sensors that no method reads under this config."""
    read = {config.topic(topic) for name in methods.names() for topic in methods.method(name).topics}
    read |= {part for source in config.topics.values() for part in source.parts}
    kinds = {kind for name in methods.names() for topic in methods.method(name).topics for kind in topic.types}
    return tuple(
        name for name, topic in recording.topics.items() if topic.type in kinds and topic.count and name not in read
    )


def idle(recording: Recording, config: Config, method: str) -> tuple[str, ...]:
    """Return sentences about topics that a method does not read, but could read as another of its sensors.

    None about a topic and what `apply` made of it, where one of the two is read.
    """
    chosen = methods.method(method)
    sources = (config.topics.get(topic.key, TopicSource(topic=topic.name)) for topic in chosen.topics)
    read = {part for source in sources for part in source.parts}
    read |= {source.name for source in config.topics.values()}
    own = {_corrected(recording, name) for name in read}
    sentences = []
    for topic in chosen.topics:
        if _is_attitude(topic) or wanted(recording, config, topic):
            continue
        there = recording.topics.items()
        free = [n for n, t in there if t.type == topic.types[0] and t.count and t.is_readable]
        free = [name for name in free if _corrected(recording, name) not in own]
        if free:
            sentences.append(
                f"{' and '.join(free)} ({topic.types[0].rpartition('/')[2]}): not used; is it the {topic.key}? "
                f"`topics: {{{topic.key}: {free[0]}}}`"
            )
    return tuple(sentences)


def _corrected(recording: Recording, name: str) -> str:
    """Return the name of the recorded topic that `apply` corrected into a topic: by its attachment, else its suffix."""
    stated = recording.attachment(f"{CORRECTED}{name}", needed=False)
    return name.removesuffix(CALIBRATED) if stated is None else stated.decode(errors="replace")


def empty(recording: Recording, config: Config, method: str) -> tuple[str, ...]:
    """Return sentences about a method's topics that are recorded, but have no message."""
    names = dict.fromkeys(config.topic(topic) for topic in methods.method(method).topics)
    there = [name for name in names if name in recording.topics and not recording.topics[name].count]
    return tuple(f"topic {name} has no messages: it counts as not recorded" for name in there)


class _Search:
    """Search of a recording for the topics of one method.

    `pairings`, (gyro, attitude) -> how they turn together, are shared by all searches of a recording.
    """

    def __init__(
        self, recording: Recording, config: Config, method: str, pairings: dict[tuple[str, str], Pairing | None]
    ) -> None:
        self._recording, self._config, self._pairings = recording, config, pairings
        self._method = chosen = methods.method(method)
        every = (one for need in chosen.requirements for group in need for one in group)
        self._needed = [one for one in every if not isinstance(one, Setting)]
        self._attitudes = [topic for topic in self._needed if _is_attitude(topic)]
        self._gyros = [topic for topic in self._needed if _is_gyro(topic)]
        self._taken = {config.topic(topic) for topic in chosen.topics if config.topic(topic) in recording.topics}
        named = [config.topics[topic.key] for topic in chosen.topics if topic.key in config.topics]
        self._taken |= {part for source in named for part in source.parts}
        self._topics: dict[str, TopicSource] = {}
        self._reasons: list[str] = []

    def suggestion(self) -> Suggestion:
        """Search topics for all sensors of the method; return those found, and what would still be missing."""
        config, there = self._config, self._recording.topics
        doubtful: set[str] = set()
        for attitude in self._attitudes:
            for gyro in self._gyros:
                doubtful |= self._pair_up(attitude, gyro)
        for topic in dict.fromkeys([*self._needed, *self._method.topics]):
            is_known = topic.key in self._topics or config.topic(topic) in there or topic.key in config.topics
            is_needed = topic in self._needed
            if not is_known and topic.key not in doubtful and (is_needed or self._topics):
                self._propose(topic, is_needed)
        more = config.model_copy(update={"topics": {**config.topics, **self._topics}})
        missing = lacking(self._method.requirements, self._recording.with_config(more.topics.values()), more)
        return Suggestion(self._method.name, self._topics, tuple(self._reasons), missing)

    def _propose(self, topic: Topic, is_needed: bool) -> None:
        """Take as source of `topic` the recorded topic of its type with the most similar name, if there is one."""
        used = self._taken | {part for source in self._topics.values() for part in (source.name, *source.parts)}
        split = self._split_imu(used) if is_needed and _is_gyro(topic) else None
        if split is not None:
            self._topics[topic.key] = split
            self._reasons.append(
                f"{split.gyro} has rates alone, {split.accel} accelerations: together they are the {topic.key}"
            )
            return
        there = self._of_type(topic, used)
        named = _by_name(topic, there, is_needed)
        if named is None:
            if is_needed and len(there) > 1:
                self._reasons.append(_to_choose(topic, there))
            return
        twin = None if is_needed or not _is_gyro(topic) else self._twin(named)
        if twin is not None:
            self._reasons.append(f"{named} turns as {twin} does: not proposed as {topic.key}")
            return
        found = self._recording.topics[named]
        self._topics[topic.key] = TopicSource(topic=named)
        self._reasons.append(
            f"{named} ({found.type.rpartition('/')[2]}, {found.count} messages) proposed as {topic.key}"
        )

    def _pair_up(self, attitude: Topic, gyro: Topic) -> set[str]:
        """Take as sources the gyro and the attitude, of those that may serve, whose rates correlate best.

        Returns the keys that people have to choose a topic for: several turn alike, or an attitude fits in a way only
        that is not taken without being asked for.
        """
        fitting = [
            (found, g, a)
            for a in self._candidates(attitude)
            for g in self._candidates(gyro)
            if a.name != g.name
            if (found := self._pairing(g.name, a)) is not None and found.correlation > BELONGS
        ]
        if not fitting:
            return set()
        found, g, a = max(fitting, key=lambda one: one[0].correlation)
        least = self._as_high(found.correlation)
        alike = [one for one in fitting if one[0].correlation >= least]
        named = {
            gyro: list(dict.fromkeys(g.name for _, g, _ in alike)),
            attitude: list(dict.fromkeys(a.name for _, _, a in alike)),
        }
        several = {topic: names for topic, names in named.items() if len(names) > 1}
        to_choose = {topic.key for topic in several}
        self._reasons.extend(f"{_to_choose(topic, names)}; they turn alike" for topic, names in several.items())
        if found.order != (0, 1, 2, 3) or (found.inverted and found.angle > MAX_MOUNT):
            fits = "inverted, far from its mount" if found.inverted else "in another order of its components"
            self._reasons.append(
                f"{a.name} turns with {g.name}, but {fits}: are they x, y, z, w where w, x, y, z is meant? Not taken "
                "by itself: mend the order, or say invert in the config"
            )
            return {attitude.key, *to_choose}
        if abs(np.log10(found.ratio)) > _OTHER_UNIT:
            self._reasons.append(
                f"{g.name} turns with {a.name}, but {found.ratio:.3g} times as fast: is the unit of the gyro right, or "
                "that of the times? Not taken by itself"
            )
            return {attitude.key, gyro.key, *to_choose}
        if self._config.topic(gyro) != g.name and gyro.key not in to_choose:
            self._topics[gyro.key] = g
        if (self._config.topic(attitude) != a.name or found.inverted) and attitude.key not in to_choose:
            self._topics[attitude.key] = a.model_copy(update={"invert": a.invert != found.inverted})
        if not to_choose:
            way = ", inverted" if found.inverted else ""
            offset = f", time offset {1e3 * found.offset_s:+.0f} ms" if abs(found.offset_s) > _DELAY else ""
            self._reasons.append(f"{a.name} matches {g.name}: rate correlation {found.correlation:.2f}{offset}{way}")
            if found.at_its_stamps:
                self._reasons.append(f"{a.name} has the stamps of {g.name}: an attitude made of it is no reference")
        return to_choose

    def _twin(self, gyro: str) -> str | None:
        """Return the method's gyro that turns with a given one, so that both are on one body; None without one."""
        named = {each.key: TopicSource(topic=each.name) for each in (*self._gyros, *self._attitudes)}
        sources = named | self._config.topics | self._topics
        for own in self._gyros:
            for attitude in self._attitudes:
                name, seen = sources[own.key].name, sources[attitude.key]
                ours, theirs = self._pairing(gyro, seen), self._pairing(name, seen)
                if ours and theirs and ours.correlation >= self._as_high(theirs.correlation):
                    return name
        return None

    def _as_high(self, correlation: float) -> float:
        """Return the least correlation as high but for chance: 3 sigmas of Fisher's z of independent samples."""
        sigma = np.sqrt(2.0 * INTERVAL / max(self._recording.duration_s, INTERVAL))
        return float(np.tanh(np.arctanh(min(correlation, _HIGHEST)) - 3.0 * sigma))

    def _candidates(self, topic: Topic) -> list[TopicSource]:
        """Return unused recorded topics of a type of `topic`: only the one that the config names, if it is recorded.

        An attitude may be between any two frames of a TFMessage. What is part of another source is none itself.
        """
        recording, own = self._recording, self._config.topic(topic)
        if own in recording.topics:
            return [self._config.topics.get(topic.key, TopicSource(topic=own))]
        made = {source.name: source for source in self._config.topics.values() if source.gyro is not None}
        taken = self._taken.union(*(source.parts for source in made.values()))
        there = [(n, t) for n, t in recording.topics.items() if t.count and t.is_readable and n not in taken]
        found = [made.get(n, TopicSource(topic=n)) for n, t in there if t.type in topic.types]
        if _is_attitude(topic):
            for name in (n for n, t in there if t.type == messages.TF):
                found += [TopicSource(topic=name, frames=pair) for pair in _moving_pairs(recording, name)]
        return found

    def _pairing(self, gyro: str, attitude: TopicSource) -> Pairing | None:
        """Return how an attitude turns with a gyro; None where one of them cannot be read."""
        key, recording = (gyro, attitude.name), self._recording
        if key not in self._pairings:
            self._pairings[key] = None
            with suppress(InputError):
                rates, poses = recording.imu(gyro), recording.poses_of(attitude)
                imus = [n for n, topic in recording.topics.items() if topic.type in messages.IMUS and n != gyro]
                carriers = [(imu.t_ns, imu.gyro) for n in imus if (imu := _rates(recording, n)) is not None]
                self._pairings[key] = pair(rates.t_ns, rates.gyro, poses.t_ns, poses.wxyz, carriers)
        return self._pairings[key]

    def _split_imu(self, used: set[str]) -> TopicSource | None:
        """Return a gyro and an accelerometer that a driver publishes on two topics, as one source; None if not both."""
        recording = self._recording
        free = [n for n, t in recording.topics.items() if t.type in messages.IMUS and t.count and n not in used]
        there = {name: imu for name in free if (imu := _rates(recording, name)) is not None} if len(free) > 1 else {}
        gyros = [n for n, imu in there.items() if _has(imu, "gyro") and not _has(imu, "accel")]
        accels = [n for n, imu in there.items() if _has(imu, "accel") and not _has(imu, "gyro")]
        pairs = [(difflib.SequenceMatcher(None, g, a).ratio(), g, a) for g in gyros for a in accels]
        _, gyro, accel = max(pairs, default=(0.0, None, None))
        return None if gyro is None else TopicSource(gyro=gyro, accel=accel)

    def _of_type(self, topic: Topic, used: set[str]) -> list[str]:
        """Return the unused recorded topics that have a type of `topic`; pairing finds attitudes in Imu messages."""
        of_type = {n: t for n, t in self._recording.topics.items() if t.type in topic.types and n not in used}
        there = {n: t.type == messages.IMU for n, t in of_type.items() if t.count and t.is_readable}
        if _is_attitude(topic):
            return [name for name, is_imu in there.items() if not is_imu]
        needs_attitude = topic.key.startswith("reference")
        return [n for n, is_imu in there.items() if not (needs_attitude and is_imu) or self._has_attitude(n)]

    def _has_attitude(self, topic: str) -> bool:
        imu = _rates(self._recording, topic)
        return imu is not None and bool((imu.wxyz_cov[:, 0, 0] >= 0.0).any() and imu.wxyz.any())


def _is_attitude(topic: Topic) -> bool:
    return messages.POSE in topic.types


def _is_gyro(topic: Topic) -> bool:
    return messages.IMU in topic.types and not _is_attitude(topic)


def _to_choose(topic: Topic, names: Sequence[str]) -> str:
    return f"{' and '.join(names)} could be the {topic.key}: choose, `topics: {{{topic.key}: {names[0]}}}`"


def _moving_pairs(recording: Recording, topic: str) -> list[tuple[str, str]]:
    """Return the pairs of frames on a TFMessage topic that have most messages, as moving frames do."""
    try:
        counts = {pair: len(found) for pair, found in recording.transforms(topic).items()}
    except InputError:
        return []
    return sorted((pair for pair, n in counts.items() if n >= _FEWEST), key=lambda pair: -counts[pair])[:_MOST_PAIRS]


def _rates(recording: Recording, topic: str) -> ImuSeries | None:
    try:
        return recording.imu(topic)
    except InputError:
        return None


def _by_name(topic: Topic, there: Sequence[str], is_needed: bool) -> str | None:
    """Return the topic whose name is most like that of `topic`; None unless it is clearly the most alike."""
    words = topic.key.replace("_", " ")
    alike = {name: difflib.SequenceMatcher(None, words, name.strip("/").replace("/", " ")).ratio() for name in there}
    ranked = sorted(there, key=lambda name: -alike[name])
    if not ranked or not (is_needed or alike[ranked[0]] > _ALIKE):
        return ranked[0] if len(ranked) == 1 and _is_gyro(topic) else None
    # Which of several is meant, none of them by its name, is not for chance to say.
    return None if len(ranked) > 1 and alike[ranked[0]] - alike[ranked[1]] < _CLEARLY else ranked[0]


def _has(imu: ImuSeries, kind: str) -> bool:
    return is_there(kind, getattr(imu, kind), getattr(imu, f"{kind}_cov"))
