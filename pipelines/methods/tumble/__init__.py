"""The tumble method: magnetometer, accelerometer and gyro of a device turned by hand, which nothing watches."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from alidade.pipelines.methods import Method, Scenario

if TYPE_CHECKING:
    from alidade.pipelines.diagnostics.checklist import ChecklistItem
    from alidade.pipelines.diagnostics.cross_validation import Validation
    from alidade.pipelines.diagnostics.fault_models import FaultModel
    from alidade.pipelines.diagnostics.use import Truth, Use
    from alidade.pipelines.display.figure import Plot
    from alidade.pipelines.display.table import Table
    from alidade.pipelines.estimation.problem import Estimate, Findings, Problem
    from alidade.pipelines.methods.formula import Formula
    from alidade.pipelines.methods.tumble.recording import TumbleData
    from alidade.pipelines.methods.tumble.scenario import TumbleScenario
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.calibration import SavedCalibration
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config
    from alidade.pipelines.simulation.simulated import Simulated


class Tumble(Method):
    """The door of the tumble method."""

    name = "tumble"
    title = "Tumbled magnetometer and accelerometer"
    sheets: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "gyro": ("scale", "skew", "g_sensitivity", "temperature"),
        "accel": ("square", "temperature"),
        "mag": ("delay",),
        "field": ("model_error",),
    }
    of_recording = ("accel_b?", "gyro_bias_*", "gravity", "field_*")
    cards: ClassVar[Mapping[str, tuple[tuple[str, str, tuple[str, ...]], ...]]] = {
        "Gyro": (
            ("Bias", "deg/s", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
            ("Scale error", "%", ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")),
        ),
        "Field": (
            ("Strength", "", ("field_strength",)),
            ("Dip", "deg", ("field_dip",)),
            ("Delay of the magnetometer", "ms", ("mag_delay",)),
        ),
    }
    sketch = Path(__file__).with_name("frames.svg")
    drawn = True
    yields = True

    @property
    def topics(self) -> tuple[Topic, ...]:
        from alidade.pipelines.methods.tumble.topics import TOPICS

        return TOPICS

    @property
    def needs(self) -> tuple[Need, ...]:
        from alidade.pipelines.methods.tumble.topics import NEEDS

        return NEEDS

    @property
    def data(self) -> type[TumbleData]:
        from alidade.pipelines.methods.tumble.recording import TumbleData

        return TumbleData

    def read(self, recording: Recording, config: Config) -> TumbleData:
        from alidade.pipelines.methods.tumble.recording import read_tumble

        return read_tumble(recording, config)

    def problem(self, data: TumbleData, config: Config) -> Problem:
        from alidade.pipelines.methods.tumble.graph import problem

        return problem(data, config)

    def published(self, data: TumbleData, config: Config, problem: Problem) -> Estimate:
        from alidade.pipelines.methods.tumble.published import published_estimate

        return published_estimate(data, config, problem)

    @property
    def scenario(self) -> type[TumbleScenario]:
        from alidade.pipelines.methods.tumble.scenario import TumbleScenario

        return TumbleScenario

    def simulate(self, scenario: TumbleScenario, seed: int, images: bool = False) -> Simulated:
        from alidade.pipelines.methods.tumble.simulation import simulated

        return simulated(scenario, seed, images)

    def write(self, path: Path, simulated: Simulated) -> None:
        from alidade.pipelines.methods.tumble.recording import write_tumble

        write_tumble(path, simulated)

    def candidates(self, scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
        from alidade.pipelines.methods.tumble.candidates import candidates

        return candidates(scenario)

    def checklist(self, data: TumbleData, config: Config) -> Sequence[ChecklistItem]:
        from alidade.pipelines.methods.tumble.guidance import checklist

        return checklist(data, config)

    def hypotheses(self) -> FaultModel:
        from alidade.pipelines.methods.tumble.hypotheses import HYPOTHESES

        return HYPOTHESES

    def validate(self, data: TumbleData, config: Config, values: Mapping[str, float]) -> Sequence[Validation]:
        from alidade.pipelines.methods.tumble.validation import validate

        return validate(data, config, values)

    def formulas(self, parameters: Collection[str], config: Config) -> Sequence[Formula]:  # noqa: ARG002
        from alidade.pipelines.methods.tumble.formulas import formulas

        return formulas(parameters)

    def findings(self, data: TumbleData, config: Config, estimate: Estimate) -> Findings:
        from alidade.pipelines.methods.tumble.findings import findings

        return findings(data, config, estimate)

    def figures(self, data: TumbleData, calibration: Calibration) -> Sequence[Plot | Table]:
        from alidade.pipelines.methods.tumble.figures import figures

        return figures(data, calibration)

    def uses(self, true: Truth, config: Config, noise: Mapping[str, float]) -> Sequence[Use]:  # noqa: ARG002
        from alidade.pipelines.methods.tumble.uses import uses

        return uses(true)

    @property
    def exporters(self) -> Mapping[str, Callable[[SavedCalibration], str]]:
        from alidade.pipelines.methods.triad_export import FORMATS

        return FORMATS


METHOD = Tumble()
