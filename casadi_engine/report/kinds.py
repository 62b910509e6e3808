"""The kinds of result that the report room can show, and how to say that it cannot show something."""

from __future__ import annotations

from dataclasses import dataclass

from casadi_engine.errors import ResultError
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters

KINDS = "a Fit, a Validation, a Simulated, a Repair"
# What report and plot also take.
READ_BACK = ", a loaded Result"
# What can be drawn, but has no page.
DRAWN_ONLY = ", Modes, a Reduction, an Experiment, Orders"


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


def not_shown(result: object, verb: str) -> ResultError:
    """The error for an object that is no result."""
    return ResultError(
        f"{verb} does not know this kind of result",
        seen=type(result).__name__,
        allowed=KINDS
        + (READ_BACK if verb in ("plot", "report") else "")
        + (DRAWN_ONLY if verb == "plot" else ""),
        cure="give what estimate, validate or simulate returned",
    )
