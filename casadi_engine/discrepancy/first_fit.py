"""The fit without effects, in its share of the time of a repair."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from casadi_engine.deadline import Deadline, TimeUp, late
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.estimation.ipopt import ONE_STEP, OUT_OF_ITERATIONS
from casadi_engine.estimation.second_look import over_whole_records

# Times as many iterations for a fit that had too few: a valley may be nearly flat.
_FURTHER = 5


def first_fit(given: Mapping[str, Any], seconds: float, *, patient: bool) -> tuple[Fit, Deadline]:
    """The fit, and the deadline under which it was made, which knows what it cost.

    given : what ``estimate`` is given; seconds : its share of the time, which is lifted where none of its starts has
    come to a point by then: without a fit there is no answer; patient : more iterations are for it to take
    Raises TimeUp where the time is up before there is a point.
    """
    try:
        with Deadline(seconds, best=True) as own:
            return _fitted(given, patient), own
    except TimeUp:
        if late():
            raise
    with Deadline(best=True) as own:
        return _fitted(given, patient), own


def continued(fit: Fit, given: Mapping[str, Any], seconds: float) -> Fit | None:
    """The fit from where one ended whose time was up, in so many seconds more; None where it does not converge."""
    with suppress(TimeUp, CasadiEngineError), Deadline(seconds, best=True):
        found = estimate(**_alone(given), warm=fit)
        return found if found.converged else None
    return None


def _fitted(given: Mapping[str, Any], patient: bool) -> Fit:
    fit = estimate(**given)
    alone = {**given, "starts": 1, "neighbours": 0, "jobs": 1}
    if fit.converged and fit.innovations is None:  # as a fit by itself is looked at
        with suppress(TimeUp):  # there is a fit
            fit = over_whole_records(fit, lambda changed: estimate(**(alone | changed)))
    # as its message tells a person to, who may have wanted no more than so many
    if ONE_STEP in fit.status or (fit.status == OUT_OF_ITERATIONS and patient):
        more = _alone(given)
        more["max_iterations"] = _FURTHER * given["max_iterations"]
        with suppress(CasadiEngineError):  # there is a fit
            again = estimate(**more, warm=fit)
            fit = again if again.converged else fit
    return fit


def _alone(given: Mapping[str, Any]) -> dict[str, Any]:
    """What a fit from one start is given."""
    several = ("starts", "neighbours", "jobs", "enough")
    return {name: own for name, own in given.items() if name not in several}
