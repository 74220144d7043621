"""The indexer method: IMU-to-axes mounting angles of a two-axis rotating INS."""

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
    from alidade.pipelines.estimation.problem import Estimate, Problem
    from alidade.pipelines.methods.formula import Formula
    from alidade.pipelines.methods.indexer.recording import IndexerData
    from alidade.pipelines.methods.indexer.simulation import IndexerScenario
    from alidade.pipelines.methods.indexer.topics import IndexerConfig
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config
    from alidade.pipelines.simulation.simulated import Simulated


class Indexer(Method):
    """The door of the indexer method."""

    name = "indexer"
    title = "Indexer"
    sheets: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "gyro": ("scale", "skew", "temperature"),
        "encoder": ("once_per_turn", "delay"),
    }
    of_recording = ("gyro_bias_*",)
    cards: ClassVar[Mapping[str, tuple[tuple[str, str, tuple[str, ...]], ...]]] = {
        "IMU on the indexer": (("Mounting", "", ("theta_x", "theta_y", "theta_z")),),
        "Gyro": (
            ("Bias", "", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z")),
            ("Scale error", "ppm", ("gyro_scale_x", "gyro_scale_y", "gyro_scale_z")),
        ),
    }
    sketch = Path(__file__).with_name("frames.svg")
    meanings: ClassVar[Mapping[str, str]] = {
        r"theta_([xyz])": "IMU misalignment about {0} of the platform.",
        r"axis_nonperpendicularity": "Non-perpendicularity of inner and outer axis.",
    }

    @property
    def topics(self) -> tuple[Topic, ...]:
        from alidade.pipelines.methods.indexer.topics import TOPICS

        return TOPICS

    @property
    def needs(self) -> tuple[Need, ...]:
        from alidade.pipelines.methods.indexer.topics import NEEDS

        return NEEDS

    @property
    def section(self) -> type[IndexerConfig]:
        from alidade.pipelines.methods.indexer.topics import IndexerConfig

        return IndexerConfig

    @property
    def data(self) -> type[IndexerData]:
        from alidade.pipelines.methods.indexer.recording import IndexerData

        return IndexerData

    def read(self, recording: Recording, config: Config) -> IndexerData:
        from alidade.pipelines.methods.indexer.recording import read_indexer

        return read_indexer(recording, config)

    def problem(self, data: IndexerData, config: Config) -> Problem:
        from alidade.pipelines.methods.indexer.graph import problem

        return problem(data, config)

    def published(self, data: IndexerData, config: Config, problem: Problem) -> Estimate:
        from alidade.pipelines.methods.indexer.published import published_estimate

        return published_estimate(data, config, problem)

    @property
    def scenario(self) -> type[IndexerScenario]:
        from alidade.pipelines.methods.indexer.simulation import IndexerScenario

        return IndexerScenario

    def simulate(self, scenario: IndexerScenario, seed: int, images: bool = False) -> Simulated:
        from alidade.pipelines.methods.indexer.simulation import simulated

        return simulated(scenario, seed, images)

    def write(self, path: Path, simulated: Simulated) -> None:
        from alidade.pipelines.methods.indexer.recording import write_indexer

        write_indexer(path, simulated.data, simulated.truth, simulated.config)

    def candidates(self, scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
        from alidade.pipelines.methods.indexer.candidates import candidates

        return candidates(scenario)

    def hypotheses(self) -> FaultModel:
        from alidade.pipelines.methods.indexer.hypotheses import HYPOTHESES

        return HYPOTHESES

    def validate(self, data: IndexerData, config: Config, values: Mapping[str, float]) -> Sequence[Validation]:
        from alidade.pipelines.methods.indexer.validation import validate

        return validate(data, config, values)

    def checklist(self, data: IndexerData, config: Config) -> Sequence[ChecklistItem]:
        from alidade.pipelines.methods.indexer.guidance import checklist

        return checklist(data, config)

    def formulas(self, parameters: Collection[str], config: Config) -> Sequence[Formula]:  # noqa: ARG002
        from alidade.pipelines.methods.indexer.formulas import formulas

        return formulas(parameters)

    def figures(self, data: IndexerData, calibration: Calibration) -> Sequence[Plot]:
        from alidade.pipelines.methods.indexer.figures import indexer_plots

        return indexer_plots(data, calibration)

    def uses(self, true: Truth, config: Config, noise: Mapping[str, float]) -> Sequence[Use]:  # noqa: ARG002
        from alidade.pipelines.methods.indexer.uses import uses

        return uses(noise)


METHOD = Indexer()
