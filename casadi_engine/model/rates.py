"""Rates of outputs: what a delayed sensor needs to know of its signal.

The rate of an output is its total derivative by time along the model's equations. Where an output shows a channel at
once (an accelerometer shows the force), the channel's own rate is a part of it; no equation holds that one. It is a
further entry of u behind the channels, and who samples the channels supplies it: the slope of the recorded values.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca

from casadi_engine.model.declarations import Ports
from casadi_engine.model.jumps import jumps_in

if TYPE_CHECKING:
    from casadi_engine.model.model import Model


def with_rates(model: Model, *, of_rates: bool = False, prompt: bool = False) -> Model:
    """The model with the signals value, rate and bend (the rate's rate) of its sensors as its equations give them.

    An output without a rate, because it jumps, by what acts at a port too, or holds another delay already, has the
    signal value alone. One whose rate shows a channel has no bend, unless ``of_rates`` asks for it: the channel's rate
    is noise where it is measured, and does no harm over a part of a sample only. Torques at ports change no bend:
    nobody knows their rates. prompt : the outputs are written without the delays of the model's effects
    """
    shown = _drives_put_in(model, _laws_put_in(model))
    late = () if prompt else [one.at for one in model.effects if getattr(one.effect, "retards", False)]
    sensors = [port.name for port in model.ports if port.kind == "sensor"]
    smooth = [name not in late and _has_rate(model, shown[row]) for row, name in enumerate(sensors)]
    model = _with_symbols(model, [shown[row] for row, good in enumerate(smooth) if good])
    rates = _total_rates(model, _laws_put_in(model))
    whole = _drives_put_in(model, rates)
    if of_rates:  # a drive that is made of channels joined by lines goes along a line too; where no
        # channel is shown at once it is held, which keeps the linear core
        lines = ca.is_linear(ca.vertcat(ca.SX(0, 1), model.drive_expressions), model.channels)
        shows = whole if lines and model.rates else rates
        model = _with_symbols(model, [shows[row] for row, good in enumerate(smooth) if good])
    # over a part of a sample a channel that is joined by lines keeps its rate
    unknown = ca.SX(0, 1) if of_rates else model.u
    bent = [good and _has_bend(model, whole[row], unknown) for row, good in enumerate(smooth)]
    bends = _total_rates(model, rates)
    fresh, row = [], 0
    for port in model.ports:
        if port.kind == "sensor":
            signals = {"value": model.output_expressions[row]}
            signals |= {"rate": rates[row]} if smooth[row] else {}
            signals |= {"bend": bends[row]} if bent[row] else {}
            port = replace(port, signals=signals)
            row += 1
        fresh.append(port)
    return replace(model, ports=Ports(fresh))


def shows_at_once(model: Model, row: int) -> bool:
    """True for an output that shows a channel, or what acts at a port, without a state between."""
    shown = _drives_put_in(model, model.output_expressions[row])
    return bool(ca.depends_on(shown, ca.vertcat(model.w, model.channels)))


def _laws_put_in(model: Model) -> Any:
    """The outputs with what acts at ports that they show: an accelerometer shows all of it."""
    outputs = model.output_expressions
    if model.w.numel() and ca.depends_on(outputs, model.w):
        return ca.substitute(outputs, model.w, model.slot_laws)
    return outputs


def _drives_put_in(model: Model, shown: Any) -> Any:
    if model.d.numel() and ca.depends_on(shown, model.d):
        return ca.substitute(shown, model.d, model.drive_expressions)
    return shown


def _has_bend(model: Model, rate: Any, unknown: Any) -> bool:
    """True if a rate, drives put in, is smooth and shows nothing whose own rate is unknown."""
    hidden = unknown.numel() and ca.depends_on(rate, unknown)
    return not hidden and not jumps_in(rate, ca.vertcat(model.x, model.t))


def _has_rate(model: Model, shown: Any) -> bool:
    """True if an output, drives put in, neither jumps nor depends on torques or rates, whose rates nobody knows."""
    unknown = ca.vertcat(model.w, model.channel_rates, model.late_channels)
    return not ca.depends_on(shown, unknown) and not jumps_in(shown, ca.vertcat(model.x, model.u, model.t))


def _with_symbols(model: Model, shown: list[Any]) -> Model:
    """The model with a rate in u for each channel that one of these outputs shows."""
    column = ca.vertcat(ca.SX(0, 1), *shown)
    if not ca.depends_on(column, model.channels):
        return model
    names = [
        variable.name
        for row, variable in enumerate(model.inputs)
        if variable.name not in model.rates and ca.depends_on(column, model.channels[row])
    ]
    if not names:
        return model
    symbols = [ca.SX.sym(f"{name}_rate") for name in names]
    u = ca.vertcat(model.channels, model.channel_rates, *symbols, model.late_channels)
    return replace(model, u=u, rates=(*model.rates, *names))


def _total_rates(model: Model, outputs: Any) -> Any:
    """(ny, 1) SX of the total derivatives of outputs by time, torques at ports held."""
    known = [variable.name for variable in model.inputs]
    channels = ca.vertcat(ca.SX(0, 1), *[model.channels[known.index(name)] for name in model.rates])
    rates = ca.jtimes(outputs, model.x, model.ode) + _partial_rates(outputs, channels, model)
    if model.d.numel() and ca.depends_on(outputs, model.d):
        rates = rates + ca.jtimes(outputs, model.d, _partial_rates(model.drive_expressions, channels, model))
    return rates


def _partial_rates(expression: Any, channels: Any, model: Model) -> Any:
    """The rate of an expression at held states: by its channels and by time itself."""
    rate = ca.jacobian(expression, model.t)
    if channels.numel():
        rate = rate + ca.jtimes(expression, channels, model.channel_rates)
    return rate
