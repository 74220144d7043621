"""What a cube calibration and its report need in several places is computed once."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from alidade.pipelines.methods import simulate
from alidade.pipelines.methods.cube import static_poses as static_intervals
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.vision import pose
from tests.support.solved import calibrate

POSES = 4
SCENARIO = f"{{poses: {POSES}, static_s: 2.0, turn_rad_s: 4.0, camera: {{rate_hz: 1.0, pictures: {{rate_hz: 1.0}}}}}}"


@pytest.mark.usefixtures("few_solutions")
@pytest.mark.parametrize("images", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["detections", "pictures"])
def test_static_intervals_and_tag_poses_are_found_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images: bool
) -> None:
    """By reading, three solvers, findings and a report together."""
    (tmp_path / "scenario.yaml").write_text(SCENARIO)
    simulate("cube", str(tmp_path / "scenario.yaml"), 1, tmp_path / "s.mcap", images)
    calls: Counter[str] = Counter()

    def counted(module: Any, name: str) -> None:
        original = getattr(module, name)

        def call(*arguments: Any, **options: Any) -> Any:
            calls[name] += 1
            return original(*arguments, **options)

        monkeypatch.setattr(module, name, call)

    counted(static_intervals, "find_static_intervals")
    counted(pose, "estimate_pose")
    calibrations = calibrate(tmp_path / "s.mcap", ["batch", "incremental", "published"], report=True)
    assert "Static poses" in report_html(calibrations[0])
    assert calls == {"find_static_intervals": 1, "estimate_pose": POSES}
