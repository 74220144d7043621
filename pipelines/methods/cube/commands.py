"""The cube's own commands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.options import ConfigFile, Quiet, RecordingPath


def cube_layout(
    session: RecordingPath,
    out: Annotated[Path, typer.Option(help="The config to write, with where the tags are.")],
    config: ConfigFile = None,
    quiet: Quiet = False,
) -> None:
    """Where the tags are on a cube, from pictures of it on all sides; the config gives their ids and sizes."""
    from pipelines import progress, terminal
    from pipelines.config import recorded_config
    from pipelines.methods.cube.layout import cube_layout as estimate
    from pipelines.methods.cube.layout import layout_yaml
    from pipelines.recording.reading import open_recording
    from pipelines.reports.whole import write_file

    with progress.shown(quiet), progress.doing("finding where the tags are"):
        recording = open_recording(session)
        layout = estimate([(recording, recorded_config(recording, config))])
    write_file(out, layout_yaml(layout))
    terminal.say(f"Wrote {out}")


def cube_print(
    edge: Annotated[float, typer.Option(help="Of the cube, m.")],
    out: Annotated[Path, typer.Option(help="The PDF to write.")],
    first_id: Annotated[int, typer.Option(help="Tag on the top face; the others follow.")] = 16,
) -> None:
    """Sheets with the six faces of a tag cube, true to scale."""
    from pipelines import terminal
    from pipelines.methods.cube.printing import print_cube

    print_cube(out, edge, first_id)
    terminal.say(f"Wrote {out}: print at 100 % and check the ruler")
