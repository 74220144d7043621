"""The conda recipe has the version, the command and the dependencies of pyproject.toml."""

from __future__ import annotations

import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from ruamel.yaml import YAML

ROOT = Path(__file__).parents[2]
# conda-forge's names of others.
NAMES = {"opencv-contrib-python-headless": "py-opencv"}


def test_recipe_agrees_with_the_project() -> None:
    recipe = YAML(typ="safe", pure=True).load(ROOT / "docs" / "packaging" / "recipe.yaml")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    made, built = project["project"], project["build-system"]["requires"]
    assert recipe["context"]["version"] == made["version"]
    assert recipe["about"]["summary"] == made["description"]
    assert recipe["about"]["license"] == made["license"]
    command, entry = next(iter(made["scripts"].items()))
    assert recipe["build"]["python"]["entry_points"] == [f"{command} = {entry}"]
    expected = {f"python{made['requires-python']}", *map(_bound, made["dependencies"])}
    assert set(map(_bound, recipe["requirements"]["run"])) == expected
    assert set(map(_bound, built)) <= set(map(_bound, recipe["requirements"]["host"]))


def _bound(text: str) -> str:
    """Name and bounds, without markers."""
    requirement = Requirement(text)
    bounds = ",".join(sorted(map(str, requirement.specifier)))
    return f"{NAMES.get(requirement.name, requirement.name)}{bounds}"
