"""Functions replayed on arrays against CasADi's own evaluation."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.simulation import tape
from casadi_engine.simulation.tape import ArrayFunction

# Numbers at which signs, kinks and poles show.
SPECIAL = np.array([-3.0, -2.0, -1.0, -0.5, -0.0, 0.0, 0.3, 0.5, 1.0, 2.0, 2.5, 3.0, np.inf, -np.inf, np.nan])

UNARY = {
    "neg": lambda a: -a,
    "exp": ca.exp,
    "log": ca.log,
    "sqrt": ca.sqrt,
    "square": lambda a: a**2,
    "twice": lambda a: a + a,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "asinh": ca.asinh,
    "acosh": ca.acosh,
    "atanh": ca.atanh,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "fabs": ca.fabs,
    "sign": ca.sign,
    "erf": ca.erf,
    "inverse": lambda a: 1 / a,
    "not": ca.logic_not,
    "cube": lambda a: a**3,
    "power": lambda a: a**1.7,
    "base": lambda a: 2.5**a,
    "log1p": ca.log1p,
    "expm1": ca.expm1,
    "erfinv": ca.erfinv,
}
BINARY = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "and": ca.logic_and,
    "or": ca.logic_or,
    "fmod": ca.fmod,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "atan2": ca.atan2,
    "copysign": ca.copysign,
    "if_else": lambda a, b: ca.if_else(a > 0, a, b),
    "hypot": ca.hypot,
    "remainder": ca.remainder,
}


def one_by_one(inputs, outputs, arguments, count):
    """CasADi's evaluation, column by column."""
    f = ca.Function("f", inputs, [ca.densify(ca.vec(out)) for out in outputs])
    wide = [a if a.ndim == 2 else np.repeat(a[:, None], count, axis=1) for a in arguments]
    columns = [f.call([ca.DM(a[:, k]) for a in wide]) for k in range(count)]
    return [
        np.array([np.asarray(column[i], dtype=float).ravel() for column in columns]).T
        for i in range(len(outputs))
    ]


def compare(inputs, outputs, arguments, rtol=1e-14):
    count = max((a.shape[1] for a in arguments if a.ndim == 2), default=1)
    found = ArrayFunction(inputs, outputs)(*arguments)
    for part, target in zip(found, one_by_one(inputs, outputs, arguments, count), strict=True):
        assert part.shape == target.shape
        np.testing.assert_allclose(part, target, rtol=rtol, atol=1e-15)


# ---- operations


@pytest.mark.parametrize("name", UNARY)
def test_functions_of_one_argument(name):
    a = ca.SX.sym("a")
    compare([a], [UNARY[name](a)], [SPECIAL[None]], rtol=1e-13)


@pytest.mark.parametrize("name", BINARY)
def test_functions_of_two_arguments(name):
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    values = SPECIAL[:-3] if name in ("atan2", "copysign", "fmod", "remainder", "pow") else SPECIAL
    x, y = (part.reshape(1, -1) for part in np.meshgrid(values, values))
    compare([a, b], [BINARY[name](a, b)], [x, y], rtol=1e-13)


def test_signs_of_zero_and_infinity():
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    x, y = (part.reshape(1, -1) for part in np.meshgrid(SPECIAL[:-1], SPECIAL[:-1]))
    for name in ("atan2", "copysign"):
        compare([a, b], [BINARY[name](a, b)], [x, y])


OPERATIONS = ["+", "-", "*", "/", "sin", "tanh", "sqrt1", "max", "less", "sq", "atan2", "const"]


def combined(data, leaves):
    """A random expression of up to 25 operations."""
    nodes = list(leaves)
    for _ in range(data.draw(st.integers(1, 25))):
        a, b = (nodes[data.draw(st.integers(0, len(nodes) - 1))] for _ in range(2))
        kind = data.draw(st.sampled_from(OPERATIONS))
        nodes.append(
            {
                "+": lambda a=a, b=b: a + b,
                "-": lambda a=a, b=b: a - b,
                "*": lambda a=a, b=b: a * b,
                "/": lambda a=a, b=b: a / (2 + ca.fabs(b)),
                "sin": lambda a=a: ca.sin(a),
                "tanh": lambda a=a: ca.tanh(a),
                "sqrt1": lambda a=a: ca.sqrt(1 + a**2),
                "max": lambda a=a, b=b: ca.fmax(a, b),
                "less": lambda a=a, b=b: ca.if_else(a < b, a, -b),
                "sq": lambda a=a: ca.tanh(a) ** 2,
                "atan2": lambda a=a, b=b: ca.atan2(a, 1 + b**2),
                "const": lambda: ca.SX(data.draw(st.floats(-3, 3))),
            }[kind]()
        )
    return nodes


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.data())
def test_random_expressions(data):
    x, p, t = ca.SX.sym("x", 2), ca.SX.sym("p", 3), ca.SX.sym("t")
    nodes = combined(data, [x[0], x[1], p[0], p[1], p[2], t])
    picked = [nodes[data.draw(st.integers(0, len(nodes) - 1))] for _ in range(4)] + [nodes[-1]]
    matrix = ca.SX(2, 3)  # structural zeros in it
    matrix[0, 0], matrix[1, 1], matrix[0, 2] = picked[0], picked[1], picked[2]
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    arguments = [rng.normal(size=(2, 6)), rng.normal(size=3), rng.normal(size=(1, 6))]
    compare([x, p, t], [matrix, ca.vertcat(*picked)], arguments, rtol=1e-10)


# ---- shapes


def test_arguments_that_are_the_same_in_all_columns():
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", 2)
    f = ArrayFunction([x, p], [x * p, ca.dot(p, p), ca.SX(3.0)])
    found = f(np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([10.0, 100]))
    np.testing.assert_array_equal(found[0], [[10, 20, 30], [400, 500, 600]])
    np.testing.assert_array_equal(found[1], [[10100] * 3])
    np.testing.assert_array_equal(found[2], [[3.0] * 3])


def test_without_columns_there_is_one():
    p = ca.SX.sym("p", 2)
    np.testing.assert_array_equal(ArrayFunction([p], [2 * p])(np.array([1.0, 2.0]))[0], [[2.0], [4.0]])


def test_empty_arguments_and_outputs():
    none, t = ca.SX(0, 1), ca.SX.sym("t")
    found = ArrayFunction([none, t, none], [t + 1, ca.SX(0, 3)])(
        np.zeros((0, 4)), np.ones((1, 4)), np.zeros(0)
    )
    np.testing.assert_array_equal(found[0], [[2.0] * 4])
    assert found[1].shape == (0, 4)


def test_matrices_come_by_columns_with_their_zeros():
    t = ca.SX.sym("t")
    matrix = ca.SX(2, 2)
    matrix[1, 0], matrix[0, 1] = t, 2 * t
    found = ArrayFunction([t], [matrix])(np.array([[1.0, 10.0]]))[0]
    np.testing.assert_array_equal(found, [[0, 0], [1, 10], [2, 20], [0, 0]])


def test_arguments_are_not_changed_and_results_are_fresh():
    t = ca.SX.sym("t")
    given_values = np.ones((1, 3))
    f = ArrayFunction([t], [t, t])
    first, second = f(given_values)
    first[:] = 7
    np.testing.assert_array_equal(second, [[1, 1, 1]])
    np.testing.assert_array_equal(given_values, [[1, 1, 1]])


# ---- long arrays, unknown operations


@pytest.mark.parametrize("count", [1, 4095, 4096, 4097, 9000])
def test_long_arrays_are_worked_on_in_pieces(count):
    assert tape._CHUNK == 4096
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    f = ArrayFunction([x, p], [ca.sin(x) * p, x[0] - x[1]])
    values = np.random.default_rng(0).normal(size=(2, count))
    found = f(values, np.array([2.0]))
    np.testing.assert_allclose(found[0], 2 * np.sin(values), rtol=1e-14)
    np.testing.assert_array_equal(found[1], values[:1] - values[1:])


def test_operations_that_are_not_known_are_left_to_casadi():
    a, p, none = ca.SX.sym("a", 2), ca.SX.sym("p"), ca.SX(0, 1)
    f = ArrayFunction([a, p, none], [ca.erfinv(a) * p, ca.SX(1, 2), p])
    assert not f._replay
    values = np.random.default_rng(0).uniform(-0.9, 0.9, (2, 40))
    compare([a, p, none], [ca.erfinv(a) * p, ca.SX(1, 2), p], [values, np.array([2.0]), np.zeros(0)])
    long = f(np.tile(values, 200), np.array([2.0]), np.zeros(0))
    np.testing.assert_array_equal(long[0][:, -40:], long[0][:, :40])
    assert [part.shape for part in long] == [(2, 8000), (2, 8000), (1, 8000)]


def test_what_is_not_finite_makes_no_noise():
    a = ca.SX.sym("a")
    found = ArrayFunction([a], [ca.log(a), 1 / a, ca.exp(1000 * a)])(np.array([[-1.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(np.isfinite(found[0]), [[False, False, True]])
    np.testing.assert_array_equal(np.isfinite(found[1]), [[True, False, True]])
    np.testing.assert_array_equal(np.isfinite(found[2]), [[True, True, False]])


# ---- bound to its last inputs


def test_a_bound_function_is_the_same_and_works_out_what_it_knows_once():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 2)
    expression = ca.vertcat(
        ca.tanh(x[0] / p[0]) * ca.sin(p[1]) + u, ca.fmax(x[1], p[0]) ** 2, p[0] * p[1] + 1
    )
    function = ArrayFunction([x, u, p], [expression, x[0] + 0 * u])
    rng = np.random.default_rng(0)
    columns, channel, known = rng.normal(size=(2, 7)), rng.normal(size=(1, 7)), np.array([0.3, 1.2])
    bound = function.bound(known)
    for _ in range(2):  # nothing is left over from the first call
        for one, other in zip(bound(columns, channel), function(columns, channel, known), strict=True):
            np.testing.assert_array_equal(one, other)
    other = rng.normal(size=(2, 3))
    np.testing.assert_array_equal(bound(other, channel[:, :3])[0], function(other, channel[:, :3], known)[0])


def test_a_bound_function_with_an_unknown_operation_is_evaluated_by_casadi():
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    function = ArrayFunction([x, p], [ca.remainder(x, p)])
    found = function.bound(np.array([2.0]))(np.array([[0.3, 2.5, 4.1]]))
    np.testing.assert_allclose(found[0], [[0.3, 0.5, 0.1]], atol=1e-15)
