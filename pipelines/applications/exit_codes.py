"""Exit codes of the command line, which a fleet prints for each recording."""

from __future__ import annotations

CALIBRATED = 0
CRASHED = 1
BAD_INPUT = 2
UNDETERMINED = 3
INCONSISTENT = 4
INTERRUPTED = 130
KILLED = 137

OF_STATUS = {
    "calibrated": CALIBRATED,
    "unobservable": UNDETERMINED,
    "weak": UNDETERMINED,
    "inconsistent": INCONSISTENT,
}

OF_VALIDATION = {"holds": CALIBRATED, "same": CALIBRATED, "unknown": UNDETERMINED, "changed": INCONSISTENT}
