"""The answer on one screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from casadi_engine.estimation.summary import wrapped

if TYPE_CHECKING:
    from casadi_engine.identifiability.structural import Identifiability


def summary(found: Identifiability) -> str:
    """The verdict first, then what is lost, why, and what to do."""
    lines = [*wrapped(verdict(found), "  ")]
    return "\n".join(lines)


def verdict(found: Identifiability) -> str:
    """One sentence."""
    count = len(found.free)
    if found.passed:
        return f"YES: all {count} free parameters can be told"
    return f"NO: {len(found.lost)} of {count} free parameters cannot be told: {', '.join(found.lost)}"
