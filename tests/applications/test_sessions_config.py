"""What a config may say, how two are put together, and what is said about a wrong one."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest

from alidade.pipelines.applications.session import of_other_methods
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.gaussian_prior import independent
from alidade.pipelines.methods import method
from alidade.pipelines.methods.cube.recording import CubeConfig, field_date
from alidade.pipelines.methods.head.recording import HEAD_IMU, HeadConfig
from alidade.pipelines.methods.los.recording import GIMBAL
from alidade.pipelines.settings import Tag, check_names, first_given

# The example of the file format, with every key.
FULL = b"""
method: los
topics: {imu: /imu, gimbal: /gimbal/joint_states, los_error: /los/error}
noise: {gyro_density: 5.0e-5, gyro_bias_walk: 1.0e-6, platform_gyro_density: 1.0e-5, accel_density: 2.0e-3,
        mag_density: 5.0e-8, los_error: 2.0e-5, los_roll: 2.0e-4, encoder: 1.0e-5, vision_attitude: 8.7e-3,
        corner_px: 0.3}
priors: {delta_px: 0.05, delta_gx: 0, delta_gy: null}
require: {delta_px: 1.7e-4}
latitude_deg: 40.0
date: 2026-11-20
indexer: {base_attitude: [1, 0, 0, 0]}
cube: {tag_family: 36h11, tags: {16: {size: 0.12, rotation: [1, 0, 0, 0], position: [0, 0, 0.08]}},
       camera_rotation: [1, 0, 0, 0], raw: {accel: {scale: 2.41e-3, offset: 33000}}}
head: {board: {tag_family: 36h11, tags: {0: {size: 0.04, rotation: [1, 0, 0, 0], position: [0, 0, 0]}}}}
"""


def test_a_config_as_override_keeps_what_an_earlier_calibration_knows() -> None:
    known = load_config(b"method: los").with_prior(independent(["delta_px"], [0.01], [1e-3], "earlier"))
    (_, gaussian_prior) = load_config(FULL, known).gaussian_priors
    assert (gaussian_prior.names, gaussian_prior.source) == ((), "earlier"), "priors of the config win"
    (_, gaussian_prior) = load_config(b"latitude_deg: 40.0", known).gaussian_priors
    assert (gaussian_prior.names, gaussian_prior.mean.tolist()) == (("delta_px",), [0.01])


def test_a_section_without_anything_is_none_in_a_mapping_too() -> None:
    assert load_config(None, {"noise": None, "method": "los"}).method == "los"


def test_every_key_of_the_format() -> None:
    config = load_config(FULL)
    assert config.method == "los"
    assert config.noise.gyro_density == 5e-5
    assert config.priors == {"delta_px": 0.05, "delta_gx": 0.0, "delta_gy": None}
    assert config.section(CubeConfig).tags[16] == Tag(size=0.12, position=(0.0, 0.0, 0.08))
    accel = config.section(CubeConfig).raw.accel
    assert accel is not None
    assert accel.offset == 33000.0
    board = config.section(HeadConfig).board
    assert board is not None
    assert board.tags[0].size == 0.04
    assert field_date(config) == datetime.date(2026, 11, 20)
    assert config.topic(GIMBAL) == "/gimbal/joint_states"


def test_nothing_given_is_visible_as_nothing() -> None:
    for config in (load_config(None), load_config(b""), load_config(b"noise:\ncube:\n")):
        assert config.noise.gyro_density is None
        assert config.method is None
        assert config.section(HeadConfig).board is None
        assert config.topic(HEAD_IMU) == "/head/imu"


def test_a_date_under_cube_is_taken() -> None:
    assert field_date(load_config(b"cube: {date: 2026-11-20}")) == datetime.date(2026, 11, 20)
    assert field_date(load_config(b"cube: {date: '2026-11-20'}")) == datetime.date(2026, 11, 20)


def test_the_file_overrides_key_by_key(tmp_path: Path) -> None:
    other = tmp_path / "more.yaml"
    other.write_text(
        "noise: {gyro_density: 1e-3}\ncube: {tags: {16: {size: 0.2}, 17: {size: 0.1}}}\npriors: {delta_px: null}"
    )
    config = load_config(FULL, other)
    assert (config.noise.gyro_density, config.noise.los_error) == (1e-3, 2e-5)
    assert (config.section(CubeConfig).tags[16].size, config.section(CubeConfig).tags[16].position) == (
        0.2,
        (0.0, 0.0, 0.08),
    )
    assert config.section(CubeConfig).tags[17].size == 0.1
    assert config.priors["delta_px"] is None
    assert config.require == {"delta_px": 1.7e-4}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nois: {}", "unknown key nois; the nearest known key is noise"),
        ("noise: {gyro_noise: 1}", r"unknown key noise\.gyro_noise; the nearest known key is gyro_density"),
        ("noise: {gyro_densty: 1}", r"unknown key noise\.gyro_densty; the nearest known key is gyro_density"),
        ("cube: {tags: {16: {size: 1, rotaton: []}}}", r"unknown key cube\.tags\.16\.rotaton; .* is rotation"),
        ("cube: {tags: {16: {sise: 1}}}", r"unknown key cube\.tags\.16\.sise; the nearest known key is size"),
        ("head: {board: {tag: {}}}", r"unknown key head\.board\.tag; the nearest known key is tags"),
        ("cube: {raw: {acel: {scale: 1}}}", r"unknown key cube\.raw\.acel; the nearest known key is accel"),
        ("topics: {imuu: /x}", r"unknown key topics\.imuu; the nearest known key is imu"),
        ("noise: {gyro_density: -1}", r"noise\.gyro_density: must be greater than 0, not -1"),
        ("noise: {gyro_density: abc}", r"noise\.gyro_density: must be a valid number, not 'abc'"),
        ("noise: {gyro_density: true}", r"noise\.gyro_density: must be a valid number, not True"),
        ("noise: {gyro_density: .inf}", r"noise\.gyro_density: must be a finite number"),
        ("noise: 3", "noise: must be"),
        ("sensors: perfect", "sensors: must be data sheets by sensor, or ideal, not 'perfect'$"),
        ("priors: {x: -0.1}", r"priors\.x: must be greater than or equal to 0, not -0.1"),
        ("require: {x: 0}", r"require\.x: must be greater than 0, not 0"),
        ("method: loss", "method: must be 'los', 'indexer', 'head', 'cube' or 'tumble', not 'loss'"),
        ("latitude_deg: 91", "latitude_deg: must be less than or equal to 90"),
        ("cube: {tags: {16: {rotation: [1, 0, 0, 0]}}}", r"cube\.tags\.16\.size: is missing"),
        ("cube: {tags: {a: {size: 1}}}", r"cube\.tags\.a: must be a valid integer"),
        ("cube: {camera_rotation: [1, 1, 0, 0]}", r"cube\.camera_rotation: a unit quaternion .* norm 1\.414"),
        ("date: [1]", "date: must be a valid date"),
        ("date: 01.08.2020", "date: a date year-month-day is needed, as 2026-11-20, not '01.08.2020'"),
        ("cube: {date: tomorrow}", r"cube\.date: .*tomorrow"),
        ("method: los\nnoise: {a: [1,\npriors: 3", "unreadable YAML, line 3"),
        ("a: 1\na: 2", "unreadable YAML, line 2: .*duplicate key"),
        ("\t- x", "unreadable YAML, line 1"),
        ("date: 2026-13-45", "unreadable YAML.*month"),
        ("- 1", "keys and values are needed, not a list"),
        ("a: !!python/object:os.x {}", "unreadable YAML, line 1"),
    ],
)
def test_what_is_wrong_is_one_line_with_key_and_source(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^attachment alidade.yaml: .*{message}") as caught:
        load_config(text.encode())
    assert "\n" not in str(caught.value)
    other = tmp_path / "more.yaml"
    other.write_text(text)
    with pytest.raises(InputError, match=r"more\.yaml: ") as caught:
        load_config(b"latitude_deg: 40.0", other)
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not UTF-8"):
        load_config(b"\xff\xfe")
    with pytest.raises(InputError, match=r"none\.yaml: cannot be opened"):
        load_config(None, tmp_path / "none.yaml")


def test_what_is_of_another_method_is_named() -> None:
    head = method("head")
    config = load_config(b"cube: {raw: {accel: {scale: 0.1}}}\nhead: {}\nrequire: {gyro_bias_x: 0.1}")
    assert list(of_other_methods(head, config)) == ["`cube:` in the config is of another method: head does not use it"]
    with pytest.raises(InputError, match=r"require.accel_b1: a parameter of cube and tumble, not of head"):
        list(of_other_methods(head, load_config(b"require: {accel_b1: 0.1}")))
    with pytest.raises(InputError, match=r"the config is for method cube: require.accel_b1: a"):
        list(of_other_methods(head, load_config(b"method: cube\nrequire: {accel_b1: 0.1}")))


def test_a_result_given_as_the_config_is_named(tmp_path: Path) -> None:
    (tmp_path / "calibration.yaml").write_text("schema: alidade.calibration/1\nmethod: head\n")
    with pytest.raises(
        InputError, match=r"calibration\.yaml: that is a result, not a config; `calibrate --prior` takes it"
    ):
        load_config(None, tmp_path / "calibration.yaml")


def test_a_wrong_key_in_the_recording_is_not_blamed_on_the_file(tmp_path: Path) -> None:
    other = tmp_path / "more.yaml"
    other.write_text("noise: {gyro_density: 1}")
    with pytest.raises(InputError, match=r"^attachment alidade\.yaml: unknown key noise\.x"):
        load_config(b"noise: {x: 1}", other)


def test_names_of_parameters_are_checked_against_those_of_the_method() -> None:
    check_names(["a", "b"], {"a", "b", "c"}, "priors")
    with pytest.raises(InputError, match=r"unknown key priors\.delta_pxx; the nearest known key is delta_px"):
        check_names(["delta_pxx"], ["delta_gx", "delta_px"], "priors")


def test_config_wins_over_message_over_default() -> None:
    assert first_given(1.0, 2.0, 3.0) == 1.0
    assert first_given(None, 2.0, 3.0) == 2.0
    assert first_given(0.0, 2.0, 3.0) == 0.0
    assert first_given(None, None, 3.0) == 3.0
    with pytest.raises(ValueError, match="no value"):
        first_given(None, None)


def test_configs_of_the_independent_recordings(shared_data: Path) -> None:
    from alidade.pipelines.recording.recording import open_recording

    methods = {}
    for path in (shared_data / "contract").glob("*.mcap"):
        config = load_config(open_recording(path).attachment("alidade.yaml"))
        methods[path.stem] = config.method
        assert (field_date(config) is not None) == (config.method == "cube")
    assert methods["head_mounts"] == "head"
    assert len(methods) == 6


FIGURES = {
    "noise_known: 1e300": "noise_known: must be less than or equal to 10",
    "noise: {gyro_density: 1.0e-300}": "noise.gyro_density: must be 0 or at least 1e-15",
    "noise: {gyro_density: 1.0e300}": "noise.gyro_density: must be less than or equal to 1000",
    "priors: {delta_px: 1.0e-300}": "priors.delta_px: must be 0 or at least 1e-15",
    "priors: {delta_px: {mean: 1.0e10, sigma: 1.0e-3}}": "priors.delta_px.mean: must be between -1e",
    "require: {delta_px: 1.0e-300}": "require.delta_px: must be 0 or at least 1e-15",
    "share: {delta_px: 1.0e300}": "share: must be between -1e",
    "altitude_m: 1.0e300": "altitude_m: must be between -1e",
    "cube: {tags: {1: {size: 1.0e300}}}": "cube.tags.1.size: must be less than or equal to 100",
    "cube: {tags: {1: {size: 0.1, position: [1.0e300, 0, 0]}}}": "cube.tags.1.position: must be between -1e",
    "cube: {camera: {focal: [1.0e300, 1.0], centre: [0.0, 0.0], distortion: []}}": "cube.camera.focal: must be between",
}


@pytest.mark.parametrize("text", FIGURES)
def test_figures_beyond_all_range_are_refused_wherever_they_stand(text: str) -> None:
    """Before they reach native code, which may end the process."""
    with pytest.raises(InputError) as refused:
        load_config(text.encode())
    assert FIGURES[text] in str(refused.value)
