"""Sheets with a cube's tags to print, cut out and glue on, true to scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.errors import InputError
from alidade.pipelines.files import write_file
from alidade.pipelines.methods.cube.simulation import FACES, SIDES

_POINTS_PER_M = 72.0 / 0.0254
_PAGE = (0.210, 0.297)  # A4, m
_MARGIN = 0.01
# A tag's black square is 8 cells, its white margin one more all round: 10 cells fill the face.
_CELLS = 10


def tag_size(edge: float) -> float:
    """Edge of a tag's black square, m, on a cube with this edge, m."""
    return edge * 8.0 / _CELLS


def print_cube(out: Path, edge: float, first_id: int = 16) -> None:
    """Write a PDF with a cube's six faces, and beside it the config (.yaml) of the cube with the tags as drawn.

    Each face has a page with its outline, its id, where it goes, and a ruler to check the scale.

    Args:
        out: the PDF.
        edge: of the cube, m.
        first_id: id of the tag on the top face; the others follow.

    Raises:
        InputError: the face does not fit a page, the ids leave the family, or the files cannot be written.
    """
    if out.suffix == ".yaml":
        raise InputError(f"--out {out}: the PDF; the tags as drawn go into a .yaml beside it")
    if not 0.02 <= edge <= _PAGE[0] - 2.0 * _MARGIN:
        raise InputError(f"--edge {edge:g} m: faces from 0.02 to {_PAGE[0] - 2.0 * _MARGIN:g} m fit an A4 page")
    if not 0 <= first_id <= 587 - 6:
        raise InputError(f"tag ids {first_id} to {first_id + 5}: the family 36h11 has 0 to 586")
    faces = dict(zip(range(first_id, first_id + 6), FACES.values(), strict=True))
    pages = [_face(edge, tag, np.array(bRt)) for tag, (bRt, _) in faces.items()]
    write_file(out, _document(pages))
    tags = [
        f"    {tag}: {{size: {tag_size(edge):.6g}, rotation: {_numbers(bRt)}, "
        f"position: {_numbers(0.5 * edge * np.array(normal))}}}"
        for tag, (bRt, normal) in faces.items()
    ]
    write_file(out.with_suffix(".yaml"), "\n".join(["cube:", "  tag_family: 36h11", "  tags:", *tags, ""]))


def _numbers(values: Sequence[float] | Array) -> str:
    return f"[{', '.join(f'{value:.9g}' for value in values)}]"


def _side(axis: Array) -> str:
    """Side of the cube nearest to the direction of a vector."""
    return max(SIDES, key=lambda side: float(np.dot(SIDES[side], axis)))


def _face(edge: float, tag: int, bRt: Array) -> str:
    """Drawing commands of one page, the print of one face."""
    from alidade.pipelines.simulation.rendering import tag_bits

    bits = tag_bits(tag)
    cell = edge / _CELLS
    left, bottom = 0.5 * (_PAGE[0] - edge), 0.5 * (_PAGE[1] - edge)
    rows, columns = np.nonzero(~bits)
    squares = [
        _rectangle(left + c * cell, bottom + (_CELLS - 1 - r) * cell, cell, cell)
        for r, c in zip(rows.tolist(), columns.tolist(), strict=True)
    ]
    outline = f"0.3 w {_rectangle(left, bottom, edge, edge)} S"
    ruler = f"{_rectangle(_MARGIN, _MARGIN, 0.1, 0.002)} f"
    size = 1000.0 * tag_size(edge)
    _, up, out = so3.matrix(bRt).T
    lines = (
        f"tag {tag}, 36h11, black square {size:.2f} mm, face {1000.0 * edge:.2f} mm; the bar is 100 mm: print at 100 %",
        f"for a cube as drawn: on side {_side(out)}, this way up towards side {_side(up)}",
    )
    labels = [
        f"BT /F 10 Tf {_points(_MARGIN)} {_points(_MARGIN + 0.005 * (2 - i))} Td ({text}) Tj ET"
        for i, text in enumerate(lines)
    ]
    return "\n".join([*squares, "f", outline, ruler, *labels])


def _points(length: float) -> str:
    return f"{length * _POINTS_PER_M:.4f}"


def _rectangle(x: float, y: float, width: float, height: float) -> str:
    return " ".join(_points(v) for v in (x, y, width, height)) + " re"


def _document(pages: list[str]) -> bytes:
    """Assemble pages into a PDF document (PDF 32000-1, sections 7.5 and 8.5)."""
    count = len(pages)
    kids = " ".join(f"{4 + 2 * i} 0 R" for i in range(count))
    box = f"[0 0 {_points(_PAGE[0])} {_points(_PAGE[1])}]"
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {count} >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    for i, content in enumerate(pages):
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents {5 + 2 * i} 0 R "
            "/Resources << /Font << /F 3 0 R >> >> >>"
        )
        objects.append(f"<< /Length {len(content)} >>\nstream\n{content}\nendstream")
    out = b"%PDF-1.4\n"
    offsets: NDArray[np.int64] = np.zeros(len(objects), dtype=np.int64)
    for i, body in enumerate(objects):
        offsets[i] = len(out)
        out += f"{i + 1} 0 obj\n{body}\nendobj\n".encode("ascii")
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    trailer = f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(out)}\n%%EOF\n"
    return out + f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}{trailer}".encode("ascii")
