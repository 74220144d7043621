"""Which of a recording's topics could serve what a method needs, found by type, content and name.

Nothing is taken silently: what is found is a suggestion, with its reasons, for people to put into the config.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alidade.pipelines import methods
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import flow_yaml
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.info import lacking
from alidade.pipelines.recording.pairing import INTERVAL, MAX_MOUNT, Pairing, pair
from alidade.pipelines.recording.plausibility import is_there
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.series import ImuSeries
from alidade.pipelines.recording.topics import Setting, Topic, TopicSource, wanted
from alidade.pipelines.settings import Config

# Rates and attitudes belong together above this correlation of their norms.
_BELONGS = 0.7
# Correlations are compared up to this one.
_HIGHEST = 1.0 - 1e-9
# Names are alike above this ratio of difflib.
_ALIKE = 0.6
# ... and one is meant rather than another by a ratio so much larger.
_CLEARLY = 0.1
# Of the pairs of frames of a TFMessage so many are tried, those with so many transforms at least.
_MOST_PAIRS, _FEWEST = 12, 20
# Delays worth a word, s.
_DELAY = 0.002


@dataclass(frozen=True)
class Suggestion:
    """The topics that a method could read in a recording.

    Attributes:
        method: its name.
        topics: key in the config -> where it could come from; the keys that are lacking alone.
        reasons: sentences about why.
        missing: what would still be lacking.
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
    """Suggested topics for each method (of `only`) that lacks something and could have it from the recording."""
    found = []
    pairings: dict[tuple[str, str], Pairing | None] = {}
    for name in methods.names() if only is None else only:
        if lacking(methods.method(name).requirements, recording, config):
            made = _suggestion(name, recording, config, pairings)
            if made.topics and made.missing and config.method is None:
                by_name = _suggestion(name, recording, config.model_copy(update={"method": name}), pairings)
                made = replace(by_name, has_to_be_asked_for=True) if not by_name.missing else made
            if made.topics or made.reasons:
                found.append(made)
    return tuple(found)


def with_suggested(recording: Recording, config: Config, method: str | None = None) -> tuple[Recording, Config]:
    """The recording and config with the topics suggested for a method, or for the only one that they would serve.

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
    """Phrase with the suggestion for the method that lacks least; empty if there is none."""
    if not found:
        return ""
    best = min(found, key=lambda suggestion: len(suggestion.missing))
    by_name = f"--method {best.method} " if best.has_to_be_asked_for else ""
    lacks = f"; still missing: {'; '.join(best.missing)}" if best.missing else f", which `{by_name}--auto-topics` uses"
    if not best.topics:
        return f"for {best.method}: {'; '.join(best.reasons)}{lacks}"
    topics = best.yaml.replace("\n  ", ", ").replace("topics:,", "topics: {", 1).replace("{ ", "{") + "}"
    return f"for {best.method}: {'; '.join(best.reasons)}: `{topics}`{lacks}"


def unused(recording: Recording, config: Config) -> tuple[str, ...]:
    """Topics of sensors that no method reads under this config."""
    read = {config.topic(topic) for name in methods.names() for topic in methods.method(name).topics}
    read |= {part for source in config.topics.values() for part in source.parts}
    kinds = {kind for name in methods.names() for topic in methods.method(name).topics for kind in topic.types}
    return tuple(
        name for name, topic in recording.topics.items() if topic.type in kinds and topic.count and name not in read
    )


def idle(recording: Recording, config: Config, method: str) -> tuple[str, ...]:
    """Sentences about topics that a method could read as another of its sensors, and does not."""
    chosen = methods.method(method)
    read = {part for topic in chosen.topics for part in _recorded_as(config, topic)}
    read |= {source.name for source in config.topics.values()}
    sentences = []
    for topic in chosen.topics:
        if _is_attitude(topic) or wanted(recording, config, topic):
            continue
        there = recording.topics.items()
        free = [n for n, t in there if t.type == topic.types[0] and t.count and t.is_readable and n not in read]
        if free:
            sentences.append(
                f"{' and '.join(free)} ({topic.types[0].rpartition('/')[2]}): not used; is it the {topic.key}? "
                f"`topics: {{{topic.key}: {free[0]}}}`"
            )
    return tuple(sentences)


def empty(recording: Recording, config: Config, method: str) -> tuple[str, ...]:
    """Sentences about topics of a method that are there without a message."""
    names = dict.fromkeys(config.topic(topic) for topic in methods.method(method).topics)
    there = [name for name in names if name in recording.topics and not recording.topics[name].count]
    return tuple(f"topic {name} has no messages: it counts as not recorded" for name in there)


def _recorded_as(config: Config, topic: Topic) -> tuple[str, ...]:
    """The recorded topics that a topic of a method is taken from."""
    source = config.topics.get(topic.key)
    return (topic.name,) if source is None else source.parts


def _suggestion(
    method: str, recording: Recording, config: Config, pairings: dict[tuple[str, str], Pairing | None]
) -> Suggestion:
    chosen = methods.method(method)
    needed = [one for need in chosen.requirements for group in need for one in group if not isinstance(one, Setting)]
    taken = {config.topic(topic) for topic in chosen.topics if config.topic(topic) in recording.topics}
    taken |= {part for topic in chosen.topics if topic.key in config.topics for part in config.topics[topic.key].parts}
    topics: dict[str, TopicSource] = {}
    reasons: list[str] = []
    doubtful: set[str] = set()
    attitudes = [topic for topic in needed if _is_attitude(topic)]
    gyros = [topic for topic in needed if messages.IMU in topic.types and not _is_attitude(topic)]
    for attitude in attitudes:
        for gyro in gyros:
            free = [_candidates(recording, config, topic, taken) for topic in (attitude, gyro)]
            doubtful |= _pair_up(recording, config, (attitude, gyro), free, pairings, topics, reasons)
    for topic in dict.fromkeys([*needed, *chosen.topics]):
        if topic.key in topics or config.topic(topic) in recording.topics or topic.key in config.topics:
            continue
        if topic.key in doubtful or (topic not in needed and not topics):
            continue
        used = taken | {part for source in topics.values() for part in (source.name, *source.parts)}
        split = _split_imu(recording, used) if messages.IMU in topic.types and not _is_attitude(topic) else None
        if split is not None and topic in needed:
            topics[topic.key] = split
            reasons.append(
                f"{split.gyro} has rates alone, {split.accel} accelerations: together they are the {topic.key}"
            )
            continue
        named = _by_name(recording, topic, used, is_needed=topic in needed)
        if named is None and topic in needed and len(several := _of_type(recording, topic, used)) > 1:
            reasons.append(_to_choose(topic, several))
        if named is not None and topic not in needed and messages.IMU in topic.types and not _is_attitude(topic):
            sources = {each.key: TopicSource(topic=each.name) for each in (*gyros, *attitudes)} | config.topics | topics
            twins = [
                sources[gyro.key].name
                for gyro in gyros
                for attitude in attitudes
                if _turns_as(recording, named, sources[gyro.key].name, sources[attitude.key], pairings)
            ]
            if twins:
                reasons.append(f"{named} turns as {twins[0]} does: not proposed as {topic.key}")
                continue
        if named is not None:
            topics[topic.key] = TopicSource(topic=named)
            reasons.append(f"{named} ({_short(recording, named)}) proposed as {topic.key}")
    more = config.model_copy(update={"topics": {**config.topics, **topics}})
    missing = lacking(chosen.requirements, recording.with_config(more.topics.values()), more)
    return Suggestion(method, topics, tuple(reasons), missing)


def _is_attitude(topic: Topic) -> bool:
    return messages.POSE in topic.types


def _pair_up(
    recording: Recording,
    config: Config,
    pair_of: tuple[Topic, Topic],
    free: list[list[TopicSource]],
    pairings: dict[tuple[str, str], Pairing | None],
    topics: dict[str, TopicSource],
    reasons: list[str],
) -> set[str]:
    """The gyro and the attitude that turn together most alike, of those that may serve.

    Returns the keys that people have to choose a topic for: several turn alike, or an attitude fits in a way only that
    is not taken without being asked for.
    """
    attitude, gyro = pair_of
    fitting = [
        (found, g, a)
        for a in free[0]
        for g in free[1]
        if a.name != g.name
        if (found := _pairing(recording, g.name, a, pairings)) is not None and found.correlation > _BELONGS
    ]
    if not fitting:
        return set()
    found, g, a = max(fitting, key=lambda one: one[0].correlation)
    least = _as_high(recording, found.correlation)
    alike = [one for one in fitting if one[0].correlation >= least]
    named = {
        gyro: list(dict.fromkeys(g.name for _, g, _ in alike)),
        attitude: list(dict.fromkeys(a.name for _, _, a in alike)),
    }
    to_choose = {topic.key for topic, names in named.items() if len(names) > 1}
    reasons.extend(f"{_to_choose(topic, names)}; they turn alike" for topic, names in named.items() if len(names) > 1)
    if found.order != (0, 1, 2, 3) or (found.inverted and found.angle > MAX_MOUNT):
        fits = "inverted, far from its mount" if found.inverted else "in another order of its components"
        reasons.append(
            f"{a.name} turns with {g.name}, but {fits}: are they x, y, z, w where w, x, y, z is meant? Not taken by "
            "itself: mend the order, or say invert in the config"
        )
        return {attitude.key, *to_choose}
    if config.topic(gyro) != g.name and gyro.key not in to_choose:
        topics[gyro.key] = g
    if (config.topic(attitude) != a.name or found.inverted) and attitude.key not in to_choose:
        topics[attitude.key] = a.model_copy(update={"invert": a.invert != found.inverted})
    if to_choose:
        return to_choose
    way = ", inverted" if found.inverted else ""
    offset = f", time offset {1e3 * found.offset_s:+.0f} ms" if abs(found.offset_s) > _DELAY else ""
    reasons.append(f"{a.name} matches {g.name}: rate correlation {found.correlation:.2f}{offset}{way}")
    return set()


def _turns_as(
    recording: Recording, gyro: str, other: str, attitude: TopicSource, known: dict[tuple[str, str], Pairing | None]
) -> bool:
    """Whether a gyro turns with an attitude as another one does, which is then on the same body."""
    own, theirs = (_pairing(recording, name, attitude, known) for name in (gyro, other))
    return own is not None and theirs is not None and own.correlation >= _as_high(recording, theirs.correlation)


def _as_high(recording: Recording, correlation: float) -> float:
    """The least correlation not lower by more than chance: three sigmas of Fisher's z of independent samples."""
    sigma = np.sqrt(2.0 * INTERVAL / max(recording.duration_s, INTERVAL))
    return float(np.tanh(np.arctanh(min(correlation, _HIGHEST)) - 3.0 * sigma))


def _to_choose(topic: Topic, names: Sequence[str]) -> str:
    return f"{' and '.join(names)} could be the {topic.key}: choose, `topics: {{{topic.key}: {names[0]}}}`"


def _candidates(recording: Recording, config: Config, topic: Topic, taken: set[str]) -> list[TopicSource]:
    """Recorded topics of a type of the topic that serve nothing else: the one the config names, if it is there.

    An attitude may be between any two frames of a TFMessage.
    """
    own = config.topic(topic)
    if own in recording.topics:
        return [config.topics.get(topic.key, TopicSource(topic=own))]
    there = [(n, t) for n, t in recording.topics.items() if t.count and t.is_readable and n not in taken]
    found = [TopicSource(topic=n) for n, t in there if t.type in topic.types]
    if _is_attitude(topic):
        for name in (n for n, t in there if t.type == messages.TF):
            found += [TopicSource(topic=name, frames=pair) for pair in _moving_pairs(recording, name)]
    return found


def _moving_pairs(recording: Recording, topic: str) -> list[tuple[str, str]]:
    """The pairs of frames of a TFMessage topic that occur most often, as moving ones are."""
    try:
        counts = {pair: len(found) for pair, found in recording.transforms(topic).items()}
    except InputError:
        return []
    return sorted((pair for pair, n in counts.items() if n >= _FEWEST), key=lambda pair: -counts[pair])[:_MOST_PAIRS]


def _pairing(
    recording: Recording, gyro: str, attitude: TopicSource, known: dict[tuple[str, str], Pairing | None]
) -> Pairing | None:
    if (gyro, attitude.name) not in known:
        known[gyro, attitude.name] = _paired(recording, gyro, attitude)
    return known[gyro, attitude.name]


def _paired(recording: Recording, gyro: str, attitude: TopicSource) -> Pairing | None:
    try:
        rates, poses = recording.imu(gyro), recording.poses_of(attitude)
    except InputError:
        return None
    there = (name for name, topic in recording.topics.items() if topic.type in messages.IMUS and name != gyro)
    others = filter(None, (_rates(recording, name) for name in there))
    carriers = [(other.t_ns, other.gyro) for other in others]
    return pair(rates.t_ns, rates.gyro, poses.t_ns, poses.wxyz, carriers)


def _rates(recording: Recording, topic: str) -> ImuSeries | None:
    try:
        return recording.imu(topic)
    except InputError:
        return None


def _by_name(recording: Recording, topic: Topic, used: set[str], is_needed: bool) -> str | None:
    """The topic of the first type that is there: of several the one whose name is most alike; an optional one if it is.

    An attitude of an Imu is left to its content, which pairs it.
    """
    there = _of_type(recording, topic, used)
    words = topic.key.replace("_", " ")
    alike = {name: difflib.SequenceMatcher(None, words, name.strip("/").replace("/", " ")).ratio() for name in there}
    best = max(there, key=lambda name: alike[name], default=None)
    if best is not None and (is_needed or alike[best] > _ALIKE) and _is_ambiguous(alike):
        return None
    return best if best is not None and (is_needed or alike[best] > _ALIKE or _is_other_gyro(topic, there)) else None


def _split_imu(recording: Recording, used: set[str]) -> TopicSource | None:
    """A gyro and an accelerometer on two topics, as some drivers publish them; None where there are not both."""
    free = [n for n, t in recording.topics.items() if t.type in messages.IMUS and t.count and n not in used]
    there = {name: imu for name in free if (imu := _rates(recording, name)) is not None} if len(free) > 1 else {}
    gyros = [n for n, imu in there.items() if _has(imu, "gyro") and not _has(imu, "accel")]
    accels = [n for n, imu in there.items() if _has(imu, "accel") and not _has(imu, "gyro")]
    if not gyros or not accels:
        return None
    pairs = [(difflib.SequenceMatcher(None, g, a).ratio(), g, a) for g in gyros for a in accels]
    _, gyro, accel = max(pairs)
    return TopicSource(gyro=gyro, accel=accel)


def _has(imu: ImuSeries, kind: str) -> bool:
    return is_there(kind, getattr(imu, kind), getattr(imu, f"{kind}_cov"))


def _has_attitude(recording: Recording, topic: str) -> bool:
    imu = _rates(recording, topic)
    return imu is not None and bool((imu.wxyz_cov[:, 0, 0] >= 0.0).any() and imu.wxyz.any())


def _of_type(recording: Recording, topic: Topic, used: set[str]) -> list[str]:
    """Recorded topics that a topic of a method could be, by type."""
    return [
        name
        for name, found in recording.topics.items()
        if found.type in topic.types and found.count and found.is_readable and name not in used
        if not (_is_attitude(topic) and found.type == messages.IMU)
        if not (topic.key.startswith("reference") and found.type == messages.IMU and not _has_attitude(recording, name))
    ]


def _is_ambiguous(alike: dict[str, float]) -> bool:
    """Whether several topics could be meant, none of them by its name: which is not for chance to say."""
    ranked = sorted(alike.values(), reverse=True)
    return len(ranked) > 1 and ranked[0] - ranked[1] < _CLEARLY


def _is_other_gyro(topic: Topic, there: list[str]) -> bool:
    """Whether a topic of a gyro has but one that is left to serve."""
    return len(there) == 1 and messages.IMU in topic.types and not _is_attitude(topic)


def _short(recording: Recording, name: str) -> str:
    found = recording.topics[name]
    return f"{found.type.rpartition('/')[2]}, {found.count} messages"
