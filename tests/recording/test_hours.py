"""Recordings of hours: what is kept of each sample while a recording is read and its graph is prepared."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import alidade
from alidade.factors import preintegration
from alidade.pipelines.applications.session import Session
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los import recording as los
from alidade.pipelines.recording.checks import take_rows
from alidade.pipelines.recording.plausibility import density
from alidade.pipelines.recording.recording import open_recording

# Of los at 1 kHz and 50 pictures a second, bytes a sample of the gyro: with ten hours, 36 million, in 8 GiB.
READING, READ, PREPARING, PREPARED = 165.0, 73.0, 145.0, 115.0


@pytest.mark.parametrize("block", [37, 1000])
def test_checks_of_a_gimbal_look_at_blocks(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """An encoder that stands still, and the sign of an axis, are seen however many samples are looked at together."""
    data = alidade.simulate("los", {"duration_s": 20.0, "gyro_rate_hz": 100.0}).data
    frozen = data.gimbal.copy()
    during = (data.gimbal_t > 5.0) & (data.gimbal_t < 12.0)
    frozen[during, 0] = frozen[during, 0][0]
    turned = data.gyro * [1.0, -1.0, 1.0]

    def said() -> list[str]:
        found = []
        los.check(data, "/gyro", "/gimbal")
        for changed in ({"gimbal": frozen}, {"gyro": turned}):
            with pytest.raises(InputError) as refused:
                los.check(replace(data, **changed), "/gyro", "/gimbal")
            found.append(str(refused.value))
        return found

    whole = said()
    monkeypatch.setattr(los, "_BLOCK", block)
    assert said() == whole


def test_rows_that_are_all_of_them_are_no_copy() -> None:
    values = np.arange(12.0).reshape(4, 3)
    assert take_rows(values, np.arange(4)) is values
    np.testing.assert_array_equal(take_rows(values, np.array([1, 0, 2, 3])), values[[1, 0, 2, 3]])
    np.testing.assert_array_equal(take_rows(values, np.array([0, 2])), values[[0, 2]])
    alike = take_rows(np.broadcast_to(np.eye(3), (5, 3, 3)), np.array([0, 4]))
    assert alike.shape == (2, 3, 3)
    assert alike.strides[0] == 0


@pytest.mark.parametrize(("variance", "known"), [(-1.0, False), (1e-20, False), (4e-6, True)])
def test_covariances_that_never_change_count_as_often_as_they_are_told(variance: float, known: bool) -> None:
    t, dropped = np.linspace(0.0, 0.49, 50), dict[str, int]()
    alike = np.broadcast_to(variance * np.eye(3), (50, 3, 3))
    found = density("/t", "gyro", t, alike, 2e-7, dropped)
    again: dict[str, int] = {}
    assert found == pytest.approx(density("/t", "gyro", t, alike.copy(), 2e-7, again))
    assert (found is not None) == known
    assert dropped == again
    assert list(dropped.values()) == ([] if known else [50])


@pytest.mark.slow
def test_memory_of_a_sample(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the difference of two lengths, with blocks so short that both have many."""
    monkeypatch.setattr(preintegration, "_BLOCK", 1 << 12)
    monkeypatch.setattr(preintegration, "_KEPT", 2)
    monkeypatch.setattr(preintegration, "_TOGETHER", 200)
    lengths = (120.0, 300.0)
    used = []
    for seconds in lengths:
        path = tmp_path / f"{seconds:g}.mcap"
        simulated = alidade.simulate("los", {"duration_s": seconds, "gyro_rate_hz": 1000.0})
        method("los").write_data(path, simulated.data, config_yaml=simulated.config)
        del simulated
        used.append(_used(path))
    each = np.diff(used, axis=0)[0] / (1000.0 * np.diff(lengths))
    assert (each < [READING, READ, PREPARING, PREPARED]).all(), each


def _used(path: Path) -> list[int]:
    """Bytes at most while a recording is read, then; at most while its graph is prepared, then."""
    tracemalloc.start()
    session = Session.read(open_recording(path), None, None)
    _, reading = tracemalloc.get_traced_memory()
    assert session.facts.duration_s > 0.0
    read, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    problem = session.problem()
    prepared, preparing = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert problem.parameters
    return [reading, read, preparing, prepared]
