"""Every pinned run-time dependency as a wheel, for each platform and Python: nothing is compiled at an installation.

    python tests/install/wheels.py          # exit code 1 if one is missing; needs pip and a package index

pip takes wheels of other platforms, and environment markers of its own; the dependencies are found here.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
# What pip takes on systems of 2021 and later: glibc 2.34, macOS 14.
_GLIBC = ("manylinux2014", *(f"manylinux_2_{minor}" for minor in range(17, 35)))
_MACOS = tuple(f"macosx_{version}_0" for version in range(11, 15))
# Name -> sys_platform, platform_machine, tags of wheels.
PLATFORMS = {
    "Linux x86-64": ("linux", "x86_64", _GLIBC),
    "Linux aarch64": ("linux", "aarch64", _GLIBC),
    "macOS arm64": ("darwin", "arm64", _MACOS),
}
PYTHONS = ("3.11", "3.12", "3.13", "3.14")


def pinned(environment: dict[str, str]) -> list[str]:
    """The run-time dependencies in an environment, name==version, with all that they need."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = {pin.name: pin for pin in map(Requirement, lines) if pin.marker is None or pin.marker.evaluate(environment)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    left, found = [Requirement(each) for each in project["dependencies"]], dict[str, str]()
    while left:
        needed = left.pop()
        name = needed.name.lower().replace("_", "-").replace(".", "-")
        if name in found or (needed.marker is not None and not needed.marker.evaluate({**environment, "extra": ""})):
            continue
        found[name] = f"{name}{pins[name].specifier}"
        try:
            left += map(Requirement, requires(name) or ())
        except PackageNotFoundError:  # not needed here, and without dependencies of its own
            continue
    return sorted(found.values())


def missing(system: str, machine: str, tags: tuple[str, ...], python: str) -> str:
    """What pip says of the dependencies that have no wheel; empty if all have one."""
    own = {"sys_platform": system, "platform_machine": machine, "python_version": python}
    known = {key: str(value) for key, value in default_environment().items()}
    with tempfile.TemporaryDirectory() as target:
        command = [
            *(sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--disable-pip-version-check"),
            *(
                "--no-deps",
                "--ignore-requires-python",
                "--ignore-installed",
                "--only-binary=:all:",
                "--target",
                target,
                "--python-version",
                python,
            ),
            *(option for tag in tags for option in ("--platform", f"{tag}_{machine}")),
            *pinned({**known, **own, "python_full_version": f"{python}.0"}),
        ]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    return run.stderr.strip() if run.returncode else ""


def main() -> Iterator[str]:
    """A line for each pair of platform and Python that lacks a wheel."""
    for platform, (system, machine, tags) in PLATFORMS.items():
        for python in PYTHONS:
            lack = missing(system, machine, tags, python)
            print(f"{platform}, Python {python}: {'LACKS A WHEEL' if lack else 'wheels of all dependencies'}")
            if lack:
                yield f"{platform}, Python {python}: {lack}"


if __name__ == "__main__":
    sys.exit("\n".join(main()) or None)  # an empty text would be a failure
