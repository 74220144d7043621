"""Several recordings of one device in one graph, the long way: what joint and recursive estimates have to equal."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from alidade.factors.bridge import BoundModel
from alidade.pipelines.estimation.problem import Factor, Parameter, Problem, Step
from alidade.pipelines.solvers.engines import ALL, Compiled
from alidade.pipelines.solvers.levenberg import LevenbergConfig, minimize
from alidade.pipelines.solvers.posterior import Reported
from benchmarks.batch import solve as minimum

# Indices of one recording's variables stay below this.
_APART = 10_000_000


def one_graph(problems: Sequence[Problem], shared: Collection[str]) -> Problem:
    """The problems on the same variables where these hold shared parameters alone; of the others each has its own.

    Parameters of the second recording are called `name@1`.
    """
    same = {p.key for p in problems[0].parameters if all(q.name in shared for q in p.quantities)}
    wholes = [_whole(problem) for problem in problems]

    def steps(_: int) -> Iterator[Step]:
        step = Step(time=1.0)
        for i, whole in enumerate(wholes):
            for f in whole.factors:
                common = f.family == "prior" and same.issuperset(f.factor.keys())
                if i == 0 or not common:
                    step.factors.append(_moved(f, same, i))
            for key in whole.initial.keys():
                if i == 0 or key not in same:
                    _copy(whole.initial, key, _key(key, same, i), step.initial)
            step.current_keys.update({_key(a, same, i): _key(b, same, i) for a, b in whole.current_keys.items()})
        yield step

    parameters = [_renamed(p, same, i) for i, problem in enumerate(problems) for p in problem.parameters]
    kept = {p.key: p for p in reversed(parameters)}
    # Noise as stated, that beside other noise included.
    noises = tuple(replace(n, noise=replace(n.noise, known=0.0), least=None) for n in problems[0].noises)
    return replace(
        problems[0], parameters=tuple(kept.values()), steps=steps, attitudes=None, noises=noises, refined_graph=None
    )


def _whole(problem: Problem) -> Step:
    """All steps as one."""
    whole = Step(time=0.0)
    for step in problem.steps(ALL):
        whole.factors.extend(step.factors)
        whole.initial.insert(step.initial)
        whole.current_keys.update(step.current_keys)
    return whole


def _key(key: int, same: Collection[int], i: int) -> int:
    return key if key in same else key + i * _APART


def _renamed(parameter: Parameter, same: Collection[int], i: int) -> Parameter:
    if i == 0 or parameter.key in same:
        return parameter
    quantities = tuple(replace(q, name=f"{q.name}@{i}") for q in parameter.quantities)
    return replace(parameter, key=_key(parameter.key, same, i), quantities=quantities)


def _moved(factor: Factor, same: Collection[int], i: int) -> Factor:
    own = factor.bound
    if own is None:
        moves = [_key(k, same, i) for k in factor.factor.keys()]
        return Factor(factor.family, factor.factor.rekey(moves))
    tied = [_key(c, same, i) if isinstance(c, int) else [_key(k, same, i) for k in c] for c in own.columns]
    moved = BoundModel(own.model, tied, own.loss, weights=own.weights)
    of = Factor.process_of if factor.measurement is None else Factor.of
    return of(factor.family, moved, factor.beside)


def _copy(values: gtsam.Values, key: int, to: int, out: gtsam.Values) -> None:
    try:
        out.insert(to, values.atRot3(key))
    except RuntimeError:
        out.insert(to, values.atVector(key))


def solved(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Values and sigmas by name of the problem's solution, steps made until nothing is left of them."""
    compiled = Compiled.of(problem)
    found = minimum(compiled)
    found = minimize(found.engine, found.values, LevenbergConfig(cost_tolerance=1e-14))
    reported = Reported.of(compiled, found.values)
    covariance = reported.covariance(reported.root(found.factorization.root).covariance())
    numbers, sigmas = reported.numbers.tolist(), np.sqrt(np.diag(covariance)).tolist()
    return dict(zip(reported.names, numbers, strict=True)), dict(zip(reported.names, sigmas, strict=True))
