"""The signals of a law: the few linear combinations of states that it depends on.

A friction law of a coupling sees two speeds, but only by their difference. The integrator's work grows with the number
of signals, so the combinations are read off the law's own expression graph: as long as an operation keeps a value
affine in the states with constant factors, the factors are carried along; the first operation that does not makes
the value a signal.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.jets import Array

# A combination counts as one of those found before if what is left of it is below this share.
_TOLERANCE = 1e-12


def signals(expression: ca.SX, x: ca.SX, others: ca.SX) -> Array:
    """(s, n) independent rows q such that ``expression`` (nw, 1) depends on x by q x alone.

    expression : in x : (n, 1) and ``others`` : (k, 1) symbols
    """
    function = ca.Function("laws", [x, others], [ca.densify(expression)])
    rows: list[Array] = []
    for direction in _directions(function, int(x.numel())):
        if _is_new(direction, rows):
            rows.append(direction / direction[np.flatnonzero(direction)[0]])
    return np.array(rows).reshape(len(rows), int(x.numel()))


def lift(rows: Array) -> Array:
    """(n, s) a right inverse of the signals' rows with zeros where it can have them: x = lift(q) s gives q x = s."""
    count, n = rows.shape
    chosen: list[int] = []
    left = rows.copy()
    for _ in range(count):
        # Pivots by column: the columns taken are the states that stand for the signals.
        size = np.abs(left)
        row, column = np.unravel_index(int(np.argmax(size)), size.shape)
        chosen.append(int(column))
        left = left - np.outer(left[:, column], left[row]) / left[row, column]
        left[row] = 0.0
    inverse = np.zeros((n, count))
    inverse[chosen] = np.linalg.inv(rows[:, chosen])
    inverse[np.abs(inverse) < _TOLERANCE] = 0.0
    return inverse


def _is_new(direction: Array, rows: list[Array]) -> bool:
    if not rows:
        return True
    known = np.array(rows)
    share = np.linalg.lstsq(known.T, direction, rcond=None)[0]
    return bool(np.abs(direction - share @ known).max() > _TOLERANCE * np.abs(direction).max())


def _directions(function: ca.Function, n: int) -> list[Array]:
    """Factors (n,) of every value affine in x that enters an operation that is not."""
    none, found = np.zeros(n), []
    # For each work element: its factors of x, and its value if it is a number.
    factors: list[Array] = [none] * function.sz_w()
    numbers: list[float | None] = [None] * function.sz_w()
    for k in range(function.n_instructions()):
        op, source, target = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if op == ca.OP_INPUT:
            factor = none.copy()
            if source[0] == 0:
                factor[source[1]] = 1.0
            factors[target[0]], numbers[target[0]] = factor, None
        elif op == ca.OP_CONST:
            factors[target[0]], numbers[target[0]] = none, function.instruction_constant(k)
        elif op == ca.OP_OUTPUT:
            found.append(factors[source[0]])
        else:
            used = [factors[i] for i in source]
            factor_or_none = _affine(op, used, [numbers[i] for i in source])
            if factor_or_none is None:
                found += used
            factors[target[0]] = none if factor_or_none is None else factor_or_none
            numbers[target[0]] = None
    return [factor for factor in found if factor.any()]


def _affine(op: int, used: list[NDArray[np.float64]], numbers: list[float | None]) -> Array | None:
    """Factors of the result of an operation that keeps values affine, None if it does not."""
    if not any(factor.any() for factor in used):
        return used[0]
    if op == ca.OP_ASSIGN:
        return used[0]
    if op == ca.OP_NEG:
        return -used[0]
    if op == ca.OP_TWICE:
        return 2 * used[0]
    if op == ca.OP_ADD:
        return used[0] + used[1]
    if op == ca.OP_SUB:
        return used[0] - used[1]
    if op == ca.OP_MUL and numbers[0] is not None:
        return numbers[0] * used[1]
    if op == ca.OP_MUL and numbers[1] is not None:
        return numbers[1] * used[0]
    if op == ca.OP_DIV and numbers[1]:
        return used[0] / numbers[1]
    return None
