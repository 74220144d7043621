"""`make demo` as on a fresh machine: a copy of the checkout, and an environment that is made for it."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measure import Cost, Ratio

_CHECKOUT = Path(__file__).parents[1]
_NOT_COPIED = (".git", ".venv", "build", "dist", "alidade-demo", "__pycache__", ".*_cache")
# It may take so many seconds, with the packages at hand, and so many bytes.
_SECONDS, _BYTES = 40.0, 700e6


def run() -> Iterator[Ratio]:
    """Wall time, most of which is the package index's and the disk's, and the size of what is installed."""
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / "alidade"
        shutil.copytree(_CHECKOUT, copy, ignore=shutil.ignore_patterns(*_NOT_COPIED))
        start = time.monotonic()
        subprocess.run(["make", "demo"], cwd=copy, check=True, capture_output=True)
        seconds = time.monotonic() - start
        size = sum(path.lstat().st_size for path in (copy / ".venv").rglob("*") if path.is_file())
    yield Ratio(
        "demo.time",
        f"make demo, nothing installed, over {_SECONDS:g} s",
        seconds / _SECONDS,
        tolerance=1.0,
        wanted=1.0,
        ours=Cost(seconds),
    )
    compared = f"what it installs, {size / 1e6:.0f} MB, over {_BYTES / 1e6:g} MB"
    yield Ratio("demo.size", compared, size / _BYTES, tolerance=0.05, wanted=1.0)
