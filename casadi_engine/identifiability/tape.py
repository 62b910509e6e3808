"""A CasADi function as a list of operations on which each result stands once, made for exact arithmetic."""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import isfinite
from typing import Any

import casadi as ca

from casadi_engine.errors import IdentifiabilityError

# An integer power up to this is multiplied out, so that it may be taken of zero.
_MOST_FACTORS = 64

_REBUILD: dict[int, Callable[..., Any]] = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_NEG: operator.neg,
    ca.OP_ADD: operator.add,
    ca.OP_SUB: operator.sub,
    ca.OP_MUL: operator.mul,
    ca.OP_DIV: operator.truediv,
    ca.OP_SQ: lambda a: a**2,
    ca.OP_TWICE: lambda a: 2 * a,
    ca.OP_INV: lambda a: 1 / a,
    ca.OP_SQRT: ca.sqrt,
    ca.OP_EXP: ca.exp,
    ca.OP_LOG: ca.log,
    ca.OP_POW: operator.pow,
    ca.OP_CONSTPOW: operator.pow,
    ca.OP_SIN: ca.sin,
    ca.OP_COS: ca.cos,
    ca.OP_TAN: lambda a: ca.sin(a) / ca.cos(a),
    ca.OP_SINH: lambda a: (ca.exp(a) - ca.exp(-a)) / 2,
    ca.OP_COSH: lambda a: (ca.exp(a) + ca.exp(-a)) / 2,
    ca.OP_TANH: ca.tanh,
    ca.OP_LOG1P: lambda a: ca.log(1 + a),
    ca.OP_EXPM1: lambda a: ca.exp(a) - 1,
    ca.OP_HYPOT: lambda a, b: ca.sqrt(a * a + b * b),
}
_NAMES = {
    value: name.removeprefix("OP_").lower()
    for name, value in vars(ca).items()
    if name.startswith("OP_") and isinstance(value, int)
}
_ADVICE = {
    ca.OP_FABS: "write abs(v) as sqrt(v**2 + e**2) with a small e, or as v where its sign is known",
    ca.OP_SIGN: "write sign(v) as tanh(v/e) with a small e, or as 1 where the sign is known",
    ca.OP_IF_ELSE_ZERO: "test each branch as a model of its own, or join them by (1 + tanh(v/e))/2",
    ca.OP_FMIN: "test each branch as a model of its own, or write a smooth minimum with sqrt",
    ca.OP_FMAX: "test each branch as a model of its own, or write a smooth maximum with sqrt",
}
_SWITCH = "test each side of the switch as a model of its own, or join them by (1 + tanh(v/e))/2"
_SMOOTH = "write it with exp, log, sin, cos, tanh, sqrt and powers"
_SWITCHES = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR}


def exact(value: float) -> Fraction:
    """The rational number that a constant of a model stands for.

    A decimal of up to 12 digits is taken as written, the double next to a simple fraction as that fraction,
    every other double as the dyadic number that it is.

    >>> exact(0.1), exact(1 / 3)
    (Fraction(1, 10), Fraction(1, 3))
    """
    if float(value).is_integer():
        return Fraction(int(value))
    written = Fraction(repr(float(value)))
    if len(str(written.numerator)) <= 12 and len(str(written.denominator)) <= 13:
        return written
    simple = written.limit_denominator(10_000)
    return simple if float(simple) == value else Fraction(value)


@dataclass(frozen=True, eq=False)
class Lifted:
    """Expressions in which constants are symbols, so that no derivative of them is ever rounded.

    expressions : SX, as given; constants : SX column; values : what the constants stand for
    """

    expressions: tuple[Any, ...]
    constants: Any
    values: tuple[Fraction, ...]


def lift(inputs: Sequence[Any], expressions: Sequence[Any], *, where: Sequence[Sequence[str]]) -> Lifted:
    """Replace the constants in expressions (SX columns) of the inputs (SX columns) by symbols.

    where : for every entry of every expression what it is, for messages
    Raises IdentifiabilityError for an operation without an exact rule, by its name.
    """
    function = ca.Function("lifted", list(inputs), [ca.densify(one) for one in expressions])
    entries = [list(ca.vertsplit(column)) if column.numel() else [] for column in inputs]
    found: dict[Fraction, Any] = {}
    work: list[Any] = [None] * function.sz_w()
    made: list[list[Any]] = [[None] * int(one.numel()) for one in expressions]
    exponents = _integer_exponents(function)
    for k in range(function.n_instructions()):
        op, i, o = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_CONST:
            value = function.instruction_constant(k)
            work[o[0]] = value if k in exponents else _constant(value, found)
        elif op == ca.OP_INPUT:
            work[o[0]] = entries[i[0]][i[1]]
        elif op == ca.OP_OUTPUT:
            made[o[0]][o[1]] = work[i[0]]
        elif op in _REBUILD:
            work[o[0]] = _REBUILD[op](*(work[j] for j in i))
        else:
            raise _unsupported(op, expressions, where)
    columns = tuple(ca.vertcat(*(ca.SX(one) for one in rows)) if rows else ca.SX(0, 1) for rows in made)
    symbols = ca.vertcat(*found.values()) if found else ca.SX(0, 1)
    return Lifted(columns, symbols, tuple(found))


def _constant(value: float, found: dict[Fraction, Any]) -> Any:
    if value in (0.0, 1.0, -1.0, 2.0, 0.5):  # what folds without rounding
        return value
    if not isfinite(value):
        raise IdentifiabilityError(
            "the model holds a constant that is not a finite number",
            seen=value,
            allowed="finite numbers",
            cure="look for a division by zero or a missing default",
        )
    number = exact(value)
    if number not in found:
        found[number] = ca.SX.sym(f"constant_{len(found)}")
    return found[number]


def _integer_exponents(function: Any) -> set[int]:
    """The instructions that make a constant which is nothing but an integer exponent."""
    written: dict[int, int] = {}  # place -> instruction that wrote a constant there
    used: dict[int, bool] = {}
    for k in range(function.n_instructions()):
        op, i, o = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op in (ca.OP_CONST, ca.OP_INPUT):
            pass
        else:
            for position, place in enumerate(i):
                if place in written:
                    good = op in (ca.OP_CONSTPOW, ca.OP_POW) and position == 1
                    used[written[place]] = used.get(written[place], True) and good
        if op != ca.OP_OUTPUT:
            for place in o:
                written.pop(place, None)
        if op == ca.OP_CONST and float(function.instruction_constant(k)).is_integer():
            written[o[0]] = k
    return {k for k, good in used.items() if good}


def _unsupported(op: int, expressions: Sequence[Any], where: Sequence[Sequence[str]]) -> IdentifiabilityError:
    name = _NAMES.get(op, f"operation {op}")
    places = []
    for column, names in zip(expressions, where, strict=True):
        for row, place in enumerate(names):
            one = ca.Function("one", ca.symvar(column[row]), [column[row]])
            if any(one.instruction_id(k) == op for k in range(one.n_instructions())):
                places.append(place)
    return IdentifiabilityError(
        f"the exact test has no rule for the operation {name}",
        seen=f"{name} in {', '.join(places[:4])}" if places else name,
        allowed="+ - * /, powers, sqrt, exp, log, sin, cos, tan, sinh, cosh, tanh",
        cure=_ADVICE.get(op, _SWITCH if op in _SWITCHES else _SMOOTH),
    )


Node = tuple[int, int, int, Any]  # operation, operands, payload


class Tape:
    """An SX function in single-assignment form: CasADi reuses its places, this does not.

    code : (operation, first operand, second operand or -1, payload); an input's operands are its argument and entry
    outputs : for each output the node of every structural nonzero
    """

    def __init__(self, function: Any) -> None:
        self.code: list[Node] = []
        self.outputs: list[list[int]] = [[-1] * function.nnz_out(i) for i in range(function.n_out())]
        places: list[int] = [-1] * function.sz_w()
        for k in range(function.n_instructions()):
            op, i, o = (
                function.instruction_id(k),
                function.instruction_input(k),
                function.instruction_output(k),
            )
            if op == ca.OP_OUTPUT:
                self.outputs[o[0]][o[1]] = places[i[0]]
            elif op == ca.OP_INPUT:
                places[o[0]] = self._put((op, i[0], i[1], None))
            elif op == ca.OP_CONST:
                places[o[0]] = self._put((op, -1, -1, function.instruction_constant(k)))
            else:
                places[o[0]] = self._operation(op, [places[j] for j in i])

    @cached_property
    def reach(self) -> list[int]:
        """For every node the inputs that it depends on, as bits: that of input q of `entries` is 1 << q."""
        made: list[int] = []
        for op, a, b, _ in self.code:
            if op == ca.OP_INPUT:
                made.append(1 << self.entries.index((a, b)))
            else:
                made.append((made[a] if a >= 0 else 0) | (made[b] if b >= 0 else 0))
        return made

    @cached_property
    def entries(self) -> list[tuple[int, int]]:
        """The inputs in use, (argument, entry) each."""
        return [(a, b) for op, a, b, _ in self.code if op == ca.OP_INPUT]

    def own_inputs(self, node: int) -> list[tuple[int, int]]:
        """The inputs that this root or quotient depends on, and no root before it."""
        before = 0
        for other, (op, _, _, _) in enumerate(self.code[:node]):
            if op in (ca.OP_SQRT, ca.OP_POW):
                before |= self.reach[other]
        own = self.reach[node] & ~before
        return [entry for q, entry in enumerate(self.entries) if own >> q & 1]

    def _put(self, node: Node) -> int:
        self.code.append(node)
        return len(self.code) - 1

    def _operation(self, op: int, a: list[int]) -> int:
        if op == ca.OP_ASSIGN:
            return a[0]
        if op in (ca.OP_CONSTPOW, ca.OP_POW):
            kind, _, _, value = self.code[a[1]]
            if kind == ca.OP_CONST and float(value).is_integer() and abs(value) <= _MOST_FACTORS:
                return self._integer_power(a[0], int(value))
            return self._put((ca.OP_POW, a[0], a[1], None))
        return self._put((op, a[0], a[1] if len(a) > 1 else -1, None))

    def _integer_power(self, base: int, exponent: int) -> int:
        if exponent < 0:
            return self._put((ca.OP_INV, self._integer_power(base, -exponent), -1, None))
        made = -1
        while exponent:
            if exponent & 1:
                made = base if made < 0 else self._put((ca.OP_MUL, made, base, None))
            exponent >>= 1
            if exponent:
                base = self._put((ca.OP_SQ, base, -1, None))
        return made if made >= 0 else self._put((ca.OP_CONST, -1, -1, 1.0))
