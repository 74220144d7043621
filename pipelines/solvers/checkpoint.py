"""A run of the incremental solver in a file, to be taken up again in another process.

A run is saved where the past was just marginalised out: the Gaussian it goes on from, in gtsam's own text, which keeps
every digit, and the rows it has gathered. The steps after it come from the recording again. The run that wrote the file
went on from the very same numbers, so both end at the same estimates.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.noise import Level, Noise
from alidade.pipelines.estimation.problem import Problem
from alidade.pipelines.solvers.course import Way
from alidade.pipelines.solvers.incremental import Run
from alidade.pipelines.solvers.innovations import Innovations
from alidade.pipelines.solvers.rows import Rows
from alidade.pipelines.solvers.state import State
from alidade.pipelines.solvers.window import Keyframes

_SCHEMA = "alidade.checkpoint/5"
_INNOVATIONS = "innovations/"


def save_checkpoint(path: Path, run: Run, identity: Mapping[str, str]) -> None:
    """Write a run whose past was just marginalised out; the file is replaced whole or not at all.

    Args:
        path: the file.
        run: with run.just_marginalized.
        identity: what the run belongs to, in words: recording, config, versions. Only a run of the same is resumed.

    Raises:
        InputError: the file cannot be written.
    """
    state = run.base
    if state is None or run.past:
        raise ValueError("a run can be saved only where its past was just marginalised out")
    head = {
        "schema": _SCHEMA,
        "identity": dict(identity),
        "window": run.window,
        "time": state.time,
        "stamps": list(state.stamps.items()),
        "current_keys": list(run.current_keys.items()),
        "keyframes": run.keyframes,
        "walked": sorted(run.walked),
        "levels": [asdict(level) for level in run.levels],
        "trouble": run.trouble,
        "unusable": run.innovations.unusable,
        "rejected_in_a_row": run.innovations.rejected_in_a_row,
        "values": state.values.serialize(),
        "linear": state.linear.serialize(),
    }
    rows: dict[str, Any] = {_INNOVATIONS + family: rows.array for family, rows in run.innovations.families.items()}
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            np.savez(
                stream,
                head=np.array(json.dumps(head)),
                history=run.history.array,
                way=run.way.rows.array,
                attitudes=run.attitudes.array,
                **rows,
            )
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path}: the checkpoint cannot be written ({error.strerror})") from error
    finally:
        part.unlink(missing_ok=True)


def load_checkpoint(path: Path, problem: Problem, identity: Mapping[str, str]) -> Run:
    """The run as it was saved; it goes on with the steps later than `run.time`.

    Raises:
        InputError: the file is no checkpoint, is damaged, or belongs to something else.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        head = json.loads(str(arrays.pop("head")))
        if head["schema"] != _SCHEMA:
            raise InputError(f"{path}: a checkpoint of the form {head['schema']}, needed is {_SCHEMA}; delete it")
        for what, mine in identity.items():
            theirs = head["identity"].get(what)
            if theirs != mine:
                raise InputError(
                    f"{path}: the checkpoint is of another {what}, {theirs}, not {mine}; delete it or name another file"
                )
        values, linear = gtsam.Values(), gtsam.JacobianFactor()
        values.deserialize(head["values"])
        linear.deserialize(head["linear"])
        stamps = {int(key): float(stamp) for key, stamp in head["stamps"]}
        # What is saved as a whole number is keyframes.
        window = Keyframes(head["window"]) if isinstance(head["window"], int) else float(head["window"])
        levels = tuple(_level_of(**level) for level in head["levels"])
        run = Run.resumed(problem, window, State(head["time"], values, linear, stamps), levels, head["trouble"])
        run.current_keys = {int(key): int(held) for key, held in head["current_keys"]}
        run.keyframes, run.walked = head["keyframes"], set(head["walked"])
        run.history, run.attitudes = Rows(arrays.pop("history")), Rows(arrays.pop("attitudes"))
        run.way = Way(Rows(arrays.pop("way")))
        families = {name.removeprefix(_INNOVATIONS): Rows(array) for name, array in arrays.items()}
        run.innovations = Innovations(families, head["unusable"], head["rejected_in_a_row"])
    except OSError as error:
        raise InputError(f"{path}: the checkpoint cannot be read ({error.strerror or error}); delete it") from error
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, EOFError, RuntimeError) as error:
        raise InputError(f"{path}: no checkpoint, or a damaged one ({error}); delete it") from error
    return run


def _level_of(noise: Mapping[str, Any], **level: Any) -> Level:
    """A noise level from its fields; JSON keeps tuples as lists."""
    stated: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in noise.items()}
    return Level(Noise(**stated), **level)
