"""The head method: helmet attitude, gyro bias and mounts from a helmet MIMU, the platform IMU and vision."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from alidade.pipelines.methods import Method, Scenario

if TYPE_CHECKING:
    from alidade.pipelines.diagnostics.checklist import ChecklistItem
    from alidade.pipelines.diagnostics.cross_validation import Validation
    from alidade.pipelines.diagnostics.fault_models import FaultModel
    from alidade.pipelines.diagnostics.use import Truth, Use
    from alidade.pipelines.display.figure import Plot
    from alidade.pipelines.estimation.problem import Estimate, Findings, Problem
    from alidade.pipelines.methods.formula import Formula
    from alidade.pipelines.methods.head.recording import HeadData
    from alidade.pipelines.methods.head.simulation import HeadScenario
    from alidade.pipelines.methods.head.topics import HeadConfig
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config
    from alidade.pipelines.simulation.simulated import Simulated


class Head(Method):
    """The door of the head method."""

    name = "head"
    title = "Helmet"
    sheets: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "gyro": ("scale", "skew", "g_sensitivity", "temperature"),
        "platform_gyro": ("bias", "scale", "skew"),
        "camera": ("scale", "filter"),
        "clock": ("skew",),
    }
    of_recording = ("gyro_bias_*", "time_offset", "clock_skew", "platform_bias_*")
    cards: ClassVar[Mapping[str, tuple[tuple[str, str, tuple[str, ...]], ...]]] = {
        "Mounts": (
            ("Markers to helmet IMU", "deg", ("helmet_mount_x", "helmet_mount_y", "helmet_mount_z")),
            ("Platform to camera", "deg", ("camera_mount_x", "camera_mount_y", "camera_mount_z")),
        ),
        "Helmet gyro": (
            ("Bias", "deg/s", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
            ("Scale error", "%", ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")),
        ),
        "Timing and camera": (
            ("Delay of the pictures", "ms", ("time_offset",)),
            ("Clock skew", "ppm", ("clock_skew",)),
            ("Scale of vision's angles", "%", ("vision_scale",)),
        ),
    }
    sketch = Path(__file__).with_name("frames.svg")
    meanings: ClassVar[Mapping[str, str]] = {
        r"helmet_mount_([xyz])": "Rotation markers to helmet IMU (vRh), {0} of the rotation vector.",
        r"camera_mount_([xyz])": "Rotation platform to camera (cRb), {0} of the rotation vector.",
        r"vision_scale": "Scale error of the angles measured by vision.",
        r"vision_filter": "Low-pass of vision: half the second moment of its impulse response, less the gyro's.",
    }
    rotations: ClassVar[Mapping[str, str]] = {"helmet_mount": "vRh", "camera_mount": "cRb"}

    @property
    def topics(self) -> tuple[Topic, ...]:
        from alidade.pipelines.methods.head.topics import TOPICS

        return TOPICS

    @property
    def needs(self) -> tuple[Need, ...]:
        from alidade.pipelines.methods.head.topics import NEEDS

        return NEEDS

    @property
    def section(self) -> type[HeadConfig]:
        from alidade.pipelines.methods.head.topics import HeadConfig

        return HeadConfig

    @property
    def data(self) -> type[HeadData]:
        from alidade.pipelines.methods.head.recording import HeadData

        return HeadData

    def read(self, recording: Recording, config: Config) -> HeadData:
        from alidade.pipelines.methods.head.recording import read_head

        return read_head(recording, config)

    def proposed(self, recording: Recording, config: Config) -> Sequence[str]:
        from alidade.pipelines.methods.head.vision_kind import proposed

        return proposed(recording, config)

    def problem(self, data: HeadData, config: Config) -> Problem:
        from alidade.pipelines.methods.head.graph import problem

        return problem(data, config)

    def published(self, data: HeadData, config: Config, problem: Problem) -> Estimate:
        from alidade.pipelines.methods.head.published import published_estimate

        return published_estimate(data, config, problem)

    @property
    def scenario(self) -> type[HeadScenario]:
        from alidade.pipelines.methods.head.simulation import HeadScenario

        return HeadScenario

    def simulate(self, scenario: HeadScenario, seed: int, images: bool = False) -> Simulated:
        from alidade.pipelines.methods.head.simulation import simulated

        return simulated(scenario, seed, images)

    def nominal(self, images: bool = False) -> str:
        return "head_pictures" if images else "head_nominal"

    def write(self, path: Path, simulated: Simulated) -> None:
        from alidade.pipelines.methods.head.recording import write_head

        write_head(path, simulated.data, simulated.truth, simulated.config, simulated.pictures)

    def candidates(self, scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
        from alidade.pipelines.methods.head.candidates import candidates

        return candidates(scenario)

    def hypotheses(self) -> FaultModel:
        from alidade.pipelines.methods.head.hypotheses import HYPOTHESES

        return HYPOTHESES

    def validate(self, data: HeadData, config: Config, values: Mapping[str, float]) -> Sequence[Validation]:
        from alidade.pipelines.methods.head.validation import validate

        return validate(data, config, values)

    def checklist(self, data: HeadData, config: Config) -> Sequence[ChecklistItem]:
        from alidade.pipelines.methods.head.guidance import checklist

        return checklist(data, config)

    def formulas(self, parameters: Collection[str], config: Config) -> Sequence[Formula]:  # noqa: ARG002
        from alidade.pipelines.methods.head.formulas import formulas

        return formulas(parameters)

    def findings(self, data: HeadData, config: Config, estimate: Estimate) -> Findings:
        from alidade.pipelines.methods.head.findings import findings

        return findings(data, config, estimate)

    def figures(self, data: HeadData, calibration: Calibration) -> Sequence[Plot]:
        from alidade.pipelines.methods.head.figures import head_plots

        return head_plots(data, calibration)

    def uses(self, true: Truth, config: Config, noise: Mapping[str, float]) -> Sequence[Use]:  # noqa: ARG002
        from alidade.pipelines.methods.head.uses import uses

        return uses(noise)


METHOD = Head()
