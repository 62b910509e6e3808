"""The grammar of units: a text such as ``N m s/rad`` becomes base exponents, a factor and an offset.

A product is a space, ``*``, ``·`` or ``.``; a power is written behind its symbol (``m2``, ``m^2``, ``m²``, ``s-1``);
what stands behind a slash is one symbol or a bracket, because ``W/m2 K`` could be read in two ways.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

from casadi_engine.errors import UnitError

from .unit_symbols import BASE, Symbol, suggestion, symbol_of

# No quantity has a higher power, a factor beyond this cannot be a float any more, and no unit is a longer text.
LARGEST_POWER = 12
LARGEST_FACTOR = 1e200
LONGEST = 100

_TOKEN = re.compile(
    r"(?P<space>\s+)|(?P<number>\d+(?:\.\d+)?)|(?P<raised>[⁻⁺]?[⁰¹²³⁴-⁹]+)|(?P<power>\^|\*\*)"
    r"|(?P<times>[*·⋅×.])|(?P<slash>[/÷])|(?P<open>\()|(?P<close>\))|(?P<minus>[-−+])"
    r"|(?P<word>[cm]mH2O(?!\w)|[^\W\d_⁰¹²³⁴-⁹]+|[%°][^\W\d_]*)"
)
_RAISED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺", "0123456789-+")
RULE = "symbols such as N m s/rad, kg m2, L/min, mg/L, W/(m2 K), 1/h, km/h, degC, rpm, %, with SI prefixes"


@dataclass(frozen=True)
class Unit:
    """A unit that was read.

    text : as written, with single spaces.  si : the coherent SI unit in the same symbols ("L/min": "m3/s").
    exponents : (base, power) for s, m, kg, A, K, mol, cd and rad, zero powers left out.
    factor, pi : a value times ``factor * math.pi**pi``, plus ``offset``, is the value in ``si``.
    clocks : symbols of time other than s that it is written with ("km/h": h).
    written : its symbols with their powers, as written ("L/min": L 1, min -1).
    """

    text: str
    si: str
    exponents: tuple[tuple[str, Fraction], ...]
    factor: Fraction
    pi: Fraction
    offset: Fraction
    clocks: tuple[str, ...]
    written: tuple[tuple[str, Fraction], ...]

    @property
    def is_si(self) -> bool:
        """True when values in it are SI numbers."""
        return self.factor == 1 and not self.pi and not self.offset

    @property
    def dimension(self) -> str:
        """Its dimension as a product of SI base units, angle included: "kg m2 s-2"."""
        parts = [base + ("" if power == 1 else _written(power)) for base, power in self.exponents]
        return " ".join(parts) or "1"

    def compatible(self, other: Unit) -> bool:
        """True when a value in one can be told in the other.

        The radian counts as 1, so that N m/rad goes with N m, and rad with 1. Only in a pure rate it does not: 1/s
        may count revolutions, so that it does not go with rad/s.
        """
        own, its = dict(self.exponents), dict(other.exponents)
        angle, their_angle = own.pop("rad", Fraction(0)), its.pop("rad", Fraction(0))
        if own != its:
            return False
        rate = set(own) == {"s"} and own["s"] < 0
        return angle == their_angle or not rate

    def steps_to(self, other: Unit) -> tuple[float, float, float]:
        """(times, over, plus): a value times ``times``, over ``over``, plus ``plus`` is the value in the other unit.

        Two numbers for the factor, so that 1 ms is 1/1000 s and not 1 * 0.001 s.
        """
        ratio, pi = self.factor / other.factor, float(self.pi - other.pi)
        times, over = float(ratio.numerator), float(ratio.denominator)
        if pi > 0:
            times, over = math.pi**pi * times / over, 1.0
        elif pi < 0:
            over *= math.pi**-pi
        return times, over, float((self.offset - other.offset) / other.factor)


def _written(power: Fraction) -> str:
    return str(power.numerator) if power.denominator == 1 else f"{float(power):g}"


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    at: int


@lru_cache(maxsize=4096)
def parse_unit(text: str) -> Unit:
    """Read a unit. Raises :class:`UnitError` with a caret under the part that cannot be read.

    >>> parse_unit("L/min").si, parse_unit("N mm").factor, parse_unit("kg·m²").dimension
    ('m3/s', Fraction(1, 1000), 'm2 kg')
    """
    return _Reader(text).unit()


class _Reader:
    """One reading of a text: the factors found, and where in the text it stands."""

    def __init__(self, text: str) -> None:
        self.text = text
        if len(text) > LONGEST:
            raise UnitError(
                "a unit is too long to be one", seen=repr(text[:40]), allowed=RULE, cure="correct the text"
            )
        self.tokens = list(self._tokens())
        self.next = 0
        self.factors: list[tuple[Symbol, Fraction, str]] = []

    def refuse(self, problem: str, at: int, length: int, cure: str) -> UnitError:
        """The error with a caret under the place."""
        return UnitError(
            problem,
            seen=f"\n  {self.text}\n  {' ' * at}{'^' * max(length, 1)}\n",
            allowed=RULE,
            cure=cure,
        )

    def _tokens(self) -> Iterator[_Token]:
        at = 0
        while at < len(self.text):
            match = _TOKEN.match(self.text, at)
            if match is None:
                raise self.refuse(f"{self.text[at]!r} stands for no unit", at, 1, "take it out")
            yield _Token(str(match.lastgroup), match[0], at)
            at = match.end()

    def _peek(self) -> _Token:
        return self.tokens[self.next] if self.next < len(self.tokens) else _Token("end", "", len(self.text))

    def _take(self) -> _Token:
        token = self._peek()
        self.next += 1
        return token

    def _skip_space(self) -> None:
        while self._peek().kind == "space":
            self.next += 1

    def unit(self) -> Unit:
        """The unit of the whole text."""
        self._product(Fraction(1), closing=False)
        return _gathered(" ".join(self.text.split()), self.factors, self)

    def _product(self, sign: Fraction, *, closing: bool) -> None:
        """Factors up to the end or the closing bracket, each to the power ``sign`` times its own."""
        self._skip_space()
        self._factor(sign)
        divided = False
        while True:
            self._skip_space()
            token = self._peek()
            if token.kind == "end" or (closing and token.kind == "close"):
                return
            if token.kind == "slash":
                self._take()
                self._skip_space()
                self._factor(-sign)
                divided = True
                continue
            if divided and token.kind != "close":
                raise self.refuse(
                    "a product behind a slash can be read in two ways", token.at, len(token.text),
                    "put all that is divided by in brackets, as in W/(m2 K), or write the product first",
                )  # fmt: skip
            if token.kind == "times":
                self._take()
                self._skip_space()
            self._factor(sign)

    def _factor(self, sign: Fraction) -> None:
        token = self._take()
        if token.kind == "open":
            begun = len(self.factors)
            self._product(sign, closing=True)
            if self._take().kind != "close":
                raise self.refuse("a bracket is not closed", token.at, 1, "close it")
            power = self._power()
            self.factors[begun:] = [(symbol, own * power, name) for symbol, own, name in self.factors[begun:]]
        elif token.kind == "number" and token.text == "1":
            return
        elif token.kind == "word":
            symbol = symbol_of(token.text)
            if symbol is None:
                raise self.refuse(
                    f"unknown unit {token.text!r}",
                    token.at,
                    len(token.text),
                    suggestion(self.text, token.text),
                )
            self.factors.append((symbol, sign * self._power(), token.text))
        else:
            problem, cure = "a unit is missing here", "write a symbol; 1 for a dimensionless quantity"
            if token.kind == "number":
                problem, cure = "a number stands where a symbol is needed", "scale the data, or use a prefix"
            elif token.kind == "minus":
                problem, cure = "a hyphen joins no units", "write a space between the symbols"
            raise self.refuse(problem, token.at, len(token.text), cure)

    def _power(self) -> Fraction:
        token = self._peek()
        if token.kind == "raised":
            power = Fraction(self._take().text.translate(_RAISED))
        elif token.kind == "number":
            power = Fraction(self._take().text)
        elif token.kind == "minus" and self._after(1) == "number":
            power = self._signed()
        elif token.kind == "power":
            self._take()
            if self._peek().kind == "open":
                self._take()
                power = self._signed()
                if self._peek().kind == "slash":
                    self._take()
                    below = self._signed()
                    power = power / below if below else Fraction(0)
                if self._take().kind != "close":
                    raise self.refuse("a bracket is not closed", token.at, len(token.text), "close it")
            else:
                power = self._signed()
        else:
            return Fraction(1)
        if not 0 < abs(power) <= LARGEST_POWER:
            raise self.refuse(
                "no quantity has such a power", token.at, len(token.text), f"1 to {LARGEST_POWER} can be read"
            )
        return power

    def _after(self, steps: int) -> str:
        place = self.next + steps
        return self.tokens[place].kind if place < len(self.tokens) else "end"

    def _signed(self) -> Fraction:
        sign = 1
        if self._peek().kind == "minus":
            sign = 1 if self._take().text == "+" else -1
        token = self._take()
        if token.kind != "number":
            raise self.refuse(
                "the power is not a number", token.at, len(token.text), "write m^2, for instance"
            )
        return sign * Fraction(token.text)


def _gathered(text: str, factors: list[tuple[Symbol, Fraction, str]], reader: _Reader) -> Unit:
    """The unit of a product of symbols to powers."""
    exponents = dict.fromkeys(BASE, Fraction(0))
    written: dict[str, Fraction] = {}
    as_written: dict[str, Fraction] = {}
    factor, pi, offset = Fraction(1), Fraction(0), Fraction(0)
    for symbol, power, called in factors:
        as_written[called] = as_written.get(called, Fraction(0)) + power
        for base, own in symbol.exponents:
            exponents[base] += own * power
        for name, own in symbol.si:
            written[name] = written.get(name, Fraction(0)) + own * power
        whole = power.denominator == 1
        factor *= symbol.factor ** int(power) if whole else Fraction(float(symbol.factor) ** float(power))
        pi += symbol.pi * power
    if not 1 / LARGEST_FACTOR < factor < LARGEST_FACTOR:
        raise reader.refuse("the unit is too large or too small", 0, len(text), "use another prefix")
    if len(factors) == 1 and factors[0][1] == 1:
        offset = factors[0][0].offset  # elsewhere a degree is a difference of temperature, as in W/(m2 degC)
    clocks = tuple(dict.fromkeys(symbol.clock for symbol, _, _ in factors if symbol.clock))
    found = tuple((base, power) for base, power in exponents.items() if power)
    left = tuple((called, power) for called, power in as_written.items() if power)
    return Unit(text, product_text(written), found, factor, pi, offset, clocks, left)


def product_text(written: Mapping[str, Fraction]) -> str:
    """The text of symbols with powers: those above the slash in their order, then those below."""
    above = [name + _raised(power) for name, power in written.items() if power > 0]
    below = [name + _raised(-power) for name, power in written.items() if power < 0]
    over = "" if not below else "/" + (below[0] if len(below) == 1 else f"({' '.join(below)})")
    return (" ".join(above) or "1") + over


def _raised(power: Fraction) -> str:
    return "" if power == 1 else _written(power)
