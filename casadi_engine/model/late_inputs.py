"""Inputs that act late, exactly: their values are read off the record at earlier times.

The law of a delay holds at one instant and has but states to hold the past with: a rational function of s, which rings
where the input jumps, and is far off where an output shows the input at once. Where it is known how late an input acts,
its own earlier values are at hand: u(t - τ) by the line from u(t - lag) to u(t - lag - h), or back to u(t - lag + h),
with a lag of whole steps h next to τ. That is what acts of an input that goes along lines, at every sample, and on
average over each step of one that is held. So searches find τ by the law, and end by the record.
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

# Steps by which a delay may be off the lag at which an input is read.
_NEAR = 0.6
# What a lag of an input, and its step, are known by beside those of outputs.
_LAG, _STEP = "lag of input ", "step of input "


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
    """Lags, and their steps, at which late inputs are read at these values of the delays.

    begun : only those that are read off the record already: the law of the delay shows the way from farther off
    """
    known, found = {name: (lag, step) for name, lag, step in model.late}, dict[str, float]()
    for name, delay in late_inputs(model).items():
        if (begun and name not in known) or not np.isfinite(values.get(delay, np.nan)):
            continue
        step = max((_step(model, record) for record in records), default=0.0)
        if not step > 0:
            continue
        lag, before = known.get(name, (np.inf, step))
        off = abs(values[delay] - lag) / step
        if abs(before - step) > 1e-6 * step or off > _NEAR:
            lag = max(float(np.rint(values[delay] / step)), 1.0) * step
        found |= {f"{_LAG}{name}": lag, f"{_STEP}{name}": step}
    return found


def read_late(model: Model, lags: Mapping[str, float]) -> Model:
    """The model whose late inputs are read off the record at these lags; others stay as they are."""
    for name in late_inputs(model):
        if f"{_LAG}{name}" in lags:
            model = _read(model, name, lags[f"{_LAG}{name}"], lags[f"{_STEP}{name}"])
    return model


def as_they_act(model: Model) -> dict[str, tuple[str, Any]]:
    """Drive -> the parameter of its delay, and what acts that much later, in the channels; of inputs that are read off
    the record."""
    found, names = {}, [one.name for one in model.drives]
    channels = [one.name for one in model.inputs]
    for row, (name, lag, _) in enumerate(model.late):
        value = ca.substitute(model.drive_expressions[names.index(_drive(name))], _delay(model, name), lag)
        here = ca.substitute(value, model.late_channels[3 * row + 1], model.u[channels.index(name)])
        found[_drive(name)] = late_inputs(model)[name], ca.simplify(here)
    return found


def earlier(model: Model, symbol: Any, value: Any) -> list[tuple[Any, Any]]:
    """Earlier values of a channel that acts late, each with what a value made of the channel is of it; none of another
    channel, nor of what has states, whose earlier values nobody has."""
    names = [one.name for one in model.inputs]
    row = next(
        (k for k, own in enumerate(model.late) if own[0] == symbol.name() and symbol.name() in names), None
    )
    if row is None or ca.depends_on(value, ca.vertcat(model.x, model.d, model.w)):
        return []
    parts = ca.vertsplit(model.late_channels)[3 * row : 3 * row + 3]
    return [(part, ca.substitute(value, symbol, part)) for part in parts]


def of_outputs(lags: Mapping[str, float]) -> dict[str, float]:
    """Those that are lags of outputs."""
    return {name: lag for name, lag in lags.items() if not name.startswith((_LAG, _STEP))}


def reads(lags: Mapping[str, float]) -> bool:
    """True if an input is read late."""
    return any(name.startswith(_LAG) for name in lags)


def _step(model: Model, record: Experiment) -> float:
    """The typical step of the fastest of a record's channels that the model has."""
    names = [one.name for one in (*model.inputs, *model.outputs) if one.name in record]
    steps = [float(np.median(np.diff(record[name].time))) for name in names if len(record[name].time) > 1]
    return float(f"{min(steps, default=0.0):.10g}")


def _read(model: Model, name: str, lag: float, step: float) -> Model:
    known = [one[0] for one in model.late]
    if name not in known:
        return _without_law(model, name, lag, step)
    row = known.index(name)
    _, before, own = model.late[row]
    if (before, own) == (lag, step):
        return model
    # the same weights of the three values, at the same share of a step off the new lag
    delay = _delay(model, name)
    at = [one.name for one in model.drives].index(_drive(name))
    drives = ca.SX(model.drive_expressions)
    moved = delay - (lag - before) if own == step else (delay - lag) * (own / step) + before
    drives[at] = ca.substitute(drives[at], delay, moved)
    late = tuple((name, lag, step) if k == row else one for k, one in enumerate(model.late))
    return replace(model, drive_expressions=drives, late=late)


def _without_law(model: Model, name: str, lag: float, step: float) -> Model:
    """The model in which the input's earlier values stand for the states of the law; itself where what the law delays
    is more than the input."""
    from casadi_engine.model.attach import replaced, with_drive

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
    late = ca.vertcat(*[ca.SX.sym(f"{name}_late_{k}") for k in range(3)])
    after, here, ahead = (ca.substitute(passed, symbol, late[k]) for k in range(3))
    off = (_delay(model, name) - lag) / step
    acts = here + ca.if_else(off >= 0, off * (ahead - here), off * (here - after))
    drive = ca.SX.sym(_drive(name))
    unit = model.inputs[[v.name for v in model.inputs].index(name)].unit
    wider = replace(model, u=ca.vertcat(model.u, late), late=(*model.late, (name, lag, step)))
    wider = with_drive(wider, drive, acts, f"{name} as it acts, late", unit)
    for part, value in zip(parts, (drive, ca.SX(0), ca.SX(0)), strict=True):
        wider = replaced(wider, wider.x[states.index(part)], value)
    return _without(wider, states=parts, drive=f"d_{parts[2]}")


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


def _drive(name: str) -> str:
    """What the drive is called that is an input as it acts."""
    return f"{name}_late"
