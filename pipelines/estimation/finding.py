"""Findings: what a reader must know before using an estimate, as numbers, and motions that would improve it.

`reports/sentences.py` puts findings in words. The status of a result is that of its most severe finding. All values are
SI; sigmas are one standard deviation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal

Status = Literal["calibrated", "weak", "inconsistent", "unobservable"]

# Kind -> keys of its evidence, as in result.json. `share` is of a family or of the recording, `z` a z-score.
KINDS: Mapping[str, tuple[str, ...]] = {
    "not_converged": ("message",),
    "direction": ("weights", "sigma_ratio", "advice"),  # unit vector in prior sigmas; posterior over prior sigma
    "hypothesis": ("label", "chi_square_before", "chi_square_after", "dof", "equivalents"),
    # Effect: required parameter -> shift if the parameter were at its prior mean.
    "prior_conflict": ("parameter", "value", "sigma", "z", "inseparable", "effect"),
    # A number that the config fixes, what it is stated to be and what it is freed alone; effect: parameter -> shift.
    "contradiction": ("parameter", "unit", "stated", "value", "sigma", "z", "inseparable", "effect"),
    "change": ("since_s", "time_s", "steps"),  # between both times; parameter -> (step, sigma)
    "jump": ("since_s", "time_s", "size", "sigma"),  # of vision, by the mount or by the reference, rad
    "device_change": ("parameter", "step", "sigma", "recordings", "dates"),  # between two recordings
    "rejection": ("family", "share", "noise_factor"),  # with noise_factor times the noise all of it would fit
    "disturbance": ("family", "since_s", "time_s", "rejected"),  # measurements rejected one after the other
    "noise": (
        "noise",
        "unit",
        "source",
        "used",
        "factor",
        "estimated_factor",
    ),  # used, and estimated alone, over stated
    "correlation": ("family", "share"),
    "correlated_error": ("noise", "unit", "used", "correlation_time"),  # a Gauss-Markov error, s
    # Errors of measurements by where they are made: rms, and of which prior; effect: parameter -> shift by them.
    "error_map": ("name", "unit", "rms", "prior", "chi_square", "dof", "effect"),
    "slow_error": ("parameter", "ratio"),  # sandwich over nominal sigma, the largest of a required parameter
    # Family None: all measurements, of which `largest` departs most; noise_factor times its noise would fit it.
    "misfit": ("family", "chi_square", "dof", "largest", "noise_factor"),
    "dominant_prior": ("figure", "stated", "share"),  # data-sheet figure: its share of a variance
    "ambiguous_solution": ("chi_square", "values"),  # excess over the reported one; parameter -> (there, reported)
    "solver_difference": ("parameter", "z", "sigma_ratio"),  # incremental less batch
    "recording": ("recording", "findings"),  # those of one recording of a joint calibration by itself
    "recordings_disagree": ("recordings", "dates", "chi_square", "dof"),  # dates: of two in a row, else none
    "remark": ("text",),  # a premise of the method, a note of the reader
}


class Severity(IntEnum):
    """Severity of a finding, in the contract's order of statuses; a NOTE leaves the status unchanged."""

    NOTE, WEAK, INCONSISTENT, UNOBSERVABLE = range(4)


@dataclass(frozen=True)
class Finding:
    """A departure from the model, the priors or the requirements, with the numbers that show it.

    Raises:
        ValueError: the evidence is not that of its kind.
    """

    kind: str
    severity: Severity
    evidence: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self.evidence.keys() != set(KINDS[self.kind]):
            raise ValueError(f"evidence of {self.kind}: {', '.join(KINDS[self.kind])}; not {', '.join(self.evidence)}")


def remark(text: str) -> Finding:
    """Note in words: a premise of the method, what a time limit ended."""
    return Finding("remark", Severity.NOTE, {"text": text})


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity, the most severe first, equally severe ones in the given order."""
    return tuple(sorted(findings, key=lambda finding: -finding.severity))


def status(findings: Iterable[Finding]) -> Status:
    """Status of a result: that of its most severe finding."""
    statuses: tuple[Status, ...] = ("calibrated", "weak", "inconsistent", "unobservable")
    return statuses[max((finding.severity for finding in findings), default=Severity.NOTE)]


@dataclass(frozen=True)
class Motion:
    """A motion of the device that would improve the recording.

    Attributes:
        words: a sentence, without its capital and its full stop.
        picture: of it, SVG as `alidade.pipelines.display.drawing` draws it; empty: none.
        why: what it is for; empty: that goes without saying.
    """

    words: str
    picture: str = ""
    why: str = ""

    @property
    def advice(self) -> str:
        """Advice as a sentence: why, and which motion."""
        return f"{self.why}: {self.words}" if self.why else self.words
