"""A refit: the values that explain records best at known noise levels, from a start near by, and little beside.

What many candidates of one model are compared by. ``estimate`` adds what a person reads: traces, tests, errors of every
parameter, neighbours, messages. A refit is the numbers alone; its steps over short windows first, then longer ones,
then the whole record, are those of ``windows``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from casadi_engine.estimation.corner_widths import narrowed, with_widths
from casadi_engine.estimation.refit_answer import Refit, RefitRecord
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters

__all__ = ["Refit", "RefitProblem", "RefitRecord", "refit"]


def refit(
    model: Model,
    records: Sequence[Experiment],
    parameters: Parameters,
    *,
    levels: Mapping[str, float],
    start: Mapping[str, float] | None = None,
    initial: Mapping[str, Mapping[str, Any]] | None = None,
    warm: Refit | None = None,
    horizons: Sequence[float | None] | None = None,
    corners: bool = True,
    most: int = 60,
) -> Refit:
    """Minimise chi-squared at known noise levels from a start near by.

    Parameters
    ----------
    model, records : the equations, and records that have names of their own (channels in the model's units)
    parameters : the set: values, bounds, ties and priors; inequality constraints are refused
    levels : output -> standard deviation of its noise, held
    start : name -> value of free parameters in place of the set's, clipped to the bounds
    initial : record -> state -> number or Estimate, where the states begin; they are free
    warm : a refit of the same records, whose model may have fewer effects: values, states and fineness of the
        integration are taken from it as far as they are there; ``start`` and ``initial`` go before it
    horizons : lengths of the windows [s], one after the other, None for whole records; (None,) for the simulation
        alone. By default windows of a few shooting intervals, then four times as long, and so on, then None
    corners : make those of laws (friction, play) as sharp as the motion asks at the end, where the set leaves their
        widths as they were declared; ``Refit.widths`` says which
    most : steps over each horizon at most

    Raises EstimationError for input that cannot be used; a model that cannot be evaluated has the ``status`` for it.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)))
    >>> model = ce.one_inertia()
    >>> found = refit(model, [exp], model.parameters(), levels={"omega": 0.01})
    >>> found.status, {name: round(value, 4) for name, value in found.values.items()}
    ('converged', {'J_eng': 0.4, 'C_eng': 0.5})
    """
    problem = RefitProblem(model, records, parameters, levels=levels)
    found = problem.run(start=start, initial=initial, warm=warm, horizons=horizons, most=most)
    sharper = narrowed(problem, parameters, found) if corners and found.converged else {}
    if not sharper:
        return found
    finer = RefitProblem(model, records, with_widths(parameters, sharper), levels=levels)
    last = finer.run(warm=found, horizons=(None,), most=most)
    return replace(last, widths=sharper, steps=found.steps + last.steps) if last.converged else found
