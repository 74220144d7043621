"""A calibration for the programs that will apply it, in their own conventions."""

from __future__ import annotations

from alidade.pipelines import methods
from alidade.pipelines.errors import InputError
from alidade.pipelines.reports.calibration import SavedCalibration
from alidade.pipelines.reports.transforms import FORMATS


def exported(saved: SavedCalibration, form: str) -> str:
    """The text of a parameter file.

    Any method's mounting rotations go out as static transforms; methods have formats of their own beside.

    Raises InputError when there is no such format for the calibration.
    """
    formats = {**methods.method(saved.method).exporters, **(FORMATS if saved.transforms else {})}
    if not formats:
        raise InputError(f"this calibration of {saved.method} holds nothing that another program could be given")
    if form not in formats:
        raise InputError(f"unknown format {form}; there are {', '.join(formats)}")
    return formats[form](saved)
