"""Refits: the model with effects added, all parameters free, started from what the score test predicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.deadline import TimeUp
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.exchanged_units import BEHIND, LAG, WRONG
from casadi_engine.discrepancy.linear_algebra import basis, without
from casadi_engine.discrepancy.noise_choice import NoiseChoice, scatter_of
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.start import Start
from casadi_engine.effects import Effect
from casadi_engine.effects.friction import Rounded, motion
from casadi_engine.effects.protocol import moves
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Estimate, Fit, estimate
from casadi_engine.estimation.corner_widths import courses, paths_of
from casadi_engine.estimation.followed import not_followed
from casadi_engine.estimation.ipopt import ONE_STEP
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.port_view import PortView
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.linear import LinearPropagator
from casadi_engine.simulation.null_path import NullPath
from casadi_engine.simulation.propagator import switches_with_states

# Iterations of one try; of one that holds an amplitude; and of one that is to show that it cannot be held.
_ITERATIONS, _FEWER, _GLANCE = 60, 30, 10
# Times that a fit goes on along a valley.
_FURTHER = 4
# Share of where its search started at which an amplitude is none.
_GONE = 1e-6
# Share of the motion over which a friction that is rounded itself may be at most: beyond it is a law of its own. Times
# by which it may be sharper than where its search starts.
_ROUNDED, _SHARPER = 0.2, 64.0
# Intervals into which a record is cut for laws with sharp corners.
_INTERVALS = 400

# Rise of chi-squared at which a smaller amplitude is as good; times that it is made smaller, by half at first, and by
# as much as this while nothing rises.
_CONTENT, _HALVINGS, _FASTEST = 1.0, 16, 256.0
# Rise of chi-squared at which all of an input or a sensor is late, as it is but for what nobody builds: two standard
# errors; and part of the shortest time that is searched which an input may then have.
_ALL, _SHORTER = 4.0, 0.1


@dataclass(frozen=True, eq=False)
class Addition:
    """An effect that is added: its candidate, the amplitude from which the search starts, and from how many choices of
    whole numbers (the cycles of a misfire) it is the best one.

    times : of an event in several records, nuisance name -> record -> where its search starts, inf where the event does
        not happen; shared : it has one amplitude in all of them; width : of a law whose corners are rounded
        themselves, by a number that is estimated, where its search starts; None where they are as sharp as data feel
    """

    candidate: Candidate
    start: float
    choices: int = 1
    times: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    shared: bool = True
    width: float | None = None

    @property
    def label(self) -> str:
        """The candidate's label."""
        return self.candidate.label

    @property
    def name(self) -> str:
        """Effect and port, without where its search began."""
        return f"{self.candidate.effect} at {self.candidate.port}"

    @property
    def key(self) -> str:
        """``port.effect``, the stem of its parameters' names."""
        return f"{self.candidate.port}.{self.candidate.effect}"

    @property
    def amplitude(self) -> str:
        """Name of the amplitude among the parameters."""
        return f"{self.key}.{self.candidate.source.effect.amplitude.name}"

    @property
    def bounds(self) -> Any:
        """The effect's `Amplitude`."""
        return self.candidate.source.effect.amplitude

    @property
    def nuisance(self) -> Mapping[str, Any]:
        """Name -> `Grid` of the effect's nuisance parameters."""
        found: Mapping[str, Any] = self.candidate.source.effect.nuisance
        return found

    @property
    def kind(self) -> str:
        """The kind of its port."""
        return str(self.candidate.source.model.ports[self.candidate.port].kind)

    @property
    def forms(self) -> tuple[Addition, ...]:
        """What is refitted of it: an event in several records with one amplitude for all, and with one for each."""
        return (self, replace(self, shared=False)) if self.times else (self,)

    @property
    def is_law(self) -> bool:
        """True for what depends on the motion or on an input: no constant, and no event."""
        source = self.candidate.source
        acts = ca.vertcat(source.slots, source.drives, source.outputs)
        return not self.placed and bool(
            ca.depends_on(acts, ca.vertcat(source.model.x, source.model.u, source.model.d))
        )

    @property
    def placed(self) -> bool:
        """True for an event: an effect at a time or in cycles of one record."""
        nuisance = self.candidate.source.effect.nuisance
        return any(grid.over in ("time", "cycle") for grid in nuisance.values())

    @property
    def moves(self) -> bool:
        """True for an event that may happen at another time in another record."""
        return moves(self.candidate.source.effect)

    @property
    def recurs(self) -> bool:
        """True for an event of certain cycles, which may happen in other cycles of another record."""
        grids = self.candidate.source.effect.nuisance.values()
        return bool(grids) and all(grid.over == "cycle" and grid.whole for grid in grids)

    @property
    def record(self) -> str | None:
        """The record of an event that happens in one alone, None for an effect of all records."""
        if not self.placed or self.times or not isinstance(self.candidate.direction, Mapping):
            return None
        return next(iter(self.candidate.direction))


def addition(
    candidate: Candidate,
    amplitude: float,
    choices: int = 1,
    times: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> Addition:
    """An effect to add, from its one-step amplitude; a candidate made at a size starts there."""
    start = candidate.size if candidate.size is not None else amplitude
    bounds = candidate.source.effect.amplitude
    return Addition(candidate, float(np.clip(start, bounds.min, bounds.max)), choices, times)


def parts_of(one: Addition, values: Mapping[str, float]) -> Mapping[str, float]:
    """See ``Effect.parts``; values : of all parameters where a structure was refitted."""
    own = {n.rpartition(".")[2]: v for n, v in values.items() if n.startswith(f"{one.key}.")}
    return one.candidate.source.effect.parts({n.partition("@")[0]: v for n, v in own.items()})


@dataclass(eq=False)
class Refitter:
    """What all refits share: the null fit's model, parameters, data and options of ``estimate``.

    base : the fit without effects, by whose motion the corners of laws are narrowed; share : of the width that this
        motion gives, one for all effects, so that no structure gains by a sharper corner than its rivals have;
        sharpest : share from which on corners ask for more steps than are taken everywhere
    firsts : fresh record -> how well it was described best so far, and the first states by which it was
    """

    model: Model
    parameters: Parameters
    data: tuple[Experiment, ...]
    noise: Noise | None
    options: Mapping[str, Any] = field(default_factory=dict)
    base: Fit | None = None
    share: float = 1.0
    sharpest: float = 0.0
    firsts: dict[str, tuple[float, Mapping[str, float] | None]] = field(default_factory=dict, repr=False)
    # (label, share) -> the effect as refits have it, with its corners narrowed
    _narrow: dict[tuple[str, float], Any] = field(default_factory=dict, repr=False)
    _motion: list[NullPath] | None = field(default=None, repr=False)
    # models by their effects, each with the effect added last, so that it keeps its identity
    _models: dict[tuple[Any, ...], tuple[Any, Model]] = field(default_factory=dict, repr=False)

    def __call__(self, base: Fit, effects: Sequence[Addition], *, start: Any) -> Fit | None:
        """The fit with these effects, of all data and as the fit without effects was made, from where a refit arrived;
        None where it fails.

        base : the fit without effects; start : values and initial states
        """
        self.base = base if self.base is None else self.base
        model = self.extended(effects)
        pars = self.parameters_of(model, effects)
        fit = self._try(model, pars, start)
        if (
            fit is not None and not fit.converged and math.isfinite(fit.cost)
        ):  # often it is a step short of it
            fit = _better(self._try(model, pars, Start.of(fit), most=_FEWER), fit)
        for _ in range(_FURTHER):  # along a valley, as what lacks a second effect may have one
            if fit is None or ONE_STEP not in fit.status:
                break
            fit = _better(self._try(model, pars, Start.of(fit)), fit)
        if fit is None or not fit.converged:
            far = Start(start.values, {}, {}, False)
            fit = _better(fit, self._try(model, pars, far))
        if start.converged and (fit is None or not fit.converged) and self._has_corners(effects):
            # it is near an optimum in one run, and gaps between intervals may not close beside sharp corners; step by
            # step this takes long
            fit = _better(self._try(model, pars, start, most=_FEWER, interval="single"), fit)
        if fit is None or not fit.converged:
            return fit
        return self._smallest(self._with_all(fit, effects), effects, effects)

    def _has_corners(self, effects: Sequence[Addition]) -> bool:
        """True if corners of a law are rounded over a width."""
        return any(getattr(self.rounded(one), "width", None) is not None for one in effects)

    def _with_all(self, fit: Fit, effects: Sequence[Addition]) -> Fit:
        """The fit with all of each input late that is late, and of each sensor that lags, where the data are content:
        the share by which it is so and the time are hardly told from each other where that is short."""
        for one in effects:
            share = fit.estimates.get(one.amplitude)
            if one.candidate.effect not in (LAG, *BEHIND) or share is None or share.fixed:
                continue
            whole = None
            with suppress(TimeUp):  # there is a fit
                whole = self._late_by_all(fit.model, fit.parameters.copy(), one, Start.of(fit))
            if whole is not None and whole.converged and merit(whole) <= merit(fit) + _ALL:
                fit = whole
        return fit

    def with_all(self, effects: Sequence[Addition], one: Addition, time: float, near: Fit) -> Fit | None:
        """The fit with all of an input late by one of these effects, from about a time [s] and a fit near by."""
        model = self.extended(effects)
        start = Start.of(near)
        values = {**start.values, f"{one.key}.time": time, one.amplitude: 1.0}
        return self._late_by_all(
            model, self.parameters_of(model, effects), one, replace(start, values=values, converged=False)
        )

    def _late_by_all(self, model: Model, pars: Parameters, one: Addition, start: Start) -> Fit | None:
        time = pars[f"{one.key}.time"]
        pars.fix(one.amplitude, 1.0)
        time.set(min=(_SHORTER if one.candidate.effect in BEHIND else 1.0) * time.min)
        fit = self._try(model, pars, start)
        if (
            fit is not None and not fit.converged and math.isfinite(fit.cost)
        ):  # often it is a step short of it
            fit = _better(self._try(model, pars, Start.of(fit), most=_FEWER), fit)
        return fit

    def _smallest(self, fit: Fit, effects: Sequence[Addition], new: Sequence[Addition]) -> Fit:
        """The fit with amplitudes that have no error, one larger than themselves, or rest on their upper bound, as
        small as the data are content with: a play that is never crossed may have any width, and claims too much."""
        for one in new:
            found = fit.estimates.get(one.amplitude)
            if found is None or found.value == 0 or found.fixed:  # all of it, with which the data are content
                continue
            if _determined(found) and not self._open_above(fit, effects, one):
                continue
            if found.stderr is None and self._told_beside(fit, effects, one):
                continue
            best, least, share = fit, merit(fit) + _CONTENT, 2.0
            none = _GONE * min(abs(found.value), abs(one.start))
            for _ in range(_HALVINGS):
                if abs(best.values[one.amplitude]) <= none:
                    break
                held = self.parameters_of(fit.model, effects)
                held.fix(one.amplitude, best.values[one.amplitude] / share)
                step = self._try(fit.model, held, Start.of(best), most=_FEWER)
                if step is not None and step.converged and merit(step) <= least:
                    best, share = step, min(share**2, _FASTEST)
                elif share > 2.0:
                    share = 2.0
                else:
                    break
            if best is fit and not _determined(found):
                continue
            size = best.values[one.amplitude]
            pars = self.parameters_of(fit.model, effects)
            own = pars[one.amplitude]
            own.set(size, min=own.min if size > 0 else size, max=size if size > 0 else own.max)
            again = self._try(fit.model, pars, Start.of(best))
            fit = again if again is not None and again.converged and merit(again) <= least else fit
        return fit

    def _told_beside(self, fit: Fit, effects: Sequence[Addition], one: Addition) -> bool:
        """True for an amplitude that has no error because of what the data leave open without effects, a common factor
        of all: it is told where one number of each such combination is known."""
        left = () if self.base is None else self.base.undetermined
        pars = self.parameters_of(fit.model, effects)
        for direction in left:
            known = {
                name: abs(w) for name, w in direction.weights.items() if name in fit.free and name in pars
            }
            if known:
                largest = max(known, key=lambda name: known[name])
                pars.fix(largest, fit.values[largest])
        again = self._try(fit.model, pars, Start.of(fit), most=_FEWER) if left else None
        return again is not None and again.converged and _determined(again.estimates[one.amplitude])

    def _open_above(self, fit: Fit, effects: Sequence[Addition], one: Addition) -> bool:
        """True for a law that bends in its amplitude, of which twice as much explains the data as well: the error by
        its slope says nothing of larger ones."""
        if type(one.candidate.source.effect).sizes is Effect.sizes:
            return False
        pars = self.parameters_of(fit.model, effects)
        own, size = pars[one.amplitude], 2 * fit.values[one.amplitude]
        own.set(size, min=min(size, own.min), max=max(size, own.max))
        pars.fix(one.amplitude)
        levels = {name: sigma for name, (sigma, _) in fit.noise.items()}
        initial = {r: {n: e.value for n, e in states.items()} for r, states in fit.initial.items()}
        try:
            problem = RefitProblem(
                fit.model, self.data, pars.unconstrained(), levels=levels, interval=self.interval
            )
            if self.in_places:
                problem.step_in_places(anyway=True)
            found = problem.run(start=fit.values, initial=initial, horizons=(None,), most=_GLANCE)
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            return False  # a model that fails explains nothing
        return found.cost <= fit.cost + _CONTENT

    def extended(self, effects: Sequence[Addition]) -> Model:
        """The null fit's model with these effects; the same one each time.

        A model with further effects shares its symbols, so that candidates made for the one can be put into the other.
        """
        model: Model = self.model
        key: tuple[Any, ...] = ()
        for one in effects:
            made = one.candidate.source
            values = dict(made.values) | {made.amplitude.name: one.start}
            effect = self.rounded(one)
            key = (*key, (one.key, id(effect), tuple(sorted(values.items()))))
            if key not in self._models:
                self._models[key] = (effect, model.with_effect(effect, at=one.candidate.port, values=values))
            _, model = self._models[key]
        return model

    def rounded(self, one: Addition) -> Any:
        """An addition's effect with its corners as sharp as the motion without it passes them, times the share."""
        key = one.label, self.share
        if self.base is None or one.width is not None:
            return one.candidate.source.effect
        if key not in self._narrow:
            self._narrow[key] = _narrowed(one, self.base, self._paths(), self.share)
        return self._narrow[key]

    def widest(self, one: Addition) -> float:
        """The width over which the law of a friction may be rounded itself, in the unit of its motion; 0 of any other
        law, and where there is no motion."""
        effect = one.candidate.source.effect
        if self.base is None or not isinstance(effect, Rounded) or not self._paths():
            return 0.0
        model = self.base.model
        view = PortView(
            model, model.ports[one.candidate.port], partial(courses, self._paths()), effect=effect.name
        )
        values = np.concatenate(list(view.courses(motion(view)[0])))
        return _ROUNDED * float(np.sqrt(np.mean(values**2)))

    @property
    def in_places(self) -> bool:
        """True if corners are so sharp that steps are to be short in places alone, as those of the base were."""
        stiff = self.base is not None and any(
            one.integrator.startswith("implicit") for one in self.base.integration.values()
        )
        return stiff or self.share <= self.sharpest

    @property
    def interval(self) -> Any:
        """The length of shooting intervals: short ones for laws whose corners ask for many steps of the integrator,
        which all intervals take side by side."""
        own = self.options.get("interval", "auto")
        if own != "auto" or self.share >= 1 or switches_with_states(self.model):
            return own
        return short_intervals(self.data)

    def _paths(self) -> list[NullPath]:
        """The simulation of the base, or where that does not follow the data, as one that stands still, pieces that do;
        none where that fails: then corners stay as they are declared."""
        if self._motion is None and self.base is not None:
            try:
                with np.errstate(all="ignore"):
                    self._motion = self._pieces(self.base) if not_followed(self.base) else paths_of(self.base)
            except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
                self._motion = []
        return self._motion or []

    def _pieces(self, base: Fit) -> list[NullPath]:
        """The motion over short pieces, each from states that explain its own samples, at the parameters' own values:
        those of a fit that follows nothing may be anywhere. As simulated where the model is linear, of which no states
        are kept at samples."""
        levels = {name: sigma for name, (sigma, _) in base.noise.items()}
        own = self.parameters.unconstrained()
        problem = RefitProblem(self.model, self.data, own, levels=levels)
        if any(isinstance(record.propagator, LinearPropagator) for record in problem.records):
            return paths_of(base)
        return problem.measured_paths({})

    def parameters_of(self, model: Model, effects: Sequence[Addition]) -> Parameters:
        pars = self.parameters.copy().extended(model)
        spans = {record.name: record.span for record in self.data}
        for one in effects:
            if one.width is not None:
                wide = pars[f"{one.key}.width"]
                wide.set(one.width, min=one.width / _SHARPER, max=max(self.widest(one), one.width), vary=True)
            for name, grid in one.candidate.source.effect.nuisance.items():
                if grid.over != "time" or grid.whole:
                    continue
                if name in one.times:
                    values = {r: _time(v, spans[r]) for r, v in one.times[name].items()}
                    pars.vary_by_experiment(f"{one.key}.{name}", values=values)
                    continue
                own = [span for r, span in spans.items() if r == one.record] or list(spans.values())
                pars[f"{one.key}.{name}"].set(min=min(s[0] for s in own), max=max(s[1] for s in own))
            if one.placed and len(self.data) > 1 and not (one.times and one.shared):
                pars.vary_by_experiment(one.amplitude)
            elif one.candidate.effect in BEHIND:
                share = pars[one.amplitude]  # where more is missing it would run away, and stand for that
                share.set(min(share.value, 1 + WRONG), max=min(share.max, 1 + WRONG))
        return pars

    def _try(
        self,
        model: Model,
        pars: Parameters,
        warm: Start | None,
        *,
        most: int = _ITERATIONS,
        interval: Any = None,
    ) -> Fit | None:
        """One estimate of at most so many iterations; interval : None for the usual one."""
        most = min(int(self.options.get("max_iterations", most)), most)
        options = dict(self.options) | {"max_iterations": most, "errors": "quadratic", "progress": False}
        options["interval"] = self.interval if interval is None else interval
        if warm is not None and self.in_places:
            warm = replace(warm, in_places=True)
        try:
            with np.errstate(all="ignore"):
                fit = estimate(model, self.data, parameters=pars, noise=self.noise, warm=warm, **options)
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            return None  # the model fails at this start: as good as not converged
        return fit


def _time(start: float, span: tuple[float, float]) -> tuple[float, float, float]:
    """Start and bounds of an event's time in a record; of one that does not happen there, behind its end."""
    low, high = span
    behind = 0.01 * (high - low)
    return (start, low, high) if start <= high else (high + behind, high, high + 2 * behind)


def _narrowed(one: Addition, base: Fit, paths: Sequence[NullPath], share: float) -> Any:
    """An addition's effect with the corners that these simulations can follow."""
    effect = one.candidate.source.effect
    if not paths:
        return effect
    model = base.model
    view = PortView(model, model.ports[one.candidate.port], partial(courses, paths), effect=effect.name)
    return effect.narrowed(view, share)


def short_intervals(data: Sequence[Experiment]) -> int:
    """Samples to a shooting interval where corners ask for many steps of the integrator."""
    return max(2, max(map(_samples, data)) // _INTERVALS)


def _samples(record: Experiment) -> int:
    """Samples of a record's longest channel."""
    return max(len(record[name].time) for name in record.names)


def _determined(found: Estimate) -> bool:
    """True for an estimate inside its bounds with an error that is smaller than itself."""
    return found.at_bound is False and found.stderr is not None and found.stderr < abs(found.value)


def _better(one: Fit | None, other: Fit | None) -> Fit | None:
    """The better of two fits of the same data: a converged one, then the lower cost at the same noise."""
    found = [fit for fit in (one, other) if fit is not None]
    return min(found, key=lambda fit: (not fit.converged, merit(fit)), default=None)


def merit(fit: Fit) -> float:
    """-2 log likelihood but for a constant, samples of all outputs alike."""
    levels = [math.log(sigma) for sigma, _ in fit.noise.values()]
    return fit.cost + 2 * fit.n / max(len(levels), 1) * sum(levels)


def whitened_cost(fit: Fit, choice: NoiseChoice) -> float:
    """Chi-squared with priors of a fit under a noise model, parameters moved to its optimum under that noise."""
    null = null_model(fit)
    scatter = scatter_of(null, fit.data, choice.cylinders) if choice.scatter else ()
    reduced = compress(null, (), choice.noise, scatter=scatter).reduced()
    frame = basis(reduced.rows[:, : reduced.parameters])
    rest = without(frame, reduced.rows[:, reduced.parameters :])
    return float((rest**2).sum())


def freedom(fit: Fit) -> int:
    """How many numbers a fit estimated."""
    return len(fit.free) + sum(not e.fixed for states in fit.initial.values() for e in states.values())


def numbers(effects: Sequence[Addition]) -> int:
    """How many numbers effects bring: amplitudes, nuisance parameters that are estimated, and widths that are."""
    return sum(
        1 + (one.width is not None) + sum(not grid.whole for grid in one.nuisance.values()) for one in effects
    )


def vanished(effects: Sequence[Addition], fit: Fit) -> bool:
    """True if a fit leaves nothing of one of its effects: on the bound where it is none, or made smaller and smaller
    while the data were content."""
    for one in effects:
        own = [e for name, e in fit.estimates.items() if name.partition("@")[0] == one.amplitude]
        if own and all(abs(e.value) <= _GONE * abs(one.start) for e in own):
            return True
    return False
