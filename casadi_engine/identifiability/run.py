"""One experiment at one random point: its outputs' coefficients, differentiated by everything unknown."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from casadi_engine.identifiability.convolution import Convolution
from casadi_engine.identifiability.equations import CONSTANTS, DRIVEN, FREE, STATES, Equations, gradient_tape
from casadi_engine.identifiability.field import Field, Matrix, Pole
from casadi_engine.identifiability.series import Replay, Series
from casadi_engine.identifiability.settings import Setting
from casadi_engine.identifiability.tape import Tape
from casadi_engine.identifiability.values import Values

# How often parts of one point are drawn again before all of it is.
_REDRAWS = 200


class Run:
    """The rows ∂y^(k)/∂(unknown drives, free initial states, free parameters), up to factors, for k = 0, 1, 2, …

    Columns: the coefficients of the unknown drives, drive by drive; the free initial states; z.
    point : the values of z. orders : how many coefficients of an arbitrary drive are looked at
    Raises Pole at a point that has to be drawn again.
    """

    def __init__(
        self, equations: Equations, setting: Setting, values: Values, point: Sequence[int], *, orders: int
    ) -> None:
        self.values = values
        self.made = equations.derivatives(setting.outputs, setting.unknown)
        self.free_states = setting.free_states
        classes = [setting.inputs[name] for name in equations.driven]
        unknown = [setting.inputs[name] for name in setting.unknown]
        self.heights = [orders if one.degree is None else one.degree + 1 for one in unknown]
        self.unknown_columns = sum(self.heights)
        self.columns = self.unknown_columns + len(self.free_states) + len(point)
        self._lengths = [
            1 if one.still else None if one.degree is None else one.degree + 1 for one in classes
        ]
        start, sensitivity, rational = self._start(equations, setting, point)
        self.x: list[Series] = [[value] for value in start]
        self.v: list[Series] = [[0 if one.word == "zero" else values.number()] for one in classes]
        self.clock: Series = [values.number()]
        constants = [[self.field.fraction(value)] for value in self.made.constants]
        still = {(FREE, j) for j in range(len(point))} | {(CONSTANTS, j) for j in range(len(constants))}
        still |= {(DRIVEN, j) for j, one in enumerate(classes) if one.still}
        movable = {i for i, one in enumerate(setting.start.values()) if one.word in ("free", "known")}
        self.replay = self._replay(list(point), constants, frozenset(still), rational, movable)
        self.order = -1
        self.sensitivity: list[Matrix] = [sensitivity]  # S_k = ∂x_k, (n, columns)
        self._by_state = self._convolution()
        self._by_drive: list[Matrix] = []
        self._entries: list[tuple[int, tuple[int, int]]] = []
        self._weight = 1

    @property
    def field(self) -> Field:
        """The field of all numbers here."""
        return self.values.field

    def step(self) -> Matrix:
        """The rows of the next order, (outputs, columns)."""
        self.order += 1
        k, n, field = self.order, self.made.states, self.field
        if k:
            self._extend(k)
            self.replay.step()
        right = self._by_state.next(k, self.sensitivity[k])
        # With a constant Jacobian the rows are taken k! times: then nothing has to be divided by k + 1.
        weight = self._weight = self._weight * max(k, 1) % field.prime if self._by_state.still else 1
        self._add_parameters(right, k, weight)
        if self.heights:
            self._add_drives(right, k, weight)
        over = field.reciprocal(k + 1)
        for series, node in zip(self.x, self.made.tape.outputs[0][:n], strict=True):
            series.append(self.replay.coefficient(node, k) * over % field.prime)
        self.sensitivity.append(right[:n] if self._by_state.still else field.scaled(right[:n], over))
        return right[n:]

    def _replay(
        self,
        point: list[int],
        constants: list[Series],
        still: frozenset[tuple[int, int]],
        rational: dict[tuple[int, int], Fraction],
        movable: set[int],
    ) -> Replay:
        """Start the tape; where a root is missing, draw again what no earlier root depends on.

        Half of all elements have a square root: with a dozen roots a point at which all exist is not met by chance.
        movable : the states with generic values
        """
        known = rational | {(CONSTANTS, j): value for j, value in enumerate(self.made.constants)}
        inputs = [self.x, [[value] for value in point], self.v, [self.clock], constants]
        for _ in range(_REDRAWS):
            try:
                return Replay(self.made.tape, self.values, inputs, still=still, rational=known)
            except Pole as pole:
                last = pole
            moved = False
            for argument, entry in self.made.tape.own_inputs(last.node):
                if (argument == STATES and entry in movable) or (argument == DRIVEN and self.v[entry][0]):
                    inputs[argument][entry][0] = self.values.number()
                    moved = True
            if not moved:
                raise last
        raise last

    def _extend(self, k: int) -> None:
        """Coefficient k of what drives the model; the states have theirs already."""
        for series, length in zip(self.v, self._lengths, strict=True):
            if length != 1:
                series.append(self.values.number() if length is None or k < length else 0)
        self.clock.append(1 if k == 1 else 0)

    def _convolution(self) -> Convolution:
        nodes, replay = self.made.tape.outputs[1], self.replay
        return Convolution(
            self.field,
            (self.made.states + len(self.made.outputs), self.made.states),
            self.columns,
            self.made.places[0],
            [replay.changes[node] for node in nodes],
            lambda q, k: replay.coefficient(nodes[q], k),
        )

    def _add_parameters(self, right: Matrix, k: int, weight: int) -> None:
        """Add coefficient k of the Jacobian by z to its columns."""
        replay, prime = self.replay, self.field.prime
        entries = (
            self._entries if k else list(zip(self.made.tape.outputs[2], self.made.places[1], strict=True))
        )
        if not entries:
            return
        if not k:
            self._entries = [(node, place) for node, place in entries if replay.changes[node]]
        shift = self.unknown_columns + len(self.free_states)
        rows = [row for _, (row, _) in entries]
        columns = [shift + column for _, (_, column) in entries]
        values = [replay.coefficient(node, k) * weight % prime for node, _ in entries]
        right[rows, columns] = self.field.sum(right[rows, columns], np.array(values, dtype=np.int64))

    def _add_drives(self, right: Matrix, k: int, weight: int) -> None:
        """Add what the unknown drives do: coefficient i of a drive meets order k - i of its Jacobian."""
        now = np.zeros((right.shape[0], len(self.heights)), dtype=np.int64)
        for node, (row, column) in zip(self.made.tape.outputs[3], self.made.places[2], strict=True):
            now[row, column] = self.replay.coefficient(node, k)
        self._by_drive.append(now)
        first = 0
        for column, height in enumerate(self.heights):
            count = min(height, k + 1)
            for i in range(count):
                added = self._by_drive[k - i][:, column]
                if added.any():
                    added = self.field.scaled(added, weight) if weight != 1 else added
                    right[:, first + i] = self.field.sum(right[:, first + i], added)
            first += height

    # ---- the start

    def _start(
        self, equations: Equations, setting: Setting, point: Sequence[int]
    ) -> tuple[list[int], Matrix, dict[tuple[int, int], Fraction]]:
        """Initial states, their derivatives by all columns, and the rational ones among them."""
        n, field = len(setting.start), self.field
        rows = np.zeros((n, self.columns), dtype=np.int64)
        start, rational = [], {}
        texts = {
            f"the start of {name}": one.text for name, one in setting.start.items() if one.text is not None
        }
        given, gradients = gradients_at(equations, texts, self.values, point) if texts else ([], None)
        expression = column = 0
        for i, one in enumerate(setting.start.values()):
            if one.text is not None:
                start.append(given[expression])
                if gradients is not None:
                    rows[i, self.columns - len(point) :] = gradients[expression]
                expression += 1
            elif one.number is not None:
                start.append(field.fraction(one.number))
                rational[STATES, i] = one.number
            else:
                start.append(self.values.number())
                if not one.special:
                    rows[i, self.unknown_columns + column] = 1
                    column += 1
        return start, rows, rational


def gradients_at(
    equations: Equations, texts: dict[str, str], values: Values, point: Sequence[int]
) -> tuple[list[int], Matrix]:
    """Values, and gradients by z (len(texts), nz), of expressions in parameter names at a point."""
    tape, constants = gradient_tape(equations, texts)
    replay = _still_replay(tape, values, point, constants)
    found = [replay.coefficient(node, 0) for node in tape.outputs[0]]
    gradients = np.zeros((len(texts), len(point)), dtype=np.int64)
    for q, node in enumerate(tape.outputs[1]):  # column-major
        gradients[q % len(texts), q // len(texts)] = replay.coefficient(node, 0)
    return found, gradients


def _still_replay(tape: Tape, values: Values, point: Sequence[int], constants: Sequence[Fraction]) -> Replay:
    return Replay(
        tape,
        values,
        [[[value] for value in point], [[values.field.fraction(value)] for value in constants]],
        still=frozenset({(0, j) for j in range(len(point))} | {(1, j) for j in range(len(constants))}),
        rational={(1, j): value for j, value in enumerate(constants)},
    )
