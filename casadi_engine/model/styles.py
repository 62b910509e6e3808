"""How symbols, numbers, fractions, powers and functions are written: as plain text or as LaTeX."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol

# How tightly the outermost operation of a text binds.
RELATION, SUM, PRODUCT, POWER, ATOM = 0, 1, 2, 3, 4

# Multiples of π are recognised up to this denominator.
PI_DENOMINATOR = 12

_GREEK = re.compile(
    "alpha|beta|gamma|delta|epsilon|zeta|eta|theta|iota|kappa|lambda|mu|nu|xi|rho|sigma|tau|phi|chi|psi|omega|"
    "Gamma|Delta|Theta|Lambda|Xi|Pi|Sigma|Phi|Psi|Omega|pi"
)
_LATEX_FUNCTIONS = ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "min", "max")
_LATEX_NAMES = {"asin": r"\arcsin", "acos": r"\arccos", "atan": r"\arctan"}
_LATEX_RELATIONS = {"<=": r"\le", "==": "=", "!=": r"\ne", "and": r"\wedge", "or": r"\vee"}


@dataclass(frozen=True)
class Piece:
    """A written part: its text without sign, the level of its outermost operation, whether it is negative."""

    text: str
    level: int
    negative: bool = False


class Style(Protocol):
    """What a writer needs to know of a form of print."""

    def symbol(self, name: str) -> str: ...
    def number(self, value: float) -> Piece: ...
    def bracket(self, piece: Piece, least: int) -> str: ...
    def fraction(self, above: Sequence[Piece], below: Sequence[Piece]) -> Piece: ...
    def power(self, base: Piece, exponent: Piece) -> Piece: ...
    def function(self, name: str, arguments: Sequence[Piece]) -> Piece: ...
    def relation(self, name: str, left: Piece, right: Piece) -> Piece: ...
    def derivative(self, name: str) -> str: ...
    def remark(self, words: str) -> str: ...


def signed(piece: Piece) -> str:
    """The text of a piece with its sign."""
    return ("-" if piece.negative else "") + piece.text


def _pi_multiple(value: float) -> Fraction | None:
    """The fraction of which `value` > 0 is the multiple of π to the last digits, or None."""
    if not 1e-3 < value < 1e3:
        return None
    ratio = Fraction(value / math.pi).limit_denominator(PI_DENOMINATOR)
    return ratio if ratio and abs(float(ratio) * math.pi - value) <= 4e-16 * value else None


def _digits(value: float) -> str:
    """The shortest text that reads back as `value` to 15 digits, as sums and squares are rounded in the last one; whole
    numbers without a point."""
    return str(int(value)) if value.is_integer() and value < 1e15 else repr(float(f"{value:.15g}"))


class TextStyle:
    """Plain text in the notation of Python, which the expressions of constraints read as well."""

    def symbol(self, name: str) -> str:
        """The name as it is."""
        return name

    def number(self, value: float) -> Piece:
        """A number, multiples of π as such."""
        size, negative = abs(value), math.copysign(1, value) < 0
        if not math.isfinite(value):
            return Piece("nan" if math.isnan(value) else "inf", ATOM, negative)
        multiple = _pi_multiple(size)
        if multiple is None:
            return Piece(_digits(size), ATOM, negative and value != 0)
        above = "pi" if multiple.numerator == 1 else f"{multiple.numerator}*pi"
        text = above if multiple.denominator == 1 else f"{above}/{multiple.denominator}"
        return Piece(text, ATOM if text == "pi" else PRODUCT, negative)

    def bracket(self, piece: Piece, least: int) -> str:
        """The text of a piece where an operation of level `least` or tighter is needed."""
        if piece.level < least or (piece.negative and least > SUM):
            return f"({signed(piece)})"
        return signed(piece)

    def fraction(self, above: Sequence[Piece], below: Sequence[Piece]) -> Piece:
        """A product over a product."""
        if len(above) == 1 and not below:
            return above[0]
        text = "*".join(self.bracket(piece, PRODUCT) for piece in above) or "1"
        if below:
            under = "*".join(self.bracket(piece, POWER) for piece in below)
            text += f"/({under})" if len(below) > 1 else f"/{under}"
        return Piece(text, PRODUCT)

    def power(self, base: Piece, exponent: Piece) -> Piece:
        """A power; its base in brackets unless it is a symbol, number or function."""
        return Piece(f"{self.bracket(base, ATOM)}**{self.bracket(exponent, ATOM)}", POWER)

    def function(self, name: str, arguments: Sequence[Piece]) -> Piece:
        """A function call."""
        return Piece(f"{name}({', '.join(signed(argument) for argument in arguments)})", ATOM)

    def relation(self, name: str, left: Piece, right: Piece) -> Piece:
        """A comparison."""
        return Piece(f"{self.bracket(left, SUM)} {name} {self.bracket(right, SUM)}", RELATION)

    def derivative(self, name: str) -> str:
        """The derivative of a state by time."""
        return f"d({name})/dt"

    def remark(self, words: str) -> str:
        """Words behind a symbol, in brackets."""
        return f" ({words})"


class LatexStyle(TextStyle):
    """LaTeX mathematics, without surrounding dollar signs."""

    def symbol(self, name: str) -> str:
        """Greek letters as such, the part after the first _ or before final digits as a subscript."""
        head, _, tail = name.partition("_")
        if not tail and (match := re.fullmatch(r"([^\W\d]+)(\d+)", head)):
            head, tail = match.groups()
        base = head
        if _GREEK.fullmatch(head):
            base = f"\\{head}"
        elif len(head) > 1:
            base = rf"\mathrm{{{head}}}"
        if not tail:
            return base
        words = tail.replace("_", r"\,").replace(".", r"\,")
        return (
            f"{base}_{{{words}}}" if len(tail) == 1 or tail.isdigit() else rf"{base}_{{\mathrm{{{words}}}}}"
        )

    def remark(self, words: str) -> str:
        """Words behind a symbol, in brackets."""
        return rf"\,\text{{({words})}}"

    def number(self, value: float) -> Piece:
        """A number, multiples of π as fractions, powers of ten as such."""
        plain = super().number(value)
        if plain.text.endswith(("inf", "nan")):
            return Piece(r"\infty" if plain.text == "inf" else r"\mathrm{nan}", ATOM, plain.negative)
        multiple = _pi_multiple(abs(value)) if math.isfinite(value) else None
        if multiple is not None:
            above = r"\pi" if multiple.numerator == 1 else rf"{multiple.numerator} \pi"
            text = above if multiple.denominator == 1 else rf"\frac{{{above}}}{{{multiple.denominator}}}"
            return Piece(text, PRODUCT, plain.negative)
        mantissa, mark, exponent = plain.text.partition("e")
        if not mark:
            return plain
        return Piece(rf"{mantissa} \cdot 10^{{{int(exponent)}}}", PRODUCT, plain.negative)

    def bracket(self, piece: Piece, least: int) -> str:
        """As in text, with brackets that grow."""
        if piece.level < least or (piece.negative and least > SUM):
            return rf"\left({signed(piece)}\right)"
        return signed(piece)

    def fraction(self, above: Sequence[Piece], below: Sequence[Piece]) -> Piece:
        """A fraction bar; a lone sum above or below it needs no brackets."""
        if len(above) == 1 and not below:
            return above[0]
        text = self._row(above, alone=bool(below))
        return Piece(rf"\frac{{{text}}}{{{self._row(below, alone=True)}}}" if below else text, PRODUCT)

    def _row(self, pieces: Sequence[Piece], *, alone: bool) -> str:
        least = SUM if alone and len(pieces) == 1 else PRODUCT
        return r" \, ".join(self.bracket(piece, least) for piece in pieces) or "1"

    def power(self, base: Piece, exponent: Piece) -> Piece:
        """A power with its exponent raised."""
        return Piece(f"{self.bracket(base, ATOM)}^{{{signed(exponent)}}}", POWER)

    def function(self, name: str, arguments: Sequence[Piece]) -> Piece:
        """Roots and absolute values by their signs, other functions by name."""
        inner = ", ".join(signed(argument) for argument in arguments)
        if name == "sqrt":
            return Piece(rf"\sqrt{{{inner}}}", ATOM)
        if name == "abs":
            return Piece(rf"\left|{inner}\right|", ATOM)
        called = _LATEX_NAMES.get(name) or (f"\\{name}" if name in _LATEX_FUNCTIONS else None)
        if called is None:
            called = r"\operatorname{" + name.replace("_", r"\_") + "}"
        # A function's power is written outside, so that it counts as an atom only with its brackets.
        return Piece(rf"{called}\left({inner}\right)", ATOM)

    def relation(self, name: str, left: Piece, right: Piece) -> Piece:
        """A comparison."""
        sign = _LATEX_RELATIONS.get(name, name)
        return Piece(f"{self.bracket(left, SUM)} {sign} {self.bracket(right, SUM)}", RELATION)

    def derivative(self, name: str) -> str:
        """The derivative of a state by time."""
        return rf"\frac{{\mathrm{{d}}}}{{\mathrm{{d}}t}} {self.symbol(name)}"


TEXT: Style = TextStyle()
LATEX: Style = LatexStyle()
