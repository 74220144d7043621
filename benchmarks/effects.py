"""A sweep over what sensors may be off: python -m benchmarks.effects METHOD [--only EFFECT ...] [--seeds N] ...

Every assumption of a method in turn, from a third of its prior to ten times that, with a random sign for each of its
numbers, and nothing at all; what the calibration's status was, how far the worst of the parameters that matter was off
in its sigmas and in what is required of it, what the headline named first, and whether something was said to change.
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

import numpy as np

from alidade.pipelines import methods
from alidade.pipelines.applications.session import Session
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.parameters import kind

NOTHING = "nothing"
SIZES = (0.3, 1.0, 3.0, 6.0, 10.0)
# Errors beyond the first are wrong, up to the second and half of what is required right.
WRONG, RIGHT = 4.0, 3.0
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
    """

    case: Case
    status: str
    sigmas: float
    required: float
    determined: bool
    changed: bool
    named: bool
    headline: str


def effects(method: str, scenario: str | None) -> dict[str, dict[str, float]]:
    """Effect -> the parameters it consists of, with their priors."""
    chosen = methods.method(method)
    session = Session.of(chosen, chosen.simulate(chosen.settings(scenario), 0))
    found: dict[str, dict[str, float]] = {NOTHING: {}}
    for q in session.problem().quantities:
        if q.group == "assumption" and q.prior_sigma:
            found.setdefault(kind(q.name), {})[q.name] = q.prior_sigma
    return found


def run(case: Case, numbers: Mapping[str, float]) -> Found:
    """Simulate and solve one recording."""
    chosen = methods.method(case.method)
    signs = np.random.default_rng([case.seed, 2]).choice([-1.0, 1.0], len(numbers))
    values = {name: float(s * case.size * p) for s, (name, p) in zip(signs, numbers.items(), strict=True)}
    settings = chosen.settings(case.scenario)
    settings = type(settings).model_validate(settings.model_dump() | {"effects": values})
    try:
        calibration = Session.of(chosen, chosen.simulate(settings, case.seed)).calibrate(case.solver)
    except InputError as error:
        return Found(case, "refused", 0.0, 0.0, False, False, False, str(error))
    truth = calibration.truth or {}
    parameters = calibration.parameters
    off = [
        (abs(p.value - float(str(truth[name]))) / p.sigma, abs(p.value - float(str(truth[name]))) / p.require)
        for name, p in parameters.items()
        if p.group is None and p.require and name in truth and p.sigma > 0.0
    ]
    told = [parameters[name].sigma < 0.5 * prior for name, prior in numbers.items() if name in parameters]
    headline = calibration.headline
    first = headline.split(". ")[0]
    return Found(
        case,
        calibration.status,
        max((sigmas for sigmas, _ in off), default=0.0),
        max((required for _, required in off), default=0.0),
        any(told),
        calibration.stability is not None and calibration.stability.changed,
        any(name in first for name in numbers),
        headline,
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the sweep of one method; what FILE already has is not run again."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.effects", description=__doc__.split("\n\n")[1])
    parser.add_argument("method")
    parser.add_argument("--scenario", help="default: the nominal one")
    parser.add_argument(
        "--only", nargs="+", metavar="EFFECT", help=f"default: all; {NOTHING}: sensors as they should be"
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
        for size, seed in product((0.0,) if effect == NOTHING else SIZES, range(options.seeds))
    ]
    done = {} if options.out is None else {f.case: f for f in _read(options.out)}
    left = [case for case in cases if case not in done]
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as processes:
        for each in processes.map(run, left, [swept[case.effect] for case in left]):
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
    return [Found(**row | {"case": Case(**row["case"])}) for row in rows]


if __name__ == "__main__":
    sys.exit(main())
