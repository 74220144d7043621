"""The tumble method: magnetometer, accelerometer and gyro of a device turned by hand, which nothing watches."""

from pathlib import Path

from alidade.pipelines.estimation.parameters import DEAD_BAND, scalar
from alidade.pipelines.methods import Method, deferred
from alidade.pipelines.methods.triads import triad_specs
from alidade.pipelines.methods.tumble import turning
from alidade.pipelines.methods.tumble.recording import (
    ACCEL_CURVATURE,
    REQUIREMENTS,
    SLOPES,
    TOPICS,
    TumbleData,
    read_tumble,
    tumble_topics,
)

# Priors of triads and strengths are in `tumble.parameters`: over the strength, and by the model of the field.
PARAMETERS = (
    *triad_specs("accel", "m/s^2", (0.3, 5e-3), (0.2, 2e-3), per_recording=True),
    *triad_specs("mag", "T", (0.3, 5e-3), (10.0, 1e-2)),
    scalar("gravity", "m/s^2", 1e-2, "Local gravity.", per_recording=True),
    scalar(
        "field_strength", "T", 5e-7, "Strength of the local magnetic field.", "field.model_error", per_recording=True
    ),
    scalar(
        "field_dip", "rad", 1.0, "Inclination of the magnetic field, positive down.", require=2e-2, per_recording=True
    ),
    turning.BIAS,
    *turning.SCALE,
    turning.SENSITIVITY,
    turning.DELAY,
    turning.FILTER,
    DEAD_BAND,
    turning.ARM,
    *ACCEL_CURVATURE,
    *SLOPES,
)

METHOD = Method(
    name="tumble",
    title="Tumbled magnetometer and accelerometer",
    data=TumbleData,
    topics=TOPICS,
    requirements=REQUIREMENTS,
    read=read_tumble,
    to_topics=tumble_topics,
    parameters=PARAMETERS,
    problem=deferred("alidade.pipelines.methods.tumble.graph:problem"),
    published=deferred("alidade.pipelines.methods.tumble.published:published_estimate"),
    simulator=deferred("alidade.pipelines.methods.tumble.simulation:SIMULATOR"),
    guidance=deferred("alidade.pipelines.methods.tumble.guidance:GUIDANCE"),
    faults=deferred("alidade.pipelines.methods.tumble.guidance:FAULTS"),
    report=deferred("alidade.pipelines.methods.tumble.report:REPORT"),
    frames=Path(__file__).with_name("frames.svg"),
    fallback=True,
)
