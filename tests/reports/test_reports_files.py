"""result.json, calibration.yaml, attitude.tum, estimates.mcap, and how they come to their places."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from alidade.factors import so3
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Attitudes, ChiSquare, History, Residuals
from alidade.pipelines.recording.messages import definition
from alidade.pipelines.reports import write
from alidade.pipelines.reports.calibration import SavedCalibration, calibration_yaml, load_calibration
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import result_json
from alidade.pipelines.reports.write import tum, write_results
from tests.support.builders import EPOCH_NS, MOUNT, NAMES, make_calibration


def numbers(content: object) -> Iterator[float]:
    """All numbers in a JSON document."""
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list):
        for entry in content:
            yield from numbers(entry)
    elif isinstance(content, int | float):
        yield content


def strict(text: str) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_result_json_has_the_contracts_keys() -> None:
    content = strict(result_json(make_calibration()))
    assert content["schema"] == "alidade.result/1"
    assert (content["method"], content["solver"], content["status"]) == ("head", "incremental", "calibrated")
    for parameter in content["parameters"]:
        assert list(parameter) == [
            "name",
            "value",
            "sigma",
            "unit",
            "prior_sigma",
            "require",
            "observability",
            "inflation",
        ]
    by_name = {p["name"]: p for p in content["parameters"]}
    assert by_name["free"]["prior_sigma"] is None
    assert by_name["pinned"]["observability"] == "fixed"
    assert by_name["time_offset"]["value"] == 0.012
    assert content["covariance"]["order"] == list(NAMES)
    assert np.array(content["covariance"]["matrix"]).shape == (6, 6)
    assert content["covariance"]["matrix"][3][3] == pytest.approx(4e-8)
    assert content["null_directions"] == []
    assert {"value", "dof", "low", "high", "families"} == set(content["chi_square"])
    assert content["chi_square"]["low"] < 588.0 < content["chi_square"]["high"]
    assert content["session"] == {
        "sha256": "ab" * 32,
        "start": "2026-11-20T12:00:00+00:00",
        "duration_s": 9.5,
        "counts": {"/head/imu": 3800, "vision": 196},
        "dropped": {"/vision/attitude: not finite": 3, "vision: outliers": 4},
    }
    assert "gtsam" in content["software"]
    assert content["timing_s"] == {"read": 0.2, "solve": 1.5}
    assert "truth" not in content


def test_null_directions_are_in_result_json() -> None:
    covariance = np.diag([1e-6, 1e-6, 0.35**2, 1e-8, 1e-8, 0.0])
    content = strict(result_json(make_calibration(covariance=covariance)))
    assert content["status"] == "unobservable"
    (direction,) = content["null_directions"]
    assert direction["weights"] == {"helmet_mount_z": 1.0}
    assert direction["sigma_ratio"] == pytest.approx(1.0)
    assert direction["advice"]


def test_result_json_has_finite_numbers_for_any_covariance_and_chi_square() -> None:
    broken = make_calibration(
        covariance=np.full((6, 6), np.nan), chi_square=ChiSquare(math.nan, math.inf, {"vision": (math.nan, 3.0)})
    )
    content = strict(result_json(broken))
    assert all(math.isfinite(number) for number in numbers(content))
    assert content["chi_square"]["value"] is None


def test_a_published_solver_may_know_fewer_parameters_and_no_chi_square(tmp_path: Path) -> None:
    known = make_calibration(
        solver="published",
        names=("free", "time_offset"),
        values=np.array([1e-3, 0.0]),
        covariance=np.diag([1e-8, 1e-8]),
        chi_square=None,
        history=None,
    )
    content = strict(result_json(known))
    assert [p["name"] for p in content["parameters"]] == ["free", "time_offset"]
    assert content["parameters"][0]["unit"] == "rad/s"
    assert content["chi_square"] == {"value": None, "dof": None, "low": None, "high": None, "families": {}}
    assert load_from(tmp_path, known).rotations == {}


def test_truth_stands_under_its_own_key() -> None:
    truth = {"time_offset": 0.0125, "pinned": 0.1, "_t0": 5, "_attitude": {"t": []}}
    content = strict(result_json(make_calibration(truth=truth)))
    assert set(content["truth"]) == {"time_offset", "pinned"}
    assert content["truth"]["time_offset"]["error"] == pytest.approx(-5e-4)
    assert content["truth"]["time_offset"]["error_sigmas"] == pytest.approx(-2.5)
    assert content["truth"]["pinned"]["error_sigmas"] is None


def test_no_convergence_is_the_reason_in_the_headline() -> None:
    rejected = {"vision": Residuals(np.arange(10.0), np.full((10, 3), 5.0), np.arange(10) < 4)}
    content = strict(result_json(make_calibration(converged=False, message="stuck", residuals=rejected)))
    assert [(each["kind"], each["severity"]) for each in content["findings"]] == [
        ("not_converged", "inconsistent"),
        ("rejection", "inconsistent"),
    ]
    assert content["headline"].startswith("No solution: stuck. Do not use the values. 60 % of vision measurements")


def load_from(folder: Path, calibration: Calibration) -> SavedCalibration:
    path = folder / "calibration.yaml"
    path.write_text(calibration_yaml(calibration))
    return load_calibration(path)


def test_calibration_yaml_reads_back(tmp_path: Path) -> None:
    saved = load_from(tmp_path, make_calibration())
    assert (saved.method, saved.status) == ("head", "calibrated")
    assert saved.value("time_offset") == 0.012
    assert saved.parameters["free"].value == 5e-5
    assert saved.parameters["free"].unit == "rad/s"
    rotation = saved.rotations["helmet_mount"]
    assert rotation.name == "vRh"
    np.testing.assert_allclose(so3.log(np.array(rotation.wxyz)), MOUNT, atol=1e-11)
    assert any("gyro - gyro_bias" in formula for formula in saved.formulas)
    with pytest.raises(InputError, match="no parameter gyro_bias_x"):
        saved.value("gyro_bias_x")


def test_calibration_yaml_has_floats_that_older_yaml_readers_take_for_floats() -> None:
    """YAML 1.1 takes 5e-05 for a string."""
    assert "value: 5.0e-05" in calibration_yaml(make_calibration())


@pytest.mark.parametrize("text", ["", "[1, 2", "method: head\n", "a: \x00", "- 1\n", "schema: alidade.result/1"])
def test_a_file_that_is_no_calibration_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"calibration\.yaml: ") as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)
    assert "Input should be a valid dict" not in str(caught.value)
    assert ("is a result.json" in str(caught.value)) == ("result" in text)
    with pytest.raises(InputError, match="is a folder; name a file in it"):
        load_calibration(tmp_path)
    with pytest.raises(InputError, match="cannot be opened"):
        load_calibration(tmp_path / "none.yaml")


def test_tum_has_absolute_times_to_the_nanosecond_in_order() -> None:
    wxyz = so3.exp(np.array([[0.0, 0.0, 0.2], [0.1, -0.3, 0.0], [0.0, 0.0, 0.1]]))
    lines = tum(Attitudes(np.array([1.0, 2.5, 0.000000011]), wxyz), EPOCH_NS).splitlines()
    assert [line.split()[0] for line in lines] == [
        "1795176000.123456800",
        "1795176001.123456789",
        "1795176002.623456789",
    ]
    rows = np.array([line.split() for line in lines], dtype=float)
    np.testing.assert_array_equal(rows[:, 1:4], 0.0)
    np.testing.assert_allclose(rows[:, [7, 4, 5, 6]], wxyz[[2, 0, 1]], atol=1e-12)


def test_evo_reads_the_trajectory(tmp_path: Path) -> None:
    from evo.core import metrics, trajectory
    from evo.tools import file_interface

    calibration = make_calibration()
    attitudes = calibration.estimate.attitudes
    assert attitudes is not None
    write_results(tmp_path, calibration)
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "attitude.tum"))
    assert read.check()[0]
    truth = trajectory.PoseTrajectory3D(
        np.zeros((200, 3)), so3.multiply(attitudes.wxyz, so3.exp([0.0, 0.0, 0.01])), EPOCH_NS * 1e-9 + attitudes.time
    )
    error = metrics.APE(metrics.PoseRelation.rotation_angle_rad)
    error.process_data((truth, read))
    assert error.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(0.01, rel=1e-6)


def test_estimates_read_back_with_a_ros_decoder(tmp_path: Path) -> None:
    calibration = make_calibration()
    history = calibration.estimate.history
    assert history is not None
    write_results(tmp_path, calibration)
    with (tmp_path / "estimates.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found: dict[str, list[tuple[int, Any]]] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            decoded = definition(schema.name, schema.data.decode()).decode(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert {topic for topic in found if topic.startswith("/estimate/")} == {f"/estimate/{name}" for name in NAMES}
    rows = found["/estimate/time_offset"]
    assert [t for t, _ in rows] == [EPOCH_NS + round(t * 1e9) for t in history.time.tolist()]
    for t_ns, message in rows:
        assert message.stamp.sec * 1_000_000_000 + message.stamp.nanosec == t_ns
        assert (message.value, message.sigma) == (0.012, 2e-4)
        assert (message.lower, message.upper) == pytest.approx((0.0118, 0.0122))


def _lines(history: History, calibration: Calibration) -> dict[str, np.ndarray]:
    """What is to be plotted, by the name of its line: values and the edges of their bands."""
    free = {q.name for q in calibration.problem.quantities if q.prior_sigma != 0.0}
    found: dict[str, np.ndarray] = {}
    for i, name in enumerate(calibration.estimate.names):
        if name in free:
            value, sigma = history.values[:, i], history.sigmas[:, i]
            found |= {name: value, f"{name}_lower": value - sigma, f"{name}_upper": value + sigma}
    return found


def test_estimates_read_back_with_foxgloves_own_decoder(tmp_path: Path) -> None:
    """Standard messages with named numbers, which PlotJuggler takes for lines of these names."""
    calibration = make_calibration()
    assert calibration.estimate.history is not None
    write_results(tmp_path, calibration)
    lines: dict[str, list[float]] = {}
    sigmas: dict[str, list[float]] = {}
    with (tmp_path / "estimates.mcap").open("rb") as stream:
        for _, channel, _, message in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic.startswith(("/plot/", "/sigma/")):
                into = lines if channel.topic.startswith("/plot/") else sigmas
                for name, number in zip(message.name, message.position, strict=True):
                    into.setdefault(name, []).append(number)
    wanted = _lines(calibration.estimate.history, calibration)
    assert lines.keys() == wanted.keys()
    for name, numbers in wanted.items():
        np.testing.assert_array_equal(lines[name], numbers, name)
    assert sigmas.keys() == {name for name in wanted if not name.endswith(("_lower", "_upper"))}


def test_estimates_open_with_plots_in_rerun(tmp_path: Path) -> None:
    """Read with Rerun's own importer: lines with names, the numbers that were written."""
    chunk = pytest.importorskip("rerun.chunk")
    calibration = make_calibration()
    assert calibration.estimate.history is not None
    write_results(tmp_path, calibration)
    lines: dict[str, list[float]] = {}
    for one in chunk.McapReader(tmp_path / "estimates.mcap", include_topic_regex=["/plot/.*"]).stream():
        batch = one.to_record_batch()
        if "Scalars:scalars" in batch.schema.names and one.entity_path.endswith("/position"):
            names, numbers = batch["SeriesLines:names"].to_pylist(), batch["Scalars:scalars"].to_pylist()
            for row_names, row in zip(names, numbers, strict=True):
                for name, number in zip(row_names, row, strict=True):
                    lines.setdefault(name, []).append(number)
    wanted = _lines(calibration.estimate.history, calibration)
    assert lines.keys() == wanted.keys()
    for name, numbers in wanted.items():
        np.testing.assert_array_equal(lines[name], numbers, name)


def test_the_foxglove_layout_plots_what_the_estimates_hold(tmp_path: Path) -> None:
    write_results(tmp_path, make_calibration())
    layout = json.loads((tmp_path / "foxglove.json").read_text())
    paths = {path["value"] for panel in layout["configById"].values() for path in panel["paths"]}
    with (tmp_path / "estimates.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    free = {topic for topic in topics if topic.startswith("/estimate/")} - {"/estimate/pinned"}
    assert paths == {f"{topic}.{field}" for topic in free for field in ("value", "lower", "upper")}

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])


def test_all_files_are_written_and_others_left_alone(tmp_path: Path) -> None:
    files = {"calibration.yaml", "attitude.tum", "estimates.mcap", "foxglove.json", "report.html", "result.json"}
    out = tmp_path / "a" / "b"
    written = write_results(out, make_calibration())
    assert {path.name for path in written} == files
    assert {path.name for path in out.iterdir()} == files
    (out / "notes.txt").write_text("mine")
    batch = make_calibration(solver="batch", history=None)
    over_time = {"estimates.mcap", "foxglove.json"}
    assert {path.name for path in write_results(out, batch)} == files - over_time
    assert {path.name for path in out.iterdir()} == {*files, "notes.txt"} - over_time
    assert json.loads((out / "result.json").read_text())["solver"] == "batch"


def test_a_failure_leaves_everything_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_results(tmp_path, make_calibration())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(write, "write_estimates", fail)
    with pytest.raises(InputError, match="No space left"):
        write_results(tmp_path, make_calibration(values=np.zeros(6)))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    with pytest.raises(InputError):
        write_results(tmp_path / "new", make_calibration())
    assert not (tmp_path / "new").exists()


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "out"
    path.write_text("x")
    with pytest.raises(InputError, match="no folder"):
        write_results(path, make_calibration())
    assert path.read_text() == "x"
