"""The first states of a fresh record for a model whose parameters are known, in windows first."""

from __future__ import annotations

from collections.abc import Mapping

from casadi_engine.discrepancy.path import FAILURES, FELT_ERRORS, STEPS
from casadi_engine.discrepancy.refit import short_intervals
from casadi_engine.discrepancy.start import Start
from casadi_engine.estimation.refit_entry import RefitProblem
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters

# Chi-squared per sample at which first states describe a record well enough not to be looked for in windows.
_FITS = 2.0


def first_states_on(
    model: Model,
    record: Experiment,
    parameters: Parameters,
    levels: Mapping[str, float],
    *,
    in_places: bool = False,
) -> Start | None:
    """Where a refit of a record's first states ends, in windows first; None where the model fails.

    in_places : laws are so sharp that steps are short in places alone, and intervals short
    """
    interval = short_intervals((record,)) if in_places else "auto"
    try:
        problem = RefitProblem(
            model, (record,), parameters.unconstrained(), levels=levels, felt=FELT_ERRORS, interval=interval
        )
        if in_places:
            problem.step_in_places(anyway=True)
        found = problem.run(horizons=(None,), most=STEPS) if in_places else problem.run()
        if in_places and not (found.converged and found.cost < _FITS * problem.count):
            found = (
                problem.run()
            )  # short windows, of which every one finds anew what sticks there, take far longer
    except FAILURES:
        return None
    if not found.initial:
        return None
    return Start(found.values, found.initial, {}, found.converged, fineness=found.fineness)
