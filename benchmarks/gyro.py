"""The gyro chain: what scale and g-sensitivity as variables cost over a gyro with a bias only."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.gyro import GyroIncrementFactor
from alidade.factors.preintegration import GyroPath
from alidade.pipelines.estimation.problem import ChainLayout, Factor
from alidade.pipelines.solvers.layout import Layout
from alidade.pipelines.solvers.linearization import Linearization
from benchmarks.ahrs import ahrs_factors
from benchmarks.measure import Ratio, costs

SAMPLES, WINDOWS = 300_000, 36_000
BIAS, ERRORS = (int(gtsam.symbol(c, 0)) for c in "be")
KEYS = [int(gtsam.symbol("x", k)) for k in range(WINDOWS + 1)]


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
        values.insert(KEYS[k], so3.to_gtsam(attitude))
    for key, size in [(BIAS, 3), (ERRORS, 15)]:
        values.insert(key, np.zeros(size))
    model = GyroIncrementFactor(edges[1:], turns, path, np.full(WINDOWS, 1e-5), errors=15)
    factor = Factor.process_of("gyro", model.on(KEYS[:-1], KEYS[1:], BIAS, ERRORS))
    layout, ours = Layout.of(ChainLayout("x"), values)
    linearization = Linearization.of([factor], layout)
    native = gtsam.NonlinearFactorGraph()
    for each in ahrs_factors(KEYS[:-1], KEYS[1:], [BIAS] * WINDOWS, turns, path.bias_hat, np.full(WINDOWS, 1e-10)):
        native.add(each)

    chain, plain = costs([lambda: linearization.at(ours), lambda: native.linearize(values)])
    compared = "linearising increments with scale and g-sensitivity over native AHRSFactors, 36,000 keyframes"
    yield Ratio("gyro.linearisation", compared, chain.seconds / plain.seconds, ours=chain, theirs=plain)
