"""Where the search for a delay starts: at the whole samples by which the simulation fits best, moved as it is.

One step along a model foretells a delay by the rate of its output, which holds for as long as that goes along a line:
where an output passes its range within a sample or two, a delay of four samples is another optimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casadi_engine.discrepancy.refit import Addition
from casadi_engine.estimation import Fit
from casadi_engine.estimation.fit import Trace
from casadi_engine.model.lags import delays
from casadi_engine.model.model import Model

# Samples that a simulation is moved by at most, and the share of a record.
_MOST, _SHARE = 200, 0.25
# Steps by which times may differ, as a share.
_EQUAL = 1e-3


def at_whole_lags(fit: Fit, model: Model, effects: Sequence[Addition]) -> tuple[Addition, ...]:
    """The effects, delays with the start that moves the fit's simulation nearest to the measurement.

    model : with the effects
    """
    late = {name: output for output, name in delays(model).items()}
    return tuple(
        replace(one, start=_start(fit, late[one.amplitude], one.start)) if one.amplitude in late else one
        for one in effects
    )


def _start(fit: Fit, output: str, foretold: float) -> float:
    """The delay [s] that a search starts from: the whole samples that leave least, unless what is foretold is as
    near."""
    traces = [own[output] for own in fit.traces.values() if output in own]
    steps = [np.diff(one.time) for one in traces]
    if not steps or any(len(own) < 2 for own in steps):
        return foretold
    step = float(steps[0][0])
    if any(np.abs(own - step).max() > _EQUAL * step for own in steps):
        return foretold
    most = min(_MOST, int(_SHARE * min(len(one.time) for one in traces)))
    lags = np.arange(-most, most + 1)
    left = [sum((_left(one, int(lag)) for one in traces), 0.0) for lag in lags]
    best = int(lags[np.argmin(left)])
    return foretold if abs(best - foretold / step) <= 1 or best == 0 else best * step


def _left(trace: Trace, lag: int) -> float:
    """Mean square of what a simulation leaves that is so many samples later; inf where no sample is left."""
    first, last = max(lag, 0), len(trace.time) + min(lag, 0)
    moved = trace.measured[first:last] - trace.simulated[first - lag : last - lag]
    own = moved[trace.mask[first:last]]
    return float(np.mean(np.square(own))) if len(own) else np.inf
