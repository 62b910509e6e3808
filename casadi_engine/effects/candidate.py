"""Candidates: what an effect that a model lacks would do to its torques, drives and outputs, per unit of amplitude.

Along the null trajectory the sensitivity s = ∂x/∂ψ of a candidate obeys ṡ = f_x s + g, and ∂y/∂ψ = h_x s + m,
with g = `Candidate.ode` and m = `Candidate.output`: one linear sweep scores any number of candidates.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.effects.combustion import CYCLE
from casadi_engine.effects.protocol import Amplitude, Effect, check_effect, with_settings
from casadi_engine.errors import CasadiEngineError, EffectError
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.arrival import arriving
from casadi_engine.model.declarations import Port
from casadi_engine.model.late_inputs import earlier
from casadi_engine.model.law_checks import OwnState
from casadi_engine.model.linearity import is_affine
from casadi_engine.model.port_view import Courses, PortView
from casadi_engine.model.term import (
    NotApplicable,
    Term,
    not_applicable_because,
    ports_for,
    read_term,
    read_terms,
    takes_torque,
)
from casadi_engine.parameters import Parameters

# What was read of laws: by port, effect and values the terms, and with the model and the sizes the candidates.
Known = dict[tuple[Any, ...], list[Any]]

# Amplitudes at which a law is looked at that has no slope at 0, in its own unit.
_SIZES = tuple(10.0**power for power in range(-8, 7))
# A combustion counts as a cycle of the record if at least this much of it is inside [rad].
_INSIDE = 0.5


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect at a port of a model that does not have it, at amplitude 0.

    effect, at : the effect and the name of its port        model : the model without it
    values : nuisance values        size : None for the slope at amplitude 0; else the amplitude whose secant it is
    slots : (nw, 1) ∂(torque in the slots)/∂ψ        drives : (m, 1) ∂(drives)/∂ψ
    outputs : (ny, 1) ∂(outputs)/∂ψ beside the states' share
    all SX in the model's (x, u, d, t, p); at an input these are the responses of laws, drives and outputs
    states : of the effect's own, at amplitude 0
    """

    model: Model
    effect: Any
    at: str
    values: Mapping[str, float]
    size: float | None
    slots: Any
    drives: Any
    outputs: Any
    states: tuple[OwnState, ...] = ()
    beyond: Any = field(default=None, repr=False)

    @property
    def key(self) -> str:
        """``port.effect``, the same for all values and sizes."""
        return f"{self.at}.{self.effect.name}"

    @property
    def label(self) -> str:
        """``port.effect`` with values and size."""
        shown = [f"{name}={value:.6g}" for name, value in self.values.items()]
        shown += [] if self.size is None else [f"{self.amplitude.name}={self.size:.6g}"]
        return f"{self.key}({', '.join(shown)})" if shown else self.key

    @property
    def is_flat(self) -> bool:
        """True where secants had to be taken, as the law has no slope at amplitude 0."""
        return self.size is not None and type(self.effect).sizes is Effect.sizes

    @property
    def amplitude(self) -> Amplitude:
        """The effect's amplitude: unit, bounds, whether it is one-sided."""
        made: Amplitude = self.effect.amplitude
        return made

    @cached_property
    def closed(self) -> tuple[Any, Any]:
        """∂ẋ/∂ψ (n, 1) and ∂y/∂ψ (ny, 1) at fixed states, SX in (x, u, t, p) and the own states' symbols."""
        model, small = self.model, ca.SX.sym("psi")
        beyond = ca.SX.zeros(model.x.numel(), 1) if self.beyond is None else self.beyond
        moved = replace(
            model,
            p=ca.vertcat(model.p, small),
            ode=model.ode + small * beyond,
            laws=model.laws + small * self.slots,
            drive_expressions=model.drive_expressions + small * self.drives,
            output_expressions=model.output_expressions + small * self.outputs,
        )
        both = ca.vertcat(moved.closed_ode, moved.closed_outputs)
        slope = ca.substitute(ca.jacobian(both, small), small, 0)
        count = model.x.numel()
        return ca.densify(slope[:count]), ca.densify(slope[count:])

    @property
    def ode(self) -> Any:
        """g (n, 1) SX in (x, u, t, p): forcing of the sensitivity equation."""
        return self.closed[0]

    @property
    def output(self) -> Any:
        """m (ny, 1) SX in (x, u, t, p): direct share of the output's sensitivity."""
        return self.closed[1]

    @cached_property
    def function(self) -> Any:
        """CasADi function (x, u, d, t, p) -> (slots, drives, outputs), for effects without states."""
        m = self.model
        symbols, names = [m.x, m.u, m.d, m.t, m.p], ["x", "u", "d", "t", "p"]
        results = [ca.densify(part) for part in (self.slots, self.drives, self.outputs)]
        return ca.Function("candidate", symbols, results, names, ["slots", "drives", "outputs"])

    def extended(self, *, psi: float = 0.0, sharp: bool = False) -> Model:
        """The model with the effect, its parameters starting at `psi` and this candidate's values."""
        start = dict(self.values) | {self.amplitude.name: psi}
        return self.model.with_effect(self.effect, at=self.at, values=start, sharp=sharp)


def candidate(
    model: Model,
    effect: Effect,
    at: Any,
    values: Mapping[str, float] | None = None,
    *,
    size: float | None = None,
    sharp: bool = False,
) -> Candidate:
    """Return what an effect at a port would do to a model, per unit of amplitude.

    values : nuisance values; those left out are in the middle of their grid
    size : None for the slope at amplitude 0, which is one-sided where the amplitude is; or an amplitude whose
        secant is taken, for laws that bend (the play of a coupling)
    sharp : the law without rounding. Then only effects that are linear in the amplitude have a slope at 0; a
        sharp dead zone at half-width 0 counts as the sign of its argument, the limit from above
    EffectError as `Model.with_effect`; ModelError for an unknown port.
    """
    term = read_term(model, effect, at, values=_without_amplitude(effect, values or {}), sharp=sharp)
    return _made(model, term, size)


def _without_amplitude(effect: Effect, values: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in values.items() if name != effect.amplitude.name}


def _made(model: Model, term: Term, size: float | None) -> Candidate:
    """The candidate of a term, at the values of its declarations."""
    numbers = {one.name.rpartition(".")[2]: one.value for one in term.declarations[1:]}
    value = ca.vertcat(*(_per_amplitude(term, part, size) for part in (term.value, term.arrives)))
    if numbers:
        value = ca.substitute(value, ca.vertcat(*term.symbols[1:]), ca.SX(ca.DM(list(numbers.values()))))
    states, value = _own_states(term, list(numbers.values()), value)
    effect = term.effect
    every = {name: term.constants.get(name, numbers.get(name, math.nan)) for name in effect.nuisance}
    slots, drives, outputs, beyond = responses(model, term.port, value)
    return Candidate(model, effect, term.port.name, every, size, slots, drives, outputs, states, beyond)


def candidates(
    model: Model,
    effects: Iterable[Effect],
    record: Experiment,
    *,
    parameters: Parameters | Mapping[str, float] | None = None,
    sharp: bool = False,
    courses: Courses | None = None,
    skipped: list[NotApplicable] | None = None,
    known: Known | None = None,
    free: Collection[str] | None = None,
    again: bool = False,
    at: str | None = None,
    settled: dict[tuple[str, str], Effect] | None = None,
) -> tuple[Candidate, ...]:
    """Return all candidates of effects at all ports of a model, over the grids of their nuisance parameters.

    record : gives time grids their span, cycle grids their cycles, and cylinders their motored trace
    parameters : as in `Model.parameter_vector`, for constants that depend on them
    courses : an SX scalar of the model -> its values (N,) along each record, for effects that look at the motion
    skipped : a list to which every effect is added that cannot be prepared at a port, with the reason; None raises
    EffectError for it
    known : what earlier calls have read, to be used again; this call adds to it
    free : names of the parameters that are estimated or tied, which have no fixed value that could be wrong; None takes
    those of `parameters`, and of the declarations where it is no Parameters
    again : True for effects that the model has already at a port too, as it has them a second time: an event that
    happens elsewhere. Else they are left out there. Ports that lack a signal which the law reads are left out always.
    at : the name of the one port that is asked for, None for all
    settled : (name of an effect, port) -> the effect as the first record made it, whose settings `alike` count for all
    records; this call adds to it
    """
    record = arriving(model, record)
    vector = model.parameter_vector(parameters)
    numbers = dict(zip(model.parameter_names, (float(value) for value in vector), strict=True))
    there = set() if again else {(one.at, one.effect.name) for one in model.effects}
    free = _not_fixed(model, parameters) if free is None else free
    found: list[Candidate] = []
    unused = model.unused_inputs
    for effect in effects:
        check_effect(effect)
        for port in ports_for(model, effect):
            if at not in (None, port.name) or (port.name, effect.name) in there:
                continue
            if effect.fixed_only and port.parameter in free:
                continue
            try:
                view = PortView(model, port, courses, effect=effect.name, free=free)
                made, words = _at_port(
                    model, effect, port, view, record, numbers, sharp, known, again, settled
                )
            except EffectError as fault:
                if skipped is None:
                    raise
                _note(not_applicable_because(effect, port, fault), skipped)
                continue
            if port.kind == "input" and not words and (own := port.name.partition("_")[2]) in unused:
                made, words = [], f"no equation depends on {own}"
            if port.parameter and not all(_has_lever(one, vector) for one in made):
                made, words = [], f"no equation depends on {port.parameter} at these values"
            if words:
                _note(NotApplicable(effect.name, port.name, (), tuple(port.signals), words), skipped)
            found += made
    return tuple(found)


def _not_fixed(model: Model, parameters: Any) -> frozenset[str]:
    """The parameters that are estimated or tied."""
    given = parameters if isinstance(parameters, Parameters) else model.parameters()
    return frozenset(name for name, one in given.items() if one.vary or one.tie is not None)


def _note(why: NotApplicable, skipped: list[NotApplicable] | None) -> None:
    if skipped is not None and why not in skipped:
        skipped.append(why)


def _has_lever(one: Candidate, vector: NDArray[np.float64]) -> bool:
    """False if nothing at all depends on a candidate at these values of the parameters."""
    parts = [part for part in (one.slots, one.drives, one.outputs, one.beyond) if part is not None]
    left = ca.substitute(ca.vertcat(*parts), one.model.p, ca.SX(ca.DM(vector)))
    return bool(ca.sparsify(left).nnz() > 0)


def _at_port(
    model: Model,
    effect: Effect,
    port: Port,
    view: PortView,
    record: Experiment,
    numbers: Mapping[str, float],
    sharp: bool,
    known: Known | None,
    again: bool,
    settled: dict[tuple[str, str], Effect] | None,
) -> tuple[list[Candidate], str]:
    """The candidates of one effect at one port, or why there are none; EffectError where a method of it fails."""
    try:
        words = effect.idle(view)
        if words:
            return [], words
        own = effect.fitted(view, record, numbers)
        if settled is not None and effect.alike:
            first = settled.setdefault((effect.name, port.name), own)
            own = with_settings(own, {name: getattr(first, name) for name in effect.alike})
        # corners as sharp as the motion passes them; the candidate keeps the effect whose widths are still open
        sharper = own.narrowed(view) if view.has_courses else own
        points = own.choices(view, grid_values(own, view, record, numbers))
        sizes = (None, *own.sizes(view, numbers))
    except CasadiEngineError:
        raise
    except Exception as fault:
        raise EffectError(
            f"a method of {effect.name} fails at {port.name}",
            seen=f"{type(fault).__name__}: {fault}",
            allowed="idle, fitted, narrowed, choices and sizes as ce.Effect describes them",
            cure="correct that method of the effect, or leave it out",
        ) from fault
    if not points:
        return [], f"no value of {' and '.join(own.nuisance)} is within reach of the motion on the records"
    places = tuple(_without_amplitude(sharper, values) for values in points)
    law = (port, sharper, tuple(tuple(one.items()) for one in places), sharp)
    # an effect that is no value may have changed since
    if known is None or not _is_value(sharper):
        known = {}
    if law not in known:
        known[law] = read_terms(model, sharper, port, places, sharp=sharp, again=again)
    if len(sizes) == 1 and not sharp and _is_flat(known[law][0]):
        sizes = _secants(own.amplitude)
    key = (model, *law, sizes)
    if key not in known:
        known[key] = [_made(model, term, size) for term in known[law] for size in sizes]
    return [one if one.effect is own else replace(one, effect=own) for one in known[key]], ""


def _is_flat(term: Term) -> bool:
    """True for a law that has no slope at amplitude 0, as of a square or a magnitude: none of it is seen there."""
    law = ca.vertcat(term.value, term.arrives, *[state.rate for state in term.states])
    slope = ca.substitute(ca.jacobian(law, term.amplitude), term.amplitude, 0)
    return bool(ca.sparsify(ca.simplify(slope)).nnz() == 0)


def _secants(amplitude: Amplitude) -> tuple[float, ...]:
    """Amplitudes whose secants stand for the slope of a law that has none, of any size and of each sign allowed."""
    sides = [side for side, end in ((1.0, amplitude.max), (-1.0, amplitude.min)) if side * end > 0]
    within = {1.0: amplitude.max, -1.0: -amplitude.min}
    return tuple(side * size for side in sides for size in _SIZES if size <= within[side]) or tuple(
        side * within[side] for side in sides
    )


def _is_value(effect: Effect) -> bool:
    """True for a frozen dataclass, which is what its fields say."""
    made = getattr(effect, "__dataclass_params__", None)
    return made is not None and made.frozen and "__hash__" in vars(type(effect))


def grid_values(
    effect: Effect, view: PortView, record: Experiment, numbers: Mapping[str, float]
) -> dict[str, tuple[float, ...]]:
    """The values of every nuisance grid of an effect at a port, for a record."""
    found = {}
    for name, grid in effect.nuisance.items():
        magnitude = 1.0 if grid.of is None else view.typical(grid.of)
        cycles = cycles_of(view, record, numbers) if grid.over == "cycle" else (1,)
        found[name] = grid.values(magnitude=magnitude, time=record.span, cycles=cycles)
    return found


def cycles_of(view: PortView, record: Experiment, numbers: Mapping[str, float]) -> tuple[int, ...]:
    """The cycles of a cylinder whose combustion lies in a record, counted from theta = 0 of cylinder 1."""
    if "theta" not in record:
        raise EffectError(
            "there is no crank angle to count engine cycles by",
            seen=f"{record.place} without theta",
            allowed="a record with the channel theta [rad]",
            cure="leave effects with cycles out, or record the crank angle",
        )
    offset = view.number("firing_offset", numbers) if view.has("firing_offset") else 0.0
    theta = record["theta"].values
    first = math.ceil((float(theta[0]) - offset) / CYCLE - 1e-9)
    last = math.floor((float(theta[-1]) - _INSIDE - offset) / CYCLE)
    return tuple(number + 1 for number in range(first, last + 1))


def _per_amplitude(term: Term, value: Any, size: float | None) -> Any:
    """The slope of a value of the law at amplitude 0, or its secant to `size`."""
    psi = term.amplitude
    if size is not None:
        if not np.isfinite(size) or size == 0:
            raise EffectError(
                "the amplitude of a secant is not acceptable",
                seen=repr(size),
                allowed="a finite number other than 0",
                cure="leave `size` out for the slope at 0",
            )
        return ca.substitute(value, psi, size) / size
    if not term.sharp or is_affine(value, psi, ca.SX(0, 1)):
        return ca.substitute(ca.jacobian(value, psi), psi, 0)
    # A sharp law that bends in its amplitude: the limit from above, by a secant that is exact for the piecewise
    # linear laws there are. 1e-9 of the unit amplitude is far below any state that counts.
    least = 1e-9 * (1 if term.effect.amplitude.one_sided >= 0 else -1)
    return ca.substitute(value, psi, least) / least


def _own_states(term: Term, numbers: list[float], value: Any) -> tuple[tuple[OwnState, ...], Any]:
    """The own states with their rates at amplitude 0, and a value of theirs, in symbols of the candidate's own: another
    time constant moves another state."""
    if not term.states:
        return (), value
    known = ca.vertcat(*term.symbols)
    point = ca.SX(ca.DM([0.0, *numbers]))
    old = ca.vertcat(*[state.symbol for state in term.states])
    new = [ca.SX.sym(state.symbol.name()) for state in term.states]
    rates = ca.substitute(ca.vertcat(*[state.rate for state in term.states]), known, point)
    rates, value = ca.substitute([rates, ca.SX(value)], [old], [ca.vertcat(*new)])
    made = zip(term.states, new, ca.vertsplit(rates), strict=True)
    return tuple(replace(state, symbol=symbol, rate=rate) for state, symbol, rate in made), value


def responses(model: Model, port: Port, value: Any) -> tuple[Any, Any, Any, Any]:
    """What a value at a port adds to slots, drives and outputs, and the ode's own share (of a parameter), or None.

    value : (2, 1), what a law adds there, and what arrives at the second end of a link
    """
    slots = ca.SX.zeros(model.w.numel(), 1)
    drives = ca.SX.zeros(model.d.numel(), 1)
    outputs = ca.SX.zeros(len(model.outputs), 1)
    value, arrives = ca.vertsplit(value)
    if port.kind in ("sensor", "cross"):
        sensors = [made.name for made in model.ports if made.kind == "sensor"]
        outputs[sensors.index((port.ends or (port.name,))[0])] = value
        return slots, drives, outputs, None
    if takes_torque(port) or port.ends:
        rows = [made.name for made in model.ports.with_slot]
        parts = (-value, arrives) if len(port.ends) > 1 else (value,)
        for name, part in zip(port.ends or (port.name,), parts, strict=True):
            slots[rows.index(name)] = part
        return slots, drives, outputs, None
    if port.kind == "input":
        name = port.name.partition("_")[2]
        symbol = model.u[[variable.name for variable in model.inputs].index(name)]
    else:
        symbol = model.p[model.parameter_names.index(port.parameter)]
    moved = [model.laws, model.drive_expressions, model.output_expressions, model.ode]
    # an input that acts late is changed where it is read off the record too
    places = [(symbol, value), *earlier(model, symbol, value)]
    slots, drives, outputs, beyond = (
        sum((ca.densify(ca.jacobian(part, at)) * own for at, own in places), ca.SX.zeros(*part.shape))
        if part.numel()
        else part
        for part in moved
    )
    return slots, drives, outputs, beyond
