"""The signals of a law: the few linear combinations of states that it depends on.

A friction law of a coupling sees two speeds, but only by their difference. The integrator's work grows with the number
of signals, so the law's own expression graph is followed: as long as an operation keeps a value affine in the states
with constant factors, the factors are carried along; the first operation that does not sees the value as a signal.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_engine.simulation.jets import Array

# What is left of a combination, or its share of another, counts as nothing below this.
_TOLERANCE = 1e-12


def in_signals(expression: ca.SX, x: ca.SX, others: ca.SX) -> tuple[Array, ca.SX, ca.SX]:
    """Rows q (ns, n), independent of each other, symbols s (ns, 1), and ``expression`` with s in place of q x.

    expression : (nw, 1) in x : (n, 1) and ``others`` : (k, 1), all SX
    """
    found = _Signals(int(x.numel()))
    function = ca.Function("laws", [x, others], [ca.densify(expression)])
    # Each work element is factors @ x + rest; factors None: they are all zero.
    work: list[tuple[Array | None, ca.SX]] = [(None, ca.SX(0))] * function.sz_w()
    results = [ca.SX(0)] * int(expression.numel())
    for k in range(function.n_instructions()):
        op, source, target = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if op == ca.OP_INPUT and source[0] == 0:
            work[target[0]] = (np.eye(1, found.states, source[1])[0], ca.SX(0))
        elif op == ca.OP_INPUT:
            work[target[0]] = (None, others[source[1]])
        elif op == ca.OP_CONST:
            work[target[0]] = (None, ca.SX(function.instruction_constant(k)))
        elif op == ca.OP_OUTPUT:
            results[target[1]] = found.value(*work[source[0]])
        else:
            work[target[0]] = _operated(op, [work[i] for i in source], found)
    rows = np.array(found.rows).reshape(len(found.rows), found.states)
    return rows, ca.vertcat(ca.SX(0, 1), *found.symbols), ca.vertcat(*results)


class _Signals:
    """The signals found so far."""

    def __init__(self, states: int) -> None:
        self.states = states
        self.rows: list[Array] = []
        self.symbols: list[ca.SX] = []

    def value(self, factors: Array | None, rest: ca.SX) -> ca.SX:
        """factors @ x + rest as an expression in signals; a combination not seen before is a new signal."""
        if factors is None or not factors.any():
            return rest
        share: Array = np.zeros(0)
        if self.rows:
            known = np.array(self.rows)
            share = np.asarray(np.linalg.lstsq(known.T, factors, rcond=None)[0], dtype=np.float64)
            share[np.abs(share) < _TOLERANCE * np.abs(share).max()] = 0.0
            left = np.abs(factors - share @ known).max()
        if not self.rows or left > _TOLERANCE * np.abs(factors).max():
            first = factors[np.flatnonzero(factors)[0]]
            self.rows.append(factors / first)
            self.symbols.append(ca.SX.sym(f"s{len(self.rows)}"))
            share = np.append(np.zeros(len(self.rows) - 1), first)
        total = rest
        for part, symbol in zip(share, self.symbols, strict=True):
            if part:
                total = total + part * symbol
        return total


def _operated(op: int, used: list[tuple[Array | None, ca.SX]], found: _Signals) -> tuple[Array | None, ca.SX]:
    """The result of one operation: still affine in x where the operation keeps it so, else without factors."""
    factors = [part[0] for part in used]
    if any(part is not None for part in factors):
        kept = _affine(op, used)
        if kept is not None:
            rests = [part[1] for part in used]
            return kept, ca.SX.unary(op, *rests) if len(rests) == 1 else ca.SX.binary(op, *rests)
    values = [found.value(*part) for part in used]
    return None, ca.SX.unary(op, *values) if len(values) == 1 else ca.SX.binary(op, *values)


def _affine(op: int, used: list[tuple[Array | None, ca.SX]]) -> Array | None:
    """Factors of the result of an operation that keeps values affine with constant factors, None if it does not."""
    rows = [np.zeros(1) if factors is None else factors for factors, _ in used]
    numbers = [float(rest) if factors is None and rest.is_constant() else None for factors, rest in used]
    if op == ca.OP_ASSIGN:
        return rows[0]
    if op == ca.OP_NEG:
        return -rows[0]
    if op == ca.OP_TWICE:
        return 2 * rows[0]
    if op == ca.OP_ADD:
        return rows[0] + rows[1]
    if op == ca.OP_SUB:
        return rows[0] - rows[1]
    if op == ca.OP_MUL and numbers[0] is not None:
        return numbers[0] * rows[1]
    if op == ca.OP_MUL and numbers[1] is not None:
        return numbers[1] * rows[0]
    if op == ca.OP_DIV and numbers[1]:
        return rows[0] / numbers[1]
    return None
