"""Camera calibrations in files: four programs' forms give one CameraInfo, beside a recording's own topics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.recording import open_recording

K = np.array([[500.5, 0.0, 321.25], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]])
D = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01])
ROS = """\
image_width: 640
image_height: 480
camera_name: head
camera_matrix: {rows: 3, cols: 3, data: [500.5, 0, 321.25, 0, 510, 239.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.05, 0.001, -0.002, 0.01]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [480, 0, 320, 0, 0, 490, 240, 0, 0, 0, 1, 0]}
"""
KALIBR = """\
cam0:
  T_cam_imu: [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.05, 1.0e-3, -2.0e-3]
  distortion_model: radtan
  intrinsics: [500.5, 510.0, 321.25, 239.5]
  resolution: [640, 480]
  rostopic: /left/image
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [400.0, 400.0, 320.0, 240.0]
  resolution: [640, 480]
"""
MRCAL = """\
# generated on 2026-11-20
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 500.5, 510.0, 321.25, 239.5, -0.2, 0.05, 0.001, -0.002, 0.01, 0, 0, 0,],
    'extrinsics': [ 0., 0., 0., 0., 0., 0.,],
    'imagersize': [ 640, 480,],
    'icam_intrinsics': 0,
}
"""


def opencv(path: Path) -> None:
    import cv2

    store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    store.write("image_width", 640)
    store.write("image_height", 480)
    store.write("camera_matrix", K)
    store.write("distortion_coefficients", D[None])
    store.release()


@pytest.mark.parametrize(
    ("name", "text", "topic", "model", "d"),
    [
        ("ros.yaml", ROS, "/camera/camera_info", "plumb_bob", D),
        ("opencv.yml", "", "/camera/camera_info", "plumb_bob", D),
        ("camchain.yaml", KALIBR, "/cam0/camera_info", "plumb_bob", [*D[:4], 0.0]),
        ("m.cameramodel", MRCAL, "/camera/camera_info", "rational_polynomial", [*D, 0.0, 0.0, 0.0]),
    ],
)
def test_a_camera_file_is_a_camera_info(
    name: str, text: str, topic: str, model: str, d: list[float], tmp_path: Path
) -> None:
    opencv(tmp_path / name) if not text else (tmp_path / name).write_text(text)
    found = open_recording(tmp_path / name).camera_info(topic)
    assert (found.width, found.height, found.distortion_model) == (640, 480, model)
    np.testing.assert_array_equal(found.k, K)
    np.testing.assert_array_equal(found.d, d)
    assert found.p[0, 0] == (480.0 if name == "ros.yaml" else K[0, 0])


def test_beside_a_recording_it_is_one_of_its_topics_and_does_not_begin_it(tmp_path: Path) -> None:
    (tmp_path / "poses.tum").write_text("".join(f"{1_700_000_000 + 0.1 * i:.1f} 0 0 0 0 0 0 1\n" for i in range(50)))
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    recording = open_recording(tmp_path / "*")
    assert {"/trajectory", "/cam0/camera_info", "/cam1/camera_info"} <= recording.topics.keys()
    assert recording.camera_info("/cam1/camera_info").distortion_model == "equidistant"
    assert recording.epoch_ns == 1_700_000_000_000_000_000
    assert recording.duration_s == pytest.approx(4.9)
    assert any("camchain.yaml" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.cameramodel", MRCAL.replace("OPENCV8", "SPLINED_STEREOGRAPHIC_order=3"), "mrcal-convert-lensmodel"),
        ("a.yaml", KALIBR.replace("pinhole", "omni"), "camera model omni is not pinhole"),
        ("a.yaml", ROS.replace("image_width", "width"), "KeyError: 'image_width'"),
        ("a.yaml", ROS.replace("rows: 3, cols: 3, data: [500.5,", "rows: 3, cols: 3, data: ["), "ValueError"),
        ("a.yml", "a: 1", "no camera calibration of ROS, OpenCV, Kalibr or mrcal"),
        ("a.yml", "[1, 2]", "no camera calibration"),
        ("c.yaml", "method: cube", "that is a config, no recording; `--config` takes it"),
        ("c.yaml", "schema: alidade.calibration/1", "that is a result, no recording"),
        ("result.json", '{\n "schema": "alidade.result/1",\n "method": "los"\n}', "that is a result, no recording"),
        ("a.yaml", "a: [", "unreadable YAML"),
    ],
)
def test_what_is_no_camera_is_one_line(name: str, text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        open_recording(tmp_path / name)
