"""Readable text and LaTeX of CasADi expressions, from their operation tape: never a second copy by hand.

CasADi prints shared parts as @1, @2 and sets a parenthesis around every operation. Here sums and products are
written flat, with the parentheses that are needed, and only large shared parts get a name.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from casadi_engine.model.styles import ATOM, PRODUCT, SUM, TEXT, Piece, Style, signed

# A part that is used more than once and needs more operations than this is written once, under a name.
SHARED_OPERATIONS = 15

_FUNCTIONS = {
    ca.OP_SQRT: "sqrt", ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SIN: "sin", ca.OP_COS: "cos",
    ca.OP_TAN: "tan", ca.OP_ASIN: "asin", ca.OP_ACOS: "acos", ca.OP_ATAN: "atan", ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh", ca.OP_TANH: "tanh", ca.OP_ASINH: "asinh", ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh", ca.OP_FABS: "abs", ca.OP_SIGN: "sign", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil",
    ca.OP_FMIN: "min", ca.OP_FMAX: "max", ca.OP_ATAN2: "atan2", ca.OP_ERF: "erf", ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1", ca.OP_HYPOT: "hypot", ca.OP_FMOD: "fmod", ca.OP_COPYSIGN: "copysign",
    ca.OP_IF_ELSE_ZERO: "if_else_zero", ca.OP_NOT: "not", ca.OP_REMAINDER: "remainder",
    ca.OP_ERFINV: "erfinv",
}  # fmt: skip
_RELATIONS = {
    ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==", ca.OP_NE: "!=", ca.OP_AND: "and", ca.OP_OR: "or",
}  # fmt: skip


@dataclass(frozen=True)
class Node:
    """One operation of the tape: its CasADi code, the numbers of its operands, its value or name."""

    op: int
    args: tuple[int, ...] = ()
    value: float = 0.0
    name: str = ""


@dataclass
class Tape:
    """The operations of some expressions, each different one once, and which are the expressions' roots."""

    nodes: list[Node] = field(default_factory=list)
    roots: list[int] = field(default_factory=list)
    _known: dict[Node, int] = field(default_factory=dict)

    @staticmethod
    def read(expressions: Sequence[Any]) -> Tape:
        """Read scalar SX expressions."""
        column = ca.densify(ca.vertcat(*expressions))
        symbols = ca.symvar(column)
        function = ca.Function("tape", [ca.vertcat(*symbols)] if symbols else [], [column])
        tape = Tape(roots=[-1] * column.numel())
        registers: dict[int, int] = {}
        for index in range(function.n_instructions()):
            op = function.instruction_id(index)
            taken, given = function.instruction_input(index), function.instruction_output(index)
            if op == ca.OP_OUTPUT:
                tape.roots[given[1]] = registers[taken[0]]
            elif op == ca.OP_INPUT:
                registers[given[0]] = tape.add(Node(op, name=symbols[taken[1]].name(), args=(-1 - taken[1],)))
            elif op == ca.OP_CONST:
                registers[given[0]] = tape.add(Node(op, value=function.instruction_constant(index)))
            else:
                operands = tuple(registers[register] for register in taken)
                registers[given[0]] = tape.add(Node(op, operands))
        return tape

    def add(self, node: Node) -> int:
        """Return the number of `node`, which is added if it is new."""
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return self._known[node]

    def operands(self, number: int) -> tuple[int, ...]:
        """The numbers of a node's operands; none for a symbol or constant."""
        return () if self.nodes[number].op in (ca.OP_INPUT, ca.OP_CONST) else self.nodes[number].args

    def below(self, roots: Iterable[int]) -> set[int]:
        """The nodes that these roots are made of, themselves included."""
        found: set[int] = set()
        waiting = list(roots)
        while waiting:
            number = waiting.pop()
            if number not in found:
                found.add(number)
                waiting.extend(self.operands(number))
        return found

    def shared(self, among: set[int], *, least: int, cut: Container[int]) -> list[int]:
        """The nodes used more than once and larger than `least` operations as they are written.

        A part with a name (in `cut`, or shared itself) counts as one symbol. The list rises, so that a part
        comes before those that use it.
        """
        uses: Counter[int] = Counter()
        for number in among:
            uses.update(set(self.operands(number)))
        size: dict[int, int] = {}
        found: list[int] = []
        for number in sorted(among):  # operands always come before what is made of them
            below = self.operands(number)
            size[number] = sum(size[operand] for operand in below) + (1 if below else 0)
            if number in cut:
                size[number] = 0
            # A sign is not worth a name: the part under it is.
            elif uses[number] > 1 and size[number] > least and self.nodes[number].op != ca.OP_NEG:
                found.append(number)
                size[number] = 0
        return found


class Writer:
    """Writes the expressions of a tape in a style; the parts in `named` by their names."""

    def __init__(self, tape: Tape, style: Style, named: Mapping[int, str]):
        self.tape, self.style, self.named = tape, style, named

    def write(self, number: int, *, top: bool = False) -> Piece:
        """Write a node; at the `top` of a definition it is written out even if it has a name."""
        if self._is_named(number, top):
            return Piece(self.style.symbol(self.named[number]), ATOM)
        op = self.tape.nodes[number].op
        if op in (ca.OP_ADD, ca.OP_SUB):
            return self._sum(number, top)
        if op in (ca.OP_MUL, ca.OP_DIV, ca.OP_NEG, ca.OP_INV, ca.OP_TWICE):
            return self._product(number, top)
        return self._other(number)

    def _is_named(self, number: int, top: bool) -> bool:
        return number in self.named and not top

    def _sum(self, number: int, top: bool) -> Piece:
        text = ""
        for negative, term in self._terms(number, False, top):
            piece = self.write(term)
            minus = negative != piece.negative
            unsigned = self.style.bracket(Piece(piece.text, piece.level), PRODUCT)
            text += ((" - " if minus else " + ") if text else ("-" if minus else "")) + unsigned
        return Piece(text, SUM)

    def _terms(self, number: int, negative: bool, top: bool = False) -> Iterator[tuple[bool, int]]:
        """The terms of a flat sum, each with its sign."""
        op, args = self.tape.nodes[number].op, self.tape.operands(number)
        if self._is_named(number, top) or op not in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG):
            yield negative, number
        elif op == ca.OP_NEG:
            yield from self._terms(args[0], not negative)
        else:
            yield from self._terms(args[0], negative)
            yield from self._terms(args[1], negative != (op == ca.OP_SUB))

    def _product(self, number: int, top: bool) -> Piece:
        factors = _Factors()
        self._collect(number, factors, inverse=False, top=top)
        above = [self.write(factor) for factor in factors.above]
        below = [self.write(factor) for factor in factors.below]
        negative = factors.negative
        if factors.constant_above != 1 or not above:
            above.insert(0, self.style.number(factors.constant_above))
        if factors.constant_below != 1:
            below.insert(0, self.style.number(factors.constant_below))
        # Signs of the factors count for the product as a whole.
        negative ^= sum(piece.negative for piece in above + below) % 2 == 1
        whole = self.style.fraction(_unsigned(above), _unsigned(below))
        if negative and whole.level < PRODUCT:  # the sign is of the whole sum
            return Piece(self.style.bracket(whole, PRODUCT), PRODUCT, True)
        return Piece(whole.text, whole.level, negative)

    def _collect(self, number: int, factors: _Factors, *, inverse: bool, top: bool = False) -> None:
        """Sort the factors of a flat product above and below the fraction bar."""
        node, args = self.tape.nodes[number], self.tape.operands(number)
        if not self._is_named(number, top):
            if node.op == ca.OP_CONST and math.isfinite(node.value) and node.value != 0:
                factors.multiply(node.value, inverse)
                return
            if node.op == ca.OP_TWICE:
                factors.multiply(2.0, inverse)
            if node.op == ca.OP_NEG:
                factors.negative = not factors.negative
            if node.op in (ca.OP_NEG, ca.OP_TWICE, ca.OP_INV):
                self._collect(args[0], factors, inverse=inverse != (node.op == ca.OP_INV))
                return
            if node.op in (ca.OP_MUL, ca.OP_DIV):
                self._collect(args[0], factors, inverse=inverse)
                self._collect(args[1], factors, inverse=inverse != (node.op == ca.OP_DIV))
                return
        (factors.below if inverse else factors.above).append(number)

    def _other(self, number: int) -> Piece:
        node = self.tape.nodes[number]
        if node.op == ca.OP_INPUT:
            return Piece(self.style.symbol(node.name), ATOM)
        if node.op == ca.OP_CONST:
            return self.style.number(node.value)
        args = [self.write(operand) for operand in node.args]
        if node.op == ca.OP_SQ:
            return self.style.power(args[0], self.style.number(2.0))
        if node.op in (ca.OP_POW, ca.OP_CONSTPOW):
            return self.style.power(args[0], args[1])
        if node.op in _RELATIONS:
            return self.style.relation(_RELATIONS[node.op], args[0], args[1])
        return self.style.function(_FUNCTIONS.get(node.op, f"operation_{node.op}"), args)


@dataclass
class _Factors:
    """The factors of a product: nodes and constants above and below the fraction bar, and the sign."""

    above: list[int] = field(default_factory=list)
    below: list[int] = field(default_factory=list)
    constant_above: float = 1.0
    constant_below: float = 1.0
    negative: bool = False

    def multiply(self, value: float, inverse: bool) -> None:
        """Take a constant in; its sign counts for the product."""
        self.negative ^= value < 0
        if inverse:
            self.constant_below *= abs(value)
        else:
            self.constant_above *= abs(value)


def _unsigned(pieces: Sequence[Piece]) -> list[Piece]:
    return [Piece(piece.text, piece.level) for piece in pieces]


@dataclass(frozen=True)
class Written:
    """Texts of expressions, in order, and the definitions of the shared parts that they use."""

    texts: tuple[str, ...]
    shared: tuple[tuple[str, str], ...]


def write_expressions(
    expressions: Sequence[Any],
    *,
    style: Style = TEXT,
    named: Mapping[str, Any] | None = None,
    shared_operations: int = SHARED_OPERATIONS,
) -> Written:
    """Write scalar SX expressions as text (or LaTeX, with `style=LATEX`).

    named : names for parts of the expressions (scalar SX) that are always written by name, where they occur
    Other parts that are used more than once and take more than `shared_operations` operations are named
    z1, z2, … All of these are written once, in `shared` as (name as written, text).

    >>> x, k = ca.SX.sym("x"), ca.SX.sym("k")
    >>> write_expressions([-k * (x - 1) / 2 + ca.sin(x - 3 * math.pi) ** 2]).texts
    ('sin(x - 3*pi)**2 - k*(x - 1)/2',)
    """
    wanted = dict(named or {})
    tape = Tape.read([*expressions, *wanted.values()])
    roots = tape.roots[: len(expressions)]
    used = tape.below(roots)
    by_name = {
        root: name for root, name in zip(tape.roots[len(roots) :], wanted, strict=True) if root in used
    }
    taken = {node.name for node in tape.nodes} | set(wanted)
    names = (name for name in (f"z{index}" for index in range(1, 10**6)) if name not in taken)
    for number in tape.shared(used, least=shared_operations, cut=by_name):
        by_name[number] = next(names)
    writer = Writer(tape, style, by_name)
    return Written(
        tuple(signed(writer.write(root, top=root not in by_name)) for root in roots),
        tuple(
            (style.symbol(by_name[part]), signed(writer.write(part, top=True))) for part in sorted(by_name)
        ),
    )
