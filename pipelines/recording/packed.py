"""Messages that a recorder compressed one by one, as `compression_mode: message` of rosbag2 does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import zstandard

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.container import Container, Rows, rows_of
from alidade.pipelines.recording.data_loss import DataLoss

# No message of a sensor is larger.
_LARGEST = 1 << 26


class PackedMessages(Container):
    """A container whose messages are zstd frames, unpacked.

    Reading raises InputError at one that is damaged: nothing tells how many others are.
    """

    def __init__(self, packed: Container) -> None:
        self._packed = packed
        self.path, self.data, self.profile = packed.path, packed.data, packed.profile
        self.channels, self.schemas, self.counts = packed.channels, packed.schemas, packed.counts
        self.unpacked = packed
        self.remarks = packed.remarks

    @property
    def losses(self) -> Sequence[DataLoss]:  # type: ignore[override]
        """Of the container."""
        return self._packed.losses

    @property
    def missing(self) -> dict[str, int]:
        """Of the container."""
        return self._packed.missing

    @property
    def attachments(self) -> tuple[str, ...]:
        """Of the container."""
        return self._packed.attachments

    def attachment(self, name: str, needed: bool = True) -> bytes | None:
        """Of the container."""
        return self._packed.attachment(name, needed)

    def sha256(self) -> str:
        """Of the container."""
        return self._packed.sha256()

    def rows(self, channels: set[int]) -> Iterator[Rows]:
        """The messages, unpacked."""
        unpacker = zstandard.ZstdDecompressor()
        for rows in self._packed.rows(channels):
            try:
                messages = [_unpack(unpacker, rows.message(i)) for i in range(len(rows.start))]
            except (zstandard.ZstdError, MemoryError, ValueError) as error:
                topic = self.channels[rows.channel].topic
                raise InputError(f"{self.path}: topic {topic}: a compressed message is damaged ({error})") from error
            yield rows_of(rows.channel, messages, rows.log_ns)

    def notes(self, start_ns: int | None, duration_s: float = 0.0) -> tuple[str, ...]:
        """Of the container."""
        return self._packed.notes(start_ns, duration_s)


def _unpack(unpacker: zstandard.ZstdDecompressor, message: bytes) -> bytes:
    size = zstandard.frame_content_size(message)
    if size > _LARGEST:
        raise ValueError(f"it says that it holds {size} bytes")
    return unpacker.decompress(message, max_output_size=_LARGEST)
