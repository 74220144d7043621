"""Calibrations that were made before, to begin from: result.json with its joint covariance, or calibration.yaml, whose
numbers count as independent.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import MAX_RESULT_BYTES, read_bytes
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.reports.calibration import SavedCalibration, SavedParameter, SavedRecording, load_calibration
from alidade.pipelines.reports.result_json import read_result

# A covariance is symmetric, and none of its eigenvalues negative, to this share.
_ROUNDING = 1e-6


def load_known(path: Path) -> SavedCalibration:
    """Read result.json or calibration.yaml. Raises InputError when the file cannot be used."""
    data = read_bytes(path, MAX_RESULT_BYTES)
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: neither a result.json nor a calibration.yaml: it is no text") from error
    known = _of_result(path, text) if text.lstrip().startswith("{") else load_calibration(path)
    _ = known.start_ns  # refused now where it is no date
    return known


def with_covariance(known: SavedCalibration, path: Path) -> SavedCalibration:
    """The same with the joint covariance in result.json beside a calibration.yaml, if it is of the same calibration."""
    beside = path.with_name("result.json")
    if path == beside or not beside.is_file():
        return known
    try:
        joint = load_known(beside)
    except InputError:
        return known
    ours, theirs = ((each.recording.sha256, each.solver, list(each.parameters)) for each in (known, joint))
    return known.with_joint(joint.gaussian_prior) if ours == theirs else known


def _of_result(path: Path, text: str) -> SavedCalibration:
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
    known = SavedCalibration(
        method=result.method,
        solver=result.solver,
        status=result.status,
        recording=SavedRecording(file=path.name, sha256=result.session.sha256, start=result.session.start),
        parameters={
            p.name: SavedParameter(value=p.value, sigma=float(sigma), unit=p.unit, verdict=p.observability)
            for p, sigma in zip(result.parameters, sigmas, strict=True)
        },
        constants=result.constants or {},
    )
    return known.with_joint(GaussianPrior(names, np.array([p.value for p in result.parameters]), covariance, str(path)))
