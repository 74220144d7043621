"""The head method from pictures alone: a rendered tag board on the helmet, to calibrated parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alidade.factors import so3
from alidade.pipelines.applications.session import Session, open_session
from alidade.pipelines.config import load_config
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import DEAD_BAND
from alidade.pipelines.methods import method
from alidade.pipelines.methods.head.parameters import PARAMETERS, VISION_MAP
from alidade.pipelines.methods.head.recording import HeadData, read_head
from alidade.pipelines.methods.head.simulation import HeadScenario, head_config, simulate_head, simulate_pictures
from alidade.pipelines.methods.temperature import GYRO_SLOPE
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.simulation.scenario import load_scenario


def scenario(**changes: object) -> HeadScenario:
    return HeadScenario.model_validate(load_scenario(HeadScenario, "head_pictures").model_dump() | changes)


def written(path: Path, settings: HeadScenario, seed: int) -> Path:
    data, truth = simulate_head(settings, seed)
    method("head").write_data(path, data, truth, head_config(settings, images=True), simulate_pictures(settings, seed))
    return path


def read(path: Path) -> HeadData:
    recording = open_recording(path)
    return read_head(recording, load_config(recording.attachment("alidade.yaml")))


def sigmas_off(session: Session) -> tuple[np.ndarray, str]:
    """Errors of all parameters in sigmas, and the verdict."""
    calibration = session.calibrate(report=False)
    assert calibration.truth is not None
    truth = np.array([calibration.truth[name] for name in calibration.estimate.names], dtype=float)
    off = (calibration.estimate.values - truth) / calibration.estimate.sigmas
    return off, calibration.status


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    settings = scenario(duration_s=8, vision_rate_hz=4)
    return open_session(written(tmp_path_factory.mktemp("pictures") / "s.mcap", settings, 1))


def test_every_parameter_from_pictures_alone(session: Session) -> None:
    recording = session.recording
    assert recording is not None
    assert "/vision/attitude" not in recording.topics
    assert {"/camera/image/compressed", "/camera/camera_info"} <= set(recording.topics)
    off, status = sigmas_off(session)
    assert len(off) == sum(len(spec.names) for spec in PARAMETERS if spec not in (GYRO_SLOPE, DEAD_BAND, VISION_MAP))
    # The largest of some 40 numbers is as likely to be beyond as one is to be beyond 2.2.
    assert np.abs(off).max() < 3.5
    assert status == "calibrated"


def test_attitudes_seen_in_pictures_are_the_boards(session: Session) -> None:
    """Mounts and time offset included; their errors fit the covariance that came with them."""
    settings = scenario(duration_s=8, vision_rate_hz=4)
    exact = settings.model_copy(update={"noise": settings.noise.model_copy(update={"vision_attitude": 0.0})})
    expected, _ = simulate_head(exact, 1)
    data = session.data
    assert len(data.vision_t) > 0.95 * len(expected.vision_t)
    at = np.searchsorted(expected.vision_t, data.vision_t)
    np.testing.assert_array_equal(data.vision_t, expected.vision_t[at])
    error = so3.log(so3.multiply(so3.inverse(expected.vision_wxyz[at]), data.vision_wxyz))
    assert np.rad2deg(np.sqrt((error**2).mean())) < 0.05
    assert data.vision_cov is not None
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(data.vision_cov), error)
    assert 1.0 < nees.mean() < 5.0


def test_outages_have_no_pictures_and_png_is_read(tmp_path: Path) -> None:
    settings = scenario(
        duration_s=3,
        vision_rate_hz=4,
        vision_outages_s=[(1.0, 2.0)],
        pictures={"format": "png"},
    )
    path = written(tmp_path / "s.mcap", settings, 2)
    t = read(path).vision_t
    assert len(t) == 8
    assert not ((t >= 1.0) & (t < 2.0)).any()
    _, first = next(open_recording(path).images("/camera/image/compressed"))
    assert first.startswith(b"\x89PNG")


def test_same_seed_same_pictures() -> None:
    settings = scenario(duration_s=1, vision_rate_hz=1)
    (_, a), (_, b), (_, c) = (simulate_pictures(settings, seed) for seed in (1, 1, 2))
    assert list(a.data) == list(b.data)
    first = next(iter(simulate_pictures(settings, 1)[1].data))
    assert first != next(iter(c.data))


def test_outliers_cannot_be_drawn() -> None:
    with pytest.raises(InputError, match="outlier_fraction"):
        simulate_pictures(scenario(outlier_fraction=0.1), 1)


@pytest.mark.slow
def test_errors_over_seeds_are_as_large_as_their_sigmas(tmp_path: Path) -> None:
    """Ten parameters, eight seeds; the corners' stated noise is a little too large rather than too small."""
    sessions = [open_session(written(tmp_path / f"{seed}.mcap", scenario(), seed)) for seed in range(8)]
    off = np.concatenate([sigmas_off(each)[0] for each in sessions])
    assert 0.5 < np.sqrt((off**2).mean()) < 1.2
    assert np.abs(off).max() < 4.0
