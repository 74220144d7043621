"""Several files as one recording: the parts of a bag that was split, or files recorded side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from alidade.pipelines.recording.container import Channel, Container, Rows, Schema, sha256_together
from alidade.pipelines.recording.data_loss import DataLoss

# Ids of channels and schemas in a part; each part has its own range of them.
_IDS = 1 << 32


class Parts(Container):
    """Containers in the order of their first messages.

    Args:
        path: of the folder, or of the first part.
        parts: the containers.
    """

    def __init__(self, path: Path, parts: Sequence[Container]) -> None:
        self.path, self.data = path, path
        self.parts = sorted(parts, key=lambda part: part.first_log_ns)
        self.remarks = tuple(f"{part.path.name}: {remark}" for part in self.parts for remark in part.remarks)
        self.profile = next((part.profile for part in self.parts if part.profile), "")
        self.channels: Mapping[int, Channel] = {
            i * _IDS + number: channel._replace(id=i * _IDS + number, schema_id=i * _IDS + channel.schema_id)
            for i, part in enumerate(self.parts)
            for number, channel in part.channels.items()
        }
        self.schemas: Mapping[int, Schema] = {
            i * _IDS + number: schema for i, part in enumerate(self.parts) for number, schema in part.schemas.items()
        }

    @property
    def counts(self) -> dict[int, int]:  # type: ignore[override]
        """Channel -> messages that can be read, as far as is known."""
        return {i * _IDS + number: n for i, part in enumerate(self.parts) for number, n in part.counts.items()}

    @property
    def losses(self) -> list[DataLoss]:  # type: ignore[override]
        """Of all parts."""
        return [loss for part in self.parts for loss in part.losses]

    @property
    def missing(self) -> dict[str, int]:
        """Topic -> messages known to be lost."""
        missing: dict[str, int] = {}
        for part in self.parts:
            for topic, n in part.missing.items():
                missing[topic] = missing.get(topic, 0) + n
        return missing

    @property
    def attachments(self) -> tuple[str, ...]:
        """Names of the attachments."""
        return tuple(dict.fromkeys(name for part in self.parts for name in part.attachments))

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """The attachment of that name in the first part that has one."""
        for part in self.parts:
            if name in part.attachments:
                return part.attachment(name, needed)
        return None

    def rows(self, channels: set[int]) -> Iterator[Rows]:
        """The messages of these channels, part by part."""
        for i, part in enumerate(self.parts):
            wanted = {number - i * _IDS for number in channels if number // _IDS == i}
            for rows in part.rows(wanted) if wanted else ():
                yield rows._replace(channel=i * _IDS + rows.channel)

    def notes(self, start_ns: int | None, duration_s: float = 0.0) -> tuple[str, ...]:
        """Sentences about what is lost, of each part under its name."""
        notes = (f"{part.path.name}: {note}" for part in self.parts for note in part.notes(start_ns, duration_s))
        return tuple(notes)

    def sha256(self) -> str:
        """SHA-256 of the parts' own digests (their 32 bytes each), in the order of the parts."""
        return sha256_together(part.sha256() for part in self.parts)
