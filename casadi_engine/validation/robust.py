"""robust: what a fit with a robust loss makes of outliers, for tests that count squares."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casadi_engine.estimation import Fit, Trace
from casadi_engine.estimation.loss import Loss
from casadi_engine.experiment import Experiment


def pulled_in(fit: Fit, loss: Loss) -> Fit:
    """The fit with measurements no farther from its model than the loss counts with: by these least squares have the
    optimum of that loss, and what is left has a size that outliers do not decide (Huber 1981, section 7.8).

    Its noise levels, in which the loss counted, are those of the residuals that were pulled in.
    """
    sigma = fit.residual_level
    traces = {
        record: {name: _pulled(trace, loss.knee * sigma[name]) for name, trace in own.items()}
        for record, own in fit.traces.items()
    }
    data = tuple(_with(record, fit.traces[record.name], traces[record.name]) for record in fit.data)
    noise = {
        name: (_level(traces, name) * math.sqrt(fit.n / max(fit.dof, 1.0)), True) if free else (level, free)
        for name, (level, free) in fit.noise.items()
    }
    return replace(fit, traces=traces, data=data, noise=noise)


def _pulled(trace: Trace, most: float) -> Trace:
    left = trace.residual
    return replace(trace, measured=trace.measured - left + np.clip(left, -most, most))


def _with(record: Experiment, before: Mapping[str, Trace], after: Mapping[str, Trace]) -> Experiment:
    """The record with what is measured moved as in the traces."""
    for name, trace in after.items():
        channel, there = record[name], trace.mask
        values = np.array(channel.values)
        at = np.searchsorted(channel.time, trace.time[there])
        values[at] += trace.measured[there] - before[name].measured[there]
        record = record.with_channel(replace(channel, values=values))
    return record


def _level(traces: Mapping[str, Mapping[str, Trace]], name: str) -> float:
    """Root of the mean square of an output's residuals."""
    every = np.concatenate([own[name].residual[own[name].mask] for own in traces.values() if name in own])
    return float(np.sqrt(np.mean(every**2)))
