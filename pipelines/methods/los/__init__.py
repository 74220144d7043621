"""The los method: gyro and camera mounting angles of an indirectly stabilised line of sight."""

from functools import partial
from pathlib import Path

from alidade.pipelines.methods import Method, deferred
from alidade.pipelines.methods.los.parameters import PARAMETERS
from alidade.pipelines.methods.los.recording import REQUIREMENTS, TOPICS, LosData, check, los_topics, read_los

METHOD = Method(
    name="los",
    title="Line of sight",
    data=LosData,
    topics=TOPICS,
    requirements=REQUIREMENTS,
    read=read_los,
    check=partial(check, gyro="gyro", gimbal="gimbal"),
    to_topics=los_topics,
    parameters=PARAMETERS,
    problem=deferred("alidade.pipelines.methods.los.model:problem"),
    published=deferred("alidade.pipelines.methods.los.published:published_estimate"),
    simulator=deferred("alidade.pipelines.methods.los.simulation:SIMULATOR"),
    guidance=deferred("alidade.pipelines.methods.los.guidance:GUIDANCE"),
    faults=deferred("alidade.pipelines.methods.los.guidance:FAULTS"),
    report=deferred("alidade.pipelines.methods.los.report:REPORT"),
    frames=Path(__file__).with_name("frames.svg"),
)
