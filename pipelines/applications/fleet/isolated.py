"""One calibration among many: whatever goes wrong with it is its result, and costs the others nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from alidade.pipelines.applications import exit_codes
from alidade.pipelines.applications.fleet.store import Result
from alidade.pipelines.errors import InputError

if TYPE_CHECKING:
    from alidade.pipelines.reports.result import Calibration


def run_isolated(summarise: Callable[[Calibration], Result], calibrate: Callable[[], Calibration]) -> Result:
    """Status, exit code, reason, seconds of wall time, and what `summarise` takes of the calibration. Never raises."""
    from alidade.pipelines.solvers.chain import IndeterminateError

    try:
        calibration = calibrate()
        return {
            "status": calibration.status,
            "exit_code": exit_codes.OF_STATUS[calibration.status],
            "reason": "" if calibration.status == "calibrated" else calibration.headline,
            "seconds": sum(calibration.timing.values()),
            **summarise(calibration),
        }
    except InputError as error:
        return failure(exit_codes.BAD_INPUT, str(error))
    except IndeterminateError as error:
        return failure(exit_codes.UNDETERMINED, str(error))
    except Exception as error:
        return failure(exit_codes.CRASHED, f"{type(error).__name__}: {error}")


def failure(exit_code: int, reason: str) -> Result:
    """The result of what came to no estimate."""
    return {"status": "failed", "exit_code": exit_code, "reason": " ".join(reason.split()), "parameters": {}}


def quarantined() -> Result:
    """The result of what killed its workers."""
    return failure(exit_codes.KILLED, "killed its worker each time it was tried, at last alone; quarantined")
