"""Two gyros on one body: their relative rotation, time offset and bias difference.

Frames: a and b are those of the two gyros; aRb maps coordinates in b to coordinates in a. One body has one rate, so
w_a = aRb w_b at every moment.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from alidade.pipelines.methods import Method, Scenario

if TYPE_CHECKING:
    from alidade.pipelines.diagnostics.checklist import ChecklistItem
    from alidade.pipelines.diagnostics.cross_validation import Validation
    from alidade.pipelines.diagnostics.fault_models import FaultModel
    from alidade.pipelines.display.figure import Plot
    from alidade.pipelines.estimation.problem import Estimate, Problem
    from alidade.pipelines.methods.formula import Formula
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config
    from alidade.pipelines.simulation.simulated import Simulated
    from gyro_pair.recording import GyroPairData
    from gyro_pair.simulation import GyroPairScenario
    from gyro_pair.topics import GyroPairConfig


class GyroPair(Method):
    """The door of the gyro_pair method."""

    name = "gyro_pair"
    title = "Two gyros"
    rotations: ClassVar[Mapping[str, str]] = {"rotation": "aRb"}
    of_recording = ("bias_difference_*",)
    meanings: ClassVar[Mapping[str, str]] = {
        r"rotation_([xyz])": "Rotation gyro b to gyro a (aRb), {0} of the rotation vector.",
        r"bias_difference_([xyz])": "Bias of gyro b minus bias of gyro a about {0}, in b.",
        r"time_offset": "Time offset of gyro b (true time minus stamp, on gyro a's clock).",
    }
    scenarios = Path(__file__).parent / "scenarios"

    @property
    def topics(self) -> tuple[Topic, ...]:
        from gyro_pair.topics import TOPICS

        return TOPICS

    @property
    def needs(self) -> tuple[Need, ...]:
        from gyro_pair.topics import NEEDS

        return NEEDS

    @property
    def section(self) -> type[GyroPairConfig]:
        from gyro_pair.topics import GyroPairConfig

        return GyroPairConfig

    @property
    def data(self) -> type[GyroPairData]:
        from gyro_pair.recording import GyroPairData

        return GyroPairData

    def read(self, recording: Recording, config: Config) -> GyroPairData:
        from gyro_pair.recording import read_gyro_pair

        return read_gyro_pair(recording, config)

    def problem(self, data: GyroPairData, config: Config) -> Problem:
        from gyro_pair.graph import problem

        return problem(data, config)

    def published(self, data: GyroPairData, config: Config, problem: Problem) -> Estimate:
        from gyro_pair.published import published_estimate

        return published_estimate(data, config, problem)

    @property
    def scenario(self) -> type[GyroPairScenario]:
        from gyro_pair.simulation import GyroPairScenario

        return GyroPairScenario

    def simulate(self, scenario: GyroPairScenario, seed: int, images: bool = False) -> Simulated:
        from gyro_pair.simulation import simulated

        return simulated(scenario, seed, images)

    def write(self, path: Path, simulated: Simulated) -> None:
        from gyro_pair.recording import write_gyro_pair

        write_gyro_pair(path, simulated)

    def candidates(self, scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
        from gyro_pair.candidates import candidates

        return candidates(scenario)

    def hypotheses(self) -> FaultModel:
        from gyro_pair.hypotheses import HYPOTHESES

        return HYPOTHESES

    def validate(self, data: GyroPairData, config: Config, values: Mapping[str, float]) -> Sequence[Validation]:
        from gyro_pair.validation import validate

        return validate(data, config, values)

    def checklist(self, data: GyroPairData, config: Config) -> Sequence[ChecklistItem]:
        from gyro_pair.guidance import checklist

        return checklist(data, config)

    def formulas(self, parameters: Collection[str], config: Config) -> Sequence[Formula]:  # noqa: ARG002
        from gyro_pair.formulas import formulas

        return formulas(parameters)

    def figures(self, data: GyroPairData, calibration: Calibration) -> Sequence[Plot]:
        from gyro_pair.figures import figures

        return figures(data, calibration)
