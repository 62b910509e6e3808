"""The printer: exact texts, and texts that read back as the same value whatever the expression."""

import math

import casadi as ca
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from casadi_engine.model.printing import write_expressions
from casadi_engine.model.styles import LATEX, TEXT
from casadi_engine.parameters import parse_expression

NAMES = ("a", "b", "x", "omega_eng")
a, b, x, w = SYMBOLS = tuple(ca.SX.sym(name) for name in NAMES)


def text(expression, **options):
    return write_expressions([expression], **options).texts[0]


def latex(expression):
    return text(expression, style=LATEX)


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (a + b, "a + b"),
        (a - (b - x), "a - b + x"),
        (-(a + b), "-(a + b)"),
        (a - b * x, "a - b*x"),
        ((a - b) * x, "(a - b)*x"),
        (a / (b * x), "a/(b*x)"),
        (a / b / x, "a/(b*x)"),
        (a / (b / x), "a*x/b"),
        (a * (b / x), "a*b/x"),
        (1 / a, "1/a"),
        (1 / (a + b), "1/(a + b)"),
        (-a / b, "-a/b"),
        (a * -b, "-a*b"),
        ((-a) * (-b), "a*b"),
        (a / -b, "-a/b"),
        (a / 2, "a/2"),
        (0.5 * a, "0.5*a"),
        (2 * a, "2*a"),
        (-3 * a * b, "-3*a*b"),
        (a + -2.5, "a - 2.5"),
        (a - -2.5, "a + 2.5"),
        (a**2, "a**2"),
        ((a + b) ** 2, "(a + b)**2"),
        ((-a) ** 3, None),
        ((a * b) ** 2, "(a*b)**2"),
        (a**b, "a**b"),
        (a ** (b + 1), "a**(b + 1)"),
        (a ** (-b), "a**(-b)"),
        ((a**b) ** x, "(a**b)**x"),
        (2 * a**2, "2*a**2"),
        (-(a**2), "-a**2"),
        (ca.sin(a - 3 * math.pi), "sin(a - 3*pi)"),
        (ca.cos(a + math.pi / 2), "cos(a + pi/2)"),
        (a * math.pi, "pi*a"),
        (a / math.pi, "a/pi"),
        (a / (1.5 * math.pi), "a/(3*pi/2)"),
        (ca.sqrt(1 - (a / b) ** 2), "sqrt(1 - (a/b)**2)"),
        (ca.fabs(-a), None),
        (ca.fmax(a, ca.tanh(b)), "max(a, tanh(b))"),
        (ca.if_else(a < b, x, 0), None),
        (a < b, "a < b"),
        (ca.SX(0), "0"),
        (ca.SX(-1.5), "-1.5"),
        (ca.SX(1e-9), "1e-09"),
        (ca.SX(math.inf), "inf"),
        (ca.SX(-math.inf), "-inf"),
        (ca.SX(math.nan), "nan"),
        (a, "a"),
        (0 * a + ca.SX(3e20), "3e+20"),
    ],
)
def test_text(expression, expected):
    if expected is None:  # CasADi rewrites it first; it must not fail
        assert text(expression)
    else:
        assert text(expression) == expected


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (w, r"\omega_{\mathrm{eng}}"),
        (ca.SX.sym("x_1"), "x_{1}"),
        (ca.SX.sym("p12"), "p_{12}"),
        (ca.SX.sym("theta"), r"\theta"),
        (ca.SX.sym("twist"), r"\mathrm{twist}"),
        (ca.SX.sym("w_cylinder_1"), r"w_{\mathrm{cylinder\,1}}"),
        (a / b, r"\frac{a}{b}"),
        ((a + b) / (a - b), r"\frac{a + b}{a - b}"),
        ((a + b) * x / b, r"\frac{\left(a + b\right) \, x}{b}"),
        (1 / b, r"\frac{1}{b}"),
        ((a / b) ** 2, r"\left(\frac{a}{b}\right)^{2}"),
        (a ** (b + 1), r"a^{b + 1}"),
        (ca.sin(a - math.pi / 2), r"\sin\left(a - \frac{\pi}{2}\right)"),
        (ca.sqrt(a + b), r"\sqrt{a + b}"),
        (ca.fabs(a), r"\left|a\right|"),
        (ca.atan(a), r"\arctan\left(a\right)"),
        (ca.sign(a), r"\operatorname{sign}\left(a\right)"),
        (1e-9 * a, r"1 \cdot 10^{-9} \, a"),
        (2.5e21 + a, r"2.5 \cdot 10^{21} + a"),
        (a <= b, r"a \le b"),
        (ca.SX(-math.inf), r"-\infty"),
        (a - (b + 1), "a - b - 1"),
    ],
)
def test_latex(expression, expected):
    assert latex(expression) == expected


def grow(children):
    binary = st.sampled_from([lambda p, q: p + q, lambda p, q: p - q, lambda p, q: p * q, lambda p, q: p / q])
    unary = st.sampled_from([lambda p: -p, lambda p: p**2, ca.sin, ca.tanh, lambda p: 1 / p, lambda p: 2 * p])
    return st.one_of(
        st.builds(lambda f, p, q: f(p, q), binary, children, children),
        st.builds(lambda f, p: f(p), unary, children),
    )


leaves = st.one_of(
    st.sampled_from(SYMBOLS),
    st.sampled_from([1.0, -2.0, 0.5, math.pi, -3 * math.pi / 2, 1e-7]).map(ca.SX),
)


@settings(max_examples=150, deadline=None)
@given(st.recursive(leaves, grow, max_leaves=12), st.integers(0, 4))
def test_text_reads_back_as_the_same_value(expression, least):
    """Shared parts are put back from their definitions, in order, before reading."""
    point = ca.DM([0.7, -1.3, 0.4, 2.1])
    first = float(ca.Function("first", [ca.vertcat(*SYMBOLS)], [expression])(point))
    assume(math.isfinite(first) and abs(first) < 1e8)
    written = write_expressions([expression], shared_operations=least)
    # a constant that is a division by zero is written, and not read
    assume(not any("inf" in text for text in (*written.texts, *(own for _, own in written.shared))))
    symbols = dict(zip(NAMES, SYMBOLS, strict=True))
    for name, definition in written.shared:
        symbols[name] = parse_expression(definition, symbols)
    again = parse_expression(written.texts[0], symbols)
    second = float(ca.Function("second", [ca.vertcat(*SYMBOLS)], [again])(point))
    assert second == pytest.approx(first, rel=1e-6, abs=1e-6)


def test_large_shared_parts_are_written_once():
    part = ca.sqrt(1 + a**2 + b**2)
    written = write_expressions([part * x, w / part], shared_operations=3)
    assert written.texts == ("z1*x", "omega_eng/z1")
    assert written.shared == (("z1", "sqrt(1 + a**2 + b**2)"),)
    assert write_expressions([part * x, w / part]).shared == ()


def test_shared_parts_may_use_each_other_and_avoid_taken_names():
    inner = ca.sin(a + b) + 1
    outer = inner**2 + inner * ca.SX.sym("z1")
    written = write_expressions([outer + 1 / outer], shared_operations=2)
    assert written.shared == (("z2", "sin(a + b) + 1"), ("z3", "z2**2 + z2*z1"))
    assert written.texts == ("z3 + 1/z3",)


def test_given_names_are_used_where_they_occur():
    lever = ca.sin(a)
    written = write_expressions([b * lever, x], named={"f": lever, "unused": ca.cos(a)})
    assert written.texts == ("b*f", "x")
    assert written.shared == (("f", "sin(a)"),)


def test_an_expression_that_is_itself_a_named_part():
    part = ca.sin(a)
    written = write_expressions([part, b * part], named={"f": part})
    assert written.texts == ("f", "b*f")


def test_long_sums_do_not_break_the_printer():
    total = ca.SX(0)
    for index in range(200):
        total = total + ca.SX.sym(f"t{index}")
    assert text(total).count(" + ") == 199


def test_derivative_and_symbol_of_the_styles():
    assert TEXT.derivative("omega") == "d(omega)/dt"
    assert LATEX.derivative("omega") == r"\frac{\mathrm{d}}{\mathrm{d}t} \omega"
