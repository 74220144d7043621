"""What the simulator of a tumbled device is asked for."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from alidade.pipelines.simulation.scenario import NotNegative, Positive, ScenarioPart
from alidade.pipelines.simulation.sensors import Warming, recording_config


class TumbledMagnetometer(ScenarioPart):
    """Settings of the simulated magnetometer, with hard and soft iron."""

    rate_hz: Positive = 50.0
    density: Positive = 5e-8  # T/sqrt(Hz)
    soft_iron: NotNegative = 0.05  # sigma of each entry of K - 1
    hard_iron: NotNegative = 3e-5  # T, sigma of each component of b


class TumbledAccelerometer(ScenarioPart):
    """Settings of the simulated accelerometer."""

    rate_hz: Positive = 100.0
    density: Positive = 1.5e-3  # m/s^2/sqrt(Hz)
    gain: NotNegative = 0.02  # sigma of each entry of K - 1
    bias: NotNegative = 0.3  # m/s^2
    mounting_deg: NotNegative = 3.0  # sigma of the magnetometer's rotation against it, each component
    temperature: NotNegative = 1e-2  # m/s^2/K, sigma of each slope of b, where there is a temperature
    square: NotNegative = 3e-5  # s^2/m, sigma of what is felt squared that each axis reads beside it
    arm: NotNegative = 0.1  # m, from the centre that the device is turned about


class TumbledGyro(ScenarioPart):
    """Settings of the simulated gyro, sampled with the accelerometer if there is one."""

    rate_hz: Positive = 100.0
    density: Positive = 1e-4  # rad/s/sqrt(Hz)
    bias: NotNegative = 1e-2  # rad/s, sigma of each component
    scale: NotNegative = 1e-2  # sigma of each number of S
    g_sensitivity: NotNegative = 2e-4  # rad/s per m/s^2, sigma of each number of G, beside an accelerometer
    temperature: NotNegative = 1e-4  # rad/s/K, sigma of each slope of the bias, where there is a temperature
    mounting_deg: NotNegative = 0.5  # sigma of the next sensor's rotation against it, each component
    mag_delay: NotNegative = 1e-2  # s, sigma


class TumbleScenario(ScenarioPart):
    """Settings of the `tumble` simulator; every key has a default, `null` leaves a sensor out."""

    attitudes: Annotated[int, Field(ge=2)] = 30  # random ones, gone through one after the other
    turn_rad_s: Positive = 1.5  # mean rate from one to the next
    rest_s: NotNegative = 0.0  # in each
    tilt_deg: Annotated[float, Field(gt=0.0, le=180.0)] = 180.0  # the attitudes are within this of level, any heading
    magnetometer: TumbledMagnetometer | None = TumbledMagnetometer()
    accelerometer: TumbledAccelerometer | None = None
    gyro: TumbledGyro | None = None
    temperature: Warming | None = None  # of accelerometer and gyro; null: nobody measures it
    latitude_deg: float | None = 40.0  # null: nobody knows where it was
    longitude_deg: float = 116.3
    field_error: NotNegative = 5e-7  # T, sigma of the strength about its model
    field_measured: Positive | None = 1e-7  # T, sigma of the strength that was measured there; null: nobody did
    priors: dict[str, float | None] = {}  # passed on to the recording's config


def tumble_config(scenario: TumbleScenario, **more: object) -> str:
    """Config (YAML) of the recording: simulated noise, the scenario's priors, other keys."""
    noise = {}
    if scenario.magnetometer is not None:
        noise["mag_density"] = scenario.magnetometer.density
    if scenario.accelerometer is not None:
        noise["accel_density"] = scenario.accelerometer.density
    if scenario.gyro is not None:
        noise |= {"gyro_density": scenario.gyro.density, "gyro_bias_walk": 0.0}
    return recording_config("tumble", scenario, noise, date="2026-11-20", **more)
