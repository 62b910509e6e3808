"""A CasADi function evaluated on whole arrays: its instruction tape replayed with NumPy, one operation a time.

CasADi's virtual machine evaluates one sample after the other; a drive or a friction law over a record of 1e4 samples
is an order of magnitude faster when every instruction works on the array of all samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.simulation.jets import Array

# Columns worked on at a time: the arrays of one instruction then stay in the cache.
_CHUNK = 4096


def _erf(a: Any) -> Any:
    from scipy.special import erf

    return erf(a)


_UNARY: dict[int, Callable[[Any], Any]] = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_NEG: np.negative,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda a: a + a,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_FABS: np.abs,
    ca.OP_SIGN: np.sign,
    ca.OP_ERF: _erf,
    ca.OP_INV: np.reciprocal,
    ca.OP_NOT: lambda a: np.where(a == 0, 1.0, 0.0),
}
_BINARY: dict[int, Callable[[Any, Any], Any]] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_LT: lambda a, b: np.where(a < b, 1.0, 0.0),
    ca.OP_LE: lambda a, b: np.where(a <= b, 1.0, 0.0),
    ca.OP_EQ: lambda a, b: np.where(a == b, 1.0, 0.0),
    ca.OP_NE: lambda a, b: np.where(a != b, 1.0, 0.0),
    ca.OP_AND: lambda a, b: np.where((a != 0) & (b != 0), 1.0, 0.0),
    ca.OP_OR: lambda a, b: np.where((a != 0) | (b != 0), 1.0, 0.0),
    ca.OP_FMOD: np.fmod,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_IF_ELSE_ZERO: lambda a, b: np.where(a != 0, b, 0.0),
}


class ArrayFunction:
    """An SX function of column vectors, evaluated for N columns at once.

    inputs : SX column vectors; outputs : SX matrices. Calling it with one array (rows, N) for each input (or its rows
    in a list), or (rows,) for one that is the same in all columns, gives one array (numel, N) for each output,
    column-major.
    """

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> None:
        dense = [ca.densify(ca.vec(out)) for out in outputs]
        self._function = ca.Function("columns", list(inputs), dense)
        self._rows, self._room = [int(out.numel()) for out in dense], int(self._function.sz_w())
        f = self._function
        code = [
            (f.instruction_id(k), f.instruction_input(k), f.instruction_output(k))
            for k in range(f.n_instructions())
        ]
        known = {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT, *_UNARY, *_BINARY}
        self._replay = all(op in known for op, _, _ in code)
        self._steps = [
            (
                _UNARY.get(op) or _BINARY.get(op),
                f.instruction_constant(k) if op == ca.OP_CONST else 0.0,
                op,
                source,
                target,
            )
            for k, (op, source, target) in enumerate(code)
        ]

    def __call__(self, *arguments: Array | Sequence[Array]) -> list[Array]:
        """Outputs (numel, N) at the arguments (rows, N) or (rows,)."""
        count = max((k for k in map(_columns, arguments) if k is not None), default=1)
        if not self._replay:
            arrays = [a if isinstance(a, np.ndarray) else np.array(a) for a in arguments]
            wide = [a if a.ndim == 2 else np.repeat(a[:, None], count, axis=1) for a in arrays]
            found = self._function.map(count)(*wide)
            parts = found if isinstance(found, (tuple, list)) else (found,)
            return [
                np.asarray(p, dtype=float).reshape(r, count) for p, r in zip(parts, self._rows, strict=True)
            ]
        outputs = [np.zeros((rows, count)) for rows in self._rows]
        with np.errstate(all="ignore"):  # the caller looks for what is not finite
            if count <= _CHUNK:
                self._run(arguments, outputs)
            for k in range(0, count if count > _CHUNK else 0, _CHUNK):
                ask()
                part = slice(k, k + _CHUNK)
                self._run([_part(a, part) for a in arguments], [out[:, part] for out in outputs])
        return outputs

    def bound(self, *last: Array) -> Callable[..., list[Array]]:
        """The function of its first inputs, for few columns in an inner loop, with its last inputs (rows,) put in.

        The first argument holds all columns, (rows, N). What hangs on the bound inputs alone is worked out here.
        Nothing is split, and warnings of what is not finite are the caller's to silence.
        """
        if not self._replay:
            return lambda *first: self(*first, *last)
        return _Bound(self._steps, self._rows, self._function.n_in() - len(last), last).call

    def _run(self, arguments: Sequence[Array | Sequence[Array]], outputs: list[Array]) -> None:
        work: list[Any] = [0.0] * self._room
        for function, constant, op, source, target in self._steps:
            if function is not None:
                work[target[0]] = function(*[work[i] for i in source])
            elif op == ca.OP_INPUT:
                work[target[0]] = arguments[source[0]][source[1]]
            elif op == ca.OP_OUTPUT:
                outputs[target[0]][target[1]] = work[source[0]]
            else:
                work[target[0]] = constant


def _columns(argument: Array | Sequence[Array]) -> int | None:
    """Number of columns of an argument; None of one that is the same in all."""
    if isinstance(argument, np.ndarray):
        return argument.shape[1] if argument.ndim == 2 else None
    return len(argument[0]) if argument else None


def _part(argument: Array | Sequence[Array], columns: slice) -> Array | Sequence[Array]:
    """Some columns of an argument."""
    if isinstance(argument, np.ndarray):
        return argument[:, columns] if argument.ndim == 2 else argument
    return [row[columns] for row in argument]


class _Bound:
    """A tape with some inputs put in; every result has a place of its own, so that known ones are kept."""

    def __init__(self, steps: Sequence[Any], rows: Sequence[int], free: int, last: Sequence[Array]) -> None:
        self._rows = rows
        self._known: list[Any] = []
        self._inputs: list[tuple[int, int, int]] = []
        self._steps: list[tuple[Callable[..., Any], int, int, int]] = []
        self._outputs: list[tuple[int, int, int]] = []
        at: dict[int, int] = {}  # the place of what a register of the tape holds
        for function, constant, op, source, target in steps:
            if op == ca.OP_OUTPUT:
                self._outputs.append((target[0], target[1], at[source[0]]))
                continue
            place = len(self._known)
            if op == ca.OP_INPUT and source[0] < free:
                self._inputs.append((place, source[0], source[1]))
                self._known.append(None)
            elif op == ca.OP_INPUT:
                self._known.append(float(last[source[0] - free][source[1]]))
            elif function is None:
                self._known.append(float(constant))
            else:
                self._operate(function, [at[register] for register in source])
            at[target[0]] = place

    def _operate(self, function: Callable[..., Any], places: list[int]) -> None:
        values = [self._known[place] for place in places]
        if any(value is None for value in values):
            self._steps.append((function, places[0], places[-1] if len(places) > 1 else -1, len(self._known)))
            self._known.append(None)
            return
        with np.errstate(all="ignore"):
            self._known.append(float(function(*values)))

    def call(self, *arguments: Array) -> list[Array]:
        work = self._known.copy()
        for place, source, row in self._inputs:
            work[place] = arguments[source][row]
        for function, one, other, place in self._steps:
            work[place] = function(work[one]) if other < 0 else function(work[one], work[other])
        outputs = [np.empty((rows, arguments[0].shape[1])) for rows in self._rows]
        for output, row, place in self._outputs:
            outputs[output][row] = work[place]
        return outputs
