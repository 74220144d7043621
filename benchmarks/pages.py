"""Reports of the four nominal scenarios: their sizes, and how long a browser takes to show one."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from alidade.pipelines.applications.session import open_session
from alidade.pipelines.methods import simulate
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.reports.result import Calibration
from benchmarks.measure import Cost, Ratio, costs
from tests.support.browser import CHROMIUM

_METHODS = ("los", "indexer", "head", "cube")
# A page may have so many bytes, and be shown after so many seconds.
_BYTES, _SECONDS = 1e6, 1.5
# ... and take so long, s, to be made.
_WRITTEN = 0.3


def run() -> Iterator[Ratio]:
    """Bytes over a megabyte; and seconds over one and a half, where a browser is installed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for method in _METHODS:
            simulate(method, None, 1, folder / "session.mcap")
            (calibration,) = open_session(folder / "session.mcap").calibrations(["batch"])
            page = folder / f"{method}.html"
            (written,) = costs([partial(_write, calibration, page)])
            compared = f"making the report of {method} over {_WRITTEN:g} s"
            yield Ratio(f"pages.written_{method}", compared, written.seconds / _WRITTEN, wanted=1.0, ours=written)
            size = page.stat().st_size
            yield Ratio(
                f"pages.size_{method}", f"report of {method}, {size / 1e3:.0f} kB, over 1 MB", size / _BYTES, wanted=1.0
            )
            if CHROMIUM is not None:
                shown = _shown(folder, page)
                compared = f"report of {method} until its first figure is drawn, over 1.5 s"
                yield Ratio(f"pages.shown_{method}", compared, shown.seconds / _SECONDS, wanted=1.0, ours=shown)


def _write(calibration: Calibration, page: Path) -> None:
    page.write_text(report_html(calibration), encoding="utf-8")


def _shown(folder: Path, page: Path, rounds: int = 5) -> Cost:
    """Median wall time until the page and its first figure are drawn, of a browser that has seen no such page."""
    from tests.support.devtools import Tab

    seconds = []
    for i in range(rounds):
        (folder / str(i)).mkdir(exist_ok=True)
        with Tab(folder / str(i)) as tab:
            tab.size(1280)
            start = time.monotonic()
            tab.open(page.as_uri())
            tab.wait("document.readyState == 'complete' && document.querySelector('.plot[data-drawn]') != null", 60.0)
            seconds.append(time.monotonic() - start)
    return Cost(float(np.median(seconds)))
