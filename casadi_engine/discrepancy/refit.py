"""Refits: the model with effects added, all parameters free, started from what the score test predicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.linear_algebra import basis, without
from casadi_engine.discrepancy.noise_choice import NoiseChoice, scatter_of
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

# Shares of the predicted amplitude at which it is held, one after the other, where a free start fails.
_SHARES = (0.1, 0.3, 0.6, 1.0)
_SMALL = 0.02
# One step tells little of an effect whose predicted drop of chi-squared is larger.
_LARGE = 400.0
# Iterations of one try.
_ITERATIONS = 60
_ROUNDING = 1e-3


@dataclass(frozen=True, eq=False)
class Addition:
    """An effect that is added: its candidate, the amplitude from which the search starts, and the predicted drop of
    chi-squared."""

    candidate: Candidate
    start: float
    drop: float = 0.0

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
    def placed(self) -> bool:
        """True for an event: an effect at a time or in cycles of one record."""
        nuisance = self.candidate.source.effect.nuisance
        return any(grid.over in ("time", "cycle") for grid in nuisance.values())

    @property
    def record(self) -> str | None:
        """The record of an event, None for an effect of all records."""
        if not self.placed or not isinstance(self.candidate.direction, Mapping):
            return None
        return next(iter(self.candidate.direction))


def addition(candidate: Candidate, amplitude: float, drop: float) -> Addition:
    """An effect to add, from its one-step amplitude; a candidate made at a size starts there."""
    start = candidate.size if candidate.size is not None else amplitude
    bounds = candidate.source.effect.amplitude
    return Addition(candidate, float(np.clip(start, bounds.min, bounds.max)), drop)


@dataclass(frozen=True, eq=False)
class _Start:
    """Values and initial states to start from, as ``estimate(warm=...)`` reads them."""

    values: Mapping[str, float]
    initial: Mapping[str, Any]
    noise: Mapping[str, tuple[float, bool]]
    converged: bool = False


@dataclass(frozen=True, eq=False)
class Refitter:
    """What all refits share: the null fit's model, parameters, data and options of ``estimate``."""

    model: Model
    parameters: Parameters
    data: tuple[Experiment, ...]
    noise: Noise | None
    options: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, base: Fit, effects: Sequence[Addition], *, start: Any = None) -> Fit:
        """The fit with these effects, from a fit with some of them.

        start : values and initial states near it, if known

        Not converged where no start leads to an optimum below the base's. Tried are the base's optimum with the
        predicted amplitude; the parameters' own start values where the base was driven to a bound; the base's optimum
        with a small amplitude; and the amplitude held at growing shares of the prediction.
        """
        model = self.extended(effects)
        pars = self._parameters(model, effects)
        new = [one for one in effects if one.amplitude not in base.parameters]
        if start is not None:
            near = self._try(model, pars, start)
            if near is not None and _nested(base, near):
                return near
        warm = _Start(base.values, base.initial, base.noise)
        best = self._try(model, pars, warm)
        if best is None or not best.converged or _driven(base) or _driven(best):
            best = _better(best, self._try(model, pars, None))
        if not new:
            return base if best is None else best
        if not _nested(base, best):
            best = _better(best, self._try(model, self._at(pars, new, _SMALL), warm))
        if not _nested(base, best) and any(one.drop > _LARGE for one in new):
            best = _better(best, self._continued(model, pars, new, warm))
        if best is None or not _nested(base, best):
            return replace(base, status="not converged: no start leads below the fit without the effect")
        return best

    def _continued(self, model: Model, pars: Parameters, new: Sequence[Addition], warm: _Start) -> Fit | None:
        """The fit reached with the amplitude held at growing shares of the prediction."""
        for share in _SHARES:
            held = self._at(pars, new, share)
            for one in new:
                held.fix(one.amplitude)
            step = self._try(model, held, warm)
            if step is None:
                break
            warm = _Start(step.values, step.initial, step.noise, step.converged)
        return self._try(model, pars, warm)

    @staticmethod
    def _at(pars: Parameters, new: Sequence[Addition], share: float) -> Parameters:
        moved = pars.copy()
        for one in new:
            moved[one.amplitude].set(share * one.start)
        return moved

    def extended(self, effects: Sequence[Addition]) -> Model:
        """The null fit's model with these effects."""
        model = self.model
        for one in effects:
            made = one.candidate.source
            values = dict(made.values) | {made.amplitude.name: one.start}
            model = model.with_effect(made.effect, at=one.candidate.port, values=values)
        return model

    def _parameters(self, model: Model, effects: Sequence[Addition]) -> Parameters:
        pars = self.parameters.copy().extended(model)
        spans = [record.span for record in self.data]
        for one in effects:
            for name, grid in one.candidate.source.effect.nuisance.items():
                if grid.over == "time" and not grid.whole:
                    own = [r.span for r in self.data if r.name == one.record] or spans
                    low, high = min(s[0] for s in own), max(s[1] for s in own)
                    pars[f"{one.key}.{name}"].set(min=low, max=high)
            if one.placed and len(self.data) > 1:
                pars.vary_by_experiment(one.amplitude)
        return pars

    def _try(self, model: Model, pars: Parameters, warm: _Start | None) -> Fit | None:
        most = min(int(self.options.get("max_iterations", _ITERATIONS)), _ITERATIONS)
        options = dict(self.options) | {"max_iterations": most, "progress": False}
        try:
            with np.errstate(all="ignore"):
                return estimate(model, self.data, parameters=pars, noise=self.noise, warm=warm, **options)
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            return None  # the model fails at this start: as good as not converged


def _driven(fit: Fit) -> bool:
    """True if an estimate is at a bound."""
    return any(fit.estimates[name].at_bound is not False for name in fit.free)


def _nested(base: Fit, fit: Fit | None) -> bool:
    """True for a converged fit that is no worse than the base, which it holds as a special case."""
    return fit is not None and fit.converged and merit(fit) <= merit(base) + _ROUNDING


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
