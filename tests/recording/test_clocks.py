"""Clocks that were set during a recording are named; late messages, gaps and stalls of the recorder are none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.checks import find_clock_step
from alidade.pipelines.recording.recording import open_recording
from tests.support.raw_messages import STORE, T0, random_message, write_raw

Stamps = NDArray[np.int64]
MS = 1_000_000
N = 2000
RNG = np.random.default_rng(6)
# A sensor at 200 Hz whose messages take 1 to 3 ms.
STAMPS = T0 + 5 * MS * np.arange(N)
LOGGED = STAMPS + RNG.integers(1 * MS, 3 * MS, N)


def after(i: int, ms: float, times: Stamps) -> Stamps:
    """The clock set at message i."""
    return times + int(ms * MS) * (np.arange(len(times)) >= i)


@pytest.mark.parametrize("ms", [-60_000.0, -1000.0, -500.0, -100.0, -30.0, 30.0, 100.0, 1000.0, 3e6])
@pytest.mark.parametrize("i", [30, 700, N - 30])
def test_a_sensor_whose_clock_is_set_is_found(i: int, ms: float) -> None:
    step = find_clock_step(after(i, ms, STAMPS), LOGGED)
    assert step is not None
    assert step.what == "the stamps"
    assert step.size == pytest.approx(ms / 1000, abs=0.006)
    assert step.after_ns == STAMPS[i - 1]


@pytest.mark.parametrize("ms", [-2500.0, -1000.0, -100.0])
def test_a_recorder_whose_clock_is_set_back_is_found(ms: float) -> None:
    """A leap second, say: stamps and log times alike run twice through the same second."""
    step = find_clock_step(after(700, ms, STAMPS), after(700, ms, LOGGED))
    assert step is not None
    assert step.size == pytest.approx(ms / 1000, abs=0.02)


def test_a_clock_set_from_1970_is_found() -> None:
    uptime = after(700, 1.7e12, STAMPS - STAMPS[0] + 20_000 * MS)
    for logged in (LOGGED, uptime + 2 * MS):
        step = find_clock_step(uptime, logged)
        assert step is not None
        assert step.size == pytest.approx(1.7e9, rel=1e-6)


def late(times: Stamps) -> tuple[Stamps, Stamps]:
    """One message in 150 arrives after its three successors, and one burst of eight after fifty."""
    order = np.arange(N, dtype=float)
    order[::150] += 3.5
    order[1000:1008] += 50.5
    which = np.argsort(order, kind="stable")
    return times[which], LOGGED


def stalled(times: Stamps) -> tuple[Stamps, Stamps]:
    """The recorder hangs for two seconds, then logs what has piled up."""
    logged = LOGGED.copy()
    logged[500:900] = logged[900] + np.arange(400) * 10_000
    logged[900:] = np.maximum(logged[900:], logged[899] + 10_000)
    return times, logged


def with_gaps(times: Stamps) -> tuple[Stamps, Stamps]:
    keep = np.r_[0:300, 320:900, 1500:N]
    return times[keep], LOGGED[keep]


def twice(times: Stamps) -> tuple[Stamps, Stamps]:
    """A piece recorded twice."""
    which = np.r_[0:800, 600:N]
    return times[which], LOGGED[which]


def slower(times: Stamps) -> tuple[Stamps, Stamps]:
    keep = np.r_[0:1000, 1000:N:4]
    return times[keep], LOGGED[keep]


def lagging(times: Stamps) -> tuple[Stamps, Stamps]:
    """From the middle on the messages take 200 ms longer: a loaded network."""
    return times, after(N // 2, 200.0, LOGGED)


def without_stamps(_: Stamps) -> tuple[Stamps, Stamps]:
    return LOGGED, LOGGED


def irregular(times: Stamps) -> tuple[Stamps, Stamps]:
    """Every tenth in the mean: detections, when there is something to be seen."""
    keep = np.flatnonzero(np.random.default_rng(1).random(N) < 0.1)
    return times[keep], LOGGED[keep]


def in_another_order(times: Stamps) -> tuple[Stamps, Stamps]:
    """Pieces of the file the other way round."""
    which = np.concatenate(np.split(np.arange(N), 10)[::-1])
    return times[which], LOGGED[which]


def stuck(times: Stamps) -> tuple[Stamps, Stamps]:
    """Ten messages with the stamp of the one before: counted as duplicates later on."""
    stamps = times.copy()
    stamps[400:410] = stamps[399]
    return stamps, LOGGED


def all_forward(times: Stamps) -> tuple[Stamps, Stamps]:
    """All clocks set five seconds forward: nothing tells it from a gap, and as one it is read."""
    return after(700, 5000.0, times), after(700, 5000.0, LOGGED)


@pytest.mark.parametrize(
    "make",
    [late, stalled, with_gaps, twice, slower, lagging, without_stamps, irregular, in_another_order, stuck, all_forward],
)
def test_what_is_no_step_is_none(make: Callable[[Stamps], tuple[Stamps, Stamps]]) -> None:
    assert find_clock_step(*make(STAMPS)) is None


@pytest.mark.parametrize(("ms", "way"), [(-400.0, "back"), (400.0, "forward")])
def test_the_line_says_topic_time_size_and_what_to_do(ms: float, way: str, tmp_path: Path) -> None:
    kind = messages.IMU
    made: list[Any] = [
        random_message(kind, np.random.default_rng(i), int(t), "") for i, t in enumerate(after(100, ms, STAMPS[:300]))
    ]
    data = [bytes(STORE.serialize_cdr(one, kind)) for one in made]
    path = write_raw(tmp_path / "x.mcap", "/imu", kind, messages.definition_text(kind), data, LOGGED[:300].tolist())
    with pytest.raises(InputError, match=rf"topic /imu: the stamps jump {way} by 0\.40\d s after 0\.495 s.*Split the"):
        open_recording(path).imu("/imu")
