"""How small a missing effect would have been found, and where that number says nothing.

The size is that of a score beyond the threshold. It is no news where another effect does the same in these data, and
where it is so large that the effect would have to move an output by more than that moves at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casadi_engine.discrepancy.beside_starts import moved_by
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import RecordNull
from casadi_engine.discrepancy.priors import PHYSICAL, SENSOR, STATED
from casadi_engine.discrepancy.repaired import NotFound
from casadi_engine.discrepancy.screening import Screened

# Correlation beyond which two effects are one; standard deviations of a prior beyond which a size is not plausible.
_TWINS, _PLAUSIBLE = 0.995, 2.0
# Share of itself by which a simulated output that stands still moves by rounding.
_STILL = 1e-9


def not_found(screened: Screened) -> tuple[NotFound, ...]:
    """Every effect that is not in the model, with the size that would have been found: the middle one of its grid.

    Where that size says little, a note says why.
    """
    detectable = screened.scores.detectable(screened.threshold)
    members: dict[tuple[str, str], list[int]] = {}
    for k, one in enumerate(screened.candidates):
        members.setdefault(one.key, []).append(k)
    scales = prior_scales(screened)
    middles: dict[tuple[str, str], int] = {}
    for key, own in members.items():
        finite = sorted((k for k in own if np.isfinite(detectable[k])), key=lambda k: detectable[k])
        if finite:
            middles[key] = finite[len(finite) // 2]
    found = []
    for key, own in members.items():
        name, at = key
        unit = screened.candidates[own[-1]].unit
        middle = middles.get(key)
        if middle is None:
            found.append(NotFound(name, at, math.inf, unit, False, _untestable(screened, own)))
            continue
        size = _size(screened, own, detectable, middle)
        twin = _twin(screened, middle, middles)
        times = float(detectable[middle]) / float(scales[middle])
        note = _beyond(size, times, screened, middle) if times > _PLAUSIBLE else ""
        found.append(NotFound(name, at, size, unit, True, note, twin))
    return tuple(found)


def _size(screened: Screened, own: Sequence[int], detectable: Array, middle: int) -> float:
    """The smallest size of an effect; of a law without a slope at 0 that at which a secant finds its own size."""
    side = screened.candidates[middle].side
    alike = [k for k in own if screened.candidates[k].side == side and np.isfinite(detectable[k])]
    flat = [k for k in alike if screened.candidates[k].source.is_flat]
    if middle not in flat:
        return float(detectable[middle])
    flat.sort(key=lambda k: abs(screened.candidates[k].size or 1.0))
    sizes = np.log([abs(screened.candidates[k].size or 1.0) for k in flat])
    over = sizes - np.log(detectable[flat])  # rises with the size
    k = int(np.clip(np.searchsorted(over, 0.0), 1, max(len(over) - 1, 1)))
    if k >= len(over) or over[k] <= over[k - 1]:
        return float(detectable[middle])
    rise = (over[k] - over[k - 1]) / (sizes[k] - sizes[k - 1])
    return float(np.exp(sizes[k] - over[k] / rise))


def prior_scales(screened: Screened) -> Array:
    """(k,) the size of each candidate that is plausible before the data: that which moves an output by its own
    variation, an error of a sensor by a twentieth of it; a tenth for the share of a stated number. inf where it moves
    nothing."""
    ports = screened.null.model.ports
    found = np.full(len(screened.candidates), np.inf)
    for record in screened.null.records:
        for output, moved in moved_by(screened.null, record, screened.columns[record.name]).items():
            varied = _variation(record, output)
            if not varied > 0:
                continue  # an output that stands still says nothing of sizes
            with np.errstate(divide="ignore"):
                found = np.minimum(found, np.where(moved > 0, varied / moved, np.inf))
    kinds = [ports[one.port].kind for one in screened.candidates]
    share = np.array([SENSOR if kind in ("sensor", "cross") else PHYSICAL for kind in kinds])
    stated = np.array(
        [
            kind == "parameter" and one.unit == "1"
            for kind, one in zip(kinds, screened.candidates, strict=True)
        ],
        dtype=bool,
    )
    return np.where(stated, STATED, share * found)


def _variation(record: RecordNull, output: str) -> float:
    """How much an output moves without its noise: as simulated, or as measured where the simulation stands still."""
    measured = record.path.grid.measured[output].values
    simulated = measured - record.residual[output]
    moves = float(np.std(simulated))
    return moves if moves > _STILL * float(np.abs(simulated).max(initial=0.0)) else float(np.std(measured))


def _twin(screened: Screened, middle: int, middles: dict[tuple[str, str], int]) -> str:
    """``effect at port`` of the other effect that does the same in these data, "" without one."""
    directions = screened.scores.directions
    key = screened.candidates[middle].key
    best, name = _TWINS, ""
    for other, k in middles.items():
        alike = abs(float(directions[:, middle] @ directions[:, k]))
        if other != key and alike > best:
            best, name = alike, f"{other[0]} at {other[1]}"
    return name


def _beyond(size: float, ratio: float, screened: Screened, k: int) -> str:
    kind = screened.null.model.ports[screened.candidates[k].port].kind
    times = f"{ratio:.2g} times"
    if kind == "parameter" and screened.candidates[k].unit == "1":
        return f"it would have to be wrong by {100 * size:.2g} %"
    if kind in ("sensor", "cross"):
        return f"it would have to be {times} as large as {100 * SENSOR:.0f} % of what the output varies by"
    return f"it would have to move an output by {times} what that varies by"


def _untestable(screened: Screened, members: list[int]) -> str:
    """Why the data cannot test an effect."""
    moved = any(
        bool(np.any(columns[:, members]))
        for outputs in screened.columns.values()
        for columns in outputs.values()
    )
    return (
        "the free parameters explain all that it does in these data"
        if moved
        else "it does nothing along these records"
    )
