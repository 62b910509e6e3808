"""Random SX expressions with jumps and kinks, for hypothesis."""

import casadi as ca
from hypothesis import strategies as st

UNARY = {
    "neg": lambda a: -a,
    "sin": ca.sin,
    "tanh": ca.tanh,
    "square": lambda a: a * a,
    "sign": ca.sign,
    "fabs": ca.fabs,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "not": ca.logic_not,
    "heaviside": ca.heaviside,
    "ramp": ca.ramp,
    "pw_const": lambda a: ca.pw_const(a, ca.DM([-0.3, 0.4]), ca.DM([1, -2, 3])),
    "pw_lin": lambda a: ca.pw_lin(a, ca.DM([-1, 0.2, 1]), ca.DM([1, -2, 3])),
    "conditional": lambda a: ca.conditional(ca.floor(a), [a, -2 * a], 3.0),
}
BINARY = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "half sum": lambda a, b: (a + b) / 2,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "fmod": lambda a, b: ca.fmod(a, 1 + b * b),
    "remainder": lambda a, b: ca.remainder(a, 1 + b * b),
    "copysign": ca.copysign,
    "less": lambda a, b: a < b,
    "at most": lambda a, b: a <= b,
    "equal": lambda a, b: a == b,
    "not equal": lambda a, b: a != b,
    "and": ca.logic_and,
    "or": ca.logic_or,
    "constants": lambda a, b: ca.if_else(a > b, -1.3, 0.4),
    "branches": lambda a, b: ca.if_else(a < b, 2 * a + 1, -b),
    "atan2": ca.atan2,
}


def expressions(symbols, *, without=(), leaves=6):
    """A strategy of SX scalars of some of the symbols."""
    constants = st.sampled_from([-2.0, -0.5, 0.0, 0.7, 1.0, 3.0]).map(ca.SX)
    unary = st.sampled_from([made for name, made in UNARY.items() if name not in without])
    binary = st.sampled_from([made for name, made in BINARY.items() if name not in without])
    return st.recursive(
        st.one_of(st.sampled_from(symbols), st.sampled_from(symbols), constants),
        lambda inner: st.one_of(
            st.builds(lambda f, a: ca.SX(f(a)), unary, inner),
            st.builds(lambda f, a, b: ca.SX(f(a, b)), binary, inner, inner),
        ),
        max_leaves=leaves,
    )
