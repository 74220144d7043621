"""Real files and small inputs that reproduce public trouble, through the command or the public functions."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

import alidade
from tests.support.command import Command


def test_a_real_accelerometer_turned_axis_by_axis_did_not_change(
    shared_data: Path, tmp_path: Path, alidade: Command
) -> None:
    """Published: K diagonal about 1.0023, b .202 m/s^2 along x."""
    table = shared_data / "reports" / "files" / "ck_acc_log.csv"
    (tmp_path / "c.yaml").write_text(
        "{method: tumble, columns: {/imu: {rate: 100, accel: [ax, ay, az], units: {accel: g}}}}"
    )
    run = alidade("calibrate", table, "--config", tmp_path / "c.yaml", "--out", tmp_path / "out")
    assert run.code == 0, run.out
    found = json.loads((tmp_path / "out" / "result.json").read_text())
    assert found["status"] == "calibrated"
    values = alidade_values(tmp_path / "out")
    assert values["accel_k11"] == pytest.approx(1.0023, abs=2e-3)
    assert values["accel_b1"] == pytest.approx(0.202, abs=4e-3)


def alidade_values(folder: Path) -> dict[str, float]:
    loaded = alidade.load(folder / "calibration.yaml")
    return {name: parameter.value for name, parameter in loaded.parameters.items()}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_curvature_of_an_accelerometer_is_no_change(shared_data: Path, seed: int) -> None:
    """Turned about x, then y, then obliquely, with .2 %/g of quadratic nonlinearity."""
    file = shared_data / "reports" / "08-false-change-axis-by-axis" / "scene.py"
    spec = importlib.util.spec_from_file_location("scene", file)
    assert spec is not None
    assert spec.loader is not None
    scene = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(scene)
    t, accel, *_ = scene.make(seed, 0.67, sig=0.03)
    bent = accel + 9.80665 * 2e-3 * (accel / 9.80665) ** 2
    data = {"accel_t": t, "accel": np.asarray(bent)}
    found = alidade.open(data, method="tumble", config=alidade.Config()).calibrate(report=False)
    assert found.status == "calibrated"
