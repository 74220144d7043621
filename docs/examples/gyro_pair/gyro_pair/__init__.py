"""Two gyros on one body: their relative rotation, time offset and bias difference.

Frames: a and b are those of the two gyros; aRb maps coordinates in b to coordinates in a. One body has one rate, so
w_a = aRb w_b at every moment.
"""

from alidade.pipelines.methods import Guidance, Method, Report, deferred
from gyro_pair.parameters import PARAMETERS
from gyro_pair.recording import GyroPairData, read_gyro_pair, write_gyro_pair
from gyro_pair.topics import NEEDS, TOPICS, GyroPairConfig

METHOD = Method(
    name="gyro_pair",
    title="Two gyros",
    data=GyroPairData,
    topics=TOPICS,
    requirements=NEEDS,
    config_section=GyroPairConfig,
    read=read_gyro_pair,
    write_data=write_gyro_pair,
    parameters=PARAMETERS,
    problem=deferred("gyro_pair.graph:problem"),
    published=deferred("gyro_pair.published:published_estimate"),
    faults=deferred("gyro_pair.hypotheses:HYPOTHESES"),
    simulator=deferred("gyro_pair.simulation:SIMULATOR"),
    guidance=Guidance(
        checklist=deferred("gyro_pair.guidance:checklist"), variations=deferred("gyro_pair.candidates:candidates")
    ),
    report=Report(
        formulas=deferred("gyro_pair.formulas:formulas"),
        figures=deferred("gyro_pair.figures:figures"),
        validate=deferred("gyro_pair.validation:validate"),
    ),
)
