"""Files that grow: what is read of them by pieces is what is read of them at once."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.summary import Summary
from mcap.writer import Writer

from alidade.pipelines.errors import InputError
from alidade.pipelines.recording.growing import GrowingFiles
from alidade.pipelines.recording.mcap_writer import write_session
from alidade.pipelines.recording.recording import Recording, open_recording
from tests.support.live import messages, write
from tests.support.recorded import session


@pytest.mark.parametrize(("chunk_size", "count"), [(1, 40), (3_000, 200), (1 << 20, 200)])
def test_what_grew_by_pieces_is_the_whole(tmp_path: Path, chunk_size: int, count: int) -> None:
    write_session(tmp_path / "s.mcap", session(count))
    with (tmp_path / "whole.mcap").open("wb") as out:
        write(messages(tmp_path / "s.mcap"), out, chunk_size)
    content = (tmp_path / "whole.mcap").read_bytes()
    whole = open_recording(tmp_path / "whole.mcap")
    path, growing = tmp_path / "grows.mcap", GrowingFiles()
    ends = np.sort(np.random.default_rng(chunk_size).integers(9, len(content), 12)).tolist()
    seen = 0
    for end in [*ends, len(content)]:
        path.write_bytes(content[:end])
        try:
            recording = Recording(growing.refresh([path], None), whole.epoch_ns)
            imu = recording.imu("/imu")
        except InputError:
            assert seen == 0, "it could be read before"
            continue
        assert len(imu) >= seen
        seen = len(imu)
        for name in ("t_ns", "gyro", "accel"):
            np.testing.assert_array_equal(getattr(imu, name), getattr(whole.imu("/imu"), name)[:seen])
    assert seen == len(whole.imu("/imu"))


def test_the_end_alone(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", session(500))
    with (tmp_path / "whole.mcap").open("wb") as out:
        write(messages(tmp_path / "s.mcap"), out, 2_000)
    whole, growing = open_recording(tmp_path / "whole.mcap"), GrowingFiles()
    imu = whole.imu("/imu")
    for since in (imu.t_ns[len(imu) // 3], imu.t_ns[-10]):
        late = Recording(growing.refresh([tmp_path / "whole.mcap"], int(since)), whole.epoch_ns)
        end = late.imu("/imu")
        assert len(imu) > len(end) >= np.count_nonzero(imu.t_ns >= since)
        np.testing.assert_array_equal(end.gyro, imu.gyro[-len(end) :])
        assert late.epoch_ns == whole.epoch_ns


def test_a_damaged_chunk_is_left_out(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", session(500))
    with (tmp_path / "whole.mcap").open("wb") as out:
        write(messages(tmp_path / "s.mcap"), out, 2_000)
    content = bytearray((tmp_path / "whole.mcap").read_bytes())
    content[len(content) // 2 : len(content) // 2 + 4] = b"\xff\xff\xff\xff"
    (tmp_path / "whole.mcap").write_bytes(content)
    growing = GrowingFiles()
    for _ in range(3):
        late = Recording(growing.refresh([tmp_path / "whole.mcap"], None)).imu("/imu")
    wanted = open_recording(tmp_path / "whole.mcap").imu("/imu")
    np.testing.assert_array_equal(late.t_ns, wanted.t_ns)
    np.testing.assert_array_equal(late.gyro, wanted.gyro)


def test_a_damaged_last_chunk_is_one_loss_however_often_it_is_looked_at(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", session(500))
    with (tmp_path / "whole.mcap").open("wb") as out:
        write(messages(tmp_path / "s.mcap"), out, 2_000)
    path = tmp_path / "grows.mcap"
    content = bytearray((tmp_path / "whole.mcap").read_bytes())
    with (tmp_path / "whole.mcap").open("rb") as stream:
        last = get_summary(stream).chunk_indexes[-1]
    middle = last.chunk_start_offset + last.chunk_length // 2
    content[middle : middle + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(content[: last.chunk_start_offset + last.chunk_length])  # its index is not written yet
    growing = GrowingFiles()
    losses = [len(growing.refresh([path], None).losses) for _ in range(4)]
    assert losses == [1, 1, 1, 1]


def get_summary(stream: BinaryIO) -> Summary:
    summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary


def test_pictures_about_the_size_that_is_kept_come_in_their_order(tmp_path: Path) -> None:
    """Chunks of large messages are read one by one, those of small ones together; a topic has both."""
    with (tmp_path / "s.mcap").open("wb") as stream:
        writer = Writer(stream, chunk_size=60_000)
        writer.start()
        schema = writer.register_schema("Raw", "jsonschema", b"{}")
        channel = writer.register_channel("/pictures", "json", schema)
        for i in range(90):
            data = bytes(20_000 if i // 15 % 2 else 12_000)
            writer.add_message(channel, log_time=i * 10**7, data=data, publish_time=0)
        writer.finish()  # type: ignore[no-untyped-call]
    container = GrowingFiles().refresh([tmp_path / "s.mcap"], None)
    log_ns = np.concatenate([block.log_ns for block in container.blocks({channel})])
    np.testing.assert_array_equal(log_ns, np.arange(90) * 10**7)


def test_a_table_that_has_only_begun_may_still_become_a_recording(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("t,gx,gy,gz\n")
    with pytest.raises(InputError, match="no line of numbers") as caught:
        GrowingFiles().refresh([tmp_path / "s.csv"], None)
    assert type(caught.value) is InputError
