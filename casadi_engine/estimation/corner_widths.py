"""Corners of laws in fits, as sharp as the data can tell: widths follow the motion on the records.

A law with a corner (dry friction, a play) is rounded over a width, so that it has derivatives. The width is a bias:
friction that holds a shaft lets it creep at width · atanh(T/T_f). So what `with_effect` declares, a share of a typical
magnitude, is a start. The simulation of the first fit shows how fast its signal passes the corner (`Effect.narrowed`);
then the widths are divided until chi-squared does not feel it, or the integrator can follow no further.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.effects.corners import narrow
from casadi_engine.errors import CasadiEngineError, EstimationError
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.lower_optimum import merit
from casadi_engine.estimation.refit_answer import Refit
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.model import Model
from casadi_engine.model.corners import Corner
from casadi_engine.model.port_view import PortView
from casadi_engine.parameters import Parameters, compile
from casadi_engine.simulation.candidate_sensitivities import at_measurements
from casadi_engine.simulation.exponential_runge_kutta import MOST_SUBSTEPS, ExponentialPropagator
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.null_path import NullPath, null_path
from casadi_engine.simulation.observed import ObservedPropagator

Array = NDArray[np.float64]

# Corners are sharpened by this factor, at most so often, as long as chi-squared feels it by more than this: a quarter
# is a bias of half a standard error at most, of errors that count with the colour of what the fit leaves.
FACTOR, SHARPER, FELT = 4.0, 4, 0.25
# How often they are wider by the factor where none can be followed as they were declared: then about as wide as motion.
WIDER = 4
# How the message begins that says so.
ROUNDED = "the data feel how corners are rounded"
_ASKED = "the data ask for rounded corners"
CORNERS = ROUNDED, _ASKED
# Of -2 log likelihood, what a law that is rounded itself has to leave less than a sharp one for its one more number:
# three standard errors.
_PREFERRED = 9.0
# The least factor that is worth a fit of its own.
_WORTH = 1.4
# Correlation of neighbours, in its standard errors, from which a residual counts as coloured; and share of what is left
# that is no cause of the rest.
_COLOUR, _NO_CAUSE = 3.0, 0.01
# Steps of the integrator over all records that a sharper corner may cost.
_STEPS = 1e6
# Intervals into which a record is cut then: the integrator takes them side by side.
_INTERVALS = 400
# Times that a run is made anew, as its steps become shorter.
_ANEW = 3


def from_wide_corners(
    first: Callable[[dict[str, Any]], Fit],
    again: Callable[[dict[str, Any]], Fit],
    arguments: Mapping[str, Any],
) -> Fit:
    """The fit; where it ends at values that no integrator follows with corners as sharp as they were declared, from one
    with corners that are far wider, and then sharper in steps.

    first(changes), again(changes) : make a fit with changed arguments, from all starts and from a warm one
    """
    try:
        return first({})
    except EstimationError as fault:
        model, parameters = arguments["model"], arguments["parameters"]
        widths = {name: parameters[name].value for name in open_widths(model, parameters)}
        if not isinstance(fault.__cause__, FloatingPointError) or not widths:
            raise
    wider = [
        with_widths(parameters, {name: FACTOR**k * width for name, width in widths.items()})
        for k in range(WIDER, -1, -1)
    ]
    fit = first({"parameters": wider[0]})
    for sharper in wider[1:]:
        try:
            fit = again({"parameters": sharper, "warm": fit, "approach": "direct"})
        except EstimationError:
            own = ", ".join(f"{name} = {fit.parameters[name].value:.2g}" for name in widths)
            words = f"{ROUNDED} ({own}), and with sharper ones the equations cannot be followed"
            return replace(fit, messages=(words, *fit.messages))
    return fit


def follow_motion(fit: Fit, parameters: Parameters, again: Callable[[Parameters, Fit, Any], Fit]) -> Fit:
    """The fit with the widths of its effects' corners as the motion on the records asks for.

    parameters : the set of the fit before it; again(parameters, warm, interval) : makes a fit
    A width that was given a value of its own, or fixed by the user, stays. One that no record passes keeps its default,
    at the cost of one simulation.
    """
    widths = open_widths(fit.model, parameters)
    if not widths or not fit.converged or fit.gain is not None:
        return fit
    wide = {name: parameters[name].value for name in widths}
    try:
        with np.errstate(all="ignore"):
            return _followed(fit, parameters, widths, wide, again)
    except (FloatingPointError, np.linalg.LinAlgError):
        names = ", ".join(f"{name} = {width:.2g}" for name, width in wide.items())
        words = (
            f"corners are rounded as they were declared ({names}), and whether the data feel that is not known: the "
            "simulation that would tell it fails; set a smaller width and compare"
        )
        return replace(fit, messages=(words, *fit.messages))


def _followed(
    fit: Fit,
    parameters: Parameters,
    widths: Mapping[str, Any],
    wide: dict[str, float],
    again: Callable[[Parameters, Fit, Any], Fit],
) -> Fit:
    begun = Motion(fit, wide)
    first = _by_motion(fit.model, fit.parameters, widths, begun.paths())
    found = begun if first == wide else _refitted(begun, parameters, first, again)
    for _ in range(SHARPER):
        if found is None:
            break
        finer = _sharper(found, first)
        if finer == first:
            return _as_rounded(found, parameters, again) or found.fit
        if finer is None:
            break
        sharper = _refitted(found, parameters, finer, again)
        if sharper is None:
            break
        found, first = sharper, finer
    if found is None:
        return _told(begun, wide)
    return _as_rounded(found, parameters, again) or _told(found, first)


def _as_rounded(
    sharp: Motion, parameters: Parameters, again: Callable[[Parameters, Fit, Any], Fit]
) -> Fit | None:
    """The fit with corners as wide as the law itself is rounded, where the data prefer such to sharp ones: their widths
    are estimated then. None where they do not. Simulations with wider ones tell whether and where to begin."""

    def times(factor: float) -> dict[str, float]:
        return {name: float(f"{factor * width:.2g}") for name, width in sharp.widths.items()}

    try:
        costs = {factor: sharp.cost(times(factor)) for factor in (FACTOR**k for k in range(SHARPER + 1))}
    except (FloatingPointError, np.linalg.LinAlgError):
        return None  # there is a fit
    factor = min(costs, key=costs.__getitem__)
    begun = _refitted(sharp, parameters, times(factor), again) if costs[factor] < costs[1.0] - FELT else None
    if begun is None:
        return None
    pars = with_widths(parameters, begun.widths)
    for name, width in begun.widths.items():
        pars[name].set(width, min=sharp.widths[name], vary=True)
    try:
        fit = again(pars, begun.fit, max(2, max(begun.samples) // _INTERVALS))
    except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
        return None
    if not fit.converged or merit(fit) > merit(sharp.fit) - _PREFERRED:
        return None
    names = " and ".join(begun.widths)
    words = f"{_ASKED}: {names} is estimated, as sharp corners leave a larger residual than by chance"
    return replace(fit, messages=(words, *fit.messages))


class Motion:
    """The simulation of a fit at other widths of its corners, parameters and initial states as they are.

    The shooting intervals run side by side, with short steps where a corner is passed, and the gaps between them close
    in a few steps. ``whole`` : the exponential integrator, whose steps are short everywhere, runs through at once.
    """

    def __init__(self, fit: Fit, widths: Mapping[str, float]) -> None:
        self.fit, self.widths = fit, dict(widths)
        pars = fit.parameters.copy()
        for name, width in widths.items():
            pars[name].set(width, min=0.0, vary=True)
        levels = {name: sigma for name, (sigma, _) in fit.noise.items()}
        in_places = any(one.integrator.startswith("implicit") for one in fit.integration.values())
        samples = max(fit.n // max(len(fit.data), 1), 1)
        interval = max(2, samples // _INTERVALS) if in_places else "auto"
        self._problem = RefitProblem(fit.model, fit.data, pars, levels=levels, interval=interval)
        if in_places:  # as the fit was made, whose laws are too stiff for the other one
            self._problem.step_in_places(anyway=True)
        linear = (ExponentialPropagator, ObservedPropagator)
        self.whole = any(isinstance(record.propagator, linear) for record in self._problem.records)
        self._values = dict(zip(fit.free, fit.z.tolist(), strict=True))
        self._nodes = [] if self.whole else self._joined()

    def _joined(self) -> list[Array]:
        """The run of each record (M, n), made anew where its steps turned out too long; none where they do not settle:
        then the exponential integrator runs through."""
        values = self._values | self.widths
        for _ in range(_ANEW):
            nodes = self._problem.simulated(values, self.fit.initial)
            with suppress(FloatingPointError, np.linalg.LinAlgError):
                self._problem.paths(values, nodes)
                return nodes
        self.whole = True
        return []

    @property
    def samples(self) -> list[int]:
        """Samples of each record's grid."""
        return [record.grid.samples for record in self._problem.records]

    @property
    def steps(self) -> int:
        """Most integration steps to a sample."""
        return max((one.substeps for one in self.fit.integration.values()), default=0)

    @property
    def felt(self) -> float:
        """Change of chi-squared that the data feel: ``FELT`` in errors that count with the colour of what is left, and
        no more than a share of that, which such corners may have made."""
        traces = [trace for own in self.fit.traces.values() for trace in own.values()]
        alike = min((_neighbours(one.residual[one.mask]) for one in traces), default=0.0)
        left = alike * min(self.fit.cost, self.fit.n)
        return max(FELT, min(FELT * (1 + alike) / (1 - alike), _NO_CAUSE * left))

    def cost(self, widths: Mapping[str, float]) -> float:
        """Chi-squared at these widths, in units of what the fit leaves."""
        if self.whole:
            return cost_along(self.fit, paths_of(self.fit, moved=widths))
        cost = self._problem.cost_from(self._values | dict(widths), self._nodes)
        return cost / max(self.fit.cost / self.fit.n, 1.0)

    def paths(self) -> list[NullPath]:
        """The records' simulations at the fit's own widths."""
        if self.whole:
            return paths_of(self.fit)
        return self._problem.paths(self._values | self.widths, self._nodes)


def _neighbours(residual: Array) -> float:
    """Correlation of neighbours in a residual (n,); 0 where it is no larger than chance makes it."""
    square, count = float(residual @ residual), max(len(residual), 1)
    own = float(residual[1:] @ residual[:-1]) / square if square > 0 else 0.0
    return min(own, 1 - 1 / count) if own > _COLOUR / math.sqrt(count) else 0.0


def felt_by(fit: Fit, widths: Mapping[str, float]) -> float:
    """By how much chi-squared of a fit changes with these widths doubled, its parameters held: as much may be left by
    what they are."""
    return _change(Motion(fit, widths), widths)


def _change(motion: Motion, widths: Mapping[str, float]) -> float:
    return abs(motion.cost({name: 2 * width for name, width in widths.items()}) - motion.cost(widths))


def _told(motion: Motion, widths: Mapping[str, float]) -> Fit:
    """The fit, with a message if twice its widths change chi-squared."""
    fit = motion.fit
    change = _change(motion, widths)
    if change < motion.felt:
        return fit
    names = ", ".join(f"{name} = {width:.2g}" for name, width in widths.items())
    words = (
        f"{ROUNDED} ({names}: twice as wide they change chi-squared by {change:.2g}), and "
        f"no fit with sharper ones was reached: estimates may be off by about "
        f"{math.sqrt(change * FELT / motion.felt):.2g} standard errors; "
        "with_effect(..., sharp=True) keeps the corners as they are, and is fitted through its events"
    )
    return replace(fit, messages=(words, *fit.messages))


def with_cut_corners(fit: Fit) -> Fit:
    """The last fit with sharper corners than those before, of a search whose time was up; with a message."""
    rounded = [one.width for one in fit.model.effects] + [one.width for one in fit.model.corners]
    widths = [name for name in rounded if name in fit.parameters]
    names = ", ".join(f"{name} = {fit.parameters[name].value:.2g}" for name in widths)
    words = f"{ROUNDED}, maybe: the time was up before sharper ones were tried ({names})"
    return replace(fit, messages=(words, *fit.messages))


def open_widths(model: Model, parameters: Parameters) -> dict[str, Any]:
    """Name -> the effect's attachment or the rounded jump, of widths that are as the model declares them."""
    declared = {one.name: one.value for one in model.declarations}
    rounded: tuple[Any, ...] = (*model.effects, *model.corners)
    return {
        one.width: one
        for one in rounded
        if one.width and one.width in parameters and _untouched(parameters[one.width], declared[one.width])
    }


def with_widths_of(fit: Fit, parameters: Parameters) -> Parameters:
    """A copy of a set with the widths of corners that a fit found by the motion, where the set leaves them as they were
    declared; estimated where the fit estimated them: beside what is missing they are others."""
    widths = {name: fit.parameters[name].value for name in open_widths(fit.model, parameters)}
    pars = with_widths(parameters, widths)
    for name in widths:
        if name in fit.free:
            pars[name].set(fit.values[name], min=fit.parameters[name].min, vary=True)
    return pars


def _untouched(parameter: Any, value: float) -> bool:
    own = parameter.vary or parameter.fixed_by_user or parameter.tie is not None
    return not own and bool(parameter.value == value)


def narrowed(problem: RefitProblem, parameters: Parameters, found: Refit) -> dict[str, float]:
    """The widths of the corners that the motion of a refit asks to be sharper than the set has them."""
    widths = open_widths(problem.model, parameters)
    if not widths:
        return {}
    try:
        with np.errstate(all="ignore"):
            paths = problem.paths(found.values, found.nodes)
            by_motion = _by_motion(problem.model, parameters, widths, paths)
    except (FloatingPointError, np.linalg.LinAlgError):
        return {}
    return {name: width for name, width in by_motion.items() if width < parameters[name].value}


def with_widths(parameters: Parameters, widths: Mapping[str, float]) -> Parameters:
    """A copy of a set with other widths of corners."""
    pars = parameters.copy()
    for name, width in widths.items():
        pars[name].set(width, min=min(width, pars[name].min))
    return pars


def _by_motion(
    model: Model, parameters: Parameters, widths: Mapping[str, Any], paths: Sequence[NullPath]
) -> dict[str, float]:
    """The width of each corner by the motion along these simulations."""
    found = {}
    for name, one in widths.items():
        if isinstance(one, Corner):
            found[name] = narrow(courses(paths, one.signal), parameters[name].value)
            continue
        view = PortView(model, model.ports[one.at], partial(courses, paths), effect=one.effect.name)
        width = getattr(one.effect.narrowed(view), "width", None)
        found[name] = parameters[name].value if width is None else min(width, parameters[name].value)
    return found


def _refitted(
    motion: Motion,
    parameters: Parameters,
    widths: Mapping[str, float],
    again: Callable[[Parameters, Fit, Any], Fit],
) -> Motion | None:
    """The simulation of a converged fit with these widths; None where there is none."""
    pars = with_widths(parameters, widths)
    try:
        fit = again(pars, motion.fit, max(2, max(motion.samples) // _INTERVALS))
        return Motion(fit, widths) if fit.converged else None
    except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
        return None  # too sharp for the integrator


def _sharper(motion: Motion, widths: Mapping[str, float]) -> dict[str, float] | None:
    """The widest widths that the data do not tell from sharper ones; None where the integrator can follow none."""
    allowed = min(MOST_SUBSTEPS, _STEPS / sum(motion.samples))
    limit = allowed / max(motion.steps, 1)
    if limit < _WORTH:
        return None
    # by factors, and at last as sharp as the integrator can follow
    shares = [FACTOR**k for k in range(SHARPER + 1) if FACTOR**k < limit / _WORTH] + [limit]
    levels = [{name: float(f"{width / share:.2g}") for name, width in widths.items()} for share in shares]
    try:
        # the sharpest first: it asks for the finest steps, which the others then share
        sharpest = motion.cost(levels[-1])
        felt = (abs(motion.cost(level) - sharpest) >= motion.felt for level in levels[:-1])
        return next((level for level, more in zip(levels, felt, strict=False) if not more), levels[-1])
    except (FloatingPointError, np.linalg.LinAlgError):
        return None  # what is sharper cannot be simulated


def paths_of(
    fit: Fit, model: Model | None = None, *, moved: Mapping[str, float] | None = None
) -> list[NullPath]:
    """The simulations of a fit's records.

    model : in place of the fit's, with the same parameters; moved : name -> value of parameters in place of the fit's
    """
    model = fit.model if model is None else model
    pmap = compile(fit.parameters, model.parameter_names, tuple(record.name for record in fit.data))
    found = []
    for record in fit.data:
        measured = tuple(out.name for out in model.outputs if out.name in record)
        first = np.array([e.value for e in fit.initial[record.name].values()])
        grid = lay_grid(model, record, outputs=measured)
        p = np.array(pmap.unpack(fit.z, record.name))
        for name, value in (moved or {}).items():
            p[model.parameter_names.index(name)] = value
        found.append(null_path(model, grid, p, first))
    return found


def courses(paths: Sequence[NullPath], signal: ca.SX) -> list[Array]:
    """A scalar of the model (N,) at the samples of each path."""
    found = []
    for path in paths:
        points = path.at_samples()
        values = path.function([signal])(*points.arguments)[0][0]
        found.append(np.array(np.broadcast_to(values, points.t.shape[1])))
    return found


def cost_along(fit: Fit, paths: Sequence[NullPath]) -> float:
    """Chi-squared of simulations at a fit's noise level, in units of what the fit leaves."""
    total = 0.0
    for path in paths:
        model, grid = path.model, path.grid
        out = path.function([model.output_expressions])(*path.at_samples().arguments)[0]
        shown = at_measurements(path, np.broadcast_to(out, (len(model.outputs), grid.samples))[None])
        for name, (sigma, _) in fit.noise.items():
            if name in grid.measured:
                total += float((((grid.measured[name].values - shown[name][0]) / sigma) ** 2).sum())
    return total / max(fit.cost / fit.n, 1.0)
