"""Initial states of records whose parameters are known: few numbers, searched along one run of each record.

A search by shooting may leave the states that a model can have between its intervals, and come back from there in
hundreds of iterations or not at all. One run that begins where the measurement says, and only ever gets nearer to it,
stays where the model has a value.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.integration import shorten_steps
from casadi_engine.estimation.levenberg_marquardt import Minimum, Squares, minimise
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.starts import chained_nodes

if TYPE_CHECKING:
    from casadi_engine.estimation.first_points import FirstPoints

Array = NDArray[np.float64]

# Fall of half chi-squared that ends a search, steps of it, and chi-squared per sample from which on one run is lost.
_FALL, _STEPS, _LOST = 1e-6, 50, 4.0
# How often steps of the integration are made shorter.
_SHORTENED = 4


def states_first(search: FirstPoints, x: Array) -> Array:
    """The point (size,) with the initial states at their best along one run of each record, where no parameter is free
    and the noise is known, so that it is told whether that explains the record; else the point itself."""
    if search.problem.nv or any(search.levels.estimated) or search.predictor.kind != "none":
        return x
    if search.loss.robust or all(record.linear for record in search.records):
        return x
    search.problem.forget()  # steps may be made shorter
    found = x.copy()
    for record, lay in zip(search.records, search.problem.layouts, strict=True):
        if record.linear:
            continue
        own = slice(lay.at, lay.at + record.n)
        end = _at_best(record, x[own], search.lower[own], search.upper[own])
        if end is None or 2 * end.squares.cost > _LOST * record.count:
            return x
        nodes = chained_nodes(record, np.zeros(0), end.x)
        found[lay.at : lay.at + nodes.size] = nodes.ravel()
    return found


def _finely(record: RecordTerm, first: Array) -> None:
    """Give a record steps that can follow it from its first state: long ones may lead to where no state ever is."""
    for _ in range(_SHORTENED):
        try:
            if not shorten_steps([record], np.zeros(0), [chained_nodes(record, np.zeros(0), first)]):
                return
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return


def _at_best(record: RecordTerm, first: Array, low: Array, high: Array) -> Minimum | None:
    v, valid = np.zeros(0), record.observation.valid.ravel()
    _finely(record, first)

    def squares(at: Array) -> Squares | None:
        try:
            point = record.evaluate(v, chained_nodes(record, v, at))
            rows = chained_slopes(record, point).reshape(-1, record.weight.size)[:, valid]
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return None
        r = point.r.ravel()[valid]
        if not (np.isfinite(rows).all() and np.isfinite(r).all()):
            return None
        return Squares(0.5 * float(r @ r), rows @ r, rows @ rows.T)

    with np.errstate(all="ignore"):
        return minimise(squares, first, low, high, fall=_FALL, steps=_STEPS)
