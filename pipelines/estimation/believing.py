"""Beliefs in place of a graph's own priors.

A belief is about reported numbers, and so is its factor. The method's own priors lose the rows that are about nothing
but numbers that are believed; rows that tie these to others stay.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.pipelines.belief import Belief, root_of_information
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.priors import pinned
from alidade.pipelines.estimation.problem import Array, Factor, Parameter, Problem, Quantity, Step

# Elements of a prior's row below this share of its largest are rounding.
_ROUNDING = 1e-9
# First values farther from what is believed than this, in sigmas, are moved there, in so many steps.
_APART, _MOVES = 3.0, 5
# In units of a number's usual prior: means and sigmas beyond, sigmas below and not 0, and combinations of numbers known
# so much better than these themselves are slips, by which no linear system in double precision can be solved.
_FARTHEST, _LEAST_SIGMA, _LEAST_CORRELATED = 1e6, 1e-10, 1e-12


def believing(problem: Problem, beliefs: Sequence[Belief]) -> Problem:
    """The problem with beliefs in place of its priors of the same numbers.

    A number that the problem fixes stays fixed unless the belief is the config's own, and what is believed of others
    follows from that.

    Raises:
        InputError: a number is to be fixed elsewhere than at 0 that the graph leaves out where it is fixed.
    """
    for belief in beliefs:
        problem = _believing(problem, belief)
    return problem


def about(factor: gtsam.GaussianFactor, parameters: Sequence[Parameter], values: gtsam.Values) -> NDArray[np.bool_]:
    """(m, n) which rows of a linearised prior are about which of the parameters' reported numbers."""
    A, _ = factor.jacobian()
    inverses = {p.key: np.linalg.pinv(p.coordinates(values, p.key)[1]) for p in parameters if p.key in factor.keys()}
    columns, start = {}, 0
    for key in factor.keys():
        stop = start + len(inverses[key])
        columns[key] = slice(start, stop)
        start = stop
    parts = [
        np.abs(A[:, columns[p.key]] @ inverses[p.key]) if p.key in columns else np.zeros((len(A), len(p.quantities)))
        for p in parameters
    ]
    # In units of the priors: angles, rates and seconds stand side by side.
    size = np.hstack(parts) * [q.prior_scale for p in parameters for q in p.quantities]
    return np.asarray(size > _ROUNDING * size.max(axis=1, keepdims=True, initial=0.0))


def about_alone(
    factor: gtsam.GaussianFactor, parameters: Sequence[Parameter], values: gtsam.Values, names: Collection[str]
) -> NDArray[np.bool_]:
    """(m,) which rows of a linearised prior are about some of these numbers and no others, but for fixed ones."""
    quantities = [q for p in parameters for q in p.quantities]
    among = np.array([q.name in names for q in quantities])
    others = np.array([q.name not in names and q.prior_sigma != 0.0 for q in quantities])
    rows = about(factor, parameters, values)
    return np.asarray((rows & among).any(axis=1) & ~(rows & others).any(axis=1))


def _believing(problem: Problem, belief: Belief) -> Problem:
    own = {q.name: q for q in problem.quantities}
    for name, mean, sigma in zip(belief.names, belief.mean, belief.sigmas, strict=True):
        if name not in own and sigma == 0.0 and mean != 0.0:
            raise InputError(
                f"priors.{name}: where it is fixed it is left out of the graph, which takes it for 0; give it a sigma"
            )
    known, by_hand = belief.of(own), not belief.source
    _require_sense(known, own)
    replaced = frozenset(name for name in known.names if by_hand or own[name].prior_sigma != 0.0)
    if not replaced:
        return problem
    believed = {
        name: replace(own[name], prior_mean=float(mean), prior_sigma=float(sigma))
        for name, mean, sigma in zip(known.names, known.mean, known.sigmas, strict=True)
        if name in replaced
    }
    means = dict(zip(known.names, known.mean.tolist(), strict=True))
    parameters = tuple(
        replace(p, quantities=tuple(believed.get(q.name, q) for q in p.quantities)).near(means)
        for p in problem.parameters
    )
    told = _Told(parameters, known, replaced)
    steps, after, onward = problem.steps, problem.steps_after, problem.onward
    premise = f"The prior of {len(replaced)} parameters is {belief.source}." if belief.source else ""
    return replace(
        problem,
        parameters=parameters,
        steps=lambda chunk: told.steps(steps(chunk)),
        steps_after=None if after is None else lambda time: told.steps(after(time)),
        onward=None if onward is None else lambda data, time: _grown(onward(data, time), belief),
        premises=(*problem.premises, *filter(None, [premise])),
    )


def _require_sense(belief: Belief, own: Mapping[str, Quantity]) -> None:
    """Raise InputError for a mean, a sigma or a covariance of which no solution can be made."""
    where = belief.source or "priors"
    for name, mean, sigma in zip(belief.names, belief.mean, belief.sigmas, strict=True):
        scale, unit = own[name].prior_scale, own[name].unit
        if not (abs(mean) <= _FARTHEST * scale and sigma <= _FARTHEST * scale):
            raise InputError(
                f"{where}: {name}: {mean:g} ± {sigma:g} {unit} is far from anything it can be; units are SI"
            )
        if 0.0 < sigma < _LEAST_SIGMA * scale:
            raise InputError(f"{where}: {name}: a sigma of {sigma:g} {unit} is less than any; 0 fixes it")
    sigmas = belief.sigmas
    free = sigmas > 0.0
    correlation = belief.covariance[np.ix_(free, free)] / np.outer(sigmas[free], sigmas[free])
    if np.linalg.eigvalsh(correlation).min(initial=1.0) < _LEAST_CORRELATED:
        raise InputError(f"{where}: the covariance is singular: a combination of its numbers is known exactly")


def _grown(problem: Problem | None, belief: Belief) -> Problem | None:
    return None if problem is None else _believing(problem, belief)


@dataclass(frozen=True, eq=False)
class _Told:
    """A belief as a factor, and the step that takes it.

    Attributes:
        parameters: of the problem, with the priors now in force.
        belief: about some of their numbers.
        replaced: those of them that have no other prior.
    """

    parameters: Sequence[Parameter]
    belief: Belief
    replaced: Collection[str]

    def steps(self, steps: Iterable[Step]) -> Iterator[Step]:
        """The steps, the one with the parameters changed."""
        concerned = [p for p in self.parameters if any(q.name in self.belief.names for q in p.quantities)]
        for step in steps:
            begins = all(step.initial.exists(p.key) for p in concerned)
            yield self._begun(step, concerned) if begins else step

    def _begun(self, step: Step, concerned: Sequence[Parameter]) -> Step:
        keys = {p.key for p in self.parameters}
        factors: list[Factor] = []
        for f in step.factors:
            if f.family == "prior" and keys.issuperset(f.factor.keys()):
                factors += self._rest(f, step.initial)
            else:
                factors.append(f)
        initial = gtsam.Values(step.initial)
        for p in concerned:
            self._move(p, initial)
        return replace(step, factors=[*factors, self._factor(concerned)], initial=initial)

    def _rest(self, prior: Factor, values: gtsam.Values) -> list[Factor]:
        """What of a prior is not replaced."""
        kept = ~about_alone(prior.factor.linearize(values), self.parameters, values, self.replaced)
        if kept.all():
            return [prior]
        return [Factor("prior", _rows_of(prior.factor, np.flatnonzero(kept), values))] if kept.any() else []

    def _move(self, parameter: Parameter, values: gtsam.Values) -> None:
        """Take a first value that contradicts the belief to its mean."""
        rows, places = self._places(parameter)
        mean, sigmas = self.belief.mean[places], self.belief.sigmas[places]
        for _ in range(_MOVES):
            numbers, J = parameter.coordinates(values, parameter.key)
            if not (np.abs(mean - numbers[rows]) > _APART * sigmas).any():
                return
            wanted = np.zeros(len(numbers))
            wanted[rows] = mean - numbers[rows]
            move = gtsam.VectorValues()
            move.insert(parameter.key, np.linalg.pinv(J) @ wanted)
            values.update(values.retract(move))

    def _places(self, parameter: Parameter) -> tuple[list[int], list[int]]:
        """Which of a parameter's numbers are believed, and where in the belief they are."""
        names = [q.name for q in parameter.quantities]
        rows = [i for i, name in enumerate(names) if name in self.belief.names]
        return rows, [self.belief.names.index(names[i]) for i in rows]

    def _factor(self, concerned: Sequence[Parameter]) -> Factor:
        """The belief, whitened."""
        places = [self._places(p) for p in concerned]
        order = [place for _, own in places for place in own]
        quantities = {q.name: q for p in concerned for q in p.quantities}
        root = _square_root(self.belief, [quantities[name] for name in self.belief.names])[:, order]
        mean = self.belief.mean[order]

        def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
            numbers, start = [], 0
            for i, (p, (rows, _own)) in enumerate(zip(concerned, places, strict=True)):
                reported, J = p.coordinates(values, p.key)
                stop = start + len(rows)
                numbers.append(reported[rows])
                if jacobians is not None:
                    jacobians[i] = root[:, start:stop] @ J[rows]
                start = stop
            return np.asarray(root @ (np.concatenate(numbers) - mean))

        unit = gtsam.noiseModel.Unit.Create(len(root))
        return Factor("prior", gtsam.CustomFactor(unit, [p.key for p in concerned], evaluate))


def _square_root(belief: Belief, quantities: Sequence[Quantity]) -> Array:
    """(n, n) R with R'R the information of the numbers; one that is exactly known is held as fixed ones are."""
    sigmas = np.where(belief.sigmas > 0.0, belief.sigmas, [pinned(q) for q in quantities])
    correlation = belief.covariance / np.outer(sigmas, sigmas)
    np.fill_diagonal(correlation, 1.0)
    if not (correlation - np.eye(len(sigmas))).any():
        return np.diag(1.0 / sigmas)  # row by row about one number, as budgets tell priors
    return root_of_information(correlation, sigmas)


def _rows_of(factor: gtsam.NonlinearFactor, rows: NDArray[np.intp], at: gtsam.Values) -> gtsam.CustomFactor:
    """Some rows of a factor; its variables are among the values."""
    keys, dims = factor.keys(), at.dims()
    ends = np.cumsum([dims[key] for key in keys])[:-1]

    def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        A, b = factor.linearize(values).jacobian()
        if jacobians is not None:
            for i, block in enumerate(np.split(A[rows], ends, axis=1)):
                jacobians[i] = block
        return np.asarray(-b[rows])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(rows)), keys, evaluate)
