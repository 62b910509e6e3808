"""A repair on one screen: the verdict, the effects found, the gap before and after, and what to do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair


def summary(repair: Repair) -> str:
    """Return a repair as text of at most 45 lines and 100 columns."""
    return f"Repair of {repair.model.name}: {repair.verdict or repair.status}"
