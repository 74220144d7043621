"""The formulas in calibration.yaml are right for what is free, and are what `Calibration.apply` computes."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import alidade
from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.indexer import base_from_platform
from alidade.factors.los import LosDirectionFactor
from alidade.pipelines.config import load_config
from alidade.pipelines.diagnostics.diagnose import diagnose
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Parameter, Quantity
from alidade.pipelines.methods import method, names
from alidade.pipelines.methods.formula import apply
from alidade.pipelines.reports import sentences
from alidade.pipelines.reports.calibration import calibration_yaml, saved
from alidade.pipelines.reports.export_formats import ros_parameters
from alidade.pipelines.settings import Config
from tests.support.builders import make_calibration
from tests.support.formulas import CASES
from tests.support.short_problems import COARSE


class Rotation:
    """A rotation matrix, with the products that formulas use."""

    def __init__(self, matrix: Array) -> None:
        self.matrix = matrix

    def __mul__(self, other: Any) -> Any:
        return Rotation(self.matrix @ other.matrix) if isinstance(other, Rotation) else self.matrix @ np.asarray(other)


class Matrix(list[Any]):
    """A matrix written out."""

    def __mul__(self, other: Any) -> Any:
        return np.array(self) @ np.asarray(other)


def exp(vector: Array) -> Rotation:
    return Rotation(so3.matrix(so3.exp(vector)))


def passive(axis: int) -> Any:
    return lambda angle: Rotation(exp(angle * np.eye(3)[axis]).matrix.T)


def read(expression: str, known: Mapping[str, Any]) -> Any:
    """The value of a formula's text, read as the text says, not by the code beside it."""
    expression = re.sub(r"\bExp\((\w+) (e[xyz])\)", r"Exp(\1 * \2)", expression)
    expression = re.sub(r"\[\[.*?\]\]", lambda rows: f"Matrix({rows[0]})", expression)
    axes = dict(zip(("ex", "ey", "ez"), np.eye(3), strict=True))
    words = {
        **axes,
        "Exp": exp,
        "Rx": passive(0),
        "Ry": passive(1),
        "Rz": passive(2),
        "Matrix": Matrix,
        "sin": np.sin,
        "cos": np.cos,
        "inverse": lambda m: Matrix(np.linalg.inv(m)) if isinstance(m, Matrix) else Rotation(m.matrix.T),
    }
    return eval(expression, {"__builtins__": {}}, {**words, **known})


def plain(value: Any) -> Array:
    return value.matrix if isinstance(value, Rotation) else np.asarray(value)


ROTATIONS = {"cRh", "nRm", "camera_rotation", "rotation_17", "nRB_said", "CRT", "bodyRtag"}
NUMBERS = {"measured_error", "azimuth", "elevation", "outer", "inner", "stamp", "first_stamp"}


def _config(case: str) -> Config:
    """Counts where the case says so."""
    raw = "cube: {raw: {accel: {scale: 2.0e-3, offset: 3.0}, gyro: {scale: 1.0e-2, offset: -2.0}}}"
    return load_config(raw.encode() if case.endswith("counts") else b"{}")


@pytest.mark.parametrize("case", CASES)
def test_the_text_says_what_the_code_computes(case: str) -> None:
    name, parameters = CASES[case]
    rng = np.random.default_rng(0)
    formulas = method(name).report.formulas(parameters, _config(case))
    values = {parameter: float(x) for parameter, x in zip(parameters, rng.normal(size=len(parameters)), strict=True)}
    values["first_stamp"] = 0.3
    measured: dict[str, Any] = {}
    for quantity in dict.fromkeys(m for formula in formulas for m in formula.inputs):
        if quantity in ROTATIONS:
            measured[quantity] = so3.exp(rng.normal(size=3))
        else:
            measured[quantity] = rng.normal() if quantity in NUMBERS else rng.normal(size=3)
    found = apply(formulas, values, measured)
    assert list(found) == [formula.name for formula in formulas]
    known: dict[str, Any] = dict(values)
    for stem in {parameter[:-2] for parameter in parameters if parameter.endswith("_x")}:
        known[stem] = np.array([values[f"{stem}_{axis}"] for axis in "xyz"])
    known |= {k: Rotation(so3.matrix(v)) if k in ROTATIONS else v for k, v in measured.items()}
    for formula in formulas:
        known[formula.name] = read(formula.expression, known)
        computed = found[formula.name]
        computed = so3.matrix(computed) if isinstance(known[formula.name], Rotation) else computed
        np.testing.assert_allclose(plain(known[formula.name]), computed, atol=1e-12, err_msg=formula.text)


def test_los_formulas_are_those_of_the_graph_whatever_is_free() -> None:
    """calibration.yaml once left out roll, collimation, the axes' tilt and the time offset."""
    names = ("delta_px", "delta_gx", "delta_gy", "delta_z", "camera_roll", "collimation", "axis_nonperpendicularity")
    rng = np.random.default_rng(1)
    angles = 0.1 * rng.normal(size=len(names))
    gimbal = rng.normal(size=(1, 2))
    cRm = LosDirectionFactor(np.zeros(1), np.zeros((1, 2)), np.zeros((1, 2, 2)), gimbal, names).camera(angles[None])[0]
    formulas = method("los").report.formulas(names, Config())
    values = dict(zip(names, angles.tolist(), strict=True))
    found = apply(formulas, values, {"azimuth": gimbal[0, 0], "elevation": gimbal[0, 1]})
    np.testing.assert_allclose(so3.log(so3.compose(found["lRb"], found["M"], so3.inverse(cRm))), 0.0, atol=1e-12)
    text = " ".join(formula.text for formula in formulas)
    assert all(name in text for name in names)
    assert "time_offset" not in text
    assert "time_offset" in method("los").report.formulas([*names, "time_offset"], Config())[-1].text


def test_indexer_formulas_scale_the_gyro_and_tilt_the_axes_where_these_are_free() -> None:
    """calibration.yaml once said w_it = inverse(mRt) (gyro - gyro_bias) with gyro_scale free."""
    free = [*(f"{name}_{axis}" for name in ("theta", "gyro_bias", "gyro_scale") for axis in "xyz")]
    free.append("axis_nonperpendicularity")
    rng = np.random.default_rng(2)
    values = {name: float(x) for name, x in zip(free, 0.1 * rng.normal(size=len(free)), strict=True)}
    theta, bias, scale = (np.array([values[f"{n}_{a}"] for a in "xyz"]) for n in ("theta", "gyro_bias", "gyro_scale"))
    rate = rng.normal(size=3)
    measured = (1.0 + scale) * so3.rotate(so3.inverse(so3.from_angles(theta)), rate) + bias
    found = apply(
        method("indexer").report.formulas(free, Config()), values, {"gyro": measured, "outer": 0.3, "inner": 0.7}
    )
    np.testing.assert_allclose(found["w_it"], rate, atol=1e-12)
    tilt = values["axis_nonperpendicularity"]
    np.testing.assert_allclose(so3.matrix(found["bRt"]), so3.matrix(base_from_platform(0.3, 0.7, tilt)), atol=1e-12)


def test_a_calibration_applies_itself() -> None:
    settings = {"duration_s": 12.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 20.0, "time_offset_s": 0.02}
    data, truth = alidade.simulate("head", {**settings, "effects": {"gyro_scale_x": 0.03}}, seed=1)
    calibration = alidade.calibrate(data, method="head")
    assert calibration.parameters["time_offset"].value == pytest.approx(truth["time_offset"], abs=5e-3)
    found = calibration.apply(gyro=data.head_gyro, cRh=data.vision_wxyz[:3], stamp=data.vision_t[:3])
    # A scale that the recording determined is applied; what is left is what a gyro without it says.
    bias = np.array([truth[f"gyro_bias_{axis}"] for axis in "xyz"])
    plain, _ = alidade.simulate("head", settings, seed=1)
    off, left = (np.abs(rate - plain.head_gyro + bias).max() for rate in (data.head_gyro - bias, found["w_iv"]))
    assert left < 0.3 * off
    assert found["bRv"].shape == (3, 4)
    feels = method("head").report.formulas(["gyro_g_xx"], Config())
    # No g-sensitivity was determined: the specific force, given all the same, is not looked at.
    assert not any("accel" in formula.inputs for formula in calibration.formulas)
    same = calibration.apply(gyro=data.head_gyro, accel=data.head_force)
    np.testing.assert_array_equal(same["w_iv"], found["w_iv"])
    with pytest.raises(InputError, match="apply: gyro serves only together with accel"):
        apply(feels, {}, {"gyro": np.zeros(3)})
    with pytest.raises(InputError, match=r"apply: gyro has the shape \(3, 5\); \(..., 3\) is needed"):
        calibration.apply(gyro=np.zeros((3, 5)))
    with pytest.raises(InputError, match="nothing is computed from giro; measurements are gyro, cRh, stamp"):
        calibration.apply(giro=np.zeros(3))


def test_what_the_published_solver_does_not_know_counts_as_zero() -> None:
    config = Config()
    calibration = alidade.open(alidade.simulate("los", {"duration_s": 4.0}, seed=1)).calibrate("published")
    assert "gyro_bias_x" not in calibration.parameters
    assert config.method is None
    gyro = np.array([0.1, -0.2, 0.3])
    M = calibration.apply()["M"]
    np.testing.assert_allclose(calibration.apply(gyro=gyro)["w_b"], so3.rotate(M, gyro))


@pytest.mark.parametrize(
    ("name", "scenario"),
    [
        ("los", {"duration_s": 3.0, "gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0, "image_rate_hz": 5.0}),
        ("indexer", COARSE),
        ("head", {"duration_s": 3.0, "gyro_rate_hz": 50.0, "vision_rate_hz": 10.0}),
        ("cube", {"poses": 4, "static_s": 1.0, "imu_rate_hz": 50.0, "camera": {"rate_hz": 2.0}}),
        ("tumble", None),
    ],
)
def test_a_saved_calibration_applies_as_the_one_it_is_of(
    name: str, scenario: Mapping[str, Any] | None, tmp_path: Path
) -> None:
    calibration = alidade.open(alidade.simulate(name, scenario, seed=1)).calibrate(report=False)
    (tmp_path / "calibration.yaml").write_text(calibration_yaml(calibration))
    loaded = alidade.load(tmp_path / "calibration.yaml")
    rng = np.random.default_rng(0)
    numbers = ("azimuth", "elevation", "outer", "inner", "stamp")
    names = dict.fromkeys(name for formula in calibration.formulas for name in formula.inputs)
    vectors = {name: rng.normal(size=3) for name in names}
    measured: dict[str, Any] = {
        name: vector[0] if name in numbers else so3.exp(vector) if re.search("R|rotation", name) else vector
        for name, vector in vectors.items()
    }
    wanted, found = calibration.apply(**measured), loaded.apply(**measured)
    assert list(wanted) == list(found)
    for key, value in wanted.items():
        np.testing.assert_allclose(found[key], value, rtol=1e-9, atol=1e-12)


def test_formulas_of_another_config_are_refused(tmp_path: Path) -> None:
    calibration = alidade.open(alidade.simulate("tumble", seed=1)).calibrate("published")
    file = tmp_path / "calibration.yaml"
    file.write_text(calibration_yaml(calibration).replace("mag_k11, mag_k12", "mag_k12, mag_k11"))
    with pytest.raises(InputError, match="not those of its parameters and this config"):
        alidade.load(file).apply(mag=[0.0, 0.0, 1.0])


@pytest.mark.parametrize("name", ["head", "los"])
def test_time_of_a_picture_has_the_clock_drift(name: str) -> None:
    values = {"time_offset": 0.02, "clock_skew": 1e-4}
    own = [each for each in method(name).report.formulas(values, Config()) if each.name == "time"]
    found = apply(own, values | {"first_stamp": 5.0}, {"stamp": np.array([5.0, 605.0])})
    np.testing.assert_allclose(found["time"], [5.02, 605.02 - 0.06], atol=1e-12)


def test_a_departure_that_is_significant_is_applied_though_its_sigma_is_nearly_that_of_its_prior() -> None:
    """A gyro's scale 8 prior sigmas off was left out of the rate, since its sigma was 85 % of its prior's."""
    values, sigmas = np.array([0.0786, 0.0399, 0.001]), np.array([8.5e-3, 3.7e-3, 9e-3])
    names = tuple(f"gyro_scale_{axis}" for axis in "xyz")
    scales = [Quantity(n, "", 0.01, 0.01, np.inf, group="assumption", sheet="gyro.scale") for n in names]
    made = make_calibration()
    estimate = replace(
        made.estimate, names=names, values=values, covariance=np.diag(sigmas**2), inflation=None, sandwich=None
    )
    problem = replace(made.problem, parameters=(Parameter(9, tuple(scales)),))
    calibration = replace(made, problem=problem, estimate=estimate)
    assert calibration.applied == list(names[:2])
    assert "[[1 + gyro_scale_x, 0, 0], [0, 1 + gyro_scale_y, 0], [0, 0, 1 + 0]]" in calibration.formulas[2].text
    # The same numbers in the snippet of a node, with 0 for what is left out.
    assert "gyro_scale: [0.0786, 0.0399, 0.0]" in ros_parameters(saved(calibration), calibration.applied)
    # A prior other than 0, as of an earlier calibration, is applied whatever the recording adds.
    known = replace(problem, parameters=(Parameter(9, tuple(replace(q, prior_mean=0.002) for q in scales)),))
    assert replace(calibration, problem=known).applied == list(names)
    (note,) = (note for note in sentences.notes(diagnose(estimate, scales), calibration.quantities) if "state" in note)
    assert note == "If the device is so, state it: `sensors: {gyro: {scale: 0.1}}`"
    # No data sheet has a reversed axis.
    reversed_axis = replace(estimate, values=np.array([0.0786, 0.0399, -1.945]))
    said = sentences.notes(diagnose(reversed_axis, scales), calibration.quantities)
    (note,) = (note for note in said if "state it" in note)
    assert note.startswith("gyro_scale_z is that of a reversed axis: correct its sign. If the device is so, state it")
    assert "{gyro: {scale: 0.1}}" in note  # for x, not 2 for z
    # Nor a dead one.
    dead_axis = replace(estimate, values=np.array([0.0786, 0.0399, -1.0007]))
    said = sentences.notes(diagnose(dead_axis, scales), calibration.quantities)
    assert any(note.startswith("gyro_scale_z is that of a dead or wrong axis, with less than") for note in said)
    # A prior of the config's own goes before the data sheet, which would change nothing.
    own = replace(problem, parameters=(Parameter(9, (replace(scales[0], sheet=""), *scales[1:])),))
    priors = replace(calibration, problem=own)
    (note,) = (
        note for note in sentences.notes(diagnose(estimate, own.quantities), priors.quantities) if "state" in note
    )
    assert note.endswith("state it: `sensors: {gyro: {scale: 0.04}}` and `priors: {gyro_scale_x: 0.1}`")


# Parameters that no formula uses, and why.
NOT_UNDONE = {
    **dict.fromkeys(("target_rate_x", "target_rate_z"), "motion of the target, no error of a sensor"),
    **dict.fromkeys(("field_e", "field_n", "field_u", "field_strength", "field_dip", "gravity"), "of the place"),
    **dict.fromkeys(("encoder_delay", "mag_delay"), "says when a reading is true, which leaves its number as it is"),
    **dict.fromkeys(("gyro_filter", "vision_filter"), "a low-pass: what it took away needs the readings around it"),
    **dict.fromkeys(("accel_arm_x", "accel_arm_y", "accel_arm_z"), "its share needs the angular acceleration"),
    **dict.fromkeys(("camera_focal", "camera_centre_x", "camera_centre_y"), "of pictures; formulas begin at attitudes"),
    **dict.fromkeys(("tag_17_px", "tag_17_py", "tag_17_pz"), "a position; formulas turn, they move nothing"),
    "gyro_dead_band": "added to the size of readings, whose sign no formula has; a premise of the result says so",
    **dict.fromkeys((f"vision_map_{axis}_17" for axis in "xyz"), "of harmonics that one recording's attitudes have"),
    **dict.fromkeys((f"los_map_{axis}_17" for axis in "xz"), "of harmonics that one recording's gimbal angles have"),
    "vision_scale": "of angles since the recording's first picture, which later ones do not have",
}


@pytest.mark.parametrize("name", names())
def test_formulas_undo_every_parameter(name: str) -> None:
    """In calibration.yaml nothing is listed that its formulas forget."""
    parameters = [each.replace("*", "17") for spec in method(name).parameters for each in spec.names]
    trees = [formula.tree for formula in method(name).report.formulas(parameters, Config())]
    used = {node.id for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Name)}
    forgotten = {each for each in parameters if not {each, each[:-2]} & used}
    assert forgotten == set(parameters) & NOT_UNDONE.keys()


def test_nothing_is_said_of_parameters_that_are_not_there() -> None:
    there = {each.replace("*", "17") for name in names() for spec in method(name).parameters for each in spec.names}
    assert NOT_UNDONE.keys() <= there
