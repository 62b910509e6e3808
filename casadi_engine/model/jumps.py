"""Where an expression jumps or has a kink, and the same expression with its jumps held.

CasADi's derivative of ``sign``, ``floor``, a comparison or the condition of an ``if_else`` is 0, so that neither a
Jacobian nor ``ca.is_linear`` sees them. Here the operations of the expression are followed one by one.

A switching function g is smooth between events; an event is where it passes 0 (or a whole number, for ``floor``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import nan, pi
from typing import Any

import casadi as ca

_COMPARISONS = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE)
_LOGIC = (ca.OP_NOT, ca.OP_AND, ca.OP_OR)
_ROUNDED = (ca.OP_FLOOR, ca.OP_CEIL, ca.OP_FMOD, ca.OP_REMAINDER)
_SIGNS = (ca.OP_SIGN, ca.OP_COPYSIGN, ca.OP_IF_ELSE_ZERO, ca.OP_ATAN2)
_NO_SIDES = nan, nan
_KINKS = frozenset((ca.OP_FABS, ca.OP_FMIN, ca.OP_FMAX))
_JUMPS = frozenset((*_COMPARISONS, *_LOGIC, *_ROUNDED, *_SIGNS))


@dataclass(frozen=True, eq=False)
class Switch:
    """One switching function.

    g : SX scalar
    kind : "jump", the expression jumps at g = 0; "integer", it jumps where g is a whole number; "kink", it is
        continuous at g = 0 and its slope jumps
    """

    g: Any
    kind: str

    @property
    def function(self) -> Any:
        """SX scalar that changes its sign at every event: g, or sin(π g) for the kind "integer"."""
        return ca.sin(pi * self.g) if self.kind == "integer" else self.g


@dataclass(frozen=True, eq=False)
class Held:
    """An expression whose jumps and kinks are replaced by symbols b, so that it is smooth at given b.

    expression : SX as the one given, smooth in all symbols but b
    symbols : (k, 1) SX b; `values` : (k, 1) SX what they stand for, in the symbols of the given expression:
        with b = values both expressions are equal. Between two events the values are constants.
    switches : the distinct switching functions, in the given symbols and in b (a condition may depend on another)
    at : (k,) for each b the index of the switch at whose events it changes; sides : (k,) its values where that
        switching function is negative and where it is positive, nan for whole numbers
    """

    expression: Any
    symbols: Any
    values: Any
    switches: tuple[Switch, ...]
    at: tuple[int, ...]
    sides: tuple[tuple[float, float], ...]


def jumps(expression: Any, of: Any = None) -> list[Switch]:
    """The distinct switching functions of an SX expression, in its own symbols; empty for a smooth one.

    of : SX column; only the switches that depend on these symbols (default: on any)

    >>> w = ca.SX.sym("w")
    >>> [(switch.g, switch.kind) for switch in jumps(ca.if_else(w > 2, -3.0, 3.0) * ca.fabs(w))]
    [(SX((2-w)), 'jump'), (SX(w), 'kink')]
    """
    if not _has(expression, _JUMPS | _KINKS):
        return []
    holder = _Holder(of)
    holder.follow(expression)
    return [Switch(plain, kind) for plain, _, kind in holder.switches]


def with_held_jumps(expression: Any, of: Any = None, *, products: bool = False) -> Held:
    """An SX expression with a symbol in place of what jumps; see `Held`.

    of : SX column; only the jumps that depend on these symbols (default: on any)
    products : truth values are multiplied with, so that they may be anything between 0 and 1

    >>> w = ca.SX.sym("w")
    >>> held = with_held_jumps(-3 * ca.sign(w) - w)
    >>> held.expression, held.symbols, held.values
    (SX(((-3*b0)-w)), SX(b0), SX(sign(w)))
    """
    holder = _Holder(of, products=products)
    smooth = holder.follow(expression)
    return Held(
        smooth,
        ca.vertcat(ca.SX(0, 1), *holder.symbols),
        ca.vertcat(ca.SX(0, 1), *holder.values),
        tuple(Switch(held, kind) for _, held, kind in holder.switches),
        tuple(holder.at),
        tuple(holder.sides),
    )


def jumps_in(expression: Any, of: Any) -> bool:
    """True if a jump (a kink is none) in the SX expression depends on one of the symbols `of`."""
    if not _has(expression, _JUMPS):
        return False
    code, symbols, _ = _operations(expression)
    inside = _hashes(of)
    reached: list[bool] = []
    for op, operands, payload in code:
        if op == ca.OP_INPUT:
            reached.append(symbols[payload].element_hash() in inside)
            continue
        found = any(reached[k] for k in operands)
        if op == ca.OP_IF_ELSE_ZERO:
            jump = reached[operands[0]]
        elif op in _JUMPS:
            jump = found
        else:
            jump = False
        if jump:
            return True
        reached.append(found)
    return False


def has_jumps(expression: Any) -> bool:
    """True if the SX expression jumps (a kink is no jump) in any of its symbols."""
    return _has(expression, _JUMPS)


def _has(expression: Any, operations: frozenset[int]) -> bool:
    # free symbols: what the operations are does not depend on which inputs a function has
    function = ca.Function("operations", [], [expression], {"allow_free": True})
    return any(function.instruction_id(k) in operations for k in range(function.n_instructions()))


def _hashes(column: Any) -> set[int]:
    return {symbol.element_hash() for symbol in ca.symvar(column)} if column.numel() else set()


def _function(expression: Any) -> Any:
    """The CasADi function of all symbols of an SX expression, in the order of `ca.symvar`."""
    symbols = ca.vertcat(ca.SX(0, 1), *ca.symvar(expression))
    return ca.Function("operations", [symbols], [ca.densify(ca.vec(expression))])


# operation, operands as indices of operations before it, index of the symbol or value of the constant
_Operation = tuple[int, tuple[int, ...], Any]


def _operations(expression: Any) -> tuple[list[_Operation], list[Any], list[int]]:
    """The operations of an SX expression, each result once; its symbols; and for each entry its operation."""
    symbols, function = ca.symvar(expression), _function(expression)
    code: list[_Operation] = []
    known: dict[_Operation, int] = {}
    places: list[int] = [-1] * function.sz_w()
    outputs = [-1] * function.numel_out(0)
    for k in range(function.n_instructions()):
        op, source, target = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if op == ca.OP_OUTPUT:
            outputs[target[1]] = places[source[0]]
            continue
        if op == ca.OP_INPUT:
            made: _Operation = (op, (), source[1])
        elif op == ca.OP_CONST:
            made = (op, (), function.instruction_constant(k))
        else:
            made = (op, tuple(places[i] for i in source), None)
        if made not in known:
            known[made] = len(code)
            code.append(made)
        places[target[0]] = known[made]
    return code, symbols, outputs


class _Holder:
    """Follows an expression; `plain` are its values as they are, `held` those with its jumps held.

    A value moves if it depends on symbols in question other than by held jumps: only what moves can switch.
    """

    def __init__(self, of: Any = None, *, products: bool = False) -> None:
        self._of = None if of is None else _hashes(of)
        self._products = products
        self.sides: list[tuple[float, float]] = []
        self.symbols: list[Any] = []
        self.values: list[Any] = []
        self.at: list[int] = []
        self.switches: list[tuple[Any, Any, str]] = []
        self._known: dict[Any, int] = {}
        self._plain: list[Any] = []
        self._held: list[Any] = []
        self._moves: list[bool] = []
        self._constants: dict[int, float] = {}
        self._once: dict[Any, Any] = {}

    def follow(self, expression: Any) -> Any:
        """The expression with its jumps held."""
        code, symbols, outputs = _operations(expression)
        for op, operands, payload in code:
            if op == ca.OP_INPUT:
                symbol = symbols[payload]
                moves = self._of is None or symbol.element_hash() in self._of
                self._put(symbol, symbol, moves)
            elif op == ca.OP_CONST:
                self._constants[len(self._plain)] = float(payload)
                self._put(ca.SX(payload), ca.SX(payload), False)
            else:
                plain = _operated(op, [self._plain[k] for k in operands])
                held, moves = self._operation(op, operands)
                self._put(plain, held, moves)
        made = [self._held[k] for k in outputs]
        return ca.reshape(ca.vertcat(ca.SX(0, 1), *made), expression.shape)

    def _put(self, plain: Any, held: Any, moves: bool) -> None:
        self._plain.append(plain)
        self._held.append(held)
        self._moves.append(moves)

    def _operation(self, op: int, k: tuple[int, ...]) -> tuple[Any, bool]:
        """The held value of an operation, and whether it moves."""
        h, moves = [self._held[i] for i in k], [self._moves[i] for i in k]
        if self._products:
            made = self._smoothed(op, k, h, moves)
            if made is not None:
                return made
        if not any(moves):
            return _operated(op, h), False
        if op == ca.OP_SIGN:
            return self._symbol(ca.sign, "jump", k), False
        if op in _COMPARISONS:
            return self._symbol(lambda a, b: ca.SX.binary(op, a, b), "jump", k), False
        if op in (ca.OP_FLOOR, ca.OP_CEIL):
            return self._symbol(lambda a: ca.SX.unary(op, a), "integer", k), False
        if op in _LOGIC:
            return _operated(op, [self._truth(i) for i in k]), False
        if op == ca.OP_IF_ELSE_ZERO:
            return _operated(op, [self._truth(k[0]), h[1]]), moves[1]
        if op in (ca.OP_FMOD, ca.OP_REMAINDER):
            return h[0] - h[1] * self._whole(op, k), True
        if op == ca.OP_FABS:
            return h[0] * self._side(k[0], "kink"), True
        if op in (ca.OP_FMIN, ca.OP_FMAX):
            least = op == ca.OP_FMIN
            first = self._symbol(lambda a, b: a < b if least else a > b, "kink", k)
            return ca.if_else(first, h[0], h[1]), True
        if op == ca.OP_COPYSIGN:
            size = h[0] * self._side(k[0], "kink") if moves[0] else ca.fabs(h[0])
            return size * (self._side(k[1], "jump") if moves[1] else ca.copysign(1, h[1])), moves[0]
        if op == ca.OP_ATAN2:
            return self._angle(k), True
        return _operated(op, h), True

    def _smoothed(
        self, op: int, k: tuple[int, ...], h: list[Any], moves: list[bool]
    ) -> tuple[Any, bool] | None:
        """What is made of truth values between 0 and 1; kinks stay as they are. None for other operations."""
        if op in (ca.OP_FABS, ca.OP_FMIN, ca.OP_FMAX):
            return _operated(op, h), any(moves)
        if op not in (*_LOGIC, ca.OP_IF_ELSE_ZERO):
            return None
        held = ca.vertcat(ca.SX(0, 1), *self.symbols)
        count = 1 if op == ca.OP_IF_ELSE_ZERO else len(k)
        if not any(self._moves[i] or ca.depends_on(self._held[i], held) for i in k[:count]):
            return None
        truth = [self._truth(i) for i in k[:count]]
        if op == ca.OP_NOT:
            return 1 - truth[0], False
        if op == ca.OP_IF_ELSE_ZERO:
            return truth[0] * h[1], moves[1]
        both = truth[0] * truth[1]
        return (both if op == ca.OP_AND else truth[0] + truth[1] - both), False

    def _angle(self, k: tuple[int, ...]) -> Any:
        """atan2(a, b), which jumps by 2π at a = 0 where b < 0, continued beyond that."""
        a, b = (self._held[i] for i in k)
        side = self._side(k[0], "jump") if self._moves[k[0]] else ca.copysign(1, a)
        return ca.if_else(b < 0, ca.atan2(-a, -b) + pi * side, ca.atan2(a, b))

    def _truth(self, k: int) -> Any:
        """A value that is taken as true or false."""
        if not self._moves[k]:
            return self._held[k]
        if ("truth", k) not in self._once:
            self._once["truth", k] = self._symbol(lambda a: a != 0, "jump", (k,))
        return self._once["truth", k]

    def _side(self, k: int, kind: str) -> Any:
        """-1 or 1, also at 0."""
        return self._symbol(lambda a: ca.copysign(1, a), kind, (k,))

    def _whole(self, op: int, k: tuple[int, ...]) -> Any:
        """The number of whole divisors that a remainder leaves out: truncated, or rounded to the nearest."""
        shift = 0.5 if op == ca.OP_REMAINDER else 0.0
        plain, held = (values[k[0]] / values[k[1]] + shift for values in (self._plain, self._held))
        a, b = (self._plain[i] for i in k)
        whole = ca.floor((a - ca.SX.binary(op, a, b)) / b + 0.5)  # a whole number but for rounding
        return self._new(whole, self._switch(("quotient", k, shift), plain, held, "integer"), _NO_SIDES)

    def _symbol(self, value: Callable[..., Any], kind: str, k: tuple[int, ...]) -> Any:
        """A new symbol for a value that switches where its operand, or the difference of both, passes 0."""
        zero = [i for i in k if self._constants.get(i) == 0]
        pair = tuple(sorted(set(k) - set(zero))) if len(k) == 2 else k
        plain, held = (
            values[pair[0]] - values[pair[1]] if len(pair) == 2 else values[pair[0]]
            for values in (self._plain, self._held)
        )
        made = value(*[self._plain[i] for i in k])
        sides = _NO_SIDES
        if kind != "integer":
            low, high = (float(value(*[ca.SX(side if i == pair[0] else 0) for i in k])) for side in (-1, 1))
            sides = low, high
        return self._new(made, self._switch((kind == "integer", pair), plain, held, kind), sides)

    def _switch(self, key: Any, plain: Any, held: Any, kind: str) -> int:
        """Index of a switching function; one that is there as a kink becomes a jump if it is that too."""
        if key not in self._known:
            self._known[key] = len(self.switches)
            self.switches.append((plain, held, kind))
        index = self._known[key]
        if kind == "jump":
            self.switches[index] = (*self.switches[index][:2], kind)
        return index

    def _new(self, value: Any, switch: int, sides: tuple[float, float]) -> Any:
        symbol = ca.SX.sym(f"b{len(self.symbols)}")
        self.symbols.append(symbol)
        self.values.append(value)
        self.at.append(switch)
        self.sides.append(sides)
        return symbol


def _operated(op: int, values: list[Any]) -> Any:
    return ca.SX.unary(op, *values) if len(values) == 1 else ca.SX.binary(op, *values)
