"""Events with a time of their own in every record: one amplitude for all, where and when each record says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from casadi_engine.effects.protocol import Attachment, Grid
from casadi_engine.errors import EffectError
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.experiment import given_records
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters, near_matches

Starts = Mapping[str, Mapping[str, float]]


def by_record(
    model: Model,
    data: Experiment | Sequence[Experiment],
    parameters: Parameters | None = None,
    *,
    starts: Starts | None = None,
) -> Parameters:
    """Return a set for a model with events, in which every event has its own time in each record.

    parameters : the set to start from (default: the model's); it is copied
    starts : name of a time or cycle of an effect (``load.load_step.time``) -> name of the record -> its start, for a
        cycle its number; a time that is left out starts in the middle of its record
    Times are estimated, as ``load.load_step.time@record`` where there are several records, between the ends of their
    record; cycles are numbers that are given for every record and stay. All other parameters of the effects, their
    amplitudes among them, are shared by the records.
    EffectError for a name in `starts` that is no time or cycle of an effect of the model, for a record that there is
    not, for a start outside its record and for a cycle that a record is not given.

    >>> import numpy as np
    >>> from casadi_engine import Experiment, effects, one_inertia
    >>> time = np.arange(0, 2, 0.01)
    >>> runs = [Experiment.from_arrays(name, time=time, units={"T": "N m"}, T=0 * time) for name in ("a", "b")]
    >>> model = one_inertia().with_effect(effects.LoadStep(), at="engine")
    >>> pars = effects.by_record(model, runs, starts={"engine.load_step.time": {"a": 0.4}})
    >>> [pars["engine.load_step.time"].in_record(name) for name in ("a", "b")]
    [(0.4, 0.0, 1.99), (0.995, 0.0, 1.99)]
    """
    records = given_records(data)
    found = (model.parameters() if parameters is None else parameters).extended(model)
    starts = {} if starts is None else starts
    placed = {f"{one.key}.{name}": grid for one in model.effects for name, grid in _placed(one).items()}
    for name, own in starts.items():
        _check(name, "is no time or cycle of an effect of the model", placed)
        for record in own:
            _check(record, "is no record of these data", [one.name for one in records])
    for name, grid in placed.items():
        own = starts.get(name, {})
        values = {record.name: _place(name, grid, record, own.get(record.name)) for record in records}
        if grid.over == "cycle":
            found.fix(name)
        if len(records) > 1:
            found.vary_by_experiment(name, values=values)
            continue
        value, low, high = next(iter(values.values()))
        found[name].set(value, min=low, max=high)
    return found


def _placed(one: Attachment) -> dict[str, Grid]:
    """The nuisance parameters that place an event in a record."""
    return {
        name: grid
        for name, grid in one.effect.nuisance.items()
        if grid.over in ("time", "cycle") and not grid.whole
    }


def _place(name: str, grid: Grid, record: Experiment, start: Any) -> tuple[float, float, float]:
    """Start and bounds of a time or cycle in a record."""
    if grid.over == "cycle":
        if start is None or start != int(start):
            raise EffectError(
                f"{name} needs a cycle of the record {record.name}",
                seen=f"{start!r}",
                allowed="a whole number",
                cure=f'give starts={{"{name}": {{"{record.name}": 1}}}}, for instance',
            )
        return float(start), -float("inf"), float("inf")
    low, high = record.span
    value = 0.5 * (low + high) if start is None else float(start)
    if not low <= value <= high:
        raise EffectError(
            f"the start of {name} is outside the record {record.name}",
            seen=f"{value:.6g} s",
            allowed=f"{low:.6g} to {high:.6g} s",
            cure="give a time of the record, or leave it out for its middle",
        )
    return value, low, high


def _check(name: str, problem: str, known: Any) -> None:
    if name not in known:
        raise EffectError(
            f"a start is given for {name}, which {problem}",
            seen=repr(name),
            allowed=near_matches(name, known),
            cure="leave it out, or correct the name",
        )
