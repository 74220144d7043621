"""Directives that make tables of the program itself, so that no page can say anything else.

    ```{config-keys}            keys of a config, of all sections
    ```{noise}                  noise of a config, with units and defaults
    ```{parameters} head        parameters of a method: meaning, unit, prior, requirement
    ```{arrays} head            arrays of a method's data
    ```{members} alidade.Method public names of a module or class, and what each is
    ```{topics}                 topics of all methods
    ```{data-sheets}            figures of data sheets, defaults and sources
    ```{result-keys}            keys of result.json
    ```{scenario-keys} head     settings of a method's simulator, YAML
    ```{scenarios} head         scenarios of a method, with their descriptions
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
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import typer
from docutils import nodes
from pydantic import BaseModel
from ruamel.yaml import YAML
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import alidade
from alidade.pipelines import methods
from alidade.pipelines.applications import cli
from alidade.pipelines.config import load_config, model
from alidade.pipelines.estimation.problem import Quantity
from alidade.pipelines.noises import NOISES
from alidade.pipelines.recording.topics import Topic
from alidade.pipelines.reports.result_json import Result
from alidade.pipelines.settings import DEFAULT_NOISE, Noise, Sensors
from alidade.pipelines.simulation.scenario import summary

SHEETS = Path(__file__).parents[1] / "reference" / "data-sheets.yaml"
_ATTRIBUTES = re.compile(r"\n\s*Attributes:\n(.*?)(\n\n|\Z)", re.DOTALL)


def config_keys() -> Iterator[str]:
    """A table of keys for each section of a config."""
    return _tables(model(), "", known={Noise})


def result_keys() -> Iterator[str]:
    """A table of keys for each object of result.json."""
    return _tables(Result, "")


def scenario_keys(name: str) -> Iterator[str]:
    """The settings of a method's simulator as YAML with their defaults; `noise` and `sensors` are those of a config."""
    yield "```yaml"
    yield from _listing(methods.method(name).scenario, "")
    yield "```"


def _listing(kind: type[BaseModel], margin: str) -> Iterator[str]:
    meanings = _meanings(kind)
    for name, field in kind.model_fields.items():
        key, models = field.alias or name, [found for found in _models(field.annotation) if found is not Sensors]
        default = field.get_default(call_default_factory=True)
        text = meanings.get(name, "")
        remark = f"  # {text}" if text else ""
        if models and isinstance(default, BaseModel):
            yield f"{margin}{key}:{remark}"
            yield from _listing(models[0], margin + "  ")
        else:
            value = json.dumps(default, default=lambda part: part.model_dump(exclude_defaults=True))
            yield f"{margin}{key}: {value}{remark}"
            if models:
                yield f"{margin}  # {'each' if default == [] else 'or'}: {', '.join(models[0].model_fields)}"


def scenarios(name: str) -> Iterator[str]:
    """A row for each scenario that comes with a method."""
    yield from ("| scenario | what it shows |", "| --- | --- |")
    for scenario, path in methods.scenarios()[name].items():
        yield f"| `{scenario}` | {_cell(summary(path))} |"


def commands() -> Iterator[str]:
    """A section for each command: usage, help, options."""
    group: Any = typer.main.get_command(cli.app)
    context = group.make_context("alidade", [], resilient_parsing=True)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        help_ = command.get_help(command.make_context(name, [], parent=context, resilient_parsing=True))
        yield from ("", f"## alidade {name}", "", "```text", *help_.splitlines(), "```")


def noise() -> Iterator[str]:
    """A row for each noise of a config, with its unit and default."""
    units = _meanings(Noise)
    yield from ("| key | unit | default | noise of |", "| --- | --- | --- | --- |")
    for key, default in DEFAULT_NOISE.model_dump().items():
        meaning = NOISES[key].description.removesuffix(".")
        yield f"| `{key}` | {_cell(units[key])} | {default:g} | {meaning} |"


def parameters(name: str) -> Iterator[str]:
    """A row for each kind of parameter of a method: meaning, unit, default prior and requirement, data-sheet figure."""
    method = methods.method(name)
    kinds: dict[tuple[str, str], list[Quantity]] = {}
    for quantity in _quantities(method):
        kinds.setdefault((_kind(quantity.name), quantity.sheet), []).append(quantity)
    yield from ("| parameters | meaning | unit | prior sigma | requirement |", "| --- | --- | --- | --- | --- |")
    for (_, sheet), found in kinds.items():
        first = found[0]
        names = f"`{first.name}`" + (f" to `{found[-1].name}`" if len(found) > 1 else "")
        prior = f"{first.prior_scale:.2g}" + (f" (`{sheet}`)" if sheet else "")
        require = f"{first.require:.2g}" if first.judged else ""
        unit = first.unit or "1"
        yield f"| {names} | {_cell(method.describe(first.name))} | {unit} | {prior} | {require} |"


def _quantities(method: methods.Method) -> list[Quantity]:
    """All parameters of a method's recordings, those of its plainest scenario first."""
    found: dict[str, Quantity] = {}
    for scenario in _SHOWN[method.name]:
        simulated = alidade.simulate(method.name, scenario, seed=0)
        problem = method.problem(simulated.data, load_config(simulated.config.encode()))
        found |= {q.name: q for parameter in problem.parameters for q in parameter.quantities if q.name not in found}
    return list(found.values())


# Scenarios that together have all parameters of a method.
_SHOWN: dict[str, tuple[str, ...]] = {
    "los": ("los_nominal", "los_warming"),
    "indexer": ("indexer_nominal", "indexer_warming"),
    "head": ("head_mounts", "head_warming"),
    "cube": ("cube_nominal", "cube_warming"),
    "tumble": ("tumble_nominal", "tumble_imu", "tumble_phone"),
}


def _kind(name: str) -> str:
    """The name of a parameter without axes, tags and rows of a matrix."""
    return re.sub(r"(_\d+)?(_[xyzenu]{1,2}|_?[123]{1,2})?(_sin|_cos)?$", "", re.sub(r"_\d+_", "_ID_", name))


def topics() -> Iterator[str]:
    """A row for each topic that a method reads."""
    rows: dict[Topic, list[str]] = {}
    for name in methods.names():
        for topic in methods.method(name).topics:
            rows.setdefault(topic, []).append(name)
    yield from ("| key | default name | methods | message types |", "| --- | --- | --- | --- |")
    for topic, names in rows.items():
        types = ", ".join(each.rpartition("/")[2] for each in topic.types)
        yield f"| `{topic.key}` | `{topic.name}` | {', '.join(names)} | {types} |"


def arrays(name: str) -> Iterator[str]:
    """The arrays of a method's data, as its class describes them."""
    kind = methods.method(name).data
    yield f"{inspect.cleandoc(kind.__doc__ or '')}".replace("*", "\\*")


def members(name: str) -> Iterator[str]:
    """A row for each public name of a module or class, with the first paragraph of its docstring."""
    owner = _named(name)
    names = getattr(owner, "__all__", None) or [each for each in vars(owner) if not each.startswith("_")]
    yield from ("| name | meaning |", "| --- | --- |")
    for each in names:
        found = getattr(owner, each)
        text = inspect.getdoc(found) or ""
        if text and (callable(found) or isinstance(found, property) or inspect.ismodule(found)):
            yield f"| `{each}` | {_cell(' '.join(text.partition(chr(10) * 2)[0].split()))} |"


def _named(name: str) -> Any:
    """A module, or a class in one."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        module, _, attribute = name.rpartition(".")
        return getattr(import_module(module), attribute)


def data_sheets() -> Iterator[str]:
    """Figures of data sheets as one sigma, and the program's defaults beside them."""
    sheets = YAML(typ="safe").load(SHEETS.read_text(encoding="utf-8"))
    yield from ("## Figures", "")
    for figure, entry in sheets["figures"].items():
        defaults = ", ".join(f"{name} {sigma:g}" for name, sigma in default_sigmas(figure).items())
        yield from (
            "",
            f"### `{figure}`",
            "",
            f"Unit: {entry['unit']}. Default: {defaults or 'none'}. {entry['right_for']}",
            "",
        )
        if "devices" in entry:
            yield from ("| device | sheet | one sigma | source |", "| --- | --- | --- | --- |")
            for device in entry["devices"]:
                yield "| " + " | ".join(_cell(str(part)) for part in device) + " |"
    yield from ("", "## Sources", "")
    yield from (f"- [{key}] {_cell(text)}" for key, text in sheets["sources"].items())


def default_sigmas(figure: str) -> dict[str, float]:
    """Method -> default of a figure of a data sheet, in the methods that use it."""
    specs = {name: methods.method(name).parameters for name in methods.names()}
    return {name: spec.prior for name, own in specs.items() for spec in own if spec.data_sheet == figure}


# Name of a directive -> the function that writes its Markdown; what stands behind the name is its argument.
GENERATED: dict[str, Callable[..., Iterator[str]]] = {
    "config-keys": config_keys,
    "result-keys": result_keys,
    "scenario-keys": scenario_keys,
    "scenarios": scenarios,
    "commands": commands,
    "noise": noise,
    "parameters": parameters,
    "topics": topics,
    "arrays": arrays,
    "members": members,
    "data-sheets": data_sheets,
}


class _Generated(SphinxDirective):
    """A directive whose content is Markdown that a function writes."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """The text, read as the page is, anew each time: the program may have changed."""
        self.env.note_reread()
        text = "\n".join(GENERATED[self.name](*self.arguments))
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def _tables(
    kind: type[BaseModel], path: str, level: int = 2, known: set[type[BaseModel]] | None = None
) -> Iterator[str]:
    """A table of a model's keys, then those of the models inside it, each model once.

    Args:
        kind: the model.
        path: of its keys, with a dot at the end.
        level: of the headings.
        known: models that stand elsewhere; those that are shown here are added.
    """
    known = set() if known is None else known
    known.add(kind)
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
        text = meanings.get(name) or (_about(models[0]).partition("\n")[0] if models else "")
        rows.append([f"`{key}`", _cell(_words(described)), default, _cell(text)])
        shape = next((part for part in described.get("anyOf", ()) if part.get("type") != "null"), described)
        many = "[]." if shape.get("type") == "array" else ".NAME." if "additionalProperties" in shape else "."
        inside += [(found, f"{path}{key}{many}") for found in models]
    yield from ("| key | value | default | meaning |", "| --- | --- | --- | --- |")
    yield from (f"| {' | '.join(row)} |" for row in rows)
    for found, where in inside:
        if found not in known:
            yield from _tables(found, where, level, known)


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
    """A JSON schema in the notation of TypeScript, with bounds: `number > 0`, `text | null`, `number[3]`."""
    if not isinstance(described, dict):
        return "any"
    if "$ref" in described:
        return "section"
    if "anyOf" in described or "oneOf" in described:
        return "/".join(dict.fromkeys(map(_words, described.get("anyOf") or described["oneOf"])))
    if "const" in described or "enum" in described:
        return "/".join(f"`{value}`" for value in described.get("enum", [described.get("const")]))
    kind = described.get("type")
    if kind == "array":
        items = described.get("prefixItems")
        return f"number[{len(items)}]" if items else f"{_words(described.get('items', {}))}[]"
    if kind == "object":
        return f"{{NAME: {_words(described.get('additionalProperties', {}))}}}"
    limits = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    bounds = [f"{sign}{described[limit]:g}" for limit, sign in limits.items() if limit in described]
    name = {"number": "number", "integer": "integer", "string": "text", "boolean": "true/false"}.get(kind or "")
    return "".join([name or ("null" if kind == "null" else "any"), *bounds])


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
    for name in GENERATED:
        app.add_directive(name, _Generated)
    app.connect("build-finished", _write_schema)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
