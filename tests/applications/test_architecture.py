"""The house keeps its rules: one door a method, arrows one way."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from alidade.pipelines.methods import _Deferred, method, names

ROOT = Path(__file__).parents[2]
ROOMS = [ROOT / "factors", ROOT / "pipelines"]
_DOCSTRING = re.compile(r'"""(?:.|\n)*?"""')
_COMMENT = re.compile(r"#[^\n]*")


def test_nothing_outside_methods_branches_on_a_methods_name() -> None:
    """Thirteen places once did, and as many tables were keyed by it. The demo may name its one."""
    quoted = re.compile(rf"""(==|!=|\bin\b|case|\[|\{{|,)\s*["']({"|".join(names())})["']\s*(:|\]|,|\)|\}}|$)""")
    found = []
    for room in ROOMS:
        for path in room.rglob("*.py"):
            if (ROOT / "pipelines" / "methods") in path.parents:
                continue
            code = _COMMENT.sub("", _DOCSTRING.sub("", path.read_text(encoding="utf-8")))
            found += [f"{path.relative_to(ROOT)}: {line.strip()}" for line in code.splitlines() if quoted.search(line)]
    # The header's name in a checkpoint and the first bytes of a message.
    allowed = ('_LAYOUT = np.dtype([("head", "V4")', 'arrays.pop("head")', 'out["head"] = _CDR_HEAD')
    assert [line for line in found if not any(word in line for word in allowed)] == []


def test_the_arrows_between_rooms_point_one_way() -> None:
    run = subprocess.run(
        [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout
    assert "0 broken" in run.stdout


def test_no_test_imports_from_another_test() -> None:
    """Helpers live in modules of their own."""
    imports = re.compile(r"^\s*(?:from|import) tests\.(?:\w+\.)*(test_\w+)", re.MULTILINE)
    for path in (ROOT / "tests").rglob("*.py"):
        assert set(imports.findall(path.read_text(encoding="utf-8"))) <= {path.stem}, path.name


@pytest.mark.parametrize("name", names())
def test_everything_that_a_method_defers_can_be_imported(name: str) -> None:
    found = method(name)
    assert found.simulator is not None
    groups: list[Any] = [found.simulator, found.guidance, found.report, found.faults]
    for group in groups:
        for field in dataclasses.fields(getattr(group, "_target", group)):
            value = getattr(group, field.name)
            assert callable(value._target) if isinstance(value, _Deferred) else True, field.name
    for function in (found.problem, found.published, found.read, found.to_topics):
        assert callable(getattr(function, "_target", function))
    assert found.settings() is not None


def test_declarations_of_methods_import_nothing_slow() -> None:
    """Every command reads them."""
    code = "import sys; from alidade.pipelines.methods import method, names; [method(name) for name in names()]"
    run = [sys.executable, "-c", f"{code}; print([m for m in ('cv2', 'scipy', 'bokeh') if m in sys.modules])"]
    assert subprocess.run(run, cwd=ROOT, capture_output=True, text=True).stdout.strip() == "[]"
