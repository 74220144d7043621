"""Damaged and unfinished recordings: what is read of them is what was recorded, and what is lost is told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode

from alidade.pipelines.applications.session import session_facts
from alidade.pipelines.errors import InputError
from alidade.pipelines.recording import mcap_writer
from alidade.pipelines.recording.recording import open_recording
from alidade.pipelines.settings import Config
from tests.support.damage import (
    CONFIG,
    FORMS,
    Whole,
    boundaries,
    check_sound,
    cuts,
    flips,
    has_chunks,
    read,
    spoilt,
    topics,
    write_small,
)

OWN = "alidade's own"


@dataclass
class Small:
    """A small recording: its bytes, what is in it, and a place for damaged copies."""

    data: bytes
    whole: Whole
    copy: Path

    def outcomes(self, copies: Iterable[bytes]) -> Counter[str]:
        """How many damaged copies were read whole, in part, or refused; all of them soundly."""
        found: Counter[str] = Counter()
        for data in copies:
            self.copy.write_bytes(data)
            found[check_sound(self.copy, self.whole)] += 1
        return found


@pytest.fixture(scope="module", params=[*FORMS, OWN])
def small(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Small:
    return make(request.param, tmp_path_factory.mktemp("damaged"))


def make(form: str, folder: Path) -> Small:
    path = folder / "s.mcap"
    if form == OWN:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mcap_writer, "CHUNK_BYTES", 4000)
            mcap_writer.write_session(path, topics(), {"alidade.yaml": CONFIG})
    else:
        path = write_small(path, form)
    whole = read(open_recording(path))
    assert check_sound(path, whole) == "whole"
    assert not open_recording(path).notes
    return Small(path.read_bytes(), whole, folder / "copy.mcap")


def test_cut_at_record_boundaries(small: Small) -> None:
    every = cuts(small.data)
    found = small.outcomes(every[:: len(every) // 20])
    assert found["part"] > 10
    assert found["refused"] < 8  # before the first chunk ends


def test_flipped_bytes(small: Small) -> None:
    found = small.outcomes(flips(small.data, 40, 1))
    assert found["whole"] > 0
    # All messages outside chunks have but one checksum.
    assert found["part"] > 20 or not has_chunks(small.data)


@pytest.mark.slow
def test_every_cut_and_many_flips(small: Small) -> None:
    rng = np.random.default_rng(2)
    random_cuts = [small.data[:at] for at in rng.integers(8, len(small.data), 200)]
    for name, copies in {
        "cut at a record": cuts(small.data),
        "cut anywhere": random_cuts,
        "one byte": flips(small.data, 500, 3),
        "stretches and several bytes": spoilt(small.data, 500, 4),
    }.items():
        print(name, dict(small.outcomes(copies)))


def test_a_missing_summary_loses_nothing(small: Small) -> None:
    end = next(at for at in boundaries(small.data)[:-1] if small.data[at] == Opcode.DATA_END)
    small.copy.write_bytes(small.data[:end])
    cut = open_recording(small.copy)
    for name, (t_ns, values) in read(cut).items():
        np.testing.assert_array_equal(t_ns, small.whole[name][0])
        np.testing.assert_array_equal(values, small.whole[name][1])
    assert cut.notes == ("the recording is truncated: it ends without its closing records",)
    assert not cut.container.missing
    with pytest.raises(InputError, match="--strict"):
        open_recording(small.copy, strict=True)


def test_a_damaged_length_loses_one_chunk(small: Small) -> None:
    """The walk goes on at the next chunk, though it does not know where the damaged record ends."""
    if not has_chunks(small.data):
        pytest.skip("messages outside chunks have one checksum for all of them")
    at = [place for place in boundaries(small.data)[:-1] if small.data[place] == Opcode.CHUNK][4]
    small.copy.write_bytes(small.data[: at + 4] + b"\xff" + small.data[at + 5 :])
    recording = open_recording(small.copy)
    facts = session_facts(recording, Config())
    assert [loss.chunks for loss in recording.container.losses] == [1]
    assert 2 <= facts.lost["/imu"] <= 10
    imu = next(topic for topic in facts.topics if topic.name == "/imu")
    assert imu.largest_gap_s == pytest.approx(0.005 * (facts.lost["/imu"] + 1), abs=1e-9)
    assert imu.count + facts.lost["/imu"] == 120
    assert "between 0." in recording.notes[0]
