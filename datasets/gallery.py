"""Public recordings, one or more a method, calibrated with one command, and what others published of the same device.

    python -m datasets.gallery FOLDER        # the table of datasets/README.md, of the files that are in FOLDER

Recordings are not part of the project: `address` of each says where they are. No recording of a gimbal with encoders,
gyro and image error (`los`) is public.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alidade.factors.array import Array
from datasets import imu_tk_xsens, imucal

GRAVITY = 9.81  # m/s^2
Values = Mapping[str, float]


@dataclass(frozen=True)
class Recording:
    """A public recording, with its source and the commands that calibrate it.

    Attributes:
        method: that calibrates it.
        file: below the folder of the recordings; sha256: of it, hexadecimal.
        address: of the repository, with the commit; licence: of the recordings there.
        convert: module that makes a session of it; its argument below the folder; empty: read as it is.
        options: of `alidade calibrate`.
        what: what is compared, with its unit.
        found: estimates or their sigmas by name -> the numbers compared.
        published: the same numbers by others; by: how they found them.
    """

    method: str
    file: str
    sha256: str
    address: str
    licence: str
    what: str
    found: Callable[[Values], Array]
    published: tuple[float, ...]
    by: str
    convert: str = ""
    argument: str = ""
    options: tuple[str, ...] = ()

    @property
    def source(self) -> str:
        """Source of the recording: address, file, licence, checksum."""
        return f"{self.address}, {Path(self.file).name}, {self.licence}, {self.sha256[:16]}"

    @property
    def commands(self) -> str:
        """Commands of the calibration, as typed in the folder of the file."""
        name = Path(self.argument or self.file).name
        if not self.convert:
            return f"`alidade calibrate {' '.join((name, *self.options))}`"
        return f"`python -m {self.convert} {name} --out s.mcap`, `alidade calibrate s.mcap`"


def _named(*names: str, unit: float = 1.0) -> Callable[[Values], Array]:
    return lambda values: unit * np.array([values[name] for name in names])


def _xyz(name: str, unit: float = 1.0) -> Callable[[Values], Array]:
    return _named(*(f"{name}_{axis}" for axis in "xyz"), unit=unit)


def _at_rest(values: Values) -> Array:
    """Gyro reading at rest with z up, deg/s: bias plus the effect of gravity."""
    felt = np.array([values.get(f"gyro_g_{axis}z", 0.0) for axis in "xyz"])
    return np.asarray(np.rad2deg(_xyz("gyro_bias")(values) + GRAVITY * felt))


RECORDINGS = (
    Recording(
        "head",
        "broad/01_undisturbed_slow_rotation_A.mat",
        "ad2cec0390a279953084e1de12dfd8d542af55e4ea187e68e8ebb7c316ecb96b",
        "github.com/dlaidig/broad at 7e2f8189",
        "CC BY 4.0",
        "rate at rest, deg/s",
        _at_rest,
        (-0.077, -0.075, 0.470),
        "mean rate at rest",
        "datasets.broad",
    ),
    Recording(
        "indexer",
        "imucal/annotated_session.csv",
        "bd4b8f3b4b270d76327523d886d9b056c3b6da405420824b62267fbce30379ff",
        "github.com/mad-lab-fau/imucal at 8716e4c5",
        "MIT",
        "gyro, counts per deg/s",
        lambda values: imucal.COUNTS * (1.0 + _xyz("gyro_scale")(values)),
        (16.678, 16.188, 16.253),
        "imucal",
        "datasets.imucal",
    ),
    Recording(
        "cube",
        "imu_tk_xsens/xsens_acc.mat.gz",
        "1b20fc52b16a97ffd3af9d5017bca629214f948708e9d54c72ecfd8cf697f820",
        "github.com/Kyle-ak/imu_tk at 7780270f",
        "BSD",
        "accelerometer, counts per m/s²",
        lambda values: imu_tk_xsens.as_on_sheet(values)[0].scale,
        (415.0, 413.0, 415.0),
        "factory sheet",
        "datasets.imu_tk_xsens",
        "imu_tk_xsens",
    ),
    Recording(
        "tumble",
        "reports/files/qmc5883l_noisy.csv",
        "703d0f329c27d2985cef49b89bcee0d1ca0b815d3c687089d1a4d33657b0a513",
        "github.com/tomisuarez2/ImuCalibration",
        "MIT",
        "magnetometer, field strengths per 1000 counts",
        _named("mag_k11", "mag_k22", "mag_k33", unit=1e3),
        (0.93, 1.37, 0.62),
        "ellipsoid fit",
        options=("--method", "tumble", "--auto-columns"),
    ),
)


def calibrated(recording: Recording, folder: Path) -> tuple[str, Array, Array]:
    """Run the commands; return status, numbers (n,) and their sigmas (n,), propagated to first order."""
    with tempfile.TemporaryDirectory() as place:
        session = folder / recording.file
        if recording.convert:
            session = Path(place) / "s.mcap"
            given = folder / (recording.argument or recording.file)
            _run("-m", recording.convert, str(given), "--out", str(session))
        out = Path(place) / "out"
        _run("-m", "alidade", "calibrate", str(session), *recording.options, "--out", str(out), "--quiet")
        result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    names, covariance = result["covariance"]["order"], np.array(result["covariance"]["matrix"])
    values = {parameter["name"]: parameter["value"] for parameter in result["parameters"]}
    x, best = np.array([values[name] for name in names]), recording.found(values)
    J = np.zeros((len(best), len(names)))
    for i, name in enumerate(names):
        step = 1e-2 * np.sqrt(covariance[i, i])
        if step > 0.0:
            J[:, i] = (recording.found({**values, name: x[i] + step}) - best) / step
    return result["status"], best, np.sqrt(np.diag(J @ covariance @ J.T))


def table(folder: Path) -> Iterator[str]:
    """Yield the table's lines, for the recordings that are present."""
    yield "| method | recording, licence, SHA-256 | commands | quantity | found | published |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for each in RECORDINGS:
        path = folder / each.file
        if not path.is_file():
            print(f"{path} is not there: {each.address}", file=sys.stderr)
            continue
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if digest != each.sha256:
            print(f"{path}: SHA-256 {digest}, not {each.sha256}: another version", file=sys.stderr)
        status, found, sigma = calibrated(each, folder)
        numbers = ", ".join(f"{a:.4g} ± {s:.1g}" for a, s in zip(found, sigma, strict=True))
        other = ", ".join(f"{value:.4g}" for value in each.published)
        result = f"{each.what} | {numbers} ({status}) | {other} ({each.by})"
        yield f"| {each.method} | {each.source} | {each.commands} | {result} |"


def _run(*command: str) -> None:
    subprocess.run([sys.executable, *command], check=False, stdout=subprocess.DEVNULL)


def main() -> None:
    """Print the gallery's table."""
    parser = argparse.ArgumentParser(description="Calibrate public recordings; print found and published numbers.")
    parser.add_argument("folder", type=Path, help="of the recordings, as `file` of each has them")
    for line in table(parser.parse_args().folder):
        print(line, flush=True)


if __name__ == "__main__":
    main()
