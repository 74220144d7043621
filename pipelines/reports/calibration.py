"""calibration.yaml: the result for people and for programs that apply it; and result.json as such a calibration.

saved = load_calibration(Path("out/calibration.yaml"))
saved.value("gyro_bias_x"), saved.rotations["helmet_mount"]
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, PrivateAttr, ValidationError

from alidade.factors import so3
from alidade.factors.array import Array
from alidade.pipelines.diagnostics.observability import Verdict
from alidade.pipelines.errors import InputError
from alidade.pipelines.estimation.finding import Status
from alidade.pipelines.files import MAX_RESULT_BYTES, MAX_YAML_BYTES, as_date, load_yaml, read_bytes, yaml_float
from alidade.pipelines.gaussian_prior import GaussianPrior, independent
from alidade.pipelines.methods.formula import Value, results
from alidade.pipelines.reports.result import Calibration
from alidade.pipelines.reports.result_json import invalid, read_result
from alidade.pipelines.reports.values import Application, SensorValues, difference
from alidade.pipelines.settings import Config

_HEAD = """\
# Calibration by alidade. Units are SI and radians, quaternions w x y z. aRb maps coordinates in b to coordinates in a,
# Exp turns a rotation vector into a rotation. Do not apply parameters whose verdict is weak or unobservable.
# Formulas leave out what the recording does not determine, and use `applied` where a parameter has one: the best value
# without that, its estimate if what is left out is at its prior mean.
"""
# More digits than any sigma needs, fewer than tire the eye.
_DIGITS = 12
# A rotation's meaning in the formulas begins with its frames, and this is a step for its derivatives.
_FRAMES = re.compile(r"([\w ]+) to ([\w ]+)(?:,|$)")
_STEP = 1e-6
# Of what was found beside the parameters.
_FEWER_DIGITS = 6
# A covariance is symmetric, and none of its eigenvalues negative, to this share.
_ROUNDING = 1e-6


class _Record(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False, populate_by_name=True)


class SavedParameter(_Record):
    """Parameter, SI; `applied`: its value in formulas that leave out nuisance parameters, None: `value`."""

    value: float
    sigma: float
    unit: str
    verdict: Verdict | None
    applied: float | None = None

    @property
    def in_formulas(self) -> float:
        """Value that formulas use for the parameter."""
        return self.value if self.applied is None else self.applied

    def __repr__(self) -> str:
        return f"<{self.value:.6g} ± {self.sigma:.2g} {self.unit}, {self.verdict}>"


class SavedRotation(_Record):
    """A rotation made of three parameters: its name in the formulas and its quaternion."""

    name: str
    wxyz: tuple[float, float, float, float]


class SavedTransform(_Record):
    """A mounting rotation as programs want it: the attitude of the frame `child` in `parent`.

    The covariance, 3x3 by rows, is that of small rotations about the parent's axes, rad^2.
    """

    parent: str
    child: str
    wxyz: tuple[float, float, float, float]
    covariance: Annotated[tuple[float, ...], Field(min_length=9, max_length=9)]


class SavedRecording(_Record):
    """Recording that the device was calibrated on."""

    file: str
    sha256: str
    start: str


class SavedCalibration(_Record, SensorValues):
    """Content of a calibration.yaml."""

    schema_name: Annotated[Literal["alidade.calibration/1"], Field(alias="schema")] = "alidade.calibration/1"
    method: str
    solver: str
    status: Status
    recording: SavedRecording
    # SHA-256 of each recording behind the values, where there are several.
    sources: list[str] = []
    parameters: dict[str, SavedParameter]
    rotations: dict[str, SavedRotation] = {}
    transforms: dict[str, SavedTransform] = {}
    # The method's own tables, which result.json has as `tables`.
    findings: dict[str, list[dict[str, object]]] = Field(
        default={}, validation_alias=AliasChoices("findings", "tables")
    )
    formulas: list[str] = []
    constants: dict[str, float] = {}
    _config: Config = PrivateAttr(default_factory=Config)
    _joint_prior: GaussianPrior | None = PrivateAttr(default=None)
    _source: str = PrivateAttr(default="")

    def with_joint(self, gaussian_prior: GaussianPrior) -> SavedCalibration:
        """This calibration with its parameters' joint distribution, which calibration.yaml does not have."""
        known = self.model_copy()
        known._joint_prior = gaussian_prior
        return known

    def includes(self, sha256: str) -> bool:
        """Whether the values come from the recording of this SHA-256, alone or among others."""
        return sha256 in (self.recording.sha256, *self.sources)

    @property
    def gaussian_prior(self) -> GaussianPrior:
        """Gaussian distribution of the parameters, independent where their joint distribution is not known."""
        given = self.parameters.values()
        return self._joint_prior or independent(
            list(self.parameters), [p.value for p in given], [p.sigma for p in given], self._source
        )

    @property
    def start_ns(self) -> int:
        """Start of the calibration's recording, Unix ns, to the second; UTC without a zone. Raises InputError."""
        try:
            return round(as_date(self.recording.start).timestamp()) * 1_000_000_000
        except InputError as error:
            raise InputError(f"{self._source}: start of the recording: {error}") from error

    def of_method(self, name: str) -> SavedCalibration:
        """Return this calibration. Raises InputError when it is another method's."""
        if self.method != name:
            raise InputError(
                f"{self.gaussian_prior.source}: is a calibration of {self.method}, not of {name}; give one that "
                f"`calibrate --method {name}` wrote"
            )
        return self

    @property
    def values(self) -> dict[str, float]:
        """Parameters and constants by name."""
        return {**self.constants, **{name: parameter.value for name, parameter in self.parameters.items()}}

    def _joint(self) -> tuple[Sequence[str], Array]:
        if self._joint_prior is None:
            raise InputError(
                "calibration.yaml has no joint covariance: result.json is not beside it, or of another one"
            )
        return self._joint_prior.names, self._joint_prior.covariance

    def to_dict(self) -> dict[str, Any]:
        """The content of calibration.yaml."""
        return self.model_dump(by_alias=True, mode="json")

    def __repr__(self) -> str:
        return f"<SavedCalibration {self.method}, {self.solver}, of {self.recording.file}: {self.status}>"

    def value(self, name: str) -> float:
        """Value of a parameter. Raises InputError if the calibration has none of that name."""
        if name not in self.parameters:
            raise InputError(f"the calibration has no parameter {name}; it has {', '.join(self.parameters)}")
        return self.parameters[name].value

    def application(self) -> Application:
        """Formulas, values and config with which the calibration is applied."""
        from alidade.pipelines.methods import method

        text = "\n".join(self.formulas)
        # A formula names a parameter, or the vector that it is a component of.
        applied = [name for name in self.parameters if re.search(rf"\b({name}|{name[:-2]})\b", text)]
        formulas_of = method(self.method).report.formulas
        formulas = formulas_of(applied, self._config)
        if [formula.text for formula in formulas] != self.formulas:
            raise InputError(
                "apply: the formulas in the calibration are not those of its parameters and this config: "
                "`--config` has to be the config of the calibration, as for cube.raw"
            )
        values = {name: self.parameters[name].in_formulas for name in applied}
        return Application(formulas, formulas_of(list(self.parameters), self._config), values, self.constants)


def calibration_yaml(calibration: Calibration) -> str:
    """Return the text of calibration.yaml."""
    from ruamel.yaml import YAML
    from ruamel.yaml.comments import CommentedMap
    from ruamel.yaml.representer import RoundTripRepresenter

    class Representer(RoundTripRepresenter):
        """YAML representer with floats as `yaml_float` writes them."""

    def one_line(entry: dict[str, object]) -> CommentedMap:
        flat = CommentedMap(entry)
        flat.fa.set_flow_style()
        return flat

    Representer.add_representer(
        float, lambda made, value: made.represent_scalar("tag:yaml.org,2002:float", yaml_float(value))
    )
    content = saved(calibration).model_dump(by_alias=True, mode="json")
    for entry in content["parameters"].values():
        if entry["applied"] is None:
            del entry["applied"]
    for section in ("parameters", "rotations", "transforms"):
        content[section] = {name: one_line(entry) for name, entry in content[section].items()}
    content["findings"] = {name: [one_line(row) for row in rows] for name, rows in content["findings"].items()}
    for key in ("constants", "sources"):
        if not content[key]:
            del content[key]
    yaml = YAML()
    yaml.Representer = Representer
    yaml.width = 200
    text = StringIO()
    yaml.dump(content, text)
    return _HEAD + text.getvalue()


def saved(calibration: Calibration) -> SavedCalibration:
    """Return a calibration as the content of its calibration.yaml."""
    used = calibration.applied_values
    parameters = {
        p.name: SavedParameter(
            value=_rounded(p.value),
            sigma=_rounded(p.sigma),
            unit=p.unit,
            verdict=p.observability,
            applied=None if (applied := _rounded(used.get(p.name, p.value))) == _rounded(p.value) else applied,
        )
        for p in calibration.parameters.values()
    }
    content = SavedCalibration(
        method=calibration.problem.method,
        solver=calibration.estimate.solver,
        status=calibration.status,
        recording=SavedRecording(file=calibration.recording, sha256=calibration.sha256, start=calibration.start),
        sources=calibration.sources,
        parameters=parameters,
        rotations=rotations_of(calibration),
        transforms=_transforms(calibration),
        findings={name: [_plain(row) for row in rows] for name, rows in calibration.tables.items()},
        formulas=[formula.text for formula in calibration.formulas],
        constants=dict(calibration.problem.constants),
    )
    content._config, estimate = calibration.config, calibration.estimate
    content._joint_prior = GaussianPrior(
        estimate.names, estimate.values, calibration.covariance, str(Path(calibration.recording))
    )
    return content


def load_calibration(path: Path, config: Config | None = None) -> SavedCalibration:
    """Read calibration.yaml, with the config that its formulas are for. Raises InputError when it cannot be used."""
    data = read_bytes(path, MAX_YAML_BYTES)
    try:
        content = load_yaml(data, str(path))
        if isinstance(content, dict) and content.get("schema") == "alidade.result/1":
            raise InputError(f"{path}: is a result.json, which has no formulas")
        read = SavedCalibration.model_validate(content)
        read._config, read._source = config or Config(), str(path)
        return read
    except InputError as error:
        raise InputError(f"{error}; a calibration.yaml as `alidade calibrate` writes it is needed") from error
    except ValidationError as error:
        raise invalid(path, "a calibration.yaml", error) from error


def load_known(path: Path) -> SavedCalibration:
    """Read result.json, with its joint covariance, or calibration.yaml, whose numbers count as independent.

    Raises:
        InputError: the file cannot be used.
    """
    data = read_bytes(path, MAX_RESULT_BYTES)
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: neither a result.json nor a calibration.yaml: it is no text") from error
    known = _of_result(path, text) if text.lstrip().startswith("{") else load_calibration(path)
    _ = known.start_ns  # refused now where it is no date
    return known


def with_covariance(known: SavedCalibration, path: Path) -> SavedCalibration:
    """A calibration with the joint covariance of the result.json beside it, if that is of the same calibration."""
    beside = path.with_name("result.json")
    if path == beside or not beside.is_file():
        return known
    try:
        joint = load_known(beside)
    except InputError:
        return known
    ours, theirs = ((each.recording.sha256, each.solver, list(each.parameters)) for each in (known, joint))
    return known.with_joint(joint.gaussian_prior) if ours == theirs else known


def _of_result(path: Path, text: str) -> SavedCalibration:
    result = read_result(path, text)
    names = tuple(p.name for p in result.parameters)
    covariance = np.array(result.covariance.matrix, dtype=float) if names else np.empty((0, 0))
    if tuple(result.covariance.order) != names or covariance.shape != (len(names), len(names)):
        raise InputError(f"{path}: not a result.json: its covariance is not that of its parameters")
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scaled = covariance / np.outer(np.where(sigmas > 0.0, sigmas, 1.0), np.where(sigmas > 0.0, sigmas, 1.0))
    asymmetry, negative = np.abs(scaled - scaled.T).max(initial=0.0), -np.linalg.eigvalsh(scaled).min(initial=0.0)
    if np.diag(covariance).min(initial=0.0) < 0.0 or max(asymmetry, negative) > _ROUNDING:
        raise InputError(f"{path}: not a result.json: its covariance is none")
    known = SavedCalibration(
        method=result.method,
        solver=result.solver,
        status=result.status,
        recording=SavedRecording(file=path.name, sha256=result.session.sha256, start=result.session.start),
        parameters={
            p.name: SavedParameter(value=p.value, sigma=float(sigma), unit=p.unit, verdict=p.observability)
            for p, sigma in zip(result.parameters, sigmas, strict=True)
        },
        constants=result.constants or {},
        sources=result.sources or [part.sha256 for part in result.recordings or ()],
    )
    return known.with_joint(GaussianPrior(names, np.array([p.value for p in result.parameters]), covariance, str(path)))


def as_saved(given: str | Path | Calibration | SavedCalibration, config: Config | None = None) -> SavedCalibration:
    """Return a calibration as the content of calibration.yaml; of a file, with the config that its formulas are for.

    Raises:
        InputError: the file cannot be used.
    """
    if isinstance(given, str | Path):
        return load_calibration(Path(given), config)
    return saved(given) if isinstance(given, Calibration) else given


def rotations_of(calibration: Calibration) -> dict[str, SavedRotation]:
    """Return the parameters that are rotation vectors as quaternions w, x, y, z, by name."""
    values: Mapping[str, float] = {name: p.value for name, p in calibration.parameters.items()}
    found = {}
    for parameter in calibration.problem.parameters:
        names = [q.name for q in parameter.quantities]
        if parameter.is_rotation and all(name in values for name in names):
            name, spec = names[0].rsplit("_", 1)[0], calibration.method.spec(names[0])
            w, x, y, z = (_rounded(v) for v in so3.exp(np.array([values[n] for n in names])).tolist())
            found[name] = SavedRotation(name=spec.rotation if spec and spec.rotation else name, wxyz=(w, x, y, z))
    return found


def _transforms(calibration: Calibration) -> dict[str, SavedTransform]:
    """Return the rotations among the formulas that have no measured input, between the frames in their meaning."""
    estimate, covariance = calibration.estimate, calibration.covariance
    unknown = dict.fromkeys((q.name for q in calibration.problem.quantities), 0.0)
    given = calibration.method.report.fixed_rotations(calibration.config)

    def at(values: Array) -> dict[str, Value]:
        known = {**unknown, **dict(zip(estimate.names, values.tolist(), strict=True))}
        return results(calibration.formulas, known, given)

    best = np.array([calibration.applied_values.get(name, value) for name, value in calibration.values.items()])
    there = at(best)
    rotations = {
        f.name: named.groups()
        for f in calibration.formulas
        if f.name in there and there[f.name].kind == "rotation" and (named := _FRAMES.match(f.description))
    }
    if not rotations:
        return {}
    ends = [(at(best + step), at(best - step)) for step in _STEP * np.eye(len(estimate.names))]
    found = {}
    for name, frames in rotations.items():
        turns = [difference(ahead[name], behind[name]) for ahead, behind in ends]
        J = np.array(turns).T / (2.0 * _STEP)
        child, parent = (word.strip().lower().replace(" ", "_") for word in frames)
        w, x, y, z = (_rounded(v) for v in there[name].array.tolist())
        spread = tuple(_rounded(float(v), _FEWER_DIGITS) for v in (J @ covariance @ J.T).ravel())
        found[name] = SavedTransform(parent=parent, child=child, wxyz=(w, x, y, z), covariance=spread)
    return found


def _plain(value: Any) -> Any:
    """Return a row of findings, or a value in it, with its numbers rounded."""
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return _rounded(value, _FEWER_DIGITS) if isinstance(value, float) else value


def _rounded(value: float, digits: int = _DIGITS) -> float:
    return float(f"{value:.{digits}g}")
