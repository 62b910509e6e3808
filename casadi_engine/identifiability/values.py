"""Values of exp, log, sin and cos in a prime field: drawn at random, but with every relation among them kept.

An argument is written as a sum of rational multiples of monomials. A monomial is known by its value, so that two
ways of writing one product meet; each gets one random value of exp (or one random point of the circle), and sums
of arguments become products. So exp(2a) is exp(a)**2, sin(θ + 120°) is what it must be beside sin θ, and x**0.5
is sqrt(x). Drawn independently, they would make parameters look identifiable that are not.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from math import pi
from random import Random
from typing import Any

from casadi_engine.identifiability.field import Field, Pole

# rational multiples of monomials, each monomial by its value; 1 is the constant
Sum = dict[int, Fraction]

# Phases nearer than this [rad] to an exact step are that step.
_NEAR = 1e-11


class Values:
    """One drawing: the random values of elementary functions at one random point."""

    def __init__(self, field: Field, random: Random) -> None:
        self.field, self.random = field, random
        self._exponentials: dict[int, int] = {}
        self._turns: dict[int, tuple[int, int]] = {}
        self._logarithms: dict[int, int] = {}  # value -> its logarithm
        self._arguments: dict[int, int] = {}  # logarithm -> the value it is of
        self._exponents: dict[int, Sum] = {}  # value of exp -> its argument
        self._phases: list[tuple[Fraction, tuple[int, int]]] = [(Fraction(0), (1, 0))]

    def number(self) -> int:
        """A random element that has a square root."""
        return pow(self.random.randrange(2, self.field.prime - 1), 2, self.field.prime)

    def exp(self, argument: Sum) -> int:
        """The value of exp at an argument."""
        field, made = self.field, 1
        for monomial, factor in argument.items():
            if monomial in self._arguments:
                made = made * field.power(self._arguments[monomial], factor) % field.prime
                continue
            base, share = self._base(monomial, self._exponentials)
            if base not in self._exponentials:
                self._exponentials[base] = field.exponential(self.random)
            made = made * field.exponential_power(self._exponentials[base], factor * share) % field.prime
        self._exponents.setdefault(made, dict(argument))
        return made

    def log(self, factors: Sum) -> tuple[int, Sum]:
        """The value of log at a product of powers (value -> exponent), and the same as a sum."""
        total, found = 0, Sum()
        for value, exponent in factors.items():
            if value == 1:
                continue
            if value == 0:
                raise Pole("logarithm of zero")
            if value in self._exponents:  # log(exp(u)) = u
                for key, factor in self._exponents[value].items():
                    found[key] = found.get(key, Fraction(0)) + factor * exponent
                    total += key * self.field.fraction(factor * exponent)
                continue
            if value not in self._logarithms:
                inverse = self.field.inverse(value)
                if inverse in self._logarithms:
                    value, exponent = inverse, -exponent
                else:
                    drawn = self.random.randrange(2, self.field.prime)
                    self._logarithms[value], self._arguments[drawn] = drawn, value
            key = self._logarithms[value]
            found[key] = found.get(key, Fraction(0)) + exponent
            total += key * self.field.fraction(exponent)
        return total % self.field.prime, {key: factor for key, factor in found.items() if factor}

    def turn(self, argument: Sum) -> tuple[int, int]:
        """(cos, sin) at an argument [rad]."""
        field = self.field
        made = self._phase(argument.get(1, Fraction(0)))
        for monomial, factor in argument.items():
            if monomial == 1:
                continue
            base, share = self._base(monomial, self._turns)
            if base not in self._turns:
                self._turns[base] = field.turn(self.random)
            made = field.turned(made, field.turn_multiple(self._turns[base], factor * share))
        return made

    def _phase(self, constant: Fraction) -> tuple[int, int]:
        """The point at a constant angle [rad]: exact steps from zero, or from a constant drawn before."""
        step = 2 * pi / self.field.steps
        for reference, point in self._phases:
            steps = float(constant - reference) / step
            if abs(steps - round(steps)) * step < _NEAR:
                return self.field.turned(point, self.field.rotation(round(steps)))
        # not a fraction of a turn: all such numbers are multiples of one angle, as they are of one number
        if 1 not in self._turns:
            self._turns[1] = self.field.turn(self.random)
        point = self.field.turn_multiple(self._turns[1], constant)
        self._phases.append((constant, point))
        return point

    def _base(self, monomial: int, known: Mapping[int, Any]) -> tuple[int, Fraction]:
        """The monomial, of which this is a rational multiple, that has a value already; and the multiple."""
        if monomial not in known and monomial != 1:
            inverse = self.field.inverse(monomial)
            for other in known:
                share = self.field.small_fraction(other * inverse % self.field.prime, 10_000)
                if other != 1 and share:
                    return other, 1 / share
        return monomial, Fraction(1)
