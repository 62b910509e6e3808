"""Candidates that were made for one model, for another one that has other effects, or the same in another order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import casadi as ca

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.model import Model
from casadi_engine.simulation.candidate_sensitivities import Direction


def at_home(candidates: Sequence[Candidate], model: Model) -> list[Candidate]:
    """The candidates in the symbols of a model: those of the same name are the same, and what it does not have, the
    laws of effects that it lacks, is nothing."""
    found, turned = [], dict[int, Direction]()
    for one in candidates:
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
