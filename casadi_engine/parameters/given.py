"""Expressions as users give them: text of the grammar, or CasADi scalars of a set's symbols."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from casadi_engine.errors import ExpressionError, ParameterError, TieError
from casadi_engine.parameters.expression import parse_expression, write_expression
from casadi_engine.parameters.names import near_matches

SHOWN = 60


def read_given(
    expression: Any, symbols: Mapping[str, Any], what: str, error: type[ParameterError]
) -> tuple[Any, str | None]:
    """Return an expression as SX scalar of `symbols`, and its text if it came as text.

    Raises `error`, which names `what`, for anything else and for symbols of another set; for text see
    `parse_expression`.
    """
    if isinstance(expression, str):
        unknown = TieError if error is TieError else ExpressionError
        return parse_expression(expression, symbols, unknown=unknown), expression.strip()
    if not isinstance(expression, ca.SX) or expression.shape != (1, 1):
        seen = f"SX {expression.shape}" if isinstance(expression, ca.SX) else repr(expression)
        raise error(
            f"{what} must be text or a CasADi SX scalar",
            seen=seen,
            allowed='such as "C_eng/4" or parameters.symbol("C_eng")/4',
            cure="write one scalar expression",
        )
    known = {symbol.element_hash() for symbol in symbols.values()}
    strange = [symbol.name() for symbol in ca.symvar(expression) if symbol.element_hash() not in known]
    if strange:
        raise error(
            f"{what} uses symbols that are not of this set",
            seen=", ".join(strange),
            allowed="parameters.symbol(name) with " + near_matches(strange[0], symbols),
            cure="take the symbols from this very set",
        )
    return ca.SX(expression), None  # a copy: SX objects can be changed in place


def names_in(expression: Any) -> tuple[str, ...]:
    """The names that an expression depends on; one that cancels is not among them."""
    return tuple(symbol.name() for symbol in ca.symvar(expression))


def shown_text(expression: Any) -> str:
    """An SX for tables: as text of the grammar, or as CasADi prints it if the grammar lacks something."""
    try:
        return write_expression(expression)
    except ExpressionError:
        text = str(expression)
        return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."
