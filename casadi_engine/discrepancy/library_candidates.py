"""The effects of a library at all ports of a model as candidates of the score test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca

from casadi_engine.discrepancy.candidate import Candidate, Side
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.effects import Effect, candidates
from casadi_engine.effects.candidate import Known
from casadi_engine.estimation.corner_widths import courses
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.term import NotApplicable, unit_at
from casadi_engine.simulation.candidate_sensitivities import Direction, slot_direction


def library_candidates(
    null: NullModel,
    data: Sequence[Experiment],
    effects: Sequence[Effect],
    skipped: list[NotApplicable] | None = None,
    known: Known | None = None,
    *,
    again: bool = False,
    at: str | None = None,
) -> list[Candidate]:
    """Every effect at every port that it can attach to, over its grids, linearised at the null parameters.

    An effect that sits at a time or in cycles is a candidate of one record each; any other acts in all records alike,
    with the constants that each record gives. Effects at several cylinders form a group.
    skipped, known, again, at : as in ``candidates``
    Raises EffectError for an effect that does not follow the protocol.
    """
    found: dict[tuple[Any, ...], Candidate] = {}
    known = {} if known is None else known
    free = frozenset(name.partition("@")[0] for name in null.parameters)
    # of all records together: a grid that followed each one's motion would make one effect several
    motion = partial(courses, [record.path for record in null.records])
    settled: dict[tuple[str, str], Effect] = {}
    for record, experiment in zip(null.records, data, strict=True):
        numbers = dict(zip(null.model.parameter_names, record.path.p.tolist(), strict=True))
        every = candidates(
            null.model,
            effects,
            experiment,
            parameters=numbers,
            courses=motion,
            skipped=skipped,
            known=known,
            free=free,
            again=again,
            at=at,
            settled=settled,
        )
        for number, made in enumerate(every):
            placed = any(grid.over in ("time", "cycle") for grid in made.effect.nuisance.values())
            several = len(null.records) > 1
            key = (record.name if placed and several else "", number if placed else made.label)
            if key in found:
                one = found[key]
                assert isinstance(one.direction, dict)
                alike = made is one.source
                one.direction[record.name] = (
                    next(iter(one.direction.values())) if alike else direction_of(made)
                )
                continue
            port = null.model.ports[made.at]
            found[key] = Candidate(
                effect=made.effect.name,
                port=made.at,
                direction={record.name: direction_of(made)},
                nuisance=dict(made.values),
                side=_side(made),
                unit=_unit(null.model, made),
                group=_group(made, port.kind, port.name),
                size=made.size,
                source=made,
            )
    return list(found.values())


def _side(made: Any) -> Side:
    """The sign that an amplitude may have; that of its own size for a law which has no slope at 0."""
    if made.is_flat:
        return 1 if made.size > 0 else -1
    side: Side = made.amplitude.one_sided
    return side


def direction_of(made: Any) -> Direction:
    """The direction of one candidate of an effect library."""
    found = slot_direction(made.model, made.slots, name=made.label, drives=made.drives, outputs=made.outputs)
    if made.beyond is not None:
        found = replace(found, ode=found.ode + made.beyond)
    if not made.states:
        return found
    return replace(
        found,
        states=ca.vertcat(*[state.symbol for state in made.states]),
        rates=ca.vertcat(*[state.rate for state in made.states]),
        start=tuple(float(state.start) for state in made.states),
    )


def _group(made: Any, kind: str, port: str) -> str | None:
    """Effects at single cylinders are tested together too, per choice of their nuisance values."""
    if kind != "cylinder" or port == "cylinders":
        return None
    values = ", ".join(f"{name} {value:.4g}" for name, value in made.values.items())
    return f"{made.effect.name} at all cylinders" + (f" ({values})" if values else "")


def _unit(model: Model, made: Any) -> str:
    """The unit of the amplitude, as its port has it; of the port's value where the effect leaves it open."""
    port, unit = model.ports[made.at], made.amplitude.unit
    return unit_at(model, port) if unit is None else port.in_its_unit(unit)
