"""Before recording: what a planned motion would tell, what it would leave weak, and a motion that tells more.

    plan = make_plan("los", "my_sway.yaml", None, {"delta_px": 1e-4})
    plan.now.assessment.status, [step.change for step in plan.steps]

The motion is simulated with the noise that its scenario states and goes through the method's own graph; the joint
covariance there depends on motion and noise levels, and next to nothing on the noise drawn.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines import progress
from pipelines.errors import InputError
from pipelines.graph.problem import Quantity
from pipelines.judgement.observability import Assessment, assess

if TYPE_CHECKING:
    from pydantic import BaseModel

_MOST_STEPS = 3
# A change that tells less than this about what is missing, nats, is not worth the trouble.
_LEAST_GAIN = 0.1
# Of the sways added.
_LOS_SWAY = {"amplitude_deg": 5.0, "frequency_hz": 0.29}
_HEAD_SWAY = {"amplitude_deg": 20.0, "frequency_hz": 0.29}

# Poses of a cube that are proposed together, and the seed of all simulations.
_SERIES, _SEED = 6, 0

Scenario = dict[str, Any]


@dataclass(frozen=True)
class Prediction:
    """What a recording of a motion would tell.

    Attributes:
        scenario: the motion.
        duration: of the recording, s.
        quantities: what is estimated.
        assessment: its sigmas and verdicts are the predicted ones.
    """

    scenario: Scenario
    duration: float
    quantities: tuple[Quantity, ...]
    assessment: Assessment

    @property
    def sigmas(self) -> dict[str, float]:
        """Parameter -> predicted sigma, SI."""
        sigmas = self.assessment.sigmas.tolist()
        return {q.name: sigma for q, sigma in zip(self.quantities, sigmas, strict=True)}

    @property
    def missing(self) -> dict[str, float]:
        """Parameter -> predicted sigma over the one required, of those that fall short."""
        sigmas = self.sigmas
        estimated = [q for q in self.quantities if q.prior_sigma != 0.0]
        return {q.name: sigmas[q.name] / q.require for q in estimated if sigmas[q.name] > q.require}


@dataclass(frozen=True)
class Step:
    """A change of the motion.

    Attributes:
        change: in words.
        gain: information it adds about what falls short, nats, beyond what more time alone would.
        prediction: with this change and those before it.
    """

    change: str
    gain: float
    prediction: Prediction


@dataclass(frozen=True)
class Plan:
    """A planned motion and the changes that would make it tell more, the most telling first."""

    method: str
    now: Prediction
    steps: tuple[Step, ...]

    @property
    def best(self) -> Prediction:
        """With all changes."""
        return self.steps[-1].prediction if self.steps else self.now

    @property
    def scenario_text(self) -> str:
        """The best motion as a scenario file, what is as by default left out."""
        return scenario_yaml(_model(self.method).model_validate(self.best.scenario).model_dump(exclude_defaults=True))


def make_plan(
    method_name: str,
    scenario: str | None = None,
    config_file: Path | None = None,
    require: Mapping[str, float] | None = None,
    most_steps: int = _MOST_STEPS,
) -> Plan:
    """Predict a planned motion's sigmas and, where they fall short, better it greedily.

    Args:
        method_name: of the registry.
        scenario: YAML file or name; None is the method's nominal one.
        config_file: overrides key by key the config that the simulated recording brings.
        require: parameter -> sigma wanted, over those of the config.
        most_steps: changes at most.

    Raises:
        InputError: no such method, scenario or parameter, or a scenario without usable data.
    """
    from pipelines.simulation.scenario import load_scenario

    wanted = dict(require or {})
    model = _model(method_name)
    settings = load_scenario(model, scenario or f"{method_name}_nominal").model_dump()
    with progress.doing("predicting"):
        now = predict(method_name, settings, config_file, wanted)
    steps: list[Step] = []
    best = now
    while best.missing and len(steps) < most_steps:
        found = list(progress.track(_candidates(method_name, best, config_file, wanted), "trying other motions"))
        if not found:
            break
        step = max(found, key=lambda each: each.gain)
        if step.gain < _LEAST_GAIN:
            break
        steps.append(step)
        best = step.prediction
    return Plan(method_name, now, tuple(steps))


def predict(method_name: str, scenario: Scenario, config_file: Path | None, require: Mapping[str, float]) -> Prediction:
    """The sigmas that a recording of this motion would end with. Raises InputError when it would be unusable."""
    from pipelines.config import ATTACHMENT, load_config
    from pipelines.recording.info import session_facts
    from pipelines.recording.reading import open_recording
    from pipelines.registry import method
    from pipelines.solvers.batch import solve_batch
    from pipelines.solvers.marginals import IndeterminateError

    chosen = method(method_name)
    with tempfile.TemporaryDirectory(prefix="alidade.") as folder:
        file, session = Path(folder) / "scenario.yaml", Path(folder) / "planned.mcap"
        file.write_text(scenario_yaml(scenario), encoding="utf-8")
        chosen.simulate(str(file), _SEED, session, False)
        recording = open_recording(session)
        config = load_config(recording.attachment(ATTACHMENT), config_file)
        config = config.model_copy(update={"require": {**config.require, **require}})
        data = chosen.read(recording, config)
        duration = session_facts(recording, config).duration_s
    problem = chosen.problem(data, config)
    try:
        estimate = solve_batch(problem)
    except IndeterminateError as error:
        raise InputError(f"scenario: {error}") from error
    assessment = assess(problem.quantities, estimate.covariance, None, problem.advice)
    return Prediction(scenario, duration, problem.quantities, assessment)


def requirements(given: Sequence[str]) -> dict[str, float]:
    """Parameter -> sigma from words like delta_px=1e-4. Raises InputError when one is no such thing."""
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


def write_scenario(path: Path, plan: Plan) -> None:
    """Write the best motion as a scenario file. Raises InputError when it cannot be written."""
    try:
        path.write_text(plan.scenario_text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def scenario_yaml(scenario: Scenario) -> str:
    """The text of a scenario file."""
    from io import StringIO

    from ruamel.yaml import YAML

    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    text = StringIO()
    yaml.dump(scenario, text)
    return text.getvalue()


def _model(method_name: str) -> type[BaseModel]:
    if method_name == "los":
        from pipelines.methods.los.simulation import LosScenario

        return LosScenario
    if method_name == "head":
        from pipelines.methods.head.simulation import HeadScenario

        return HeadScenario
    if method_name == "indexer":
        from pipelines.methods.indexer.simulation import IndexerScenario

        return IndexerScenario
    if method_name == "cube":
        from pipelines.methods.cube.simulation import CubeScenario

        return CubeScenario
    raise InputError(f"no method {method_name}; there are {', '.join(_CHANGES)}")


def _candidates(
    method_name: str, before: Prediction, config_file: Path | None, require: Mapping[str, float]
) -> Iterator[Step]:
    """Each possible change with what it would bring; those that cannot be recorded are left out."""
    for change, scenario in _CHANGES[method_name](before.scenario):
        try:
            after = predict(method_name, scenario, config_file, require)
        except InputError:
            continue
        yield Step(change, _gain(before, after), after)


def _gain(before: Prediction, after: Prediction) -> float:
    """Fall of what is missing, nats, less what a recording as long would bring by its length."""
    sigmas = after.sigmas
    required = {q.name: q.require for q in after.quantities}
    by_time = 0.5 * float(np.log(after.duration / before.duration))
    fall = [np.log(ratio / max(sigmas[name] / required[name], 1.0)) for name, ratio in before.missing.items()]
    return float(np.sum(fall)) - by_time * len(fall)


def _sways(motion: Mapping[str, Sequence[Any]] | None, sway: Mapping[str, float]) -> Iterator[tuple[str, Scenario]]:
    """A motion with one more sway about each axis."""
    for i, axis in enumerate(("yaw", "pitch", "roll")):
        # Sways of one frequency on two axes would be one sway about an axis between them.
        more = {**sway, "frequency_hz": round(sway["frequency_hz"] + 0.04 * i, 3)}
        now: dict[str, Sequence[Any]] = {"yaw": [], "pitch": [], "roll": [], **(motion or {})}
        words = f"sway by {more['amplitude_deg']:g} deg at {more['frequency_hz']:g} Hz in {axis}"
        yield words, {**now, axis: [*now[axis], more]}


def _los_changes(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    for words, motion in _sways(scenario["carrier"], _LOS_SWAY):
        yield f"the carrier: {words}", {**scenario, "carrier": motion}
    # Another target from the middle of the longest stretch without one found anew.
    found = sorted([0.0, *(loss["end_s"] for loss in scenario["losses"]), scenario["duration_s"]])
    i = int(np.argmax(np.diff(found)))
    middle = 0.5 * (found[i] + found[i + 1])
    for words, key, step in (
        ("25 deg higher", "elevation_step_deg", 25.0),
        ("25 deg lower", "elevation_step_deg", -25.0),
        ("40 deg to the side", "azimuth_step_deg", 40.0),
    ):
        loss = {"start_s": middle - 1.0, "end_s": middle + 1.0, key: step}
        yield f"from {middle + 1.0:g} s on a target {words}", {**scenario, "losses": [*scenario["losses"], loss]}


def _head_changes(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    for who, key in (("head", "head"), ("platform", "platform")):
        for words, motion in _sways(scenario[key], _HEAD_SWAY):
            yield f"the {who}: {words}", {**scenario, key: motion}


def _indexer_changes(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    for axis in ("outer", "inner"):
        for other in (0.0, 90.0, 180.0):
            position = {"axis": axis, "other_deg": other, "turns": 3.0}
            words = f"three turns each way about the {axis} axis, the other at {other:g} deg"
            yield words, {**scenario, "positions": [*scenario["positions"], position]}
    if not scenario["record_moves"]:
        yield "record the moves between positions too", {**scenario, "record_moves": True}


def _cube_changes(scenario: Scenario) -> Iterator[tuple[str, Scenario]]:
    from pipelines.methods.cube.next_poses import next_poses
    from pipelines.methods.cube.simulation import CubeScenario

    single, series = next_poses(CubeScenario.model_validate(scenario), _SEED, _SERIES)
    for poses in (*([pose] for pose in single), series):
        more = [*scenario["attitudes"], *(pose.model_dump() for pose in poses)]
        words = "; then ".join(str(pose) for pose in poses)
        yield (
            f"{'one more pose' if len(poses) == 1 else f'{len(poses)} more poses'}: {words}",
            {**scenario, "attitudes": more},
        )
    yield "rests twice as long", {**scenario, "static_s": 2.0 * scenario["static_s"]}
    if scenario["turn_axes"]:
        yield "turns about any axis", {**scenario, "turn_axes": []}
    if scenario["faces_hidden"]:
        yield "every face shown", {**scenario, "faces_hidden": []}


_CHANGES = {"los": _los_changes, "indexer": _indexer_changes, "head": _head_changes, "cube": _cube_changes}
