"""Following as it happens: delays through each source, and the cost of looks at a recording of hours."""

from __future__ import annotations

import io
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.sources import Source, StandardInput, source_of
from alidade.pipelines.applications.session import open_session
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.recording.growing import GrowingFiles
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.settings import Sensors
from alidade.pipelines.solvers import incremental
from tests.support.builders import BRISK, IDEAL
from tests.support.live import Bridge, Message, messages, paced, write


def record(
    path: Path, seconds: float, images_hz: float, rate_hz: float, sensors: Sensors | None = IDEAL
) -> tuple[Path, Path]:
    """A recording, and its config, which streams do not carry."""
    scenario = LosScenario(
        duration_s=seconds,
        carrier=BRISK,
        image_rate_hz=images_hz,
        gyro_rate_hz=rate_hz,
        gimbal_rate_hz=rate_hz,
        sensors=sensors,
    )
    method("los").write(path / "whole.mcap", simulate_los(scenario, 2))
    (path / "c.yaml").write_text(los_config(scenario))
    return path / "whole.mcap", path / "c.yaml"


def played(
    kind: str, whole: list[Message], folder: Path, stack: ExitStack
) -> tuple[Source, Callable[[], bool], Callable[[], float]]:
    """A source that plays the messages as fast as they were recorded, whether it is over, and when it began."""
    began = time.monotonic()
    if kind == "bridge":
        bridge = stack.enter_context(Bridge(whole, 1.0))
        first = whole[0][2]
        return source_of(bridge.url, None, lambda _: None), lambda: bridge.is_over, lambda: bridge.came[first]
    if kind == "standard input":
        out, into = os.pipe()
        threading.Thread(target=_send, args=(whole, into), daemon=True).start()
        # What is written may not have been read: the end of the pipe is the end.
        return StandardInput(None, os.fdopen(out, "rb")), lambda: False, lambda: began
    path = folder / "s.mcap" if kind == "file" else folder / "bag"
    thread = threading.Thread(target=_record, args=(whole, path), daemon=True)
    thread.start()
    return Source(path), lambda: not thread.is_alive(), lambda: began


class _Pipe(io.FileIO):
    """What mcap's writer can write into: it asks where it is."""

    _at = 0

    def write(self, data: Any) -> int:
        written = super().write(data)
        self._at += written
        return written

    def tell(self) -> int:
        return self._at


def _send(whole: list[Message], into: int) -> None:
    with _Pipe(into, "w") as pipe:
        write(paced(whole, 1.0), pipe, 2_000)


def _record(whole: list[Message], path: Path) -> None:
    """Into a file; into a folder in three parts."""
    if path.suffix:
        with path.open("wb") as out:
            write(paced(whole, 1.0), out, 2_000)
        return
    path.mkdir()
    pace = paced(whole, 1.0)
    for i in range(3):
        with (path / f"bag_{i}.mcap").open("wb") as out:
            write((next(pace) for _ in range(len(whole) // 3)), out, 2_000)
    names = "".join(f"\n    - bag_{i}.mcap" for i in range(3))
    (path / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:{names}\n")


def follow_live(kind: str, whole: Path, config: Path, folder: Path) -> tuple[Calibration, np.ndarray, np.ndarray]:
    """What came out; how old, s, what was told was when it was told, and up to when, s of recording."""
    sent = messages(whole)
    told: list[tuple[float, float]] = []

    def show(view: View) -> None:
        if view.values is not None:
            told.append((time.monotonic(), view.time))

    with ExitStack() as stack:
        source, is_over, began = played(kind, sent, folder, stack)
        stack.enter_context(source)
        settings = Settings(config=config, patience=10.0, check=True)
        calibration = Follower(source, settings, show, lambda _: None, is_over).follow()
    now, upto = np.array(told).T
    return calibration, now - began() - upto, upto


@pytest.mark.parametrize("kind", [pytest.param("file", marks=pytest.mark.slow), "standard input"])
def test_a_few_seconds_as_they_come(kind: str, tmp_path: Path) -> None:
    """Folders and bridges are in test_follow_sources."""
    whole, config = record(tmp_path, 2.5, 8.0, 50.0)
    calibration, late, upto = follow_live(kind, whole, config, tmp_path)
    assert calibration.facts.duration_s > 2.3
    assert len(np.unique(upto)) > 1, "it was to be seen while it came"
    assert (late > 0.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["file", "folder", "bridge", "standard input"])
def test_ninety_seconds_as_they_come(kind: str, tmp_path: Path) -> None:
    """In the end what the finished file says; how long a message takes to be in the estimate is printed."""
    whole, config = record(tmp_path, 90.0, 10.0, 100.0, None)
    calibration, late, upto = follow_live(kind, whole, config, tmp_path)
    print(f"{kind}: median delay {np.median(late):.3f} s, 95 % below {np.percentile(late, 95):.3f} s")
    assert upto[-1] > 89.0
    finished = open_session(whole).calibrate("incremental")
    for name, p in finished.parameters.items():
        assert calibration.parameters[name].value == pytest.approx(p.value, abs=1e-3 * p.sigma), name


# Enough for a first look, s.
_FIRST = 8.0


class Grown:
    """A recording that grows by pieces of some seconds, whenever the last one has been taken up.

    Attributes:
        spent: (n, 2) s of recording, and s of processor until then.
    """

    def __init__(self, whole: Path, path: Path, piece_s: float) -> None:
        self._pieces = self._write(messages(whole), path, piece_s)
        self._taken = True
        self._rows: list[tuple[float, float]] = []

    @property
    def spent(self) -> np.ndarray:
        return np.array(self._rows)

    def show(self, view: View) -> None:
        self._taken = True
        self._rows.append((view.time, time.process_time()))

    def stopped(self) -> bool:
        """Asked often; never."""
        if self._taken:
            self._taken = next(self._pieces, False)
        return False

    def _write(self, whole: list[Message], path: Path, piece_s: float) -> Iterator[bool]:
        """False: there is something to be taken up."""
        due = threading.Semaphore(0)
        done = threading.Semaphore(0)

        def waited() -> Iterator[Message]:
            end = whole[0][2] + _FIRST * 1e9
            for message in whole:
                if message[2] > end:
                    done.release()
                    due.acquire()
                    end += piece_s * 1e9
                yield message

        def run() -> None:
            with path.open("wb") as out:
                write(waited(), out, 4_000)
            done.release()

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        while thread.is_alive():
            done.acquire()
            yield False
            due.release()


def follow_grown(path: Path, seconds: float, piece_s: float) -> np.ndarray:
    whole, config = record(path, seconds, 2.0, 50.0)
    grown = Grown(whole, path / "s.mcap", piece_s)
    source = Source(path / "s.mcap")
    Follower(source, Settings(config=config, patience=60.0), grown.show, lambda _: None, grown.stopped).follow()
    return grown.spent


def test_a_look_reads_the_end_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[tuple[int, int]] = []
    look = GrowingFiles.refresh

    def noted(self: GrowingFiles, where: list[Path], since_ns: int | None) -> object:
        found = look(self, where, since_ns)
        read.append((0 if since_ns is None else since_ns, sum(found.counts.values())))
        return found

    monkeypatch.setattr(GrowingFiles, "refresh", noted)
    # The initialisation phase may end with fewer steps, and the past is marginalised out more often than every 20 s.
    monkeypatch.setattr(incremental, "MIN_STEPS", 20)
    monkeypatch.setattr(incremental, "MARGINALIZE_EVERY", 4.0)
    spent = follow_grown(tmp_path, 30.0, 4.0)
    assert spent[-1, 0] > 29.0
    late = np.array(read[-2:])
    assert (late[:, 0] > 0).all(), "all was read"
    # 102 messages a second; at most 4 s since the past was marginalised out, two before, and a piece or two.
    assert (late[:, 1] < 102 * 16).all()


@pytest.mark.slow
def test_an_hour_costs_as_much_at_its_end_as_at_its_start(tmp_path: Path) -> None:
    """Pieces of 4 s, as looks five times a second at 20 times the speed would find them."""
    spent = follow_grown(tmp_path, 3600.0, 4.0)
    # In the end a clock that has drifted far is solved anew from the first second.
    again = np.flatnonzero(np.diff(spent[:, 0]) < 0.0)
    time_s, processor = spent[: again[0] + 1 if len(again) else None].T

    def share(start: float, stop: float) -> float:
        a, b = np.interp([start, stop], time_s, processor)
        return (b - a) / (stop - start)

    first, last = share(60.0, 360.0), share(3290.0, 3590.0)
    print(f"processor per second of recording: {first:.4f} in the first five minutes, {last:.4f} in the last")
    assert last < 1.2 * first
