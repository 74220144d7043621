"""README and docs: commands and outputs are real, links lead somewhere, pages are short and in the field's words."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import alidade as door
from alidade.pipelines import methods
from alidade.pipelines.config import load_config
from alidade.pipelines.estimation.finding import KINDS
from docs._site.tables import arrays, commands, config_keys, data_sheets, noise, result_keys, scenarios
from docs._site.words import BUDGETS, counted, dialect, excesses, prose, words
from tests.install.walk import Step, difference, steps
from tests.support.browser import DESKTOP, PHONE, look, needs_browser, running
from tests.support.command import Command, Run

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
EXAMPLE = DOCS / "examples" / "gyro_pair"
PAGES = [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if EXAMPLE not in p.parents)]
_CODE = re.compile(r"^```python file=(\S+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\((?!https?://)([^)#]*)(?:#([^)]*))?\)")
_HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)

# Their commands need a process of their own.
_APART = ("docs/howto/fleet.md", "docs/howto/write-a-method.md")
# `make dist` walks them in an environment of its own.
_WALKED = {
    page
    for pattern in re.findall(r"\$\(CURDIR\)/(\S+)", (ROOT / "Makefile").read_text(encoding="utf-8"))
    for page in ROOT.glob(pattern)
}
# Their commands are those of other tests, on longer recordings.
_LONG = (
    *_APART,
    "docs/howto/check-a-result.md",
    "docs/howto/print-a-cube.md",
    "docs/howto/several-recordings.md",
    "docs/howto/validate.md",
    "docs/troubleshooting.md",
)
# What people search for, each in a title, in the first paragraph of a page or in the glossary.
_SEARCHED = (
    "extrinsic", "boresight", "misalignment", "lever arm", "hand-eye", "hard iron", "soft iron", "Allan", "gimbal",
    "AHRS", "observability", "covariance", "ellipsoid fit", "AprilTag", "turntable", "intrinsics",
)  # fmt: skip


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, marks=[pytest.mark.slow] * (_name(p) in _LONG), id=_name(p))
        for p in PAGES
        if p not in _WALKED and steps(p)
    ],
)
def test_page_works(
    page: Path,
    tmp_path: Path,
    alidade: Command,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    """The commands run in this process, which imports once, wherever they can."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    path = [str(ROOT)]
    if page.name == "write-a-method.md":
        path.append(str(request.getfixturevalue("example_site")))
    program: dict[str, Any] = {"__name__": "__main__"}
    for step in steps(page):
        if step.kind == "yaml":
            Path(step.file).write_text(step.text, encoding="utf-8")
            load_config(None, Path(step.file))
        elif step.kind == "python":
            capsys.readouterr()
            exec(compile(step.text, page.name, "exec"), program)
            assert not difference(step.output or "", capsys.readouterr().out)
        elif step.kind == "sh":
            here = step.words[0] == "alidade" and _name(page) not in _APART
            run = alidade(*step.words[1:]) if here else _apart(step, path)
            assert run.code == step.exit_code, f"{step.text}\n{run.out}{run.err}"
            assert not (wrong := difference(step.output or "", run.out)), f"{step.text}\n{wrong}"


def _apart(step: Step, path: list[str]) -> Run:
    words = step.words
    command = [sys.executable, "-m", "alidade", *words[1:]] if words[0] == "alidade" else words
    environment = {"PYTHONPATH": os.pathsep.join(path), "PATH": "/usr/bin:/bin", "COLUMNS": "100"}
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    return Run(run.returncode, run.stdout, run.stderr)


@pytest.mark.parametrize(
    ("documented", "printed", "agree"),
    [
        ("a 1.00 b\n...\nd 2", "a 1.01 b c\nd  2.03", True),
        ("theta  12 ±3\n", " theta │ 12 ±3 ", True),
        ("1.70 of 37", "1.71 of 38", False),
        ("a 1.00", "a 1.03", False),
        ("a 1", "b 1", False),
        ("b\n...\na", "a b", False),
        ("-0.5 deg", "0.5 deg", False),
    ],
)
def test_outputs_are_compared(documented: str, printed: str, agree: bool) -> None:
    assert (difference(documented, printed) == "") is agree


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "datasets" / "README.md"], ids=_name)
def test_links_lead_to_files_and_headings(page: Path) -> None:
    for target, anchor in _LINK.findall(page.read_text(encoding="utf-8")):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in _anchors(file), f"{target}#{anchor}"


def _anchors(page: Path) -> set[str]:
    """Of a page's headings, as GitHub and MyST make them."""
    headings = _HEADING.findall(page.read_text(encoding="utf-8"))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_page_opens_with_its_purpose_in_a_sentence(page: Path) -> None:
    title, first = page.read_text(encoding="utf-8").split("\n\n")[:2]
    assert title.startswith("# ")
    assert not re.match(r"[#|<!]|```", first), first
    assert words(re.split(r"(?<=[.:])\s", first)[0]) <= 40, first


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_page_is_in_the_words_of_the_field(page: Path) -> None:
    assert list(dialect(prose(page.read_text(encoding="utf-8")))) == []


def test_help_is_in_the_words_of_the_field_and_summaries_fit_a_line(
    alidade: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(dialect("\n".join(commands()))) == []
    monkeypatch.setenv("COLUMNS", "80")
    assert not [line for line in alidade("-h").out.splitlines()[1:] if line.endswith("...")]


@pytest.mark.parametrize("generate", [config_keys, result_keys, noise, data_sheets])
def test_generated_reference_is_in_the_words_of_the_field(generate: Callable[[], Iterator[str]]) -> None:
    assert list(dialect(prose("\n".join(generate())))) == []


@pytest.mark.parametrize("method", ["los", "indexer", "head", "cube", "tumble"])
def test_parameters_scenarios_and_arrays_are_in_the_words_of_the_field(method: str) -> None:
    text = "\n".join([*scenarios(method), *arrays(method), *_meanings(method)])
    assert list(dialect(prose(text))) == []


def _meanings(method: str) -> list[str]:
    return [spec.description for spec in methods.method(method).parameters]


def test_pages_keep_their_budgets() -> None:
    assert counted().keys() == BUDGETS.keys()
    assert excesses() == []


def test_what_people_search_for_is_found() -> None:
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    openings = " ".join(" ".join(" ".join(text.split("\n\n")[:2]).split()) for text in texts)
    glossary = (DOCS / "reference" / "glossary.md").read_text(encoding="utf-8")
    for word in _SEARCHED:
        assert word.lower() in (openings + glossary).lower(), word


def test_the_reference_has_every_name_of_the_public_door() -> None:
    page = (DOCS / "reference" / "python.md").read_text(encoding="utf-8")
    for name in set(door.__all__) - {"__version__"}:
        assert re.search(rf"^\.\. auto\w+:: alidade\.{name}\b", page, re.MULTILINE), name


def test_every_kind_of_finding_is_on_the_page() -> None:
    page = (DOCS / "reference" / "result-json.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (`\w+`(?:, `\w+`)*) \|", page, re.MULTILINE)
    assert {kind: tuple(re.findall(r"\w+", numbers)) for kind, numbers in rows} == KINDS


def test_code_of_the_example_is_that_of_its_files() -> None:
    page = (DOCS / "howto" / "write-a-method.md").read_text(encoding="utf-8")
    blocks = _CODE.findall(page)
    assert blocks
    for file, text in blocks:
        source = (EXAMPLE / file).read_text(encoding="utf-8")
        # Pages are formatted: a block starts at the margin wherever its code stands.
        assert any(textwrap.indent(text, " " * depth) in source for depth in (0, 4, 8)), f"{file}:\n{text}"


def test_every_dependency_is_named() -> None:
    """The page Install and pyproject.toml agree, except for what only development needs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    section = (DOCS / "install.md").read_text(encoding="utf-8").split("## Extras")[1]
    extras = {name: needed for name, needed in project["optional-dependencies"].items() if name != "dev"}
    assert set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)) == extras.keys()
    for requirement in [*project["dependencies"], *(each for needed in extras.values() for each in needed)]:
        assert re.split(r"[\[<>=]", requirement)[0] in section


@pytest.mark.slow
@needs_browser
def test_the_site_is_built_and_its_pages_fit(tmp_path: Path) -> None:
    folders = ("-d", tmp_path / "doctrees", DOCS, tmp_path / "site")
    subprocess.run([sys.executable, "-m", "sphinx", "-q", "-W", *map(str, folders)], check=True, cwd=ROOT)
    pages = sorted(p for p in (tmp_path / "site").rglob("*.html") if "_static" not in p.parts)
    assert len(pages) > 30
    tab = running()
    for page in pages:
        for width in (DESKTOP, PHONE):
            look(tab, page, width)
            assert tab.value("document.documentElement.scrollWidth <= innerWidth"), f"{page.name} at {width} px"
