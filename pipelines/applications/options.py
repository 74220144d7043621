"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help="File, bag folder or quoted pattern.")]
RecordingPaths = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING...", help="File, bag folder or quoted pattern. Several: one device, solved jointly."
    ),
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML config; overrides the recording's own.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bars.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON only.")]
