"""The search for a linear model's parameters in the band of frequencies in which they act.

A band that holds most of the parameters' Fisher information is searched first; where that ends, all bins are looked
at once, and those above the band enter by their quadratic there while the search goes on to its end. What is found
so is the start of the fit on all samples, whose own steps then have next to nothing left to do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Minimum, Squares, minimise
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.spectral import Common, SpectralRecord
from casadi_engine.estimation.spectral_modes import Room
from casadi_engine.estimation.spectral_squares import (
    Told,
    difference,
    foretold,
    largest_share,
    scaled,
    with_rest,
)

Array = NDArray[np.float64]
Priors = Callable[[Array], tuple[float, Array, Array, Array]]

# Share of the information in any direction of the parameters that bins above the band may hold.
LEFT_OUT = 0.05
# Bands that are compared, from one to the next; the lowest has this share of the bins.
_STEP, _LOWEST = 2**0.5, 1 / 128
# Fall of half chi-squared that ends the search, that which ends it on the band alone, and that which ends it on a band
# before this one, which moves the estimates by more anyhow; bands tried.
_FALL, COARSE, _BEFORE, _BANDS = 1e-5, 1e-2, 0.1, 4
# Looks at all bins, and the move in squared standard errors after which another is taken.
_ROUNDS, _MOVED = 3, 0.1
# Damping where the search goes on with all bins: it is close to the optimum.
_NEAR = 1e-5
# Shares of the band that are searched before it.
_BELOW = (0.25, 0.5)


@dataclass(frozen=True)
class Found:
    """Where a search in the band ended.

    minimum : v (nv,), with the band's squares and those above it by their quadratic; information : (nv, nv) of all bins
    hertz, kept, bins : the band, its number of bins and that of all; share : of the information above it
    strayed : of a search beside a known optimum, True if it did not come back to it
    top : the highest frequency of its bins, of which there are no fewer than parameters ask for
    """

    minimum: Minimum
    information: Array
    hertz: float
    kept: int
    bins: int
    share: float
    strayed: bool = False
    top: float = 0.0

    def scaled(self, share: float) -> Found:
        """The same with all squares times a share: at another noise level."""
        return replace(self, minimum=scaled(self.minimum, share), information=share * self.information)

    def __str__(self) -> str:
        if self.kept == self.bins:
            return f"all {self.bins} frequency bins"
        top = max(self.hertz, self.top)
        return (
            f"{self.kept} of {self.bins} frequency bins up to {top:.4g} Hz; the others by their quadratic "
            f"({100 * self.share:.2g} % of the information)"
        )


class SpectralSearch:
    """Minimises half the summed squares of all records, and priors, over v (nv,) within bounds."""

    def __init__(
        self,
        records: list[RecordTerm],
        priors: Priors,
        low: Array,
        high: Array,
        longest: Callable[[Array], Array],
    ) -> None:
        """longest : (nv,) longest change of each unknown in one step from v."""
        room = Room()
        self.records = [SpectralRecord(record, room) for record in records]
        self.top = max(record.hertz[-1] for record in self.records)
        self._priors = priors
        self.limits: dict[str, Any] = {"low": low, "high": high, "longest": longest}
        self._hertz: float | None = None  # of the band
        self._costs = np.array([np.inf]), np.zeros(1)  # below frequencies, at the first start
        self._first: tuple[Array, Array, Array] | None = None  # products at the point that was asked for last

    def weigh(self, sigma: Array) -> None:
        """Divide the outputs by these standard deviations (ny,)."""
        for record in self.records:
            if not np.array_equal(record.sigma, sigma):
                record.sigma, self._first = sigma, None

    def release(self) -> None:
        """Give back the memory of long records' spectra until they are asked for again."""
        for record in self.records:
            record.release()

    def squares(self, v: Array, hertz: float = np.inf) -> Squares | None:
        """The problem at v on the bins below a frequency; None where the model cannot be evaluated."""
        cost, gradient, _, matrix = self._priors(v)
        gradient, matrix = gradient.copy(), matrix.copy()
        common: Common = {}
        with np.errstate(all="ignore"):
            for record in self.records:
                try:
                    (gram,) = record.gram(v, [record.below(hertz).stop], common)
                except (FloatingPointError, np.linalg.LinAlgError):
                    return None
                own = record.record.active
                cost += 0.5 * float(gram[0, 0])
                gradient[own] += gram[1:, 0]
                matrix[np.ix_(own, own)] += gram[1:, 1:]
        return Squares(cost, gradient, matrix) if np.isfinite(cost) and np.isfinite(matrix).all() else None

    def whole(self, v: Array) -> Array | None:
        """Products (1 + nv, 1 + nv) of residual and Jacobian in all bins; None where the model cannot be evaluated."""
        with np.errstate(all="ignore"):
            try:
                found = self._ladder(v)[1][-1]
            except (FloatingPointError, np.linalg.LinAlgError):
                return None
        return found if np.isfinite(found).all() else None

    def _ladder(self, v: Array) -> tuple[Array, Array]:
        """Frequencies (e,), each a band's, and the products in the bins below them at v."""
        if self._first is None or not np.array_equal(self._first[0], v):
            edges = self.edges()
            self._first = (v.copy(), edges, self.grams(v, edges))
        return self._first[1:]

    def edges(self) -> Array:
        """Frequencies (e,), each a band's, the last one beyond all bins."""
        edges = self.top * _STEP ** np.arange(np.ceil(np.log(_LOWEST) / np.log(_STEP)), 1)
        edges[-1] = np.inf
        return np.asarray(edges)

    def grams(self, v: Array, edges: Array) -> Array:
        """Products (e, 1 + nv, 1 + nv) of residual and Jacobian in the bins below each of the edges, and of priors."""
        cost, gradient, _, matrix = self._priors(v)
        priors = np.block([[2 * cost, gradient], [gradient[:, None], matrix]])
        found = np.repeat(priors[None], len(edges), axis=0)
        common: Common = {}
        for record in self.records:
            entries = np.append(0, 1 + record.record.active)
            stops = [record.below(edge).stop for edge in edges]
            parts = dict(zip(sorted(set(stops)), record.gram(v, sorted(set(stops)), common), strict=True))
            for e, stop in enumerate(stops):
                found[e][np.ix_(entries, entries)] += parts[stop]
        return found

    def band(self, v: Array) -> float:
        """The lowest frequency above which bins hold little of the information at v."""
        edges, grams = self._ladder(v)
        if not np.diag(grams[-1])[1:].all():
            raise FloatingPointError("a parameter has no slope here")
        shares = [largest_share(grams[-1, 1:, 1:], part[1:, 1:]) for part in grams]
        chosen = int(np.argmax(np.array(shares) <= LEFT_OUT))
        self._costs = edges, 0.5 * grams[:, 0, 0]
        return float(edges[chosen])

    def run(self, v: Array, *, steps: int, stop: Callable[[float], bool]) -> Found | None:
        """The optimum that a search from v leads to, or None where there is nothing to evaluate.

        stop : sees the cost before every step, that above the band as it was at first; True ends the search
        """
        with np.errstate(all="ignore"):
            try:
                hertz = self.band(v) if self._hertz is None else self._hertz
            except (FloatingPointError, np.linalg.LinAlgError):
                return None
        told, done = Told(stop), 0
        for tried in range(_BANDS):
            found = self._in_band(v, hertz, max(steps - done, bool(tried)), told)
            if found is None:
                return None
            done += found.minimum.steps
            found = replace(found, minimum=replace(found.minimum, steps=done))
            if not found.minimum.converged or found.share <= 2 * LEFT_OUT:
                break
            v, hertz = found.minimum.x, 2 * hertz
        self._hertz = hertz
        return found

    def from_below(self, v: Array, hertz: float, steps: int) -> Array:
        """Where searches in bands below one lead from v, one after the other.

        Low modes stand out of the noise: the frequency of a high one is close to where they put it, and a search that
        looks for both at once may end at a line of the noise. A start that was near is lost on this way.
        """
        for share in _BELOW:
            band = Band(self, share * min(hertz, self.top))
            found = minimise(band, v, fall=_BEFORE, steps=steps, round_bends=False, **self.limits)
            if found is None:
                break
            v = found.x
            if not found.converged:
                break
        return v

    def _shown(self, told: Callable[[float], bool], hertz: float) -> Callable[[float], bool]:
        """The same for the cost below a frequency, with that above as it was at the first start."""
        edges, costs = self._costs
        above = float(costs[-1] - costs[min(int(np.searchsorted(edges, hertz)), len(costs) - 1)])
        return lambda cost: told(cost + above)

    def _in_band(self, v: Array, hertz: float, steps: int, told: Told) -> Found | None:
        band = Band(self, hertz)
        first = minimise(
            band, v, fall=COARSE if band.kept < band.bins else _FALL, steps=steps, stop=self._shown(told, hertz),
            **self.limits,
        )  # fmt: skip
        if first is None:
            return None
        told.again()
        if not first.converged or band.kept == band.bins:
            return Found(first, first.squares.matrix, hertz, band.kept, band.bins, 0.0, top=band.top)
        return self.in_all_bins(first, band, steps, told)

    def in_all_bins(
        self,
        first: Minimum,
        band: Band,
        steps: int,
        told: Callable[[float], bool],
        *,
        most: float = np.inf,
        rounds: int = _ROUNDS,
        there: Callable[[Array], bool] = lambda _: False,
    ) -> Found | None:
        """From an optimum of a band on, with the other bins by their quadratic; None where there is nothing to
        evaluate.

        most : half chi-squared above which nothing is looked for; rounds : looks at all bins, at most
        there : True at a point at which nothing is looked for
        """
        last, left, found = first, steps - first.steps, None
        for _ in range(rounds):
            whole, part, at = self.squares(last.x), band(last.x), last.x
            if whole is None or part is None:
                return None
            ahead = foretold(whole)
            share = largest_share(whole.matrix, part.matrix)
            if ahead.cost > most:
                high = replace(last, squares=ahead)
                return Found(high, whole.matrix, band.hertz, band.kept, band.bins, share, top=band.top)
            near = minimise(
                with_rest(band, difference(whole, part), at), at, fall=_FALL, steps=max(left, 1),
                damping=_NEAR, stop=lambda cost: told(cost) or there(band.at), **self.limits,
            )  # fmt: skip
            if near is None:
                return None
            left -= near.steps
            last = Minimum(near.x, near.squares, steps - left, near.converged)
            found = Found(last, whole.matrix, band.hertz, band.kept, band.bins, share, top=band.top)
            moved = near.x - at
            if not near.converged or there(near.x) or moved @ whole.matrix @ moved < _MOVED:
                break
        return found


class Band:
    """The problem on the bins below a frequency; remembers the point ``at`` that it was asked for last."""

    def __init__(self, search: SpectralSearch, hertz: float) -> None:
        parts = [record.below(hertz) for record in search.records]
        # no fewer bins than parameters ask for, which a short record has at higher frequencies
        tops = [
            record.hertz[part.stop - 1]
            for record, part in zip(search.records, parts, strict=True)
            if part.stop
        ]
        self._search, self.hertz, self.top = search, hertz, max([hertz, *map(float, tops)])
        self.kept = sum(part.stop for part in parts)
        self.bins = sum(record.size for record in search.records)
        self._found: tuple[Array, Squares | None] | None = None

    @property
    def at(self) -> Array:
        """The point (nv,) that was asked for last; none before."""
        return np.zeros(0) if self._found is None else self._found[0]

    def __call__(self, v: Array) -> Squares | None:
        if self._found is None or not np.array_equal(self._found[0], v):
            self._found = (v, self._search.squares(v, self.hertz))
        return self._found[1]
