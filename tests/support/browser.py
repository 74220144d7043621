"""Pages in a real browser, at the widths of a desktop and of a phone, and on paper."""

from __future__ import annotations

import atexit
import re
import shutil
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.support.devtools import Tab

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium to draw the page; none is installed")

DESKTOP, PHONE = 1280, 390
# A4 between margins of 9 mm, in CSS px.
PAPER = 725
_PATIENCE_S = 60.0

# Elements that stand out of the page to the right, and boxes that have to be scrolled; on a phone the sketch has to be.
_OVERFLOWING = """(() => {
  const width = document.documentElement.clientWidth, found = [];
  for (const element of document.querySelectorAll("body *")) {
    const box = element.getBoundingClientRect();
    const scrolls = element.matches(".scroll") && element.scrollWidth > element.clientWidth + 1;
    if ((box.right <= width + 1 && !scrolls) || box.width == 0 || element.closest("svg, nav")) continue;
    const where = `${element.tagName} ${element.className} ${element.textContent.slice(0, 40)}`;
    found.push(`${where}: ${Math.round(box.right)} of ${width}`);
  }
  return found;
})()"""


@dataclass(frozen=True)
class Look:
    """What a page looks like: figures drawn, elements that stand out, in words, and complaints of the browser."""

    figures: int
    overflowing: list[str]
    complaints: list[str]


def drawn(text: str, folder: Path) -> int:
    """Number of figures a browser draws of a page; nothing may stand out to the right, complain or use the network."""
    (folder / "page.html").write_text(text, encoding="utf-8")
    tab = running()
    seen = [look(tab, folder / "page.html", DESKTOP), on_paper(tab), look(tab, folder / "page.html", PHONE)]
    for each, where in zip(seen, (f"at {DESKTOP} px", "on paper", f"at {PHONE} px"), strict=True):
        assert not each.complaints, f"{where}: {each.complaints}"
        assert not each.overflowing, f"{where}: too wide: {each.overflowing[:5]}"
    (count,) = {each.figures for each in seen}
    return count


def fits(text: str, folder: Path) -> None:
    """Checks a page of another test as `drawn` does; nothing where no browser is installed."""
    if CHROMIUM is not None:
        assert drawn(text, folder) == text.count('class="plot"')


def look(tab: Tab, path: Path, width: int) -> Look:
    """What a page looks like at a width in px, all its figures drawn."""
    tab.complaints.clear()
    tab.size(width)
    tab.screen()
    tab.open(path.as_uri())
    tab.wait("document.readyState == 'complete'", _PATIENCE_S)
    tab.value("for (const fold of document.querySelectorAll('details')) fold.open = true")
    tab.wait("document.readyState == 'complete' && !document.querySelector('.plot:not([data-drawn])')", _PATIENCE_S)
    return _seen(tab)


def on_paper(tab: Tab) -> Look:
    """What the page that was looked at last is like when it is printed."""
    tab.print()
    tab.size(PAPER)
    return _seen(tab)


def sheets(text: str, folder: Path) -> int:
    """Number of pages of paper that a page takes when it is printed."""
    (folder / "page.html").write_text(text, encoding="utf-8")
    tab = running()
    look(tab, folder / "page.html", DESKTOP)
    tab.pdf(folder / "page.pdf")
    return len(re.findall(rb"/Type\s*/Page\b", (folder / "page.pdf").read_bytes()))


@cache
def running() -> Tab:
    """The one browser of this run of the tests."""
    from tests.support.devtools import Tab

    folder = Path(tempfile.mkdtemp(prefix="alidade-browser-"))
    tab = Tab(folder).__enter__()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    atexit.register(tab.__exit__)
    return tab


def _seen(tab: Tab) -> Look:
    figures = tab.value("document.querySelectorAll('.plot[data-drawn]').length")
    return Look(figures, tab.value(_OVERFLOWING), list(tab.complaints))
