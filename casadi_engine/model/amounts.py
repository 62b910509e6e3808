"""What the numbers of an expression count: a bare number times a product of units.

A bare number is one that the equations hold as it stands, as 0.001 in 0.001*R*I. It may convert units, or stand for a
quantity of which nobody said the unit, so that nothing that it multiplies has a known unit. Two kinds of it do no harm:
those by which no unit converts (2, 3/4, the root of 2), and those that take what they multiply into SI, to the digit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any

import casadi as ca

from casadi_engine.experiment.unit_parser import LARGEST_POWER
from casadi_engine.experiment.units import NOT_STATED, read_unit, unit_product

Powers = tuple[tuple[str, Fraction], ...]

# Whole numbers that no two units of one kind have between them; 5 and 10 are left out, and so what is made of them.
_PLAIN = (1, 2, 3, 4, 6, 8, 9)
_PLAIN_RATIOS = tuple(sorted({above / below for above in _PLAIN for below in _PLAIN}))
_ROUNDING = 1e-9
# Relative error of a conversion number that was written by hand, as 9.549 for rpm.
_CONVERTED = 1e-4

_SUMS = (ca.OP_ADD, ca.OP_SUB, ca.OP_FMIN, ca.OP_FMAX)
_KEEPS = (ca.OP_ASSIGN, ca.OP_NEG, ca.OP_FABS, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_COPYSIGN, ca.OP_FMOD)
_POWERS = {ca.OP_SQ: Fraction(2), ca.OP_SQRT: Fraction(1, 2), ca.OP_INV: Fraction(-1)}
_DIMENSIONLESS = (
    ca.OP_EXP, ca.OP_LOG, ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_ATAN2,
    ca.OP_SINH, ca.OP_COSH, ca.OP_TANH, ca.OP_ASINH, ca.OP_ACOSH, ca.OP_ATANH, ca.OP_ERF, ca.OP_SIGN,
    ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR, ca.OP_LOG1P, ca.OP_EXPM1,
)  # fmt: skip


@dataclass(frozen=True)
class Amount:
    """A bare number times units to powers.

    loose : True if a unit in it may have been left out, so that it stands for any other
    symbols : True if there is anything but the number
    """

    number: float = 1.0
    powers: Powers = ()
    loose: bool = False
    symbols: bool = False

    def times(self, other: Amount, power: int = 1) -> Amount:
        """The product with another amount to a power of 1 or -1."""
        found = dict(self.powers)
        for name, own in other.powers:
            found[name] = found.get(name, Fraction(0)) + power * own
        powers = tuple((name, own) for name, own in found.items() if own)
        number = self.number * other.number if power == 1 else _over(self.number, other.number)
        return Amount(number, powers, self.loose or other.loose, self.symbols or other.symbols)

    def to_the(self, power: Fraction) -> Amount:
        """The amount to a power."""
        try:
            number = abs(self.number) ** float(power)
        except (OverflowError, ZeroDivisionError):
            number = math.nan
        return replace(self, number=number, powers=tuple((name, own * power) for name, own in self.powers))

    @property
    def is_plain(self) -> bool:
        """True if its bare number, or the square of it, is one by which no unit converts; no unit has huge powers."""
        return _is_plain(abs(self.number)) and all(abs(power) <= LARGEST_POWER for _, power in self.powers)

    @property
    def is_one(self) -> bool:
        """True if its number is 1 or -1."""
        return _is_near(abs(self.number), 1.0)

    @property
    def tells(self) -> bool:
        """True if what is added to it has its unit: not where it is dimensionless, which may be one times anything."""
        return self.is_plain and not self.loose and bool(self.powers)

    @property
    def unit(self) -> str:
        """The text of its units."""
        return _text(self.powers)

    def in_si(self) -> Amount:
        """The amount in SI where its number takes it there, as in 0.001*R for R in mOhm; else as it is."""
        if _is_plain(abs(self.number)) or not self.powers or not 0 < abs(self.number) < math.inf:
            return self
        if abs(math.log(abs(self.number)) - log_factor(self.powers)) > _CONVERTED:
            return self
        return replace(self, number=math.copysign(1.0, self.number), powers=_si(self.powers))


def amount_of(unit: str, *, loose: bool = False) -> Amount:
    """The amount of a symbol in a unit that was stated."""
    return Amount(1.0, read_unit(unit).written, loose, True)


@lru_cache(maxsize=1024)
def _is_plain(number: float) -> bool:
    return any(_is_near(own, one) for own in (number, number * number) for one in _PLAIN_RATIOS)


@lru_cache(maxsize=1024)
def _text(powers: Powers) -> str:
    return unit_product(*powers)


@lru_cache(maxsize=1024)
def log_factor(powers: Powers) -> float:
    """The logarithm of what takes a number in these units into SI."""
    found = 0.0
    for name, power in powers:
        own = read_unit(name)
        found += float(power) * (math.log(own.factor) + float(own.pi) * math.log(math.pi))
    return found


@lru_cache(maxsize=1024)
def _si(powers: Powers) -> Powers:
    """The SI units of units to powers, in the same symbols."""
    found: dict[str, Fraction] = {}
    for name, power in powers:
        for base, own in read_unit(read_unit(name).si).written:
            found[base] = found.get(base, Fraction(0)) + own * power
    return tuple((base, power) for base, power in found.items() if power)


def _over(one: float, other: float) -> float:
    return one / other if other else math.nan


def _is_near(one: float, other: float, within: float = _ROUNDING) -> bool:
    return abs(one - other) <= within * abs(other)


@dataclass(frozen=True)
class Step:
    """One operation of an expression: what it does, of which steps, and the number of a constant."""

    does: int
    of: tuple[int, ...]
    number: float = math.nan

    @property
    def is_sum(self) -> bool:
        """True if what it is made of has one unit, its own."""
        return self.does in _SUMS

    @property
    def keeps(self) -> bool:
        """True if its unit is that of the first that it is made of."""
        return self.does in _KEEPS


def steps_of(expressions: Any, symbols: Any) -> tuple[list[Step], list[int]]:
    """The operations of a column of expressions in their order, and the step of each expression.

    Steps 0, 1, ... are the symbols; -1 stands for an expression that is 0.
    """
    function = ca.Function("steps", [symbols], [ca.densify(expressions)], {"allow_free": True})
    steps = [Step(ca.OP_INPUT, ()) for _ in range(symbols.numel())]
    at: dict[int, int] = {}  # of a place in memory, which is written again and again
    ends = [-1] * expressions.numel()
    for k in range(function.n_instructions()):
        does, into, outof = (
            function.instruction_id(k), function.instruction_output(k), function.instruction_input(k),
        )  # fmt: skip
        if does == ca.OP_OUTPUT:
            ends[into[1]] = at[outof[0]]
        elif does == ca.OP_INPUT:
            at[into[0]] = outof[1]
        else:
            constant = float(function.instruction_constant(k)) if does == ca.OP_CONST else math.nan
            operands = () if does in (ca.OP_CONST, ca.OP_PARAMETER) else tuple(at[one] for one in outof)
            steps.append(Step(does, operands, constant))
            at[into[0]] = len(steps) - 1
    return steps, ends


def amounts_of(steps: Sequence[Step], known: Sequence[Amount | None]) -> list[Amount | None]:
    """The amount of every step, None where it is not known.

    known : of the symbols, which are the first steps
    """
    found: list[Amount | None] = list(known)
    for step in steps[len(known) :]:
        parts = [found[one] for one in step.of]
        if step.is_sum:
            made = _sum([part for part in parts if part is not None])
        elif step.does in (ca.OP_POW, ca.OP_CONSTPOW):
            made = _power(parts[0], parts[1])
        elif step.does == ca.OP_CONST:
            made = Amount(step.number)
        else:
            made = _made(step, parts)
        found.append(None if made is None else made.in_si())
    return found


def _made(step: Step, parts: Sequence[Amount | None]) -> Amount | None:
    """The amount of what a step of products, of powers, or of a function makes."""
    if step.does in _DIMENSIONLESS:
        return Amount(symbols=True)
    if step.does == ca.OP_IF_ELSE_ZERO:
        return parts[1]
    if not parts or any(part is None for part in parts):
        return None
    one, *others = (part for part in parts if part is not None)
    if step.keeps:
        return one
    if step.does == ca.OP_MUL:
        return one.times(others[0])
    if step.does == ca.OP_DIV:
        return one.times(others[0], -1)
    if step.does == ca.OP_TWICE:
        return one.times(Amount(2.0))
    return one.to_the(_POWERS[step.does]) if step.does in _POWERS else None


def _power(one: Amount | None, power: Amount | None) -> Amount | None:
    if one is None or power is None or power.symbols:
        return None if one is None or one.powers else Amount(symbols=True)
    half = 2 * power.number
    return one.to_the(Fraction(round(half), 2)) if math.isfinite(half) and half == round(half) else None


def _sum(terms: Sequence[Amount]) -> Amount | None:
    """The amount of a sum: that of a term that tells one, if no other contradicts it."""
    telling = [term for term in terms if term.tells]
    telling = [term for term in telling if term.is_one] or telling
    if telling:
        return telling[0] if all(is_alike(telling[0], other) for other in telling[1:]) else None
    if len(terms) > 1 and all(not term.powers for term in terms):
        return Amount(1.0, (), any(term.loose for term in terms), any(term.symbols for term in terms))
    loose = [term for term in terms if term.is_plain and term.symbols]
    return replace(loose[0], loose=True) if loose else None


def is_of_one_kind(one: Amount, other: Amount) -> bool:
    """True for amounts of one dimension, angles left out."""
    return _dimension(one.powers) == _dimension(other.powers)


def is_alike(one: Amount, other: Amount) -> bool:
    """True for amounts of one dimension, angles left out, in units of one size."""
    return is_of_one_kind(one, other) and abs(log_factor(one.powers) - log_factor(other.powers)) < _ROUNDING


@lru_cache(maxsize=1024)
def _dimension(powers: Powers) -> Powers:
    found: dict[str, Fraction] = {}
    for name, power in powers:
        for base, own in read_unit(name).exponents:
            found[base] = found.get(base, Fraction(0)) + own * power
    return tuple(sorted((base, power) for base, power in found.items() if power and base != "rad"))


def symbols_of(units: Sequence[tuple[Any, str]], may_lack: Collection[int]) -> Iterator[Amount | None]:
    """The amounts of symbols with units, None where none was stated.

    may_lack : hashes of symbols whose unit may be a default that nobody stated
    """
    for symbol, unit in units:
        yield None if unit == NOT_STATED else amount_of(unit, loose=symbol.element_hash() in may_lack)
