"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# As the command has it, and before anything imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from alidade.pipelines import deadline
from alidade.pipelines.applications import cli
from tests.support.command import LONGER, Command, Run

# A shell's background jobs, and so the commands that tests start, are told to ignore Ctrl-C; a terminal's are not.
signal.signal(signal.SIGINT, signal.default_int_handler)

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collection_finish() -> None:
    """Python looks for no garbage among what is there before the first test, 90,000 objects."""
    gc.collect()
    gc.freeze()


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """After `make slow`: how long the tests of each file took, as the table in CONTRIBUTING.md has it."""
    if config.option.markexpr != "slow":
        return
    seconds: defaultdict[str, list[float]] = defaultdict(list)
    for report in (*terminalreporter.stats.get("passed", ()), *terminalreporter.stats.get("failed", ())):
        seconds[report.nodeid.partition("::")[0]].append(report.duration)
    terminalreporter.write_line("| file | tests | s | longest, s |\n| --- | --- | --- | --- |")
    for file, each in sorted(seconds.items(), key=lambda item: -sum(item[1])):
        terminalreporter.write_line(f"| `{file}` | {len(each)} | {sum(each):.0f} | {max(each):.0f} |")


@pytest.fixture(autouse=True, scope="session")
def on_a_busy_machine() -> None:
    """The usual time limit is longer in this process: no load ends what a test waits for."""
    deadline.LEAST_S *= LONGER


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real and independent recordings beside the checkout."""
    if not _SHARED.is_dir():
        pytest.skip("needs the recordings in ../shared/data, which are not part of the project")
    return _SHARED


@pytest.fixture(scope="session")
def example_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the example distribution is installed, to be put on the path of a command."""
    site = tmp_path_factory.mktemp("site")
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    example = Path(__file__).parents[1] / "docs" / "examples" / "gyro_pair"
    subprocess.run([sys.executable, "-m", "pip", "install", *options, "--target", site, example], check=True)
    return site


# It is there until all tests are done, and its threads look around fifty times a second where nobody looks at them.
QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "10s",
}


@pytest.fixture(scope="session")
def local_cluster() -> Iterator[str]:
    """Address of a cluster with two workers."""
    distributed = pytest.importorskip("distributed", reason="needs the extra alidade[fleet]")
    import dask

    with (
        dask.config.set(QUIET),
        distributed.LocalCluster(2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture
def few_solutions(monkeypatch: pytest.MonkeyPatch) -> None:
    """An incremental run's first phase is solved at 1, 2, 4, ... s; by default at 1, 1.15, 1.15^2, ... s."""
    monkeypatch.setattr("alidade.pipelines.solvers.incremental.SOLVE_GROWTH", 2.0)


@pytest.fixture
def alidade(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Runs the command in this process (imports paid once)."""

    def run(*arguments: str | Path) -> Run:
        monkeypatch.setattr(sys, "argv", ["alidade", *map(str, arguments)])
        capsys.readouterr()
        try:
            cli.main()
            code: int | str | None = 0
        except SystemExit as stop:
            code = stop.code
        captured = capsys.readouterr()
        return Run(int(code or 0), captured.out, captured.err)

    return run
