"""Other optima of a linear model in the frequency domain than one that is known, and how they are looked for.

Where a mode is buried in noise, its frequency is at an optimum on many lines of the noise. A search ends where it comes
back to the known optimum, or to one that is higher by more than the bins above the band could make good; only of others
all bins are looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Minimum, minimise
from casadi_engine.estimation.spectral_search import COARSE, Band, Found, SpectralSearch
from casadi_engine.estimation.spectral_squares import BLIND, Told

Array = NDArray[np.float64]

# Optima are looked for where the frequencies below some edge leave a direction more uncertain than all do by this
# factor.
_OPEN = 5.0
# Squared standard errors from an optimum within which a search goes there.
_HOME = 0.5
# Share of its quadratic by which the rise from an optimum may differ from it for the way back to be known.
_BENT = 0.2
# Half chi-squared above the known optimum up to which another one counts (a fit tells of rivals within it), and last
# steps that have to have fallen by what is left to it.
_RIVAL, _LAST = 5.0, 3
# Fall of half chi-squared that ends a search in the band, which all bins go on from where it counts.
_FALL = 0.1
# Half chi-squared in the band by which an optimum has to be above the known one not to be looked at in all bins.
_HIGHER = 1.0


class OtherOptima:
    """Looks for other optima than ``known``."""

    def __init__(self, search: SpectralSearch, known: Found) -> None:
        self._search, self.known = search, known

    @cached_property
    def ways(self) -> list[Array]:
        """Square roots (nv, nv) of what the parameters may be by the frequencies below an edge alone, within a longest
        step; one for every edge that leaves some direction far more open than all do: optima of a mode above it lie
        within that."""
        known, made = self.known, []
        with np.errstate(all="ignore"):
            try:
                size = np.sqrt(np.diag(known.information))
                root = np.linalg.inv(np.linalg.cholesky(known.information / np.outer(size, size))) / size
                edges = self._search.edges()
                far = np.diag(self._search.limits["longest"](known.minimum.x) ** -2)
                for gram in self._search.grams(known.minimum.x, edges[edges <= known.hertz]):
                    values, vectors = np.linalg.eigh(root @ (gram[1:, 1:] + far) @ root.T)
                    if values[0] > _OPEN**-2:
                        break
                    made.append(root.T @ (vectors / np.sqrt(values)))
            except (FloatingPointError, np.linalg.LinAlgError):
                return []
        return made

    @cached_property
    def _band(self) -> Band:
        return Band(self._search, self.known.hertz)

    @cached_property
    def _goal(self) -> Minimum | None:
        """The known optimum as it is in the band alone."""
        return minimise(self._band, self.known.minimum.x, fall=COARSE, **self._search.limits)

    def run(self, v: Array, *, steps: int, stop: Callable[[float], bool]) -> Found | None:
        """The optimum that a search from v leads to; the known one where that is it, or none that counts (then the
        search has ``strayed``); None where there is nothing to evaluate.

        stop : sees the cost before every step; True ends the search
        """
        band, goal, known = self._band, self._goal, self.known
        if goal is None:
            return None
        told, above = Told(stop), known.minimum.squares.cost - goal.squares.cost
        back = _WayBack(band, goal, self._apart)
        first = minimise(
            band, v, fall=_FALL, steps=steps, stop=lambda cost: told(cost + above) or back(cost),
            round_bends=False, **self._search.limits,
        )  # fmt: skip
        if first is None:
            return None
        told.again()
        ended = replace(known, minimum=replace(known.minimum, steps=first.steps), strayed=False)
        if back.home or self._apart(first.x, goal.x) < _HOME:
            return ended
        if not first.converged:
            return replace(ended, strayed=True)
        higher = first.squares.cost - goal.squares.cost
        if higher > _HIGHER:
            squares = replace(first.squares, cost=known.minimum.squares.cost + higher)
            other = replace(first, squares=squares)
            return replace(known, minimum=other, information=squares.matrix, strayed=True)
        found = self._search.in_all_bins(
            first, band, steps, told, most=known.minimum.squares.cost + _HIGHER,
            rounds=1, there=lambda x: self._apart(x, known.minimum.x) < _HOME,
        )  # fmt: skip
        if found is None or self._apart(found.minimum.x, known.minimum.x) >= _HOME:
            return None if found is None else replace(found, strayed=True)
        return replace(ended, minimum=replace(known.minimum, steps=found.minimum.steps))

    def _apart(self, one: Array, other: Array) -> float:
        """Squared standard errors between two points."""
        return float((one - other) @ self.known.information @ (one - other)) if len(one) else np.inf


class _WayBack:
    """Ends a search at the goal, or where its quadratic holds and leads there (``home``), and on a way to nothing that
    counts."""

    def __init__(self, band: Band, goal: Minimum, apart: Callable[[Array, Array], float]) -> None:
        self._band, self._goal, self._apart, self.home = band, goal, apart, False
        self._seen: list[float] = []

    def __call__(self, cost: float) -> bool:
        """True at an end; asked with half chi-squared of every step."""
        x, goal, risen = self._band.at, self._goal, cost - self._goal.squares.cost
        self._seen.append(cost)
        fell = self._seen[-1 - _LAST] - cost if len(self._seen) > _LAST else np.inf
        self.home = self._apart(x, goal.x) < _HOME
        if self.home or risen > max(fell, _RIVAL):
            return True
        here, moved = self._band(x), x - goal.x
        bent = 0.5 * float(moved @ goal.squares.matrix @ moved)
        if here is not None and abs(risen - bent) < _BENT * bent:
            step = np.linalg.lstsq(here.matrix, here.gradient, rcond=BLIND)[0]
            self.home = self._apart(x - step, goal.x) < _HOME
        return self.home
