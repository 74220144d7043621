"""Why residuals do not fit: causes tried for real, each by solving again with the data or the config changed.

    causes = find_causes(method, data, config)      # after a calibration that ended inconsistent
    causes[0].label, causes[0].evidence             # the likeliest

A cause counts when the recording fits with it, or fits far better. Signs of axes and the time offset go before the
noise: noise large enough fits anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.config import DEFAULT_NOISE, Config
from pipelines.errors import InputError
from pipelines.graph.problem import Array, ChiSquare, Estimate, Factor, Problem, Residuals
from pipelines.judgement.observability import Cause, Fit
from pipelines.reports.units import robust_sigma

if TYPE_CHECKING:
    from pipelines.registry import Method

# Trials are made on this much of a recording, s, where it fits worst, and looked at on less.
_STRETCH, _SHORT = 30.0, 8.0
# Two numbers of one recording differ by more than chance beyond this many sigmas.
_SIGNIFICANT = 5.0
# A change that leaves more than this share of the noise factor explains little.
_BETTER = 0.8
_OFFSET = "time_offset"
_OFFSET_PRIOR = 0.05
_NOISE_STEPS = 5
_NOISE_ACCURACY = 0.02
# Stamps are moved by this much first, s, and tags scaled by this much; then so many times to the bottom of a parabola.
_FIRST_SHIFT, _FIRST_SCALING, _PARABOLAS = 0.01, 0.01, 4
# A recording with more than this share rejected does not fit.
_OUTLIERS = 0.1
_MOST_NAMED = 3
# A family of at least so many measurements is mostly rejected when less than this share is used.
_FEWEST_MEASUREMENTS, _FEWEST_USED = 10, 0.6
# Iterations of a first look at a change, and how far the typical residual has to fall for a second.
_GLANCE = 5
# A model that is right needs no more damping than this; one that needs more is not looked at any longer.
_GLANCE_DAMPING = 1e-4
_PROMISING = 0.97

# A half tells a parameter when its sigma is below this share of the prior's; one chunk in so many is held out.
_TOLD, _HELD_OUT = 0.5, 5

# What it would be, data and config.
_Trial = tuple[str, Any, Config]
# Noise this far from the one stated is worth a word.
_NOTABLE = 1.1


@dataclass(frozen=True)
class _Suspects:
    """What can be wrong with a method's data, by the names of its fields.

    Attributes:
        streams: stamps -> what carries them.
        signs: readings (n,) or (n, k) -> how people call them, and their columns.
        noise: key of the config's noise -> the field that holds the messages' own, if any, and the families it is of.
        offset: whether the method has a parameter `time_offset`.
        clock: stamps that may be late, and how people call their source.
        cut: whether a stretch of the recording is a recording.
    """

    streams: Mapping[str, Sequence[str]]
    signs: Mapping[str, tuple[str, Sequence[str]]]
    noise: Mapping[str, tuple[str | None, Sequence[str]]]
    offset: bool = False
    clock: tuple[str, str] | None = None
    cut: bool = True


_AXES = ("x", "y", "z")
_SUSPECTS: dict[str, _Suspects] = {
    "head": _Suspects(
        streams={
            "head_t": ("head_gyro",),
            "platform_t": ("platform_gyro",),
            "vision_t": ("vision_wxyz", "vision_cov"),
            "truth_t": ("truth_wxyz",),
        },
        signs={"head_gyro": ("helmet gyro", _AXES), "platform_gyro": ("platform gyro", _AXES)},
        noise={
            "vision_attitude": ("vision_cov", ("vision",)),
            "gyro_density": ("gyro_density", ("gyro",)),
            "platform_gyro_density": ("platform_gyro_density", ("gyro",)),
        },
        offset=True,
    ),
    "los": _Suspects(
        streams={"gyro_t": ("gyro",), "gimbal_t": ("gimbal",), "image_t": ("error", "error_cov")},
        signs={"gyro": ("gyro", _AXES), "gimbal": ("gimbal", ("azimuth", "elevation"))},
        noise={
            "los_error": ("error_cov", ("los", "los with roll")),
            "gyro_density": ("gyro_density", ("gyro",)),
        },
        offset=True,
    ),
    "indexer": _Suspects(
        streams={"gyro_t": ("gyro", "attitude"), "encoder_t": ("outer", "inner")},
        signs={"gyro": ("gyro", _AXES), "outer": ("encoder", ("outer",)), "inner": ("encoder", ("inner",))},
        noise={
            "gyro_density": ("gyro_density", ("turn", "move", "dwell")),
            "encoder": (None, ("turn", "move", "dwell")),
        },
        clock=("encoder_t", "encoders"),
        cut=False,
    ),
    # Opposite signs of accelerometer and magnetometer are part of what is calibrated.
    "cube": _Suspects(
        streams={"imu_t": ("gyro", "accel"), "mag_t": ("mag",), "reference_t": ("reference_wxyz", "reference_cov")},
        signs={"gyro": ("gyro", _AXES)},
        noise={
            "corner_px": (None, ("tags",)),
            "accel_density": ("accel_density", ("accelerometer",)),
            "gyro_density": ("gyro_density", ("gyro at rest", "gyro turns")),
            "mag_density": ("mag_density", ("magnetometer",)),
        },
        cut=False,
    ),
}


@dataclass(frozen=True)
class _Outcome:
    """How well a recording fits after a change: the solution, and the loss of what it rejected.

    Attributes:
        estimate: the solution.
        chi_square: of what was used.
        lost: what the rejected measurements cost, at the gate each.
        rows: degrees of freedom, the rejected rows among them.
    """

    estimate: Estimate
    chi_square: ChiSquare
    lost: float
    rows: float

    @classmethod
    def of(cls, problem: Problem, estimate: Estimate) -> _Outcome | None:
        """None without chi-square."""
        if estimate.chi_square is None or not np.isfinite(estimate.chi_square.value):
            return None
        rejected = {f: int((~r.used).sum()) for f, r in estimate.residuals.items()}
        rows = sum(n * estimate.residuals[f].whitened.shape[1] for f, n in rejected.items())
        gate = problem.loss.gate if problem.loss else 0.0
        lost = gate**2 * sum(rejected.values())
        return cls(estimate, estimate.chi_square, lost, estimate.chi_square.dof + rows)

    @property
    def cost(self) -> float:
        """Chi-square, the rejected included."""
        return self.chi_square.value + self.lost

    @property
    def factor(self) -> float:
        """By what the noise stated would have to be multiplied for the recording to fit."""
        return float(np.sqrt(self.cost / max(self.rows, 1.0)))

    @property
    def fits(self) -> bool:
        """Whether chi-square lies within its interval without more than a few outliers rejected."""
        few = self.chi_square.dof > (1.0 - _OUTLIERS) * self.rows
        return few and self.chi_square.value <= Fit.of(0.0, self.chi_square.dof).high

    def spread(self, families: Sequence[str]) -> float:
        """Size of the families' residuals in units of what is expected, those rejected not forgotten."""
        of = [f for f in families if f in self.chi_square.families]
        value, dof = (sum(self.chi_square.families[f][i] for f in of) for i in range(2))
        rejected = [r for f, r in self.estimate.residuals.items() if f in of and not r.used.all()]
        typical = max((robust_sigma(r.whitened) for r in rejected), default=0.0)
        return max(float(np.sqrt(value / max(dof, 1.0))), typical)

    @property
    def imbalance(self) -> float:
        """How far the family that fits worst is from its expectation, in standard deviations."""
        fits = (Fit.of(value, dof) for value, dof in self.chi_square.families.values())
        return max((abs(fit.excess) for fit in fits if fit.dof >= 1.0), default=0.0)


def mostly_rejected(estimate: Estimate) -> bool:
    """Whether so much of a family was rejected that these can be no outliers."""
    many = (r.used for r in estimate.residuals.values() if len(r.used) >= _FEWEST_MEASUREMENTS)
    return any(float(used.mean()) < _FEWEST_USED for used in many)


def find_causes(method: Method, data: Any, config: Config, estimate: Estimate | None = None) -> tuple[Cause, ...]:
    """What makes a recording fit that does not, the likeliest first; empty when nothing that was tried does.

    Args:
        method: of the registry.
        data: what the method read.
        config: of the recording.
        estimate: its calibration, which tells where to look; by default the whole is tried.
    """
    problem = method.problem(data, config)
    suspects = _SUSPECTS[problem.method]
    if estimate is not None and estimate.solver == "batch" and not suspects.cut:
        before = _Outcome.of(problem, estimate)
    else:
        if estimate is not None and suspects.cut:
            data = cut(problem.method, data, *_worst_stretch(estimate.residuals, _STRETCH))
        before = _outcome(method, data, config)
    if before is None or (before.fits and not mostly_rejected(before.estimate)):
        return ()
    found: list[tuple[_Outcome, str]] = []
    for label, changed, changed_config in _screened(method, suspects, data, config, before):
        after = _outcome(method, changed, changed_config)
        if after is not None and _explains(before, after):
            found.append((after, _named(label, after)))
    found.sort(key=lambda each: each[0].factor)
    if any(after.fits for after, _ in found):
        found = [each for each in found if each[0].fits]
    elif not found:
        found = _noise(method, suspects, data, config, before)
    return tuple(Cause(label, _evidence(before, after)) for after, label in found[:_MOST_NAMED])


def cut(method: str, data: Any, start: float, stop: float) -> Any:
    """The data of [start, stop), s; times stay as they are."""
    changes: dict[str, Array] = {}
    for stamps, fields in _SUSPECTS[method].streams.items():
        time = getattr(data, stamps)
        if time is None:
            continue
        inside = (time >= start) & (time < stop)
        for name in (stamps, *fields):
            values = getattr(data, name)
            if values is not None:
                changes[name] = values[inside]
    return replace(data, **changes)


@dataclass(frozen=True)
class Halves:
    """A parameter from either half of a recording: values and sigmas, SI."""

    first: float
    first_sigma: float
    second: float
    second_sigma: float

    @property
    def difference_sigmas(self) -> float:
        """Second less first, over the sigma of that difference."""
        return (self.second - self.first) / float(np.hypot(self.first_sigma, self.second_sigma))


def split_halves(method: Method, data: Any, config: Config) -> dict[str, Halves]:
    """The parameters that each half of a recording tells by itself; none when a half cannot be solved.

    Those that a prior holds in either half are left out: they would agree whatever was recorded. A bias that walks
    differs between halves by its walk too.
    """
    name = method.problem(data, config).method
    times = [time for stamps in _SUSPECTS[name].streams if (time := getattr(data, stamps)) is not None]
    start, stop = min(t[0] for t in times), max(t[-1] for t in times)
    middle = 0.5 * (start + stop)
    first, second = (
        _outcome(method, cut(name, data, *span), config) for span in ((start, middle), (middle, stop + 1.0))
    )
    if first is None or second is None:
        return {}
    a, b = first.estimate, second.estimate
    found = {}
    for i, q in enumerate(method.problem(data, config).quantities):
        sigmas = float(a.sigmas[i]), float(b.sigmas[i])
        if 0.0 < max(sigmas) < _TOLD * q.scale:
            found[q.name] = Halves(float(a.values[i]), sigmas[0], float(b.values[i]), sigmas[1])
    return found


def held_out(problem: Problem) -> dict[str, float]:
    """Family -> typical size of measurements that took no part in the solution, in sigmas of their own noise.

    One chunk in five is held out. 1 is as good as the noise; a little more is the uncertainty of the prediction.
    """
    import gtsam

    from pipelines.solvers.batch import CHUNK, optimize, residuals_of

    if problem.loss is not None:
        problem.loss.mu = np.inf
    values = gtsam.Values()
    stand_ins: dict[int, int] = {}
    kept: list[Factor] = []
    out: list[Factor] = []
    for i, step in enumerate(problem.steps(CHUNK)):
        values.insert(step.initial)
        stand_ins.update(step.stand_ins)
        for f in step.factors:
            (out if f.measurement is not None and i % _HELD_OUT == _HELD_OUT - 1 else kept).append(f)
    if not any(f.measurement is not None for f in kept):
        return {}
    shared = [stand_ins.get(p.key, p.key) for p in problem.parameters]
    solution = optimize(kept, values, shared, problem.loss)
    if not solution.converged:
        return {}
    return {family: robust_sigma(r.whitened) for family, r in residuals_of(out, solution.values).items()}


def _outcome(method: Method, data: Any, config: Config) -> _Outcome | None:
    """The batch solution; None when there is none."""
    from pipelines.solvers.batch import solve_batch
    from pipelines.solvers.marginals import IndeterminateError

    try:
        problem = method.problem(data, config)
        return _Outcome.of(problem, solve_batch(problem))
    except (InputError, IndeterminateError):
        return None


def _screened(method: Method, suspects: _Suspects, data: Any, config: Config, before: _Outcome) -> list[_Trial]:
    """The changes worth a closer look, by the typical residual after a few iterations."""
    name = method.problem(data, config).method
    stretch = _worst_stretch(before.estimate.residuals, _SHORT) if suspects.cut else (-np.inf, np.inf)
    trials = [
        *_flips(suspects, data, config),
        *_turned(suspects, data, config),
        *_units(suspects, data, config),
        *_offset(method, suspects, data, config),
        *_tag_sizes(method, data, config),
    ]
    found = [_glance(method, cut(name, changed, *stretch), other) for _, changed, other in trials]
    enough = _PROMISING * _glance(method, cut(name, data, *stretch), config)
    return [trials[i] for i in np.argsort(found)[:_MOST_NAMED] if found[i] < enough]


def _glance(method: Method, data: Any, config: Config) -> float:
    """Typical residual of the measurements plus that of the processes near the least-squares solution, sigmas.

    Infinite when there is no solution.
    """
    import gtsam

    from pipelines.solvers.batch import CHUNK, optimize, residuals_of

    try:
        problem = method.problem(data, config)
    except InputError:
        return np.inf
    if problem.loss is not None:
        problem.loss.mu = 0.0
    steps = list(problem.steps(CHUNK))
    factors = [f for step in steps for f in step.factors]
    values = gtsam.Values()
    stand_ins: dict[int, int] = {}
    for step in steps:
        values.insert(step.initial)
        stand_ins.update(step.stand_ins)
    shared = [stand_ins.get(p.key, p.key) for p in problem.parameters]
    values = optimize(factors, values, shared, None, _GLANCE, _GLANCE_DAMPING).values
    measured = np.concatenate([np.abs(r.whitened).ravel() for r in residuals_of(factors, values).values()])
    processes = [f.factor for f in factors if f.measurement is None and f.family not in ("prior", "definition")]
    sizes = [np.sqrt(2.0 * f.error(values) / f.dim()) for f in processes]
    return float(np.median(measured) + (np.median(sizes) if sizes else 0.0))


def _worst_stretch(residuals: Mapping[str, Residuals], length: float) -> tuple[float, float]:
    """Of the residuals' time, the stretch with the largest sum of squares, rejected ones counted in full."""
    time = np.concatenate([r.time for r in residuals.values()])
    square = np.concatenate([(r.whitened**2).sum(axis=1) for r in residuals.values()])
    order = np.argsort(time, kind="stable")
    time, total = time[order], np.append(0.0, np.cumsum(square[order]))
    ends = np.searchsorted(time, time + length)
    first = int(np.argmax(total[ends] - total[: len(time)]))
    start = max(min(time[first], time[-1] - length), time[0])
    return float(start) - 0.1, float(start) + length + 0.1


def _flips(suspects: _Suspects, data: Any, config: Config) -> Iterator[_Trial]:
    """Every choice of opposite signs of a sensor's axes."""
    for name, (sensor, columns) in suspects.signs.items():
        values = getattr(data, name)
        if values is None:
            continue
        for signs in product((1.0, -1.0), repeat=len(columns)):
            wrong = [column for column, sign in zip(columns, signs, strict=True) if sign < 0.0]
            if wrong:
                axes = " and ".join(wrong)
                label = f"the sign of the {sensor}'s {axes} is wrong"
                factor = np.array(signs) if values.ndim > 1 else signs[0]
                yield label, replace(data, **{name: factor * values}), config


def _turned(suspects: _Suspects, data: Any, config: Config) -> Iterator[_Trial]:
    """Axes of a sensor in another order: two of them swapped, or turned by a right angle about the third."""
    for name, (sensor, columns) in suspects.signs.items():
        values = getattr(data, name)
        if values is None or len(columns) < 3:
            continue
        for i, j in combinations(range(3), 2):
            swapped = np.eye(3)
            swapped[[i, j]] = swapped[[j, i]]
            third = columns[3 - i - j]
            labels = {
                f"the {sensor}'s {columns[i]} and {columns[j]} are swapped": np.ones(3),
                f"the {sensor} is turned by 90 deg about its {third}": np.where(np.arange(3) == i, -1.0, 1.0),
                f"the {sensor} is turned by 90 deg the other way about its {third}": np.where(
                    np.arange(3) == j, -1.0, 1.0
                ),
            }
            for label, signs in labels.items():
                yield label, replace(data, **{name: values @ swapped * signs}), config


def _units(suspects: _Suspects, data: Any, config: Config) -> Iterator[_Trial]:
    """Rates in degrees a second, or turned into radians twice."""
    for name, (sensor, _) in suspects.signs.items():
        values = getattr(data, name)
        if values is not None and "gyro" in name:
            yield f"the {sensor} is in deg/s, not rad/s", replace(data, **{name: np.deg2rad(values)}), config
            yield (
                f"the {sensor} was turned from deg/s to rad/s twice",
                replace(data, **{name: np.rad2deg(values)}),
                config,
            )


def _offset(method: Method, suspects: _Suspects, data: Any, config: Config) -> Iterator[_Trial]:
    """The time offset as a parameter, or the stamps that may be late moved to where residuals are smallest."""
    if suspects.offset:
        free = config.model_copy(update={"priors": {**config.priors, _OFFSET: _OFFSET_PRIOR}})
        yield "a time offset of {time_offset} is taken for known", data, free
    if suspects.clock is None:
        return
    stamps, source = suspects.clock

    def moved(shift: float) -> tuple[Any, Config]:
        return replace(data, **{stamps: getattr(data, stamps) + shift}), config

    def cost(shift: float) -> float:
        outcome = _outcome(method, *moved(shift))
        return outcome.cost if outcome else np.inf

    shift = _lowest(cost, _FIRST_SHIFT)
    if shift is not None:
        side = "early" if shift > 0.0 else "late"
        yield f"the stamps of the {source} are {1e3 * abs(shift):.3g} ms too {side}", *moved(shift)


def _tag_sizes(method: Method, data: Any, config: Config) -> Iterator[_Trial]:
    """All tags of the cube larger or smaller, to where residuals are smallest."""
    if not config.cube.tags:
        return

    def scaled(more: float) -> tuple[Any, Config]:
        tags = {i: tag.model_copy(update={"size": (1.0 + more) * tag.size}) for i, tag in config.cube.tags.items()}
        return data, config.model_copy(update={"cube": config.cube.model_copy(update={"tags": tags})})

    # Not chi-square, which levels off where most tags are rejected.
    more = _lowest(lambda more: _glance(method, *scaled(more)) ** 2, _FIRST_SCALING)
    if more is not None:
        yield f"the tags are {1.0 + more:.3g} times as large as the config says", *scaled(more)


def _lowest(cost: Callable[[float], float], step: float) -> float | None:
    """The size of a change that costs least; None when there is none.

    From the best so far a step to either side, and to the bottom of the parabola through the three.
    """
    known, best = {0.0: cost(0.0)}, 0.0
    for _ in range(_PARABOLAS):
        sides = best - step, best + step
        known |= {size: cost(size) for size in sides if size not in known}
        left, middle, right = known[sides[0]], known[best], known[sides[1]]
        bend = left - 2.0 * middle + right
        if not np.isfinite(bend):
            return None
        if bend > 0.0:
            bottom = best + float(np.clip(0.5 * step * (left - right) / bend, -5.0 * step, 5.0 * step))
            known[bottom] = cost(bottom)
        best = min(known, key=known.__getitem__)
        if best not in sides:
            step *= 0.2
    return best


def _named(label: str, after: _Outcome) -> str:
    if "{" not in label:
        return label
    i = after.estimate.names.index(_OFFSET)
    value, sigma = 1e3 * after.estimate.values[i], 1e3 * after.estimate.sigmas[i]
    return label.format(time_offset=f"{value:.3g} ± {sigma:.2g} ms")


def _explains(before: _Outcome, after: _Outcome) -> bool:
    """Whether a change makes chi-square fall by far more than chance and to (nearly) what it should be."""
    fall = (before.cost - after.cost) / max(after.factor, 1.0) ** 2
    return fall > _SIGNIFICANT**2 and (after.fits or after.factor < _BETTER * before.factor)


def _evidence(before: _Outcome, after: _Outcome) -> str:
    fits = "and fits" if after.fits else "and still does not fit"
    return (
        f"with that changed chi-square falls from {before.cost:.4g} to {after.cost:.4g} for {after.rows:.4g} degrees "
        f"of freedom {fits}"
    )


def _noise(
    method: Method, suspects: _Suspects, data: Any, config: Config, before: _Outcome
) -> list[tuple[_Outcome, str]]:
    """The one noise that, stated larger, balances all families best; nothing when none brings chi-square to fit."""
    found = []
    for key in suspects.noise:
        scaled = _scaled_to_fit(method, suspects, data, config, key, before)
        if scaled is not None and scaled[1] > _NOTABLE:
            found.append((scaled[0], f"the noise {key} is stated {scaled[1]:.2g} times too small"))
    return sorted(found, key=lambda each: each[0].imbalance)[:1]


def _scaled_to_fit(
    method: Method, suspects: _Suspects, data: Any, config: Config, key: str, before: _Outcome
) -> tuple[_Outcome, float] | None:
    """The solution with a noise multiplied so that its families' chi-square is the expected one, and the factor.

    Variance component estimation, as Foerstner has it (1979).
    """
    families = suspects.noise[key][1]
    factor, after = 1.0, before
    for _ in range(_NOISE_STEPS):
        step = after.spread(families)
        if abs(step - 1.0) < _NOISE_ACCURACY:
            break
        factor *= step
        found = _outcome(method, *_with_noise(suspects, data, config, key, factor))
        if found is None:
            return None
        after = found
    return (after, factor) if after.fits else None


def _with_noise(suspects: _Suspects, data: Any, config: Config, key: str, factor: float) -> tuple[Any, Config]:
    """Data and config with a noise multiplied, wherever it is stated."""
    source = suspects.noise[key][0]
    own = None if source is None else getattr(data, source)
    if source is not None and own is not None:
        data = replace(data, **{source: own * factor ** (1 if isinstance(own, float) else 2)})
    given = getattr(config.noise, key)
    if given is None and own is None:
        given = getattr(DEFAULT_NOISE, key)
    if given is not None:
        config = config.model_copy(update={"noise": config.noise.model_copy(update={key: given * factor})})
    return data, config
