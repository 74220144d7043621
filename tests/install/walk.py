"""A page of the documentation walked as its reader would: files written, commands typed, outputs compared.

    python walk.py PAGE...        in the environment that this Python belongs to, each page in a folder of its own

Blocks are told by what follows their fence: `sh` (a command a line; a comment says `exit code 3` where it is not 0),
`yaml file=NAME`, `python` (one program a page), and `text output`, what the last command before it prints: there `...`
stands for anything, blanks and the lines of tables do not count, and numbers agree to 2 %, counts below 50 exactly, or
to a unit of their last decimal.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_BLOCK = re.compile(r"^```(sh|yaml file=(?P<file>\S+)|python|text output)\n(?P<text>.*?)^```", re.MULTILINE | re.DOTALL)
_EXIT_CODE = re.compile(r"#.* exit code (\d+)")
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_ACTIVATE = "source .venv/bin/activate"


@dataclass(frozen=True)
class Step:
    """One block, or one line of commands.

    Attributes:
        kind: `sh`, `yaml` or `python`.
        text: the command, the file's content, the program.
        file: to be written.
        exit_code: of a command.
        output: that the page shows of it, if it does.
    """

    kind: str
    text: str
    file: str = ""
    exit_code: int = 0
    output: str | None = None

    @property
    def words(self) -> list[str]:
        """Of a command."""
        return shlex.split(self.text, comments=True)


def steps(page: Path) -> list[Step]:
    """What a page has its reader do, in order."""
    found: list[Step] = []
    for block in _BLOCK.finditer(page.read_text(encoding="utf-8")):
        kind, text = block[1].split()[0], block["text"]
        if kind == "sh":
            found += _commands(text)
        elif kind == "text":
            last = found[-1]
            found[-1] = Step(last.kind, last.text, last.file, last.exit_code, text)
        elif kind == "python" and found and found[-1].kind == "python" and found[-1].output is None:
            found[-1] = Step(kind, found[-1].text + text)
        else:
            found.append(Step(kind, text, block["file"] or ""))
    return found


def _commands(text: str) -> Iterator[Step]:
    for line in text.splitlines():
        told = _EXIT_CODE.search(line)
        if shlex.split(line, comments=True) and line != _ACTIVATE:
            yield Step("sh", line, exit_code=int(told[1]) if told else 0)


def difference(documented: str, printed: str) -> str:
    """What a page shows and a program did not print; empty where they agree."""
    left = _plain(printed)
    for part in re.split(r"^\s*\.\.\.\s*$|(?<=\s)\.\.\.(?=\s)", documented, flags=re.MULTILINE):
        wanted = _plain(part)
        pattern = re.escape(_NUMBER.sub("0", wanted)).replace("0", rf"({_NUMBER.pattern})")
        for found in re.finditer(pattern, left):
            if all(map(_alike, _NUMBER.findall(wanted), found.groups())):
                left = left[found.end() :]
                break
        else:
            return f"not printed:\n{part}\nbut:\n{printed}"
    return ""


def _plain(text: str) -> str:
    return " ".join(re.sub("[─━│]", " ", text).split())


def _alike(shown: str, printed: str) -> bool:
    mantissa, _, exponent = shown.partition("e")
    digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2])) if set(".e") & set(shown) else 0.0
    return abs(float(shown) - float(printed)) <= max(1.001 * digit, 0.02 * abs(float(shown)))


def main() -> None:
    """Walk the pages with the commands of this environment."""
    tools = str(Path(sys.executable).parent)
    environment = {**os.environ, "PATH": os.pathsep.join([tools, os.environ["PATH"]]), "COLUMNS": "100"}
    environment.pop("PYTHONPATH", None)
    for page in map(Path, sys.argv[1:]):
        with tempfile.TemporaryDirectory() as folder:
            program = ""
            for step in steps(page):
                if step.kind == "yaml":
                    Path(folder, step.file).write_text(step.text, encoding="utf-8")
                    continue
                program += step.text if step.kind == "python" else ""
                command = ["python", "-c", program] if step.kind == "python" else step.words
                run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
                assert run.returncode == step.exit_code, f"{page}: {step.text}\n{run.stdout}{run.stderr}"
                wrong = difference(step.output or "", run.stdout)
                assert not wrong, f"{page}: {step.text}\n{wrong}"
        print(f"{page}: every command does what it says")


if __name__ == "__main__":
    main()
