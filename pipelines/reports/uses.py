"""Uncertainty in use of a calibration: bands of the method's uses, from the joint covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from alidade.factors.array import Array
from alidade.pipelines.diagnostics.use import Posterior, Truth, UseBands, use_bands
from alidade.pipelines.methods.formula import Formula, results
from alidade.pipelines.reports.result import Calibration, quantities_of

# An error in use below this, in the unit shown, is rounding: nothing that was estimated has to do with that use.
_ROUNDING = 1e-9


class AppliedFormulas:
    """Formulas with values of parameters; parameters without a value count as zero."""

    def __init__(self, formulas: Sequence[Formula], values: Mapping[str, float], others: Mapping[str, float]) -> None:
        self.values = values
        self._formulas, self._all = formulas, {**others, **values}
        self._first = {"temperature": others["first_temperature"]} if "first_temperature" in others else {}

    def __call__(self, **measured: Array) -> Mapping[str, Array]:
        """Compute the formulas from measured arrays, at the first temperature."""
        found = results(self._formulas, self._all, {**measured, **self._first})
        return {name: value.array for name, value in found.items()}


def uses_of(calibration: Calibration) -> tuple[UseBands, ...]:
    """Return the error bands of all uses of the method; none without a solution."""
    c = calibration
    if not c.estimate.converged or not np.isfinite(c.covariance).all():
        return ()
    posterior, noise = posterior_of(c), {noise.name: noise.used for noise in c.noises}
    known = {**c.problem.constants, **c.values}
    true = Truth([*known], np.array([*known.values()]))
    found = []
    for use in c.method.report.uses(true, c.config, noise):
        with suppress(KeyError):  # its formulas need what this graph has not got
            found.append(use_bands(use, posterior))
    return tuple(each for each in found if max(each.before, each.after) > _ROUNDING)


def posterior_of(c: Calibration) -> Posterior:
    """Return the posterior of the parameters that the formulas apply."""
    quantities, known = quantities_of(c.problem, c.estimate), c.application()
    gains = {q.name: q for q in quantities if len(q.name) > 4 and q.name[-4:-2] == "_k"}
    plain = all(q.unit in ("", "1") for q in gains.values())
    nominal = {
        q.name: (float(q.name[-1] == q.name[-2]) if q.name in gains else 0.0) if plain else q.prior_mean
        for q in quantities
        if q.group is None and q.name in known.values
    }
    truth = None
    if c.truth is not None:
        stated = {name: value for name, value in c.truth.items() if isinstance(value, int | float)}
        truth = np.array([stated.get(name, value) for name, value in c.values.items()], dtype=float)
    require = [q.require if q.judged and np.isfinite(q.require) else 0.0 for q in quantities]
    return Posterior(
        names=c.estimate.names,
        x=c.estimate.values,
        P=c.covariance,
        require=np.array(require),
        applied=AppliedFormulas(known.formulas, known.values, known.constants),
        nominal=AppliedFormulas(known.formulas, nominal, known.constants),
        whole=AppliedFormulas(known.whole, c.values, known.constants),
        truth=truth,
    )
