"""The functions that effects' laws are written with: smooth ones for fits, sharp ones for simulation."""

from __future__ import annotations

import math as _math
from typing import Any

import casadi as ca


class Smooth:
    """Switches and kinks rounded over `width`, so that laws can be differentiated.

    Each is the sharp one a few widths away from the switch, and dead_zone is exactly its argument at half = 0.
    """

    sharp = False
    pi = _math.pi
    sin, cos, tan = staticmethod(ca.sin), staticmethod(ca.cos), staticmethod(ca.tan)
    exp, log, sqrt, tanh = (staticmethod(made) for made in (ca.exp, ca.log, ca.sqrt, ca.tanh))

    @staticmethod
    def sign(x: Any, width: Any) -> Any:
        """−1, 0 or 1; tanh(x/width)."""
        return ca.tanh(x / width)

    @staticmethod
    def step(x: Any, width: Any) -> Any:
        """0 for x < 0, 1 for x > 0."""
        return 0.5 * (1 + ca.tanh(x / width))

    @staticmethod
    def abs(x: Any, width: Any) -> Any:
        """|x|; sqrt(x² + width²)."""
        return ca.sqrt(x**2 + width**2)

    @staticmethod
    def positive(x: Any, width: Any) -> Any:
        """x for x > 0, else 0."""
        return 0.5 * (x + ca.sqrt(x**2 + width**2))

    @staticmethod
    def dead_zone(x: Any, half: Any, width: Any) -> Any:
        """0 within ±half, and x moved towards 0 by `half` outside."""
        return x - 0.5 * (ca.sqrt((x + half) ** 2 + width**2) - ca.sqrt((x - half) ** 2 + width**2))


class SharpInTime(Smooth):
    """The smooth functions, but a switch at an instant that time and parameters alone decide is sharp: integrators meet
    such instants, and the state behind one moves with it smoothly. A rounded one slips through between two steps.
    """

    def __init__(self, still: Any) -> None:
        """still : symbols that do not move along a simulation, and time."""
        self._still = {one.element_hash() for one in ca.vertsplit(still)}

    def step(self, x: Any, width: Any) -> Any:  # type: ignore[override]
        """0 for x < 0, 1 for x > 0."""
        still = all(one.element_hash() in self._still for one in ca.symvar(ca.SX(x)))
        return Sharp.step(x) if still else Smooth.step(x, width)


class Sharp(Smooth):
    """The same functions without rounding; `width` is ignored."""

    sharp = True

    @staticmethod
    def sign(x: Any, width: Any = None) -> Any:
        """−1, 0 or 1."""
        del width
        return ca.sign(x)

    @staticmethod
    def step(x: Any, width: Any = None) -> Any:
        """0 for x < 0, ½ at 0, 1 for x > 0."""
        del width
        return 0.5 * (1 + ca.sign(x))

    @staticmethod
    def abs(x: Any, width: Any = None) -> Any:
        """|x|."""
        del width
        return ca.fabs(x)

    @staticmethod
    def positive(x: Any, width: Any = None) -> Any:
        """x for x > 0, else 0."""
        del width
        return ca.fmax(x, 0)

    @staticmethod
    def dead_zone(x: Any, half: Any, width: Any = None) -> Any:
        """0 within ±half, and x moved towards 0 by `half` outside."""
        del width
        return x - 0.5 * (ca.fabs(x + half) - ca.fabs(x - half))
