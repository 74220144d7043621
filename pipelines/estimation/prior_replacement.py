"""Gaussian priors on reported numbers in place of a method's own priors.

The factor of such a prior is about reported numbers. The method's own priors lose the rows that are about replaced
numbers alone; rows that tie these to others stay.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import takewhile
from typing import Any

import gtsam
import numpy as np

from alidade.factors.array import Array, Index, Mask
from alidade.factors.bridge import value_at
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.priors import pinned
from alidade.pipelines.estimation.problem import Factor, Parameter, Problem, Quantity, Step, changed
from alidade.pipelines.gaussian_prior import GaussianPrior, root_of_information

# Gives the steps before some.
Earlier = Callable[[], Iterable[Step]]

# Elements of a prior's row below this share of its largest are rounding.
_ROUNDING = 1e-9
# First values farther from the prior mean than this, in sigmas, are moved there, in so many steps.
_APART, _MOVES = 3.0, 5
# In units of a number's usual prior: means and sigmas beyond, sigmas below and not 0, and combinations of numbers known
# so much better than these themselves are slips, by which no linear system in double precision can be solved.
_FARTHEST, _LEAST_SIGMA, _LEAST_CORRELATED = 1e6, 1e-10, 1e-12


def with_priors(problem: Problem, gaussian_priors: Sequence[GaussianPrior]) -> Problem:
    """Replace a problem's priors of some numbers by Gaussian priors.

    A number that the problem fixes stays fixed unless the prior is the config's own; the priors of others are
    conditioned on that.

    Raises:
        InputError: a number is to be fixed elsewhere than at 0 that the graph leaves out where it is fixed.
    """
    for gaussian_prior in gaussian_priors:
        problem = _with_prior(problem, gaussian_prior)
    return problem


def _about_alone(
    factor: gtsam.GaussianFactor, parameters: Sequence[Parameter], values: gtsam.Values, names: Collection[str]
) -> Mask:
    """Mask (m,) of rows of a linearised prior that involve named numbers and, beside fixed ones, no others."""
    A, _ = factor.jacobian()
    blocks = dict(zip(factor.keys(), _by_key(A, factor.keys(), values), strict=True))
    own = [p for p in parameters if p.key in blocks]
    quantities = [q for p in own for q in p.quantities]
    by_numbers = [blocks[p.key] @ np.linalg.pinv(p.coordinates(values, p.key)[1]) for p in own]
    # In units of the priors: angles, rates and seconds stand side by side.
    size = np.abs(np.hstack(by_numbers)) * [q.prior_scale for q in quantities]
    about = size > _ROUNDING * size.max(axis=1, keepdims=True, initial=0.0)
    among = np.array([q.name in names for q in quantities])
    others = np.array([q.name not in names and q.prior_sigma != 0.0 for q in quantities])
    return np.asarray((about & among).any(axis=1) & ~(about & others).any(axis=1))


def _by_key(A: Array, keys: Sequence[int], values: gtsam.Values) -> list[Array]:
    """Split a Jacobian into the columns of each variable."""
    dims = values.dims()
    return np.split(A, np.cumsum([dims[key] for key in keys])[:-1], axis=1)


def _with_prior(problem: Problem, gaussian_prior: GaussianPrior, before: Earlier = tuple) -> Problem:
    """Replace a problem's priors by one Gaussian prior; `before` yields the earlier steps of a growing recording."""
    own = {q.name: q for q in problem.quantities}
    for name, mean, sigma in zip(gaussian_prior.names, gaussian_prior.mean, gaussian_prior.sigmas, strict=True):
        if name not in own and sigma == 0.0 and mean != 0.0:
            raise InputError(
                f"priors.{name}: where it is fixed it is left out of the graph, which takes it for 0; give it a sigma"
            )
    known, by_hand = gaussian_prior.of(own), not gaussian_prior.source
    _require_sense(known, own)
    replaced = frozenset(name for name in known.names if by_hand or own[name].prior_sigma != 0.0)
    if not replaced:
        return problem
    replacements = {
        name: replace(own[name], prior_mean=float(mean), prior_sigma=float(sigma), sheet="")
        for name, mean, sigma in zip(known.names, known.mean, known.sigmas, strict=True)
        if name in replaced
    }
    means = known.means
    parameters = tuple(
        replace(p, quantities=tuple(replacements.get(q.name, q) for q in p.quantities)).near(means)
        for p in problem.parameters
    )
    others = known.given({name: mean for name, mean in means.items() if name not in replaced})
    factors = _PriorFactors(parameters, known, replaced)
    steps, after, continuation = problem.steps, problem.steps_after, problem.continuation

    def continued(data: Any, time: float) -> Problem | None:
        more = continuation(data, time) if continuation is not None else None
        return None if more is None else _with_prior(more, gaussian_prior, lambda: _until(steps, time))

    premise = f"The prior of {len(replaced)} parameters is {gaussian_prior.source}." if gaussian_prior.source else ""
    return replace(
        problem,
        parameters=parameters,
        gaussian_priors=(*problem.gaussian_priors, others),
        steps=lambda chunk: factors.steps(steps(chunk), before),
        steps_after=None if after is None else lambda time: factors.steps(after(time), lambda: _until(steps, time)),
        continuation=None if continuation is None else continued,
        refined_graph=changed(problem.refined_graph, partial(_with_prior, gaussian_prior=gaussian_prior)),
        premises=(*problem.premises, *filter(None, [premise])),
    )


def _require_sense(gaussian_prior: GaussianPrior, own: Mapping[str, Quantity]) -> None:
    """Raise InputError for a prior mean, sigma or covariance that makes the problem unsolvable."""
    where = gaussian_prior.source or "priors"
    for name, mean, sigma in zip(gaussian_prior.names, gaussian_prior.mean, gaussian_prior.sigmas, strict=True):
        scale, unit = own[name].prior_scale, own[name].unit
        if not (abs(mean) <= _FARTHEST * scale and sigma <= _FARTHEST * scale):
            raise InputError(
                f"{where}: {name}: {mean:g} ± {sigma:g} {unit} is far from anything it can be; units are SI"
            )
        if 0.0 < sigma < _LEAST_SIGMA * scale:
            raise InputError(f"{where}: {name}: a sigma of {sigma:g} {unit} is less than any; 0 fixes it")
    sigmas = gaussian_prior.sigmas
    free = sigmas > 0.0
    correlation = gaussian_prior.covariance[np.ix_(free, free)] / np.outer(sigmas[free], sigmas[free])
    if np.linalg.eigvalsh(correlation).min(initial=1.0) < _LEAST_CORRELATED:
        raise InputError(f"{where}: the covariance is singular: a combination of its numbers is known exactly")


def _until(steps: Callable[[int], Iterator[Step]], time: float) -> Iterator[Step]:
    """Yield the steps up to a time, s."""
    return takewhile(lambda step: step.time <= time, steps(1) if np.isfinite(time) else ())


@dataclass(frozen=True, eq=False)
class _PriorFactors:
    """Gaussian prior in conditional factors: each variable given the variables that begin before it.

    Attributes:
        parameters: of the problem, with the priors now in force.
        gaussian_prior: about some of their numbers.
        replaced: those of them that have no other prior.
    """

    parameters: Sequence[Parameter]
    gaussian_prior: GaussianPrior
    replaced: Collection[str]

    def steps(self, steps: Iterable[Step], before: Earlier = tuple) -> Iterator[Step]:
        """Yield the steps, with the Gaussian prior in place of other priors where its variables begin.

        Args:
            steps: in time order.
            before: the steps before these, looked at only if a variable begins in these.
        """
        begun: gtsam.Values | None = None
        for step in steps:
            if not any(step.initial.exists(p.key) for p in self.parameters):
                yield step
                continue
            if begun is None:
                begun = gtsam.Values()
                for earlier in before():
                    self._begin(earlier, begun)
            yield self._changed(step, begun)

    @cached_property
    def _concerned(self) -> list[Parameter]:
        """Parameters with numbers in the Gaussian prior."""
        return [p for p in self.parameters if any(q.name in self.gaussian_prior.names for q in p.quantities)]

    def _begin(self, step: Step, begun: gtsam.Values) -> list[Parameter]:
        """Add the parameters that begin in a step to `begun`, moved to the prior mean; return these parameters."""
        new = [p for p in self.parameters if step.initial.exists(p.key)]
        for p in new:
            begun.insert(p.key, value_at(step.initial, p.key))
            if p in self._concerned:
                self._move(p, begun)
        return new

    def _changed(self, step: Step, begun: gtsam.Values) -> Step:
        """Return a step, in which parameters begin, with their priors replaced by the Gaussian prior."""
        earlier = [p for p in self._concerned if begun.exists(p.key)]
        new = self._begin(step, begun)
        initial = gtsam.Values(step.initial)
        for p in new:
            initial.update(p.key, value_at(begun, p.key))
        factors: list[Factor] = []
        for f in step.factors:
            if f.family == "prior" and all(begun.exists(key) for key in f.keys):
                factors += self._kept_rows(f, begun)
            else:
                factors.append(f)
        concerned = [p for p in new if p in self._concerned]
        factors += [self._factor(earlier, concerned)] if concerned else []
        return replace(step, factors=factors, initial=initial)

    def _kept_rows(self, prior: Factor, values: gtsam.Values) -> list[Factor]:
        """Factors of the rows of a prior that the Gaussian prior does not replace."""
        kept = ~_about_alone(prior.factor.linearize(values), self.parameters, values, self.replaced)
        if kept.all():
            return [prior]
        return [Factor("prior", _rows_of(prior.factor, np.flatnonzero(kept), values))] if kept.any() else []

    def _move(self, parameter: Parameter, values: gtsam.Values) -> None:
        """Move an initial value that contradicts the Gaussian prior to the prior mean."""
        rows, places = self._places(parameter)
        mean, sigmas = self.gaussian_prior.mean[places], self.gaussian_prior.sigmas[places]
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
        """Rows of a parameter's numbers that the Gaussian prior covers, and their positions in that prior."""
        names = [q.name for q in parameter.quantities]
        rows = [i for i, name in enumerate(names) if name in self.gaussian_prior.names]
        return rows, [self.gaussian_prior.names.index(names[i]) for i in rows]

    def _factor(self, earlier: Sequence[Parameter], new: Sequence[Parameter]) -> Factor:
        """Whitened conditional factor of the parameters that begin, given those that began earlier."""
        concerned = [*earlier, *new]
        places = [self._places(p) for p in concerned]
        order = [place for _, own in places for place in own]
        fixed = {q.name: pinned(q) for p in concerned for q in p.quantities}
        names, given = [self.gaussian_prior.names[i] for i in order], self.gaussian_prior.sigmas[order]
        sigmas = np.array([sigma or fixed[name] for name, sigma in zip(names, given, strict=True)])
        count = sum(len(self._places(p)[1]) for p in new)
        root = conditional_root(self.gaussian_prior.covariance[np.ix_(order, order)], sigmas)[-count:]
        mean = self.gaussian_prior.mean[order]

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


def conditional_root(covariance: Array, sigmas: Array) -> Array:
    """Lower triangular square root R (n, n) of information R'R: row i conditions number i on those before.

    Args:
        covariance: (n, n) of the numbers; fixed ones have rows of zeros.
        sigmas: (n,) of the numbers, above zero also where they are fixed.
    """
    correlation = covariance / np.outer(sigmas, sigmas)
    np.fill_diagonal(correlation, 1.0)
    if not (correlation - np.eye(len(sigmas))).any():
        return np.diag(1.0 / sigmas)
    # A QR decomposition from the last column to the first.
    R = np.linalg.qr(root_of_information(correlation, np.ones(len(sigmas)))[:, ::-1])[1]
    return np.asarray(R[::-1, ::-1] / sigmas)


def _rows_of(factor: gtsam.NonlinearFactor, rows: Index, at: gtsam.Values) -> gtsam.CustomFactor:
    """Build a gtsam factor from selected rows of another; `at` has values of its variables."""
    keys = factor.keys()

    def evaluate(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        A, b = factor.linearize(values).jacobian()
        if jacobians is not None:
            for i, block in enumerate(_by_key(A[rows], keys, at)):
                jacobians[i] = block
        return np.asarray(-b[rows])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(rows)), keys, evaluate)
