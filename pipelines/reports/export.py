"""A calibration for the programs that will apply it, in their own conventions."""

from __future__ import annotations

from pipelines import methods
from pipelines.errors import InputError
from pipelines.reports.calibration import SavedCalibration


def exported(saved: SavedCalibration, form: str) -> str:
    """The text of a parameter file. Raises InputError when the calibration's method has no such format."""
    formats = methods.method(saved.method).exporters
    if not formats:
        able = [name for name in methods.names() if methods.method(name).exporters]
        raise InputError(
            f"only calibrations of the {' and '.join(able)} method can be exported, this one is of {saved.method}"
        )
    if form not in formats:
        raise InputError(f"unknown format {form}; there are {', '.join(formats)}")
    return formats[form](saved)
