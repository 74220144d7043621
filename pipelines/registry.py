"""The methods, each with the functions that serve it. A new method is one more entry here.

Entries are made when asked for: the modules behind them import gtsam, which takes a quarter of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.errors import InputError

if TYPE_CHECKING:
    from pipelines.config import Config
    from pipelines.graph.problem import Estimate, Findings, Problem
    from pipelines.judgement.validation import Validation
    from pipelines.methods.collected import Collected
    from pipelines.recording.reading import Recording
    from pipelines.reports.result import Calibration, Plot, Table


@dataclass(frozen=True)
class Method:
    """What the command line needs of a method.

    Attributes:
        read: recording and config -> the method's data.
        problem: data and config -> the graph.
        published: data, config and problem -> the published solver's estimate.
        simulate: scenario (name, file or None for the nominal one), seed, file to write, whether with pictures.
        plots: the method's own figures and tables for the report.
        findings: data, config and estimate -> what there is to tell beside the parameters.
        validate: data, config and parameter values by name -> errors before and after compensation.
        collected: data and config -> what there is by now of what the method needs, for the person recording.
    """

    read: Callable[[Recording, Config], Any]
    problem: Callable[[Any, Config], Problem]
    published: Callable[[Any, Config, Problem], Estimate]
    simulate: Callable[[str | None, int, Path, bool], None]
    plots: Callable[[Any], Callable[[Calibration], Sequence[Plot | Table]]] | None = None
    findings: Callable[[Any, Config, Estimate], Findings] | None = None
    validate: Callable[[Any, Config, Mapping[str, float]], Sequence[Validation]] | None = None
    collected: Callable[[Any, Config], Sequence[Collected]] | None = None


def method(name: str) -> Method:
    """The method of that name. Raises InputError when there is none."""
    if name not in _METHODS:
        raise InputError(f"method {name} is not built yet; there are {', '.join(_METHODS)}")
    return _METHODS[name]()


def _head() -> Method:
    from functools import partial

    from pipelines.methods.collected import collected_head
    from pipelines.methods.head.figures import head_plots
    from pipelines.methods.head.graph import problem
    from pipelines.methods.head.published import published_estimate
    from pipelines.methods.head.recording import read_head
    from pipelines.methods.head.simulation import write_simulation
    from pipelines.methods.head.validation import validate

    return Method(
        read_head,
        problem,
        published_estimate,
        write_simulation,
        lambda data: partial(head_plots, data),
        validate=validate,
        collected=collected_head,
    )


def _los() -> Method:
    from functools import partial

    from pipelines.methods.collected import collected_los
    from pipelines.methods.los.figures import los_plots
    from pipelines.methods.los.graph import problem
    from pipelines.methods.los.published import published_estimate
    from pipelines.methods.los.recording import read_los
    from pipelines.methods.los.simulation import write_simulation
    from pipelines.methods.los.validation import validate

    return Method(
        read_los,
        problem,
        published_estimate,
        write_simulation,
        lambda data: partial(los_plots, data),
        validate=validate,
        collected=collected_los,
    )


def _indexer() -> Method:
    from functools import partial

    from pipelines.methods.collected import collected_indexer
    from pipelines.methods.indexer.figures import indexer_plots
    from pipelines.methods.indexer.graph import problem, validate
    from pipelines.methods.indexer.published import published_estimate
    from pipelines.methods.indexer.recording import read_indexer
    from pipelines.methods.indexer.simulation import write_simulation

    return Method(
        read_indexer,
        problem,
        published_estimate,
        write_simulation,
        lambda data: partial(indexer_plots, data),
        validate=validate,
        collected=collected_indexer,
    )


def _cube() -> Method:
    from functools import partial

    from pipelines.methods.collected import collected_cube
    from pipelines.methods.cube.figures import cube_plots
    from pipelines.methods.cube.findings import findings
    from pipelines.methods.cube.graph import problem
    from pipelines.methods.cube.published import published_estimate
    from pipelines.methods.cube.recording import read_cube
    from pipelines.methods.cube.simulation import write_simulation
    from pipelines.methods.cube.validation import validate

    return Method(
        read_cube,
        problem,
        published_estimate,
        write_simulation,
        lambda data: partial(cube_plots, data),
        findings,
        validate,
        collected_cube,
    )


_METHODS: dict[str, Callable[[], Method]] = {"los": _los, "indexer": _indexer, "head": _head, "cube": _cube}
