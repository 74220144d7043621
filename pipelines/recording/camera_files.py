"""Camera calibrations in files beside a recording: camera_info of ROS, FileStorage of OpenCV, Kalibr's camchain, mrcal.

All are YAML, mrcal's too. The camera's topic is `/camera/camera_info`, in a camchain `/cam0/camera_info` and so on.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.errors import InputError
from alidade.pipelines.files import MAX_YAML_BYTES, load_yaml, read_bytes
from alidade.pipelines.recording import series
from alidade.pipelines.recording.array_container import ArrayContainer

SUFFIXES = (".yaml", ".yml", ".cameramodel")
# Why a result is refused in place of a recording.
IS_RESULT = "that is a result, no recording; `--prior` and `--calibration` take it"
# ROS's name of Kalibr's and EuRoC's models.
_ROS = {"radtan": "plumb_bob", "radial-tangential": "plumb_bob", "none": "plumb_bob"}
# Their distortion coefficients are OpenCV's, after fx fy cx cy.
_MRCAL = ("LENSMODEL_PINHOLE", "LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8")


class CameraFile(ArrayContainer):
    """Container of camera calibrations by topic, stamped `t_ns`, Unix ns: the start of the recording beside them."""

    def __init__(self, path: Path, cameras: Mapping[str, series.CameraInfo], data: Path, t_ns: int = 0) -> None:
        self.cameras = {topic: replace(each, t_ns=t_ns) for topic, each in cameras.items()}
        super().__init__(path, self.cameras, [f"the camera calibration is that of {path.name}"], data)


def read_cameras(path: Path, data: Path) -> CameraFile:
    """Read the camera calibrations in file `data`, called `path` in messages. Raises InputError where there is none."""
    text = read_bytes(data, MAX_YAML_BYTES).decode(errors="replace")
    content = load_yaml(re.sub(r"^%YAML[ :]1\.\d\s*(---)?|!!opencv-matrix", "", text), str(path))
    try:
        chain = {name: each for name, each in content.items() if re.fullmatch(r"cam\d+", name)}
        cameras = {f"/{name}/camera_info": camera(each, name) for name, each in (chain or {"camera": content}).items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        why = f"no camera calibration of ROS, OpenCV, Kalibr or mrcal ({type(error).__name__}: {error})"
        raise InputError(f"{path}: {_why_own_file(content) or why}") from error
    return CameraFile(path, cameras, data)


def _why_own_file(content: object) -> str:
    """Return why a result or a config of alidade is no camera calibration, as a phrase; empty for other content."""
    keys = set(content) if isinstance(content, dict) else set()
    if isinstance(content, dict) and str(content.get("schema", "")).startswith("alidade."):
        return IS_RESULT
    if keys & {"method", "topics", "columns", "noise", "priors", "require", "sensors"}:
        return "that is a config, no recording; `--config` takes it, beside a recording"
    return ""


def camera(content: Mapping[str, Any], frame_id: str, t_ns: int = 0) -> series.CameraInfo:
    """Return the camera that an entry of a calibration file describes, or a sensor.yaml in EuRoC's form.

    Raises AttributeError, KeyError, TypeError or ValueError where something is missing or of another kind.
    """
    rectified: Any = None
    if "lensmodel" in content:
        if content["lensmodel"] not in _MRCAL:
            raise ValueError(f"{content['lensmodel']} is none of {', '.join(_MRCAL)}: mrcal-convert-lensmodel")
        (*focal, cx, cy), d = content["intrinsics"][:4], content["intrinsics"][4:]
        size, name = content["imagersize"], ""
    elif "intrinsics" in content:
        if content.get("camera_model", "pinhole") != "pinhole":
            raise ValueError(f"the camera model {content['camera_model']} is not pinhole")
        *focal, cx, cy = content["intrinsics"]
        d = content["distortion_coeffs" if "distortion_coeffs" in content else "distortion_coefficients"]
        size, name = content["resolution"], _ROS.get(content["distortion_model"], str(content["distortion_model"]))
    else:
        K = _numbers(content["camera_matrix"]).reshape(3, 3)
        focal, cx, cy = [K[0, 0], K[1, 1]], K[0, 2], K[1, 2]
        d = _numbers(content["distortion_coefficients"]).tolist()
        size, name = (content["image_width"], content["image_height"]), str(content.get("distortion_model", ""))
        rectified = content.get("projection_matrix")
    fx, fy = focal
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=float)
    width, height = map(int, size)
    name = name or ("rational_polynomial" if len(d) > 5 else "plumb_bob")
    d = np.array([*d, 0.0] if len(d) == 4 and name == "plumb_bob" else d, dtype=float)
    p = np.pad(matrix, ((0, 0), (0, 1))) if rectified is None else _numbers(rectified).reshape(3, 4)
    return series.CameraInfo(t_ns, width, height, name, d, matrix, np.eye(3), p, frame_id)


def _numbers(matrix: Any) -> NDArray[np.float64]:
    """Return the numbers of a matrix, flattened, from nested lists or from the mapping that OpenCV and ROS write."""
    return np.array(matrix["data"] if isinstance(matrix, dict) else matrix, dtype=float).ravel()
