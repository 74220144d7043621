"""Many recordings on dask.distributed: Monte Carlo studies and fleets. Needs the extra `alidade[fleet]`."""

from __future__ import annotations

from importlib.util import find_spec

from alidade.pipelines.errors import InputError


def require_extra() -> None:
    """Raise InputError unless the packages of the extra are installed."""
    missing = [package for package in ("distributed", "fsspec", "arro3") if find_spec(package) is None]
    if missing:
        raise InputError(f"this command needs {', '.join(missing)}: pip install 'alidade[fleet]'")
