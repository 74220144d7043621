"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RecordingPath = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A file, a bag folder, or a pattern in quotes.")
]
RecordingPaths = Annotated[
    list[Path],
    typer.Argument(metavar="RECORDING...", help="A file, a bag folder, or a pattern in quotes; several: one device's."),
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML that overrides the recording's own config.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bars.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]
