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
    from alidade.pipelines.applications.api import (
        Config,
        calibrate,
        compare,
        follow,
        hand_eye,
        imu_static,
        load,
        magcal,
        open,
        simulate,
    )
    from alidade.pipelines.applications.apply import apply
    from alidade.pipelines.applications.fleet.fleet import fleet
    from alidade.pipelines.applications.noise import noise
    from alidade.pipelines.applications.planning import plan
    from alidade.pipelines.applications.session import Session
    from alidade.pipelines.applications.validate import validate
    from alidade.pipelines.errors import IndeterminateError, InputError
    from alidade.pipelines.methods import Method
    from alidade.pipelines.methods import names as methods
    from alidade.pipelines.reports.certificate import certificate
    from alidade.pipelines.reports.export_formats import export
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.simulation.scenario import Simulated

__all__ = [
    "Calibration",
    "Config",
    "IndeterminateError",
    "InputError",
    "Method",
    "Session",
    "Simulated",
    "__version__",
    "apply",
    "calibrate",
    "certificate",
    "compare",
    "export",
    "fleet",
    "follow",
    "hand_eye",
    "imu_static",
    "load",
    "magcal",
    "methods",
    "noise",
    "open",
    "plan",
    "simulate",
    "validate",
]

_MODULES = {
    "Calibration": "alidade.pipelines.reports.result",
    "IndeterminateError": "alidade.pipelines.errors",
    "InputError": "alidade.pipelines.errors",
    "Method": "alidade.pipelines.methods",
    "Session": "alidade.pipelines.applications.session",
    "Simulated": "alidade.pipelines.simulation.scenario",
    "apply": "alidade.pipelines.applications.apply",
    "certificate": "alidade.pipelines.reports.certificate",
    "export": "alidade.pipelines.reports.export_formats",
    "fleet": "alidade.pipelines.applications.fleet.fleet",
    "noise": "alidade.pipelines.applications.noise",
    "plan": "alidade.pipelines.applications.planning",
    "validate": "alidade.pipelines.applications.validate",
}
_API = "alidade.pipelines.applications.api"


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("alidade")
    if name == "methods":
        return import_module("alidade.pipelines.methods").names
    if name not in __all__:
        raise AttributeError(f"module 'alidade' has no attribute {name!r}")
    return getattr(import_module(_MODULES.get(name, _API)), name)


def __dir__() -> list[str]:
    return __all__
