"""The commands in README and docs are run as they stand, block after block, in one folder."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from pipelines.config import load_config

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "docs" / "examples" / "gyro_pair"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_BLOCK = re.compile(r"^```(sh|yaml file=(\S+))\n(.*?)^```", re.MULTILINE | re.DOTALL)
_PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"^```python file=(\S+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
# What a command whose verdict is not "calibrated" says of itself on the page.
_EXIT_CODE = re.compile(r"#.* exit code (\d+)")
_LINK = re.compile(r"\]\((?!https?://)([^)#]+)")


# Their Python needs the scheduler of a cluster.
_CLUSTER = ("fleet.md",)
# Their commands are those of other tests, on longer recordings.
_LONG = ("cube.md", "fleet.md", "trust.md", "write-your-own-method.md")


def _text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def _name(page: Path) -> str:
    return page.name


@pytest.mark.parametrize(
    "page", [pytest.param(p, marks=[pytest.mark.slow] * (p.name in _LONG), id=p.name) for p in PAGES]
)
def test_commands_work(page: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    path = [str(ROOT)]
    if page.name == "write-your-own-method.md":
        path.append(str(request.getfixturevalue("example_site")))
    for kind, file, text in _BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind != "sh":
            (tmp_path / file).write_text(text, encoding="utf-8")
            load_config(None, tmp_path / file)
            continue
        for line in text.splitlines():
            words = shlex.split(line, comments=True)
            command = [sys.executable, "-m", "pipelines.cli", *words[1:]] if words[:1] == ["alidade"] else words
            run = subprocess.run(
                command,
                cwd=tmp_path,
                env={"PYTHONPATH": os.pathsep.join(path), "PATH": "/usr/bin:/bin"},
                capture_output=True,
                text=True,
            )
            told = _EXIT_CODE.search(line)
            assert run.returncode == (int(told[1]) if told else 0), f"{line}\n{run.stdout}{run.stderr}"


@pytest.mark.parametrize("page", [p for p in PAGES if p.name not in _CLUSTER and _PYTHON.search(_text(p))], ids=_name)
def test_python_works(page: Path, tmp_path: Path) -> None:
    """Block after block, as one program."""
    program = "\n".join(_PYTHON.findall(_text(page)))
    run = subprocess.run(
        [sys.executable, "-"],
        input=program,
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "datasets" / "README.md"], ids=lambda p: p.name
)
def test_links_lead_somewhere(page: Path) -> None:
    for target in _LINK.findall(page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_code_of_the_example_is_that_of_its_files() -> None:
    page = (ROOT / "docs" / "write-your-own-method.md").read_text(encoding="utf-8")
    blocks = _CODE.findall(page)
    assert blocks
    for file, text in blocks:
        source = (EXAMPLE / file).read_text(encoding="utf-8")
        # Pages are formatted: a block starts at the margin wherever its code stands.
        assert any(textwrap.indent(text, " " * depth) in source for depth in (0, 4, 8)), f"{file}:\n{text}"


def test_readme_names_no_dependency_that_is_not_there() -> None:
    """The Dependencies section and pyproject.toml say the same."""
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    section = (ROOT / "README.md").read_text(encoding="utf-8").split("## Dependencies")[1]
    for requirement in project["dependencies"]:
        assert re.split(r"[\[<>=]", requirement)[0] in section
