"""A fit without effects that runs away: a model that lacks something may have a valley without end.

A belt whose ratio is wrong can only slip, and a fit makes it a clutch as stiff as the bounds allow: the likelihood
rises by next to nothing all the way, the equations become stiff, and from out there no effect looks as it does. What
the data do not tell of a parameter then stays about where the user put it, as by a prior as wide as ten times its
start value; it holds for this fit alone, not for the models with effects.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate

# Standard deviation of the prior, in start values; what the fit may cost, in multiples of the work of the one before.
_FACTOR, _MORE = 10.0, 4.0
# Times its start value, or share of it, at which a parameter of a fit that was ended has run away.
_FAR = 1e3
KEPT_NEAR = (
    "the fit without effects has no end: it runs away along what the data do not tell; effects were looked for from "
    "where parameters stay within about ten times their start values"
)


def is_far_off(fit: Fit) -> bool:
    """True where a parameter has run away from its start."""
    pairs = [(abs(fit.values[name]), abs(fit.start.get(name, 0.0))) for name in fit.free]
    return any(start > 0 and not start / _FAR < value < start * _FAR for value, start in pairs)


def kept_near(fit: Fit, work: float, given: Mapping[str, Any], seconds: float = math.inf) -> Fit | None:
    """The fit of a model that was not converged with parameters that stay near their starts, None where it has no end
    either.

    work : of the fit, in units of ``Deadline``; given : what ``estimate`` was given for it; seconds : that it may take
    """
    near = given["parameters"].copy()
    for name in fit.free:
        own = name.partition("@")[0]
        if own in near.names and near[own].vary and near[own].prior is None and near[own].value:
            near[own].set(prior=(near[own].value, _FACTOR * abs(near[own].value)))
    try:
        with Deadline(seconds, work=_MORE * work, best=True):
            found = estimate(**{**given, "parameters": near, "starts": 1, "neighbours": 0})
    except (TimeUp, CasadiEngineError, FloatingPointError):  # there is a fit
        return None
    return found if found.converged else None
