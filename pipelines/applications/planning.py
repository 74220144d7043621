"""Planning before recording: predicted sigmas and weak directions of a motion, and a motion that determines more.

    found = plan("los", "my_sway.yaml", require={"delta_px": 1e-4})
    found.now.status, [step.change for step in found.steps]

The motion is simulated with the noise that its scenario states and goes through the method's own graph; the joint
covariance there depends on motion and noise levels, and next to nothing on the noise drawn. Where the motion itself, or
sensors far from nominal, are drawn, several draws are predicted, and what is promised is the largest sigma of each
parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines import methods, progress
from alidade.pipelines.config import Settings
from alidade.pipelines.diagnostics.observability import Advise, Verdict, finite_covariance, verdicts, weak_directions
from alidade.pipelines.errors import IndeterminateError, InputError
from alidade.pipelines.estimation.finding import Finding, Status, status
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.files import dump_yaml
from alidade.pipelines.methods import Method, Scenario

_MOST_STEPS = 3
# A change that brings less information than this on what is missing, nats, is not worth the trouble.
_LEAST_GAIN = 0.1
# Simulations of a scenario whose motion is drawn; of others there is one.
_DRAWS = 5


@dataclass(frozen=True)
class Prediction:
    """Predicted estimate of a recording of one motion.

    Attributes:
        scenario: the motion.
        duration: of the recording, s.
        quantities: what is estimated.
        values: (n,) of the draw.
        covariance: (n, n), predicted, SI, in the order of the quantities.
        budget: parameter -> source -> its share of the variance, of the worst draw.
        worst: the seed of the draw that falls shortest of what is required.
        advice: of the graph, for weak directions.
    """

    scenario: Scenario
    duration: float
    quantities: tuple[Quantity, ...]
    values: Array
    covariance: Array
    budget: Mapping[str, Mapping[str, float]]
    worst: int = 0
    advice: Advise | None = None

    @property
    def sigmas(self) -> dict[str, float]:
        """Predicted sigma of each parameter, SI."""
        sigmas = np.sqrt(np.diag(self.covariance)).tolist()
        return {q.name: sigma for q, sigma in zip(self.quantities, sigmas, strict=True)}

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Parameter -> predicted verdict, of those with a required accuracy."""
        return verdicts(self.quantities, self.covariance, (), self.values)

    @property
    def directions(self) -> tuple[Finding, ...]:
        """Predicted weak and unobservable directions, worst first."""
        return weak_directions(self.quantities, self.covariance, self.advice, self.values)

    @property
    def status(self) -> Status:
        """Predicted status: calibrated, weak or unobservable."""
        return status(self.directions)

    @property
    def missing(self) -> dict[str, float]:
        """Parameter -> ratio of predicted to required sigma, where it exceeds one."""
        sigmas = self.sigmas
        estimated = [q for q in self.quantities if q.prior_sigma != 0.0 and not q.relative]
        return {q.name: sigmas[q.name] / q.require for q in estimated if sigmas[q.name] > q.require}


# Scenario, as text, and seed -> what is predicted of that draw.
Made = dict[tuple[str, int], Prediction]


@dataclass(frozen=True)
class Step:
    """Proposed change of the motion, with its prediction.

    Attributes:
        change: in words.
        gain: information it adds about what falls short, nats, beyond what more time alone would.
        prediction: with this change and those before it.
    """

    change: str
    gain: float
    prediction: Prediction


@dataclass(frozen=True, repr=False)
class Plan:
    """A planned motion and the changes that would make it determine more, the most informative first."""

    method: str
    now: Prediction
    steps: tuple[Step, ...]

    def __repr__(self) -> str:
        return f"<Plan {self.method}: {self.now.status}, with {len(self.steps)} changes {self.best.status}>"

    @property
    def best(self) -> Prediction:
        """Prediction with all proposed changes."""
        return self.steps[-1].prediction if self.steps else self.now

    @property
    def scenario_text(self) -> str:
        """The best motion as a scenario file, what is as by default left out."""
        model = methods.method(self.method).scenario
        return dump_yaml(model.model_validate(self.best.scenario).model_dump(exclude_defaults=True))


def plan(
    method: str,
    scenario: str | Path | None = None,
    *,
    config: Settings = None,
    require: Mapping[str, float] | None = None,
    most_steps: int = _MOST_STEPS,
) -> Plan:
    """How well a planned motion would determine each parameter, and a better one: `.now.sigmas`, `.steps`, `.best`.

    Where sigmas fall short of what is required the motion is bettered greedily.

    Args:
        method: los, indexer, ...
        scenario: YAML file or name; None: the method's nominal motion, without the priors of that scenario.
        config: overrides key by key the config that the simulated recording brings.
        require: parameter -> sigma wanted, over those of the config.
        most_steps: changes at most.

    Raises:
        InputError: no such method, scenario or parameter, the config cannot be used, or a scenario without usable data.
    """
    chosen = methods.method(method)
    settings = chosen.settings(None if scenario is None else str(scenario)).model_dump()
    if scenario is None and "priors" in settings:
        settings["priors"] = {}
    predicted = partial(predict, method, config_file=config, require=dict(require or {}), made={})
    with progress.doing("predicting"):
        now = predicted(settings)
    steps: list[Step] = []
    best = now
    while best.missing and len(steps) < most_steps:
        found = list(progress.track(_candidates(chosen, best, predicted), "trying other motions"))
        if not found:
            break
        step = max(found, key=lambda each: each.gain)
        if step.gain < _LEAST_GAIN:
            break
        best = predicted(step.prediction.scenario)
        steps.append(replace(step, prediction=best))
    return Plan(method, now, tuple(steps))


def predict(
    method_name: str,
    scenario: Scenario,
    config_file: Settings,
    require: Mapping[str, float],
    seeds: Sequence[int] | None = None,
    made: Made | None = None,
) -> Prediction:
    """Predict the sigmas after a recording of this motion, the largest over several random draws of the scenario.

    Without `seeds` there are as many draws as the method's scenarios need. Predictions that `made` has are not made
    again, and new ones are added; all else has to be the same. Raises InputError when the recording would be unusable.
    """
    made = {} if made is None else made
    if seeds is None:
        seeds = range(_DRAWS if methods.method(method_name).require_simulator().randomised else 1)
    for seed in seeds:
        if (repr(scenario), seed) not in made:
            made[repr(scenario), seed] = _predicted(method_name, scenario, config_file, require, seed)
    each = [made[repr(scenario), seed] for seed in seeds]
    worst = max(each, key=lambda prediction: max(prediction.missing.values(), default=0.0))
    largest = np.max([np.sqrt(np.diag(prediction.covariance)) for prediction in each], axis=0)
    own = np.sqrt(np.diag(worst.covariance))
    grown = np.divide(largest, own, out=np.ones_like(own), where=own > 0.0)
    covariance = worst.covariance * np.outer(grown, grown)
    return replace(worst, covariance=covariance)


def _predicted(
    method_name: str, scenario: Scenario, config_file: Settings, require: Mapping[str, float], seed: int
) -> Prediction:
    """Predict the estimate of a recording of the motion with one seed."""
    from alidade.pipelines.applications.session import Session
    from alidade.pipelines.solvers.batch import solve_batch

    method = methods.method(method_name)
    session = Session.of(method, method.simulate(method.scenario.model_validate(scenario), seed), config_file)
    # The noise asked about is that of the config; the recording is only simulated.
    config = session.config.model_copy(update={"require": {**session.config.require, **require}, "noise_known": 0.0})
    problem = method.graph(session.data, config)
    try:
        estimate = solve_batch(problem, budget=True, error_map=True)
    except IndeterminateError as error:
        raise InputError(f"scenario: {error}") from error
    covariance = finite_covariance(problem.quantities, estimate.covariance)
    duration, budget = session.facts.duration_s, estimate.budget or {}
    return Prediction(scenario, duration, problem.quantities, estimate.values, covariance, budget, seed, problem.advice)


def requirements(given: Sequence[str]) -> dict[str, float]:
    """Return parameter -> required sigma from words like delta_px=1e-4. Raises InputError for any other word."""
    found = {}
    for word in given:
        name, _, number = word.partition("=")
        try:
            sigma = float(number)
        except ValueError:
            sigma = 0.0
        if not (name and 0.0 < sigma < float("inf")):
            raise InputError(f"--require {word}: NAME=SIGMA is needed, sigma a number above zero in SI units")
        found[name] = sigma
    return found


def _candidates(method: Method, before: Prediction, predicted: Callable[..., Prediction]) -> Iterator[Step]:
    """Yield each possible change of the motion with its gain for the worst draw; skip those that cannot be recorded."""
    seeds = (before.worst,)
    now = predicted(before.scenario, seeds=seeds)
    for change, scenario in method.guidance.variations(before.scenario):
        try:
            after = predicted(scenario, seeds=seeds)
        except InputError:
            continue
        yield Step(change, _gain(now, after), after)


def _gain(before: Prediction, after: Prediction) -> float:
    """Return the reduction of excess sigmas over the required ones, nats, beyond that of the longer time alone."""
    sigmas = after.sigmas
    required = {q.name: q.require for q in after.quantities}
    by_time = 0.5 * float(np.log(after.duration / before.duration))
    fall = [np.log(ratio / max(sigmas[name] / required[name], 1.0)) for name, ratio in before.missing.items()]
    return float(np.sum(fall)) - by_time * len(fall)
