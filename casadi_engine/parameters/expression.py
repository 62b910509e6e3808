"""Text expressions of ties and constraints, read into CasADi by a whitelist, and written back.

The grammar is names, numbers, ``+ - * / **``, unary minus, parentheses, the constant ``pi`` and the
functions of `FUNCTIONS`. Python's own parser makes the tree; nothing of it is ever executed.
"""

from __future__ import annotations

import ast
import functools
import math
import operator
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca

from casadi_engine.errors import ExpressionError, ParameterError
from casadi_engine.parameters.names import near_matches

MAX_LENGTH = 1000
MAX_DEPTH = 40
MAX_POWER = 100

# name -> (function, takes two or more arguments)
FUNCTIONS: dict[str, tuple[Callable[..., Any], bool]] = {
    "sqrt": (ca.sqrt, False),
    "exp": (ca.exp, False),
    "log": (ca.log, False),
    "sin": (ca.sin, False),
    "cos": (ca.cos, False),
    "tan": (ca.tan, False),
    "tanh": (ca.tanh, False),
    "abs": (ca.fabs, False),
    "min": (ca.fmin, True),
    "max": (ca.fmax, True),
}
OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
GRAMMAR = f"names, numbers, + - * / **, parentheses, pi and the functions {', '.join(FUNCTIONS)}"


def parse_expression(
    text: str, symbols: Mapping[str, Any], *, unknown: type[ParameterError] = ExpressionError
) -> Any:
    """Read a text expression into a CasADi SX scalar of `symbols` (name -> SX scalar).

    Raises ExpressionError, which shows the text with a caret under the place, for anything outside the
    grammar, unknown names, more than 1000 characters, more than 40 nested levels, constant powers beyond
    100 and constants that are not finite; an unknown name raises the class `unknown`.

    >>> parse_expression("C_eng/4", {"C_eng": ca.SX.sym("C_eng")})
    SX((C_eng/4))
    """
    if not isinstance(text, str):
        raise ExpressionError(
            "an expression must be text or a CasADi SX scalar",
            seen=type(text).__name__,
            allowed=GRAMMAR,
            cure='write it in quotes, such as "C_eng/4"',
        )
    if len(text) > MAX_LENGTH:
        raise ExpressionError(
            "an expression is too long",
            seen=f"{len(text)} characters",
            allowed=f"at most {MAX_LENGTH}",
            cure="split it with an auxiliary parameter, or give it as a CasADi SX",
        )
    # Python reads a line break as the end of the expression, so blanks of every kind become spaces.
    flat = "".join(" " if letter.isspace() else letter for letter in text).strip()
    return _Reader(flat, symbols, unknown).read()


class _Reader:
    """One reading of one text: walks the syntax tree, keeps the text for messages."""

    def __init__(self, text: str, symbols: Mapping[str, Any], unknown: type[ParameterError]):
        self.text, self.symbols, self.unknown = text, symbols, unknown

    def read(self) -> Any:
        if not self.text:
            raise self.wrong("an expression is empty", 0)
        if "#" in self.text:  # Python would read past it, and half of the expression with it
            raise self.wrong("an expression holds a comment", self.text.index("#"))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # "1if" and the like only warn: here they are mistakes
                tree = ast.parse(self.text, mode="eval")
        except SyntaxError as error:
            column = (error.offset or len(self.text) + 1) - 1  # no place is told when the end is missing
            raise self.wrong("an expression cannot be read", max(column, 0)) from None
        except (ValueError, RecursionError, MemoryError, Warning):
            # null bytes, lone surrogates, absurd nesting, deprecated ways to write numbers
            raise self.wrong("an expression cannot be read", 0) from None
        return ca.SX(self.node(tree.body, 0))

    def node(self, node: ast.AST, depth: int) -> Any:
        if depth > MAX_DEPTH:
            raise self.wrong(f"an expression is nested more than {MAX_DEPTH} levels deep", node)
        match node:
            case ast.Constant():
                return self.number(node)
            case ast.Name() | ast.Attribute():
                return self.name(node)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
                inner = self.node(node.operand, depth + 1)
                return -inner if isinstance(node.op, ast.USub) else inner
            case ast.BinOp():
                return self.chain(node, depth)
            case ast.Call():
                return self.call(node, depth)
            case ast.Compare(left=left, comparators=[right, *_]):
                raise self.wrong("a comparison is outside the grammar", self.between(left, right))
            case ast.BoolOp(values=[left, right, *_]):
                raise self.wrong("and, or are outside the grammar", self.between(left, right))
            case ast.Tuple(elts=[left, right, *_]):
                raise self.wrong(
                    "several expressions are outside the grammar of one", self.between(left, right)
                )
            case ast.Subscript(value=inner):
                raise self.wrong("an expression holds something outside the grammar", self.after(inner))
        raise self.wrong("an expression holds something outside the grammar", node)

    def after(self, node: ast.AST) -> int:
        """The first column after a part of the tree and its closing parentheses."""
        end = self.column(getattr(node, "end_col_offset", 0))
        while end < len(self.text) and self.text[end] in " )":
            end += 1
        return end

    def between(self, left: ast.AST, right: ast.AST) -> int:
        """The column of what stands between two operands."""
        return min(self.after(left), self.column(getattr(right, "col_offset", 0)))

    def column(self, offset: int) -> int:
        """The column of an offset of the syntax tree, which counts the bytes of UTF-8."""
        return len(self.text.encode()[:offset].decode(errors="ignore"))

    def chain(self, node: ast.BinOp, depth: int) -> Any:
        """Read ``a + b + c …``: the tree leans to the left, so a long sum is walked, not recursed into."""
        links: list[ast.BinOp] = []
        left: ast.AST = node
        while isinstance(left, ast.BinOp):
            links.append(left)
            left = left.left
        value = self.node(left, depth + 1)
        for link in reversed(links):
            function = OPERATORS.get(type(link.op))
            if function is None:
                what = "an expression uses an operator outside the grammar"
                power = isinstance(link.op, ast.BitXor)
                raise self.wrong(
                    what, self.between(link.left, link.right), "a power is written **" if power else GRAMMAR
                )
            right = self.node(link.right, depth + 1)
            if isinstance(link.op, ast.Pow) and right.is_constant() and abs(float(right)) > MAX_POWER:
                raise self.wrong(f"a constant power is beyond {MAX_POWER}", link.right)
            value = self.finite(function(value, right), link)
        return value

    def number(self, node: ast.Constant) -> Any:
        value = node.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.wrong("an expression holds something that is not a real number", node)
        try:
            value = float(value)
        except OverflowError:
            value = math.inf
        return self.finite(ca.SX(value), node)

    def name(self, node: ast.AST) -> Any:
        name = _dotted(node)
        if name is None:
            raise self.wrong("an expression holds something outside the grammar", node)
        if name in self.symbols:
            return self.symbols[name]
        if name == "pi":
            return ca.SX(math.pi)
        if name in FUNCTIONS:
            raise self.wrong(f"the function {name} lacks its parentheses", node)
        raise self.wrong(
            f"an expression uses the unknown name {name}",
            node,
            near_matches(name, self.symbols),
            error=self.unknown,
        )

    def call(self, node: ast.Call, depth: int) -> Any:
        if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
            called = _dotted(node.func)
            what = (
                f"the unknown function {called}" if called else "a call of something that is not a function"
            )
            raise self.wrong(f"an expression uses {what}", node)
        function, several = FUNCTIONS[node.func.id]
        if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise self.wrong(f"the function {node.func.id} takes plain arguments alone", node)
        if (len(node.args) < 2) if several else (len(node.args) != 1):
            wanted = "two or more arguments" if several else "one argument"
            raise self.wrong(f"the function {node.func.id} takes {wanted}, not {len(node.args)}", node)
        arguments = [self.node(argument, depth + 1) for argument in node.args]
        value = functools.reduce(function, arguments) if several else function(arguments[0])
        return self.finite(value, node)

    def finite(self, value: Any, node: ast.AST) -> Any:
        """Refuse ``1/0`` and ``sqrt(-1)`` where they stand: later they would only show as a failed fit."""
        if value.is_constant() and not math.isfinite(float(value)):
            raise self.wrong("an expression holds a constant that is not a finite number", node)
        return value

    def wrong(
        self,
        problem: str,
        at: ast.AST | int,
        allowed: str = GRAMMAR,
        *,
        error: type[ParameterError] = ExpressionError,
    ) -> ParameterError:
        column = at if isinstance(at, int) else self.column(getattr(at, "col_offset", 0))
        column = min(column, len(self.text))
        shown = self.text.encode(errors="replace").decode()
        return error(
            problem,
            seen=f"\n  {shown}\n  {' ' * column}^\n",
            allowed=allowed,
            cure="correct the expression at the caret",
        )


def _dotted(node: ast.AST) -> str | None:
    """The dotted name that a tree of attributes spells, or None if it is something else."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        return None
    return ".".join([node.id, *reversed(parts)])


# ---- writing back --------------------

# op code -> (text with the operands in place, binding strength of the whole, of each operand)
_SUM, _PRODUCT, _SIGN, _POWER, _ATOM = 1, 2, 3, 4, 5
_WRITTEN: dict[int, tuple[str, int, tuple[int, ...]]] = {
    ca.OP_ADD: ("{} + {}", _SUM, (_SUM, _PRODUCT)),
    ca.OP_SUB: ("{} - {}", _SUM, (_SUM, _PRODUCT)),
    ca.OP_MUL: ("{}*{}", _PRODUCT, (_PRODUCT, _SIGN)),
    ca.OP_DIV: ("{}/{}", _PRODUCT, (_PRODUCT, _SIGN)),
    ca.OP_NEG: ("-{}", _SIGN, (_POWER,)),
    ca.OP_POW: ("{}**{}", _POWER, (_ATOM, _ATOM)),
    ca.OP_CONSTPOW: ("{}**{}", _POWER, (_ATOM, _ATOM)),
    ca.OP_SQ: ("{}**2", _POWER, (_ATOM,)),
    ca.OP_TWICE: ("2*{}", _PRODUCT, (_SIGN,)),
    ca.OP_INV: ("1/{}", _PRODUCT, (_SIGN,)),
    ca.OP_FMIN: ("min({}, {})", _ATOM, (0, 0)),
    ca.OP_FMAX: ("max({}, {})", _ATOM, (0, 0)),
} | {
    code: (name + "({})", _ATOM, (0,))
    for code, name in {
        ca.OP_SQRT: "sqrt",
        ca.OP_EXP: "exp",
        ca.OP_LOG: "log",
        ca.OP_SIN: "sin",
        ca.OP_COS: "cos",
        ca.OP_TAN: "tan",
        ca.OP_TANH: "tanh",
        ca.OP_FABS: "abs",
    }.items()
}


def write_expression(expression: Any) -> str:
    """Write a CasADi SX scalar as text of the grammar, so that `parse_expression` reads the same value.

    Raises ExpressionError for an operation that the grammar lacks, and for text that the reader's own
    limits would refuse.
    """
    text = _write(expression, 0)[0]
    try:  # one grammar decides, the reader's
        parse_expression(text, {symbol.name(): symbol for symbol in ca.symvar(expression)})
    except ExpressionError as error:
        raise _unwritable(f"{text[:200]} ({error.problem})") from None
    return text


def _write(expression: Any, depth: int) -> tuple[str, int]:
    if depth > MAX_LENGTH // 4:  # a long sum leans to one side; Python's stack is finite
        raise _unwritable(f"more than {MAX_LENGTH // 4} nested operations")
    if expression.is_symbolic():
        return expression.name(), _ATOM
    if expression.is_constant():
        value = float(expression)
        if not math.isfinite(value):
            raise _unwritable(f"the constant {value}")
        text = repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
        return text, _ATOM if value >= 0 else _SIGN
    form = _WRITTEN.get(expression.op())
    if form is None:
        raise _unwritable(f"the operation in {expression}"[:200])
    template, strength, needed = form
    operands = []
    for index, least in enumerate(needed):
        text, own = _write(expression.dep(index), depth + 1)
        operands.append(text if own >= least else f"({text})")
    written = template.format(*operands)
    if len(written) > MAX_LENGTH:
        raise _unwritable(f"an expression of {len(written)} characters or more")
    return written, strength


def _unwritable(seen: str) -> ExpressionError:
    return ExpressionError(
        "a CasADi expression cannot be written as text, and so not be stored",
        seen=seen,
        allowed=f"{GRAMMAR}; at most {MAX_LENGTH} characters",
        cure="write it within the grammar, or keep the set in memory alone",
    )
