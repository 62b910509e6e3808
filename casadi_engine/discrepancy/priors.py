"""What is known of a model's free numbers before the data: weak and physical, in the scales of the records.

An amplitude is scaled by what it does: at one prior standard deviation it moves an output by the output's own
variation (an error of a sensor by a twentieth of it, one of what an input is recorded as by a fifth; a stated number
that may be wrong, by a tenth of itself; a channel that lags or is late is so with all of it, but for a tenth). That
holds in any units and any way of writing the model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casadi_engine.discrepancy.beside_starts import moved_by
from casadi_engine.discrepancy.evidence import Prior
from casadi_engine.discrepancy.exchanged_units import BEHIND, LAG, WRONG, is_shortest
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.parameters import Parameters

# Share of an output's variation that a physical effect, an error of a sensor, and one of a recorded input may well
# make; share of itself by which a stated number may well be wrong.
PHYSICAL, SENSOR, RECORDED, STATED = 1.0, 0.05, 0.2, 0.1
# A channel that is behind is so with all of it, but for this share; with any part of it where that stands for a shorter
# time.
WHOLE, SHORTER = 0.1, 0.5
# A law that bends has no slope where it does nothing: its amplitude is not taken to be larger than so many times.
_BENT = 30.0
# Standard deviation of a parameter without bounds, in its own size.
_OPEN = 10.0


def priors_of(null: NullModel, parameters: Parameters, effects: Sequence[Addition]) -> dict[str, Prior]:
    """The prior of every free parameter of a model with these effects, linearised at its optimum."""
    amplitudes = {one.amplitude: one for one in effects}
    nuisance = {f"{one.key}.{name}": (one, name) for one in effects for name in one.nuisance}
    found: dict[str, Prior] = {}
    values = dict(zip(null.parameters, map(float, null.values), strict=True))
    for k, name in enumerate(null.parameters):
        stem = name.partition("@")[0]
        if stem in amplitudes:
            one = amplitudes[stem]
            if one.candidate.effect in BEHIND and is_shortest(one, values):
                found[name] = Prior(SHORTER, True, centre=1.0)
            elif one.candidate.effect in (LAG, *BEHIND):
                found[name] = Prior(WHOLE, True, centre=1.0)
            else:
                found[name] = Prior(_amplitude(null, k, one), True, one.bounds.one_sided != 0)
        elif stem in nuisance:
            one, own = nuisance[stem]
            found[name] = Prior(_range_of(one, own, null, parameters, stem))
        else:
            found[name] = _base(parameters, stem, float(null.values[k]))
    return found


def _amplitude(null: NullModel, k: int, one: Addition) -> float:
    kind = one.kind
    value = abs(float(null.values[k]))
    if kind == "parameter" and one.bounds.unit == "1":
        return STATED
    if kind in ("sensor", "input") and one.bounds.name == "gain" and value > WRONG:
        # no calibration, but units that were exchanged or edges counted twice, at either end alike
        return value
    share = {"sensor": SENSOR, "cross": SENSOR, "input": RECORDED}.get(kind, PHYSICAL)
    step = float(np.linalg.norm(null.turn[k]))
    direction = int(np.argmax(np.abs(null.turn[k])))
    sizes = []
    for record in null.records:
        own = moved_by(
            null, record, {o: slopes[:, direction : direction + 1] for o, slopes in record.slopes.items()}
        )
        for output, each in own.items():
            moved = float(each[0]) / max(step, 1e-300)
            varied = float(np.std(record.path.grid.measured[output].values))
            if moved > 0 and varied > 0:
                sizes.append(share * varied / moved)
    size = min(sizes, default=math.inf)
    size = min(size, _BENT * value) if value > 0 else size
    return size if 0 < size < math.inf else max(value, 1e-12)


def _range_of(one: Addition, name: str, null: NullModel, parameters: Parameters, stem: str) -> float:
    """Standard deviation of a number that may be anywhere on its grid, or in the record."""
    grid = one.nuisance[name]
    if grid.over == "time":
        return max(r.path.grid.span for r in null.records) / math.sqrt(12)
    own = parameters[stem]
    if math.isfinite(own.max - own.min):
        return float(own.max - own.min) / math.sqrt(12)
    return max(abs(float(own.value)), 1e-12) * (2.0 if grid.log else 1.0)


def _base(parameters: Parameters, name: str, value: float) -> Prior:
    own = parameters[name]
    if math.isfinite(own.max - own.min) and own.max > own.min:
        return Prior(float(own.max - own.min) / math.sqrt(12))
    # a declared value of 0 says nothing of the size
    size = _OPEN * max(abs(float(own.value) or value), 1e-12)
    return Prior(size, centre=float(own.value), open=bool(own.value))
