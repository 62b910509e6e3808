"""Constants of an expression, some of which are no numbers where Python's own functions were called with a symbol."""

from __future__ import annotations

from typing import Any

import casadi as ca


def constants(expression: Any) -> list[float]:
    """The constants of an SX scalar."""
    function = ca.Function("value", ca.symvar(expression), [expression])
    return [
        float(function.instruction_constant(k))
        for k in range(function.n_instructions())
        if function.instruction_id(k) == ca.OP_CONST
    ]
