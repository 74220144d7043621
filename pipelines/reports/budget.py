"""Where the uncertainty of a parameter comes from, for people: sources named, small ones put together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from alidade.pipelines.estimation.parameters import kind
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.solvers.joint import RECORDING, WALK

_PRIOR = "prior of "
# Smaller shares are summed, and so are those after so many.
_LEAST, _MOST = 0.02, 4
REST = "everything else"


@dataclass(frozen=True)
class Limit:
    """What limits a parameter.

    Attributes:
        name: of the parameter.
        parts: source in words and its share of the variance, the largest first, the rest of them last.
        advice: what would make the largest smaller.
    """

    name: str
    parts: tuple[tuple[str, float], ...]
    advice: str

    @property
    def sentence(self) -> str:
        """The largest source and what to do about it."""
        source, share = self.parts[0]
        return f"{100.0 * share:.0f} % of the variance of {self.name}: {source}; {self.advice}"


def limits(budget: Mapping[str, Mapping[str, float]], quantities: Sequence[Quantity]) -> list[Limit]:
    """What limits each parameter of a budget (parameter -> source -> share), given the quantities of its problem."""
    assumed = {q.name for q in quantities if q.assumed}
    return [_limit(name, shares, assumed) for name, shares in budget.items()]


def _limit(name: str, shares: Mapping[str, float], assumed: set[str]) -> Limit:
    parts: dict[str, float] = {}
    advice: dict[str, str] = {}
    for source, share in shares.items():
        label, what = _described(name, source, assumed)
        parts[label] = parts.get(label, 0.0) + share
        advice.setdefault(label, what)
    order = sorted(parts.items(), key=lambda part: -part[1])
    kept = [part for i, part in enumerate(order) if i == 0 or (i < _MOST and part[1] >= _LEAST)]
    rest = sum(share for _, share in order[len(kept) :])
    last = [(REST, rest)] if rest > 0.0 else []
    return Limit(name, (*kept, *last), advice[kept[0][0]])


def _described(name: str, source: str, assumed: set[str]) -> tuple[str, str]:
    """A source in words, and what would make it smaller."""
    if source.startswith(RECORDING):
        return source, "record longer, or more often"
    if source == WALK:
        return source, "calibrate more often"
    if not source.startswith(_PRIOR):
        return f"{source} noise", "record longer, or measure it better"
    of = source.removeprefix(_PRIOR)
    kinds = ", ".join(dict.fromkeys(map(kind, of.split(", "))))
    if assumed.issuperset(of.split(", ")):
        return f"prior of {kinds}", "state its data sheet if yours is better, or move so that it shows"
    if of == name:
        return "its own prior", "the recording adds little to what was known"
    return f"prior of {kinds}", "know it better, or move so that it shows"
