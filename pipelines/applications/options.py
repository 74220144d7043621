"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_WHAT = "File, bag folder, or pattern in quotes, 'run_*.mcap'."
RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help=_WHAT)]
RecordingPaths = Annotated[
    list[Path],
    typer.Argument(metavar="RECORDING...", help=f"{_WHAT} Several: one device, solved jointly."),
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML config; overrides the recording's own.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bars.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON only.")]
