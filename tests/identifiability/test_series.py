"""Power series of elementary functions by identities that no recurrence of theirs knows of."""

from __future__ import annotations

from fractions import Fraction
from math import factorial
from random import Random

import casadi as ca
import numpy as np
import pytest

from casadi_engine.identifiability.field import field_of
from casadi_engine.identifiability.series import Replay
from casadi_engine.identifiability.tape import Tape, exact, lift
from casadi_engine.identifiability.values import Values

ORDERS = 9
x, y, a = ca.SX.sym("x"), ca.SX.sym("y"), ca.SX.sym("a")
sinh, cosh = ca.sinh(x), ca.cosh(x)
ONE = {
    "exp of a sum": (ca.exp(x + y), ca.exp(x) * ca.exp(y)),
    "exp of a double": (ca.exp(2 * x), ca.exp(x) ** 2),
    "exp of a fraction": (ca.exp(x / 3) ** 3, ca.exp(x)),
    "exp of a product": (ca.exp(a * x) ** 2, ca.exp(2 * x * a)),
    "exp of log": (ca.exp(ca.log(x)), x),
    "log of exp": (ca.log(ca.exp(x) * ca.exp(y)) - ca.log(ca.exp(y)), ca.log(ca.exp(x))),
    "log undoes exp": (ca.log(ca.exp(a * x + y)), a * x + y),
    "log undoes exp in a product": (ca.log(x * ca.exp(y)), ca.log(x) + y),
    "log of a product": (ca.log(x * y**2), ca.log(x) + 2 * ca.log(y)),
    "log of a quotient": (ca.log(x / y), ca.log(x) - ca.log(y)),
    "circle": (ca.sin(x) ** 2 + ca.cos(x) ** 2, ca.SX(1)),
    "sine of a sum": (ca.sin(x + y), ca.sin(x) * ca.cos(y) + ca.cos(x) * ca.sin(y)),
    "sine of a double": (ca.sin(2 * x), 2 * ca.sin(x) * ca.cos(x)),
    "shifted by 120°": (sum(ca.sin(x + 2 * np.pi * k / 3) for k in range(3)), ca.SX(0)),
    "shifted by 90°": (ca.sin(x + np.pi / 2), ca.cos(x)),
    "shifted by 1/16°": (ca.sin(2 * x + np.pi / 1440), 2 * ca.sin(x + np.pi / 2880) * ca.cos(x + np.pi / 2880)),
    "tangent": (ca.tan(x) * ca.cos(x), ca.sin(x)),
    "hyperbola": (cosh**2 - sinh**2, ca.SX(1)),
    "tanh": (ca.tanh(x) * cosh, sinh),
    "tanh of a sum": (
        ca.tanh(x + y) * (1 + ca.tanh(x) * ca.tanh(y)), ca.tanh(x) + ca.tanh(y),
    ),
    "root": (ca.sqrt(x) ** 2, x),
    "root of a square's square": (ca.sqrt(x**4), x**2),
    "root as a power": (x**0.5, ca.sqrt(x)),
    "cubic root": ((x * y) ** ca.SX(1 / 3), x ** ca.SX(1 / 3) * y ** ca.SX(1 / 3)),
    "power with a parameter": (x ** (a + 2), x**a * x**2),
    "power as exp": (x**a, ca.exp(a * ca.log(x))),
    "integer power": (x**7, x * x * x * x * x * x * x),
    "negative power": (x**-3 * x**3, ca.SX(1)),
    "quotient": ((x + y) / y * y, x + y),
    "inverse": (1 / x * x, ca.SX(1)),
    "log1p": (ca.log1p(x), ca.log(1 + x)),
    "expm1": (ca.expm1(x) + 1, ca.exp(x)),
    "hypot": (ca.hypot(x, y) ** 2, x**2 + y**2),
}  # fmt: skip


def replayed(expressions, *, seed=0):
    """The series of expressions in x and y, which change, and a, which does not."""
    field = field_of()
    lifted = lift([ca.vertcat(x, y), a], expressions, where=[["it"]] * len(expressions))
    function = ca.Function("f", [ca.vertcat(x, y), a, lifted.constants], list(lifted.expressions))
    tape, random = Tape(function), Random(seed)
    constants = [[field.fraction(value)] for value in lifted.values]
    still = frozenset({(1, 0), *((2, k) for k in range(len(constants)))})
    known = {(2, k): value for k, value in enumerate(lifted.values)}
    for _ in range(300):
        values = Values(field, random)
        moving = [[values.number()] for _ in range(2)]
        try:
            replay = Replay(
                tape, values, [moving, [[values.number()]], constants], still=still, rational=known
            )
        except ArithmeticError:  # no root at this point
            continue
        for _ in range(ORDERS):
            for series in moving:
                series.append(values.number())
            replay.step()
        nodes = [output[0] if output else None for output in tape.outputs]
        return [
            [0 if node is None else replay.coefficient(node, k) for k in range(ORDERS + 1)] for node in nodes
        ]
    raise AssertionError("no point was found")


@pytest.mark.parametrize("name", ONE)
def test_identity(name):
    left, right = (ca.SX(one) for one in ONE[name])
    one, other = replayed([left, right])
    assert one == other


@pytest.mark.parametrize(
    ("left", "right"),
    [(ca.exp(x), ca.exp(y)), (ca.exp(2 * x), ca.exp(x)), (ca.sin(x), ca.cos(x)), (ca.log(x), ca.log(y))],
)
def test_what_is_different_stays_different(left, right):
    one, other = replayed([left, right])
    assert one != other


def test_coefficients_of_exp_and_log_are_those_of_taylor():
    """exp(t)/exp(t0) and the logarithm of 1 + t, with x = t0 + t."""
    field = field_of()
    for expression, wanted in (
        (ca.exp(x), [Fraction(1, factorial(k)) for k in range(ORDERS + 1)]),
        (ca.log(x), [None, *(Fraction((-1) ** (k + 1), k) for k in range(1, ORDERS + 1))]),
    ):
        tape = Tape(ca.Function("f", [x], [expression]))
        values = Values(field, Random(2))
        moving = [[1 if wanted[0] is None else values.number()]]
        replay = Replay(tape, values, [moving], still=frozenset(), rational={})
        for k in range(1, ORDERS + 1):
            moving[0].append(1 if k == 1 else 0)
            replay.step()
        first = 1 if wanted[0] is None else replay.coefficient(tape.outputs[0][0], 0)
        for k in range(1, ORDERS + 1):
            assert (
                replay.coefficient(tape.outputs[0][0], k) == field.fraction(wanted[k]) * first % field.prime
            )


@pytest.mark.parametrize(
    ("value", "number"),
    [(0.1, Fraction(1, 10)), (1 / 3, Fraction(1, 3)), (2.0, Fraction(2)), (5 / 7, Fraction(5, 7)),
     (np.pi, Fraction(np.pi)), (-2.5e-7, Fraction(-1, 4_000_000))],
)  # fmt: skip
def test_constants_are_the_rational_numbers_that_were_meant(value, number):
    assert exact(value) == number
