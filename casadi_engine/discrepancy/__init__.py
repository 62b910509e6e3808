"""Discrepancy: where simulation and data disagree, and which effect, not in the model, explains it."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repair import repair
    from casadi_engine.discrepancy.repaired import Repair
    from casadi_engine.discrepancy.screening import Screened, screen

__all__ = ["Repair", "Screened", "repair", "screen"]

import_at_first_use(
    __name__,
    {
        "casadi_engine.discrepancy.repair": ("repair",),
        "casadi_engine.discrepancy.repaired": ("Repair",),
        "casadi_engine.discrepancy.screening": ("Screened", "screen"),
    },
)
