"""Parameters of the gyro_pair method."""

from alidade.pipelines.estimation.parameters import ParameterSpec, scalar

ROTATION = ParameterSpec(
    "rotation",
    "rad",
    3.15,
    "Rotation gyro b to gyro a (aRb), {axis} of the rotation vector.",
    require=1e-3,
    rotation="aRb",
)
TIME_OFFSET = scalar(
    "time_offset", "s", 0.1, "Time offset of gyro b (true time minus stamp, on gyro a's clock).", require=5e-4
)
DIFFERENCE = ParameterSpec(
    "bias_difference",
    "rad/s",
    0.1,
    "Bias of gyro b minus bias of gyro a about {axis}, in b.",
    require=2e-4,
    per_recording=True,
)
PARAMETERS = (ROTATION, TIME_OFFSET, DIFFERENCE)
