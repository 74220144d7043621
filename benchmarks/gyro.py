"""The gyro chain: what scale and g-sensitivity as variables cost over a gyro with a bias only."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.attitude import ahrs_factors
from alidade.factors.gyro import GyroIncrementFactor
from alidade.factors.preintegration import GyroPath
from alidade.factors.vectorized import Ensemble
from alidade.pipelines.solvers.assembly import CHUNK
from benchmarks.measure import Ratio, costs

SAMPLES, WINDOWS = 300_000, 36_000
BIAS, ERRORS = (int(gtsam.symbol(c, 0)) for c in "be")


def run() -> Iterator[Ratio]:
    """Integrating a stream, and linearising the factors on it, with and without."""
    rng = np.random.default_rng(0)
    t = np.arange(SAMPLES) / 500.0
    rate, force = (np.sin(t[:, None] * rng.uniform(1.0, 6.0, 3)) for _ in range(2))
    edges = np.linspace(t[0], t[-1], WINDOWS + 1)
    windows = edges[:-1], edges[1:]
    chain, plain = costs(
        [
            lambda: GyroPath(t, rate, drivers=force).increments(*windows, scale=True),
            lambda: GyroPath(t, rate).increments(*windows),
        ]
    )
    compared = "increments with derivatives by scale and g-sensitivity over those with a bias only, 300,000 samples"
    yield Ratio("gyro.integration", compared, chain.seconds / plain.seconds, wanted=2.0, ours=chain, theirs=plain)

    path = GyroPath(t, rate, drivers=force)
    turns = path.increments(*windows, scale=True)
    values = gtsam.Values()
    for k, attitude in enumerate(path.attitude(edges)):
        values.insert(k, so3.to_gtsam(attitude))
    for key, size in [(BIAS, 3), (ERRORS, 15)]:
        values.insert(key, np.zeros(size))
    factors = [
        GyroIncrementFactor(edges[k + 1], turns[k], path, np.full(len(k), 1e-5)).on(k, k + 1, BIAS, ERRORS)
        for k in np.array_split(np.arange(WINDOWS), WINDOWS // CHUNK)
    ]
    native = gtsam.NonlinearFactorGraph()
    keys = list(range(WINDOWS + 1))
    for each in ahrs_factors(keys[:-1], keys[1:], [BIAS] * WINDOWS, turns, path.bias_hat, np.full(WINDOWS, 1e-10)):
        native.add(each)

    def linearize() -> None:
        with Ensemble(factors).at(values):
            for factor in factors:
                factor.linearized(values)

    chain, plain = costs([linearize, lambda: native.linearize(values)])
    compared = "linearising increments with scale and g-sensitivity over native AHRSFactors, 36,000 keyframes"
    yield Ratio("gyro.linearisation", compared, chain.seconds / plain.seconds, ours=chain, theirs=plain)
