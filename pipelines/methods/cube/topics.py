"""What the cube method reads, and its section of the config."""

from __future__ import annotations

import datetime
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from alidade.pipelines.recording import messages
from alidade.pipelines.recording.topics import CAMERA_INFO, IMAGE, IMU, MAG, TEMPERATURE, Need, Setting, Topic
from alidade.pipelines.settings import Board, Config, Date, MethodSection, Quaternion, Section, Sigma

REFERENCE_FIX = Topic("reference_fix", "/reference/fix", (messages.NAV_SAT_FIX,))
REFERENCE_IMU = Topic("reference_imu", "/reference/imu", (messages.IMU,))
# Of a covariance in decimal digits, the negative share that is rounding.
_ROUNDING = 1e-5

TAG_DETECTIONS = Topic("tag_detections", "/tag_detections", (messages.TAG_DETECTIONS,))


class RawConversion(Section):
    """Nominal conversion of counts: (raw - offset) * scale."""

    scale: Sigma  # SI per count
    offset: float = 0.0  # counts


class Raw(Section):
    """Conversions of the sensors that record counts."""

    accel: RawConversion | None = None
    gyro: RawConversion | None = None
    mag: RawConversion | None = None


class LayoutCovariance(Section):
    """What cube-layout knows of its tags: covariance of rotation (rad) and position (m) of each, six numbers a tag."""

    tags: list[int]  # ids in order
    camera: bool = False  # whether its focal length (a share) and centre (px) follow after the tags
    rows: list[str]  # the lower triangle, each row its numbers with blanks between them

    @model_validator(mode="after")
    def _whole(self) -> Self:
        needed = 6 * len(self.tags) + 3 * self.camera
        if len(self.rows) != needed:
            what = f"{len(self.tags)} tags{' and a camera' if self.camera else ''}"
            raise ValueError(f"{what} need {needed} rows, there are {len(self.rows)}")
        if np.linalg.eigvalsh(self.matrix).min(initial=0.0) < -_ROUNDING * np.diag(self.matrix).max(initial=0.0):
            raise ValueError("rows are no covariance: a combination of the numbers has a negative variance")
        return self

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(6 n, 6 n), of a layout with camera (6 n + 3, 6 n + 3)."""
        out = np.zeros((len(self.rows), len(self.rows)))
        for i, row in enumerate(self.rows):
            try:
                numbers = [float(number) for number in row.split()]
            except ValueError as error:
                raise ValueError(f"row {i + 1} holds something that is no number: {row[:40]!r}") from error
            if len(numbers) != i + 1:
                raise ValueError(f"row {i + 1} of a lower triangle has {i + 1} numbers, not {len(numbers)}")
            out[i, : i + 1] = out[: i + 1, i] = numbers
        return out


class RefinedCamera(Section):
    """What cube-layout found of the camera, which goes before the numbers of its CameraInfo."""

    focal: Annotated[tuple[Sigma, Sigma], Field(strict=False)]  # px
    centre: Annotated[tuple[float, float], Field(strict=False)]  # px
    distortion: list[float]  # coefficients of CameraInfo's model


class CubeConfig(Board, MethodSection):
    """The cube: its tags and how well they are known, the camera on the reference, counts, date."""

    key: ClassVar[str] = "cube"

    camera_rotation: Quaternion | None = None  # BRC, camera on the reference: w, x, y, z
    raw: Raw = Raw()  # of sensors that record counts
    date: Date | None = None  # of the field model, as at the top level
    covariance: LayoutCovariance | None = None  # as cube-layout writes it
    camera: RefinedCamera | None = None  # as cube-layout --refine-camera writes it


def field_date(config: Config) -> datetime.date | None:
    """Date for the field model, at the top or under `cube`."""
    return config.date or config.section(CubeConfig).date


TOPICS = (IMU, MAG, REFERENCE_FIX, REFERENCE_IMU, TAG_DETECTIONS, IMAGE, CAMERA_INFO, TEMPERATURE)
_TAGS = Setting("cube.tags in the config", lambda config: bool(config.section(CubeConfig).tags))
_METHOD = Setting("`method: cube` in the config", lambda config: config.method == "cube")
NEEDS: tuple[Need, ...] = (
    ((IMU,),),
    # Pictures alone could be of anything. Without camera the turns between poses and gravity serve; the config has to
    # say that this is meant.
    ((TAG_DETECTIONS, CAMERA_INFO), (IMAGE, CAMERA_INFO, REFERENCE_IMU), (IMAGE, CAMERA_INFO, _TAGS), (_METHOD,)),
)
