"""Inputs that act late, exactly: their values are read off the record at earlier times.

The law of a delay holds at one instant and has but states to hold the past with: a rational function of s, which rings
where the input jumps, and is far off where an output shows the input at once. Where it is known how late an input acts,
its own earlier values are at hand: u(t - τ) by the line a + τ b from u(t - k h) to u(t - (k + 1) h), with τ between two
steps h of a grid. That is what acts of an input that goes along lines, at every point, and on average over each step of
one that is held. Where τ is no whole number of the record's steps, those of the grid are parts of them. So searches
find τ by the law, and end by the record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from casadi_engine.model.declarations import Ports

if TYPE_CHECKING:
    from casadi_engine.experiment import Experiment
    from casadi_engine.model.model import Model

# Steps by which a delay may lie outside the step of a record in which its input is read, and outside a finer one.
_NEAR, _NEAR_FINE = 0.05, 0.1
# Squared steps by which what acts over a step may be off in its second moment, as a jump within it is spread over all
# of it: a sixtieth of the most that it may be. At twice as much a rotor was off by 2.7 errors.
_SPREAD = 0.002
# Share of a step within which a lag is of whole ones.
_WHOLE = 1e-6
# What a lag of an input is known by beside those of outputs.
_LAG = "lag of input "


def late_inputs(model: Model) -> dict[str, str]:
    """Input -> the parameter that it acts late by, of the effects in a model."""
    return {
        one.at.partition("_")[2]: f"{one.key}.{one.effect.delays}"
        for one in model.effects
        if getattr(one.effect, "delays", "")
    }


def input_lags(
    model: Model, values: Mapping[str, float], records: Sequence[Experiment], *, begun: bool
) -> dict[str, float]:
    """Lags at which late inputs are read at these values of the delays.

    begun : only those that are read off the record already: the law of the delay shows the way from farther off
    """
    known, found = dict(model.late), dict[str, float]()
    for name, delay in late_inputs(model).items():
        if (begun and name not in known) or not np.isfinite(values.get(delay, np.nan)):
            continue
        steps = [step for step in (_step(model, record) for record in records) if step > 0]
        if steps:
            lag = known.get(name)
            stays = lag is not None and all(_holds(lag, h, values[delay]) for h in steps)
            found[f"{_LAG}{name}"] = lag if lag is not None and stays else float(values[delay])
    return found


def _holds(lag: float, step: float, delay: float) -> bool:
    """True where the line over the step of a grid that a lag lies in is that of a delay too."""
    parts = finer(lag, step)
    own, near = step / parts, _NEAR if parts == 1 else _NEAR_FINE
    return abs(delay - (between(lag, own) + 0.5) * own) <= (0.5 + near) * own


def between(lag: float, step: float) -> int:
    """Whole steps of a grid in a lag."""
    return int(np.floor(lag / step + _WHOLE))


def shortest_step(model: Model, records: Sequence[Experiment]) -> float:
    """The typical step [s] of the fastest channel of these records; 0 where there is none."""
    return min((step for step in (_step(model, record) for record in records) if step > 0), default=0.0)


def finer(lag: float, step: float) -> int:
    """By how much finer than its record a grid is on which a lag is of whole steps, as nearly as jumps need."""
    for parts in range(1, 100):
        rest = abs(lag / step * parts - round(lag / step * parts))
        if rest * (1 - rest) <= 2 * _SPREAD * parts**2:
            return parts
    return 1


def read_late(model: Model, lags: Mapping[str, float]) -> Model:
    """The model whose late inputs are read off the record at these lags; others stay as they are."""
    for name in late_inputs(model):
        if f"{_LAG}{name}" in lags:
            model = _read(model, name, lags[f"{_LAG}{name}"])
    return model


def as_they_act(model: Model) -> dict[str, tuple[str, Any]]:
    """Drive -> the parameter of its delay, and what acts that much later, in the channels; of inputs that are read off
    the record."""
    found, channels = {}, [one.name for one in model.inputs]
    drives = list(zip(model.drives, ca.vertsplit(model.drive_expressions), strict=True))
    for row, (name, _) in enumerate(model.late):
        at, slope = _parts(model, row)
        drive, value = next((one, own) for one, own in drives if ca.depends_on(own, at))
        here, _ = ca.substitute([value, slope], [at, slope], [model.u[channels.index(name)], ca.SX(0)])
        found[drive.name] = late_inputs(model)[name], ca.simplify(here)
    return found


def earlier(model: Model, symbol: Any, value: Any) -> list[tuple[Any, Any]]:
    """The entry of u that stands for a channel which acts late, with what a value made of the channel was that much
    earlier; none of another channel, nor of what has states, whose earlier values nobody has."""
    names = [one.name for one in model.inputs]
    row = next(
        (k for k, own in enumerate(model.late) if own[0] == symbol.name() and symbol.name() in names), None
    )
    if row is None or ca.depends_on(value, ca.vertcat(model.x, model.d, model.w)):
        return []
    at, slope = _parts(model, row)
    return [(at, ca.substitute(value, symbol, at + _delay(model, symbol.name()) * slope))]


def of_outputs(lags: Mapping[str, float]) -> dict[str, float]:
    """Those that are lags of outputs."""
    return {name: lag for name, lag in lags.items() if not name.startswith(_LAG)}


def reads(lags: Mapping[str, float]) -> bool:
    """True if an input is read late."""
    return any(name.startswith(_LAG) for name in lags)


def _step(model: Model, record: Experiment) -> float:
    """The typical step of the fastest of a record's channels that the model has."""
    names = [one.name for one in (*model.inputs, *model.outputs) if one.name in record]
    steps = [float(np.median(np.diff(record[name].time))) for name in names if len(record[name].time) > 1]
    return float(f"{min(steps, default=0.0):.10g}")


def _parts(model: Model, row: int) -> list[Any]:
    """Symbols of the line a + τ b that an input's values follow between two steps of the record."""
    found: list[Any] = ca.vertsplit(model.late_channels)[2 * row : 2 * row + 2]
    return found


def _read(model: Model, name: str, lag: float) -> Model:
    known = dict(model.late)
    if name not in known:
        return _without_law(model, name, lag)
    return model if known[name] == lag else replace(model, late=tuple((known | {name: lag}).items()))


def _without_law(model: Model, name: str, lag: float) -> Model:
    """The model in which the input's earlier values stand for the states of the law; itself where what the law delays
    is more than the input."""
    from casadi_engine.model.attach import replaced, with_drive
    from casadi_engine.model.lags import with_delays
    from casadi_engine.model.rates import with_rates

    (one,) = (e for e in model.effects if getattr(e.effect, "delays", "") and e.at == f"input_{name}")
    stem = f"{one.at}_{one.effect.name}_"
    states, drives = [s.name for s in model.states], [d.name for d in model.drives]
    parts = [f"{stem}{part}" for part in ("passes", "rate", "bend")]
    if f"d_{parts[2]}" not in drives or not set(parts) <= set(states):
        return model
    symbol = model.u[[v.name for v in model.inputs].index(name)]
    entered = drives.index(f"d_{parts[2]}")
    # what moves the third state is 60 times what is late, over the delay
    passed = ca.substitute(model.drive_expressions[entered], _delay(model, name), 1.0) / 60
    own = {symbol.element_hash(), *(s.element_hash() for s in ca.symvar(model.p))}
    if not {s.element_hash() for s in ca.symvar(passed)} <= own:
        return model
    late = [ca.SX.sym(f"{name}_late_{part}") for part in ("at", "slope")]
    acts = ca.substitute(passed, symbol, late[0] + _delay(model, name) * late[1])
    called, taken = f"{name}_late", {*drives, *states, *(v.name for v in (*model.inputs, *model.outputs))}
    while called in taken | {*model.parameter_names}:
        called += "_"
    drive = ca.SX.sym(called)
    unit = model.inputs[[v.name for v in model.inputs].index(name)].unit
    wider = replace(model, u=ca.vertcat(model.u, *late), late=(*model.late, (name, lag)))
    wider = with_drive(wider, drive, acts, f"{name} as it acts, late", unit)
    for part, value in zip(parts, (drive, ca.SX(0), ca.SX(0)), strict=True):
        wider = replaced(wider, wider.x[states.index(part)], value)
    # what sensors show by now has other rates
    return with_rates(with_delays(_without(wider, states=parts, drive=f"d_{parts[2]}")))


def _without(model: Model, *, states: Sequence[str], drive: str) -> Model:
    """The model without states and a drive that nothing depends on."""
    keep = [k for k, one in enumerate(model.states) if one.name not in states]
    left = [k for k, one in enumerate(model.drives) if one.name != drive]
    return replace(
        model,
        states=tuple(model.states[k] for k in keep),
        x=model.x[keep],
        ode=model.ode[keep],
        drives=tuple(model.drives[k] for k in left),
        d=model.d[left],
        drive_expressions=model.drive_expressions[left],
        ports=Ports(model.ports),
    )


def _delay(model: Model, name: str) -> Any:
    return model.p[model.parameter_names.index(late_inputs(model)[name])]
