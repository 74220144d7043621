"""The cube's own commands."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from alidade.pipelines.applications.options import ConfigFile, Json, Quiet
from alidade.pipelines.errors import InputError

if TYPE_CHECKING:
    from alidade.pipelines.vision.layout import Layout


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
    from alidade.pipelines import progress
    from alidade.pipelines.config import configured
    from alidade.pipelines.methods.cube.layout import cube_layout as estimate
    from alidade.pipelines.methods.cube.layout import layout_yaml
    from alidade.pipelines.methods.cube.layout_page import layout_html, layout_json
    from alidade.pipelines.recording.recording import open_recording
    from alidade.pipelines.reports import terminal
    from alidade.pipelines.reports.whole import write_file

    page = out.with_suffix(".html")
    if page == out:
        raise InputError(f"{out}: --out names the config, and its page takes the name with .html; call it .yaml")
    with progress.shown(quiet), progress.doing("finding where the tags are"):
        layout = estimate([configured(open_recording(session), config) for session in sessions], refine_camera)
    write_file(out, layout_yaml(layout))
    write_file(page, layout_html(layout, [session.name for session in sessions]))
    if as_json:
        print(layout_json(layout))
        return
    _show(layout)
    terminal.say(f"Wrote {out} for calibrate --config, and {page}")


def _show(layout: "Layout") -> None:
    """A table of the tags, what became of them, and what to do."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from alidade.pipelines.methods.cube.layout_page import COLUMNS, advice, camera_rows, headline, rows
    from alidade.pipelines.reports import terminal

    table = Table(box=SIMPLE_HEAD, header_style="bold", pad_edge=False)
    for column in COLUMNS:
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows(layout):
        table.add_row(*row)
    terminal.console.print(table)
    terminal.say(headline(layout))
    for sentence in advice(layout):
        terminal.say(f"  {sentence}")
    for camera, name, given, found, sigma in camera_rows(layout):
        terminal.say(f"  camera {camera}: {name} {found} ± {sigma}, given {given}")
    if layout.camera_sigma is not None and layout.with_camera is None:
        terminal.say("  calibrate takes the camera's numbers from a layout of one camera; here they are several")


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
