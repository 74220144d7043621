"""Bars on a terminal, silence elsewhere; tags found in several processes as in one."""

from __future__ import annotations

import pytest
from rich.console import Console

from alidade.pipelines import progress
from alidade.pipelines.parallel import processes
from alidade.pipelines.vision import tags
from benchmarks.detection import cube_picture


def test_silent_when_not_a_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    with progress.shown():
        assert list(progress.track(range(3), "counting", 3)) == [0, 1, 2]
    assert capfd.readouterr().err == ""


def test_quiet_is_silent_on_a_terminal_and_the_others_are_not(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Console, "is_terminal", True)
    with progress.shown(quiet=True):
        list(progress.track(range(3), "counting", 3))
    assert capfd.readouterr().err == ""
    with progress.shown():
        list(progress.track(range(3), "counting", 3))
    assert "counting" in capfd.readouterr().err


@pytest.mark.slow
def test_tags_by_several_processes_are_those_by_one_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    monkeypatch.setattr(tags, "_MANY", 3)
    camera, picture = cube_picture()
    encoded = cv2.imencode(".png", picture)[1].tobytes()
    images = [(k, encoded if k % 4 else b"broken") for k in range(8)]
    alone = list(tags.detections(images, camera=camera))
    with processes(2):
        together = list(tags.detections(iter(images), camera=camera))
    assert [t for t, _ in together] == [t for t, _ in alone] == list(range(8))
    for (_, a), (_, b) in zip(together, alone, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert (a.corners == b.corners).all()
    assert together[0][1] is None
