"""Outputs that no search for effects has a use for: one that does not move, or is noise alone. What a few samples do is
told by every fit, see ``estimation/faulty_samples.py``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from casadi_engine.errors import ExperimentError
from casadi_engine.estimation import Fit
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.validation.residual_tests import whiteness

# Values that an output takes where it moves by its resolution at most; samples that this takes to be said.
_VALUES, _FEW = 2, 8
# p-value of the whiteness test beyond which an output counts as noise about a constant.
_WHITE = 0.01
_NAMED = 5


def refuse_still(model: Model, records: Sequence[Experiment]) -> None:
    """Raise ExperimentError where no output of any record moves by more than its resolution, and for an output that is
    one and the same number everywhere: it has no noise by which the others could be weighed against it."""
    seen, levels = [], dict[str, list[str]]()
    moves = False
    for record in records:
        for out in model.outputs:
            if out.name not in record:
                continue
            channel = record[out.name]
            values = np.unique(channel.values[channel.mask & np.isfinite(channel.values)])
            if len(values) > _VALUES or len(channel.values) < _FEW:
                moves = True
            words = " or ".join(f"{value:.6g}" for value in values[:_VALUES])
            told = f"{out.name} of {record.name} is {words} in all samples"
            seen += [told] if len(values) else []
            levels.setdefault(out.name, []).append(
                told if len(values) == 1 and len(channel.values) >= _FEW else ""
            )
    if seen and not moves:
        raise ExperimentError(
            "no output moves, and nothing can be learnt from it",
            seen="; ".join(seen[:_NAMED]),
            allowed="an output that moves by more than its resolution",
            cure="look whether the sensor is connected and the channel is the right one; record one with motion",
        )
    still = [told[0] for told in levels.values() if all(told)]
    if still:
        raise ExperimentError(
            "an output does not move at all",
            seen="; ".join(still[:_NAMED]),
            allowed="outputs that move, if only by their noise",
            cure="look whether its sensor is connected, or leave the channel out of the record",
        )


def noise_alone(fit: Fit) -> str | None:
    """What to say where every output is white noise about a constant, which the model explains worse than a constant
    would, although inputs move: a sensor that is stuck, say. None for all others."""
    names = []
    for record in fit.data:
        moves = any(np.ptp(record[v.name].values) > 0 for v in fit.model.inputs if v.name in record)
        for output, trace in fit.traces[record.name].items():
            y, e = trace.measured[trace.mask], trace.residual[trace.mask]
            worse = len(e) > _FEW and float(e @ e) > float(((y - y.mean()) ** 2).sum())
            if not (moves and worse):
                return None
            p = whiteness(np.where(trace.mask, trace.measured - y.mean(), 0.0), mask=trace.mask).p_value
            if p is None or p < _WHITE:
                return None
            names.append(f"{output} of {record.name}")
    return (
        f"{', '.join(names[:_NAMED])} does not follow the inputs: it is noise about a constant, and the model fits it "
        "worse than that constant: look whether the sensor is connected and the channel is the right one"
    )
