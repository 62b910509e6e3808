"""The coordinates v in which the solver works: logarithms of what must be positive, scaled values of the rest."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.parameters.compiled import ParameterMap

Array = NDArray[np.float64]

# Beyond this an exponential is no number; a search that runs away must end with one.
_FARTHEST = 300.0


class Coordinates:
    """z = scale * exp(v) where the lower bound is positive (inertias, stiffnesses), else z = scale * v.

    A step in the logarithm cannot cross zero, and inertias and stiffnesses are known to a factor rather than to an
    amount; a damper may be zero and stays linear. v = 0 or 1 at the scale.

    felt : (nz,) scales of those whose start says nothing of their size, which are linear too; NaN for the rest
    """

    def __init__(self, pmap: ParameterMap, felt: Array | None = None) -> None:
        felt = np.full(len(pmap.free), np.nan) if felt is None else felt
        # no size is larger than all that the bounds allow: IPOPT breaks on bounds that lie rounding apart
        felt = np.where(pmap.upper > pmap.lower, np.minimum(felt, pmap.upper - pmap.lower), felt)
        self.scale = np.where(np.isnan(felt), pmap.scale, felt)
        self.log = (pmap.lower > 0) & (pmap.start > 0) & np.isnan(felt)
        self.symbol = ca.SX.sym("v", len(pmap.free))
        parts = [
            float(s) * (ca.exp(self.symbol[i]) if log else self.symbol[i])
            for i, (s, log) in enumerate(zip(self.scale, self.log, strict=True))
        ]
        self.z = ca.vertcat(ca.SX(0, 1), *parts)
        self._pmap = pmap

    def substitute(self, expression: ca.SX) -> ca.SX:
        """An expression of z as one of v."""
        return ca.substitute(expression, self._pmap.z, self.z) if self.symbol.numel() else expression

    def values(self, v: Array) -> Array:
        """z (..., nz) at v (..., nz)."""
        power = np.clip(np.where(self.log, v, 0.0), -_FARTHEST, _FARTHEST)
        return self.scale * np.where(self.log, np.exp(power), v)

    def of(self, z: Array) -> Array:
        """v (nz,) at z (nz,); -inf and inf stay."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.log, np.log(np.where(self.log, z / self.scale, 1.0)), z / self.scale)

    def slope(self, v: Array) -> Array:
        """dz/dv (..., nz), diagonal."""
        return np.where(self.log, self.values(v), self.scale)
