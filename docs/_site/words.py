"""Words of the documentation: how many a reader meets, and which of them are not the field's.

    python -m docs._site.words            # dialect left in pages, screens and code; words by group of pages
    python -m docs._site.words --pages    # words page by page

The words of a page are what is left without comments, blocks of code, formulas, targets of links and rules of tables.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
EXAMPLE = DOCS / "examples" / "gyro_pair"
_UNREAD = re.compile(
    r"<!--.*?-->|^```.*?^```[^\n]*|\$\$.*?\$\$|(?<=\])\([^)]*\)|^\|[-| :]+\|$|^ {4}[^\n]*$", re.MULTILINE | re.DOTALL
)
_DIRECTIVE = re.compile(r"^```\{([\w-]+)\}([ \w.]*)\n```", re.MULTILINE)
_CODE = re.compile(r"^```.*?^```|`[^`\n]+`", re.MULTILINE | re.DOTALL)
_SIGNS = re.compile(r"[|#*_`>\[\]!]")

# What the field has another word for (CONTRIBUTING.md, "Words").
DIALECT = re.compile(
    r"\b(told|tells?|telling|foretold|holds? it to|believ\w*|belief|reckon\w*|pulls?|young|folded|folds|bent|bends"
    r"|stretch(?:es)?|goes? together|chance (?:alone )?makes?|by that time|held against|has its say|have the word"
    r"|in the dark|look like grass|dear|faint|withheld|lest|wherefore|hardly anything|turned against each other"
    r"|says? so|say nothing|says? how sure|taken for|takes? for exact|stands? in for|by itself alone|onward|strained"
    r"|spurious|warmth|surroundings)\b",
    re.IGNORECASE,
)
# Right where they stand: the position of a stream, keys of result.json and of a fleet's store.
_RIGHT = re.compile(
    r"\.tell\(|def tell\(|\b(?:pull|stretch(?:es)?)(?=[:=])|\.(?:pull|stretch)\b|\btold: str\b"
    r"|[\"`](?:pull|stretch(?:es)?|told)[\"`]"
)


def pages() -> list[Path]:
    """README and every page of the documentation, in the order of their paths."""
    return [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if EXAMPLE not in p.parents)]


# Words that are written in a page or a folder at most, and how many times as many are an error in
# tests/applications/test_docs.py. Blocks of code do not count, nor what the program or autodoc writes.
TOLERANCE = 1.05
BUDGETS = {
    "README.md": 600,
    "start": 2_850,
    "methods": 5_300,
    "tutorials": 360,
    "howto": 5_000,
    "explanation": 2_400,
    "validation": 2_050,
    "reference": 2_200,
}
# Of all pages.
BUDGET = 21_000


def words(text: str) -> int:
    """Number of words that a reader of Markdown meets."""
    return len(_SIGNS.sub(" ", _UNREAD.sub(" ", text)).split())


def prose(text: str) -> str:
    """A page without code, which quotes what programs print; its lines stay where they are."""
    return _CODE.sub(lambda found: "\n" * found[0].count("\n"), text)


def dialect(text: str) -> Iterator[tuple[int, str]]:
    """Line and word of each match of DIALECT."""
    for number, line in enumerate(text.splitlines(), 1):
        for found in DIALECT.finditer(_RIGHT.sub("", line)):
            yield number, found[0]


def group(page: Path) -> str:
    """README, the folder of a page, or `start` for the pages above all folders."""
    inside = page.relative_to(ROOT).parts
    return inside[0] if len(inside) == 1 else inside[1] if len(inside) > 2 else "start"


def _screens() -> list[Path]:
    """Files with text that users read on screens: commands, templates, names and meanings."""
    rooms = ("applications", "display", "reports", "diagnostics", "methods")
    return sorted(p for room in rooms for p in (ROOT / "pipelines" / room).rglob("*") if p.suffix in (".py", ".html"))


def counted(by: Callable[[Path], str] = group) -> dict[str, int]:
    """Words of the pages by group."""
    counts: dict[str, int] = {}
    for page in pages():
        counts[by(page)] = counts.get(by(page), 0) + words(page.read_text(encoding="utf-8"))
    return counts


def excesses() -> list[str]:
    """A line for each folder above its budget, and for all of them: by how many words, and what to do."""
    counts = counted()
    limits = {name: int(TOLERANCE * budget) for name, budget in BUDGETS.items()} | {"all pages": BUDGET}
    return [
        f"{name}: {count:,} words, {count - limits[name]:,} too many: shorten, or drop what another page says"
        for name, count in {**counts, "all pages": sum(counts.values())}.items()
        if count > limits[name]
    ]


def generated() -> int:
    """Words that the program writes into the pages, without blocks of code and without what autodoc adds."""
    from docs._site.tables import GENERATED

    found = [each for page in pages() for each in _DIRECTIVE.findall(page.read_text(encoding="utf-8"))]
    return sum(words("\n".join(GENERATED[name](*argument.split()))) for name, argument in found if name in GENERATED)


def main() -> None:
    """Print the words of each group of pages, and what dialect is left where."""
    counts = counted((lambda page: str(page.relative_to(ROOT))) if "--pages" in sys.argv else group)
    for name, count in counts.items():
        print(f"{count:7,}  {name}")
    print(f"{sum(counts.values()):7,}  written, in all, of {BUDGET:,}\n{generated():7,}  generated")
    print(*excesses(), sep="\n")
    code = sorted(p for room in ("alidade", "factors", "pipelines") for p in (ROOT / room).rglob("*.py"))
    seen: set[Path] = set()
    for what, files in (("pages", pages()), ("screens", _screens()), ("other code", code)):
        files = [file for file in files if file not in seen]
        seen.update(files)
        read = prose if what == "pages" else str
        found = [(file, list(dialect(read(file.read_text(encoding="utf-8"))))) for file in files]
        print(f"\ndialect in {what}: {sum(len(hits) for _, hits in found)}")
        for file, hits in sorted(found, key=lambda each: -len(each[1])):
            if hits:
                terms = ", ".join(sorted({word.lower() for _, word in hits}))
                print(f"{len(hits):5}  {file.relative_to(ROOT)}: {terms}")


if __name__ == "__main__":
    main()
