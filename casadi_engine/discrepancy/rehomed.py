"""Candidates that were made for one model, for another one that has other effects, or the same in another order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import casadi as ca

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.library_candidates import direction_of
from casadi_engine.model import Model
from casadi_engine.simulation.candidate_sensitivities import Direction


def at_home(candidates: Sequence[Candidate], model: Model) -> list[Candidate]:
    """The candidates in the symbols of a model: those of the same name are the same, and what it does not have, the
    laws of effects that it lacks, is nothing."""
    found, turned = [], dict[int, Direction]()
    for one in (_in_states_of(model, one) for one in candidates):
        own = None if one.source is None else _foreign(one.source.model, model)
        if own is None:
            found.append(one)
            continue
        direction = one.direction
        if isinstance(direction, Mapping):
            moved = {name: _turned(part, own, turned) for name, part in direction.items()}
            found.append(replace(one, direction=moved))
        else:
            found.append(replace(one, direction=_turned(direction, own, turned)))
    return found


def _in_states_of(model: Model, one: Candidate) -> Candidate:
    """A candidate with a row for each state of a model, by their names: effects may have states of their own, such as
    what a sensor is behind by, and what pushes the others pushes these too."""
    made = None if one.source is None else one.source.model
    if made is None or [s.name for s in made.states] == [s.name for s in model.states]:
        return one
    if isinstance(one.direction, Mapping):  # read off each record: an own state is pushed by none of it
        moved = {
            name: replace(part, ode=_states(part.ode, made, model)) for name, part in one.direction.items()
        }
        return replace(one, direction=moved)
    source = one.source
    slots = [[port.name for port in own.ports.with_slot] for own in (made, model)]
    drives = [[drive.name for drive in own.drives] for own in (made, model)]
    wider = replace(
        source,
        model=model,
        slots=_by_name(source.slots, *slots),
        drives=_by_name(source.drives, *drives),
        beyond=None if source.beyond is None else _states(source.beyond, made, model),
    )
    return replace(one, direction=direction_of(wider))


def _states(column: ca.SX, made: Model, model: Model) -> ca.SX:
    return _by_name(column, [s.name for s in made.states], [s.name for s in model.states])


def _by_name(column: ca.SX, before: Sequence[str], now: Sequence[str]) -> ca.SX:
    """The rows (n, 1) of other names, zero for those that there were not."""
    known = dict(zip(before, ca.vertsplit(ca.densify(column)) if column.numel() else (), strict=True))
    return ca.vertcat(ca.SX(0, 1), *[known.get(name, ca.SX(0)) for name in now])


def _turned(direction: Direction, own: tuple[ca.SX, ca.SX], known: dict[int, Direction]) -> Direction:
    """A direction with these symbols put in."""
    if id(direction) not in known:
        parts = ca.substitute([direction.ode, direction.output, direction.rates], [own[0]], [own[1]])
        known[id(direction)] = replace(direction, ode=parts[0], output=parts[1], rates=parts[2])
    return known[id(direction)]


@lru_cache(maxsize=256)
def _foreign(made: Model, model: Model) -> tuple[ca.SX, ca.SX] | None:
    """Symbols of a model that another one does not have, and what stands for them there; None where it has all."""
    if made is model:
        return None
    here = {one.element_hash(): one for one in _symbols(model)}
    named = {one.name(): one for one in here.values()}
    foreign = [one for one in _symbols(made) if one.element_hash() not in here]
    if not foreign:
        return None
    return ca.vertcat(*foreign), ca.vertcat(*[named.get(one.name(), ca.SX(0)) for one in foreign])


def _symbols(model: Model) -> list[ca.SX]:
    every = ca.veccat(model.x, model.u, model.d, model.w, model.t, model.p)
    return [one for one in ca.vertsplit(every) if one.is_symbolic()] if every.numel() else []
