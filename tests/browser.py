"""Pages in a real browser, at the widths of a desktop and of a phone."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium to draw the page; none is installed")

DESKTOP, PHONE = 1280, 390

# Frames, since a browser without a screen has no window as narrow as a phone. The title tells what was drawn in each.
_LOOK = """<!doctype html><title>not loaded</title>{frames}<script>
const look = () => {{
  const pages = [...document.querySelectorAll('iframe')].map(frame => frame.contentDocument);
  if (pages.some(page => page.querySelector('.plot:not([data-drawn])'))) return setTimeout(look, 100);
  document.title = pages.map((page, i) => {{
    const fits = page.documentElement.scrollWidth <= frames[i].innerWidth ? 'fits' : 'too wide';
    return `${{fits}} ${{page.querySelectorAll('.plot').length}}`;
  }}).join(', ');
}};
addEventListener('load', look);
</script>"""


def drawn(text: str, folder: Path) -> int:
    """Number of figures a browser draws of a page; nothing may stand out to the right, complain or use the network."""
    (folder / "page.html").write_text(text, encoding="utf-8")
    frames = "".join(f'<iframe src="page.html" width="{w}" height="2000"></iframe>' for w in (DESKTOP, PHONE))
    (folder / "look.html").write_text(_LOOK.format(frames=frames), encoding="utf-8")
    command = [
        str(CHROMIUM),
        *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
        *("--disable-background-networking", "--disable-component-update", f"--user-data-dir={folder / 'profile'}"),
        *("--allow-file-access-from-files", "--enable-logging=stderr", "--virtual-time-budget=60000"),
        *("--window-size=1400,2000", "--dump-dom", (folder / "look.html").as_uri()),
    ]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    # A request that the page's own policy stops is a complaint too.
    assert "CONSOLE" not in run.stderr, run.stderr
    title = re.search("<title>(.*)</title>", run.stdout)
    assert title is not None
    desktop, phone = title.group(1).split(", ")
    assert desktop.startswith("fits "), f"at {DESKTOP} px: {desktop}"
    assert phone == desktop, f"at {PHONE} px: {phone}"
    return int(desktop.split()[-1])
