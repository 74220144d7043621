"""los recordings: written and read back, and what is wrong with them named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.methods import method, simulate
from alidade.pipelines.methods.los.recording import LosData, read_los
from alidade.pipelines.methods.los.simulation import LosCamera, LosScenario, los_config, simulate_los, simulate_pictures
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.recording.topics import TopicSource
from alidade.pipelines.settings import Config
from alidade.pipelines.simulation.scenario import load_scenario

DATA, TRUTH = simulate_los(LosScenario(duration_s=12.0, measures_roll=True), 1)


def _back(path: Path, data: LosData, config: Config | None = None) -> LosData:
    method("los").write_data(path, data)
    return read_los(open_recording(path), config or Config())


def test_written_and_read_back(tmp_path: Path) -> None:
    scenario = LosScenario(duration_s=12.0, measures_roll=True)
    path = tmp_path / "s.mcap"
    method("los").write_data(path, DATA, TRUTH, los_config(scenario))
    recording = open_recording(path)
    config = load_config(recording.attachment("alidade.yaml"))
    back = read_los(recording, config)
    assert back.epoch_ns == DATA.epoch_ns
    for name in ("gyro_t", "gyro", "gimbal_t", "gimbal", "image_t", "error"):
        np.testing.assert_array_equal(getattr(back, name), getattr(DATA, name), err_msg=name)
    assert back.gyro_density == pytest.approx(3e-5)
    assert config.noise.los_error == 2e-5


def test_turning_azimuth_is_made_continuous(tmp_path: Path) -> None:
    data, _ = simulate_los(LosScenario(duration_s=12.0, azimuth_deg=179.0), 1)
    folded = np.stack([(data.gimbal[:, 0] + np.pi) % (2 * np.pi) - np.pi, data.gimbal[:, 1]], axis=1)
    assert np.abs(np.diff(folded[:, 0])).max() > 6.0
    back = _back(tmp_path / "s.mcap", replace(data, gimbal=folded))
    np.testing.assert_allclose(np.diff(back.gimbal, axis=0), np.diff(data.gimbal, axis=0), atol=1e-12)


def test_lost_target_is_left_out_and_counted_nowhere_as_zero(tmp_path: Path) -> None:
    error = DATA.error.copy()
    error[100:150, :2] = np.nan
    back = _back(tmp_path / "s.mcap", replace(DATA, error=error))
    assert len(back.image_t) == len(DATA.image_t) - 50
    assert back.dropped == {"/los/error: not a finite number": 50}


def _degrees(data: LosData) -> LosData:
    return replace(data, gimbal=np.rad2deg(data.gimbal))


def _steep(data: LosData) -> LosData:
    return replace(data, gimbal=data.gimbal + np.array([0.0, np.deg2rad(82.0) - data.gimbal[:, 1].max()]))


def _frozen(data: LosData) -> LosData:
    gimbal = data.gimbal.copy()
    gimbal[data.gimbal_t > 6.0, 1] = gimbal[data.gimbal_t > 6.0][0, 1]
    return replace(data, gimbal=gimbal)


def _other_sign(data: LosData) -> LosData:
    return replace(data, gyro=data.gyro * np.array([1.0, -1.0, 1.0]))


def _pixels(data: LosData) -> LosData:
    return replace(data, error=data.error * 2000.0 + [5.0, 0.0, 0.0])


def _never_found(data: LosData) -> LosData:
    return replace(data, error=np.full_like(data.error, np.nan))


def _no_errors(data: LosData) -> LosData:
    return replace(data, error=np.zeros_like(data.error))


def _nearly_one_error(data: LosData) -> LosData:
    error = data.error.copy()
    error[20:] = error[20]
    return replace(data, error=error)


def _one_axis(data: LosData) -> LosData:
    return replace(data, error=data.error * [1.0, 0.0, 1.0])


def _against_earth(data: LosData, angle: int, axis: int) -> LosData:
    """A gimbal angle with the carrier's own turn about an axis in it."""
    turned = np.interp(data.gimbal_t, data.gyro_t, np.cumsum(data.gyro[:, axis]) * np.gradient(data.gyro_t))
    return replace(data, gimbal=data.gimbal + turned[:, None] * np.eye(2)[angle])


def _noisy(data: LosData, angle: int) -> LosData:
    """A gimbal angle that shows nothing but noise."""
    gimbal = data.gimbal.copy()
    gimbal[:, angle] = gimbal[0, angle] + 1e-5 * np.random.default_rng(0).standard_normal(len(gimbal))
    return replace(data, gimbal=gimbal)


def _held(data: LosData, share: float) -> LosData:
    """For such a share of every hundred messages the tracker gives the error of the first."""
    error = data.error.copy()
    for start in range(0, len(error), 100):
        error[start : start + round(100 * share)] = error[start]
    return replace(data, error=error)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_degrees, r"/gimbal/joint_states: elevation of .* is the encoder in degrees\?"),
        (_steep, r"elevation of 82.00 deg .* beyond 80 deg .* cannot stabilise"),
        (_frozen, r"elevation stands still from .* the encoder is frozen"),
        (_other_sign, r"/imu: gimbal and pictures show that the gyro's y has the opposite sign"),
        (lambda data: replace(data, gyro=np.rad2deg(data.gyro)), r"/imu: gimbal and pictures show that .* in deg/s"),
        (lambda data: _against_earth(data, 0, 2), r"states: gimbal and pictures show that its azimuth does not follow"),
        (lambda data: _noisy(data, 1), r"states: gimbal and pictures show that its elevation does not follow"),
        (_pixels, r"/los/error: LOS errors of .* are they in pixels\?"),
        (_never_found, r"/los/error: the target was never found, none of the 600 messages"),
        (
            _no_errors,
            r"/los/error: x and z read the same value in all 600 messages: the tracker did not measure; check",
        ),
        (_nearly_one_error, r"/los/error: x and z read the same value in 97 % of the 600 messages: the tracker"),
        (_one_axis, r"/los/error: z reads the same value in all 600 messages: the tracker did not measure; check"),
        (lambda data: _held(data, 0.8), r"/los/error: \d\d % of the samples cannot be used: stuck .* on axis x, the"),
    ],
)
def test_bad_input_is_named(tmp_path: Path, spoil: Callable[[LosData], LosData], said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        _back(tmp_path / "s.mcap", spoil(DATA))
    assert "\n" not in str(caught.value)


def test_what_a_tracker_holds_is_left_out_and_counted(tmp_path: Path) -> None:
    back = _back(tmp_path / "s.mcap", _held(DATA, 0.15))
    ((what, number),) = back.dropped.items()
    assert what == "/los/error: stuck at one value"
    # Of six stretches of fourteen one may end where the error happens to be what it was.
    assert number in (5 * 14, 6 * 14)
    assert len(back.image_t) == len(back.error) == len(DATA.image_t) - number


def test_whole_pixels_are_no_frozen_tracker(tmp_path: Path) -> None:
    pixel = 2.0 * np.nanstd(DATA.error[:, :2])
    error = DATA.error.copy()
    error[:, :2] = pixel * np.round(error[:, :2] / pixel)
    assert (np.diff(error[:, :2], axis=0) == 0.0).mean() > 0.8
    back = _back(tmp_path / "s.mcap", replace(DATA, error=error))
    assert not back.dropped
    assert len(back.image_t) == len(DATA.image_t)


def test_gimbal_locked_on_purpose_is_no_frozen_encoder(tmp_path: Path) -> None:
    """Standing encoders are right when the picture moves with the carrier."""
    turned = np.cumsum(DATA.gyro, axis=0) * np.median(np.diff(DATA.gyro_t))
    error = DATA.error.copy()
    error[:, 0] = np.interp(DATA.image_t, DATA.gyro_t, turned[:, 0])
    error[:, 1] = np.interp(DATA.image_t, DATA.gyro_t, turned[:, 2])
    locked = replace(DATA, gimbal=np.zeros_like(DATA.gimbal), error=error)
    assert (_back(tmp_path / "s.mcap", locked).gimbal == 0.0).all()


def test_nothing_recorded_at_the_same_time(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no time is covered by all of"):
        _back(tmp_path / "s.mcap", replace(DATA, image_t=DATA.image_t + 100.0))


def _small_pictures() -> LosScenario:
    base = load_scenario(LosScenario, "los_images")
    camera = LosCamera(width=320, height=240, focal_px=1000.0)
    return base.model_copy(update={"duration_s": 2.0, "camera": camera})


def test_pictures_take_the_place_of_los_errors(tmp_path: Path) -> None:
    scenario = _small_pictures()
    data, _ = simulate_los(
        scenario.model_copy(update={"noise": scenario.noise.model_copy(update={"los_error": 0.0})}), 1
    )
    path = tmp_path / "s.mcap"
    method("los").write_data(path, data, pictures=simulate_pictures(scenario, 1))
    back = read_los(open_recording(path), Config())
    assert back.error_cov is not None
    # To a tenth of a pixel, up to where the first picture puts the target.
    miss = back.error[:, :2] - data.error[:, :2]
    assert (miss - miss.mean(axis=0)).std() < 0.1 / 1000.0


def test_pictures_without_camera_info(tmp_path: Path) -> None:
    info, images = simulate_pictures(_small_pictures(), 1)
    path = tmp_path / "s.mcap"
    method("los").write_data(path, DATA, pictures=(info, images))
    with pytest.raises(InputError, match="no topic /camera/none"):
        read_los(open_recording(path), Config(topics={"camera_info": TopicSource(topic="/camera/none")}))
    with pytest.raises(InputError, match="no topic /los/error"):
        read_los(open_recording(path), Config(topics={"los_error": TopicSource(topic="/los/error")}))


def test_simulate_writes_a_whole_session(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    simulate("los", None, 1, path, images=False)
    recording = open_recording(path)
    data = read_los(recording, load_config(recording.attachment("alidade.yaml")))
    assert len(data.image_t) == 3000
    with pytest.raises(InputError, match="pictures are simulated of a single target"):
        simulate("los", "los_outliers", 1, tmp_path / "p.mcap", images=True)
    assert not (tmp_path / "p.mcap").exists()
