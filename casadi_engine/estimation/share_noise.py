"""Noise that is a share of what a sensor shows, for bands of what it will show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.loss import loss_of
from casadi_engine.estimation.varied_noise import FLOOR, as_a_share

Array = NDArray[np.float64]

# How many times more likely noise that is a share has to be than one of one size: normal noise of one size is so once
# in 140 records at most, Phi(-sqrt(2 log 20)), and less often where an output varies by more than a few per cent.
_LIKELY = 20.0


@dataclass(frozen=True)
class ShareNoise:
    """Noise of a share of what an output shows, of ``floor`` [output's unit] at least."""

    share: float
    floor: float

    def at(self, shown: Array) -> Array:
        """Standard deviations where an output shows this (...,)."""
        return np.asarray(self.share * np.maximum(np.abs(shown), self.floor))


def share_noises(fit: Fit) -> dict[str, ShareNoise]:
    """Output -> its noise, of those with an estimated level whose residuals say that it is a share of what is shown."""
    found: dict[str, ShareNoise] = {}
    if loss_of(fit).robust or fit.innovations is not None:
        return found
    for name, (_, estimated) in fit.noise.items():
        traces = [own[name] for own in fit.traces.values() if name in own]
        if not (estimated and traces):
            continue
        residual = np.concatenate([one.residual[one.mask] for one in traces])
        size = np.abs(np.concatenate([one.simulated[one.mask] for one in traces]))
        if as_a_share(residual, size) < math.log(_LIKELY):
            continue
        floor = FLOOR * float(size.max())
        left = residual / np.maximum(size, floor)
        # by what the estimates left of the residual
        kept = max(fit.dof / max(fit.n, 1), 1 / max(fit.n, 1))
        found[name] = ShareNoise(float(np.sqrt(np.mean(left**2) / kept)), floor)
    return found
