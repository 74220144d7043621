"""Directives that make tables of the program itself, so that no page can say anything else.

    ```{config-keys}            keys of a config, of all sections
    ```{result-keys}            keys of result.json
    ```{scenario-keys} head     settings of a method's simulator
    ```{scenarios} head         scenarios of a method, and what each says of itself
    ```{commands}               commands with their arguments and options

It also writes the JSON Schema of result.json beside the pages.
"""

from __future__ import annotations

import ast
import inspect
import io
import json
import re
import tokenize
from collections.abc import Iterator
from typing import Any

import typer
from docutils import nodes
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from alidade.pipelines import methods
from alidade.pipelines.applications import cli
from alidade.pipelines.config import model
from alidade.pipelines.reports.result import Result
from alidade.pipelines.simulation.scenario import summary

_ATTRIBUTES = re.compile(r"\n\s*Attributes:\n(.*?)(\n\n|\Z)", re.DOTALL)


class _Page(SphinxDirective):
    """A directive whose content is Markdown that a subclass writes."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The text, read as the page is, anew each time: the program may have changed."""
        self.env.note_reread()
        return self.parse_text_to_nodes("\n".join(self.lines()), allow_section_headings=True)

    def lines(self) -> Iterator[str]:
        """Markdown, line by line."""
        raise NotImplementedError


class ConfigKeys(_Page):
    """Every section of a config with its keys."""

    def lines(self) -> Iterator[str]:
        """A table a section."""
        return _tables(model(), "")


class ResultKeys(_Page):
    """Every object of result.json with its keys."""

    def lines(self) -> Iterator[str]:
        """A table an object."""
        return _tables(Result, "")


class ScenarioKeys(_Page):
    """Settings of a simulator."""

    def lines(self) -> Iterator[str]:
        """A table a section."""
        return _tables(methods.method(self.arguments[0]).scenario, "", level=4)


class Scenarios(_Page):
    """Shipped scenarios of a method."""

    def lines(self) -> Iterator[str]:
        """A row each."""
        yield from ("| scenario | what it shows |", "| --- | --- |")
        for name, path in methods.scenarios()[self.arguments[0]].items():
            yield f"| `{name}` | {_cell(summary(path))} |"


class Commands(_Page):
    """The command line."""

    def lines(self) -> Iterator[str]:
        """A section a command: usage, help, options."""
        group: Any = typer.main.get_command(cli.app)
        context = group.make_context("alidade", [], resilient_parsing=True)
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            help_ = command.get_help(command.make_context(name, [], parent=context, resilient_parsing=True))
            yield from ("", f"## alidade {name}", "", "```text", *help_.splitlines(), "```")


def _tables(kind: type[BaseModel], path: str, level: int = 2) -> Iterator[str]:
    """A table of a model's keys, then those of the models inside it."""
    schema = kind.model_json_schema(by_alias=True)
    required, meanings = schema.get("required", []), _meanings(kind)
    heading = f"`{path.removesuffix('.')}`" if path else "Top level"
    yield from ("", f"{'#' * level} {heading}", "", _about(kind), "")
    rows: list[list[str]] = []
    inside: list[tuple[type[BaseModel], str]] = []
    for name, field in kind.model_fields.items():
        key = field.alias or name
        described, models = schema["properties"][key], _models(field.annotation)
        default = "required" if key in required else _default(field.get_default(call_default_factory=True))
        meaning = meanings.get(name) or (_about(models[0]).partition("\n")[0] if models else "")
        rows.append([f"`{key}`", _cell(_words(described)), default, _cell(meaning)])
        shape = next((part for part in described.get("anyOf", ()) if part.get("type") != "null"), described)
        many = "[]." if shape.get("type") == "array" else ".NAME." if "additionalProperties" in shape else "."
        inside += [(found, f"{path}{key}{many}") for found in models]
    yield from ("| key | value | default | meaning |", "| --- | --- | --- | --- |")
    yield from (f"| {' | '.join(row)} |" for row in rows)
    for found, where in inside:
        yield from _tables(found, where, level)


def _about(kind: type[BaseModel]) -> str:
    """What the class says of itself, without its attributes, which stand in the table."""
    return _ATTRIBUTES.sub("\n", inspect.cleandoc(kind.__doc__ or "")).strip()


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field of this type holds, alone or many."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for argument in getattr(annotation, "__args__", ()) for found in _models(argument)]


def _default(value: object) -> str:
    if isinstance(value, BaseModel):
        return "see below"
    if value is None:
        return ""
    return f"`{json.dumps(value, default=lambda part: part.model_dump(exclude_defaults=True))}`"


def _words(described: Any) -> str:
    """A JSON schema in a few words."""
    if not isinstance(described, dict):
        return "anything"
    if "$ref" in described:
        return "section"
    if "anyOf" in described or "oneOf" in described:
        return " or ".join(dict.fromkeys(map(_words, described.get("anyOf") or described["oneOf"])))
    if "const" in described or "enum" in described:
        return ", ".join(f"`{value}`" for value in described.get("enum", [described.get("const")]))
    kind = described.get("type")
    if kind == "array":
        items = described.get("prefixItems")
        return f"list of {len(items)} numbers" if items else f"list, each: {_words(described.get('items', {}))}"
    if kind == "object":
        return f"by name: {_words(described.get('additionalProperties', {}))}"
    limits = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    bounds = [f"{sign} {described[limit]:g}" for limit, sign in limits.items() if limit in described]
    name = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}.get(kind or "")
    return " ".join([name or ("null" if kind == "null" else "anything"), ", ".join(bounds)]).strip()


def _meanings(kind: type[BaseModel]) -> dict[str, str]:
    """Field -> what its class says of it: in the docstring's Attributes, or in the comment beside or above it."""
    meanings: dict[str, str] = {}
    for base in reversed([c for c in kind.__mro__ if issubclass(c, BaseModel) and c is not BaseModel]):
        meanings |= _commented(base) | _attributes(base)
    return meanings


def _attributes(kind: type[BaseModel]) -> dict[str, str]:
    found = _ATTRIBUTES.search(inspect.cleandoc(kind.__doc__ or "") + "\n\n")
    entries = re.findall(r"^    (\w[\w, ]*): (.*(?:\n {5,}.*)*)", found.group(1) if found else "", re.MULTILINE)
    return {name: " ".join(text.split()) for names, text in entries for name in names.split(", ")}


def _commented(kind: type[BaseModel]) -> dict[str, str]:
    try:
        source = inspect.cleandoc("\n" + inspect.getsource(kind))
    except (OSError, TypeError):  # made by pydantic's create_model
        return {}
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {
        t.start[0]: (t.string.lstrip("# "), t.line.lstrip()[:1] == "#") for t in tokens if t.type == tokenize.COMMENT
    }
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for node in definition.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            first = node.lineno
            while first - 1 in comments and comments[first - 1][1]:
                first -= 1
            above = [comments[line][0] for line in range(first, node.lineno)]
            beside = [comments[node.end_lineno][0]] if node.end_lineno in comments else []
            found[node.target.id] = " ".join(above + beside)
    return found


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("*", "\\*").replace("<", "&lt;")


def _write_schema(app: Sphinx, failed: Exception | None) -> None:
    if failed is None:
        schema = json.dumps(Result.model_json_schema(by_alias=True), indent=1)
        (app.outdir / "_static" / "result.schema.json").write_text(schema + "\n", encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    directives = {
        "config-keys": ConfigKeys,
        "result-keys": ResultKeys,
        "scenario-keys": ScenarioKeys,
        "scenarios": Scenarios,
        "commands": Commands,
    }
    for name, directive in directives.items():
        app.add_directive(name, directive)
    app.connect("build-finished", _write_schema)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
