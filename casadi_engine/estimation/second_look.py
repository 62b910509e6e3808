"""A second search where the first one ended in what hardly follows the data: over short pieces of them first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from casadi_engine.deadline import Deadline, TimeUp, late
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.followed import not_followed
from casadi_engine.estimation.lower_optimum import merit

# Half of twice the log likelihood by which the second has to be better; seconds for it, and times those of the first.
_LOWER, _SECONDS, _TIMES = 0.1, 2.0, 3.0
# What the option says then.
BOTH = "direct, then prediction"


def is_lost(fit: Fit) -> bool:
    """True for a fit that leaves a good part of an output's motion, and no white noise of it."""
    return any(
        words.startswith(f"the residual of {key} is not white")
        for key in not_followed(fit)
        for words in fit.messages
    )


def looked_at_twice(fit: Fit, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit, or a better one that begins with predictions over short pieces; of a fit that is lost in one search.

    again(changes) : makes a fit with changed arguments
    """
    plain = fit.options.get("approach") == "direct" and fit.options.get("starts") == 1
    if not (plain and fit.converged and fit.innovations is None and is_lost(fit)):
        return fit
    try:
        with Deadline(_SECONDS + _TIMES * fit.timing["total"]):
            found = again({"approach": "prediction"})
    except TimeUp:
        if late():
            raise
        return fit
    better = found.converged and merit(found) < merit(fit) - _LOWER
    best = found if better else fit
    return replace(best, options={**best.options, "approach": BOTH})
