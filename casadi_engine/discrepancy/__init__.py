"""Discrepancy: where simulation and data disagree, and which effect, not in the model, explains it."""

from casadi_engine.discrepancy.repair import repair
from casadi_engine.discrepancy.repaired import Repair
from casadi_engine.discrepancy.screening import Screened, screen

__all__ = ["Repair", "Screened", "repair", "screen"]
