"""The model without effects where its fit is lost: the starts nearby lead to no simulation that follows the data.

What a wrong optimum leaves looks like missing physics, of any kind. Where a good part of an output's motion is left,
the model is fitted to predictions over short pieces first, from many starts, which follow the measurement whatever the
parameters are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.discrepancy.linear_algebra import basis, without
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate

# What the predictions may cost, in multiples of the work of the fit before.
_MORE = 20.0
# Share of the squared gap that one effect explains by one step: more than is left, which no wrong optimum lets it do.
_EXPLAINED = 0.5


def explained(screened: Screened) -> bool:
    """True if an effect explains most of what the fit leaves, by one step: then the fit is not lost, but lacks it."""
    scored = screened.choice.white or screened.compressed
    rows, own = scored.reduced().rows, scored.reduced().parameters
    left = without(basis(rows[:, :own]), rows[:, -1:])
    best = float(np.nanmax(score(scored).drop, initial=0.0))
    return best > _EXPLAINED * float((left**2).sum())


def found_again(fit: Fit, work: float, given: Mapping[str, Any], seconds: float = math.inf) -> Fit:
    """The fit by predictions, if that follows the data better; else the fit.

    work : of the fit, in units of ``Deadline``; given : what ``estimate`` was given for it; seconds : that it may take
    """
    try:
        with Deadline(seconds, work=_MORE * work, best=True):
            other = estimate(**{**given, "approach": "prediction", "starts": 1, "neighbours": 0})
    except (TimeUp, CasadiEngineError, FloatingPointError):  # there is a fit
        return fit
    better = other.converged and likelihood(other) > likelihood(fit)
    return other if better else fit


def likelihood(fit: Fit) -> float:
    """The log likelihood of a simulation but for a constant, with the levels of the noise that it leaves."""
    found = 0.0
    for traces in fit.traces.values():
        for trace in traces.values():
            e = trace.residual[np.isfinite(trace.residual)]
            found -= 0.5 * len(e) * math.log(max(float(e @ e) / max(len(e), 1), 1e-300))
    return found
