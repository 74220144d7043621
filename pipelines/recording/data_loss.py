"""What a damaged or unfinished recording has lost, and how that is said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

# Times stated by damaged bytes are believed within so much of the recording, s.
_NEAR = 3600.0

Kind = Literal["cut", "damage", "summary", "definition", "attachment"]


@dataclass(frozen=True)
class DataLoss:
    """A stretch of a file that cannot be used.

    Attributes:
        kind: the file ends too early; bytes are damaged; the summary after the data is damaged or missing, which loses
            no message; messages whose channel is defined nowhere (size: their number); an attachment (reason:
            its name).
        at: first byte of the stretch.
        size: bytes.
        chunks: chunks known to be in it.
        span: log times, Unix ns, of the first and the last message, as the file states them; None if unknown.
        reason: what is wrong with the bytes, as a part of a sentence.
    """

    kind: Kind
    at: int
    size: int
    chunks: int = 0
    span: tuple[int, int] | None = None
    reason: str = ""


def described(
    losses: Sequence[DataLoss], missing: Mapping[str, int], total: int, start_ns: int | None, duration_s: float
) -> tuple[str, ...]:
    """Sentences about what is lost, one a kind.

    Args:
        losses: of the file.
        missing: topic -> messages known to be lost.
        total: bytes of the file.
        start_ns: start of the session, Unix ns; None leaves out when the losses are.
        duration_s: length of what is left.
    """
    messages = f"; messages lost: {', '.join(f'{n} of {topic}' for topic, n in missing.items())}" if missing else ""
    notes = []
    damaged = [loss for loss in losses if loss.kind == "damage"]
    if damaged:
        size, chunks = sum(loss.size for loss in damaged), sum(loss.chunks for loss in damaged)
        what = f"{chunks} {'chunk' if chunks == 1 else 'chunks'}, " if chunks else ""
        notes.append(
            f"the recording is damaged: {what}{size} of {total} bytes from byte {damaged[0].at} on cannot be used"
            f" ({damaged[0].reason}){_when(damaged, start_ns, duration_s)}{messages}"
        )
        messages = ""
    for loss in losses:
        if loss.kind == "cut":
            lost = f", the last {loss.size} of {total} bytes cannot be used" if loss.size else ""
            when = _when([loss], start_ns, duration_s)
            notes.append(f"the recording is truncated: it ends without its closing records{lost}{when}{messages}")
            messages = ""
        elif loss.kind == "summary":
            notes.append(
                f"the recording's summary at byte {loss.at} cannot be used ({loss.reason}); no message is in it"
            )
        elif loss.kind == "attachment":
            notes.append(f"the attachment {loss.reason} is damaged and not used")
    undefined = sum(loss.size for loss in losses if loss.kind == "definition")
    if undefined:
        notes.append(f"the recording is damaged: {undefined} messages cannot be read, it does not define their channel")
    if messages:
        notes.append(f"the recording has fewer messages than it says{messages}")
    return tuple(notes)


def _when(losses: Sequence[DataLoss], start_ns: int | None, duration_s: float) -> str:
    """Where on the session's clock the losses are; nothing where that is unknown or cannot be."""
    if start_ns is None:
        return ""
    spans = [loss.span for loss in losses if loss.span is not None]
    times = [((a - start_ns) * 1e-9, (b - start_ns) * 1e-9) for a, b in spans if a <= b]
    near = [(a, b) for a, b in times if a > -_NEAR and b < duration_s + _NEAR]
    if not near:
        return ""
    return f", between {min(a for a, _ in near):.3f} and {max(b for _, b in near):.3f} s"
