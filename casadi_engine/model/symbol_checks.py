"""Every symbol of a model's expressions is declared, and stands where it may be used."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from casadi_engine.errors import ModelError
from casadi_engine.model.declarations import Port, Variable
from casadi_engine.model.model import Model

_MOVED = "move the term: channels enter by drives, nonlinear torques by laws of ports"


def check_symbols(model: Model) -> None:
    """Every symbol of every expression must be declared, and allowed where it is used."""
    groups = {
        "states": model.x,
        "channels": model.u,
        "drives": model.d,
        "slots": model.w,
        "time": model.t,
        "parameters": model.p,
    }
    owner = {key: group for group, own in groups.items() for key in hashes(own)}
    rules: list[tuple[str, Sequence[Variable | Port], Any, tuple[str, ...]]] = [
        ("the ode of", model.states, model.ode, ("states", "drives", "slots", "time", "parameters")),
        ("the drive", model.drives, model.drive_expressions, ("channels", "time", "parameters")),
        ("the law of port", model.ports.with_slot, model.laws, tuple(groups)),
        ("the output", model.outputs, model.output_expressions, ("states", "drives", "slots", "parameters")),
    ]
    for what, items, expressions, allowed in rules:
        wrong = [
            symbol for symbol in ca.symvar(expressions) if owner.get(symbol.element_hash()) not in allowed
        ]
        if not wrong:
            continue
        symbol, group = wrong[0], owner.get(wrong[0].element_hash())
        row = next(row for row in range(len(items)) if ca.depends_on(expressions[row], symbol))
        if group is None:
            raise ModelError(
                f"{what} {items[row].name} uses a symbol that was not declared",
                seen=symbol.name(),
                allowed=", ".join(made.name() for made in ca.symvar(column(groups.values()))),
                cure="declare it with state, input, drive, port or parameter and use the symbol returned",
            )
        raise ModelError(
            f"{what} {items[row].name} uses a symbol that may not be used there",
            seen=f"{symbol.name()} (one of the {group})",
            allowed=", ".join(allowed),
            cure=_MOVED,
        )


def column(items: Any) -> Any:
    """SX scalars below each other, (0, 1) without any."""
    made = list(items)
    return ca.vertcat(*made) if made else ca.SX(0, 1)


def hashes(expressions: Any) -> set[int]:
    """What tells the symbols of expressions apart, whatever their names."""
    return {symbol.element_hash() for symbol in ca.symvar(expressions)}
