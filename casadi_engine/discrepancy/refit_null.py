"""A refit as the tests see it: residuals and their slopes where it ended, of all samples that were measured."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np

from casadi_engine.discrepancy.late_samples import completed, with_all_samples
from casadi_engine.discrepancy.null_model import (
    NullModel,
    RecordNull,
    cycle_numbers,
    free_directions,
    own_states,
    prior_rows,
    unit_of,
)
from casadi_engine.estimation.refit_entry import Refit, RefitProblem
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters


def null_of_refit(
    model: Model, parameters: Parameters, problem: RefitProblem, found: Refit, levels: Mapping[str, float]
) -> NullModel:
    """The null model where a refit ended: its residuals and slopes, without another simulation."""
    pmap = problem.pmap
    z = np.array([found.values[name] for name in pmap.free])
    turn = free_directions(model, pmap, z, ())
    scale = np.array([state.scale for state in model.states])
    records = []
    nodes = found.nodes or (np.zeros((0, len(scale))),) * len(problem.records)
    for term, at in zip(problem.records, nodes, strict=True):
        grid, own = term.grid, found.records[term.experiment.name]
        residual, slopes = {}, {}
        for output, e in own.residual.items():
            both, seen = own.jacobian[output] * levels[output], grid.measured[output]
            both = np.concatenate([both[:, : len(z)] @ turn, both[:, len(z) :] * scale], axis=1)
            residual[output] = completed(seen, -e * levels[output], mirror=True)
            slopes[output] = completed(seen, both, mirror=False)
        grid = with_all_samples(grid, term.experiment)
        measured = grid.measured
        records.append(
            RecordNull(
                name=term.experiment.name,
                path=SimpleNamespace(grid=grid),  # type: ignore[arg-type]
                residual=residual,
                time={name: measured[name].time for name in residual},
                index={name: measured[name].index for name in residual},
                length={name: len(term.experiment[name].time) for name in residual},
                cycle={name: cycle_numbers(model, grid, measured[name].time) for name in residual},
                slopes=slopes,
                starts=tuple(state.name for state in model.states),
                begins=own_states(model, at * scale),
            )
        )
    units = tuple(unit_of(parameters, name) for name in pmap.free)
    return NullModel(model, pmap.free, units, z, turn, prior_rows(pmap, z, turn), tuple(records))


def cost_beyond(problem: RefitProblem, found: Refit) -> float:
    """Chi-squared of what late sensors show of the time before the records."""
    cost = 0.0
    for term in problem.records:
        for output, e in found.records[term.experiment.name].residual.items():
            seen = term.grid.measured[output]
            if len(seen.beyond):
                cost += float((completed(seen, e, mirror=True) ** 2).sum() - (e**2).sum())
    return cost
