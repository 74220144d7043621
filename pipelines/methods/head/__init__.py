"""The head method: helmet attitude, gyro bias and mounts from a helmet MIMU, the platform IMU and vision."""

from pathlib import Path

from alidade.pipelines.methods import Method, deferred
from alidade.pipelines.methods.head.parameters import PARAMETERS
from alidade.pipelines.methods.head.recording import (
    REQUIREMENTS,
    TOPICS,
    HeadConfig,
    HeadData,
    head_topics,
    proposed,
    read_head,
)

METHOD = Method(
    name="head",
    title="Helmet",
    data=HeadData,
    topics=TOPICS,
    config_section=HeadConfig,
    proposed=proposed,
    requirements=REQUIREMENTS,
    read=read_head,
    to_topics=head_topics,
    parameters=PARAMETERS,
    problem=deferred("alidade.pipelines.methods.head.model:problem"),
    published=deferred("alidade.pipelines.methods.head.published:published_estimate"),
    simulator=deferred("alidade.pipelines.methods.head.simulation:SIMULATOR"),
    guidance=deferred("alidade.pipelines.methods.head.guidance:GUIDANCE"),
    faults=deferred("alidade.pipelines.methods.head.guidance:FAULTS"),
    report=deferred("alidade.pipelines.methods.head.report:REPORT"),
    frames=Path(__file__).with_name("frames.svg"),
)
