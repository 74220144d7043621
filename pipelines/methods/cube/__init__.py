"""The cube method: accelerometer, gyro and magnetometer of a device in a cube of AprilTags."""

from pathlib import Path

from alidade.pipelines.methods import Method, deferred
from alidade.pipelines.methods.cube.parameters import PARAMETERS
from alidade.pipelines.methods.cube.recording import REQUIREMENTS, TOPICS, CubeConfig, CubeData, cube_topics, read_cube

METHOD = Method(
    name="cube",
    title="Tag cube",
    data=CubeData,
    topics=TOPICS,
    config_section=CubeConfig,
    requirements=REQUIREMENTS,
    read=read_cube,
    to_topics=cube_topics,
    parameters=PARAMETERS,
    problem=deferred("alidade.pipelines.methods.cube.model:problem"),
    published=deferred("alidade.pipelines.methods.cube.published:published_estimate"),
    simulator=deferred("alidade.pipelines.methods.cube.simulation:SIMULATOR"),
    guidance=deferred("alidade.pipelines.methods.cube.guidance:GUIDANCE"),
    faults=deferred("alidade.pipelines.methods.cube.guidance:FAULTS"),
    report=deferred("alidade.pipelines.methods.cube.report:REPORT"),
    frames=Path(__file__).with_name("frames.svg"),
)
