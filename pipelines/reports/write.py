"""All files of a result, whole or not at all.

estimates.mcap and foxglove.json have every parameter and its sigma over time, for Foxglove, Rerun and PlotJuggler. One
topic per parameter, `/estimate/<parameter>`, of one ROS 2 message whose definition stands in the file: Foxglove and
PlotJuggler plot the numbers of any ROS 2 message as they come, and so does whatever reads the recordings themselves.
The fields are value, sigma, lower and upper, the last two one sigma away, so that the band can be plotted too. What
moves along has `/smoothed/<parameter>` as well: its value at each moment from the whole recording.

Rerun plots the messages that it knows. Of those of ROS sensor_msgs/JointState is the one with named numbers, which
PlotJuggler shows by their names too: `/plot/<variable>` has a variable's values and the edges of their bands,
`/sigma/<variable>` its sigmas, as positions. foxglove.json is a layout that Foxglove or Lichtblick imports.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alidade.factors.array import Array
from alidade.pipelines.display.figure import COLORS, PALETTE
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.problem import Attitudes, History
from alidade.pipelines.files import Content, write_whole
from alidade.pipelines.recording.array_container import encode_series
from alidade.pipelines.recording.checks import nanoseconds
from alidade.pipelines.recording.messages import JOINT_STATE, definition_text
from alidade.pipelines.recording.series import JointSeries
from alidade.pipelines.reports.calibration import calibration_yaml
from alidade.pipelines.reports.calibration_report import report_html
from alidade.pipelines.reports.plots import variables
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import result_json

# Folder of the recordings of a joint calibration.
PARTS = "recordings"


def write_results(out_dir: Path, calibration: Calibration) -> tuple[Path, ...]:
    """Write every file the calibration has content for, whole or not at all; returns their paths.

    Raises:
        InputError: out_dir is a file, or cannot be written to.
    """
    estimate, history = calibration.estimate, calibration.estimate.history
    attitudes = estimate.attitudes if estimate.attitudes is not None and len(estimate.attitudes.time) else None
    over_time = history if history is not None and len(history.time) else None
    # result.json, gone first and back last, says that the others are its own.
    contents: dict[str, Content] = {
        "calibration.yaml": calibration_yaml(calibration),
        "attitude.tum": tum(attitudes, calibration.facts.epoch_ns) if attitudes else None,
        "estimates.mcap": partial(write_estimates, calibration=calibration, history=over_time) if over_time else None,
        "foxglove.json": foxglove_layout(calibration) if over_time else None,
        "report.html": report_html(calibration),
        "result.json": result_json(calibration),
    }
    return write_whole(out_dir, contents)


def write_part(out_dir: Path, calibration: Calibration) -> None:
    """Write the calibration of one of several recordings into a folder of its own. Raises as `write_results` does."""
    stem, taken = Path(calibration.recording).stem, 1
    name = stem
    while (out_dir / PARTS / name).exists():
        taken += 1
        name = f"{stem}-{taken}"
    write_results(out_dir / PARTS / name, calibration)


def adopt_parts(out_dir: Path, written: Path) -> None:
    """Copy what `write_part` wrote into another folder. Raises InputError when that folder cannot be written to."""
    try:
        shutil.copytree(written / PARTS, out_dir / PARTS, dirs_exist_ok=True)
    except (OSError, shutil.Error) as error:
        raise InputError(f"{out_dir / PARTS}: cannot be written ({error})") from error


def tum(attitudes: Attitudes, epoch_ns: int) -> str:
    """Return attitude.tum: lines `t tx ty tz qx qy qz qw` by time; t is Unix time in s to the ns, the position zero."""
    order = np.argsort(attitudes.time, kind="stable")
    stamps = nanoseconds(attitudes.time[order], epoch_ns)
    lines = []
    for t_ns, (w, x, y, z) in zip(stamps.tolist(), attitudes.wxyz[order].tolist(), strict=True):
        # In whole numbers: a double holds today's Unix time to a quarter of a microsecond only.
        seconds, rest = divmod(t_ns, 1_000_000_000)
        lines.append(f"{seconds}.{rest:09d} 0 0 0 {x:.12f} {y:.12f} {z:.12f} {w:.12f}\n")
    return "".join(lines)


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
    """Write the history of an estimate and its smoothed values, if any; metadata of a channel says its unit."""
    from mcap.writer import Writer

    smoothed = calibration.estimate.smoothed
    epoch_ns = calibration.facts.epoch_ns
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="alidade")
        schema = writer.register_schema(MESSAGE, "ros2msg", DEFINITION.encode())
        messages: list[tuple[int, int, bytes]] = []
        for i, p in enumerate(calibration.parameters.values()):
            known = {"estimate": history}
            if smoothed is not None and np.ptp(smoothed.values[:, i]) > 0.0:
                known["smoothed"] = smoothed
            for kind, over_time in known.items():
                metadata = {"unit": p.unit, "method": calibration.problem.method}
                channel = writer.register_channel(f"/{kind}/{p.name}", "cdr", schema, metadata)
                stamps = nanoseconds(over_time.time, epoch_ns)
                encoded = _encode(stamps, over_time.values[:, i], over_time.sigmas[:, i])
                messages += [(t, channel, row.tobytes()) for t, row in zip(stamps.tolist(), encoded, strict=True)]
        joints = writer.register_schema(JOINT_STATE, "ros2msg", definition_text(JOINT_STATE).encode())
        stamps = nanoseconds(history.time, epoch_ns)
        for topic, unit, names, numbers in _plots(calibration, history):
            channel = writer.register_channel(
                topic, "cdr", joints, {"unit": unit, "method": calibration.problem.method}
            )
            series = JointSeries(stamps, numbers, names)
            encoded = encode_series(series).take(len(series))
            messages += [(t, channel, row.tobytes()) for t, row in zip(stamps.tolist(), encoded, strict=True)]
        for k, (t_ns, channel, message) in enumerate(sorted(messages, key=lambda m: m[0])):
            # Log times are unsigned: what was stamped before 1970 is logged at its beginning.
            writer.add_message(channel, max(t_ns, 0), message, max(t_ns, 0), k)
        writer.finish()  # type: ignore[no-untyped-call]


def _plots(calibration: Calibration, history: History) -> Iterator[tuple[str, str, tuple[str, ...], Array]]:
    """Yield topic, unit, names and values over time (n, names) of what one panel plots."""
    column = {name: i for i, name in enumerate(calibration.estimate.names)}
    for title, unit, members in variables(calibration):
        variable = re.sub(r"\W+", "_", title)
        rows = [column[q.name] for q in members]
        values, sigmas = history.values[:, rows], history.sigmas[:, rows]
        bands = np.stack([values, values - sigmas, values + sigmas], axis=2).reshape(len(values), -1)
        edges = tuple(f"{q.name}{edge}" for q in members for edge in ("", "_lower", "_upper"))
        yield f"/plot/{variable}", unit, edges, bands
        yield f"/sigma/{variable}", unit, tuple(q.name for q in members), sigmas


def _encode(stamps: NDArray[np.int64], value: Array, sigma: Array) -> NDArray[np.void]:
    """Encode all messages of a topic as CDR: value, sigma and the edges of the one-sigma band."""
    out = np.zeros(len(stamps), _LAYOUT)
    out["head"] = _CDR_HEAD
    out["sec"], out["nanosec"] = np.divmod(stamps, 1_000_000_000)
    out["numbers"] = np.column_stack([value, sigma, value - sigma, value + sigma])
    return out


_PLOT = {
    "showXAxisLabels": True,
    "showYAxisLabels": True,
    "showLegend": True,
    "legendDisplay": "floating",
    "showPlotValuesInLegend": True,
    "isSynced": True,
    "xAxisVal": "timestamp",
    "sidebarDimension": 240,
}


def foxglove_layout(calibration: Calibration) -> str:
    """Return Foxglove's layout as JSON: a plot of each variable, with values and one-sigma bands of its numbers."""
    panels = {}
    for title, unit, members in variables(calibration):
        paths = [
            {
                "value": f"/estimate/{q.name}.{field}",
                "label": q.name if field == "value" else f"{q.name} {field}",
                "enabled": True,
                "color": PALETTE[color][0],
                "lineSize": 2 if field == "value" else 0.5,
                "timestampMethod": "headerStamp",
            }
            for q, color in zip(members, cycle(COLORS))
            for field in ("value", "lower", "upper")
        ]
        panels[f"Plot!{title}"] = {"title": f"{title}, {unit}", "paths": paths, **_PLOT}
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split(list(panels), "row"),
    }
    return json.dumps(layout, indent=1) + "\n"


def _split(panels: Sequence[str], direction: str) -> Any:
    """Arrange panels in rows and columns, alternately split into halves."""
    if len(panels) == 1:
        return panels[0]
    half = (len(panels) + 1) // 2
    other = "column" if direction == "row" else "row"
    return {
        "direction": direction,
        "first": _split(panels[:half], other),
        "second": _split(panels[half:], other),
        "splitPercentage": round(100 * half / len(panels)),
    }
