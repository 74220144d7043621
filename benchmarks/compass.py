"""A magnetometer beside a gyro, by tumble and its peers: python -m benchmarks.compass [--draws N] [--nees].

The simulation of Rodriguez-Martinez and Troni ("Full magnetometer and gyroscope bias estimation using angular rates",
IEEE J. Oceanic Eng. 2024): roll, pitch and heading are sinusoids, 10 Hz, magnetometer 10 mG and gyro 10 mrad/s a
sample, which is the mean rate since the sample before. Their solvers are measured where `magyc` is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain

import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.pipelines.applications.session import Session
from alidade.pipelines.methods import method
from alidade.pipelines.methods.triads import triad_of
from alidade.pipelines.methods.tumble.published import ellipsoid
from alidade.pipelines.methods.tumble.recording import TumbleData
from alidade.pipelines.methods.tumble.simulation import TumbleScenario
from alidade.pipelines.methods.tumble.turning import SCALE
from alidade.pipelines.settings import Config
from alidade.pipelines.solvers.batch import solve_batch

# Amplitudes of roll, pitch and heading, deg.
MOTIONS = {"wide": (5.0, 45.0, 360.0), "middle": (5.0, 5.0, 360.0), "low": (5.0, 45.0, 90.0)}
# Data sheet of the simulated gyro, and what the peers assume: no errors but its bias.
PERFECT = Config.model_validate({"sensors": {"gyro": {"scale": 0.0, "skew": 0.0, "filter": 0.0}}})
_EPOCH_NS = 1_700_000_000_000_000_000
_FIELD = np.array([227.207, 51.796, 411.731]) * 1e-7  # T, level
_SOFT = np.array([[1.10, 0.10, 0.04], [0.10, 0.88, 0.02], [0.04, 0.02, 1.22]])
_HARD = np.array([2e-6, 12e-6, 9e-6])
_GAUSS = 1e-4  # T

# Noise densities, SI, and gyro bias and scale of a simulated grade.
GRADES: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "tactical": ({"density": 1e-8}, {"density": 5e-6, "bias": 1e-4, "scale": 1e-3}),
    "consumer": ({"density": 3e-8}, {"density": 1e-4, "bias": 1e-2, "scale": 1e-2}),
    "poor": ({"density": 2e-7, "soft_iron": 0.1}, {"density": 1e-3, "bias": 5e-2, "scale": 3e-2}),
}
# Largest tilt, deg, and number of attitudes: by hand, in flight, on deck.
TILTS = {"all": (180.0, 16), "flight": (40.0, 20), "level": (8.0, 24)}
RATES_HZ = (5.0, 10.0, 25.0, 100.0, 400.0)

# K (3, 3) and b (3,) of calibrated = K raw + b, in any unit.
Triad = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A simulated recording, what its magnetometer reads without noise (n, 3), T, and the field (n, 3), T, in b."""

    data: TumbleData
    exact: Array
    field: Array

    def angle_rms_deg(self, triad: Triad) -> float:
        """Angle between the calibrated and the true field, RMS, deg."""
        found = self.exact @ triad[0].T + triad[1]
        cosine = (found * self.field).sum(axis=1) / np.linalg.norm(found, axis=1) / np.linalg.norm(self.field, axis=1)
        return float(np.rad2deg(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2))))


def drawn(amplitude_deg: Sequence[float], seconds: float, seed: int) -> Drawn:
    """A recording with random phases and rates."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 0.1)
    A, phase = np.deg2rad(amplitude_deg), rng.uniform(-np.pi, np.pi, 3)
    rate = [rng.uniform(0.05, 0.08), rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.4)]
    roll, pitch, heading = (
        so3.exp(np.outer(a * np.sin(w / a * t + p), axis))
        for a, w, p, axis in zip(A, rate, phase, np.eye(3), strict=True)
    )
    R = so3.multiply(so3.multiply(heading, pitch), roll)
    field = so3.rotate(so3.inverse(R), _FIELD)
    turn = 10.0 * so3.local(R[:-1], R[1:])
    exact = field @ _SOFT.T + _HARD
    mag = exact + 1e-6 * rng.standard_normal(field.shape)
    gyro = np.vstack([turn[:1], turn]) + [0.004, -0.005, 0.002] + 0.01 * rng.standard_normal(field.shape)
    return Drawn(TumbleData(_EPOCH_NS, mag_t=t, mag=mag, gyro_t=t, gyro=gyro), exact, field)


def by_tumble(each: Drawn, config: Config) -> Triad:
    """Batch. Raises AssertionError where it does not converge, or does not use the gyro."""
    estimate = solve_batch(method("tumble").problem(each.data, config))
    assert estimate.converged, estimate.message
    assert "gyro_bias_x" in estimate.names
    return triad_of("mag", dict(zip(estimate.names, estimate.values.tolist(), strict=True)))


def by_ellipsoid(each: Drawn) -> Triad:
    """Linear least squares without the gyro; the readings as they are where no ellipsoid fits."""
    found = None if each.data.mag is None else ellipsoid(each.data.mag)
    return (np.eye(3), np.zeros(3)) if found is None else (found.S, -found.S @ found.centre)


def by_magyc(solver: str, each: Drawn) -> Triad:
    """One of magyc's solvers, which take gauss."""
    from magyc import methods  # type: ignore[import-not-found]

    assert each.data.mag is not None
    hard, soft, *_ = getattr(methods, solver)(each.data.mag / _GAUSS, each.data.gyro, each.data.mag_t)
    K = np.linalg.inv(np.asarray(soft))
    return K, -_GAUSS * K @ np.asarray(hard)


def solvers() -> Mapping[str, Callable[[Drawn], Triad]]:
    """By name; those of magyc where it is installed."""
    own: dict[str, Callable[[Drawn], Triad]] = {
        "tumble": partial(by_tumble, config=Config()),
        "tumble, gyro stated perfect": partial(by_tumble, config=PERFECT),
        "ellipsoid": by_ellipsoid,
    }
    if importlib.util.find_spec("magyc") is None:
        return own
    return own | {f"magyc_{kind}": partial(by_magyc, f"magyc_{kind}") for kind in ("ls", "nls", "bfg", "ifg")}


def table(draws: int, seconds: float) -> Iterator[str]:
    """Rows, markdown: the angle's RMS, deg, of every draw."""
    columns = solvers()
    yield f"| motion | {' | '.join(columns)} |"
    yield "|" + " --- |" * (1 + len(columns))
    for name, amplitude in MOTIONS.items():
        recordings = [drawn(amplitude, seconds, seed) for seed in range(draws)]
        cells = [
            " ".join(f"{each.angle_rms_deg(solver(each)):.2f}" for each in recordings) for solver in columns.values()
        ]
        yield f"| {name} | {' | '.join(cells)} |"


def nees(hz: float, grade: str, motion: str, seeds: Iterable[int], accelerometer: bool = False) -> tuple[float, int]:
    """Sum over recordings of the NEES of all parameters, and its degrees of freedom; every second place is unknown."""
    (mag, gyro), (tilt, attitudes) = GRADES[grade], TILTS[motion]
    data_sheet = dict.fromkeys(chain.from_iterable(each.names for each in SCALE), gyro["scale"])
    total, dof = 0.0, 0
    for seed in seeds:
        scenario = TumbleScenario.model_validate(
            {
                "tilt_deg": tilt,
                "attitudes": attitudes,
                "turn_rad_s": 0.6 if hz < 25.0 else 1.5,
                "magnetometer": {"rate_hz": min(hz, 50.0), **mag},
                "gyro": {"rate_hz": hz, **gyro},
                "accelerometer": {"rate_hz": hz, "arm": 0.0} if accelerometer else None,
                "latitude_deg": None if seed % 2 else 40.0,
                "priors": data_sheet,
            }
        )
        simulated = method("tumble").simulate(scenario, seed)
        estimate = solve_batch(Session.of(method("tumble"), simulated).problem())
        rows = [
            i for i, n in enumerate(estimate.names) if n in simulated.truth and float(estimate.covariance[i, i]) > 0.0
        ]
        error = estimate.values[rows] - [simulated.truth[estimate.names[i]] for i in rows]
        total += float(error @ np.linalg.solve(estimate.covariance[np.ix_(rows, rows)], error))
        dof += len(rows)
    return total, dof


def consistency(draws: int) -> Iterator[str]:
    """Rows, markdown: NEES over its degrees of freedom, * outside its two-sided 99 % interval; time of 30 pairs."""
    yield f"| rate, Hz | {' | '.join(f'{grade}, {motion}' for grade in GRADES for motion in TILTS)} |"
    yield "|" + " --- |" * (1 + len(GRADES) * len(TILTS))
    for hz in RATES_HZ:
        cells = []
        for grade in GRADES:
            for motion in TILTS:
                total, dof = nees(hz, grade, motion, range(draws))
                inside = quantile(0.005, dof) < total < quantile(0.995, dof)
                cells.append(f"{total / dof:.2f}{'' if inside else '*'}")
        yield f"| {hz:g} | {' | '.join(cells)} |"
    begin = time.process_time()
    total, dof = nees(100.0, "consumer", "all", range(30), accelerometer=True)
    low, high = (quantile(p, dof) / dof for p in (0.025, 0.975))
    yield f"30 pairs with an accelerometer: {time.process_time() - begin:.0f} s of processor, simulation included; "
    yield f"ANEES {total / dof:.3f}, 95 % {low:.3f} to {high:.3f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compass", description="Angle of the field, RMS, deg.")
    parser.add_argument("--draws", type=int, default=3, help="recordings of each motion")
    parser.add_argument("--seconds", type=float, default=600.0, help="length of each")
    parser.add_argument("--nees", action="store_true", help="consistency of tumble")
    options = parser.parse_args()
    for row in consistency(options.draws) if options.nees else table(options.draws, options.seconds):
        print(row, flush=True)


if __name__ == "__main__":
    main()
