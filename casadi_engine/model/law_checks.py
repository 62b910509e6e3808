"""What an effect's law returns, read and checked: a scalar of the model that vanishes at amplitude 0."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from casadi_engine.effects.protocol import Law
from casadi_engine.errors import EffectError
from casadi_engine.experiment.units import unit_words
from casadi_engine.model.constants import constants
from casadi_engine.model.declarations import Port
from casadi_engine.model.port_view import PortView

if TYPE_CHECKING:
    from casadi_engine.model.model import Model
    from casadi_engine.model.term import Term

# An effect is absent at amplitude 0 if its law is below this share of itself at amplitude 1.
_ABSENT = 1e-9

# What the law may depend on, by the kind of port: attributes of the model.
_MAY_USE: Mapping[str, tuple[str, ...]] = {
    "inertia": ("x", "u", "d", "t", "p"),
    "internal": ("x", "u", "d", "t", "p"),
    "coupling": ("x", "u", "d", "t", "p"),
    "cylinder": ("x", "u", "d", "t", "p"),
    "link": ("x", "u", "d", "t", "p"),
    "pipe": ("x", "u", "d", "t", "p"),
    "path": ("x", "u", "d", "t", "p"),
    "input": ("u", "t", "p"),
    "sensor": ("x", "u", "d", "w", "t", "p"),
    "cross": ("x", "u", "d", "w", "t", "p"),
    "parameter": ("t", "p"),
}
_WORDS = {
    "x": "states",
    "u": "channels",
    "d": "drives",
    "w": "slots",
    "t": "time",
    "p": "parameters",
}


@dataclass(frozen=True, eq=False)
class OwnState:
    """A state of an effect's own: its symbol, start value and rate."""

    name: str
    symbol: Any
    start: float
    rate: Any


def check_units(effect: Any, port: Port) -> None:
    """Raise EffectError where a parameter of an effect is stated in another unit than the port's numbers are in."""
    parameters = {effect.amplitude.name: effect.amplitude} | dict(effect.nuisance)
    for name, one in parameters.items():
        right = "" if one.unit is None else port.contradicts(one.unit)
        if right:
            signals = "".join(f", {signal} in {unit}" for signal, unit in port.units.items())
            raise EffectError(
                f"the unit of {effect.name}.{name} does not go with those of the port {port.name}",
                seen=f"{name} in {one.unit}; what acts at {port.name} in {unit_words(port.unit)}{signals}",
                allowed=f"{right}: a law reads the port's own numbers, and what it gives is added to them",
                cure=f'state unit="{right}", and let the law convert nothing; units of N m, rad and s, as N m/rad, '
                "are read in the units of each port",
            )


def read_law(effect: Any, port: Port, view: PortView, law: Any) -> tuple[Any, tuple[OwnState, ...], Any]:
    """Value and own states of what a law returned, and at a link what arrives at its second end."""
    given = law if isinstance(law, Law) else Law(law)
    if not isinstance(given.states, Mapping) or not all(map(_is_state, given.states.values())):
        raise EffectError(
            f"the states of the law of {effect.name} are not acceptable",
            seen=repr(given.states),
            allowed="name -> (start, rate), the start a finite number, the rate a scalar expression",
            cure='return Law(value, states={"stretch": (0.0, rate)}), for instance',
        )
    if set(given.states) != set(view.states):
        raise EffectError(
            f"the states of the law of {effect.name} do not fit those that it uses",
            seen=f"used: {', '.join(view.states) or 'none'}; given: {', '.join(given.states) or 'none'}",
            allowed="the same names",
            cure="return Law(value, states={name: (start, rate)}) for every port.state(name)",
        )
    states = []
    for name, (start, rate) in given.states.items():
        states.append(
            OwnState(
                f"{port.name}_{effect.name}_{name}",
                view.states[name],
                float(start),
                _scalar(f"the rate of {name} of {effect.name}", rate),
            )
        )
    what = f"the law of {effect.name} at {port.name}"
    value = _scalar(what, given.value)
    arrives = value if given.arrives is None else _scalar(f"what arrives by {what}", given.arrives)
    return value, tuple(states), arrives


def _is_state(pair: Any) -> bool:
    number = isinstance(pair, tuple | list) and len(pair) == 2 and isinstance(pair[0], Real)
    return number and not isinstance(pair[0], bool) and math.isfinite(pair[0])


def _scalar(what: str, value: Any) -> Any:
    if isinstance(value, Real) and not isinstance(value, bool):
        value = ca.SX(float(value))
    if not isinstance(value, ca.SX) or value.numel() != 1:
        raise EffectError(
            f"{what} is not a scalar expression",
            seen=f"{type(value).__name__} {getattr(value, 'shape', '')}".strip(),
            allowed="a scalar expression of the port's signals and the parameters",
            cure="return one torque, or one change of the port's value",
        )
    if not all(map(math.isfinite, constants(value))):
        raise EffectError(
            f"{what} is not a number",
            seen="a constant in it that is nan or infinite",
            allowed="a scalar expression that is finite along a motion",
            cure="look for a division by 0, or the root or logarithm of a negative constant, in the method law",
        )
    return ca.densify(value)


def check_symbols(model: Model, terms: Sequence[Term]) -> None:
    """Raise EffectError unless terms of one effect at one port use nothing but what is known there, and their own."""
    port, effect = terms[0].port, terms[0].effect
    allowed = _MAY_USE[port.kind]
    columns = {letter: getattr(model, letter) for letter in _WORDS}
    owner = {s.element_hash(): letter for letter, column in columns.items() for s in _symbols(column)}
    own = [s for term in terms for s in (*term.symbols, *(state.symbol for state in term.states))]
    fine = {s.element_hash() for s in own}
    used = [
        expression
        for term in terms
        for expression in (term.value, term.arrives, *(state.rate for state in term.states))
    ]
    for symbol in ca.symvar(ca.vertcat(*used)):
        key = symbol.element_hash()
        if key in fine or owner.get(key) in allowed:
            continue
        where = f"one of the {_WORDS[owner[key]]}" if key in owner else "not of this model"
        raise EffectError(
            f"the law of {effect.name} at {port.name} uses a symbol that it may not use",
            seen=f"{symbol.name()} ({where})",
            allowed=", ".join(_WORDS[letter] for letter in allowed),
            cure="write the law with the port's signals, p and math",
        )


def check_null(terms: Sequence[Term]) -> None:
    """The laws of terms of one effect at one port must vanish at amplitude 0: tried at a few points."""
    values = ca.vertcat(*[ca.vertcat(term.value, term.arrives) for term in terms])
    amplitudes = {term.amplitude.element_hash(): term.amplitude for term in terms}
    others = [s for s in ca.symvar(values) if s.element_hash() not in amplitudes]
    function = ca.Function("law", [ca.vertcat(*amplitudes.values()), ca.vertcat(*others)], [values])
    points = np.random.default_rng(0).uniform(0.1, 2.0, (len(others), 5))
    there, left = (np.abs(np.array(function(np.full(len(amplitudes), size), points))) for size in (1.0, 0.0))
    most = np.nanmax(left, axis=1, initial=0.0)
    wrong = np.flatnonzero(most > _ABSENT * np.maximum(1.0, np.nanmax(there, axis=1, initial=0.0)))
    if len(wrong):
        effect = terms[0].effect
        raise EffectError(
            f"the law of {effect.name} does not vanish at amplitude 0",
            seen=f"{float(most[wrong[0]]):.6g} at {effect.amplitude.name} = 0",
            allowed="0 for every state and channel",
            cure="write the law so that the amplitude switches it on",
        )


def _symbols(column: Any) -> Iterable[Any]:
    return ca.symvar(column) if column.numel() else ()
