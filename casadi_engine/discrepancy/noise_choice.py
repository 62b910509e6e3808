"""Which noise the score tests count with: known or estimated levels, colour where the residual asks for it, and the
scatter of combustions whose pressure was assumed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from casadi_engine.discrepancy.assumed_pressure import carried_cylinders
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.combustion_scatter import Scatter, assumed_cylinders, combustion_scatter
from casadi_engine.discrepancy.compression import compress, scatter_columns
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.noise_model import NoiseModel, estimated_noise, left_over
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.score import score
from casadi_engine.experiment import Experiment
from casadi_engine.validation import whiteness

Columns = Mapping[str, Mapping[str, Array]]
ColourChoice = Literal["auto"] | bool

# Columns of the library that may explain part of the residual while the noise is estimated.
_MOST, _SHARE, _ALIKE = 60, 0.05, 0.9
# A residual is coloured, or a known level wrong, if chance would do as much less often than this.
_SURE = 1e-4


@dataclass(frozen=True, eq=False)
class NoiseChoice:
    """The noise model, its random amplitudes by record, the cylinders that were asked for ("assumed", or names), and
    what the user should know."""

    noise: NoiseModel
    scatter: tuple[Scatter, ...] = ()
    cylinders: Any = "assumed"
    messages: tuple[str, ...] = ()


def scatter_of(
    null: NullModel, data: Sequence[Experiment], cylinders: Any = "assumed"
) -> tuple[Scatter, ...]:
    """Random amplitudes of combustions: of the cylinders given, or with "assumed" of those whose pressure is not
    measured in a record; not of those that the model carries as parameters."""
    found = []
    for record, experiment in zip(null.records, data, strict=True):
        names = assumed_cylinders(experiment) if cylinders == "assumed" else tuple(cylinders or ())
        known = carried_cylinders(null.model)
        names = tuple(name for name in names if name in null.model.ports.names and name not in known)
        if names:
            made = combustion_scatter(null.model, record, cylinders=names)
            if made.directions:
                found.append(made)
    return tuple(found)


def choose_noise(
    null: NullModel,
    candidates: Sequence[Candidate],
    columns: Columns,
    levels: Mapping[str, tuple[float, bool]],
    *,
    cylinders: Any = "assumed",
    data: Sequence[Experiment],
    colour: ColourChoice = "auto",
) -> NoiseChoice:
    """The noise of a null model's residuals.

    levels : output -> (sigma, estimated); a known one is held unless the residual that all candidates together leave is
    larger than chance allows. colour : True, False, or "auto" for where that residual is not white
    """
    scatter = scatter_of(null, data, cylinders)
    rough = NoiseModel({name: sigma for name, (sigma, _) in levels.items()})
    explained = _explained(null, candidates, columns, rough)
    random = {r.name: scatter_columns(r, scatter) for r in null.records} if scatter else None
    known = {name: sigma for name, (sigma, estimated) in levels.items() if not estimated}
    noise = estimated_noise(null, explained=explained, scatter=random)
    messages = []
    for name, sigma in known.items():
        freedom = sum(len(r.residual[name]) for r in null.records if name in r.residual)
        if stats.chi2.sf(freedom * (noise.sigma[name] / sigma) ** 2, freedom) < _SURE:
            messages.append(
                f"the noise of {name} is larger than stated: {noise.sigma[name]:.4g} is left when the whole library "
                f"may explain the residual, {sigma:.4g} was given; the larger one counts"
            )
            del known[name]
            break
    coloured = _coloured(null, noise, explained, random) if colour == "auto" else bool(colour)
    if coloured:
        noise = estimated_noise(null, explained=explained, scatter=random, colour=True)
        messages.append("the residual is coloured: the score tests count with an autoregression of the noise")
    elif len(known) == len(levels) and not messages:
        noise = (
            estimated_noise(null, explained=explained, scatter=random, sigma=known)
            if random
            else NoiseModel(known, source="known")
        )
    elif known and not random:
        noise = NoiseModel({**noise.sigma, **known}, {}, {}, "estimated")
    return NoiseChoice(noise, scatter, cylinders, tuple(messages))


def _explained(
    null: NullModel, candidates: Sequence[Candidate], columns: Columns, rough: NoiseModel
) -> dict[str, dict[str, Array]]:
    """Null slopes and the strongest candidates that are not alike: record -> output -> (N, k)."""
    chosen: list[int] = []
    if candidates:
        scores = score(compress(null, candidates, rough, columns=columns))
        most = min(_MOST, int(_SHARE * null.count))
        for k in sorted(np.flatnonzero(scores.testable), key=lambda k: -scores.statistic[k]):
            if len(chosen) >= most:
                break
            if not chosen or np.abs(scores.correlation[k, chosen]).max() < _ALIKE:
                chosen.append(int(k))
    return {
        record.name: {
            output: np.concatenate([record.slopes[output], columns[record.name][output][:, chosen]], axis=1)
            for output in record.outputs
        }
        for record in null.records
    }


def _coloured(null: NullModel, noise: NoiseModel, explained: Columns, random: Columns | None) -> bool:
    """True if the residual that the columns and the scatter leave is not white, in any output of any record."""
    left = left_over(null, noise, explained, random)
    tests = 0
    smallest = 1.0
    for record in null.records:
        for output in record.outputs:
            held = explained[record.name][output]
            if random is not None:
                held = np.concatenate([held, random[record.name][output]], axis=1)
            p = white_p(record, output, left[record.name][output], held)
            if p is not None:
                tests, smallest = tests + 1, min(smallest, p)
    return bool(smallest * tests < _SURE)


def white_p(record: Any, output: str, residual: Array, jacobian: Array | None) -> float | None:
    """The p-value of the whiteness test of a residual (N,) at the valid samples of a channel; None if there is none."""
    length, index = record.length[output], record.index[output]
    full, valid = np.zeros(length), np.zeros(length, dtype=bool)
    full[index], valid[index] = residual, True
    slopes = None
    if jacobian is not None:
        slopes = np.zeros((length, jacobian.shape[1]))
        slopes[index] = jacobian
    return whiteness(full, mask=valid, jacobian=slopes).p_value
