"""Noise levels of a graph: from the config, from messages, and from a sensor's own samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.static_intervals import stretches_at_rest
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.noise import ROUGHLY, Level, Noise, Source
from alidade.pipelines.estimation.robust import robust_sigma
from alidade.pipelines.noises import NOISES, NoiseSpec
from alidade.pipelines.settings import Config

# Order of the differences that separate a sensor's white noise from its motion: motion is smooth, noise is not.
_ORDER = 6
# Means of so many samples are looked at, one after the other, until two of them agree to this part: below a sensor's
# own filter its noise is white.
_MEANS, _ALIKE = (1, 2, 4, 8), 0.1
# Differences worked out at a time.
_BLOCK = 100_000
# Differences up to this part of the largest sample are rounding, as of readings between which a driver interpolates.
_ROUNDING = 1e-13
# Fewer differences are not used; the best of them are not trusted to less than this, in the logarithm.
_FEWEST, TRUSTED = 200, 0.05
# A walk is looked for in steps of this, in the logarithm, where the bias was seen so many times.
# ... and what was stated is contradicted by so many sigmas.
_STEP, _FEWEST_MEANS, _SURE = 0.25, 12, 4.0
# s over which samples at rest are averaged: one sample shows a slow motion least, longer ones what is rounded off.
_REST_MEANS = (0.0, 0.1, 0.4)
# How well repeatability is known, in the logarithm, where nobody states it.
HARDLY = 2.0
# A walk that nobody states is no smaller than this, over the default.
_SMALLEST_WALK = 1e-3
# A process is not made smaller than this without its residuals being asked.
_MUCH_SMALLER = 0.8


def stated(
    spec: str | NoiseSpec,
    config: Config,
    message: float | None = None,
    families: Sequence[str] = (),
    rows: Sequence[int] | None = None,
) -> Noise:
    """Read a noise of the config's section `noise`: its figure, else that of the messages, else the default.

    Args:
        spec: its key, or the declaration of a noise that only one method has.
        message: typical figure of the messages; None: they state none.
        families, rows: as Noise has them.
    """
    own = NOISES[spec] if isinstance(spec, str) else spec
    given: float | None = getattr(config.noise, own.name, None)
    assert own.default is not None
    figure = own.default
    source: Source = "default"
    if given is not None:
        figure, source = float(given), "config"
    elif message is not None:
        figure, source = float(message), "message"
    # Who takes the config's figures for exact wants no level estimated.
    known = config.noise_known if given is not None or config.noise_known == 0.0 else ROUGHLY
    of = None if rows is None else tuple(rows)
    return Noise(own.name, figure, source, known, tuple(families), of, own=None if own.name in NOISES else own)


def refuse_gyro_scale(method: str, config: Config) -> None:
    """Raise InputError if the config states noise.gyro_scale, for a method that estimates the gyro's scale itself."""
    if figure := config.noise.gyro_scale:
        raise InputError(
            f"noise.gyro_scale: {method} estimates the gyro's scale; write sensors: {{gyro: {{scale: {figure:g}, "
            f"skew: {figure:g}}}}} instead"
        )


def repeatability(sensor: str, config: Config, family: str) -> Level:
    """Level of what a sensor's means over a rest or turn scatter by beside white noise, estimated from residuals."""
    return estimated(f"{sensor}_repeatability", config, (family,), beside=True)


def estimated(
    name: str, config: Config, families: Sequence[str], message: float | None = None, beside: bool = False
) -> Level:
    """Level of a noise to be estimated from residuals: its prior the stated figure, else a default within a factor 7.

    Where noise is said to be known exactly there is none `beside` it unless that is stated.

    Args:
        name: of the noise, as in the config.
        config: of the recording.
        families: of measurements or processes that it drives.
        message: its figure in the recording's messages, SI.
        beside: whether it adds to the noise that its factors are whitened by, see `Noise.beside`.
    """
    noise = replace(stated(name, config, message, families), beside=beside)
    if noise.source != "default":
        return Level(noise)
    if noise.known:
        return Level(replace(noise, known=HARDLY))
    return Level(replace(noise, stated=0.0) if beside else noise)


def sampled(noise: Noise, time: Array, samples: Array) -> Level:
    """Estimate a sensor's white noise level from its samples in motion, with the stated level as prior.

    What is stated larger than the samples have it may stand for more than white noise, so that residuals decide.

    Args:
        noise: its density; its families are the processes, if any, that it drives.
        time: (n,) s.
        samples: (n, k) of a rate.
    """
    found = white_density(time, samples) if noise.known > 0.0 and noise.stated > 0.0 else None
    held = replace(noise, families=())
    if found is None:
        # A default that samples do not determine is estimated from residuals.
        return Level(noise if noise.source == "default" else held)
    ratio, spread = found[0] / noise.stated, max(found[1], TRUSTED)
    level = weighed(Level(held, 1.0, ratio, ratio * spread))
    if noise.families and level.scale < _MUCH_SMALLER:
        return replace(level, noise=noise, scale=1.0, least=level.scale)
    return level


def at_most_sampled(noise: Noise, time: Array, samples: Array) -> Level:
    """Bound a sensor's white noise level above by that of its samples in motion, which adds noise and takes none away.

    Samples whose noise is not white, as behind a filter, bound nothing.

    Args:
        noise: sigma of a sample.
        time: (n,) s.
        samples: (n, k).
    """
    level = Level(replace(noise, families=()))
    found = white_density(time, samples) if noise.known > 0.0 and noise.stated > 0.0 else None
    if found is None:
        return level
    ratio = found[0] / float(np.median(np.diff(time))) ** 0.5 / noise.stated
    return replace(level, scale=ratio, found=ratio, sigma=TRUSTED * ratio) if ratio < 1.0 else level


def at_least_at_rest(level: Level, time: Array, gyro: Array, force: Array | None) -> Level:
    """Bound a gyro's white noise level below by the noise that the gyro shows at rest.

    Motion adds noise and takes none away. The bound is the least density of means over some times, less three of its
    sigmas; of a recording without rest there is none.

    Args:
        level: of the density, rad/s/sqrt(Hz).
        time: (n,) s.
        gyro: (n, 3) rad/s.
        force: (n, 3) m/s^2 of the accelerometer beside it; None: there is none.
    """
    if not level.noise.estimated:
        return level
    pieces = [gyro[rest] for rest in _rests(time, gyro, force)]
    interval = float(np.median(np.diff(time)))
    found = min((_rest_density(pieces, max(1, round(mean / interval)), interval) for mean in _REST_MEANS), default=0.0)
    return replace(level, noise=replace(level.noise, least=found / level.noise.stated))


def mean_at_rest(time: Array, gyro: Array, force: Array | None) -> Array:
    """Replace a gyro's rates (n, 3) at rest by their mean over each interval at rest.

    What a sensor turns within milliseconds at rest is not what its noise says. The same array of a recording without
    rest; arguments as `at_least_at_rest` has them.
    """
    out = gyro
    for rest in _rests(time, gyro, force):
        out = gyro.copy() if out is gyro else out
        out[rest] = gyro[rest].mean(axis=0)
    return out


def _rests(time: Array, gyro: Array, force: Array | None) -> list[slice]:
    """Slices of the samples in each static interval."""
    spans = stretches_at_rest(time, [gyro] if force is None else [gyro, force], gyro)
    return [slice(*np.searchsorted(time, span) + [0, 1]) for span in spans]


def _rest_density(pieces: Sequence[Array], count: int, interval: float) -> float:
    """Lower 3-sigma bound of a noise density, from the Allan deviation of means of `count` samples; 0: too few."""
    differences = [
        np.diff(piece[: len(piece) // count * count].reshape(-1, count, 3).mean(axis=1), axis=0) for piece in pieces
    ]
    each = np.concatenate([np.empty((0, 3)), *differences]).ravel()
    sure = 1.0 - 3.0 / np.sqrt(max(each.size, 1))
    return max(sure, 0.0) * float(np.sqrt(0.5 * np.mean(each**2) * count * interval)) if each.size else 0.0


def walked(noise: Noise, time: Array, means: Array, causes: Array) -> Level:
    """Estimate the level of a bias's random walk from direct observations of the bias and the stated level.

    By restricted maximum likelihood: the walk beside an error that is new every time, the mean and what follows its
    causes (g-sensitivity, the vertical part of the earth's rate, a slope over temperature) free.

    Args:
        noise: the walk.
        time: (n,) s.
        means: (n, k) the bias as measured then.
        causes: (n, d) specific force and, where it is known, temperature then, in any unit.
    """
    if noise.known == 0.0 or noise.stated == 0.0 or len(time) < _FEWEST_MEANS:
        return Level(noise)
    causes = causes[:, np.ptp(causes, axis=0) > 0.0]
    follows = np.column_stack([np.ones(len(time)), causes / np.abs(causes).max(axis=0)])
    left = means - follows @ np.linalg.lstsq(follows, means)[0]
    size = float(np.std(left, axis=0).max())
    tried = size / float(np.ptp(time)) ** 0.5 * np.exp(np.arange(-5.0, 3.0, _STEP))
    error = size * np.exp(np.arange(-4.0, 0.5, _STEP))
    earlier = np.minimum.outer(time - time[0], time - time[0])

    def likeliest(walk: float) -> float:
        return max(_likelihood(left, follows, walk**2 * earlier + e**2 * np.eye(len(time))) for e in error)

    fit = np.array([likeliest(walk) for walk in tried])
    best = int(np.argmax(fit))
    contradicts = fit[best] - likeliest(noise.stated) > 0.5 * _SURE**2
    if best in (0, len(tried) - 1) or not contradicts:
        return Level(noise)
    bend = float(2.0 * fit[best] - fit[best - 1] - fit[best + 1]) / _STEP**2
    ratio, spread = float(tried[best]) / noise.stated, max(bend, 1e-6) ** -0.5
    return weighed(Level(noise, 1.0, ratio, ratio * spread))


def walking(config: Config) -> Level:
    """Level of a bias's random walk that acts through process factors: as stated or, for a default, smaller.

    A default is that of no particular sensor, and a better one's residuals say how far below it is.
    """
    noise = stated("gyro_bias_walk", config)
    if noise.source != "default" or noise.known == 0.0:
        return Level(noise)
    return Level(replace(noise, families=("bias walk", "definition")), least=_SMALLEST_WALK)


def _likelihood(means: Array, follows: Array, covariance: Array) -> float:
    """Restricted log likelihood of columns (n, k), their regression on others (n, d) marginalised out.

    Patterson, Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika 1971.
    """
    root = np.linalg.cholesky(covariance)
    own, columns = np.linalg.solve(root, follows), np.linalg.solve(root, means)
    orthogonal, triangle = np.linalg.qr(own)
    square = float((columns**2).sum() - ((orthogonal.T @ columns) ** 2).sum())
    diagonals = np.concatenate([np.diag(root), np.diag(triangle)])
    return -0.5 * square - means.shape[1] * float(np.log(np.abs(diagonals)).sum())


def weighed(level: Level) -> Level:
    """Combine a level's stated and estimated scale, weighted by their uncertainties."""
    assert level.found is not None
    assert level.sigma is not None
    spread = level.sigma / level.found
    return replace(level, scale=float(np.exp(np.log(level.found) / (1.0 + (spread / level.known) ** 2))))


def white_density(time: Array, samples: Array) -> tuple[float, float] | None:
    """Density per sqrt(Hz) of the white part of samples (n, k) in motion, and its relative sigma.

    From high differences of means of 1, 2, 4, ... samples, each of which sees a lower band: the first two that agree.
    None where none do, as behind a filter, under vibration, or where steps of the readings hide the noise.
    """
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if not interval > 0.0:
        return None
    even = np.append(np.abs(np.diff(time) / interval - 1.0) < 0.5, False)
    pieces = np.split(samples, np.flatnonzero(~even) + 1)
    rounding = _ROUNDING * float(np.abs(samples).max())
    before: float | None = None
    for count in _MEANS:
        found = [_differences(piece, count) for piece in pieces]
        differences = found[0] if len(found) == 1 else np.concatenate(found)
        if differences.size < _FEWEST or np.mean(np.abs(differences) <= rounding) > 0.05:
            return None
        density = robust_sigma(differences) / comb(2 * _ORDER, _ORDER) ** 0.5 * (count * interval) ** 0.5
        if before is not None and abs(np.log(density / before)) < _ALIKE:
            # Neighbouring differences are correlated, and the median is less efficient than the mean square.
            return before, float(2.0 * differences.size**-0.5)
        before = density
    return None


def _differences(samples: Array, count: int) -> Array:
    """High-order differences of means of `count` consecutive samples (n, k)."""
    out = np.empty((max(len(samples) // count - _ORDER, 0), samples.shape[1]))
    for begin in range(0, len(out), _BLOCK):
        end = min(begin + _BLOCK, len(out))
        some = samples[begin * count : (end + _ORDER) * count]
        out[begin:end] = np.diff(some.reshape(-1, count, samples.shape[1]).mean(axis=1), _ORDER, axis=0)
    return out.ravel()


def typical(covariance: Array | None, *components: int) -> float | None:
    """Median sigma of selected components over covariances (n, m, m) of measurements; None where none is given."""
    if covariance is None:
        return None
    variance = np.concatenate([covariance[:, i, i] for i in components])
    known = variance[np.isfinite(variance)]
    return float(np.sqrt(np.median(known))) if len(known) else None
