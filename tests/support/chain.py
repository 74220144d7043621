"""A chain of states with one calibrated number, small enough to be solved by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.factors.loss import TruncatedLoss
from alidade.factors.model import Block, Model, Residuals
from alidade.pipelines.estimation.priors import prior_of
from alidade.pipelines.estimation.problem import Factor, Parameter, Problem, Quantity, Step

PARAMETER = int(gtsam.symbol("p", 0))
WALK, START, NOISE, PRIOR = 0.3, 0.5, 0.2, 2.0
INTERVAL = 0.1


def state(k: int) -> int:
    return int(gtsam.symbol("s", k))


@dataclass(frozen=True)
class Line(Model):
    """Measurements z = s + h p of a walking number s, with a slope p (d,) of known rows h (n, d)."""

    time: Array
    h: Array
    z: Array
    rows: int = 1

    @property
    def blocks(self) -> tuple[Block, ...]:
        return (1, self.h.shape[1])

    def __call__(self, s: Array, p: Array) -> Residuals:
        predicted = s[:, 0] + (self.h * p).sum(axis=1)
        jacobians = (np.full((len(s), 1, 1), 1.0 / NOISE), self.h[:, None, :] / NOISE)
        return ((predicted - self.z) / NOISE)[:, None], lambda: jacobians


@dataclass(frozen=True)
class Walk:
    """A linear problem: parameter (d,), states that walk, one measurement a state."""

    h: Array
    z: Array
    prior: float | None = PRIOR

    @classmethod
    def random(cls, seed: int, h: Array | None = None, n: int = 60) -> tuple[Walk, Array]:
        """With data drawn from the model, priors included, and the true parameter."""
        rng = np.random.default_rng(seed)
        h = rng.standard_normal((n, 2)) if h is None else h
        p = PRIOR * rng.standard_normal(h.shape[1:])
        s = START * rng.standard_normal() + np.append(0.0, np.cumsum(WALK * rng.standard_normal(len(h) - 1)))
        return cls(h, s + h @ p + NOISE * rng.standard_normal(len(h))), p

    @property
    def parameter(self) -> Parameter:
        names = [f"slope_{i}" for i in range(self.h.shape[1])]
        return Parameter(PARAMETER, tuple(Quantity(name, "", self.prior, PRIOR, 0.5) for name in names))

    def problem(self, loss: TruncatedLoss | None = None) -> Problem:
        return Problem("linear", (self.parameter,), lambda chunk: self.steps(chunk, loss), loss)

    def steps(self, chunk: int, loss: TruncatedLoss | None) -> Iterator[Step]:
        first = self.step(range(1), loss)
        first.initial.insert(PARAMETER, np.zeros(self.h.shape[1]))
        start = gtsam.PriorFactorVector(state(0), np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, START))
        prior = prior_of(self.parameter)
        yield replace(first, factors=[prior, Factor("start", start), *first.factors])
        for begin in range(1, len(self.z), chunk):
            yield self.step(range(begin, min(begin + chunk, len(self.z))), loss)

    def step(self, frames: range, loss: TruncatedLoss | None) -> Step:
        initial = gtsam.Values()
        for k in frames:
            initial.insert(state(k), np.zeros(1))
        time = INTERVAL * np.array(frames)
        noise = gtsam.noiseModel.Isotropic.Sigma(1, WALK)
        walk = [
            Factor("walk", gtsam.BetweenFactorVector(state(k - 1), state(k), np.zeros(1), noise)) for k in frames if k
        ]
        model = Line(time, self.h[list(frames)], self.z[list(frames)])
        seen = model.on([state(k) for k in frames], PARAMETER, loss=loss)
        stamps = {state(k): float(t) for k, t in zip(frames, time, strict=True)}

        def predict(values: gtsam.Values) -> gtsam.Values:
            out = gtsam.Values()
            for k in frames:
                out.insert(state(k), values.atVector(state(frames.start - 1)))
            return out

        return Step(float(time[-1]), initial, [*walk, Factor.of("seen", seen)], predict, stamps)

    def whitened(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Rows A x - b of all unknowns x = (p, s), and which of them are priors on p."""
        n, d = self.h.shape
        walk = np.eye(n, k=0)[1:] - np.eye(n)[:-1]
        A = np.vstack(
            [
                np.eye(d, n + d) / (self.prior or np.inf),
                np.eye(1, n + d, d) / START,
                np.hstack([np.zeros((n - 1, d)), walk / WALK]),
                np.hstack([self.h, np.eye(n)]) / NOISE,
            ]
        )
        b = np.concatenate([np.zeros(d + 1 + n - 1), self.z / NOISE])
        return A, b, np.arange(len(b)) < d

    def closed_form(self) -> tuple[Array, Array, float]:
        """Value and covariance of the parameter, and the sum of squares without its priors."""
        A, b, prior = self.whitened()
        d = self.h.shape[1]
        covariance = np.asarray(np.linalg.inv(A.T @ A), dtype=float)
        x = covariance @ A.T @ b
        return x[:d], covariance[:d, :d], float((((A @ x - b)[~prior]) ** 2).sum())
