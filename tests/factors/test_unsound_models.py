"""Models of what cannot be are refused when they are made, in one line that says which number of which model."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, X

import alidade.factors
from alidade.factors import AccelFactor, MagFactor, TriadPriorFactor, TruncatedLoss, so3
from alidade.factors.array import Array
from alidade.factors.model import Model, Residuals

N = 20
RNG = np.random.default_rng(0)
ATTITUDES = so3.exp(RNG.normal(size=(N, 3)))
UP = so3.rotate(so3.inverse(ATTITUDES), [0.0, 0.0, 9.81])
GOOD: dict[str, Any] = {
    "time": np.arange(float(N)),
    "raw": 1.02 * UP + [0.1, -0.2, 0.05] + 1e-3 * RNG.standard_normal((N, 3)),
    "sigma": np.full(N, 1e-3),
    "gravity": 9.81,
}


def _changed(values: Array, at: Any, to: float) -> Array:
    changed = values.copy()
    changed[at] = to
    return changed


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "NaN in one reading": ({"raw": _changed(GOOD["raw"], (3, 1), np.nan)}, "raw[3, 1] is nan; it must be finite"),
    "an infinite reading": ({"raw": _changed(GOOD["raw"], (0, 2), np.inf)}, "raw[0, 2] is inf"),
    "NaN as stamp": ({"time": _changed(GOOD["time"], 7, np.nan)}, "time[7] is nan"),
    "sigma 0": ({"sigma": 0.0 * GOOD["sigma"]}, "sigma[0] is 0; sigmas are larger than 0"),
    "sigma negative": ({"sigma": _changed(GOOD["sigma"], 5, -1e-3)}, "sigma[5] is -0.001"),
    "sigma NaN": ({"sigma": _changed(GOOD["sigma"], 5, np.nan)}, "sigma[5] is nan"),
    "raw 3 x n": ({"raw": GOOD["raw"].T}, "raw of 20 measurements has shape (3, 20), not (20, 3)"),
    "raw too short": ({"raw": GOOD["raw"][:-1]}, "raw of 20 measurements has shape (19, 3), not (20, 3)"),
    "sigma by axis": ({"sigma": np.full((N, 3), 1e-3)}, "sigma of 20 measurements has shape (20, 3), not (20,)"),
    "sigma one number": ({"sigma": 1e-3}, "sigma of 20 measurements has shape (), not (20,)"),
    "text": ({"raw": [["a"] * 3] * N}, "raw is no array of numbers"),
    "ragged lists": ({"raw": [[1.0, 2.0, 3.0]] * (N - 1) + [[1.0]]}, "raw is no array of numbers"),
    "temperature too long": (
        {"temperature": np.zeros(N + 1)},
        "temperature of 20 measurements has shape (21,), not (20,)",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_is_refused_when_the_model_is_made(case: str) -> None:
    changed, said = WRONG[case]
    with pytest.raises(ValueError, match=re.escape(f"AccelFactor: {said}")) as refused:
        AccelFactor(**{**GOOD, **changed})
    assert "\n" not in str(refused.value)


def test_other_ways_to_make_a_model_are_looked_at_too() -> None:
    with pytest.raises(ValueError, match=re.escape("AccelFactor: sigma[0] is 0")):
        replace(AccelFactor(**GOOD), sigma=np.zeros(N))
    with pytest.raises(ValueError, match=re.escape("MagFactor: raw of 2 measurements has shape (2, 2), not (2, 3)")):
        MagFactor(np.zeros(2), np.zeros((2, 2)), np.ones(2))


def test_an_infinite_sigma_says_that_nothing_is_known() -> None:
    TriadPriorFactor(np.zeros(1), np.zeros((1, 12)), np.full((1, 12), np.inf))


def test_lists_are_arrays() -> None:
    given = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in GOOD.items()}
    from_lists, from_arrays = _solved(AccelFactor(**given)), _solved(AccelFactor(**GOOD))
    np.testing.assert_array_equal(from_lists, from_arrays)
    assert from_arrays[0] == pytest.approx(1.02, abs=1e-3)


def _solved(model: AccelFactor) -> Array:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(model.on([X(k) for k in range(N)], A(0)).factor)
    for k in range(N):
        attitude = so3.to_gtsam(ATTITUDES[k])
        graph.add(gtsam.PriorFactorRot3(X(k), attitude, gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
        values.insert(X(k), attitude)
    values.insert(A(0), np.append(np.eye(3), np.zeros(3)))
    found: Array = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atVector(A(0))
    return found


@pytest.mark.parametrize("loss", [5.0, "huber", gtsam.noiseModel.mEstimator.Huber.Create(1.0)])
def test_a_loss_of_another_make_is_refused_with_the_name_of_ours(loss: Any) -> None:
    with pytest.raises(ValueError, match=r"AccelFactor: the loss must be an alidade\.factors\.TruncatedLoss"):
        AccelFactor(**GOOD).on([X(k) for k in range(N)], A(0), loss=loss)


@pytest.mark.parametrize(("gate", "mu"), [(0.0, 1.0), (-1.0, 1.0), (np.nan, 1.0), (5.0, -1.0), (5.0, np.nan)])
def test_a_loss_that_cannot_be_is_refused(gate: float, mu: float) -> None:
    with pytest.raises(ValueError, match="TruncatedLoss: gate"):
        TruncatedLoss(gate, mu)


def test_every_model_with_a_sigma_says_its_shape() -> None:
    """So that the shape of whatever is new is looked at as well."""
    models = [getattr(alidade.factors, name) for name in alidade.factors.__all__]
    own: list[Any] = [
        model for model in models if isinstance(model, type) and issubclass(model, Model) and model is not Model
    ]
    assert len(own) > 8
    for model in own:
        if "sigma" in getattr(model, "stacked", ()):
            assert "sigma" in model.shapes, model


def test_a_model_of_ones_own_is_looked_at_as_ours_are() -> None:
    @dataclass(frozen=True)
    class Own(Model):
        time: Array
        measured: Array
        rows: int = 1
        blocks = (1,)

        def __call__(self, x: Array) -> Residuals:
            return x - self.measured, lambda: (np.ones((len(x), 1, 1)),)

    with pytest.raises(ValueError, match=re.escape("Own: measured[1, 0] is nan")):
        Own(np.zeros(2), np.array([[0.0], [np.nan]]))
