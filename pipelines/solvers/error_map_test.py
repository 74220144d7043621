"""Score test of errors that depend on where measurements are made, see estimation.error_map.

About a solution without a map its numbers c are more shared unknowns of the linear system. Everything else eliminated,
what is left is R c = d, without the prior of c, sigma p. Of the directions of c that the recording determines better
than the prior does, singular values of R above 1 / p, the squares of d, over the square of what coloured residuals
widen sigmas by, sum to chi-square under the model (Rao, Proc. Camb. Phil. Soc. 1948).

Where the sum is significant, c is freed. What it trades with is then known as well as its prior says, which must not
be smaller than the map: p is at least the rms of the map that makes d most likely. A map that moves nothing has that
rms, or `ErrorMap.least`. What was solved for moves as it does with c, where no other error can be mistaken for a map,
and its covariance grows by what c adds. Noise levels, rejected measurements and residuals stay those without the map.

Where it is not, a map may still be there: what it has in common with a mount or a scale shows in no residual. The
covariance grows by one of rms `ErrorMap.least`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.factors.chi_square import quantile
from alidade.pipelines import deadline
from alidade.pipelines.estimation.error_map import SOURCE, ErrorMap, FoundMap
from alidade.pipelines.estimation.problem import Estimate, History, PosteriorHistory, Problem, SqrtInformation
from alidade.pipelines.estimation.widening import widened
from alidade.pipelines.solvers.chain import IndeterminateStateError
from alidade.pipelines.solvers.engines import Compiled
from alidade.pipelines.solvers.error_budget import sigma_ratio
from alidade.pipelines.solvers.freed import at_solution
from alidade.pipelines.solvers.layout import Values
from alidade.pipelines.solvers.levenberg import LevenbergConfig, Solution, minimize
from alidade.pipelines.solvers.linearization import Group, Linearization
from alidade.pipelines.solvers.posterior import sqrt_information, without_priors
from alidade.pipelines.solvers.posterior_history import posterior_history, smoothed
from alidade.pipelines.solvers.weak_directions import Posterior, constrained_solution

# Share of recordings without such errors in which they are found.
FALSE_ALARMS = 1e-2
_WHAT = "the test for errors that depend on the attitude"
# Iterations with a map, which is linear: three or four on real recordings, hundreds in a wrong model.
_MINIMISATION = LevenbergConfig(15)
# Sigmas that the numbers of a map may have, in those of their prior.
_SIGMAS = np.append(0.0, np.geomspace(1e-2, 1e3, 500))


def with_error_map(problem: Problem, posterior: Posterior, estimate: Estimate) -> Estimate:
    """Test for systematic errors by position and, if significant, re-estimate with their map.

    Args:
        problem: as it was solved, without a map.
        posterior: of the solution, rejected measurements left out.
        estimate: the same as reported.
    """
    engine, values = posterior.at.engine, posterior.at.values
    error_map = problem.error_map(estimate) if problem.error_map is not None and estimate.converged else None
    if error_map is None or not engine.is_chain or deadline.passed(_WHAT):
        return estimate
    mapped, at = _mapped(engine, values, error_map)
    k, ratio = len(error_map.names), estimate.widest(problem.quantities)
    root = mapped.at(at)[0].root()
    chi_square, dof, _ = _tested(root[-k - 1 :, -k - 1 :], error_map, ratio)
    found = None
    if chi_square > quantile(1.0 - FALSE_ALARMS, dof):
        try:
            found = _freed(problem, error_map, posterior, estimate, ratio)
        except (IndeterminateStateError, np.linalg.LinAlgError):
            deadline.passed(_WHAT)
    if found is not None or not error_map.least:
        return found or estimate
    return _covered(problem, error_map, posterior, estimate, root)


def _covered(problem: Problem, error_map: ErrorMap, posterior: Posterior, estimate: Estimate, root: Array) -> Estimate:
    """Add the least error map to an estimate's covariance, by R of the linear system with the map as last unknowns.

    The square-root information has no priors of the device, without which the map trades with more.
    """
    apart = None
    if (information := estimate.sqrt_info) is not None:
        at, device = posterior.at, np.array(information.names)[(information.prior_R != 0.0).any(axis=0)].tolist()
        engine, *_ = without_priors(problem, posterior.reported, at.engine, at.values, device)
        mapped, values = _mapped(engine, at.values, error_map)
        apart = _least(error_map, posterior, mapped.at(values)[0].root())
    return widened(estimate, SOURCE, _least(error_map, posterior, root), apart=apart)


def _least(error_map: ErrorMap, posterior: Posterior, root: Array) -> Array:
    """Columns S (n, k): the least error map adds S S' to the covariance, by R with the map as last unknowns."""
    k, reported = len(error_map.names), posterior.reported
    moves = -np.linalg.lstsq(root[: -k - 1, : -k - 1], root[: -k - 1, -k - 1 : -1], rcond=None)[0]
    columns, names = np.zeros((len(reported.names), k)), [reported.names[i] for i in reported.free]
    gain = _along_strong(reported.jacobian[reported.free] @ moves, names, posterior)
    columns[reported.free] = gain @ _spread(root[-k - 1 : -1, -k - 1 : -1], error_map.least)
    return columns


def _freed(
    problem: Problem, error_map: ErrorMap, without: Posterior, estimate: Estimate, ratio: float
) -> Estimate | None:
    """Re-estimate with the error map as free parameters, its prior at least as wide as the map's rms, or that rms.

    Directions that are weak `without` the map keep their values. A map that moves a required number by more than the
    sigma of its default prior takes that number's place, as where a device hardly turns, and is no error: the estimate
    stays: None. Moves beyond a prior known from an earlier calibration are what such errors do.
    """
    compiled, solution, information = _solved(problem, error_map, estimate)
    if not solution.converged:
        deadline.passed(_WHAT)
        return None
    chi_square, dof, rms = _tested(_rows(information, error_map)[1], error_map, ratio)
    if rms == 0.0 and not error_map.moves:
        return None
    if rms > error_map.prior or not error_map.moves:
        error_map = replace(error_map, prior=max(rms, error_map.least))
        near = replace(estimate, names=information.names, values=information.at)
        compiled, solution, information = _solved(problem, error_map, near)
    if not solution.converged:
        deadline.passed(_WHAT)
        return None
    posterior = constrained_solution(compiled, solution)
    at = dict(zip(posterior.reported.names, posterior.reported.numbers.tolist(), strict=True))
    shift = np.array([at[name] for name in estimate.names]) - estimate.values
    required = {q.name: q.prior_scale for q in problem.quantities if q.required}
    if any(abs(by) > required.get(name, np.inf) for name, by in zip(estimate.names, shift.tolist(), strict=True)):
        return None
    rows, root = _rows(information, error_map)
    p, own = len(rows) - len(root), _own(information, error_map)
    # Given the map the numbers move by -R_xx^-1 R_xc c; with its prior the information on c is R_cc' R_cc + 1 / p^2.
    gain = np.asarray(-np.linalg.lstsq(rows[:p, :p], rows[:p, p:-1], rcond=None)[0], dtype=float)
    others = [name for name, is_own in zip(information.names, own, strict=True) if not is_own]
    gain = _along_strong(_along_strong(gain, others, posterior), others, without)
    columns, rows_of = np.zeros((len(estimate.names), len(root) - 1)), [estimate.names.index(n) for n in others]
    columns[rows_of] = gain @ _spread(root[:-1, :-1], error_map.prior)
    weak = np.zeros_like(shift)
    weak[rows_of] = shift[rows_of] - _along_strong(shift[rows_of, None], others, without)[:, 0]
    found = FoundMap(
        error_map,
        error_map.error(information.at[own]),
        chi_square,
        dof,
        estimate.names,
        shift - weak,
        columns,
    )
    out = replace(found.applied(estimate), error_map=found)
    return _with_history(out, compiled, posterior, weak) if error_map.moves else out


def _spread(root: Array, prior: float) -> Array:
    """Root S (k, k) of the covariance S S' of a map's numbers, from rows R (k, k) about them and their prior sigma."""
    return np.asarray(np.linalg.inv(np.linalg.qr(np.concatenate([root, np.eye(len(root)) / prior]), mode="r")))


def _along_strong(gain: Array, names: Sequence[str], posterior: Posterior) -> Array:
    """Project moves (n, k) of the numbers on the strong directions; weak ones stay at their priors."""
    reported, weak = posterior.reported, posterior.directions.weak
    if not weak.shape[1]:
        return gain
    free = [reported.names[i] for i in reported.free]
    at = [free.index(name) for name in names]
    axes, scale = np.linalg.qr(weak[at])[0], reported.scale[at][:, None]
    return np.asarray(gain - scale * (axes @ (axes.T @ (gain / scale))))


def _solved(problem: Problem, error_map: ErrorMap, estimate: Estimate) -> tuple[Compiled, Solution, SqrtInformation]:
    """Minimise with the error map free; return the minimum and its information without the map's prior.

    Noise levels that contain the map would make it smaller, and are found anew.
    """
    compiled, engine, values = at_solution(error_map.added_to(problem), estimate)
    solution = minimize(engine, values, _MINIMISATION)
    return compiled, solution, sqrt_information(compiled, engine, solution.values, error_map.names)


def _own(information: SqrtInformation, error_map: ErrorMap) -> NDArray[np.bool_]:
    return np.array([name in error_map.names for name in information.names])


def _rows(information: SqrtInformation, error_map: ErrorMap) -> tuple[Array, Array]:
    """Triangle [others | map | right side], the map's right side about zero, and its block about the map alone."""
    own = _own(information, error_map)
    right = information.d + information.R[:, own] @ information.at[own]
    rows = np.column_stack([information.R[:, ~own], information.R[:, own], right])
    rows = np.pad(rows, ((0, max(0, rows.shape[1] - len(rows))), (0, 0)))
    rows = np.asarray(np.linalg.qr(rows, mode="r"), dtype=float)
    return rows, rows[-own.sum() - 1 :, -own.sum() - 1 :]


def _with_history(estimate: Estimate, compiled: Compiled, posterior: Posterior, weak: Array) -> Estimate:
    """Replace an estimate's history by that of the solution with the map, which is free of the map's errors.

    The solution is off by `weak` (n,) along directions that are weak without the map.
    """
    n = len(estimate.names)
    bias = smoothed(compiled, posterior, posterior.covariance)
    if bias is not None:
        bias = History(bias.time, bias.values[:, :n] - weak, bias.sigmas[:, :n])
    history = estimate.posterior_history and posterior_history(compiled, posterior)
    if history is None:
        return replace(estimate, smoothed=bias)
    own = PosteriorHistory(
        history.time, history.values[:, :n] - weak, history.covariance[:, :n, :n], history.steady[:n]
    )
    wide = sigma_ratio(np.diag(own.covariance[-1]), np.diag(estimate.covariance))
    return replace(estimate, smoothed=bias, posterior_history=own, history=own.history.inflated(wide))


def _tested(root: Array, error_map: ErrorMap, ratio: float) -> tuple[float, int, float]:
    """Chi-square, degrees of freedom and most likely rms of an error map with rows [R | d] (k + 1, k + 1)."""
    U, sizes, _ = np.linalg.svd(root[:-1, :-1] * error_map.prior)
    squares, seen = np.square(U.T @ root[:-1, -1] / ratio), sizes > 1.0
    variances = 1.0 + np.square(_SIGMAS[:, None] * sizes / ratio)
    likely = _SIGMAS[np.argmin((np.log(variances) + squares / variances).sum(axis=1))]
    rms = np.sqrt(error_map.functions.shape[1]) * error_map.prior * likely
    return float(squares[seen].sum()), int(seen.sum()), float(rms)


def _mapped(engine: Linearization, values: Values, error_map: ErrorMap) -> tuple[Linearization, Values]:
    """Add an error map to a linearisation as its last shared unknowns, at 0 and without a prior."""
    (_, d, _, c, s), k = engine.layout.sizes, len(error_map.names)
    layout, values, at = engine.layout.with_shared(values, k, np.zeros(k))
    begin = {"state": d + c + s, "pair": 2 * d + c + s, "walk": 2 * c + s, "shared": s}

    def added(group: Group) -> Group:
        model = error_map.of_model(group.family, group.model)
        if model is None:
            return group
        if group.weights is not None:
            model = model.at_noise(group.weights)
        columns = begin[group.target] + np.arange(k)
        return replace(
            group,
            model=model,
            gather=[*group.gather, (k, layout.row[[at]])],
            at=[*group.at, np.array([at])],
            columns=[*group.columns, [columns[None]]],
            deviates=[*group.deviates, np.array([False])],
        )

    return replace(engine, layout=layout, groups=[added(group) for group in engine.groups]), values
