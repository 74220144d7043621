"""Trials of the BROAD benchmark as recordings."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from alidade.pipelines.config import load_config
from alidade.pipelines.methods.head.recording import HeadData, read_head
from alidade.pipelines.recording.recording import open_recording

RATE_HZ = 2000.0 / 7.0
BIAS = np.array([1e-3, -2e-3, 3e-3])
LOST = slice(1000, 1400)
TRIALS = {
    "01_undisturbed_slow_rotation_A": (-0.077, -0.075, 0.470),
    "07_undisturbed_fast_rotation_B": (0.204, 0.120, -0.234),
    "21_undisturbed_fast_combined": (0.182, 0.115, -0.218),
}


def converted(trial_file: Path, out: Path, *options: str) -> HeadData:
    command = [sys.executable, "-m", "datasets.broad", str(trial_file), "--out", str(out), *options]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    recording = open_recording(out)
    return read_head(recording, load_config(recording.attachment("alidade.yaml")))
