"""A tape replayed on power series in time over a prime field, one coefficient after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from operator import mul

import casadi as ca

from casadi_engine.errors import IdentifiabilityError
from casadi_engine.identifiability.field import Pole
from casadi_engine.identifiability.tape import Tape, exact
from casadi_engine.identifiability.values import Sum, Values

Series = list[int]

# A sum with more terms than this counts as one monomial when it is the argument of exp, sin, cos or a power.
_MOST_TERMS = 64

# What a step does at a node, by which of its operands change in time.
(_ADD, _SUB, _COPY, _NEGATE, _TWICE, _SCALE, _PRODUCT, _SQUARE, _QUOTIENT, _OVER, _TURN, _EXP, _LOG, _POWER, _TANH,
 _SQRT) = range(16)  # fmt: skip


class Replay:
    """The coefficients of every node of a tape.

    inputs : for each argument of the function one series for each entry, which the caller extends by one coefficient
        before each `step`
    still : arguments that do not change in time (their series have one coefficient)
    rational : (argument, entry) -> the rational number that a still input stands for, where it is known
    Raises Pole at a point that has to be drawn again.
    """

    def __init__(
        self,
        tape: Tape,
        values: Values,
        inputs: Sequence[Sequence[Series]],
        *,
        still: frozenset[tuple[int, int]],
        rational: Mapping[tuple[int, int], Fraction],
    ) -> None:
        self.tape, self.values, self.field = tape, values, values.field
        self.series: list[Series] = []
        self.changes: list[bool] = []
        self._rational = rational
        self._sums: dict[int, Sum] = {}
        self._work: list[tuple[int, int, Series, Series, int]] = []  # (what, node, operand, operand, number)
        self._partner: dict[int, Series] = {}  # cosine of a sine and sine of a cosine, 1 - tanh**2
        self._turned: dict[int, tuple[Series, Series]] = {}
        self.count = 1
        for node, (op, a, b, payload) in enumerate(tape.code):
            if op == ca.OP_INPUT:
                self.series.append(inputs[a][b])
                self.changes.append((a, b) not in still)
            elif op == ca.OP_CONST:
                self.series.append([self.field.fraction(exact(payload))])
                self.changes.append(False)
            else:
                try:
                    self._start(node, op, a, b)
                except Pole as pole:
                    pole.node = node
                    raise

    def coefficient(self, node: int, k: int) -> int:
        """Coefficient k of a node."""
        series = self.series[node]
        return series[k] if k < len(series) else 0

    def step(self) -> None:
        """Append the next coefficient to every node that changes."""
        k, prime = self.count, self.field.prime
        for what, node, a, b, number in self._work:
            own = self.series[node]
            if what == _PRODUCT:
                own.append(sum(map(mul, a, reversed(b))) % prime)
            elif what == _SCALE:
                own.append(a[k] * number % prime)
            elif what == _ADD:
                own.append((a[k] + b[k]) % prime)
            elif what == _SUB:
                own.append((a[k] - b[k]) % prime)
            elif what == _COPY:
                own.append(a[k])
            elif what == _NEGATE:
                own.append(-a[k] % prime)
            elif what == _TWICE:
                own.append(2 * a[k] % prime)
            elif what == _SQUARE:
                own.append(sum(map(mul, a, reversed(a))) % prime)
            elif what == _QUOTIENT:  # own·b = a
                own.append((a[k] - sum(map(mul, own, reversed(b)))) * number % prime)
            elif what == _OVER:  # own·b = constant
                own.append(-sum(map(mul, own, reversed(b))) * number % prime)
            else:
                self._transcendental(what, node, a, b, number)
        self.count += 1

    def _transcendental(self, what: int, node: int, a: Series, b: Series, number: int) -> None:
        k, prime, own = self.count, self.field.prime, self.series[node]
        over = self.field.reciprocal(k)
        if what == _TURN:  # both of the pair, once
            sine, cosine = self._turned[number]
            if len(sine) == k:
                rate = [j * a[j] for j in range(1, k + 1)]
                up = sum(map(mul, rate, reversed(cosine))) * over % prime
                down = -sum(map(mul, rate, reversed(sine))) * over % prime
                sine.append(up)
                cosine.append(down)
        elif what == _EXP:
            own.append(sum(j * a[j] * own[k - j] for j in range(1, k + 1)) * over % prime)
        elif what == _LOG:  # own'·a = a'
            rest = sum(j * own[j] * a[k - j] for j in range(1, k))
            own.append((a[k] - rest * over) * number % prime)
        elif what == _POWER:  # own'·a = exponent·own·a', b holds the exponent
            e = b[0]
            rest = sum((e * j - (k - j)) * a[j] * own[k - j] for j in range(1, k + 1))
            own.append(rest % prime * over * number % prime)
        elif what == _TANH:  # own' = (1 - own**2)·a'
            slope = self._partner[node]
            own.append(sum(j * a[j] * slope[k - j] for j in range(1, k + 1)) * over % prime)
            slope.append(-sum(map(mul, own, reversed(own))) % prime)
        elif what == _SQRT:
            inner = sum(own[i] * own[k - i] for i in range(1, k))
            own.append((a[k] - inner) * number % prime)

    # ---- the first coefficient

    def _start(self, node: int, op: int, a: int, b: int) -> None:
        field, prime = self.field, self.field.prime
        left, right = self.series[a], self.series[b] if b >= 0 else []
        moves_left, moves_right = self.changes[a], b >= 0 and self.changes[b]
        x, y = left[0], right[0] if right else 0
        what, first, second, number = -1, left, right, 0
        if op == ca.OP_ADD:
            value = x + y
            what = _ADD if moves_left and moves_right else _COPY
            first = left if moves_left else right
        elif op == ca.OP_SUB:
            value = x - y
            what = _SUB if moves_left and moves_right else _COPY if moves_left else _NEGATE
            first = left if moves_left else right
        elif op == ca.OP_MUL:
            value = x * y
            what = _PRODUCT if moves_left and moves_right else _SCALE
            first, number = (left, y) if moves_left else (right, x)
        elif op == ca.OP_NEG:
            value, what = -x, _NEGATE
        elif op == ca.OP_TWICE:
            value, what = 2 * x, _TWICE
        elif op == ca.OP_SQ:
            value, what = x * x, _SQUARE
        elif op in (ca.OP_DIV, ca.OP_INV):
            below, over = (right, moves_right) if op == ca.OP_DIV else (left, moves_left)
            number = field.inverse(below[0])
            value = number * (x if op == ca.OP_DIV else 1)
            if not over:
                what = _SCALE
            else:
                what = _QUOTIENT if op == ca.OP_DIV and moves_left else _OVER
                second = below
        else:
            value, what, first, second, number = self._start_function(node, op, a, b)
        if what == _PRODUCT:
            second = right if first is left else left
        changes = moves_left or moves_right
        self.changes.append(changes)
        if op in (ca.OP_SIN, ca.OP_COS):
            self.series.append(self._turned[number][0 if op == ca.OP_SIN else 1])
        else:
            self.series.append([value % prime])
        if changes:
            self._work.append((what, node, first, second, number))

    def _start_function(self, node: int, op: int, a: int, b: int) -> tuple[int, int, Series, Series, int]:
        field, left = self.field, self.series[a]
        x = left[0]
        if op in (ca.OP_SIN, ca.OP_COS):
            if a not in self._turned:
                cosine, sine = self.values.turn(self._sum(a))
                self._turned[a] = ([sine], [cosine])
            return 0, _TURN, left, [], a
        if op == ca.OP_EXP:
            return self.values.exp(self._sum(a)), _EXP, left, [], 0
        if op == ca.OP_TANH:
            twice = self.values.exp({key: 2 * factor for key, factor in self._sum(a).items()})
            value = (twice - 1) * field.inverse(twice + 1) % field.prime
            self._partner[node] = [(1 - value * value) % field.prime]
            return value, _TANH, left, [], 0
        if op == ca.OP_SQRT:
            value = field.root(x)
            return value, _SQRT, left, [], field.inverse(2 * value)
        if op == ca.OP_LOG:
            value, self._sums[node] = self.values.log(self._factors(a))
            return value, _LOG, left, [], field.inverse(x)
        if op == ca.OP_POW and not self.changes[b]:
            _, logarithm = self.values.log(self._factors(a))
            value = self.values.exp(self._times(self._sum(b), logarithm))
            return value, _POWER, left, self.series[b], field.inverse(x)
        if op == ca.OP_POW:
            raise IdentifiabilityError(
                "the exact test has no rule for a power with an exponent that changes in time",
                seen="pow with states or inputs in the exponent",
                allowed="exponents made of parameters and numbers",
                cure="write a**b as exp(b*log(a))",
            )
        raise AssertionError(op)  # `lift` lets nothing else through

    # ---- arguments as sums of monomials, and as products of powers

    def _sum(self, node: int) -> Sum:
        if node not in self._sums:
            made = self._expanded(node)
            value = self.series[node][0]
            if made is None or len(made) > _MOST_TERMS:
                made = {value: Fraction(1)}
            self._sums[node] = {key: factor for key, factor in made.items() if factor and key}
        return self._sums[node]

    def _expanded(self, node: int) -> Sum | None:
        op, a, b, payload = self.tape.code[node]
        if op == ca.OP_CONST:
            return {1: exact(payload)}
        if op == ca.OP_INPUT:
            return {1: self._rational[a, b]} if (a, b) in self._rational else None
        if op in (ca.OP_ADD, ca.OP_SUB):
            made = dict(self._sum(a))
            for key, factor in self._sum(b).items():
                made[key] = made.get(key, Fraction(0)) + (factor if op == ca.OP_ADD else -factor)
            return made
        if op in (ca.OP_NEG, ca.OP_TWICE):
            share = -1 if op == ca.OP_NEG else 2
            return {key: share * factor for key, factor in self._sum(a).items()}
        if op in (ca.OP_MUL, ca.OP_SQ):
            one, other = self._sum(a), self._sum(b if op == ca.OP_MUL else a)
            return self._times(one, other) if len(one) * len(other) <= _MOST_TERMS else None
        if op in (ca.OP_DIV, ca.OP_INV):
            one = self._sum(a) if op == ca.OP_DIV else {1: Fraction(1)}
            below = b if op == ca.OP_DIV else a
            other = self._sum(below)
            if len(other) == 1:
                ((key, factor),) = other.items()
                return self._times(one, {self.field.inverse(key): 1 / factor})
            return self._times(one, {self.field.inverse(self.series[below][0]): Fraction(1)})
        return None

    def _times(self, one: Sum, other: Sum) -> Sum:
        made: Sum = {}
        for key, factor in one.items():
            for by, share in other.items():
                product = key * by % self.field.prime
                made[product] = made.get(product, Fraction(0)) + factor * share
        return made

    def _factors(self, node: int) -> Sum:
        """value -> exponent: the node as a product of powers."""
        op, a, b, _ = self.tape.code[node]
        if op in (ca.OP_MUL, ca.OP_DIV):
            made = dict(self._factors(a))
            for key, power in self._factors(b).items():
                made[key] = made.get(key, Fraction(0)) + (power if op == ca.OP_MUL else -power)
            return made
        if op in (ca.OP_SQ, ca.OP_INV, ca.OP_SQRT):
            share = {ca.OP_SQ: Fraction(2), ca.OP_INV: Fraction(-1), ca.OP_SQRT: Fraction(1, 2)}[op]
            return {key: share * power for key, power in self._factors(a).items()}
        if not self.series[node][0]:
            raise Pole("logarithm of zero")
        return {self.series[node][0]: Fraction(1)}
