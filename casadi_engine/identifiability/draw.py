"""One drawing of the exact test: random numbers for everything unknown, and the rows that follow from them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from random import Random

import numpy as np

from casadi_engine.errors import IdentifiabilityError
from casadi_engine.identifiability.echelon import Echelon, null_space
from casadi_engine.identifiability.field import Field, Matrix, Pole
from casadi_engine.identifiability.question import Question
from casadi_engine.identifiability.run import Run
from casadi_engine.identifiability.values import Values

_ATTEMPTS = 2000
# Orders without growth, after the first, before the rank counts as final at a generic point (one is enough).
_PATIENCE = 2
_DOUBLINGS = 6
# A known start may be silent for long even in a small model: at least so many orders are looked at.
_LEAST = 32


@dataclass(frozen=True, eq=False)
class Work:
    """What a drawing was made of, for questions that change little of it.

    echelon : of all columns, [coefficients of unknown drives, free initial states, z]
    runs : one for each experiment; columns : for each of them its columns among all. unknown : how many come first
    """

    echelon: Echelon
    runs: tuple[Run, ...]
    columns: tuple[list[int], ...]
    unknown: int


@dataclass(frozen=True, eq=False)
class Drawn:
    """What one drawing found about the columns [free initial states, free parameters].

    rows : (rank, columns) in reduced echelon form: every row is a combination of unknowns that the outputs
        determine to first order, whatever the unknown drives do
    point : (columns,) the random values at which. states : how many columns are initial states
    order : of the derivative that brought the last of the rank. orders : up to which derivatives were looked at
    """

    field: Field
    rows: Matrix
    point: tuple[int, ...]
    states: int
    order: int
    orders: int
    values: Values
    work: Work | None = dataclasses.field(default=None, repr=False)

    @property
    def rank(self) -> int:
        """Independent combinations of initial states and parameters."""
        return int(self.rows.shape[0])

    @property
    def parameter_rows(self) -> Matrix:
        """(directions, nz): combinations of the parameters alone."""
        leading = [int(np.flatnonzero(row)[0]) for row in self.rows]
        inside = [i for i, column in enumerate(leading) if column >= self.states]
        return self.rows[inside][:, self.states :]

    @property
    def identifiable(self) -> list[bool]:
        """For each column: is it determined by itself?"""
        single = (self.rows != 0).sum(axis=1) == 1
        found = np.zeros(self.rows.shape[1], dtype=bool)
        found[[int(np.flatnonzero(row)[0]) for row in self.rows[single]]] = True
        return [bool(one) for one in found]

    @property
    def null_space(self) -> Matrix:
        """(columns, columns - rank): directions in which nothing is seen."""
        return null_space(self.field, self.rows)


def draw(question: Question, seed: int, *, keep: bool = False) -> Drawn:
    """Draw until a point without poles is found, and take in derivatives until the rank is final.

    keep : keep the work, for `remedies`. IdentifiabilityError if no point will do.
    """
    random = Random(seed)
    for _ in range(_ATTEMPTS):
        values = Values(question.field, random)
        try:
            found = _drawn_arbitrary(question, values) if question.arbitrary else _drawn(question, values, 0)
        except Pole as pole:
            reason = str(pole)
            continue
        return found if keep else replace(found, work=None)
    raise IdentifiabilityError(
        "the equations have no power series at the start that was given",
        seen=reason,
        allowed="starts at which no denominator, root or logarithm is of zero",
        cure='give start="free", or a number other than zero for the states in question',
    )


def _drawn_arbitrary(question: Question, values: Values) -> Drawn:
    """Unknown drives of no form have as many coefficients as orders are looked at: look again with twice as many."""
    orders = 2 + len(question.free) + len(question.initial) + sum(len(one.start) for one in question.settings)
    before = _drawn(question, values, orders)
    for _ in range(_DOUBLINGS):
        orders *= 2
        found = _drawn(question, Values(values.field, values.random), orders)
        if (found.rank, len(found.parameter_rows)) == (before.rank, len(before.parameter_rows)):
            return found
        before = found
    return before


def _orders(question: Question) -> int:
    size = len(question.free) + len(question.initial)
    return max(_LEAST, 2 * (size + sum(len(setting.start) for setting in question.settings)) + 2)


def _drawn(question: Question, values: Values, fixed: int) -> Drawn:
    """fixed : number of orders to look at, or 0 to stop when the rank is final."""
    point = [values.number() for _ in question.free]
    runs = [
        Run(equations, setting, values, point, orders=fixed)
        for equations, setting in zip(question.equations, question.settings, strict=True)
    ]
    unknown = sum(run.unknown_columns for run in runs)
    states = sum(len(run.free_states) for run in runs)
    size = states + len(point)
    places = _places(runs, unknown, unknown + states, len(point))
    echelon = Echelon(values.field, unknown + size)
    order = idle = 0
    wanted = fixed or (_orders(question) if question.special else 0)
    k = -1
    while echelon.rank < unknown + size:
        k += 1
        grown = 0
        for run, columns in zip(runs, places, strict=True):
            rows = run.step()
            wide = np.zeros((rows.shape[0], unknown + size), dtype=np.int64)
            wide[:, columns] = rows
            grown += echelon.add(wide)
        order, idle = (k, 0) if grown else (order, idle + 1)
        if fixed:
            if k + 1 >= fixed:
                break
        elif question.special:
            if k + 1 >= wanted:
                if order < wanted // 2 or wanted > 2**_DOUBLINGS * _orders(question):
                    break
                wanted *= 2
        elif idle >= _PATIENCE:
            break
    rows = echelon.rows
    leading = np.array(sorted(echelon.pivots), dtype=np.int64)
    start = [series[0] for run, setting in zip(runs, question.settings, strict=True)
             for series, one in zip(run.x, setting.start.values(), strict=True) if not one.special]  # fmt: skip
    return Drawn(
        field=values.field,
        rows=np.ascontiguousarray(rows[leading >= unknown][:, unknown:]),
        point=tuple(start) + tuple(point),
        states=states,
        order=order,
        orders=k,
        values=values,
        work=Work(echelon, tuple(runs), tuple(places), unknown),
    )


def _places(runs: list[Run], states: int, parameters: int, count: int) -> list[list[int]]:
    """For each run the columns of the joint matrix that its own columns are."""
    places, unknown = [], 0
    for run in runs:
        own = len(run.free_states)
        places.append(
            [*range(unknown, unknown + run.unknown_columns), *range(states, states + own),
             *range(parameters, parameters + count)]
        )  # fmt: skip
        unknown += run.unknown_columns
        states += own
    return places
