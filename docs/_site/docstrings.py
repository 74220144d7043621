"""Docstrings as autodoc takes them: what is indented after an empty line is code, as people read it."""

from __future__ import annotations

from typing import Any

from sphinx.application import Sphinx


def _literal(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:  # noqa: ARG001
    out: list[str] = []
    code = False
    for before, line in zip(["", *lines], lines, strict=False):
        indented = line.startswith("    ")
        if indented and not before.strip() and not code and out:
            out += ["::", ""]
            code = True
        code = code and (indented or not line.strip())
        out.append(line)
    lines[:] = out


def setup(app: Sphinx) -> dict[str, bool]:
    """Before napoleon, which comes at priority 500."""
    app.connect("autodoc-process-docstring", _literal, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
