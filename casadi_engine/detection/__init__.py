"""Misfire detection: the probability of every combustion that it was lost, from crank speed alone."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from .misfires import Misfires, misfires

__all__ = ["Misfires", "misfires"]

import_at_first_use(__name__, {"casadi_engine.detection.misfires": ("Misfires", "misfires")})
