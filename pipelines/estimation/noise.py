"""The noises of a problem: what was stated of each, by whom, what the recording says, and what is used."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from alidade.pipelines.noises import NOISES, NoiseSpec

Source = Literal["config", "message", "default"]


# How well a noise is known, one sigma in its logarithm, that a message states or nobody. What the config states counts
# as known no better once the recording contradicts it by so many sigmas.
ROUGHLY, _APART = 1.0, 3.0
# Family of the transitions of an error that is correlated in time.
CORRELATED_ERROR = "correlated error"


@dataclass(frozen=True)
class Noise:
    """A noise of a problem, with its stated figure.

    Attributes:
        name: as in the config's section `noise`, where it is there.
        stated: its sigma or density before the recording is asked; typical where measurements differ.
        source: of the stated value.
        known: one sigma of its logarithm; 0: exactly.
        families: of measurements whose residuals estimate it; none: it is not estimated.
        rows: of each measurement that it is of; None: all.
        least: its level is never less than this over what is stated: what else than white noise is in a mean of many
            samples shows in few of them alike.
        beside: whether it is there beside the noise that its factors are whitened by, which say as `beside` how much
            of it they have: what means of many samples repeat to is more than white noise over their duration.
        own: declaration of a noise that only one method has.
        no_noise: beyond this it is no noise, in its unit; None: as declared.
        correlation_time: s, of a first-order Gauss-Markov process; None: it is white, or a walk.
    """

    name: str
    stated: float
    source: Source
    known: float
    families: tuple[str, ...] = ()
    rows: tuple[int, ...] | None = None
    least: float = 0.0
    beside: bool = False
    own: NoiseSpec | None = None
    no_noise: float | None = None
    correlation_time: float | None = None

    @property
    def spec(self) -> NoiseSpec:
        """Declaration of the noise: name, unit, description."""
        return self.own or NOISES.get(self.name) or NoiseSpec(self.name, "", "")

    @property
    def unit(self) -> str:
        """Unit of the noise: SI, or pixels."""
        return self.spec.unit

    @property
    def estimated(self) -> bool:
        """Whether the level of the noise is estimated from residuals."""
        return self.known > 0.0 and bool(self.families) and self.stated > 0.0


@dataclass(frozen=True)
class Level:
    """Estimated size of a noise, relative to the stated one.

    Attributes:
        noise: as it was stated.
        scale: what is used.
        found: what the recording alone says; None where it is not asked, or says nothing.
        sigma: one standard deviation of that.
        least: of a process that its sensor's own samples say is smaller than stated: how small, at most. Residuals
            estimate it in between, and never larger than stated: coloured noise of other sensors would
            raise it without bound. None: of no such process.
        effective: of a noise with others beside it: root mean square over the recording of all together, and one
            standard deviation. Each alone is known less well: they take each other's part.
    """

    noise: Noise
    scale: float = 1.0
    found: float | None = None
    sigma: float | None = None
    least: float | None = None
    effective: tuple[float, float] | None = None

    def over(self, correlation_time: float) -> Level:
        """Return the level with another correlation time, s."""
        return replace(self, noise=replace(self.noise, correlation_time=correlation_time))

    @property
    def contradicted(self) -> bool:
        """Whether the estimated level differs significantly from the stated one."""
        if self.found is None or self.sigma is None:
            return False
        return abs(float(np.log(self.found))) > _APART * float(np.hypot(self.noise.known, self.sigma / self.found))

    @property
    def together(self) -> Level:
        """Level of this noise and all additional noises of the same rows, as one."""
        if self.effective is None:
            return self
        size, sigma = self.effective
        return replace(self, scale=size, found=size, sigma=sigma)

    @property
    def known(self) -> float:
        """Sigma of the logarithm of the stated noise; wide when the recording contradicts the statement."""
        return max(self.noise.known, ROUGHLY) if self.contradicted else self.noise.known

    @property
    def used(self) -> float:
        """Noise level in use, in the unit of the noise."""
        return self.scale * self.noise.stated
