"""Refits: the model with effects added, all parameters free, started from what the score test predicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.linear_algebra import basis, without
from casadi_engine.discrepancy.noise_choice import NoiseChoice, scatter_of
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.selection import effective_samples
from casadi_engine.discrepancy.start import Start
from casadi_engine.effects import Effect
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Estimate, Fit, estimate
from casadi_engine.estimation.corner_widths import FACTOR, FELT, cost_along, courses, paths_of
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.port_view import PortView
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.exponential_runge_kutta import MOST_SUBSTEPS
from casadi_engine.simulation.null_path import NullPath

# Iterations of one try; of one that holds an amplitude.
_ITERATIONS, _FEWER = 60, 30
# Intervals into which a record is cut for laws with sharp corners.
_INTERVALS = 400
# Corners are sharpened at most so often.
_SHARPER = 3
# And as long as all records together are not integrated in more steps than this.
_STEPS = 1e5

# Rise of chi-squared at which a smaller amplitude is as good; times that it is made smaller, by half at first, and by
# as much as this while nothing rises.
_CONTENT, _HALVINGS, _FASTEST = 1.0, 16, 256.0


@dataclass(frozen=True, eq=False)
class Addition:
    """An effect that is added: its candidate, the amplitude from which the search starts, and from how many choices of
    whole numbers (the cycles of a misfire) it is the best one.

    times : of an event in several records, nuisance name -> record -> where its search starts, inf where the event does
        not happen; shared : it has one amplitude in all of them
    """

    candidate: Candidate
    start: float
    choices: int = 1
    times: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    shared: bool = True

    @property
    def label(self) -> str:
        """The candidate's label."""
        return self.candidate.label

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
    def placed(self) -> bool:
        """True for an event: an effect at a time or in cycles of one record."""
        nuisance = self.candidate.source.effect.nuisance
        return any(grid.over in ("time", "cycle") for grid in nuisance.values())

    @property
    def moves(self) -> bool:
        """True for an event that may happen at another time in another record."""
        grids = self.candidate.source.effect.nuisance.values()
        return bool(grids) and all(grid.over == "time" and not grid.whole for grid in grids)

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


@dataclass(frozen=True, eq=False)
class Refitter:
    """What all refits share: the null fit's model, parameters, data and options of ``estimate``."""

    model: Model
    parameters: Parameters
    data: tuple[Experiment, ...]
    noise: Noise | None
    options: Mapping[str, Any] = field(default_factory=dict)
    # label -> the effect as refits have it, with its corners narrowed, and the share of the first width
    _narrow: dict[str, tuple[Any, float]] = field(default_factory=dict, repr=False)
    # models by their effects, each with the effect added last, so that it keeps its identity
    _models: dict[tuple[Any, ...], tuple[Any, Model]] = field(default_factory=dict, repr=False)

    def __call__(self, base: Fit, effects: Sequence[Addition], *, start: Any) -> Fit | None:
        """The fit with these effects, of all data and as the fit without effects was made, from where a refit arrived;
        None where it fails.

        base : the fit without effects, by whose motion corners are narrowed; start : values and initial states
        """
        self._look(base, effects)
        model = self.extended(effects)
        pars = self.parameters_of(model, effects)
        fit = self._try(model, pars, start)
        if fit is None or not fit.converged:
            far = Start(start.values, {}, {}, False)
            fit = _better(fit, self._try(model, pars, far))
        if fit is None or not fit.converged:
            return fit
        return self._smallest(self._sharpened(fit, effects), effects, effects)

    def _smallest(self, fit: Fit, effects: Sequence[Addition], new: Sequence[Addition]) -> Fit:
        """The fit with amplitudes that have no error, one larger than themselves, or rest on their upper bound, as
        small as the data are content with: a play that is never crossed may have any width, and claims too much."""
        for one in new:
            found = fit.estimates.get(one.amplitude)
            if found is None or found.value == 0:
                continue
            if _determined(found) and not self._open_above(fit, effects, one):
                continue
            best, least, share = fit, merit(fit) + _CONTENT, 2.0
            for _ in range(_HALVINGS):
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

    def _open_above(self, fit: Fit, effects: Sequence[Addition], one: Addition) -> bool:
        """True for a law that bends in its amplitude, of which twice as much explains the data as well: the error by
        its slope says nothing of larger ones."""
        if type(one.candidate.source.effect).sizes is Effect.sizes:
            return False
        pars = self.parameters_of(fit.model, effects)
        own, size = pars[one.amplitude], 2 * fit.values[one.amplitude]
        own.set(size, min=min(size, own.min), max=max(size, own.max))
        pars.fix(one.amplitude)
        step = self._try(fit.model, pars, Start.of(fit), most=_FEWER)
        return step is not None and merit(step) <= merit(fit) + _CONTENT

    def extended(self, effects: Sequence[Addition]) -> Model:
        """The null fit's model with these effects; the same one each time.

        A model with further effects shares its symbols, so that candidates made for the one can be put into the other.
        """
        model: Model = self.model
        key: tuple[Any, ...] = ()
        for one in effects:
            made = one.candidate.source
            values = dict(made.values) | {made.amplitude.name: one.start}
            effect, _ = self._narrow.get(one.label, (made.effect, 1.0))
            key = (*key, (one.key, id(effect), tuple(sorted(values.items()))))
            if key not in self._models:
                self._models[key] = (effect, model.with_effect(effect, at=one.candidate.port, values=values))
            _, model = self._models[key]
        return model

    def _look(self, base: Fit, effects: Sequence[Addition]) -> None:
        """Narrow the corners of effects that were not looked at yet, by the motion of the base."""
        unknown = [one for one in effects if one.label not in self._narrow]
        if unknown:
            paths = paths_of(base)
            self._narrow.update({one.label: (_narrowed(one, base.model, paths, 1.0), 1.0) for one in unknown})

    def _sharpened(self, fit: Fit, effects: Sequence[Addition]) -> Fit:
        """The fit with corners so sharp that the data do not tell them from sharper ones.

        A corner's width is a bias: friction that sticks creeps. Chi-squared at the fit's own values tells which width
        is felt, as far as the integrator can follow; where it is the first, the fit is made again with a sharper one.
        """
        steps = max((one.substeps for one in fit.integration.values()), default=0)
        allowed = min(MOST_SUBSTEPS, _STEPS / sum(map(_samples, self.data)))
        most = int(math.log(max(allowed / max(steps, 1), 1.0), FACTOR) + 1e-9)
        if not steps or not most:
            return fit
        paths, before = paths_of(fit), dict(self._narrow)
        levels, costs = [before], [cost_along(fit, paths)]
        for level in range(1, min(most, _SHARPER) + 1):
            finer = dict(before)
            for one in effects:
                share = before[one.label][1] / FACTOR**level
                finer[one.label] = (_narrowed(one, fit.model, paths, share), share)
            if all(finer[one.label][0] == before[one.label][0] for one in effects):
                return fit
            self._narrow.update(finer)
            levels.append(finer)
            costs.append(cost_along(fit, paths_of(fit, self.extended(effects))))
        worth = _independent(fit)
        chosen = next(k for k, cost in enumerate(costs) if worth * abs(cost - costs[-1]) < FELT)
        self._narrow.update(levels[chosen])
        if not chosen:
            return fit
        model = self.extended(effects)
        again = self._try(model, self.parameters_of(model, effects), Start.of(fit), short=True)
        if again is not None and again.converged and merit(again) < merit(fit) + FELT:
            return again
        self._narrow.update(before)
        return fit

    def parameters_of(self, model: Model, effects: Sequence[Addition]) -> Parameters:
        pars = self.parameters.copy().extended(model)
        spans = {record.name: record.span for record in self.data}
        for one in effects:
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
        return pars

    def _try(
        self,
        model: Model,
        pars: Parameters,
        warm: Start | None,
        *,
        most: int = _ITERATIONS,
        short: bool = False,
    ) -> Fit | None:
        """One estimate of at most so many iterations; short : in short intervals, for laws that ask for many steps of
        the integrator, which all intervals take side by side."""
        most = min(int(self.options.get("max_iterations", most)), most)
        options = dict(self.options) | {"max_iterations": most, "errors": "quadratic", "progress": False}
        if short and options.get("interval", "auto") == "auto":
            options["interval"] = max(2, max(_samples(one) for one in self.data) // _INTERVALS)
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


def _independent(fit: Fit) -> float:
    """The share of a fit's samples that its residuals are worth: less than 1 where they are coloured."""
    found = [trace.residual for traces in fit.traces.values() for trace in traces.values()]
    left = [e[np.isfinite(e)] for e in found]
    return sum(effective_samples(e) for e in left) / max(sum(map(len, left)), 1)


def _narrowed(one: Addition, model: Model, paths: Sequence[NullPath], share: float) -> Any:
    """An addition's effect with the corners that these simulations can follow."""
    effect = one.candidate.source.effect
    view = PortView(model, model.ports[one.candidate.port], partial(courses, paths), effect=effect.name)
    return effect.narrowed(view, share)


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
