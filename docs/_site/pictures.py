"""Pictures of the pages that the program makes: on a desktop, on a phone and on paper; cards of reports with faults.

    python -m docs._site.pictures [NAME...]      # all of them or some, into docs/pictures; minutes, needs a Chromium

Recordings are simulated with fixed seeds. NAME.png has the top of the page at 1280 px and at 390 px, and its first
sheet as printed; report.png has the beginning of a report, fault-NAME.png one figure of the report of a faulty
recording, 845 px wide.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import alidade
from alidade.factors import so3
from alidade.pipelines.applications import cli
from alidade.pipelines.settings import Noise

if TYPE_CHECKING:
    from tests.support.devtools import Tab

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[1] / "pictures"
_METHODS = ("los", "indexer", "head", "cube", "tumble")
# Of each look: width of the window, px, and the size it is brought to.
_DESKTOP, _PHONE = (1280, (600, 560)), (390, (205, 560))
_REPORT = (1020, (760, 860))
_SHEET = (396, 560)
_GAP, _COLOURS = 10, 48
_DRAWN = (
    "document.readyState == 'complete' && "
    "![...document.querySelectorAll('.plot:not([data-drawn])')].some(plot => !plot.closest('details:not([open])'))"
)
# Units of a fleet: mounting angles at two dates, of which one has moved.
_UNITS = {"U1": (0.50, 0.50), "U2": (0.42, 0.42), "U3": (0.57, 0.57), "U4": (0.47, 0.47), "U5": (0.52, 0.90)}
_SHORT = "{{duration_s: 20, gyro_rate_hz: 100, image_rate_hz: 20, sensors: ideal, angles_deg: {{delta_px: {0}}}}}"


def main(wanted: list[str]) -> None:
    """Make the pictures of these names, or all."""
    from tests.support.devtools import Tab

    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch, Tab(Path(scratch)) as tab:
        for name, make in _pages(Path(scratch)).items():
            if not wanted or name in wanted:
                _write(name, _looks(tab, make().as_uri(), Path(scratch)))
        if not wanted or "report" in wanted:
            _write_report(tab, Path(scratch))
        for name, (fault, figure) in _FAULTS.items():
            if not wanted or name in wanted:
                _write_figure(tab, name, fault(Path(scratch)), figure)


def _pages(folder: Path) -> dict[str, Callable[[], Path]]:
    """Name of each page -> what makes it and tells its file."""

    def report(method: str) -> Path:
        _run("calibrate", _recording(folder, method), "--out", folder / method, "--quiet")
        return folder / method / "report.html"

    def made(page: str, *words: str | Path) -> Path:
        _run(*words)
        return folder / page

    def validation() -> Path:
        held = report("los").with_name("calibration.yaml")
        recording = _recording(folder, "los", 2)
        return made("validation.html", "validate", recording, "--calibration", held, "--out", folder, "--quiet")

    def certificate() -> Path:
        return made("certificate.html", "certificate", report("tumble").parent, "--out", folder)

    def layout() -> Path:
        shown = _recording(folder, "cube", 1, "--scenario", "cube_shown")
        return made("layout.html", "cube-layout", shown, "--out", folder / "layout.yaml", "--quiet")

    def compare() -> Path:
        return made("compare.html", "compare", _recording(folder, "los"), "--out", folder, "--quiet")

    def study() -> Path:
        words = ("montecarlo", "tumble", "--runs", "20", "--jobs", "1", "--out", folder, "--quiet")
        return made("montecarlo.html", *words)

    return {
        **{method: lambda method=method: report(method) for method in _METHODS},  # type: ignore[misc]
        "compare": compare,
        "validation": validation,
        "fleet": lambda: _fleet(folder),
        "montecarlo": study,
        "plan": lambda: made("plan.html", "plan", "los", "--page", folder / "plan.html", "--quiet"),
        "noise": lambda: made("noise.html", "noise", _recording(folder, "cube"), "--out", folder, "--quiet"),
        "certificate": certificate,
        "layout": layout,
    }


def _write_report(tab: Tab, scratch: Path) -> None:
    recording = _recording(scratch, "head", 1, "--scenario", "head_mounts")
    _run("calibrate", recording, "--out", scratch / "mounts", "--quiet")
    top = _screen(tab, (scratch / "mounts" / "report.html").as_uri(), _REPORT, scratch)
    path = FOLDER.parent / "report.png"
    top.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def _faulty(folder: Path, where: Callable[[Array], NDArray[np.bool_]], by: Array) -> Path:
    """The report of a minute of head motion, attitudes rotated by these vectors at the times that `where` selects."""
    data, _ = alidade.simulate("head", "head_mounts", seed=3)
    wrong = where(data.vision_t)
    attitudes = data.vision_wxyz.copy()
    attitudes[wrong] = so3.multiply(attitudes[wrong], so3.exp(by[: wrong.sum()]))
    config = alidade.Config(noise=Noise(gyro_density=1.0e-4, vision_attitude=8.7e-3))
    changed = replace(data, vision_wxyz=attitudes)
    alidade.open(changed, method="head", config=config).calibrate().write(folder)
    return folder / "report.html"


def _step(folder: Path) -> Path:
    slip = np.tile(np.deg2rad([0.5, 0.0, 0.0]), (10_000, 1))
    return _faulty(folder / "step", lambda t: t > 30.0, slip)


def _outliers(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    return _faulty(folder / "outliers", lambda t: rng.random(len(t)) < 0.15, 0.2 * rng.normal(size=(10_000, 3)))


# Name of a picture -> the report, and the beginning of the figure's title.
_FAULTS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "fault-step": (_step, "helmet_mount over time"),
    "fault-outliers": (_outliers, "Residuals of vision"),
}


def _write_figure(tab: Tab, name: str, report: Path, title: str) -> None:
    """One figure of a report, alone on the page."""
    tab.screen()
    tab.size(845, 380)
    tab.open(report.as_uri())
    tab.wait("document.readyState == 'complete'", 60.0)
    tab.value("for (const fold of document.querySelectorAll('details')) fold.open = true")
    tab.wait(_DRAWN, 60.0)
    cards = "[...document.querySelectorAll('.card.figure')]"
    card = f"{cards}.find(card => card.querySelector('h3').textContent.startsWith('{title}'))"
    tab.value(f"document.body.replaceChildren({card})")
    path = FOLDER / f"{name}.png"
    tab.picture(path)
    quantised = Image.open(path).convert("RGB").quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    quantised.save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def _run(*words: str | Path) -> None:
    """The command, in this process; it may say that a recording is short of something."""
    sys.argv = ["alidade", *map(str, words)]
    try:
        cli.main()
    except SystemExit as stop:
        if stop.code not in (0, None, 3, 4):
            raise


def _recording(folder: Path, method: str, seed: int = 1, *more: str | Path) -> Path:
    out = folder / f"{method}-{seed}{'-'.join(Path(word).stem for word in more[1:])}.mcap"
    if not out.exists():
        _run("simulate", method, "--seed", str(seed), *more, "--out", out, "--quiet")
    return out


def _fleet(folder: Path) -> Path:
    units = folder / "units"
    units.mkdir()
    for k, (name, angles) in enumerate(_UNITS.items()):
        for month, angle in enumerate(angles, 1):
            (folder / "unit.yaml").write_text(_SHORT.format(angle), encoding="utf-8")
            made = _recording(folder, "los", 10 * k + month, "--scenario", folder / "unit.yaml")
            made.rename(units / f"{name}_2026-{month:02}-01.mcap")
    _run("fleet", units / "*.mcap", "--names", "{unit}_{date}", "--jobs", "1", "--out", folder / "fleet", "--quiet")
    return folder / "fleet" / "fleet.html"


def _looks(tab: Tab, url: str, scratch: Path) -> list[Image.Image]:
    """Desktop, phone and paper."""
    screens = [_screen(tab, url, look, scratch) for look in (_DESKTOP, _PHONE)]
    tab.size(_DESKTOP[0])
    tab.open(url)
    tab.wait("document.readyState == 'complete'", 60.0)
    tab.value("for (const fold of document.querySelectorAll('details')) fold.open = true")
    tab.wait(_DRAWN, 60.0)
    tab.pdf(scratch / "page.pdf")
    sheet = scratch / "sheet"
    subprocess.run(["pdftoppm", "-r", "110", "-f", "1", "-l", "1", "-singlefile", "-png", scratch / "page.pdf", sheet])
    return [*screens, Image.open(sheet.with_suffix(".png")).convert("RGB").resize(_SHEET, Image.Resampling.LANCZOS)]


def _screen(tab: Tab, url: str, look: tuple[int, tuple[int, int]], scratch: Path) -> Image.Image:
    """The top of a page in a window of that width."""
    width, size = look
    tab.screen()
    tab.size(width, round(width * size[1] / size[0]))
    tab.open(url)
    tab.wait(_DRAWN, 60.0)
    tab.picture(scratch / "screen.png")
    picture = Image.open(scratch / "screen.png").convert("RGB")
    # Without the bar that scrolls.
    top = picture.crop((0, 0, picture.width, round(picture.width * size[1] / size[0])))
    return top.resize(size, Image.Resampling.LANCZOS)


def _write(name: str, looks: list[Image.Image]) -> None:
    """Side by side, in few colours."""
    width = sum(look.width for look in looks) + _GAP * (len(looks) + 1)
    whole = Image.new("RGB", (width, looks[0].height + 2 * _GAP), "#8a949e")
    left = _GAP
    for look in looks:
        whole.paste(look, (left, _GAP))
        left += look.width + _GAP
    path = FOLDER / f"{name}.png"
    whole.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
