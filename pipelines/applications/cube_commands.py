"""Commands for the tag cube: locate its tags, print its faces."""

from pathlib import Path
from typing import Annotated

import typer

from alidade.pipelines import progress
from alidade.pipelines.applications.options import ConfigFile, Json, Quiet
from alidade.pipelines.errors import InputError


def cube_layout(
    sessions: Annotated[
        list[Path], typer.Argument(metavar="RECORDING...", help="Recordings of one or several cameras.")
    ],
    out: Annotated[Path, typer.Option(help="Config to write, with the located tags; its page is beside it, .html.")],
    config: ConfigFile = None,
    refine_camera: Annotated[
        bool, typer.Option("--refine-camera", help="Estimate focal length, centre and distortion too.")
    ] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Locate the AprilTags of a cube.

    From pictures of all sides; ids and sizes come from the config.
    """
    from alidade.pipelines.config import configured
    from alidade.pipelines.methods.cube.layout import cube_layout as estimate
    from alidade.pipelines.methods.cube.layout import layout_yaml
    from alidade.pipelines.methods.cube.layout_page import layout_json, layout_report
    from alidade.pipelines.recording.recording import open_recording
    from alidade.pipelines.reports import terminal
    from alidade.pipelines.reports.html import render_html
    from alidade.pipelines.reports.whole import write_file

    page = out.with_suffix(".html")
    if page == out:
        raise InputError(f"{out}: --out names the config, and its page takes the name with .html; call it .yaml")
    with progress.shown(quiet), progress.doing("finding where the tags are"):
        layout = estimate([configured(open_recording(session), config) for session in sessions], refine_camera)
    write_file(out, layout_yaml(layout))
    report = layout_report(layout, [session.name for session in sessions])
    write_file(page, render_html(report))
    if as_json:
        print(layout_json(layout))
        return
    terminal.print_report(report)
    terminal.say(f"Wrote {out} for calibrate --config, and {page}")


def cube_print(
    edge: Annotated[float, typer.Option(help="Edge of the cube, m.")],
    out: Annotated[Path, typer.Option(help="PDF to write; the config of the tags is beside it, .yaml.")],
    first_id: Annotated[int, typer.Option(help="Id of the tag on the top face; the others follow.")] = 16,
) -> None:
    """Print the six faces of an AprilTag cube, true to scale."""
    from alidade.pipelines.methods.cube.printing import print_cube
    from alidade.pipelines.reports import terminal

    print_cube(out, edge, first_id)
    terminal.say(f"Wrote {out}: print at 100 % and check the ruler")
    terminal.say(
        f"Wrote {out.with_suffix('.yaml')}: ids and sizes for cube-layout --config; of a cube as drawn all tags"
    )
