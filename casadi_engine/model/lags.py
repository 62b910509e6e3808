"""Sensors that are late, exactly: the part of a delay that is a number of samples is read off their times.

The law of a delay holds at one instant and so cannot hold the past: y(t - τ) to second order is far off where τ is as
long as y takes to move, and at every corner of an input. But a sensor that is late by a lag shows at t_k what was at
t_k - lag: its samples are those of the output without delay at earlier times. What the law has to hold is the rest,
τ - lag, a part of a sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from casadi_engine.experiment import Experiment
from casadi_engine.model.late_inputs import input_lags, late_inputs, of_outputs, read_late
from casadi_engine.model.rates import with_rates

if TYPE_CHECKING:
    from casadi_engine.model.model import Model

# Steps by which a delay may be off the lag that its samples are read at: beyond it a lag nearer by is there.
_NEAR = 0.6
# Shares of the longest and of the shortest record that samples are moved by at most, so that some are left.
_MOST, _LEFT = 0.5, 0.9


def delays(model: Model) -> dict[str, str]:
    """Output -> the parameter that its sensor is late by, of the effects in a model."""
    sensors = [port.name for port in model.ports if port.kind == "sensor"]
    return {
        model.outputs[sensors.index(one.at)].name: f"{one.key}.{one.effect.amplitude.name}"
        for one in model.effects
        if getattr(one.effect, "retards", False)
    }


def is_late(model: Model) -> bool:
    """True if a sensor of the model is late, or an input acts late."""
    return bool(delays(model) or late_inputs(model))


def nearest_lags(
    model: Model,
    values: Mapping[str, float],
    records: Sequence[Experiment],
    *,
    most: float = _MOST,
    begun: bool = False,
) -> dict[str, float]:
    """Late output -> lag [s] at these values of the parameters: of whole steps of the slowest record's grid, or 0.

    most : share of the longest record that samples are moved by at most; inf for any, where none has to be left
    begun : of inputs that act late those alone that are read off the record already, see ``input_lags``

    A lag that the model has is kept as long as the delay is near it. Where an input jumps at a sample and then holds,
    or its rate counts, lags are up to a step longer than the delay: the law looks ahead from a sample then, over which
    the input holds, or goes along one line.
    """
    before, found = dict(model.lags), input_lags(model, values, records, begun=begun)
    middle = 0.5 if model.rates or _jumps(model, records) else 0.0
    for output, name in delays(model).items():
        steps = [_step(model, record, output) for record in records]
        if name not in values or not steps or not np.isfinite(values[name]):
            continue
        step, spans = max(step for step, _ in steps), [span for _, span in steps]
        lag = before.get(output, 0.0)
        if abs(values[name] / step - (lag / step - middle)) > _NEAR:
            left = _LEFT * min(spans) if np.isfinite(most) else np.inf
            far = np.floor(min(most * max(spans), left) / step + 1e-6)
            lag = float(np.clip(np.rint(values[name] / step + middle), -far, far) * step)
        found[output] = lag
    return found


def far_from_lags(model: Model, values: Mapping[str, float], records: Sequence[Experiment]) -> list[str]:
    """The delays that no lag is near, as they are longer than samples are moved by: the law holds the rest poorly."""
    lags, found = dict(model.lags), []
    for output, name in delays(model).items():
        step = max(_step(model, record, output)[0] for record in records)
        if name in values and abs(values[name] - lags.get(output, 0.0)) > 2 * step:
            found.append(name)
    return found


def lagged(model: Model, lags: Mapping[str, float]) -> Model:
    """The model whose late outputs are read at these lags, those left out at none, and late inputs at theirs; the same
    one if it has them."""
    from casadi_engine.model.attach import replaced

    model = made = read_late(model, lags)
    lags = of_outputs(lags)
    for output, name in delays(model).items():
        more = lags.get(output, 0.0) - dict(model.lags).get(output, 0.0)
        if more:
            symbol = made.p[made.parameter_names.index(name)]
            made = replaced(made, symbol, symbol - more)
    return (
        made if made is model else replace(made, lags=tuple((name, lag) for name, lag in lags.items() if lag))
    )


def with_delays(model: Model, *, of_rates: bool = True) -> Model:
    """The model whose delays hold the rates of all effects that are in it, in whatever order these came.

    An output that is late by τ is written anew as y - δ dy/dt + δ² d²y/dt² / 2 with δ = τ - lag, and y what it is at
    δ = 0. of_rates : True to hold the rates of channels that dy/dt shows, over a part of a sample. Torques at ports
    stay as they are over it, and so do drives where y shows no channel at once: where a channel that goes along lines
    is a drive of dy/dt, half a step of delay is held to a five-hundredth of the signal at a sixth of the sampling rate.
    """
    late = delays(model)
    if not late:
        return model
    known, lags = [out.name for out in model.outputs], dict(model.lags)
    sensors = [port.name for port in model.ports if port.kind == "sensor"]
    symbols = {out: model.p[model.parameter_names.index(name)] for out, name in late.items()}
    shown = ca.SX(model.output_expressions)
    for output, symbol in symbols.items():
        row = known.index(output)
        shown[row] = ca.substitute(shown[row], symbol, lags.get(output, 0.0))
    plain = with_rates(replace(model, output_expressions=shown), of_rates=of_rates, prompt=True)
    for output, symbol in symbols.items():
        row, rest = known.index(output), symbol - lags.get(output, 0.0)
        signals = plain.ports[sensors[row]].signals
        shown[row] = shown[row] - rest * signals["rate"] + 0.5 * rest**2 * signals.get("bend", 0.0)
    return replace(plain, output_expressions=shown)


def with_nearest_lags(
    model: Model,
    values: Mapping[str, float],
    records: Sequence[Experiment],
    *,
    most: float = _MOST,
    begun: bool = False,
) -> Model:
    """The model with the lags that these values of its delays ask for; most, begun : as in ``nearest_lags``."""
    return (
        lagged(model, nearest_lags(model, values, records, most=most, begun=begun))
        if is_late(model)
        else model
    )


def _jumps(model: Model, records: Sequence[Experiment]) -> bool:
    """True if a record holds an input from one sample to the next."""
    inputs = [variable.name for variable in model.inputs]
    return any(record[name].hold == "zero" for record in records for name in inputs if name in record)


def _step(model: Model, record: Experiment, output: str) -> tuple[float, float]:
    """The typical step of the fastest of an output and the inputs, whose points samples may be moved to, and how long
    the output's last, or that one's where it was not measured [s]."""
    names = [name for name in (output, *(variable.name for variable in model.inputs)) if name in record]
    times = [record[name].time for name in names or record.names]
    steps = [float(np.median(np.diff(time))) for time in times]
    long = times[0] if output in record else times[int(np.argmin(steps))]
    return min(steps), float(long[-1] - long[0])
