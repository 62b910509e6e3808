"""Loss functions of the weighted residual: least squares, and Huber's for outliers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError

Array = NDArray[np.float64]


# Key of a fit's options: from how many standard deviations on a residual counts linearly, where it does.
KNEE = "knee"


@dataclass(frozen=True)
class Loss:
    """rho(r) = r^2/2 up to |r| = knee, linear beyond (Huber 1964); knee = inf is least squares."""

    knee: float = math.inf

    @property
    def robust(self) -> bool:
        """True for Huber's loss."""
        return math.isfinite(self.knee)

    def value(self, r: Array) -> float:
        """Sum of rho."""
        if not self.robust:
            return 0.5 * float(np.vdot(r, r))
        size = np.abs(r)
        return float(np.where(size <= self.knee, 0.5 * r * r, self.knee * (size - 0.5 * self.knee)).sum())

    def slope(self, r: Array) -> Array:
        """rho'(r)."""
        return np.clip(r, -self.knee, self.knee) if self.robust else r

    def curvature(self, r: Array) -> Array | None:
        """rho''(r), or None where it is 1 throughout."""
        return (np.abs(r) <= self.knee).astype(float) if self.robust else None

    def secant(self, r: Array) -> Array | None:
        """rho'(r)/r: the parabola through r with this curvature lies above rho, so its steps lower the loss.

        Far from the solution rho'' vanishes nearly everywhere and says nothing about the length of a step.
        """
        return self.knee / np.maximum(np.abs(r), self.knee) if self.robust else None


def loss_of(fit: Any) -> Loss:
    """The loss that a fit was made with; least squares of what is no fit."""
    knee = getattr(fit, "options", {}).get(KNEE)
    return Loss() if knee is None else Loss(float(knee))


def read_loss(loss: Any) -> Loss:
    """Loss of the ``loss`` option: "square", "huber" (knee 1.345) or ("huber", knee)."""
    if isinstance(loss, Loss):
        return loss
    word = loss if isinstance(loss, str) else None
    if word == "square":
        return Loss()
    if word == "huber":
        return Loss(1.345)
    if isinstance(loss, tuple) and len(loss) == 2 and isinstance(loss[0], str) and loss[0] == "huber":
        knee = loss[1]
        number = isinstance(knee, (int, float)) and not isinstance(knee, bool)
        if number and math.isfinite(knee) and knee > 0:
            return Loss(float(knee))
    raise EstimationError(
        "the loss is not known",
        seen=repr(loss),
        allowed='"square", "huber", or ("huber", knee) with the knee in standard deviations',
        cure='leave it out for least squares, or give ("huber", 1.345)',
    )
