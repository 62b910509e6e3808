"""Draws that weigh alike, whatever they were made by, with what is known of their quality."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.posterior.ensemble import Chains
from casadi_engine.posterior.importance import Weighted
from casadi_engine.posterior.psis import kish, normalised

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drawn:
    """Draws u (n, d) with their log densities (n,).

    method : "importance" or "ensemble", and why; log_evidence, error : with its standard error
    rhat : (d,) or None; bulk, tail : (d,) effective sample sizes of all that was drawn; shape : Pareto k-hat or None
    chains : (m, t, d) of an ensemble, before what was left out had its say, or None
    """

    u: Array
    density: Array
    method: str
    why: str
    log_evidence: float
    error: float
    rhat: Array | None
    bulk: Array
    tail: Array
    shape: float | None
    chains: Array | None = None

    def with_evidence(self, more: float, error: float) -> Drawn:
        """The same, with a log evidence that is larger by so much, and uncertain by so much more."""
        return replace(self, log_evidence=self.log_evidence + more, error=float(np.hypot(self.error, error)))

    def reweighed(self, index: NDArray[np.intp], log_weight: Array, random: np.random.Generator) -> Drawn:
        """As many draws, of those with these numbers and weights."""
        weight = normalised(log_weight)
        places = (np.arange(len(index)) + random.random()) / len(index)
        chosen = index[np.minimum(np.searchsorted(np.cumsum(weight), places), len(index) - 1)]
        share = kish(weight) / len(weight)
        return replace(
            self,
            u=self.u[chosen],
            density=self.density[chosen],
            bulk=share * self.bulk,
            tail=share * self.tail,
        )


def weighed(found: Weighted, why: str, count: int, random: np.random.Generator) -> Drawn:
    """From weighted draws."""
    index = found.resampled(count, random)
    return Drawn(
        found.x[index], found.density[index], "importance", why, found.log_evidence, found.error,
        None, np.full(found.x.shape[1], found.size), found.tail, found.shape,
    )  # fmt: skip


def thinned(chains: Chains, evidence: tuple[float, float], count: int, why: str) -> Drawn:
    """From chains, evenly."""
    flat = chains.x.swapaxes(0, 1).reshape(-1, chains.x.shape[2])
    height = chains.density.T.reshape(-1)
    index = np.unique(np.linspace(0, len(flat) - 1, min(count, len(flat))).round().astype(int))
    return Drawn(
        flat[index],
        height[index],
        "ensemble",
        why,
        *evidence,
        chains.rhat,
        chains.bulk,
        chains.tail,
        None,
        chains.x,
    )
