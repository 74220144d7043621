"""From a recording and a calibration to the errors without and with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.config import recorded_config
from pipelines.errors import InputError
from pipelines.judgement.validation import Validation
from pipelines.methods import method
from pipelines.recording.reading import open_recording
from pipelines.reports.calibration import SavedCalibration, load_calibration
from pipelines.reports.validation import validation_html, validation_rows
from pipelines.reports.whole import write_page
from pipelines.session import resolve_method

FILE = "validation.html"


@dataclass(frozen=True, eq=False)
class Validated:
    """A calibration held against a recording.

    Attributes:
        calibration: the one validated.
        recording: name of the file.
        validations: what the method says.
        same_recording: it was calibrated on the very recording.
        lost: sentences about what of the recording cannot be used.
    """

    calibration: SavedCalibration
    recording: str
    validations: Sequence[Validation]
    same_recording: bool
    lost: tuple[str, ...] = ()

    @property
    def notes(self) -> list[str]:
        """What a reader has to know beside the numbers."""
        out = [*self.lost, *(f"{v.name}: {v.note}" for v in self.validations if v.note)]
        if self.same_recording:
            out.append("this is the recording it was calibrated on; another one says more")
        if self.calibration.status != "calibrated":
            out.append(f"the calibration's own verdict is {self.calibration.status}")
        return out


def validate(
    path: Path,
    calibration_file: Path,
    method_name: str | None = None,
    config_file: Path | None = None,
    strict: bool = False,
) -> Validated:
    """The errors of a recording before and after compensation.

    Args:
        path: the recording.
        calibration_file: calibration.yaml.
        method_name: overrides the config's.
        config_file: overrides the recording's own config key by key.
        strict: refuse a recording of which anything is lost.

    Raises:
        InputError: recording, config or calibration cannot be used, or the calibration is another method's.
    """
    calibration = load_calibration(calibration_file)
    recording = open_recording(path, strict)
    config = recorded_config(recording, config_file)
    name = resolve_method(method_name or calibration.method, recording, config)
    if name != calibration.method:
        raise InputError(f"{calibration_file}: is a calibration of {calibration.method}, not of {name}")
    chosen = method(name)
    values = {parameter: saved.value for parameter, saved in calibration.parameters.items()}
    validations = chosen.validate(chosen.read(recording, config), config, values)
    same = calibration.recording.sha256 == recording.sha256()
    return Validated(calibration, path.name, validations, same, recording.notes)


def table(validated: Validated) -> list[str]:
    """Lines of text: for each error RMS and peak, before and after."""
    rows = validation_rows(validated.validations)
    width = max(len(row[0]) for row in rows)
    head = f"{'':{width}}  {'RMS':>9} {'':>9}  {'peak':>9}"
    under = f"{'error':{width}}  {'before':>9} {'after':>9}  {'before':>9} {'after':>9}"
    lines = [f"{name:{width}}  {a:>9} {b:>9}  {c:>9} {d:>9}  {unit}" for name, a, b, c, d, unit in rows]
    return [head, under, *lines]


def write_validation(out_dir: Path, validated: Validated) -> Path:
    """Write validation.html; returns its path. Raises InputError when it cannot be written."""
    return write_page(out_dir, FILE, validation_html(validated.validations, validated.calibration, validated.recording))
