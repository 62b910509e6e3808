"""Fit: what an estimation found, as numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.parameter_errors import ParameterErrors
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.parameters.by_name import ByName
from casadi_engine.simulation.error_estimate import ErrorEstimate

Array = NDArray[np.float64]
AtBound = Literal[False, "min", "max"]


@dataclass(frozen=True)
class Estimate:
    """One number with its error.

    value, stderr : in ``unit``; stderr is None where there is none, and ``why`` says why
    at_bound : False, "min" or "max"; at a bound there is no symmetric error
    time : of an initial state, the instant that it holds at [s]
    interval : low, high of the 95 % interval by profile likelihood, where the error is not symmetric and that was
        quickly found
    quadratic : the standard error by the curvature at the optimum, where the fit found that it does not describe the
        likelihood; stderr is None then
    """

    value: float
    stderr: float | None
    unit: str
    at_bound: AtBound = False
    why: str | None = None
    fixed: bool = False
    time: float | None = None
    interval: tuple[float, float] | None = None
    quadratic: float | None = None


@dataclass(frozen=True)
class Trace:
    """One output of one record at its measured times.

    time : (N,) s; measured : (N,), NaN where missing; mask : (N,) bool, True where a sample counts;
    simulated : (N,) from the estimated initial state alone; predicted : (N,) one step ahead, or None for output error
    """

    time: Array
    measured: Array
    mask: NDArray[np.bool_]
    simulated: Array
    predicted: Array | None = None

    @property
    def residual(self) -> Array:
        """Measured less predicted (less simulated for output error), (N,); NaN where a sample is missing."""
        model = self.simulated if self.predicted is None else self.predicted
        return np.where(self.mask, self.measured - model, np.nan)


@dataclass(frozen=True)
class Innovations:
    """The one-step predictor of a fit, (2.10): x+ = A_D x + B_D u + K e, y = C x + D u + e.

    kind : "stated" (the gain was given), "innovations" (estimated entry by entry) or "process" (by the Riccati equation
    from noise covariances). gain : (n, ny) L of x + L e before a step. kalman : (n, ny) K = A_D L, state's unit per
    output's unit; stderr : (n, ny) of K, NaN where there is none. sigma : output -> standard deviation of its
    innovation e, in its unit. radius : spectral radius of A_D - K C, below one for a stable predictor. ``every`` : grid
    steps from one sample of the outputs to the next; between them the state is not corrected
    """

    kind: str
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    gain: Array
    kalman: Array
    stderr: Array
    sigma: Mapping[str, float]
    radius: float
    every: int = 1


@dataclass(frozen=True)
class Direction:
    """A combination of free parameters (or initial states) that the data do not determine.

    text : in words, largest entries first; weights : name -> share of the unit vector in scaled units
    """

    text: str
    weights: Mapping[str, float]


@dataclass(frozen=True)
class Optimum:
    """One local optimum of a multi-start: its cost, the free parameters, how many starts ended there.

    apart : the direction in which it differs from the best one, in words; empty for the best one itself
    initial : record -> state -> first value, where the search had come to any
    """

    cost: float
    values: Mapping[str, float]
    starts: int
    status: str
    apart: str = ""
    initial: Mapping[str, Mapping[str, float]] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, eq=False)
class Fit:
    """The answer of ``estimate``: parameters, errors, traces and how they were found.

    status : "converged", "interrupted" (the best point so far) or "not converged: <why>". Converged means that one more
    step would lower chi-squared by 0.001 at most (the optimum is within 0.03 standard errors), and that the simulation
    from these values and initial states has the chi-squared that the search found, within 0.001 and a millionth of it
    parameters : frozen set at the optimum. start : name -> value where the search was told to start (free
    parameters), whichever of several starts was the best
    estimates : name -> Estimate of every parameter of the set, tied, auxiliary and fixed ones too
    free : names of the estimated vector z. z : (nz,) its values. covariance : (nz, nz) of the quadratic around the
    optimum, also where the fit doubts it; zero rows for entries at a bound, NaN rows for entries that the data do not
    determine
    initial : record -> state -> Estimate
    noise : output -> (sigma, estimated)
    cost : sum of ((y - y_hat)/sigma)^2 + priors, simulated from these values as the traces are
    n : number of samples that count. dof : n less what was estimated
    traces : record -> output -> Trace. drives : record -> drive -> (2, N) array of times [s] and values
    fit_percent : record -> output -> {"simulation": %, "prediction": % or None}, (2.32)
    timing : seconds of "setup", "solve", "covariance", "total". nodes : number of shooting intervals
    messages : what the user should know. gain : correction gain L of the predictor, None for output error.
    integration : record -> estimated error of the integration at the optimum, empty for models that are solved exactly
    innovations : the predictor, with K and its errors, None for output error; with process noise ``noise`` holds the
    levels of the measurement alone
    errors : the errors of z as a prior for other data, whatever directions are not determined; None without an optimum
    own_noise : free parameter, or record/state for an initial state -> by how much its error is larger than that of
    white noise of the fit's levels, as the residual is coloured or larger than stated; 1 where it is neither
    fineness : record -> how finely it was integrated, for a fit that goes on from here
    lower : a place at which the profile of a parameter came below this optimum, if one did
    followed : length [s] of records along which an unstable motion can be followed, where these are longer
    """

    model: Model
    parameters: Parameters
    data: tuple[Experiment, ...]
    status: str
    estimates: Mapping[str, Estimate]
    start: Mapping[str, float]
    free: tuple[str, ...]
    z: Array
    covariance: Array
    undetermined: tuple[Direction, ...]
    initial: Mapping[str, Mapping[str, Estimate]]
    noise: Mapping[str, tuple[float, bool]]
    cost: float
    n: int
    dof: float
    iterations: int
    nodes: int
    optima: tuple[Optimum, ...]
    traces: Mapping[str, Mapping[str, Trace]]
    drives: Mapping[str, Mapping[str, Array]]
    fit_percent: Mapping[str, Mapping[str, Mapping[str, float | None]]]
    timing: Mapping[str, float]
    options: Mapping[str, Any] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    states_at_start: Mapping[str, Array] = field(default_factory=dict)
    gain: Array | None = None
    innovations: Innovations | None = None
    integration: Mapping[str, ErrorEstimate] = field(default_factory=dict)
    errors: ParameterErrors | None = None
    own_noise: Mapping[str, float] = field(default_factory=dict)
    fineness: Mapping[str, Any] = field(default_factory=dict, repr=False)
    followed: float | None = None
    lower: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "estimates", ByName(self.estimates))

    def __str__(self) -> str:
        from casadi_engine.estimation.summary import summary

        return summary(self)

    @property
    def converged(self) -> bool:
        """True if this is an optimum, and what is printed is it (see ``status``)."""
        return self.status == "converged"

    @property
    def residual_level(self) -> dict[str, float]:
        """Output -> standard deviation of its residual in the fit, in its unit."""
        if self.innovations is not None:
            return dict(self.innovations.sigma)
        return {name: sigma for name, (sigma, _) in self.noise.items()}

    @property
    def values(self) -> dict[str, float]:
        """Name -> value of every parameter."""
        return ByName({name: estimate.value for name, estimate in self.estimates.items()})

    def values_for(self, record: str) -> dict[str, float]:
        """Name -> value of every parameter in a record of this name.

        A parameter that varies by experiment has its own value in each record of the fit, and the records' mean in
        any other one (``averaged_for`` names those).
        """
        plain = self.parameters.as_dict()
        found = {name: self.values.get(f"{name}@{record}", self.values.get(name)) for name in plain}
        return {name: plain[name] if value is None else value for name, value in found.items()}

    def averaged_for(self, record: str) -> tuple[str, ...]:
        """Parameters that vary by experiment and of which a record of this name has no value of its own."""
        values = self.values
        return tuple(n for n in self.parameters.names if n not in values and f"{n}@{record}" not in values)

    @property
    def stderr(self) -> dict[str, float | None]:
        """Name -> standard error; None where there is none (``estimates[name].why`` says why)."""
        return ByName({name: estimate.stderr for name, estimate in self.estimates.items()})

    @property
    def doubted(self) -> tuple[str, ...]:
        """Free parameters whose errors are not known: the likelihood is not that of the quadratic, nor was an interval
        found quickly."""
        found = {name: self.estimates[name] for name in self.free if name in self.estimates}
        return tuple(name for name, one in found.items() if one.quadratic and one.interval is None)

    def to_inference_data(self, **options: Any) -> dict[str, Any]:
        """What ``arviz.from_dict(**...)`` takes, of the posterior of the parameters; no dependency.

        options : of ``casadi_engine.posterior``, which draws it and says what it refuses; to keep it, draw it yourself,
        ``ce.posterior(fit).to_inference_data()``
        """
        # the room above this one knows how to draw
        draw = import_module("casadi_engine.posterior.posterior").posterior
        found: dict[str, Any] = draw(self, **options).to_inference_data()
        return found

    @property
    def correlation(self) -> Array:
        """(nz, nz) correlation of the free parameters; NaN where one has no error."""
        spread = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.covariance / np.outer(spread, spread)
