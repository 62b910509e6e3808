"""The kinds of result that the report room can show, and how to say that it cannot show something."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from casadi_engine.errors import ResultError
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters

KINDS = "a Fit, a Validation, a Simulated, a Repair"
# What report and plot also take.
READ_BACK = ", a Posterior, a Comparison, a loaded Result"
# What can be drawn, but has no page.
DRAWN_ONLY = ", Modes, a Reduction, an Experiment, Orders, a Prediction"
# The modules that show the less common kinds; each needs the package that its results come from.
OTHERS = (
    "identifiability_figures",
    "modes_figures",
    "orders_figures",
    "posterior_figures",
    "posterior_page",
    "posterior_result",
    "prediction_figures",
    "repaired",
    "repaired_figures",
    "repaired_page",
    "stored_view",
)


@dataclass(frozen=True, eq=False)
class Simulated:
    """Records that were simulated and written to files.

    model, parameters : what was simulated.  data : the records that gave the inputs
    simulated : one experiment for each of them, outputs with origin "derived"
    files : the data files that were written, in the same order (may be empty)
    """

    model: Model
    parameters: Parameters
    data: tuple[Experiment, ...]
    simulated: tuple[Experiment, ...]
    files: tuple[str, ...] = ()


def shown_by_others(show: Any, result: object, verb: str) -> Callable[..., Any]:
    """Return the implementation of the generic function `show` for a less common kind of result.

    Raises ResultError for an object that is no result.
    """
    for name in OTHERS:
        import_module(f"casadi_engine.report.{name}")
    found: Callable[..., Any] = show.dispatch(type(result))
    if found is not show.dispatch(object):
        return found
    raise ResultError(
        f"{verb} does not know this kind of result",
        seen=type(result).__name__,
        allowed=KINDS
        + (READ_BACK if verb in ("plot", "report") else "")
        + (DRAWN_ONLY if verb == "plot" else ""),
        cure="give what estimate, validate or simulate returned",
    )
