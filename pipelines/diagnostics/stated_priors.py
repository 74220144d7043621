"""Numbers that the config fixes or data sheets state, against what the recording says of them: score tests.

With H, g the information of a graph in which they are free, linear about the solution with them fixed, A the numbers
that are free there and j a fixed one, the estimate of j alone freed is

    x_j = (g_j - H_jA H_AA^-1 g_A) / I_j,    I_j = H_jj - H_jA H_AA^-1 H_Aj,    sigma^2 = 1 / I_j

(Rao's score test: x_j^2 I_j is chi-square of one degree of freedom). The worst one is freed, and the others are tested
again, so that what explains a misfit is named once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from alidade.factors.array import Array, Mask
from alidade.pipelines.diagnostics.diagnose import LIMITS
from alidade.pipelines.diagnostics.observability import UNCHANGED
from alidade.pipelines.estimation.finding import Finding, Severity
from alidade.pipelines.estimation.parameters import prior_z_scores
from alidade.pipelines.estimation.problem import Estimate, Quantity, SqrtInformation
from alidade.pipelines.estimation.widening import by_wider_priors, widened
from alidade.pipelines.settings import Config

# In an error budget.
CONFLICT = "data sheets that the recording contradicts"


def with_conflicts(estimate: Estimate, quantities: Sequence[Quantity], conflicts: Sequence[Finding]) -> Estimate:
    """Widen an estimate's covariance by what prior conflicts cost that are notes.

    A prior that is contradicted draws all that is correlated with it to where the truth is not. What a data sheet
    states of one number it states of all of that figure: the priors of all of them are widened by the largest z-score,
    and both the variance that this adds and the shift are added. Of numbers of which the recording shows next to
    nothing a conflict costs nothing: its z-score is one of small differences of sigmas. The square-root information for
    joint calibrations is left: priors are no part of it.

    Args:
        estimate: of n numbers.
        quantities: in its order.
        conflicts: findings of `diagnose.prior_conflicts`; where one is no note, the values are not to be used.
    """
    if any(each.severity != Severity.NOTE for each in conflicts):
        return estimate
    z: dict[str, float] = {}
    for e in (each.evidence for each in conflicts):
        for q in quantities:
            if q.name in (e["parameter"], *e["inseparable"]) and e["sigma"] < UNCHANGED * q.scale:
                z[q.sheet or q.name] = max(z.get(q.sheet or q.name, 1.0), abs(e["z"]))
    times = np.array([z.get(q.sheet or q.name, 1.0) if q.prior_sigma else 1.0 for q in quantities])
    by = estimate.widenings
    white = estimate.covariance / np.outer(by, by)
    wider = by_wider_priors(quantities, times, estimate.values[None], white[None])
    if wider is None:
        return estimate
    columns = np.column_stack([by[:, None] * wider[1][0], wider[0][0]])
    z_scores = tuple(prior_z_scores(estimate, quantities))
    return replace(widened(estimate, CONFLICT, columns), sqrt_info=estimate.sqrt_info, prior_z=z_scores)


def freed_config(config: Config, quantities: Sequence[Quantity]) -> Config | None:
    """Return the config with all fixed and tightly stated parameters free; None if none is fixed.

    Args:
        config: in force.
        quantities: of its graph; what is not among them is fixed.
    """
    known = {q.name: q for q in quantities}
    tight = [name for name in config.priors if name in known and known[name].tight]
    fixed = [name for name in config.priors if config.prior(name, None) == 0.0]
    sheets = {}
    for name in config.sensors.model_fields_set:
        sheet = getattr(config.sensors, name)
        exact = [figure for figure in sheet.model_fields_set if getattr(sheet, figure) == 0.0]
        if exact:
            sheets[name] = sheet.model_copy(update=dict.fromkeys(exact))
    if not fixed and not sheets:
        return None
    priors = {**config.priors, **dict.fromkeys(fixed + tight)}
    return config.model_copy(update={"priors": priors, "sensors": config.sensors.model_copy(update=sheets)})


def contradictions(
    sqrt_info: SqrtInformation,
    freed: Sequence[Quantity],
    quantities: Sequence[Quantity],
    ratio: float,
) -> tuple[Finding, ...]:
    """Findings of kind `contradiction`: fixed numbers that the recording contradicts, the worst first.

    INCONSISTENT where freeing it shifts a required parameter by half of what is required, else a NOTE.

    Args:
        sqrt_info: information of the graph in which they are free, about the solution with them fixed.
        freed: quantities of that graph.
        quantities: as they were solved for; what is not among them is fixed.
        ratio: of sigmas to those for white noise of the model.
    """
    known = {q.name: q for q in freed}
    free = {q.name for q in quantities if q.prior_sigma != 0.0}
    inside = np.array([name in free for name in sqrt_info.names])
    found: list[Finding] = []
    while not inside.all():
        gain, x, information, correlation = _each_freed(sqrt_info, inside)
        z = x * np.sqrt(information) / ratio
        worst = int(np.argmax(np.abs(z)))
        if abs(z[worst]) < LIMITS.prior_z:
            break
        fixed = np.flatnonzero(~inside)
        j, shifts = fixed[worst], np.zeros(len(inside))
        shifts[inside], shifts[j] = -gain[:, worst] * x[worst], x[worst]
        shifts *= sqrt_info.scales
        effect = {
            name: float(shifts[i]) for i, name in enumerate(sqrt_info.names) if known[name].required and shifts[i]
        }
        material = any(abs(shift) >= LIMITS.material * known[name].require for name, shift in effect.items())
        alike = fixed[np.abs(correlation[worst]) > LIMITS.inseparable]
        evidence = {
            "parameter": sqrt_info.names[j],
            "unit": known[sqrt_info.names[j]].unit,
            "stated": float(sqrt_info.at[j]),
            "value": float(sqrt_info.at[j] + shifts[j]),
            "sigma": float(ratio * sqrt_info.scales[j] / np.sqrt(information[worst])),
            "z": float(z[worst]),
            "inseparable": tuple(sorted(sqrt_info.names[k] for k in alike if k != j)),
            "effect": effect,
        }
        found.append(Finding("contradiction", Severity.INCONSISTENT if material else Severity.NOTE, evidence))
        inside[j] = True
    return tuple(found)


def _each_freed(sqrt_info: SqrtInformation, inside: Mask) -> tuple[Array, Array, Array, Array]:
    """Free each of f fixed numbers by itself: gain (a, f), value (f,), information (f,), correlations (f, f)."""
    R, a = sqrt_info.R * sqrt_info.scales, int(inside.sum())
    rows = np.column_stack([R[:, inside], R[:, ~inside], sqrt_info.d])
    T = np.asarray(np.linalg.qr(rows, mode="r"), dtype=float)
    gain: Array = np.linalg.lstsq(T[:a, :a], T[:a, a:-1], rcond=None)[0]
    own, right = T[a:, a:-1], T[a:, -1]
    H: Array = own.T @ own
    information: Array = np.maximum(np.diag(H), np.finfo(float).tiny)
    return gain, own.T @ right / information, information, H / np.sqrt(np.outer(information, information))
