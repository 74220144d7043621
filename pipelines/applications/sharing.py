"""Parameters that several recordings of one device share, and findings of one recording by itself.

The method says which parameters belong to a recording, as a gyro's turn-on bias does; the config's `share` goes before
that, by names or patterns ("camera_mount_*").
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from alidade.pipelines.errors import InputError, nearest
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.gaussian_prior import GaussianPrior
from alidade.pipelines.methods import Method
from alidade.pipelines.reports.calibration import SavedCalibration
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Config

DAY_S = 86_400.0
# Findings on a recording's residuals, which an estimate of several recordings does not have.
_ON_RESIDUALS = ("rejection", "change", "jump")


def walks(method: Method, config: Config, names: Sequence[str]) -> dict[str, float]:
    """Return the random-walk rates of the device's parameters, SI per root day; 0: constant, or to be estimated.

    Raises:
        InputError: the config's `share` names no parameter.
    """
    for pattern in config.share:
        if not any(fnmatchcase(name, pattern) for name in names):
            where = f"{config.origin}: " if config.origin else ""
            raise InputError(f"{where}unknown key share.{pattern}{nearest(pattern, names)}")
    rates = {}
    for name in names:
        share = _share(config, name) or ("recording" if method.is_per_recording(name) else "device")
        if share != "recording":
            rates[name] = 0.0 if isinstance(share, str) else share
    return rates


def stated_walks(config: Config, names: Sequence[str]) -> list[str]:
    """Return the names of the parameters whose walk is to be estimated from several recordings."""
    return [name for name in names if _share(config, name) == "walks"]


def _share(config: Config, name: str) -> str | float | None:
    """Return the config's `share` of a parameter, by the last pattern that fits; None if no pattern fits."""
    found = [share for pattern, share in config.share.items() if fnmatchcase(name, pattern)]
    return found[-1] if found else None


def device_prior(known: SavedCalibration, method: Method, config: Config, sha256: str, start_ns: int) -> GaussianPrior:
    """Prior on the device at the time of another recording, from the earlier calibration `known`.

    The other arguments are the recording's: `config` says in `share` what walks, `start_ns` is Unix ns.

    Raises:
        InputError: the calibration is another method's, has no sigmas worth the name, or is of this very recording; or
            the walk of a parameter is to be estimated.
    """
    every = known.of_method(method.name).gaussian_prior
    source = every.source
    if known.solver == "published":
        raise InputError(f"{source}: is of the published solver, whose sigmas make no prior; use batch's")
    if known.includes(sha256):
        raise InputError(f"{source}: was made of this very recording, which would count twice; name another one's")
    rates = walks(method, config, every.names)
    for name in stated_walks(config, every.names):
        raise InputError(f"share: how far {name} walks, only several recordings together determine it; give a number")
    uncertain = [name for name, sigma in zip(every.names, every.sigmas, strict=True) if sigma > 0.0]
    gaussian_prior = every.of([name for name in uncertain if name in rates])
    days = abs(start_ns - known.start_ns) * 1e-9 / DAY_S
    walked = np.diag([rates[name] ** 2 * days for name in gaussian_prior.names])
    date = datetime.datetime.fromtimestamp(known.start_ns // 1_000_000_000, datetime.UTC).date()
    verdict = "" if known.status == "calibrated" else f", whose own verdict is {known.status}"
    said = f"that of {Path(source).name}, of {date}{verdict}"
    return replace(
        gaussian_prior,
        covariance=gaussian_prior.covariance + walked.reshape(gaussian_prior.covariance.shape),
        source=said,
        recordings=tuple(known.sources or [known.recording.sha256]),
    )


def finding_of_recording(calibration: Calibration, but: Finding | None = None) -> Finding | None:
    """Collect what is inconsistent in a recording by itself, or shown by its residuals, in one finding; None without.

    The finding `but` is left out.
    """
    own = [
        finding
        for finding in calibration.findings
        if finding is not but and (finding.severity == Severity.INCONSISTENT or finding.kind in _ON_RESIDUALS)
    ]
    if not own:
        return None
    evidence = {"recording": calibration.recording, "findings": tuple(own)}
    return Finding("recording", max(finding.severity for finding in own), evidence)
