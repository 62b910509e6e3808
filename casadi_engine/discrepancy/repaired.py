"""Repair: what ``repair`` found, as numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.confirmation import Gap, PairedGain
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.latent_torque import LatentTorque
from casadi_engine.discrepancy.random_families import Course
from casadi_engine.estimation.fit import Estimate, Fit, Trace
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.term import NotApplicable
from casadi_engine.parameters import Parameters

Array = NDArray[np.float64]
Verdict = Literal["named", "class", "unnamed", "nothing missing"]
# Why effects that were found are no answer.
REFUSED, UNCONFIRMED = "contradicted by fresh data", "not confirmed by fresh data"
IN_PART = "closing the gap of fresh data in part alone"
TOO_LITTLE, BEHIND_LAW = "closing too little of the gap", "less probable than an unknown law"
LEAVING, BENT = (
    "leaving more than noise",
    "bending to what is missing, by what is too large to be true",
)
UNJUDGED = "leaving more than noise, and not held against fresh data before the time was up"
BEHIND_OTHERS = "far less probable than what could not be fitted to its end"


# What was not searched where the time was up before fresh data were asked.
FRESH_DATA = "the fresh data"
# What an answer says that was made before it was looked for anything.
UNTOLD = "the time was up before it could be told whether anything is missing"
# What is said of a law that is seen along a simulation far from the motion.
FAR_OFF = "where it acts is not certain"
# What an answer does without where the time was up, and so is not known of laws that no effect names.
LAWS_CUT = (
    "a law that no effect names, in the place of those found: not looked for, as the time was up",
    "what such a law does as a part of the equations: not looked for, as the time was up",
)
UNTRIED = "it was not refitted in the equations, as the time was up: where it acts is not certain"
# How the word on what came nearest begins, where the time was up before its fit.
SO_FAR = "the most probable so far is"
MORE_THAN_NOISE = (
    "the residual is larger than the noise that was stated; the time was up before it was told by what"
)


@dataclass(frozen=True)
class Member:
    """One effect of a class: rho, its correlation with the lead; probability of the model with it in the lead's place,
    given the data, among the members; more : what else is meant by it, " with EFFECT at PORT" for two effects in the
    place of one."""

    name: str
    at: str
    rho: float
    probability: float
    more: str = ""

    @property
    def label(self) -> str:
        """``EFFECT at PORT``, and what else is meant."""
        return f"{self.name} at {self.at}{self.more}"


@dataclass(frozen=True, eq=False)
class FoundEffect:
    """An effect that the data ask for.

    name, at : effect and port; sentence : in words; values : nuisance values of the grid point that scored best
    parameters : name -> Estimate after the refit, ``at.name.parameter``, the amplitude first; the amplitude is zero
    in the null model. constants : whole numbers that belong to it (the cycles of a misfire)
    z, p_value : the score, and the p-value pooled over the whole library; drop : fall of chi-squared by the refit
    share_explained : of the gap above the noise, closed by adding it
    predicted_shift, found_shift : old parameter -> change in its unit, by the score and by the refit
    selection_frequency : share of half-samples of the cycles in which it scores best; None for too few cycles
    members : its class, the lead first, alone where the data name it
    course : record -> (2, K) times [s] and its value, torque [N m] where it is one, along the repaired model
    why_withdrawn : why it is no part of the answer; "" where it is
    """

    name: str
    at: str
    sentence: str
    values: Mapping[str, float]
    parameters: Mapping[str, Estimate]
    constants: Mapping[str, float]
    z: float
    p_value: float
    drop: float
    share_explained: float
    predicted_shift: Mapping[str, float]
    found_shift: Mapping[str, float]
    selection_frequency: float | None
    members: tuple[Member, ...]
    course: Mapping[str, Array] = field(default_factory=dict)
    why_withdrawn: str = ""

    @property
    def key(self) -> str:
        """``port.effect``."""
        return f"{self.at}.{self.name}"

    @property
    def amplitude(self) -> Estimate:
        """The estimate of the amplitude."""
        return next(iter(self.parameters.values()))


@dataclass(frozen=True)
class ScoreRow:
    """The score of one candidate against the null model: an effect at a port, at one choice of its nuisance values.

    z : N(0, 1) if nothing is missing; statistic : |z|, or z cut at 0 in the allowed direction; p_value of it alone
    amplitude, stderr : one-step estimate in ``unit``; smallest_detectable : found with 95 % power, inf if not testable
    testability : share of its sensitivity that the parameters leave, 0..1; significant : beyond the threshold
    """

    effect: str
    at: str
    label: str
    values: Mapping[str, float]
    z: float
    statistic: float
    p_value: float
    amplitude: float
    stderr: float
    unit: str
    smallest_detectable: float
    testability: float
    testable: bool
    significant: bool


@dataclass(frozen=True, eq=False)
class ClassMatrix:
    """Which effects the data tell apart: labels and (effect, port) keys of k candidates, their correlation (k, k)."""

    labels: tuple[str, ...]
    keys: tuple[tuple[str, str], ...]
    rho: Array


@dataclass(frozen=True)
class Place:
    """Where the gap sits; a part is None where the data do not single one out.

    location : port at which a torque of unknown course explains most; record; time : (from, to) s; cycles : from 1
    crank_angle : (from, to) rad in 0..4 pi, from > to where it goes over 0; order : per revolution
    excess : record -> share of chi-squared above the noise
    """

    location: str | None
    record: str
    time: tuple[float, float]
    cycles: tuple[int, ...] | None
    crank_angle: tuple[float, float] | None
    order: float | None
    excess: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Side:
    """Simulation against data, before or after: the gap by output, whiteness p-values by record and output (None where
    the test cannot be made), and traces record -> output -> Trace.

    On fresh data: within_errors : chi-squared per sample that is left once the parameters have moved as far as their
    errors allow; parameters_p : the chance that they would have to move so far; both None elsewhere. left : output ->
    what share of its squares they leave then; jointly : that is of one set of parameters for all records
    fits : those that the traces are of
    """

    gap: Gap
    whiteness_p: Mapping[str, Mapping[str, float | None]]
    traces: Mapping[str, Mapping[str, Trace]]
    within_errors: float | None = None
    parameters_p: float | None = None
    fits: tuple[Fit, ...] = field(default=(), repr=False)
    left: Mapping[str, float] = field(default_factory=dict)
    jointly: bool = False


@dataclass(frozen=True, eq=False)
class Gaps:
    """The gap before and after, on the data that the repair was found from and on fresh ones (None without).

    validation_before/after hold the parameters and find initial states alone; their whiteness is that of what errors of
    the parameters do not explain. gain_per_cycle : of fresh data
    source : "records" (fresh ones), "cycles" (held out) or None
    """

    estimation_before: Side
    estimation_after: Side
    validation_before: Side | None = None
    validation_after: Side | None = None
    gain_per_cycle: PairedGain | None = None
    source: Literal["records", "cycles"] | None = None


@dataclass(frozen=True, eq=False)
class Unknown:
    """Something is missing that no effect of the library names.

    sentence : in words; tests : name of each rejected residual test -> p-value; port, signal : the torque at ``port``
    as a function of ``signal`` that explains most, with its p-value and course, None if no such function does
    odds : how many times more probable that function is than the effects that were found in its place, where it is
    held against them and they do not exclude it
    """

    sentence: str
    tests: Mapping[str, float]
    port: str | None = None
    signal: str | None = None
    p_value: float | None = None
    course: Course | None = None
    odds: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Nearest:
    """The model with the effects that were withdrawn, where these are not all that is missing, or not it.

    names : "effect at port" of each; fit : on the data of the search; estimation, validation : the gap with it, None
    without fresh data
    """

    names: tuple[str, ...]
    fit: Fit
    estimation: Gap
    validation: Gap | None = None

    def __repr__(self) -> str:
        """The names, and what is left with them; the model is ``fit``."""
        sides = [("", self.estimation), ("fresh ", self.validation)]
        left = [
            f"{words}rmse {', '.join(f'{name} {size:.4g}' for name, size in gap.rmse.items())}"
            for words, gap in sides
            if gap is not None
        ]
        return f"Nearest({' and '.join(self.names)}: {'; '.join(left)}; .fit is the model)"

    def closes(self, gaps: Gaps, sigma: Mapping[str, float] | None = None) -> float:
        """Share of the squared gap that is closed, outputs in units of their noise ``sigma``, or the mean of all where
        it is not known; where there are fresh data, the smaller one of both."""
        pairs = [(gaps.estimation_before.gap, self.estimation)]
        if gaps.validation_before is not None and self.validation is not None:
            pairs.append((gaps.validation_before.gap, self.validation))
        found = []
        for before, after in pairs:
            known = {name: size for name, size in before.rmse.items() if size > 0}
            noise = {name: (sigma or {}).get(name) or size for name, size in known.items()}
            if known:
                left = sum((after.rmse[name] / noise[name]) ** 2 for name in known)
                found.append(1 - left / sum((size / noise[name]) ** 2 for name, size in known.items()))
        return min(found, default=0.0)


def more_probable(unknown: Unknown | None) -> bool:
    """True for a law of no name that is far more probable than the effects that were found."""
    return unknown is not None and unknown.odds is not None and unknown.odds >= FACTOR


def in_its_place(unknown: Unknown | None, effects: Sequence[FoundEffect]) -> bool:
    """True where a law of no name may stand in the place of effects: it is far more probable, or what they leave is
    again a function at a port of theirs, so that they are a part of it."""
    if unknown is None or unknown.odds is not None or unknown.course is None:
        return more_probable(unknown)
    return any(one.at == unknown.port for one in effects)


@dataclass(frozen=True)
class NotFound:
    """An effect that was looked for and not found: the smallest size that would have been, with 95 % power, in ``unit``
    (inf where not testable, which is not to say that it is absent).

    note : why it is not testable, or why that size is no plausible one, so that nothing is excluded; "" for others
    twin : ``effect at port`` of another that does the same in these data: one of this size would be found, and may be
    taken for that; "" for others
    """

    name: str
    at: str
    smallest_detectable: float
    unit: str
    testable: bool
    note: str = ""
    twin: str = ""

    @property
    def excluded(self) -> bool:
        """True if larger sizes than the smallest detectable one are excluded, and those are plausible."""
        return self.testable and not self.note


@dataclass(frozen=True)
class NextExperiment:
    """The experiment that would split a class: what to change, the pairs of effects that it splits, and the separation
    d expected with it and now (d = 3.3: right in 95 %)."""

    change: str
    splits: tuple[str, ...]
    expected_separation: float
    separation_now: float


@dataclass(frozen=True)
class Equation:
    """Equations of the repaired model; terms : the lines that the repair changed."""

    text: str
    latex: str
    terms: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class NoiseFound:
    """The noise of the score tests: sigma : output -> (standard deviation, estimated); colour : "record/output" ->
    order of its autoregression; scatter : kind -> standard deviation of a relative amplitude, cycle by cycle;
    is_coloured : it has a colour beyond chance."""

    sigma: Mapping[str, tuple[float, bool]]
    colour: Mapping[str, int]
    scatter: Mapping[str, float]
    is_coloured: bool = False


@dataclass(frozen=True)
class Round:
    """One round of the search: structures (label, gain of log evidence over the one before), their refits (label,
    chi-squared, converged), the label kept or None, the labels dropped, and effects that were not refitted (label,
    chi-squared by one step in the place of the best one), as they stay far above it."""

    proposals: tuple[tuple[str, float], ...]
    refits: tuple[tuple[str, float, bool], ...]
    kept: str | None
    dropped: tuple[str, ...]
    left_out: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Repair:
    """The answer of ``repair``.

    status : "answered", or why there is no answer
    verdict : "named", "class" (one of several, a law of no name among them), "unnamed", "nothing missing", or None
        without an answer
    confirmed : fresh data agree; False where they withdrew the repair; None without fresh data or with too few cycles
    null_fit : the fit without effects, on the data of the search; fit : with all effects found (the null fit if none)
    model, parameters : the repaired model and its parameters
    effects : found, in the order in which they were; withdrawn : found first and then refused by fresh data
    alpha : false-alarm rate over the whole library; threshold : its |z|; threshold_p : the p-value of a single test
    candidates : how many were tested; scores : of every candidate against the null model
    not_applicable : effects that could not be looked for at a port, and why
    data, fresh : records of the search, and those (or held-out cycles) of the confirmation
    latent : a torque of unknown course per port before the repair, the one that explains most first
    timing : seconds of each part and "total"; messages : what the user should know
    stopped : "the user" or "the time budget" where one of them ended the search, else ""; not_searched : what it was
        about to try
    blind : True if the whole library was asked for, and no effect of it could act inside the model
    nearest : of an answer without a name, the model with the effects that were withdrawn; None without any
    """

    status: str
    verdict: Verdict | None
    confirmed: bool | None
    null_fit: Fit
    fit: Fit
    alpha: float
    threshold: float | None = None
    threshold_p: float | None = None
    candidates: int = 0
    scores: tuple[ScoreRow, ...] = ()
    matrix: ClassMatrix | None = None
    effects: tuple[FoundEffect, ...] = ()
    withdrawn: tuple[FoundEffect, ...] = ()
    where: Place | None = None
    gaps: Gaps | None = None
    unknown: Unknown | None = None
    not_found: tuple[NotFound, ...] = ()
    not_applicable: tuple[NotApplicable, ...] = ()
    next_experiment: NextExperiment | None = None
    equation: Equation | None = None
    noise: NoiseFound | None = None
    latent: tuple[LatentTorque, ...] = ()
    rounds: tuple[Round, ...] = ()
    data: tuple[Experiment, ...] = ()
    fresh: tuple[Experiment, ...] = ()
    timing: Mapping[str, float] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    stopped: str = ""
    not_searched: tuple[str, ...] = ()
    blind: bool = False
    nearest: Nearest | None = None

    @property
    def model(self) -> Model:
        """The repaired model."""
        return self.fit.model

    @property
    def parameters(self) -> Parameters:
        """The repaired model's parameters, frozen at the optimum."""
        return self.fit.parameters

    @property
    def best_scores(self) -> tuple[ScoreRow, ...]:
        """The best score of each effect at each port, the highest statistic first."""
        best: dict[tuple[str, str], ScoreRow] = {}
        for row in sorted(self.scores, key=lambda one: -one.statistic):
            best.setdefault((row.effect, row.at), row)
        return tuple(best.values())

    def save(self, path: Any) -> Path:
        """Write the answer as result.json, all or nothing, and return its path; ``ce.load_result`` reads it back.

        path : a file NAME.json, or a folder, which is made and gets a result.json. What is read back prints as this
        does; records, traces and figures are not in it. OutputError where it cannot be written.
        """
        # The room above this one knows the file, and is not there before it is needed.
        save = import_module("casadi_engine.report.result_file").save_result
        seconds, seed = self.timing.get("total", 0.0), self.options.get("seed")
        found: Path = save(self, path, "repair", seconds, seed)
        return found

    def __str__(self) -> str:
        from casadi_engine.discrepancy.summary import summary

        return summary(self)
