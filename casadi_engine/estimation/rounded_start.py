"""Where the search of equations that jump with their states begins: where rounded corners led over short windows.

A jump has no slope, and what a simulation over the whole record says of a play or of dry friction is lost after a few
reversals. Over windows of a few shooting intervals, each from states of its own, the data still tell; there corners are
wide at first, as wide as the motion, and then sharper. From there the equations are refitted as they are, to the whole
record; the search begins at what simulates the record best, that or the values that were given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.corner_widths import courses
from casadi_engine.estimation.refit_answer import Refit
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.corners import with_rounded_jumps
from casadi_engine.parameters import Parameters
from casadi_engine.simulation.null_path import NullPath

Array = NDArray[np.float64]

# Widths of corners as shares of the signals' typical size, and the shooting intervals of the windows then: two of them
# are as long as the time between passes of a corner.
_LADDER = ((0.4, (2, 4)), (0.1, (4, 8)), (0.025, (8,)))
# Steps over each, and of the equations as they are.
_STEPS, _LAST = 20, 40
# Samples of an interval at least; the share of its typical size by which a signal has to be beyond 0 to have passed it.
_SHORTEST, _BEYOND = 8, 0.5
# Units of work for each sample that the windows may cost in all.
_WORK = 5e3
# A refit with sharper corners or over longer windows whose chi-squared is larger by this factor was lost.
_LOST = 4.0


def rounded_refit(
    model: Model,
    records: Sequence[Experiment],
    parameters: Parameters,
    levels: Mapping[str, float],
    start: Mapping[str, float],
) -> Refit | None:
    """The refit of the whole records that those of the rounded model over short windows lead to; None where nothing
    jumps, or where they fail.

    start : name -> value of the free parameters
    """
    rounded = with_rounded_jumps(model)
    if rounded is model:
        return None
    try:
        with np.errstate(all="ignore"):
            with Deadline(work=_WORK * sum(record.samples for record in records)):
                there = _in_windows(
                    rounded, records, parameters.unconstrained().extended(rounded), levels, start
                )
            if there is None:
                return None
            whole = RefitProblem(model, records, parameters.unconstrained(), levels=levels)
            found = whole.run(start=there.values, initial=there.initial, horizons=(None,), most=_LAST)
    except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError, TimeUp):
        return None
    return found if np.isfinite(found.cost) else None


def _in_windows(
    rounded: Model,
    records: Sequence[Experiment],
    pars: Parameters,
    levels: Mapping[str, float],
    start: Mapping[str, float],
) -> Refit | None:
    """The refit over the longest windows, with the sharpest corners, over which none was lost."""
    found: Refit | None = None
    first = RefitProblem(rounded, records, pars, levels=levels)
    sizes, passes = _passes(rounded, first.measured_paths(start))
    samples = sum(record.grid.samples for record in first.records)
    length = max(round(samples / max(passes, 1) / 2), _SHORTEST)
    for share, counts in _LADDER:
        for name, size in sizes.items():
            pars.fix(name, share * size)
        problem = RefitProblem(rounded, records, pars, levels=levels, interval=length)
        interval = max(record.plan.length * record.grid.step for record in problem.records)
        for count in counts:
            begun = found.values if found else start
            try:
                there = problem.run(start=begun, horizons=(count * interval,), most=_STEPS)
            except TimeUp:
                return found
            if not there.cost < (_LOST * found.cost if found else np.inf):
                return found
            found = there
    return found


def _passes(rounded: Model, paths: Sequence[NullPath]) -> tuple[dict[str, float], int]:
    """Width -> the typical size of the signal that jumps, along the states that explain each interval, and how often
    the signals pass 0."""
    found, passes = {}, 0
    for one in rounded.corners:
        along = courses(paths, one.signal)
        size = float(np.median(np.abs(np.concatenate(along))))
        if 0 < size < np.inf:
            found[one.width] = size
            sides = [np.sign(course[np.abs(course) > _BEYOND * size]) for course in along]
            passes += sum(int(np.count_nonzero(np.diff(side))) for side in sides)
    return found, passes
