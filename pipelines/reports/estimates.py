"""estimates.mcap: every parameter and its sigma over time, for Foxglove and PlotJuggler.

One topic per parameter, `/estimate/<parameter>`, of one ROS 2 message whose definition stands in the file: both tools
plot the numbers of any ROS 2 message as they come, and so does whatever reads the recordings themselves. The fields
are value, sigma, lower and upper, the last two one sigma away, so that the band can be plotted too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.methods.base import Array, History
from pipelines.reports.result import Calibration

MESSAGE = "alidade_msgs/msg/Estimate"
DEFINITION = """\
builtin_interfaces/Time stamp
float64 value
float64 sigma
float64 lower
float64 upper

================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

# CDR, little-endian: its head of four bytes, then the fields in order, none of which needs padding.
_LAYOUT = np.dtype([("head", "V4"), ("sec", "<i4"), ("nanosec", "<u4"), ("numbers", "<f8", 4)])
_CDR_HEAD = np.void(b"\x00\x01\x00\x00")


def write_estimates(path: Path, calibration: Calibration, history: History) -> None:
    """Write the history of an estimate; each channel's metadata says its unit."""
    from mcap.writer import Writer

    stamps = calibration.facts.epoch_ns + np.round(history.time * 1e9).astype(np.int64)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="alidade")
        schema = writer.register_schema(MESSAGE, "ros2msg", DEFINITION.encode())
        rows = []
        for i, p in enumerate(calibration.parameters):
            topic = f"/estimate/{p.name}"
            channel = writer.register_channel(
                topic, "cdr", schema, {"unit": p.unit, "method": calibration.problem.method}
            )
            rows.append((channel, _encode(stamps, history.values[:, i], history.sigmas[:, i])))
        for k, t_ns in enumerate(stamps.tolist()):
            for channel, messages in rows:
                writer.add_message(channel, t_ns, messages[k].tobytes(), t_ns, k)
        writer.finish()  # type: ignore[no-untyped-call]


def _encode(stamps: NDArray[np.int64], value: Array, sigma: Array) -> NDArray[np.void]:
    """CDR of all messages of a topic."""
    out = np.zeros(len(stamps), _LAYOUT)
    out["head"] = _CDR_HEAD
    out["sec"], out["nanosec"] = np.divmod(stamps, 1_000_000_000)
    out["numbers"] = np.column_stack([value, sigma, value - sigma, value + sigma])
    return out
