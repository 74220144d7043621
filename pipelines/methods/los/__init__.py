"""The los method: gyro and camera mounting angles of an indirectly stabilised line of sight."""

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
    from alidade.pipelines.methods.los.recording import LosData
    from alidade.pipelines.methods.los.simulation import LosScenario
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config
    from alidade.pipelines.simulation.simulated import Simulated


class Los(Method):
    """The door of the los method."""

    name = "los"
    title = "Line of sight"
    sheets: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "gyro": ("scale", "skew", "g_sensitivity", "temperature"),
        "camera": ("scale", "roll"),
        "encoder": ("once_per_turn", "delay"),
        "clock": ("offset", "skew"),
        "gimbal": ("collimation", "nonperpendicularity"),
        "target": ("rate",),
    }
    of_recording = ("gyro_bias_*", "time_offset", "clock_skew", "target_rate_*")
    cards: ClassVar[Mapping[str, tuple[tuple[str, str, tuple[str, ...]], ...]]] = {
        "Mounting": (
            ("Camera on the gimbal, elevation", "deg", ("delta_px",)),
            ("IMU on the carrier", "deg", ("delta_gx", "delta_gy", "delta_gz")),
            ("Azimuth, camera minus IMU", "deg", ("delta_z", "delta_pz")),
        ),
        "Gyro and timing": (
            ("Gyro bias", "deg/h", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
            ("Delay of the pictures", "ms", ("time_offset",)),
            ("Delay of the encoders", "ms", ("encoder_delay",)),
        ),
        "Gimbal geometry": (
            ("Axes and camera", "deg", ("axis_nonperpendicularity", "collimation", "camera_roll")),
            ("Scale of the LOS error", "%", ("los_scale",)),
        ),
    }
    sketch = Path(__file__).with_name("frames.svg")
    meanings: ClassVar[Mapping[str, str]] = {
        r"delta_px": "Boresight in elevation: added to the elevation encoder.",
        r"delta_g([xy])": "Gyro misalignment about {0} of the carrier.",
        r"delta_z": "Azimuth misalignment, camera minus gyro.",
        r"delta_pz": "Boresight in azimuth: added to the azimuth encoder.",
        r"delta_gz": "Gyro misalignment about z of the carrier.",
        r"camera_roll": "Camera roll about the line of sight.",
        r"collimation": "Collimation: line of sight against the normal of the elevation axis.",
        r"axis_nonperpendicularity": "Non-perpendicularity of elevation and azimuth axis.",
        r"los_scale": "Scale error of the LOS errors (focal length).",
        r"target_rate_([xz])": "Drift of the target direction about {0}.",
    }
    components: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "los": ("phx, angle to the target below", "phz, angle to the target to the right", "roll of the picture")
    }

    @property
    def topics(self) -> tuple[Topic, ...]:
        from alidade.pipelines.methods.los.topics import TOPICS

        return TOPICS

    @property
    def needs(self) -> tuple[Need, ...]:
        from alidade.pipelines.methods.los.topics import NEEDS

        return NEEDS

    @property
    def data(self) -> type[LosData]:
        from alidade.pipelines.methods.los.recording import LosData

        return LosData

    def read(self, recording: Recording, config: Config) -> LosData:
        from alidade.pipelines.methods.los.recording import read_los

        return read_los(recording, config)

    def check(self, data: LosData) -> None:
        from alidade.pipelines.methods.los.recording import check

        check(data, "gyro", "gimbal")

    def problem(self, data: LosData, config: Config) -> Problem:
        from alidade.pipelines.methods.los.graph import problem

        return problem(data, config)

    def published(self, data: LosData, config: Config, problem: Problem) -> Estimate:
        from alidade.pipelines.methods.los.published import published_estimate

        return published_estimate(data, config, problem)

    @property
    def scenario(self) -> type[LosScenario]:
        from alidade.pipelines.methods.los.simulation import LosScenario

        return LosScenario

    def simulate(self, scenario: LosScenario, seed: int, images: bool = False) -> Simulated:
        from alidade.pipelines.methods.los.simulation import simulated

        return simulated(scenario, seed, images)

    def nominal(self, images: bool = False) -> str:
        return "los_images" if images else "los_nominal"

    def write(self, path: Path, simulated: Simulated) -> None:
        from alidade.pipelines.methods.los.recording import write_los

        write_los(path, simulated.data, simulated.truth, simulated.config, simulated.pictures)

    def candidates(self, scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
        from alidade.pipelines.methods.los.candidates import candidates

        return candidates(scenario)

    def hypotheses(self) -> FaultModel:
        from alidade.pipelines.methods.los.hypotheses import HYPOTHESES

        return HYPOTHESES

    def validate(self, data: LosData, config: Config, values: Mapping[str, float]) -> Sequence[Validation]:
        from alidade.pipelines.methods.los.validation import validate

        return validate(data, config, values)

    def checklist(self, data: LosData, config: Config) -> Sequence[ChecklistItem]:
        from alidade.pipelines.methods.los.guidance import checklist

        return checklist(data, config)

    def formulas(self, parameters: Collection[str], config: Config) -> Sequence[Formula]:  # noqa: ARG002
        from alidade.pipelines.methods.los.formulas import formulas

        return formulas(parameters)

    def findings(self, data: LosData, config: Config, estimate: Estimate) -> Findings:
        from alidade.pipelines.methods.los.findings import findings

        return findings(data, config, estimate)

    def figures(self, data: LosData, calibration: Calibration) -> Sequence[Plot]:
        from alidade.pipelines.methods.los.figures import los_plots

        return los_plots(data, calibration)

    def uses(self, true: Truth, config: Config, noise: Mapping[str, float]) -> Sequence[Use]:  # noqa: ARG002
        from alidade.pipelines.methods.los.uses import uses

        return uses(true)


METHOD = Los()
