"""alidade: how sensors are mounted and how wrong they are, by factor graphs, and how sure that is.

    import alidade

    session = alidade.open("session.mcap")              # or arrays, or what alidade.simulate returns
    calibration = session.calibrate("batch")
    print(calibration)                                  # a table; in a notebook it shows itself
    calibration.parameters["time_offset"].sigma
    calibration.write("results/")
    alidade.load("results/calibration.yaml").apply(...)

Names are imported when they are first used, so that `import alidade` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipelines.api import Config, calibrate, follow, load, open, plan, simulate
    from pipelines.errors import InputError
    from pipelines.methods import Method
    from pipelines.methods import names as methods
    from pipelines.reports.result import Calibration
    from pipelines.session import Session
    from pipelines.simulation.simulated import Simulated
    from pipelines.solvers.marginals import IndeterminateError

__all__ = [
    "Calibration",
    "Config",
    "IndeterminateError",
    "InputError",
    "Method",
    "Session",
    "Simulated",
    "__version__",
    "calibrate",
    "follow",
    "load",
    "methods",
    "open",
    "plan",
    "simulate",
]

_MODULES = {
    "Calibration": "pipelines.reports.result",
    "Config": "pipelines.api",
    "IndeterminateError": "pipelines.solvers.marginals",
    "InputError": "pipelines.errors",
    "Method": "pipelines.methods",
    "Session": "pipelines.session",
    "Simulated": "pipelines.simulation.simulated",
    "calibrate": "pipelines.api",
    "follow": "pipelines.api",
    "load": "pipelines.api",
    "open": "pipelines.api",
    "plan": "pipelines.api",
    "simulate": "pipelines.api",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("alidade")
    if name == "methods":
        return import_module("pipelines.methods").names
    if name not in _MODULES:
        raise AttributeError(f"module 'alidade' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
