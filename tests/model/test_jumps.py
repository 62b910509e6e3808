"""Switching functions of expressions, and expressions with their jumps held."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.model.jumps import has_jumps, jumps, jumps_in, with_held_jumps
from tests.model.random_expressions import expressions

X, Y, P = ca.SX.sym("x"), ca.SX.sym("y"), ca.SX.sym("p")
BOTH = ca.vertcat(X, Y)
REPEATABLE = settings(max_examples=200, deadline=None, derandomize=True)

# expression, (switching function, kind) of each event
CASES = {
    "smooth": (ca.tanh(X) * ca.hypot(X, Y) + ca.erf(Y), []),
    "sign": (ca.sign(2 * X - Y), [(2 * X - Y, "jump")]),
    "constants": (ca.if_else(X > 2, -3.0, 3.0), [(2 - X, "jump")]),
    "condition that is a number": (ca.if_else(X, 1.0, 2.0), [(X, "jump")]),
    "two comparisons": (ca.logic_and(X > 0, ca.logic_not(Y <= 1)), [(X, "jump"), (Y - 1, "jump")]),
    "table": (ca.pw_const(X, ca.DM([0, 1]), ca.DM([1, 2, 3])), [(X, "jump"), (1 - X, "jump")]),
    "floor and ceil": (ca.floor(X) + ca.ceil(X), [(X, "integer")]),
    "remainder of a division": (ca.fmod(X, Y), [(X / Y, "integer")]),
    "nearest remainder": (ca.remainder(X, Y), [(X / Y + 0.5, "integer")]),
    "kinks": (ca.fabs(X) + ca.fmax(X, Y), [(X, "kink"), (X - Y, "kink")]),
    "jump and kink at one place": (ca.fabs(X) * ca.sign(X), [(X, "jump")]),
    "sign of another number": (ca.copysign(X, Y), [(X, "kink"), (Y, "jump")]),
    "angle": (ca.atan2(Y, X), [(Y, "jump")]),
    "jump of a jump": (ca.sign(ca.sign(X) + 0.5), [(X, "jump")]),
    "jump in a switching function": (ca.floor(X + ca.sign(Y)), [(Y, "jump"), (X + ca.sign(Y), "integer")]),
}


@pytest.mark.parametrize("name", CASES)
def test_the_switching_functions_of_an_expression(name):
    expression, expected = CASES[name]
    found = jumps(expression)
    assert [switch.kind for switch in found] == [kind for _, kind in expected]
    for switch, (g, _) in zip(found, expected, strict=True):
        value = ca.Function("g", [X, Y], [ca.fabs(switch.g) - ca.fabs(g)])  # the sign of g means nothing
        assert all(abs(float(value(*point))) < 1e-15 for point in [(0.3, -1.7), (-2.4, 0.9), (5.1, 3.3)])


def test_a_switch_that_depends_on_other_symbols_alone_is_none_of_these():
    expression = ca.sign(P) * ca.if_else(X > P, 1.0, -1.0)
    assert [str(switch.g) for switch in jumps(expression, X)] == ["(p-x)"]
    assert len(jumps(expression)) == 2
    held = with_held_jumps(expression, X)
    assert held.symbols.numel() == 1
    assert str(held.values[0]) == "(p<x)"


def test_whole_numbers_are_zeros_of_a_sine():
    (switch,) = jumps(ca.floor(3 * X))
    at = ca.Function("at", [X], [switch.function])
    assert abs(float(at(2 / 3))) < 1e-15
    assert float(at(0.6)) * float(at(0.7)) < 0


@pytest.mark.parametrize(
    ("expression", "of", "jumping"),
    [
        (ca.sign(X), X, True),
        (ca.sign(Y), X, False),
        (ca.if_else(Y > 0, X, -X), X, False),
        (ca.if_else(X > 0, Y, -Y), X, True),
        (ca.fmod(X, 3), X, True),
        (ca.fabs(X) + ca.fmin(X, Y), X, False),
        (ca.atan2(Y, X), X, True),
        (ca.SX(2), X, False),
    ],
)
def test_whether_a_jump_depends_on_symbols(expression, of, jumping):
    assert jumps_in(expression, of) is jumping


def numbers(expressions, point):
    return np.array(ca.Function("f", [BOTH], [ca.vertcat(ca.SX(0, 1), *expressions)])(point)).ravel()


POINTS = st.lists(st.floats(-2, 2, width=16), min_size=2, max_size=2)


@REPEATABLE
@given(expressions([X, Y]), POINTS)
def test_a_held_expression_with_its_values_is_the_expression(expression, point):
    held = with_held_jumps(expression)
    whole = ca.substitute(held.expression, held.symbols, held.values) if held.at else held.expression
    expected, found = numbers([expression, whole], point)
    assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


@REPEATABLE
@given(expressions([X, Y], without=("atan2",)))
def test_a_held_expression_is_smooth(expression):
    held = with_held_jumps(expression)
    assert jumps(held.expression, BOTH) == []
    assert not any(jumps(switch.g, BOTH) for switch in held.switches)


@REPEATABLE
@given(expressions([X, Y]), POINTS, POINTS)
def test_held_values_change_with_their_switch_alone(expression, first, second):
    held, found = with_held_jumps(expression), jumps(expression)
    assert len(found) == len(held.switches)
    signature = lambda s, g: (np.floor(g), np.ceil(g)) if s.kind == "integer" else np.sign(g)  # noqa: E731
    g, b = (
        [numbers(column, point) for point in (first, second)]
        for column in ([switch.g for switch in found], ca.vertsplit(held.values))
    )
    for j, index in enumerate(held.at):
        if signature(found[index], g[0][index]) == signature(found[index], g[1][index]):
            assert b[0][j] == b[1][j]


def test_an_angle_is_continued_over_its_jump():
    held = with_held_jumps(ca.atan2(Y, X))
    at = ca.Function("at", [X, Y, held.symbols], [held.expression])
    for angle in np.linspace(2.0, 4.2, 12):
        assert float(at(np.cos(angle), np.sin(angle), 1.0)) == pytest.approx(angle, rel=1e-14)


@pytest.mark.parametrize("name", CASES)
def test_an_expression_has_jumps_where_a_switch_is_one(name):
    """Kinks are none; also among the rows of a column that has smooth ones and zeros."""
    expression, switches = CASES[name]
    jumping = any(kind != "kink" for _, kind in switches)
    assert has_jumps(expression) == jumping
    assert has_jumps(ca.vertcat(ca.SX(1, 1), X, expression)) == jumping
