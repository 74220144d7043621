"""The cube method: accelerometer, gyro and magnetometer of a device in a cube of AprilTags."""

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
    from alidade.pipelines.estimation.problem import Array, Estimate, Findings, Problem
    from alidade.pipelines.methods.cube.data import CubeData
    from alidade.pipelines.methods.cube.scenario import CubeScenario
    from alidade.pipelines.methods.cube.topics import CubeConfig
    from alidade.pipelines.methods.formula import Formula
    from alidade.pipelines.recording.recording import Recording
    from alidade.pipelines.recording.topics import Need, Topic
    from alidade.pipelines.reports.calibration import SavedCalibration
    from alidade.pipelines.reports.result import Calibration
    from alidade.pipelines.settings import Config
    from alidade.pipelines.simulation.simulated import Simulated


class Cube(Method):
    """The door of the cube method."""

    name = "cube"
    title = "Tag cube"
    sheets: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "gyro": ("g_sensitivity", "temperature"),
        "accel": ("square", "cube", "temperature"),
        "reference": ("tilt",),
        "field": ("model_error",),
        "camera": ("focal", "centre"),
    }
    drawn = True
    of_recording = ("gyro_b?", "accel_b?", "field_?", "reference_*")
    cards: ClassVar[Mapping[str, tuple[tuple[str, str, tuple[str, ...]], ...]]] = {
        "Mounts and field": (
            ("Camera to reference, correction", "deg", ("camera_mount_x", "camera_mount_y", "camera_mount_z")),
            ("Reference heading", "deg", ("reference_heading",)),
            ("Field", "µT", ("field_e", "field_n", "field_u")),
        ),
    }
    sketch = Path(__file__).with_name("frames.svg")
    meanings: ClassVar[Mapping[str, str]] = {
        r"camera_mount_([xyz])": "Camera mount about {0}, correction of the config.",
        r"reference_heading": "Heading error of the reference.",
        r"reference_tilt_([en])": "Tilt error of the reference about {0}.",
        r"tag_(\d+)_([xyz])": "Tag {0} rotation about {1}, correction of the config.",
        r"accel_cube_([123])": "Accelerometer cubic nonlinearity, {0}.",
        r"camera_focal": "Relative correction of the focal length.",
        r"camera_centre_([xy])": "Correction of the image centre along {0}.",
    }
    rotations: ClassVar[Mapping[str, str]] = {"camera_mount": "correction of BRC"}

    @property
    def topics(self) -> tuple[Topic, ...]:
        from alidade.pipelines.methods.cube.topics import TOPICS

        return TOPICS

    @property
    def needs(self) -> tuple[Need, ...]:
        from alidade.pipelines.methods.cube.topics import NEEDS

        return NEEDS

    @property
    def section(self) -> type[CubeConfig]:
        from alidade.pipelines.methods.cube.topics import CubeConfig

        return CubeConfig

    @property
    def data(self) -> type[CubeData]:
        from alidade.pipelines.methods.cube.data import CubeData

        return CubeData

    def read(self, recording: Recording, config: Config) -> CubeData:
        from alidade.pipelines.methods.cube.recording import read_cube

        return read_cube(recording, config)

    def problem(self, data: CubeData, config: Config) -> Problem:
        from alidade.pipelines.methods.cube.graph import problem

        return problem(data, config)

    def published(self, data: CubeData, config: Config, problem: Problem) -> Estimate:
        from alidade.pipelines.methods.cube.published import published_estimate

        return published_estimate(data, config, problem)

    @property
    def scenario(self) -> type[CubeScenario]:
        from alidade.pipelines.methods.cube.scenario import CubeScenario

        return CubeScenario

    def simulate(self, scenario: CubeScenario, seed: int, images: bool = False) -> Simulated:
        from alidade.pipelines.methods.cube.simulation import simulated

        return simulated(scenario, seed, images)

    def write(self, path: Path, simulated: Simulated) -> None:
        from alidade.pipelines.methods.cube.writing import write_cube

        write_cube(path, simulated.data, simulated.truth, simulated.config, simulated.pictures)

    def candidates(self, scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
        from alidade.pipelines.methods.cube.candidates import candidates

        return candidates(scenario)

    def hypotheses(self) -> FaultModel:
        from alidade.pipelines.methods.cube.hypotheses import HYPOTHESES

        return HYPOTHESES

    def validate(self, data: CubeData, config: Config, values: Mapping[str, float]) -> Sequence[Validation]:
        from alidade.pipelines.methods.cube.validation import validate

        return validate(data, config, values)

    def checklist(self, data: CubeData, config: Config) -> Sequence[ChecklistItem]:
        from alidade.pipelines.methods.cube.guidance import checklist

        return checklist(data, config)

    def formulas(self, parameters: Collection[str], config: Config) -> Sequence[Formula]:
        from alidade.pipelines.methods.cube.formulas import formulas

        return formulas(parameters, config)

    def stated(self, config: Config) -> Mapping[str, Array]:
        from alidade.pipelines.methods.cube.formulas import stated

        return stated(config)

    def figures(self, data: CubeData, calibration: Calibration) -> Sequence[Plot | Table]:
        from alidade.pipelines.methods.cube.figures import cube_plots

        return cube_plots(data, calibration)

    def findings(self, data: CubeData, config: Config, estimate: Estimate) -> Findings:
        from alidade.pipelines.methods.cube.findings import findings

        return findings(data, config, estimate)

    def uses(self, true: Truth, config: Config, noise: Mapping[str, float]) -> Sequence[Use]:  # noqa: ARG002
        from alidade.pipelines.methods.cube.uses import uses

        return uses(true, config)

    @property
    def exporters(self) -> Mapping[str, Callable[[SavedCalibration], str]]:
        from alidade.pipelines.methods.triad_export import FORMATS

        return FORMATS

    @property
    def commands(self) -> Mapping[str, Callable[..., None]]:
        from alidade.pipelines.methods.cube.commands import cube_layout, cube_print

        return {"cube-layout": cube_layout, "cube-print": cube_print}


METHOD = Cube()
