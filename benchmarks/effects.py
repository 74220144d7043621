"""A sweep over what sensors may be off: python -m benchmarks.effects METHOD [--only EFFECT ...] [--seeds N] ...

Every assumption of a method in turn, from a third of its prior to ten times that, with a random sign for each of its
numbers, and nothing at all; what the calibration's status was, how far the worst of the parameters that matter was off
in its sigmas and in what is required of it, what the headline named first, and whether something was said to change.
`several` draws three to six effects at once from their priors, with rates, duration, grade, motion and mounts. `every`
draws all of them: the sigmas cover every prior, so only there do the errors have a Gaussian's shares.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from alidade.factors import so3
from alidade.pipelines import deadline, methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import kind

NOTHING, SEVERAL, EVERY = "nothing", "several", "every"
DRAWN = (SEVERAL, EVERY)
SIZES = (0.3, 1.0, 3.0, 6.0, 10.0)
# Errors beyond the first are wrong, up to the second and half of what is required right.
WRONG, RIGHT = 4.0, 3.0
# Of a calibration, s: so long that the load of the machine seldom matters.
LIMIT_S = 300.0
# Ranges, even in the logarithm, of the settings that `several` and `every` draw where a simulator has them.
RANGES = {
    "duration_s": (15.0, 3600.0),
    "gyro_rate_hz": (25.0, 1000.0),
    "platform_gyro_rate_hz": (25.0, 400.0),
    "imu_rate_hz": (25.0, 400.0),
    "vision_rate_hz": (5.0, 50.0),
    "image_rate_hz": (5.0, 50.0),
    "gimbal_rate_hz": (20.0, 400.0),
    "encoder_rate_hz": (20.0, 400.0),
    "rate_deg_s": (5.0, 40.0),
    "static_s": (1.2, 5.0),
    "poses": (12.0, 30.0),
    "attitudes": (12.0, 60.0),
    "turn_rad_s": (0.6, 1.6),
}
# Noise of three grades, times that of the simulator.
GRADES = (0.3, 1.0, 3.0)
# Amplitudes, deg, of the swings of each axis, by what swings; rotations, deg, by what is mounted: None is anywhere.
SWINGS = {"head": (5.0, 35.0), "platform": (5.0, 15.0), "carrier": (2.0, 8.0)}
OPTIONAL = ("accelerometer", "gyro", "temperature")
MOUNTS = {"helmet_mount_deg": None, "camera_mount_deg": None, "angles_deg": 5.7, "mounting_deg": 0.5}
# From so many times its prior on an assumption that the recording determines is to be named.
NAMED_FROM = 6.0


@dataclass(frozen=True)
class Case:
    """One recording to be simulated and solved."""

    method: str
    scenario: str | None
    solver: str
    effect: str
    size: float
    seed: int


@dataclass(frozen=True)
class Found:
    """What came out.

    Attributes:
        case: of which.
        status: of the calibration; "refused" where there is none.
        sigmas: the largest error of a parameter that is no assumption, in its sigmas.
        required: likewise, in what is required.
        determined: whether the recording told a number of the effect to better than half of its prior.
        changed: whether something was said to have changed over the recording.
        named: whether the first sentence of the headline names the effect, alone or with what it cannot be told from.
        headline: whole.
        errors: in sigmas, of every parameter that is no assumption and has a requirement.
    """

    case: Case
    status: str
    sigmas: float
    required: float
    determined: bool
    changed: bool
    named: bool
    headline: str
    errors: tuple[float, ...] = ()


def effects(method: str, scenario: str | None, drawn: Mapping[str, Any] | None = None) -> dict[str, dict[str, float]]:
    """Effect -> the parameters it consists of, with their priors; `drawn` are settings on top of the scenario's.

    A simulator that draws all effects itself has none to be set: `several` varies them.
    """
    found: dict[str, dict[str, float]] = {NOTHING: {}}
    if not hasattr(methods.method(method).settings(scenario), "effects"):
        return found
    session = _simulated(method, scenario, drawn or {}, 0)
    for q in session.problem().quantities:
        if q.group == "assumption" and q.prior_sigma:
            found.setdefault(kind(q.name), {})[q.name] = q.prior_sigma
    return found


def _simulated(method: str, scenario: str | None, drawn: Mapping[str, Any], seed: int) -> Session:
    """Session of a recording simulated by a scenario with some settings drawn."""
    chosen = methods.method(method)
    settings = chosen.settings(scenario)
    return Session.of(chosen, chosen.simulate(type(settings).model_validate(settings.model_dump() | drawn), seed))


def several(case: Case) -> tuple[dict[str, Any], dict[str, float]]:
    """Settings drawn for the seed of a case, its effects among them, and the numbers of these with their priors."""
    rng = np.random.default_rng([case.seed, 5])
    settings = methods.method(case.method).settings(case.scenario)
    drawn: dict[str, Any] = {"priors": {}}
    for name, value in settings:
        if name in RANGES and isinstance(value, int | float):
            number = float(np.exp(rng.uniform(*np.log(RANGES[name]))))
            drawn[name] = round(number) if isinstance(value, int) else number
        elif name == "noise":
            grade = GRADES[case.seed % len(GRADES)]
            drawn[name] = {key: grade * level for key, level in value.model_dump().items()}
        elif name in SWINGS:
            if value is not None or rng.random() < 0.7:
                drawn[name] = {axis: _swings(rng, SWINGS[name]) for axis in ("yaw", "pitch", "roll")}
        elif name in OPTIONAL and value is None and rng.random() < 0.5:
            drawn[name] = {}
        elif name in MOUNTS:
            drawn[name] = _mounted(rng, MOUNTS[name], value)
    if "camera_mount_deg" in drawn and not drawn.get("platform"):
        del drawn["camera_mount_deg"]  # it is not estimated there
    if not hasattr(settings, "effects"):
        return drawn, {}  # its simulator draws them all
    known = effects(case.method, case.scenario, drawn)
    kinds = sorted(known.keys() - {NOTHING})
    count = len(kinds) if case.effect == EVERY else min(len(kinds), int(rng.integers(3, 7)))
    chosen = rng.choice(kinds, count, replace=False)
    numbers = {name: prior for one in chosen for name, prior in known[str(one)].items()}
    drawn["effects"] = {name: float(case.size * p * rng.standard_normal()) for name, p in numbers.items()}
    return drawn, numbers


def _swings(rng: np.random.Generator, amplitude: tuple[float, float]) -> list[dict[str, float]]:
    """Two swings of an axis."""
    return [
        {
            "amplitude_deg": float(rng.uniform(*amplitude)),
            "frequency_hz": float(np.exp(rng.uniform(np.log(0.08), np.log(0.8)))),
            "phase_deg": float(rng.uniform(0.0, 360.0)),
        }
        for _ in range(2)
    ]


def _mounted(rng: np.random.Generator, sigma: float | None, value: Any) -> Any:
    """Angles about those that a setting has, deg; anywhere without a sigma."""
    if sigma is None:
        return np.rad2deg(so3.log(so3.normalize(rng.standard_normal(4)))).tolist()
    if isinstance(value, tuple):
        return [float(x) for x in sigma * rng.standard_normal(len(value))]
    return {name: float(sigma * rng.standard_normal()) for name in type(value).model_fields}


def run(case: Case, numbers: Mapping[str, float]) -> Found:
    """Simulate and solve one recording."""
    if case.effect in DRAWN:
        drawn, numbers = several(case)
    else:
        signs = np.random.default_rng([case.seed, 2]).choice([-1.0, 1.0], len(numbers))
        effect = {n: float(s * case.size * p) for s, (n, p) in zip(signs, numbers.items(), strict=True)}
        drawn = {"effects": effect} if effect else {}
    try:
        with deadline.within(LIMIT_S):
            calibration = _simulated(case.method, case.scenario, drawn, case.seed).calibrate(case.solver)
    except InputError as error:
        return Found(case, "refused", 0.0, 0.0, False, False, False, str(error))
    truth = calibration.truth or {}
    parameters = calibration.parameters
    off = [
        (error / p.sigma, error / p.require)
        for name, p in parameters.items()
        if p.group is None and p.require and name in truth and p.sigma > 0.0
        for error in [p.value - float(str(truth[name]))]
    ]
    told = [parameters[name].sigma < 0.5 * prior for name, prior in numbers.items() if name in parameters]
    headline = calibration.headline
    first = headline.split(". ")[0]
    return Found(
        case,
        calibration.status,
        max((abs(sigmas) for sigmas, _ in off), default=0.0),
        max((abs(required) for _, required in off), default=0.0),
        any(told),
        calibration.stability is not None and calibration.stability.changed,
        any(name in first for name in numbers),
        headline,
        tuple(round(sigmas, 2) for sigmas, _ in off),
    )


def report(found: Sequence[Found]) -> Iterator[str]:
    """The figures, a table by effect and size and their sums."""
    yield "| effect | size | calibrated | weak | inconsistent | refused | worst, sigmas | if calibrated | named first |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    for effect, size in dict.fromkeys((f.case.effect, f.case.size) for f in found):
        of = [f for f in found if (f.case.effect, f.case.size) == (effect, size)]
        count = {s: sum(f.status == s for f in of) for s in ("calibrated", "weak", "inconsistent", "refused")}
        trusted = max((f.sigmas for f in of if f.status == "calibrated"), default=0.0)
        yield (
            f"| {effect} | {size:g} | {' | '.join(str(n) for n in count.values())} | "
            f"{max(f.sigmas for f in of):.1f} | {trusted:.1f} | {sum(f.named for f in of)} |"
        )
    within = [f for f in found if f.case.size <= 1.0]
    wrong = [f for f in found if f.status == "calibrated" and f.sigmas > WRONG]
    far = [f for f in found if f.case.size >= NAMED_FROM and f.determined]
    harmful = [f for f in wrong if f.required > 1.0]
    # What is far beyond its prior is to be told, however right the rest.
    right = [f for f in within if f.sigmas < RIGHT and f.required < 0.5]
    yield ""
    yield (
        f"calibrated beyond {WRONG:g} sigmas: {len(wrong)} of {len(found)}, within the priors "
        f"{sum(f in wrong for f in within)} of {len(within)}, beyond what is required {len(harmful)}"
    )
    yield f"named first from {NAMED_FROM:g} times the prior on, where told: {sum(f.named for f in far)} of {len(far)}"
    refused = sum(f.status == "inconsistent" for f in right)
    changed = [f.changed for f in found if f.case.effect == NOTHING]
    if changed:
        yield f"without any effect said to have changed: {sum(changed)} of {len(changed)}"
    yield f"within the priors inconsistent although right: {refused} of {len(right)}"
    for effect in DRAWN:
        errors = np.abs([error for f in found if f.case.effect == effect for error in f.errors])
        if not errors.size:
            continue
        shares = ", ".join(f"{np.mean(errors < sigmas):.3f}" for sigmas in (1.0, 2.0, 3.0))
        yield f"{effect}: within 1, 2, 3 sigmas {shares} of {errors.size} errors"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sweep of one method; what FILE already has is not run again."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.effects", description=__doc__.split("\n\n")[1])
    parser.add_argument("method")
    parser.add_argument("--scenario", help="default: the nominal one")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="EFFECT",
        help=f"default: all; {NOTHING}: sensors as they should be; {SEVERAL}; {EVERY}",
    )
    parser.add_argument("--solver", default="batch", choices=("batch", "incremental"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, metavar="FILE", help="where to write what came out, a line each (JSON)")
    options = parser.parse_args(arguments)
    swept = effects(options.method, options.scenario)
    cases = [
        Case(options.method, options.scenario, options.solver, effect, size, seed)
        for effect in options.only or swept
        for size, seed in product(
            {NOTHING: (0.0,), **dict.fromkeys(DRAWN, (1.0,))}.get(effect, SIZES), range(options.seeds)
        )
    ]
    done = {} if options.out is None else {f.case: f for f in _read(options.out)}
    left = [case for case in cases if case not in done]
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as processes:
        for each in processes.map(run, left, [swept.get(case.effect, {}) for case in left]):
            done[each.case] = each
            if options.out is not None:
                with options.out.open("a") as lines:
                    lines.write(json.dumps(asdict(each)) + "\n")
    print("\n".join(report([done[case] for case in cases])))
    return 0


def _read(path: Path) -> list[Found]:
    """What was found before, if anything."""
    if not path.exists():
        return []
    rows = (json.loads(line) for line in path.read_text().splitlines())
    return [Found(**row | {"case": Case(**row["case"]), "errors": tuple(row.get("errors", ()))}) for row in rows]


if __name__ == "__main__":
    sys.exit(main())
