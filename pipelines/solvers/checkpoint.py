"""Checkpoint of an incremental run: the marginal Gaussian that it continues from, in memory and in a file.

A run is saved where everything but the active variables was just marginalised out of its smoother: the Gaussian, in
gtsam's own text, which keeps every digit, with the rows and noise levels that the run has gathered. Later steps come
from the recording again. The run that wrote the file continues from the same numbers, so both give the same estimates.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from alidade.factors.array import Array
from alidade.factors.bridge import value_at
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.noise import Level, Noise
from alidade.pipelines.estimation.problem import Factor, Step
from alidade.pipelines.solvers.gating import InnovationGate, RowBuffer
from alidade.pipelines.solvers.gtsam_engine import undetermined
from alidade.pipelines.solvers.smoother import ordering_of
from alidade.pipelines.solvers.window import Keyframes, Window

_SCHEMA = "alidade.checkpoint/7"
_ROWS = ("history", "attitudes", "moments")
_INNOVATIONS, _SHARES = "innovations/", "shares/"


@dataclass(frozen=True)
class MarginalState:
    """Gaussian over some variables, all others marginalised out.

    Attributes:
        time: s, of the last step in it.
        values: of the variables, about which it is linear.
        linear: square-root information, rows R dx = d.
        stamps: variable -> time of last use, of variables that age.
    """

    time: float
    values: gtsam.Values
    linear: gtsam.JacobianFactor
    stamps: Mapping[int, float]

    @classmethod
    def of(
        cls,
        time: float,
        linear: gtsam.GaussianFactorGraph,
        values: gtsam.Values,
        keys: Sequence[int],
        stamps: Mapping[int, float],
    ) -> MarginalState:
        """Marginalise all variables except `keys` out of a system linear about the values.

        Raises:
            IndeterminateStateError: a variable that is marginalised out is not determined.
        """
        kept = set(keys)
        rest = [key for key in linear.keyVector() if key not in kept]
        try:
            # By QR: tight processes beside loose priors cost Cholesky its digits.
            remaining = linear.eliminatePartialMultifrontal(rest, gtsam.EliminateQR)[1] if rest else linear
            conditional, _ = gtsam.EliminateQR(remaining, ordering_of(keys))
        except RuntimeError as error:
            raise undetermined(error) from None
        own = gtsam.Values()
        for key in keys:
            own.insert(key, value_at(values, key))
        return cls(time, own, gtsam.JacobianFactor(conditional), {k: t for k, t in stamps.items() if k in kept})

    @property
    def estimate(self) -> gtsam.Values:
        """Mean of the Gaussian, as values."""
        graph = gtsam.GaussianFactorGraph()
        graph.add(self.linear)
        return self.values.retract(graph.optimize(ordering_of(self.linear.keys()), gtsam.EliminateQR))

    @property
    def factor(self) -> Factor:
        """The Gaussian as a factor of a graph."""
        return Factor("prior", gtsam.LinearContainerFactor(self.linear, self.values))


def require_known_variables(factors: Iterable[Factor], values: gtsam.Values, time: float) -> None:
    """Raise InputError if a factor needs a variable that is not among the values."""
    for f in factors:
        for key in f.keys:
            if not values.exists(key):
                raise InputError(
                    f"{f.family} at {time:.3f} s needs the state {gtsam.Symbol(key).string()}, which the smoother has "
                    "forgotten: give it a longer --window"
                )


def require_finite(factors: Sequence[Factor], values: gtsam.Values, time: float) -> None:
    """Raise InputError for factors that are not finite, before these enter and spoil a smoother.

    Raises:
        InputError: a factor needs a variable that is not there, or its residual or Jacobian is not finite.
    """
    require_known_variables(factors, values, time)
    for f in factors:
        if not _is_finite(f, values):
            moment = time if f.measurement is None else float(f.measurement.model.time[0])
            raise InputError(
                f"{f.family} at {moment:.3f} s: residual or Jacobian is not a finite number; look for NaN, infinite or "
                "absurd values in the recording around that time"
            )


def without_infinite(steps: Sequence[Step], values: gtsam.Values) -> tuple[list[Step], dict[str, int]]:
    """Remove measurements with residuals that are not finite; return the steps and each family's count removed."""
    kept, left_out = list[Step](), Counter[str]()
    for step in steps:
        used = []
        for f in step.factors:
            if f.measurement is None or _is_finite(f, values):
                used.append(f)
            else:
                left_out[f.family] += len(f.measurement.model.time)
        kept.append(replace(step, factors=used))
    return kept, dict(left_out)


def _is_finite(factor: Factor, values: gtsam.Values) -> bool:
    linear = factor.linearized(values)
    return linear is None or bool(np.isfinite(linear.augmentedJacobian()).all())


@dataclass(eq=False)
class RunState:
    """State of an incremental run, except the steps since its past was marginalised out.

    Attributes:
        window: how long states are kept, s or Keyframes; None keeps all.
        levels: noise levels of the last batch solution.
        estimated: names of the numbers that are not fixed.
        marginal: the Gaussian that the run continues from since everything else was marginalised out; None: never.
        current_keys: parameter key -> variable that holds its value now.
        keyframes: number added.
        walked: parameter keys whose values other variables held before.
        trouble: why the last batch solution did not converge; empty: it did.
        gate: innovations of all measurements.
        shares: of the families in the covariance, see `error_budget.variance_shares`.
        history: rows of time, values and sigmas.
        attitudes: rows of time and quaternion.
        moments: rows of time, values and covariance of joint estimates at moments a fixed share of the time apart, so
            that hours have a few hundred of them; none where the beginning is not known.
    """

    window: Window
    levels: tuple[Level, ...]
    estimated: tuple[str, ...]
    marginal: MarginalState | None = None
    current_keys: dict[int, int] = field(default_factory=dict)
    keyframes: int = 0
    walked: set[int] = field(default_factory=set)
    trouble: str = ""
    gate: InnovationGate = field(default_factory=InnovationGate)
    shares: Mapping[str, Array] = field(default_factory=dict)
    history: RowBuffer = field(default_factory=RowBuffer)
    attitudes: RowBuffer = field(default_factory=RowBuffer)
    moments: RowBuffer = field(default_factory=RowBuffer)


def save_checkpoint(path: Path, run: RunState, identity: Mapping[str, str]) -> None:
    """Write a run to a file, atomically.

    Args:
        path: the file.
        run: to be saved, its past just marginalised out.
        identity: what the run belongs to, in words: recording, config, versions. Only a run of the same is resumed.

    Raises:
        InputError: the file cannot be written.
    """
    state = run.marginal
    assert state is not None
    head = {
        "schema": _SCHEMA,
        "identity": dict(identity),
        "window": run.window,
        "time": state.time,
        "stamps": list(state.stamps.items()),
        "values": state.values.serialize(),
        "linear": state.linear.serialize(),
        "current_keys": list(run.current_keys.items()),
        "keyframes": run.keyframes,
        "walked": sorted(run.walked),
        "estimated": run.estimated,
        "levels": [asdict(level) for level in run.levels],
        "trouble": run.trouble,
        "rejected_in_a_row": run.gate.rejected_in_a_row,
        "unusable": run.gate.unusable,
    }
    rows = {name: getattr(run, name) for name in _ROWS} | {_INNOVATIONS + f: r for f, r in run.gate.families.items()}
    arrays: dict[str, Any] = {name: buffer.array for name, buffer in rows.items()}
    arrays |= {_SHARES + family: share for family, share in run.shares.items()}
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as stream:
            np.savez(stream, head=np.array(json.dumps(head)), **arrays)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path}: the checkpoint cannot be written ({error.strerror})") from error
    finally:
        part.unlink(missing_ok=True)


def load_checkpoint(path: Path, identity: Mapping[str, str]) -> RunState:
    """Load a saved run, which continues with the steps later than its marginal's time.

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
        return _saved_run(head, arrays)
    except OSError as error:
        raise InputError(f"{path}: the checkpoint cannot be read ({error.strerror or error}); delete it") from error
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, EOFError, RuntimeError) as error:
        raise InputError(f"{path}: no checkpoint, or a damaged one; delete it") from error


def _saved_run(head: Mapping[str, Any], arrays: Mapping[str, Array]) -> RunState:
    """Build a run from the parts of its file."""
    values, linear = gtsam.Values(), gtsam.JacobianFactor()
    values.deserialize(head["values"])
    linear.deserialize(head["linear"])
    innovations, shares = (
        {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
        for prefix in (_INNOVATIONS, _SHARES)
    )
    stamps = {int(key): float(stamp) for key, stamp in head["stamps"]}
    families = {family: RowBuffer(rows) for family, rows in innovations.items()}
    return RunState(
        # A whole number is a number of keyframes.
        window=Keyframes(head["window"]) if isinstance(head["window"], int) else float(head["window"]),
        marginal=MarginalState(head["time"], values, linear, stamps),
        current_keys={int(key): int(held) for key, held in head["current_keys"]},
        keyframes=head["keyframes"],
        walked=set(head["walked"]),
        estimated=tuple(head["estimated"]),
        levels=tuple(_level_of(**level) for level in head["levels"]),
        trouble=head["trouble"],
        gate=InnovationGate(families, head["unusable"], head["rejected_in_a_row"]),
        shares=shares,
        **{name: RowBuffer(arrays[name]) for name in _ROWS},
    )


def _level_of(noise: Mapping[str, Any], **level: Any) -> Level:
    """Build a noise level from its JSON fields, whose lists become tuples."""
    stated, found = (_with_tuples(each) for each in (noise, level))
    return Level(Noise(**stated), **found)


def _with_tuples(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
