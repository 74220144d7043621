"""What a smoother knows, in a form that another smoother, or another process, can go on from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Factor
from alidade.pipelines.solvers.marginals import IndeterminateError, explain, ordering_of


@dataclass(frozen=True)
class State:
    """A Gaussian over some variables, everything else marginalised out.

    Attributes:
        time: s, of the last step that went into it.
        values: of the variables, about which it is linear.
        linear: its square root, rows R dx = d.
        stamps: variable -> time of last use, of those that age.
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
    ) -> State:
        """The marginal of a linear system about the values.

        Raises:
            IndeterminateError: a variable that is marginalised out is not determined.
        """
        kept = set(keys)
        rest = [key for key in linear.keyVector() if key not in kept]
        try:
            # By QR: tight processes beside loose priors cost Cholesky its digits.
            remaining = linear.eliminatePartialMultifrontal(rest, gtsam.EliminateQR)[1] if rest else linear
            conditional, _ = gtsam.EliminateQR(remaining, ordering_of(keys))
        except RuntimeError as error:
            raise IndeterminateError(explained(error)) from None
        held = gtsam.Values()
        for key in keys:
            _copy(values, key, held)
        return cls(time, held, gtsam.JacobianFactor(conditional), {k: t for k, t in stamps.items() if k in kept})

    @property
    def estimate(self) -> gtsam.Values:
        """The mean."""
        graph = gtsam.GaussianFactorGraph()
        graph.add(self.linear)
        return self.values.retract(graph.optimize(ordering_of(self.linear.keys()), gtsam.EliminateQR))

    @property
    def factor(self) -> Factor:
        """The Gaussian as a factor of the graph."""
        return Factor("prior", gtsam.LinearContainerFactor(self.linear, self.values))


def _copy(values: gtsam.Values, key: int, out: gtsam.Values) -> None:
    try:
        out.insert(key, values.atRot3(key))
    except RuntimeError:
        out.insert(key, values.atVector(key))


def require_known(factors: Iterable[Factor], values: gtsam.Values, time: float) -> None:
    """Raise InputError if a factor asks for a variable that is not there."""
    for f in factors:
        for key in f.factor.keys():
            if not values.exists(key):
                raise InputError(
                    f"{f.family} at {time:.3f} s needs the state {gtsam.Symbol(key).string()}, which the smoother has "
                    "forgotten: give it a longer --window"
                )


def require_sound(factors: Sequence[Factor], values: gtsam.Values, time: float) -> None:
    """Look at factors before they enter a smoother, which an exception or a NaN would spoil.

    Raises:
        InputError: a factor asks for a variable that is not there, or its residual or Jacobian is not finite.
    """
    require_known(factors, values, time)
    for f in factors:
        linear = f.linearized(values)
        if linear is not None and not np.isfinite(linear.augmentedJacobian()).all():
            moment = time if f.measurement is None else float(f.measurement.model.time[0])
            raise InputError(
                f"{f.family} at {moment:.3f} s: residual or Jacobian is not a finite number; look for NaN, infinite or "
                "absurd values in the recording around that time"
            )


def explained(error: Exception) -> str:
    """A sentence from what gtsam says of a singular system."""
    return explain(str(error))
