"""A calibration that was made before, as something to begin from: result.json with its joint covariance, or
calibration.yaml, whose numbers count as independent.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Status
from alidade.pipelines.files import MAX_RESULT_BYTES, read_bytes
from alidade.pipelines.gaussian_prior import GaussianPrior, independent
from alidade.pipelines.reports.calibration import SavedCalibration, SavedParameter, SavedRecording, load_calibration
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import read_result, result_json

# A covariance is symmetric, and none of its eigenvalues negative, to this share.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Known:
    """What a calibration says of all its parameters.

    Attributes:
        method, solver, status: of the calibration.
        sha256: of its recording.
        start_ns: of its recording, Unix ns.
        gaussian_prior: of its parameters.
        constants: that its formulas need beside them.
    """

    method: str
    solver: str
    status: Status
    sha256: str
    start_ns: int
    gaussian_prior: GaussianPrior
    constants: Mapping[str, float] = field(default_factory=dict)

    def of_method(self, name: str) -> Known:
        """Itself. Raises InputError when it is another method's calibration."""
        if self.method != name:
            raise InputError(f"{self.gaussian_prior.source}: is a calibration of {self.method}, not of {name}")
        return self


def with_covariance(known: Known, path: Path) -> Known:
    """The same from the result.json beside a calibration.yaml, where it is of the same calibration."""
    beside = path.with_name("result.json")
    if path == beside or not beside.is_file():
        return known
    try:
        joint = load_known(beside)
    except InputError:
        return known
    same = (joint.sha256, joint.solver, joint.gaussian_prior.names) == (
        known.sha256,
        known.solver,
        known.gaussian_prior.names,
    )
    return joint if same else known


def saved_of(known: Known, path: Path) -> SavedCalibration:
    """As calibration.yaml has it. Raises InputError when that is a file that cannot be used."""
    if path.suffix != ".json":
        return load_calibration(path)
    parameters = {
        name: SavedParameter(value=value, sigma=sigma, unit="", verdict=None)
        for name, value, sigma in zip(
            known.gaussian_prior.names,
            known.gaussian_prior.mean.tolist(),
            known.gaussian_prior.sigmas.tolist(),
            strict=True,
        )
    }
    start = datetime.datetime.fromtimestamp(known.start_ns // 1_000_000_000, datetime.UTC).isoformat()
    recording = SavedRecording(file=path.name, sha256=known.sha256, start=start)
    return SavedCalibration(
        method=known.method,
        solver=known.solver,
        status=known.status,
        recording=recording,
        parameters=parameters,
        constants=dict(known.constants),
    )


def load_known(path: Path) -> Known:
    """Read result.json or calibration.yaml. Raises InputError when the file cannot be used."""
    data = read_bytes(path, MAX_RESULT_BYTES)
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: neither a result.json nor a calibration.yaml: it is no text") from error
    return _of_result(path, text) if text.lstrip().startswith("{") else _of_calibration(path)


def known_of(calibration: Calibration) -> Known:
    """A calibration that was just made."""
    return _of_result(Path(calibration.recording), result_json(calibration))


def _of_result(path: Path, text: str) -> Known:
    result = read_result(path, text)
    names = tuple(p.name for p in result.parameters)
    covariance = np.array(result.covariance.matrix, dtype=float) if names else np.empty((0, 0))
    if tuple(result.covariance.order) != names or covariance.shape != (len(names), len(names)):
        raise InputError(f"{path}: not a result.json: its covariance is not that of its parameters")
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scaled = covariance / np.outer(np.where(sigmas > 0.0, sigmas, 1.0), np.where(sigmas > 0.0, sigmas, 1.0))
    asymmetry, negative = np.abs(scaled - scaled.T).max(initial=0.0), -np.linalg.eigvalsh(scaled).min(initial=0.0)
    if np.diag(covariance).min(initial=0.0) < 0.0 or max(asymmetry, negative) > _ROUNDING:
        raise InputError(f"{path}: not a result.json: its covariance is none")
    gaussian_prior = GaussianPrior(names, np.array([p.value for p in result.parameters]), covariance, str(path))
    start = _nanoseconds(result.session.start, f"{path}: not a result.json: session.start")
    constants = result.constants or {}
    return Known(result.method, result.solver, result.status, result.session.sha256, start, gaussian_prior, constants)


def _of_calibration(path: Path) -> Known:
    saved = load_calibration(path)
    given = saved.parameters
    gaussian_prior = independent(
        list(given), [p.value for p in given.values()], [p.sigma for p in given.values()], str(path)
    )
    start = _nanoseconds(saved.recording.start, f"{path}: not a calibration.yaml: recording.start")
    return Known(saved.method, saved.solver, saved.status, saved.recording.sha256, start, gaussian_prior)


def _nanoseconds(start: str, where: str) -> int:
    """Unix ns of an ISO 8601 date, UTC where it has no zone, to the second."""
    try:
        date = datetime.datetime.fromisoformat(start)
    except ValueError as error:
        raise InputError(f"{where}: {start!r} is no date") from error
    return round((date if date.tzinfo else date.replace(tzinfo=datetime.UTC)).timestamp()) * 1_000_000_000
