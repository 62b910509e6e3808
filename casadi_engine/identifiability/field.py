"""Exact arithmetic in a prime field GF(P), P a little below 2**61: matrices by NumPy, single numbers by Python."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache
from random import Random

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.int64]
Limbs = NDArray[np.float64]

# P + 1 is divisible by 5760, so the circle over GF(P) has exact rotations by every sixteenth of a degree.
PRIME = 2305843009213674239
# The same, and by every 1/(16·7·11·13) of a degree: engines with 7, 11 or 13 evenly firing cylinders.
WIDE_PRIME = 2305843009187477759

_BITS = 21
_LOW = np.int64((1 << _BITS) - 1)
_LOW_40 = np.int64((1 << 40) - 1)
_LOW_61 = np.int64((1 << 61) - 1)
# Products of two limbs have 42 bits; three sums of this many of them add up exactly in double precision.
_TERMS = 682
# Products of matrices with more multiplications than this would be spread over threads, which costs far more than
# it saves at the sizes met here.
_THREADS_FROM = 1 << 18
_SMALL_FACTORS = 10_000


class Pole(ArithmeticError):
    """A random point at which the model has a pole, or no root: another one has to be drawn.

    node : of the tape, where it came up; -1 if that is not known
    """

    node = -1


class Field:
    """GF(P) for P = 2**61 - c with 0 < c < 2**27, P ≡ 3 mod 4.

    Matrices are int64 with entries in [0, P); their products go through double-precision BLAS on limbs of 21
    bits, which is exact.
    """

    def __init__(self, prime: int = PRIME) -> None:
        self.prime = prime
        self._excess = np.int64((1 << 61) - prime)
        self._inverses = [0, 1]
        # Powers with rational exponents live in the part of a group without small factors, where they are unique.
        self.root_order = _without_small_factors((prime - 1) // 2)
        self.turn_order = _without_small_factors(prime + 1)
        self.steps = 5760 * (1001 if (prime + 1) % 1001 == 0 else 1)  # exact rotations by 360°/steps

    # ---- numbers

    def inverse(self, value: int) -> int:
        """1/value; Pole for zero."""
        if value % self.prime == 0:
            raise Pole("division by zero")
        return pow(value, -1, self.prime)

    def reciprocal(self, number: int) -> int:
        """1/number for the small numbers 1, 2, 3, … that the series need, kept in a table."""
        while len(self._inverses) <= number:
            self._inverses.append(pow(len(self._inverses), -1, self.prime))
        return self._inverses[number]

    def fraction(self, value: Fraction) -> int:
        """A rational number as an element."""
        return value.numerator * self.inverse(value.denominator) % self.prime

    def root(self, value: int) -> int:
        """The square root that is itself a square; Pole if there is none."""
        found = pow(value, (self.prime + 1) // 4, self.prime)
        if found * found % self.prime != value % self.prime or value % self.prime == 0:
            raise Pole("no square root")
        return found

    def power(self, value: int, exponent: Fraction) -> int:
        """value**exponent, the same root every time; Pole if there is none."""
        if exponent.denominator == 1:
            number = exponent.numerator
            return (
                pow(value, number, self.prime)
                if number >= 0
                else pow(self.inverse(value), -number, self.prime)
            )
        order = (self.prime - 1) // 2  # of the squares
        if value % self.prime == 0 or pow(value, order, self.prime) != 1:
            raise Pole("no root")
        shared = math.gcd(exponent.denominator, order)
        while shared > 1:  # roots whose degree divides the group's order: only in the smaller group
            order //= shared
            shared = math.gcd(exponent.denominator, order)
        if pow(value, order, self.prime) != 1:
            raise Pole("no root")
        return pow(value, exponent.numerator * pow(exponent.denominator, -1, order) % order, self.prime)

    def small_fraction(self, value: int, bound: int = 1000) -> Fraction | None:
        """The fraction with numerator and denominator up to `bound` that equals `value`, or None."""
        before, now, left, right = self.prime, value % self.prime, 0, 1
        while now > bound:
            quotient = before // now
            before, now, left, right = now, before - quotient * now, right, left - quotient * right
        if right == 0 or abs(right) > bound:
            return None
        return Fraction(now if right > 0 else -now, abs(right))

    # ---- groups: where exp, sin and cos take their values

    def exponential(self, random: Random) -> int:
        """A generic value of exp, of which every rational power up to small degrees exists."""
        while True:
            drawn = pow(random.randrange(2, self.prime), (self.prime - 1) // self.root_order, self.prime)
            if drawn != 1:
                return drawn

    def exponential_power(self, base: int, exponent: Fraction) -> int:
        """The power of a value that `exponential` drew."""
        order = self.root_order
        return pow(base, exponent.numerator * pow(exponent.denominator, -1, order) % order, self.prime)

    def turn(self, random: Random) -> tuple[int, int]:
        """A generic point (cos, sin) of the circle, of which every rational multiple exists."""
        while True:
            drawn = self.multiple(self._point(random), (self.prime + 1) // self.turn_order)
            if drawn != (1, 0):
                return drawn

    def turn_multiple(self, point: tuple[int, int], factor: Fraction) -> tuple[int, int]:
        """The point at `factor` times the angle of one that `turn` drew."""
        order = self.turn_order
        return self.multiple(point, factor.numerator * pow(factor.denominator, -1, order) % order)

    def multiple(self, point: tuple[int, int], number: int) -> tuple[int, int]:
        """The point at `number` >= 0 times the angle."""
        made, base = (1, 0), point
        while number:
            if number & 1:
                made = self.turned(made, base)
            base = self.turned(base, base)
            number >>= 1
        return made

    def turned(self, one: tuple[int, int], other: tuple[int, int]) -> tuple[int, int]:
        """The point at the sum of two angles."""
        (a, b), (c, d), prime = one, other, self.prime
        return (a * c - b * d) % prime, (a * d + b * c) % prime

    def rotation(self, number: int) -> tuple[int, int]:
        """The point at `number` exact steps of 360°/steps."""
        return self.multiple(_unit_rotation(self.prime, self.steps), number % self.steps)

    def _point(self, random: Random) -> tuple[int, int]:
        prime = self.prime
        while True:
            r = random.randrange(2, prime)
            square = r * r % prime
            if (square + 1) % prime:
                scale = self.inverse(1 + square)
                return (1 - square) * scale % prime, 2 * r * scale % prime

    # ---- matrices

    def split(self, matrix: Matrix) -> Limbs:
        """The limbs of a matrix, (3, rows, columns)."""
        made = np.empty((3, *matrix.shape))
        made[0] = matrix & _LOW
        made[1] = (matrix >> _BITS) & _LOW
        made[2] = matrix >> (2 * _BITS)
        return made

    def product(self, left: Matrix, right: Matrix) -> Matrix:
        """left (m, k) times right (k, n)."""
        return self.product_of_limbs(self.split(left), self.split(right))

    def product_of_limbs(self, left: Limbs, right: Limbs) -> Matrix:
        """The product of matrices in limbs, (3, m, k) times (3, k, n), as (m, n)."""
        terms = left.shape[2]
        if terms > _TERMS:
            total = self.product_of_limbs(left[:, :, :_TERMS], right[:, :_TERMS])
            return self.sum(total, self.product_of_limbs(left[:, :, _TERMS:], right[:, _TERMS:]))
        p = _products(left, right)
        made = p[2, 2].astype(np.int64)
        for added in (p[1, 2] + p[2, 1], p[0, 2] + p[1, 1] + p[2, 0], p[0, 1] + p[1, 0], p[0, 0]):
            # made·2**21 + added with 2**61 ≡ excess: nothing here passes 2**62
            high = made >> 40
            high *= self._excess
            made &= _LOW_40
            made <<= _BITS
            made += high
            made += added.astype(np.int64)
            np.right_shift(made, 61, out=high)
            high *= self._excess
            made &= _LOW_61
            made += high
        made -= np.where(made >= self.prime, np.int64(self.prime), np.int64(0))
        return made

    def scaled(self, matrix: Matrix, factor: int) -> Matrix:
        """factor times a matrix."""
        return self.product(np.array([[factor]], dtype=np.int64), matrix.reshape(1, -1)).reshape(matrix.shape)

    def sum(self, one: Matrix, other: Matrix) -> Matrix:
        """one + other."""
        made = one + other
        made -= np.where(made >= self.prime, np.int64(self.prime), np.int64(0))
        return made

    def difference(self, one: Matrix, other: Matrix) -> Matrix:
        """one - other."""
        made = one - other
        made += np.where(made < 0, np.int64(self.prime), np.int64(0))
        return made


def _products(left: Limbs, right: Limbs) -> Limbs:
    """Every limb of one matrix times every limb of the other, (3, 3, m, n)."""
    m, terms, n = left.shape[1], left.shape[2], right.shape[2]
    if terms == 1:
        return np.multiply(left[:, None], right[None])
    step = max(1, _THREADS_FROM // max(1, m * n))
    total: Limbs = np.matmul(left[:, None, :, :step], right[None, :, :step])
    for first in range(step, terms, step):
        total += np.matmul(left[:, None, :, first : first + step], right[None, :, first : first + step])
    return total


@lru_cache
def field_of(prime: int = PRIME) -> Field:
    """The field of a prime, made once."""
    return Field(prime)


@lru_cache
def _unit_rotation(prime: int, steps: int) -> tuple[int, int]:
    """A point of the circle that comes back after `steps` multiples and not before."""
    field, random = field_of(prime), Random(0)
    factors = [p for p in (2, 3, 5, 7, 11, 13) if steps % p == 0]
    while True:
        point = field.multiple(field._point(random), (prime + 1) // steps)
        if all(field.multiple(point, steps // p) != (1, 0) for p in factors):
            # a quarter turn must be (0, 1), not (0, -1): which of the two is a matter of sign
            quarter = field.multiple(point, steps // 4)
            return point if quarter == (0, 1) else (point[0], -point[1] % prime)


def _without_small_factors(number: int) -> int:
    for factor in range(2, _SMALL_FACTORS):
        while number % factor == 0:
            number //= factor
    return number
