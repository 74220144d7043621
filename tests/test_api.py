"""The toolkit from Python: what `import alidade` gives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import alidade
from pipelines.methods import simulate as write
from pipelines.session import calibrate
from tests.forms import split

HEAD = {"duration_s": 12.0, "gyro_rate_hz": 100.0, "vision_rate_hz": 20.0}


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
    import factors
    import pipelines

    for package in (alidade, factors, pipelines):
        assert (Path(str(package.__file__)).parent / "py.typed").is_file()


def test_a_file_its_data_and_its_arrays_give_the_same_calibration(
    simulated: alidade.Simulated, calibration: alidade.Calibration, tmp_path: Path
) -> None:
    from pipelines.methods import method

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
        again = session.calibrate()
        assert list(again.parameters) == list(calibration.parameters)
        np.testing.assert_allclose(again.estimate.values, calibration.estimate.values, atol=1e-7)
        np.testing.assert_allclose(again.covariance, calibration.covariance, rtol=1e-4, atol=1e-12)


def test_a_calibration_shows_itself_and_writes_itself(calibration: alidade.Calibration, tmp_path: Path) -> None:
    assert repr(calibration) == "<Calibration head, batch, of arrays: calibrated>"
    assert "time_offset" in str(calibration)
    assert "calibrated." in str(calibration)
    assert "<td>time_offset</td>" in calibration._repr_html_()
    assert calibration.status == "calibrated"
    assert calibration.headline.startswith("All")
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
    rates = "gyro_rate_hz: 100, image_rate_hz: 10, gimbal_rate_hz: 100"
    (tmp_path / "s.yaml").write_text(f"{{duration_s: 12, {rates}, sensors: ideal}}")
    plan = alidade.plan("los", tmp_path / "s.yaml")
    assert plan.now.assessment.status == "calibrated"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"head_t": [0.0, 1.0]}, "arrays: head needs head_gyro"),
        ({"head_tt": [0.0]}, "arrays: head has no head_tt; it has epoch_ns, head_t"),
        (
            {"head_t": [0.0, 0.0], "head_gyro": np.zeros((2, 3)), "vision_t": [0.0], "vision_wxyz": np.ones((1, 4))},
            "arrays: head_t has to be one row of stamps in s, each later than the one before",
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
