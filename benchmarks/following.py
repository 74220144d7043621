"""Following a recording while another process writes it: what it costs in hour two, and how late estimates are.

ALIDADE_BENCH_MINUTES=120 python -m benchmarks following replays two hours, at 20 times their speed; by default it is
ten minutes.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from alidade.factors.array import Array
from alidade.pipelines.applications.follow.follower import Follower, Settings
from alidade.pipelines.applications.follow.guidance import View
from alidade.pipelines.applications.follow.sources import Source
from alidade.pipelines.methods import method
from alidade.pipelines.methods.los.simulation import LosScenario, los_config, simulate_los
from alidade.pipelines.simulation.sensors import EulerMotion, Swing
from benchmarks.measure import Ratio, resident_mib

MINUTES = float(os.environ.get("ALIDADE_BENCH_MINUTES", "10"))
_SPEED = 20.0
# Of the recording, s, before the past has been marginalised out for the first time.
_FILLED = 60.0
_BRISK = EulerMotion(
    roll=[Swing(amplitude_deg=6, frequency_hz=0.31)],
    pitch=[Swing(amplitude_deg=5, frequency_hz=0.27)],
    yaw=[Swing(amplitude_deg=6, frequency_hz=0.23)],
)
# A recorder writes down a chunk when it has so many bytes: a twentieth of a second, as they come and 20 times as fast.
_CHUNK = 2_000


def run() -> Iterator[Ratio]:
    """Los at 10 pictures/s as they come, then at 2/s for long."""
    told = _followed(90.0, 10.0, 100.0, 1.0)
    late = told[:, 1] - told[:, 0]
    compared = (
        f"s from message to estimate, median, as they come at 10 pictures/s; 95 % below {np.percentile(late, 95):.3f} s"
    )
    yield Ratio("following.delay", compared, float(np.median(late)), wanted=0.3, tolerance=1.0)

    told = _followed(60.0 * MINUTES, 2.0, 50.0, _SPEED)
    # When the recording is closed all of it is read once more.
    told = told[told[:, 1] < 60.0 * MINUTES / _SPEED]
    end = told[-1, 0]
    length = min(300.0, end / 3.0)
    first, last = (_share(told, start, start + length) for start in (_FILLED, end - length))
    compared = (
        f"processor of the last {length:.0f} s over that of {length:.0f} s from {_FILLED:.0f} s on, of {MINUTES:g} min "
        f"at {_SPEED:g} times their speed; {100.0 * _SPEED * first:.0f} and {100.0 * _SPEED * last:.0f} % of a core, "
        f"{1e3 * first:.1f} and {1e3 * last:.1f} ms a second recorded"
    )
    yield Ratio("following.growth", compared, last / first, wanted=1.2)
    filled, late_mib = (float(np.interp(at, told[:, 0], told[:, 3])) for at in (_FILLED, end))
    compared = f"memory at the end over that at {_FILLED:.0f} s: {late_mib:.0f} and {filled:.0f} MiB"
    yield Ratio("following.memory", compared, late_mib / filled)


def _followed(seconds: float, images_hz: float, rate_hz: float, speed: float) -> Array:
    """(n, 4) whenever something was told: s of recording it is about, s since the start, of processor, MiB."""
    rows: list[tuple[float, float, float, float]] = []
    with TemporaryDirectory() as folder:
        whole, grows = Path(folder, "whole.mcap"), Path(folder, "s.mcap")
        config = Path(folder, "c.yaml")
        scenario = LosScenario(
            duration_s=seconds, carrier=_BRISK, image_rate_hz=images_hz, gyro_rate_hz=rate_hz, gimbal_rate_hz=rate_hz
        )
        method("los").write(whole, simulate_los(scenario, 2))
        config.write_text(los_config(scenario))
        spawn = multiprocessing.get_context("spawn")
        began: Synchronized[float] = spawn.Value("d", 0.0)
        writer = spawn.Process(target=_write, args=(whole, grows, speed, began), daemon=True)
        writer.start()

        def show(view: View) -> None:
            if view.values is not None:
                rows.append((view.time, time.monotonic() - began.value, time.process_time(), resident_mib()))

        with Source(grows) as source:
            Follower(source, Settings(config=config), show, print, lambda: False).follow()
        writer.join()
    return np.array(rows)


def _write(whole: Path, path: Path, speed: float, began: Synchronized[float]) -> None:
    """The recording once more, when it is due."""
    with whole.open("rb") as stream, path.open("wb") as out:
        writer = Writer(out, chunk_size=round(_CHUNK * speed))
        writer.start("ros2")
        channels: dict[str, int] = {}
        start, first = time.monotonic(), None
        began.value = start
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            first = message.log_time if first is None else first
            ahead = (message.log_time - first) * 1e-9 / speed - (time.monotonic() - start)
            if ahead > 0.0:
                time.sleep(ahead)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.log_time)
            out.flush()
        writer.finish()  # type: ignore[no-untyped-call]


def _share(told: Array, start: float, stop: float) -> float:
    """Processor, s, for a second of recording in between."""
    a, b = np.interp([start, stop], told[:, 0], told[:, 2])
    return float(b - a) / (stop - start)
