"""Interface between a method and a solver: problem, steps, estimate.

A method writes its graph once, as a `Problem` that yields `Step`s in time order. The batch solver collects all steps
and solves once; the incremental solver feeds them one by one to a smoother. Both, and the published solver of the
method, return an `Estimate`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, ParamSpec

import gtsam
import numpy as np

from alidade.factors import so3
from alidade.factors.array import Array, Mask
from alidade.factors.bridge import BoundModel
from alidade.factors.loss import TruncatedLoss
from alidade.pipelines.estimation.finding import Motion
from alidade.pipelines.estimation.noise import Level
from alidade.pipelines.gaussian_prior import GaussianPrior

if TYPE_CHECKING:
    from alidade.pipelines.estimation.camera_clock import Keyframes
    from alidade.pipelines.estimation.error_map import ErrorMap, FoundMap


# What eliminates the linear systems of the batch solver, see solvers.engines.
EngineName = Literal["auto", "chain", "gtsam"]
# When attitudes are reported: where vision has one, or at each sample of the gyro.
AttitudeRate = Literal["vision", "gyro"]
# Frames in one vectorised factor of a gtsam graph: past this the Jacobians' zeros cost more than the calls they save.
CHUNK = 20

Arguments = ParamSpec("Arguments")

# What a method found beside its parameters: name of a table -> its rows, plain numbers and words in SI.
Findings = Mapping[str, Sequence[Mapping[str, object]]]

# Reported numbers (n,) of one variable and their Jacobian (n, d) with respect to its tangent.
Coordinates = Callable[[gtsam.Values, int], tuple[Array, Array]]


# Factor that takes rounding off half a turn.
_ALMOST = 1.0 - 1e-12


def vector_coordinates(values: gtsam.Values, key: int) -> tuple[Array, Array]:
    """Coordinates of a vector variable: the vector itself."""
    vector = np.asarray(values.atVector(key), dtype=float)
    return vector, np.eye(len(vector))


@dataclass(frozen=True)
class NearRotationVector:
    """Coordinates of a Rot3 variable: its rotation vector nearest to a given one, modulo full turns, rad.

    Half a turn is +pi in one recording and -pi in the next; compared, joined or given a prior, both have to be one.

    Attributes:
        reference: rotation vector that the reported one is to be near, rad.
    """

    reference: tuple[float, float, float]

    def __call__(self, values: gtsam.Values, key: int) -> tuple[Array, Array]:
        """Rotation vector (3,), rad, and its Jacobian by the variable."""
        phi = so3.log(so3.from_gtsam([values.atRot3(key)])[0])
        angle = float(np.linalg.norm(phi))
        away = (float(phi @ self.reference) / angle - angle) / (2.0 * np.pi) if angle > 0.0 else 0.0
        turns = round(_ALMOST * away)  # what is half a turn off stays, whatever rounding says
        if turns != 0:
            phi = phi * (1.0 + 2.0 * np.pi * turns / angle)
        return phi, so3.right_jacobian_inverse(phi)


# Coordinates of a Rot3 variable: its rotation vector, of at most half a turn, rad.
rotation_vector_coordinates = NearRotationVector((0.0, 0.0, 0.0))


@dataclass(frozen=True)
class CommonFactor:
    """Common factor of a sensor's K and b, inseparable from the strength of the measured field.

    What is left is the sensor's shape: K and b in units of that strength.

    Attributes:
        sensor: its name.
        require: accuracy wanted of the factor and of K over it, one sigma.
    """

    sensor: str
    require: float

    @property
    def scale(self) -> str:
        """Name of the derived number for the common factor, SENSOR_scale."""
        return f"{self.sensor}_scale"

    @property
    def shape(self) -> str:
        """Name of the derived number for K and b without the common factor, SENSOR_shape."""
        return f"{self.sensor}_shape"


# A recording says what a number is when its sigma is below this share of the prior's.
_DETERMINED = 0.5


@dataclass(frozen=True)
class Quantity:
    """Calibrated number as listed in the result.

    Attributes:
        name: as in result.json.
        unit: SI.
        prior_sigma: sigma of its prior; 0 fixes it, None leaves it free.
        prior_scale: the contract's default prior sigma, the yardstick for a free one.
        require: the accuracy wanted, sigma; infinite: none is.
        extra_sigma: known error that the graph does not model, added in square to the reported sigma.
        prior_mean: of its prior.
        group: "assumption" for a systematic effect that is estimated only to keep it out of the others; None for what
            is calibrated.
        nuisance: calibrated, but beside the purpose: a value far beyond its prior is a fault, as of an assumption.
        sheet: of an assumption, the data sheet's figure that its prior comes from, as in the config: "gyro.scale".
        factor: that it has in common with others; None: none.
        relative: its required accuracy is up to that factor, and it is judged with the others.
        valid_below: how far below its prior's mean the model is valid, one sigma, however wide the prior; None: as far
            as the prior allows.
    """

    name: str
    unit: str
    prior_sigma: float | None
    prior_scale: float
    require: float
    extra_sigma: float = 0.0
    prior_mean: float = 0.0
    group: Literal["assumption"] | None = None
    nuisance: bool = False
    sheet: str = ""
    factor: CommonFactor | None = None
    relative: bool = False
    valid_below: float | None = None

    @property
    def assumed(self) -> bool:
        """Whether the quantity is a nuisance parameter, with a prior from a data sheet or an assumption."""
        return self.nuisance or self.group is not None

    @property
    def tight(self) -> bool:
        """Whether the prior is tighter than the default one, and so is an explicit statement."""
        return 0.0 < (self.prior_sigma or 0.0) < self.prior_scale

    @property
    def required(self) -> bool:
        """Whether the quantity has a required accuracy."""
        return math.isfinite(self.require)

    @property
    def judged(self) -> bool:
        """Whether the quantity has a required accuracy of its own, and so a verdict."""
        return self.required and not self.relative

    @property
    def scale(self) -> float:
        """Reference for the quantity's sigma: the sigma of its prior, or of the default prior."""
        return self.prior_sigma or self.prior_scale

    def prior_at(self, value: float) -> float:
        """Sigma by which a value may differ from the prior's mean; 0 without a prior."""
        prior = self.prior_sigma or 0.0
        return prior if self.valid_below is None or value > self.prior_mean else min(prior, self.valid_below)

    def determined(self, sigma: float) -> bool:
        """Whether the recording rather than the prior determines the quantity, by its posterior sigma."""
        return self.prior_sigma != 0.0 and sigma < _DETERMINED * self.scale


@dataclass(frozen=True)
class Parameter:
    """A calibration variable of the graph, with the numbers that report its value."""

    key: int
    quantities: tuple[Quantity, ...]
    coordinates: Coordinates = vector_coordinates

    @property
    def is_rotation(self) -> bool:
        """Whether the parameter is a rotation, reported as a rotation vector."""
        return isinstance(self.coordinates, NearRotationVector)

    def near(self, numbers: Mapping[str, float]) -> Parameter:
        """Return the parameter with rotations reported by the rotation vector nearest to given numbers."""
        names = [q.name for q in self.quantities]
        if not self.is_rotation or any(name not in numbers for name in names):
            return self
        x, y, z = (float(numbers[name]) for name in names)
        return replace(self, coordinates=NearRotationVector((x, y, z)))


@dataclass(frozen=True)
class Factor:
    """A factor of the graph, with the family that accounts for its chi-square.

    Attributes:
        family: "vision", "gyro", "prior", ...
        native: a gtsam factor; None: it is a vectorised one.
        bound: the vectorised model behind it; None: it is a native one.
        is_measurement: whether it may be an outlier: the incremental solver gates its innovation, reports plot its
            residuals.
        beside: (n,) what a unit of the noise beside its own adds to the whitened residuals, see Noise.beside.
        fixed: (n,) part of the variance by which it is whitened that is no noise, and that no level scales.
    """

    family: str
    native: gtsam.NonlinearFactor | None = None
    bound: BoundModel | None = None
    is_measurement: bool = False
    beside: Array | None = None
    fixed: Array | None = None

    @classmethod
    def of(cls, family: str, measurement: BoundModel, beside: Array | None = None) -> Factor:
        """Build the factor of a measurement, which may be an outlier."""
        return cls(family, bound=measurement, is_measurement=True, beside=beside)

    @classmethod
    def process_of(
        cls, family: str, process: BoundModel, beside: Array | None = None, fixed: Array | None = None
    ) -> Factor:
        """Build the factor of a process, which joins variables and is never an outlier."""
        return cls(family, bound=process, beside=beside, fixed=fixed)

    @property
    def factor(self) -> gtsam.NonlinearFactor:
        """The gtsam factor; a vectorised factor builds a new one at every call."""
        if self.bound is not None:
            return self.bound.factor
        assert self.native is not None
        return self.native

    @property
    def keys(self) -> list[int]:
        """Keys of the factor's variables."""
        return list(self.factor.keys()) if self.bound is None else self.bound.keys

    @property
    def measurement(self) -> BoundModel | None:
        """The vectorised model of a measurement; None for any other factor."""
        return self.bound if self.is_measurement else None

    def rebound(self, bound: BoundModel) -> Factor:
        """Return the factor with another vectorised model."""
        return replace(self, bound=bound)

    def linearized(self, values: gtsam.Values) -> gtsam.GaussianFactor:
        """Linearise the factor about the values."""
        return self.factor.linearize(values) if self.bound is None else self.bound.linearized(values)


@dataclass(frozen=True)
class Step:
    """Addition to the graph at one moment; read-only once a method has filled its collections.

    Attributes:
        time: s from the session's start.
        initial: the new variables, with values taken from the data around them (batch).
        factors: the new factors. Those that are no measurements must by themselves determine the new variables: the
            innovation of a measurement is judged against that prediction.
        predict: the new variables from the current estimate (incremental); None means `initial` serves.
        timestamps: variable -> time of last use, s. A smoother with a window forgets a variable when its time leaves
            the window; one that is named in no step is kept for good. Repeat a key to keep it alive.
        current_keys: parameter key -> variable that from now on holds its value, for parameters that move along.
        keyframes: index range of the states this step adds, for `Problem.attitudes`.
    """

    time: float
    initial: gtsam.Values = field(default_factory=gtsam.Values)
    factors: list[Factor] = field(default_factory=list)
    predict: Callable[[gtsam.Values], gtsam.Values] | None = None
    timestamps: dict[int, float] = field(default_factory=dict)
    current_keys: dict[int, int] = field(default_factory=dict)
    keyframes: range = range(0)


@dataclass(frozen=True)
class ChainLayout:
    """Variables of a problem that form a chain, by the letters of their symbols; all others are shared.

    Every measurement depends on the states of one keyframe or of two successive ones, on the bias node in force there
    and on shared variables. A factor of few rows may join the states of many keyframes.

    Attributes:
        states: letters of the variables, one a keyframe, of which its state is made; not all need be there.
        nodes: letter of the nodes of a bias that walks and, where there is one, of its running means. The first node is
            a shared variable, the mean up to its end too; the later ones are deviations from it.
    """

    states: str = ""
    nodes: str = ""


@dataclass(frozen=True)
class Attitudes:
    """A trajectory: times (n,), s from the session's start, and quaternions (n, 4), w x y z."""

    time: Array
    wxyz: Array


@dataclass(frozen=True)
class CorrelatedError:
    """Gauss-Markov error that measurements may have: of a rotation R that they share, R Exp(u).

    Attributes:
        key: of the rotation.
        level: of its noise, rad, as far as it is known beforehand.
        least: sigma, rad, of errors that are material; smaller ones stay noise.
    """

    key: int
    level: Level
    least: float


@dataclass(frozen=True)
class Problem:
    """The graph of one recording.

    Attributes:
        method: its name.
        parameters: what is calibrated, in reporting order.
        steps: yields the graph; its argument is how many measurements a step takes together at least (one when fed to a
            smoother, many in batch, where fewer and larger factors are faster). Steps of many end where some of one do.
        loss: shared by all measurements that may be outliers; the batch solver anneals it. None: no outliers expected.
        attitudes: the trajectory at some keyframes, given values that hold them; None when the method has none.
        at_gyro_rate: the trajectory at each sample of the gyro, from an estimate's and its values by name. None: the
            method has no such.
        advice: what to do about a weak direction, given its weights by parameter name.
        dropped: measurements left out before solving, reason -> count.
        premises: assumptions that a reader has to know, sentences.
        steps_after: the steps of one measurement or more that are later than a time, s, for graphs whose steps stay
            as they are while the recording grows, but for those of its last second. None: all may change.
        continuation: the graph of a recording that grows, from the data of its end and the time, s, of a keyframe of
            this graph that is in them and from which on there are steps; -inf: from all data, with all steps. It agrees
            with this one on variables, and its steps stay as they are, but for the last one and those of the last
            `revision_horizon` s. None if there is no such keyframe. Not every graph can be built from the end alone.
        revision_horizon: length, s, of the end of the graph whose steps still change while the recording grows.
        noises: that are in force, with what sensors' own samples say of them.
        constants: numbers of the recording that formulas need beside the parameters, by name.
        keyframes: where they stand; None: there are no pictures with a clock that is estimated.
        elsewhere: of a solution, values that explain the measurements as well in another way, near which there may be
            other minima. None: the method has no such.
        layout: how its variables are a chain; None: they are none, and gtsam eliminates them.
        marginal_likelihood: whether noise levels are those that maximise it, for which it needs a layout.
        step_candidates: keys of rotations that are tested for a step at one moment, as of a mount that slips.
        offsets: names of the quantities, each sensor's together, that are tested for a step at one moment.
        correlated_error: that measurements may have, and that is looked for; None: the method has none.
        refined_graph: noise levels -> the graph that they need, with more keyframes or with an error that is
            correlated in time; None where this one serves.
        error_map: errors that measurements may have at the places that an estimate finds; None: the method has none.
        gaussian_priors: joint priors from elsewhere than data sheets; the last one about a number is in force.
    """

    method: str
    parameters: tuple[Parameter, ...]
    steps: Callable[[int], Iterator[Step]]
    loss: TruncatedLoss | None = None
    attitudes: Callable[[Sequence[int], gtsam.Values], Attitudes] | None = None
    at_gyro_rate: Callable[[Attitudes, Mapping[str, float]], Attitudes] | None = None
    advice: Callable[[Mapping[str, float]], Motion] | None = None
    dropped: Mapping[str, int] = field(default_factory=dict)
    premises: tuple[str, ...] = ()
    steps_after: Callable[[float], Iterator[Step]] | None = None
    continuation: Callable[[Any, float], Problem | None] | None = None
    revision_horizon: float = 1.0
    noises: tuple[Level, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict)
    keyframes: Keyframes | None = None
    elsewhere: Callable[[gtsam.Values], Iterator[gtsam.Values]] | None = None
    layout: ChainLayout | None = None
    marginal_likelihood: bool = False
    step_candidates: tuple[int, ...] = ()
    offsets: tuple[tuple[str, ...], ...] = ()
    correlated_error: CorrelatedError | None = None
    refined_graph: Callable[[Sequence[Level]], Problem | None] | None = None
    error_map: Callable[[Estimate], ErrorMap | None] | None = None
    gaussian_priors: tuple[GaussianPrior, ...] = ()

    def near(self, numbers: Mapping[str, float]) -> Problem:
        """Return the problem with rotations reported by the rotation vectors nearest to given ones (rad, by name)."""
        return replace(
            self,
            parameters=tuple(parameter.near(numbers) for parameter in self.parameters),
            continuation=changed(self.continuation, lambda more: more.near(numbers)),
            refined_graph=changed(self.refined_graph, lambda more: more.near(numbers)),
        )

    def at_levels(self, levels: Sequence[Level]) -> Problem:
        """Return the graph that some noise levels need: this one, or one with more keyframes or states."""
        return (self.refined_graph and self.refined_graph(levels)) or self

    def numbers(self, estimate: Estimate) -> dict[str, float]:
        """Inputs of formulas by name: an estimate's values, and the constants."""
        return {**self.constants, **dict(zip(estimate.names, estimate.values.tolist(), strict=True))}

    def graph(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Build the gtsam graph and initial values, for gtsam's optimizers, Marginals and ISAM2."""
        graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for step in self.steps(CHUNK):
            initial.insert(step.initial)
            for factor in step.factors:
                graph.add(factor.factor)
        return graph, initial

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """All calibrated numbers, in reporting order."""
        return tuple(q for p in self.parameters for q in p.quantities)

    @property
    def estimated(self) -> tuple[str, ...]:
        """Names of the calibrated numbers that are not fixed, in reporting order."""
        return tuple(q.name for q in self.quantities if q.prior_sigma != 0.0)

    def prior_covariance(self, names: Sequence[str], sigmas: Array) -> Array:
        """Prior covariance (m, m) of named numbers, from sigmas (m,) and the correlations of `gaussian_priors`."""
        covariance = np.diag(np.square(sigmas))
        for gaussian_prior in self.gaussian_priors:
            known = gaussian_prior.of(names)
            at = np.array([list(names).index(name) for name in known.names], dtype=np.intp)
            covariance[at], covariance[:, at] = 0.0, 0.0
            covariance[np.ix_(at, at)] = known.covariance
        return covariance


def changed(
    make: Callable[Arguments, Problem | None] | None, change: Callable[[Problem], Problem]
) -> Callable[Arguments, Problem | None] | None:
    """Compose a function that makes a problem (or None) with a change of that problem."""
    if make is None:
        return None

    def made(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Problem | None:
        problem = make(*args, **kwargs)
        return None if problem is None else change(problem)

    return made


@dataclass(frozen=True)
class Residuals:
    """Residuals of one family of measurements.

    Attributes:
        time: (n,) s.
        whitened: (n, m), each of unit variance if the noise is as stated.
        used: (n,) False for measurements rejected as outliers.
    """

    time: Array
    whitened: Array
    used: Mask


@dataclass(frozen=True)
class ChiSquare:
    """Sum of squared whitened residuals with its degrees of freedom, in total and by family."""

    value: float
    dof: float
    families: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class History:
    """Estimates over time: times (k,), s, values and sigmas (k, n), in the order of Estimate.names."""

    time: Array
    values: Array
    sigmas: Array

    def inflated(self, by: Array) -> History:
        """Multiply the history's sigmas by factors (n,)."""
        return replace(self, sigmas=self.sigmas * by)


@dataclass(frozen=True)
class PosteriorHistory:
    """Joint posterior at moments, each given all data before, all with the same noise levels.

    Attributes:
        time: (k,), s.
        values: (k, n) in the order of Estimate.names.
        covariance: (k, n, n) for white noise.
        steady: (n,) which quantities are the same number at all times; the others walk.
    """

    time: Array
    values: Array
    covariance: Array
    steady: Mask

    @property
    def history(self) -> History:
        """Convert the covariances of the history to sigmas."""
        return History(self.time, self.values, np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))


@dataclass(frozen=True)
class InfluentialMeasurement:
    """Influence of a measurement on the parameter that the measurement shifts most, in sigmas.

    Attributes:
        family: of the measurement.
        time: s, its own, or that of the last reading in it.
        parameter: its name.
        sigmas: how far the measurement takes it, in the parameter's sigmas; left out, it would be back by that, and by
            more where few others observe it.
    """

    family: str
    time: float
    parameter: str
    sigmas: float


@dataclass(frozen=True, eq=False)
class SqrtInformation:
    """Square-root information of a recording about its free numbers: R (x - at) = d, rows of unit variance.

    It is linear about the estimate.

    Attributes:
        names: (n,) of the numbers.
        at: (n,) the estimate.
        R: (r, n) of measurements and all priors but those of the device.
        d: (r,).
        prior_R: (p, n) of the device's priors.
        prior_d: (p,).
        scales: (n,) the usual priors' sigmas, so that angles, rates and seconds are comparable.
        added: (n, m) S of the errors S a, a unit normal, that are marginalised out of R and d beside; None: none.
    """

    names: tuple[str, ...]
    at: Array
    R: Array
    d: Array
    prior_R: Array
    prior_d: Array
    scales: Array
    added: Array | None = None


@dataclass(frozen=True)
class Minimum:
    """An alternative solution: reported values (n,), and the excess of its chi-square, priors included."""

    values: Array
    chi_square: float


# Chi-square of three numbers beyond which a step by motion alone is another one than with the chain: one in a hundred.
APART = 11.345


@dataclass(frozen=True)
class StepEstimate:
    """Estimated step of a parameter at one moment of a recording, with its test statistics.

    Attributes:
        time_s, since_s: of the first measurement after it, and of the last one before, s.
        steps: parameter -> its step and the sigma of that, SI.
        size, sigma: of the step as a rotation, rad.
        fall: of -2 log L with the step and noise levels found anew, less what a wide prior of it pays.
        by_motion: chi-square of the step by motion alone: the attitude is free to jump with it.
        apart: chi-square of the difference of both steps.
        ratio: of sandwich to nominal sigmas, the largest of any direction of both, near an end also of the parameter
            with the step held fixed, at least 1.
        ratio_by_motion: of the step by motion alone.
        jumped: whether vision jumps by three sigmas, and does not come back soon.
    """

    time_s: float
    since_s: float
    steps: Mapping[str, tuple[float, float]]
    size: float
    sigma: float
    fall: float
    by_motion: float
    apart: float
    ratio: float
    ratio_by_motion: float
    jumped: bool

    @property
    def agrees(self) -> bool:
        """Whether the step from all data agrees with the step from motion alone.

        What the reference errs slowly moves both, and is more than chance where the step itself is large.
        """
        return self.apart <= max(APART * self.ratio_by_motion**2, 0.25 * self.by_motion)

    @property
    def statistic(self) -> float:
        """Chi-square of the step: the smaller of both tests if these agree and it is no rise, else 0."""
        return max(min(self.fall, self.by_motion), 0.0) / self.ratio**2 if self.agrees else 0.0


@dataclass(frozen=True)
class OffsetStep:
    """Most significant step of a recording's offsets at one moment.

    Attributes:
        time_s: of the first measurement after it, s.
        statistic: size of the step as a standard normal number.
        level: p-value, anywhere in the recording.
        steps: offset -> its step and the sigma of that, SI.
    """

    time_s: float
    statistic: float
    level: float
    steps: Mapping[str, tuple[float, float]]


# Ratio of sandwich to nominal sigmas from which on it counts: 1.3 over 25 blocks has p = .01.
SLOW_ERROR = 1.3


@dataclass(frozen=True)
class Estimate:
    """Calibration result of one solver; `names`, `values` (n,) and `covariance` (n, n) are in one order.

    Attributes:
        solver: "batch", "incremental" or "published".
        names: of the quantities this solver knows (a published one may know fewer than the problem has).
        values: (n,).
        covariance: (n, n), joint, of the reported numbers, everything else marginalised out. Rows of fixed quantities
            are zero. Directions without any information have the variance of a very wide prior, never infinity.
        converged: whether the solver converged; `message`: how, or why not.
        residuals: family -> residuals of measurements at the estimate; innovations if `has_innovations`.
        innovations: family -> those of a batch solution, predicted from what was measured before by its noise levels.
        chi_square: None for solvers that have none.
        history: values and sigmas from what was recorded until each moment; None: not asked for.
        posterior_history: joint posterior at moments; None: not asked for, or noise levels differ between moments.
        smoothed: values and sigmas at each moment from the whole recording, where parameters move along; the others
            are as they are at the end.
        attitudes: the trajectory, if the method has one.
        budget: quantity -> source -> its share of the quantity's variance, the largest first; None: not asked for.
        moved: input of the graph -> quantity -> by how much it moves when that input is changed; None: not asked for.
        strongest: the measurements that move parameters most, the strongest first; None: not asked for.
        rejected: family -> number of measurements rejected as outliers.
        levels: of the noises; none: all are as stated.
        colours: family -> how many of its measurements in a row count as one, of those whose residuals are correlated.
        sandwich: (n,) ratio of sandwich to nominal sigma, at least 1, where noise levels maximise the likelihood: what
            errs slowly and is no noise of the model makes it large. Above SLOW_ERROR it is in the covariance. None: not
            looked for.
        steps: those that explain the recording best, the most significant first; None: not looked for.
        offset_step: the most significant one of `Problem.offsets`; None: not looked for.
        inflation: (n,) by what the sigmas are larger because residuals are correlated in time; None: by nothing.
        sqrt_info: information without the device's priors; None: not asked for.
        error_map: errors by where measurements are made that were found, and are in it; None: none, or not looked for.
        second: the second best solution of several, if it is nearly as likely; None: there is none, or not looked for.
        prior_z: see `prior_z_scores`, where prior conflicts have widened the covariance; None: as it is.
        concluded: whether an incremental solver's run ended with the solution of all rows together.
        seconds: phase -> wall time.
    """

    solver: str
    names: tuple[str, ...]
    values: Array
    covariance: Array
    converged: bool
    message: str
    residuals: Mapping[str, Residuals] = field(default_factory=dict)
    innovations: Mapping[str, Residuals] = field(default_factory=dict)
    chi_square: ChiSquare | None = None
    history: History | None = None
    posterior_history: PosteriorHistory | None = None
    smoothed: History | None = None
    attitudes: Attitudes | None = None
    budget: Mapping[str, Mapping[str, float]] | None = None
    moved: Mapping[str, Mapping[str, float]] | None = None
    strongest: tuple[InfluentialMeasurement, ...] | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)
    levels: tuple[Level, ...] = ()
    colours: Mapping[str, float] = field(default_factory=dict)
    inflation: Array | None = None
    sandwich: Array | None = None
    steps: tuple[StepEstimate, ...] | None = None
    offset_step: OffsetStep | None = None
    sqrt_info: SqrtInformation | None = None
    error_map: FoundMap | None = None
    second: Minimum | None = None
    prior_z: tuple[float | None, ...] | None = None
    concluded: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def sigmas(self) -> Array:
        """Standard deviations (n,) of the values."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def has_innovations(self) -> bool:
        """Whether the residuals are innovations: measured minus predicted from earlier data."""
        return self.solver == "incremental" and not self.concluded

    @property
    def sensitivities(self) -> Array:
        """Shift (n, n) of each number (row) per unit shift of another (column); 0 for fixed columns.

        Of the covariance without what only widens sigmas: slow errors, and a map of errors that moves nothing.
        """
        P, found = self.covariance, self.error_map
        if found is not None and not found.map.moves:
            P = P - found.columns @ found.columns.T
        widened = slow_widening(self.sandwich, len(self.values))
        P = P / np.outer(widened, widened)
        variances = np.diag(P)
        return P / np.where(variances > 0.0, variances, np.inf)

    @property
    def inflations(self) -> Array:
        """Inflation factors (n,) of the sigmas; ones where `inflation` is None."""
        return np.ones(len(self.values)) if self.inflation is None else self.inflation

    @property
    def widenings(self) -> Array:
        """Ratio (n,) of the sigmas to those by white noise alone: correlated residuals, and slow errors."""
        return self.inflations * slow_widening(self.sandwich, len(self.values))

    def widest(self, quantities: Sequence[Quantity]) -> float:
        """Largest inflation, at least 1, of a judged quantity's sigma by correlated residuals and slow errors."""
        ratios = self.inflations if self.sandwich is None else self.inflations * self.sandwich
        return float(ratios[[q.judged for q in quantities]].max(initial=1.0))


def slow_widening(sandwich: Array | None, n: int) -> Array:
    """Factors (n,) on sigmas for slow errors, from ratios of sandwich to nominal sigma; None: ones."""
    return np.ones(n) if sandwich is None else np.where(sandwich > SLOW_ERROR, sandwich, 1.0)
