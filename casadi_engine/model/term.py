"""The term of an effect at a port of a model: its law read with symbols, and checked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from casadi_engine.effects.functions import Sharp, SharpInTime
from casadi_engine.effects.protocol import PORT_KINDS, Effect, Grid, check_effect
from casadi_engine.errors import CasadiEngineError, EffectError
from casadi_engine.model.declarations import ParameterDeclaration, Port
from casadi_engine.model.law_checks import OwnState, check_null, check_symbols, check_units, read_law
from casadi_engine.model.paths import is_further
from casadi_engine.model.port_side import check_side
from casadi_engine.model.port_view import MissingSignalError, PortView, TrialView, Values
from casadi_engine.parameters import near_matches

if TYPE_CHECKING:
    from casadi_engine.model.model import Model


@dataclass(frozen=True, eq=False)
class Term:
    """What an effect adds at a port.

    value : SX scalar in the model's symbols, the parameters' and the own states'
    declarations, symbols : of the effect's parameters, the amplitude first, the width of its corners last
    arrives : as `value`, what enters the second end of a link
    constants : whole numbers        width : name of the width among the parameters, "" without one
    """

    effect: Any
    port: Port
    value: Any
    states: tuple[OwnState, ...]
    declarations: tuple[ParameterDeclaration, ...]
    symbols: tuple[Any, ...]
    constants: Mapping[str, float]
    sharp: bool
    arrives: Any
    width: str = ""

    @property
    def amplitude(self) -> Any:
        """SX symbol of the amplitude."""
        return self.symbols[0]


@dataclass(frozen=True)
class NotApplicable:
    """An effect that cannot act at a port, and why.

    at : name of the port, "" where the model has none of the right kind
    missing : signals that the law reads and the port lacks; has : the signals of the port
    """

    effect: str
    at: str
    missing: tuple[str, ...]
    has: tuple[str, ...]
    why: str

    def __str__(self) -> str:
        return f"{self.effect} at {self.at}: {self.why}" if self.at else f"{self.effect}: {self.why}"


def not_applicable(model: Model, effect: Any, port: Port) -> tuple[NotApplicable, EffectError] | None:
    """Why an effect cannot act at a port of the right kind, with the error; None where it can.

    The law is called on trial: what it reads, and whether it gives a term, is seen and not declared.
    """
    try:
        read_term(model, effect, port, values=_tried_values(effect), again=True)
        check_side(model, port)
    except EffectError as fault:
        return not_applicable_because(effect, port, fault), fault
    return None


def not_applicable_because(effect: Any, port: Port, fault: EffectError) -> NotApplicable:
    """The note for an effect that an error keeps from acting at a port."""
    if isinstance(fault, MissingSignalError):
        why = f"the port has no {', '.join(fault.missing)}"
        return NotApplicable(effect.name, port.name, fault.missing, fault.has, why)
    why = fault.problem if fault.seen is None else f"{fault.problem} ({fault.seen})"
    return NotApplicable(effect.name, port.name, (), tuple(port.signals), why)


def ports_of_kind(model: Model, effect: Any) -> tuple[Port, ...]:
    """The ports of the kinds that an effect attaches to, in model order; last the links that no coupling joins, and the
    paths and crosses that there may be."""
    links = [link for link in model.ports.links if link.kind in effect.attaches]
    listed = (port for port in model.ports if port.kind in effect.attaches)
    paths = model.ports.paths if "path" in effect.attaches else ()
    crosses = model.ports.crosses if "cross" in effect.attaches else ()
    return (
        *listed,
        *(link for link in links if not joined(model, link)),
        *(path for path in paths if is_further(model, path, effect)),
        *crosses,
    )


def joined(model: Model, link: Port) -> bool:
    """True if a coupling of the model acts between the ends of a link: an effect there is one at the coupling."""
    first, second = (model.ports[name].slot for name in link.ends)
    couplings = [port.slot for port in model.ports.with_slot if port.kind == "coupling"]
    between = ca.jacobian(model.ode, first) - ca.jacobian(model.ode, second)
    apart = [ca.jacobian(model.ode, slot) - sign * between for slot in couplings for sign in (1, -1)]
    if not apart:
        return False
    unknown = [model.x, model.u, model.d, model.w, model.t]
    values = ca.vertcat(*[one.value for one in model.declarations])
    function = ca.Function("apart", [*unknown, model.p], [ca.horzcat(between, *apart)])
    rng = np.random.default_rng(0)
    found = np.array(function(*(rng.uniform(0.5, 1.5, one.numel()) for one in unknown), values))
    return bool((np.abs(found[:, 1:]).max(axis=0) < 1e-9 * np.abs(found[:, 0]).max()).any())


def ports_for(model: Model, effect: Any) -> tuple[Port, ...]:
    """The ports of a model that an effect can act at, in model order: of its kinds, with the signals its law reads."""
    return tuple(port for port in ports_of_kind(model, effect) if not_applicable(model, effect, port) is None)


def find_port(model: Model, effect: Any, at: Any) -> Port:
    """The port `at`; EffectError that lists the right ports if it does not exist or does not fit."""
    name = at.name if isinstance(at, Port) else at
    if name not in model.ports.names and name not in [own.name for own in model.ports.unlisted]:
        right = [port.name for port in ports_for(model, effect)]
        raise EffectError(
            f"{effect.name} is to act at a port that the model {model.name} does not have",
            seen=repr(name),
            allowed=near_matches(name, right),
            cure="print(model.ports) lists all ports",
        )
    port = model.ports[name]
    if port.kind not in effect.attaches:
        right = [port.name for port in ports_for(model, effect)]
        raise EffectError(
            f"{effect.name} cannot act at the port {port.name}",
            seen=f"a port of the kind {port.kind}",
            allowed=near_matches(name, right),
            cure=f"choose one of these ports ({', '.join(effect.attaches)})",
        )
    return port


def read_term(
    model: Model,
    effect: Any,
    at: Any,
    *,
    values: Mapping[str, float] | None = None,
    sharp: bool = False,
    again: bool = False,
) -> Term:
    """Read an effect's law at a port with fresh symbols for its parameters.

    values : start values of parameters; those that are whole numbers must be given
    sharp : the law without rounding
    again : True where the model may have the effect there already
    EffectError for an effect, port, value or law that does not fit; MissingSignalError names all signals that the law
    reads and the port lacks.
    """
    return read_terms(model, effect, at, [values or {}], sharp=sharp, again=again)[0]


def read_terms(
    model: Model,
    effect: Any,
    at: Any,
    choices: Sequence[Mapping[str, float]],
    *,
    sharp: bool = False,
    again: bool = False,
) -> list[Term]:
    """As ``read_term``, for several choices of values: the law is read once for each choice of whole numbers."""
    check_effect(effect)
    port = find_port(model, effect, at)
    if isinstance(effect, Effect):
        effect = effect.placed(PortView(model, port, effect=effect.name))
    check_units(effect, port)
    if not again and any(one.at == port.name and one.effect.name == effect.name for one in model.effects):
        raise EffectError(
            f"the model {model.name} has {effect.name} at {port.name} already",
            seen=f"{effect.name} twice at {port.name}",
            allowed="an effect once at each port",
            cure="leave it out, or attach it at another port",
        )
    whole = [name for name, grid in effect.nuisance.items() if grid.whole]
    laws: dict[tuple[float, ...], Term] = {}
    own: tuple[ParameterDeclaration, ...] | None = None
    found = []
    for values in choices:
        given = _checked_values(effect, values)
        key = tuple(given[name] for name in whole)
        term = laws.get(key)
        if term is None:
            term = laws[key] = _law_read(model, effect, port, given, sharp)
            found.append(term)
        else:
            if own is None:
                view = PortView(model, port, effect=effect.name)
                own = _declarations(effect, port, view, {}, unit_at(model, port))
            width = term.declarations[len(own) :]
            found.append(replace(term, declarations=(*_at_values(own, given), *width)))
    check_symbols(model, [*laws.values()])
    check_null([*laws.values()])
    return found


def _law_read(model: Model, effect: Any, port: Port, given: Mapping[str, float], sharp: bool) -> Term:
    """The term of one choice of whole numbers."""
    view = TrialView(model, port, effect=effect.name)
    declarations = _declarations(effect, port, view, given, unit_at(model, port))
    symbols = tuple(ca.SX.sym(declared.name) for declared in declarations)
    known = dict(zip(_estimated(effect), symbols, strict=True))
    constants = {name: given[name] for name, grid in effect.nuisance.items() if grid.whole}
    try:
        functions = Sharp if sharp else SharpInTime(ca.vertcat(model.t, model.p, *symbols))
        law = effect.law(view, Values(effect.name, known | constants), functions)
    except CasadiEngineError:
        view.check()
        raise
    except Exception as fault:
        view.check()
        raise EffectError(
            f"the law of {effect.name} at {port.name} fails",
            seen=f"{type(fault).__name__}: {fault}",
            allowed="an expression of the port's signals, p and math",
            cure="correct the method law of the effect",
        ) from fault
    view.check()
    value, states, arrives = read_law(effect, port, view, law)
    name = ""
    if view.corner is not None and _uses(view.corner[0], ca.vertcat(value, arrives), states):
        symbol, default, unit = view.corner
        name = symbol.name()
        declarations, symbols = (
            (*declarations, _width(name, default, port.in_its_unit(unit))),
            (*symbols, symbol),
        )
    return Term(effect, port, value, states, declarations, symbols, constants, sharp, arrives, name)


def _tried_values(effect: Any) -> dict[str, float]:
    """A whole number for each parameter that needs one: the first cycle, or the middle of its grid."""
    found = {}
    for name, grid in effect.nuisance.items():
        if grid.whole:
            values = grid.values(cycles=(1,))
            found[name] = values[len(values) // 2]
    return found


def _estimated(effect: Any) -> list[str]:
    """The amplitude and the nuisance parameters that are not whole numbers."""
    return [effect.amplitude.name, *(name for name, grid in effect.nuisance.items() if not grid.whole)]


def _checked_values(effect: Any, values: Mapping[str, float]) -> dict[str, float]:
    names = [effect.amplitude.name, *effect.nuisance]
    if not isinstance(values, Mapping):
        raise EffectError(
            f"the values of the effect {effect.name} are not a mapping",
            seen=repr(values),
            allowed=f"{', '.join(names)} -> number",
            cure=f'give values={{"{names[0]}": 1.0}}, for instance',
        )
    for name, value in values.items():
        if name not in names:
            raise EffectError(
                f"the effect {effect.name} has no such parameter",
                seen=repr(name),
                allowed=near_matches(name, names),
                cure="leave it out",
            )
        if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
            raise EffectError(
                f"the value of {name} of the effect {effect.name} is not acceptable",
                seen=repr(value),
                allowed="a finite number in the parameter's unit",
                cure="give one number",
            )
    for name, grid in effect.nuisance.items():
        if grid.whole and (name not in values or values[name] != int(values[name])):
            raise EffectError(
                f"{effect.name} needs a whole number for {name}",
                seen=f"{name} = {values[name]!r}" if name in values else f"no {name}",
                allowed="a whole number",
                cure=f'give values={{"{name}": 1}}, for instance',
            )
    return {name: float(value) for name, value in values.items()}


def _declarations(
    effect: Any, port: Port, view: PortView, values: Mapping[str, float], unit: str
) -> tuple[ParameterDeclaration, ...]:
    """The amplitude and the nuisance parameters that are not whole numbers, at these values or their own."""
    key, amplitude = f"{view.name}.{effect.name}", effect.amplitude
    made = [
        ParameterDeclaration(
            f"{key}.{amplitude.name}",
            0.0,
            unit if amplitude.unit is None else port.in_its_unit(amplitude.unit),
            amplitude.min,
            amplitude.max,
            True,
            amplitude.description or _words(effect, port),
        )
    ]
    for name, grid in effect.nuisance.items():
        if not grid.whole:
            low, high, middle = _range(grid, view)
            words = grid.description or f"{name} of {effect.name}"
            own = port.in_its_unit(grid.unit)
            made.append(ParameterDeclaration(f"{key}.{name}", middle, own, low, high, True, words))
    return _at_values(made, values)


def _at_values(
    declared: Sequence[ParameterDeclaration], values: Mapping[str, float]
) -> tuple[ParameterDeclaration, ...]:
    """Declarations of an effect at other values, which are within the bounds of a nuisance parameter."""
    amplitude, *others = declared
    name = amplitude.name.rpartition(".")[2]
    found = [replace(amplitude, value=values[name]) if name in values else amplitude]
    for one in others:
        value = values.get(one.name.rpartition(".")[2], one.value)
        found.append(replace(one, value=value, min=min(one.min, value), max=max(one.max, value)))
    return tuple(found)


def _words(effect: Any, port: Port) -> str:
    return effect.worded(port) if isinstance(effect, Effect) else f"{effect.name} at {port.name}"


def _uses(symbol: Any, value: Any, states: Iterable[OwnState]) -> bool:
    return bool(ca.depends_on(ca.vertcat(value, *(state.rate for state in states)), symbol))


def _width(name: str, default: float, unit: str) -> ParameterDeclaration:
    """The width of a law's corners as a fixed parameter; far narrower than its default nothing can follow it."""
    words = "corners are rounded over it; where records pass them, estimate sets it by the motion"
    return ParameterDeclaration(name, default, unit, 1e-9 * default, math.inf, False, words)


def unit_at(model: Model, port: Port) -> str:
    """The unit of what an effect adds at a port."""
    name = port.name.partition("_")[2]
    groups: dict[str, Iterable[Any]] = {
        "input": model.inputs,
        "sensor": model.outputs,
        "parameter": model.declarations,
    }
    found = [item.unit for item in groups.get(port.kind, ()) if item.name == name]
    return found[0] if found else port.unit


def _range(grid: Grid, view: PortView) -> tuple[float, float, float]:
    """Bounds and start value; a grid of times or cycles has no bounds before the record is known."""
    if grid.over == "cycle":
        return -math.inf, math.inf, 1.0
    magnitude = 1.0 if grid.of is None else view.typical(grid.of)
    if grid.over == "time":
        return -math.inf, math.inf, 0.5 * sum(grid.ends())
    low, high = grid.ends(magnitude=magnitude)
    found = grid.values(magnitude=magnitude)
    return low if grid.least is None else min(low, grid.least), high, found[len(found) // 2]


def takes_torque(port: Port) -> bool:
    """True if effects add a torque there."""
    return PORT_KINDS[port.kind]
