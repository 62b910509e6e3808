"""Functions where no effect of the library acts: a parameter that is not constant, a sensor that drifts, and what acts
at a port by the signals of others.

There are many of them, most of them absurd, so that they are asked only where something is known to be missing, share
half of the prior, and are looked at by two terms first.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.evidence import Levels
from casadi_engine.discrepancy.linear_algebra import Array, basis, triangle, without
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.random_families import (
    TIME,
    Family,
    Signal,
    along,
    families_of,
    family_candidates,
    family_columns,
    smooth_family,
    term_candidate,
)
from casadi_engine.effects.candidate import responses
from casadi_engine.model import Model, Port
from casadi_engine.simulation.candidate_sensitivities import slot_direction

# Terms of a function at a look, and of one that is held against others; how many are.
_LOOK, _TERMS, _KEPT = 3, 6, 8
# Chi-squared below which a function does no more than its constant: chance makes as much of its other terms in one
# of 20.
_CONSTANT = 6.0
# What the name of a difference between two ports, and of what a port shows of several states and inputs, begins with.
DROP, SHOWN = "difference_at_", "shown_at_"
# Numbers that are one but for rounding.
_ALIKE = 1e-9
# Numbers of the terms of functions that are looked at together.
_AT_ONCE = 10_000_000


def elsewhere(null: NullModel, levels: Levels) -> tuple[list[Candidate], list[Family], int]:
    """The terms of the functions that serve best at a look, these functions, and among how many they were chosen."""
    places = [(port, signal) for port, signal in _places(null) if _varies(signal.values)]
    if not places:
        return [], [], 0
    at_once = max(_AT_ONCE // (_LOOK * null.count), 1)
    looks = [_drops(null, levels, places[k : k + at_once]) for k in range(0, len(places), at_once)]
    drops, beyond = (np.concatenate(own) for own in zip(*looks, strict=True))
    order = np.argsort(-drops)
    # what a constant does all of it does, by whatever signal: one of these says as much as all
    plain = [k for k in order if beyond[k] < _CONSTANT][1:]
    best = [k for k in order if k not in plain][:_KEPT]
    return *_terms(null, [places[k] for k in best], _TERMS), len(places)


def functions_of(null: NullModel, port: str, signal: str) -> tuple[list[Candidate], list[Family]]:
    """The terms of the functions of one signal at a port, wherever that is known, and these functions."""
    candidates, families = family_candidates(null, ports=[port])
    own = [family for family in families if family.signal == signal]
    if own:
        return candidates, own
    return _terms(
        null, [(at, one) for at, one in _places(null) if (at.name, one.name) == (port, signal)], _TERMS
    )


def _places(null: NullModel) -> list[tuple[Port, Signal]]:
    """Where a function may act, and what it may depend on: all states and inputs, and time at a parameter, the
    difference across it and what ports show of several states, at a sensor time, the other outputs and the inputs that
    no equation uses, and at the other inputs these."""
    model = null.model
    # a state of an effect that may be withdrawn is none that a law is told by
    lent = tuple(f"{one.at}_{one.effect.name}_" for one in model.effects)
    every = [(s.name, model.x[k]) for k, s in enumerate(model.states) if not s.name.startswith(lent or "\0")]
    every += [(u.name, model.u[k]) for k, u in enumerate(model.inputs)]
    made: dict[str, Signal] = {
        name: Signal(name, symbol, along(null, symbol)) for name, symbol in [*every, (TIME, model.t)]
    }
    unused = model.idle_inputs
    found = []
    for port in model.ports:
        if _may_change(model, port) and _acts(model, port):
            at_ports = _said_at_ports(model, port, every)
            found += [(port, signal) for name, signal in made.items() if name not in at_ports]
            more = drops_of(model, port) | {
                n: s for n, s in shown_at_ports(model).items() if n not in at_ports
            }
            found += [(port, Signal(name, one, along(null, one))) for name, one in more.items()]
        elif port.kind == "sensor":
            found += [(port, made[name]) for name in (TIME, *unused)]
            felt = felt_by(model, port)
            found += [(port, Signal(name, one, along(null, one))) for name, one in felt.items()]
        elif port.kind == "input" and port.name.removeprefix("input_") not in unused:
            found += [(port, made[name]) for name in unused]
        elif port.slot is not None:
            own = list(port.signals.values())
            moving = ca.vertcat(model.x, model.u)
            found += [(port, made[name]) for name, symbol in every if not _is_own(symbol, own, moving)]
    return found


def felt_by(model: Model, sensor: Port) -> dict[str, ca.SX]:
    """The other outputs, of which what a sensor shows may be a function too."""
    outputs = {one.name for one in model.outputs}
    crosses = (one for one in model.ports.crosses if one.ends == (sensor.name,))
    named = ((one.name.removesuffix(f"_to_{sensor.name}"), one.signals["input"]) for one in crosses)
    return {name: signal for name, signal in named if name in outputs}


def drops_of(model: Model, port: Port) -> dict[str, ca.SX]:
    """Differences between two states that a parameter's term is made of, beside an input or another state: the opening
    of a gate times the drop across it. Without these a law between both does what any function of the drop does."""
    moved = _rates(model, port, ca.SX(ca.vertcat(1, 0)))
    if moved is None:
        return {}
    moving = ca.vertcat(model.x, model.u, model.t)
    here = _names(ca.vertcat(moved, ca.SX(0)), moving)
    found = {}
    for link in model.ports.links:
        drop = link.signals["difference"]
        own = _names(drop, moving)
        if len(own) > 1 and own < here:
            found[f"{DROP}{link.name}"] = drop
    return found


def shown_at_ports(model: Model) -> dict[str, ca.SX]:
    """What a port shows first, where that is made of several states and inputs: a temperature above that of the room,
    of which a parameter may be a function as well as of the state alone."""
    moving, found = ca.vertcat(model.x, model.u), dict[str, tuple[str, ca.SX]]()
    for port in model.ports.with_slot:
        signal = next(iter(port.signals.values()), None)
        if signal is not None and len(_names(signal, moving)) > 1 and not ca.depends_on(signal, model.t):
            found.setdefault(str(signal), (f"{SHOWN}{port.name}", signal))
    return dict(found.values())


def _names(expression: ca.SX, moving: ca.SX) -> set[str]:
    """Of the moving symbols that an expression has."""
    return {symbol.name() for symbol in ca.symvar(moving) if ca.depends_on(expression, symbol)}


def unused_everywhere(model: Model, free: Collection[str]) -> list[Family]:
    """Functions of the inputs that act on nothing, at every port at which something may act and in the place of every
    free parameter that the equations have: who records an input expects that it matters."""
    blank = np.array([0.0, 1.0])
    may = [one.name for one in model.ports if one.slot is not None]
    may += [p.name for p in model.ports if p.kind == "parameter" and p.parameter in free and _acts(model, p)]
    return [smooth_family(port, name, blank) for name in model.idle_inputs for port in may]


def _said_at_ports(model: Model, parameter: Port, every: Sequence[tuple[str, ca.SX]]) -> set[str]:
    """The signals of which a parameter may be any function and do no more than a function of them at a port does, as a
    damping that depends on the speed."""
    one = ca.SX(ca.vertcat(1, 0))
    moved = _rates(model, parameter, one)
    known = ca.vertcat(*[symbol for _, symbol in every])
    rng, found, shown = np.random.default_rng(0), set[str](), shown_at_ports(model)
    for port in model.ports.with_slot:
        acts = _rates(model, port, one)
        if moved is None or acts is None:
            continue
        size = ca.sumsqr(acts)
        ratio = ca.dot(acts, moved) / size
        rest = ca.sumsqr(moved - ratio * acts)
        own = ca.vertcat(*port.signals.values())
        symbols = ca.symvar(ca.vertcat(ratio, rest, moved, known, own))
        turned = [ca.jacobian(ratio, known), ca.jacobian(own, known)]
        look = ca.Function("look", [ca.vertcat(*symbols)], [rest, ca.sumsqr(moved), *turned])
        left, whole, slope, turn = (np.array(each) for each in look(rng.uniform(0.5, 1.5, len(symbols))))
        if not left[0, 0] <= _ALIKE * whole[0, 0]:
            continue
        rows = np.vstack([slope, turn[:1]])
        rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
        if np.linalg.matrix_rank(rows, tol=_ALIKE) <= 1:  # a function of that alone
            found |= {name for name, signal in shown.items() if ca.is_equal(signal, own[0], 2)}
        needs = {name for (name, _), s in zip(every, slope.ravel(), strict=True) if abs(s) > _ALIKE}
        told = {name for name, symbol in every if _is_known(symbol, list(port.signals.values()))}
        if len(needs) <= 1:
            found |= (needs or told) & told
    return found


def same_parameters(model: Model, port: Port) -> tuple[str, ...]:
    """Other parameters that do in the equations what one does, but for a factor that does not move: of a/A alone no
    data tell which of both changes."""
    one = ca.SX(ca.vertcat(1, 0))
    moved = _rates(model, port, one)
    if moved is None:
        return ()
    moving = ca.vertcat(model.x, model.u, model.t)
    rng, found = np.random.default_rng(0), []
    for other in model.ports:
        if other.name == port.name or not _may_change(model, other):
            continue
        acts = _rates(model, other, one)
        if acts is None or acts.nnz() == 0:
            continue
        ratio = ca.dot(acts, moved) / ca.sumsqr(acts)
        rest = ca.sumsqr(moved - ratio * acts)
        symbols = ca.symvar(ca.vertcat(ratio, rest, moved, moving))
        look = ca.Function(
            "look", [ca.vertcat(*symbols)], [rest, ca.sumsqr(moved), ratio, ca.jacobian(ratio, moving)]
        )
        left, whole, factor, slope = (
            np.array(each).ravel() for each in look(rng.uniform(0.5, 1.5, len(symbols)))
        )
        if left[0] <= _ALIKE * whole[0] and np.abs(slope).max() <= _ALIKE * abs(factor[0]):
            found.append(other.parameter)
    return tuple(found)


def _rates(model: Model, port: Port, value: ca.SX) -> ca.SX | None:
    """What a value at a port adds to the rates of the states; None where it adds to an output too."""
    slots, drives, outputs, beyond = responses(model, port, value)
    made = slot_direction(model, slots, name="", drives=drives, outputs=outputs)
    if ca.sparsify(made.output).nnz():
        return None
    ode = made.ode if beyond is None else made.ode + beyond
    return ca.substitute(ca.substitute(ode, model.w, model.laws), model.d, model.drive_expressions)


def _may_change(model: Model, port: Port) -> bool:
    """True for a parameter of the model's own that is no constant of physics."""
    if port.kind != "parameter" or "." in port.parameter:
        return False
    return not any(one.name == port.parameter and one.is_constant_of_nature for one in model.declarations)


def _acts(model: Model, port: Port) -> bool:
    """True for a parameter that the equations have."""
    symbol = model.p[model.parameter_names.index(port.parameter)]
    parts = (model.ode, model.laws, model.drive_expressions, model.output_expressions)
    return any(ca.depends_on(ca.vertcat(part, ca.SX(0)), symbol) for part in parts)


def _is_known(symbol: ca.SX, own: Sequence[ca.SX]) -> bool:
    """True where a port's own signals say what a symbol does: one of them is made of it."""
    return any(ca.depends_on(signal, symbol) for signal in own)


def _is_own(symbol: ca.SX, own: Sequence[ca.SX], moving: ca.SX) -> bool:
    """True where one of a port's own signals is made of a symbol alone: of a difference a function of one of both is
    none."""
    return any(_names(signal, moving) == {symbol.name()} for signal in own)


def _varies(values: Array) -> bool:
    return bool(np.ptp(values) > 1e-9 * max(float(np.abs(values).max()), 1e-300))


def _terms(
    null: NullModel, places: Sequence[tuple[Port, Signal]], terms: int
) -> tuple[list[Candidate], list[Family]]:
    """The terms of functions as candidates, and the functions."""
    candidates: list[Candidate] = []
    families: list[Family] = []
    for port, signal in places:
        for terms_of, family in families_of(port.name, signal, terms):
            members = tuple(range(len(candidates), len(candidates) + len(terms_of)))
            families.append(replace(family, members=members))
            candidates += [term_candidate(null.model, port, signal, k, one) for k, one in enumerate(terms_of)]
    return candidates, families


def _drops(null: NullModel, levels: Levels, places: Sequence[tuple[Port, Signal]]) -> tuple[Array, Array]:
    """What each function takes off chi-squared at most, beside all parameters and first states; and what of it is
    beyond that of its constant."""
    candidates, families = _terms(null, places, _LOOK)
    columns = family_columns(null, candidates)
    n, kept = null.turn.shape[1], []
    for record in null.records:
        rows = np.concatenate(
            [
                np.column_stack([record.slopes[output], columns[record.name][output], e])
                * levels.weight(output)
                for output, e in record.residual.items()
            ]
        )
        starts = rows.shape[1] - n - len(candidates) - 1
        free = without(basis(rows[:, n : n + starts]), np.delete(rows, np.s_[n : n + starts], axis=1))
        kept.append(triangle(free))
    whole = np.concatenate(kept)
    left = without(basis(whole[:, :n]), whole[:, n:])
    e = left[:, -1]
    own = [left[:, list(f.members)] for f in families]
    drops, constants = (
        np.array([float(((basis(one).T @ e) ** 2).sum()) for one in terms])
        for terms in (own, [one[:, : not (f.cycle or f.order)] for one, f in zip(own, families, strict=True)])
    )
    return drops, drops - constants
