"""What methods of other distributions are written with; docs/howto/write-a-method.md goes through an example.

from alidade.plugin import Method, ParameterSpec, parameter_problem
"""

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.model import ROT3, Model, Residuals
from alidade.factors.preintegration import GyroPath, Increments
from alidade.pipelines.diagnostics.checklist import ChecklistItem, swayed, turned
from alidade.pipelines.diagnostics.cross_validation import Validation, rms
from alidade.pipelines.diagnostics.fault_models import DataFault, ExactInput, FaultModel, ScaleFactor
from alidade.pipelines.diagnostics.use import Use
from alidade.pipelines.display.drawing import swaying
from alidade.pipelines.display.figure import AXES, COLORS, Figure, Plot
from alidade.pipelines.display.table import Column, Table
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.estimation.parameters import ParameterSpec, parameter_problem, scalar
from alidade.pipelines.estimation.problem import ChainLayout, Estimate, Factor, Parameter, Problem, Step
from alidade.pipelines.methods import Correction, Guidance, Method, Report, Scenario, Simulator, deferred
from alidade.pipelines.methods.formula import Formula, apply
from alidade.pipelines.methods.noise import stated
from alidade.pipelines.noises import NoiseSpec
from alidade.pipelines.recording import messages
from alidade.pipelines.recording.checks import check_overlap, nanoseconds
from alidade.pipelines.recording.pairing import pair
from alidade.pipelines.recording.recording import Recording
from alidade.pipelines.recording.shapes import (
    Covariances,
    Fields,
    Forces,
    Numbers,
    PlatformRates,
    Quaternions,
    Rates,
    Vectors,
)
from alidade.pipelines.recording.streams import StreamReader, imu_series
from alidade.pipelines.recording.topics import IMU, MAG, Setting, Topic, wanted
from alidade.pipelines.settings import Config, MethodSection
from alidade.pipelines.simulation.scenario import EPOCH_NS, ScenarioPart, Simulated, sways
from alidade.pipelines.simulation.sensors import EulerMotion, Swing, by_axis, recording_config, sample_times

# fmt: off
__all__ = [
    "AXES", "COLORS", "EPOCH_NS", "IMU", "MAG", "ROT3", "Array", "ChainLayout", "ChecklistItem", "Column",
    "Config", "Correction", "Covariances", "DataFault", "Estimate", "EulerMotion", "ExactInput", "Factor",
    "FaultModel", "Fields", "Figure", "Forces", "Formula", "Guidance", "GyroPath", "Increments", "InputError",
    "Level", "Method", "MethodSection", "Model", "Motion", "NoiseSpec", "Numbers", "Parameter", "ParameterSpec",
    "PlatformRates", "Plot", "Problem", "Quaternions", "Rates", "Recording", "Report", "Residuals",
    "ScaleFactor", "Scenario", "ScenarioPart", "Setting", "Simulated", "Simulator", "Step", "StreamReader",
    "Swing", "Table", "Topic", "Use", "Validation", "Vectors", "apply", "by_axis", "check_overlap", "deferred",
    "imu_series", "messages", "nanoseconds", "pair", "parameter_problem", "recording_config", "rms",
    "sample_times", "scalar", "so3", "stated", "swayed", "swaying", "sways", "turned", "wanted",
]
# fmt: on
