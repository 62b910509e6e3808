"""Whether an expression is affine in some symbols: the one test of the package, and one that sees jumps."""

from __future__ import annotations

from typing import Any

import casadi as ca

from casadi_engine.model.jumps import jumps_in


def affine_parts(expression: Any, inside: Any, outside: Any) -> tuple[Any, Any] | None:
    """Return slope (k, n) and rest (k, 1) with expression = slope @ inside + rest, or None if it is not so.

    expression : (k, 1) SX        inside : (n, 1) SX symbols
    outside : (m, 1) SX symbols that the slope may not depend on; the rest may, and may jump in them

    CasADi's derivative of ``sign``, ``floor`` or a comparison is 0: to `ca.is_linear` they are constants. So an
    expression with a jump that depends on `inside` is none; one with a kink has a slope that depends on `inside`.

    >>> x, u = ca.SX.sym("x"), ca.SX.sym("u")
    >>> affine_parts(2 * x + ca.sign(u), x, u)
    (SX(2), SX(sign(u)))
    >>> affine_parts(2 * x + ca.sign(x), x, u) is None
    True
    """
    slope = ca.jacobian(expression, inside)
    if not _holds(expression, slope, inside, outside):
        return None
    rest = ca.substitute(expression, inside, ca.SX.zeros(inside.numel(), 1)) if inside.numel() else expression
    return slope, rest


def is_affine(expression: Any, inside: Any, outside: Any) -> bool:
    """True if (k, 1) SX `expression` is affine in `inside`, and nothing in it depends on `outside`.

    >>> x, p = ca.SX.sym("x"), ca.SX.sym("p")
    >>> is_affine(p * x + ca.sign(p), x, ca.SX(0, 1)), is_affine(ca.if_else(x > 0, p, -p), x, ca.SX(0, 1))
    (True, False)
    """
    if ca.depends_on(expression, outside):
        return False
    return _holds(expression, ca.jacobian(expression, inside), inside, outside)


def _holds(expression: Any, slope: Any, inside: Any, outside: Any) -> bool:
    """True if the slope is the same everywhere, and no jump lies between two points."""
    return not ca.depends_on(slope, ca.vertcat(inside, outside)) and not jumps_in(expression, inside)
