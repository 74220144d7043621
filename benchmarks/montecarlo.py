"""What one run of a study costs: simulated arrays solved for numbers, against a file with all that a report tells."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from alidade.pipelines import methods
from alidade.pipelines.applications.fleet.montecarlo import simulate_and_solve
from alidade.pipelines.applications.session import open_session
from benchmarks.measure import Ratio, costs


def run() -> Iterator[Ratio]:
    """The nominal scenario of each method, by batch."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        for name in methods.names():
            settings = methods.method(name).settings()
            a, b = costs(
                [partial(simulate_and_solve, name, settings, 0, ["batch"], None), partial(_by_file, name, path)]
            )
            compared = f"a run of {name}'s nominal scenario on arrays over one through a file, all told"
            yield Ratio(f"montecarlo.{name}", compared, a.seconds / b.seconds, wanted=1.0, ours=a, theirs=b)


def _by_file(name: str, path: Path) -> None:
    methods.simulate(name, None, 0, path)
    open_session(path).calibrations(["batch"])
