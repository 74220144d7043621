"""Many tasks on dask.distributed: on a cluster of this machine, or on one that runs already.

    with cluster(None, jobs=2) as client:
        for name, result in completed(client, work, {"one": (1,), "two": (2,)}):
            ...

A task whose worker dies is done again by another. Dask gives a task up after several deaths, but it may only have
waited on a worker that another one killed: so each is tried once more alone, and quarantined if that kills too.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import logging
import queue
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alidade.pipelines import progress
from alidade.pipelines.applications.fleet import require_extra
from alidade.pipelines.errors import InputError

if TYPE_CHECKING:
    from distributed import Client, Future

# Tasks handed to the scheduler ahead of time: enough for as many workers.
_AHEAD = 2000
# s to reach a scheduler, and s that it may be without workers.
_REACH = 10.0
_PATIENCE = 60.0


class Killed:
    """Result of a task that killed its worker each time it was tried, the last time alone on the worker."""


@cache
def source_version() -> str:
    """alidade's version with a hash of its source and that of methods installed beside it, `0.1.0+1c9f3b2a`.

    Two checkouts may bear the same number.
    """
    return _source_version()()


@contextmanager
def cluster(scheduler: str | None, jobs: int | None) -> Iterator[Client]:
    """Yield a client of the scheduler at an address, or of a new local one with `jobs` worker processes.

    Args:
        scheduler: tcp://host:8786; None starts workers on this machine for the time of the `with` block.
        jobs: local workers; None: one a core. Not to be given with a scheduler.

    Raises:
        InputError: the extra is missing, nothing answers at the address, it has no workers, or one of them runs
            another alidade.
    """
    require_extra()
    from distributed import Client

    if jobs is not None and (scheduler is not None or jobs < 1):
        raise InputError(f"--jobs {jobs}: a number of local workers, 1 or more, and not together with --scheduler")
    # Lost workers and connections are in the results, or an error of one line.
    for name in ("distributed", "distributed.client", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        address = scheduler or stack.enter_context(_local(jobs))
        try:
            client = stack.enter_context(Client(address, timeout=_REACH, set_as_default=False))
        except (OSError, ValueError) as error:
            raise InputError(
                f"no scheduler at {address}: start one with `dask scheduler`, and workers with `dask worker {address}`"
            ) from error
        _require_workers(client, _REACH)
        _require_version(client)
        yield client


def work_off(
    function: Callable[..., Any],
    tasks: Mapping[str, tuple[Any, ...]],
    take: Callable[[str, Any], None],
    what: str,
    scheduler: str | None,
    jobs: int | None,
) -> bool:
    """Pass the name and result of every task to `take` as they come; return whether Ctrl-C came before the end.

    Progress is shown under the name `what`. Without tasks there is no cluster; see `cluster` and `completed`.
    """
    if not tasks:
        return False
    with cluster(scheduler, jobs) as client:
        try:
            for name, result in progress.track(completed(client, function, tasks), what, len(tasks)):
                take(name, result)
        except KeyboardInterrupt:  # answered at once: workers take a while to end
            print("interrupted: what is finished is written", file=sys.stderr, flush=True)
            return True
    return False


def completed(
    client: Client, function: Callable[..., Any], tasks: Mapping[str, tuple[Any, ...]]
) -> Iterator[tuple[str, Any]]:
    """Yield the name and result of each task as it ends: the function's return value, or Killed.

    The function and its arguments travel to the workers, its result travels back. Leaving the loop early withdraws
    what is not running yet.

    Raises:
        InputError: raised by a task; or the scheduler is gone, or has been without workers for a minute.
    """
    suspects: dict[str, tuple[Any, ...]] = {}
    for name, result in _ended(client, function, tasks):
        if isinstance(result, Killed):
            suspects[name] = tasks[name]
        else:
            yield name, result
    for name, arguments in suspects.items():
        yield from _ended(client, function, {name: arguments})


def _ended(
    client: Client, function: Callable[..., Any], tasks: Mapping[str, tuple[Any, ...]]
) -> Iterator[tuple[str, Any]]:
    version = source_version()
    ended: queue.SimpleQueue[Future] = queue.SimpleQueue()
    running: dict[Future, str] = {}

    def start(count: int) -> None:
        for name, arguments in islice(waiting, count):
            future = client.submit(_work, version, function, arguments, pure=False)
            running[future] = name
            future.add_done_callback(ended.put)

    waiting = iter(tasks.items())
    start(_AHEAD)
    try:
        while running:
            future = _next(client, ended)
            # Taken out only with its result in hand: what is left at an interruption is cancelled.
            result = _result(client, future)
            name = running.pop(future)
            start(1)
            yield name, result
    finally:
        with contextlib.suppress(Exception):
            client.cancel(list(running), force=True)


def _work(version: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Run a task on a worker. Raises InputError on another version: workers that joined late were not asked."""
    if (own := source_version()) != version:
        from distributed import get_worker

        raise InputError(_other_version(get_worker().address, own, version))
    return function(*arguments)


def _next(client: Client, ended: queue.SimpleQueue[Future]) -> Future:
    while True:
        try:
            return ended.get(timeout=_PATIENCE)
        except queue.Empty:
            # Long tasks are no trouble, but without workers this would never end.
            _require_workers(client, _PATIENCE)


def _result(client: Client, future: Future) -> Any:
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except KilledWorker:
        return Killed()
    except CancelledError as error:
        raise InputError(
            f"the scheduler at {_address(client)} is gone; what is finished is kept, the same command continues"
        ) from error


@contextmanager
def _local(jobs: int | None) -> Iterator[Any]:
    from dask.system import CPU_COUNT
    from distributed import LocalCluster
    from distributed.utils import LoopRunner

    # Ctrl-C reaches every process on the terminal; workers inherit the mask of the thread that starts them, and leave
    # it to this one, which hears it meanwhile. The tracker of resources, started by the first of them, would undo it.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    runner = LoopRunner()
    runner.start()
    signal.pthread_sigmask(signal.SIG_SETMASK, before)

    class Cluster(LocalCluster):  # type: ignore[misc]
        """Local cluster that only its block closes, not Python's exit: Ctrl-C may have left it half made."""

        shutdown_on_close = property(lambda _: False, lambda *_: None)

    try:
        with Cluster(
            n_workers=jobs or CPU_COUNT,
            threads_per_worker=1,
            loop=runner.loop,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        ) as local:
            yield local
    finally:
        runner.stop()


def _require_workers(client: Client, timeout: float) -> None:
    address = _address(client)
    try:
        client.wait_for_workers(1, timeout=timeout)
    except OSError as error:
        raise InputError(
            f"the scheduler at {address} has no workers: start some with `dask worker {address}`"
        ) from error


def _require_version(client: Client) -> None:
    own = source_version()
    for worker, version in client.run(_source_version()).items():
        if version != own:
            raise InputError(_other_version(worker, version, own))


def _other_version(worker: str, version: str | None, own: str) -> str:
    return f"the worker at {worker} has alidade {version or 'not installed'}, this is {own}: install the same on both"


def _address(client: Client) -> str:
    return str(client.scheduler.address) if client.scheduler else ""


def _source_version() -> Callable[[], str]:
    """The function that returns the version, nested so that it travels as code to workers with another alidade."""

    def version() -> str:
        digest = hashlib.sha256()
        brought = {entry.module.partition(".")[0] for entry in metadata.entry_points(group="alidade.methods")}
        for package in ("alidade.factors", "alidade.pipelines", *sorted(brought)):
            try:
                spec = importlib.util.find_spec(package)
            except ModuleNotFoundError:
                return ""
            if spec is None or not spec.submodule_search_locations:
                return ""
            root = Path(next(iter(spec.submodule_search_locations)))
            for path in sorted(root.rglob("*.py")):
                digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
        try:
            number = metadata.version("alidade")
        except metadata.PackageNotFoundError:
            number = "unknown"
        return f"{number}+{digest.hexdigest()[:8]}"

    return version
