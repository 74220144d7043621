"""Recordings with corrected sensors: a calibration applied to what an IMU or a magnetometer measured.

    applied = apply("session.mcap", "calibration.yaml", "corrected.mcap")

Everything recorded is copied as it is, block by block. Behind each block of a topic that the calibration corrects stand
its corrected messages in ROS 2's form, with the stamps and log times of the recorded ones; an attachment,
`corrected:/imu_calibrated`, names the recorded topic. Covariances are J C J^T, J the derivative of the correction. The
error that the calibration leaves is the same in all messages, no noise, and in none of their covariances.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from alidade.pipelines import methods, progress
from alidade.pipelines.applications import CALIBRATED
from alidade.pipelines.applications.table_discovery import with_columns
from alidade.pipelines.config import Settings, configured
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import plain_json, replacing, require_mcap_name
from alidade.pipelines.methods.formula import Value, results
from alidade.pipelines.methods.triads import numeric_jacobian
from alidade.pipelines.recording import messages, series
from alidade.pipelines.recording.array_container import encode_series, ros2_schema
from alidade.pipelines.recording.mcap_writer import McapOutput
from alidade.pipelines.recording.plausibility import is_there
from alidade.pipelines.recording.recording import Recording, open_recording
from alidade.pipelines.recording.streams import StreamReader
from alidade.pipelines.recording.topics import TEMPERATURE
from alidade.pipelines.reports.calibration import SavedCalibration, as_saved
from alidade.pipelines.settings import CORRECTED

if TYPE_CHECKING:
    from alidade.factors.array import Array, Stamps
    from alidade.pipelines.methods import Correction
    from alidade.pipelines.recording.container import MessageBlock
    from alidade.pipelines.recording.opening import Where
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config

# Of a sensor's RMS, for the derivatives of its correction.
_STEP = 1e-3
_SENSORS = {"gyro": "gyro", "accel": "accelerometer", "field": "magnetometer"}


@dataclass(frozen=True, eq=False)
class CorrectedTopic:
    """A corrected topic: its name, that of the recorded one, sensors that were corrected, and the messages."""

    name: str
    recorded: str
    sensors: tuple[str, ...]
    messages: series.Series

    @property
    def text(self) -> str:
        """One line about the topic: sensors, source, number of messages, frame."""
        frame = f", frame {self.messages.frame_id}" if self.messages.frame_id else ""
        return f"{self.name}: {' and '.join(self.sensors)} of {self.recorded}, {len(self.messages)} messages{frame}"


@dataclass(frozen=True, eq=False)
class Applied:
    """Corrected recording: its file, its corrected topics, and notes for people who use the file."""

    path: Path
    topics: tuple[CorrectedTopic, ...]
    notes: tuple[str, ...]


def apply(
    recording: Where,
    calibration: str | Path | Calibration | SavedCalibration,
    out: str | Path,
    *,
    config: Settings = None,
    suffix: str = CALIBRATED,
    strict: bool = False,
    auto_columns: bool = False,
) -> Applied:
    """Copy a recording to an MCAP file with corrected topics beside the recorded ones: `.topics`, `.notes`.

    It is written whole or not at all.

    Args:
        recording: a file, a folder, or the files of one.
        calibration: calibration.yaml, or what `calibrate` or `load` returns; of a file the config is that of the
            recording.
        out: file to be written.
        config: overrides the recording's own config key by key.
        suffix: what is added to the name of a topic for that of the corrected one.
        strict: refuse a recording of which anything is lost.
        auto_columns: use the columns of tables that `alidade info` proposes where the config describes none.

    Raises:
        InputError: recording, config or calibration cannot be used, the calibration corrects no sensor of the
            recording, a correction needs what was not recorded, or the file cannot be written.
    """
    opened, settings = configured(open_recording(recording, strict), config)
    if auto_columns:
        opened, settings = with_columns(opened, settings)
    known, path = as_saved(calibration, settings), Path(out)
    require_mcap_name(path)
    parts = [opened.container, *getattr(opened.container, "parts", ())]
    if path.exists() and any(
        file.exists() and path.samefile(file) for part in parts for file in (part.path, part.data)
    ):
        raise InputError(f"{path}: that is the recording; give another file")
    corrections = methods.method(known.method).report.corrections
    if not corrections:
        raise InputError(f"method {known.method} corrects no sensor's readings: there is nothing to apply")
    made = {
        each.topic: topic
        for each in corrections
        if settings.base(each.topic) in opened.topics
        and (topic := _corrected(opened, settings, known, each, suffix)) is not None
    }
    if not made:
        names = " and ".join(settings.base(each.topic) for each in corrections)
        raise InputError(
            f"{opened.path}: nothing is there that the calibration (method {known.method}) corrects on "
            f"{names}; {opened.there()}; `topics:` in the config can rename"
        )
    for each in corrections:
        if each.frame_of in made and each.topic in made:
            frame = made[each.frame_of].messages.frame_id
            made[each.topic] = replace(made[each.topic], messages=replace(made[each.topic].messages, frame_id=frame))
    topics = tuple(made.values())
    with replacing(path) as stream:
        _write(stream, opened, topics)
    return Applied(path, topics, (*_notes(known), *opened.notes))


def _notes(calibration: SavedCalibration) -> Iterator[str]:
    if calibration.status != "calibrated":
        yield f"the calibration's own verdict is {calibration.status}"
    strength = calibration.parameters.get("field_strength")
    if strength is not None and strength.unit == "1":
        yield "the corrected field is in units of its strength, not in T: it was calibrated without a position"


def _corrected(
    recording: Recording, config: Config, calibration: SavedCalibration, correction: Correction, suffix: str
) -> CorrectedTopic | None:
    """Return a topic with corrected sensors; None if the calibration has no formula for the sensors in it."""
    base, topic = config.base(correction.topic), config.topic(correction.topic)
    if f"{base}{suffix}" in recording.topics:
        raise InputError(f"{recording.path}: topic {base}{suffix} is there already; give another suffix")
    known = calibration.application()
    formulas = [*known.formulas, *correction.formulas]
    needs = {formula.name: formula.inputs for formula in formulas}
    is_field = messages.MAGNETIC_FIELD in correction.topic.types
    read: Any = recording.magnetic(topic) if is_field else recording.imu(topic)
    there = [column for column in correction.inputs if _is_measured(read, column)]
    columns = [column for column in there if correction.results.get(column) in needs]
    if not columns:
        return None
    measured = {correction.inputs[column]: getattr(read, column) for column in there}
    wanted = {name for column in columns for name in needs[correction.results[column]]}
    if "temperature" in wanted and config.topic(TEMPERATURE) in recording.topics:
        t = (read.t_ns - recording.epoch_ns) * 1e-9
        measured["temperature"] = StreamReader(recording, {}).temperature(config.topic(TEMPERATURE), t).above(0.0, t)
    if missing := sorted(wanted - measured.keys()):
        raise InputError(
            f"{recording.path}: topic {topic}: the correction takes {' and '.join(missing)} too, which is not there"
        )
    corrected = partial(results, formulas, {**known.constants, **known.values})
    found, change = corrected(measured), dict[str, Any]()
    for column in columns:
        J = _derivative(corrected, measured, correction.inputs[column], correction.results[column])
        C = getattr(read, f"{column}_cov")
        change[column] = found[correction.results[column]].array
        change[f"{column}_cov"] = np.where(C[:, :1, :1] < 0.0, C, J @ C @ J.T)
    for column in _SENSORS:  # no NaN, which ROS does not have for this
        if hasattr(read, column) and not _is_measured(read, column):
            change |= {column: np.zeros(3), f"{column}_cov": series.ABSENT}
    if correction.frame:
        change |= {"frame_id": correction.frame} | ({} if is_field else {"wxyz": None, "wxyz_cov": None})
    sensors = tuple(_SENSORS[column] for column in columns)
    return CorrectedTopic(f"{base}{suffix}", base, sensors, replace(read, **change))


def _is_measured(read: Any, column: str) -> bool:
    return column == "field" or is_there(column, getattr(read, column), getattr(read, f"{column}_cov"))


def _derivative(corrected: Any, measured: Mapping[str, Array], name: str, result: str) -> Array:
    """Return the derivative (3, 3) of a result with respect to a measured vector, at the mean of the measurements."""
    usual = {key: np.nanmean(values, axis=0) for key, values in measured.items()}
    size = float(np.sqrt(np.nanmean(measured[name] ** 2))) or 1.0

    def at(x: Array) -> Array:
        found: Mapping[str, Value] = corrected({**usual, name: x})
        return found[result].array

    return numeric_jacobian(at, usual[name], np.full(3, _STEP * size))


def _write(stream: BinaryIO, recording: Recording, topics: Sequence[CorrectedTopic]) -> None:
    """Write the messages of a recording, each block followed by the corrected messages with its stamps."""
    container = recording.container
    attached = {name: container.attachment(name, needed=False) for name in container.attachments}
    attached |= {f"{CORRECTED}{topic.name}": topic.recorded.encode() for topic in topics}
    out = McapOutput(stream, {name: data for name, data in attached.items() if data is not None})
    corrected = {topic.recorded: (topic, np.argsort(topic.messages.t_ns, kind="stable")) for topic in topics}
    defined = {number for number in container.channels if container.is_defined(number)}
    for block in progress.track(container.blocks(defined), "writing"):
        channel = container.channels[block.channel]
        schema = container.schemas.get(channel.schema_id)
        out.put(block._replace(channel=out.channel(channel.topic, channel.message_encoding, schema)))
        if channel.topic in corrected:
            topic, order = corrected[channel.topic]
            number = out.channel(topic.name, "cdr", ros2_schema(topic.messages.TYPE))
            found = _of_stamps(topic.messages, order, recording.stamps(block), block.log_ns)
            out.put(found._replace(channel=number))
    out.finish()


def _of_stamps(corrected: series.Series, order: Stamps, stamps: Stamps, log_ns: Stamps) -> MessageBlock:
    """Return the corrected messages that have these stamps, with the log times of the recorded messages."""
    rows = order[np.minimum(np.searchsorted(corrected.t_ns, stamps, sorter=order), len(order) - 1)]
    same = corrected.t_ns[rows] == stamps
    some = {name: getattr(corrected, name)[rows[same]] for name in ("t_ns", *corrected.COLUMNS)}
    encoder = encode_series(replace(corrected, **some))
    return encoder.block(0, len(encoder.log_ns))._replace(log_ns=log_ns[same])


def applied_json(applied: Applied) -> str:
    """JSON of `apply`: the file, its corrected topics, notes."""
    topics = [
        {
            "name": topic.name,
            "recorded": topic.recorded,
            "sensors": topic.sensors,
            "messages": len(topic.messages),
            "frame_id": topic.messages.frame_id,
        }
        for topic in applied.topics
    ]
    return plain_json("applied", {"file": str(applied.path), "topics": topics, "notes": applied.notes})
