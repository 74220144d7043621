"""The sweep over what sensors may be off: a small one of each kind."""

from __future__ import annotations

from pathlib import Path

from benchmarks.effects import Case, effects, report, run

SHORT = """
duration_s: 20
gyro_rate_hz: 100
platform_gyro_rate_hz: 100
vision_rate_hz: 15
platform: {yaw: [{amplitude_deg: 10, frequency_hz: 0.3}], pitch: [{amplitude_deg: 12, frequency_hz: 0.2}]}
"""


def test_within_its_prior_it_is_right_and_far_beyond_it_is_named(tmp_path: Path) -> None:
    short = str(tmp_path / "short.yaml")
    Path(short).write_text(SHORT)
    swept = effects("head", short)
    assert set(swept["gyro_scale"]) == {"gyro_scale_x", "gyro_scale_y", "gyro_scale_z"}
    assert {"platform_bias", "clock_skew", "gyro_g"} <= set(swept)
    found = [run(Case("head", short, "batch", "gyro_scale", size, 0), swept["gyro_scale"]) for size in (1, 10)]
    within, far = found
    assert within.status == "calibrated"
    assert within.sigmas < 4.0
    assert not within.named
    assert (far.status, far.determined, far.named) == ("inconsistent", True, True)
    assert not far.changed
    assert "named first from 6 times the prior on, where told: 1 of 1" in list(report(found))
