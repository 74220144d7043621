"""The toolkit from Python: what `import alidade` gives."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import alidade
from alidade.pipelines.methods import names
from alidade.pipelines.methods import simulate as write
from alidade.pipelines.recording.shapes import rows_by_name
from tests.support.forms import split
from tests.support.solved import calibrate

HEAD = {"duration_s": 12.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 10.0}


@pytest.fixture(scope="module")
def simulated() -> alidade.Simulated:
    return alidade.simulate("head", HEAD, seed=3)


@pytest.fixture(scope="module")
def calibration(simulated: alidade.Simulated) -> alidade.Calibration:
    return alidade.open(simulated).calibrate()


def test_every_name_is_there_and_nothing_heavy_is_imported_before_it_is_used() -> None:
    assert all(getattr(alidade, name) is not None for name in alidade.__all__)
    assert set(alidade.__all__) <= set(dir(alidade))
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        alidade.calibrat  # noqa: B018
    heavy = (
        "import sys, alidade; print([m for m in ('numpy', 'gtsam', 'cv2', 'pydantic', 'typer') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_python_dash_m_is_the_command() -> None:
    run = subprocess.run([sys.executable, "-m", "alidade", "--version"], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == alidade.__version__


def test_typing_is_announced() -> None:
    """`Typing :: Typed` once stood in the classifiers without py.typed."""
    from alidade import factors, pipelines

    for package in (alidade, factors, pipelines):
        assert (Path(str(package.__file__)).parent / "py.typed").is_file()


def test_a_file_its_data_and_its_arrays_give_the_same_calibration(tmp_path: Path) -> None:
    from alidade.pipelines.methods import method

    simulated = alidade.simulate("head", BRIEF["head"], seed=3)
    calibration = alidade.open(simulated).calibrate()
    method("head").write(tmp_path / "s.mcap", simulated)
    data = simulated.data
    config = alidade.open(simulated).config
    arrays = {
        name: getattr(data, name)
        for name in ("head_t", "head_gyro", "vision_t", "vision_wxyz", "vision_cov", "gyro_density", "head_force")
    }
    for session in (
        alidade.open(tmp_path / "s.mcap"),
        alidade.open(data, method="head", config=config),
        alidade.open(arrays, method="head", config=config),
    ):
        again = session.calibrate(report=False)
        assert list(again.parameters) == list(calibration.parameters)
        np.testing.assert_allclose(again.estimate.values, calibration.estimate.values, atol=1e-7)
        np.testing.assert_allclose(again.covariance, calibration.covariance, rtol=1e-4, atol=1e-12)


def test_a_calibration_shows_itself_and_writes_itself(calibration: alidade.Calibration, tmp_path: Path) -> None:
    assert repr(calibration) == "<Calibration head, batch, of arrays: calibrated>"
    assert "Delay of the pictures, ms" in str(calibration)
    assert "calibrated." in str(calibration)
    assert "Delay of the pictures" in calibration._repr_html_()
    assert calibration.status == "calibrated"
    assert calibration.headline == "7 of 7 parameters meet the required accuracy."
    assert calibration.covariance.shape == 2 * (len(calibration.parameters),)
    assert calibration.history is not None
    assert set(calibration.residuals) == {"vision"}
    assert {path.name for path in calibration.write(tmp_path / "out")} >= {"result.json", "report.html"}


def test_a_config_overrides_the_recordings_own_key_by_key(simulated: alidade.Simulated) -> None:
    config = alidade.Config(priors={"time_offset": 0.0})
    session = alidade.open(simulated, config=config)
    assert session.config.priors["time_offset"] == 0.0
    assert session.config.noise.gyro_density is not None


def test_scenarios_come_by_name_keys_file_or_model(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("{duration_s: 3.0}")
    by_file = alidade.simulate("head", tmp_path / "s.yaml", seed=1).data
    by_keys = alidade.simulate("head", {"duration_s": 3.0}, seed=1).data
    np.testing.assert_array_equal(by_file.head_gyro, by_keys.head_gyro)
    assert len(alidade.simulate("head", "head_nominal").data.head_t) > len(by_keys.head_t)
    with pytest.raises(alidade.InputError, match="scenario: unknown key duration; the nearest known key is duration_s"):
        alidade.simulate("head", {"duration": 3.0})


def test_a_plan_needs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It once wrote a recording to a temporary folder and read it again."""
    import tempfile

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a file was asked for")

    monkeypatch.setattr(tempfile, "TemporaryDirectory", refuse)
    rates = "gyro_rate_hz: 50, image_rate_hz: 5, gimbal_rate_hz: 50"
    (tmp_path / "s.yaml").write_text(f"{{duration_s: 12, {rates}, sensors: ideal}}")
    plan = alidade.plan("los", tmp_path / "s.yaml")
    assert plan.now.status == "calibrated"
    blurred = alidade.Config.model_validate({"noise": {"los_error": 2e-2}})
    assert alidade.plan("los", tmp_path / "s.yaml", config=blurred, most_steps=0).now.status != "calibrated"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"head_t": [0.0, 1.0]}, "arrays: head needs head_gyro"),
        ({"head_tt": [0.0]}, "arrays: head has no head_tt; it has epoch_ns, head_t"),
        (
            {"head_t": [0.0, 0.0], "head_gyro": np.zeros((2, 3)), "vision_t": [0.0], "vision_wxyz": np.ones((1, 4))},
            "arrays: head_t: 1 usable messages, at least 2 are needed",
        ),
        (
            {"head_t": [0.0, 1.0], "head_gyro": np.zeros((3, 3)), "vision_t": [0.0], "vision_wxyz": np.ones((1, 4))},
            "arrays: head_gyro has 3 rows for the 2 stamps of head_t",
        ),
    ],
)
def test_arrays_that_cannot_be_used_are_refused_in_one_line(given: dict[str, object], message: str) -> None:
    with pytest.raises(alidade.InputError, match=message):
        alidade.open(given, method="head")


# Short recordings of the methods.
BRIEF: dict[str, dict[str, object]] = {
    "los": {"duration_s": 3.0, "gyro_rate_hz": 50.0, "gimbal_rate_hz": 50.0, "image_rate_hz": 5.0},
    "indexer": {"gyro_rate_hz": 5.0, "encoder_rate_hz": 5.0},
    "head": {"duration_s": 3.0, "gyro_rate_hz": 50.0, "vision_rate_hz": 10.0},
    "cube": {"poses": 3, "static_s": 1.0, "imu_rate_hz": 50.0},
    "tumble": {},
}


@pytest.mark.parametrize("name", names())
def test_every_methods_arrays_are_opened_by_name(name: str) -> None:
    """Those of a cube were not: what its class was annotated with was there for type checkers alone."""
    data = alidade.simulate(name, BRIEF.get(name)).data
    given = {field.name: getattr(data, field.name) for field in fields(data)}
    opened = alidade.open(given, method=name).data
    for field in fields(data):
        np.testing.assert_equal(getattr(opened, field.name), given[field.name])
    arrays = rows_by_name(type(data))
    assert {field.name for field in fields(data) if isinstance(given[field.name], np.ndarray)} <= arrays.keys()
    assert all(rows.shape is not None for rows in arrays.values())


def _spoilt(values: Any, *at: int) -> Any:
    values = values.copy()
    values[at] = np.nan
    return values


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("vision_wxyz", lambda q: 1.5 * q, r"vision_wxyz: the quaternion at 0\.\d+ s has norm 1.5 \(and \d+ more\)"),
        ("vision_wxyz", np.zeros_like, r"vision_wxyz: the quaternion at 0\.\d+ s is zero \(and \d+ more\)"),
        ("head_gyro", lambda w: _spoilt(w, 3, 1), "head_gyro is not finite at 0.030000 s; leave out such rows"),
        (
            "head_gyro",
            lambda w: np.ma.masked_less(w, 9.0),
            r"head_gyro is not finite at 0.000000 s \(and 1199 more\)",
        ),
        ("head_gyro", lambda w: w[:, :2], r"head_gyro has the shape \(1200, 2\); \(N, 3\) is needed"),
        ("head_gyro", lambda _: 1.0, r"head_gyro has the shape \(\); \(N, 3\) is needed"),
        ("head_gyro", lambda _: [[1.0, 2.0, 3.0], [1.0]], "head_gyro is no array: its rows differ in length"),
        ("head_gyro", lambda w: w.astype(str), "head_gyro has to be numbers, not str"),
        ("head_gyro", lambda w: [None, *w[1:].tolist()], "head_gyro is no array: .*: row 1 is "),
        ("head_gyro", lambda w: np.rad2deg(w) + 50.0, "head_gyro: rate of .*is the gyro in deg/s"),
        ("head_t", lambda t: 1e3 * t, "head_t: samples are 10 s apart .*is the unit of time ms"),
        ("head_t", lambda t: t[::-1], "head_t: 1199 of 1200 stamps are out of order"),
        ("head_t", lambda t: (t + 1.7e9).astype(np.float32), "head_t is float32, which holds 1.7e.09 to 128 s"),
        ("head_gyro", lambda w: w[:0], "head_gyro has no rows; what was not recorded is left out"),
        ("head_gyro", lambda _: None, "head needs head_gyro"),
        ("head_t", lambda t: (1e9 * t).astype("datetime64[ns]"), "head_t are dates, .*vision_t.* are not"),
        ("head_t", lambda t: 1e9 * t, r"head_t spans 1.2e\+10 s; times have to be in s, not in us or ns"),
        ("vision_wxyz", lambda q: q[:, 1:], r"vision_wxyz has the shape \(\d+, 3\); \(N, 4\) is needed"),
        ("platform_gyro", lambda _: np.zeros((1200, 3)), "platform_gyro needs its stamps, platform_t"),
    ],
)
def test_an_array_that_is_not_what_it_has_to_be_is_named(
    simulated: alidade.Simulated, name: str, spoil: Callable[[Any], object], message: str
) -> None:
    given = {field: getattr(simulated.data, field) for field in ("head_t", "head_gyro", "vision_t", "vision_wxyz")}
    with pytest.raises(alidade.InputError, match=f"^arrays: {message}"):
        alidade.open(given | {name: spoil(given.get(name))}, method="head")
    with pytest.raises(alidade.InputError, match=f"^arrays: {message}"):
        alidade.open(replace(simulated.data, **{name: spoil(given.get(name))}), method="head")


def test_lists_integers_and_masked_arrays_become_floats(simulated: alidade.Simulated) -> None:
    data = simulated.data
    given = {
        "head_t": data.head_t.tolist(),
        "head_gyro": np.rint(data.head_gyro).astype(int),
        "vision_t": np.ma.masked_array(data.vision_t),
        "vision_wxyz": data.vision_wxyz.astype(np.float32),
    }
    opened = alidade.open(given, method="head").data
    assert {type(getattr(opened, name)) for name in given} == {np.ndarray}
    assert {getattr(opened, name).dtype for name in given} == {np.dtype(float)}
    np.testing.assert_array_equal(opened.head_gyro, np.rint(data.head_gyro))


def test_a_roll_may_be_missing_and_nothing_else_of_an_los_error() -> None:
    data = alidade.simulate("los", BRIEF["los"]).data
    covariance = np.broadcast_to(np.eye(3), (len(data.error), 3, 3)).copy()
    covariance[:, 2] = covariance[:, :, 2] = np.nan
    whole = replace(data, error=_spoilt(data.error, 2, 2), error_cov=covariance)
    assert np.isnan(alidade.open(whole, method="los").data.error[2, 2])
    at = f"{data.image_t[4]:.6f}"
    with pytest.raises(alidade.InputError, match=f"arrays: error is not finite at {at} s"):
        alidade.open(replace(whole, error=_spoilt(whole.error, 4, 0)), method="los")
    with pytest.raises(alidade.InputError, match=f"arrays: error_cov is not finite at {at} s"):
        alidade.open(replace(whole, error_cov=_spoilt(covariance, 4, 0, 1)), method="los")


@pytest.mark.parametrize("window", [-1, 0.0, float("nan"), float("inf"), "50kf"])
def test_a_window_that_is_none_is_refused(simulated: alidade.Simulated, window: Any, tmp_path: Path) -> None:
    """-1 once gave a calibration, and a text a TypeError after all of the graph had been prepared."""
    with pytest.raises(alidade.InputError, match=f"^window: {window!r}; seconds above zero are needed, or None for"):
        alidade.open(simulated).calibrate("incremental", window=window)
    with pytest.raises(alidade.InputError, match=f"^window: {window!r}; seconds"):
        alidade.follow(tmp_path / "none.mcap", window=window, patience=0.0)


def test_a_number_is_no_config_and_a_seed_is_no_negative_number(simulated: alidade.Simulated) -> None:
    config: Any = 1e-4
    with pytest.raises(
        alidade.InputError, match=r"^config: a file, an alidade.Config or its keys are needed, not floa"
    ):
        alidade.open(simulated, config=config)
    nothing: Any = 3
    with pytest.raises(alidade.InputError, match="takes a recording, simulated data or arrays by name, not int"):
        alidade.open(nothing, method="head")
    for seed in (-1, 0.5):
        unusable: Any = seed
        with pytest.raises(alidade.InputError, match=f"^seed: {seed} is no whole number from zero on"):
            alidade.simulate("head", HEAD, seed=unusable)


def test_arrays_do_not_say_their_method(simulated: alidade.Simulated) -> None:
    with pytest.raises(
        alidade.InputError, match=r"arrays do not say which method they are for: open\(..., method=...\)"
    ):
        alidade.open(simulated.data)
    with pytest.raises(alidade.InputError, match="arrays: los takes LosData, not HeadData"):
        alidade.open(simulated.data, method="los")


def test_a_list_is_the_files_of_one_recording(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("{duration_s: 5, gyro_rate_hz: 100}")
    write("head", str(tmp_path / "s.yaml"), 1, tmp_path / "s.mcap")
    bag = split(tmp_path / "s.mcap", tmp_path / "bag")
    parts = sorted(bag.glob("*.mcap"))
    whole, listed, two = (alidade.open(source).data for source in (bag, [*map(str, parts)], parts[:2]))
    np.testing.assert_array_equal(listed.head_gyro, whole.head_gyro)
    assert 0 < len(two.head_t) < len(whole.head_t)
    with pytest.raises(alidade.InputError, match="takes the files of one recording"):
        alidade.open([whole])
    with pytest.raises(alidade.InputError, match="a recording of no files"):
        alidade.open([])


def test_a_misspelt_solver_is_refused_and_a_text_is_no_list(tmp_path: Path) -> None:
    """`calibrate(path, ["bacth"])` once ran batch, and `calibrate(path, "batch")` solved five times."""
    (tmp_path / "s.yaml").write_text("{duration_s: 5, gyro_rate_hz: 100}")
    write("head", str(tmp_path / "s.yaml"), 1, tmp_path / "s.mcap")
    with pytest.raises(alidade.InputError, match="no solver 'bacth'; there are batch, incremental, published"):
        calibrate(tmp_path / "s.mcap", ["bacth"])
    with pytest.raises(alidade.InputError, match="a list of names is needed, not the text 'batch'"):
        calibrate(tmp_path / "s.mcap", "batch")
    with pytest.raises(alidade.InputError, match="no solver 'bacth'"):
        alidade.calibrate(tmp_path / "s.mcap", "bacth")


def test_arrays_have_the_place_of_the_config() -> None:
    data = alidade.simulate("tumble", {}).data
    arrays = {
        field.name: getattr(data, field.name) for field in fields(data) if field.name not in ("latitude", "longitude")
    }
    place: dict[str, Any] = {
        "latitude_deg": float(np.rad2deg(data.latitude)),
        "longitude_deg": float(np.rad2deg(data.longitude)),
    }
    opened = alidade.open(arrays, method="tumble", config=alidade.Config(**place)).data
    assert opened.latitude == pytest.approx(data.latitude)
    assert opened.longitude == pytest.approx(data.longitude)
    with pytest.raises(alidade.InputError, match=r"arrays: latitude is .*by the config"):
        alidade.open({**arrays, "latitude": 0.1}, method="tumble", config=alidade.Config(**place))


def test_dates_are_times_and_rows_are_sorted_by_them(simulated: alidade.Simulated) -> None:
    data = simulated.data
    start = np.datetime64("2026-03-01T10:00:00", "ns")
    names = ("head_t", "head_gyro", "vision_t", "vision_wxyz")
    given = {name: getattr(data, name) for name in names}
    dates = {name: start + np.round(1e9 * given[name]).astype("timedelta64[ns]") for name in ("head_t", "vision_t")}
    opened = alidade.open({**given, **dates}, method="head").data
    assert opened.epoch_ns == start.astype(np.int64)
    np.testing.assert_allclose(opened.head_t, data.head_t, atol=1e-9)
    swapped = np.arange(len(data.head_t))
    swapped[[100, 101]] = 101, 100
    mixed = {"head_t": np.append(data.head_t[swapped], data.head_t[-1])}
    mixed["head_gyro"] = np.concatenate([data.head_gyro[swapped], data.head_gyro[-1:]])
    again = alidade.open({**given, **mixed}, method="head").data
    np.testing.assert_array_equal(again.head_t, data.head_t)
    np.testing.assert_array_equal(again.head_gyro, data.head_gyro)
    assert sum(again.dropped.values()) == 2


def test_sensors_of_a_calibration_come_as_matrix_bias_rotation_and_covariance(
    simulated: alidade.Simulated, calibration: alidade.Calibration, tmp_path: Path
) -> None:
    p, data = calibration.parameters, simulated.data
    K, bias = calibration.matrix("gyro"), calibration.bias("gyro")
    np.testing.assert_array_equal(bias, [p[f"gyro_bias_{axis}"].value for axis in "xyz"])
    S = np.linalg.inv(K) - np.eye(3)
    assert S[0, 1] == pytest.approx(p["gyro_skew_xy"].value)
    assert S[2, 2] == pytest.approx(p["gyro_scale_z"].value)
    assert data.head_gyro.shape == ((data.head_gyro - bias) @ K.T).shape
    assert calibration.rotations["helmet_mount"].name == "vRh"
    P = calibration.covariance_of(["time_offset", "gyro_bias_x"])
    np.testing.assert_allclose(np.sqrt(np.diag(P)), [p["time_offset"].sigma, p["gyro_bias_x"].sigma])
    assert calibration.to_dict()["schema"] == "alidade.result/1"
    calibration.write(tmp_path)
    saved = alidade.load(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(saved.matrix("gyro"), K, atol=1e-11)
    np.testing.assert_allclose(saved.covariance_of(["time_offset", "gyro_bias_x"]), P, rtol=1e-9)
    assert saved.to_dict()["method"] == "head"
    (tmp_path / "result.json").unlink()
    with pytest.raises(alidade.InputError, match="no joint covariance"):
        alidade.load(tmp_path / "calibration.yaml").covariance_of(["time_offset"])
    refused: list[tuple[Callable[[], object], str]] = [
        (lambda: calibration.matrix("mag"), "the calibration has no sensor 'mag'; it has gyro"),
        (lambda: calibration.covariance_of(["time_ofset"]), "no parameter time_ofset; the nearest known key is time_o"),
    ]
    for failing, message in refused:
        with pytest.raises(alidade.InputError, match=message):
            failing()


def test_what_is_shown_at_a_prompt_is_one_short_line(
    simulated: alidade.Simulated, calibration: alidade.Calibration, tmp_path: Path
) -> None:
    calibration.write(tmp_path)
    saved = alidade.load(tmp_path / "calibration.yaml")
    shown = (simulated, alidade.open(simulated), calibration, *calibration.uses, saved)
    assert calibration.uses
    parameters = calibration.parameters["time_offset"], saved.parameters["time_offset"]
    for each in (*shown, *parameters, alidade.Config({"latitude_deg": 48.0})):
        assert len(repr(each)) < 100
        assert "\n" not in repr(each)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"noise": {"gyro_densty": 1e-4}},
            "config: unknown key noise.gyro_densty; the nearest known key is gyro_density",
        ),
        ({"noise": {"gyro_density": "low"}}, "config: noise.gyro_density: must be a valid number, not 'low'"),
    ],
)
def test_a_config_from_a_dict_is_refused_in_one_line(
    simulated: alidade.Simulated, keys: dict[str, Any], message: str
) -> None:
    for make in (
        lambda: alidade.Config(keys),
        lambda: alidade.Config(**keys),
        lambda: alidade.open(simulated, config=keys),
    ):
        with pytest.raises(alidade.InputError) as error:
            make()
        assert str(error.value) == message


def test_a_magnetometer_is_calibrated_in_one_line() -> None:
    """In the unit of the readings, as MATLAB's function of the same name has it."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    soft = np.array([[1.1, 0.02, 0.01], [0.02, 0.95, -0.03], [0.01, -0.03, 1.02]])
    hard = np.array([20.0, -10.0, 5.0])
    m = 48.0 * directions @ np.linalg.inv(soft) + hard + 0.05 * rng.standard_normal((300, 3))
    found = alidade.magcal(m)
    A, b, field = found
    size = np.linalg.det(soft) ** (1.0 / 3.0)
    np.testing.assert_allclose(A, soft / size, atol=1e-3)
    np.testing.assert_allclose(b, hard, atol=0.05)
    assert field == pytest.approx(48.0 / size, rel=1e-3)
    assert np.linalg.det(A) == pytest.approx(1.0)
    assert np.std(np.linalg.norm((m - b) @ A, axis=1)) < 0.06
    assert found.calibration.status == "calibrated"


def test_an_imu_in_many_attitudes_is_calibrated_in_one_line() -> None:
    data, truth = alidade.simulate("cube", {"poses": 20}, seed=1)
    found = alidade.imu_static(data.accel, data.gyro, data.imu_t, latitude_deg=40.0)
    K, bias, K_gyro, bias_gyro = found
    assert found.calibration.status == "calibrated"
    true = {name: np.array([[truth[f"{name}_k{i}{j}"] for j in "123"] for i in "123"]) for name in ("accel", "gyro")}
    offsets = {name: np.array([truth[f"{name}_b{i}"] for i in "123"]) for name in ("accel", "gyro")}
    # Body's axes are the accelerometer's own: lengths do not depend on them.
    raw = np.linalg.solve(true["accel"], 9.8 * np.eye(3) - offsets["accel"]).T
    lengths = np.linalg.norm((raw - bias) @ K.T, axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(raw @ true["accel"].T + offsets["accel"], axis=1), rtol=1e-3)
    np.testing.assert_allclose(bias_gyro, -np.linalg.solve(true["gyro"], offsets["gyro"]), atol=1e-4)
    np.testing.assert_allclose(K_gyro.T @ K_gyro, true["gyro"].T @ true["gyro"], atol=2e-3)


def test_a_gyro_and_a_tracked_body_are_registered_in_one_line() -> None:
    from alidade.factors import so3

    data, truth = alidade.simulate("head", {**HEAD, "helmet_mount_deg": [5.0, 3.0, -4.0]}, seed=1)
    found = alidade.hand_eye(data.head_gyro, data.head_t, data.vision_wxyz, data.vision_t)
    R, delay = found
    mount = so3.matrix(so3.exp(np.array([truth[f"helmet_mount_{axis}"] for axis in "xyz"])))
    np.testing.assert_allclose(R, mount, atol=4e-3)
    assert delay == pytest.approx(truth["time_offset"], abs=4.0 * found.calibration.parameters["time_offset"].sigma)


def test_a_hand_eye_calibration_that_one_axis_does_not_determine_warns() -> None:
    from alidade.factors import so3

    t, noise = np.arange(0.0, 10.0, 0.01), np.random.default_rng(0)
    axis = np.array([1.0, 0.0, 0.0])
    gyro = np.cos(2.0 * t)[:, None] * axis + 1e-3 * noise.standard_normal((len(t), 3))
    attitudes = so3.exp((0.5 * np.sin(2.0 * t[::5]))[:, None] * axis + 5e-3 * noise.standard_normal((len(t[::5]), 3)))
    with pytest.warns(UserWarning, match="unobservable: .*helmet_mount"):
        alidade.hand_eye(gyro, t, attitudes, t[::5])


def test_what_the_commands_do_is_there(calibration: alidade.Calibration, tmp_path: Path) -> None:
    from alidade.pipelines.methods import method

    calibration.write(tmp_path / "out")
    method("head").write(tmp_path / "later.mcap", alidade.simulate("head", BRIEF["head"], seed=4))
    validated = alidade.validate(tmp_path / "later.mcap", calibration)
    assert validated.held is not None
    assert validated.calibration.method == "head"
    assert "static_transform_publisher" in alidade.export(calibration, "tf")
    assert alidade.export(tmp_path / "out" / "calibration.yaml", "tf") == alidade.export(calibration, "tf")
    files, missing = alidade.certificate(tmp_path / "out")
    assert {path.name for path in files} == {"certificate.html", "certificate.json"}
    assert "serial" in missing


def test_arrays_are_looked_at_as_files_are() -> None:
    """A component that never changes was not measured; sensors that contradict one another are named."""
    data = alidade.simulate("los", {"duration_s": 20.0, "gyro_rate_hz": 100.0}).data
    error = np.column_stack([data.error[:, :2], np.zeros(len(data.error))])
    session = alidade.open(replace(data, error=error), method="los")
    assert np.isnan(session.data.error[:, 2]).all()
    assert [reason for reason in session.data.dropped if "column 2 reads one value throughout" in reason]
    with pytest.raises(alidade.InputError, match="arrays: gyro: gimbal and pictures show that the gyro is in deg/s"):
        alidade.open(replace(data, gyro=np.rad2deg(data.gyro)), method="los")


def _clipped(values: Any) -> Any:
    most = np.sort(np.abs(values), axis=0)[-len(values) // 40]
    return np.clip(values, -most, most)


def _stuck(values: Any) -> Any:
    values = values.copy()
    start, stop = int(0.5 * len(values)), int(0.55 * len(values))
    values[start:stop] = values[start]
    return values


@pytest.mark.parametrize("spoil", [_clipped, _stuck])
@pytest.mark.parametrize(
    ("name", "brief", "fields", "columns"),
    [
        ("tumble", {}, ("mag_t", "mag"), {"/mag": {"time": "t", "field": ["x", "y", "z"]}}),
        (
            "cube",
            {"poses": 12, "static_s": 2.0, "imu_rate_hz": 100.0, "camera": None},
            ("imu_t", "gyro", "accel"),
            {"/imu": {"time": "t", "gyro": ["x", "y", "z"], "accel": ["ax", "ay", "az"]}},
        ),
    ],
)
def test_faulty_readings_are_left_out_of_arrays_as_of_files(
    name: str,
    brief: dict[str, Any],
    fields: tuple[str, ...],
    columns: dict[str, Any],
    spoil: Callable[[Any], Any],
    tmp_path: Path,
) -> None:
    """Arrays were not screened: clipped readings moved parameters by 4.5 sigma, of a calibration within its limits."""
    data = alidade.simulate(name, brief, seed=1).data
    t, readings, *others = (getattr(data, each) for each in fields)
    given = dict(zip(fields, (np.round(t - t[0], 9), spoil(readings), *others), strict=True))
    header = "t,x,y,z,ax,ay,az" if others else "t,x,y,z"
    np.savetxt(tmp_path / "s.csv", np.column_stack([*given.values()]), "%.17g", ",", header=header, comments="")
    config = {"latitude_deg": 48.0, "longitude_deg": 11.0, "date": "2026-01-01"}
    arrays = alidade.open(given, method=name, config=alidade.Config(config))
    file = alidade.open(tmp_path / "s.csv", method=name, config=alidade.Config({**config, "columns": columns}))
    what = "saturated" if spoil is _clipped else "stuck at one value"
    lost, lost_of_file = (
        sum(n for reason, n in session.data.dropped.items() if reason.endswith(what)) for session in (arrays, file)
    )
    assert lost == lost_of_file > 0
    for each in given:
        np.testing.assert_allclose(getattr(arrays.data, each), getattr(file.data, each), rtol=1e-12, atol=1e-9)
    found, expected = (session.calibrate(report=False) for session in (arrays, file))
    assert found.status == expected.status
    np.testing.assert_allclose(found.estimate.values, expected.estimate.values, rtol=1e-6, atol=1e-9)


def test_dead_and_repeated_readings_of_arrays_are_treated_as_those_of_files(simulated: alidade.Simulated) -> None:
    gyro = simulated.data.head_gyro * [1.0, 0.0, 1.0]
    with pytest.raises(alidade.InputError, match=r"^arrays: head_gyro: axis y reads 0 throughout"):
        alidade.open(replace(simulated.data, head_gyro=gyro), method="head")
    held = np.repeat(simulated.data.head_gyro[::4], 4, axis=0)[: len(gyro)]
    (note,) = alidade.open(replace(simulated.data, head_gyro=held), method="head").facts.notes
    assert note == f"head_t: repeats the reading before, used once: {len(gyro) * 3 // 4}"
    parked = np.zeros_like(gyro)
    data = replace(simulated.data, platform_t=simulated.data.head_t, platform_gyro=parked)
    assert len(alidade.open(data, method="head").data.platform_gyro) == len(parked), "a platform may be parked"
