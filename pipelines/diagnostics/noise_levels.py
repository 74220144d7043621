"""What noise levels that the recording contradicts do to a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from alidade.pipelines.diagnostics.observability import Consistency
from alidade.pipelines.estimation.noise import Level

# A noise found to be more than so many times the one stated, by so many sigmas, is no noise: the model lacks something.
# One that is far smaller spoils nothing once it is known.
_NO_NOISE, _SURE = 4.0, 3.0
# Processes are judged that have so many degrees of freedom of their own: of fewer, measurements' errors are most.
_ENOUGH = 100.0
# A level so many times larger or smaller than a data sheet says is told.
_WORTH_A_WORD = 2.0
# Residuals that go together for this part of the recording are no noise either.
_SLOW = 0.1
# A noise so many times larger than stated is worth looking for another cause.
_SUSPICIOUS = 1.5


def asked(levels: Sequence[Level]) -> bool:
    """Whether the recording was asked for noise levels, so that chi-square does not decide."""
    return any(level.noise.estimated for level in levels)


def suspicious(levels: Sequence[Level], colours: Mapping[str, float], counts: Mapping[str, int]) -> bool:
    """Whether measurements err by so much more than stated that another cause is to be looked for.

    White residuals are noise. Arguments as `misfit` has them.
    """
    told = [(level, counts.keys() & set(level.noise.families)) for level in levels]
    return any(
        level.found > (_SUSPICIOUS if colours.keys() & families else _NO_NOISE)
        for level, families in told
        if families and level.contradicted and level.found is not None
    )


def misfit(
    levels: Sequence[Level], consistency: Consistency | None, colours: Mapping[str, float], counts: Mapping[str, int]
) -> str:
    """A sentence where noise is none, since the model lacks something; else empty.

    Args:
        levels: of the noises.
        consistency: of the residuals at these levels.
        colours: family -> how many of its measurements in a row count as one.
        counts: family -> number of measurements.
    """
    sentences = [
        f"{level.noise.name} is found to be {level.found:.3g} times what the {level.noise.source} states: that is no "
        "noise, the model lacks something or the figure is not what it says"
        for level in levels
        if level.noise.source != "default" and _no_noise(level)
    ]
    told = {family for level in levels if level.least is None for family in level.noise.families}
    if consistency is not None and asked(levels):
        sentences += [
            f"the residuals of {family} are {fit.noise_factor:.3g} times as large as stated"
            for family, fit in consistency.families.items()
            if family not in told and fit.dof > _ENOUGH and fit.noise_factor > _NO_NOISE
        ]
    sentences += [
        f"the residuals of {family} go together for {100.0 * length / counts[family]:.0f} % of the recording: that is "
        "no noise, the model lacks something"
        for family, length in colours.items()
        if length > _SLOW * counts[family]
    ]
    text = "; ".join(sentences)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def remarks(levels: Sequence[Level]) -> tuple[str, ...]:
    """Sentences on what was stated otherwise than found, and what is used."""
    return tuple(
        f"{level.noise.name}: {level.used:.3g} {level.noise.unit} is used, {level.scale:.2g} times what the "
        f"{level.noise.source} states."
        for level in levels
        if level.noise.source != "default"
        and level.scale != 1.0
        and (level.contradicted or not 1.0 / _WORTH_A_WORD < level.scale < _WORTH_A_WORD)
    )


def _no_noise(level: Level) -> bool:
    if level.found is None or level.sigma is None or not level.noise.families:
        return False
    return level.found - _SURE * level.sigma > _NO_NOISE
