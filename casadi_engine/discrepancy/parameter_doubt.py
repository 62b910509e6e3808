"""What errors of the parameters may explain of a gap on fresh data.

Parameters that are held on fresh data carry the errors of their estimates along, and at another load or speed these may
be larger than the noise. What lies in the directions of the parameters is therefore no sign of something missing: the
residual tests of fresh data take it away first, so that their false-alarm rate holds whatever the errors are.
"""

from __future__ import annotations

import numpy as np

from casadi_engine.discrepancy.assumed_pressure import is_carried
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.estimation import Fit
from casadi_engine.parameters import compile


def doubted(fit: Fit, held: Fit) -> NullModel:
    """The null model of fresh data with slopes for what a fit estimated: parameters, and the fresh initial states.

    fit : on the data searched; held : its model on fresh data, parameters held. Amplitudes of events that do not act in
    the fresh data, and parameters at a bound, have no errors there.
    """
    names = tuple(record.name for record in held.data)
    pmap = compile(fit.parameters, held.model.parameter_names, names)
    values = held.values
    z = np.array([values[name.partition("@")[0]] for name in pmap.free])
    sure = [
        name for name in pmap.free if "@" in name or fit.estimates[name].at_bound is not False
        or (values[name] != fit.values[name] and not is_carried(name))
    ]  # fmt: skip
    first = {name: np.array([e.value for e in held.initial[name].values()]) for name in names}
    known = {
        name: tuple(s for s, e in held.initial[name].items() if e.fixed or e.at_bound is not False)
        for name in names
    }
    return null_at(held.model, held.data, fit.parameters, z, first, held_starts=known, held_parameters=sure)
